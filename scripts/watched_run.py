"""One run of `streamtrack track` that tells, a JSON object a line, what happens and when.

    watched_run.py SETTINGS_JSON    source, target, record, live, rotate, keep, stall_timeout_s

Started by the scripts here as a child, in the environment of an emulated camera. Lines: ``frame``
(all is done with it), ``state`` and ``counts`` of the source, ``log``, and ``slow`` with each new
longest time that a call of the live view took; ``t`` is wall time.
"""

from __future__ import annotations

import json
import logging
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from streamtrack.cli.common import StopOnSignal
from streamtrack.job import TrackJob, run_track
from streamtrack.progress import NoProgress
from streamtrack.recording.live_server import parse_live
from streamtrack.recording.live_view import LiveView
from streamtrack.settings import build_settings
from streamtrack.sources.live_status import Journal
from streamtrack.targets import parse_targets
from streamtrack.types import SourceInfo, Step
from streamtrack.watching import Outputs

LOCK = threading.Lock()


def tell(kind: str, **facts: Any) -> None:
    line = json.dumps({"kind": kind, "t": time.time(), **facts})
    with LOCK:
        sys.stdout.write(line + "\n")
        sys.stdout.flush()


class Told(NoProgress):
    def begin(self, info: SourceInfo, frames: int | None) -> None:
        tell("begin", size=info.size_wh)

    def advance(self, step: Step) -> None:
        frame, track = step.frame, step.tracks[0] if step.tracks else None
        tell(
            "frame",
            index=frame.index,
            epoch=frame.epoch,
            size=frame.size_wh,
            age_ms=(time.monotonic() - (frame.captured_s or 0.0)) * 1e3,
            tracking=track is not None and track.quad is not None,
        )


class _LogLines(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        tell("log", text=record.getMessage())


def watch_states_and_calls() -> None:
    """Have each change of state and each long call told at once."""
    enter, count = Journal.enter, Journal.count

    def told_enter(self: Journal, state: Any, detail: str, epoch: int) -> None:
        enter(self, state, detail, epoch)
        tell("state", state=str(state), detail=detail)

    def told_count(self: Journal, **numbers: int) -> None:
        count(self, **numbers)
        kept = {name: n for name, n in numbers.items() if n and name in ("lost", "damaged")}
        if kept:
            tell("counts", **kept)

    setattr(Journal, "enter", told_enter)  # noqa: B010
    setattr(Journal, "count", told_count)  # noqa: B010
    longest = [0.0]
    for name in ("log", "log_text", "log_source"):
        setattr(LiveView, name, timed(getattr(LiveView, name), longest))


def timed(call: Callable[..., None], longest: list[float]) -> Callable[..., None]:
    def timed_call(*arguments: Any, **named: Any) -> None:
        began = time.perf_counter()
        call(*arguments, **named)
        took = time.perf_counter() - began
        if took > longest[0]:
            longest[0] = took
            tell("slow", ms=took * 1e3)

    return timed_call


def main() -> None:
    given = json.loads(sys.argv[1])
    logger = logging.getLogger("streamtrack")
    logger.addHandler(_LogLines(logging.WARNING))
    watch_states_and_calls()
    recording = {name: given[name] for name in ("rotate", "keep") if given.get(name)}
    live = {"stall_timeout_s": given.get("stall_timeout_s", 5.0)}
    outputs = Outputs(
        record=Path(given["record"]) if given.get("record") else None,
        live=parse_live(given["live"]) if given.get("live") else None,
    )
    targets = parse_targets([given["target"]]) if given.get("target") else []
    job = TrackJob(
        given["source"], targets, build_settings({"recording": recording, "live": live}), outputs
    )
    with StopOnSignal() as stop:
        outcome = run_track(job, Told(), stop)
    status = outcome.summary.live
    assert status is not None
    tell(
        "end",
        error=str(outcome.error or ""),
        dropped=status.dropped,
        age_p50=status.age_ms_p50,
        age_p95=status.age_ms_p95,
    )


if __name__ == "__main__":
    main()
