"""Which parts of the world were seen how often, and when: small square cells, sparse."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.types import Mask, Matrix, Points, Size

_BLOCK = 64
Values: TypeAlias = npt.NDArray[np.int32]


@dataclass(frozen=True, slots=True, eq=False)
class Footprint:
    """The cells that a frame sees: ``seen`` (rows, columns) from cell (x, y) on."""

    x: int
    y: int
    seen: Mask

    @property
    def count(self) -> int:
        return int(np.count_nonzero(self.seen))


def footprint(
    world_from_frame: Matrix, size_wh: Size, cell_px: float, hidden: Sequence[Points] = ()
) -> Footprint:
    """The cells whose centres lie inside a frame. ``cell_px`` is their side in world pixels.

    Those that lie in the quads ``hidden`` (4, 2) of the frame are not seen.
    """
    quad = geometry.transform_points(world_from_frame, geometry.image_quad(size_wh))
    x0, y0, x1, y1 = (int(np.floor(v / cell_px)) for v in geometry.bounding_box(quad))
    x = (np.arange(x0, x1 + 1) + 0.5) * cell_px
    y = ((np.arange(y0, y1 + 1) + 0.5) * cell_px)[:, None]
    ax, ay = quad.astype(np.float64).T[:, :, None, None]
    along_x, along_y = np.roll(ax, -1, axis=0) - ax, np.roll(ay, -1, axis=0) - ay
    seen = (along_x * (y - ay) >= along_y * (x - ax)).all(axis=0)  # clockwise: inside is right
    for outline in hidden:
        there = geometry.transform_points(world_from_frame, outline) / cell_px
        polygon = np.rint(np.clip(there - (x0 + 0.5, y0 + 0.5), -1e4, 1e4)).astype(np.int32)
        inside = np.zeros(seen.shape, np.uint8)
        cv2.fillConvexPoly(inside, polygon, 1)
        seen &= inside == 0
    return Footprint(x0, y0, seen)


class CellGrid:
    """Whole numbers by cell, 0 where nothing was written; grows in all directions."""

    def __init__(self) -> None:
        self._blocks: dict[tuple[int, int], Values] = {}

    def read(self, where: Footprint) -> Values:
        """The values under a footprint's rectangle (rows, columns), a copy."""
        values = np.zeros(where.seen.shape, np.int32)
        for key, there, here in _parts(where):
            if key in self._blocks:
                values[here] = self._blocks[key][there]
        return values

    def write(self, where: Footprint, values: Values) -> None:
        """Set the values of the cells that the footprint sees."""
        for key, there, here in _parts(where):
            seen = where.seen[here]
            if seen.any():
                block = self._blocks.setdefault(key, np.zeros((_BLOCK, _BLOCK), np.int32))
                block[there][seen] = values[here][seen]

    def add(self, where: Footprint, amount: int) -> None:
        """Add to the cells that the footprint sees."""
        self.write(where, self.read(where) + np.int32(amount))


Part: TypeAlias = tuple[tuple[int, int], tuple[slice, slice], tuple[slice, slice]]


def _parts(where: Footprint) -> list[Part]:
    """Key of each block that is touched, and the common part in the block and in the footprint."""
    rows, columns = where.seen.shape
    parts: list[Part] = []
    for by in range(where.y // _BLOCK, (where.y + rows - 1) // _BLOCK + 1):
        for bx in range(where.x // _BLOCK, (where.x + columns - 1) // _BLOCK + 1):
            x0, y0 = max(where.x, bx * _BLOCK), max(where.y, by * _BLOCK)
            x1 = min(where.x + columns, (bx + 1) * _BLOCK)
            y1 = min(where.y + rows, (by + 1) * _BLOCK)
            there = (
                slice(y0 - by * _BLOCK, y1 - by * _BLOCK),
                slice(x0 - bx * _BLOCK, x1 - bx * _BLOCK),
            )
            here = slice(y0 - where.y, y1 - where.y), slice(x0 - where.x, x1 - where.x)
            parts.append(((bx, by), there, here))
    return parts
