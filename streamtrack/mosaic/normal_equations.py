"""Normal equations as sparse as the graph they come from, and their solution."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

Doubles: TypeAlias = npt.NDArray[np.float64]
Rows: TypeAlias = npt.NDArray[np.intp]

_DENSE_UNKNOWNS = 240


@dataclass(frozen=True, slots=True, eq=False)
class Normal:
    """A symmetric matrix of k x k blocks: (n, k, k) on its diagonal, (m, k, k) at (row, column).

    Blocks at the same place add up, and each stands transposed at (column, row) too.
    """

    diagonal: Doubles
    row: Rows
    column: Rows
    blocks: Doubles

    def solved(self, right: Doubles) -> Doubles:
        """Solution (n, k) or (n, k, m) of this matrix times it = ``right``, of the same shape."""
        count, k = right.shape[:2]
        every = np.arange(count)
        row = np.concatenate([every, self.row, self.column])
        column = np.concatenate([every, self.column, self.row])
        blocks = np.concatenate([self.diagonal, self.blocks, self.blocks.transpose(0, 2, 1)])
        flat = right.reshape(count * k, -1)
        if count * k <= _DENSE_UNKNOWNS:
            dense = np.zeros((count, count, k, k))
            np.add.at(dense, (row, column), blocks)
            square = dense.transpose(0, 2, 1, 3).reshape(count * k, count * k)
            return np.asarray(np.linalg.solve(square, flat), np.float64).reshape(right.shape)
        from scipy.sparse import coo_array
        from scipy.sparse.linalg import splu

        shape = blocks.shape
        inner = np.arange(k)
        rows = np.broadcast_to(row[:, None, None] * k + inner[:, None], shape).ravel()
        columns = np.broadcast_to(column[:, None, None] * k + inner, shape).ravel()
        square = coo_array((blocks.ravel(), (rows, columns)), shape=(count * k, count * k)).tocsc()
        factors = splu(square, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        return np.asarray(factors.solve(flat), np.float64).reshape(right.shape)
