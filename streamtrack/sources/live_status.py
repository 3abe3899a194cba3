"""What a live source does and did: its states, their changes, and counts."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from streamtrack.meters import LogHistogram
from streamtrack.summary_text import number

_MAX_EVENTS = 1000
_IN_SUMMARY = ("captured", "dropped", "thinned", "lost", "damaged", "reconnects", "stalls")


class LiveState(StrEnum):
    """What a live source is doing."""

    CONNECTING = "connecting"
    STREAMING = "streaming"
    STALLED = "stalled"
    WAITING = "waiting"
    ENDED = "ended"


@dataclass(frozen=True, slots=True)
class LiveEvent:
    """A change of state. ``time_s`` is on the axis of `Frame.time_s`, 0 before the first frame."""

    state: LiveState
    detail: str
    time_s: float
    unix_s: float
    epoch: int


@dataclass(frozen=True, slots=True)
class LiveStatus:
    """Where a live source stands. Counts and times are since it was made.

    captured         pictures that came whole and were wanted; the frames are those not dropped
    dropped          pictures given up because newer ones were there
    thinned          left out because of ``max_fps``
    lost, damaged    by the word of the device
    openings         that succeeded; ``reconnects`` is one less
    away_s           time from the last picture before a loss to the first after it
    age_ms_p50, p95  from capture to `LiveSource.note_output`; None before the first
    """

    state: LiveState
    since_unix_s: float
    epoch: int
    captured: int
    dropped: int
    thinned: int
    lost: int
    damaged: int
    openings: int
    failed_openings: int
    stalls: int
    away_s: float
    age_ms_p50: float | None
    age_ms_p95: float | None

    @property
    def reconnects(self) -> int:
        """Openings after the first."""
        return max(0, self.openings - 1)

    def to_json(self) -> dict[str, Any]:
        """What belongs into the summary of a run."""
        counts = {name: getattr(self, name) for name in _IN_SUMMARY}
        age_ms = {"p50": self.age_ms_p50, "p95": self.age_ms_p95}
        return {**counts, "away_s": self.away_s, "frame_age_ms": age_ms}

    def rows(self) -> list[tuple[str, str]]:
        """The same as (label, value) pairs for a table."""
        counts = ", ".join(f"{name} {getattr(self, name)}" for name in _IN_SUMMARY)
        p50, p95 = number(self.age_ms_p50, 0), number(self.age_ms_p95, 0)
        return [
            ("Live pictures", f"{counts}, away {self.away_s:.1f} s"),
            ("Age of a frame when done", f"median {p50} ms, p95 {p95} ms"),
        ]


_COUNTED = (
    "captured",
    "dropped",
    "thinned",
    "lost",
    "damaged",
    "openings",
    "failed_openings",
    "stalls",
)


class Journal:
    """Keeps the status; written by the capturing thread, read by any."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._events: deque[tuple[LiveState, str, float, float, int]] = deque(maxlen=_MAX_EVENTS)
        self._state = LiveState.CONNECTING
        self._since_unix_s = time.time()
        self._counts = dict.fromkeys(_COUNTED, 0)
        self._ages_ms = LogHistogram()
        self._epoch = 0
        self._away_s = 0.0
        self._away_since_s: float | None = None

    def enter(self, state: LiveState, detail: str, epoch: int) -> None:
        """Note a change of state, now."""
        with self._lock:
            self._state, self._since_unix_s, self._epoch = state, time.time(), epoch
            event = (state, detail, time.monotonic(), self._since_unix_s, epoch)
            self._events.append(event)

    def count(self, **numbers: int) -> None:
        """Add to counts by their names in `LiveStatus`."""
        with self._lock:
            for what, number in numbers.items():
                self._counts[what] += number

    def begin_away(self, since_s: float) -> None:
        """The stream is gone, if it was not already, since `time.monotonic` was ``since_s``."""
        with self._lock:
            if self._away_since_s is None and self._counts["captured"]:
                self._away_since_s = since_s

    def end_away(self) -> float:
        """The stream is back. For how many seconds it was gone."""
        with self._lock:
            if self._away_since_s is None:
                return 0.0
            gone_s = time.monotonic() - self._away_since_s
            self._away_s += gone_s
            self._away_since_s = None
            return gone_s

    def note_age(self, age_s: float) -> None:
        """Take in the age of one frame at its output."""
        with self._lock:
            self._ages_ms.add(age_s * 1e3)

    def status(self, dropped: int) -> LiveStatus:
        """All of it; ``dropped`` are those given up after capture."""
        with self._lock:
            away_s = self._away_s
            if self._away_since_s is not None:
                away_s += time.monotonic() - self._away_since_s
            counts = {**self._counts, "dropped": self._counts["dropped"] + dropped}
            return LiveStatus(
                self._state,
                self._since_unix_s,
                self._epoch,
                **counts,
                away_s=away_s,
                age_ms_p50=self._ages_ms.quantile(0.5),
                age_ms_p95=self._ages_ms.quantile(0.95),
            )

    def drain(self, time_of: Callable[[float], float]) -> list[LiveEvent]:
        """Changes since the last call; ``time_of`` maps `time.monotonic` to the frames' time."""
        with self._lock:
            taken = list(self._events)
            self._events.clear()
        return [
            LiveEvent(state, detail, max(0.0, time_of(at_s)), unix_s, epoch)
            for state, detail, at_s, unix_s, epoch in taken
        ]
