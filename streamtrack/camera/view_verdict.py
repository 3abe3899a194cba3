"""The verdict on an alignment of two views: cell by cell, do the pictures agree with it?

A cell agrees if its own pixels correlate and would not rather lie elsewhere. These cells are the
point pairs on which the verdict rests.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import log
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.camera.view_levels import USUAL, Floats, Pixels, ReferenceView, ViewLevels
from streamtrack.registration import judge_mapping
from streamtrack.types import Mask, Matrix, Points, Size, Verdict
from streamtrack.uncertainty import motion_rows

Doubles: TypeAlias = npt.NDArray[np.float64]

_MIN_CELL_PIXELS = 6
_MIN_CELLS = 6
_MIN_AGREEING_SHARE = 0.3
_MIN_SPREAD_SHARE = 0.08
_MIN_CELL_CORRELATION = 0.5
_MIN_CORRELATION = 0.6
_MAX_CELL_SHIFT_PX = 0.75  # pixels of the usual level
_MAX_CORNER_SIGMA_PX = 2.0
_CORRELATED = 3.0  # neighbouring pixels do not err independently: factor on predicted errors


@dataclass(frozen=True, slots=True, eq=False)
class ViewAlignment:
    """How another view maps into a reference view, with its evidence and its verdict.

    reference_from_view  None unless the verdict is OK
    reference_points     float32 (M, 2), middles of the reference's cells that both views show
    view_points          float32 (M, 2), where the alignment takes them in the other view
    is_inlier            bool (M,), the cell agrees
    rmse_px              of the shifts that agreeing cells would still like to make, view pixels
    correlation          normalised cross-correlation of the agreeing cells' pixels, or NaN
    corner_sigma_px      predicted error of the view's corners, reference pixels, or inf
    gradients            (M, 5) sums over each cell's pixels, of the reference's gradients xx, xy
                         and yy a reference pixel, and of their products with what differs
    sharpness            gradient energy of the view against the reference's: below 1 if blurred
    """

    verdict: Verdict
    reference_from_view: Matrix | None
    reference_points: Points
    view_points: Points
    is_inlier: Mask
    rmse_px: float = float("nan")
    correlation: float = float("nan")
    corner_sigma_px: float = float("inf")
    sharpness: float = float("nan")
    gradients: Doubles = field(default_factory=lambda: np.zeros((0, 5)))

    @property
    def inliers(self) -> int:
        return int(np.count_nonzero(self.is_inlier))

    def refused(self, verdict: Verdict) -> ViewAlignment:
        """The same, with a reason why it is not believed."""
        return replace(self, verdict=verdict, reference_from_view=None)

    @property
    def support(self) -> float:
        """What the agreeing cells tell of each other in both views: nats a pixel, over the cells.

        Mutual information of Gaussian values (Cover & Thomas 2006, section 8.5): a mapping that
        lies between two motions agrees with many cells, and exactly with few.
        """
        unlike = max(1 - self.correlation**2, 1e-3)
        return -0.5 * self.inliers * log(unlike) if self.inliers else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """A fit at one level: the mapping, and the pixels (N,) it rests on."""

    view_from_reference: Matrix
    level: int
    pixels: Pixels
    seen: Floats
    residual: Floats
    basis: Doubles
    normal: Doubles
    is_settled: bool


def refusal(verdict: Verdict) -> ViewAlignment:
    """An alignment that says why there is none."""
    none = np.zeros((0, 2), np.float32)
    return ViewAlignment(verdict, None, none, none, np.zeros(0, np.bool_))


def judged(reference: ReferenceView, view: ViewLevels, fitted: Fitted) -> ViewAlignment:
    """The alignment with its cells' evidence, refused with the first reason that applies."""
    usual_px = view.images[fitted.level].shape[1] / view.images[USUAL].shape[1]
    cells = _cells(fitted, _MAX_CELL_SHIFT_PX * usual_px)
    reference_from_level = geometry.inverted(reference.levels.level_from_view(fitted.level))
    reference_points = geometry.transform_points(reference_from_level, cells.middles)
    view_points = geometry.transform_points(fitted.view_from_reference, reference_points)
    scale = 1 / float(reference_from_level[0, 0])
    view_px = view.size_wh[0] / view.images[fitted.level].shape[1]
    agreeing = cells.is_agreeing
    shifts = cells.shifts_px[agreeing]
    rmse_px = float(np.sqrt(np.mean(shifts**2))) * view_px if len(shifts) else float("nan")
    verdict = _support_verdict(cells, view_points, view.size_wh)
    reference_from_view, sigma_px = None, float("inf")
    if verdict is Verdict.OK:
        verdict, reference_from_view, sigma_px = _placed(reference, view, fitted)
    return ViewAlignment(
        verdict,
        reference_from_view,
        reference_points,
        view_points,
        agreeing,
        rmse_px,
        cells.correlation,
        sigma_px,
        cells.sharpness,
        cells.gradients * [scale**2, scale**2, scale**2, scale, scale],
    )


def _placed(
    reference: ReferenceView, view: ViewLevels, fitted: Fitted
) -> tuple[Verdict, Matrix | None, float]:
    """The verdict on the mapping, reference_from_view if it is OK, and the corners' sigma."""
    try:
        reference_from_view = geometry.inverted(fitted.view_from_reference)
    except np.linalg.LinAlgError:
        return Verdict.MIRRORED, None, float("inf")
    sigma_px = _corner_sigma_px(reference, fitted, reference_from_view, view.size_wh)
    verdict = judge_mapping(reference_from_view, geometry.image_quad(view.size_wh))
    is_certain = fitted.is_settled and sigma_px <= _MAX_CORNER_SIGMA_PX
    if verdict is Verdict.OK and not is_certain:
        verdict = Verdict.UNCERTAIN
    return verdict, reference_from_view if verdict is Verdict.OK else None, sigma_px


@dataclass(frozen=True, slots=True, eq=False)
class _Cells:
    """Evidence of the cells (M,) that both views show."""

    middles: Doubles
    shifts_px: Doubles
    is_agreeing: Mask
    correlation: float
    sharpness: float
    gradients: Doubles


def _cells(fitted: Fitted, max_shift_px: float) -> _Cells:
    pixels = fitted.pixels
    starts = np.flatnonzero(np.diff(pixels.cell, prepend=-1))
    wanted, got = pixels.values, fitted.seen
    unit = np.float32(pixels.unit_from_level[0, 0])
    gx, gy = pixels.jacobian[2] * unit, pixels.jacobian[5] * unit
    r = fitted.residual
    x, y, one = pixels.points
    terms = np.empty((13, len(wanted)), np.float32)
    terms[:5] = one, x, y, wanted, got
    pairs = (
        (wanted, wanted),
        (got, got),
        (wanted, got),
        (gx, gx),
        (gy, gy),
        (gx, gy),
        (gx, r),
        (gy, r),
    )
    for row, (left, right) in enumerate(pairs, start=5):
        np.multiply(left, right, out=terms[row])
    sums = np.add.reduceat(terms, starts, axis=1).astype(np.float64)
    n, sum_x, sum_y, w, g, ww, gg, wg, xx, yy, xy, rx, ry = sums
    covariance = wg / n - w * g / n**2
    variances = np.maximum(ww / n - (w / n) ** 2, 0) * np.maximum(gg / n - (g / n) ** 2, 0)
    correlation = covariance / np.sqrt(variances + 1e-6)
    # Shift that would suit the cell's own pixels best, held small where texture says nothing.
    xx, yy = xx + n, yy + n
    shift = np.hypot(yy * rx - xy * ry, xx * ry - xy * rx) / (xx * yy - xy * xy)
    gradients = np.stack([xx, xy, yy, rx, ry], axis=1)
    shown = n >= _MIN_CELL_PIXELS
    agreeing = shown & (correlation >= _MIN_CELL_CORRELATION) & (shift <= max_shift_px)
    middles = np.stack([sum_x / n, sum_y / n], axis=1)
    together, ratio = float("nan"), float("nan")
    if agreeing.any():
        count, w, g, ww, gg, wg = sums[[0, 3, 4, 5, 6, 7]][:, agreeing].sum(axis=1)
        variance_w, variance_g = ww / count - (w / count) ** 2, gg / count - (g / count) ** 2
        together = float((wg / count - w * g / count**2) / np.sqrt(variance_w * variance_g + 1e-9))
        ratio = float(np.sqrt(variance_g / max(float(variance_w), 1e-9)))
    return _Cells(middles[shown], shift[shown], agreeing[shown], together, ratio, gradients[shown])


def _support_verdict(cells: _Cells, view_points: Points, size_wh: Size) -> Verdict:
    """Do enough of the cells agree, in enough of the view? ``view_points`` (M, 2): their places."""
    shown, agreeing = len(cells.is_agreeing), int(np.count_nonzero(cells.is_agreeing))
    if shown < _MIN_CELLS:
        return Verdict.TOO_FEW_FEATURES
    if agreeing < max(_MIN_CELLS, _MIN_AGREEING_SHARE * shown):
        return Verdict.TOO_FEW_INLIERS
    hull = cv2.convexHull(view_points[cells.is_agreeing])
    share = float(cv2.contourArea(hull)) / (size_wh[0] * size_wh[1])
    if share < _MIN_SPREAD_SHARE:
        return Verdict.NOT_SPREAD
    if not cells.correlation >= _MIN_CORRELATION:
        return Verdict.LOW_CORRELATION
    return Verdict.OK


def _corner_sigma_px(
    reference: ReferenceView, fitted: Fitted, reference_from_view: Matrix, size_wh: Size
) -> float:
    """Predicted standard deviation of the view's worst corner, in reference pixels."""
    corners = geometry.transform_points(reference_from_view, geometry.image_quad(size_wh))
    to_unit = fitted.pixels.unit_from_level @ reference.levels.level_from_view(fitted.level)
    unit = geometry.transform_points(to_unit, corners).astype(np.float64)
    if not np.isfinite(unit).all():
        return float("inf")
    rows = motion_rows(unit) @ fitted.basis
    try:
        variances = np.sum(rows @ np.linalg.inv(fitted.normal) * rows, axis=1)
    except np.linalg.LinAlgError:
        return float("inf")
    worst = float(np.sqrt(max(float(variances.reshape(4, 2).sum(axis=1).max()), 0.0)))
    return float(_CORRELATED * worst / to_unit[0, 0])
