"""Brightness of the views of a mosaic: one factor a colour and view, by least squares.

After Brown and Lowe (IJCV 2007, section 6), in logarithms, where the fit is linear: the factors
g_a and g_b of two views that overlap should satisfy g_a + log a = g_b + log b, with a weak pull
towards 0 that stops them from wandering off together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.types import Image, Matrix

THUMB_SIDE = 48
PULL = 0.02
_MOST = float(np.log(2.0))
_MIN_PIXELS = 40
_LOG = np.log(np.maximum(np.arange(256), 1)).astype(np.float32)
LogGain: TypeAlias = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class GainEdge:
    """Views ``a`` and ``b`` overlap: log_ratio (3,) is log b - log a there, weight in 0..1."""

    a: int
    b: int
    log_ratio: LogGain
    weight: float


def ratio(thumb_a: Image, thumb_b: Image, a_from_b: Matrix) -> tuple[LogGain, float] | None:
    """Median of log b - log a (3,) over the overlap and its weight; None if it is too small.

    The median keeps moving objects out of it, saturated and black pixels are left out.
    ``a_from_b`` maps pixels of the thumbnails.
    """
    size = thumb_a.shape[1], thumb_a.shape[0]
    there = cv2.warpPerspective(thumb_b, a_from_b, size, flags=cv2.INTER_LINEAR)
    pair = np.concatenate([thumb_a.reshape(-1, 4), there.reshape(-1, 4)], axis=1)
    weight = np.minimum(pair[:, 3], pair[:, 7])
    colours = pair[:, (0, 1, 2, 4, 5, 6)]
    fit = (weight > 8) & (colours.min(axis=1) > 6) & (colours.max(axis=1) < 250)
    count = int(np.count_nonzero(fit))
    if count < _MIN_PIXELS:
        return None
    logs = _LOG[colours[fit]]
    ratios = np.partition(logs[:, 3:] - logs[:, :3], count // 2, axis=0)
    return ratios[count // 2].astype(np.float64), min(1.0, count / (0.5 * weight.size))


def thumb_matrix(thumb: Image, size_wh: tuple[int, int]) -> Matrix:
    """Maps pixels of a frame to those of its thumbnail."""
    return geometry.scaling(thumb.shape[1] / size_wh[0], thumb.shape[0] / size_wh[1])


def running_gain(neighbours: Sequence[tuple[LogGain, LogGain, float]]) -> LogGain:
    """The log gain (3,) of a new view from (log gain, log ratio, weight) of its neighbours."""
    total, weights = np.zeros(3), PULL
    for gain, log_ratio, weight in neighbours:
        total += weight * (gain + log_ratio)
        weights += weight
    return np.asarray(np.clip(total / weights, -_MOST, _MOST))


def solve_gains(count: int, edges: Sequence[GainEdge], rounds: int = 200) -> LogGain:
    """Log gains (count, 3) that fit all edges best; conjugate gradients on the normal equations."""
    gains = np.zeros((count, 3))
    if not edges:
        return gains
    a = np.array([edge.a for edge in edges])
    b = np.array([edge.b for edge in edges])
    weight = np.array([edge.weight for edge in edges])[:, None]
    ratios = np.array([edge.log_ratio for edge in edges])

    def spread(flow: LogGain) -> LogGain:
        total = np.zeros((count, 3))
        np.add.at(total, a, flow)
        np.add.at(total, b, -flow)
        return total

    def normal(values: LogGain) -> LogGain:
        return spread(weight * (values[a] - values[b])) + PULL * values

    residual = spread(weight * ratios)
    direction = residual.copy()
    energy = np.sum(residual**2, axis=0)
    for _ in range(min(rounds, 4 * count)):
        if np.max(energy) < 1e-12:
            break
        pushed = normal(direction)
        step = energy / np.maximum(np.sum(direction * pushed, axis=0), 1e-30)
        gains += step * direction
        residual -= step * pushed
        before, energy = energy, np.sum(residual**2, axis=0)
        direction = residual + energy / np.maximum(before, 1e-30) * direction
    return np.asarray(np.clip(gains, -_MOST, _MOST))
