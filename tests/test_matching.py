"""Matching against a slow, plain oracle."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from streamtrack.features import no_features
from streamtrack.matching import match, match_guided
from streamtrack.settings import MatchingSettings
from streamtrack.types import Features, Matches, Points

Descriptors = npt.NDArray[np.generic]


def features_of(descriptors: Descriptors, points: Points | None = None) -> Features:
    count = len(descriptors)
    points = np.zeros((count, 2), np.float32) if points is None else points
    return Features(points, np.ones(count, np.float32), np.ones(count, np.float32), descriptors)


def some_descriptors(
    rng: np.random.Generator, kind: str, refs: int, curs: int, shared: int
) -> tuple[Descriptors, Descriptors]:
    """Random ones, of which ``shared`` rows of cur are rows of ref with a little noise."""
    if kind == "binary":
        ref = rng.integers(0, 256, (refs, 32), np.uint8)
        cur = rng.integers(0, 256, (curs, 32), np.uint8)
        flips = np.packbits(rng.random((shared, 256)) < 0.1, axis=1)
        cur[rng.permutation(curs)[:shared]] = ref[rng.permutation(refs)[:shared]] ^ flips
        return ref, cur
    ref = rng.uniform(0, 255, (refs, 128)).astype(np.float32)
    cur = rng.uniform(0, 255, (curs, 128)).astype(np.float32)
    noise = rng.normal(0, 25, (shared, 128))
    cur[rng.permutation(curs)[:shared]] = ref[rng.permutation(refs)[:shared]] + noise
    return ref, cur


def distances_between(ref: Descriptors, cur: Descriptors) -> npt.NDArray[np.float64]:
    if ref.dtype == np.uint8:
        bits = np.bitwise_count(np.bitwise_xor(ref[:, None], cur[None]))
        return np.asarray(bits.sum(axis=2), np.float64)
    difference = ref[:, None].astype(np.float64) - cur[None].astype(np.float64)
    return np.asarray(np.linalg.norm(difference, axis=2), np.float64)


def plainly_matched(
    distances: npt.NDArray[np.float64], allowed: npt.NDArray[np.bool_], max_ratio: float
) -> set[tuple[int, int]]:
    """Mutual nearest neighbours among the allowed pairs that pass the ratio test, in loops."""
    distances = np.where(allowed, distances, np.inf)
    pairs = set()
    for i, row in enumerate(distances):
        order = np.argsort(row, kind="stable")
        j = int(order[0])
        second = row[order[1]] if len(order) > 1 else np.inf
        is_unambiguous = np.isinf(second) or row[j] <= max_ratio * second
        is_mutual = int(np.argmin(distances[:, j])) == i
        if np.isfinite(row[j]) and is_unambiguous and is_mutual:
            pairs.add((i, j))
    return pairs


def pairs_of(matches: Matches) -> set[tuple[int, int]]:
    return set(zip(matches.ref.tolist(), matches.cur.tolist(), strict=True))


@pytest.mark.parametrize("kind", ["binary", "float"])
@pytest.mark.parametrize("ratio", [0.6, 0.8, 0.95, 0.99])
@pytest.mark.parametrize(("refs", "curs"), [(80, 120), (120, 60), (40, 2), (2, 40)])
def test_match_agrees_with_the_oracle(
    rng: np.random.Generator, kind: str, ratio: float, refs: int, curs: int
) -> None:
    ref, cur = some_descriptors(rng, kind, refs, curs, min(refs, curs) // 2)
    found = match(features_of(ref), features_of(cur), MatchingSettings(max_ratio=ratio))
    distances = distances_between(ref, cur)
    assert pairs_of(found) == plainly_matched(distances, np.ones_like(distances, bool), ratio)
    np.testing.assert_allclose(found.distances, distances[found.ref, found.cur], rtol=1e-4)
    assert len(set(found.ref.tolist())) == len(set(found.cur.tolist())) == len(found)


@pytest.mark.parametrize("kind", ["binary", "float"])
@pytest.mark.parametrize("radius", [0.0, 10.0, 40.0, 1e4])
def test_guided_match_agrees_with_the_oracle(
    rng: np.random.Generator, kind: str, radius: float
) -> None:
    ref, cur = some_descriptors(rng, kind, 90, 110, 50)
    predicted = rng.uniform(0, 200, (90, 2)).astype(np.float32)
    points = rng.uniform(0, 200, (110, 2)).astype(np.float32)
    found = match_guided(
        features_of(ref), features_of(cur, points), predicted, radius, MatchingSettings()
    )
    away = np.linalg.norm(predicted[:, None] - points[None], axis=2)
    expected = plainly_matched(distances_between(ref, cur), away <= radius, 0.8)
    assert pairs_of(found) == expected
    assert np.all(away[found.ref, found.cur] <= radius)


def test_an_unbounded_radius_guides_nothing(rng: np.random.Generator) -> None:
    ref, cur = some_descriptors(rng, "binary", 60, 60, 40)
    nowhere = np.zeros((60, 2), np.float32)
    guided = match_guided(features_of(ref), features_of(cur), nowhere, 1.0, MatchingSettings())
    assert pairs_of(guided) == pairs_of(
        match(features_of(ref), features_of(cur), MatchingSettings())
    )


def test_guidance_tells_twins_apart(rng: np.random.Generator) -> None:
    """Two places that look the same are ambiguous, unless only one of them is in reach."""
    ref = rng.integers(0, 256, (1, 32), np.uint8)
    cur = np.concatenate([ref ^ np.uint8(1), ref ^ np.uint8(2)])
    points = np.array([[0, 0], [100, 0]], np.float32)
    assert len(match(features_of(ref), features_of(cur, points), MatchingSettings())) == 0
    for i in range(2):
        found = match_guided(
            features_of(ref), features_of(cur, points), points[i : i + 1], 50.0, MatchingSettings()
        )
        assert pairs_of(found) == {(0, i)}


def test_guidance_beyond_the_horizon_pairs_nothing(rng: np.random.Generator) -> None:
    ref = rng.integers(0, 256, (4, 32), np.uint8)
    points = np.zeros((4, 2), np.float32)
    predicted = np.array([[np.nan, 0], [np.inf, 0], [-np.inf, np.inf], [1e30, -1e30]], np.float32)
    found = match_guided(
        features_of(ref), features_of(ref, points), predicted, 60.0, MatchingSettings()
    )
    assert len(found) == 0


@pytest.mark.parametrize("kind", ["binary", "float"])
@pytest.mark.parametrize(("refs", "curs"), [(0, 0), (0, 5), (5, 0)])
def test_nothing_matches_nothing(rng: np.random.Generator, kind: str, refs: int, curs: int) -> None:
    ref, cur = some_descriptors(rng, kind, refs, curs, 0)
    predicted = np.zeros((refs, 2), np.float32)
    for found in (
        match(features_of(ref), features_of(cur), MatchingSettings()),
        match_guided(features_of(ref), features_of(cur), predicted, 9.0, MatchingSettings()),
    ):
        assert len(found) == 0
        assert found.ref.dtype == found.cur.dtype == np.intp


def test_no_features_match_no_features_and_any(rng: np.random.Generator) -> None:
    some = features_of(rng.uniform(0, 255, (6, 128)).astype(np.float32))
    for a, b in ((no_features(), some), (some, no_features()), (no_features(), no_features())):
        assert len(match(a, b, MatchingSettings())) == 0


@pytest.mark.parametrize("kind", ["binary", "float"])
def test_one_against_one_is_a_match(rng: np.random.Generator, kind: str) -> None:
    """With no second best there is no ambiguity."""
    ref, cur = some_descriptors(rng, kind, 1, 1, 1)
    assert pairs_of(match(features_of(ref), features_of(cur), MatchingSettings())) == {(0, 0)}


@pytest.mark.parametrize("kind", ["binary", "float"])
@pytest.mark.parametrize("differs", [0, 1])
def test_identical_descriptors_are_ambiguous(
    rng: np.random.Generator, kind: str, differs: int
) -> None:
    """Two equally good partners are none, the perfect ones (distance 0) included."""
    ref, _ = some_descriptors(rng, kind, 6, 6, 0)
    cur = np.concatenate([ref, ref])
    if differs:
        cur = (cur ^ np.uint8(1)) if kind == "binary" else cur + np.float32(3)
    found = match(features_of(ref), features_of(cur), MatchingSettings())
    assert pairs_of(found) == set()


@pytest.mark.parametrize("kind", ["binary", "float"])
def test_a_partner_is_given_away_once(rng: np.random.Generator, kind: str) -> None:
    ref, cur = some_descriptors(rng, kind, 6, 12, 0)
    ref = np.concatenate([ref, ref])
    cur[:6] = ref[:6]
    found = match(features_of(ref), features_of(cur), MatchingSettings())
    assert sorted(found.cur.tolist()) == list(range(6))


def test_matches_are_the_same_from_call_to_call(rng: np.random.Generator) -> None:
    ref, cur = some_descriptors(rng, "binary", 100, 100, 50)
    first, second = (
        match(features_of(ref), features_of(cur), MatchingSettings()) for _ in range(2)
    )
    np.testing.assert_array_equal(first.ref, second.ref)
    np.testing.assert_array_equal(first.cur, second.cur)
