"""Does the scene agree, or only what stands still in both pictures?

A stamped date, a logo, a frame, the black around a round view or dirt on the lens lie at the same
place in every picture, and agree perfectly. A mapping that hardly moves anything may rest on them
alone: then the rest of the two pictures says so, for a scene seen twice from one place is alike
nearly everywhere.
"""

from __future__ import annotations

from itertools import product

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.mosaic.pairs.subpixel import Overlap
from streamtrack.types import Mask, Matrix, Points, Size

Floats = npt.NDArray[np.float32]

_STANDING_SHARE = 0.01  # of a picture's diagonal
_MOST = 0.8
_ANCHORS = (0.0, 0.5, 1.0)

_SIDES_PX = 160, 40
_WINDOW_PX = 9
_ROUND_ABOUT_PX = 19
_MIN_VARIANCE = 3.0
_NOISE_VARIANCE = 0.5
_ALIKE = 0.3
_MAX_UNLIKE_SHARE = 0.22


def overlay_like(a_points: Points, b_points: Points, a_wh: Size, b_wh: Size) -> Matrix | None:
    """How an overlay lies in picture b, from picture a, if most pairs (M, 2) move no otherwise.

    Overlays are scaled with the picture, or keep their size and their distance from a corner, the
    middle of a side or the centre. None if the pairs move by more than 1 % of b's diagonal.
    """
    wider, higher = b_wh[0] - a_wh[0], b_wh[1] - a_wh[1]
    overlays = [geometry.scaling(b_wh[0] / a_wh[0], b_wh[1] / a_wh[1])]
    if (wider, higher) != (0, 0):
        overlays += [
            geometry.translation(x * wider, y * higher) for x, y in product(_ANCHORS, _ANCHORS)
        ]
    for overlay in overlays:
        standing = np.count_nonzero(stands(a_points, b_points, overlay, b_wh))
        if standing > 0 and standing >= _MOST * len(a_points):
            return overlay
    return None


def stands(a_points: Points, b_points: Points, b_from_overlay: Matrix, b_wh: Size) -> Mask:
    """Which pairs (M,) lie as an overlay would, give or take 1 % of picture b's diagonal."""
    off = geometry.transform_points(b_from_overlay, a_points) - b_points
    is_near: Mask = np.hypot(off[:, 0], off[:, 1]) <= _STANDING_SHARE * float(np.hypot(*b_wh))
    return is_near


def scene_differs(overlap: Overlap) -> bool:
    """Is more not alike than movers before a standing camera, noise and compression explain?"""
    return any(_unlike_share(overlap, side) > _MAX_UNLIKE_SHARE for side in _SIDES_PX)


def _unlike_share(overlap: Overlap, side_px: int) -> float:
    """How much of what shows anything is not alike in the two renderings, 0..1.

    Correlation in windows of 9 pixels, the pictures reduced to ``side_px``: noise and blur are
    gone there, and what is laid over them has shrunk to what it is of the whole.
    """
    width, height = overlap.size_wh
    factor = min(1.0, side_px / max(width, height))
    size = max(_WINDOW_PX, round(width * factor)), max(_WINDOW_PX, round(height * factor))

    def small(image: npt.NDArray[np.uint8]) -> Floats:
        return np.asarray(cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_AREA))

    seen = (small(overlap.covered) > 250).astype(np.float32)

    def mean(values: Floats, window: int) -> Floats:
        weight = cv2.blur(seen, (window, window)) + np.float32(1e-3)
        return np.asarray(cv2.blur(values * seen, (window, window)) / weight, np.float32)

    near, far = (
        image - mean(image, _ROUND_ABOUT_PX) for image in (small(overlap.near), small(overlap.far))
    )
    near_mean, far_mean = mean(near, _WINDOW_PX), mean(far, _WINDOW_PX)
    near_variance = mean(near * near, _WINDOW_PX) - near_mean**2
    far_variance = mean(far * far, _WINDOW_PX) - far_mean**2
    covariance = mean(near * far, _WINDOW_PX) - near_mean * far_mean
    shows = (seen > 0) & (np.maximum(near_variance, far_variance) > _MIN_VARIANCE)
    scale = np.sqrt((near_variance + _NOISE_VARIANCE) * (far_variance + _NOISE_VARIANCE))
    unlike = shows & (covariance < _ALIKE * scale)
    return float(np.count_nonzero(unlike)) / max(float(np.count_nonzero(shows)), 1.0)
