"""Addresses of cameras: ``/dev/video0``, ``v4l2:///dev/video0?size=640x480&fps=30&format=mjpeg``.

Options: ``size``, ``fps`` (may be a fraction as 30000/1001), ``format`` and ``control.NAME`` for
any control of the device. What a device does not have is granted as near as it can.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from pathlib import PurePosixPath
from urllib.parse import quote, unquote

from streamtrack.errors import UsageError, unknown_name
from streamtrack.sources.v4l2.choice import Wanted
from streamtrack.sources.v4l2.formats import FORMATS
from streamtrack.types import Size

PREFIX = "v4l2://"
OPTIONS = ("size", "fps", "format")
_CONTROL = "control."
_NAMES = {name: fourcc for fourcc, name in FORMATS.items()}
_OTHER_NAMES = dict(
    **dict.fromkeys(("mjpg",), "MJPG"),
    **dict.fromkeys(("yuy2", "yuyv422"), "YUYV"),
    **dict.fromkeys(("uyvy422",), "UYVY"),
    **dict.fromkeys(("i420", "yuv420", "yuv420p"), "YU12"),
    **dict.fromkeys(("gray", "y8"), "GREY"),
    **dict.fromkeys(("bgr", "bgr3"), "BGR3"),
    **dict.fromkeys(("rgb", "rgb3"), "RGB3"),
)


@dataclass(frozen=True, slots=True)
class Address:
    """A device and what is wanted of it; ``controls`` are names and values in order."""

    path: str
    wanted: Wanted
    controls: tuple[tuple[str, str], ...]


def parse_address(uri: str) -> Address:
    """Raises UsageError for an address that cannot be right."""
    place, _, query = uri.removeprefix(PREFIX).partition("?")
    path = unquote(place) if uri.startswith(PREFIX) else place
    if not path.startswith("/"):
        raise UsageError(
            f"'{uri}' names no device by its whole path: write {PREFIX}/dev/video0, with three /"
        )
    # A path with "." or "//" in it is the same device by another name.
    path = str(PurePosixPath("/", path.lstrip("/")))
    options: dict[str, str] = {}
    for item in filter(None, query.split("&")):
        key, _, value = item.partition("=")
        if key not in OPTIONS and not (key.startswith(_CONTROL) and key != _CONTROL):
            raise unknown_name(f"option of {PREFIX}", key, (*OPTIONS, f"{_CONTROL}NAME"))
        if key in options:
            raise UsageError(f"{key} is given twice in '{uri}': give it once")
        options[key] = unquote(value)
    wanted = Wanted(
        _size(options["size"]) if "size" in options else None,
        _rate(options["fps"]) if "fps" in options else None,
        _fourcc(options["format"]) if "format" in options else None,
    )
    controls = tuple(
        (key.removeprefix(_CONTROL), value) for key, value in options.items() if key not in OPTIONS
    )
    return Address(path, wanted, controls)


def uri_of(path: str, size_wh: Size, rate_hz: float | None, fourcc: str) -> str:
    """The address that asks for just this."""
    rate = "" if rate_hz is None else f"&fps={rate_hz:.6g}"
    size = f"{size_wh[0]}x{size_wh[1]}"
    return f"{PREFIX}{quote(path, safe='/:')}?size={size}{rate}&format={FORMATS[fourcc]}"


def _size(text: str) -> Size:
    width, _, height = text.partition("x")
    if not (width.isascii() and height.isascii() and width.isdigit() and height.isdigit()):
        raise UsageError(f"size={text} cannot be right: give WIDTHxHEIGHT, as 640x480")
    size = int(width), int(height)
    if not all(16 <= side <= 16384 for side in size):
        raise UsageError(f"size={text} cannot be right: give sides from 16 to 16384 pixels")
    return size


def _rate(text: str) -> float:
    try:
        rate = Fraction(text)
    except (ValueError, ZeroDivisionError):
        rate = Fraction(0)
    if not Fraction(1, 100) <= rate <= 1000:
        raise UsageError(f"fps={text} cannot be right: give 0.01 to 1000, as 30 or 30000/1001")
    return float(rate)


def _fourcc(text: str) -> str:
    name = text.lower()
    fourcc = _NAMES.get(name) or _OTHER_NAMES.get(name)
    if fourcc is None:
        raise unknown_name("format", text, FORMATS.values())
    return fourcc
