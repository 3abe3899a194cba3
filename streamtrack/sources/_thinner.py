"""Leaving out pictures of a stream that has more of them than are wanted."""

from __future__ import annotations


class Thinner:
    """Chooses pictures so that no more than ``max_fps`` a second are left, evenly in time."""

    def __init__(self, max_fps: float | None) -> None:
        self._period_s = 1.0 / max_fps if max_fps else 0.0
        self._due_s: float | None = None
        self._last_s = 0.0

    def takes(self, time_s: float) -> bool:
        """True if the picture of this time is one to keep."""
        if not self._period_s:
            return True
        if self._due_s is None or time_s < self._last_s:
            self._due_s = time_s  # The first, or the clock began anew.
        self._last_s = time_s
        # A quarter of slack: times jitter, and a rate just above the asked one is not halved.
        if time_s < self._due_s - 0.25 * self._period_s:
            return False
        self._due_s = max(self._due_s, time_s - self._period_s) + self._period_s
        return True
