"""When a picture of a network stream was captured, told from when it arrived."""

from __future__ import annotations

import math

_FIRST_WINDOW_S = 2.0
_LONGEST_WINDOW_S = 60.0
_JUMP_S = 30.0
_TOLERANCE_S = 0.5


class ArrivalClock:
    """Maps a stream's own times to `time.monotonic`, free of the jitter of the way.

    A picture arrives at ``time + way``, and the way takes at least as long as it ever took: the
    smallest difference between arrival and stream time belongs to the pictures that were not held
    up, and what any other is above it is its delay. So a burst after a pause is not taken for new
    pictures. The least is taken over the last one to two minutes, as clocks drift apart (100 ppm
    is 6 ms a minute), and over less at first, as the first stamps of a stream are often wrong. A
    constant delay on the way, and in the camera, cannot be seen.
    """

    def __init__(self) -> None:
        self._window_s = _FIRST_WINDOW_S
        self._window_began_s = self._last_time_s = -math.inf
        self._least_s = self._least_before_s = math.inf

    def captured_s(self, time_s: float, arrived_s: float) -> float:
        """Moment of capture on the clock of ``arrived_s``, not later than it."""
        difference_s = arrived_s - time_s
        least_s = min(self._least_s, self._least_before_s)
        has_gone_back = time_s < self._last_time_s - _TOLERANCE_S
        self._last_time_s = time_s
        if has_gone_back or abs(difference_s - least_s) > _JUMP_S:  # The clock began anew.
            self._least_s = self._least_before_s = math.inf
            self._window_began_s, self._window_s = arrived_s, _FIRST_WINDOW_S
        elif arrived_s - self._window_began_s > self._window_s:
            self._least_before_s, self._least_s = self._least_s, math.inf
            self._window_began_s = arrived_s
            self._window_s = min(2 * self._window_s, _LONGEST_WINDOW_S)
        self._least_s = min(self._least_s, difference_s)
        return time_s + min(self._least_s, self._least_before_s)
