"""How the picture gets into a recording: copied packets, the embedded file, AV1 or JPEG."""

from __future__ import annotations

import logging
import shutil
import time
from collections import deque
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
import rerun as rr

from streamtrack.errors import OutputError
from streamtrack.recording.entities import IMAGE
from streamtrack.settings import RecordingSettings, VideoMode
from streamtrack.sources.encoder import Av1Encoder
from streamtrack.types import Frame, Image, Packet, Size, SourceInfo

_log = logging.getLogger("streamtrack.recording.recorder")

_CODECS = {
    "h264": rr.VideoCodec.H264,
    "hevc": rr.VideoCodec.H265,
    "av1": rr.VideoCodec.AV1,
    "vp8": rr.VideoCodec.VP8,
    "vp9": rr.VideoCodec.VP9,
}
_BEHIND_OVERLAYS = -10.0
_SAME_TIME_S = 1e-6
_MAX_WAITING = 64
"""Packets kept for a frame to come; a decoder holds back far fewer."""


class Clock:
    """Sets the timelines for what the calling thread logs next."""

    def __init__(self, stream: rr.RecordingStream, is_live: bool) -> None:
        self._stream = stream
        self._is_live = is_live
        self._epoch_s: float | None = None

    def follow(self, frame: Frame) -> None:
        """Take over the wall time of a frame whose source knows it."""
        if self._is_live and frame.captured_unix_s is not None:
            self._epoch_s = frame.captured_unix_s - frame.time_s

    def set(self, index: int, time_s: float) -> None:
        """``capture_time`` is the wall time of the frame followed last plus the source's own time
        since; without one, that of the first moment asked for."""
        self._stream.set_time("frame", sequence=index)
        self._stream.set_time("video_time", duration=time_s)
        if self._is_live:
            if self._epoch_s is None:
                self._epoch_s = time.time() - time_s
            self._stream.set_time("capture_time", timestamp=self._epoch_s + time_s)


class Video(Protocol):
    """One way of recording pictures, in one part (a file) or several that are each complete."""

    def begin(self) -> None:
        """Record what each part needs at its start."""
        ...

    def can_begin_at(self, frame: Frame) -> bool:
        """Whether a part may begin with this frame, the next to be recorded."""
        ...

    def finish_before(self, frame: Frame) -> None:
        """Record what belongs to the part that ends before this frame."""
        ...

    def log(self, frame: Frame) -> int:
        """Record the picture, leaving any time on the clock. The bytes that it took, about."""
        ...

    def close(self) -> None:
        """Record what was held back."""
        ...


def open_video(
    stream: rr.RecordingStream,
    clock: Clock,
    source: SourceInfo,
    settings: RecordingSettings,
    has_parts: bool = False,
) -> Video:
    """The cheapest way that the settings allow and the source can serve.

    With parts no file is embedded, for each part would hold all of it.
    """
    mode, codec = settings.video, source.packet_codec
    if mode is VideoMode.NONE:
        return without_video()
    if codec == "mjpeg" and mode in (VideoMode.AUTO, VideoMode.JPEG):
        return _CopiedJpegs(stream, clock)
    if codec in _CODECS and (mode is VideoMode.AUTO or (mode is VideoMode.AV1 and codec == "av1")):
        if codec != "av1":
            _warn_if_ffmpeg_is_missing(codec)
        return _CopiedPackets(stream, clock, _CODECS[codec])
    if mode is VideoMode.AUTO and source.asset_path is not None and not has_parts:
        try:
            video = _EmbeddedFile(stream, clock, source.asset_path, settings.max_asset_mb)
        except (OSError, RuntimeError, ValueError) as error:
            _log.info("%s is recorded as JPEG: %s", source.name, error)
        else:
            _warn_if_ffmpeg_is_missing("H.264 or H.265")
            return video
    if mode is VideoMode.AV1:
        try:
            return _EncodedAv1(stream, clock, source.size_wh, source.rate_hz)
        except OutputError as error:
            _log.warning("%s; JPEG is recorded instead", error)
    return _EncodedJpegs(stream, clock, settings.jpeg_quality)


def without_video() -> Video:
    """Records no picture."""
    return _NoVideo()


def jpeg_video(stream: rr.RecordingStream, clock: Clock, quality: int) -> Video:
    """Records each picture as JPEG."""
    return _EncodedJpegs(stream, clock, quality)


def _warn_if_ffmpeg_is_missing(codec: str) -> None:
    if shutil.which("ffmpeg") is None:
        _log.warning(
            "the native Rerun viewer shows the %s video of this recording only with an ffmpeg "
            "executable on PATH; 'streamtrack view --web' or '--record-video av1|jpeg' needs none",
            codec,
        )


class _NoVideo:
    def begin(self) -> None:
        pass

    def can_begin_at(self, frame: Frame) -> bool:
        return True

    def finish_before(self, frame: Frame) -> None:
        pass

    def log(self, frame: Frame) -> int:
        return 0

    def close(self) -> None:
        pass


class _EncodedJpegs(_NoVideo):
    def __init__(self, stream: rr.RecordingStream, clock: Clock, quality: int) -> None:
        self._stream = stream
        self._clock = clock
        self._quality = quality

    def begin(self) -> None:
        _log_jpeg_style(self._stream)

    def log(self, frame: Frame) -> int:
        data = jpeg_of(frame.image, self._quality)
        self._clock.set(frame.index, frame.time_s)
        self._stream.log(IMAGE, rr.EncodedImage.from_fields(blob=data))
        return len(data)


def jpeg_of(image: Image, quality: int) -> bytes:
    """The picture as JPEG. Raises OutputError if it is too large for that."""
    try:
        is_done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    except cv2.error:
        is_done, data = False, np.zeros(0, np.uint8)
    if not is_done:
        raise OutputError(f"cannot encode {image.shape[1]}x{image.shape[0]} pixels as JPEG")
    return data.tobytes()


def _log_jpeg_style(stream: rr.RecordingStream) -> None:
    style = rr.EncodedImage.from_fields(media_type="image/jpeg", draw_order=_BEHIND_OVERLAYS)
    stream.log(IMAGE, style, static=True)


class _PacketQueue:
    """Hands out packets, in the order of decoding, when the frame that shows them has come."""

    def __init__(self) -> None:
        self._waiting: deque[Packet] = deque()
        self._due: list[Packet] = []
        self._last: Frame | None = None

    def due(self, frame: Frame) -> list[Packet]:
        """Those to be recorded with this frame; asked again, those not yet taken."""
        if frame is not self._last:
            self._last = frame
            self._waiting.extend(frame.packets)
            now = frame.time_s + _SAME_TIME_S
            while self._waiting and (
                self._waiting[0].time_s <= now or len(self._waiting) > _MAX_WAITING
            ):
                self._due.append(self._waiting.popleft())
        return self._due

    def take(self, frame: Frame) -> list[Packet]:
        packets = self.due(frame)
        self._due = []
        return packets

    def take_before_keyframe(self, frame: Frame) -> list[Packet]:
        """Takes what stands before the last keyframe due, or all if there is none."""
        packets = self.due(frame)
        first = _last_keyframe(packets)
        first = len(packets) if first is None else first
        self._due = packets[first:]
        return packets[:first]

    def rest(self) -> list[Packet]:
        packets = [*self._due, *self._waiting]
        self._due = []
        self._waiting.clear()
        return packets


def _last_keyframe(packets: list[Packet]) -> int | None:
    places = [place for place, packet in enumerate(packets) if packet.is_keyframe]
    return places[-1] if places else None


class _SampleLog:
    """Logs video samples, each later than the one before, as the viewer needs them."""

    def __init__(self, stream: rr.RecordingStream, clock: Clock, codec: rr.VideoCodec) -> None:
        self._stream = stream
        self._clock = clock
        self._codec = codec
        self._last_s = -np.inf

    def begin(self) -> None:
        self._stream.log(
            IMAGE,
            rr.VideoStream.from_fields(codec=self._codec, draw_order=_BEHIND_OVERLAYS),
            static=True,
        )

    def log(self, index: int, packet: Packet) -> int:
        self._last_s = max(packet.time_s, self._last_s + _SAME_TIME_S)
        self._clock.set(index, self._last_s)
        sample = rr.VideoStream.from_fields(sample=packet.data, is_keyframe=packet.is_keyframe)
        self._stream.log(IMAGE, sample)
        return len(packet.data)


class _CopiedPackets:
    """One packet is one picture (there are no B-frames), so the pictures that were stepped over
    get the indices between those of the yielded frames. Where there are more packets than
    indices several share the frame's: the viewer decodes them all and shows the last."""

    def __init__(self, stream: rr.RecordingStream, clock: Clock, codec: rr.VideoCodec) -> None:
        self._queue = _PacketQueue()
        self._samples = _SampleLog(stream, clock, codec)
        self._next_index = 0

    def begin(self) -> None:
        self._samples.begin()

    def can_begin_at(self, frame: Frame) -> bool:
        return _last_keyframe(self._queue.due(frame)) is not None

    def finish_before(self, frame: Frame) -> None:
        count = len(self._queue.due(frame))
        self._log(frame, count, self._queue.take_before_keyframe(frame))

    def log(self, frame: Frame) -> int:
        packets = self._queue.take(frame)
        size = self._log(frame, len(packets), packets)
        self._next_index = frame.index + 1
        return size

    def _log(self, frame: Frame, count: int, packets: list[Packet]) -> int:
        """The first of ``count`` packets, the last of which shows the frame."""
        first = max(frame.index - count + 1, self._next_index)
        self._next_index = min(first + len(packets), frame.index)
        return sum(
            self._samples.log(min(first + number, frame.index), packet)
            for number, packet in enumerate(packets)
        )

    def close(self) -> None:
        for index, packet in enumerate(self._queue.rest(), self._next_index):
            self._samples.log(index, packet)


class _CopiedJpegs(_NoVideo):
    def __init__(self, stream: rr.RecordingStream, clock: Clock) -> None:
        self._queue = _PacketQueue()
        self._stream = stream
        self._clock = clock

    def begin(self) -> None:
        _log_jpeg_style(self._stream)

    def log(self, frame: Frame) -> int:
        packets = self._queue.take(frame)
        if not packets:
            return 0
        self._clock.set(frame.index, frame.time_s)
        self._stream.log(IMAGE, rr.EncodedImage.from_fields(blob=packets[-1].data))
        return len(packets[-1].data)


class _EncodedAv1(_NoVideo):
    """A new part or size of picture starts a new encoder, on a keyframe."""

    def __init__(
        self, stream: rr.RecordingStream, clock: Clock, size_wh: Size, rate_hz: float | None
    ) -> None:
        self._encoder = Av1Encoder(size_wh, rate_hz)
        self._rate_hz = rate_hz
        self._samples = _SampleLog(stream, clock, rr.VideoCodec.AV1)
        self._indices: deque[int] = deque()

    def begin(self) -> None:
        self._samples.begin()

    def finish_before(self, frame: Frame) -> None:
        self._log_packets(self._encoder.flush())
        self._indices.clear()
        self._encoder = Av1Encoder(frame.size_wh, self._rate_hz)

    def log(self, frame: Frame) -> int:
        if frame.size_wh != self._encoder.size_wh:
            self.finish_before(frame)
        self._indices.append(frame.index)
        return self._log_packets(self._encoder.encode(frame.image, frame.time_s))

    def close(self) -> None:
        self._log_packets(self._encoder.flush())

    def _log_packets(self, packets: list[Packet]) -> int:
        return sum(self._samples.log(self._indices.popleft(), packet) for packet in packets)


class _EmbeddedFile(_NoVideo):
    """The source's file, whole; each frame refers to its picture in there."""

    def __init__(
        self, stream: rr.RecordingStream, clock: Clock, path: Path, max_size_mb: float
    ) -> None:
        size_mb = path.stat().st_size / 1e6
        if size_mb > max_size_mb:
            raise ValueError(f"{size_mb:.0f} MB are more than the {max_size_mb:g} MB to embed")
        asset = rr.AssetVideo(path=path)
        self._times_ns = np.sort(np.asarray(asset.read_frame_timestamps_nanos(), np.int64))
        if len(self._times_ns) == 0:
            raise ValueError("no picture in it")
        self._stream = stream
        self._clock = clock
        self._asset: rr.AssetVideo | None = asset

    def begin(self) -> None:
        if self._asset is None:
            raise RuntimeError("an embedded file cannot be recorded in parts")
        self._stream.log(IMAGE, self._asset, static=True)
        self._asset = None  # the memory is wanted back
        self._stream.log(
            IMAGE,
            rr.VideoFrameReference.from_fields(draw_order=_BEHIND_OVERLAYS),
            static=True,
        )

    def log(self, frame: Frame) -> int:
        self._clock.set(frame.index, frame.time_s)
        time_ns = self._nearest(frame.time_s)
        self._stream.log(IMAGE, rr.VideoFrameReference.from_fields(timestamp=time_ns))
        return 0

    def _nearest(self, time_s: float) -> int:
        """The file's own time of the picture that is ``time_s`` after its first."""
        wanted = round(time_s * 1e9) + int(self._times_ns[0])
        right = int(np.searchsorted(self._times_ns, wanted))
        around = self._times_ns[max(right - 1, 0) : right + 1]
        return int(around[np.argmin(np.abs(around - wanted))])
