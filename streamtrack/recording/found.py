"""What targets that were found by their motion add to a recording.

There may be hundreds of them, one after the other, so each has an outline with its name while it is
tracked and nothing more: no lane, no curves and no close-ups of its own. How many there are is a
curve, and the log says when each appeared and ended.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import rerun as rr

from streamtrack.recording import rows, styles
from streamtrack.recording.entities import (
    FOUND_CURVES,
)
from streamtrack.targets import color_number
from streamtrack.types import Step, Track, TrackState


@dataclass(slots=True)
class _Shown:
    """A target that is alive: its state, its colour's number, and frames tracked."""

    state: TrackState
    number: int
    frames: int = 0


class FoundLog:
    """The targets of `Step.tracks` that were found, not given."""

    def __init__(self, stream: rr.RecordingStream) -> None:
        self._stream = stream
        self._alive: dict[str, _Shown] = {}
        self._count = 0

    def begin(self) -> None:
        """Record what each part needs at its start."""
        if self._count:
            self._log_curve_styles()
        for name, shown in self._alive.items():
            self._log_style(name, shown.number)

    def log(self, step: Step) -> list[str]:
        """Record where they are in a frame; lines for the log about what changed."""
        tracks = {track.name: track for track in step.tracks if track.is_found}
        frame = step.frame.index
        lines = [self._follow(frame, track) for track in tracks.values()]
        for name in [name for name in self._alive if name not in tracks]:
            shown = self._alive.pop(name)
            self._clear(name)
            lines.append(f"frame {frame}: {name} ended, tracked in {shown.frames} frames")
        if self._count:
            states = [shown.state for shown in self._alive.values()]
            for state in (TrackState.TRACKING, TrackState.LOST):
                path = f"{FOUND_CURVES}/{state}"
                self._stream.log(path, rows.scalar(states.count(state)))
        return [line for line in lines if line]

    def _follow(self, frame: int, track: Track) -> str:
        shown = self._alive.get(track.name)
        message = ""
        if shown is None:
            if not self._count:
                self._log_curve_styles()
            self._count += 1
            shown = self._alive[track.name] = _Shown(track.state, color_number(track, self._count))
            self._log_style(track.name, shown.number)
            message = f"frame {frame}: {track.name} appeared"
        elif shown.state is not track.state:
            why = f": {track.reason}" if track.reason else ""
            message = f"frame {frame}: {track.name} {shown.state} -> {track.state}{why}"
        was, shown.state = shown.state, track.state
        if track.quad is not None:
            shown.frames += 1
            outline = np.concatenate([track.quad, track.quad[:1]])[None]
            self._stream.log(_quad_path(track.name), rows.strips(outline))
        elif was is TrackState.TRACKING:
            self._clear(track.name)
        return message

    def _clear(self, name: str) -> None:
        self._stream.log(_quad_path(name), rr.Clear(recursive=False))

    def _log_style(self, name: str, number: int) -> None:
        style = rr.LineStrips2D.from_fields(
            colors=[styles.target_color(number)],
            radii=styles.ui_points(1.5),
            labels=[name],
            show_labels=True,
            draw_order=30,
        )
        self._stream.log(_quad_path(name), style, static=True)

    def _log_curve_styles(self) -> None:
        colors = {TrackState.TRACKING: styles.LANE_GREEN, TrackState.LOST: styles.LANE_RED}
        for state, color in colors.items():
            path = f"{FOUND_CURVES}/{state}"
            styles.log_curve_style(self._stream, path, f"automatic targets {state}", color)


def _quad_path(name: str) -> str:
    return rr.new_entity_path(["camera", "targets", name, "quad"])
