"""Views compared with each other at a quarter of the size, each pair once for many blocks."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import TypeVar

import numpy as np

from streamtrack.mosaic.stream.painting import disagreement, quarter
from streamtrack.mosaic.stream.render import Renderer
from streamtrack.mosaic.stream.tiles import Box, common_box, is_empty
from streamtrack.mosaic.stream.views import View
from streamtrack.types import Image, Mask

Cells = TypeVar("Cells", Image, Mask)


class Comparisons:
    """Of the views of one block what is not known from the block before.

    Boxes are given in pixels of the picture, in whole blocks of 4 x 4.
    """

    def __init__(self, renderer: Renderer) -> None:
        self._renderer = renderer
        self._small: dict[int, tuple[Box, Image]] = {}
        self._differs: dict[tuple[int, int], tuple[Box, Mask] | None] = {}

    def small(self, views: Sequence[View], box: Box) -> list[Image]:
        """What each view shows in a box, BGRW (h, w, 4)."""
        known = self._small
        self._small = {
            view.number: known.get(view.number) or self._renderer.shrunk(view) for view in views
        }
        return [_placed(*self._small[view.number], quarter(box)) for view in views]

    def differs(self, views: Sequence[View], box: Box) -> dict[tuple[int, int], Mask]:
        """Where pairs of views, by their rows here, disagree in a box (h, w); see `small` first."""
        pairs = list(combinations(range(len(views)), 2))
        numbers = [(views[a].number, views[b].number) for a, b in pairs]
        known = self._differs
        self._differs = {
            pair: known[pair] if pair in known else self._compared(*pair) for pair in numbers
        }
        result = {}
        for rows, pair in zip(pairs, numbers, strict=True):
            found = self._differs[pair]
            if found is not None and (mask := _placed(*found, quarter(box))).any():
                result[rows] = mask
        return result

    def _compared(self, a: int, b: int) -> tuple[Box, Mask] | None:
        (box_a, small_a), (box_b, small_b) = self._small[a], self._small[b]
        both = common_box(box_a, box_b)
        if is_empty(both):
            return None
        mask = disagreement(_cut(small_a, box_a, both), _cut(small_b, box_b, both)) > 0
        return (both, mask) if mask.any() else None


def _cut(cells: Cells, box: Box, part: Box) -> Cells:
    x0, y0, x1, y1 = part
    return np.ascontiguousarray(cells[y0 - box[1] : y1 - box[1], x0 - box[0] : x1 - box[0]])


def _placed(box: Box, cells: Cells, into: Box) -> Cells:
    """Cells that lie in one box laid into another, 0 around."""
    result = np.zeros((into[3] - into[1], into[2] - into[0], *cells.shape[2:]), cells.dtype)
    part = common_box(box, into)
    if not is_empty(part):
        result[part[1] - into[1] : part[3] - into[1], part[0] - into[0] : part[2] - into[0]] = _cut(
            cells, box, part
        )
    return result
