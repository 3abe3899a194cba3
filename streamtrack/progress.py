"""Telling a person how far a run is: a bar on a terminal, plain lines elsewhere, or nothing."""

from __future__ import annotations

import time
from typing import Self

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)

from streamtrack.types import SourceInfo, Step, TrackState

_LINE_EVERY_S = 5.0


class NoProgress:
    """Says nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        return None

    def begin(self, info: SourceInfo, frames: int | None) -> None:
        return None

    def advance(self, step: Step) -> None:
        return None

    def writing(self, text: str) -> None:
        return None


class ProgressBar:
    """A bar with frames, frames a second, time left and the targets' states, on a terminal."""

    def __init__(self, console: Console) -> None:
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[fps]}"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[states]}"),
            console=console,
            transient=True,
        )
        self._task: TaskID | None = None
        self._began = time.monotonic()
        self._done = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self._bar.stop()

    def begin(self, info: SourceInfo, frames: int | None) -> None:
        self._task = self._bar.add_task(info.name, total=frames, fps="", states="")
        self._began = time.monotonic()
        self._bar.start()

    def advance(self, step: Step) -> None:
        assert self._task is not None
        self._done += 1
        fps = self._done / max(time.monotonic() - self._began, 1e-6)
        self._bar.update(self._task, advance=1, fps=f"{fps:.1f} fps", states=_states(step))

    def writing(self, text: str) -> None:
        assert self._task is not None
        self._bar.update(self._task, states=f"writing the mosaic {text}")


class ProgressLines:
    """A plain line every few seconds, for logs and pipes."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._total: int | None = None
        self._is_live = False
        self._done = 0
        self._began = self._last = time.monotonic()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        return None

    def begin(self, info: SourceInfo, frames: int | None) -> None:
        self._total = frames
        self._is_live = info.is_live
        self._began = self._last = time.monotonic()

    def advance(self, step: Step) -> None:
        self._done += 1
        now = time.monotonic()
        if now - self._last < _LINE_EVERY_S:
            return
        self._last = now
        fps = self._done / (now - self._began)
        of = "" if self._total is None else f" of {self._total}"
        left = "" if self._total is None else f", {(self._total - self._done) / fps:.0f} s left"
        missed = f", {step.frame.index + 1 - self._done} left out" if self._is_live else ""
        self._console.print(
            f"{self._done}{of} frames, {fps:.1f} fps{left}{missed}; {_states(step)}",
            highlight=False,
            markup=False,
            soft_wrap=True,
        )

    def writing(self, text: str) -> None:
        now = time.monotonic()
        if now - self._last >= _LINE_EVERY_S:
            self._last = now
            self._console.print(f"writing the mosaic {text}", highlight=False, markup=False)


def _states(step: Step) -> str:
    tracked = sum(track.state is TrackState.TRACKING for track in step.tracks)
    if len(step.tracks) == 1:
        return f"{step.tracks[0].name} {step.tracks[0].state}"
    return f"{tracked} of {len(step.tracks)} targets tracked" if step.tracks else "no target"
