"""Live streams: never late, never hung, opened again for as long as wanted."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import TypeAlias

from streamtrack.closing import Closing
from streamtrack.errors import SourceError, StreamtrackError, UsageError
from streamtrack.settings import LiveSettings
from streamtrack.sources._backoff import Backoff
from streamtrack.sources._epoch_clock import EpochClock
from streamtrack.sources._frame_queue import FrameQueue
from streamtrack.sources._thinner import Thinner
from streamtrack.sources.capture import (
    Capture,
    Captured,
    CaptureEndedError,
    CaptureFinishedError,
    CaptureRefusedError,
    without_frames,
)
from streamtrack.sources.live_status import Journal, LiveEvent, LiveState, LiveStatus
from streamtrack.types import Frame, Packet, Size, Skipped, SourceInfo

_log = logging.getLogger("streamtrack.sources")

Opener: TypeAlias = Callable[[Callable[[], bool]], Capture]
"""Opens the device; is given a function that tells, at any time, that it shall give up."""

_SLICE_S = 0.25
_STEADY_S = 2.0
"""A stream that held this long, and as long as was waited for it, is well: its next failure is its
first. So one that breaks off again and again is there for half of the time at least."""
_JOIN_TIMEOUT_S = 2.5


class _FileBrokeOffError(SourceError):
    """A file that broke off is not begun again: its frames would come twice."""


class LiveSource(Closing):
    """A camera or network stream as a `FrameSource`, read by a thread of its own.

    The frame given is the newest one (see `FrameQueue`); what the caller has no time for is
    dropped and counted, unless ``newest_only`` is off. A finished file on a server or a pipe, known
    by its length (``info.is_live`` is false), is read whole, and not again if it breaks off.

    A stream that ends, breaks, or is silent for ``stall_timeout_s`` is opened again after 1 s,
    then 2, 4 ... 60 s (`Backoff`), the first time as all others: for ever, or ``retries`` times in
    a row. A UsageError ends it at once. Each opening begins a new `Frame.epoch`, and so does a
    change of the picture's size: what was known of the last picture need not hold for the next.
    Pictures are not scaled; ``info`` is that of the first opening.

    ``Frame.index`` counts pictures captured, dropped, thinned, damaged and lost, over all epochs;
    what was missed between two openings is not known and not counted. ``Frame.time_s`` goes on
    over epochs (`EpochClock`).

    Another thread may call `close`; a signal's handler shall set what ``should_stop`` looks at:
    both end the iteration. It may be iterated once.
    """

    def __init__(
        self,
        opener: Opener,
        settings: LiveSettings | None = None,
        *,
        name: str,
        should_stop: Callable[[], bool] | None = None,
        seed: int = 0,
    ) -> None:
        """Wait for the first picture. Raises SourceError or UsageError with nothing left open.

        With ``retries`` None it waits for ever; the log says so. ``name`` is for messages.
        """
        self._opener = opener
        self._settings = settings or LiveSettings()
        self._name = name
        self._should_stop = should_stop or (lambda: False)
        self._backoff = Backoff(self._settings.retries, seed)
        self._thinner = Thinner(self._settings.max_fps)
        self._clock = EpochClock()
        self._queue = FrameQueue()
        self._closing = threading.Event()
        self._journal = Journal()
        self._waited_s = 0.0
        self._last_picture_s = 0.0
        self._epoch = -1
        self._next_index = 0
        self._size_wh: Size | None = None
        self._packet_codec: str | None = None
        self._pending_packets: tuple[Packet, ...] = ()
        self._info: SourceInfo | None = None
        self._first: Frame | None = None
        self._error: StreamtrackError | None = None
        self._is_started = False
        self._thread = threading.Thread(target=self._run, name="streamtrack-live", daemon=True)
        self._thread.start()
        try:
            self._first = self._queue.get(self._should_stop)
            if self._first is None:
                raise self._error or SourceError(f"{name}: interrupted before the first picture")
        except BaseException:
            self.close()
            raise

    # -- what the reader of frames sees ---------------------------------------------------------

    @property
    def info(self) -> SourceInfo:
        """What was granted at the first opening; the address holds no credentials."""
        assert self._info is not None
        return self._info

    @property
    def skipped(self) -> Sequence[Skipped]:
        """Always empty: what was left out is counted, see `status`."""
        return ()

    @property
    def corrupt_packets(self) -> int:
        """Damaged pictures so far."""
        return self.status().damaged

    @property
    def shortfall(self) -> str:
        """Always empty: a live stream promises no length."""
        return ""

    def __iter__(self) -> Iterator[Frame]:
        """The frames. Raises SourceError when no retry is left."""
        if self._is_started:
            raise SourceError(f"{self._name} was already read or closed: open it again")
        self._is_started = True
        return self._frames()

    def _frames(self) -> Iterator[Frame]:
        frame, self._first = self._first, None
        while frame is not None and not self._should_stop():
            yield frame
            frame = self._queue.get(self._should_stop, may_drop=self._may_drop)
        if self._error is not None and not self._closing.is_set():
            raise self._error

    def note_output(self, frame: Frame) -> None:
        """Note that all is done with a frame: its age now counts in the status."""
        if frame.captured_s is not None:
            self._journal.note_age(time.monotonic() - frame.captured_s)

    def status(self) -> LiveStatus:
        """Counts and ages so far. Any thread may ask."""
        return self._journal.status(self._queue.dropped)

    def drain_events(self) -> list[LiveEvent]:
        """The changes of state since the last call, in order; the oldest beyond 1000 are gone."""
        return self._journal.drain(self._clock.at)

    def close(self) -> None:
        """End the thread and close the device, within three seconds. Any thread may call it."""
        self._is_started = True
        self._first = None
        self._closing.set()
        self._queue.close()
        if threading.current_thread() is not self._thread:
            self._thread.join(_JOIN_TIMEOUT_S)
            if self._thread.is_alive():
                _log.warning("%s: the device does not let go: left to itself", self._name)

    # -- the capturing thread -------------------------------------------------------------------

    def _run(self) -> None:
        try:
            while not self._closing.is_set():
                try:
                    self._enter(LiveState.CONNECTING, "")
                    reason: SourceError = self._stream_once()
                    if self._info is not None and not self._info.is_live:
                        raise _FileBrokeOffError(f"{reason}: the file was not read to its end")
                except (UsageError, _FileBrokeOffError):
                    raise
                except CaptureFinishedError:
                    break
                except SourceError as error:
                    self._journal.count(failed_openings=1)
                    reason = without_frames(error)
                self._wait_to_reopen(reason)
        except StreamtrackError as error:
            self._error = error
        except Exception as error:  # noqa: BLE001  A thread's traceback would help nobody.
            self._error = SourceError(f"{self._name}: {type(error).__name__}: {error}")
        finally:
            self._enter(LiveState.ENDED, str(self._error or ""))
            self._queue.close()

    def _stream_once(self) -> SourceError:
        """Open, and read until it ends. Returns why; raises SourceError if it cannot be opened."""
        with self._opener(self._closing.is_set) as capture:
            if self._closing.is_set():
                return CaptureEndedError("closed")
            self._begin(capture.info)
            began_s = last_s = time.monotonic()
            while not self._closing.is_set():
                try:
                    captured = capture.read(min(_SLICE_S, self._settings.stall_timeout_s))
                except CaptureFinishedError:
                    raise
                except CaptureEndedError as error:
                    return without_frames(error)
                now_s = time.monotonic()
                if captured is None:
                    if now_s - last_s >= self._settings.stall_timeout_s:
                        return self._stalled(now_s - last_s)
                    continue
                last_s = self._last_picture_s = now_s
                if now_s - began_s > max(_STEADY_S, self._waited_s):
                    self._backoff.reset()
                self._take(captured)
        return CaptureEndedError("closed")

    def _begin(self, info: SourceInfo) -> None:
        if self._info is None:
            self._info = info
            self._packet_codec = info.packet_codec
            # Each JPEG stands alone: what is left out need not be recorded.
            self._queue.keeps_packets = info.packet_codec != "mjpeg"
        self._has_same_codec = info.packet_codec == self._packet_codec
        if not self._has_same_codec:
            _log.warning(
                "%s: the codec is %s now instead of %s: its packets are not passed on",
                *(self._name, info.packet_codec, self._packet_codec),
            )
        self._size_wh = None
        self._pending_packets = ()
        self._thinner = Thinner(self._settings.max_fps)
        self._clock.begin_epoch()
        self._journal.count(openings=1)

    def _take(self, captured: Captured) -> None:
        """Count a picture and what did not come before it; make it a frame, unless thinned."""
        left_out = {
            "lost": captured.lost,
            "damaged": captured.damaged,
            "dropped": captured.dropped,
            "thinned": captured.thinned,
        }
        self._journal.count(**left_out)
        self._next_index += sum(left_out.values())
        index = self._next_index
        self._next_index += 1
        packets = (*self._pending_packets, *captured.packets) if self._has_same_codec else ()
        time_s = self._clock.time_s(captured.time_s, captured.captured_s)
        if not self._thinner.takes(captured.time_s):
            self._journal.count(thinned=1)
            self._pending_packets = packets if self._queue.keeps_packets else ()
            return
        self._pending_packets = ()
        self._journal.count(captured=1)
        self._note_size(captured)
        is_live = self.info.is_live
        shift_s = time_s - captured.time_s
        frame = Frame(
            index,
            time_s,
            captured.image,
            packets=tuple(Packet(p.time_s + shift_s, p.data, p.is_keyframe) for p in packets),
            captured_s=captured.captured_s if is_live else None,
            captured_unix_s=self._clock.unix_s(captured.captured_s) if is_live else None,
            epoch=self._epoch,
        )
        self._queue.put(frame, may_drop=self._may_drop)

    @property
    def _may_drop(self) -> bool:
        return self.info.is_live and self._settings.newest_only

    # -- states ---------------------------------------------------------------------------------

    def _stalled(self, silent_s: float) -> SourceError:
        reason = CaptureEndedError(f"{self._name}: no picture for {silent_s:.1f} s")
        self._journal.count(stalls=1)
        self._enter(LiveState.STALLED, str(reason))
        return reason

    def _note_size(self, captured: Captured) -> None:
        """The first picture of an opening, or one of another size, begins an epoch."""
        height, width = captured.image.shape[:2]
        size = f"{width}x{height}"
        if self._size_wh == (width, height):
            return
        if self._size_wh is None:
            away_s = self._journal.end_away()
            if away_s:
                _log.warning("%s: streaming again after %.1f s: %s", self._name, away_s, size)
        else:
            _log.warning("%s: the picture's size is %s now", self._name, size)
        self._epoch += 1
        self._size_wh = width, height
        self._enter(LiveState.STREAMING, size)

    def _wait_to_reopen(self, reason: SourceError) -> None:
        """Wait as the back-off says. Raises SourceError if no retry is left."""
        if self._closing.is_set():
            return
        self._journal.begin_away(self._last_picture_s)
        failures = self._backoff.failures + 1
        is_refused = isinstance(reason, CaptureRefusedError)
        delay_s = self._backoff.next_delay_s(is_refused=is_refused)
        if delay_s is None:
            tries = f" (given up after {failures} tries)" if failures > 1 else ""
            raise SourceError(f"{reason}{tries}")
        # The first few and then ever fewer: a camera that is gone for a week fills no log.
        if failures < 4 or failures & (failures - 1) == 0:
            bound = "" if self._settings.retries is None else f" of {self._settings.retries}"
            _log.warning(
                "%s: trying again in %.0f s (retry %d%s)", reason, delay_s, failures, bound
            )
        self._enter(LiveState.WAITING, str(reason))
        self._waited_s = delay_s
        self._closing.wait(delay_s)

    def _enter(self, state: LiveState, detail: str) -> None:
        self._journal.enter(state, detail, max(self._epoch, 0))
