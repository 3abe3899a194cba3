"""Measures against values worked out by hand, and the reader of POT's ground truth."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from streamtrack import evaluation
from streamtrack.errors import SourceError
from streamtrack.geometry import box_quad, translation

INF = float("inf")
NAN = float("nan")
SQUARE = box_quad(10, 20, 100, 50)
EYE = np.eye(3)


def test_alignment_error_is_the_rms_over_corners() -> None:
    moved = SQUARE.copy()
    moved[2] += (6, 8)
    assert evaluation.alignment_error(SQUARE, SQUARE) == 0
    assert evaluation.alignment_error(np.add(SQUARE, (3, 4)), SQUARE) == pytest.approx(5)
    assert evaluation.alignment_error(moved, SQUARE) == pytest.approx(5)  # sqrt(100 / 4)


@pytest.mark.parametrize("quad", [None, np.full((4, 2), NAN), np.full((4, 2), INF)])
def test_a_missing_quad_is_infinitely_wrong(quad: np.ndarray | None) -> None:
    assert evaluation.alignment_error(quad, SQUARE) == INF


@pytest.mark.parametrize(
    ("errors", "share"),
    [([1, 5, 5.01, 9], 0.5), ([None, NAN, INF, 0], 0.25), ([None], 0.0), ([0.0], 1.0)],
)
def test_precision_counts_errors_up_to_the_threshold(
    errors: list[float | None], share: float
) -> None:
    assert evaluation.precision_at(errors, 5) == share


def test_measures_over_nothing_are_nan() -> None:
    assert math.isnan(evaluation.precision_at([], 5))
    assert math.isnan(evaluation.auc_at([], 5))
    assert math.isnan(evaluation.jitter_px([SQUARE, None, SQUARE]))
    assert math.isnan(evaluation.false_lock_share([], [], []))
    assert evaluation.frames_to_reacquire([], [], []) == []


def test_homography_discrepancy_is_a_mean_of_distances_around_the_origin() -> None:
    assert evaluation.homography_discrepancy(EYE, EYE) == pytest.approx(0)
    assert evaluation.homography_discrepancy(EYE, translation(3, 4)) == pytest.approx(5)
    doubled = np.diag([2.0, 2.0, 1.0])
    assert evaluation.homography_discrepancy(EYE, doubled) == pytest.approx(math.sqrt(2))
    assert evaluation.homography_discrepancy(7 * EYE, EYE) == pytest.approx(0)
    assert evaluation.homography_discrepancy(None, EYE) == INF
    assert evaluation.homography_discrepancy(np.full((3, 3), NAN), EYE) == INF


def test_corner_error_is_a_mean_of_distances_at_the_corner_pixels() -> None:
    assert evaluation.corner_error(translation(3, 4), EYE, (640, 480)) == pytest.approx(5)
    wider = np.diag([2.0, 1.0, 1.0])
    assert evaluation.corner_error(wider, EYE, (101, 51)) == pytest.approx(50)  # 0, 100, 100, 0
    assert evaluation.corner_error(None, EYE, (640, 480)) == INF
    horizon = np.array([[1.0, 0, 0], [0, 1, 0], [-1 / 100, 0, 1]])
    assert evaluation.corner_error(horizon, EYE, (101, 51)) == INF


@pytest.mark.parametrize(
    ("errors", "threshold", "area"),
    [
        ([0.0, 0.0], 5, 1.0),
        ([INF, None], 5, 0.0),
        ([2.0], 4, (0.5 * 2 * 1 + 2 * 1) / 4),  # up to 1 at 2, then flat
        ([1.0, 3.0], 4, (0.25 + 0.75 * 2 + 1.0) / 4),
        ([3.0, INF, 1.0, NAN], 4, (0.125 + 0.375 * 2 + 0.5) / 4),
    ],
)
def test_auc_is_the_trapezoid_of_superglue(
    errors: list[float | None], threshold: float, area: float
) -> None:
    assert evaluation.auc_at(errors, threshold) == pytest.approx(area)


def test_symmetric_transfer_weighs_both_directions() -> None:
    a = np.array([[0.0, 0.0], [10.0, 0.0]])
    doubled = np.diag([2.0, 2.0, 1.0])
    assert evaluation.symmetric_transfer_rmse(doubled, a, 2 * a) == pytest.approx(0)
    b = 2 * a + (0, 2)  # 2 px in b, 1 px in a
    assert evaluation.symmetric_transfer_rmse(doubled, a, b) == pytest.approx(math.sqrt(2.5))
    assert evaluation.symmetric_transfer_rmse(None, a, b) == INF
    assert evaluation.symmetric_transfer_rmse(np.zeros((3, 3)), a, b) == INF


def test_inlier_rmse_tells_how_many_it_rests_on() -> None:
    a = np.array([[0.0, 0.0], [10.0, 0.0], [5.0, 5.0], [7.0, 7.0]])
    b = a + np.array([[0.0, 1.0], [0.0, 2.0], [0.0, 30.0], [NAN, 0.0]])
    rmse_px, inliers, pairs = evaluation.inlier_rmse(EYE, a, b, 3)
    assert rmse_px == pytest.approx(math.sqrt(2.5))
    assert (inliers, pairs) == (2, 4)
    assert evaluation.inlier_rmse(EYE, a, a + 100, 3) == (INF, 0, 4)
    assert evaluation.inlier_rmse(None, a, b, 3) == (INF, 0, 4)


def test_recall_counts_correspondences_that_were_never_matched() -> None:
    a = np.array([[0, 0], [100, 0], [200, 0], [300, 0], [400, 0]], np.float32)
    b = np.array([[10, 1], [110, 2], [210, 0], [310, 9], [10, 0]], np.float32)
    pairs = [(0, 0), (3, 3), (1, 2)]
    result = evaluation.recall_precision(a, b, pairs, translation(10, 0))
    assert result.correspondences == 3  # points 0, 1, 2 of a; 0 has two partners, counted once
    assert (result.correct, result.matches) == (1, 3)
    assert result.recall == pytest.approx(1 / 3)
    assert result.precision == pytest.approx(1 / 3)


def test_recall_without_matches_or_correspondences() -> None:
    a = np.zeros((1, 2))
    unmatched = evaluation.recall_precision(a, a, np.zeros((0, 2)), EYE)
    assert unmatched.recall == 0
    assert math.isnan(unmatched.precision)
    apart = evaluation.recall_precision(a, a + 50, [(0, 0)], EYE)
    assert math.isnan(apart.recall)
    assert apart.precision == 0
    with pytest.raises(ValueError, match="at most once"):
        evaluation.recall_precision(a, a, [(0, 0), (0, 0)], EYE)


def test_perfect_matching_of_many_points_has_recall_1() -> None:
    points = np.random.default_rng(3).uniform(0, 1000, (1500, 2))
    pairs = np.stack([np.arange(1500)] * 2, axis=1)
    result = evaluation.recall_precision(points, np.add(points, (5, 7)), pairs, translation(5, 7))
    assert result == (1.0, 1.0, 1500, 1500, 1500)


def test_jitter_ignores_even_motion_and_gaps() -> None:
    even = [np.add(SQUARE, (3 * t, -t)) for t in range(6)]
    assert evaluation.jitter_px(even) == pytest.approx(0, abs=1e-4)
    step = [SQUARE, SQUARE, np.add(SQUARE, (3, 4))]
    assert evaluation.jitter_px(step) == pytest.approx(5)
    assert evaluation.jitter_px([*step, None, SQUARE]) == pytest.approx(5)


def test_jitter_of_white_noise() -> None:
    rng = np.random.default_rng(5)
    quads = [SQUARE + rng.normal(0, 0.5, (4, 2)) for _ in range(4000)]
    assert evaluation.jitter_px(quads) == pytest.approx(0.5 * math.sqrt(12), rel=0.05)


def test_false_locks_are_claims_without_target_or_far_from_it() -> None:
    tracks = [True, True, True, False, True]
    visible = [1.0, 0.0, 1.0, 0.0, 0.04]
    errors = [3.0, None, 80.0, None, 0.5]
    assert evaluation.false_lock_share(tracks, visible, errors) == pytest.approx(3 / 5)
    assert evaluation.false_lock_share([True], [0.3], [20.0]) == 0
    assert evaluation.false_lock_share([True], [1.0], [None]) == 1


@pytest.mark.parametrize(
    ("visible", "errors", "counts"),
    [
        ([1, 0, 1, 1, 1], [0, None, None, None, 2], [2.0]),
        ([1, 0, 1, 1], [0, None, 1, 1], [0.0]),
        ([1, 0, 0.3, 0.5, 1], [0, None, 1, None, 1], [1.0]),  # not back before half is visible
        ([1, 0, 1, 0, 1], [0, None, 9, None, 1], [INF, 0.0]),
        ([1, 0, 1, 1], [0, None, 9, 9], [INF]),
        ([1, 0.2, 1, 1], [0, None, None, 1], []),  # never absent
        ([1, 0, 0], [0, None, None], []),  # never back
    ],
)
def test_frames_to_reacquire(
    visible: list[float], errors: list[float | None], counts: list[float]
) -> None:
    tracks = [error is not None for error in errors]
    assert evaluation.frames_to_reacquire(tracks, visible, errors) == counts


def test_a_lock_that_the_tracker_does_not_claim_does_not_count() -> None:
    assert evaluation.frames_to_reacquire([True, False, False, True], [1, 0, 1, 1], [0] * 4) == [1]


def _write_pot(folder: Path, rows: list[str], flags: list[str]) -> tuple[Path, Path]:
    points, flag = folder / "V01_1_gt_points.txt", folder / "V01_1_flag.txt"
    points.write_text("\n".join(rows) + "\n")
    flag.write_bytes("\r\n".join(flags).encode())
    return points, flag


ROW = "1.0 2.0 11.0 2.0 11.0 8.0 1.0 8.0 "
EMPTY = "0.0 " * 8


def test_pot_ground_truth_drops_what_is_not_scored(tmp_path: Path) -> None:
    rows = [ROW, ROW, EMPTY, ROW.replace("11.0", "12.0"), ROW]
    points, flag = _write_pot(tmp_path, rows, ["0", "0", "0", "0", "2"])
    indices, quads = evaluation.read_pot_ground_truth(points, flag)
    assert indices.tolist() == [1, 3]
    assert quads[0].tolist() == [[1, 2], [11, 2], [11, 8], [1, 8]]
    assert quads[1, 1].tolist() == [12, 2]
    everything = evaluation.read_pot_points(points)
    assert everything.shape == (5, 4, 2)
    assert np.isnan(everything[2]).all()


@pytest.mark.parametrize(
    ("rows", "flags", "message"),
    [
        ([ROW, ROW], ["0"], "one flag for each of the 2 rows"),
        (["1 2 3"], ["0"], "8 numbers a row"),
        (["1 2 x 4 5 6 7 8"], ["0"], "cannot read ground truth"),
        ([ROW, "1 2"], ["0", "0"], "cannot read ground truth"),
        ([""], ["0"], "empty"),
    ],
)
def test_bad_pot_files_are_named(
    tmp_path: Path, rows: list[str], flags: list[str], message: str
) -> None:
    points, flag = _write_pot(tmp_path, rows, flags)
    with pytest.raises(SourceError, match=message):
        evaluation.read_pot_ground_truth(points, flag)


def test_a_missing_pot_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"gone\.txt"):
        evaluation.read_pot_points(tmp_path / "gone.txt")
