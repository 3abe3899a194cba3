"""A canvas without edges: sparse tiles around a virtual origin, read and written box by box."""

from __future__ import annotations

import numpy as np

from streamtrack.mosaic.spill import SpillFile
from streamtrack.mosaic.stream.preview import Preview
from streamtrack.mosaic.stream.tiles import (
    TILE,
    Box,
    TileKey,
    TileStore,
    common_box,
    tile_box,
    tile_keys,
)
from streamtrack.types import Image


class Canvas:
    """Pixels uint8 (H, W, 4): blue, green, red, weight (0: not painted), at any whole place.

    It grows in all directions at the same cost; memory is bounded by ``max_bytes``, the rest is
    in ``spill``. All methods raise OutputError if a tile finds room neither in memory nor on disk.
    """

    def __init__(self, max_bytes: int, spill: SpillFile, preview_side: int = 1024) -> None:
        self.tiles = TileStore(max_bytes, spill)
        self.preview = Preview(preview_side)
        self._changed: dict[TileKey, None] = {}

    def read(self, box: Box) -> Image:
        """The pixels of a box, a copy."""
        pixels = np.zeros((box[3] - box[1], box[2] - box[0], 4), np.uint8)
        for key in tile_keys(box):
            tile = self.tiles.get(key)
            if tile is not None:
                there, here = _common(key, box)
                pixels[here] = tile[there]
        return pixels

    def write(self, box: Box, pixels: Image) -> None:
        """Put pixels into a box; a tile that would stay empty is not made."""
        for key in tile_keys(box):
            there, here = _common(key, box)
            part = pixels[here]
            if key in self.tiles or part[..., 3].any():
                self.tiles.make(key)[there] = part
                self._mark(key)

    def replace(self, key: TileKey, tile: Image) -> None:
        """Exchange a whole tile, as re-rendering does."""
        if key in self.tiles or tile[..., 3].any():
            self.tiles.make(key)[...] = tile
            self._mark(key)

    def _mark(self, key: TileKey) -> None:
        # The preview takes a tile in while it is in memory anyway, once it is no longer painted.
        self._changed.pop(key, None)
        self._changed[key] = None
        while len(self._changed) > _MOST_CHANGED:
            self._take_in(next(iter(self._changed)))

    def refresh_preview(self) -> Preview:
        """The preview with everything that was painted; costs only what changed since."""
        for key in list(self._changed):
            self._take_in(key)
        return self.preview

    def _take_in(self, key: TileKey) -> None:
        tile = self.tiles.get(key)
        if tile is not None:
            self.preview.update(key, tile)
        del self._changed[key]


_MOST_CHANGED = 64


def _common(key: TileKey, box: Box) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """What a tile and a box share: the part of the tile, and the part of the box."""
    tx0, ty0, _, _ = tile_box(key)
    x0, y0, x1, y1 = common_box(tile_box(key), box)
    there = slice(y0 - ty0, y1 - ty0), slice(x0 - tx0, x1 - tx0)
    here = slice(y0 - box[1], y1 - box[1]), slice(x0 - box[0], x1 - box[0])
    return there, here


__all__ = ["TILE", "Canvas"]
