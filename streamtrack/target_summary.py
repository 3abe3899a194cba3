"""One target's part of the summary of a run; definitions in `streamtrack.summary`."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from streamtrack.meters import Mean
from streamtrack.summary_text import number
from streamtrack.types import Track, TrackState


@dataclass(frozen=True, slots=True)
class TargetSummary:
    """One target: frames in each state, and means over the frames in which it was tracked.

    ``first_seen`` is the index of the first frame in which it was tracked, ``models`` counts
    frames a transformation model. What was never measured is None.
    """

    name: str
    frames_tracked: int
    frames_lost: int
    frames_searching: int
    losses: int
    first_seen: int | None
    rmse_px: float | None
    matches: float | None
    inliers: float | None
    models: dict[str, int]
    last_seen: int | None = None
    is_found: bool = False

    @property
    def share(self) -> float:
        """Share (0..1) of the frames since the target was given in which it was tracked."""
        frames = self.frames_tracked + self.frames_lost + self.frames_searching
        return self.frames_tracked / frames if frames else 0.0

    def to_text(self) -> str:
        """All of it in one line."""
        frames = self.frames_tracked + self.frames_lost + self.frames_searching
        seen = "never seen" if self.first_seen is None else f"first seen in frame {self.first_seen}"
        return (
            f"tracked {self.frames_tracked} of {frames} ({self.share:.1%}), "
            f"lost {self.frames_lost}, searching {self.frames_searching}, "
            f"losses {self.losses}, {seen}, RMSE {number(self.rmse_px, 2, ' px')}"
        )

    def to_json(self) -> dict[str, Any]:
        """Plain values, null for what was never measured."""
        return {
            "name": self.name,
            "frames_tracked": self.frames_tracked,
            "frames_lost": self.frames_lost,
            "frames_searching": self.frames_searching,
            "share": self.share,
            "first_seen": self.first_seen,
            "last_seen": self.last_seen,
            "automatic": self.is_found,
            "losses": self.losses,
            "rmse_px": self.rmse_px,
            "matches": self.matches,
            "inliers": self.inliers,
            "models": self.models,
        }


@dataclass(slots=True)
class TargetSums:
    """Running sums over a target's tracks."""

    name: str
    states: Counter[TrackState] = field(default_factory=Counter)
    losses: int = 0
    last: TrackState | None = None
    first_seen: int | None = None
    rmse_px: Mean = field(default_factory=Mean)
    matches: Mean = field(default_factory=Mean)
    inliers: Mean = field(default_factory=Mean)
    models: Counter[str] = field(default_factory=Counter)
    last_seen: int | None = None
    is_found: bool = False

    def add(self, track: Track, frame: int) -> None:
        self.states[track.state] += 1
        self.is_found = track.is_found
        self.losses += self.last is TrackState.TRACKING and track.state is TrackState.LOST
        self.last = track.state
        if track.state is not TrackState.TRACKING:
            return
        if self.first_seen is None:
            self.first_seen = frame
        self.last_seen = frame
        self.rmse_px.add(track.rmse_px)
        self.matches.add(len(track.evidence))
        self.inliers.add(track.evidence.inliers)
        if track.model is not None:
            self.models[track.model.value] += 1

    def build(self) -> TargetSummary:
        return TargetSummary(
            self.name,
            self.states[TrackState.TRACKING],
            self.states[TrackState.LOST],
            self.states[TrackState.SEARCHING],
            self.losses,
            self.first_seen,
            self.rmse_px.value,
            self.matches.value,
            self.inliers.value,
            dict(self.models.most_common()),
            self.last_seen,
            self.is_found,
        )
