"""A thing's own picture, to find it again where it touches others.

Where several things stand out as one, the flow of the larger one drags at the smaller: a small
picture of the thing, taken while it stood alone, is found by its normalised correlation instead
(`cv2.matchTemplate`, TM_CCOEFF_NORMED), to a part of a pixel by a parabola through the peak.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.types import Image

Doubles: TypeAlias = npt.NDArray[np.float64]

_REACH_PX = 4  # grid pixels
_LEAST_SIDE_PX = 5
_LEAST_CONTRAST = 4.0  # grey levels, in one of the channels
_LEAST_CORRELATION = 0.7


@dataclass(frozen=True, slots=True, eq=False)
class Likeness:
    """Picture (h, w, 3) of a thing in the grid, and where its box's corner lies in it (2,)."""

    picture: Image
    corner: Doubles

    @classmethod
    def taken(cls, image: Image, grid_box: Doubles) -> Likeness | None:
        """What is seen in a box of the grid; None if that is too little to be found again."""
        low, high = np.rint(grid_box.reshape(2, 2)).astype(int)
        if (low < 0).any() or (high > np.array(image.shape[1::-1]) - 1).any():
            return None
        picture = image[low[1] : high[1] + 1, low[0] : high[0] + 1]
        if (
            min(picture.shape[:2]) < _LEAST_SIDE_PX
            or float(cv2.meanStdDev(picture)[1].max()) < _LEAST_CONTRAST
        ):
            return None
        return cls(picture.copy(), grid_box[:2] - low)

    def find(self, image: Image, grid_box: Doubles, further_px: int = 0) -> Doubles | None:
        """By how much (2,) grid pixels it lies beside a box; None where it is not seen.

        It is looked for up to ``further_px`` further away.
        """
        reach = _REACH_PX + further_px
        corner = grid_box[:2] - self.corner
        low = np.rint(corner).astype(int) - reach
        height, width = self.picture.shape[:2]
        high = low + np.array([width, height]) + 2 * reach
        if (low < 0).any() or (high > image.shape[1::-1]).any():
            return None
        around = image[low[1] : high[1], low[0] : high[0]]
        scores = cv2.matchTemplate(around, self.picture, cv2.TM_CCOEFF_NORMED)
        _, best, _, (x, y) = cv2.minMaxLoc(scores)
        last = 2 * reach
        if best < _LEAST_CORRELATION or not (0 < x < last and 0 < y < last):
            return None
        peak = np.array(
            [x + _vertex(scores[y, x - 1 : x + 2]), y + _vertex(scores[y - 1 : y + 2, x])]
        )
        return np.asarray(low + peak - corner, np.float64)


def _vertex(values: npt.NDArray[Any]) -> float:
    """Where the parabola through three values has its top, from the middle one."""
    before, middle, after = values.tolist()
    bend = before - 2 * middle + after
    return 0.5 * (before - after) / bend if bend < -1e-9 else 0.0
