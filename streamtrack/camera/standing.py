"""Does a camera still see what it saw? Asked in every frame of one that stands, so it costs little.

One robust Gauss-Newton step of a similarity over the textured pixels of a small picture: exact
for the motion of less than a pixel that matters, and whatever it cannot explain is motion enough
to ask for a full alignment (`view_alignment.align`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.camera.view_levels import USUAL, Pixels, ReferenceView, ViewLevels
from streamtrack.types import Points

_LEVEL = 2
_MIN_PIXELS = 120
_MIN_TEXTURED_CELLS = 12
_OF_PIXELS = 2  # every second of those that a full alignment would take
_ROUNDS = 2
_STAYED_PX = 0.4
_STAYED_CORRELATION = 0.8
_UNLIKE = 0.75
"""Residuals of this share of the grey values themselves: the views have little in common."""


@dataclass(frozen=True, slots=True)
class Stand:
    """What a check found: how far the corner that moved most seems to be from where it was.

    ``moved_px`` is inf if the view is unlike the reference. ``pixels`` were compared.
    """

    moved_px: float
    pixels: int


class StandCheck:
    """Compares views with one reference view, in the same place or nearly so."""

    def __init__(self, levels: ViewLevels, hidden: Sequence[Points] = ()) -> None:
        """``hidden`` are quads (4, 2) in the view that do not belong to the scene."""
        self.reference = ReferenceView(levels, hidden)
        self._level = min(_LEVEL, len(levels.images) - 1)
        pixels = self.reference.pixels(self._level)
        x, y, _ = pixels.points[:, ::_OF_PIXELS]
        self._column, self._row = x.astype(np.intp), y.astype(np.intp)
        self._x, self._y, self._values = x, y, pixels.values[::_OF_PIXELS]
        j = pixels.jacobian[:, ::_OF_PIXELS]
        # Translation, zoom and turn, as in view_alignment.
        self._jacobian = np.stack([j[2], j[5], j[0] + j[4], j[3] - j[1]])
        self._unit = float(pixels.unit_from_level[0, 0])
        level_from_view = levels.level_from_view(self._level)
        corners = geometry.image_quad(levels.size_wh)
        self._corners = geometry.transform_points(pixels.unit_from_level @ level_from_view, corners)
        self._view_px = 1 / (self._unit * float(level_from_view[0, 0]))

    @property
    def is_possible(self) -> bool:
        """Whether the reference has texture enough to tell."""
        return (
            not self.reference.levels.is_flat()
            and self.reference.textured_cells >= _MIN_TEXTURED_CELLS
            and len(self._values) >= _MIN_PIXELS
        )

    def of(self, levels: ViewLevels, hidden: Sequence[Points] = ()) -> Stand:
        """How far the camera seems to have moved, by a view of the reference's size."""
        seen = levels.high_passed(self._level)[self._row, self._column]
        wanted, jacobian = self._values, self._jacobian
        if hidden:
            shown = self._shown(levels, hidden)
            seen, wanted, jacobian = seen[shown], wanted[shown], jacobian[:, shown]
        if len(seen) < _MIN_PIXELS:
            return Stand(float("inf"), len(seen))
        size_seen, size = _median_size(seen), _median_size(wanted)
        residual = seen * np.float32(min(3.0, max(0.33, (size + 0.2) / (size_seen + 0.2)))) - wanted
        if _median_size(residual) > _UNLIKE * size:
            return Stand(float("inf"), len(seen))
        change = _robust_step(jacobian, residual)
        return Stand(self._corner_shift_px(change), len(seen))

    def stayed_share(self, levels: ViewLevels) -> float:
        """Share of the textured cells that are where they were, to a fraction of a pixel.

        A second look, for views in which so much moves by itself (a road full of cars) that `of`
        follows that: each cell of the picture is asked by itself how far its pixels have moved,
        whatever light and shadow do to it.
        """
        pixels = self.reference.pixels(USUAL)
        column, row, _ = pixels.points.astype(np.intp)
        seen = levels.high_passed(USUAL)[row, column]
        shift_px = _cell_shifts(pixels, seen * _cell_gains(pixels, seen) - pixels.values)
        shift_px /= levels.level_from_view(USUAL)[0, 0]
        alike = _cell_correlations(pixels, seen) > _STAYED_CORRELATION
        stayed = np.count_nonzero(alike & (shift_px < _STAYED_PX))
        return float(stayed) / max(1, self.reference.textured_cells)

    def _shown(self, levels: ViewLevels, hidden: Sequence[Points]) -> npt.NDArray[np.bool_]:
        """Which pixels lie outside the boxes around the quads."""
        shown = np.ones(len(self._x), np.bool_)
        for quad in hidden:
            there = geometry.transform_points(levels.level_from_view(self._level), quad)
            x0, y0, x1, y1 = geometry.bounding_box(there)
            shown &= ~(
                (self._x >= x0 - 1)
                & (self._x <= x1 + 1)
                & (self._y >= y0 - 1)
                & (self._y <= y1 + 1)
            )
        return shown

    def _corner_shift_px(self, change: npt.NDArray[np.float64]) -> float:
        shift_x, shift_y, zoom, turn = change.tolist()
        x, y = self._corners.astype(np.float64).T
        moved = np.hypot(shift_x + zoom * x - turn * y, shift_y + zoom * y + turn * x)
        return float(moved.max()) * self._view_px


def _cell_shifts(pixels: Pixels, residual: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    """How far each cell's pixels seem to have moved (cells,), in level pixels.

    Least squares on the residuals (N,) of its pixels (Lucas & Kanade 1981); NaN without pixels.
    """
    unit = pixels.unit_from_level[0, 0]
    gx, gy = pixels.jacobian[2] * unit, pixels.jacobian[5] * unit
    xx, xy, yy, xr, yr = (
        np.bincount(pixels.cell, product)
        for product in (gx * gx, gx * gy, gy * gy, gx * residual, gy * residual)
    )
    damping = 1e-3 * (xx + yy)
    xx, yy = xx + damping, yy + damping
    with np.errstate(invalid="ignore"):
        determinant = xx * yy - xy * xy
        x, y = (yy * xr - xy * yr) / determinant, (xx * yr - xy * xr) / determinant
    return np.asarray(np.hypot(x, y), np.float64)


def _cell_gains(pixels: Pixels, seen: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """The factor (N,) by which the pixels seen (N,) fit those of their cell best, 0.5 to 2."""
    both, theirs = (np.bincount(pixels.cell, p) for p in (pixels.values * seen, seen * seen))
    gains = np.clip(both / np.maximum(theirs, 1e-6), 0.5, 2.0)
    return gains.astype(np.float32)[pixels.cell]


def _cell_correlations(pixels: Pixels, seen: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    """Correlation (cells,) of each cell's pixels with those seen (N,); NaN without pixels."""
    both, ours, theirs = (
        np.bincount(pixels.cell, product)
        for product in (pixels.values * seen, pixels.values**2, seen**2)
    )
    with np.errstate(invalid="ignore"):
        return np.asarray(both / np.sqrt(ours * theirs), np.float64)


def _robust_step(
    jacobian: npt.NDArray[np.float32], residual: npt.NDArray[np.float32]
) -> npt.NDArray[np.float64]:
    """The change (4,) that explains the residuals (N,) best, by Tukey's weights."""
    change = np.zeros(4)
    left = residual
    for _ in range(_ROUNDS):
        noise = 1.4826 * _median_size(left) + 0.3
        share = left / np.float32(4.685 * noise)
        weights = np.maximum(np.float32(0), 1 - share * share) ** 2
        weighted = jacobian * weights
        normal = (weighted @ jacobian.T).astype(np.float64) + 1e-3 * np.eye(4)
        change = np.linalg.solve(normal, (weighted @ residual).astype(np.float64))
        left = residual - change.astype(np.float32) @ jacobian
    return change


def _median_size(values: npt.NDArray[np.float32]) -> float:
    """Median of the absolute values, from every third of them."""
    sizes = np.abs(values[::3])
    sizes.partition(len(sizes) // 2)
    return float(sizes[len(sizes) // 2])
