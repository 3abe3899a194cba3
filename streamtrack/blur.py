"""Motion blur: how a frame is smeared against the template, and the template smeared alike.

A picture moving along d while the shutter is open loses gradient energy along d and none across
it. So the direction is the generalised eigenvector of the two pictures' structure tensors that
lost most, and the length is the one that costs the template as much.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.types import Image, Mask

Doubles = npt.NDArray[np.float64]

_SHARP_RATIO = 0.7
_LENGTHS_PX = (2.0, 3.0, 4.5, 6.5, 9.0, 12.5, 17.0)


def motion_blur(template: Image, seen: Image, area: Mask) -> Doubles:
    """The vector (2,), in pixels, along which ``seen`` is smeared against ``template``.

    Both (h, w) and about aligned; ``area`` (h, w) is where they show the same. Zero if the
    picture is as sharp as the template, or equally blurred in all directions.
    """
    sharp, smeared = _structure(template, area), _structure(seen, area)
    try:
        values, vectors = np.linalg.eig(np.linalg.solve(sharp, smeared))
    except np.linalg.LinAlgError:
        return np.zeros(2)
    values = np.real(values)
    if not values.max() > 0 or values.min() > _SHARP_RATIO * values.max():
        return np.zeros(2)
    along = np.real(vectors[:, values.argmin()])
    along = along / np.linalg.norm(along)
    across = np.array([-along[1], along[0]])
    wanted = _energy_ratio(smeared, sharp, along, across)
    for length_px in _LENGTHS_PX:
        vector = along * length_px
        if (
            _energy_ratio(_structure(smeared_along(template, vector), area), sharp, along, across)
            <= wanted
        ):
            return vector
    return along * _LENGTHS_PX[-1]


def smeared_along(image: Image, vector: Doubles) -> Image:
    """``image`` averaged along a line of length and direction ``vector`` (2,), in pixels."""
    reach = int(np.ceil(np.abs(vector).max() / 2)) + 1
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    for share in np.linspace(-0.5, 0.5, 4 * int(np.ceil(np.linalg.norm(vector))) + 1):
        x, y = reach + share * vector
        column, row = int(x), int(y)
        fx, fy = x - column, y - row
        kernel[row : row + 2, column : column + 2] += np.outer((1 - fy, fy), (1 - fx, fx))
    kernel /= kernel.sum()
    return np.asarray(cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REPLICATE), np.uint8)


def _structure(image: Image, area: Mask) -> Doubles:
    """Sum of the gradients' outer products (2, 2) over an area, kept away from singular."""
    gx = cv2.Sobel(image, cv2.CV_32F, 1, 0, ksize=3)[area]
    gy = cv2.Sobel(image, cv2.CV_32F, 0, 1, ksize=3)[area]
    gradients = np.stack([gx, gy])
    return (gradients @ gradients.T).astype(np.float64) + np.eye(2)


def _energy_ratio(smeared: Doubles, sharp: Doubles, along: Doubles, across: Doubles) -> float:
    """Share of the gradient energy left along a direction, against that left across it."""
    left_along = (along @ smeared @ along) / (along @ sharp @ along)
    left_across = (across @ smeared @ across) / (across @ sharp @ across)
    return float(left_along / max(left_across, 1e-12))
