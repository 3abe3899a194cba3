"""Alignment by grey values alone, from a pose that is nearly right: no flow, no features.

Gauss-Newton (`refine`) at half and then at full resolution, for a target that is seen all around.
Whether the result is right is asked of each textured point by itself: is its window like the
template's (correlation), and by how much is it still off (one step of Lucas & Kanade)?
"""

from __future__ import annotations

import numpy as np

from streamtrack import geometry
from streamtrack.fitting import poorest_model, transfer_errors
from streamtrack.frame_view import FrameView
from streamtrack.registration import judge_mapping, judge_support
from streamtrack.settings import RegistrationSettings
from streamtrack.tracking.alignment import (
    INLIER_PX,
    MIN_CORRELATION,
    MIN_VISIBLE_POINTS,
    SEARCH_PX,
    Alignment,
    Hope,
    points_in_view,
    refusal,
    surroundings,
)
from streamtrack.tracking.blur import motion_blur
from streamtrack.tracking.likeness import local_correlation, matched_in_grey, shift_left
from streamtrack.tracking.refine import Refinement, refined
from streamtrack.tracking.template import Patch, Template
from streamtrack.types import Matrix, Model, Registration, Verdict

SMEARING_PX = 8.0
"""Motion in a frame: less is hardly smeared."""
_ROUGHLY_CONVERGED_PX = 0.2
_CONVERGED_PX = 0.15  # patch pixels: what a further step would still move is a tenth of it
_NEAR_PX = 0.7  # patch pixels that a guess may be off to be refined at full resolution at once


def align_directly(
    view: FrameView,
    template: Template,
    patches: tuple[Patch, Patch],
    settings: RegistrationSettings,
    guess: Matrix,
    hope: Hope,
) -> Alignment:
    """The pose near ``guess``, or a refusal. ``patches`` are the fine and the coarse one.

    How much of the target agrees with it is for the caller to judge.
    """
    fine, coarse = patches
    richest = Model.HOMOGRAPHY if settings.model == "auto" else Model(settings.model)
    pose = guess
    is_smeared = hope.motion_px > SMEARING_PX
    if coarse is not fine and (is_smeared or hope.off_px > _NEAR_PX * fine.frame_px(guess)):
        few = Model.AFFINE if richest is Model.HOMOGRAPHY else richest
        rough = _aligned(view, coarse, guess, few, _ROUGHLY_CONVERGED_PX)
        if rough is None:
            return _nowhere(view, coarse, guess)
        pose = rough.pose
        if is_smeared:
            area = surroundings(coarse, points_in_view(view, coarse, pose))
            smear = motion_blur(coarse.image, rough.seen, area)
            if smear.any():
                fine = fine.smeared(smear * (fine.scale / coarse.scale))
    found = _aligned(view, fine, pose, richest, _CONVERGED_PX)
    if found is None or judge_mapping(found.pose, template.quad) is not Verdict.OK:
        return _nowhere(view, fine, pose)
    return _checked(view, template, fine, settings, found)


def _nowhere(view: FrameView, patch: Patch, pose: Matrix) -> Alignment:
    visible = points_in_view(view, patch, pose)
    return refusal(Verdict.LOW_CORRELATION, visible, patch.template_points[visible])


def _aligned(
    view: FrameView,
    patch: Patch,
    pose: Matrix,
    model: Model,
    converged_px: float,
) -> Refinement | None:
    visible = points_in_view(view, patch, pose)
    if np.count_nonzero(visible) < MIN_VISIBLE_POINTS:
        return None
    return refined(
        lambda pose: view.pyramid.warped(pose @ patch.template_from_patch, patch.size_wh),
        pose,
        patch.patch_from_template,
        patch.gradients,
        visible[patch.nearest_point],
        model,
        None,
        converged_px,
    )


def _checked(
    view: FrameView,
    template: Template,
    patch: Patch,
    settings: RegistrationSettings,
    found: Refinement,
) -> Alignment:
    """The refined pose with what each point in view says of it."""
    visible = points_in_view(view, patch, found.pose)
    points, template_points = patch.points[visible], patch.template_points[visible]
    columns, rows = points.astype(np.intp).T
    seen = matched_in_grey(found.seen, patch, visible)
    correlation = local_correlation(patch, seen, rows, columns)
    shift = shift_left(patch, found.smooth, rows, columns, visible)
    frame_from_patch = found.seen_through @ patch.template_from_patch
    frame_points = geometry.transform_points(frame_from_patch, points + shift)
    errors = transfer_errors(found.pose, template_points, frame_points)
    is_near = errors < INLIER_PX * patch.frame_px(found.pose)
    is_like = correlation >= MIN_CORRELATION
    is_inlier = is_like & is_near
    region = geometry.transform_points(patch.patch_from_template, template.quad)
    verdict = judge_support(points, is_inlier, settings, region, (2 * SEARCH_PX) ** 2)
    if verdict is not Verdict.OK:
        return refusal(verdict, visible, template_points)
    rmse_px = float(np.sqrt(np.mean(errors[is_inlier] ** 2)))
    model = poorest_model(found.pose, template.quad)
    if settings.model != "auto":
        model = Model(settings.model)
    registration = Registration(Verdict.OK, found.pose, model, is_inlier, rmse_px)
    mean_correlation = float(correlation[is_inlier].mean())
    alike = float(np.mean(is_like))
    return Alignment(registration, visible, template_points, frame_points, mean_correlation, alike)
