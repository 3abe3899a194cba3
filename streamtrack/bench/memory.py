"""How far the process grows while something runs."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from streamtrack.meters import peak_rss_mb


@dataclass(slots=True)
class Growth:
    """Most resident memory during a stretch above that at its start, MB; None if not known."""

    mb: float | None = None


class PeakMemory:
    """The process's peak, and that of stretches of its run (Linux alone tells the latter)."""

    def __init__(self) -> None:
        self._highest_mb = peak_rss_mb()

    @property
    def process_mb(self) -> float:
        """Most resident memory of the process so far, MB (1e6 bytes)."""
        self._highest_mb = max(self._highest_mb, peak_rss_mb())
        return self._highest_mb

    @contextmanager
    def growth(self) -> Iterator[Growth]:
        """Measures the stretch of the ``with``; the value is there when it is over."""
        self._highest_mb = self.process_mb
        growth = Growth()
        before_mb = _restart_peak()
        yield growth
        if before_mb is not None:
            growth.mb = max(peak_rss_mb() - before_mb, 0.0)


def _restart_peak() -> float | None:
    """Let the kernel's peak begin anew at what is resident now, and tell it; None if it cannot.

    Free heap is given back first, else it would take in what comes without growth.
    """
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return None
    return peak_rss_mb()
