"""Copying a video's encoded packets, so that they can be stored without encoding again."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from pathlib import Path

import av
from av.bitstream import BitStreamFilterContext
from av.packet import Packet as AvPacket
from av.video.stream import VideoStream

from streamtrack.sources._av import open_file
from streamtrack.types import Packet

_NAMES = {
    "h264": "h264",
    "hevc": "hevc",
    "av1": "av1",
    "libdav1d": "av1",
    "vp8": "vp8",
    "vp9": "vp9",
    "mjpeg": "mjpeg",
}
_EMBEDDABLE = ("h264", "hevc", "av1")
_8_BIT_420 = ("yuv420p", "yuvj420p")
_PROBED_PACKETS = 50


def copyable_codec(path: Path, stream: VideoStream) -> str | None:
    """Name of the codec if the packets can be copied one by one, else None.

    They can be if a common viewer decodes them (8-bit 4:2:0, or any JPEG) and decodes them in
    the order in which they are shown. The file is opened a second time to look at its packets.
    """
    name = _codec_name(stream)
    if name is None or (name != "mjpeg" and stream.pix_fmt not in _8_BIT_420):
        return None
    if stream.codec_context.has_b_frames or not _is_in_order(path):
        return None
    return name


def embeddable_path(path: Path, stream: VideoStream, container_format: str) -> Path | None:
    """The path if it is an MP4 or MOV file that a common viewer plays as a whole, else None."""
    is_mp4 = "mp4" in container_format.split(",")
    is_common = _codec_name(stream) in _EMBEDDABLE and stream.pix_fmt in _8_BIT_420
    return path if is_mp4 and is_common else None


def _codec_name(stream: VideoStream) -> str | None:
    return _NAMES.get(stream.codec_context.name)


def _is_in_order(path: Path) -> bool:
    """True if the first packets are shown in the order in which they are stored."""
    container, stream = open_file(path)
    last: int | None = None
    count = 0
    with container:
        try:
            for packet in container.demux(stream):
                if not packet.size:
                    continue
                if packet.pts is None or (last is not None and packet.pts <= last):
                    return False
                last = packet.pts
                count += 1
                if count == _PROBED_PACKETS:
                    break
        except av.FFmpegError:
            pass  # What is damaged further on does not tell about the order.
    return count > 0


class PacketQueue:
    """Holds packets back until the frame decoded from them comes out of the decoder.

    The decoder runs some packets ahead, and packets and frames are in the same order, so a frame
    takes all waiting packets up to its own presentation time.
    """

    def __init__(self, stream: VideoStream, time_of: Callable[[int], float]) -> None:
        self._waiting: deque[tuple[int, bytes, bool]] = deque()
        self._time_of = time_of
        self._name = _codec_name(stream)
        self._stream = stream
        self._filter = _annexb_filter(stream)
        self._is_damaged = False

    def put(self, packet: AvPacket[VideoStream]) -> None:
        """Take over a packet; the filter empties it, so it must have been decoded before."""
        pts, is_keyframe = packet.pts, packet.is_keyframe
        if pts is None:
            return
        if self._filter is None and self._name == "mjpeg" and _lacks_tables(bytes(packet)):
            self._filter = BitStreamFilterContext("mjpeg2jpeg", self._stream)
        try:
            data = self._filtered(packet)
        except av.FFmpegError:
            return  # Too damaged to be reframed: no viewer could decode it either.
        if data:
            self._waiting.append((pts, data, is_keyframe))

    def _filtered(self, packet: AvPacket[VideoStream]) -> bytes:
        if self._filter is None:
            return bytes(packet)
        return b"".join(bytes(part) for part in self._filter.filter(packet))

    def note_damage(self) -> None:
        """Some packet could not be decoded; with frame threads it is not known which."""
        self._is_damaged = True

    def take(self, pts: int | None, time_s: float) -> tuple[Packet, ...]:
        """The packets up to and including that of the frame with this pts and time.

        Those that gave no frame are invisible references of VP8 and VP9, and belong to the next
        frame; after damage they are what was damaged, and are left out.
        """
        taken: list[Packet] = []
        while self._waiting and (pts is None or self._waiting[0][0] <= pts):
            packet_pts, data, is_keyframe = self._waiting.popleft()
            if packet_pts != pts and self._is_damaged:
                continue
            # The frame's time may have been repaired; its packet must follow it.
            at = time_s if packet_pts == pts else min(self._time_of(packet_pts), time_s)
            taken.append(Packet(at, data, is_keyframe))
        self._is_damaged = False
        return tuple(taken)


def _annexb_filter(stream: VideoStream) -> BitStreamFilterContext | None:
    """The filter that gives H.264 and H.265 start codes, or None where they have them."""
    name = stream.codec_context.name
    extradata = stream.codec_context.extradata or b""
    # avcC and hvcC begin with version 1; Annex B begins with a start code, 0 0 1 or 0 0 0 1.
    if name not in ("h264", "hevc") or extradata[:1] != b"\x01":
        return None
    return BitStreamFilterContext(f"{name}_mp4toannexb", stream)


def _lacks_tables(jpeg: bytes) -> bool:
    """True for the MJPEG of old AVI files, which leaves out the standard Huffman tables."""
    return b"\xff\xc4" not in jpeg[:2048]
