"""What an alignment of a template with a frame is, whichever way it is made."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf

import cv2
import numpy as np

from streamtrack import geometry
from streamtrack.frame_view import FrameView
from streamtrack.registration import refused
from streamtrack.tracking.template import Patch, Template
from streamtrack.types import Mask, Matrix, Points, Registration, Verdict

MIN_CORRELATION = 0.5
"""Of a point's window with the frame, below which the point is no evidence."""
MIN_VISIBLE_POINTS = 10
INLIER_PX = 1.5
"""Patch pixels."""
SEARCH_PX = 12.0
"""How far, in patch pixels, a point may be found: the area for chance agreement."""
_REACH_PX = 3.0  # patch pixels, of a point's surroundings
CLEAR = 0.8
"""Share of the points in view that agree, for a target of which all is seen that is in view."""


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Where the template's textured points were found in a frame, and the pose they give.

    is_in_view                     bool (P,), which of the patch's points are in view
    template_points, frame_points  float32 (N, 2) of those that are
    registration                   frame_from_template with its verdict
    correlation                    mean local correlation of the points that support the pose
    alike                          share (0..1) of the points in view that look like the template
    """

    registration: Registration
    is_in_view: Mask
    template_points: Points
    frame_points: Points
    correlation: float
    alike: float


@dataclass(frozen=True, slots=True)
class Hope:
    """What to expect of a guess that should be good.

    share      of the points in view that then agree
    alike      mean correlation that makes up for a share below `CLEAR`: what agrees then looks as
               well as ever, so that the rest is hidden rather than turned away
    seen       share of all points, those out of view among them, that agreed in the last frame
    motion_px  how far the target moves in a frame, which may smear it
    off_px     how far off such guesses were lately, RMS over the corners
    """

    share: float
    alike: float
    seen: float
    motion_px: float
    off_px: float

    def is_met_by(self, alignment: Alignment) -> bool:
        """Does as much agree as was hoped for?"""
        share = agreeing_share(alignment)
        return share >= self.share and (share >= CLEAR or alignment.correlation >= self.alike)


def agreeing_share(alignment: Alignment) -> float:
    """Share (0..1) of the points in view that agree with the pose; 0 if it was refused."""
    found = alignment.registration
    if found.b_from_a is None or not len(found.is_inlier):
        return 0.0
    return found.inliers / len(found.is_inlier)


def seen_share(alignment: Alignment) -> float:
    """Share (0..1) of all points, those out of view among them, that agree with the pose."""
    return alignment.registration.inliers / len(alignment.is_in_view)


def patch_for(template: Template, frame_from_template: Matrix) -> int:
    """Index of the patch whose resolution fits the target's size in the frame."""
    magnification = geometry.local_scale(frame_from_template, template.centre)
    for i, patch in enumerate(template.patches):
        if patch.scale <= 1.2 * magnification:
            return i
    return len(template.patches) - 1


def points_in_view(view: FrameView, patch: Patch, pose: Matrix) -> Mask:
    """Which of the patch's points (N,) a pose (frame_from_template) puts inside the frame."""
    width, height = view.size_wh
    reach = _REACH_PX * patch.frame_px(pose)
    frame_from_patch = pose @ patch.template_from_patch
    x0, y0, x1, y1 = _reach_of(frame_from_patch, geometry.image_quad(patch.size_wh).tolist())
    if x0 >= reach and y0 >= reach and x1 < width - reach and y1 < height - reach:
        return np.ones(len(patch.points), np.bool_)
    in_frame = geometry.transform_points(pose, patch.template_points)
    visible: Mask = (
        (in_frame[:, 0] >= reach)
        & (in_frame[:, 1] >= reach)
        & (in_frame[:, 0] < width - reach)
        & (in_frame[:, 1] < height - reach)
    )
    return visible


def _reach_of(b_from_a: Matrix, quad: list[list[float]]) -> tuple[float, float, float, float]:
    """The box (x0, y0, x1, y1) in b around all inside a quad of a; all of b across the horizon."""
    (a, b, c), (d, e, f), (g, h, i) = b_from_a.tolist()
    depths = [g * x + h * y + i for x, y in quad]
    if not min(depths) > 0:
        return -inf, -inf, inf, inf
    x = [(a * x + b * y + c) / depth for (x, y), depth in zip(quad, depths, strict=True)]
    y = [(d * x + e * y + f) / depth for (x, y), depth in zip(quad, depths, strict=True)]
    return min(x), min(y), max(x), max(y)


def surroundings(patch: Patch, rows: Mask) -> Mask:
    """Which pixels (h, w) lie around some of the patch's points."""
    columns, lines = patch.points[rows].astype(np.intp).T
    near = np.zeros(patch.image.shape, np.uint8)
    near[lines, columns] = 1
    around: Mask = cv2.dilate(near, np.ones((9, 9), np.uint8)) > 0
    return around


def refusal(verdict: Verdict, in_view: Mask, template_points: Points) -> Alignment:
    """An alignment that says why there is no pose, for all points that are in view."""
    unknown = np.full_like(template_points, np.nan)
    registration = refused(verdict, len(template_points))
    return Alignment(registration, in_view, template_points, unknown, float("nan"), 0.0)


def withdrawn(alignment: Alignment, verdict: Verdict) -> Alignment:
    """The alignment with its pose taken back, for the reason given."""
    is_inlier = alignment.registration.is_inlier
    return replace(alignment, registration=refused(verdict, len(is_inlier), is_inlier))
