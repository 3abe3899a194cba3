"""The parts of a search together see the whole pyramid, and each is small."""

from __future__ import annotations

import numpy as np
import pytest

from streamtrack.feature_pyramid import level_count, part_of_pyramid, pyramid
from streamtrack.types import Size

_TURNS = 200
_MOST_PX = 260_000


@pytest.mark.parametrize("size_wh", [(640, 480), (1280, 720), (320, 240), (97, 61), (1920, 1080)])
def test_parts_cover_every_row_of_every_level_and_are_small(size_wh: Size) -> None:
    levels = pyramid(np.zeros((size_wh[1], size_wh[0]), np.uint8))
    assert len(levels) == level_count(size_wh)
    seen = [np.zeros(len(level), bool) for level, _ in levels]
    for turn in range(_TURNS):
        area = 0
        for band in part_of_pyramid(size_wh, turn):
            level = levels[band.level][0]
            assert 0 <= band.first_row < band.end_row <= len(level)
            seen[band.level][band.first_row : band.end_row] = True
            area += (band.end_row - band.first_row) * level.shape[1]
        assert area <= _MOST_PX
    assert all(rows.all() for rows in seen)


def test_a_shallow_pyramid_is_the_start_of_the_whole() -> None:
    grey = np.random.default_rng(1).integers(0, 256, (300, 400), np.uint8)
    whole, shallow = pyramid(grey), pyramid(grey, 2)
    assert len(shallow) == 3
    for (a, a_matrix), (b, b_matrix) in zip(whole, shallow, strict=False):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a_matrix, b_matrix)


@pytest.mark.parametrize("size_wh", [(640, 480), (1280, 720), (97, 61), (1920, 1080)])
def test_what_is_seen_at_once_are_whole_coarse_levels_in_bounded_time(size_wh: Size) -> None:
    heights = [len(level) for level, _ in pyramid(np.zeros((size_wh[1], size_wh[0]), np.uint8))]
    bands = part_of_pyramid(size_wh, None)
    numbers = [band.level for band in bands]
    assert numbers == list(range(numbers[0], len(heights)))
    assert all((b.first_row, b.end_row) == (0, heights[b.level]) for b in bands)
    assert (numbers[0] == 0) == (size_wh[0] <= 640)
