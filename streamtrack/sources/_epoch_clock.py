"""One clock for a stream that breaks off and begins anew."""

from __future__ import annotations

import time

_TINY_STEP_S = 1e-6
_MAX_DISAGREEMENT_S = 1.0


class EpochClock:
    """Seconds since the first picture: the stream's own clock inside an epoch, ours between them.

    So differences inside an epoch are exact, and a gap lasts as long as it lasted. A jump of the
    stream's clock that ours does not confirm is taken out the same way. Times strictly increase.
    """

    def __init__(self) -> None:
        self._first_captured_s: float | None = None
        self._offset_s: float | None = None
        self._last: tuple[float, float] | None = None  # The stream's time, the moment of capture.
        self._last_time_s = 0.0
        self._unix_offset_s = 0.0

    def begin_epoch(self) -> None:
        """The next picture comes from a stream opened anew."""
        self._offset_s = None
        # Once for each opening: a wall clock that is set meanwhile shall not tear an epoch.
        self._unix_offset_s = time.time() - time.monotonic()

    def time_s(self, stream_s: float, captured_s: float) -> float:
        """Time of the next picture, by its time in the stream and its moment of capture."""
        if self._first_captured_s is None:
            self._first_captured_s = captured_s
        is_first = self._last is None
        earliest_s = 0.0 if is_first else self._last_time_s + _TINY_STEP_S
        if self._offset_s is None or self._has_jumped(stream_s, captured_s):
            elapsed_s = captured_s - self._first_captured_s
            self._offset_s = max(elapsed_s, earliest_s) - stream_s
        self._last = stream_s, captured_s
        self._last_time_s = max(stream_s + self._offset_s, earliest_s)
        return self._last_time_s

    def _has_jumped(self, stream_s: float, captured_s: float) -> bool:
        if self._last is None:
            return False
        last_stream_s, last_captured_s = self._last
        step_s = stream_s - last_stream_s
        return abs(step_s - (captured_s - last_captured_s)) > _MAX_DISAGREEMENT_S

    def unix_s(self, monotonic_s: float) -> float:
        """Wall time of a moment on `time.monotonic`'s clock."""
        return monotonic_s + self._unix_offset_s

    def at(self, monotonic_s: float) -> float:
        """A moment on `time.monotonic`'s clock as seconds since the first picture."""
        return monotonic_s - (self._first_captured_s or monotonic_s)
