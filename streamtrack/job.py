"""One run over a stream from source to closed outputs: opens everything, loops, closes everything.

Watchers (recording, table, poses, annotated video, summary) see each `Step` and decide nothing.
Whatever ends the run, what was produced until then is kept and properly closed.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Generic, Protocol, TypeVar

from streamtrack.camera.auto import make_camera
from streamtrack.camera.moving import CameraEstimator
from streamtrack.errors import SourceError, StreamtrackError, UsageError
from streamtrack.mosaic.picture_files import check_picture_path
from streamtrack.pipeline import track
from streamtrack.results import check_tracks_path
from streamtrack.service import ServiceNotifier
from streamtrack.settings import Settings
from streamtrack.sources import open_source
from streamtrack.sources.base import FrameSource
from streamtrack.sources.live_status import LiveStatus
from streamtrack.summary import Summary, SummaryBuilder
from streamtrack.targets import TargetSpec, auto_target, given_targets
from streamtrack.types import Skipped, SourceInfo, Step
from streamtrack.watching import Outputs, RunSummary, Watchers, live_source, open_watchers
from streamtrack.working_size import graph_in_full_size


@dataclass(frozen=True, slots=True)
class TrackJob:
    """All that one run needs to know."""

    source: str | Sequence[str]
    targets: Sequence[TargetSpec]
    settings: Settings = field(default_factory=Settings)
    outputs: Outputs = field(default_factory=Outputs)
    start: int = 0
    step: int = 1
    frames: int | None = None


class Progress(Protocol):
    """Told of the run's progress, so that a person can be.

    ``writing`` is called now and then while outputs are completed after the last frame.
    """

    def begin(self, info: SourceInfo, frames: int | None) -> None: ...

    def advance(self, step: Step) -> None: ...

    def writing(self, text: str) -> None: ...


SummaryT = TypeVar("SummaryT", bound=RunSummary)
SummaryT_co = TypeVar("SummaryT_co", bound=RunSummary, covariant=True)


class Report(Protocol[SummaryT_co]):
    """Takes in every step and makes the summary of them."""

    @property
    def frames(self) -> int: ...

    def add(self, step: Step) -> None:
        """Take in a step, once all watchers have seen it."""

    def build(
        self,
        skipped: Sequence[Skipped],
        corrupt_packets: int,
        ended: str,
        live: LiveStatus | None = None,
    ) -> SummaryT_co: ...


@dataclass(frozen=True, slots=True)
class Outcome(Generic[SummaryT]):
    """What came of a run: its summary, and what went wrong once frames were coming, if anything."""

    summary: SummaryT
    error: StreamtrackError | None


def run_track(
    job: TrackJob, progress: Progress, should_stop: Callable[[], bool]
) -> Outcome[Summary]:
    """Run the job; all outputs are closed when it returns, whatever ended it.

    Raises StreamtrackError if it cannot even start, or an output cannot be closed.
    """

    def begin_report(
        source: FrameSource, camera: CameraEstimator, _watchers: object
    ) -> SummaryBuilder:
        info, settings = source.info, job.settings
        graph = graph_in_full_size(camera.graph, info.size_wh, settings.max_width)
        return SummaryBuilder(info, settings, graph=graph)

    return run(job, begin_report, progress, should_stop)


def run(
    job: TrackJob,
    begin_report: Callable[[FrameSource, CameraEstimator, Watchers], Report[SummaryT]],
    progress: Progress,
    should_stop: Callable[[], bool],
) -> Outcome[SummaryT]:
    """What `run_track` does, with a summary of the caller's choice."""
    _check_outputs(job)
    service = ServiceNotifier()
    watchers = Watchers()

    def is_over() -> bool:  # asked all the time, while a live source waits too
        watchers.wait()
        service.alive(watchers.status() if service.is_used else "")
        return should_stop()

    with ExitStack() as stack:
        source = stack.enter_context(
            open_source(
                job.source,
                with_packets=job.outputs.record is not None,
                live=job.settings.live,
                should_stop=is_over,
            )
        )
        camera = make_camera(job.settings, is_live=source.info.is_live)
        if camera.graph is not None:
            stack.callback(camera.graph.close)
        stack.callback(camera.close)
        report = begin_report(source, camera, watchers)
        steps = stack.enter_context(closing(_steps(job, source, camera)))
        # A target that does not fit the first frame is refused before any output is touched.
        first = next(steps, None)
        if first is None:
            raise SourceError(f"{source.info.name}: no frame could be read")
        views = {target.name: target.picture for target in given_targets(job.targets)}
        open_watchers(
            watchers,
            job.outputs,
            source,
            job.settings,
            views,
            camera,
            stack,
            auto_target(job.targets) is not None,
        )
        progress.begin(source.info, _expected_frames(job, source.info))
        service.ready(f"following {source.info.name}")
        error: StreamtrackError | None = None
        ended = ""
        try:
            for step in chain([first], steps):
                watchers.watch(step)
                report.add(step)
                progress.advance(step)
                if is_over():
                    ended = f"interrupted after frame {step.frame.index}"
                    if not source.info.is_live:  # which ends in no other way
                        error = StreamtrackError(f"{ended}: everything up to there is written")
                    break
        except StreamtrackError as raised:
            error, ended = raised, str(raised)
        service.stopping()
        camera.close()  # from here on the poses are final
        failure = watchers.complete(progress.writing)
        error = error or failure
        live = live_source(source)
        summary = report.build(
            source.skipped,
            source.corrupt_packets,
            ended or _natural_end(job, source, report.frames, should_stop()),
            None if live is None else live.status(),
        )
        failure = watchers.finish(summary)
        error = error or failure
    return Outcome(summary, error)


def _check_outputs(job: TrackJob) -> None:
    """Refuse, before anything is opened, outputs that would replace each other or the source."""
    outputs = job.outputs
    if outputs.tracks is not None:
        check_tracks_path(outputs.tracks)
    if outputs.record is not None and outputs.record.suffix != ".rrd":
        raise UsageError(f"recording {outputs.record}: give it the ending .rrd")
    if outputs.mosaic is not None:
        check_picture_path(outputs.mosaic)
    sources = [job.source] if isinstance(job.source, str) else job.source
    taken = {Path(source).resolve(): f"the source {source}" for source in sources}
    for name in ("record", "tracks", "poses", "video", "summary", "mosaic", "stabilized"):
        path: Path | None = getattr(outputs, name)
        if path is None:
            continue
        if path.resolve() in taken and not _is_device(path):
            raise UsageError(f"{path} would replace {taken[path.resolve()]}: name another file")
        taken[path.resolve()] = f"the {name} output"


def _natural_end(job: TrackJob, source: FrameSource, frames: int, was_stopped: bool) -> str:
    if frames == job.frames:
        return f"{frames} frames, as asked"
    if was_stopped:
        return "stopped, as asked"  # while waiting for a picture of a live source
    return f"the source {source.shortfall}" if source.shortfall else "end of source"


def _is_device(path: Path) -> bool:
    return path.exists() and not path.is_file()


def _steps(job: TrackJob, source: FrameSource, camera: CameraEstimator) -> Generator[Step]:
    return track(
        source,
        job.targets,
        job.settings,
        start=job.start,
        step=job.step,
        frames=job.frames,
        camera=camera,
    )


def _expected_frames(job: TrackJob, info: SourceInfo) -> int | None:
    if info.frame_count is None:
        return job.frames
    available = max(0, -(-(info.frame_count - job.start) // job.step))
    return available if job.frames is None else min(available, job.frames)
