"""Frames of video files, read with PyAV."""

from __future__ import annotations

import logging
import math
from collections.abc import Generator, Iterator, Sequence
from pathlib import Path

import av
from av.packet import Packet as AvPacket
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from streamtrack.closing import Closing
from streamtrack.errors import SourceError
from streamtrack.sources._av import PictureMaker, open_file
from streamtrack.sources._clock import Clock, duration_s, frame_count, rate_hz
from streamtrack.sources._packets import PacketQueue, copyable_codec, embeddable_path
from streamtrack.types import Frame, Image, Size, Skipped, SourceInfo

_log = logging.getLogger("streamtrack.sources")

_MAX_DEMUX_ERRORS = 20


class VideoSource(Closing):
    """A video file, decoded frame by frame.

    ``Frame.time_s`` is pts x time base minus the stream's start, so the first frame is at 0
    unless the file begins with pictures that cannot be decoded. Streams without timestamps
    (raw H.264) are timed by their nominal rate. Times strictly increase: a pts that does not is
    moved a microsecond past the one before, and a clock that starts again (files put end to end)
    is continued. To find a frame in the file again add the pts of the file's first frame.

    Pictures are uint8 (H, W, 3) BGR, or (H, W) for grey formats, turned upright. Sound is left
    out. A picture's size may change midway; that is warned of once.

    With ``with_packets`` each frame carries the encoded packets since the frame before it, up to
    its own, if a viewer can decode them one by one: `SourceInfo.packet_codec` is then set.
    Where it is not because of B-frames, `SourceInfo.asset_path` names an MP4 file to embed whole.

    A source is read once: a second iteration raises SourceError.
    """

    def __init__(self, path: str | Path, *, with_packets: bool = False) -> None:
        """Open ``path`` and decode its first picture. Raises SourceError."""
        self._path = Path(path)
        self._corrupt = 0
        self._shortfall = ""
        self._packets_met = 0
        self._is_started = False
        # Packets met before it is known whether they can be copied.
        self._early: list[AvPacket[VideoStream]] | None = []
        self._packets: PacketQueue | None = None
        self._container, self._stream = open_file(self._path)
        try:
            self._clock = Clock(self._stream)
            self._decoded = self._decode()
            first = self._first_frame()
            self._pictures = PictureMaker(first)
            self._first: tuple[VideoFrame, Image] | None = (first, self._convert(first))
            self._info = self._describe(self._first[1], with_packets)
        except BaseException:
            self._container.close()
            raise

    @property
    def info(self) -> SourceInfo:
        """Size as shown (upright), nominal rate, and length as the header tells it."""
        return self._info

    @property
    def skipped(self) -> Sequence[Skipped]:
        """Always empty: damaged packets are counted, not named."""
        return ()

    @property
    def corrupt_packets(self) -> int:
        """Packets so far that were damaged or whose picture was."""
        return self._corrupt

    @property
    def shortfall(self) -> str:
        """After the last frame: how much shorter the file is than its header says, or empty."""
        return self._shortfall

    def close(self) -> None:
        """Release the file. May be called again; reading afterwards raises SourceError."""
        self._is_started = True
        self._first = None
        self._decoded.close()
        self._container.close()

    def __iter__(self) -> Iterator[Frame]:
        """The frames in the order of time. Raises SourceError if the file becomes unreadable."""
        if self._is_started:
            raise SourceError(
                f"{self._path} was already read or closed: open it again to read it again"
            )
        self._is_started = True
        return self._frames()

    # -- frames ---------------------------------------------------------------------------------

    def _frames(self) -> Iterator[Frame]:
        index = 0
        end_s = 0.0
        size_warned = False
        for decoded, image in self._pictures_in_order():
            time_s = self._clock.frame_time(decoded)
            end_s = time_s + decoded.duration * self._clock.time_base
            packets = self._packets.take(decoded.pts, time_s) if self._packets else ()
            frame = Frame(index, time_s, image, packets=packets)
            if frame.size_wh != self._info.size_wh and not size_warned:
                size_warned = True
                self._warn_size(frame)
            yield frame
            index += 1
        self._report_end(index, end_s)

    def _pictures_in_order(self) -> Iterator[tuple[VideoFrame, Image]]:
        if self._first is not None:
            first, self._first = self._first, None
            yield first
        for decoded in self._decoded:
            yield decoded, self._convert(decoded)

    def _convert(self, frame: VideoFrame) -> Image:
        try:
            return self._pictures.picture(frame)
        except (av.FFmpegError, ValueError) as error:
            raise SourceError(
                f"{self._path}: pictures of format {frame.format.name} cannot be converted: "
                f"convert the video to yuv420p ({error})"
            ) from None

    def _first_frame(self) -> VideoFrame:
        for frame in self._decoded:
            return frame
        raise SourceError(
            f"{self._path} has no picture that can be decoded: it is damaged or cut off; "
            "record or copy it again"
        )

    def _describe(self, image: Image, with_packets: bool) -> SourceInfo:
        stream, early = self._stream, self._early or []
        self._early = None
        codec = asset = None
        if with_packets and not self._pictures.is_turned:
            codec = copyable_codec(self._path, stream)
            if codec is None and not self._clock.lost_order:
                asset = embeddable_path(self._path, stream, self._container.format.name)
        if codec is not None:
            self._packets = PacketQueue(stream, self._clock.packet_time)
            for packet in early:
                self._packets.put(packet)
        return SourceInfo(
            uri=str(self._path),
            size_wh=_size_wh(image),
            rate_hz=rate_hz(stream),
            frame_count=frame_count(stream, self._container.duration),
            packet_codec=codec,
            asset_path=asset,
        )

    # -- decoding -------------------------------------------------------------------------------

    def _decode(self) -> Generator[VideoFrame]:
        """Decoded frames; damage is counted and passed over, the decoder flushed at the end."""
        flagged: set[int | None] = set()
        for packet in self._demux():
            if packet.is_corrupt:
                flagged.add(packet.pts)
                self._count_damage("damaged packet")
            self._clock.note_packet(packet)
            yield from self._checked(self._decode_packet(packet), flagged)
        yield from self._checked(self._decode_packet(None), flagged)

    def _checked(self, frames: list[VideoFrame], flagged: set[int | None]) -> Iterator[VideoFrame]:
        for frame in frames:
            # Count a damaged picture once, even if its packet was known to be damaged.
            if frame.is_corrupt and frame.pts not in flagged:
                self._count_damage("damaged picture")
            flagged.discard(frame.pts)
            yield frame

    def _decode_packet(self, packet: AvPacket[VideoStream] | None) -> list[VideoFrame]:
        decoder = self._stream.codec_context
        frames: list[VideoFrame] = []
        try:
            frames = decoder.decode(packet)
        except av.error.EOFError:
            pass
        except (av.FFmpegError, ValueError) as error:
            self._count_damage(getattr(error, "strerror", None) or str(error))
            if self._packets is not None:
                self._packets.note_damage()
            if isinstance(error, av.error.BlockingIOError):
                decoder.flush_buffers()  # Stuck after damage: go on with the next keyframe.
        if packet is not None and not packet.is_corrupt:
            self._keep(packet)
        return frames

    def _keep(self, packet: AvPacket[VideoStream]) -> None:
        """Keep a packet for copying; only after decoding, as reframing empties it."""
        if self._packets is not None:
            self._packets.put(packet)
        elif self._early is not None:
            self._early.append(packet)

    def _demux(self) -> Iterator[AvPacket[VideoStream]]:
        """The stream's packets, tried again after damage as long as that brings more."""
        failures = 0
        while failures < _MAX_DEMUX_ERRORS:
            try:
                for packet in self._container.demux(self._stream):
                    self._packets_met += 1
                    if packet.size:  # The last, empty one would flush; empty ones are no pictures.
                        failures = 0
                        yield packet
                return
            except av.error.InvalidDataError as error:
                failures += 1
                self._count_damage(error.strerror or "damage")
            except av.FFmpegError as error:
                raise SourceError(
                    f"{self._path} became unreadable: {error.strerror}: check the disk"
                ) from None

    # -- warnings -------------------------------------------------------------------------------

    def _count_damage(self, what: str) -> None:
        self._corrupt += 1
        # The 1st, 10th, 100th ...: enough to notice, too little to drown in.
        if math.log10(self._corrupt).is_integer():
            _log.warning("%s: %s, passed over (number %d)", self._path.name, what, self._corrupt)

    def _warn_size(self, frame: Frame) -> None:
        _log.warning(
            "%s: picture size changes from %dx%d to %dx%d at frame %d",
            self._path.name,
            *self._info.size_wh,
            *frame.size_wh,
            frame.index,
        )

    def _report_end(self, frames: int, end_s: float) -> None:
        name, expected = self._path.name, self._stream.frames
        if self._corrupt:
            _log.warning(
                "%s: %d damaged packets in all: %d frames from %d packets",
                *(name, self._corrupt, frames, self._packets_met - 1),
            )
        rate = self._info.rate_hz
        length_s = expected / rate if expected and rate else duration_s(self._stream)
        # Judged by time, as AVI counts repeated pictures that it does not hold, and by count, as
        # the end may be there but damaged. Headers are rounded: leave some room.
        is_short = (
            length_s is not None
            and end_s + 0.25 < 0.95 * length_s
            and (not expected or self._packets_met < 0.95 * expected)
        )
        if is_short:
            promised = f"{expected} frames" if expected else f"{length_s:.2f} s"
            self._shortfall = (
                f"ends early, truncated or damaged: {frames} frames up to {end_s:.2f} s "
                f"of {promised} could be read"
            )
            _log.warning("%s %s", name, self._shortfall)


def _size_wh(image: Image) -> Size:
    return image.shape[1], image.shape[0]
