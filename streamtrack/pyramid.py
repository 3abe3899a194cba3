"""A grey picture at halved resolutions, and its one way of being warped.

Template and frame are warped by the same routine, so that their pixels are smoothed alike and a
target that does not move stays where it is to the last hundredth of a pixel.
"""

from __future__ import annotations

from math import log2

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.types import Image, Matrix, Size

_MAX_OCTAVE = 5


class Pyramid:
    """The picture (H, W) and its halves, each made when first needed."""

    def __init__(self, grey: Image) -> None:
        self._levels = [grey]

    @property
    def grey(self) -> Image:
        """The picture at full resolution."""
        return self._levels[0]

    @property
    def size_wh(self) -> Size:
        return self.grey.shape[1], self.grey.shape[0]

    def warped(self, picture_from_patch: Matrix, size_wh: Size) -> Image:
        """What a patch of ``size_wh`` sees of the picture, from the level of like resolution."""
        centre = np.array([size_wh[0] / 2, size_wh[1] / 2])
        picture_px = geometry.local_scale(picture_from_patch, centre)
        octave = max(0, min(_MAX_OCTAVE, round(log2(max(picture_px, 1e-3)))))
        level = self.level(octave)
        level_from_patch = picture_from_patch
        if octave:
            width, height = self.size_wh
            level_from_picture = geometry.scaling(level.shape[1] / width, level.shape[0] / height)
            level_from_patch = level_from_picture @ picture_from_patch
        warped = cv2.warpPerspective(
            level,
            level_from_patch,
            size_wh,
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        return np.asarray(warped, np.uint8)

    def level(self, octave: int) -> Image:
        """The picture halved ``octave`` times."""
        while len(self._levels) <= octave:
            finer = self._levels[-1]
            size = max(1, finer.shape[1] // 2), max(1, finer.shape[0] // 2)
            coarser = cv2.resize(finer, size, interpolation=cv2.INTER_AREA)
            self._levels.append(np.asarray(coarser, np.uint8))
        return self._levels[octave]


def high_passed(image: Image, window_px: int) -> npt.NDArray[np.float32]:
    """Grey values (H, W), slightly smoothed, minus their mean in the window around."""
    smooth = cv2.GaussianBlur(image, (3, 3), 0.8)
    around = cv2.boxFilter(smooth, cv2.CV_32F, (window_px, window_px))
    return np.asarray(cv2.subtract(smooth, around, dtype=cv2.CV_32F), np.float32)
