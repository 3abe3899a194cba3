"""Network streams and standard input, read by a process of their own (`reader_process`)."""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from streamtrack.closing import Closing
from streamtrack.errors import SourceError, UsageError
from streamtrack.settings import LiveSettings
from streamtrack.sources.addresses import STDIN, Redactor, check_network_address, redacted
from streamtrack.sources.capture import (
    Captured,
    CaptureEndedError,
    CaptureFinishedError,
    CaptureRefusedError,
)
from streamtrack.sources.network.arrival import ArrivalClock
from streamtrack.sources.network.wire import Messages
from streamtrack.types import Image, Packet, SourceInfo

_READER = "streamtrack.sources.network.reader_process"
_SLICE_S = 0.1
_GOODBYE_S = 1.0
_PROTOCOLS = "rtsp,rtp,srtp,udp,tcp,tls,http,https,httpproxy,crypto,srt,rtmp,rtmps,rtmpt,fd"
"""All that an address, or a playlist that it leads to, may open: no local files."""


class NetworkCapture(Closing):
    """An open network stream or pipe; implements `streamtrack.sources.capture.Capture`.

    ``rtsp``, ``rtsps`` (over TCP unless ``settings`` say UDP), ``http`` and ``https`` (MJPEG, HLS,
    files), ``udp`` and ``tcp`` (MPEG-TS or anything that FFmpeg knows by its look), ``-`` for
    standard input. Pictures are uint8 (H, W, 3) BGR, or (H, W) for grey formats, and their size
    may change midway. Damaged ones are rejected and counted; after one of H.264 or H.265 those that
    follow may be smeared up to the next keyframe, as FFmpeg conceals.

    A stream whose header tells its length, or whose server tells its size, is a finished file:
    `SourceInfo.is_live` is false, no picture is left out but by ``max_fps``, and its end raises
    CaptureFinishedError. The end of ``-`` does too.

    ``captured_s`` is the moment of arrival, freed from the jitter of the network by the stream's
    own times (`ArrivalClock`); what passed in the camera and on the way cannot be known.
    """

    def __init__(
        self,
        uri: str,
        settings: LiveSettings | None = None,
        *,
        with_packets: bool = False,
        should_stop: Callable[[], bool] | None = None,
    ) -> None:
        """Start the reader and wait for the first picture, ``open_timeout_s`` at the most.

        Raises UsageError for an address that cannot be right, CaptureRefusedError if the peer
        refuses the credentials, else SourceError; all in words without the credentials.
        ``should_stop`` is asked ten times a second and ends the waiting.
        """
        settings = settings or LiveSettings()
        if uri != STDIN:
            check_network_address(uri)
        self._uri = uri
        self._name = "standard input" if uri == STDIN else redacted(uri)
        self._redact = Redactor(uri)
        self._arrival = ArrivalClock()
        self._memory: mmap.mmap | None = None
        self._time_s = 0.0
        self._reader, self._channel, self._memory_fd = _start_reader(uri == STDIN)
        self._messages = Messages(self._channel)
        try:
            self._ask(_request(uri, settings, with_packets))
            self._described = self._wait_for_info(settings.open_timeout_s, should_stop)
        except BaseException:
            self._kill()
            raise
        described = self._described
        self._is_stamped = bool(described["is_stamped"])
        self._turn: tuple[bool, bool, bool] = tuple(described["turn"])
        self._info = SourceInfo(
            uri=uri if uri == STDIN else redacted(uri),
            size_wh=(described["size"][0], described["size"][1]),
            rate_hz=described["rate_hz"],
            frame_count=described["frames"],
            is_live=described["is_live"],
            packet_codec=described["codec"],
        )

    @property
    def info(self) -> SourceInfo:
        """Size, rate and codec of the first picture; the address without its secrets."""
        return self._info

    @property
    def description(self) -> str:
        """Container and codec, by FFmpeg's names."""
        return str(self._described["what"])

    @property
    def reader_pid(self) -> int:
        """The reader's process id."""
        return self._reader.pid

    def read(self, timeout_s: float) -> Captured | None:
        """The next picture, or None if none came in time.

        Raises CaptureEndedError when the stream is over, CaptureFinishedError if it was to be.
        """
        try:
            received = self._messages.receive(timeout_s)
        except EOFError:
            raise CaptureEndedError(f"{self._name}: {self._cause_of_death()}") from None
        if received is None:
            return None
        message, data = received
        if message["kind"] == "picture":
            return self._captured(message, data)
        is_finished = message["kind"] == "end" and message["is_finished"]
        ended = CaptureFinishedError if is_finished else CaptureEndedError
        raise ended(f"{self._name}: {self._redact(message['reason'])}")

    def close(self) -> None:
        """Say good-bye to the peer and end the reader, by force after a second."""
        if self._memory_fd < 0:
            return
        with contextlib.suppress(OSError):
            self._channel.shutdown(socket.SHUT_WR)
        # Its last messages would block it.
        with contextlib.suppress(EOFError):
            while self._messages.receive(_GOODBYE_S) is not None:
                pass
        self._kill()

    # -- opening --------------------------------------------------------------------------------

    def _ask(self, request: dict[str, Any]) -> None:
        # Over the socket, as a process list shows arguments to everyone. A reader that is gone
        # already tells by its end.
        with contextlib.suppress(OSError):
            self._channel.sendall(json.dumps(request).encode() + b"\n")

    def _wait_for_info(
        self, timeout_s: float, should_stop: Callable[[], bool] | None
    ) -> dict[str, Any]:
        end_s = time.monotonic() + timeout_s
        received = None
        while received is None:
            if should_stop is not None and should_stop():
                raise SourceError(f"{self._name}: interrupted before the first picture")
            left_s = end_s - time.monotonic()
            if left_s <= 0:
                raise SourceError(
                    f"{self._name}: no picture within {timeout_s:g} s: check that it is sending, "
                    "or raise live.open_timeout_s"
                )
            try:
                received = self._messages.receive(min(_SLICE_S, left_s))
            except EOFError:
                raise SourceError(f"{self._name}: {self._cause_of_death()}") from None
        message, _ = received
        if message["kind"] == "info":
            return message
        raise self._trouble(message)

    def _trouble(self, message: dict[str, Any]) -> SourceError | UsageError:
        said = next((text for text in reversed(message["said"]) if text), "")
        reason = self._redact(message["reason"])
        said = self._redact(said)
        if message["trouble"] == "refused":
            return CaptureRefusedError(
                f"{self._name}: {reason}: check user and password, written "
                "SCHEME://USER:PASSWORD@HOST/..., special characters as %XX"
            )
        if message["trouble"] == "unknown":
            return UsageError(f"{self._name}: this FFmpeg cannot read it: {reason}")
        detail = f" ({said})" if said and said != reason else ""
        advice = "the pipe's other end" if self._uri == STDIN else "the address and the sender"
        return SourceError(f"{self._name}: cannot be opened: {reason}{detail}: check {advice}")

    def _cause_of_death(self) -> str:
        with contextlib.suppress(subprocess.TimeoutExpired):
            code = self._reader.wait(timeout=_GOODBYE_S)
            return f"its reader ended unexpectedly (code {code})"
        return "its reader does not answer"

    # -- pictures -------------------------------------------------------------------------------

    def _captured(self, message: dict[str, Any], data: bytes) -> Captured:
        image = self._picture(message)
        arrived_s = float(message["arrived_s"])
        time_s = message["time_s"]
        captured_s = arrived_s
        if time_s is None:
            time_s = self._time_s + 1e-6  # A picture without a time among others that have one.
        elif self._is_stamped and self._info.is_live:
            captured_s = self._arrival.captured_s(time_s, arrived_s)
        self._time_s = time_s
        return Captured(
            image,
            time_s,
            captured_s,
            damaged=message["damaged"],
            packets=_packets(message["packets"], data, time_s),
            dropped=message["dropped"],
            thinned=message["thinned"],
        )

    def _picture(self, message: dict[str, Any]) -> Image:
        """A copy of the picture in its slot, which is given back."""
        height, width, channels = message["shape"]
        stride, offset = message["stride"], message["offset"]
        end = offset + stride * height
        if self._memory is None or end > len(self._memory):
            self._memory = mmap.mmap(self._memory_fd, os.fstat(self._memory_fd).st_size)
        rows = np.frombuffer(self._memory, np.uint8, stride * height, offset)
        picture = rows.reshape(height, stride)[:, : width * channels].copy()
        del rows
        with contextlib.suppress(OSError):
            self._channel.settimeout(None)
            self._channel.sendall(bytes([message["slot"]]))
        shape = (height, width) if channels == 1 else (height, width, channels)
        return _upright(picture.reshape(shape), self._turn)

    def _kill(self) -> None:
        self._reader.kill()
        self._reader.wait()
        self._channel.close()
        os.close(self._memory_fd)
        self._memory, self._memory_fd = None, -1


def _start_reader(reads_stdin: bool) -> tuple[subprocess.Popen[bytes], socket.socket, int]:
    """The process, the socket to it, and the descriptor of the memory that both map."""
    ours, its = socket.socketpair()
    memory_fd = _memory_file()
    try:
        reader = subprocess.Popen(
            [sys.executable, "-P", "-m", _READER, str(its.fileno()), str(memory_fd)],
            stdin=None if reads_stdin else subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=(its.fileno(), memory_fd),
            env={**os.environ, "PYTHONPATH": os.pathsep.join(path or "." for path in sys.path)},
        )
    except OSError as error:
        ours.close()
        os.close(memory_fd)
        raise SourceError(f"cannot start a process to read a stream: {error.strerror}") from None
    finally:
        its.close()
    return reader, ours, memory_fd


def _memory_file() -> int:
    if hasattr(os, "memfd_create"):
        return os.memfd_create("streamtrack-pictures")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


def _request(uri: str, settings: LiveSettings, with_packets: bool) -> dict[str, Any]:
    scheme = uri.partition("://")[0].lower()
    is_rtsp = scheme in ("rtsp", "rtsps")
    # Little is looked at before the first picture: each second of it is a second's delay.
    options = {
        "protocol_whitelist": _PROTOCOLS,
        "analyzeduration": "1500000",
        "fpsprobesize": "3",
    }
    if is_rtsp:
        options |= {
            "rtsp_transport": settings.rtsp_transport,
            "allowed_media_types": "video",
        }
    if scheme == "udp":
        options |= {"fifo_size": "50000", "overrun_nonfatal": "1"}
    return {
        "url": "fd:" if uri == STDIN else uri,
        "format": None,
        "options": options,
        "max_fps": settings.max_fps,
        "packets": with_packets,
        "is_live": scheme not in ("http", "https", STDIN),
        "is_patient": not settings.newest_only,
        "ends_for_good": uri == STDIN,
    }


def _packets(entries: list[list[Any]], data: bytes, time_s: float) -> tuple[Packet, ...]:
    packets, start = [], 0
    for at, length, is_keyframe in entries:
        at_s = time_s if at is None else min(float(at), time_s)
        packets.append(Packet(at_s, data[start : start + length], is_keyframe))
        start += length
    return tuple(packets)


def _upright(image: Image, turn: tuple[bool, bool, bool]) -> Image:
    if not any(turn):
        return image
    is_transposed, flip_x, flip_y = turn
    if is_transposed:
        image = np.swapaxes(image, 0, 1)
    return np.ascontiguousarray(image[:: -1 if flip_y else 1, :: -1 if flip_x else 1])
