"""The table of targets in a recording: where each is now, how fast, and how often it was seen."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import rerun as rr

from streamtrack.recording.entities import TRACKS
from streamtrack.types import Step, Track, TrackState, WorldPlace

_EVERY_S = 0.5
_CHANGED_EVERY_S = 0.05
_MOST_ROWS = 40


class TracksTable:
    """Records the table twice a second of the source's clock, and soon after a state has changed.

    The clock is set by the caller.
    """

    def __init__(self, stream: rr.RecordingStream, has_ground: bool) -> None:
        self._stream = stream
        self._has_ground = has_ground
        self._last_s = -math.inf
        self._seen: Counter[str] = Counter()
        self._states: dict[str, TrackState] = {}
        self._frames = 0

    def begin(self) -> None:
        """Each part of a recording has the table from its start."""
        self._last_s = -math.inf

    def follow(self, step: Step) -> None:
        """Take in a frame."""
        self._frames += 1
        tracked = [track for track in step.tracks if track.state is TrackState.TRACKING]
        self._seen.update(track.name for track in tracked)
        time_s = step.frame.time_s
        states = {track.name: track.state for track in step.tracks}
        wait_s = _EVERY_S if states == self._states else _CHANGED_EVERY_S
        if (states or self._states) and not 0.0 <= time_s - self._last_s < wait_s:
            self._last_s, self._states = time_s, states
            self._stream.log(
                TRACKS,
                rr.TextDocument(self.markdown(step.tracks), media_type="text/markdown"),
            )
        if len(self._seen) > 16 * _MOST_ROWS:  # automatic targets come and go for ever
            now = {track.name for track in step.tracks}
            self._seen = Counter({name: n for name, n in self._seen.items() if name in now})

    def markdown(self, tracks: Sequence[Track]) -> str:
        """The table of a frame."""
        titles = ["target", "state", "world x, y", "px/s"]
        titles += ["ground x, y", "units/s"] if self._has_ground else []
        titles += ["frames seen", "why"]
        lines = [_line(titles), _line(["---"] * len(titles))]
        lines += [_line(self._cells(track)) for track in tracks[:_MOST_ROWS]]
        if not tracks:
            return "no target now\n"
        if len(tracks) > _MOST_ROWS:
            lines.append(f"\nand {len(tracks) - _MOST_ROWS} more")
        return "\n".join(lines) + "\n"

    def _cells(self, track: Track) -> list[str]:
        world = track.world
        ground = None if world is None else world.ground
        cells = [
            track.name,
            str(track.state),
            "-" if world is None else _place(world),
            "-" if world is None else _number(world.speed_px_s),
        ]
        if self._has_ground:
            cells += [
                "-" if ground is None else "{:.2f}, {:.2f}".format(*ground.position),
                "-" if ground is None else _number(ground.speed_units_s),
            ]
        return [*cells, str(self._seen[track.name]), track.reason]


def _place(world: WorldPlace) -> str:
    """Its position, and how far off the corners are expected to be."""
    x, y = world.position
    spread = f" ± {world.sigma_px:.2g}" if math.isfinite(world.sigma_px) else ""
    return f"{x:.0f}, {y:.0f}{spread}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(" ".join(cell.split()).replace("|", "/") for cell in cells) + " |"
