"""The median, without what `numpy.median` costs: its first call imports all of `numpy.ma`."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt


def median(values: npt.NDArray[Any]) -> float:
    """Median of numbers (M,), M > 0; NaN sorts as the largest."""
    upper = len(values) // 2
    lower = (len(values) - 1) // 2
    parted = np.partition(values, upper if lower == upper else (lower, upper))
    return (float(parted[lower]) + float(parted[upper])) / 2
