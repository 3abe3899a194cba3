"""What the V4L2 nodes of this machine are and offer: kind, formats, sizes, rates."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from streamtrack.sources.v4l2 import api
from streamtrack.types import Size

FORMATS = {
    "YUYV": "yuyv",
    "UYVY": "uyvy",
    "NV12": "nv12",
    "YU12": "yu12",
    "BGR3": "bgr24",
    "RGB3": "rgb24",
    "MJPG": "mjpeg",
    "JPEG": "jpeg",
    "GREY": "grey",
}
"""The pixel formats that can be read, by fourcc, with their names in a URI."""
COMPRESSED = ("MJPG", "JPEG")
_COMMON_SIZES: tuple[Size, ...] = (
    *((160, 120), (320, 240), (640, 360), (640, 480), (800, 600)),
    *((1280, 720), (1280, 960), (1920, 1080), (2592, 1944), (3840, 2160)),
)
_MOST_ENTRIES = 256
"""A driver that lists more of anything than this is taken to be listing for ever."""


class NodeKind(StrEnum):
    """What a node carries."""

    CAPTURE = "capture"
    METADATA = "metadata"
    OUTPUT = "output"
    CONVERTER = "converter"
    OTHER = "other"


@dataclass(frozen=True, slots=True)
class Rates:
    """Frame rates in Hz, the fastest first; if ``is_range``, the two ends. Empty if not told."""

    values: tuple[float, ...] = ()
    is_range: bool = False

    def nearest(self, rate_hz: float) -> float | None:
        """The offered rate nearest to the one wanted."""
        if not self.values:
            return None
        if self.is_range:
            return min(max(rate_hz, self.values[-1]), self.values[0])
        return min(self.values, key=lambda value: abs(value - rate_hz))

    def __str__(self) -> str:
        return ("-" if self.is_range else ", ").join(f"{value:.4g}" for value in self.values)


@dataclass(frozen=True, slots=True)
class Mode:
    """One way in which a device can deliver pictures; sizes out of a range are the common ones."""

    fourcc: str
    size_wh: Size
    rates: Rates
    is_ranged: bool = False


@dataclass(frozen=True, slots=True)
class Node:
    """A V4L2 device node as its driver describes it."""

    path: str
    name: str
    driver: str
    bus: str
    kind: NodeKind
    is_mplane: bool
    is_streaming: bool


@contextmanager
def opened(path: str) -> Iterator[int]:
    """A descriptor of the node, closed at the end. Raises OSError."""
    fd = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        yield fd
    finally:
        os.close(fd)


def node_paths() -> list[str]:
    """The video nodes there are, in the order of their numbers."""
    numbers = [
        int(match[1]) for entry in _names("/dev") if (match := re.fullmatch(r"video(\d+)", entry))
    ]
    return [f"/dev/video{number}" for number in sorted(numbers)]


def stable_paths() -> dict[str, str]:
    """Names that stay when devices are plugged in another order, by the node they lead to now."""
    links: dict[str, str] = {}
    for folder in ("/dev/v4l/by-path", "/dev/v4l/by-id"):  # by-id, the better one, wins
        for name in sorted(_names(folder), reverse=True):
            links[os.path.realpath(f"{folder}/{name}")] = f"{folder}/{name}"
    return links


def _names(folder: str) -> list[str]:
    try:
        return [path.name for path in Path(folder).iterdir()]
    except OSError:
        return []


def describe(fd: int, path: str) -> Node:
    """What the node is. Raises OSError; ENOTTY if it is no V4L2 device."""
    answer = api.Capability()
    api.ioctl(fd, api.QUERYCAP, answer)
    # "capabilities" are those of the whole device, "device_caps" those of this node.
    has_own = answer.capabilities & api.CAP_DEVICE_CAPS
    caps = answer.device_caps if has_own else answer.capabilities
    return Node(
        path,
        api.text_of(answer.card),
        api.text_of(answer.driver),
        api.text_of(answer.bus_info),
        _kind(caps),
        not caps & api.CAP_VIDEO_CAPTURE and bool(caps & api.CAP_VIDEO_CAPTURE_MPLANE),
        bool(caps & api.CAP_STREAMING),
    )


def _kind(caps: int) -> NodeKind:
    if caps & (api.CAP_VIDEO_M2M | api.CAP_VIDEO_M2M_MPLANE):
        return NodeKind.CONVERTER
    captures = caps & (api.CAP_VIDEO_CAPTURE | api.CAP_VIDEO_CAPTURE_MPLANE)
    outputs = caps & (api.CAP_VIDEO_OUTPUT | api.CAP_VIDEO_OUTPUT_MPLANE)
    # Old converters have no word of their own for both ways; v4l2loopback does both in one node,
    # and captures from whatever feeds it.
    if captures and outputs and caps & api.CAP_VIDEO_CAPTURE_MPLANE:
        return NodeKind.CONVERTER
    if captures:
        return NodeKind.CAPTURE
    if caps & (api.CAP_META_CAPTURE | api.CAP_META_OUTPUT):
        return NodeKind.METADATA
    return NodeKind.OUTPUT if outputs else NodeKind.OTHER


def offered_formats(fd: int, node: Node) -> list[str]:
    """Fourccs of all pixel formats that the node offers. Raises OSError."""
    buffer_type = api.BUF_TYPE_CAPTURE_MPLANE if node.is_mplane else api.BUF_TYPE_CAPTURE
    formats: list[str] = []
    for index in range(_MOST_ENTRIES):
        listed = api.FormatDescription(index=index, type=buffer_type)
        if not api.is_offered(fd, api.ENUM_FMT, listed):
            break
        # The top bit, for big-endian, is no part of the letters: those are other formats.
        if listed.pixelformat == api.code_of(api.fourcc_of(listed.pixelformat)):
            formats.append(api.fourcc_of(listed.pixelformat))
    return formats


def read_modes(fd: int, formats: Iterable[str], asked_wh: Size | None = None) -> tuple[Mode, ...]:
    """Every size and rate of some formats that the device offers.

    ``asked_wh`` is listed too if a range of sizes holds it. Raises OSError.
    """
    return tuple(mode for fourcc in formats for mode in _modes_of(fd, fourcc, asked_wh))


def _modes_of(fd: int, fourcc: str, asked_wh: Size | None) -> Iterator[Mode]:
    code = api.code_of(fourcc)
    for index in range(_MOST_ENTRIES):
        listed = api.FrameSizeEnum(index=index, pixel_format=code)
        if not api.is_offered(fd, api.ENUM_FRAMESIZES, listed):
            break
        values = tuple(int(value) for value in listed.values)
        if listed.type == api.SIZE_DISCRETE:
            size_wh = values[0], values[1]
            yield Mode(fourcc, size_wh, _rates(fd, code, size_wh))
            continue
        for size_wh in sizes_in_range(values, asked_wh):
            yield Mode(fourcc, size_wh, _rates(fd, code, size_wh), is_ranged=True)
        break


def sizes_in_range(values: tuple[int, ...], asked_wh: Size | None) -> list[Size]:
    """The least, the largest and the common sizes, and the one asked for, brought onto the steps.

    ``values``: least, largest and step of the width, then of the height.
    """
    low_w, high_w, step_w, low_h, high_h, step_h = values
    wanted = [(low_w, low_h), *_COMMON_SIZES, (high_w, high_h)]
    inside = [(w, h) for w, h in wanted if low_w <= w <= high_w and low_h <= h <= high_h]
    if asked_wh is not None:
        inside.append((min(max(asked_wh[0], low_w), high_w), min(max(asked_wh[1], low_h), high_h)))
    on_steps = {
        (w - (w - low_w) % max(1, step_w), h - (h - low_h) % max(1, step_h)) for w, h in inside
    }
    return sorted(on_steps)


def _rates(fd: int, code: int, size_wh: Size) -> Rates:
    rates: list[float] = []
    for index in range(_MOST_ENTRIES):
        listed = api.FrameIntervalEnum(
            index=index, pixel_format=code, width=size_wh[0], height=size_wh[1]
        )
        if not api.is_offered(fd, api.ENUM_FRAMEINTERVALS, listed):
            break
        if listed.type != api.SIZE_DISCRETE:
            ends = [_rate(*listed.values[k : k + 2]) for k in (0, 2)]
            return Rates(tuple(sorted(filter(None, ends), reverse=True)), is_range=True)
        rates.append(_rate(*listed.values[:2]))
    return Rates(tuple(sorted({rate for rate in rates if rate > 0}, reverse=True)))


def _rate(numerator: int, denominator: int) -> float:
    """Of an interval in seconds; 0 if it is none."""
    return denominator / numerator if numerator else 0.0
