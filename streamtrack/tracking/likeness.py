"""How a warped frame is made like the patch, and where it is like it."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.fitting import median
from streamtrack.tracking.refine import contrast_gain
from streamtrack.tracking.template import CORRELATION_WINDOW, Patch, window_means
from streamtrack.types import Image, Mask

Floats = npt.NDArray[np.float32]
Rows = npt.NDArray[np.intp]

_NOISE_VARIANCE = 9.0  # grey levels squared


def matched_in_grey(image: Image, patch: Patch, visible: Mask) -> Image:
    """The warped frame with its contrast and brightness brought to the patch's.

    Fitted robustly (median and quartiles) at the visible points, so that an occluder of less
    than half the target does not set them. DIS itself removes the mean of each small block.
    """
    columns, rows = patch.points[visible].astype(np.intp).T
    ours, theirs = np.sort(patch.image[rows, columns]), np.sort(image[rows, columns])
    low, middle, high = (int(share * len(ours)) for share in (0.2, 0.5, 0.8))
    ours_range, theirs_range = (int(v[high]) - int(v[low]) + 2 for v in (ours, theirs))
    gain = min(4.0, max(0.3, ours_range / theirs_range))
    shift = float(ours[middle]) - gain * float(theirs[middle])
    adjusted = cv2.convertScaleAbs(image, alpha=gain, beta=shift)
    return np.asarray(adjusted, np.uint8)


def moved_by(image: Image, field: Floats) -> Image:
    """``image`` sampled at each pixel's place plus its flow (h, w, 2)."""
    places = field + _pixel_grid(*image.shape)
    # Both coordinates stand in the first map; OpenCV's stubs do not know that this is allowed.
    warped = cv2.remap(  # type: ignore[call-overload]
        image, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(warped, np.uint8)


@lru_cache(maxsize=32)
def _pixel_grid(height: int, width: int) -> Floats:
    """Each pixel's own place, (h, w, 2)."""
    columns, rows = np.meshgrid(
        np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)
    )
    return np.stack([columns, rows], axis=2)


def local_correlation(patch: Patch, seen: Image, rows: Rows, columns: Rows) -> Floats:
    """Normalised cross-correlation (N,) in -1..1 of the windows around pixels of the patch.

    The variance of plain noise is added to the denominator, so flat windows score zero.
    """
    window = (CORRELATION_WINDOW, CORRELATION_WINDOW)
    product = cv2.multiply(patch.image, seen, dtype=cv2.CV_32F)
    mean, square, product = (
        np.asarray(picture, np.float32)[rows, columns]
        for picture in (
            cv2.boxFilter(seen, cv2.CV_32F, window),
            cv2.sqrBoxFilter(seen, cv2.CV_32F, window),
            cv2.boxFilter(product, -1, window),
        )
    )
    patch_mean, patch_variance = (
        patch.windows.mean[rows, columns],
        patch.windows.variance[rows, columns],
    )
    covariance = product - patch_mean * mean
    variance = square - mean * mean + _NOISE_VARIANCE
    scale = np.sqrt((patch_variance + _NOISE_VARIANCE) * variance)
    return np.asarray(covariance / scale, np.float32)


def shift_left(patch: Patch, smooth: Floats, rows: Rows, columns: Rows, visible: Mask) -> Floats:
    """By how many pixels (N, 2) the windows around the visible points of a patch are still off.

    One step of Lucas & Kanade (1981) with the template's gradients; ``smooth`` (h, w) is the frame
    warped back and high-passed.
    """
    ours = patch.gradients
    contrast = median(np.abs(ours.smooth[rows, columns]))
    residual = contrast_gain(contrast, smooth[rows, columns]) * smooth - ours.smooth
    x, y = (
        window_means(np.asarray(cv2.multiply(gradient, residual), np.float32))[rows, columns]
        for gradient in (ours.gx, ours.gy)
    )
    (xx, xy), (_, yy) = patch.softness[visible].transpose(1, 2, 0)
    return -np.stack([xx * x + xy * y, xy * x + yy * y], axis=1)
