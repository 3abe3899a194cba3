"""Streaming from a V4L2 device: buffers of the driver, mapped, copied out and given back."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import math
import mmap
import select
from dataclasses import dataclass

from streamtrack.sources.v4l2 import api

_BUFFERS = 4
_SEQUENCES = 1 << 32


@dataclass(frozen=True, slots=True)
class Delivered:
    """One buffer as the driver filled it; ``stamp_s`` is on the driver's clock."""

    data: bytes
    sequence: int
    stamp_s: float
    is_monotonic: bool
    is_error: bool


class MappedStream:
    """The buffers of an open device whose format is set. `start` begins, `stop` ends for good."""

    def __init__(self, fd: int, is_mplane: bool) -> None:
        """Raises OSError; `stop` gives back what was had by then."""
        self._fd = fd
        self._type = api.BUF_TYPE_CAPTURE_MPLANE if is_mplane else api.BUF_TYPE_CAPTURE
        self._is_mplane = is_mplane
        self._maps: list[mmap.mmap] = []
        self._poll = select.poll()

    @property
    def buffers(self) -> int:
        """How many the driver gave."""
        return len(self._maps)

    def start(self) -> None:
        """Raises OSError; EBUSY if another program streams, ENOSPC if the bus is full."""
        request = api.RequestBuffers(count=_BUFFERS, type=self._type, memory=api.MEMORY_MMAP)
        api.ioctl(self._fd, api.REQBUFS, request)
        for index in range(request.count):
            buffer, plane = self._buffer(index)
            api.ioctl(self._fd, api.QUERYBUF, buffer)
            length = plane.length if self._is_mplane else buffer.length
            offset = plane.m.mem_offset if self._is_mplane else buffer.m.offset
            self._maps.append(mmap.mmap(self._fd, length, offset=offset))
            api.ioctl(self._fd, api.QBUF, buffer)
        if not self._maps:
            raise OSError(errno.ENOMEM, "the driver has no memory for pictures")
        api.ioctl(self._fd, api.STREAMON, ctypes.c_int32(self._type))
        self._poll.register(self._fd, select.POLLIN)

    def wait(self, timeout_s: float) -> bool:
        """True once `take` has something to give or to raise."""
        return bool(self._poll.poll(max(0, math.ceil(timeout_s * 1000))))

    def take(self) -> Delivered | None:
        """The oldest filled buffer, or None if none is ready. Raises OSError if all is over."""
        buffer, plane = self._buffer(0)
        try:
            api.ioctl(self._fd, api.DQBUF, buffer)
        except BlockingIOError:
            self._check()
            return None
        try:
            return self._delivered(buffer, plane)
        finally:
            api.ioctl(self._fd, api.QBUF, buffer)

    def _check(self) -> None:
        """A broken queue reports an error in poll and may have nothing to say in DQBUF."""
        for _, events in self._poll.poll(0):
            if events & (select.POLLERR | select.POLLHUP | select.POLLNVAL):
                raise OSError(errno.EIO, "the driver's queue is broken")

    def _delivered(self, buffer: api.Buffer, plane: api.Plane) -> Delivered:
        used = plane.bytesused if self._is_mplane else buffer.bytesused
        skipped = plane.data_offset if self._is_mplane else 0
        return Delivered(
            self._maps[buffer.index][skipped:used],
            buffer.sequence,
            buffer.timestamp.tv_sec + buffer.timestamp.tv_usec * 1e-6,
            buffer.flags & api.BUF_FLAG_CLOCK_MASK == api.BUF_FLAG_CLOCK_MONOTONIC,
            bool(buffer.flags & api.BUF_FLAG_ERROR),
        )

    def _buffer(self, index: int) -> tuple[api.Buffer, api.Plane]:
        buffer = api.Buffer(index=index, type=self._type, memory=api.MEMORY_MMAP)
        planes = api.Planes()
        if self._is_mplane:
            buffer.m.planes = ctypes.cast(planes, ctypes.POINTER(api.Plane))
            buffer.length = api.MAX_PLANES
        return buffer, planes[0]

    def stop(self) -> None:
        """Give all buffers back; a device that is gone is no error."""
        with contextlib.suppress(OSError):
            api.ioctl(self._fd, api.STREAMOFF, ctypes.c_int32(self._type))
        for mapped in self._maps:
            mapped.close()
        self._maps.clear()
        request = api.RequestBuffers(count=0, type=self._type, memory=api.MEMORY_MMAP)
        with contextlib.suppress(OSError):
            api.ioctl(self._fd, api.REQBUFS, request)


def lost_between(before: int | None, sequence: int) -> int:
    """Pictures that a driver numbered and did not deliver.

    Numbers have 32 bits and wrap. Going back or staying means a new count or none at all.
    """
    if before is None:
        return 0
    missing = (sequence - before - 1) % _SEQUENCES
    return missing if missing < _SEQUENCES // 2 else 0


class DriverClock:
    """Brings a driver's stamps onto `time.monotonic`'s clock.

    Stamps that say they are monotonic already are taken as they are, as long as they lie between
    the start and now; they may be old, if nobody read for a while, and some drivers stamp a
    little ahead. Any other clock is mapped once, at its first stamp, and again if it jumps.
    Times always rise.
    """

    TOLERANCE_S = 1.0

    def __init__(self, started_s: float) -> None:
        self._started_s = started_s
        self._offset_s = 0.0
        self._last_s = -math.inf

    def time_s(self, stamp_s: float, is_monotonic: bool, now_s: float) -> float:
        """The moment of capture; ``now_s`` is the moment at which the buffer came."""
        oldest_s, latest_s = self._started_s - self.TOLERANCE_S, now_s + self.TOLERANCE_S
        if is_monotonic and max(oldest_s, self._last_s) < stamp_s <= latest_s:
            self._offset_s = 0.0
        time_s = stamp_s + self._offset_s
        if self._offset_s or not is_monotonic:
            oldest_s = now_s - self.TOLERANCE_S
        if not max(oldest_s, self._last_s) < time_s <= latest_s:
            time_s = max(now_s, self._last_s + 1e-6)
            self._offset_s = time_s - stamp_s
        self._last_s = time_s
        return time_s
