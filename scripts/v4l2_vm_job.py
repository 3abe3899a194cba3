"""Reads real V4L2 devices (vivid, v4l2loopback) and reports; started in the VM by scripts/v4l2_vm.

Each check is a function that returns its figures in words and fails by AssertionError.
"""

from __future__ import annotations

import logging
import os
import platform
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
FEEDER = ROOT / "scripts" / "v4l2_vm_feed.py"
sys.path.insert(0, str(ROOT / "tests"))

from v4l2_emulator import DEFAULT_FRAMES, decode_number  # noqa: E402

from streamtrack.devices import find_devices  # noqa: E402
from streamtrack.errors import StreamtrackError  # noqa: E402
from streamtrack.sources.capture import Captured, CaptureEndedError  # noqa: E402
from streamtrack.sources.v4l2 import api  # noqa: E402
from streamtrack.sources.v4l2.camera import V4L2Capture  # noqa: E402
from streamtrack.sources.v4l2.controls import plain_name  # noqa: E402
from streamtrack.sources.v4l2.formats import opened  # noqa: E402

VIVID = "/dev/video0"
MPLANE = "/dev/video10"
LOOPBACK = "/dev/video20"
CHECKS: list[Callable[[], str]] = []
WARNINGS: list[str] = []


class _Collected(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        WARNINGS.append(record.getMessage())


def check(function: Callable[[], str]) -> Callable[[], str]:
    CHECKS.append(function)
    return function


def press(path: str, name: str, value: int = 1) -> None:
    """Set a control of any kind; buttons are pressed so."""
    with opened(path) as fd:
        asked = api.QueryControl(id=api.CTRL_FLAG_NEXT)
        while api.is_offered(fd, api.QUERYCTRL, asked):
            if plain_name(api.text_of(asked.name)) == name:
                api.ioctl(fd, api.S_CTRL, api.Control(id=asked.id, value=value))
                return
            asked = api.QueryControl(id=asked.id | api.CTRL_FLAG_NEXT)
    raise AssertionError(f"{path} has no control {name}")


def read(capture: V4L2Capture, count: int, timeout_s: float = 5.0) -> list[Captured]:
    frames = [capture.read(timeout_s) for _ in range(count)]
    assert None not in frames, "no frame in time"
    return [frame for frame in frames if frame is not None]


def rate_of(frames: list[Captured]) -> float:
    return (len(frames) - 1) / (frames[-1].time_s - frames[0].time_s)


def end_of(capture: V4L2Capture) -> tuple[str, float]:
    """The error that ends it, and how long after."""
    start_s = time.monotonic()
    try:
        while time.monotonic() < start_s + 10:
            capture.read(1.0)
    except CaptureEndedError as error:
        return str(error), time.monotonic() - start_s
    raise AssertionError("did not end")


def error_of(uri: str) -> str:
    try:
        with V4L2Capture(uri):
            raise AssertionError(f"{uri} opened")
    except StreamtrackError as error:
        return str(error)


@check
def devices_are_listed() -> str:
    start_s = time.monotonic()
    devices = find_devices()
    took_s = time.monotonic() - start_s
    paths = [device.path for device in devices]
    nodes = sorted(Path("/dev").glob("video*"))
    # The loopbacks take what is fed to them, and offer something only then.
    assert VIVID in paths
    assert MPLANE in paths
    assert len(paths) < len(nodes)
    modes = sum(len(device.modes) for device in devices)
    return f"{len(paths)} cameras of {len(nodes)} nodes, {modes} modes, {took_s * 1e3:.0f} ms"


@check
def other_nodes_are_refused() -> str:
    refused = []
    captures = {device.path for device in find_devices()}
    for node in sorted(map(str, Path("/dev").glob("video*"))):
        if node not in captures:
            error = error_of(node)
            assert "use /dev/video" in error or "no pictures" in error or "takes none" in error
            refused.append(error)
    assert refused
    return refused[0]


def _formats(path: str, names: tuple[str, ...]) -> str:
    """All formats show the same colour bars; RGB needs no conversion and is the reference."""
    pictures = {}
    for name in names:
        with V4L2Capture(f"{path}?size=640x360&fps=30&format={name}") as capture:
            assert capture.granted.size_wh == (640, 360)
            pictures[name] = read(capture, 3)[-1].image
    reference = pictures["rgb24"].astype(int)
    worst = 0.0
    for name, picture in pictures.items():
        expected = reference
        if picture.ndim == 2:
            expected = cv2.cvtColor(pictures["rgb24"], cv2.COLOR_BGR2GRAY).astype(int)
        # The text moves; the bars do not.
        difference = np.abs(picture.astype(int) - expected)
        median = float(np.percentile(difference, 90))
        limit = 25 if name == "grey" else 6
        assert median <= limit, f"{name} differs by {median}"
        if name != "grey":
            worst = max(worst, median)
    return f"{', '.join(names)}: 90 % of the pixels within {worst:.0f} of rgb24"


@check
def pixel_formats_of_vivid() -> str:
    return _formats(VIVID, ("rgb24", "bgr24", "yuyv", "uyvy", "nv12", "yu12", "grey"))


@check
def pixel_formats_of_the_multi_planar_interface() -> str:
    return _formats(MPLANE, ("rgb24", "bgr24", "yuyv", "uyvy", "nv12", "yu12", "grey"))


@check
def rates_and_stamps() -> str:
    figures = []
    for path in (VIVID, MPLANE):
        with V4L2Capture(f"{path}?size=640x360&fps=15") as capture:
            frames = read(capture, 30)
            measured = rate_of(frames)
            counted = capture.lost + capture.dropped
            measured *= (29 + counted) / 29
            assert abs(measured - 15) < 0.5, measured
            ages_ms = [1e3 * (time.monotonic() - frames[-1].captured_s)]
            assert all(frame.captured_s <= time.monotonic() for frame in frames)
            figures.append(
                f"{measured:.2f} fps, {counted} lost or dropped, {ages_ms[0]:.0f} ms old"
            )
    return "asked for 15: " + "; ".join(figures)


@check
def other_rate_and_size_granted() -> str:
    WARNINGS.clear()
    with V4L2Capture(f"{VIVID}?size=333x222&fps=17&format=yuyv") as capture:
        granted = capture.granted
        assert read(capture, 1)[0].image.shape[1::-1] == granted.size_wh
    assert len(WARNINGS) == 2, WARNINGS
    return "; ".join(WARNINGS)


@check
def frames_lost_by_the_driver() -> str:
    with V4L2Capture(f"{VIVID}?size=320x180&fps=15") as capture:
        press(VIVID, "percentage_of_dropped_buffers", 50)
        frames = read(capture, 25)
        press(VIVID, "percentage_of_dropped_buffers", 0)
        lost = capture.lost
        expected = round((frames[-1].time_s - frames[0].time_s) * 15) - 24 - capture.dropped
        assert lost > 5
        assert abs(lost - expected) <= 2, (lost, expected)
    return f"{lost} counted, {expected} by the stamps, of {len(frames) + lost}"


@check
def error_flags() -> str:
    with V4L2Capture(f"{VIVID}?size=320x180&fps=15") as capture:
        read(capture, 2)
        for _ in range(5):
            press(VIVID, "inject_v4l2_buf_flag_error")
            read(capture, 3)
        assert capture.damaged == 5, capture.damaged
    return "5 injected, 5 counted, none passed on"


@check
def fatal_streaming_error() -> str:
    with V4L2Capture(f"{VIVID}?size=320x180&fps=15") as capture:
        read(capture, 2)
        press(VIVID, "inject_fatal_streaming_error")
        error, after_s = end_of(capture)
    start_s = time.monotonic()
    with V4L2Capture(f"{VIVID}?size=320x180&fps=15") as capture:
        read(capture, 1)
        again_s = time.monotonic() - start_s
    return f"{error}: noticed after {after_s:.2f} s, a picture {again_s:.2f} s after opening again"


@check
def disconnected() -> str:
    with V4L2Capture(f"{VIVID}?size=320x180&fps=15") as capture:
        read(capture, 2)
        press(VIVID, "disconnect")
        error, after_s = end_of(capture)
    assert "unplugged" in error
    start_s = time.monotonic()
    with V4L2Capture(f"{VIVID}?size=320x180&fps=15") as capture:
        read(capture, 1)
        again_s = time.monotonic() - start_s
    return f"{error}: noticed after {after_s:.2f} s, a picture {again_s:.2f} s after opening again"


@check
def numbers_and_stamps_that_wrap() -> str:
    press(VIVID, "wrap_sequence_number", 1)
    press(VIVID, "wrap_timestamp", 1)
    try:
        with V4L2Capture(f"{VIVID}?size=320x180&fps=15") as capture:
            start_s = time.monotonic()
            frames = read(capture, 300)
            took_s = time.monotonic() - start_s
            times = [frame.time_s for frame in frames]
            assert np.all(np.diff(times) > 0)
            spanned_s = times[-1] - times[0]
            assert abs(spanned_s - took_s) < 1.0, (spanned_s, took_s)
            counted = 299 + capture.lost + capture.dropped
            assert abs(counted - 15 * spanned_s) <= 8, (counted, 15 * spanned_s)
    finally:
        press(VIVID, "wrap_sequence_number", 0)
        press(VIVID, "wrap_timestamp", 0)
    return (
        f"300 frames, {capture.lost} lost, {capture.dropped} dropped, 15 fps would make "
        f"{15 * spanned_s + 1:.0f}; times rise by {spanned_s:.1f} s in {took_s:.1f} s"
    )


@check
def controls() -> str:
    WARNINGS.clear()
    with V4L2Capture(
        f"{VIVID}?size=320x180&control.brightness=30&control.test_pattern=9"
    ) as capture:
        read(capture, 2)
    assert not WARNINGS, WARNINGS
    error = error_of(f"{VIVID}?control.brightness=3000")
    press(VIVID, "test_pattern", 0)
    press(VIVID, "brightness", 128)
    return error


@check
def busy() -> str:
    with V4L2Capture(f"{VIVID}?size=320x180") as capture:
        read(capture, 1)
        own = error_of(VIVID)
    assert "this program itself" in own
    code = (
        f"import sys; sys.path.insert(0, {str(ROOT)!r})\n"
        "from streamtrack.sources.v4l2.camera import V4L2Capture\n"
        f"with V4L2Capture('{VIVID}'): print('ready', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        assert other.stdout is not None
        other.stdout.readline()
        error = error_of(VIVID)
        other.communicate(b"")
    assert f"process {other.pid}" in error
    return error


@contextmanager
def fed(fourcc: str, size: str, damaged_every: int = 0) -> Iterator[subprocess.Popen[bytes]]:
    """A process that feeds the loopback."""
    command = [sys.executable, str(FEEDER), LOOPBACK, fourcc, size, str(damaged_every)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as feeder:
        assert feeder.stdout is not None
        feeder.stdout.readline()
        try:
            yield feeder
        finally:
            feeder.send_signal(signal.SIGCONT)
            feeder.kill()


@check
def loopback_jpeg() -> str:
    with fed("MJPG", "640x480"), V4L2Capture(LOOPBACK) as capture:
        frames = read(capture, 30)
        assert capture.info.packet_codec == "mjpeg"
        numbers = [decode_number(frame.image) for frame in frames]
        assert None not in numbers, numbers
        steps = np.diff(np.asarray(numbers, int)) % DEFAULT_FRAMES
        missing = int(np.sum(steps - 1))
        assert capture.damaged == 0
        return (
            f"{capture.granted}; 30 pictures, {missing} not seen, {capture.lost} lost and "
            f"{capture.dropped} dropped counted, {rate_of(frames):.1f} fps"
        )


@check
def loopback_damaged_jpeg() -> str:
    with fed("MJPG", "640x480", damaged_every=4), V4L2Capture(LOOPBACK) as capture:
        frames = read(capture, 30)
        numbers = [decode_number(frame.image) for frame in frames]
        assert not [n for n in numbers if n is None or n % 4 == 3], numbers
        assert capture.damaged >= 8
        return f"every 4th lacks bytes: {len(frames)} good ones given, {capture.damaged} rejected"


@check
def loopback_that_stops_and_goes_on() -> str:
    with fed("YUYV", "320x240") as feeder, V4L2Capture(LOOPBACK) as capture:
        read(capture, 3)
        feeder.send_signal(signal.SIGSTOP)
        time.sleep(0.3)
        while capture.read(0.0) is not None:
            pass
        start_s = time.monotonic()
        assert capture.read(1.0) is None
        waited_s = time.monotonic() - start_s
        assert waited_s < 2, waited_s
        feeder.send_signal(signal.SIGCONT)
        read(capture, 3)
        return f"waiting 1 s ended after {waited_s:.2f} s; pictures go on after SIGCONT"


@check
def loopback_that_returns_with_another_size() -> str:
    granted = []
    for fourcc, size in (("YUYV", "320x240"), ("MJPG", "640x480")):
        with fed(fourcc, size), V4L2Capture(LOOPBACK) as capture:
            read(capture, 2)
            granted.append(str(capture.granted))
    return "; then ".join(granted)


@check
def opened_and_closed_fifty_times() -> str:
    def resources() -> tuple[int, int, float]:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return (
            len(list(Path("/proc/self/fd").iterdir())),
            threading.active_count(),
            pages * 4096 / 1e6,
        )

    def cycle() -> None:
        with V4L2Capture(f"{VIVID}?size=320x180") as capture:
            read(capture, 1)

    for _ in range(10):
        cycle()
    before = resources()
    start_s = time.monotonic()
    for _ in range(50):
        cycle()
    after = resources()
    took_s = time.monotonic() - start_s
    assert after[:2] == before[:2], (before, after)
    assert after[2] - before[2] < 3, (before, after)
    return (
        f"{took_s * 20:.0f} ms each with the first picture; descriptors {before[0]} -> {after[0]}, "
        f"threads {before[1]} -> {after[1]}, {before[2]:.1f} -> {after[2]:.1f} MB"
    )


def main(report: Path) -> None:
    logging.getLogger("streamtrack.sources").addHandler(_Collected(logging.WARNING))
    lines = [
        "# The V4L2 reader on real kernel devices",
        "",
        "Written by `scripts/v4l2_vm`: vivid (one device of the single-planar, one of the",
        "multi-planar interface) and v4l2loopback in QEMU, emulated without hardware help, so",
        "times are several times longer than on a real machine.",
        "",
        f"Linux {platform.release()}, Python {platform.python_version()}, {os.cpu_count()} CPUs.",
        "",
        "| check | result | seen |",
        "|---|---|---|",
    ]
    failures = 0
    for function in CHECKS:
        name = function.__name__.replace("_", " ")
        try:
            result, seen = "ok", function()
        except Exception as error:  # noqa: BLE001 a failed check must not hide the others
            result, seen = "**failed**", f"{type(error).__name__}: {error}"
            failures += 1
        lines.append(f"| {name} | {result} | {seen.replace('|', '/')} |")
        print(lines[-1], flush=True)
    lines += ["", "All passed." if not failures else f"{failures} failed."]
    report.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
