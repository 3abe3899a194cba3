"""Keeping to a time a frame by doing less, in stated steps.

The first step aligns half the area, the others look for fewer features and, for lost targets, less
often. Targets are not aligned more coarsely than that: a quarter of the area costs no less, as more
alignments fail and are repeated, and corners go wrong. What then still takes too long the summary
tells; a live source drops the pictures that there is no time for.

The level goes down when frames take longer than the budget and up again when there is room, so with
a budget results depend on the machine's speed; without one they never do. A frame of a live source
takes from when it lay ready: whatever keeps the run (writing, other programs), work goes down while
it is late.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class WorkLevel:
    """How much is done for a frame.

    patch_steps      steps of `2**-0.5` in scale by which targets are aligned more coarsely
    feature_share    of the features that the settings ask for
    search_interval  lost targets are searched for in every so many-th frame
    """

    index: int
    patch_steps: int
    feature_share: float
    search_interval: int


LEVELS = (
    WorkLevel(0, 0, 1.0, 1),
    WorkLevel(1, 1, 0.5, 1),
    WorkLevel(2, 1, 0.35, 2),
    WorkLevel(3, 1, 0.25, 4),
)
FULL_WORK = LEVELS[0]

_RATE = 0.25  # share of a new frame in the running mean
_ROOM_SHARE = 0.55  # of the budget: a level costs at most about 1 / 0.6 of the next lower one
_FRAMES_BEFORE_LESS = 3
_FRAMES_BEFORE_MORE = 30
_LONGEST_BEFORE_MORE = 960


class Budget:
    """Chooses the level of each frame from what the frames before took."""

    def __init__(self, budget_ms: float | None) -> None:
        self._budget_ms = budget_ms
        self._level = 0
        self._mean_ms: float | None = None
        self._frames_at_level = 0
        self._before_more = _FRAMES_BEFORE_MORE
        self._has_risen = False

    @property
    def level(self) -> WorkLevel:
        return LEVELS[self._level]

    def note(self, frame_ms: float) -> None:
        """Take in what a frame took at the present level, its waiting for us included."""
        if self._budget_ms is None:
            return
        mean = frame_ms if self._mean_ms is None else self._mean_ms
        self._mean_ms = mean + _RATE * (frame_ms - mean)
        self._frames_at_level += 1
        if self._mean_ms > self._budget_ms and self._frames_at_level >= _FRAMES_BEFORE_LESS:
            self._lower()
        elif (
            self._mean_ms < _ROOM_SHARE * self._budget_ms
            and self._frames_at_level >= self._before_more
        ):
            self._has_risen = True
            self._go_to(max(self._level - 1, 0))

    def _lower(self) -> None:
        """A level that was tried and did not fit is tried again ever more rarely."""
        is_failed_try = self._has_risen and self._frames_at_level < self._before_more
        longer = min(2 * self._before_more, _LONGEST_BEFORE_MORE)
        self._before_more = longer if is_failed_try else _FRAMES_BEFORE_MORE
        self._has_risen = False
        self._go_to(min(self._level + 1, len(LEVELS) - 1))

    def _go_to(self, level: int) -> None:
        if level != self._level:
            self._level, self._mean_ms, self._frames_at_level = level, None, 0
