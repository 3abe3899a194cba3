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
from streamtrack.tracking.blur import motion_blur, with_best_length
from streamtrack.tracking.likeness import local_correlation, matched_in_grey, moved_by
from streamtrack.tracking.refine import Prior, refined
from streamtrack.tracking.template import Patch, Template
from streamtrack.types import Image, Mask, Matrix, Model, Points, Registration, Verdict

Floats = npt.NDArray[np.float32]

_MIN_CORRELATION = 0.5  # of a point's window, below which the point is no evidence
_MIN_SUPPORTED_SHARE = 0.12  # of the points in view that must agree with the pose
_MIN_VISIBLE_POINTS = 10
_SEARCH_PX = 12.0  # how far, in patch pixels, a flow may reach: the area for chance agreement
_INLIER_PX = 1.5  # patch pixels
_SMEARING_PX = 8.0  # motion in a frame: less is hardly smeared
_COARSE_STEPS = 2  # patches between the fine and the coarse alignment: half the resolution
_CLEAR = 0.8  # share of the points in view that agree
_POINT_SIGMA_PX = 0.5  # patch pixels
_HOLDING_STEPS = 2
_BENT_INLIER_PX = 5.0  # patch pixels, from a similarity, for a target that is not flat
_SEEN_SHARE = 0.5
_CLEAR_OF_SEEN = 0.55
_ROUGH = Effort((Model.AFFINE,), 0)
_QUICK = Effort((Model.AFFINE, Model.HOMOGRAPHY), 1)


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Where the template's textured points were found in a frame, and the pose they give.

    is_in_view                     bool (P,), which of the patch's points are in view
    template_points, frame_points  float32 (N, 2) of those that are
    registration                   frame_from_template with its verdict
    correlation                    mean local correlation of the points that support the pose
    """

    registration: Registration
    is_in_view: Mask
    template_points: Points
    frame_points: Points
    correlation: float


@dataclass(frozen=True, slots=True, eq=False)
class _Warp:
    """The frame seen through a pose as the patch would see it."""

    image: Image
    frame_from_patch: Matrix
    frame_px: float
    visible: Mask


@dataclass(frozen=True, slots=True)
class Hope:
    """What to expect of a guess that should be good.

    share      of the points in view that then agree
    motion_px  how far the target moves in a frame, which may smear it
    """

    share: float
    motion_px: float


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
        """The same from a guess that should be good, at half the cost: fine at once.

        Refused unless as much of the target agrees as was hoped for.
        """
        fine, coarse = self._patches_for(view, guess)
        prior = None if sigma_px is None else Prior(guess, self._template.quad, sigma_px)
        found = self._flow_step(view, fine, guess, self._fine_flow, _QUICK, prior)
        if found.registration.b_from_a is None:
            return found
        if agreeing_share(found) < hope.share:
            is_inlier = found.registration.is_inlier
            unlike = refused(Verdict.LOW_CORRELATION, len(is_inlier), is_inlier)
            return replace(found, registration=unlike)
        if hope.motion_px > _SMEARING_PX:
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
        smear = motion_blur(patch.image, seen.image, _near(patch, seen.visible))
        if not smear.any():
            return sharp, smear
        smeared = self._flow_step(
            view, patch.smeared(smear), guess, self._coarse_flow, _ROUGH, prior
        )
        pose = smeared.registration.b_from_a
        if pose is None or smeared.registration.inliers < sharp.registration.inliers:
            return sharp, np.zeros(2)
        seen = _warp_back(view, patch, pose)
        area = _near(patch, seen.visible)
        return smeared, with_best_length(patch.image, seen.image, area, smear)

    def _refined(
        self, view: FrameView, patch: Patch, found: Alignment, prior: Prior | None
    ) -> Alignment:
        """The alignment with its pose refined on the grey values around the inliers."""
        registration = found.registration
        if registration.b_from_a is None or registration.model is None:
            return found
        if registration.inliers > _CLEAR * len(found.is_in_view):
            prior = None  # seen all around: it would change nothing
        pose = refined(
            lambda pose: view.pyramid.warped(pose @ patch.template_from_patch, patch.size_wh),
            registration.b_from_a,
            patch.patch_from_template,
            patch.gradients,
            self._shown(patch, found),
            registration.model,
            None if prior is None else prior.against(agreeing_share(found)),
        )
        if pose is None or judge_mapping(pose, self._template.quad) is not Verdict.OK:
            pose = registration.b_from_a
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
        if np.count_nonzero(visible) < _MIN_VISIBLE_POINTS:
            return _refusal(Verdict.OUT_OF_VIEW, visible, template_points)
        image = matched_in_grey(warp.image, patch, visible)
        start = np.zeros((*image.shape, 2), np.float32)
        field = np.asarray(flow.calc(patch.image, image, start), np.float32)
        columns, rows = patch.points[visible].astype(np.intp).T
        moved = patch.points[visible] + field[rows, columns]
        frame_points = geometry.transform_points(warp.frame_from_patch, moved)
        correlation = local_correlation(patch, moved_by(image, field), rows, columns)
        is_like = correlation >= _MIN_CORRELATION
        registration = self._estimate(patch, warp, moved, is_like, effort, prior)
        supported = registration.is_inlier
        share = np.count_nonzero(supported) / len(supported)
        mean = float(correlation[supported].mean()) if supported.any() else float("nan")
        if registration.verdict is Verdict.OK and share < _MIN_SUPPORTED_SHARE:
            registration = refused(Verdict.LOW_CORRELATION, len(supported), supported)
        return Alignment(registration, visible, template_points, frame_points, mean)

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
        settings = self._settings.model_copy(update={"inlier_threshold_px": _INLIER_PX})
        found = register(
            patch.points[warp.visible][is_like],
            moved[is_like],
            settings,
            geometry.transform_points(patch.patch_from_template, self._template.quad),
            (2 * _SEARCH_PX) ** 2,
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
                (2 * _SEARCH_PX) ** 2,
                effort,
            )
        is_inlier = np.zeros(len(moved), np.bool_)
        is_inlier[np.flatnonzero(is_like)[found.is_inlier]] = True
        if found.b_from_a is None:
            return replace(found, is_inlier=is_inlier)
        seen_from_patch = found.b_from_a
        if prior is not None and found.model is not None and np.mean(is_inlier) < _CLEAR:
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


def agreeing_share(alignment: Alignment) -> float:
    """Share (0..1) of the points in view that agree with the pose; 0 if it was refused."""
    found = alignment.registration
    if found.b_from_a is None or not len(found.is_inlier):
        return 0.0
    return found.inliers / len(found.is_inlier)


def _near(patch: Patch, rows: Mask) -> Mask:
    """The surroundings (h, w) of some of the patch's points."""
    columns, lines = patch.points[rows].astype(np.intp).T
    near = np.zeros(patch.image.shape, np.uint8)
    near[lines, columns] = 1
    around: Mask = cv2.dilate(near, np.ones((9, 9), np.uint8)) > 0
    return around


def patch_for(template: Template, frame_from_template: Matrix) -> int:
    """Index of the patch whose resolution fits the target's size in the frame."""
    magnification = geometry.local_scale(frame_from_template, template.centre)
    for i, patch in enumerate(template.patches):
        if patch.scale <= 1.2 * magnification:
            return i
    return len(template.patches) - 1


def _make_flow() -> cv2.DISOpticalFlow:
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    flow.setFinestScale(1)
    flow.setPatchSize(8)
    flow.setPatchStride(4)
    flow.setGradientDescentIterations(10)
    flow.setVariationalRefinementIterations(0)
    return flow


def _warp_back(view: FrameView, patch: Patch, pose: Matrix) -> _Warp:
    height, width = patch.image.shape
    frame_from_patch = pose @ patch.template_from_patch
    frame_px = geometry.local_scale(frame_from_patch, np.array([width / 2, height / 2]))
    in_frame = geometry.transform_points(frame_from_patch, patch.points)
    frame_width, frame_height = view.size_wh
    reach = 3 * frame_px
    visible = (
        (in_frame[:, 0] >= reach)
        & (in_frame[:, 1] >= reach)
        & (in_frame[:, 0] < frame_width - reach)
        & (in_frame[:, 1] < frame_height - reach)
    )
    image = view.pyramid.warped(frame_from_patch, (width, height))
    return _Warp(image, frame_from_patch, frame_px, visible)


def _smeared_alike(view: FrameView, patch: Patch, coarse: Patch, found: Alignment) -> Patch:
    """The patch under the motion blur under which it was found, judged at lower resolution."""
    pose = found.registration.b_from_a
    assert pose is not None
    seen = _warp_back(view, coarse, pose)
    smear = motion_blur(coarse.image, seen.image, _near(coarse, seen.visible))
    return patch.smeared(smear * (patch.scale / coarse.scale)) if smear.any() else patch


def _refusal(verdict: Verdict, in_view: Mask, template_points: Points) -> Alignment:
    unknown = np.full_like(template_points, np.nan)
    registration = refused(verdict, len(template_points))
    return Alignment(registration, in_view, template_points, unknown, float("nan"))
