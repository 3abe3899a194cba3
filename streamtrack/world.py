"""Where targets are in the world, where they went there and how fast: camera and target together.

A position is where the diagonals of a quad cross, which is the same point of a flat target however
it is seen. Poses of a moving camera may change when a loop closes; positions of earlier frames
then move with them, so that a path stays whole and no speed jumps.
"""

from __future__ import annotations

import threading
from dataclasses import replace
from functools import lru_cache
from math import hypot
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.ground import Ground
from streamtrack.types import Frame, GroundPlace, Matrix, Points, Step, Track, WorldPlace
from streamtrack.uncertainty import target_sigma_px

if TYPE_CHECKING:
    from streamtrack.pose_graph import PoseGraph

_WINDOW_S = 0.5
"""Velocities are means over this time."""
_LEAST_POINTS = 3
_LEAST_IN_WINDOW = 5  # where frames come slowly
_MOST_WINDOW_S = 2.0
_MOST_IN_WINDOW = 24
_MOST_POINTS = 4096

Doubles = npt.NDArray[np.float64]


class WorldPath:
    """The positions of one target; of very many, every second is let go."""

    def __init__(self, graph: PoseGraph | None) -> None:
        self._graph = graph
        self._lock = threading.Lock()  # displays read paths in threads of their own
        self._count = 0
        self._frames = np.zeros(64, np.int64)
        self._times_s = np.zeros(64)
        self._in_frame = np.zeros((64, 2))
        self._positions = np.zeros((64, 2))
        self._revisions = np.zeros(64, np.int64)  # of the graph, at which each position is known

    def add(self, frame: Frame, in_frame: Doubles, position: Doubles) -> None:
        """Add the position (2,) in a frame and in the world."""
        with self._lock:
            if self._count == _MOST_POINTS:
                self._thin()
            elif self._count == len(self._frames):
                self._grow()
            row = self._count
            self._frames[row], self._times_s[row] = frame.index, frame.time_s
            self._in_frame[row], self._positions[row] = in_frame, position
            self._revisions[row] = 0 if self._graph is None else self._graph.revision
            self._count += 1

    def __getstate__(self) -> dict[str, Any]:
        """For copies and pickles: positions as they are known now, which then stay."""
        with self._lock:
            self._follow_keyframes(range(self._count))
            columns = {name: column[: self._count] for name, column in self._columns().items()}
            return {"_graph": None, "_count": self._count, **columns}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._lock = threading.Lock()

    def _columns(self) -> dict[str, npt.NDArray[np.generic]]:
        names = ("_frames", "_times_s", "_in_frame", "_positions", "_revisions")
        return {name: getattr(self, name) for name in names}

    def _grow(self) -> None:
        for name, column in self._columns().items():
            setattr(self, name, np.concatenate([column, np.zeros_like(column)]))

    def _thin(self) -> None:
        for name, column in self._columns().items():
            setattr(self, name, np.concatenate([column[::2], np.zeros_like(column[1::2])]))
        self._count = (self._count + 1) // 2

    def points(self, last_frame: int) -> Points:
        """Positions (N, 2) up to a frame, where they lie by what is known now."""
        with self._lock:
            count = int(np.searchsorted(self._frames[: self._count], last_frame, side="right"))
            self._follow_keyframes(range(count))
            return self._positions[:count].astype(np.float32)

    def recent(self) -> tuple[Doubles, Doubles]:
        """Times (N,) and positions (N, 2) of the last moments, as far as they are used."""
        times = self._times_s[: self._count]
        first = int(np.searchsorted(times, times[-1] - _WINDOW_S - 1e-9))
        if self._count - first < _LEAST_IN_WINDOW:
            earliest = int(np.searchsorted(times, times[-1] - _MOST_WINDOW_S))
            first = max(self._count - _LEAST_IN_WINDOW, earliest, 0)
        step = -(-(self._count - first) // _MOST_IN_WINDOW)
        rows = slice(first + (self._count - 1 - first) % step, self._count, step)
        with self._lock:
            self._follow_keyframes(range(self._count)[rows])
        return times[rows], self._positions[rows]

    def _follow_keyframes(self, rows: range) -> None:
        """Bring those of the positions up to date that were known before keyframes moved."""
        if self._graph is None:
            return
        revision = self._graph.revision
        old = self._revisions[rows.start : rows.stop : rows.step] != revision
        for row in np.asarray(rows)[old].tolist():
            pose = self._graph.world_from_frame(int(self._frames[row]))
            if pose is not None:
                self._positions[row] = geometry.transform_points(pose, self._in_frame[row])[0]
            self._revisions[row] = revision


class WorldMotion:
    """Puts the targets of each frame into the world; ``ground`` gives them units as well."""

    def __init__(self, graph: PoseGraph | None = None, ground: Ground | None = None) -> None:
        self._graph = graph
        self._ground = ground
        self._paths: dict[str, WorldPath] = {}

    def placed(self, step: Step) -> Step:
        """The step, its tracks with their place in the world, None while that is not known.

        While a fixed camera warns that it was moved, nothing is known.
        """
        pose, frame = step.camera, step.frame
        names = {track.name for track in step.tracks}
        if self._paths.keys() - names:  # targets that ended
            self._paths = {name: path for name, path in self._paths.items() if name in names}
        world_from_frame = None if pose.warning else pose.world_from_frame
        if world_from_frame is None:
            return step
        # What is not moved is exactly where it is seen.
        camera_sigma_px = 0.0 if np.array_equal(world_from_frame, np.eye(3)) else pose.sigma_px
        tracks = tuple(
            self._placed(frame, track, world_from_frame, camera_sigma_px) for track in step.tracks
        )
        return replace(step, tracks=tracks)

    def _placed(
        self, frame: Frame, track: Track, world_from_frame: Matrix, camera_sigma_px: float
    ) -> Track:
        if track.quad is None:
            return track
        centre = crossing(track.quad)
        quad = geometry.transform_points(world_from_frame, track.quad)
        position = geometry.transform_points(world_from_frame, centre)[0].astype(np.float64)
        if not (np.isfinite(quad).all() and np.isfinite(position).all()):
            return track
        if track.name not in self._paths:
            self._paths[track.name] = WorldPath(self._graph)
        path = self._paths[track.name]
        path.add(frame, centre, position)
        times, positions = path.recent()
        velocity = mean_velocity(times, positions)
        ground = self._on_ground(position, times, positions)
        own_px = _sigma_px(track) * geometry.local_scale(world_from_frame, centre)
        sigma_px = hypot(camera_sigma_px, own_px)
        place = WorldPlace(quad, position, velocity, sigma_px, ground, path, frame.index)
        return replace(track, world=place)

    def _on_ground(
        self, position: Doubles, times: Doubles, positions: Doubles
    ) -> GroundPlace | None:
        if self._ground is None:
            return None
        here = self._ground.positions(position)[0]
        if not np.isfinite(here).all():
            return None
        velocity = mean_velocity(times, self._ground.positions(positions))
        return GroundPlace(here, None if velocity is None else float(np.hypot(*velocity)))


def _sigma_px(track: Track) -> float:
    """Expected RMS error of a target's corners in the frame; 0 of one without point pairs."""
    pose, quad = track.frame_from_template, track.quad
    if track.model is None or pose is None or quad is None or not track.evidence.inliers:
        return 0.0
    corners = geometry.transform_points(geometry.inverted(pose), quad)
    return target_sigma_px(pose, track.model, track.evidence, corners)


def crossing(quad: Points) -> Doubles:
    """Where the diagonals of a quad (4, 2) cross, (2,); its middle if they do not."""
    (ax, ay), (bx, by), (cx, cy), (dx, dy) = quad.tolist()
    across_x, across_y, down_x, down_y = cx - ax, cy - ay, dx - bx, dy - by
    size = across_x * down_y - across_y * down_x
    share = ((bx - ax) * down_y - (by - ay) * down_x) / size if size else 0.5
    if not 0 <= share <= 1:
        return np.asarray(quad.mean(axis=0), np.float64)
    return np.array([ax + share * across_x, ay + share * across_y])


def mean_velocity(times: Doubles, positions: Doubles) -> Doubles | None:
    """Mean velocity (2,) from times (N,) and positions (N, 2), the median of all slopes.

    Theil (1950) and Sen (1968): a third of the positions may be wrong. None if fewer than three
    moments differ, or any position is not known.
    """
    if len(times) < _LEAST_POINTS or not np.isfinite(positions).all():
        return None
    earlier, later = _pairs(len(times))
    apart = times[later] - times[earlier]
    if np.count_nonzero(np.diff(times) > 0) < _LEAST_POINTS - 1:
        return None
    if apart.min() <= 0:
        is_later = apart > 0
        earlier, later, apart = earlier[is_later], later[is_later], apart[is_later]
    slopes = (positions[later] - positions[earlier]) / apart[:, None]
    middle = len(slopes) // 2
    return np.asarray(np.partition(slopes, middle, axis=0)[middle], np.float64)


@lru_cache(maxsize=32)
def _pairs(count: int) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    return np.triu_indices(count, 1)
