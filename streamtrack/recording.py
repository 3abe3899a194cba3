"""Recording a run for the Rerun viewer.

The file is the record of truth. Killed at any moment, a run leaves a file that opens and misses at
most the last `_FLUSH_EVERY_S` (``rerun rrd optimize`` mends its end). A disk that fills up ends the
recording with one warning, and tracking goes on.
"""

from __future__ import annotations

import datetime
import logging
import math
import os
import threading
import time
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import numpy.typing as npt
import rerun as rr

from streamtrack import blueprint, recorded_rows
from streamtrack.errors import OutputError
from streamtrack.recorded_target import TargetLog
from streamtrack.recorded_video import Clock, open_video, without_video
from streamtrack.settings import Settings
from streamtrack.types import Image, Mask, SourceInfo, Step, Track, TrackState
from streamtrack.viewer import view

__all__ = ["Recorder", "view"]

_log = logging.getLogger("streamtrack.recording")

_FLUSH_EVERY_S = 0.2
_FLUSH_BYTES = 1 << 19
_RESERVE_BYTES = 1 << 21
"""Space kept on the disk so that a recording can still be ended properly."""
_RESERVE_PICTURES = 8
_GROWTH_CHECK_S = 5.0
_MEND = "'rerun rrd optimize FILE -o WHOLE' makes the file so far whole"

_LEVELS = {
    logging.CRITICAL: "CRITICAL",
    logging.ERROR: "ERROR",
    logging.WARNING: "WARN",
    logging.INFO: "INFO",
    logging.DEBUG: "DEBUG",
}


class Recorder:
    """Writes each `Step` of a run to an .rrd file, with the layout to view it in.

    ``template_views`` are the targets' pictures as they were given, by name; a target without one
    gets its first close-up instead. Log records of the logger ``streamtrack`` go in as well.
    ``failed`` says why recording ended early, and is None while all is well. Raises OutputError
    if the file cannot be written.
    """

    def __init__(
        self,
        path: Path,
        source: SourceInfo,
        settings: Settings,
        target_names: Sequence[str],
        template_views: Mapping[str, Image] | None = None,
    ) -> None:
        self.path = path
        self.failed: str | None = None
        self._source = source
        self._lock = threading.RLock()
        self._templates = dict(template_views or {})
        self._frames = 0
        self._last_frame = (0, 0.0)
        self._picture_bytes = 0
        self._has_points = False
        self._stages: dict[str, str] = {}
        self._last_stages: set[str] = set()
        self._growth = (time.monotonic(), 0)
        self._is_closed = False
        _check_writable(path)

        timeline = "video_time" if source.is_live or source.rate_hz else "frame"
        layout = blueprint.build(source.size_wh, target_names, timeline)
        batching = rr.ChunkBatcherConfig.DEFAULT()
        batching.flush_tick = datetime.timedelta(seconds=_FLUSH_EVERY_S)
        batching.flush_num_bytes = _FLUSH_BYTES
        self._stream = rr.RecordingStream(blueprint.APPLICATION_ID, batcher_config=batching)
        try:
            self._stream.save(path, default_blueprint=layout)
        except (OSError, RuntimeError) as error:
            raise OutputError(f"recording {path} cannot be written: {error}") from None
        self._clock = Clock(self._stream, source.is_live)
        self._handler = _LogHandler(self)
        logging.getLogger("streamtrack").addHandler(self._handler)
        self._summary = _run_summary(source, settings, target_names)
        self._log_start(settings)
        self._target_count = len(target_names)
        self._targets: dict[str, TargetLog] = {}
        for name in target_names:
            self._target(name)
        self._video = open_video(self._stream, self._clock, source, settings.recording)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def is_recording(self) -> bool:
        return self.failed is None and not self._is_closed

    def log(self, step: Step) -> None:
        """Record all that one frame produced."""
        if not self.is_recording:
            return
        with self._lock:
            if (trouble := self._trouble_with_disk()) is not None:
                self._stop(trouble)
                return
            self._log_picture(step)
            self._last_frame = (step.frame.index, step.frame.time_s)
            self._clock.set(*self._last_frame)
            self._log_points(step)
            for track in step.tracks:
                message = self._target(track.name).log(step, track)
                if message:
                    self._log_line(_level_of(track.state), message)
            self._log_times(step)
            self._frames += 1

    def log_text(self, level: str, message: str) -> None:
        """Add a line to the log at the time of the last frame; levels are Python's names."""
        if not self.is_recording:
            return
        with self._lock:
            self._clock.set(*self._last_frame)  # the timelines are each thread's own
            self._log_line(level, message)

    def close(self, summary_markdown: str = "") -> None:
        """End the file; closing again does nothing."""
        if not self.is_recording:
            return
        with self._lock:
            self._video.close()
            text = summary_markdown or f"{self._summary}| frames | {self._frames} |\n"
            self._log_summary(text)
            if not self._finish():
                self.failed = "its end could not be written"
                _log.warning("recording %s is not complete: %s", self.path, _MEND)

    def _log_start(self, settings: Settings) -> None:
        source = self._source
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
        blueprint.log_styles(self._stream)
        self._log_summary(self._summary)

    def _log_summary(self, markdown: str) -> None:
        document = rr.TextDocument(markdown, media_type="text/markdown")
        self._stream.log(blueprint.SUMMARY, document, static=True)

    def _log_line(self, level: str, message: str) -> None:
        self._stream.log(blueprint.LOG, rr.TextLog(message, level=level))

    def _target(self, name: str) -> TargetLog:
        """The target's part of the recording, begun when it is first asked for."""
        if name not in self._targets:
            number, template = len(self._targets), self._templates.get(name)
            self._targets[name] = TargetLog(
                self._stream, name, number, max(self._target_count, number + 1), template
            )
        return self._targets[name]

    def _log_picture(self, step: Step) -> None:
        try:
            self._picture_bytes = self._video.log(step.frame)
        except OutputError as error:
            self._video = without_video()
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
        classes = np.full(len(points), blueprint.UNMATCHED, np.uint16)
        agreeing = [_classes(one.is_inlier) for one in evidence]
        if agreeing:
            paired = np.concatenate(agreeing)
            classes[len(points) - len(paired) :] = paired
        self._stream.log(blueprint.KEYPOINTS, recorded_rows.points(points, classes))
        self._log_lines(step.tracks)

    def _log_lines(self, tracks: Sequence[Track]) -> None:
        """How the points of the evidence moved since the step before."""
        lines = [np.zeros((0, 2, 2), np.float32)]
        classes = [np.zeros(0, np.uint16)]
        for track in tracks:
            start = self._target(track.name).points_before(track)
            if start is not None:
                lines.append(np.stack([start, track.evidence.frame_points], axis=1))
                classes.append(_classes(track.evidence.is_inlier))
        self._stream.log(
            blueprint.MATCHES, recorded_rows.strips(np.concatenate(lines), np.concatenate(classes))
        )

    def _log_times(self, step: Step) -> None:
        if step.features is not None:
            self._stream.log(blueprint.FEATURE_COUNT, recorded_rows.scalar(len(step.features)))
        for stage, milliseconds in step.stage_ms.items():
            self._stream.log(self._stage_path(stage), recorded_rows.scalar(milliseconds))
        for stage in self._last_stages - step.stage_ms.keys():
            self._stream.log(self._stage_path(stage), recorded_rows.scalar(math.nan))
        self._last_stages = set(step.stage_ms)

    def _stage_path(self, stage: str) -> str:
        if stage == "total":
            return blueprint.TOTAL_MS
        if stage not in self._stages:
            path = rr.new_entity_path([*blueprint.TOTAL_MS.split("/"), stage])
            blueprint.log_stage_style(self._stream, path, stage, len(self._stages))
            self._stages[stage] = path
        return self._stages[stage]

    def _trouble_with_disk(self) -> str | None:
        """Why recording has to end, before Rerun gives up by itself in the middle of a message."""
        reserve = _RESERVE_BYTES + _RESERVE_PICTURES * self._picture_bytes
        try:
            disk = os.statvfs(self.path.parent)
            if disk.f_bavail * disk.f_frsize < reserve:
                return "the disk is full"
            since, size = self._growth
            now = time.monotonic()
            if now - since > _GROWTH_CHECK_S:
                self._growth = (now, self.path.stat().st_size)
                if self._growth[1] == size:
                    self._stream.flush(timeout_sec=1.0)
        except OSError as error:
            return str(error.strerror or error)
        except (RuntimeError, ValueError) as error:
            return f"the file cannot be written any more ({error})"
        return None

    def _stop(self, reason: str) -> None:
        self.failed = reason
        self._log_line("ERROR", f"recording ended: {reason}")
        is_whole = self._finish()
        _log.warning(
            "recording to %s ended at frame %d: %s; tracking goes on, and %s",
            self.path,
            self._last_frame[0],
            reason,
            "the file so far is whole" if is_whole else _MEND,
        )

    def _finish(self) -> bool:
        """End the file; False if its end could not be written."""
        self._is_closed = True
        logging.getLogger("streamtrack").removeHandler(self._handler)
        is_whole = True
        try:
            self._stream.flush(timeout_sec=30.0)
        except (RuntimeError, ValueError):
            is_whole = False
        self._stream.disconnect()
        return is_whole


class _LogHandler(logging.Handler):
    """Routes log records of any thread into the recording."""

    def __init__(self, recorder: Recorder) -> None:
        super().__init__(logging.INFO)
        self._recorder = recorder

    def emit(self, record: logging.LogRecord) -> None:
        level = _LEVELS.get(record.levelno, record.levelname)
        self._recorder.log_text(level, record.getMessage())


def _check_writable(path: Path) -> None:
    """Make the folder and an empty file. Raises OutputError if that fails."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("wb"):
            pass
    except OSError as error:
        raise OutputError(f"recording {path}: {error.strerror or error}") from None


def _version() -> str:
    try:
        return version("streamtrack")
    except PackageNotFoundError:
        return "unknown"


def _run_summary(source: SourceInfo, settings: Settings, target_names: Sequence[str]) -> str:
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


def _classes(is_inlier: Mask) -> npt.NDArray[np.uint16]:
    return np.where(is_inlier, blueprint.INLIER, blueprint.OUTLIER).astype(np.uint16)


def _level_of(state: TrackState) -> str:
    return "WARN" if state is TrackState.LOST else "INFO"
