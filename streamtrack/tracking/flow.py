"""Alignment by pre-warped dense flow: the frame is warped back into the template, then matched.

The idea of WOFT (Serych & Matas 2023): after warping the frame by the predicted pose, the target
looks nearly as in its first frame, so a small flow remains, and as it is measured against the
first frame every time, no drift accumulates. The flow is DIS (Kroeger et al. 2016), here without
its variational refinement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.fitting import fit, gauss_newton_step, poorest_model, transfer_errors
from streamtrack.frame_view import FrameView
from streamtrack.registration import Effort, judge_mapping, refused, register
from streamtrack.settings import RegistrationSettings
from streamtrack.tracking.alignment import (
    CLEAR,
    INLIER_PX,
    MIN_CORRELATION,
    MIN_VISIBLE_POINTS,
    SEARCH_PX,
    Alignment,
    Hope,
    agreeing_share,
    patch_for,
    points_in_view,
    refusal,
    surroundings,
    withdrawn,
)
from streamtrack.tracking.blur import motion_blur, with_best_length
from streamtrack.tracking.direct import SMEARING_PX, align_directly
from streamtrack.tracking.likeness import local_correlation, matched_in_grey, moved_by
from streamtrack.tracking.refine import Prior, refined
from streamtrack.tracking.template import Patch, Template
from streamtrack.types import Image, Mask, Matrix, Model, Points, Registration, Verdict

Floats = npt.NDArray[np.float32]

_MIN_SUPPORTED_SHARE = 0.12  # of the points in view that must agree with the pose
_COARSE_STEPS = 2  # patches between the fine and the coarse alignment: half the resolution
_WHOLE = 0.9  # share of all points that agreed, for a target that is seen as a whole
_POINT_SIGMA_PX = 0.5  # patch pixels
_HOLDING_STEPS = 2
_BENT_INLIER_PX = 5.0  # patch pixels, from a similarity, for a target that is not flat
_SEEN_SHARE = 0.5
_CLEAR_OF_SEEN = 0.55
_ROUGH = Effort((Model.AFFINE,), 0)
_QUICK = Effort((Model.AFFINE, Model.HOMOGRAPHY), 1)


@dataclass(frozen=True, slots=True, eq=False)
class _Warp:
    """The frame seen through a pose as the patch would see it."""

    image: Image
    frame_from_patch: Matrix
    frame_px: float
    visible: Mask


class FlowAligner:
    """Aligns one template; keeps DIS's buffers from frame to frame, nothing else."""

    def __init__(self, template: Template, settings: RegistrationSettings) -> None:
        self._template = template
        self._settings = settings
        # Two, because DIS keeps buffers of the size it last saw.
        self._coarse_flow = _make_flow()
        self._fine_flow = _make_flow()

    def align(self, view: FrameView, guess: Matrix, sigma_px: float | None = None) -> Alignment:
        """The pose near ``guess`` (frame_from_template): first coarse, then fine, then refined.

        ``sigma_px`` says how far from the guess the corners usually turn out to be, if known.
        """
        fine, coarse = self._patches_for(view, guess)
        prior = None if sigma_px is None else Prior(guess, self._template.quad, sigma_px)
        pose = guess
        if coarse is not fine:
            rough, smear = self._roughly(view, coarse, guess, prior)
            if rough.registration.b_from_a is None:
                return rough
            pose = rough.registration.b_from_a
            if smear.any():
                fine = fine.smeared(smear * (fine.scale / coarse.scale))
        found = self._flow_step(view, fine, pose, self._fine_flow, _QUICK, prior)
        return self._refined(view, fine, found, prior)

    def align_near(
        self, view: FrameView, guess: Matrix, hope: Hope, sigma_px: float | None = None
    ) -> Alignment:
        """The same from a guess that should be good: fine at once, and without flow if possible.

        Refused unless as much of the target agrees as was hoped for.
        """
        fine, coarse = self._patches_for(view, guess)
        if hope.seen >= _WHOLE:
            patches = fine, coarse
            direct = align_directly(view, self._template, patches, self._settings, guess, hope)
            if agreeing_share(direct) >= CLEAR:
                return direct
        prior = None if sigma_px is None else Prior(guess, self._template.quad, sigma_px)
        found = self._flow_step(view, fine, guess, self._fine_flow, _QUICK, prior)
        if found.registration.b_from_a is None:
            return found
        if not hope.is_met_by(found):
            return withdrawn(found, Verdict.LOW_CORRELATION)
        if hope.motion_px > SMEARING_PX:
            fine = _smeared_alike(view, fine, coarse, found)
        return self._refined(view, fine, found, prior)

    def _patches_for(self, view: FrameView, guess: Matrix) -> tuple[Patch, Patch]:
        """The fine and the coarse patch; there may be none that is coarser."""
        patches = self._template.patches
        fine = min(patch_for(self._template, guess) + view.work.patch_steps, len(patches) - 1)
        return patches[fine], patches[min(fine + _COARSE_STEPS, len(patches) - 1)]

    def _roughly(
        self, view: FrameView, patch: Patch, guess: Matrix, prior: Prior | None
    ) -> tuple[Alignment, npt.NDArray[np.float64]]:
        """The coarse alignment, and the motion blur under which it was found, in patch pixels."""
        sharp = self._flow_step(view, patch, guess, self._coarse_flow, _ROUGH, prior)
        pose = sharp.registration.b_from_a
        seen = _warp_back(view, patch, guess if pose is None else pose)
        smear = motion_blur(patch.image, seen.image, surroundings(patch, seen.visible))
        if not smear.any():
            return sharp, smear
        smeared = self._flow_step(
            view, patch.smeared(smear), guess, self._coarse_flow, _ROUGH, prior
        )
        pose = smeared.registration.b_from_a
        if pose is None or smeared.registration.inliers < sharp.registration.inliers:
            return sharp, np.zeros(2)
        seen = _warp_back(view, patch, pose)
        area = surroundings(patch, seen.visible)
        return smeared, with_best_length(patch.image, seen.image, area, smear)

    def _refined(
        self, view: FrameView, patch: Patch, found: Alignment, prior: Prior | None
    ) -> Alignment:
        """The alignment with its pose refined on the grey values around the inliers."""
        registration = found.registration
        if registration.b_from_a is None or registration.model is None:
            return found
        if registration.inliers > CLEAR * len(found.is_in_view):
            prior = None  # seen all around: it would change nothing
        better = refined(
            lambda pose: view.pyramid.warped(pose @ patch.template_from_patch, patch.size_wh),
            registration.b_from_a,
            patch.patch_from_template,
            patch.gradients,
            self._shown(patch, found),
            registration.model,
            None if prior is None else prior.against(agreeing_share(found)),
        )
        pose = registration.b_from_a
        if better is not None and judge_mapping(better.pose, self._template.quad) is Verdict.OK:
            pose = better.pose
        errors = transfer_errors(pose, found.template_points, found.frame_points)
        rmse_px = float(np.sqrt(np.mean(errors[registration.is_inlier] ** 2)))
        model = registration.model
        if self._settings.model == "auto":
            model = poorest_model(pose, self._template.quad)
        refinement = replace(registration, b_from_a=pose, model=model, rmse_px=rmse_px)
        return replace(found, registration=refinement)

    def _shown(self, patch: Patch, found: Alignment) -> Mask:
        """Which gradient pixels (N,) show the target: those whose nearest point is an inlier."""
        is_inlier = np.zeros(len(patch.points), np.bool_)
        is_inlier[np.flatnonzero(found.is_in_view)[found.registration.is_inlier]] = True
        shown: Mask = is_inlier[patch.nearest_point]
        return shown

    def _flow_step(
        self,
        view: FrameView,
        patch: Patch,
        pose: Matrix,
        flow: cv2.DISOpticalFlow,
        effort: Effort,
        prior: Prior | None = None,
    ) -> Alignment:
        warp = _warp_back(view, patch, pose)
        visible = warp.visible
        template_points = patch.template_points[visible]
        if np.count_nonzero(visible) < MIN_VISIBLE_POINTS:
            return refusal(Verdict.OUT_OF_VIEW, visible, template_points)
        image = matched_in_grey(warp.image, patch, visible)
        start = np.zeros((*image.shape, 2), np.float32)
        field = np.asarray(flow.calc(patch.image, image, start), np.float32)
        columns, rows = patch.points[visible].astype(np.intp).T
        moved = patch.points[visible] + field[rows, columns]
        frame_points = geometry.transform_points(warp.frame_from_patch, moved)
        correlation = local_correlation(patch, moved_by(image, field), rows, columns)
        is_like = correlation >= MIN_CORRELATION
        registration = self._estimate(patch, warp, moved, is_like, effort, prior)
        supported = registration.is_inlier
        share = np.count_nonzero(supported) / len(supported)
        mean = float(correlation[supported].mean()) if supported.any() else float("nan")
        if registration.verdict is Verdict.OK and share < _MIN_SUPPORTED_SHARE:
            registration = refused(Verdict.LOW_CORRELATION, len(supported), supported)
        alike = float(np.mean(is_like))
        return Alignment(registration, visible, template_points, frame_points, mean, alike)

    def _estimate(
        self,
        patch: Patch,
        warp: _Warp,
        moved: Points,
        is_like: Mask,
        effort: Effort,
        prior: Prior | None,
    ) -> Registration:
        """frame_from_template, from where the patch's points in view have moved in the warp.

        The model is that of the remaining motion: what the guess had of richer models stays.
        """
        settings = self._settings.model_copy(update={"inlier_threshold_px": INLIER_PX})
        found = register(
            patch.points[warp.visible][is_like],
            moved[is_like],
            settings,
            geometry.transform_points(patch.patch_from_template, self._template.quad),
            (2 * SEARCH_PX) ** 2,
            effort,
        )
        # Not for a target that comes back: what agrees so loosely would be thin evidence.
        if settings.model == "auto" and prior is not None and _looks_bent(is_like, found):
            loose = {"inlier_threshold_px": _BENT_INLIER_PX, "model": Model.SIMILARITY.value}
            found = register(
                patch.points[warp.visible][is_like],
                moved[is_like],
                settings.model_copy(update=loose),
                geometry.transform_points(patch.patch_from_template, self._template.quad),
                (2 * SEARCH_PX) ** 2,
                effort,
            )
        is_inlier = np.zeros(len(moved), np.bool_)
        is_inlier[np.flatnonzero(is_like)[found.is_inlier]] = True
        if found.b_from_a is None:
            return replace(found, is_inlier=is_inlier)
        seen_from_patch = found.b_from_a
        if prior is not None and found.model is not None and np.mean(is_inlier) < CLEAR:
            pairs = patch.points[warp.visible][is_inlier], moved[is_inlier]
            held = prior.against(float(np.mean(is_inlier)))
            seen_from_patch = _held_by(held, found.model, *pairs, patch, warp)
        pose = geometry.normalized(
            warp.frame_from_patch @ seen_from_patch @ patch.patch_from_template
        )
        verdict = judge_mapping(pose, self._template.quad)
        if verdict is not Verdict.OK:
            return refused(verdict, len(moved), is_inlier)
        rmse_px = found.rmse_px * warp.frame_px
        return Registration(Verdict.OK, pose, found.model, is_inlier, rmse_px)


def _looks_bent(is_like: Mask, found: Registration) -> bool:
    """Is the target all there, (N,) points alike, but not where any one plane would put it?

    An occluder hides points, so they are not alike; a bent or moving surface shifts them.
    """
    seen, agreeing = float(np.mean(is_like)), found.inliers / len(is_like)
    return seen >= _SEEN_SHARE and agreeing < _CLEAR_OF_SEEN * seen


def _held_by(
    prior: Prior, model: Model, points: Points, moved: Points, patch: Patch, warp: _Warp
) -> Matrix:
    """The mapping of the points to where they moved, the expected corners being four more pairs.

    Where points are seen all around they hardly matter; a corner far from any point, to which a
    mapping would extrapolate, stays where motion says that it is.
    """
    patch_from_frame = geometry.inverted(warp.frame_from_patch)
    corners = geometry.transform_points(patch.patch_from_template, prior.corners)
    expected = geometry.transform_points(patch_from_frame @ prior.pose, prior.corners)
    corner_weight = (_POINT_SIGMA_PX * warp.frame_px / prior.sigma_px) ** 2
    a, b = np.concatenate([points, corners]), np.concatenate([moved, expected])
    weights = np.concatenate([np.ones(len(points)), np.full(4, corner_weight)])
    if model is not Model.HOMOGRAPHY:
        return fit(model, a, b, weights)
    mapping = fit(Model.AFFINE, a, b, weights)
    for _ in range(_HOLDING_STEPS):
        mapping = gauss_newton_step(mapping, a.astype(np.float64), b.astype(np.float64), weights)
    return mapping


def _make_flow() -> cv2.DISOpticalFlow:
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    flow.setFinestScale(1)
    flow.setPatchSize(8)
    flow.setPatchStride(4)
    flow.setGradientDescentIterations(10)
    flow.setVariationalRefinementIterations(0)
    return flow


def _smeared_alike(view: FrameView, patch: Patch, coarse: Patch, found: Alignment) -> Patch:
    """The patch under the motion blur under which it was found, judged at lower resolution."""
    pose = found.registration.b_from_a
    assert pose is not None
    seen = _warp_back(view, coarse, pose)
    smear = motion_blur(coarse.image, seen.image, surroundings(coarse, seen.visible))
    return patch.smeared(smear * (patch.scale / coarse.scale)) if smear.any() else patch


def _warp_back(view: FrameView, patch: Patch, pose: Matrix) -> _Warp:
    frame_from_patch = pose @ patch.template_from_patch
    visible = points_in_view(view, patch, pose)
    image = view.pyramid.warped(frame_from_patch, patch.size_wh)
    return _Warp(image, frame_from_patch, patch.frame_px(pose), visible)
