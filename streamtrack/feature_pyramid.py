"""The image pyramid on which corner detectors run, and its division into parts of like cost."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.geometry import scaling
from streamtrack.types import Image, Size

PYRAMID_STEP = 2**0.5
_MIN_LEVEL_PX = 48
_MOST_LEVELS = 6
_PART_PX = 160_000
"""About as much of the pyramid as is searched in one turn: half of a 640x480 picture."""

_AT_ONCE_PX = 900_000


@dataclass(frozen=True, slots=True)
class Band:
    """Rows of a level of the pyramid."""

    level: int
    first_row: int
    end_row: int


def part_of_pyramid(size_wh: Size, turn: int | None) -> list[Band]:
    """What one turn of a search sees: all coarse parts in turn, then a fine one, and again.

    Turn None sees the coarse levels at once, as many as a search of 640x480 takes time for.
    """
    if turn is None:
        return _at_once(size_wh)
    coarse, fine = _parts(size_wh)
    round_of_coarse, place = divmod(turn, len(coarse) + (1 if fine else 0))
    return coarse[place] if place < len(coarse) else fine[round_of_coarse % len(fine)]


@cache
def _at_once(size_wh: Size) -> list[Band]:
    bands: list[Band] = []
    area = 0
    for number in range(level_count(size_wh) - 1, -1, -1):
        width, height = _level_size(size_wh, number)
        area += width * height
        if bands and area > _AT_ONCE_PX:
            break
        bands.insert(0, Band(number, 0, height))
    return bands


@cache
def _parts(size_wh: Size) -> tuple[list[list[Band]], list[list[Band]]]:
    """Levels that are seen as a whole, the small ones together, and the bands of larger ones."""
    sizes = [_level_size(size_wh, number) for number in range(level_count(size_wh))]
    whole = [[Band(number, 0, height)] for number, (_, height) in enumerate(sizes)]
    areas = [width * height for width, height in sizes]
    small = [band for area, (band,) in zip(areas, whole, strict=True) if 2 * area <= _PART_PX]
    coarse = [small] if small else []
    fine: list[list[Band]] = []
    for number in range(len(sizes) - len(small) - 1, -1, -1):
        height = sizes[number][1]
        count = max(1, round(areas[number] / _PART_PX))
        edges = [round(height * share / count) for share in range(count + 1)]
        bands = [[Band(number, *pair)] for pair in pairwise(edges)]
        (coarse if count == 1 else fine).extend(bands)
    return coarse, fine


def level_count(size_wh: Size) -> int:
    """How many levels the pyramid of a picture has."""
    count = 1
    while count < _MOST_LEVELS and min(_level_size(size_wh, count)) >= _MIN_LEVEL_PX:
        count += 1
    return count


def _level_size(size_wh: Size, number: int) -> Size:
    factor = PYRAMID_STEP**-number
    return round(size_wh[0] * factor), round(size_wh[1] * factor)


def pyramid(grey: Image, deepest: int | None = None) -> list[tuple[Image, npt.NDArray[np.float64]]]:
    """(level picture, full_from_level), each smaller by `PYRAMID_STEP`, down to the ``deepest``.

    Every second level halves the one two above it, the others lie between: OpenCV takes a mean
    over areas fast only where they are whole pixels, and for one step of `PYRAMID_STEP` linear
    interpolation smooths as much, in a tenth of the time.
    """
    size_wh = grey.shape[1], grey.shape[0]
    count = level_count(size_wh) if deepest is None else deepest + 1
    levels = [(grey, np.eye(3))]
    for number in range(1, count):
        width, height = _level_size(size_wh, number)
        is_between = number % 2 == 1
        source = levels[-1 if is_between else -2][0]
        interpolation = cv2.INTER_LINEAR_EXACT if is_between else cv2.INTER_AREA
        level = cv2.resize(source, (width, height), interpolation=interpolation)
        full_from_level = scaling(size_wh[0] / width, size_wh[1] / height)
        levels.append((np.asarray(level, np.uint8), full_from_level))
    return levels


def quotas(levels: int, total: int) -> list[int]:
    """Keypoints a level may keep: falling by the pyramid step, `total` in sum."""
    shares = PYRAMID_STEP ** -np.arange(levels, dtype=np.float64)
    return [max(1, round(total * share)) for share in shares / shares.sum()]
