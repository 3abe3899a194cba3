"""The queue between a capturing thread and the loop that works on its frames."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from time import monotonic

from streamtrack.types import Frame, Packet

_CAPACITY = 2
_WAKE_S = 0.1
_MAX_PACKETS = 600


class FrameQueue:
    """Holds two frames at most. A live one gives up the oldest, any other makes the writer wait.

    Two may wait after a hiccup of the reader, and both are read. If two wait twice in a row the
    reader is too slow, and only the newest is given to it: else each would be a frame late.
    Packets of frames that are given up pass to the next frame if ``keeps_packets``: those after
    them cannot be decoded without.
    """

    def __init__(self) -> None:
        self.keeps_packets = True
        self._frames: deque[tuple[Frame, float]] = deque()
        self._changed = threading.Condition()
        self._is_closed = False
        self._was_full = False
        self._dropped = 0

    @property
    def dropped(self) -> int:
        """Frames given up so far."""
        return self._dropped

    def put(self, frame: Frame, *, may_drop: bool) -> None:
        """Add the newest frame. Does nothing once the queue is closed."""
        with self._changed:
            while not may_drop and len(self._frames) >= _CAPACITY and not self._is_closed:
                self._changed.wait()
            if self._is_closed:
                return
            self._frames.append((frame, monotonic()))
            if len(self._frames) > _CAPACITY:
                self._drop_oldest()
            self._changed.notify_all()

    def get(self, should_stop: Callable[[], bool], *, may_drop: bool = True) -> Frame | None:
        """The next frame, waited for; None if the queue is closed and empty, or on a wish to stop.

        ``should_stop`` is asked ten times a second: a signal's handler may set what it looks at.
        """
        while not self._has_one():
            if self._is_closed or should_stop():
                return None
        with self._changed:
            is_full = len(self._frames) >= _CAPACITY
            if may_drop and is_full and self._was_full:
                self._drop_oldest()
            self._was_full = is_full
            self._changed.notify_all()
            frame, ready_s = self._frames.popleft()
            if frame.captured_s is None:
                return frame  # of a file, which is never late
            return replace(frame, waited_s=monotonic() - ready_s)

    def _has_one(self) -> bool:
        """Waits a little for a frame; what is asked for in between is asked without the lock."""
        with self._changed:
            if not self._frames and not self._is_closed:
                self._changed.wait(_WAKE_S)
            return bool(self._frames)

    def close(self) -> None:
        """No frame will come any more; those that wait can still be read."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    def _drop_oldest(self) -> None:
        old, ready_s = self._frames.popleft()
        new, _ = self._frames[0]
        self._dropped += 1
        if old.packets and self.keeps_packets:
            new = replace(new, packets=_bounded((*old.packets, *new.packets)))
        self._frames[0] = new, ready_s


def _bounded(packets: tuple[Packet, ...]) -> tuple[Packet, ...]:
    """All of them, or from the last keyframe on if they are too many: a reader stood still."""
    if len(packets) <= _MAX_PACKETS:
        return packets
    last = max((n for n, packet in enumerate(packets) if packet.is_keyframe), default=len(packets))
    return packets[last:]
