"""Sparse square tiles of a canvas: made on first touch, the longest unused ones kept on disk."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator

import numpy as np

from streamtrack.mosaic.spill import Slot, SpillFile
from streamtrack.types import Image

TILE = 256
"""Side of a tile in pixels."""

TILE_BYTES = TILE * TILE * 4
_MIN_KEPT = 4

TileKey = tuple[int, int]
"""(column, row) of a tile; both may be negative, for the origin is virtual."""

Box = tuple[int, int, int, int]
"""x0, y0, x1, y1 in whole pixels, the last ones left out."""


def tile_keys(box: Box) -> Iterator[TileKey]:
    """The tiles that a box touches, row by row."""
    x0, y0, x1, y1 = box
    if x1 <= x0 or y1 <= y0:
        return
    for ty in range(y0 // TILE, (y1 - 1) // TILE + 1):
        for tx in range(x0 // TILE, (x1 - 1) // TILE + 1):
            yield tx, ty


def tile_box(key: TileKey) -> Box:
    """The pixels of a tile."""
    x0, y0 = key[0] * TILE, key[1] * TILE
    return x0, y0, x0 + TILE, y0 + TILE


def common_box(one: Box, other: Box) -> Box:
    """What two boxes have in common; see `is_empty`."""
    return (
        max(one[0], other[0]),
        max(one[1], other[1]),
        min(one[2], other[2]),
        min(one[3], other[3]),
    )


def grown(box: Box, by: int) -> Box:
    """A box with so many pixels more on each side."""
    return box[0] - by, box[1] - by, box[2] + by, box[3] + by


def is_empty(box: Box) -> bool:
    """Whether a box holds no pixel."""
    return box[0] >= box[2] or box[1] >= box[3]


class TileStore:
    """Tiles uint8 (256, 256, 4) by key: blue, green, red and weight, 0 where nothing is painted.

    At most ``max_bytes`` of them stay in memory (but never fewer than four), the least recently
    used go to the spill file. A clean tile that came back from disk is dropped, not written again.
    """

    def __init__(self, max_bytes: int, spill: SpillFile) -> None:
        self._kept_at_most = max(_MIN_KEPT, max_bytes // TILE_BYTES)
        self._spill = spill
        self._kept: OrderedDict[TileKey, Image] = OrderedDict()
        self._slots: dict[TileKey, Slot] = {}
        self._unsaved: set[TileKey] = set()

    def __contains__(self, key: TileKey) -> bool:
        return key in self._kept or key in self._slots

    def __len__(self) -> int:
        return len(self._slots.keys() | self._kept.keys())

    def keys(self) -> list[TileKey]:
        """All tiles, in memory and on disk, in order."""
        return sorted(self._slots.keys() | self._kept.keys())

    @property
    def in_memory(self) -> int:
        """How many tiles are in memory."""
        return len(self._kept)

    def get(self, key: TileKey) -> Image | None:
        """A tile to be read, None if it was never made. Raises OutputError if the disk fails."""
        tile = self._kept.get(key)
        if tile is not None:
            self._kept.move_to_end(key)
            return tile
        slot = self._slots.get(key)
        if slot is None:
            return None
        data = np.frombuffer(bytearray(self._spill.get(slot)), np.uint8)
        return self._keep(key, data.reshape(TILE, TILE, 4))

    def make(self, key: TileKey) -> Image:
        """A tile to be written to, made if need be.

        Raises OutputError if there is no room for a new one: neither in memory nor on disk.
        """
        tile = self.get(key)
        if tile is None:
            tile = self._keep(key, np.zeros((TILE, TILE, 4), np.uint8))
        self._unsaved.add(key)
        return tile

    def _keep(self, key: TileKey, tile: Image) -> Image:
        while len(self._kept) >= self._kept_at_most:
            self._evict()
        self._kept[key] = tile
        return tile

    def _evict(self) -> None:
        key, tile = next(iter(self._kept.items()))
        if key in self._unsaved:
            slot = self._spill.put(tile.tobytes())
            if key in self._slots:
                self._spill.free(self._slots[key])
            self._slots[key] = slot
            self._unsaved.discard(key)
        del self._kept[key]
