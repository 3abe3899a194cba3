"""One tracking run from source to closed outputs: opens everything, loops, closes everything.

Watchers (recording, table, poses, annotated video, summary) see each `Step` and decide nothing.
Whatever ends the run, what was produced until then is kept and properly closed.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from streamtrack.errors import OutputError, SourceError, StreamtrackError, UsageError
from streamtrack.pipeline import track
from streamtrack.results import PosesWriter, check_tracks_path, open_tracks_writer
from streamtrack.settings import Settings
from streamtrack.sources import open_source
from streamtrack.sources.base import FrameSource
from streamtrack.summary import Summary, SummaryBuilder
from streamtrack.targets import Target
from streamtrack.types import SourceInfo, Step

if TYPE_CHECKING:
    from streamtrack.recording import Recorder

_FALLBACK_RATE_HZ = 30.0


@dataclass(frozen=True, slots=True)
class Outputs:
    """Where the results go; None where they are not wanted."""

    record: Path | None = None
    tracks: Path | None = None
    poses: Path | None = None
    video: Path | None = None
    summary: Path | None = None


@dataclass(frozen=True, slots=True)
class TrackJob:
    """All that one run needs to know."""

    source: str | Sequence[str]
    targets: Sequence[Target]
    settings: Settings = field(default_factory=Settings)
    outputs: Outputs = field(default_factory=Outputs)
    start: int = 0
    step: int = 1
    frames: int | None = None


class Progress(Protocol):
    """Told of the run's progress, so that a person can be."""

    def begin(self, info: SourceInfo, frames: int | None) -> None: ...

    def advance(self, step: Step) -> None: ...


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of a run: its summary, and what went wrong once frames were coming, if anything."""

    summary: Summary
    error: StreamtrackError | None


def run_track(job: TrackJob, progress: Progress, should_stop: Callable[[], bool]) -> Outcome:
    """Run the job; all outputs are closed when it returns, whatever ended it.

    Raises StreamtrackError if it cannot even start, or an output cannot be closed.
    """
    _check_outputs(job)
    with ExitStack() as stack:
        source = stack.enter_context(
            open_source(job.source, with_packets=job.outputs.record is not None)
        )
        builder = SummaryBuilder(source.info, job.settings)
        steps = stack.enter_context(closing(_steps(job, source)))
        # A target that does not fit the first frame is refused before any output is touched.
        first = next(steps, None)
        if first is None:
            raise SourceError(f"{source.info.name}: no frame could be read")
        watchers, finish = _open_watchers(job, source, stack)
        progress.begin(source.info, _expected_frames(job, source.info))
        error: StreamtrackError | None = None
        ended = ""
        try:
            for step in chain([first], steps):
                for watch in watchers:
                    watch(step)
                builder.add(step)
                progress.advance(step)
                if should_stop():
                    ended = f"interrupted after frame {step.frame.index}"
                    error = StreamtrackError(f"{ended}: everything up to there is written")
                    break
        except StreamtrackError as raised:
            error, ended = raised, str(raised)
        summary = builder.build(
            source.skipped,
            source.corrupt_packets,
            ended or _natural_end(job, source, builder.frames),
        )
        failure = finish(summary)
        error = error or failure
    return Outcome(summary, error)


def _check_outputs(job: TrackJob) -> None:
    """Refuse, before anything is opened, outputs that would replace each other or the source."""
    outputs = job.outputs
    if outputs.tracks is not None:
        check_tracks_path(outputs.tracks)
    if outputs.record is not None and outputs.record.suffix != ".rrd":
        raise UsageError(f"recording {outputs.record}: give it the ending .rrd")
    sources = [job.source] if isinstance(job.source, str) else job.source
    taken = {Path(source).resolve(): f"the source {source}" for source in sources}
    for name in ("record", "tracks", "poses", "video", "summary"):
        path = getattr(outputs, name)
        if path is None:
            continue
        if path.resolve() in taken and path.name and not _is_device(path):
            raise UsageError(f"{path} would replace {taken[path.resolve()]}: name another file")
        taken[path.resolve()] = f"the {name} output"


def _natural_end(job: TrackJob, source: FrameSource, frames: int) -> str:
    if frames == job.frames:
        return f"{frames} frames, as asked"
    return f"the source {source.shortfall}" if source.shortfall else "end of source"


def _is_device(path: Path) -> bool:
    return path.exists() and not path.is_file()


def _steps(job: TrackJob, source: FrameSource) -> Generator[Step]:
    return track(
        source, job.targets, job.settings, start=job.start, step=job.step, frames=job.frames
    )


def _expected_frames(job: TrackJob, info: SourceInfo) -> int | None:
    if info.frame_count is None:
        return job.frames
    available = max(0, -(-(info.frame_count - job.start) // job.step))
    return available if job.frames is None else min(available, job.frames)


def _open_watchers(
    job: TrackJob, source: FrameSource, stack: ExitStack
) -> tuple[list[Callable[[Step], None]], Callable[[Summary], StreamtrackError | None]]:
    """What to call for each Step, and what to call with the summary at the end.

    The latter returns what went wrong with an output that did not stop the run.
    """
    outputs, info = job.outputs, source.info
    watchers: list[Callable[[Step], None]] = []
    finishers: list[Callable[[Summary], None]] = []
    recorder: Recorder | None = None
    if outputs.summary is not None:
        finishers.append(_summary_finisher(outputs.summary))
    if outputs.tracks is not None:
        watchers.append(stack.enter_context(open_tracks_writer(outputs.tracks)).write)
    if outputs.poses is not None:
        poses = stack.enter_context(PosesWriter(outputs.poses))
        watchers.append(poses.write)
        finishers.append(_skipped_finisher(poses))
    if outputs.video is not None:
        watchers.append(_video_watcher(outputs.video, info, stack))
    if outputs.record is not None:
        from streamtrack.recording import Recorder

        views = {t.name: t.picture for t in job.targets if t.picture is not None}
        names = [target.name for target in job.targets]
        recorder = stack.enter_context(Recorder(outputs.record, info, job.settings, names, views))
        watchers.append(recorder.log)
        finishers.append(lambda summary: recorder.close(summary.to_markdown()))

    def finish(summary: Summary) -> StreamtrackError | None:
        failure: StreamtrackError | None = None
        for finisher in finishers:
            try:
                finisher(summary)
            except StreamtrackError as error:
                failure = failure or error
        if failure is None and recorder is not None and recorder.failed is not None:
            failure = OutputError(
                f"the recording {recorder.path} ended early ({recorder.failed}); "
                "all else is complete"
            )
        return failure

    return watchers, finish


def _summary_finisher(path: Path) -> Callable[[Summary], None]:
    return lambda summary: summary.write_json(path)


def _skipped_finisher(poses: PosesWriter) -> Callable[[Summary], None]:
    def finish(summary: Summary) -> None:
        for skipped in summary.skipped:
            poses.write_skipped(skipped)

    return finish


def _video_watcher(path: Path, info: SourceInfo, stack: ExitStack) -> Callable[[Step], None]:
    from streamtrack.overlay import Trails, draw_step
    from streamtrack.sources.writer import VideoWriter

    rate_hz = info.rate_hz or _FALLBACK_RATE_HZ
    writer = stack.enter_context(VideoWriter(path, rate_hz=rate_hz))
    trails = Trails()

    def watch(step: Step) -> None:
        writer.write(draw_step(step, trail=trails.follow(step)), step.frame.time_s)

    return watch
