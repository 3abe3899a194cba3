"""A live stream's encoded packets, copied so that they can be stored without encoding again.

Like `_packets`, which may look at a file twice; a stream passes by once. Imports nothing but PyAV.
"""

from __future__ import annotations

import av
from av.bitstream import BitStreamFilterContext
from av.packet import Packet
from av.video.stream import VideoStream

_MAX_PACKETS = 600
_MAX_PACKET_BYTES = 32_000_000
_CODECS = {
    "h264": "h264",
    "hevc": "hevc",
    "av1": "av1",
    "libdav1d": "av1",
    "vp8": "vp8",
    "vp9": "vp9",
    "mjpeg": "mjpeg",
}
_8_BIT_420 = ("yuv420p", "yuvj420p")


class Copier:
    """Packets made ready to be stored, from the first keyframe on, waiting for their picture."""

    def __init__(self, stream: VideoStream) -> None:
        self._filter = _packet_filter(stream)
        self._stream = stream
        self.is_intra = codec_name(stream) == "mjpeg"
        self._waiting: list[tuple[float | None, bytes, bool]] = []
        self._bytes = 0
        self._has_keyframe = False
        self._last: int | None = None

    def put(self, packet: Packet[VideoStream], time_s: float | None) -> None:
        """Take over a packet; the filter empties it, so it must have been decoded before."""
        is_keyframe, pts = packet.is_keyframe, packet.pts
        # Pictures out of order are references for none, and a viewer could not place them.
        is_late = pts is not None and self._last is not None and pts < self._last
        if not is_keyframe and (is_late or not self._has_keyframe):
            return
        data = bytes(packet)
        if self.is_intra and self._filter is None and b"\xff\xc4" not in data[:2048]:
            self._filter = BitStreamFilterContext("mjpeg2jpeg", self._stream)
        if self._filter is not None:
            try:
                data = b"".join(bytes(part) for part in self._filter.filter(packet))
            except av.FFmpegError:
                return
        if not data:
            return
        self._has_keyframe, self._last = True, pts
        self._waiting.append((time_s, data, is_keyframe))
        self._bytes += len(data)
        if len(self._waiting) > _MAX_PACKETS or self._bytes > _MAX_PACKET_BYTES:
            self.take()  # No picture came of them for long: begin again with a keyframe.
            self._has_keyframe = False

    def take(self) -> list[tuple[float | None, bytes, bool]]:
        """All that wait."""
        taken, self._waiting, self._bytes = self._waiting, [], 0
        return taken


def codec_name(stream: VideoStream) -> str | None:
    return _CODECS.get(stream.codec_context.name)


def is_copyable(stream: VideoStream) -> bool:
    """True if a common viewer can decode the packets one by one, in their order."""
    codec = codec_name(stream)
    if codec is None or stream.codec_context.has_b_frames:
        return False
    return codec == "mjpeg" or stream.codec_context.pix_fmt in _8_BIT_420


def _packet_filter(stream: VideoStream) -> BitStreamFilterContext | None:
    """What gives H.264 and H.265 start codes, and parameter sets before each keyframe."""
    name, extradata = codec_name(stream), stream.codec_context.extradata or b""
    if name not in ("h264", "hevc") or not extradata:
        return None
    if extradata[:1] == b"\x01":
        return BitStreamFilterContext(f"{name}_mp4toannexb", stream)
    # RTSP servers may send them once, in the answer to DESCRIBE, and never again.
    return BitStreamFilterContext("dump_extra=freq=keyframe", stream)
