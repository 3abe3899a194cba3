"""A small picture of a growing canvas, of bounded size and at constant cost."""

from __future__ import annotations

import cv2
import numpy as np

from streamtrack import geometry
from streamtrack.mosaic.stream.tiles import TILE, Box, TileKey
from streamtrack.types import Image, Matrix, Size

_MAX_LEVEL = 8


class Preview:
    """The mip level of the canvas that fits into ``max_side``, kept up to date tile by tile.

    Only one level is kept. When the canvas outgrows it the preview itself is halved, so that
    neither memory nor the cost of a tile grows with the canvas. Channels as in a tile.
    """

    def __init__(self, max_side: int = 1024) -> None:
        self._max_side = max_side
        self._level = 0
        self._tiles: Box = (0, 0, 0, 0)
        self._pixels: Image = np.zeros((0, 0, 4), np.uint8)

    @property
    def size_wh(self) -> Size:
        return self._pixels.shape[1], self._pixels.shape[0]

    @property
    def image(self) -> Image:
        """BGR (H, W, 3), black where nothing is painted; a copy."""
        bgr = cv2.cvtColor(self._pixels, cv2.COLOR_BGRA2BGR) if self._pixels.size else None
        return np.zeros((1, 1, 3), np.uint8) if bgr is None else np.asarray(bgr, np.uint8)

    @property
    def canvas_from_preview(self) -> Matrix:
        """Maps preview pixels to canvas pixels."""
        return geometry.translation(self._tiles[0] * TILE, self._tiles[1] * TILE) @ (
            geometry.scaling(float(1 << self._level))
        )

    def update(self, key: TileKey, tile: Image) -> None:
        """Take in a tile that was painted."""
        self._grow(key)
        side = TILE >> self._level
        x, y = (key[0] - self._tiles[0]) * side, (key[1] - self._tiles[1]) * side
        self._pixels[y : y + side, x : x + side] = reduced(tile, self._level)

    def _grow(self, key: TileKey) -> None:
        x0, y0, x1, y1 = self._tiles
        if x0 <= key[0] < x1 and y0 <= key[1] < y1:
            return
        if x1 > x0:
            grown = min(x0, key[0]), min(y0, key[1]), max(x1, key[0] + 1), max(y1, key[1] + 1)
        else:
            grown = key[0], key[1], key[0] + 1, key[1] + 1
        level, kept = self._level, self._pixels
        longest = max(grown[2] - grown[0], grown[3] - grown[1]) * TILE
        while (longest >> level) > self._max_side and level < _MAX_LEVEL:
            level += 1
            kept = reduced(kept, 1) if kept.size else kept
        side = TILE >> level
        pixels = np.zeros(((grown[3] - grown[1]) * side, (grown[2] - grown[0]) * side, 4), np.uint8)
        x, y = (x0 - grown[0]) * side, (y0 - grown[1]) * side
        if kept.size:
            pixels[y : y + kept.shape[0], x : x + kept.shape[1]] = kept
        self._level, self._tiles, self._pixels = level, grown, pixels


def reduced(pixels: Image, level: int) -> Image:
    """Tile pixels (H, W, 4) halved ``level`` times; what is not painted darkens nothing."""
    if level == 0:
        return pixels
    size_wh = max(1, pixels.shape[1] >> level), max(1, pixels.shape[0] >> level)
    weight = pixels[..., 3]
    small = np.asarray(cv2.resize(pixels, size_wh, interpolation=cv2.INTER_AREA), np.uint8)
    if cv2.countNonZero(weight) == weight.size:
        return small
    painted = cv2.threshold(weight, 0, 255, cv2.THRESH_BINARY)[1]
    share = cv2.resize(painted, size_wh, interpolation=cv2.INTER_AREA).astype(np.float32) / 255.0
    bright = small[..., :3] / np.maximum(share, 1e-3)[..., None]
    small[..., :3] = np.minimum(np.rint(bright), 255)
    small[..., 3] = np.where(share > 0, np.maximum(small[..., 3], 1), 0)
    return small
