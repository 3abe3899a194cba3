"""Which of a device's modes to ask for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from streamtrack.sources.v4l2.formats import COMPRESSED, FORMATS, Mode
from streamtrack.types import Size

DEFAULT_RATE_HZ = 30.0
_LARGEST_WH = (1280, 720)
_ENOUGH_HZ = 24.0
_EXACT_ENOUGH = 0.98
_PREFERENCE = {fourcc: place for place, fourcc in enumerate(FORMATS)}
"""Colour before grey, and raw before JPEG, which costs decoding and shows its artefacts."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """What the user asked for; None where he left it open."""

    size_wh: Size | None = None
    rate_hz: float | None = None
    fourcc: str | None = None


def choose(modes: Sequence[Mode], wanted: Wanted) -> Mode | None:
    """The mode to ask for, or None if none can be read.

    A size that was asked for is kept as near as can be, at the best format that reaches the rate.
    Without one it is the largest up to 1280x720 that reaches the rate (24 Hz unless asked for
    another); JPEG is taken where no raw format does. Rates that a driver does not tell count as
    reached.
    """
    readable = [mode for mode in modes if mode.fourcc in FORMATS and _is_whole(mode)]
    if any(_is_format(mode, wanted.fourcc) for mode in readable):
        readable = [mode for mode in readable if _is_format(mode, wanted.fourcc)]
    if not readable:
        return None
    if wanted.size_wh is not None:
        width, height = wanted.size_wh
        return min(
            readable,
            key=lambda mode: (
                abs(mode.size_wh[0] - width) + abs(mode.size_wh[1] - height),
                -_reach(mode, wanted),
                _PREFERENCE[mode.fourcc],
            ),
        )
    fitting = [mode for mode in readable if _fits(mode)]
    if fitting:
        return min(fitting, key=lambda m: (-_reach(m, wanted), -_area(m), _PREFERENCE[m.fourcc]))
    return min(readable, key=lambda m: (_area(m), -_reach(m, wanted), _PREFERENCE[m.fourcc]))


def rate_to_ask(mode: Mode, wanted: Wanted) -> float | None:
    """The frame rate to ask for in that mode; None to leave it to a driver that tells none."""
    if wanted.rate_hz is not None:
        return wanted.rate_hz
    nearest = mode.rates.nearest(DEFAULT_RATE_HZ)
    if nearest is None or mode.rates.is_range or nearest <= DEFAULT_RATE_HZ:
        return nearest
    slower = [value for value in mode.rates.values if _ENOUGH_HZ <= value <= DEFAULT_RATE_HZ]
    return max(slower) if slower else nearest


def _is_format(mode: Mode, fourcc: str | None) -> bool:
    return mode.fourcc == fourcc or (mode.fourcc in COMPRESSED and fourcc in COMPRESSED)


def _is_whole(mode: Mode) -> bool:
    """True unless chroma is shared between pixels of which one is missing."""
    width, height = mode.size_wh
    if mode.fourcc in ("NV12", "YU12"):
        return width % 2 == 0 and height % 2 == 0
    return mode.fourcc not in ("YUYV", "UYVY") or width % 2 == 0


def _reach(mode: Mode, wanted: Wanted) -> float:
    """How much of the rate it reaches, 1 for enough."""
    enough = wanted.rate_hz * _EXACT_ENOUGH if wanted.rate_hz is not None else _ENOUGH_HZ
    if not mode.rates.values:
        return 1.0
    return min(1.0, mode.rates.values[0] / enough)


def _fits(mode: Mode) -> bool:
    return mode.size_wh[0] <= _LARGEST_WH[0] and mode.size_wh[1] <= _LARGEST_WH[1]


def _area(mode: Mode) -> int:
    return mode.size_wh[0] * mode.size_wh[1]
