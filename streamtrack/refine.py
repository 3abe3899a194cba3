"""Sub-pixel refinement of a pose on the grey values themselves.

Inverse compositional alignment (Baker & Matthews 2004, section 3.2) of the frame, warped back by
the pose, with the template's patch: the Jacobian belongs to the template and is computed once.
Both are high-pass filtered, so that light that changes smoothly over the target drops out, and
the residuals are weighted by Tukey's biweight, so that occluders and highlights do.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.geometry import transform_points
from streamtrack.types import Image, Matrix, Points

Floats = npt.NDArray[np.float32]

PIXELS = 3500
_HIGH_PASS_PX = 17
_ROUNDS = 3
_CONVERGED_PX = 0.01
_MIN_PIXELS = 60


@dataclass(frozen=True, slots=True, eq=False)
class Gradients:
    """The patch's most informative pixels.

    index     int (N,) places in the flattened patch
    values    float32 (N,) high-passed grey values there
    jacobian  float32 (N, 8) change of a value with the homography's parameters
    unit_from_patch  coordinates in which those parameters are well scaled
    """

    index: npt.NDArray[np.intp]
    values: Floats
    jacobian: Floats
    unit_from_patch: Matrix


def make_gradients(image: Image, inside: npt.NDArray[np.bool_]) -> Gradients:
    """The pixels of a patch (h, w) with the strongest gradients, from every part of it."""
    smooth = high_passed(image)
    gx = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    gy = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
    height, width = image.shape
    strength = np.where(inside, np.hypot(gx, gy), 0)
    # Relative to its surroundings, so that one strong texture does not take all the pixels.
    around = cv2.boxFilter(strength.astype(np.float32), -1, (31, 31)) + 1.0
    index = np.argsort(-(strength / np.sqrt(around)).ravel(), kind="stable")[:PIXELS]
    index = np.sort(index[strength.ravel()[index] > 1.0])
    scale = 2.0 / max(width, height)
    unit_from_patch = np.array(
        [[scale, 0, -scale * (width - 1) / 2], [0, scale, -scale * (height - 1) / 2], [0, 0, 1]]
    )
    x = (index % width) * unit_from_patch[0, 0] + unit_from_patch[0, 2]
    y = (index // width) * unit_from_patch[1, 1] + unit_from_patch[1, 2]
    # Gradients per unit coordinate.
    gx, gy = gx.ravel()[index] / scale, gy.ravel()[index] / scale
    radial = gx * x + gy * y
    jacobian = np.stack(
        [gx * x, gx * y, gx, gy * x, gy * y, gy, -x * radial, -y * radial], axis=1
    ).astype(np.float32)
    return Gradients(index, smooth.ravel()[index], jacobian, unit_from_patch)


def high_passed(image: Image) -> Floats:
    """Grey values minus their local mean."""
    values = cv2.GaussianBlur(image, (3, 3), 0.8).astype(np.float32)
    return values - cv2.blur(values, (_HIGH_PASS_PX, _HIGH_PASS_PX))
