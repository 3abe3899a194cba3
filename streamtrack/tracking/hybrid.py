"""Predict, warp back, align with the first view; views, a body or features when that fails.

The pose is predicted, the frame warped back by it, and what is left of the motion measured against
the first-frame picture. When the gate refuses, recent views of the target are tried, and features,
first near the prediction and then everywhere; a target that turns out not to be flat goes on as a
`Body`.
"""

from __future__ import annotations

import numpy as np

from streamtrack import geometry
from streamtrack.frame_view import FrameView
from streamtrack.registration import refused
from streamtrack.settings import Settings
from streamtrack.tracking.alignment import (
    CLEAR,
    Alignment,
    Hope,
    agreeing_share,
    seen_share,
    withdrawn,
)
from streamtrack.tracking.appearance import (
    MAX_CHROMA_DISTANCE,
    MAX_CHROMA_DISTANCE_OTHER_CAMERA,
    chroma_distance,
    prepare_colors,
)
from streamtrack.tracking.body import Body, begun_body
from streamtrack.tracking.certainty import (
    MAX_SIGMA_FOLLOWED_PX,
    MAX_SIGMA_FOUND_PX,
    are_corners_certain,
)
from streamtrack.tracking.flatness import Flatness
from streamtrack.tracking.flow import FlowAligner
from streamtrack.tracking.prediction import Prediction
from streamtrack.tracking.search import FeatureSearch
from streamtrack.tracking.template import Template
from streamtrack.tracking.tracker import make_track
from streamtrack.tracking.views import MIN_VIEW_SHARE, RecentViews
from streamtrack.types import Evidence, Matrix, Model, Registration, Track, Verdict

_COAST_FRAMES = 10  # lost frames in which the last pose is still tried
_MAX_AREA_JUMP = 1.5  # from the prediction to what is found
_MIN_RETURN_SHARE = 0.3  # of the points in view, for a target that was lost
_MIN_SURPRISE_PX = 2.0
_THIN_SHARE = 0.33  # inliers of all points, below which hidden corners go by prediction
_MAX_DOUBT_PX = 8.0  # how far off hidden corners may be thought to be
_CALM_SURPRISE_PX = 3.0  # of a guess that is tried at once
_CALM_SURPRISE_FLAT_PX = 4.5
_LEAST_HOPED_SHARE = 0.35
_SHARE_KEPT = 0.85  # of the last frame's, where less agree of what is flat: an occluder stays
_CLEAR_VIEW_SHARE = 0.5  # inliers of all points, below which a frame teaches no surprise
_REMEMBERED_SHARE = 0.4  # of the points in view, for a frame to be a recent view
_VIEW_ADVANTAGE = 0.3  # in share of points, of a recent view over the first
_RENEWED_BELOW_SHARE = 0.75
_FRAMES_BETWEEN_VIEWS = 4  # after a view that did not help
_FRAMES_BETWEEN_NEAR = 3  # after a guess that was not as good as hoped: blur stays for a while
_BODY_COAST_FRAMES = 30  # lost frames in which a body is looked for at its last place
_FRAMES_BETWEEN_PLANES = 24  # of a body, in which it is asked whether it is flat after all
_COLOR_REACH_SHARE = 0.04  # of the target's size: how far around a point colours are compared


class HybridTracker:
    """Predict, warp back, flow against the first frame, gate; features when that fails."""

    def __init__(
        self, template: Template, settings: Settings, first_pose: Matrix | None = None
    ) -> None:
        self.template = template
        self._settings = settings
        self._aligner = FlowAligner(template, settings.registration)
        self._views = RecentViews(template, settings.registration)
        self._is_in_view = False
        self._body: Body | None = None
        self._flatness = Flatness(template.quad)
        self._frames_to_next_view = 0
        self._frames_to_next_near = 0
        self._uses_views = settings.registration.model == "auto"
        only_shifts = settings.registration.model == "translation"
        step_model = Model.TRANSLATION if only_shifts else Model.SIMILARITY
        self._prediction = Prediction(template.quad, step_model, first_pose)
        self._frames_lost = 0
        self._search = FeatureSearch(template, settings)
        self._doubt_px = 0.0
        self._last_share = 0.0
        self._last_seen = 0.0
        self._was_seen = first_pose is not None
        self._is_same_camera = first_pose is not None
        self._max_chroma_distance = (
            MAX_CHROMA_DISTANCE if self._is_same_camera else MAX_CHROMA_DISTANCE_OTHER_CAMERA
        )
        prepare_colors(template.picture)

    def update(self, view: FrameView) -> Track:
        self._views.was_made_now = False
        if self._body is not None:
            seen = self._follow_body(self._body, view)
            if seen is not None:
                return seen
        was_in_view = self._is_in_view
        followed = None if self._body is not None else self._follow(view)
        recent = self._follow_views(view, followed)
        if recent is not None:
            return self._tracked(recent, "view")
        if was_in_view and followed is not None and followed.registration.b_from_a is None:
            followed = self._follow(view)
        pose = None if followed is None else followed.registration.b_from_a
        if followed is not None and pose is not None:
            share = agreeing_share(followed)
            self._flatness.learn(pose, share, followed.alike, followed.correlation)
            if self._flatness.is_proven or share >= _REMEMBERED_SHARE:
                self._views.remember(view, followed)
            if self._flatness.is_disproven:
                self._body = self._begun_body()
            return self._tracked(followed, "flow")
        if self._body is None and followed is not None and self._frames_lost == 0:
            if self._flatness.may_be_body(followed.alike):
                self._body = self._begun_body()
            seen = None if self._body is None else self._follow_body(self._body, view)
            if seen is not None:
                return seen
            self._body = None
        self._views.forget()
        # Making a view takes as long as a search: not both in one frame.
        if self._views.was_made_now or not self._is_searched_in(view):
            return self._not_searched(followed)
        last_pose = self._prediction.pose if self._frames_lost <= 1 else None
        detected, evidence, means = self._search.find(view, last_pose, was_seen=self._was_seen)
        if detected.b_from_a is not None:
            confirmed = self._aligner.align(view, detected.b_from_a)
            if agreeing_share(confirmed) < _MIN_RETURN_SHARE:
                confirmed = withdrawn(confirmed, Verdict.LOW_CORRELATION)
            confirmed = self._with_own_colors(confirmed, view)
            if confirmed.registration.verdict is Verdict.OK:
                self._body = None
                return self._tracked(confirmed, means)
            detected = confirmed.registration
        self._frames_lost += 1
        verdict = detected if followed is None else followed.registration
        return make_track(self.template, verdict, evidence, means, self._was_seen)

    def forget_place(self) -> None:
        self._prediction.forget()
        self._body = None
        self._frames_lost = 1
        self._views.forget()

    def _is_searched_in(self, view: FrameView) -> bool:
        """Lost targets take turns between their last place and a search, and keep to the budget."""
        if self._coasts():
            return self._frames_lost == 0
        interval = view.work.search_interval
        return self._frames_lost % interval == interval - 1

    def _coasts(self) -> bool:
        """Is this one of the frames in which a target is tried at its last place?"""
        is_turn = self._frames_lost % 2 == 0
        return self._prediction.pose is not None and is_turn and self._frames_lost <= _COAST_FRAMES

    def _not_searched(self, followed: Alignment | None) -> Track:
        self._frames_lost += 1
        not_searched = refused(Verdict.NOT_SEARCHED, 0)
        found = not_searched if followed is None else followed.registration
        return make_track(self.template, found, Evidence(), "flow", self._was_seen)

    def _follow(self, view: FrameView) -> Alignment | None:
        if self._prediction.pose is None or not self._coasts():
            return None
        guess = self._prediction.guess
        followed = self._plausible(self._align_first(view, guess), guess)
        found = followed.registration
        if found.b_from_a is not None and self._frames_lost == 0:
            share = seen_share(followed)
            if share >= _CLEAR_VIEW_SHARE:
                self._doubt_px = 0.0
            elif share < _THIN_SHARE:
                self._doubt_px = float(np.hypot(self._doubt_px, self._sigma_px))
                if self._doubt_px > _MAX_DOUBT_PX:
                    followed = withdrawn(followed, Verdict.MOSTLY_HIDDEN)
        return followed if self._frames_lost == 0 else self._with_own_colors(followed, view)

    def _is_clear(self, alignment: Alignment) -> bool:
        """Is so much of the target seen that the frame teaches how good predictions are?"""
        return seen_share(alignment) >= _CLEAR_VIEW_SHARE

    def _align_first(self, view: FrameView, guess: Matrix) -> Alignment:
        """The first view in the frame: near the guess if that should be good, else farther off.

        While a recent view carries the target, the first is only tried for its return.
        """
        if self._frames_lost:
            return self._aligner.align(view, guess)
        if self._is_in_view:
            off_px = self._prediction.surprise_px
            return self._aligner.align_near(
                view, guess, Hope(_CLEAR_VIEW_SHARE, -1.0, 0.0, 0.0, off_px)
            )
        hope = self._hope()
        if self._frames_to_next_near:
            self._frames_to_next_near -= 1
        elif hope is not None:
            near = self._aligner.align_near(view, guess, hope, self._sigma_px)
            if near.registration.b_from_a is not None:
                return near
            self._frames_to_next_near = _FRAMES_BETWEEN_NEAR
        return self._aligner.align(view, guess, self._sigma_px)

    def _follow_views(self, view: FrameView, followed: Alignment | None) -> Alignment | None:
        """The pose by how the target looked lately, where the first view does not explain it."""
        if (
            not self._uses_views
            or self._prediction.pose is None
            or self._frames_lost
            or followed is None
        ):
            return None
        first_share = agreeing_share(followed)
        if first_share >= _CLEAR_VIEW_SHARE:
            self._is_in_view = False
            self._frames_to_next_view = 0
            return None
        is_plane = self._flatness.is_proven or first_share >= _MIN_RETURN_SHARE
        looks_as_ever = followed.correlation >= self._flatness.least_correlation
        if first_share > 0 and is_plane and looks_as_ever:
            return None
        if self._frames_to_next_view and followed.registration.b_from_a is not None:
            self._frames_to_next_view -= 1
            return None
        guess = self._prediction.guess
        if self._flatness.is_proven:
            self._views.take_as_flat()
        recent = self._views.align(view, guess, self._sigma_px)
        if recent is None:
            return None
        recent = self._with_own_colors(self._plausible(recent, guess), view)
        share = agreeing_share(recent)
        needed = MIN_VIEW_SHARE if self._is_in_view else first_share + _VIEW_ADVANTAGE
        self._is_in_view = share >= max(MIN_VIEW_SHARE, needed)
        if not self._is_in_view:
            self._frames_to_next_view = _FRAMES_BETWEEN_VIEWS
            return None
        self._views.remember(view, recent)
        if share < _RENEWED_BELOW_SHARE:
            self._views.renew()
        return recent

    def _begun_body(self) -> Body | None:
        """The target as a body, as its newest clear sight shows it; None if it may not be one."""
        sight = self._views.newest
        if sight is None or self._flatness.is_proven or not self._uses_views:
            return None
        return begun_body(self.template, sight, is_same_camera=self._is_same_camera)

    def _follow_body(self, body: Body, view: FrameView) -> Track | None:
        """The track of a target that is not flat; None if it is not seen near its last place."""
        assert self._prediction.pose is not None
        was_lost = self._frames_lost > 0
        if self._frames_lost > _BODY_COAST_FRAMES:
            self._body = None
            return None
        pose = body.follow(view.frame.image, self._prediction.guess, was_lost=was_lost)
        if pose is None:
            if not body.frames_seen:
                self._body = None
            return None
        if body.frames_seen % _FRAMES_BETWEEN_PLANES == 1:
            plane = self._aligner.align(view, pose)
            if self._flatness.is_plane(agreeing_share(plane), plane.alike, plane.correlation):
                self._body = None
                return self._tracked(plane, "flow")
        if was_lost:
            self._prediction.begin_at(pose, 1.0)
        else:
            self._prediction.follow(pose, is_clear=True)
        self._frames_lost = 0
        self._search.rest()
        found = Registration(
            Verdict.OK, pose, Model.SIMILARITY, np.zeros(0, np.bool_), float("nan")
        )
        return make_track(self.template, found, Evidence(), "body", self._was_seen)

    def _hope(self) -> Hope | None:
        """What to expect of the guess, if the target was well predicted in the last frames."""
        most_px = _CALM_SURPRISE_FLAT_PX if self._flatness.is_proven else _CALM_SURPRISE_PX
        if self._prediction.surprise_px > most_px:
            return None
        return Hope(
            max(_LEAST_HOPED_SHARE, min(CLEAR, _SHARE_KEPT * self._last_share)),
            self._flatness.least_correlation,
            self._last_seen,
            self._prediction.motion_px,
            self._prediction.surprise_px,
        )

    def _plausible(self, alignment: Alignment, guess: Matrix) -> Alignment:
        """The alignment, refused if the target jumped in size, or came back on thin evidence."""
        found = alignment.registration
        if found.b_from_a is None:
            return alignment
        verdict = Verdict.OK
        quad = self.template.quad
        area_ratio = geometry.signed_area(
            geometry.transform_points(found.b_from_a, quad)
        ) / geometry.signed_area(geometry.transform_points(guess, quad))
        if not 1 / _MAX_AREA_JUMP <= area_ratio <= _MAX_AREA_JUMP:
            verdict = Verdict.AREA
        elif self._frames_lost and agreeing_share(alignment) < _MIN_RETURN_SHARE:
            verdict = Verdict.LOW_CORRELATION
        return alignment if verdict is Verdict.OK else withdrawn(alignment, verdict)

    @property
    def _sigma_px(self) -> float:
        """How far off its prediction a corner is taken to be, where nothing else tells."""
        return max(self._prediction.surprise_px, _MIN_SURPRISE_PX)

    def _with_own_colors(self, alignment: Alignment, view: FrameView) -> Alignment:
        """The alignment, refused if what it found has other colours than the target."""
        found = alignment.registration
        if found.b_from_a is None:
            return alignment
        distance = chroma_distance(
            self.template.picture,
            alignment.template_points[found.is_inlier],
            view.frame.image,
            found.b_from_a,
            _COLOR_REACH_SHARE * float(np.sqrt(abs(geometry.signed_area(self.template.quad)))),
        )
        is_like = distance <= self._max_chroma_distance
        return alignment if is_like else withdrawn(alignment, Verdict.OTHER_COLORS)

    def _tracked(self, alignment: Alignment, means: str) -> Track:
        found = alignment.registration
        assert found.b_from_a is not None
        share = agreeing_share(alignment)
        if self._frames_lost == 0 and means in ("flow", "view"):
            is_clear = means == "flow" and self._is_clear(alignment)
            self._prediction.follow(found.b_from_a, is_clear=is_clear)
        else:
            self._prediction.begin_at(found.b_from_a, share)
            self._doubt_px = 0.0
        self._last_share = share if means != "view" else 0.0
        self._last_seen = seen_share(alignment)
        was_lost = self._frames_lost > 0
        self._frames_lost = 0
        self._search.rest()
        self._was_seen = True
        evidence = Evidence(alignment.template_points, alignment.frame_points, found.is_inlier)
        is_seen_all_around = self._last_seen >= CLEAR
        if not (
            means == "view"
            or is_seen_all_around
            or self._is_certain(evidence, found.b_from_a, was_lost)
        ):
            # It is followed all the same: what is seen of it leads to where more of it is seen.
            found = refused(Verdict.UNCERTAIN, len(evidence), found.is_inlier)
        return make_track(
            self.template, found, evidence, means, self._was_seen, alignment.correlation
        )

    def _is_certain(self, evidence: Evidence, pose: Matrix, was_lost: bool) -> bool:
        """Do the points place the corners? More is asked of them where no motion confirms them."""
        model, most_px = Model.HOMOGRAPHY, MAX_SIGMA_FOUND_PX
        if not was_lost:
            model = Model.HOMOGRAPHY if self._flatness.is_proven else Model.AFFINE
            most_px = MAX_SIGMA_FOLLOWED_PX
        if self._settings.registration.model != "auto":
            model = Model(self._settings.registration.model)
        return are_corners_certain(pose, model, evidence, self.template.quad, most_px)
