"""The V4L2 reader against emulated cameras with every fault.

The emulated cameras (v4l2_shim.c, v4l2_emulator.py) exist for child processes only; what these do
is in v4l2_child.py.
"""

from __future__ import annotations

import ctypes
import json
import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from v4l2_emulator import (
    DEFAULT_FRAMES,
    EmulatedCamera,
    Emulator,
    compiler,
    decode_number,
    default_picture,
    encode_number,
    encoded,
)

from streamtrack.errors import SourceError, UsageError
from streamtrack.sources.v4l2 import api
from streamtrack.sources.v4l2.camera import V4L2Capture
from streamtrack.sources.v4l2.stream import DriverClock, lost_between

CHILD = Path(__file__).with_name("v4l2_child.py")
TIMEOUT_S = 120
HD = (1280, 720)
VGA = (640, 480)


# --- stamps and numbers -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("before", "sequence", "lost"),
    [
        (None, 17, 0),
        (3, 4, 0),
        (3, 7, 3),
        (2**32 - 1, 0, 0),
        (2**32 - 2, 1, 2),
        (5, 5, 0),
        (900, 0, 0),
    ],
)
def test_lost_frames_are_counted_by_number(before: int | None, sequence: int, lost: int) -> None:
    assert lost_between(before, sequence) == lost


def test_monotonic_stamps_are_kept_even_if_old_or_a_little_ahead() -> None:
    clock = DriverClock(100.0)
    stamps = [100.1, 100.2, 105.0, 109.05]
    arrivals = [100.15, 104.0, 105.01, 109.0]
    assert [clock.time_s(s, True, n) for s, n in zip(stamps, arrivals, strict=True)] == stamps


def test_a_bad_stamp_is_replaced_and_good_ones_after_it_are_kept() -> None:
    clock = DriverClock(100.0)
    assert clock.time_s(100.1, True, 100.12) == 100.1
    assert clock.time_s(100.1, True, 100.15) == 100.15
    assert clock.time_s(100.17, True, 100.19) == 100.17
    assert clock.time_s(3.0, True, 100.25) == 100.25
    assert clock.time_s(9999.0, True, 100.30) == 100.30
    assert clock.time_s(100.33, True, 100.35) == 100.33


def test_another_clock_is_mapped_once() -> None:
    clock = DriverClock(100.0)
    times = [clock.time_s(1.7e9 + k / 30, False, 100.5 + k / 30 + k % 3 * 0.01) for k in range(9)]
    assert times[0] == 100.5
    assert np.allclose(np.diff(times), 1 / 30, atol=1e-6)


def test_times_rise_without_any_clock() -> None:
    clock = DriverClock(100.0)
    times = [clock.time_s(0.0, False, now) for now in (100.1, 100.1, 100.2, 100.3)]
    assert times[0] == 100.1
    assert all(b > a for a, b in pairwise(times))
    assert times[3] == 100.3


# --- the kernel's structures --------------------------------------------------------------------


@pytest.mark.skipif(ctypes.sizeof(ctypes.c_void_p) != 8, reason="sizes of 64-bit kernels")
def test_structures_have_the_sizes_of_the_kernel() -> None:
    sizes = {
        api.Capability: 104,
        api.FormatDescription: 64,
        api.FrameSizeEnum: 44,
        api.FrameIntervalEnum: 52,
        api.PixFormat: 48,
        api.PixFormatMplane: 192,
        api.Format: 208,
        api.StreamParm: 204,
        api.RequestBuffers: 20,
        api.Plane: 64,
        api.Buffer: 88,
        api.QueryControl: 68,
        api.QueryMenu: 44,
        api.Control: 8,
    }
    assert {kind: ctypes.sizeof(kind) for kind in sizes} == sizes
    # linux/videodev2.h as the compiler sees it
    assert (api.S_FMT, api.DQBUF, api.STREAMON) == (0xC0D05605, 0xC0585611, 0x40045612)


# --- whole, against emulated cameras ------------------------------------------------------------

Watch = Callable[..., dict[str, Any]]


@pytest.fixture(scope="module")
def emulator(tmp_path_factory: pytest.TempPathFactory) -> Emulator:
    if not sys.platform.startswith("linux"):
        pytest.skip("V4L2 is an interface of Linux")
    if compiler() is None:
        pytest.skip("no C compiler (cc) to build the emulated camera with")
    made = Emulator(tmp_path_factory.mktemp("cameras"))
    made.add(41, ["MJPG 320 240 30"], kind="meta")
    return made


@pytest.fixture(scope="module")
def shared_camera(emulator: Emulator) -> EmulatedCamera:
    return emulator.add(40, ["MJPG 320 240 30,15", "YUYV 320 240 30"])


@pytest.fixture
def camera(shared_camera: EmulatedCamera) -> EmulatedCamera:
    """/dev/video40, plugged in and without fault."""
    shared_camera.set_modes(["MJPG 320 240 30,15", "YUYV 320 240 30"])
    shared_camera.fault()
    shared_camera.plug()
    return shared_camera


@pytest.fixture(scope="module")
def watch(emulator: Emulator) -> Watch:
    """What a scenario of v4l2_child.py sees of a camera."""

    def watch(
        scenario: str, camera: EmulatedCamera, query: str = "", given: object = None
    ) -> dict[str, Any]:
        command = [sys.executable, CHILD, scenario, camera.path + query, str(camera.number)]
        done = subprocess.run(
            command,
            input=json.dumps(given),
            env=emulator.env(),
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
        )
        assert done.returncode == 0, done.stderr
        result = json.loads(done.stdout)
        assert isinstance(result, dict)
        return result

    return watch


@pytest.mark.parametrize("number", [0, 1, 37, 170, 255])
def test_frame_numbers_survive_jpeg(number: int) -> None:
    data = encoded(encode_number(default_picture(192, 96, 0), number), "MJPG")
    assert decode_number(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)) == number


def test_jpeg_stream(camera: EmulatedCamera, watch: Watch) -> None:
    result = watch("frames", camera, "?format=mjpeg")
    assert result["warnings"] == []
    assert (result["size"], result["rate"], result["is_live"]) == ([320, 240], 30.0, True)
    assert result["granted"] == "320x240 mjpeg at 30 fps"
    assert result["error"] < 4
    assert (result["packet_codec"], result["packets"]) == ("mjpeg", 1)
    assert result["is_packet_the_picture"]
    assert result["unaccounted"] == 0
    times = [frame["time_s"] for frame in result["frames"]]
    numbers = np.unwrap([frame["number"] for frame in result["frames"]], period=DEFAULT_FRAMES)
    # Stamps belong to their frames: the numbers run with them, 30 a second.
    rates = np.diff(numbers) / np.diff(times)
    assert np.median(rates) == pytest.approx(30, rel=0.1)
    for frame in result["frames"]:
        assert frame["captured_s"] == frame["time_s"]
        assert result["before_s"] - 1 < frame["captured_s"] < result["after_s"]


@pytest.mark.parametrize(
    "mode",
    [
        "YUYV 192 96 30 stride=448",
        "NV12 192 96 30 full",
        "GREY 192 96 30 stride=256",
    ],
)
def test_raw_streams(emulator: Emulator, watch: Watch, mode: str) -> None:
    camera = EmulatedCamera(emulator.root, 46)
    camera.set_modes([mode])
    camera.plug()
    result = watch("frames", camera)
    assert result["warnings"] == []
    assert result["packet_codec"] is None
    assert result["packets"] == 0
    assert result["error"] < (13 if mode.startswith("GREY") else 5)
    assert result["unaccounted"] == 0


def test_stall_ends_the_wait_and_frames_go_on(camera: EmulatedCamera, watch: Watch) -> None:
    result = watch("stall", camera)
    assert result["nothing"]
    assert 0.25 < result["waited_s"] < 1.5
    assert result["after"] == 3


@pytest.mark.parametrize("fault", ["drop=40", "drop=20 errflag=20"])
def test_lost_and_flagged_frames_are_counted_exactly(
    camera: EmulatedCamera, watch: Watch, fault: str
) -> None:
    camera.fault(fault)
    result = watch("losing", camera)
    assert len(result["frames"]) == 20
    assert result["lost"] > 0
    assert (result["damaged"] > 0) == ("errflag" in fault)
    assert result["unaccounted"] == 0
    assert None not in [frame["number"] for frame in result["frames"]]


def test_damaged_frames_are_rejected_counted_and_followed_by_good_ones(
    camera: EmulatedCamera, watch: Watch
) -> None:
    result = watch("all_bad", camera, "?format=mjpeg")
    for fault in ("errflag", "empty", "short=60", "damage"):
        assert result[fault]["nothing"], fault
        assert result[fault]["counted"] >= 3, fault
        assert result[fault]["good"]["damaged"] >= result[fault]["counted"], fault
        assert result[fault]["good"]["number"] is not None


def test_short_raw_frames_are_rejected(camera: EmulatedCamera, watch: Watch) -> None:
    result = watch("all_bad", camera, "?format=yuyv")
    assert result["short=60"]["nothing"]
    assert result["short=60"]["good"]["size"] == [320, 240]


def test_fatal_error_unplugging_and_return_with_another_format(
    camera: EmulatedCamera, watch: Watch
) -> None:
    result = watch("fatal", camera)
    assert "broke off" in result["eio"]["error"]
    assert result["again"]["error"] == result["eio"]["error"]
    assert result["reopened"] == 2
    assert "unplugged" in result["unplugged"]["error"]
    assert max(result[end]["after_s"] for end in ("eio", "again", "unplugged")) < 1.5
    assert result["missing"].startswith("SourceError: no such device /dev/video40: ")
    assert (result["back"], result["size"]) == ("320x240 yuyv at 15 fps", [[320, 240]])


def test_a_camera_that_broke_off_is_gone_at_once(camera: EmulatedCamera, watch: Watch) -> None:
    assert watch("broken_off", camera)["kept"] == 0


def test_busy_device_names_its_holder(camera: EmulatedCamera, watch: Watch) -> None:
    result = watch("busy", camera)
    assert f"in use by process {result['pid']} (" in result["error"]
    assert "in use by this program itself" in result["own_error"]
    assert result["after"] == ""


REFUSED = [
    ("eacces", "", "SourceError: no permission to open /dev/video40: sudo usermod -aG video"),
    ("busy", "", "SourceError: /dev/video40 is in use by another program"),
    ("enospc", "", "SourceError: /dev/video40: not enough bandwidth on its bus: ask for"),
    ("", "?control.gian=1", "UsageError: unknown control of /dev/video40 'gian': did you mean"),
    ("", "?control.gain=101", "UsageError: control.gain=101 cannot be right: give 0..100"),
    ("", "?control.gain=much", "UsageError: control.gain=much cannot be right"),
    ("", "?control.auto_exposure=0", "give 1 (Manual Mode), 3 (Aperture Priority Mode)"),
    ("", "?control.exposure=99", "which an automatic controls: switch that off too"),
]
ASKED_FPS = "asked for 30 fps, the device does not tell its rate"
GRANTED = [
    ("", "", [], "320x240 yuyv at 30 fps"),
    ("", "?format=mjpeg&fps=15", [], "320x240 mjpeg at 15 fps"),
    ("grant=0", "", ["asked for yuyv, granted is mjpeg"], "320x240 mjpeg at 30 fps"),
    ("grant=2", "", ["asked for 320x240, granted is 160x120"], "160x120 yuyv at 5 fps"),
    ("", "?fps=16", ["asked for 16 fps, granted is 30"], "320x240 yuyv at 30 fps"),
    ("", "?size=333x222", ["asked for 333x222, granted is 320x240"], "320x240 yuyv at 30 fps"),
    ("", "?format=nv12", ["asked for nv12, granted is yuyv"], "320x240 yuyv at 30 fps"),
    ("noparm", "?fps=30", [ASKED_FPS], "320x240 yuyv"),
    ("noparm", "", [], "320x240 yuyv"),
]


@pytest.fixture(scope="module")
def openings(shared_camera: EmulatedCamera, watch: Watch) -> list[dict[str, Any]]:
    """What became of all that, in one process."""
    shared_camera.set_modes(["MJPG 320 240 30,15", "YUYV 320 240 30", "YUYV 160 120 5"])
    shared_camera.plug()
    given = [(fault, query) for fault, query, *_ in [*REFUSED, *GRANTED]]
    results = watch("openings", shared_camera, given=given)["results"]
    assert isinstance(results, list)
    return results


@pytest.mark.parametrize(("number", "case"), [*enumerate(REFUSED)], ids=str)
def test_openings_that_fail_say_what_to_do(
    openings: list[dict[str, Any]], number: int, case: tuple[str, str, str]
) -> None:
    error = openings[number]["error"]
    assert case[2] in error
    assert "\n" not in error
    assert openings[number]["calls"][-1:] in ([], ["CLOSE"])


@pytest.mark.parametrize(("number", "case"), [*enumerate(GRANTED)], ids=str)
def test_what_is_not_granted_is_warned_of(
    openings: list[dict[str, Any]], number: int, case: tuple[str, str, list[str], str]
) -> None:
    result = openings[len(REFUSED) + number]
    assert result["warnings"] == [f"/dev/video40: {text}" for text in case[2]]
    assert result["granted"] == case[3]


def test_metadata_node_names_the_one_that_captures(camera: EmulatedCamera, watch: Watch) -> None:
    metadata = EmulatedCamera(camera.root, 41)
    assert watch("openings", metadata, given=[("", "")])["results"][0]["error"] == (
        "UsageError: /dev/video41 (Emulated Camera 40) carries metadata, no pictures: "
        "use /dev/video40, of the same device"
    )


def test_controls_are_set_switches_first(camera: EmulatedCamera, watch: Watch) -> None:
    query = "?control.exposure_absolute=200&control.focus=13&control.gain=7"
    query += "&control.exposure_auto=manual%20mode&control.focus_auto=off"
    [result] = watch("openings", camera, given=[("", query)])["results"]
    calls = [line for line in result["calls"] if not line.startswith("S_FMT")]
    assert calls[:6] == [
        "OPEN",
        "S_CTRL 009a0901 1",
        "S_CTRL 009a090c 0",
        "S_CTRL 009a0902 200",
        "S_CTRL 009a090a 10",
        "S_CTRL 00980913 7",
    ]
    assert result["warnings"] == ["/dev/video40: asked for focus_absolute 13, the device set 10"]


@pytest.mark.parametrize("fault", ["nostamp stuckseq", "ahead=40"])
def test_drivers_without_proper_stamps_or_numbers(
    camera: EmulatedCamera, watch: Watch, fault: str
) -> None:
    camera.fault(fault)
    result = watch("frames", camera)
    times = [frame["time_s"] for frame in result["frames"]]
    assert len(times) == 12
    assert all(0 < b - a < 1 for a, b in pairwise(times))
    assert result["before_s"] - 1 < times[0] < result["after_s"] + 0.05
    assert all(frame["captured_s"] <= result["after_s"] for frame in result["frames"])
    assert result["lost"] == 0 or "stuckseq" not in fault


def test_slow_reader_gets_new_frames_and_the_others_are_counted(
    camera: EmulatedCamera, watch: Watch
) -> None:
    result = watch("slow_reader", camera)
    assert result["unaccounted"] == 0
    assert result["dropped"] >= 12
    assert result["lost"] >= 12
    # Four buffers hold the first 130 ms of the 350 ms during which nobody read.
    assert np.median(result["ages_s"]) < 0.18


def test_closing_ends_even_if_the_driver_hangs(camera: EmulatedCamera, watch: Watch) -> None:
    result = watch("hanging_close", camera)
    assert result["took_s"] < 2.5
    assert "does not stop" in result["warnings"][0]
    assert "is closed" in result["read"]


@pytest.mark.slow
def test_a_thousand_failed_openings_leave_nothing_behind(
    camera: EmulatedCamera, watch: Watch
) -> None:
    result = watch("failed_openings", camera)
    before, after = result["before"], result["after"]
    assert len(result["kinds"]) == 8
    assert after["fds"] == before["fds"]
    assert after["threads"] == before["threads"]
    assert after["tasks"] == before["tasks"]
    assert after["maps"] - before["maps"] <= 8
    assert after["rss_mb"] - before["rss_mb"] < 3


# --- without any camera -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("uri", "kind", "message"),
    [
        ("/dev/video9999", SourceError, "no such device /dev/video9999: "),
        ("v4l2:///dev/null/video0", SourceError, "no such device"),
        ("v4l2:///dev/null", UsageError, "/dev/null is a device, but no camera"),
        (f"v4l2://{CHILD}", UsageError, "is a file, not a camera: give it without v4l2://"),
        (f"v4l2://{CHILD.parent}", UsageError, "is a folder, not a camera"),
    ],
)
def test_what_is_no_camera(uri: str, kind: type[Exception], message: str) -> None:
    with pytest.raises(kind, match=message) as caught:
        V4L2Capture(uri)
    assert "\n" not in str(caught.value)
