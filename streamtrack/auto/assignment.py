"""Who is who: pairing of predicted things with found ones at the least total cost."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def assign(costs: npt.NDArray[np.float64]) -> list[tuple[int, int]]:
    """Pairs (row, column) of ``costs`` (N, M) with the least sum; infinite costs are never paired.

    As many pairs as can be, by shortest augmenting paths (Jonker & Volgenant 1987; the Hungarian
    method with dual variables), in O(N^2 M).
    """
    rows, columns = costs.shape
    if rows == 0 or columns == 0:
        return []
    if rows > columns:
        return sorted((row, column) for column, row in assign(costs.T))
    is_finite = np.isfinite(costs)
    if not is_finite.any():
        return []
    span = float(np.max(np.abs(costs[is_finite]))) + 1.0
    forbidden = span * (2 * rows + 1)
    padded = np.where(is_finite, costs, forbidden)
    row_of_column = _solved(padded)
    pairs = [(int(row), column) for column, row in enumerate(row_of_column) if row >= 0]
    return sorted(pair for pair in pairs if is_finite[pair])


def _solved(costs: npt.NDArray[np.float64]) -> npt.NDArray[np.intp]:
    """Row of each column (M,), -1 where it has none; every row of ``costs`` (N <= M) gets one."""
    rows, columns = costs.shape
    row_price, column_price = np.zeros(rows), np.zeros(columns + 1)
    owner = np.full(columns + 1, -1, np.intp)  # the last column stands for "none yet"
    for row in range(rows):
        owner[columns] = row
        at = columns
        least = np.full(columns, np.inf)
        came_from = np.full(columns, columns, np.intp)
        is_done = np.zeros(columns + 1, np.bool_)
        while owner[at] >= 0:
            is_done[at] = True
            reduced = costs[owner[at]] - row_price[owner[at]] - column_price[:columns]
            is_open = ~is_done[:columns]
            is_better = is_open & (reduced < least)
            least[is_better], came_from[is_better] = reduced[is_better], at
            nearest = int(np.argmin(np.where(is_open, least, np.inf)))
            step = least[nearest]
            row_price[owner[is_done]] += step
            column_price[is_done] -= step
            least[is_open] -= step
            at = nearest
        while at != columns:
            before = int(came_from[at])
            owner[at] = owner[before]
            at = before
    return owner[:columns]
