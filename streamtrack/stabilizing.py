"""The video held still: each frame warped to a smoothed path of the camera, or to the fixed world.

`SmoothView` looks a moment ahead and follows the camera's mean motion; its pictures are cropped a
little and never show anything beyond a frame's edge. `WorldView` shows the place that the first
frame showed, for as long as the camera looks there. Both give one picture a frame, at its time.
"""

from __future__ import annotations

import math
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
from streamtrack.types import Image, Matrix, Points, Size, Step

if TYPE_CHECKING:
    from streamtrack.pose_graph import PoseGraph

_CROP = 0.06
"""Share of the picture's sides that is given up on each side, to have room to move in."""
_MOST_HELD_MB = 192.0
_SIGMA_OF_REACH = 0.45
_DIMMED = 0.35
_FARTHEST_PX = 1e6

Doubles = npt.NDArray[np.float64]


class Shown(NamedTuple):
    """One picture of a stabilised video, and the time of its frame."""

    image: Image
    time_s: float


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
        if pose is not None and not refusal(pose, step.frame.size_wh, _FARTHEST_PX):
            warped = cv2.warpPerspective(bgr, pose, size_wh)
            full = np.full(image.shape[:2], 255, np.uint8)
            inside = cv2.inRange(cv2.warpPerspective(full, pose, size_wh), 255, 255)
            cv2.copyTo(warped, inside, seen)
            cv2.copyTo(warped, inside, shown)
            self.unplaced += not cv2.countNonZero(inside)
        else:
            self.unplaced += 1
        yield Shown(np.asarray(shown, np.uint8), step.frame.time_s)

    def finish(self) -> Iterator[Shown]:
        return iter(())


@dataclass(slots=True, eq=False)
class _Held:
    """A frame, its pose as given, and its picture until it was shown."""

    index: int
    time_s: float
    size_wh: Size
    pose: Matrix | None
    image: Image | None


class SmoothView:
    """What a camera would show that moves as this one does on average.

    Each picture shows the weighted mean of the views within ``reach_s`` seconds before and after
    its frame, by their corners (Gaussian weights). Where that would leave the frame, only as much
    of the way is gone as stays in it. A frame whose pose is not known is shown as it is.

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
        quad = self._view(held)
        while self._held[0].time_s < held.time_s - self._reach_s:
            self._held.popleft()
            self._next -= 1
        self._next += 1
        if quad is None:
            self.unplaced += 1
            quad = _shrunk(geometry.image_quad(held.size_wh).astype(np.float64))
        shown_from_frame = geometry.quad_mapping(quad, geometry.image_quad(held.size_wh))
        shown = cv2.warpPerspective(
            image, shown_from_frame, held.size_wh, borderMode=cv2.BORDER_REPLICATE
        )
        return Shown(np.asarray(shown, np.uint8), held.time_s)

    def _view(self, held: _Held) -> Doubles | None:
        """What to show: a quad (4, 2) in the frame, None if the frame's pose is not known."""
        pose = self._pose(held)
        if pose is None:
            return None
        frame_from_world = geometry.inverted(pose)
        sigma = max(_SIGMA_OF_REACH * self._reach_s, 1e-9)
        corners = geometry.image_quad(held.size_wh)
        total, weights = np.zeros((4, 2)), 0.0
        for other in self._held:
            there = self._pose(other)
            if there is None or other.size_wh != held.size_wh:
                continue
            quad = geometry.transform_points(frame_from_world @ there, corners)
            if not np.isfinite(quad).all() or abs(other.time_s - held.time_s) > self._reach_s:
                continue
            weight = math.exp(-0.5 * ((other.time_s - held.time_s) / sigma) ** 2)
            total += weight * quad
            weights += weight
        return _kept_inside(total / weights, corners)

    def _pose(self, held: _Held) -> Matrix | None:
        """The pose by what is known now."""
        if held.pose is None or self._graph is None:
            return held.pose
        known = self._graph.world_from_frame(held.index)
        return held.pose if known is None else known


def _shrunk(quad: Doubles) -> Doubles:
    middle = quad.mean(axis=0)
    return np.asarray(middle + (1 - 2 * _CROP) * (quad - middle), np.float64)


def _kept_inside(wanted: Doubles, corners: Points) -> Doubles:
    """The wanted view, cropped, as far from the frame's own as it stays in the frame."""
    own = _shrunk(corners.astype(np.float64))
    way = _shrunk(wanted) - own
    low, high = corners.min(axis=0), corners.max(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        room = np.where(way > 0, (high - own) / way, (low - own) / way)
    share = min(1.0, float(np.min(np.where(way == 0, np.inf, room))))
    return np.asarray(own + share * way, np.float64)
