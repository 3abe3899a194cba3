"""The growing mosaic of a stream: it is told each frame with its pose and paints what is new.

Memory is bounded and the cost of a frame does not grow with the mosaic: most frames add nothing
and are only looked at; one that adds something is painted (its own box, see `painting`) and kept
(see `views`); and in each frame one bounded piece of re-rendering is done where poses have
changed or samples disagree (see `rerender`). The final picture is made from the frames that were
kept, at their final poses (see `export`).
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from streamtrack import geometry
from streamtrack.camera.view_levels import filled
from streamtrack.closing import Closing
from streamtrack.errors import OutputError
from streamtrack.mosaic.spill import SpillFile
from streamtrack.mosaic.stream import painting
from streamtrack.mosaic.stream.canvas import Canvas
from streamtrack.mosaic.stream.export import Exported, export
from streamtrack.mosaic.stream.movers import Movers
from streamtrack.mosaic.stream.render import Renderer
from streamtrack.mosaic.stream.rerender import Rerenderer
from streamtrack.mosaic.stream.tiles import TILE, Box
from streamtrack.mosaic.stream.views import View, ViewStore
from streamtrack.mosaic.types import MosaicView
from streamtrack.pose_graph import KeyframeEdge, PoseGraph
from streamtrack.settings import MosaicSettings
from streamtrack.types import CameraPose, Frame, Image, Matrix, Points, Size, Track

NEW_SHARE = 0.15
"""A frame that sees this share of its area for the first time is painted at once."""

LIVE_PIXELS = 640 * 480
"""Larger frames are painted smaller in the canvas that is shown; the final picture is not."""

MOST_EXTENT_PX = 100_000.0
"""How far from its origin, in canvas pixels, a mosaic may reach."""

_LEAST_SHARE = 0.01
_LEAST_OVERLAID = 0.001  # of a frame; for less nothing is painted again
_MOVED_PX = 0.5
_CHECKED_A_FRAME, _MOVED_A_FRAME = 64, 3
_SAMPLES_TO_JUDGE = 3
_LEAST_CONTESTED = 16
_TILE_SHARE, _VIEW_SHARE, _CACHE_SHARE = 0.5, 0.2, 0.15


@dataclass(slots=True)
class StreamFigures:
    """What a mosaic did so far: frames by what became of them."""

    painted: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    moved_views: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class _Waiting:
    """A frame that adds a little: painted if the camera turns back before more comes."""

    frame: Frame
    world_from_frame: Matrix
    quads: tuple[Points, ...]
    moment: int
    new: float


class StreamMosaic(Closing):
    """A mosaic that grows frame by frame; a context manager that leaves nothing behind.

    ``graph`` gives poses that may still change (loop closure); without it the poses that come
    with the frames are final. Not thread-safe.
    """

    def __init__(
        self,
        settings: MosaicSettings,
        graph: PoseGraph | None = None,
        folder: Path | None = None,
    ) -> None:
        self._settings = settings
        self._graph = graph
        self._spill = SpillFile(folder)
        self._budget = int(settings.max_memory_mb * 1e6)
        self._canvas = Canvas(int(self._budget * _TILE_SHARE), self._spill)
        self._store: ViewStore | None = None
        self._moment = -1
        self._waiting: _Waiting | None = None
        self._outline: Points | None = None
        self._checking: deque[View] = deque()
        self._revision = 0 if graph is None else graph.revision
        self._keyframe_poses: dict[int, Matrix] = {}
        self._keyframe_of: dict[int, int | None] = {}
        self._full = ""
        self._has_painted = False
        self._overlay = b""
        self._overlaid = np.zeros((0, 0), np.bool_)
        self.figures = StreamFigures()

    def close(self) -> None:
        """Give memory and disk back; further calls do nothing."""
        self._waiting = None
        self._spill.close()

    @property
    def views(self) -> int:
        """How many frames are kept."""
        return 0 if self._store is None else len(self._store)

    @property
    def tiles(self) -> int:
        """How many tiles the canvas has."""
        return len(self._canvas.tiles)

    @property
    def spilled_mb(self) -> float:
        """Room taken on disk."""
        return self._spill.size_mb

    @property
    def notes(self) -> tuple[str, ...]:
        """What a person should know of how the mosaic fell short."""
        return (self._full,) if self._full else ()

    def add(self, frame: Frame, pose: CameraPose, tracks: Sequence[Track] = ()) -> str:
        """Take in the next frame; returns why it has no place in the mosaic, or an empty string.

        What lies on ``tracks`` (targets) or over every picture is not painted. A frame without a
        pose has no place, for the camera's reason.
        """
        self._moment += 1
        self._outline = None
        world_from_frame = pose.world_from_frame
        reason = pose.reason or "its pose is not known"
        if world_from_frame is not None:
            hidden = (*painting.target_quads(tracks), *pose.overlay)
            reason = self._place(frame, world_from_frame, hidden)
            self._leave_out(pose.overlay, frame.size_wh)
        else:
            self._keep_waiting()
            if self._store is not None:
                self._movers.forget()
        if reason:
            self.figures.refused[reason] += 1
        self._work()
        return reason

    def _place(self, frame: Frame, world_from_frame: Matrix, quads: tuple[Points, ...]) -> str:
        if self._store is None:
            self._begin(frame)
        store, _ = self._parts()
        canvas_from_frame = geometry.scaling(self._scale) @ world_from_frame
        reason = painting.refusal(world_from_frame, frame.size_wh, MOST_EXTENT_PX / self._scale)
        if reason:
            return reason
        corners = geometry.image_quad(frame.size_wh)
        self._outline = geometry.transform_points(world_from_frame, corners)
        self._near = geometry.transform_points(canvas_from_frame, corners).mean(axis=0)
        need = store.need(world_from_frame, frame.size_wh, self._moment, quads)
        self._movers.follow(frame, world_from_frame)
        now = _Waiting(frame, world_from_frame, quads, self._moment, need.new)
        waiting = self._waiting
        if need.new >= NEW_SHARE or need.wants_sample or not len(store):
            self._waiting = None
            if waiting is not None and need.new < waiting.new:
                self._keep(waiting)
            self._keep(now)
        elif waiting is not None and need.new < 0.5 * waiting.new:
            self._keep_waiting()
        elif need.new > max(_LEAST_SHARE, 0.0 if waiting is None else waiting.new):
            self._waiting = now
        return ""

    def _leave_out(self, overlay: Sequence[Points], size_wh: Size) -> None:
        """What is newly known to lie over every picture lay over those kept before as well."""
        last, self._overlay = self._overlay, b"".join(quad.tobytes() for quad in overlay)
        if not overlay or self._store is None or self._overlay == last:
            return
        small = geometry.scaling(1 / painting.SHRINK)
        cells = (size_wh[1] // painting.SHRINK + 1, size_wh[0] // painting.SHRINK + 1)
        known = self._overlaid if self._overlaid.shape == cells else np.zeros(cells, np.bool_)
        covered = filled(overlay, small, cells)
        if np.count_nonzero(covered & ~known) < _LEAST_OVERLAID * covered.size:
            return
        self._overlaid = known | covered
        for view in self._store.views.values():
            if view.size_wh == size_wh:
                self._store.hide(view, overlay)
                self._renderer.forget(view)
                self._rerender.mark(self._store.tiles_of(view))

    def _begin(self, frame: Frame) -> None:
        """What depends on the size of the frames is made with the first of them."""
        width, height = frame.size_wh
        self._scale = min(1.0, math.sqrt(LIVE_PIXELS / (width * height)))
        self._store = ViewStore(
            frame.size_wh, self._scale, int(self._budget * _VIEW_SHARE), self._spill
        )
        self._movers = Movers(self._store, self._scale / painting.SHRINK)
        self._renderer = Renderer(self._store, self._scale, int(self._budget * _CACHE_SHARE))
        self._rerender = Rerenderer(self._canvas, self._store, self._renderer)
        self._near = np.zeros(2, np.float32)

    def _parts(self) -> tuple[ViewStore, Rerenderer]:
        assert self._store is not None
        return self._store, self._rerender

    def _keep_waiting(self) -> None:
        waiting, self._waiting = self._waiting, None
        if waiting is not None:
            self._keep(waiting)

    def _keep(self, given: _Waiting) -> None:
        """Keep a frame and paint it, unless there is no room any more."""
        if self._full:
            return
        store, _ = self._parts()
        world_from_frame = self._known_pose(given.frame.index, given.world_from_frame)
        try:
            view = store.add(given.frame, world_from_frame, given.quads, given.moment)
            self._movers.judge(view)
            if self._graph is not None:
                self._graph.keep(given.frame.index)
            self._paint(given.frame.image, view)
            if self._graph is not None:
                self._keyframe_of[view.number] = self._graph.keyframe_of(view.frame)
            for dropped in store.thin(view):
                self._renderer.forget(dropped)
                self._keyframe_of.pop(dropped.number, None)
        except OutputError as error:
            self._full = f"the mosaic grows no further since frame {given.frame.index}: {error}"

    def _paint(self, image: Image, view: View) -> None:
        """Paint what the canvas does not show yet; where they disagree it is judged later."""
        self._renderer.remember(view, painting.weighted(image, view.quads, self._scale))
        box = painting.box_of(self._renderer.canvas_from_frame(view), view.size_wh)
        _, small = self._renderer.shrunk(view)
        seen = painting.compared(box, painting.quartered(self._canvas.read(box)), small)
        for part in seen.parts():
            new = self._renderer.warped(view, part)
            painted = painting.paint(self._canvas.read(part), new, seen.differs_in(part))
            self._canvas.write(part, painted)
        self.figures.painted += 1
        self._has_painted = True
        self._mark_contested(box, seen.differs)

    def _mark_contested(self, box: Box, differs: Image) -> None:
        """Tiles with enough samples to judge what stands where they disagree are done again."""
        if not cv2.countNonZero(differs):
            return
        store, rerender = self._parts()
        rows, columns = (place * painting.SHRINK for place in np.nonzero(differs))
        found = Counter(
            zip(
                ((columns + box[0]) // TILE).tolist(),
                ((rows + box[1]) // TILE).tolist(),
                strict=True,
            )
        )
        rerender.mark(
            key
            for key, count in found.items()
            if count >= _LEAST_CONTESTED and len(store.on_tile(key)) >= _SAMPLES_TO_JUDGE
        )

    def _known_pose(self, index: int, given: Matrix) -> Matrix:
        """The pose as it is known now; the given one if nothing better is known."""
        known = None if self._graph is None else self._graph.world_from_frame(index)
        return given if known is None else known

    def _work(self) -> None:
        """A bounded piece of what waits: poses that changed, then tiles to paint again."""
        if self._store is None:
            return
        if self._graph is not None and self._graph.revision != self._revision:
            self._revision = self._graph.revision
            self._checking = deque(self._moved_with_keyframes(self._graph, self._store))
        self._check(_CHECKED_A_FRAME, _MOVED_A_FRAME)
        if self._has_painted:  # enough for one frame
            self._has_painted = False
            return
        try:
            self._rerender.step((float(self._near[0]), float(self._near[1])))
        except OutputError as error:
            self._full = self._full or f"parts of the mosaic are not brought up to date: {error}"

    def _moved_with_keyframes(self, graph: PoseGraph, store: ViewStore) -> list[View]:
        """The views whose keyframes lie elsewhere since last asked, and those still to check."""
        poses = {index: one.world_from_keyframe for index, one in graph.keyframes.items()}
        before, self._keyframe_poses = self._keyframe_poses, poses
        moved: set[int | None] = {i for i, pose in poses.items() if pose is not before.get(i)}
        moved.add(None)
        waiting = {view.number for view in self._checking}
        return [
            view
            for view in store.views.values()
            if view.number in waiting or self._keyframe_of.get(view.number) in moved
        ]

    def _check(self, most: int, most_moved: float) -> None:
        """Take over poses that changed by more than half a pixel, of so many of the views."""
        store, rerender = self._parts()
        views = [self._checking.popleft() for _ in range(min(most, len(self._checking)))]
        views = [view for view in views if view.number in store.views]
        known = [self._known_pose(view.frame, view.world_from_frame) for view in views]
        moved = 0
        for row in _moved_rows(views, known, _MOVED_PX / self._scale):
            view = views[row]
            if moved >= most_moved:
                self._checking.extendleft(reversed(views[row:]))
                return
            extent = MOST_EXTENT_PX / self._scale
            if not painting.refusal(known[row], view.size_wh, extent):
                rerender.mark(store.tiles_of(view))
                store.move(view, known[row])
                rerender.mark(store.tiles_of(view))
                self.figures.moved_views += 1
                moved += 1

    def catch_up(self, most: int | None = None) -> bool:
        """Do up to ``most`` pieces of waiting work (None: all); True if nothing is left to do.

        For the time between the frames of a live source, and for those who want the canvas itself.
        """
        while self._store is not None and (most is None or most > 0):
            most = None if most is None else most - 1
            is_idle = not len(self._rerender) and not self._checking
            if is_idle and (self._graph is None or self._graph.revision == self._revision):
                return True
            self._work()
            if self._full:
                return True
        return self._store is None

    def view(self) -> MosaicView:
        """The mosaic as it is now, small. Costs what was painted since the last call, no more."""
        with suppress(OutputError):
            self._canvas.refresh_preview()
        preview = self._canvas.preview
        scale = self._scale if self._store is not None else 1.0
        outlines: list[Points] = []
        edges: tuple[KeyframeEdge, ...] = ()
        if self._graph is not None and self._store is not None:
            corners = geometry.image_quad(self._first_size())
            outlines = [
                geometry.transform_points(keyframe.world_from_keyframe, corners)
                for keyframe in self._graph.keyframes.values()
            ]
            edges = tuple(self._graph.edges)
        return MosaicView(
            preview=preview.image,
            world_from_preview=geometry.scaling(1.0 / scale) @ preview.canvas_from_preview,
            frame_outline=self._outline,
            keyframe_outlines=np.array(outlines, np.float32).reshape(-1, 4, 2),
            edges=edges,
            keyframes=() if self._graph is None else tuple(self._graph.keyframes),
        )

    def _first_size(self) -> tuple[int, int]:
        store, _ = self._parts()
        return next(iter(store.views.values())).size_wh if len(store) else (1, 1)

    def finish(
        self, path: Path | None = None, advance: Callable[[str], None] | None = None
    ) -> Exported | None:
        """Take over the final poses, and write the final picture if a path is given.

        None without a path. Raises OutputError if nothing was placed or it cannot be written;
        UsageError for an ending that names no format.
        """
        if self._store is None:
            if path is None:
                return None
            why = ", ".join(f"{why} {n}" for why, n in self.figures.refused.most_common())
            raise OutputError(f"no frame could be placed ({why}): {path} is not written")
        self._keep_waiting()
        self._checking = deque(self._store.views.values())
        self._check(len(self._checking), math.inf)
        if path is None:
            return None
        return export(self._store, path, self._settings, advance)


def _moved_rows(views: Sequence[View], known: Sequence[Matrix], least_px: float) -> list[int]:
    """Which of the views have a corner that lies elsewhere by other poses (world pixels)."""
    if not views:
        return []
    corners = np.stack([geometry.image_quad(view.size_wh) for view in views]).astype(np.float64)
    homogeneous = np.concatenate([corners, np.ones((len(views), 4, 1))], axis=2)
    now = np.stack([view.world_from_frame for view in views])
    before, after = (homogeneous @ poses.transpose(0, 2, 1) for poses in (now, np.stack(known)))
    off = after[..., :2] / after[..., 2:] - before[..., :2] / before[..., 2:]
    return np.flatnonzero(np.hypot(*off.T).T.max(axis=1) > least_px).tolist()
