"""A first estimate of where one picture lies in the other, from descriptors alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from streamtrack.feature_pyramid import PYRAMID_STEP
from streamtrack.fitting import fit_best_model, fit_robustly
from streamtrack.matching import match
from streamtrack.mosaic.pairs.standing import overlay_like, stands
from streamtrack.mosaic.types import Picture
from streamtrack.registration import log10_false_alarms, robust_inliers
from streamtrack.settings import MatchingSettings, Settings
from streamtrack.types import Features, Mask, Matches, Matrix, Model, Verdict

_MAX_LOG10_FALSE_ALARMS = -4.0
_ZOOMS_TRIED = 2
_ZOOM_RATIO = 0.85
_MAX_ZOOM_STEPS = 7
_ALL_RATIO = 0.9


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """A first mapping with the matches it rests on; ``b_from_a`` is None unless OK."""

    verdict: Verdict
    matches: Matches
    is_inlier: Mask
    b_from_a: Matrix | None = None
    log10_false_alarms: float = 0.0


def estimate(a: Features, b: Features, b_area_px: float, settings: Settings) -> Estimate:
    """The mapping that most matches agree on (MAGSAC++), refused if chance may explain it."""
    return _estimate(match(a, b, settings.matching), a, b, b_area_px, settings)


def estimate_by_zoom(a: Features, b: Features, b_area_px: float, settings: Settings) -> Estimate:
    """The same, each keypoint compared only with those whose size fits one zoom of the picture.

    Under a large zoom most keypoints have no partner at all, and the many that cannot be one
    drown those that are. The zooms tried are those that the sizes of all doubtful matches
    speak for most, against what sizes would give by chance.
    """
    best = Estimate(Verdict.TOO_FEW_MATCHES, _no_matches(), np.zeros(0, np.bool_))
    for zoom in _likely_zooms(a, b):
        found = _estimate(_match_at_zoom(a, b, zoom), a, b, b_area_px, settings)
        if found.log10_false_alarms < best.log10_false_alarms:
            best = found
    return best


def estimate_of_moved(found: Estimate, a: Picture, b: Picture, settings: Settings) -> Estimate:
    """Where what was found is an overlay, the same from the matches that move otherwise."""
    matches = found.matches
    pairs = a.features.points[matches.ref], b.features.points[matches.cur]
    a_points, b_points = (side[found.is_inlier] for side in pairs)
    overlay = overlay_like(a_points, b_points, a.size_wh, b.size_wh)
    if overlay is None:
        return Estimate(Verdict.TOO_FEW_MATCHES, matches, found.is_inlier)
    moved = ~stands(*pairs, overlay, b.size_wh)
    left = Matches(matches.ref[moved], matches.cur[moved], matches.distances[moved])
    b_area_px = float(b.size_wh[0] * b.size_wh[1])
    return _estimate(left, a.features, b.features, b_area_px, settings)


def _estimate(
    matches: Matches, a: Features, b: Features, b_area_px: float, settings: Settings
) -> Estimate:
    rules = settings.registration
    nobody = np.zeros(len(matches), np.bool_)
    if len(matches) < max(4, rules.min_inliers):
        return Estimate(Verdict.TOO_FEW_MATCHES, matches, nobody)
    points_a, points_b = a.points[matches.ref], b.points[matches.cur]
    is_inlier = robust_inliers(points_a, points_b, rules)
    if np.count_nonzero(is_inlier) < rules.min_inliers:
        return Estimate(Verdict.TOO_FEW_INLIERS, matches, is_inlier)
    ladder = tuple(Model) if rules.model == "auto" else (Model(rules.model),)
    model, start = fit_best_model(points_a[is_inlier], points_b[is_inlier], ladder)
    threshold_px = rules.inlier_threshold_px
    b_from_a, is_inlier = fit_robustly(model, start, points_a, points_b, threshold_px, 3)
    inliers = int(np.count_nonzero(is_inlier))
    if inliers < rules.min_inliers or not np.isfinite(b_from_a).all():
        return Estimate(Verdict.TOO_FEW_INLIERS, matches, is_inlier)
    disc = np.pi * threshold_px**2
    chance = min(0.5, disc / max(b_area_px, 4 * disc))
    false_alarms = log10_false_alarms(len(matches), inliers, chance)
    if false_alarms > _MAX_LOG10_FALSE_ALARMS:
        return Estimate(Verdict.TOO_FEW_INLIERS, matches, is_inlier)
    return Estimate(Verdict.OK, matches, is_inlier, b_from_a, false_alarms)


def _octaves(sizes: npt.NDArray[np.float32]) -> npt.NDArray[np.intp]:
    """Sizes as whole steps of the corner pyramid."""
    steps = np.rint(np.log2(np.maximum(sizes, 1e-3)) / np.log2(PYRAMID_STEP))
    whole: npt.NDArray[np.intp] = steps.astype(np.intp)
    return whole


def _likely_zooms(a: Features, b: Features) -> list[int]:
    """Pyramid steps from a to b that the doubtful matches speak for, the likeliest first."""
    doubtful = match(a, b, MatchingSettings(max_ratio=_ALL_RATIO))
    if len(doubtful) == 0:
        return []
    steps_a, steps_b = _octaves(a.sizes), _octaves(b.sizes)
    votes = _histogram(steps_b[doubtful.cur] - steps_a[doubtful.ref])
    low = min(int(steps_a.min()), int(steps_b.min()))
    count_a, count_b = np.bincount(steps_a - low), np.bincount(steps_b - low)
    length = max(len(count_a), len(count_b))
    by_chance = np.correlate(
        np.pad(count_b, (0, length - len(count_b))).astype(np.float64),
        np.pad(count_a, (0, length - len(count_a))).astype(np.float64),
        "full",
    )
    middle = length - 1
    expected = np.array(
        [
            by_chance[middle + zoom] if abs(zoom) < length else 0.0
            for zoom in range(-_MAX_ZOOM_STEPS, _MAX_ZOOM_STEPS + 1)
        ]
    )
    expected *= len(doubtful) / max(float(by_chance.sum()), 1.0)
    # Matches of one zoom fall on it and its neighbours.
    wide = np.convolve(votes - expected, (0.5, 1.0, 0.5), "same")
    deviation = np.sqrt(np.convolve(expected, (0.25, 1.0, 0.25), "same") + 1.0)
    order = np.argsort(-(wide / deviation), kind="stable")[:_ZOOMS_TRIED]
    return [int(place) - _MAX_ZOOM_STEPS for place in order]


def _histogram(steps: npt.NDArray[np.intp]) -> npt.NDArray[np.float64]:
    near = steps[np.abs(steps) <= _MAX_ZOOM_STEPS] + _MAX_ZOOM_STEPS
    return np.bincount(near, minlength=2 * _MAX_ZOOM_STEPS + 1).astype(np.float64)


def _match_at_zoom(a: Features, b: Features, zoom: int) -> Matches:
    """Matches whose sizes differ by ``zoom`` pyramid steps, give or take one."""
    steps_a, steps_b = _octaves(a.sizes), _octaves(b.sizes)
    settings = MatchingSettings(max_ratio=_ZOOM_RATIO)
    parts = []
    for step in np.unique(steps_a):
        rows_a = np.flatnonzero(steps_a == step)
        rows_b = np.flatnonzero(np.abs(steps_b - step - zoom) <= 1)
        if len(rows_b) < 2:
            continue
        found = match(a[rows_a], b[rows_b], settings)
        parts.append(Matches(rows_a[found.ref], rows_b[found.cur], found.distances))
    if not parts:
        return _no_matches()
    return Matches(
        np.concatenate([part.ref for part in parts]),
        np.concatenate([part.cur for part in parts]),
        np.concatenate([part.distances for part in parts]),
    )


def _no_matches() -> Matches:
    none = np.zeros(0, np.intp)
    return Matches(none, none, np.zeros(0, np.float32))
