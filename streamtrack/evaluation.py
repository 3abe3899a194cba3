"""Measures of tracking, registration and matching against truth: one definition each, cited.

A missing result (None, NaN) counts as infinite error and is never left out; a measure over
nothing at all is NaN. Per-frame arguments run in step: element i of each is frame i.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from streamtrack.errors import SourceError
from streamtrack.geometry import image_quad
from streamtrack.types import Matrix, Size

_Floats = npt.NDArray[np.float64]


def _errors(values: Iterable[float | None]) -> _Floats:
    """The errors (N,), with infinity where there is no result."""
    errors = np.array([np.inf if value is None else value for value in values], np.float64)
    return np.where(np.isnan(errors), np.inf, errors)


def _pi(b_from_a: Matrix, points: npt.ArrayLike) -> _Floats:
    """Map points (N, 2) in double precision; inf or NaN on the horizon."""
    pts = np.asarray(points, np.float64).reshape(-1, 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        mapped = np.hstack([pts, np.ones((len(pts), 1))]) @ np.asarray(b_from_a, np.float64).T
        result: _Floats = mapped[:, :2] / mapped[:, 2:]
    return result


def _distances(a: npt.ArrayLike, b: npt.ArrayLike) -> _Floats:
    """Euclidean distances (N,) of point pairs, infinite where a coordinate is not finite."""
    with np.errstate(invalid="ignore"):
        difference = np.asarray(a, np.float64) - np.asarray(b, np.float64)
    distances = np.hypot(*difference.reshape(-1, 2).T)
    return np.where(np.isfinite(distances), distances, np.inf)


def alignment_error(quad: npt.ArrayLike | None, true_quad: npt.ArrayLike) -> float:
    """RMS distance of the four corners, px; infinite if there is no quad.

    e_AL = sqrt(1/4 sum_i ||x_i - x*_i||^2): Liang et al., Planar Object Tracking in the Wild (POT),
    ICRA 2018; ``aerr`` in RunEvaluation.m of PlanarTrack.
    """
    if quad is None:
        return float("inf")
    return float(np.sqrt(np.mean(_distances(quad, true_quad) ** 2)))


def precision_at(errors: Iterable[float | None], threshold: float) -> float:
    """Share of errors <= threshold.

    POT's precision with alignment errors (headline 5 px), PlanarTrack's success with homography
    discrepancies (headline 30), HPatches' MHA with corner errors. Papers average it over sequences
    (PlanarTrack) or pool the frames (WOFTSAM): not the same number.
    """
    values = _errors(errors)
    return float(np.mean(values <= threshold)) if len(values) else float("nan")


def homography_discrepancy(b_from_a: Matrix | None, true_b_from_a: Matrix) -> float:
    """Mean distance by which T* T^-1 moves the points (+-1, +-1); infinite without estimate.

    S = 1/4 sum_i ||c_i - pi(T* T^-1 c_i)||, c_i = (+-1, +-1), T and T* mapping pixels of the first
    frame to pixels of this one: POT (ICRA 2018); ``heer`` in RunEvaluation.m of PlanarTrack. The
    four points lie around pixel (0, 0), by definition.
    """
    if b_from_a is None or not np.isfinite(b_from_a).all():
        return float("inf")
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])
    difference = np.asarray(true_b_from_a, np.float64) @ np.linalg.pinv(b_from_a)
    return float(np.mean(_distances(_pi(difference, corners), corners)))


def corner_error(b_from_a: Matrix | None, true_b_from_a: Matrix, size_wh: Size) -> float:
    """Mean distance in b, px, of the mapped corners of picture a; infinite without estimate.

    1/4 sum_i ||pi(H c_i) - pi(G c_i)||: DeTone et al., SuperPoint (2018), as used on HPatches by
    SuperGlue and LoFTR. Corners are the centres of the corner pixels of a, whose size is given.
    """
    if b_from_a is None:
        return float("inf")
    corners = image_quad(size_wh)
    return float(np.mean(_distances(_pi(b_from_a, corners), _pi(true_b_from_a, corners))))


def visible_error(
    b_from_a: Matrix | None, true_b_from_a: Matrix, a_wh: Size, b_wh: Size, *, grid: int = 40
) -> float:
    """Mean transfer error, px of b, over the pixels of a that b truly shows; infinite without.

    1/|V| sum_V ||pi(H x) - pi(G x)||, V = {x in a: pi(G x) in b}: the MAE of the visible part of
    Barath, Mishkin et al., "RANSAC in 2020" tutorial (CVPR 2020), on ``grid`` x ``grid`` pixels.
    NaN if nothing is visible. Unlike the corner error it asks for no extrapolation.
    """
    x, y = np.meshgrid(np.linspace(0, a_wh[0] - 1, grid), np.linspace(0, a_wh[1] - 1, grid))
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    true = _pi(true_b_from_a, points)
    with np.errstate(invalid="ignore"):
        is_visible = ((true >= 0) & (true <= np.array(b_wh) - 1)).all(axis=1)
    if not is_visible.any():
        return float("nan")
    if b_from_a is None:
        return float("inf")
    return float(np.mean(_distances(_pi(b_from_a, points[is_visible]), true[is_visible])))


def auc_at(errors: Iterable[float | None], threshold: float) -> float:
    """Area under the recall-error curve up to ``threshold``, over ``threshold``: 0..1.

    (1/t) integral_0^t recall(e) de by the trapezoid rule over the sorted errors, (0, 0) prepended:
    ``pose_auc`` of Sarlin et al., SuperGlue (CVPR 2020). Failed estimates are infinite errors.
    """
    values = np.sort(_errors(errors))
    if not len(values):
        return float("nan")
    recall = np.concatenate([[0.0], np.arange(1, len(values) + 1) / len(values)])
    edges = np.concatenate([[0.0], values])
    last = int(np.searchsorted(edges, threshold))
    heights = np.append(recall[:last], recall[last - 1])
    return float(np.trapezoid(heights, np.append(edges[:last], threshold)) / threshold)


def symmetric_transfer_rmse(
    b_from_a: Matrix | None, points_a: npt.ArrayLike, points_b: npt.ArrayLike
) -> float:
    """RMS over both directions of the transfer error of point pairs (N, 2), px.

    sqrt(1/(2N) sum(||pi(H x) - y||^2 + ||pi(H^-1 y) - x||^2)): Hartley and Zisserman, Multiple View
    Geometry, 4.2.2. Infinite without estimate or if it is singular.
    """
    if b_from_a is None:
        return float("inf")
    try:
        a_from_b: Matrix = np.linalg.inv(np.asarray(b_from_a, np.float64))
    except np.linalg.LinAlgError:
        return float("inf")
    forward = _distances(_pi(b_from_a, points_a), points_b)
    backward = _distances(_pi(a_from_b, points_b), points_a)
    squares = np.concatenate([forward, backward]) ** 2
    return float(np.sqrt(np.mean(squares))) if len(squares) else float("nan")


class InlierRmse(NamedTuple):
    """RMS transfer error of the inliers in b, with how many there are of how many pairs."""

    rmse_px: float
    inliers: int
    pairs: int


def inlier_rmse(
    b_from_a: Matrix | None, points_a: npt.ArrayLike, points_b: npt.ArrayLike, threshold_px: float
) -> InlierRmse:
    """One-way RMS transfer error of the pairs (N, 2) that agree to ``threshold_px``.

    sqrt(1/n sum_I ||pi(H x) - y||^2), I the pairs with error <= t. Bounded by t and falling with
    it: never print it without t, n and N. Infinite without estimate or inliers.
    """
    pairs = len(np.asarray(points_a, np.float64).reshape(-1, 2))
    if b_from_a is None:
        return InlierRmse(float("inf"), 0, pairs)
    distances = _distances(_pi(b_from_a, points_a), points_b)
    kept = distances[distances <= threshold_px]
    rmse_px = float(np.sqrt(np.mean(kept**2))) if len(kept) else float("inf")
    return InlierRmse(rmse_px, len(kept), pairs)


class RecallPrecision(NamedTuple):
    """Recall and precision of matches, and the counts behind them."""

    recall: float
    precision: float
    correct: int
    matches: int
    correspondences: int


def recall_precision(
    points_a: npt.ArrayLike,
    points_b: npt.ArrayLike,
    pairs: npt.ArrayLike,
    true_b_from_a: Matrix,
    threshold_px: float = 2.5,
) -> RecallPrecision:
    """Recall and precision of matches between keypoints of two pictures.

    recall = correct matches / correspondences; 1 - precision = false / all matches: Mikolajczyk and
    Schmid, PAMI 2005. For points, a match is correct if the true homography brings its point of a
    to within ``threshold_px`` of its point of b, and each point of a with any such point of b is
    one correspondence, matched or not. ``points_a`` (N, 2) and ``points_b`` (M, 2) are all
    keypoints, ``pairs`` (K, 2) rows of a and b, each row of a at most once.
    """
    mapped = _pi(true_b_from_a, points_a)
    found = np.asarray(points_b, np.float64).reshape(-1, 2)
    rows = np.asarray(pairs, np.intp).reshape(-1, 2)
    if len(np.unique(rows[:, 0])) != len(rows):
        raise ValueError("pairs must hold each row of a at most once")
    correct = int(np.sum(_distances(mapped[rows[:, 0]], found[rows[:, 1]]) <= threshold_px))
    correspondences = _count_correspondences(mapped, found, threshold_px)
    return RecallPrecision(
        correct / correspondences if correspondences else float("nan"),
        correct / len(rows) if len(rows) else float("nan"),
        correct,
        len(rows),
        correspondences,
    )


def _count_correspondences(mapped: _Floats, found: _Floats, threshold_px: float) -> int:
    """How many of the points (N, 2) have one of ``found`` (M, 2) within the threshold."""
    count = 0
    for start in range(0, len(mapped), 512):
        block = mapped[start : start + 512]
        block = block[np.isfinite(block).all(axis=1)]
        squares = np.sum((block[:, None] - found[None]) ** 2, axis=2)
        count += int(np.sum(np.any(squares <= threshold_px**2, axis=1)))
    return count


def jitter_px(quads: Sequence[npt.ArrayLike | None]) -> float:
    """RMS second difference of the corners, px: noise from frame to frame.

    sqrt(mean ||q[t+1] - 2 q[t] + q[t-1]||^2) over corners and over t whose three quads are all
    there. For a target at rest (or in even motion) only noise is left; white noise of standard
    deviation s a coordinate gives s sqrt(12).
    """
    squares = []
    for before, now, after in zip(quads, quads[1:], quads[2:], strict=False):
        if before is not None and now is not None and after is not None:
            ends = np.asarray(before, np.float64) + np.asarray(after, np.float64)
            squares.append(_distances(ends, 2 * np.asarray(now, np.float64)) ** 2)
    return float(np.sqrt(np.mean(squares))) if squares else float("nan")


def false_lock_share(
    is_tracking: Sequence[bool],
    visible_share: Sequence[float],
    errors: Iterable[float | None],
    *,
    min_visible: float = 0.05,
    max_error_px: float = 50.0,
) -> float:
    """Share of all frames in which a tracker claims a target that is not there.

    A claim is false if less than ``min_visible`` of the target lies in the picture, or the error
    exceeds ``max_error_px``. No public benchmark defines it; this one is ours.
    """
    claims = np.asarray(is_tracking, np.bool_)
    wrong = (np.asarray(visible_share) < min_visible) | (_errors(errors) > max_error_px)
    return float(np.mean(claims & wrong)) if len(claims) else float("nan")


def frames_to_reacquire(
    is_tracking: Sequence[bool],
    visible_share: Sequence[float],
    errors: Iterable[float | None],
    *,
    absent_below: float = 0.05,
    back_at: float = 0.5,
    max_error_px: float = 5.0,
) -> list[float]:
    """Frames that each return of the target took to be tracked again; ours, no benchmark's.

    A return begins with the first frame whose visible share is >= ``back_at`` after one below
    ``absent_below``, and is over in the first frame tracked with error <= ``max_error_px``: 0 if
    that is the same frame, infinite if the target goes absent again or the frames end before.
    """
    counts: list[float] = []
    is_absent, since = False, None
    frames = zip(is_tracking, visible_share, _errors(errors), strict=True)
    for index, (tracks, visible, error) in enumerate(frames):
        if visible < absent_below:
            if since is not None:
                counts.append(float("inf"))
            is_absent, since = True, None
        elif is_absent and visible >= back_at:
            is_absent, since = False, index
        if since is not None and tracks and error <= max_error_px:
            counts.append(float(index - since))
            since = None
    return counts if since is None else [*counts, float("inf")]


def read_pot_points(points_path: Path) -> _Floats:
    """Corners (T, 4, 2) px of every frame of a POT sequence, NaN where not annotated.

    Rows ``x1 y1 .. x4 y4``: top-left, top-right, bottom-right, bottom-left of the first frame;
    rows of zeros are not annotated. Raises SourceError.
    """
    rows = _read_numbers(points_path)
    if rows.shape[1] != 8:
        raise SourceError(f"{points_path}: 8 numbers a row expected, found {rows.shape[1]}")
    quads = rows.reshape(-1, 4, 2)
    quads[~rows.any(axis=1)] = np.nan
    return quads


def read_pot_ground_truth(
    points_path: Path, flag_path: Path
) -> tuple[npt.NDArray[np.intp], _Floats]:
    """The frames of a POT sequence to be scored: their indices (N,) and true quads (N, 4, 2) px.

    Scored are the frames that are annotated and have flag 0, without the first frame (index 0),
    in which the target is given: `read_pot_points` has its quad. Raises SourceError.
    """
    quads = read_pot_points(points_path)
    flags = _read_numbers(flag_path)
    if flags.shape != (len(quads), 1):
        raise SourceError(
            f"{flag_path}: one flag for each of the {len(quads)} rows of {points_path.name} "
            f"expected, found {flags.shape[0]} x {flags.shape[1]}"
        )
    is_scored = np.isfinite(quads).all(axis=(1, 2)) & (flags[:, 0] == 0)
    is_scored[:1] = False
    return np.flatnonzero(is_scored), quads[is_scored]


def _read_numbers(path: Path) -> _Floats:
    """The whitespace-separated numbers of a text file (rows, columns). Raises SourceError."""
    try:
        lines = [line.split() for line in path.read_text(encoding="ascii").splitlines()]
        rows = np.array([[float(cell) for cell in line] for line in lines if line])
    except (OSError, ValueError) as error:
        raise SourceError(f"cannot read ground truth {path}: {error}") from None
    if rows.ndim != 2:
        raise SourceError(f"cannot read ground truth {path}: the file is empty")
    return rows
