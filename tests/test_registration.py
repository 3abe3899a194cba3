"""The robust estimate: right when there is something to find, a refusal when there is not."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from conftest import MakeHomography

from streamtrack import geometry
from streamtrack.fitting import DEGREES_OF_FREEDOM, dlt_homography, fit, transfer_errors
from streamtrack.registration import judge_mapping, log10_false_alarms, refused, register
from streamtrack.settings import RegistrationSettings, build_settings
from streamtrack.types import Matrix, Model, Points, Registration, Verdict

SIZE = (320, 240)
REGION = geometry.box_quad(0, 0, *SIZE)
AREA = 640.0 * 480.0
Pairs = tuple[Points, Points]


def settings_of(**values: object) -> RegistrationSettings:
    return build_settings({"registration": values}).registration


def registered(a: npt.ArrayLike, b: npt.ArrayLike, **values: object) -> Registration:
    points_a, points_b = (np.asarray(p, np.float32).reshape(-1, 2) for p in (a, b))
    return register(points_a, points_b, settings_of(**values), REGION, AREA)


def corner_miss(found: Matrix | None, truth: Matrix) -> float:
    """Largest distance of the region's corners from where they should be, px."""
    assert found is not None
    ours, true = (geometry.transform_points(matrix, REGION) for matrix in (found, truth))
    return float(np.linalg.norm(ours - true, axis=1).max())


def some_pairs(
    rng: np.random.Generator,
    b_from_a: Matrix,
    count: int,
    outliers: float = 0.0,
    noise: float = 0.0,
) -> Pairs:
    """Pairs of the mapping with noise in b, and a share of them with b anywhere."""
    a = rng.uniform((0, 0), SIZE, (count, 2)).astype(np.float32)
    b = geometry.transform_points(b_from_a, a) + rng.normal(0, noise, (count, 2))
    wrong = rng.permutation(count)[: round(outliers * count)]
    b[wrong] = rng.uniform((-100, -100), (540, 380), (len(wrong), 2))
    return a, b.astype(np.float32)


def example_of(model: Model, rng: np.random.Generator) -> Matrix:
    """A mapping that clearly needs all freedoms of its model."""
    x, y = rng.uniform(-40, 40, 2)
    matrix = geometry.translation(x, y)
    if model is Model.TRANSLATION:
        return matrix
    angle, scale = rng.uniform(0.2, 2.5), rng.uniform(0.7, 1.4)
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    matrix @= np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    if model is Model.SIMILARITY:
        return matrix
    matrix @= np.array([[1.0, 0.25, 0], [0, 0.8, 0], [0, 0, 1]])
    if model is Model.AFFINE:
        return matrix
    return geometry.normalized(matrix @ np.array([[1.0, 0, 0], [0, 1, 0], [8e-4, -5e-4, 1]]))


# -- least squares ------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [4, 5, 20, 200])
@pytest.mark.parametrize("seed", range(5))
def test_dlt_recovers_any_homography_exactly(
    seed: int, count: int, random_homography: MakeHomography
) -> None:
    rng = np.random.default_rng(seed)
    truth = random_homography(rng, SIZE)
    a = rng.uniform((0, 0), SIZE, (count, 2))
    if count == 4:
        a = REGION + rng.uniform(-20, 20, (4, 2))
    homogeneous = np.hstack([a, np.ones((count, 1))]) @ truth.T
    b = homogeneous[:, :2] / homogeneous[:, 2:]
    assert corner_miss(dlt_homography(a, b), truth) < 1e-3
    np.testing.assert_allclose(dlt_homography(a, b), truth, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_dlt_is_opencvs_on_clean_pairs(seed: int, random_homography: MakeHomography) -> None:
    rng = np.random.default_rng(seed)
    a, b = some_pairs(rng, random_homography(rng, SIZE), 40)
    theirs = np.asarray(cv2.findHomography(a, b, 0)[0], np.float64)
    assert corner_miss(dlt_homography(a.astype(float), b.astype(float)), theirs) < 0.01


def test_dlt_does_not_mind_where_the_origin_lies(
    rng: np.random.Generator, random_homography: MakeHomography
) -> None:
    truth = random_homography(rng, SIZE)
    a, b = some_pairs(rng, truth, 30, noise=0.5)
    first = dlt_homography(a.astype(float), b.astype(float))
    moved = dlt_homography(a.astype(float) + 1e5, b.astype(float) - 1e5)
    back = geometry.translation(1e5, 1e5) @ moved @ geometry.translation(1e5, 1e5)
    assert corner_miss(geometry.normalized(back), first) < 1e-2


@pytest.mark.parametrize("model", list(Model))
def test_a_pair_of_weight_zero_has_no_say(model: Model, rng: np.random.Generator) -> None:
    truth = example_of(model, rng)
    a, b = some_pairs(rng, truth, 30)
    weights = np.ones(30)
    b[[3, 11]] += 200
    weights[[3, 11]] = 0
    assert corner_miss(fit(model, a, b, weights), truth) < 0.02
    if model is Model.HOMOGRAPHY:
        a64, b64 = a.astype(float), b.astype(float)
        assert corner_miss(dlt_homography(a64, b64, weights), truth) < 0.02
        assert corner_miss(dlt_homography(a64, b64), truth) > 5


@pytest.mark.parametrize("model", list(Model))
def test_a_weight_of_two_is_a_pair_given_twice(model: Model, rng: np.random.Generator) -> None:
    a, b = some_pairs(rng, example_of(model, rng), 25, noise=1.0)
    weights = np.ones(25)
    weights[:10] = 2
    twice = fit(model, np.concatenate([a, a[:10]]), np.concatenate([b, b[:10]]))
    # The DLT's normalisation knows no weights, so only almost the same.
    assert corner_miss(fit(model, a, b, weights), twice) < 0.05


@pytest.mark.parametrize("model", list(Model))
@pytest.mark.parametrize("simpler", list(Model))
def test_a_richer_model_fits_what_a_simpler_one_made(
    model: Model, simpler: Model, rng: np.random.Generator
) -> None:
    truth = example_of(simpler, rng)
    a, b = some_pairs(rng, truth, 30)
    miss = corner_miss(fit(model, a, b), truth)
    if DEGREES_OF_FREEDOM[model] >= DEGREES_OF_FREEDOM[simpler]:
        assert miss < 0.02
    else:
        assert miss > 3


@pytest.mark.parametrize("model", list(Model))
def test_least_squares_beats_what_made_the_data(model: Model, rng: np.random.Generator) -> None:
    truth = example_of(model, rng)
    a, b = some_pairs(rng, truth, 60, noise=1.0)
    ours, true = (transfer_errors(m, a, b) for m in (fit(model, a, b), truth))
    assert np.sum(ours**2) <= np.sum(true**2) * 1.0001


def test_transfer_errors_are_distances_and_infinite_at_the_horizon() -> None:
    horizon = np.array([[1.0, 0, 0], [0, 1, 0], [-0.01, 0, 1]])
    a = np.array([[0, 0], [100, 0], [50, 0], [100, 40]], np.float32)
    b = np.array([[3, 4], [0, 0], [100, 0], [0, 0]], np.float32)
    np.testing.assert_allclose(transfer_errors(horizon, a, b), [5, np.inf, 0, np.inf], atol=1e-5)
    b[0] = np.nan
    assert np.isinf(transfer_errors(horizon, a, b)[0])


# -- robust estimate ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("outliers", "noise", "limit_px"),
    [(0.0, 0.0, 0.01), (0.0, 0.5, 1.0), (0.3, 0.5, 1.2), (0.5, 0.5, 1.5), (0.7, 0.5, 2.5)],
)
@pytest.mark.parametrize("seed", range(6))
def test_the_mapping_is_recovered_among_outliers(
    seed: int, outliers: float, noise: float, limit_px: float, random_homography: MakeHomography
) -> None:
    rng = np.random.default_rng(seed)
    truth = random_homography(rng, SIZE)
    a, b = some_pairs(rng, truth, 150, outliers, noise)
    found = registered(a, b)
    assert found.verdict is Verdict.OK and found.b_from_a is not None
    assert corner_miss(found.b_from_a, truth) < limit_px
    is_right = np.linalg.norm(geometry.transform_points(truth, a) - b, axis=1) < 2
    assert np.mean(found.is_inlier[is_right]) > 0.95
    assert found.inliers <= np.count_nonzero(is_right) + 5
    assert found.rmse_px == pytest.approx(
        np.sqrt(np.mean(transfer_errors(found.b_from_a, a, b)[found.is_inlier] ** 2))
    )
    assert found.rmse_px < max(2.5 * noise, 0.01)


@pytest.mark.parametrize("model", ["auto", *Model])
def test_pure_noise_is_never_accepted(model: str) -> None:
    accepted = []
    for seed in range(100 if model == "auto" else 25):
        rng = np.random.default_rng(seed)
        count = int(rng.integers(0, 120))
        a = rng.uniform((0, 0), SIZE, (count, 2))
        b = rng.uniform((0, 0), (640, 480), (count, 2))
        found = registered(a, b, model=model)
        if found.verdict is Verdict.OK or found.b_from_a is not None:
            accepted.append((seed, count))
    assert accepted == []


@pytest.mark.parametrize("seed", range(20))
def test_noise_on_a_line_or_in_clusters_is_not_accepted(seed: int) -> None:
    """Partners that crowd agree by chance far more easily than scattered ones."""
    rng = np.random.default_rng(seed)
    a = rng.uniform((0, 0), SIZE, (60, 2))
    centres = rng.uniform((0, 0), (640, 480), (3, 2))
    b = centres[rng.integers(0, 3, 60)] + rng.normal(0, 1.5, (60, 2))
    assert registered(a, b).verdict is not Verdict.OK


@pytest.mark.parametrize("model", ["auto", Model.TRANSLATION, Model.AFFINE])
@pytest.mark.parametrize("pairs", [60, 300, 1500])
def test_noise_near_a_prediction_is_not_accepted(pairs: int, model: str) -> None:
    """Partners looked for in a small window agree with the prediction by chance, many of them."""
    accepted, most = [], 0
    for seed in range(15):
        rng = np.random.default_rng(seed)
        a = rng.uniform((0, 0), SIZE, (pairs, 2)).astype(np.float32)
        b = (a + rng.uniform(-12, 12, (pairs, 2))).astype(np.float32)
        found = register(a, b, settings_of(model=model), REGION, 24.0**2)
        most = max(most, found.inliers)
        if found.verdict is Verdict.OK:
            accepted.append(seed)
    assert accepted == []
    if pairs >= 300:
        assert most >= 10  # enough of them, had chance not been reckoned with


def grid(x0: float, y0: float, x1: float, y1: float) -> Points:
    axes = np.meshgrid(np.linspace(x0, x1, 8), np.linspace(y0, y1, 8))
    return np.stack(axes, axis=-1).reshape(-1, 2).astype(np.float32)


WHOLE = grid(5, 5, 315, 235)
LINE = np.stack([np.linspace(5, 300, 64), np.linspace(5, 220, 64)], axis=1)
POINT = np.full((64, 2), 70.0)
NONE = {Verdict.TOO_FEW_MATCHES}
FEW = {Verdict.TOO_FEW_INLIERS}
NARROW = {Verdict.NOT_SPREAD}
IMPOSSIBLE = {Verdict.MIRRORED, *FEW}
STEEP = geometry.normalized(np.array([[1.0, 0, 0], [0, 1, 0], [0.0095, 0, 1]]))
FOLDED = np.array([[1.0, 0, 0], [0, 1, 0], [-0.005, 0, 1]])
BEYOND = {Verdict.AREA, Verdict.PERSPECTIVE}


@pytest.mark.parametrize(
    ("a", "b", "verdicts"),
    [
        (WHOLE, WHOLE + 7, {Verdict.OK}),
        (WHOLE, WHOLE * 6, {Verdict.OK}),
        (WHOLE, WHOLE * 0.2, {Verdict.OK}),
        (WHOLE, np.array([320, 240]) - WHOLE, {Verdict.OK}),
        (WHOLE[:0], WHOLE[:0], NONE),
        (WHOLE[:1], WHOLE[:1], NONE),
        (WHOLE[[0, 7, 60]], WHOLE[[0, 7, 60]], NONE),
        (WHOLE[[0, 7, 60, 63]], WHOLE[[0, 7, 60, 63]], NONE),
        (WHOLE[:9], WHOLE[:9], NONE),
        (LINE, LINE + 3, NARROW | FEW),
        (LINE, WHOLE, NARROW | FEW),
        (WHOLE, LINE, {Verdict.MIRRORED, Verdict.AREA, *FEW, *NARROW}),
        (POINT, POINT + 9, NARROW | FEW),
        (POINT, WHOLE, NARROW | FEW),
        (WHOLE, POINT, {Verdict.MIRRORED, Verdict.AREA, *FEW, *NARROW}),
        (grid(100, 100, 108, 108), grid(200, 50, 208, 58), NARROW),
        (grid(0, 100, 320, 102), grid(9, 100, 329, 102), NARROW),
        (WHOLE, WHOLE * [-1, 1], IMPOSSIBLE),
        (WHOLE, WHOLE * [1, -1] + 300, IMPOSSIBLE),
        (WHOLE, WHOLE[:, ::-1], IMPOSSIBLE),
        (WHOLE, WHOLE * 9, {Verdict.AREA}),
        (WHOLE, WHOLE * 0.1, {Verdict.AREA}),
        (WHOLE, geometry.transform_points(STEEP, WHOLE) * 3, BEYOND),
        (grid(5, 5, 170, 235), geometry.transform_points(FOLDED, grid(5, 5, 170, 235)), IMPOSSIBLE),
    ],
)
def test_degenerate_and_impossible_pairs(
    a: npt.ArrayLike, b: npt.ArrayLike, verdicts: set[Verdict]
) -> None:
    found = registered(a, b)
    assert found.verdict in verdicts
    assert (found.b_from_a is None) == (found.model is None) == (found.verdict is not Verdict.OK)
    assert found.is_inlier.shape == (len(np.asarray(a)),)


@pytest.mark.parametrize("model", list(Model))
@pytest.mark.parametrize(
    ("a", "b"),
    [
        (LINE, LINE + 3),
        (POINT, POINT + 9),
        (POINT, WHOLE),
        (WHOLE, POINT),
        (WHOLE, WHOLE * [-1, 1]),
    ],
)
def test_degenerate_pairs_fit_no_model(model: Model, a: npt.ArrayLike, b: npt.ArrayLike) -> None:
    assert registered(a, b, model=model).verdict is not Verdict.OK


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e20])
@pytest.mark.parametrize("side", ["a", "b", "both"])
@pytest.mark.parametrize("model", ["auto", Model.TRANSLATION])
def test_one_bad_pair_is_an_outlier_like_any_other(
    model: str, side: str, bad: float, rng: np.random.Generator
) -> None:
    truth = example_of(Model.TRANSLATION, rng)
    a, b = some_pairs(rng, truth, 60, noise=0.2)
    if side != "b":
        a[5, 0] = bad
    if side != "a":
        b[5, 1] = bad
    found = registered(a, b, model=model)
    assert found.verdict is Verdict.OK
    assert not found.is_inlier[5]
    assert found.inliers >= 57
    assert np.isfinite(found.rmse_px)
    assert corner_miss(found.b_from_a, truth) < 0.6


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("share", [0.4, 1.0])
def test_many_bad_pairs_do_not_harm(share: float, bad: float, rng: np.random.Generator) -> None:
    truth = example_of(Model.HOMOGRAPHY, rng)
    a, b = some_pairs(rng, truth, 80, noise=0.2)
    b[: round(80 * share)] = bad
    found = registered(a, b)
    if share == 1.0:
        assert found.verdict in (Verdict.TOO_FEW_MATCHES, Verdict.TOO_FEW_INLIERS)
    else:
        assert corner_miss(found.b_from_a, truth) < 1.0


@pytest.mark.parametrize(
    ("matrix", "verdict"),
    [
        (np.eye(3), Verdict.OK),
        (-2.0 * np.eye(3), Verdict.OK),
        (geometry.scaling(7), Verdict.OK),
        (geometry.scaling(1 / 7), Verdict.OK),
        (geometry.scaling(8), Verdict.AREA),
        (geometry.scaling(1 / 8), Verdict.AREA),
        (np.diag([-1.0, 1.0, 1.0]), Verdict.MIRRORED),
        (np.diag([1.0, -1.0, 1.0]), Verdict.MIRRORED),
        (np.diag([-1.0, -1.0, 1.0]), Verdict.OK),
        (FOLDED, Verdict.MIRRORED),
        (STEEP, Verdict.PERSPECTIVE),
        (np.diag([1.0, 0.0, 1.0]), Verdict.MIRRORED),
        (np.zeros((3, 3)), Verdict.MIRRORED),
        (np.full((3, 3), np.nan), Verdict.MIRRORED),
        (np.diag([np.inf, 1, 1]), Verdict.MIRRORED),
        (np.array([[1.0, 0, 0], [0, 1, 0], [-1 / 320, 0, 1]]), Verdict.MIRRORED),
    ],
)
def test_the_gate(matrix: Matrix, verdict: Verdict) -> None:
    assert judge_mapping(matrix, REGION) is verdict
    assert judge_mapping(matrix, REGION[::-1]) is verdict  # a quad may be given either way round


@pytest.mark.parametrize("seed", range(10))
def test_the_gate_lets_sane_mappings_pass(seed: int, random_homography: MakeHomography) -> None:
    matrix = random_homography(np.random.default_rng(seed), SIZE)
    assert judge_mapping(matrix, REGION) is Verdict.OK


def test_a_region_that_is_not_convex_is_refused() -> None:
    dented = np.array([[0, 0], [300, 0], [60, 60], [0, 200]], np.float32)
    assert judge_mapping(np.eye(3), dented) is Verdict.NOT_CONVEX


def test_a_refusal_has_nothing_but_its_reason() -> None:
    found = refused(Verdict.AREA, 5)
    assert found.verdict is Verdict.AREA
    assert found.b_from_a is None and found.model is None and np.isnan(found.rmse_px)
    assert found.is_inlier.tolist() == [False] * 5
    assert found.inliers == 0


# -- choice of the model ------------------------------------------------------------------------


@pytest.mark.parametrize("model", list(Model))
@pytest.mark.parametrize("outliers", [0.0, 0.4])
def test_auto_picks_the_model_that_made_the_data(model: Model, outliers: float) -> None:
    picked = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        a, b = some_pairs(rng, example_of(model, rng), 120, outliers, noise=0.2)
        picked.append(registered(a, b).model)
    assert picked.count(model) >= 11


@pytest.mark.parametrize("seed", range(20))
def test_auto_never_picks_a_model_that_misfits(seed: int, rng: np.random.Generator) -> None:
    """A freedom worth little is dropped only if what it is worth is less than the noise."""
    rng = np.random.default_rng(seed)
    gentle = rng.uniform(0, 1, 6) * [0.02, 0.02, 0.02, 0.02, 4e-5, 4e-5]
    truth = np.array(
        [[1 + gentle[0], gentle[1], 12], [gentle[2], 1 + gentle[3], -7], [*gentle[4:], 1]]
    )
    a, b = some_pairs(rng, truth, 150, noise=0.2)
    found = registered(a, b)
    assert found.verdict is Verdict.OK
    exact = geometry.transform_points(truth, a)
    assert found.b_from_a is not None
    ours = geometry.transform_points(found.b_from_a, a)
    assert np.sqrt(np.mean(np.sum((ours - exact) ** 2, axis=1))) < 0.2


@pytest.mark.parametrize("asked", list(Model))
@pytest.mark.parametrize("data", list(Model))
def test_the_model_asked_for_is_kept(asked: Model, data: Model, rng: np.random.Generator) -> None:
    a, b = some_pairs(rng, example_of(data, rng), 80, noise=0.2)
    found = registered(a, b, model=asked)
    if DEGREES_OF_FREEDOM[asked] >= DEGREES_OF_FREEDOM[data]:
        assert found.model is asked
    else:
        assert found.model in (asked, None)
    if found.b_from_a is not None and asked is not Model.HOMOGRAPHY:
        np.testing.assert_array_equal(found.b_from_a[2], [0, 0, 1])
    if found.b_from_a is not None and asked is Model.TRANSLATION:
        np.testing.assert_array_equal(found.b_from_a[:2, :2], np.eye(2))
    if found.b_from_a is not None and asked is Model.SIMILARITY:
        (p, q), (r, s) = found.b_from_a[:2, :2]
        assert p == pytest.approx(s) and q == pytest.approx(-r)


@pytest.mark.parametrize("model", [Model.TRANSLATION, Model.SIMILARITY, Model.AFFINE])
def test_the_model_asked_for_survives_outliers(model: Model) -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        truth = example_of(model, rng)
        a, b = some_pairs(rng, truth, 120, outliers=0.6, noise=0.3)
        assert corner_miss(registered(a, b, model=model).b_from_a, truth) < 1.0


# -- determinism and chance ---------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 1, 12345])
def test_the_same_seed_gives_the_same_result(
    seed: int, rng: np.random.Generator, random_homography: MakeHomography
) -> None:
    a, b = some_pairs(rng, random_homography(rng, SIZE), 100, 0.6, 0.5)
    first, second = (registered(a, b, seed=seed) for _ in range(2))
    assert first.b_from_a is not None
    np.testing.assert_array_equal(first.b_from_a, second.b_from_a)
    np.testing.assert_array_equal(first.is_inlier, second.is_inlier)


def test_inputs_are_left_as_they_are(rng: np.random.Generator) -> None:
    a, b = some_pairs(rng, np.eye(3), 50, 0.3, 0.3)
    copies = a.copy(), b.copy()
    registered(a, b)
    np.testing.assert_array_equal(a, copies[0])
    np.testing.assert_array_equal(b, copies[1])


def test_false_alarms_fall_with_inliers_and_rise_with_pairs_and_chance() -> None:
    by_inliers = [log10_false_alarms(50, k, 0.001) for k in range(6, 51)]
    assert by_inliers == sorted(by_inliers, reverse=True)
    by_pairs = [log10_false_alarms(n, 12, 0.001) for n in range(12, 400, 7)]
    assert by_pairs == sorted(by_pairs)
    by_chance = [log10_false_alarms(50, 12, p) for p in (1e-6, 1e-4, 1e-2, 0.1, 0.5)]
    assert by_chance == sorted(by_chance)


@pytest.mark.parametrize(("pairs", "inliers"), [(0, 0), (4, 4), (50, 4), (50, 0), (3, 3)])
def test_four_pairs_always_agree_and_prove_nothing(pairs: int, inliers: int) -> None:
    assert log10_false_alarms(pairs, inliers, 1e-6) >= 0
