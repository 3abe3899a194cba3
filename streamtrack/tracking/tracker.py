"""What a method of following one target is, and what it makes of a frame.

A target that is not found is ``lost`` at once, and no old quad is ever repeated.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from streamtrack import geometry
from streamtrack.frame_view import FrameView
from streamtrack.registration import register
from streamtrack.settings import Settings
from streamtrack.tracking.template import Template
from streamtrack.types import Evidence, Features, Matches, Registration, Track, TrackState


class TargetTracker(Protocol):
    """What the pipeline asks of a method of following one target."""

    @property
    def template(self) -> Template: ...

    def update(self, view: FrameView) -> Track:
        """The target in the next frame."""
        ...

    def forget_place(self) -> None:
        """The stream was interrupted: the next frame is searched everywhere."""
        ...


def register_features(
    template: Template, view: FrameView, features: Features, matches: Matches, settings: Settings
) -> tuple[Registration, Evidence]:
    """frame_from_template from matched features, and the pairs it rests on."""
    width, height = view.size_wh
    template_points = template.features.points[matches.ref]
    frame_points = features.points[matches.cur]
    found = register(
        template_points, frame_points, settings.registration, template.quad, float(width * height)
    )
    is_matched = np.zeros(len(features), np.bool_)
    is_matched[matches.cur] = True
    unmatched = features.points[~is_matched]
    return found, Evidence(template_points, frame_points, found.is_inlier, unmatched)


def make_track(
    template: Template,
    found: Registration,
    evidence: Evidence,
    means: str,
    was_seen: bool,
    correlation: float = float("nan"),
) -> Track:
    """The track that a registration stands for: a quad if it is OK, else the reason why not."""
    if found.b_from_a is None:
        state = TrackState.LOST if was_seen else TrackState.SEARCHING
        return Track(template.name, state, evidence=evidence, means=means, reason=found.verdict)
    return Track(
        template.name,
        TrackState.TRACKING,
        quad=geometry.transform_points(found.b_from_a, template.quad),
        frame_from_template=found.b_from_a,
        model=found.model,
        evidence=evidence,
        rmse_px=found.rmse_px,
        correlation=correlation,
        means=means,
    )
