"""The final picture of a stream's mosaic, painted block by block from the views that are kept.

The size is known before a pixel is painted; above a limit the picture is made smaller, and that
is said. Memory is bounded: one row of blocks, the views of one block, some decoded views.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.errors import OutputError
from streamtrack.mosaic import gains
from streamtrack.mosaic.picture_files import holds_alpha, most_side, open_picture
from streamtrack.mosaic.stream import painting
from streamtrack.mosaic.stream.bands import HALO, blended
from streamtrack.mosaic.stream.comparisons import Comparisons
from streamtrack.mosaic.stream.consensus import Sample, Tally, choose
from streamtrack.mosaic.stream.coverage import CellGrid
from streamtrack.mosaic.stream.render import Renderer
from streamtrack.mosaic.stream.tiles import Box, common_box, grown, is_empty
from streamtrack.mosaic.stream.views import View, ViewStore
from streamtrack.settings import MosaicSettings
from streamtrack.types import Image, Matrix, Size

REACH = 128
"""How far beyond a block, in pixels, votes are taken: things of that size are judged as a whole."""

_UNIT = 64
_PRIMARY_SHARES = (0.5, 0.25, 0.1)


@dataclass(frozen=True, slots=True, eq=False)
class Exported:
    """A written picture: its size, pixels per world pixel, how world maps to it, what was seen."""

    size_wh: Size
    scale: float
    picture_from_world: Matrix
    tally: Tally
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """Where the final picture lies: ``box`` in whole pixels of the world times ``scale``."""

    box: Box
    scale: float
    notes: tuple[str, ...]

    @property
    def size_wh(self) -> Size:
        return self.box[2] - self.box[0], self.box[3] - self.box[1]


def plan(views: Sequence[View], max_megapixels: float, most_side_px: int | None) -> Layout:
    """The layout of a picture of all views, made smaller if it would break a limit."""
    corners = [
        geometry.transform_points(v.world_from_frame, geometry.image_quad(v.size_wh)) for v in views
    ]
    x0, y0, x1, y1 = geometry.bounding_box(np.concatenate(corners))
    width, height = x1 - x0 + 1, y1 - y0 + 1
    notes: list[str] = []
    scale = 1.0
    if width * height > max_megapixels * 1e6:
        scale = math.sqrt(max_megapixels * 1e6 / (width * height))
        notes.append(
            f"the mosaic of {width * height / 1e6:.0f} megapixels is written at scale {scale:.3g} "
            f"to stay within {max_megapixels:g}: raise --max-megapixels for more"
        )
    if most_side_px is not None and max(width, height) * scale > most_side_px:
        scale = most_side_px / max(width, height)
        notes.append(
            f"the format holds {most_side_px} px a side: the mosaic of {width:.0f}x{height:.0f} px "
            f"is written at scale {scale:.3g}: write PNG or TIFF for more"
        )
    left, top = math.floor(x0 * scale), math.floor(y0 * scale)
    right = max(left + 1, math.floor(x1 * scale) + 1)
    bottom = max(top + 1, math.floor(y1 * scale) + 1)
    return Layout((left, top, right, bottom), scale, tuple(notes))


def export(
    store: ViewStore,
    path: Path,
    settings: MosaicSettings,
    advance: Callable[[str], None] | None = None,
) -> Exported:
    """Paint all views into a file, transparent outside where the format holds it, else black.

    Raises OutputError if there is nothing to paint or the file cannot be written.
    """
    views = list(store.views.values())
    if not views:
        raise OutputError(f"no frame could be placed: {path} is not written")
    layout = plan(views, settings.max_megapixels, most_side(path))
    painter = _Painter(store, layout, settings)
    x0, y0, x1, y1 = layout.box
    side = painter.side
    tally = Tally()
    channels = 4 if holds_alpha(path) else 3
    with open_picture(path, layout.size_wh, channels) as writer:
        for top in range(y0 // side * side, y1, side):
            strip = np.zeros((side, x1 - x0, channels), np.uint8)
            for left in range(x0 // side * side, x1, side):
                pixels, seen = painter.block((left, top, left + side, top + side))
                tally += seen
                start, stop = max(left, x0), min(left + side, x1)
                part = pixels[:, start - left : stop - left, :channels]
                strip[:, start - x0 : stop - x0] = part
            writer.write(strip[max(y0 - top, 0) : y1 - top])
            if advance is not None:
                advance(f"{min(top + side, y1) - y0} of {y1 - y0} rows written")
    picture_from_world = geometry.translation(-x0, -y0) @ geometry.scaling(layout.scale)
    return Exported(layout.size_wh, layout.scale, picture_from_world, tally, layout.notes)


class _Painter:
    """Blocks of the final picture, at absolute places, so that neighbours fit to each other."""

    def __init__(self, store: ViewStore, layout: Layout, settings: MosaicSettings) -> None:
        self._views = list(store.views.values())
        self._blending = settings.blending
        cache = int(settings.max_memory_mb * 1e6 / 3)
        self._renderer = Renderer(store, layout.scale, cache, settings.warping)
        self._set_gains(store)
        self._votes = Comparisons(self._renderer)
        self._primary = primaries(self._views)
        self._boxes = np.array(
            [painting.box_of(self._renderer.canvas_from_frame(v), v.size_wh) for v in self._views]
        )
        sides = [min(view.size_wh) * layout.scale for view in self._views]
        self.side = int(np.clip(np.median(sides) // _UNIT, 4, 8)) * _UNIT

    def _set_gains(self, store: ViewStore) -> None:
        rows = {view.number: row for row, view in enumerate(self._views)}
        edges = [gains.GainEdge(rows[e.a], rows[e.b], e.log_ratio, e.weight) for e in store.edges()]
        for view, gain in zip(self._views, gains.solve_gains(len(rows), edges), strict=True):
            view.log_gain = gain

    def block(self, box: Box) -> tuple[Image, Tally]:
        """Pixels (side, side, 4) of one block."""
        side = self.side
        if not self._touching(box).size:
            return np.zeros((side, side, 4), np.uint8), Tally()
        wide, voting = grown(box, HALO), grown(box, HALO + REACH)
        views = [self._views[row] for row in self._touching(voting)]
        small = self._votes.small(views, voting)
        samples = []
        for view, cells in zip(views, small, strict=True):
            reach = painting.box_of(self._renderer.canvas_from_frame(view), view.size_wh)
            is_seen = not is_empty(common_box(reach, wide))
            pixels = self._renderer.warped(view, wide) if is_seen else None
            samples.append(Sample(pixels, cells, view.number in self._primary, view.moment))
        choice = choose(samples, self._votes.differs(views, voting), REACH // painting.SHRINK)
        if choice is None:
            return np.zeros((side, side, 4), np.uint8), Tally()
        inner = slice(HALO, HALO + side)
        pixels = blended(choice, self._blending)[inner, inner].copy()
        pixels[..., 3] = np.where(pixels[..., 3] > 0, 255, 0)
        return pixels, choice.tally

    def _touching(self, box: Box) -> npt.NDArray[np.intp]:
        """Rows of the views that may show something in a box."""
        x0, y0, x1, y1 = self._boxes.T
        touches = (x0 < box[2]) & (x1 > box[0]) & (y0 < box[3]) & (y1 > box[1])
        return np.flatnonzero(touches)


def primaries(views: Sequence[View]) -> set[int]:
    """Numbers of the views that see much that no primary before them sees.

    The picture is made of these as far as they reach; the others only vote on what stands where,
    and fill what is left. Fewer seams, each of them between views that overlap by half.
    """
    seen = CellGrid()
    found: set[int] = set()
    for share in _PRIMARY_SHARES:
        for view in views:
            if view.number in found:
                continue
            new = np.count_nonzero(seen.read(view.cells)[view.cells.seen] == 0)
            if new >= share * max(1, view.cells.count):
                seen.add(view.cells, 1)
                found.add(view.number)
    return found
