"""Watching a run as it happens: the Rerun viewer on a page, or its own window, over gRPC.

    tracker --Step--> bounded queue (oldest goes) --> thread: small picture, rows, bytes --> pipe
        --> process of its own (`rerun -`): keeps the last data and serves any number of viewers

The tracker only ever puts a Step into the queue. Whatever viewers do (none, slow, frozen, killed),
it meets the process and, if that stops reading, the thread; the queue then loses its oldest, and
a process that does not read for long, ends, or grows too large is started anew.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import rerun as rr
import rerun_bindings

from streamtrack.closing import Closing
from streamtrack.errors import OutputError
from streamtrack.geometry import inverted, scaling
from streamtrack.mosaic.types import MosaicView, PlacedFrame
from streamtrack.recording import blueprint
from streamtrack.recording.file import Layout, new_stream
from streamtrack.recording.live_server import LiveAddress, LiveServer, ServerError, check_free
from streamtrack.recording.recorder import RunLogHandler, timeline_of
from streamtrack.recording.steps import StepLog
from streamtrack.recording.video import Clock, jpeg_video
from streamtrack.settings import Settings
from streamtrack.types import Image, SourceInfo, Step
from streamtrack.working_size import mapped_features, mapped_track, reduced

_log = logging.getLogger("streamtrack.live")

_MAX_QUEUE = 8
_MAX_RATE_HZ = 15.0
_MAX_SIDE = 640
_JPEG_QUALITY = 75
_RESTART_S = (1.0, 60.0)
_POLL_S = 0.2
_HAND_OVER_S = 0.15
"""What comes within it is handed over together: of each message that it reads from a pipe, the
process keeps 1 to 3 KB for ever (Rerun 0.41), whatever its limit; `LiveServer.check` ends it then.
"""
_LAST_LOOK_S = 0.2
"""Left to the process to hand on what came last, before it is ended."""


class LiveView(Closing):
    """Shows each `Step` of a run to whoever connects; takes what a `Recorder` takes.

    Every call returns at once. ``dropped`` counts what was not shown because the viewer's side
    was too slow; pictures are at most 640 px a side, as JPEG, at most 15 a second. Raises
    OutputError if the address is taken or there is no viewer to serve.
    """

    def __init__(
        self,
        address: LiveAddress,
        source: SourceInfo,
        settings: Settings,
        target_names: Sequence[str],
        template_views: Mapping[str, Image] | None = None,
        has_mosaic: bool = False,
        finds_targets: bool = False,
    ) -> None:
        self.address = address
        self.dropped = 0
        self._factor = min(1.0, _MAX_SIDE / max(source.size_wh))
        small = {
            name: reduced(picture, self._factor) for name, picture in (template_views or {}).items()
        }
        size_wh = round(source.size_wh[0] * self._factor), round(source.size_wh[1] * self._factor)
        world = blueprint.World.MOSAIC if has_mosaic else blueprint.World.BACKGROUND
        self._layout = Layout(
            blueprint.build(
                size_wh,
                target_names,
                timeline_of(source),
                world,
                source.is_live,
                finds_targets=finds_targets,
            )
        )
        self._stream = new_stream()
        self._clock = Clock(self._stream, source.is_live)
        self._run_facts = source, settings, target_names, small, world
        self._last_s = 0.0
        self._last_mosaic_s = 0.0
        self._waiting: queue.Queue[Callable[[StepLog], object]] = queue.Queue(_MAX_QUEUE)
        self._end = threading.Event()
        check_free(address)
        self._server = LiveServer(address)
        self._server.start()
        self._thread = threading.Thread(target=self._run, name="live-view", daemon=True)
        self._handler = RunLogHandler(self.log_text)
        self._handler.attach()
        self._thread.start()
        try:
            self._server.wait()
        except OutputError:
            self.close()
            raise

    def log(self, step: Step) -> None:
        """Show all that one frame produced, unless the one before was shown just now."""
        now = time.monotonic()
        if now - self._last_s >= 0.9 / _MAX_RATE_HZ:
            self._last_s = now
            factor = self._factor
            self._put(lambda log: log.log(_scaled_step(step, factor)))

    def log_text(self, level: str, message: str) -> None:
        """Add a line to the log."""
        self._put(lambda log: log.log_text(level, message))

    def log_source(
        self, state: str, counts: Mapping[str, int] | None = None, time_s: float | None = None
    ) -> None:
        """See `Recorder.log_source`; to be called when the state changes, or now and then."""
        kept = dict(counts or {})
        self._put(lambda log: log.log_source(state, kept, time_s))

    def is_mosaic_due(self, time_s: float) -> bool:
        """See `Recorder.is_mosaic_due`; here by this machine's clock."""
        return time.monotonic() - self._last_mosaic_s >= 1.0

    def log_mosaic(self, view: MosaicView, index: int, time_s: float) -> None:
        """See `Recorder.log_mosaic`."""
        self._last_mosaic_s = time.monotonic()

        def show(log: StepLog) -> None:
            log.set_time(index, time_s)
            log.mosaic.log_view(view, time_s)

        self._put(show)

    def log_mosaic_frame(self, placed: PlacedFrame) -> None:
        """See `Recorder.log_mosaic_frame`."""
        small = _scaled_place(placed, self._factor)
        self._put(lambda log: log.log_mosaic_frame(small))

    def begin_close(self, summary_markdown: str = "") -> None:
        """Have the last things shown and the server end, without waiting for it."""
        if self._end.is_set():
            return
        self._handler.detach()
        self._put(lambda log: log.close(summary_markdown))
        self._end.set()

    def close(self, summary_markdown: str = "") -> None:
        """Disconnect all viewers, within about two seconds; closing again does nothing."""
        self.begin_close(summary_markdown)
        self._thread.join(1.0)
        self._server.kill()  # should the thread be stuck in writing to it
        self._thread.join(1.0)

    def _put(self, show: Callable[[StepLog], object]) -> None:
        """Never blocks: where there is no room the oldest goes."""
        while not self._end.is_set():
            try:
                self._waiting.put_nowait(show)
            except queue.Full:
                with contextlib.suppress(queue.Empty):
                    self._waiting.get_nowait()
                    self.dropped += 1
            else:
                return

    def _run(self) -> None:
        """Serves until the end; a server that failed is started anew, ever more rarely."""
        pause_s = _RESTART_S[0]
        while not self._end.is_set():
            since = time.monotonic()
            try:
                self._serve(self._new_channel())
            except ServerError as error:
                if self._end.is_set():
                    break
                _log.warning("the live view is started anew: %s", error)
            self._server.stop()
            if time.monotonic() - since > _RESTART_S[1]:
                pause_s = _RESTART_S[0]
            if self._end.wait(pause_s):
                break
            pause_s = min(2.0 * pause_s, _RESTART_S[1])
            with contextlib.suppress(OSError, OutputError):
                self._server.start()

    def _new_channel(self) -> _Channel:
        """All that is said once, for a process that knows nothing yet."""
        output = rr.binary_stream(recording=self._stream)
        rerun_bindings.send_blueprint(
            self._layout.messages(), make_active=True, recording=self._stream.to_native()
        )
        log = StepLog(self._stream, self._clock, *self._run_facts)
        log.video = jpeg_video(self._stream, self._clock, _JPEG_QUALITY)
        log.begin()
        channel = _Channel(log, output, self._server)
        channel.hand_over()
        return channel

    def _serve(self, channel: _Channel) -> None:
        """Hands over what comes. Raises ServerError."""
        checked_s = time.monotonic()
        while True:
            try:
                show = self._waiting.get(timeout=channel.due_s())
            except queue.Empty:
                channel.hand_over()
                if self._end.is_set():
                    time.sleep(_LAST_LOOK_S)
                    return
            else:
                channel.show(show)
                if channel.due_s() <= 0:
                    channel.hand_over()
            if (now := time.monotonic()) - checked_s > 1.0:
                checked_s = now
                self._server.check()


class _Channel:
    """One stream of a run to one process, complete by itself."""

    def __init__(self, log: StepLog, output: rr.BinaryStream, server: LiveServer) -> None:
        self._log = log
        self._output = output
        self._server = server
        self._is_pending = False
        self._handed_over_s = 0.0

    def show(self, show: Callable[[StepLog], object]) -> None:
        """Have something shown once it is handed over."""
        show(self._log)
        self._is_pending = True

    def due_s(self) -> float:
        """How long to wait for more before handing over; not negative."""
        if not self._is_pending:
            return _POLL_S
        return max(0.0, self._handed_over_s + _HAND_OVER_S - time.monotonic())

    def hand_over(self) -> None:
        """Raises ServerError if that cannot be done."""
        self._is_pending, self._handed_over_s = False, time.monotonic()
        self._server.write(self._output.read(flush=True) or b"")


def _scaled_step(step: Step, factor: float) -> Step:
    """The step as if frames and target pictures had been given smaller."""
    if factor == 1.0:
        return step
    small_from_full = scaling(factor)
    features = step.features
    return replace(
        step,
        frame=replace(step.frame, image=reduced(step.frame.image, factor), packets=()),
        tracks=tuple(
            mapped_track(track, small_from_full, small_from_full) for track in step.tracks
        ),
        features=None if features is None else mapped_features(features, small_from_full),
    )


def _scaled_place(placed: PlacedFrame, factor: float) -> PlacedFrame:
    """The place of the frame as if it had been given smaller, in the same world."""
    pose = placed.world_from_frame
    if pose is not None:
        pose = pose @ inverted(scaling(factor))
    width, height = placed.size_wh
    small_wh = round(width * factor), round(height * factor)
    return replace(placed, size_wh=small_wh, world_from_frame=pose)
