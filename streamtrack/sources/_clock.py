"""Times, rate and length of a video stream."""

from __future__ import annotations

import heapq
import logging
from fractions import Fraction

import av
from av.packet import Packet as AvPacket
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

_log = logging.getLogger("streamtrack.sources")

FALLBACK_RATE_HZ = 25.0
"""Rate assumed for streams that tell neither times nor a rate; FFmpeg assumes the same."""

_TINY_STEP_S = 1e-6
_CLOCK_RESTART_S = 1.0
_MAX_UNSEEN_PACKETS = 32


class Clock:
    """Seconds since the stream's start from timestamps, strictly increasing."""

    def __init__(self, stream: VideoStream) -> None:
        self.time_base = float(stream.time_base or Fraction(0))
        self._stream = stream
        self._period_s = 1.0 / (rate_hz(stream) or FALLBACK_RATE_HZ)
        self._origin_s: float | None = None
        self._last_s: float | None = None
        self._is_warned = False
        self._has_order = True
        self._stamps: list[int] = []  # A heap: pts of packets whose frames have not come yet.

    @property
    def lost_order(self) -> bool:
        """True if pictures are reordered but the file gives them times in the order of storage.

        A careless cut does that. The decoder puts the pictures right, so each takes the earliest
        time not used yet, instead of the one it carries.
        """
        return self._has_order and bool(self._stream.codec_context.has_b_frames)

    def note_packet(self, packet: AvPacket[VideoStream]) -> None:
        """See a packet on its way into the decoder."""
        self._has_order &= packet.pts is not None and packet.pts == packet.dts
        # What an edit list cuts off is decoded but never shown.
        if self._has_order and packet.pts is not None and not packet.is_discard:
            heapq.heappush(self._stamps, packet.pts)
            if len(self._stamps) > _MAX_UNSEEN_PACKETS:
                heapq.heappop(self._stamps)

    def packet_time(self, pts: int) -> float:
        """Time of a packet with this pts, on the clock of the frames."""
        return pts * self.time_base - (self._origin_s or 0.0)

    def frame_time(self, frame: VideoFrame) -> float:
        """Time of the next frame, later than all before it."""
        stamp = self._stamp(frame)
        if self._origin_s is None:
            self._origin_s = self._start(stamp or 0) * self.time_base
        last_s = self._last_s
        if stamp is None:
            time_s = 0.0 if last_s is None else last_s + self._period_s
        else:
            time_s = self.packet_time(stamp)
        if last_s is not None and time_s <= last_s:
            time_s = self._repaired(time_s, last_s)
        self._last_s = time_s
        return time_s

    def _start(self, stamp: int) -> int:
        start = self._stream.start_time
        return stamp if start is None else min(start, stamp)

    def _stamp(self, frame: VideoFrame) -> int | None:
        """Timestamp in time bases. Old AVI has decoding times only: the same without reordering."""
        earliest = heapq.heappop(self._stamps) if self._stamps else None
        if self.lost_order and earliest is not None:
            return earliest
        if frame.pts is not None:
            return frame.pts
        return None if self._stream.codec_context.has_b_frames else frame.dts

    def _repaired(self, time_s: float, last_s: float) -> float:
        if not self._is_warned:
            self._is_warned = True
            _log.warning("timestamps go back from %.3f to %.3f s: repaired", last_s, time_s)
        if last_s - time_s < _CLOCK_RESTART_S:
            return last_s + _TINY_STEP_S
        self._origin_s = (self._origin_s or 0.0) - (last_s + self._period_s - time_s)
        return last_s + self._period_s


def rate_hz(stream: VideoStream) -> float | None:
    """Average or else nominal frames a second, or None if the header has neither."""
    rate = stream.average_rate or stream.guessed_rate
    return float(rate) if rate else None


def duration_s(stream: VideoStream) -> float | None:
    """Length of the stream by its header; Matroska keeps it in a tag, as hours:minutes:seconds."""
    if stream.duration and stream.time_base:
        return float(stream.duration * stream.time_base)
    try:
        hours, minutes, seconds = stream.metadata.get("DURATION", "").split(":")
        return int(hours) * 3600 + int(minutes) * 60 + float(seconds)
    except ValueError:
        return None


def frame_count(stream: VideoStream, container_duration: int | None) -> int | None:
    """Frames by the header, or by length and rate, or None."""
    if stream.frames:
        return int(stream.frames)
    length_s = duration_s(stream)
    if length_s is None and container_duration:
        length_s = container_duration / av.time_base
    rate = rate_hz(stream)
    return round(length_s * rate) if length_s and rate else None
