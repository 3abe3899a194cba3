"""The loop: one frame in, one `Step` out."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from itertools import islice

import numpy as np

from streamtrack import geometry
from streamtrack.auto import AutoTargets
from streamtrack.budget import LEVELS, Budget
from streamtrack.camera.auto import make_camera
from streamtrack.camera.moving import CameraEstimator
from streamtrack.errors import TargetError, UsageError
from streamtrack.features import FeatureExtractor
from streamtrack.frame_view import FrameView
from streamtrack.ground import make_ground
from streamtrack.meters import StageClock
from streamtrack.settings import Settings
from streamtrack.sources.base import FrameSource
from streamtrack.targets import (
    Target,
    TargetSpec,
    auto_target,
    check_quad_in_picture,
    given_targets,
)
from streamtrack.tracking.detect import DetectTracker
from streamtrack.tracking.hybrid import HybridTracker
from streamtrack.tracking.template import make_template
from streamtrack.tracking.tracker import TargetTracker
from streamtrack.types import AUTO_STAGE, CameraPose, Frame, Step, Track
from streamtrack.working_size import WorkingSize, graph_in_full_size
from streamtrack.world import WorldMotion

_MAX_GAP_S = 1.0
_POSE_AT_OTHER_SIZE = CameraPose(None, reason="the picture's size changed")
"""Pictures of another size than the first are taken to be another camera's."""


def track(
    source: FrameSource,
    targets: Sequence[TargetSpec],
    settings: Settings | None = None,
    *,
    start: int = 0,
    step: int = 1,
    frames: int | None = None,
    camera: CameraEstimator | None = None,
) -> Generator[Step]:
    """Follow targets through a source, one `Step` a frame.

    Quads are in pixels of the first frame that is used: frame ``start`` of the source, then every
    ``step``-th, ``frames`` of them at most. So are all results, also where ``settings.max_width``
    has the work done on smaller pictures. ``camera`` is the settings' own unless it is given.
    When a live source was opened again (`Frame.epoch`), targets are looked for everywhere after a
    longer gap or in a picture of another size. Raises TargetError if a target cannot be tracked in
    that frame, SourceError when the source breaks, UsageError if it has no frame ``start``.
    """
    settings = settings or Settings()
    extractors = _extractors(settings)
    budget = Budget(settings.tracker.budget_ms)
    working_size = WorkingSize(settings.max_width)
    given = given_targets(targets)
    auto = _make_auto(targets)
    trackers: list[TargetTracker] = []
    camera = camera or make_camera(settings, is_live=source.info.is_live)
    graph = graph_in_full_size(camera.graph, source.info.size_wh, settings.max_width)
    world = WorldMotion(graph, make_ground(settings.world))
    stop = None if frames is None else start + max(0, (frames - 1) * step + 1)
    world_size_wh = source.info.size_wh
    last: Frame | None = None
    for frame in islice(source, start, stop, step):
        clock = StageClock()
        work = budget.level
        view = FrameView(working_size.small(frame), extractors[work.index], work)
        if last is None:
            trackers = [
                make_tracker(working_size.target(target), view, extractors[0], settings)
                for target in given
            ]
            world_size_wh = frame.size_wh
        elif _is_elsewhere(last, frame):
            for tracker in trackers:
                tracker.forget_place()
            auto = _make_auto(targets, auto)
        last = frame
        tracks = _follow_all(trackers, view, clock)
        moving = tracks if auto is None else (*tracks, *auto.expected())
        with clock.timed("camera"):
            is_same_size = frame.size_wh == world_size_wh
            pose = camera.update(view, moving) if is_same_size else _POSE_AT_OTHER_SIZE
        if auto is not None:
            with clock.timed(AUTO_STAGE):
                tracks = (*tracks, *auto.update(view, pose, tracks))
        if view.detected is not None:
            clock.add("detect", view.detect_ms)
        total_ms = clock.total_ms
        budget.note(total_ms + frame.waited_s * 1e3)
        stage_ms = {**clock.stage_ms, "total": total_ms}
        seen = Step(view.frame, tracks, pose, view.detected, stage_ms, work.index)
        yield world.placed(working_size.full(frame, seen))
    if last is None and start > 0 and frames != 0:
        raise UsageError(f"the source has no frame {start}: it ended before")


def _make_auto(
    targets: Sequence[TargetSpec], before: AutoTargets | None = None
) -> AutoTargets | None:
    """What finds targets by itself, if that is asked for; its names go on after those before."""
    wish = auto_target(targets)
    if wish is None:
        return None
    taken = [target.name for target in given_targets(targets)]
    return AutoTargets(wish.name, taken, 0 if before is None else before.count)


def _is_elsewhere(last: Frame, frame: Frame) -> bool:
    """Is what was known of the last frame's places of no use in this one?"""
    if frame.epoch == last.epoch:
        return False
    return frame.size_wh != last.size_wh or frame.time_s - last.time_s > _MAX_GAP_S


def _extractors(settings: Settings) -> list[FeatureExtractor]:
    """One for each level of work; the first finds all the features that the settings ask for."""
    most = settings.features.max_features
    counts = [max(8, round(most * level.feature_share)) for level in LEVELS]
    return [
        FeatureExtractor(settings.features.model_copy(update={"max_features": count}))
        for count in counts
    ]


def _follow_all(
    trackers: Sequence[TargetTracker], view: FrameView, clock: StageClock
) -> tuple[Track, ...]:
    """Every target in the frame; its time counts to the way it was found, detection apart."""
    tracks: list[Track] = []
    for tracker in trackers:
        began_ms, detect_ms = clock.total_ms, view.detect_ms
        tracks.append(tracker.update(view))
        spent_ms = clock.total_ms - began_ms - (view.detect_ms - detect_ms)
        clock.add("flow" if tracks[-1].means in ("flow", "view", "body") else "match", spent_ms)
    return tuple(tracks)


def make_tracker(
    target: Target, view: FrameView, extractor: FeatureExtractor, settings: Settings
) -> TargetTracker:
    """The tracker of one target; ``view`` is the first frame, in which its quad lies."""
    picture = view.frame.image if target.picture is None else target.picture
    size_wh = (picture.shape[1], picture.shape[0])
    quad = geometry.image_quad(size_wh) if target.quad is None else target.quad
    where = "the first frame" if target.picture is None else "the template picture"
    check_quad_in_picture(target.name, quad, size_wh, where)
    template = make_template(target.name, picture, quad, extractor)
    found, needed = len(template.features), settings.registration.min_inliers
    if found < needed and (settings.tracker.method == "detect" or target.picture is not None):
        raise TargetError(
            f"target '{target.name}' has only {found} features, {needed} needed: lower "
            "--threshold, choose another detector, or a larger or more structured region"
        )
    first_pose = np.eye(3) if target.picture is None else None
    if settings.tracker.method == "detect":
        return DetectTracker(template, settings)
    return HybridTracker(template, settings, first_pose)
