"""The video held still: each frame warped to a smoothed path of the camera, or to the fixed world.

`SmoothView` looks a moment ahead and follows the camera's way without its shaking; its pictures are
cropped a little and never show anything beyond a frame's edge. `WorldView` shows the place that the
first frame showed, for as long as the camera looks there. Both give one picture a frame, at its
time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.mosaic.stream.painting import refusal
from streamtrack.settings import StabilizeSettings
from streamtrack.steady_path import Room, frames_before_a_cut, steadiest_views
from streamtrack.types import Image, Matrix, Size, Step

if TYPE_CHECKING:
    from streamtrack.pose_graph import PoseGraph

_CROP = 0.06
"""Share of the picture's sides that is given up on each side, to have room to move in."""
_MOST_HELD_MB = 192.0
_BEND = 0.375  # of the reach: what lasts much less than that is shaking
_PAST = 2  # frames shown, which are where a path sets out from, and whereto
_DIMMED = 0.35
_FARTHEST_PX = 1e6

Doubles = npt.NDArray[np.float64]


class Shown(NamedTuple):
    """One picture of a stabilised video, and the time of its frame.

    ``shown_from_frame`` takes the frame's pixels to the picture's; None if its place is not known.
    """

    image: Image
    time_s: float
    shown_from_frame: Matrix | None = None


class Stabilizer(Protocol):
    """What the watcher of a run asks of a way to hold a video still."""

    unplaced: int
    """Frames whose pose was not known, or that show nothing of the view."""

    def add(self, step: Step) -> Iterator[Shown]:
        """Take in a frame; gives the pictures that can be shown now, oldest first."""
        ...

    def finish(self) -> Iterator[Shown]:
        """The pictures that were held back."""
        ...


def make_stabilizer(settings: StabilizeSettings, graph: PoseGraph | None = None) -> Stabilizer:
    """What the settings ask for; ``graph`` has poses that may still change."""
    return WorldView() if settings.path == "world" else SmoothView(settings.reach_s, graph)


class WorldView:
    """The place that the first frame showed, at its size.

    What a frame does not reach is shown as it was seen last, darkened; in a frame whose pose is
    not known that is all of the picture.
    """

    def __init__(self) -> None:
        self.unplaced = 0
        self._seen: Image | None = None

    def add(self, step: Step) -> Iterator[Shown]:
        image = step.frame.image
        bgr = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image
        if self._seen is None:
            self._seen = np.zeros(bgr.shape, np.uint8)
        seen = self._seen
        size_wh = seen.shape[1], seen.shape[0]
        shown = cv2.convertScaleAbs(seen, alpha=_DIMMED)
        pose = step.camera.world_from_frame
        if pose is not None and refusal(pose, step.frame.size_wh, _FARTHEST_PX):
            pose = None
        if pose is not None:
            warped = cv2.warpPerspective(bgr, pose, size_wh)
            full = np.full(image.shape[:2], 255, np.uint8)
            inside = cv2.inRange(cv2.warpPerspective(full, pose, size_wh), 255, 255)
            cv2.copyTo(warped, inside, seen)
            cv2.copyTo(warped, inside, shown)
            self.unplaced += not cv2.countNonZero(inside)
        else:
            self.unplaced += 1
        yield Shown(np.asarray(shown, np.uint8), step.frame.time_s, pose)

    def finish(self) -> Iterator[Shown]:
        return iter(())


@dataclass(slots=True, eq=False)
class _Held:
    """A frame, its pose as given, its picture until it was shown, and then what was shown of it."""

    index: int
    time_s: float
    size_wh: Size
    pose: Matrix | None
    image: Image | None
    view: Doubles | None = None


class SmoothView:
    """What a camera would show that moves as this one does without its shaking.

    Each picture shows the view of its frame on the steadiest path (`steady_path`) that stays within
    the frames, by the poses up to ``reach_s`` seconds ahead. A frame whose pose is not known is
    shown with what the frames around it were moved by, the less the longer ago that was.

    ``graph`` has poses that may still change.
    """

    def __init__(self, reach_s: float, graph: PoseGraph | None = None) -> None:
        self.unplaced = 0
        self._reach_s = reach_s
        self._graph = graph
        self._held: deque[_Held] = deque()
        self._next = 0  # place in ``_held`` of the first that is yet to be shown

    def add(self, step: Step) -> Iterator[Shown]:
        frame, pose = step.frame, step.camera.world_from_frame
        held = _Held(frame.index, frame.time_s, frame.size_wh, pose, frame.image)
        self._held.append(held)
        most = max(1, int(_MOST_HELD_MB * 1e6 / frame.image.nbytes))
        while self._next < len(self._held):
            waiting = self._held[self._next]
            is_seen_through = frame.time_s - waiting.time_s >= self._reach_s
            if not is_seen_through and len(self._held) - self._next < most:
                return
            yield self._show()

    def finish(self) -> Iterator[Shown]:
        while self._next < len(self._held):
            yield self._show()

    def _show(self) -> Shown:
        """The next picture; what no later one needs is let go."""
        held = self._held[self._next]
        image, held.image = held.image, None
        assert image is not None
        while self._held[0].time_s < held.time_s - self._reach_s:
            self._held.popleft()
            self._next -= 1
        if held.pose is None:
            self.unplaced += 1
            view = self._view_in_gap(held)
        else:
            view = held.view = self._view_on_path(held)
        self._next += 1
        shown_from_frame = geometry.quad_mapping(view, geometry.image_quad(held.size_wh))
        shown = cv2.warpPerspective(
            image, shown_from_frame, held.size_wh, borderMode=cv2.BORDER_REPLICATE
        )
        return Shown(np.asarray(shown, np.uint8), held.time_s, shown_from_frame)

    def _view_on_path(self, here: _Held) -> Doubles:
        """The view (4, 2) of a frame that has a pose, in its own pixels."""
        room = Room(here.size_wh, _CROP)
        past = [held for held in self._held if held.view is not None and held.time_s < here.time_s]
        coming = [held for held in self._held if held.pose is not None and held.view is None]
        behind, matrices_behind = self._in_one_piece([here, *past[: -_PAST - 1 : -1]], room)
        ahead, matrices_ahead = self._in_one_piece(coming[coming.index(here) :], room)
        matrices = np.concatenate([matrices_behind[:0:-1], matrices_ahead])
        shown = np.array([held.view for held in behind[:0:-1]]).reshape(-1, 4, 2)
        times_s = np.array([held.time_s for held in (*behind[:0:-1], *ahead)])
        views = steadiest_views(times_s, matrices, shown, room, _BEND * self._reach_s)
        return np.asarray(views[0])

    def _in_one_piece(self, frames: list[_Held], room: Room) -> tuple[list[_Held], Doubles]:
        """Those that lie together with the first, within reach; the first's pixels from theirs."""
        first = frames[0]
        frame_from_world = geometry.inverted(self._pose(first))
        near = [
            held
            for held in frames
            if held.size_wh == first.size_wh and abs(held.time_s - first.time_s) <= self._reach_s
        ]
        matrices = np.array([frame_from_world @ self._pose(held) for held in near])
        count = frames_before_a_cut(matrices, room.own)
        return near[:count], matrices[:count]

    def _view_in_gap(self, here: _Held) -> Doubles:
        """The view (4, 2) of a frame without a pose: as the nearest ones with a pose are moved."""
        own = Room(here.size_wh, _CROP).own
        known = [
            held for held in self._held if held.pose is not None and held.size_wh == here.size_wh
        ]
        before = [held for held in known if held.view is not None][-1:]
        after = [held for held in known if held.view is None][:1]
        fade_s = self._reach_s
        if before and after:
            fade_s = min(fade_s, after[0].time_s - before[0].time_s)
        view = own.copy()
        for held in (*before, *after):
            shown = self._view_on_path(held) if held.view is None else held.view
            view += max(0.0, 1 - abs(held.time_s - here.time_s) / fade_s) * (shown - own)
        return view

    def _pose(self, held: _Held) -> Matrix:
        """The pose, of a frame that has one, by what is known now."""
        assert held.pose is not None
        known = None if self._graph is None else self._graph.world_from_frame(held.index)
        return held.pose if known is None else known
