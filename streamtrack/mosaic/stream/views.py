"""The frames that a mosaic keeps, so that any part of it can be painted again.

A frame is kept if it sees something new, or if the places it sees want another sample: about
`SAMPLES` of each place, spread over time, tell what stands there from what only passes by; where
a camera stays for long, and much may pass by, up to `MOST_SAMPLES`. Those that nothing needs any
more are dropped, so the store grows with the area seen, not with time.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from streamtrack import geometry
from streamtrack.mosaic import gains
from streamtrack.mosaic.spill import Slot, SpillFile
from streamtrack.mosaic.stream import painting
from streamtrack.mosaic.stream.coverage import CellGrid, Footprint, Values, footprint
from streamtrack.mosaic.stream.tiles import TILE, TileKey
from streamtrack.types import Frame, Image, Matrix, Points, Size

SAMPLES, MOST_SAMPLES = 5, 15
"""Samples that are wanted of each place, and of one that is looked at for long."""

_FRAMES_A_SAMPLE = 30  # in view, for which another sample is wanted
_SPARE = 2
_LEAST_LEFT = 3
_CROWDED_SHARE = 0.7
_CELLS_A_SIDE = 20
_MIN_GAP = 4
_WANTED_SHARE, _UNSURE_SHARE = 0.5, 0.1
_SURE, _MOST_RESTLESS = 2, 8  # samples at rest that will do; samples after which no more are tried
_JPEG_QUALITY = 95
_NEIGHBOURS = 4


@dataclass(slots=True, eq=False)
class View:
    """One frame that is kept.

    ``number`` counts kept views from 0, ``frame`` is the index in the source and ``moment`` the
    frame's place among those the mosaic was given. ``thumb`` is BGRW, small. ``doubts``
    (of any size) are 255 where it may not show the ground; the cells of these are ``restless``.
    """

    number: int
    frame: int
    moment: int
    size_wh: Size
    quads: tuple[Points, ...]
    picture: Slot | bytes
    thumb: Image
    world_from_frame: Matrix
    cells: Footprint
    log_gain: gains.LogGain
    doubts: Image | None = None
    restless: Footprint | None = None
    edges: list[gains.GainEdge] = field(default_factory=list)

    @property
    def centre(self) -> tuple[float, float]:
        """Where the middle of the frame lies in the world."""
        (a, b, c), (d, e, f), (g, h, i) = self.world_from_frame.tolist()
        x, y = (self.size_wh[0] - 1) / 2, (self.size_wh[1] - 1) / 2
        depth = g * x + h * y + i
        return (a * x + b * y + c) / depth, (d * x + e * y + f) / depth


@dataclass(frozen=True, slots=True)
class Need:
    """What a frame would add: shares (0..1) of the cells it sees.

    ``new`` ones were never seen, ``wanted`` ones want another sample; in ``unsure`` ones something
    moved in nearly all samples so far.
    """

    new: float
    wanted: float
    unsure: float

    @property
    def wants_sample(self) -> bool:
        return self.wanted > _WANTED_SHARE or self.unsure > _UNSURE_SHARE


class ViewStore:
    """Views by number; their pictures are JPEG, in memory up to ``max_bytes``, then in the spill.

    ``scale`` is canvas pixels per world pixel: it says which tiles a view touches.
    """

    def __init__(self, size_wh: Size, scale: float, max_bytes: int, spill: SpillFile) -> None:
        self.views: dict[int, View] = {}
        self._cell_px = max(4.0, min(size_wh) / _CELLS_A_SIDE)
        self._scale = scale
        self._max_bytes = max_bytes
        self._spill = spill
        self._bytes = 0
        self._next = 0
        self._counts, self._last, self._first = CellGrid(), CellGrid(), CellGrid()
        self._restless = CellGrid()
        self._by_tile: dict[TileKey, set[int]] = {}

    def __len__(self) -> int:
        return len(self.views)

    def need(
        self, world_from_frame: Matrix, size_wh: Size, moment: int, quads: Sequence[Points] = ()
    ) -> Need:
        """What a frame at this place and moment would add."""
        cells = footprint(world_from_frame, size_wh, self._cell_px, quads)
        seen = cells.seen
        total = max(1, cells.count)
        counts = self._counts.read(cells)[seen]
        since_last = moment + 1 - self._last.read(cells)[seen]
        age = moment + 1 - self._first.read(cells)[seen]
        gap = np.maximum(_MIN_GAP, age // _wanted_samples(age))
        wanted = (counts > 0) & (since_last >= gap)
        restless = self._restless.read(cells)[seen]
        unsure = (restless > 0) & (counts < restless + _SURE) & (restless <= _MOST_RESTLESS)
        unsure &= since_last >= _MIN_GAP
        return Need(
            *(float(np.count_nonzero(cell)) / total for cell in (counts == 0, wanted, unsure))
        )

    def add(
        self,
        frame: Frame,
        world_from_frame: Matrix,
        quads: tuple[Points, ...],
        moment: int,
    ) -> View:
        """Keep a frame. Raises OutputError if its picture finds room nowhere."""
        cells = footprint(world_from_frame, frame.size_wh, self._cell_px, quads)
        small = gains.THUMB_SIDE / max(*frame.size_wh, gains.THUMB_SIDE)
        view = View(
            number=self._next,
            frame=frame.index,
            moment=moment,
            size_wh=frame.size_wh,
            quads=quads,
            picture=self._stored(frame.image),
            thumb=painting.weighted(frame.image, quads, small),
            world_from_frame=world_from_frame,
            cells=cells,
            log_gain=np.zeros(3),
        )
        self._next += 1
        self._fit_gain(view)
        self.views[view.number] = view
        self._enter(view)
        self._first.write(cells, _first_moments(self._first.read(cells), moment + 1))
        self._last.write(cells, np.full(cells.seen.shape, moment + 1, np.int32))
        return view

    def doubt(self, view: View, doubts: Image) -> None:
        """Say where a kept view may not show the ground, 255 there (h, w), in place of before."""
        self._leave(view)
        view.doubts = doubts
        self._enter(view)

    def image_of(self, view: View) -> Image:
        """A view's picture, decoded, BGR or grey as it came. Raises OutputError."""
        held = view.picture
        data = held if isinstance(held, bytes) else self._spill.get(held)
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        assert image is not None
        return np.asarray(image, np.uint8)

    def on_tile(self, key: TileKey) -> list[View]:
        """The views that may touch a tile, oldest first."""
        return [self.views[n] for n in sorted(self._by_tile.get(key, ()))]

    def tiles_of(self, view: View) -> list[TileKey]:
        """The tiles whose pixels a view may touch."""
        canvas_from_frame = geometry.scaling(self._scale) @ view.world_from_frame
        x0, y0, x1, y1 = painting.box_of(canvas_from_frame, view.size_wh)
        return [
            (tx, ty)
            for ty in range(y0 // TILE, (y1 - 1) // TILE + 1)
            for tx in range(x0 // TILE, (x1 - 1) // TILE + 1)
        ]

    def move(self, view: View, world_from_frame: Matrix) -> None:
        """Give a view another pose."""
        self._leave(view)
        view.world_from_frame = world_from_frame
        view.cells = footprint(world_from_frame, view.size_wh, self._cell_px, view.quads)
        self._enter(view)

    def hide(self, view: View, quads: Iterable[Points]) -> None:
        """Say that quads (4, 2) of a view do not show the scene either."""
        known = {quad.tobytes() for quad in view.quads}
        view.quads += tuple(quad for quad in quads if quad.tobytes() not in known)
        self.move(view, view.world_from_frame)

    def thin(self, around: View) -> list[View]:
        """Drop views near ``around`` that no place needs; returns them."""
        dropped: list[View] = []
        while True:
            most = self._wanted(around.cells, around.moment) + _SPARE
            crowded = self._counts.read(around.cells)[around.cells.seen] > most
            if not crowded.any():
                return dropped
            view = self._least_needed(around)
            if view is None:
                return dropped
            self._drop(view)
            dropped.append(view)

    def edges(self) -> list[gains.GainEdge]:
        """The brightness ratios between views that are still kept, by their numbers."""
        kept = self.views
        return [
            edge
            for view in kept.values()
            for edge in view.edges
            if edge.a in kept and edge.b in kept
        ]

    def _least_needed(self, around: View) -> View | None:
        """The view that all its places can spare and whose neighbours in time are nearest."""
        near = sorted(self.neighbours(around), key=lambda view: view.moment)
        now = around.moment
        spare = [view for view in near if view is not around and self._can_spare(view, now)]
        moments = np.array([view.moment for view in near])

        def gap(view: View) -> int:
            at = int(np.searchsorted(moments, view.moment))
            before = moments[at - 1] if at else -(2**31)
            after = moments[at + 1] if at + 1 < len(moments) else 2**31
            return int(after - before)

        return min(spare, key=gap, default=None)

    def _can_spare(self, view: View, now: int) -> bool:
        seen = view.cells.seen
        counts = self._counts.read(view.cells)[seen]
        crowded = np.count_nonzero(counts > self._wanted(view.cells, now))
        left = counts - self._restless.read(view.cells)[seen]
        if view.restless is not None:
            left = left[~view.restless.seen[seen]]
        return bool((left > _LEAST_LEFT).all() and crowded >= _CROWDED_SHARE * len(counts))

    def _wanted(self, cells: Footprint, now: int) -> Values:
        """How many samples the cells that a footprint sees want at a moment, (N,)."""
        restless = np.minimum(self._restless.read(cells)[cells.seen], _MOST_RESTLESS)
        return _wanted_samples(now + 1 - self._first.read(cells)[cells.seen]) + restless

    def neighbours(self, view: View) -> list[View]:
        """The other views that may overlap it."""
        numbers: set[int] = set()
        for key in self.tiles_of(view):
            numbers |= self._by_tile.get(key, set())
        return [self.views[n] for n in sorted(numbers) if n != view.number]

    def _fit_gain(self, view: View) -> None:
        found = []
        frame_from_world = geometry.inverted(view.world_from_frame)
        to_thumb = gains.thumb_matrix(view.thumb, view.size_wh)
        for other in _nearest(view, self.neighbours(view)):
            from_thumb = geometry.inverted(gains.thumb_matrix(other.thumb, other.size_wh))
            this_from_other = to_thumb @ frame_from_world @ other.world_from_frame @ from_thumb
            measured = gains.ratio(view.thumb, other.thumb, this_from_other)
            if measured is not None:
                view.edges.append(gains.GainEdge(view.number, other.number, *measured))
                found.append((other.log_gain, *measured))
        view.log_gain = gains.running_gain(found)

    def _stored(self, image: Image) -> Slot | bytes:
        encoded = cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY))[1]
        data = encoded.tobytes()
        if self._bytes + len(data) <= self._max_bytes:
            self._bytes += len(data)
            return data
        return self._spill.put(data)

    def _drop(self, view: View) -> None:
        self._leave(view)
        del self.views[view.number]
        if isinstance(view.picture, bytes):
            self._bytes -= len(view.picture)
        else:
            self._spill.free(view.picture)

    def _enter(self, view: View) -> None:
        self._counts.add(view.cells, 1)
        if view.doubts is not None:
            view.restless = self._cells_of(view, view.doubts)
            self._restless.add(view.restless, 1)
        for key in self.tiles_of(view):
            self._by_tile.setdefault(key, set()).add(view.number)

    def _leave(self, view: View) -> None:
        self._counts.add(view.cells, -1)
        if view.restless is not None:
            self._restless.add(view.restless, -1)
        for key in self.tiles_of(view):
            self._by_tile[key].discard(view.number)

    def _cells_of(self, view: View, mask: Image) -> Footprint:
        """The cells that a view sees in its mask (h, w)."""
        cells = view.cells
        mask_from_frame = gains.thumb_matrix(mask, view.size_wh)
        world_from_mask = view.world_from_frame @ geometry.inverted(mask_from_frame)
        cells_from_world = geometry.translation(-cells.x - 0.5, -cells.y - 0.5) @ geometry.scaling(
            1 / self._cell_px
        )
        size_wh = cells.seen.shape[1], cells.seen.shape[0]
        found = cv2.warpPerspective(mask, cells_from_world @ world_from_mask, size_wh)
        return Footprint(cells.x, cells.y, cells.seen & (found > 127))


def _wanted_samples(age: Values) -> Values:
    """Samples wanted of places (N,) first seen so many frames ago."""
    return np.clip(age // _FRAMES_A_SAMPLE, SAMPLES, MOST_SAMPLES)


def _nearest(view: View, others: Sequence[View]) -> Iterable[View]:
    """The few whose centres are nearest: they overlap most."""
    x, y = view.centre

    def distance(other: View) -> float:
        return math.hypot(other.centre[0] - x, other.centre[1] - y)

    return sorted(others, key=distance)[:_NEIGHBOURS]


def _first_moments(first: Values, moment: int) -> Values:
    return np.where(first == 0, np.int32(moment), first)
