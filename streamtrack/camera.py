"""Camera motion: where each frame lies in the world, the pixel frame of the first keyframe.

A moving camera is registered against a keyframe, not against the frame before: consecutive
frames differ too little, and their errors would add up. A new keyframe is taken when the view
has moved on, always from a frame whose own pose passed the gate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from streamtrack import geometry
from streamtrack.frame_view import FrameView
from streamtrack.matching import match
from streamtrack.registration import register
from streamtrack.settings import Settings
from streamtrack.types import CameraPose, Features, Matrix, Registration, Track, Verdict

_MIN_OVERLAP = 0.6
_MIN_KEYFRAME_INLIERS = 60
_KEYFRAMES_KEPT = 4


class CameraEstimator(Protocol):
    """What the pipeline asks of a camera model."""

    def update(self, view: FrameView, tracks: Sequence[Track]) -> CameraPose:
        """The camera's pose in the next frame; ``tracks`` are its targets, which may move."""
        ...


def make_camera(settings: Settings) -> CameraEstimator:
    """The camera model that the settings ask for."""
    return MovingCamera(settings) if settings.camera == "moving" else FixedCamera()


class FixedCamera:
    """A camera on a tripod: the world is the picture."""

    def update(self, view: FrameView, tracks: Sequence[Track]) -> CameraPose:
        return CameraPose(np.eye(3))


@dataclass(frozen=True, slots=True, eq=False)
class _Keyframe:
    background: Features
    world_from_keyframe: Matrix


class MovingCamera:
    """A camera that moves: the background's features against those of the last keyframes."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._keyframes: list[_Keyframe] = []

    def update(self, view: FrameView, tracks: Sequence[Track]) -> CameraPose:
        background = _outside_targets(view.features(), tracks)
        if not self._keyframes:
            return self._first_pose(background)
        pose = CameraPose(None, reason=Verdict.TOO_FEW_MATCHES)
        for keyframe in reversed(self._keyframes):
            pose, keyframe_from_frame = self._pose_against(keyframe, background, view)
            if pose.world_from_frame is not None and keyframe_from_frame is not None:
                if _has_moved_on(keyframe_from_frame, pose, view):
                    self._add_keyframe(background, pose.world_from_frame)
                break
        return pose

    def _first_pose(self, background: Features) -> CameraPose:
        if len(background) < self._settings.registration.min_inliers:
            return CameraPose(None, reason=Verdict.TOO_FEW_FEATURES)
        self._add_keyframe(background, np.eye(3))
        return CameraPose(np.eye(3), len(background), len(background), 0.0)

    def _add_keyframe(self, background: Features, world_from_frame: Matrix) -> None:
        self._keyframes.append(_Keyframe(background, world_from_frame))
        del self._keyframes[:-_KEYFRAMES_KEPT]

    def _pose_against(
        self, keyframe: _Keyframe, background: Features, view: FrameView
    ) -> tuple[CameraPose, Matrix | None]:
        matches = match(background, keyframe.background, self._settings.matching)
        width, height = view.size_wh
        found: Registration = register(
            background.points[matches.ref],
            keyframe.background.points[matches.cur],
            self._settings.registration,
            geometry.image_quad(view.size_wh),
            float(width * height),
        )
        world_from_frame = None
        if found.b_from_a is not None:
            world_from_frame = geometry.normalized(keyframe.world_from_keyframe @ found.b_from_a)
        reason = "" if world_from_frame is not None else str(found.verdict)
        pose = CameraPose(world_from_frame, len(matches), found.inliers, found.rmse_px, reason)
        return pose, found.b_from_a


def _has_moved_on(keyframe_from_frame: Matrix, pose: CameraPose, view: FrameView) -> bool:
    quad = geometry.transform_points(keyframe_from_frame, geometry.image_quad(view.size_wh))
    overlap = geometry.visible_share(quad, view.size_wh)
    return overlap < _MIN_OVERLAP or pose.inliers < _MIN_KEYFRAME_INLIERS


def _outside_targets(features: Features, tracks: Sequence[Track]) -> Features:
    kept = np.ones(len(features), np.bool_)
    for track in tracks:
        if track.quad is not None:
            hull = track.quad.reshape(-1, 1, 2)
            kept &= [
                cv2.pointPolygonTest(hull, (float(x), float(y)), False) < 0
                for x, y in features.points
            ]
    return features[kept]
