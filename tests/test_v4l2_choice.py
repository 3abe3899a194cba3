"""Addresses of cameras, and the mode that is asked of one."""

from __future__ import annotations

import math
from fractions import Fraction

import pytest

from streamtrack.errors import UsageError
from streamtrack.sources.v4l2.camera import Granted, differences
from streamtrack.sources.v4l2.choice import Wanted, choose, rate_to_ask
from streamtrack.sources.v4l2.formats import Mode, Rates, sizes_in_range
from streamtrack.sources.v4l2.uri import parse_address, uri_of

HD = (1280, 720)
VGA = (640, 480)


@pytest.mark.parametrize(
    ("uri", "path", "wanted", "controls"),
    [
        ("/dev/video0", "/dev/video0", Wanted(), ()),
        ("v4l2:///dev/video3", "/dev/video3", Wanted(), ()),
        ("/dev/v4l/by-id/usb-A:B", "/dev/v4l/by-id/usb-A:B", Wanted(), ()),
        ("v4l2:///dev/a%20b?fps=25", "/dev/a b", Wanted(None, 25.0), ()),
        ("/dev/video0?format=yuy2", "/dev/video0", Wanted(fourcc="YUYV"), ()),
        (
            "v4l2:///dev/video0?size=640x480&fps=30000/1001&format=MJPEG"
            "&control.gain=7&control.auto_exposure=manual%20mode",
            "/dev/video0",
            Wanted(VGA, 30000 / 1001, "MJPG"),
            (("gain", "7"), ("auto_exposure", "manual mode")),
        ),
    ],
)
def test_addresses(
    uri: str, path: str, wanted: Wanted, controls: tuple[tuple[str, str], ...]
) -> None:
    address = parse_address(uri)
    assert (address.path, address.wanted, address.controls) == (path, wanted, controls)


@pytest.mark.parametrize(
    ("uri", "message"),
    [
        ("v4l2://dev/video0", "with three /"),
        ("v4l2://", "whole path"),
        ("v4l2:///dev/video0?resolution=640x480", "known are size, fps, format, control.NAME"),
        ("v4l2:///dev/video0?sise=640x480", "did you mean size?"),
        ("v4l2:///dev/video0?control.=1", "unknown option"),
        ("v4l2:///dev/video0?size=640", "WIDTHxHEIGHT"),
        ("v4l2:///dev/video0?size=0x480", "from 16"),
        ("v4l2:///dev/video0?size=-1x480", "WIDTHxHEIGHT"),
        ("v4l2:///dev/video0?fps=0", "fps=0 cannot be right"),
        ("v4l2:///dev/video0?fps=1/0", "fps=1/0 cannot be right"),
        ("v4l2:///dev/video0?fps=fast", "fps=fast cannot be right"),
        ("v4l2:///dev/video0?format=h264", "known are yuyv"),
        ("v4l2:///dev/video0?fps=1&fps=2", "given twice"),
    ],
)
def test_addresses_that_cannot_be_right(uri: str, message: str) -> None:
    with pytest.raises(UsageError, match=message) as caught:
        parse_address(uri)
    assert "\n" not in str(caught.value)


def test_a_made_address_asks_for_what_it_was_made_of() -> None:
    address = parse_address(uri_of("/dev/v4l/by-id/usb-a b?c", VGA, 30000 / 1001, "NV12"))
    assert address.path == "/dev/v4l/by-id/usb-a b?c"
    assert address.wanted.size_wh == VGA
    assert address.wanted.fourcc == "NV12"
    assert address.wanted.rate_hz == pytest.approx(30000 / 1001, abs=1e-3)


WEBCAM = tuple(
    Mode(fourcc, size_wh, Rates(rates))
    for fourcc, size_wh, rates in [
        ("YUYV", (1920, 1080), (5.0,)),
        ("YUYV", HD, (10.0, 5.0)),
        ("YUYV", VGA, (30.0, 15.0)),
        ("YUYV", (320, 240), (60.0, 30.0)),
        ("MJPG", (1920, 1080), (30.0,)),
        ("MJPG", HD, (60.0, 30.0)),
        ("MJPG", VGA, (120.0, 30.0)),
        ("H264", HD, (60.0,)),
    ]
)


@pytest.mark.parametrize(
    ("modes", "wanted", "fourcc", "size_wh"),
    [
        (WEBCAM, Wanted(), "MJPG", HD),
        (WEBCAM, Wanted(rate_hz=10.0), "YUYV", HD),
        (WEBCAM, Wanted(rate_hz=100.0), "MJPG", VGA),
        (WEBCAM, Wanted(VGA), "YUYV", VGA),
        (WEBCAM, Wanted(VGA, 60.0), "MJPG", VGA),
        (WEBCAM, Wanted(VGA, 30000 / 1001), "YUYV", VGA),
        (WEBCAM, Wanted((333, 222)), "YUYV", (320, 240)),
        (WEBCAM, Wanted((1920, 1080)), "MJPG", (1920, 1080)),
        (WEBCAM, Wanted(fourcc="YUYV"), "YUYV", VGA),
        (WEBCAM, Wanted(HD, fourcc="YUYV"), "YUYV", HD),
        (WEBCAM, Wanted(HD, fourcc="NV12"), "MJPG", HD),
        (WEBCAM[:1], Wanted(), "YUYV", (1920, 1080)),
        ((Mode("JPEG", VGA, Rates()),), Wanted(fourcc="MJPG"), "JPEG", VGA),
        ((Mode("NV12", (641, 480), Rates()), Mode("GREY", VGA, Rates())), Wanted(), "GREY", VGA),
        ((Mode("GREY", VGA, Rates()), Mode("MJPG", VGA, Rates())), Wanted(), "MJPG", VGA),
        ((Mode("YUYV", HD, Rates()), Mode("YUYV", VGA, Rates((30.0,)))), Wanted(), "YUYV", HD),
    ],
)
def test_chosen_mode(
    modes: tuple[Mode, ...], wanted: Wanted, fourcc: str, size_wh: tuple[int, int]
) -> None:
    mode = choose(modes, wanted)
    assert mode is not None
    assert (mode.fourcc, mode.size_wh) == (fourcc, size_wh)


def test_nothing_is_chosen_where_nothing_can_be_read() -> None:
    assert choose([Mode("H264", HD, Rates((30.0,)))], Wanted()) is None
    assert choose([], Wanted()) is None


@pytest.mark.parametrize(
    ("rates", "wanted", "asked"),
    [
        (Rates((60.0, 30.0, 15.0)), None, 30.0),
        (Rates((60.0, 50.0, 25.0)), None, 25.0),
        (Rates((60.0, 15.0)), None, 15.0),
        (Rates((120.0, 60.0)), None, 60.0),
        (Rates((90.0, 1.0), is_range=True), None, 30.0),
        (Rates((20.0, 1.0), is_range=True), None, 20.0),
        (Rates(), None, None),
        (Rates((60.0, 30.0)), 17.0, 17.0),
    ],
)
def test_rate_that_is_asked_for(rates: Rates, wanted: float | None, asked: float | None) -> None:
    assert rate_to_ask(Mode("YUYV", VGA, rates), Wanted(rate_hz=wanted)) == asked


def test_ranges_of_sizes_hold_the_common_ones_and_the_one_asked_for() -> None:
    values = (48, 1920, 16, 32, 1080, 8)
    sizes = sizes_in_range(values, (333, 222))
    assert {(48, 32), (640, 480), HD, (1920, 1080), (320, 216)} <= set(sizes)
    for width, height in sizes_in_range(values, (5000, 1)):
        assert 48 <= width <= 1920
        assert 32 <= height <= 1080
        assert (width - 48) % 16 == 0
        assert (height - 32) % 8 == 0


@pytest.mark.parametrize(
    ("wanted", "granted", "found"),
    [
        (Wanted(), Granted("MJPG", VGA, 30.0), []),
        (Wanted(VGA, 30.0, "MJPG"), Granted("JPEG", VGA, 30000 / 1001), []),
        (Wanted(), Granted("YUYV", VGA, 30.0), ["asked for mjpeg, granted is yuyv"]),
        (Wanted(fourcc="NV12"), Granted("MJPG", VGA, 9.0), ["asked for nv12, granted is mjpeg"]),
        (Wanted(HD), Granted("MJPG", VGA, 9.0), ["asked for 1280x720, granted is 640x480"]),
        (Wanted(None, 17.0), Granted("MJPG", VGA, 25.0), ["asked for 17 fps, granted is 25"]),
        (
            Wanted(None, 17.0),
            Granted("MJPG", VGA, None),
            ["asked for 17 fps, the device does not tell its rate"],
        ),
    ],
)
def test_what_is_granted_otherwise_is_named(
    wanted: Wanted, granted: Granted, found: list[str]
) -> None:
    assert differences(wanted, Mode("MJPG", VGA, Rates()), granted) == found


def test_odd_rates_keep_their_fraction() -> None:
    rate = parse_address("/dev/video0?fps=30000/1001").wanted.rate_hz
    assert rate is not None
    assert Fraction(rate).limit_denominator(1001) == Fraction(30000, 1001)
    assert math.isclose(rate, 29.97, rel_tol=1e-4)
