"""The process that reads a network stream or a pipe for `streamtrack.sources.network.stream`.

FFmpeg cannot be interrupted everywhere (a pipe that is silent, a name server that does not answer,
a decoder that hangs) and may crash on damaged streams; a process can always be ended. Run as a
module with the numbers of the two descriptors that `wire` is about. It imports nothing
but PyAV and the standard library, so it starts in a tenth of a second of CPU.
"""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import socket
import struct
import sys
import time
from collections.abc import Iterator
from itertools import chain
from typing import Any

import av
from av import logging as av_logging
from av.container import InputContainer
from av.packet import Packet
from av.stream import Discard, Disposition
from av.video.frame import VideoFrame
from av.video.reformatter import VideoReformatter
from av.video.stream import VideoStream

from streamtrack.sources._thinner import Thinner
from streamtrack.sources.network.reader_packets import Copier, codec_name, is_copyable
from streamtrack.sources.network.wire import User

_MAX_DEMUX_ERRORS = 20
_GREY_PREFIXES = ("gray", "ya8", "ya16", "mono")
_FULL_RANGE = 2  # AVCOL_RANGE_JPEG
# These formats carry no times: FFmpeg counts pictures at an assumed rate.
_UNSTAMPED = ("mpjpeg", "mjpeg", "h264", "hevc", "m4v", "obu", "jpeg_pipe", "image2pipe")


class Reader:
    """Opens what was asked for and sends its pictures until it ends."""

    def __init__(self, user: User, request: dict[str, Any]) -> None:
        self._user = user
        self._request = request
        self._container: InputContainer | None = None
        self._thinner = Thinner(request["max_fps"])
        self._arrivals: dict[int | None, float] = {}
        self._damaged = self._dropped = self._thinned = 0
        self._has_picture = False
        self._turn = (False, False, False)
        self._reformatter = VideoReformatter()

    def run(self) -> None:
        """Read to the end; whatever ends it is told to the user."""
        # FFmpeg's own words say most of why an address cannot be opened; later it only chatters.
        av_logging.set_level(av_logging.ERROR)
        logs: list[tuple[int, str, str]] = []
        is_open = False
        try:
            with av_logging.Capture(local=False) as logs:
                self._open()
                pictures = self._pictures()
                first = next(pictures, None)
            av_logging.set_level(None)
            if first is None:
                raise ValueError("no picture that can be decoded came")
            is_open = True
            self._send_info(first[0])
            self._send_all(first, pictures)
            is_finished = not self._is_live or self._request["ends_for_good"]
            self._user.send(_end("the stream ended", is_finished))
        except (av.FFmpegError, ValueError) as error:
            # PyAV's own words hold the address, so only the reason is passed on.
            reason = getattr(error, "strerror", None) or str(error)
            if is_open:
                self._user.send(_end(_in_words(reason), False))
            else:
                self._user.send(_trouble(_trouble_kind(error), reason, logs))
        finally:
            if self._container is not None:
                self._container.close()

    def _open(self) -> None:
        request = self._request
        container = self._container = av.open(
            request["url"],
            mode="r",
            format=request["format"],
            options=request["options"],
            metadata_errors="ignore",
        )
        found = [
            stream
            for stream in container.streams.video
            if not stream.disposition & Disposition.attached_pic
            and getattr(stream, "codec_context", None) is not None
        ]
        if not found or container.format.name == "tty":
            raise ValueError("it has no pictures that can be decoded")
        stream = self._stream = max(found, key=lambda one: one.width * one.height)
        for other in container.streams:
            if other is not stream:
                other.discard = Discard.all
        self._is_live = request["is_live"] or _is_endless(container, stream)
        self._is_patient = request["is_patient"] or not self._is_live
        context = stream.codec_context
        # Threads by frame would hold back a picture for each of them.
        context.thread_type = "SLICE" if self._is_live else "AUTO"
        context.thread_count = min(4, os.cpu_count() or 1)
        if codec_name(stream) == "mjpeg":
            # Without it half a picture passes as a good one.
            context.options = {"err_detect": "explode"}
        self._is_stamped = container.format.name not in _UNSTAMPED
        # Whether they can be copied is known when the first picture is decoded.
        self._copier = Copier(stream) if request["packets"] else None

    def _send_info(self, first: VideoFrame) -> None:
        stream, container = self._stream, self._container
        assert container is not None
        if first.side_data.get("DISPLAYMATRIX") is not None:
            self._turn = _turn_of(first)
        if any(self._turn) or not is_copyable(stream):
            self._copier = None
        rate = stream.average_rate or stream.guessed_rate if self._is_stamped else None
        width, height = first.width, first.height
        self._user.send(
            {
                "kind": "info",
                "size": (height, width) if self._turn[0] else (width, height),
                "rate_hz": float(rate) if rate else None,
                "frames": None if self._is_live else _frame_count(container, stream),
                "is_live": self._is_live,
                "codec": None if self._copier is None else codec_name(stream),
                "is_stamped": self._is_stamped,
                "turn": self._turn,
                "what": f"{container.format.name}, {stream.codec_context.name}",
            }
        )

    # -- pictures -------------------------------------------------------------------------------

    def _pictures(self) -> Iterator[tuple[VideoFrame, float]]:
        """Good pictures with their moments of arrival (`time.monotonic`)."""
        container = self._container
        assert container is not None
        failures = 0
        while not self._user.is_closing:
            try:
                for packet in container.demux(self._stream):
                    failures = 0
                    now = time.monotonic()
                    if self._user.is_closing:
                        return
                    if not packet.size:
                        continue  # Nothing arrived; the last one of a file says so.
                    self._arrivals[packet.pts] = now
                    yield from self._good(self._decode(packet), now)
                yield from self._good(self._decode(None), time.monotonic())
                return
            except av.error.InvalidDataError:
                self._note_damage()
                failures += 1
                if failures > _MAX_DEMUX_ERRORS:
                    raise

    def _decode(self, packet: Packet[VideoStream] | None) -> list[VideoFrame]:
        frames: list[VideoFrame] = []
        try:
            frames = self._stream.codec_context.decode(packet)
        except av.error.EOFError:
            pass
        except (av.FFmpegError, ValueError):
            self._note_damage()
            return frames
        if packet is not None and self._copier is not None and not packet.is_corrupt:
            self._copier.put(packet, self._time_of(packet.pts, self._arrivals[packet.pts]))
        return frames

    def _good(self, frames: list[VideoFrame], now: float) -> Iterator[tuple[VideoFrame, float]]:
        for frame in frames:
            arrived = self._arrivals.pop(frame.pts, now)
            if len(self._arrivals) > 64:
                self._arrivals.clear()
            if frame.is_corrupt:
                self._note_damage()
                continue
            self._has_picture = True
            yield frame, arrived

    def _note_damage(self) -> None:
        # A stream joined between two keyframes is not damaged because it cannot be decoded yet.
        self._damaged += self._has_picture

    def _time_of(self, pts: int | None, arrived: float) -> float | None:
        if not self._is_stamped:
            return arrived
        base = self._stream.time_base
        return None if pts is None or base is None else float(pts * base)

    def _send_all(
        self,
        first: tuple[VideoFrame, float],
        others: Iterator[tuple[VideoFrame, float]],
    ) -> None:
        for frame, arrived in chain([first], others):
            self._send_picture(frame, arrived)
            if self._user.is_closing:
                return

    def _send_picture(self, frame: VideoFrame, arrived: float) -> None:
        time_s = self._time_of(frame.pts, arrived)
        is_wanted = self._thinner.takes(arrived if time_s is None else time_s)
        slot = self._user.free_slot(is_patient=self._is_patient) if is_wanted else None
        if slot is None:
            self._thinned += not is_wanted
            self._dropped += is_wanted
            if self._copier is not None and self._copier.is_intra:
                self._copier.take()  # Nothing later needs them.
            return
        plain = self._convert(frame)
        plane = plain.planes[0]
        offset = self._user.put(slot, memoryview(plane))
        packets = () if self._copier is None else self._copier.take()
        self._user.send(
            {
                "kind": "picture",
                "slot": slot,
                "offset": offset,
                "shape": (plain.height, plain.width, 1 if plain.format.name == "gray" else 3),
                "stride": plane.line_size,
                "time_s": time_s,
                "arrived_s": arrived,
                "damaged": self._damaged,
                "dropped": self._dropped,
                "thinned": self._thinned,
                "packets": [(at, len(data), is_key) for at, data, is_key in packets],
            },
            tuple(data for _, data, _ in packets),
        )
        self._damaged = self._dropped = self._thinned = 0

    def _convert(self, frame: VideoFrame) -> VideoFrame:
        # Full range and one thread, as for files.
        is_grey = frame.format.name.startswith(_GREY_PREFIXES)
        return self._reformatter.reformat(
            frame,
            format="gray" if is_grey else "bgr24",
            src_color_range=frame.color_range,
            dst_color_range=_FULL_RANGE,
            threads=1,
        )


def _is_endless(container: InputContainer, stream: VideoStream) -> bool:
    """False for a finished file: its header tells a length, or the server its size."""
    if (container.duration or 0) > 0 or (stream.duration or 0) > 0:
        return False
    # The size of a playlist says nothing of what it lists.
    return container.format.name == "hls" or container.size <= 0


def _frame_count(container: InputContainer, stream: VideoStream) -> int | None:
    rate = stream.average_rate or stream.guessed_rate
    length_s = (container.duration or 0) / 1e6
    return stream.frames or (round(length_s * float(rate)) if rate and length_s > 0 else None)


def _turn_of(frame: VideoFrame) -> tuple[bool, bool, bool]:
    """(transpose first, then flip x, flip y), from the display matrix; as in `_av`."""
    matrix: Any = frame.side_data.get("DISPLAYMATRIX")
    a, b, _, c, d = struct.unpack("<5i", bytes(matrix)[:20])
    if abs(a) + abs(d) >= abs(b) + abs(c):
        return False, a < 0, d < 0
    return True, c < 0, b < 0


def _in_words(reason: str) -> str:
    return "the peer hung up" if reason == os.strerror(errno.EIO) else reason


def _trouble_kind(error: BaseException) -> str:
    if isinstance(error, av.error.HTTPUnauthorizedError | av.error.HTTPForbiddenError):
        return "refused"
    if isinstance(error, av.error.ProtocolNotFoundError | av.error.DemuxerNotFoundError):
        return "unknown"
    return "failed"


def _end(reason: str, is_finished: bool) -> dict[str, Any]:
    return {"kind": "end", "reason": reason, "is_finished": is_finished}


def _trouble(kind: str, reason: str, logs: list[tuple[int, str, str]]) -> dict[str, Any]:
    said = [" ".join(message.split()) for _, _, message in logs]
    return {"kind": "error", "trouble": kind, "reason": reason, "said": said[-5:]}


def main() -> None:
    """Serve one request."""
    # Ctrl-C goes to the whole terminal, and a service manager's end to the whole service: what
    # they mean is for the user of the stream to decide, who ends this by the socket.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    channel = socket.socket(fileno=int(sys.argv[1]))
    user = User(channel, int(sys.argv[2]))
    with contextlib.suppress(BrokenPipeError, ConnectionResetError):
        Reader(user, user.request()).run()
    # The listening thread and FFmpeg's need no good-bye.
    os._exit(0)


if __name__ == "__main__":
    main()
