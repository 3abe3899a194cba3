"""Two pictures -> Link: where one lies in the other, to a fraction of a pixel, or why not.

The cheap steps come first, so that pictures which share nothing are refused early:

1. a robust estimate from descriptors matched over the whole pictures; if there is none, once
   more zoom by zoom (`mosaic.first_estimate`);
2. the finer picture rendered on the coarser by that estimate, so that zoom, rotation and
   perspective are gone, and corners followed from one to the other (`mosaic.subpixel`);
3. the transformation model by evidence, a robust least squares and, where the scene proves to
   be flat, a last alignment on the grey values themselves (`mosaic.direct`);
4. the gate (`mosaic.link_gate`): inliers beyond chance and spread over the overlap, no fold, no
   unbelievable area or perspective, certain corners, and detail that agrees; and where hardly
   anything moves, a scene that agrees too, not just a stamp or a frame (`mosaic.standing`). If
   it does not, the matches that do move are asked alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from streamtrack import geometry
from streamtrack.evaluation import symmetric_transfer_rmse
from streamtrack.features import FeatureExtractor
from streamtrack.fitting import (
    fit,
    fit_best_model,
    fit_robustly,
    gauss_newton_step,
    median,
    transfer_errors,
)
from streamtrack.mosaic.pairs import direct
from streamtrack.mosaic.pairs.agreement import measure_agreement
from streamtrack.mosaic.pairs.ambiguity import is_ambiguous
from streamtrack.mosaic.pairs.first_estimate import (
    Estimate,
    estimate,
    estimate_by_zoom,
    estimate_of_moved,
)
from streamtrack.mosaic.pairs.link_gate import judge_link
from streamtrack.mosaic.pairs.standing import overlay_like, scene_differs
from streamtrack.mosaic.pairs.subpixel import (
    Overlap,
    opaque_part,
    render_overlap,
    rendered_again,
    tracked_corners,
)
from streamtrack.mosaic.types import Link, Picture
from streamtrack.pyramid import Pyramid
from streamtrack.registration import refused, robust_inliers
from streamtrack.settings import Settings
from streamtrack.types import Features, Image, Matrix, Model, Points, Registration, Verdict

_MAX_DETECTION_PX = 350_000
_MIN_TRACKED = 12
_ROUGH_INLIERS = 60
_ROUGH_LEVELS = 3
_LEVELS = 1
_MAX_ROUNDS = 3
_SETTLED_PX = 3.0
_TRACKED_PX = 3.0
_FLAT_PX = 0.12
_EVEN_WIDTH = 8.0
_TUKEY_ROUNDS = 3


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """The mapping after the grey values were asked, with its evidence on the overlap's grid."""

    far_from_near: Matrix
    model: Model
    near_points: Points
    far_points: Points
    overlap: Overlap


class PictureRegistrar:
    """Finds the features of pictures and links pairs of them, as the settings say.

    Raises UsageError at construction if the settings do not fit each other.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._extractor = FeatureExtractor(settings.features)

    def picture(self, index: int, name: str, image: Image) -> Picture:
        """The picture with its features. ``image`` (H, W) or (H, W, 3).

        Pictures of more than a third of a megapixel are searched at that size (what is exact comes
        later, from the full picture); the points are the full picture's all the same.
        """
        grey = geometry.grey_of(image)
        factor = float(np.sqrt(_MAX_DETECTION_PX / max(grey.size, 1)))
        if factor >= 1.0:
            return Picture(index, name, image, self._extractor.extract(grey))
        height, width = grey.shape
        size = max(1, round(width * factor)), max(1, round(height * factor))
        small = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)
        found = self._extractor.extract(small)
        full_from_small = geometry.scaling(width / size[0], height / size[1])
        features = Features(
            geometry.transform_points(full_from_small, found.points),
            found.sizes * np.float32(width / size[0]),
            found.responses,
            found.descriptors,
        )
        return Picture(index, name, image, features)

    def link(self, a: Picture, b: Picture, *, is_thorough: bool = True) -> Link:
        """The gated mapping from picture ``a`` to picture ``b``.

        ``is_thorough`` looks a second time, zoom by zoom, where the first look finds nothing.
        """
        if min(len(a.features), len(b.features)) < self._settings.registration.min_inliers:
            nothing = estimate(a.features, b.features, 1.0, self._settings)
            return _refusal(a, b, nothing, Verdict.TOO_FEW_FEATURES)
        b_area_px = float(b.size_wh[0] * b.size_wh[1])
        found = estimate(a.features, b.features, b_area_px, self._settings)
        if found.b_from_a is None and is_thorough:
            second = estimate_by_zoom(a.features, b.features, b_area_px, self._settings)
            found = second if second.b_from_a is not None else found
        if found.b_from_a is None:
            return _refusal(a, b, found, found.verdict)
        link = self._refined(a, b, found, found.b_from_a)
        if link.b_from_a is not None:
            return link
        moved = estimate_of_moved(found, a, b, self._settings)
        if moved.b_from_a is None:
            return link
        link_of_moved = self._refined(a, b, moved, moved.b_from_a)
        return link_of_moved if link_of_moved.b_from_a is not None else link

    def _refined(self, a: Picture, b: Picture, found: Estimate, b_from_a: Matrix) -> Link:
        is_swapped = _is_coarser(b_from_a, found, a.features)
        near, far = (b, a) if is_swapped else (a, b)
        start = geometry.inverted(b_from_a) if is_swapped else b_from_a
        fit = self._fit(near.pyramid, far.pyramid, start, int(np.count_nonzero(found.is_inlier)))
        if fit is None:
            return _refusal(a, b, found, Verdict.LOW_CORRELATION)
        aligned, final = self._aligned(fit, far.pyramid)
        final = opaque_part(final, near.cover, far.cover)
        exact = geometry.inverted(aligned) if is_swapped else aligned
        points = (
            (fit.far_points, fit.near_points) if is_swapped else (fit.near_points, fit.far_points)
        )
        return self._gated(a, b, found, points, exact, fit.model, final)

    def _fit(self, near: Pyramid, far: Pyramid, start: Matrix, inliers: int) -> _Fit | None:
        """Corners followed and the mapping fitted to them, again while it still moves much."""
        far_from_near = start
        levels = _ROUGH_LEVELS if inliers < _ROUGH_INLIERS else _LEVELS
        fit: _Fit | None = None
        for _ in range(_MAX_ROUNDS):
            overlap = render_overlap(near, far, far_from_near)
            if overlap is None:
                return fit
            ours, theirs = tracked_corners(overlap, levels)
            if len(ours) < _MIN_TRACKED:
                return fit
            near_points = geometry.transform_points(overlap.near_from_grid, ours)
            far_points = geometry.transform_points(overlap.far_from_grid, theirs)
            model, fitted = self._fit_model(ours, theirs, near_points, far_points)
            if fitted is None:
                return fit
            moved_px = _corner_change(overlap, fitted)
            far_from_near = fitted
            fit = _Fit(far_from_near, model, near_points, far_points, overlap)
            if moved_px < _SETTLED_PX:
                break
            levels = _LEVELS
        return fit

    def _fit_model(
        self, ours: Points, theirs: Points, near_points: Points, far_points: Points
    ) -> tuple[Model, Matrix | None]:
        """The transformation model by evidence and its mapping, None without enough support.

        Which pairs agree at all is judged on the grid, where little is left between them.
        """
        rules = self._settings.registration
        on_grid = rules.model_copy(
            update={"inlier_threshold_px": _TRACKED_PX, "model": Model.HOMOGRAPHY.value}
        )
        is_inlier = robust_inliers(ours, theirs, on_grid)
        model = Model.HOMOGRAPHY if rules.model == "auto" else Model(rules.model)
        if np.count_nonzero(is_inlier) < max(_MIN_TRACKED, rules.min_inliers):
            return model, None
        ladder = tuple(Model) if rules.model == "auto" else (model,)
        model, first = fit_best_model(near_points[is_inlier], far_points[is_inlier], ladder)
        far_px = float(np.sqrt(_area(far_points[is_inlier]) / max(_area(ours[is_inlier]), 1e-6)))
        threshold_px = _TRACKED_PX * max(far_px, 1e-3)
        fitted, _ = fit_robustly(model, first, near_points, far_points, threshold_px, _TUKEY_ROUNDS)
        fitted = _fit_evenly(model, fitted, near_points, far_points, threshold_px)
        return model, fitted if np.isfinite(fitted).all() else None

    def _aligned(self, fit: _Fit, far: Pyramid) -> tuple[Matrix, Overlap]:
        """The fit made exact on the grey values, if the corners say that the scene is flat.

        Returns far_from_near and the overlap as the fit renders it.
        """
        overlap = rendered_again(fit.overlap, far, fit.far_from_near)
        errors = transfer_errors(fit.far_from_near, fit.near_points, fit.far_points)
        far_px = geometry.local_scale(overlap.far_from_grid, np.array(overlap.size_wh) / 2)
        if median(errors) > _FLAT_PX * far_px:
            return fit.far_from_near, overlap
        found = direct.align(overlap.near, overlap.far, overlap.covered, np.eye(3), fit.model)
        if found is None:
            return fit.far_from_near, overlap
        near_to_grid = geometry.inverted(overlap.near_from_grid)
        exact = overlap.far_from_grid @ found.far_from_near @ near_to_grid
        return geometry.normalized(exact), overlap

    def _gated(
        self,
        a: Picture,
        b: Picture,
        found: Estimate,
        points: tuple[Points, Points],
        b_from_a: Matrix,
        model: Model,
        overlap: Overlap,
    ) -> Link:
        agreement = measure_agreement(overlap)
        threshold_px = self._settings.registration.inlier_threshold_px
        a_points, b_points = points
        errors = transfer_errors(b_from_a, a_points, b_points)
        is_inlier = errors < threshold_px
        verdict = judge_link(b_from_a, model, a.size_wh, b.size_wh, points, is_inlier, agreement)
        if verdict is Verdict.OK and is_ambiguous(overlap):
            verdict = Verdict.AMBIGUOUS
        a_inliers, b_inliers = a_points[is_inlier], b_points[is_inlier]
        overlay = overlay_like(a_inliers, b_inliers, a.size_wh, b.size_wh)
        if overlay is not None and scene_differs(overlap):
            verdict = Verdict.OVERLAY
        symmetric_px = float("nan")
        if verdict is Verdict.OK:
            rmse_px = float(np.sqrt(np.mean(errors[is_inlier] ** 2)))
            registration = Registration(verdict, b_from_a, model, is_inlier, rmse_px)
            symmetric_px = symmetric_transfer_rmse(b_from_a, a_inliers, b_inliers)
        else:
            registration = refused(verdict, len(a_points), is_inlier)
        return Link(
            a.index,
            b.index,
            a_points,
            b_points,
            registration,
            found.matches,
            symmetric_px,
            agreement.ncc,
        )


def _fit_evenly(model: Model, start: Matrix, a: Points, b: Points, threshold_px: float) -> Matrix:
    """``start`` once more by least squares, with a wider say than `fit_robustly` gives.

    Lenses and scenes are never quite what a homography can follow: what is left then varies
    smoothly over the picture, and the best compromise hears all of it, not the best part.
    """
    errors = transfer_errors(start, a, b)
    near = errors[errors < threshold_px]
    if len(near) < _MIN_TRACKED:
        return start
    cut = min(max(_EVEN_WIDTH * median(near), 0.25), threshold_px)
    weights = np.where(errors < cut, (1 - (errors / cut) ** 2) ** 2, 0.0)
    used = weights > 0
    if np.count_nonzero(used) < _MIN_TRACKED:
        return start
    if model is not Model.HOMOGRAPHY:
        return fit(model, a, b, weights)
    pairs = a[used].astype(np.float64), b[used].astype(np.float64)
    return gauss_newton_step(start, *pairs, weights[used])


def _corner_change(overlap: Overlap, far_from_near: Matrix) -> float:
    """How far the grid's corners move, in grid pixels, if it is rendered by this mapping."""
    corners = geometry.image_quad(overlap.size_wh)
    grid_from_far = geometry.inverted(overlap.far_from_grid)
    step = grid_from_far @ far_from_near @ overlap.near_from_grid
    return float(np.max(np.abs(geometry.transform_points(step, corners) - corners)))


def _area(points: Points) -> float:
    """Spread of points (N, 2) as an area: root of the determinant of their covariance."""
    return float(np.sqrt(max(np.linalg.det(np.cov(points.T.astype(np.float64))), 0.0)))


def _is_coarser(b_from_a: Matrix, found: Estimate, a: Features) -> bool:
    """Is b the coarser picture, judged in the middle of what the matches show of a?"""
    middle = a.points[found.matches.ref[found.is_inlier]].mean(axis=0)
    return geometry.local_scale(b_from_a, middle) < 1


def _refusal(a: Picture, b: Picture, found: Estimate, verdict: Verdict) -> Link:
    """A link that says why there is none, with the matches it was judged by."""
    a_points, b_points = a.features.points[found.matches.ref], b.features.points[found.matches.cur]
    registration = refused(verdict, len(found.matches), found.is_inlier)
    return Link(a.index, b.index, a_points, b_points, registration, found.matches)
