"""Recording a run for the Rerun viewer.

The file is the record of truth. Killed at any moment, a run leaves a file that opens and misses at
most the last 0.2 s; the next run of the same series mends its end. A disk that fills up ends the
recording with one warning, and tracking goes on; a recording in several files goes on as well, in
a new one, once there is room.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from streamtrack.closing import Closing
from streamtrack.errors import OutputError
from streamtrack.mosaic.types import MosaicView, PlacedFrame
from streamtrack.recording import blueprint
from streamtrack.recording.file import RecordingFiles, free_bytes, new_stream, reserve_bytes
from streamtrack.recording.repair import is_whole, mend
from streamtrack.recording.series import FileSeries, Limit, check_keep, parse_keep, parse_rotate
from streamtrack.recording.steps import StepLog
from streamtrack.recording.video import Clock, open_video
from streamtrack.settings import Settings
from streamtrack.types import Image, SourceInfo, Step
from streamtrack.viewer import view

__all__ = ["Recorder", "RunLogHandler", "timeline_of", "view"]

_log = logging.getLogger("streamtrack.recording.recorder")

_MEND = "'rerun rrd optimize FILE -o WHOLE' makes the file so far whole"
_RESUME_EVERY_S = 60.0
_RESUME_BYTES = 1 << 25
"""Space that must be free, beyond the reserve, before a recording that had ended goes on."""
_TIDY_EVERY_S = 60.0
_TIDY_END_S = 1.0
_LATE = 2.0
"""A new file begins without a keyframe once the one before is so many times too large or old."""

_LEVELS = {
    logging.CRITICAL: "CRITICAL",
    logging.ERROR: "ERROR",
    logging.WARNING: "WARN",
    logging.INFO: "INFO",
    logging.DEBUG: "DEBUG",
}


class Recorder(Closing):
    """Writes each `Step` of a run to an .rrd file, with the layout to view it in.

    With ``settings.recording.rotate`` it becomes a series of files beside ``path``, each complete
    by itself (`streamtrack.recording.series`); with ``keep`` the oldest of them are removed.
    ``template_views`` are the targets' pictures as they were given, by name; a target without one
    gets its first close-up instead. Log records of the logger ``streamtrack`` go in as well.
    ``path`` is the file that is being written; ``failed`` says why recording ended early, and is
    None while all is well. Raises OutputError if the file cannot be written.
    """

    def __init__(
        self,
        path: Path,
        source: SourceInfo,
        settings: Settings,
        target_names: Sequence[str],
        template_views: Mapping[str, Image] | None = None,
        has_mosaic: bool = False,
        finds_targets: bool = False,
    ) -> None:
        self.failed: str | None = None
        self._source = source
        self._lock = threading.RLock()
        self._is_closed = False
        self._began = (0.0, 0.0)
        self._resume_at = 0.0
        self._rotate = parse_rotate(settings.recording.rotate)
        keep = parse_keep(settings.recording.keep)
        check_keep(self._rotate, keep)
        self._series = None if self._rotate is None else FileSeries(path)
        self.path = path if self._series is None else self._series.next_path()

        world = blueprint.World.MOSAIC if has_mosaic else blueprint.World.BACKGROUND
        layout = blueprint.build(
            source.size_wh,
            target_names,
            timeline_of(source),
            world,
            source.is_live,
            finds_targets=finds_targets,
        )
        self._stream = new_stream()
        self._files = RecordingFiles(self._stream, layout)
        clock = Clock(self._stream, source.is_live)
        has_parts = self._series is not None
        self._files.open(self.path)
        self._steps = StepLog(
            self._stream, clock, source, settings, target_names, template_views or {}, world
        )
        self._handler = RunLogHandler(self.log_text)
        self._handler.attach()
        self._steps.video = open_video(self._stream, clock, source, settings.recording, has_parts)
        self._steps.begin()
        self._tidier = None
        if self._series is not None:
            reserve = 0 if self._rotate is None else self._rotate.size_bytes or 0
            self._tidier = _Tidier(self._series, keep, reserve)

    @property
    def is_recording(self) -> bool:
        return self.failed is None and not self._is_closed

    def log(self, step: Step) -> None:
        """Record all that one frame produced."""
        if self._is_closed or (self.failed is not None and not self._resumed()):
            return
        with self._lock:
            trouble = self._files.trouble(self._steps.picture_bytes)
            if trouble is None and self._is_next_due(step):
                trouble = self._begin_next(step)
            if trouble is not None:
                self._stop(trouble)
                return
            if self._steps.frames == 0:
                self._began = self._now(step)
            self._steps.log(step)

    def log_text(self, level: str, message: str) -> None:
        """Add a line to the log at the time of the last frame; levels are Python's names."""
        if self.is_recording:
            with self._lock:
                self._steps.log_text(level, message)

    def log_source(
        self, state: str, counts: Mapping[str, int] | None = None, time_s: float | None = None
    ) -> None:
        """The state of a live source (connecting, streaming, stalled, waiting, ended).

        ``counts`` says how many frames were not seen so far, by the reason (``dropped``, ``lost``
        ...), ``time_s`` when that was on the source's clock, by default at the last frame. Only
        what changed is recorded.
        """
        if self.is_recording:
            with self._lock:
                self._steps.log_source(state, counts or {}, time_s)

    def is_mosaic_due(self, time_s: float) -> bool:
        """Whether `log_mosaic` would record a view of the frame at this time; else spare it."""
        return self.is_recording and self._steps.mosaic.is_image_due(time_s)

    def log_mosaic(self, view: MosaicView, index: int, time_s: float) -> None:
        """Record the mosaic as it is after a frame, at most once a second of the source's clock,
        and the last one at the end."""
        if self.is_recording:
            with self._lock:
                self._steps.set_time(index, time_s)
                self._steps.mosaic.log_view(view, time_s)

    def log_mosaic_frame(self, placed: PlacedFrame) -> None:
        """Record where a frame came to lie on the mosaic, after its `log`."""
        if self.is_recording:
            with self._lock:
                self._steps.log_mosaic_frame(placed)

    def close(self, summary_markdown: str = "") -> None:
        """End the file; closing again does nothing."""
        if self._is_closed:
            return
        if self._tidier is not None:
            self._tidier.close()  # its lines still go into the log
        with self._lock:
            was_recording, self._is_closed = self.is_recording, True
            self._handler.detach()
            if not was_recording:
                return
            self._steps.close(summary_markdown)
            if not self._files.close():
                self.failed = "its end could not be written"
                _log.warning("recording %s is not complete: %s", self.path, _MEND)

    def _now(self, step: Step) -> tuple[float, float]:
        """The source's clock and this machine's."""
        return step.frame.time_s, time.monotonic()

    def _is_next_due(self, step: Step) -> bool:
        if self._rotate is None or self._steps.frames == 0:
            return False
        video_s, wall_s = (
            now - then for now, then in zip(self._now(step), self._began, strict=True)
        )
        age_s = wall_s if self._source.is_live else video_s
        size = self._files.size_bytes() + self._steps.picture_bytes
        if not self._rotate.is_reached(size, age_s):
            return False
        is_late = self._rotate.is_reached(size / _LATE, age_s / _LATE)
        return is_late or self._steps.can_begin_at(step.frame)

    def _begin_next(self, step: Step) -> str | None:
        """Go on in a new file from this frame on; what is wrong if that fails."""
        assert self._series is not None
        self._steps.finish_before(step.frame)
        try:
            path = self._series.next_path()
            self._files.open(path)
        except OutputError as error:
            return str(error)
        self.path = path
        self._began = self._now(step)
        self._steps.begin()
        if self._tidier is not None:
            self._tidier.wake()
        return None

    def _stop(self, reason: str) -> None:
        self._steps.log_text("ERROR", f"recording ended: {reason}")
        self.failed = reason  # from here on no line of the log goes in
        self._resume_at = time.monotonic() + _RESUME_EVERY_S
        is_file_whole = self._files.close()
        _log.warning(
            "recording to %s ended at frame %d: %s; tracking goes on, and %s",
            self.path,
            self._steps.last_frame[0],
            reason,
            "the file so far is whole" if is_file_whole else _MEND,
        )

    def _resumed(self) -> bool:
        """Whether a series goes on in a new file, which is tried once a minute."""
        now = time.monotonic()
        if self._series is None or now < self._resume_at:
            return False
        self._resume_at = now + _RESUME_EVERY_S
        wanted = reserve_bytes(self._steps.picture_bytes) + _RESUME_BYTES
        with self._lock:
            try:
                if free_bytes(self.path.parent) < wanted:
                    return False
                path = self._series.next_path()
                self._files.open(path)
            except (OSError, OutputError):
                return False
            self.path, self.failed = path, None
            self._began = (self._steps.last_frame[1], now)
            self._steps.begin()
        _log.warning("recording goes on in %s", path)
        return True


class RunLogHandler(logging.Handler):
    """Routes log records of the package, of any thread, to ``log_text(level, message)``.

    From INFO on, whatever is shown elsewhere; at the end the logger's level is as it was.
    """

    def __init__(self, log_text: Callable[[str, str], None]) -> None:
        super().__init__(logging.INFO)
        self._log_text = log_text
        self._logger = logging.getLogger("streamtrack")
        self._level_before: int | None = None

    def attach(self) -> None:
        if not self._logger.isEnabledFor(logging.INFO):
            self._level_before = self._logger.level
            self._logger.setLevel(logging.INFO)
        self._logger.addHandler(self)

    def detach(self) -> None:
        self._logger.removeHandler(self)
        if self._level_before is None:
            return
        for other in self._logger.handlers:
            if isinstance(other, RunLogHandler):
                other._level_before = self._level_before  # it is left to the last one
                return
        self._logger.setLevel(self._level_before)

    def handle(self, record: logging.LogRecord) -> bool:
        """Without the handler's own lock, which would be taken in either order with the others."""
        is_wanted = bool(self.filter(record))
        if is_wanted:
            self.emit(record)
        return is_wanted

    def emit(self, record: logging.LogRecord) -> None:
        self._log_text(_LEVELS.get(record.levelno, record.levelname), record.getMessage())


class _Tidier:
    """Mends what a killed run left, once, and removes what is not to be kept, aside of tracking."""

    def __init__(self, series: FileSeries, keep: Limit | None, reserve_bytes: int) -> None:
        self._series = series
        self._keep = keep
        self._reserve = reserve_bytes
        self._wake = threading.Event()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recording-files", daemon=True)
        self._thread.start()

    def wake(self) -> None:
        """A new file was begun."""
        self._wake.set()

    def close(self) -> None:
        self._end.set()
        self._wake.set()
        self._thread.join(_TIDY_END_S)

    def _run(self) -> None:
        self._remove()
        self._mend()
        while not self._end.is_set():
            self._wake.wait(_TIDY_EVERY_S)
            self._wake.clear()
            self._remove()

    def _mend(self) -> None:
        try:
            unfinished = [path for path in self._series.paths() if not is_whole(path)]
        except OSError as error:
            _log.warning("the recordings so far cannot be read: %s", error)
            return
        for path in unfinished:
            if not self._end.is_set() and (message := mend(path, self._end)):
                _log.warning("%s", message)

    def _remove(self) -> None:
        if self._keep is None:
            return
        try:
            for path, reason in self._series.remove_beyond(self._keep, self._reserve):
                _log.info("removed %s: %s", path, reason)
        except OSError as error:
            _log.warning("old recordings cannot be removed: %s", error.strerror or error)


def timeline_of(source: SourceInfo) -> str:
    """The timeline that the viewer opens with."""
    return "video_time" if source.is_live or source.rate_hz else "frame"
