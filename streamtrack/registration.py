"""From point pairs to a transformation that can be trusted, or a refusal with its reason.

Four steps: a robust estimate (MAGSAC++, OpenCV's USAC with a fixed seed), a last weighted least
squares over the inliers, the choice of the transformation model by an information criterion, and
a gate. `cv2.findHomography` answers pure noise with a confident matrix or with None; both end
here as a refusal.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import isfinite, lgamma, log

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.fitting import fit_best_model, fit_robustly, transfer_errors
from streamtrack.settings import RegistrationSettings
from streamtrack.types import Mask, Matrix, Model, Points, Registration, Verdict

_MAX_AREA_RATIO = 60.0
_MAX_PERSPECTIVE_RATIO = 15.0
_MIN_SPREAD_SHARE = 0.02
_MAX_LOG10_FALSE_ALARMS = -4.0


@dataclass(frozen=True, slots=True)
class Effort:
    """How far an estimate is taken: the models to choose from under ``auto``, and the rounds of
    reweighted least squares."""

    ladder: tuple[Model, ...]
    robust_rounds: int


FULL = Effort(tuple(Model), 3)


def register(
    a: Points,
    b: Points,
    settings: RegistrationSettings,
    region: Points,
    candidate_area_px: float,
    effort: Effort = FULL,
) -> Registration:
    """The gated mapping from picture a to picture b.

    ``a`` and ``b`` (M, 2) are paired points. ``region`` (4, 2) is the quad in a that the mapping
    is wanted for: the gate judges the mapping there. ``candidate_area_px`` is the area of b in
    which a partner was looked for, which tells how easily pairs agree by chance. Pairs with a
    coordinate that is not finite are outliers. ``effort`` is less where the caller refines the
    mapping in another way.
    """
    is_finite = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    if not is_finite.all():
        found = register(a[is_finite], b[is_finite], settings, region, candidate_area_px, effort)
        is_inlier = np.zeros(len(a), np.bool_)
        is_inlier[is_finite] = found.is_inlier
        return replace(found, is_inlier=is_inlier)
    if len(a) < max(4, settings.min_inliers):
        return refused(Verdict.TOO_FEW_MATCHES, len(a))
    near, is_inlier = _robust_estimate(a, b, settings)
    if np.count_nonzero(is_inlier) < settings.min_inliers:
        return refused(Verdict.TOO_FEW_INLIERS, len(a), is_inlier)
    ladder = effort.ladder if settings.model == "auto" else (Model(settings.model),)
    model, start = fit_best_model(a[is_inlier], b[is_inlier], ladder, near)
    b_from_a, is_inlier = fit_robustly(
        model, start, a, b, settings.inlier_threshold_px, effort.robust_rounds
    )
    inliers = int(np.count_nonzero(is_inlier))
    verdict = judge_support(a, is_inlier, settings, region, candidate_area_px)
    if verdict is Verdict.OK:
        verdict = judge_mapping(b_from_a, region)
    if verdict is not Verdict.OK:
        return refused(verdict, len(a), is_inlier)
    errors = transfer_errors(b_from_a, a, b)
    rmse_px = float(np.sqrt(np.mean(errors[is_inlier] ** 2))) if inliers else float("nan")
    return Registration(Verdict.OK, b_from_a, model, is_inlier, rmse_px)


def refused(verdict: Verdict, pairs: int, is_inlier: Mask | None = None) -> Registration:
    """A registration that says why there is none."""
    none = np.zeros(pairs, np.bool_) if is_inlier is None else is_inlier
    return Registration(verdict, None, None, none, float("nan"))


# -- robust estimate ----------------------------------------------------------------------------


def robust_inliers(a: Points, b: Points, settings: RegistrationSettings) -> Mask:
    """Which pairs (M,) agree with one homography or, of fewer freedoms, the model asked for.

    MAGSAC++ (Barath et al. 2020) as in OpenCV's USAC, with the seed of the settings.
    """
    return _robust_estimate(a, b, settings)[1]


def _robust_estimate(
    a: Points, b: Points, settings: RegistrationSettings
) -> tuple[Matrix | None, Mask]:
    """The homography, unless fewer freedoms were asked for, and which pairs (M,) agree."""
    if settings.model in ("translation", "similarity", "affine"):
        _, mask = cv2.estimateAffine2D(a, b, _usac(settings))
        return None, _as_mask(mask, len(a))
    near, mask = cv2.findHomography(a, b, _usac(settings))
    # OpenCV's stubs say that there is always a matrix.
    is_usable = near is not None and bool(np.isfinite(near).all()) and near[2, 2] != 0
    return np.asarray(near, np.float64) if is_usable else None, _as_mask(mask, len(a))


def _usac(settings: RegistrationSettings) -> cv2.UsacParams:
    params = cv2.UsacParams()
    params.threshold = settings.inlier_threshold_px
    params.randomGeneratorState = settings.seed
    params.score = cv2.SCORE_METHOD_MAGSAC
    params.sampler = cv2.SAMPLING_UNIFORM
    params.loMethod = cv2.LOCAL_OPTIM_SIGMA
    params.confidence = 0.999
    params.maxIterations = 1000
    params.isParallel = False
    return params


def _as_mask(mask: npt.NDArray[np.generic] | None, count: int) -> Mask:
    # OpenCV's stubs say the mask is never None; it is when nothing agrees.
    if mask is None:
        return np.zeros(count, np.bool_)
    is_inlier: Mask = np.asarray(mask).reshape(-1) > 0
    return is_inlier


# -- the gate -----------------------------------------------------------------------------------


def judge_support(
    a: Points,
    is_inlier: Mask,
    settings: RegistrationSettings,
    region: Points,
    candidate_area_px: float,
) -> Verdict:
    """Are the inliers more than chance would give, and do they span enough of the region?"""
    inliers = int(np.count_nonzero(is_inlier))
    if inliers < settings.min_inliers:
        return Verdict.TOO_FEW_INLIERS
    disc = np.pi * settings.inlier_threshold_px**2
    chance = min(0.5, disc / max(candidate_area_px, 4 * disc))
    if log10_false_alarms(len(a), inliers, chance) > _MAX_LOG10_FALSE_ALARMS:
        return Verdict.TOO_FEW_INLIERS
    hull = cv2.convexHull(a[is_inlier].astype(np.float32))
    share = float(cv2.contourArea(hull)) / max(abs(geometry.signed_area(region)), 1.0)
    return Verdict.OK if share >= _MIN_SPREAD_SHARE else Verdict.NOT_SPREAD


def log10_false_alarms(pairs: int, inliers: int, chance: float) -> float:
    """Decimal logarithm of how many homographies this good pure noise would be expected to give.

    A-contrario model of Moisan & Stival (2004): with 4 pairs spent on the hypothesis,
    NFA = (n - 4) C(n, k) C(k, 4) p^(k - 4), p the ``chance`` that a random pair agrees.
    """
    if inliers <= 4 or pairs <= 4:
        return 0.0

    def ln_choose(n: int, k: int) -> float:
        return lgamma(n + 1) - lgamma(k + 1) - lgamma(n - k + 1)

    ln_nfa = (
        log(pairs - 4)
        + ln_choose(pairs, inliers)
        + ln_choose(inliers, 4)
        + (inliers - 4) * log(chance)
    )
    return ln_nfa / log(10)


def judge_mapping(b_from_a: Matrix, region: Points) -> Verdict:
    """Could a flat thing really look like this? Judged on the quad ``region`` (4, 2) of a.

    Refuses fold-over and mirroring (depth or area changes sign), quads that are not convex,
    areas that change more than 60-fold, and perspective under which one corner is magnified
    15 times as much as another.
    """
    # In plain numbers: for four corners numpy would be ten times as slow.
    (a, b, c), (d, e, f), (g, h, i) = b_from_a.tolist()
    if not isfinite(a + b + c + d + e + f + g + h + i):
        return Verdict.MIRRORED
    corners = region.tolist()
    depths = [g * x + h * y + i for x, y in corners]
    if not (min(depths) > 0 or max(depths) < 0):
        return Verdict.MIRRORED
    quad = [
        ((a * x + b * y + c) / depth, (d * x + e * y + f) / depth)
        for (x, y), depth in zip(corners, depths, strict=True)
    ]
    area, area_before = geometry.signed_area(quad), geometry.signed_area(corners)
    if not isfinite(area) or area * area_before <= 0:
        return Verdict.MIRRORED
    if not geometry.is_convex(quad):
        return Verdict.NOT_CONVEX
    if not 1 / _MAX_AREA_RATIO <= area / area_before <= _MAX_AREA_RATIO:
        return Verdict.AREA
    # The local area magnification of a homography is |det H| / depth^3.
    sizes = [abs(depth) for depth in depths]
    if (max(sizes) / min(sizes)) ** 3 > _MAX_PERSPECTIVE_RATIO:
        return Verdict.PERSPECTIVE
    return Verdict.OK
