"""Who is who: pairing of predicted things with found ones at the least total cost."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def assign(costs: npt.NDArray[np.float64]) -> list[tuple[int, int]]:
    """Pairs (row, column) of ``costs`` (N, M) with the least sum; infinite costs are never paired.

    As many pairs as can be, by `scipy.optimize.linear_sum_assignment`.
    """
    is_finite = np.isfinite(costs)
    if not is_finite.any():
        return []
    from scipy.optimize import linear_sum_assignment

    span = float(np.max(np.abs(costs[is_finite]))) + 1.0
    forbidden = span * (2 * min(costs.shape) + 1)
    rows, columns = linear_sum_assignment(np.where(is_finite, costs, forbidden))
    pairs = zip(rows.tolist(), columns.tolist(), strict=True)
    return [pair for pair in pairs if is_finite[pair]]
