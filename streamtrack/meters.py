"""Running figures in bounded memory: means, quantiles, and what the process itself needs."""

from __future__ import annotations

import math
import resource
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

_BIN = math.log(1.01)
_MIN_MS, _MAX_MS = 1e-3, 1e8


class LogHistogram:
    """Quantiles of positive numbers in bounded memory: bins 1 % wide from 1e-3 to 1e8."""

    def __init__(self) -> None:
        self._bins: Counter[int] = Counter()
        self._min, self._max = math.inf, -math.inf

    def add(self, value: float) -> None:
        """Count one value; NaN is left out, values out of range count as the nearest in it."""
        if math.isnan(value):
            return
        value = min(max(value, _MIN_MS), _MAX_MS)
        self._min, self._max = min(self._min, value), max(self._max, value)
        self._bins[math.floor(math.log(value) / _BIN)] += 1

    def quantile(self, share: float) -> float | None:
        """Smallest value that ``share`` (0..1) of all do not exceed, to 0.5 %; None if empty."""
        index = nearest_rank(self._bins, share)
        if index is None:
            return None
        return min(max(math.exp((index + 0.5) * _BIN), self._min), self._max)


def nearest_rank(counts: Counter[int], share: float) -> int | None:
    """Smallest key that ``share`` (0..1) of all counted do not exceed; None if empty."""
    rank, seen = math.ceil(share * counts.total()), 0
    for value in sorted(counts):
        seen += counts[value]
        if seen >= rank:
            return value
    return None


@dataclass(slots=True)
class Mean:
    """Running mean of the finite values; None over nothing."""

    total: float = 0.0
    count: int = 0

    def add(self, value: float) -> None:
        """Take in one value; NaN and infinities are left out."""
        if math.isfinite(value):
            self.total += value
            self.count += 1

    @property
    def value(self) -> float | None:
        """The mean so far."""
        return self.total / self.count if self.count else None


def peak_rss_mb() -> float:
    """Largest resident memory of this process so far, in MB (1e6 bytes).

    On Linux from VmHWM: ru_maxrss also counts the parent that the process was forked from.
    """
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
        return int(status.partition("VmHWM:")[2].split()[0]) * 1024 / 1e6
    except (OSError, IndexError, ValueError):
        unit = 1 if sys.platform == "darwin" else 1024
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


class StageClock:
    """Wall milliseconds that one frame's stages took; ``total_ms`` runs from when it was made."""

    def __init__(self) -> None:
        self._began = time.perf_counter()
        self.stage_ms: dict[str, float] = {}

    @property
    def total_ms(self) -> float:
        return (time.perf_counter() - self._began) * 1e3

    def add(self, stage: str, spent_ms: float) -> None:
        """Count time to a stage, on top of what it took so far."""
        self.stage_ms[stage] = self.stage_ms.get(stage, 0.0) + spent_ms

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Count what happens inside to a stage."""
        began = time.perf_counter()
        yield
        self.add(stage, (time.perf_counter() - began) * 1e3)
