"""What a run adds to a stream, be it to a file or to a live view.

The stream may be cut into parts (files), each of which is complete by itself: `StepLog.begin`
records whatever is said once, and after it states are said again.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version

import numpy as np
import numpy.typing as npt
import rerun as rr

from streamtrack.errors import OutputError
from streamtrack.mosaic.types import PlacedFrame
from streamtrack.recording import blueprint, rows, styles
from streamtrack.recording.entities import (
    AGE_MS,
    FEATURE_COUNT,
    INLIER,
    KEYPOINTS,
    LOG,
    MATCHES,
    OUTLIER,
    SOURCE_COUNTS,
    SOURCE_STATE,
    SUMMARY,
    TOTAL_MS,
    UNMATCHED,
)
from streamtrack.recording.found import FoundLog
from streamtrack.recording.mosaic import MosaicLog
from streamtrack.recording.target import TargetLog
from streamtrack.recording.tracks import TracksTable
from streamtrack.recording.video import Clock, Video, without_video
from streamtrack.settings import Settings, WorldSettings
from streamtrack.sources.live_status import LiveState
from streamtrack.types import (
    Frame,
    Image,
    Mask,
    SourceInfo,
    Step,
    Track,
    TrackState,
)

_log = logging.getLogger("streamtrack.recording.recorder")


class StepLog:
    """Records each `Step` of a run, and what else happens, in a stream.

    ``templates`` are the targets' pictures as they were given, by name; a target without one gets
    its first close-up instead. ``video`` records the pictures; at first it records none.
    """

    def __init__(
        self,
        stream: rr.RecordingStream,
        clock: Clock,
        source: SourceInfo,
        settings: Settings,
        target_names: Sequence[str],
        templates: Mapping[str, Image],
        world: blueprint.World,
    ) -> None:
        self.frames = 0
        self.picture_bytes = 0
        self.last_frame = (0, 0.0)
        self.summary = run_summary(source, settings, target_names)
        self._stream = stream
        self._clock = clock
        self.video: Video = without_video()
        self._source = source
        self._settings = settings
        self._templates = dict(templates)
        self._target_count = len(target_names)
        self._targets: dict[str, TargetLog] = {}
        self._found = FoundLog(stream)
        self._mosaic = MosaicLog(stream)
        self._world = world
        self._table = TracksTable(stream, settings.world != WorldSettings())
        self._has_points = False
        self._stages: dict[str, str] = {}
        self._last_stages: set[str] = set()
        self._epoch = 0
        self._source_state = ""
        self._counts: dict[str, int] = {}
        for name in target_names:
            self._add_target(name)

    def begin(self) -> None:
        """Record what each part needs at its start."""
        self._log_properties()
        styles.log_styles(self._stream)
        if self._source.is_live:
            styles.log_source_styles(self._stream)
        self.log_summary(self.summary)
        for target in self._targets.values():
            target.begin(self._target_count)
        for number, (stage, path) in enumerate(self._stages.items()):
            styles.log_stage_style(self._stream, path, stage, number)
        self.video.begin()
        self._found.begin()
        self._mosaic.begin()
        self._table.begin()
        self._has_points = False
        if self._source_state:
            self._clock.set(*self.last_frame)
            self._log_source_state()

    def can_begin_at(self, frame: Frame) -> bool:
        """Whether a part may begin with this frame, the next to be recorded."""
        return self.video.can_begin_at(frame)

    def finish_before(self, frame: Frame) -> None:
        """Record what belongs to the part that ends before this frame, and how far it went."""
        self.video.finish_before(frame)
        self._log_end("")

    def log(self, step: Step) -> None:
        """Record all that one frame produced."""
        self._clock.follow(step.frame)
        self._log_picture(step)
        self.last_frame = (step.frame.index, step.frame.time_s)
        self._clock.set(*self.last_frame)
        if step.frame.epoch != self._epoch:
            self._epoch = step.frame.epoch
            self.log_line("WARN", f"frame {step.frame.index}: the source began anew")
        self._log_points(step)
        for track in step.tracks:
            if track.is_found:
                continue
            message = self._target(track.name).log(step, track)
            if message:
                self.log_line(_level_of(track.state), message)
        for message in self._found.log(step):
            self.log_line("INFO", message)
        self._log_times(step)
        self._table.follow(step)
        if self._world is blueprint.World.BACKGROUND:
            self._mosaic.log_world(step)
        else:
            self._mosaic.follow(step)
        self.frames += 1

    def log_text(self, level: str, message: str) -> None:
        """A line for the log at the time of the last frame; the timelines are each thread's own."""
        self._clock.set(*self.last_frame)
        self.log_line(level, message)

    def log_line(self, level: str, message: str) -> None:
        self._stream.log(LOG, rr.TextLog(message, level=level))

    def log_source(self, state: str, counts: Mapping[str, int], time_s: float | None) -> None:
        """The state of a live source, and its counts (frames dropped, lost ...) so far."""
        index, last_s = self.last_frame
        self._clock.set(index, last_s if time_s is None else time_s)
        if state != self._source_state:
            self._source_state = state
            self._log_source_state()
            if state in (LiveState.STALLED, LiveState.WAITING):
                for target in self._targets.values():
                    target.pause()
        for number, (name, count) in enumerate(counts.items()):
            path = rr.new_entity_path([*SOURCE_COUNTS.split("/"), name])
            if name not in self._counts:
                styles.log_stage_style(self._stream, path, name, number)
            if self._counts.get(name) != count:
                self._counts[name] = count
                self._stream.log(path, rows.scalar(count))

    def log_mosaic_frame(self, placed: PlacedFrame) -> None:
        """Where a frame came to lie on the mosaic; a change of state is a line in the log."""
        self._clock.set(placed.index, placed.time_s)
        if self._mosaic.log_frame(placed):
            level = "WARN" if placed.state == "lost" else "INFO"
            why = f": {placed.reason}" if placed.reason else ""
            self.log_line(level, f"frame {placed.index}: mosaic {placed.state}{why}")

    @property
    def mosaic(self) -> MosaicLog:
        """Where a mosaic is recorded; the clock must have been set."""
        return self._mosaic

    def set_time(self, index: int, time_s: float) -> None:
        self._clock.set(index, time_s)

    def log_summary(self, markdown: str) -> None:
        document = rr.TextDocument(markdown, media_type="text/markdown")
        self._stream.log(SUMMARY, document, static=True)

    def close(self, summary_markdown: str = "") -> None:
        """Record what was held back, and the summary."""
        self.video.close()
        self._clock.set(*self.last_frame)
        self._mosaic.log_last_view()
        self._mosaic.log_paths()
        self._log_end(summary_markdown)

    def _log_end(self, summary_markdown: str) -> None:
        self.log_summary(summary_markdown or f"{self.summary}| frames | {self.frames} |\n")

    def _log_properties(self) -> None:
        source, settings = self._source, self._settings
        self._stream.send_recording_name(source.name)
        self._stream.send_recording_start_time_nanos(time.time_ns())
        self._stream.send_property(
            "run",
            rr.AnyValues(
                version=_version(),
                source=source.name,
                detector=settings.features.detector,
                descriptor=settings.features.descriptor,
                width=source.size_wh[0],
                height=source.size_wh[1],
                rate_hz=math.nan if source.rate_hz is None else source.rate_hz,
                settings=settings.model_dump_json(),
            ),
        )

    def _log_source_state(self) -> None:
        self._stream.log(SOURCE_STATE, rr.StateChange(state=self._source_state))

    def _target(self, name: str) -> TargetLog:
        """The target's part of the recording, begun when it is first asked for."""
        if name not in self._targets:
            target = self._add_target(name)
            self._target_count = max(self._target_count, len(self._targets))
            target.begin(self._target_count)
        return self._targets[name]

    def _add_target(self, name: str) -> TargetLog:
        target = TargetLog(self._stream, name, len(self._targets), self._templates.get(name))
        self._targets[name] = target
        return target

    def _log_picture(self, step: Step) -> None:
        try:
            self.picture_bytes = self.video.log(step.frame)
        except OutputError as error:
            self.video = without_video()
            _log.warning("from frame %d on no picture is recorded: %s", step.frame.index, error)

    def _log_points(self, step: Step) -> None:
        """Points and lines of all targets, in one batch each; the important ones drawn last."""
        evidence = [track.evidence for track in step.tracks]
        loose = [one.unmatched_points for one in evidence]
        if step.features is not None and not any(len(points) for points in loose):
            loose.append(step.features.points)
        found = [one.frame_points for one in evidence]
        points = np.concatenate([*loose, *found]) if loose else np.zeros((0, 2), np.float32)
        if not self._has_points and not len(points):
            return
        self._has_points = len(points) > 0
        classes = np.full(len(points), UNMATCHED, np.uint16)
        agreeing = [_classes(one.is_inlier) for one in evidence]
        if agreeing:
            paired = np.concatenate(agreeing)
            classes[len(points) - len(paired) :] = paired
        self._stream.log(KEYPOINTS, rows.points(points, classes))
        self._log_lines(step.tracks)

    def _log_lines(self, tracks: Sequence[Track]) -> None:
        """How the points of the evidence moved since the step before."""
        lines = [np.zeros((0, 2, 2), np.float32)]
        classes = [np.zeros(0, np.uint16)]
        for track in tracks:
            if track.is_found:
                continue
            start = self._target(track.name).points_before(track)
            if start is not None:
                lines.append(np.stack([start, track.evidence.frame_points], axis=1))
                classes.append(_classes(track.evidence.is_inlier))
        self._stream.log(MATCHES, rows.strips(np.concatenate(lines), np.concatenate(classes)))

    def _log_times(self, step: Step) -> None:
        if step.features is not None:
            self._stream.log(FEATURE_COUNT, rows.scalar(len(step.features)))
        captured = step.frame.captured_unix_s
        if captured is not None:
            age_ms = 1e3 * (time.time() - captured)
            self._stream.log(AGE_MS, rows.scalar(age_ms))
        for stage, milliseconds in step.stage_ms.items():
            self._stream.log(self._stage_path(stage), rows.scalar(milliseconds))
        for stage in self._last_stages - step.stage_ms.keys():
            self._stream.log(self._stage_path(stage), rows.scalar(math.nan))
        self._last_stages = set(step.stage_ms)

    def _stage_path(self, stage: str) -> str:
        if stage == "total":
            return TOTAL_MS
        if stage not in self._stages:
            path = rr.new_entity_path([*TOTAL_MS.split("/"), stage])
            styles.log_stage_style(self._stream, path, stage, len(self._stages))
            self._stages[stage] = path
        return self._stages[stage]


def run_summary(source: SourceInfo, settings: Settings, target_names: Sequence[str]) -> str:
    """What is known of a run before its first frame, as Markdown."""
    rate = "" if source.rate_hz is None else f", {source.rate_hz:g} Hz"
    rows = {
        "source": source.name,
        "picture": f"{source.size_wh[0]} x {source.size_wh[1]}{rate}",
        "targets": ", ".join(target_names) or "none",
        "detector": settings.features.detector,
        "descriptor": settings.features.descriptor,
        "method": settings.tracker.method,
        "model": settings.registration.model,
        "camera": settings.camera,
    }
    lines = [f"| {key} | {value.replace('|', '/')} |\n" for key, value in rows.items()]
    return f"# {source.name}\n\n| | |\n|---|---|\n" + "".join(lines)


def _version() -> str:
    try:
        return version("streamtrack")
    except PackageNotFoundError:
        return "unknown"


def _classes(is_inlier: Mask) -> npt.NDArray[np.uint16]:
    return np.where(is_inlier, INLIER, OUTLIER).astype(np.uint16)


def _level_of(state: TrackState) -> str:
    return "WARN" if state is TrackState.LOST else "INFO"
