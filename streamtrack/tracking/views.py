"""Recent views of a target that is not flat: what it looked like when it was last seen clearly.

The first view is what a target is; it is kept for ever and tried in every frame. A car that turns
or a running animal stops looking like it, though from one frame to the next it changes little.
So each frame in which the target was seen clearly is remembered, and when the first view no longer
explains the target, the frame is aligned with the newest remembered one. Only places that were seen
to belong to the target are compared, so that an occluder never becomes part of it, and only few
freedoms are estimated, since a curved surface does not move as a plane; unless the target was seen
to be one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from streamtrack import geometry
from streamtrack.frame_view import FrameView
from streamtrack.pyramid import Pyramid
from streamtrack.settings import RegistrationSettings
from streamtrack.tracking.alignment import Alignment, Hope, agreeing_share
from streamtrack.tracking.flow import FlowAligner
from streamtrack.tracking.template import MIN_FLOW_POINTS, Template, make_passing_patches
from streamtrack.types import Image, Matrix, Model, Points

MIN_VIEW_SHARE = 0.6
"""Share of a recent view's points that must agree."""
_HOPED_SHARE = 0.75


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """One clear sight of the target: the frame, in grey too, the pose in it, and where it was seen.

    ``shown`` (N, 2) are the points of this frame that agreed with the pose, ``template_points`` the
    same in template pixels.
    """

    image: Image
    pyramid: Pyramid
    frame_from_template: Matrix
    shown: Points
    template_points: Points


class RecentViews:
    """The newest clear sight of one target, made into a template when it is needed."""

    def __init__(self, template: Template, settings: RegistrationSettings) -> None:
        self._template = template
        self._flat_settings = settings
        self._settings = settings.model_copy(update={"model": Model.SIMILARITY.value})
        self.newest: Sight | None = None
        self._in_use: Sight | None = None
        self._aligner: FlowAligner | None = None
        self.was_made_now = False
        """Was a template made since this was last set to False?"""

    def remember(self, view: FrameView, alignment: Alignment) -> None:
        """Keep a frame in which the target was seen clearly."""
        found = alignment.registration
        if found.b_from_a is not None:
            shown = alignment.frame_points[found.is_inlier]
            points = alignment.template_points[found.is_inlier]
            image, pyramid = view.frame.image, view.pyramid
            self.newest = Sight(image, pyramid, found.b_from_a, shown, points)

    def forget(self) -> None:
        """The target was lost: what it looked like then says little about where it is now."""
        self.newest = self._in_use = self._aligner = None

    def take_as_flat(self) -> None:
        """From now on every view is mapped by a homography, as a plane is."""
        if self._settings is not self._flat_settings:
            self._settings = self._flat_settings
            self._in_use = self._aligner = None

    def align(self, view: FrameView, guess: Matrix, sigma_px: float) -> Alignment | None:
        """The pose near ``guess`` by the view in use, else by the newest one; None without any.

        Poses and points are in template pixels, as those of the first view; ``sigma_px`` is as in
        `FlowAligner.align`.
        """
        aligned = self._align_in_use(view, guess, sigma_px)
        if aligned is not None and agreeing_share(aligned) >= MIN_VIEW_SHARE:
            return aligned
        if self.newest is None or self.newest is self._in_use:
            return aligned
        self._use_newest()
        return self._align_in_use(view, guess, sigma_px)

    def renew(self) -> None:
        """Compare with the newest sight from now on."""
        if self.newest is not None and self.newest is not self._in_use:
            self._use_newest()

    def _use_newest(self) -> None:
        assert self.newest is not None
        self.was_made_now = True
        sight = self._in_use = self.newest
        quad = geometry.transform_points(sight.frame_from_template, self._template.quad)
        patches = make_passing_patches(sight.pyramid, quad, sight.shown)
        if not patches or len(patches[0].points) < MIN_FLOW_POINTS:
            self._aligner = None
            return
        seen = replace(self._template, picture=sight.pyramid.grey, quad=quad, patches=patches)
        self._aligner = FlowAligner(seen, self._settings)

    def _align_in_use(self, view: FrameView, guess: Matrix, sigma_px: float) -> Alignment | None:
        if self._in_use is None or self._aligner is None:
            return None
        sight_from_template = self._in_use.frame_from_template
        template_from_sight = geometry.inverted(sight_from_template)
        is_plane = self._settings is self._flat_settings
        guess, sigma = guess @ template_from_sight, sigma_px if is_plane else None
        hope = Hope(_HOPED_SHARE, -1.0, 1.0, 0.0, sigma_px)
        aligned = self._aligner.align_near(view, guess, hope, sigma)
        if aligned.registration.b_from_a is None:
            aligned = self._aligner.align(view, guess, sigma)
        found = aligned.registration
        if found.b_from_a is not None:
            pose = geometry.normalized(found.b_from_a @ sight_from_template)
            found = replace(found, b_from_a=pose)
        points = geometry.transform_points(template_from_sight, aligned.template_points)
        return replace(aligned, registration=found, template_points=points)
