"""Tiles that no longer show what is known: painted again, a bounded piece of work at a time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from streamtrack.mosaic.stream.canvas import Canvas
from streamtrack.mosaic.stream.consensus import Chooser
from streamtrack.mosaic.stream.render import Renderer
from streamtrack.mosaic.stream.tiles import TILE, TileKey, tile_box
from streamtrack.mosaic.stream.views import ViewStore


class Rerenderer:
    """Re-renders dirty tiles from their views, the one nearest to the camera first.

    The old tile stays in the canvas until the new one is complete.
    """

    def __init__(self, canvas: Canvas, store: ViewStore, renderer: Renderer) -> None:
        self._canvas = canvas
        self._store = store
        self._renderer = renderer
        self._dirty: set[TileKey] = set()
        self._work: Iterator[None] | None = None
        self.done = 0

    def __len__(self) -> int:
        return len(self._dirty) + (self._work is not None)

    def mark(self, keys: Iterable[TileKey]) -> None:
        """These tiles show something outdated."""
        self._dirty.update(keys)

    def step(self, near: tuple[float, float]) -> bool:
        """One view of one tile; False if there is nothing to do. ``near`` is in canvas pixels.

        Raises OutputError if the disk that holds tiles or views fails.
        """
        if self._work is None:
            if not self._dirty:
                return False
            self._work = self._paint(self._nearest(near))
        if next(self._work, _END) is _END:
            self._work = None
        return True

    def _nearest(self, near: tuple[float, float]) -> TileKey:
        def distance(key: TileKey) -> tuple[float, TileKey]:
            x, y = (key[0] + 0.5) * TILE - near[0], (key[1] + 0.5) * TILE - near[1]
            return x * x + y * y, key

        key = min(self._dirty, key=distance)
        self._dirty.discard(key)
        return key

    def _paint(self, key: TileKey) -> Iterator[None]:
        chooser = Chooser((TILE, TILE))
        views = self._store.on_tile(key)
        yield from self._renderer.samples(views, tile_box(key), chooser)
        choice = chooser.choice()
        if choice is not None:
            self._canvas.replace(key, choice.feathered())
            self.done += 1


_END = object()
