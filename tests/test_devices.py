"""`streamtrack devices`: what is listed of emulated cameras, and that there may be none."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from v4l2_emulator import Emulator, compiler

from streamtrack.devices import Device, sizes_and_rates, to_json
from streamtrack.sources.v4l2.formats import Mode, Rates
from streamtrack.sources.v4l2.uri import parse_address

BY_ID = "/dev/v4l/by-id/usb-Emulated_Camera_40-video-index0"


@pytest.fixture(scope="module")
def emulator(tmp_path_factory: pytest.TempPathFactory) -> Emulator:
    if not sys.platform.startswith("linux"):
        pytest.skip("V4L2 is an interface of Linux")
    if compiler() is None:
        pytest.skip("no C compiler (cc) to build the emulated camera with")
    return Emulator(tmp_path_factory.mktemp("cameras"))


def listed(emulator: Emulator, *arguments: str) -> str:
    """What the command prints; it must succeed and complain of nothing."""
    done = subprocess.run(
        [sys.executable, "-m", "streamtrack.cli", "devices", *arguments],
        env=emulator.env(),
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


def test_no_camera(emulator: Emulator, tmp_path: Path) -> None:
    assert listed(emulator) == (
        "no cameras found: plug one in; it appears as /dev/video0 "
        "(in a container, pass it in: --device /dev/video0)\n"
    )
    assert json.loads(listed(emulator, "--json")) == {"devices": []}


@pytest.fixture(scope="module")
def cameras(emulator: Emulator) -> Emulator:
    """A webcam with its metadata node, an output, a converter, one forbidden, one unreadable."""
    small = [np.zeros((96, 192, 3), np.uint8)]
    modes = ["MJPG 1280 720 30", "YUYV 1280 720 10", "YUYV 640 480 30,15", "H264 640 480 30"]
    emulator.add(40, modes, small)
    emulator.add(41, ["MJPG 320 240 30"], small, kind="meta")
    emulator.add(42, ["YUYV 320 240 30"], small, kind="output")
    emulator.add(44, ["YUYV 320 240 30"], small, kind="m2m")
    emulator.add(46, ["YUYV 320 240 30"], small).fault("eacces")
    emulator.add(148, ["H264 640 480 30"], small)
    return emulator


def test_listing(cameras: Emulator) -> None:
    lines = listed(cameras, "--controls").splitlines()
    assert lines[:3] == [
        "/dev/video40  Emulated Camera 40 (v4l2_shim, usb-shim-40)",
        f"  always {BY_ID}",
        f"  use    'v4l2://{BY_ID}?size=1280x720&fps=30&format=mjpeg'",
    ]
    rows = [line.split() for line in lines]
    for row in (
        ["yuyv", "1280x720", "10"],
        ["yuyv", "640x480", "30,", "15"],
        ["mjpeg", "1280x720", "30"],
        ["control.exposure_time_absolute", "3..2047", "default", "250"],
        ["control.auto_exposure", "1", "(Manual", "Mode),"],
    ):
        assert row in [found[: len(row)] for found in rows]
    text = "\n".join(lines)
    assert "also H264, which are not read" in text
    assert "problem: no permission to open /dev/video46: sudo usermod -aG video" in text
    assert "problem: it offers no format that can be read" in text
    for absent in ("video41", "video42", "video44"):
        assert absent not in text


def test_json(cameras: Emulator) -> None:
    devices = json.loads(listed(cameras, "--json"))["devices"]
    assert [device["path"] for device in devices] == [f"/dev/video{n}" for n in (40, 46, 148)]
    first = devices[0]
    assert first["stable_path"] == BY_ID
    assert first["problem"] is None
    address = parse_address(first["uri"])
    assert (address.path, address.wanted.size_wh) == (BY_ID, (1280, 720))
    assert {
        "format": "yuyv",
        "fourcc": "YUYV",
        "width": 640,
        "height": 480,
        "fps": [30.0, 15.0],
        "fps_is_range": False,
        "size_is_of_range": False,
    } in first["modes"]
    assert first["unreadable_formats"] == ["H264"]
    exposure = {control["name"]: control for control in first["controls"]}["auto_exposure"]
    assert exposure["items"] == {"1": "Manual Mode", "3": "Aperture Priority Mode"}
    assert "no permission" in devices[1]["problem"]


def test_ranges_of_sizes_are_one_row() -> None:
    rates = Rates((60.0, 1.0), is_range=True)
    modes = tuple(
        Mode("GREY", size_wh, rates, is_ranged=True)
        for size_wh in ((48, 32), (640, 480), (1920, 1080))
    )
    device = Device("/dev/video0", None, "Sensor", modes=modes)
    assert sizes_and_rates(device) == [("grey", "48x32 to 1920x1080", "60-1")]
    assert to_json([device])["devices"][0]["modes"][0]["fps_is_range"]
