"""What tests/test_v4l2.py runs where emulated cameras can be seen: ``v4l2_child.py SCENARIO URI``.

Prints one JSON object: what the scenario saw, with the warnings that were logged.
"""

from __future__ import annotations

import gc
import json
import logging
import os
import resource
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from v4l2_emulator import DEFAULT_FRAMES, EmulatedCamera, decode_number, default_picture

from streamtrack.errors import StreamtrackError
from streamtrack.sources.capture import Captured, CaptureEndedError
from streamtrack.sources.v4l2.camera import V4L2Capture

SCENARIOS: dict[str, Callable[[str, EmulatedCamera], dict[str, Any]]] = {}


def scenario(
    function: Callable[[str, EmulatedCamera], dict[str, Any]],
) -> Callable[[str, EmulatedCamera], dict[str, Any]]:
    SCENARIOS[function.__name__] = function
    return function


def seen(captured: Captured) -> dict[str, Any]:
    return {
        "number": decode_number(captured.image),
        "size": list(captured.image.shape[1::-1]),
        "time_s": captured.time_s,
        "captured_s": captured.captured_s,
        "lost": captured.lost,
        "damaged": captured.damaged,
        "dropped": captured.dropped,
    }


def read(capture: V4L2Capture, count: int, timeout_s: float = 3.0) -> list[dict[str, Any]]:
    frames = []
    for _ in range(count):
        captured = capture.read(timeout_s)
        if captured is None:
            break
        frames.append(seen(captured))
    return frames


def unaccounted(frames: list[dict[str, Any]]) -> int:
    """Frames that are missing between the numbers seen and that nothing counts."""
    gaps = sum((b["number"] - a["number"] - 1) % DEFAULT_FRAMES for a, b in pairwise(frames))
    return gaps - sum(
        frame[kind] for frame in frames[1:] for kind in ("lost", "damaged", "dropped")
    )


def totals(capture: V4L2Capture) -> dict[str, int]:
    return {"lost": capture.lost, "damaged": capture.damaged, "dropped": capture.dropped}


def error_of(uri: str) -> str:
    try:
        with V4L2Capture(uri):
            return ""
    except StreamtrackError as error:
        return f"{type(error).__name__}: {error}"


@scenario
def frames(uri: str, camera: EmulatedCamera) -> dict[str, Any]:
    """Twelve frames with all there is to know of them."""
    with V4L2Capture(uri) as capture:
        before_s = time.monotonic()
        first = capture.read(3.0)
        assert first is not None
        frames = [seen(first), *read(capture, 11)]
        is_close = True
        for packet in first.packets:
            decoded = cv2.imdecode(np.frombuffer(packet.data, np.uint8), cv2.IMREAD_COLOR)
            is_close = bool(np.abs(decoded.astype(int) - first.image).mean() < 3)
            assert packet.time_s == first.time_s
            assert packet.is_keyframe
        height, width = first.image.shape[:2]
        expected = default_picture(width, height, frames[0]["number"] or 0)
        if first.image.ndim == 2:
            expected = cv2.cvtColor(expected, cv2.COLOR_BGR2GRAY)
        error = np.abs(expected.astype(int) - first.image)[20:].mean()
        info = capture.info
        return {
            "frames": frames,
            "before_s": before_s,
            "after_s": time.monotonic(),
            "error": error,
            "packets": len(first.packets),
            "packet_codec": info.packet_codec,
            "is_packet_the_picture": is_close,
            "size": list(info.size_wh),
            "rate": info.rate_hz,
            "is_live": info.is_live,
            "granted": str(capture.granted),
            "unaccounted": unaccounted(frames),
            **totals(capture),
        }


@scenario
def stall(uri: str, camera: EmulatedCamera) -> dict[str, Any]:
    """The device stops sending for a while; waiting ends, and frames go on without reopening."""
    with V4L2Capture(uri) as capture:
        read(capture, 2)
        camera.fault("stall")
        time.sleep(0.1)
        capture.read(0.0)
        start_s = time.monotonic()
        nothing = capture.read(0.3)
        waited_s = time.monotonic() - start_s
        camera.fault()
        return {"nothing": nothing is None, "waited_s": waited_s, "after": len(read(capture, 3))}


@scenario
def losing(uri: str, camera: EmulatedCamera) -> dict[str, Any]:
    """Frames get lost or damaged all the time, as the fault file says from the start."""
    with V4L2Capture(uri) as capture:
        frames = read(capture, 20)
        return {
            "frames": frames,
            "unaccounted": unaccounted(frames),
            **totals(capture),
        }


@scenario
def all_bad(uri: str, camera: EmulatedCamera) -> dict[str, Any]:
    """No frame is whole, for each way of not being whole; then all is well again."""
    results: dict[str, Any] = {}
    for fault in ("errflag", "empty", "short=60", "damage"):
        with V4L2Capture(uri) as capture:
            camera.fault(fault)
            time.sleep(0.1)
            while capture.read(0.0) is not None:
                pass  # of the time before
            damaged = capture.damaged
            nothing = capture.read(0.25)
            counted = capture.damaged - damaged
            camera.fault()
            good = capture.read(3.0)
            results[fault] = {
                "nothing": nothing is None,
                "counted": counted,
                "good": None if good is None else seen(good),
            }
    return results


@scenario
def fatal(uri: str, camera: EmulatedCamera) -> dict[str, Any]:
    """EIO, unplugging while streaming, and return with another size."""
    results: dict[str, Any] = {}
    with V4L2Capture(uri) as capture:
        read(capture, 2)
        camera.fault("eio")
        results["eio"] = _end_of(capture)
        results["again"] = _end_of(capture)
        camera.fault()
    with V4L2Capture(uri) as capture:
        results["reopened"] = len(read(capture, 2))
        camera.unplug()
        results["unplugged"] = _end_of(capture)
    results["missing"] = error_of(uri)
    camera.set_modes(["YUYV 320 240 15"])
    camera.plug()
    with V4L2Capture(uri) as capture:
        results["back"] = str(capture.granted)
        results["size"] = [frame["size"] for frame in read(capture, 1)]
    return results


@scenario
def broken_off(uri: str, camera: EmulatedCamera) -> dict[str, Any]:
    """How many captures are still there after ten that broke off, without garbage collection."""
    gc.collect()
    gc.disable()
    for _ in range(10):
        camera.fault()
        with V4L2Capture(uri) as capture:
            read(capture, 1)
            camera.fault("eio")
            _end_of(capture)
    del capture
    return {"kept": sum(isinstance(item, V4L2Capture) for item in gc.get_objects())}


def _end_of(capture: V4L2Capture) -> dict[str, Any]:
    start_s = time.monotonic()
    try:
        for _ in range(20):
            capture.read(1.0)
    except CaptureEndedError as error:
        return {"error": str(error), "after_s": time.monotonic() - start_s}
    return {}


@scenario
def openings(uri: str, camera: EmulatedCamera) -> dict[str, Any]:
    """Opened with each fault and query that come on stdin: what is granted, or the error."""
    results = []
    for fault, query in json.load(sys.stdin):
        camera.fault(fault)
        calls = len(camera.log())
        WARNINGS.lines.clear()
        result: dict[str, Any] = {}
        try:
            with V4L2Capture(uri + query) as capture:
                result = {"granted": str(capture.granted), "rate": capture.info.rate_hz}
        except StreamtrackError as error:
            result = {"error": f"{type(error).__name__}: {error}"}
        result |= {"calls": camera.log()[calls:], "warnings": [*WARNINGS.lines]}
        results.append(result)
    WARNINGS.lines.clear()
    return {"results": results}


@scenario
def busy(uri: str, camera: EmulatedCamera) -> dict[str, Any]:
    """Another program streams from the same camera."""
    code = (
        "import sys; from streamtrack.sources.v4l2.camera import V4L2Capture\n"
        "with V4L2Capture(sys.argv[1]): print('ready', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, uri],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as other:
        assert other.stdout is not None
        other.stdout.readline()
        error = error_of(uri)
        other.communicate(b"")
    with V4L2Capture(uri):
        own_error = error_of(uri)
    return {"pid": other.pid, "error": error, "own_error": own_error, "after": error_of(uri)}


@scenario
def slow_reader(uri: str, camera: EmulatedCamera) -> dict[str, Any]:
    """Nobody reads for a third of a second each time: the picture given is a new one."""
    with V4L2Capture(uri) as capture:
        frames, ages_s = read(capture, 1), []
        for _ in range(4):
            time.sleep(0.35)
            frames += read(capture, 1)
            ages_s.append(time.monotonic() - frames[-1]["captured_s"])
        return {
            "ages_s": ages_s,
            "unaccounted": unaccounted(frames),
            **totals(capture),
        }


@scenario
def hanging_close(uri: str, camera: EmulatedCamera) -> dict[str, Any]:
    """The driver takes five seconds to stop."""
    capture = V4L2Capture(uri)
    camera.fault("slowoff=5000")
    start_s = time.monotonic()
    capture.close()
    took_s = time.monotonic() - start_s
    capture.close()
    camera.fault()
    return {"took_s": took_s, "read": _read_error(capture)}


def _read_error(capture: V4L2Capture) -> str:
    try:
        capture.read(0.1)
    except CaptureEndedError as error:
        return str(error)
    return ""


@scenario
def failed_openings(uri: str, camera: EmulatedCamera) -> dict[str, Any]:
    """A thousand openings that fail, each in another way, and twenty-five that do not."""

    def fail(count: int) -> None:
        for number in range(count):
            fault, address = ways[number % len(ways)]
            camera.fault(fault)
            try:
                V4L2Capture(address).close()
            except StreamtrackError as error:
                kinds.add(str(error).split(":")[0])
            else:
                raise AssertionError(f"opened {address} with fault {fault!r}")

    kinds: set[str] = set()
    ways = [
        ("", "/dev/video77"),
        ("eacces", uri),
        ("enospc", uri),
        ("", f"{uri}?control.gain=1000"),
        ("", f"{uri}?control.nonsense=1"),
        ("", "/dev/video41"),
        ("busy", uri),
        ("", f"{uri}?control.exposure=100"),
    ]
    fail(80)
    camera.fault()
    for _ in range(5):
        with V4L2Capture(uri) as capture:
            assert capture.read(3.0) is not None
    before = _resources()
    fail(1000)
    camera.fault()
    for _ in range(25):
        with V4L2Capture(uri) as capture:
            assert capture.read(3.0) is not None
    return {"before": before, "after": _resources(), "kinds": sorted(kinds)}


def _resources() -> dict[str, float]:
    with Path("/proc/self/statm").open() as file:
        pages = int(file.read().split()[1])
    return {
        "fds": _count("fd"),
        "maps": len(Path("/proc/self/maps").read_text().splitlines()),
        "threads": threading.active_count(),
        # A thread that was joined may be listed for a moment more.
        "tasks": min((time.sleep(0.05), _count("task"))[1] for _ in range(10)),
        "rss_mb": pages * resource.getpagesize() / 1e6,
    }


def _count(kind: str) -> int:
    return len(list(Path("/proc/self", kind).iterdir()))


class _Warnings(logging.Handler):
    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())


WARNINGS = _Warnings()


def main(name: str, uri: str, number: str) -> None:
    cv2.setNumThreads(1)
    logging.getLogger("streamtrack.sources").addHandler(WARNINGS)
    camera = EmulatedCamera(Path(os.environ["V4L2_SHIM_DIR"]), int(number))
    result = SCENARIOS[name](uri, camera)
    sys.stdout.write(json.dumps({**result, "warnings": WARNINGS.lines}))


if __name__ == "__main__":
    main(*sys.argv[1:])
