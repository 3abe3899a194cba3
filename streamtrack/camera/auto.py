"""Does the camera stand or move? Found out by what it does, and asked again in every frame.

It moves until the picture has been the same for a while. While it stands its pose does not change,
and a glance at a small picture (`standing`) tells whether that is still so; what the glance doubts
is estimated as for a moving camera, so a frame in which a tripod was bumped already has its true
pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from streamtrack import geometry
from streamtrack.camera.fixed import FixedCamera
from streamtrack.camera.keyframes import KeyframeGraph
from streamtrack.camera.moving import CameraEstimator, MovingCamera
from streamtrack.camera.standing import Stand, StandCheck
from streamtrack.camera.view_levels import ViewLevels
from streamtrack.frame_view import FrameView
from streamtrack.settings import Settings
from streamtrack.types import CameraKind, CameraPose, Matrix, Points, Size, Track, Verdict

_STILL_PX = 0.75
"""Poses that differ by more are not those of a camera that stands."""
_DOUBT_PX = 0.5
_BEGINS, _STAYS = 0.12, 0.07
"""Shares of the textured cells that must be where they were for a camera to be found at rest, and
for one at rest to be so still. They do not decide alone: of clips from a moving hand two had 0.04,
one 0.25."""
_STILL_FRAMES = 25
_MOST_STILL_FRAMES = 400
_OTHER_FRAMES = 5  # in a row: something large may pass by
_MOST_PAUSE = 10  # frames between two looks whether a camera that moves has come to rest
_RENEW_EVERY = 250  # frames, so that the light may change


def make_camera(settings: Settings, *, is_live: bool = False) -> CameraEstimator:
    """The camera model that the settings ask for.

    ``is_live``: no frame waits for the thread that closes loops.
    """
    if settings.camera == "moving":
        return MovingCamera(settings, is_live=is_live)
    if settings.camera == "auto":
        return AutoCamera(settings, is_live=is_live)
    return FixedCamera()


@dataclass(slots=True, eq=False)
class _Standing:
    """A camera at rest: where, against a keyframe, what it sees, and how long that was believed."""

    keyframe: int
    keyframe_from_frame: Matrix
    check: StandCheck
    frames: int = 0

    def pose(self, graph: KeyframeGraph) -> Matrix:
        """world_from_frame, which is another once keyframes were moved."""
        world_from_keyframe = graph.keyframes[self.keyframe].world_from_keyframe
        return geometry.normalized(world_from_keyframe @ self.keyframe_from_frame)


class AutoCamera:
    """A camera of which it is found out whether it stands or moves, and when that changes."""

    def __init__(self, settings: Settings, *, is_live: bool = False) -> None:
        self._moving = MovingCamera(settings, is_live=is_live)
        self._standing: _Standing | None = None
        self._rest: _Rest | None = None
        self._needed = _STILL_FRAMES
        self._pause = 0
        self._frames_to_look = 0

    @property
    def graph(self) -> KeyframeGraph:
        """The keyframes; one alone as long as the camera stands."""
        return self._moving.graph

    @property
    def is_fixed(self) -> bool:
        """Whether the camera stands, by what was seen last."""
        return self._standing is not None

    def update(self, view: FrameView, tracks: Sequence[Track]) -> CameraPose:
        """The camera's pose in the next frame; while it stands always the same."""
        if self._standing is not None:
            return self._glance(self._standing, view, tracks)
        pose = self._moving.update(view, tracks)
        if not view.levels.is_flat():
            self._look_for_rest(pose, view, tracks)
        return replace(pose, kind=CameraKind.MOVING)

    def close(self) -> None:
        """Finish the work on loops."""
        self._moving.close()

    def _look_for_rest(self, pose: CameraPose, view: FrameView, tracks: Sequence[Track]) -> None:
        """Has the picture been the same for long enough? From here on the camera stands then.

        While every look finds another picture the camera moves, and is looked at ever more seldom.
        """
        levels, hidden, rest = view.levels, _hidden(tracks), self._rest
        if rest is None:
            self._frames_to_look -= 1
            if self._frames_to_look < 0 and pose.world_from_frame is not None:
                self._rest = self._begun_rest(view, hidden)
        elif _is_at_rest(rest.check.of(levels, hidden), rest.check, levels, _BEGINS):
            rest.add(pose, view.size_wh)
            self._pause = 0
            keyframe = rest.keyframe
            if rest.frames >= self._needed and keyframe is not None:
                found = rest.pose(view.size_wh)
                world_from_keyframe = self.graph.keyframes[keyframe].world_from_keyframe
                in_keyframe = geometry.normalized(geometry.inverted(world_from_keyframe) @ found)
                self._standing = _Standing(keyframe, in_keyframe, rest.check)
                self._rest = None
        elif rest.is_over():
            if rest.frames == 0:
                self._pause = min(2 * self._pause + 1, _MOST_PAUSE)
            self._frames_to_look = self._pause
            self._rest = None if self._pause else self._begun_rest(view, hidden)

    def _begun_rest(self, view: FrameView, hidden: Sequence[Points]) -> _Rest | None:
        """A rest that may begin in this frame; None where the picture does not tell."""
        check = StandCheck(view.levels, hidden)
        is_start = view.frame.index == next(iter(self.graph.keyframes))
        return _Rest(check, is_start) if check.is_possible else None

    def _glance(self, standing: _Standing, view: FrameView, tracks: Sequence[Track]) -> CameraPose:
        """The pose of a camera that stood until now."""
        levels, hidden = view.levels, _hidden(tracks)
        if levels.is_flat():
            reason = str(Verdict.TOO_FEW_FEATURES)
            return CameraPose(None, reason=reason, kind=CameraKind.FIXED)
        standing.frames += 1
        seen = standing.check.of(levels, hidden)
        is_at_rest = _is_at_rest(seen, standing.check, levels, _STAYS)
        if is_at_rest and standing.frames < _RENEW_EVERY:
            stood = CameraPose(None, seen.pixels, seen.pixels, keyframe=standing.keyframe)
            return self._unmoved(stood, standing, view)
        found = self._moving.update(view, tracks)
        if found.world_from_frame is None:
            return replace(found, kind=CameraKind.FIXED)
        pose = standing.pose(self.graph)
        if _apart_px(found.world_from_frame, pose, view.size_wh) > _STILL_PX:
            if is_at_rest:  # what moves by itself has carried the estimate along
                return self._unmoved(found, standing, view)
            self._standing = None
            self._needed = min(2 * self._needed, _MOST_STILL_FRAMES)
            return replace(found, kind=CameraKind.MOVING)
        check = StandCheck(levels, hidden)
        if check.is_possible:
            standing.check, standing.frames = check, 0
        return self._unmoved(found, standing, view)

    def _unmoved(self, found: CameraPose, standing: _Standing, view: FrameView) -> CameraPose:
        keyframe, keyframe_from_frame = standing.keyframe, standing.keyframe_from_frame
        self.graph.add_frame(view.frame.index, keyframe, keyframe_from_frame)
        pose = standing.pose(self.graph)
        sigma_px = self.graph.sigma_px(standing.keyframe)
        return replace(found, world_from_frame=pose, kind=CameraKind.FIXED, sigma_px=sigma_px)


class _Rest:
    """How long the picture has been as in one frame, and the pose that was estimated meanwhile.

    ``keyframe`` is the one that was last seen.
    """

    def __init__(self, check: StandCheck, is_start: bool) -> None:
        self.check = check
        self.frames = 0
        self.keyframe: int | None = None
        self._others = 0
        self._poses = 0
        self._is_start = is_start
        self._corners = np.zeros((4, 2))

    def is_over(self) -> bool:
        """Whether the picture, now another, has been for long enough to compare with a new one.

        At once if it never was the same.
        """
        self._others += 1
        return self.frames == 0 or self._others >= _OTHER_FRAMES

    def add(self, pose: CameraPose, size_wh: Size) -> None:
        """One more frame like that; its pose need not be known."""
        self.frames, self._others = self.frames + 1, 0
        if pose.world_from_frame is not None:
            corners = geometry.image_quad(size_wh)
            self._corners += geometry.transform_points(pose.world_from_frame, corners)
            self._poses += 1
            self.keyframe = pose.keyframe

    def pose(self, size_wh: Size) -> Matrix:
        """The mean pose; the world's own if the picture is that of its first frame."""
        if self._is_start:
            return np.eye(3)
        mean = np.asarray(self._corners / self._poses, np.float32)
        return geometry.quad_mapping(geometry.image_quad(size_wh), mean)


def _is_at_rest(seen: Stand, check: StandCheck, levels: ViewLevels, share: float) -> bool:
    return seen.moved_px < _DOUBT_PX or check.stayed_share(levels) >= share


def _hidden(tracks: Sequence[Track]) -> list[Points]:
    return [track.quad for track in tracks if track.quad is not None]


def _apart_px(one: Matrix, other: Matrix, size_wh: Size) -> float:
    """How far apart two poses put a point of the picture's inner half, at most.

    There, as its corners depend on what little texture is next to them.
    """
    width, height = size_wh
    quad = geometry.box_quad(width / 4, height / 4, width / 2, height / 2)
    off = geometry.transform_points(one, quad) - geometry.transform_points(other, quad)
    return float(np.max(np.hypot(off[:, 0], off[:, 1])))
