"""Who looks at a run's Steps: tables, pictures, recording, live view, mosaic.

Watchers watch and decide nothing. Each is a function of a `Step`. When the last one has gone by
and all poses are final, a completer is called once with what to tell of its progress, and then a
finisher with the summary.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeAlias

from streamtrack.camera.moving import CameraEstimator
from streamtrack.camera.notes import CameraNotes
from streamtrack.errors import OutputError, StreamtrackError
from streamtrack.mosaic.types import PlacedFrame
from streamtrack.outputs import check_writable
from streamtrack.poses import FinalPoses, PosesWriter
from streamtrack.results import GROUND_COLUMNS, TRACK_COLUMNS, open_tracks_writer
from streamtrack.settings import Settings, WorldSettings
from streamtrack.sources.base import FrameSource
from streamtrack.types import Image, SourceInfo, Step
from streamtrack.working_size import graph_in_full_size

if TYPE_CHECKING:
    from streamtrack.mosaic.stream.export import Exported
    from streamtrack.mosaic.stream.growing import StreamMosaic
    from streamtrack.pose_graph import PoseGraph
    from streamtrack.recording.live_server import LiveAddress
    from streamtrack.recording.live_view import LiveView
    from streamtrack.recording.recorder import Recorder
    from streamtrack.sources.live import LiveSource

Watcher: TypeAlias = Callable[[Step], None]
Completer: TypeAlias = Callable[[Callable[[str], None]], None]


class RunSummary(Protocol):
    """What a run was and did, for people and programs."""

    def to_markdown(self) -> str: ...

    def write_json(self, path: Path) -> None: ...


Finisher: TypeAlias = Callable[[RunSummary], None]

_FALLBACK_RATE_HZ = 30.0
_COUNTS_EVERY_S = 1.0
_SHOWN_COUNTS = ("dropped", "thinned", "lost", "damaged")

_log = logging.getLogger("streamtrack.run")


@dataclass(frozen=True, slots=True)
class Outputs:
    """Where the results go; None where they are not wanted.

    ``shows_mosaic`` has a mosaic grown for recording and live view though no file is wanted.
    """

    record: Path | None = None
    tracks: Path | None = None
    poses: Path | None = None
    video: Path | None = None
    summary: Path | None = None
    mosaic: Path | None = None
    live: LiveAddress | None = None
    stabilized: Path | None = None
    shows_mosaic: bool = False

    @property
    def has_mosaic(self) -> bool:
        return self.shows_mosaic or self.mosaic is not None


@dataclass(slots=True)
class Watchers:
    """All of one run's; what an output needs at the end is in the exit stack it was opened with.

    None of them watches before `open_watchers`.
    """

    watchers: list[Watcher] = field(default_factory=list)
    completers: list[Completer] = field(default_factory=list)
    finishers: list[Finisher] = field(default_factory=list)
    recorder: Recorder | None = None
    mosaic: MosaicWatcher | None = None
    live: LiveWatcher | None = None

    def watch(self, step: Step) -> None:
        for watcher in self.watchers:
            watcher(step)

    def wait(self) -> None:
        """To be called while no step comes: a live source may have something to say."""
        if self.live is not None:
            self.live.tell()

    def status(self) -> str:
        """How a live source does, in a few words; empty for others."""
        return "" if self.live is None else str(self.live)

    def complete(self, advance: Callable[[str], None]) -> StreamtrackError | None:
        """Do what waited for the final poses; returns the first thing that went wrong."""
        failure: StreamtrackError | None = None
        for completer in self.completers:
            try:
                completer(advance)
            except StreamtrackError as error:
                failure = failure or error
        return failure

    def finish(self, summary: RunSummary) -> StreamtrackError | None:
        """Close all outputs; returns what went wrong with one that did not stop the run."""
        self.wait()
        failure: StreamtrackError | None = None
        for finisher in self.finishers:
            try:
                finisher(summary)
            except StreamtrackError as error:
                failure = failure or error
        recorder = self.recorder
        if failure is None and recorder is not None and recorder.failed is not None:
            failure = OutputError(
                f"the recording {recorder.path} ended early ({recorder.failed}); "
                "all else is complete"
            )
        return failure


def open_watchers(
    result: Watchers,
    outputs: Outputs,
    source: FrameSource,
    settings: Settings,
    views: Mapping[str, Image | None],
    camera: CameraEstimator,
    stack: ExitStack,
    finds_targets: bool = False,
) -> None:
    """Open every output that is wanted; ``views`` holds each target's template picture or None.

    ``finds_targets`` where more of them may come by themselves.

    Raises OutputError.
    """
    info = source.info
    for at_the_end in (outputs.mosaic, outputs.summary):
        if at_the_end is not None:
            check_writable(at_the_end)
    if outputs.summary is not None:
        result.finishers.append(_summary_finisher(outputs.summary))
    if outputs.tracks is not None:
        columns = TRACK_COLUMNS
        if settings.world != WorldSettings():
            columns += GROUND_COLUMNS
        tracks = stack.enter_context(open_tracks_writer(outputs.tracks, columns))
        result.watchers.append(tracks.write)
    if outputs.video is not None:
        result.watchers.append(_video_watcher(outputs.video, info, stack))
    graph = graph_in_full_size(camera.graph, info.size_wh, settings.max_width)
    if outputs.stabilized is not None:
        _add_stabilized(outputs.stabilized, info, settings, graph, stack, result)
    displays = _open_displays(outputs, info, settings, views, finds_targets, stack, result)
    result.watchers.extend(display.log for display in displays)
    result.watchers.append(_camera_watcher(settings))
    if outputs.has_mosaic:
        from streamtrack.mosaic.stream.growing import StreamMosaic

        mosaic = stack.enter_context(StreamMosaic(settings.mosaic, graph))
        result.mosaic = MosaicWatcher(outputs.mosaic, mosaic, displays)
        result.watchers.append(result.mosaic.watch)
        result.completers.append(result.mosaic.finish)
    if outputs.poses is not None:
        _add_poses(outputs.poses, source, graph, stack, result)
    live = live_source(source)
    if live is not None:
        result.live = LiveWatcher(live, displays)
        result.watchers.append(result.live.watch)
    # The live view first: it ends by itself while the recording is closed.
    result.finishers.extend(_closer(display) for display in reversed(displays))


def _camera_watcher(settings: Settings) -> Watcher:
    """Says what the camera was found to be, and at once if it is not what it was said to be."""
    notes = CameraNotes()
    advice = "its place in the world is not known while that is so; --camera auto follows it"

    def watch(step: Step) -> None:
        note = notes.follow(step)
        if note is not None and note.is_warning and settings.camera == "fixed":
            _log.warning("%s: %s", note.text, advice)
        elif note is not None:
            _log.info("camera: %s", note.text)

    return watch


def live_source(source: FrameSource) -> LiveSource | None:
    """The source as a live one, if it is."""
    from streamtrack.sources.live import LiveSource

    return source if isinstance(source, LiveSource) else None


def _open_displays(
    outputs: Outputs,
    info: SourceInfo,
    settings: Settings,
    views: Mapping[str, Image | None],
    finds_targets: bool,
    stack: ExitStack,
    result: Watchers,
) -> list[Recorder | LiveView]:
    """The recording and the live view: both take the same."""
    displays: list[Recorder | LiveView] = []
    pictures = {name: picture for name, picture in views.items() if picture is not None}
    about = (info, settings, list(views), pictures, outputs.has_mosaic, finds_targets)
    if outputs.record is not None:
        from streamtrack.recording.recorder import Recorder

        result.recorder = stack.enter_context(Recorder(outputs.record, *about))
        displays.append(result.recorder)
    if outputs.live is not None:
        from streamtrack.recording.live_view import LiveView

        displays.append(stack.enter_context(LiveView(outputs.live, *about)))
    return displays


def _closer(display: Recorder | LiveView) -> Finisher:
    from streamtrack.recording.live_view import LiveView

    close = display.begin_close if isinstance(display, LiveView) else display.close
    return lambda summary: close(summary.to_markdown())


class MosaicWatcher:
    """Grows a mosaic with the run, and writes it if a path is given; targets are left out of it.

    ``reason`` says why the last frame has no place in it, ``paint_ms`` what that frame cost, and
    ``exported`` what was written.
    """

    def __init__(
        self,
        path: Path | None,
        mosaic: StreamMosaic,
        displays: Sequence[Recorder | LiveView],
    ) -> None:
        self.mosaic = mosaic
        self.reason = ""
        self.paint_ms = 0.0
        self.exported: Exported | None = None
        self._path = path
        self._displays = displays
        self._last: tuple[int, float] | None = None

    def watch(self, step: Step) -> None:
        frame, pose = step.frame, step.camera
        began = time.perf_counter()
        reason = self.reason = self.mosaic.add(frame, pose, step.tracks)
        self.paint_ms = (time.perf_counter() - began) * 1e3
        self._last = frame.index, frame.time_s
        world_from_frame = None if reason else pose.world_from_frame
        state = "placed" if not reason else "lost" if pose.world_from_frame is None else "refused"
        found = {
            "inliers": float(pose.inliers),
            "rmse_px": pose.rmse_px,
            "sigma_px": pose.sigma_px,
            "paint_ms": self.paint_ms,
        }
        metrics = {name: value for name, value in found.items() if math.isfinite(value)}
        placed = PlacedFrame(
            frame.index, frame.time_s, frame.size_wh, state, world_from_frame, reason, metrics
        )
        for display in self._displays:
            display.log_mosaic_frame(placed)
            if display.is_mosaic_due(frame.time_s):
                display.log_mosaic(self.mosaic.view(), frame.index, frame.time_s)

    def finish(self, advance: Callable[[str], None]) -> None:
        """Take over the final poses and write the picture. Raises OutputError."""
        self.exported = self.mosaic.finish(self._path, advance)
        for display in self._displays:
            if self._last is not None:
                display.log_mosaic(self.mosaic.view(), *self._last)


class LiveWatcher:
    """Tells the displays how a live source does, and the source when its frame is done with."""

    def __init__(self, source: LiveSource, displays: Sequence[Recorder | LiveView]) -> None:
        self._source = source
        self._displays = displays
        self._state = ""
        self._counted_s = 0.0

    def watch(self, step: Step) -> None:
        """The last to watch a step."""
        self._source.note_output(step.frame)
        self.tell()

    def tell(self) -> None:
        """Changes of state at once, counts with them and once a second."""
        events = self._source.drain_events()
        now_s = time.monotonic()
        if not events and now_s - self._counted_s < _COUNTS_EVERY_S:
            return
        self._counted_s = now_s
        status = self._source.status()
        counts = {name: getattr(status, name) for name in _SHOWN_COUNTS}
        for display in self._displays:
            for event in events:
                display.log_source(str(event.state), time_s=event.time_s)
        if events:
            self._state = str(events[-1].state)
        for display in self._displays:
            display.log_source(self._state, counts)

    def __str__(self) -> str:
        """How the source does, in a few words."""
        status = self._source.status()
        counts = [f"{name} {getattr(status, name)}" for name in _SHOWN_COUNTS]
        return f"{status.state}, {status.captured} pictures, {', '.join(counts)}"


def _summary_finisher(path: Path) -> Finisher:
    return lambda summary: summary.write_json(path)


def _add_poses(
    path: Path, source: FrameSource, graph: PoseGraph | None, stack: ExitStack, result: Watchers
) -> None:
    """Write poses as they come; of a file, where they may still change, all of them at the end."""
    poses = stack.enter_context(PosesWriter(path))
    final = None if graph is None or source.info.is_live else FinalPoses(poses, graph)
    add = poses.write_pose if final is None else final.add

    def watch(step: Step) -> None:
        frame, pose = step.frame, step.camera
        reason = pose.reason if result.mosaic is None else result.mosaic.reason
        world_from_frame = None if reason else pose.world_from_frame
        add(frame.index, frame.name, frame.time_s, world_from_frame, reason, pose.sigma_px)

    def complete(_advance: object) -> None:
        if final is not None:
            final.write()
        for skipped in source.skipped:
            poses.write_skipped(skipped)

    result.watchers.append(watch)
    result.completers.append(complete)


def _video_watcher(path: Path, info: SourceInfo, stack: ExitStack) -> Watcher:
    from streamtrack.overlay import Trails, draw_step
    from streamtrack.sources.writer import VideoWriter

    rate_hz = info.rate_hz or _FALLBACK_RATE_HZ
    writer = stack.enter_context(VideoWriter(path, rate_hz=rate_hz))
    trails = Trails()

    def watch(step: Step) -> None:
        writer.write(draw_step(step, trail=trails.follow(step)), step.frame.time_s)

    return watch


def _add_stabilized(
    path: Path,
    info: SourceInfo,
    settings: Settings,
    graph: PoseGraph | None,
    stack: ExitStack,
    result: Watchers,
) -> None:
    """Write the video held still; what a smooth path holds back comes at the end."""
    from streamtrack.sources.writer import VideoWriter
    from streamtrack.stabilizing import make_stabilizer

    view = make_stabilizer(settings.stabilize, graph)
    rate_hz = info.rate_hz or _FALLBACK_RATE_HZ
    writer = stack.enter_context(VideoWriter(path, rate_hz=rate_hz))

    def watch(step: Step) -> None:
        for shown in view.add(step):
            writer.write(shown.image, shown.time_s)

    def finish(_summary: RunSummary) -> None:
        for shown in view.finish():
            writer.write(shown.image, shown.time_s)
        if view.unplaced:
            _log.warning("%d frames could not be placed in %s", view.unplaced, path)

    result.watchers.append(watch)
    result.finishers.append(finish)
