"""Cameras of Video4Linux2, read through the kernel's own interface.

It tells what no library passes on: the format that was granted, the driver's time stamps, the
sequence numbers that count lost frames, the flag on damaged ones; and it can be waited for with a
time-out. `uri` says how cameras are addressed.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import threading
import time
from dataclasses import dataclass
from fractions import Fraction

from streamtrack.closing import Closing
from streamtrack.errors import SourceError
from streamtrack.sources.capture import Captured, CaptureEndedError
from streamtrack.sources.v4l2 import api
from streamtrack.sources.v4l2.choice import Wanted, choose, rate_to_ask
from streamtrack.sources.v4l2.controls import set_controls
from streamtrack.sources.v4l2.formats import (
    COMPRESSED,
    FORMATS,
    Mode,
    describe,
    offered_formats,
    read_modes,
)
from streamtrack.sources.v4l2.mjpeg import JpegDecoder
from streamtrack.sources.v4l2.pixels import Layout, to_picture
from streamtrack.sources.v4l2.stream import Delivered, DriverClock, MappedStream, lost_between
from streamtrack.sources.v4l2.trouble import check_kind, check_path, not_a_camera, trouble
from streamtrack.sources.v4l2.uri import parse_address
from streamtrack.types import Image, Packet, Size, SourceInfo

_log = logging.getLogger("streamtrack.sources")

_CLOSE_TIMEOUT_S = 1.9
_MOST_DRAINED = 32
"""A device that has always one more frame ready would keep `read` from returning."""
_FRESH_TIMEOUT_S = 0.2
_SAME_RATE = 0.02


@dataclass(frozen=True, slots=True)
class Granted:
    """What the driver agreed to; ``rate_hz`` is None if it does not tell."""

    fourcc: str
    size_wh: Size
    rate_hz: float | None
    stride: int = 0
    is_full_range: bool = False

    def __str__(self) -> str:
        rate = "" if self.rate_hz is None else f" at {self.rate_hz:.4g} fps"
        return f"{self.size_wh[0]}x{self.size_wh[1]} {FORMATS.get(self.fourcc, self.fourcc)}{rate}"


class V4L2Capture(Closing):
    """An open camera; implements `streamtrack.sources.capture.Capture`.

    Frames are stamped by the driver: ``time_s`` and ``captured_s`` are both seconds of
    `time.monotonic`'s clock, the latter never later than now. Pictures are BGR (H, W, 3), or grey
    (H, W) for GREY and grey JPEG. JPEG pictures are passed on as packets too, unless damaged.
    If several frames are waiting the newest is given and the others count as ``dropped``.
    One thread at a time may call it.
    """

    def __init__(self, uri: str) -> None:
        """Open, negotiate and start. Raises UsageError or SourceError with nothing left open.

        What is granted otherwise than asked is logged as a warning.
        """
        self._address = parse_address(uri)
        self._path = self._address.path
        self._fd = -1
        self._stream: MappedStream | None = None
        self._ended: OSError | None = None
        self._sequence: int | None = None
        self._lost = self._damaged = self._dropped = 0
        self._told = (0, 0, 0)
        check_path(self._path)
        try:
            self._granted = self._opened()
            self._jpeg = None
            if self._granted.fourcc in COMPRESSED:
                self._jpeg = JpegDecoder(self._granted.size_wh)
        except OSError as error:
            self.close()
            raise trouble(self._path, error) from None
        except BaseException:
            self.close()
            raise
        _log.info("%s: %s", self._path, self._granted)
        self._clock = DriverClock(time.monotonic())
        self._info = SourceInfo(
            uri,
            self._granted.size_wh,
            self._granted.rate_hz,
            None,
            is_live=True,
            packet_codec="mjpeg" if self._jpeg else None,
        )

    @property
    def info(self) -> SourceInfo:
        return self._info

    @property
    def granted(self) -> Granted:
        """Format, size and rate as the driver confirmed them."""
        return self._granted

    @property
    def lost(self) -> int:
        """Frames that the driver numbered and did not deliver, since opening."""
        return self._lost

    @property
    def damaged(self) -> int:
        """Frames that were rejected since opening: flagged, cut short, or not to be decoded."""
        return self._damaged

    @property
    def dropped(self) -> int:
        """Good frames passed over for a newer one since opening, because nobody read in time."""
        return self._dropped

    def read(self, timeout_s: float) -> Captured | None:
        """The newest frame, or None if no good one comes in time.

        Raises CaptureEndedError when the device is gone or broken, after what it still gave.
        """
        deadline_s = time.monotonic() + timeout_s
        while True:
            delivered = self._newest(deadline_s)
            if delivered is not None:
                captured = self._captured(delivered)
                if captured is not None:
                    return captured
                self._damaged += 1
            if time.monotonic() >= deadline_s:
                return None

    def close(self) -> None:
        """Give the device back; whatever it does, within two seconds."""
        fd, stream = self._fd, self._stream
        self._fd, self._stream = -1, None
        if stream is None:
            if fd >= 0:
                os.close(fd)
            return

        def release() -> None:
            stream.stop()
            os.close(fd)

        # Stopping a camera can hang in its driver, and nothing can interrupt that.
        thread = threading.Thread(target=release, name="v4l2-close", daemon=True)
        thread.start()
        thread.join(_CLOSE_TIMEOUT_S)
        if thread.is_alive():
            _log.warning("%s does not stop: its driver hangs; it is left to itself", self._path)

    def _opened(self) -> Granted:
        """Open the device, bring it to what is wanted and start it. Raises OSError too."""
        wanted = self._address.wanted
        fd = self._fd = os.open(self._path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            node = describe(fd, self._path)
        except OSError as error:
            if error.errno in (errno.ENOTTY, errno.EINVAL):
                raise not_a_camera(self._path) from None
            raise
        check_kind(node)
        formats = offered_formats(fd, node)
        modes = read_modes(fd, filter(FORMATS.__contains__, formats), wanted.size_wh)
        mode = choose(modes, wanted)
        if mode is None:
            raise SourceError(
                f"{self._path} ({node.name}) offers no format that can be read: it offers "
                f"{', '.join(formats) or 'none'}; known are {', '.join(FORMATS.values())}"
            )
        granted = _set_format(fd, self._path, mode, node.is_mplane)
        if granted.fourcc not in FORMATS:
            raise SourceError(
                f"{self._path} was asked for {FORMATS[mode.fourcc]} and gives {granted.fourcc}, "
                f"which cannot be read: ask for another format than {FORMATS[mode.fourcc]}"
            )
        rate_hz = _set_rate(fd, rate_to_ask(mode, wanted), node.is_mplane)
        granted = Granted(
            granted.fourcc, granted.size_wh, rate_hz, granted.stride, granted.is_full_range
        )
        for difference in differences(wanted, mode, granted):
            _log.warning("%s: %s", self._path, difference)
        set_controls(fd, self._path, self._address.controls)
        self._stream = MappedStream(fd, node.is_mplane)
        self._stream.start()
        return granted

    def _newest(self, deadline_s: float) -> Delivered | None:
        """The newest good buffer after emptying the queue, waiting for it if there is none."""
        newest, was_full = self._drained(deadline_s)
        if newest is None or not was_full:
            return newest
        # The driver had no buffer left to fill, so what lay there is old; the next is not.
        try:
            fresh, _ = self._drained(min(deadline_s, time.monotonic() + _FRESH_TIMEOUT_S))
        except CaptureEndedError:
            return newest  # The next call raises it again.
        self._dropped += fresh is not None
        return fresh or newest

    def _drained(self, deadline_s: float) -> tuple[Delivered | None, bool]:
        """The newest good buffer, and whether the queue was full."""
        if self._stream is None:
            raise CaptureEndedError(f"{self._path} is closed: open it again")
        if self._ended is not None:
            raise self._end(self._ended)
        if not self._stream.wait(deadline_s - time.monotonic()):
            return None, False
        newest: Delivered | None = None
        count = 0
        try:
            while count < _MOST_DRAINED and (delivered := self._stream.take()) is not None:
                count += 1
                if self._is_good(delivered):
                    self._dropped += newest is not None
                    newest = delivered
        except OSError as error:
            if newest is None:
                raise self._end(error) from None
            self._ended = _plain(error)
            return newest, False
        return newest, count >= self._stream.buffers

    def _is_good(self, delivered: Delivered) -> bool:
        lost = lost_between(self._sequence, delivered.sequence)
        self._sequence = delivered.sequence
        self._lost += lost
        is_good = bool(delivered.data) and not delivered.is_error
        self._damaged += not is_good
        return is_good

    def _captured(self, delivered: Delivered) -> Captured | None:
        """The decoded frame, or None if it is damaged."""
        now_s = time.monotonic()
        packet: bytes | None = None
        image: Image | None
        if self._jpeg is not None:
            image, packet = self._jpeg.decode(delivered.data) or (None, None)
        else:
            image = to_picture(delivered.data, self._layout)
        if image is None:
            return None
        time_s = self._clock.time_s(delivered.stamp_s, delivered.is_monotonic, now_s)
        totals = self._lost, self._damaged, self._dropped
        lost, damaged, dropped = (now - then for now, then in zip(totals, self._told, strict=True))
        self._told = totals
        return Captured(
            image,
            time_s,
            min(time_s, now_s),
            lost,
            damaged,
            () if packet is None else (Packet(time_s, packet, True),),
            dropped,
        )

    @property
    def _layout(self) -> Layout:
        granted = self._granted
        return Layout(granted.fourcc, granted.size_wh, granted.stride, granted.is_full_range)

    def _end(self, error: OSError) -> CaptureEndedError:
        self._ended = _plain(error)
        if error.errno in (errno.ENODEV, errno.ENXIO):
            return CaptureEndedError(f"{self._path} was unplugged: plug it in again")
        return CaptureEndedError(
            f"{self._path} broke off ({error.strerror or error}): open it again"
        )


def _plain(error: OSError) -> OSError:
    """An error to keep: the one that was raised holds, by its frames, the capture that keeps it."""
    return OSError(error.errno, error.strerror)


def _set_format(fd: int, path: str, mode: Mode, is_mplane: bool) -> Granted:
    """Ask for format and size; the driver grants what is nearest to it."""
    asked = api.Format(type=api.BUF_TYPE_CAPTURE_MPLANE if is_mplane else api.BUF_TYPE_CAPTURE)
    pix = asked.fmt.pix_mp if is_mplane else asked.fmt.pix
    pix.width, pix.height = mode.size_wh
    pix.pixelformat = api.code_of(mode.fourcc)
    pix.field = api.FIELD_NONE
    if is_mplane:
        pix.num_planes = 1
    api.ioctl(fd, api.S_FMT, asked)
    if pix.field in api.INTERLACED_FIELDS:
        _log.warning("%s sends half pictures: every other line is missing", path)
    full = pix.quantization == api.QUANTIZATION_FULL_RANGE or (
        pix.quantization == 0 and pix.colorspace == api.COLORSPACE_JPEG
    )
    stride = pix.plane_fmt[0].bytesperline if is_mplane else pix.bytesperline
    return Granted(api.fourcc_of(pix.pixelformat), (pix.width, pix.height), None, stride, full)


def _set_rate(fd: int, rate_hz: float | None, is_mplane: bool) -> float | None:
    """Ask for a frame rate; the rate that the driver sets, or None if it does not tell."""
    buffer_type = api.BUF_TYPE_CAPTURE_MPLANE if is_mplane else api.BUF_TYPE_CAPTURE
    answer = api.StreamParm(type=buffer_type)
    capture = answer.parm.capture
    if rate_hz is not None:
        interval = 1 / Fraction(rate_hz).limit_denominator(1001)
        capture.numerator, capture.denominator = interval.numerator, interval.denominator
    with contextlib.suppress(OSError):  # many drivers refuse to set, some also to tell
        if api.is_offered(fd, api.G_PARM if rate_hz is None else api.S_PARM, answer):
            told = bool(capture.capability & api.CAP_TIMEPERFRAME and capture.numerator)
            return capture.denominator / capture.numerator if told else None
    return None


def differences(wanted: Wanted, mode: Mode, granted: Granted) -> list[str]:
    """What was asked for and not granted, each in words."""
    found: list[str] = []
    asked = wanted.fourcc or mode.fourcc
    if granted.fourcc != asked and not (granted.fourcc in COMPRESSED and asked in COMPRESSED):
        found.append(f"asked for {FORMATS[asked]}, granted is {FORMATS[granted.fourcc]}")
    size_wh = wanted.size_wh or mode.size_wh
    if granted.size_wh != size_wh:
        found.append(
            f"asked for {size_wh[0]}x{size_wh[1]}, granted is "
            f"{granted.size_wh[0]}x{granted.size_wh[1]}"
        )
    rate_hz = wanted.rate_hz
    if rate_hz is None:
        return found
    if granted.rate_hz is None:
        found.append(f"asked for {rate_hz:.4g} fps, the device does not tell its rate")
    elif abs(granted.rate_hz - rate_hz) > _SAME_RATE * rate_hz:
        found.append(f"asked for {rate_hz:.4g} fps, granted is {granted.rate_hz:.4g}")
    return found
