"""Work on smaller pictures (``max_width``), results in pixels of the frames as they came.

Thresholds in pixels (`RegistrationSettings.inlier_threshold_px`) then mean pixels of the smaller
pictures; whatever is handed on, residuals included, is in the frames' own.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from math import sqrt
from typing import TYPE_CHECKING

import cv2
import numpy as np

from streamtrack.errors import TargetError
from streamtrack.geometry import inverted, scaling, transform_points
from streamtrack.targets import MIN_SIDE_PX, Target, check_quad_in_picture, least_side_px
from streamtrack.types import CameraPose, Features, Frame, Image, Matrix, Size, Step, Track

if TYPE_CHECKING:
    from streamtrack.pose_graph import KeyframeEdge, PoseGraph


def size_at(size_wh: Size, max_width: int | None) -> Size:
    """The size at which a picture is worked on: no wider than ``max_width``."""
    width, height = size_wh
    if max_width is None or width <= max_width:
        return size_wh
    return max_width, max(1, round(height * max_width / width))


def full_from_small(size_wh: Size, max_width: int | None) -> Matrix:
    """Pixels of a picture of that size from those of its smaller version."""
    small = size_at(size_wh, max_width)
    return scaling(size_wh[0] / small[0], size_wh[1] / small[1])


def resized(picture: Image, size_wh: Size) -> Image:
    """The picture, uint8, at a smaller size, averaged; itself if the size is its own."""
    if (picture.shape[1], picture.shape[0]) == size_wh:
        return picture
    return np.asarray(cv2.resize(picture, size_wh, interpolation=cv2.INTER_AREA), np.uint8)


def reduced(picture: Image, factor: float) -> Image:
    """The picture, uint8, with its sides times a factor of at most 1, a pixel at least."""
    height, width = picture.shape[:2]
    return resized(picture, (max(1, round(width * factor)), max(1, round(height * factor))))


class WorkingSize:
    """Makes the frames and targets of one run smaller, and its results large again."""

    def __init__(self, max_width: int | None) -> None:
        self._max_width = max_width
        self._first_wh: Size | None = None
        self._from_pictures: set[str] = set()

    def small(self, frame: Frame) -> Frame:
        """The frame to work on."""
        self._first_wh = self._first_wh or frame.size_wh
        size = size_at(frame.size_wh, self._max_width)
        return frame if size == frame.size_wh else replace(frame, image=resized(frame.image, size))

    def target(self, target: Target) -> Target:
        """A target as it lies in the smaller first frame; those with a picture stay as they are.

        Raises TargetError if it does not fit the frame, or would be too small.
        """
        assert self._first_wh is not None
        if target.picture is not None or target.quad is None:
            self._from_pictures.add(target.name)
            return target
        check_quad_in_picture(target.name, target.quad, self._first_wh)
        first = full_from_small(self._first_wh, self._max_width)
        quad = transform_points(inverted(first), target.quad)
        if least_side_px(quad) < MIN_SIDE_PX:
            raise TargetError(
                f"target '{target.name}' is only {least_side_px(quad):.0f} px wide or high at the "
                f"width of {self._max_width} px to work at: raise --max-width"
            )
        return replace(target, quad=quad)

    def full(self, frame: Frame, step: Step) -> Step:
        """The step with ``frame`` as it came, and all results in its pixels."""
        if self._first_wh is None or self._is_unchanged(frame.size_wh, self._first_wh):
            return step
        first = full_from_small(self._first_wh, self._max_width)
        now = full_from_small(frame.size_wh, self._max_width)
        unchanged = np.eye(3)
        return replace(
            step,
            frame=frame,
            tracks=tuple(
                replace(
                    mapped_track(
                        track, now, unchanged if track.name in self._from_pictures else first
                    ),
                    rmse_px=track.rmse_px * _factor(now),
                )
                for track in step.tracks
            ),
            camera=_mapped_pose(step.camera, first, now),
            features=None if step.features is None else mapped_features(step.features, now),
        )

    def _is_unchanged(self, *sizes: Size) -> bool:
        return all(size_at(size, self._max_width) == size for size in sizes)


def mapped_features(features: Features, new_from_frame: Matrix) -> Features:
    """Features in pixels of a resized frame."""
    return replace(
        features,
        points=transform_points(new_from_frame, features.points),
        sizes=(features.sizes * _factor(new_from_frame)).astype(np.float32),
    )


def mapped_track(track: Track, new_from_frame: Matrix, new_from_template: Matrix) -> Track:
    """Where a track lies in a resized frame and template picture; its figures stay as they are."""
    pose, evidence = track.frame_from_template, track.evidence
    return replace(
        track,
        quad=None if track.quad is None else transform_points(new_from_frame, track.quad),
        frame_from_template=(
            None if pose is None else new_from_frame @ pose @ inverted(new_from_template)
        ),
        evidence=replace(
            evidence,
            template_points=transform_points(new_from_template, evidence.template_points),
            frame_points=transform_points(new_from_frame, evidence.frame_points),
            unmatched_points=transform_points(new_from_frame, evidence.unmatched_points),
        ),
    )


def _mapped_pose(pose: CameraPose, new_from_world: Matrix, new_from_frame: Matrix) -> CameraPose:
    rmse_px = pose.rmse_px * _factor(new_from_frame)
    sigma_px = pose.sigma_px * _factor(new_from_world)
    if pose.world_from_frame is None:
        return replace(pose, rmse_px=rmse_px)
    world_from_frame = new_from_world @ pose.world_from_frame @ inverted(new_from_frame)
    return replace(pose, world_from_frame=world_from_frame, rmse_px=rmse_px, sigma_px=sigma_px)


def _factor(new_from_old: Matrix) -> float:
    """New pixels per old one along a line, of a resizing."""
    return sqrt(float(new_from_old[0, 0] * new_from_old[1, 1]))


@dataclass(frozen=True, slots=True)
class _FullKeyframe:
    world_from_keyframe: Matrix


def graph_in_full_size(
    graph: PoseGraph | None, size_wh: Size, max_width: int | None
) -> PoseGraph | None:
    """The keyframes in the pixels of frames of that size, whatever the work is done on."""
    if graph is None or max_width is None:
        return graph
    return FullSizeGraph(graph, full_from_small(size_wh, max_width))


class FullSizeGraph:
    """The keyframes of a camera that worked on smaller pictures, in pixels of the first frame."""

    def __init__(self, graph: PoseGraph, full_from_small: Matrix) -> None:
        self._graph = graph
        self._full_from_small = full_from_small

    @property
    def revision(self) -> int:
        return self._graph.revision

    @property
    def keyframes(self) -> Mapping[int, _FullKeyframe]:
        return {
            index: _FullKeyframe(self._full(keyframe.world_from_keyframe))
            for index, keyframe in self._graph.keyframes.items()
        }

    @property
    def edges(self) -> Iterable[KeyframeEdge]:
        return self._graph.edges

    def keyframe_of(self, index: int) -> int | None:
        """The keyframe that a frame moves with."""
        return self._graph.keyframe_of(index)

    def world_from_frame(self, index: int) -> Matrix | None:
        pose = self._graph.world_from_frame(index)
        return None if pose is None else self._full(pose)

    def sigma_px(self, index: int) -> float:
        return self._graph.sigma_px(index) * _factor(self._full_from_small)

    def keep(self, index: int) -> None:
        self._graph.keep(index)

    def _full(self, pose: Matrix) -> Matrix:
        return self._full_from_small @ pose @ inverted(self._full_from_small)
