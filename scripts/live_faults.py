"""Every fault of a live source and of its outputs, measured: a table in Markdown on stdout.

    .venv/bin/python scripts/live_faults.py [--first] [NAME ...] > scripts/live_faults_report.md

Names choose faults by a part of their name; --first (needs root) has the runs served before other
programs of a busy machine. Noticed: from the fault to the run's own word of it (a
state, a count or a log line). Recovered: from the moment the cause is gone to the first picture
that is through. Without a picture: the longest time between two pictures that are through. Not
seen: pictures that the source made and the run did not see. Memory: of the run, 2 s after it is
well again, against before. A full disk needs root (for a small tmpfs), RTSP scripts/setup-servers.
"""

from __future__ import annotations

import os
import platform
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

from emulated_run import ROOT, Run, Scene, make_scene

sys.path.insert(0, str(ROOT / "tests"))

from rrd import rrd_columns

from streamtrack.recording.repair import is_whole
from streamtrack.viewer import viewer_executable
from tests import rtsp_server, servers

CAMERA = "v4l2:///dev/video40?size=640x480&fps=30&format=mjpeg"
MODES = ["MJPG 640 480 30", "YUYV 640 480 30", "MJPG 320 240 30"]
LIVE_PORT = 9894
WAIT_S = 60.0
FAULTS: list[tuple[str, Callable[[Path], Row]]] = []


@dataclass
class Row:
    """What a fault did; None where it does not apply."""

    noticed_s: float | None = None
    recovered_s: float | None = None
    gap_s: float | None = None
    not_seen: str = ""
    memory_mb: float | None = None
    remark: str = ""


def fault(name: str) -> Callable[[Callable[[Path], Row]], Callable[[Path], Row]]:
    def register(function: Callable[[Path], Row]) -> Callable[[Path], Row]:
        FAULTS.append((name, function))
        return function

    return register


def watched(
    run: Run,
    act: Callable[[], object],
    undo: Callable[[], object],
    hold_s: float,
    rate_hz: float = 30.0,
) -> Row:
    """Make a fault for a while in a run that is well."""
    run.settle()
    memory_mb = run.rss_mb()
    began = time.time()
    act()
    time.sleep(hold_s)
    undone = time.time()
    undo()
    run.wait(lambda: run.of("frame", undone + 0.05), "frame after the fault")
    run.settle(60)
    seen = [line["t"] for line in run.of("frame", began - 2.0)]
    gap_s = max(b - a for a, b in pairwise(seen))
    words = [
        line
        for line in sorted(run.of("state", began) + run.of("counts", began), key=lambda x: x["t"])
        if line.get("state") not in ("streaming", "connecting")
    ]
    counted = {
        name: sum(line.get(name, 0) for line in run.of("counts", began))
        for name in ("lost", "damaged")
    }
    not_seen = ", ".join(f"{n} {name}" for name, n in counted.items() if n)
    is_away = any(line["kind"] == "state" for line in words)
    recovered = run.of("frame", undone)[0]
    if is_away:
        not_seen = f"about {round(gap_s * rate_hz) - 1}"
    return Row(
        words[0]["t"] - began if words else None,
        recovered["t"] - undone,
        gap_s,
        not_seen or "0",
        run.rss_mb() - memory_mb,
    )


# --- the camera ---------------------------------------------------------------------------------


@cache
def the_scene() -> Scene:
    """Rendered once."""
    return make_scene(Path(tempfile.mkdtemp(prefix="streamtrack-faults-")), MODES)


@contextmanager
def camera_run(folder: Path, **more: Any) -> Iterator[tuple[Scene, Run]]:
    scene = the_scene()
    scene.camera.plug()
    scene.camera.fault()
    with Run(folder, scene.emulator.env(), source=CAMERA, target=scene.target, **more) as run:
        yield scene, run


def camera_fault(name: str, words: str, hold_s: float) -> None:
    def measure(folder: Path) -> Row:
        with camera_run(folder) as (scene, run):
            camera = scene.camera
            return watched(run, lambda: camera.fault(words), camera.fault, hold_s)

    FAULTS.append((name, measure))


camera_fault("camera stalls for 10 s", "stall", 10.0)
camera_fault("30 % of the frames lost for 4 s", "drop=30", 4.0)
camera_fault("error flag on half of the frames for 4 s", "errflag=50", 4.0)
camera_fault("EIO", "eio", 0.05)
camera_fault("MJPG frames end after 60 % of their bytes for 2 s", "short=60", 2.0)
camera_fault("an eighth of each MJPG frame's bytes is missing for 2 s", "damage", 2.0)
camera_fault("empty buffers for 2 s", "empty", 2.0)


def camera_away(name: str, words: str, hold_s: float) -> None:
    def measure(folder: Path) -> Row:
        with camera_run(folder) as (scene, run):
            camera = scene.camera

            def back() -> None:
                camera.plug()
                camera.fault()

            def act() -> None:
                camera.unplug()
                if words:
                    time.sleep(0.5)
                    camera.fault(words)
                    camera.plug()

            if words.startswith("grant"):
                row = watched(run, act, lambda: None, 0.0)
                row.remark = (
                    f"then {run.of('frame')[-1]['size']}, epoch {run.of('frame')[-1]['epoch']}"
                )
            else:
                row = watched(run, act, back, hold_s)
            tracking = [line["tracking"] for line in run.of("frame")[-30:]]
            row.remark += f"{', ' if row.remark else ''}target found again: {all(tracking)}"
            return row

    FAULTS.append((name, measure))


camera_away("unplugged, back after 3 s", "", 3.0)
camera_away("unplugged, back after 20 s", "", 20.0)
camera_away("unplugged, at once back but busy for 5 s", "busy", 5.0)
camera_away("unplugged, back with another format", "grant=1", 0.5)
camera_away("unplugged, back with another size", "grant=2", 0.5)


# --- the network --------------------------------------------------------------------------------


@fault("RTSP server killed, back after 3 s")
def rtsp_killed(folder: Path) -> Row:
    if reason := rtsp_server.missing():
        return Row(remark=f"not measured: {reason}")
    running, port = rtsp_server.start()
    with Run(folder, source=f"rtsp://user:secret@127.0.0.1:{port}/cam") as run:
        again: list[subprocess.Popen[str]] = []
        row = watched(
            run,
            lambda: rtsp_server.stop(running),
            lambda: again.append(rtsp_server.start(port)[0]),
            3.0,
        )
        rtsp_server.stop(again[0])
    row.remark = "from the start of the server"
    return row


@fault("RTSP server frozen for 10 s")
def rtsp_frozen(folder: Path) -> Row:
    if reason := rtsp_server.missing():
        return Row(remark=f"not measured: {reason}")
    running, port = rtsp_server.start()
    with Run(folder, source=f"rtsp://127.0.0.1:{port}/cam") as run:
        row = watched(
            run,
            lambda: running.send_signal(signal.SIGSTOP),
            lambda: running.send_signal(signal.SIGCONT),
            10.0,
        )
        rtsp_server.stop(running)
    return row


@fault("HTTP stream stalls for 10 s")
def http_stall(folder: Path) -> Row:
    flows = threading.Event()
    flows.set()

    def serve(connection: Any) -> None:
        servers.read_request(connection)
        connection.sendall(servers.MJPEG_HEADER)
        for number in range(10**6):
            flows.wait()
            connection.sendall(servers.part(servers.jpeg(number % 256)))
            time.sleep(1 / 30)

    with (
        servers.Server(serve) as server,
        Run(folder, source=f"http://127.0.0.1:{server.port}/cam") as run,
    ):
        return watched(run, flows.clear, flows.set, 10.0)


# --- outputs and ends ---------------------------------------------------------------------------


Viewer = subprocess.Popen[bytes]


@contextmanager
def a_viewer() -> Iterator[Viewer]:
    """A program that reads all that the live view has to show."""
    command = [str(viewer_executable()), f"rerun+http://127.0.0.1:{LIVE_PORT}/proxy"]
    with subprocess.Popen(
        [*command, "--save", os.devnull], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as viewer:
        try:
            yield viewer
        finally:
            viewer.kill()


def viewer_fault(name: str, act: Callable[[Viewer], object], hold_s: float) -> None:
    @fault(name)
    def measure(folder: Path) -> Row:
        with live_run(folder) as run, a_viewer() as viewer:
            row = watched(run, lambda: act(viewer), lambda: None, hold_s)
            return without_effect(run, row)


@contextmanager
def live_run(folder: Path) -> Iterator[Run]:
    """A run with a recording and a live view, that is well."""
    with camera_run(folder, record=str(folder / "run.rrd"), live=str(LIVE_PORT)) as (_, run):
        run.settle(30)
        yield run


def without_effect(run: Run, row: Row) -> Row:
    """The row of something that a run should not notice at all."""
    slow = max(line["ms"] for line in run.of("slow"))
    run.stop()
    end = run.of("end")[-1]
    row.noticed_s = row.recovered_s = None
    row.not_seen = f"{end['dropped']} dropped"
    row.remark = f"longest call of the live view {slow:.1f} ms, age p95 {end['age_p95']:.0f} ms"
    return row


def read_little(viewer: Viewer, hold_s: float = 15.0) -> None:
    """Let it run for a twentieth of the time."""
    for _ in range(round(hold_s)):
        viewer.send_signal(signal.SIGSTOP)
        time.sleep(0.95)
        viewer.send_signal(signal.SIGCONT)
        time.sleep(0.05)


@fault("live view on, no viewer for 15 s")
def no_viewer(folder: Path) -> Row:
    with live_run(folder) as run:
        return without_effect(run, watched(run, lambda: None, lambda: None, 15.0))


viewer_fault("viewer slow: runs for a twentieth of 15 s", read_little, 0.0)
viewer_fault("viewer frozen for 15 s", lambda viewer: viewer.send_signal(signal.SIGSTOP), 15.0)
viewer_fault("viewer killed", lambda viewer: viewer.kill(), 3.0)


@fault("recording fills the disk's last 8 MB, room again after 20 s")
def disk_full(folder: Path) -> Row:
    disk = folder / "small"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=80m", "none", disk]).returncode:
        return Row(remark="not measured: needs root")
    try:
        record, ballast = str(disk / "run.rrd"), disk / "ballast"
        with camera_run(folder, record=record, rotate="10MB") as (_, run):
            run.settle()
            memory_mb, began = run.rss_mb(), time.time()
            left = os.statvfs(disk).f_bavail * os.statvfs(disk).f_frsize
            ballast.write_bytes(bytes(max(0, left - (8 << 20))))
            ended = run.wait(lambda: run.said("disk is full", began), "line about the disk")
            time.sleep(20.0)
            ballast.unlink()
            undone = time.time()
            resumed = run.wait(lambda: run.said("goes on in", undone), "new file", 90.0)
            run.settle()
            seen = [line["t"] for line in run.of("frame", began)]
            gap_s = max(b - a for a, b in pairwise(seen))
            memory_mb = run.rss_mb() - memory_mb
            lines = [line for line in run.of("log", began) if "the disk is full" in line["text"]]
            run.stop()
        whole = [is_whole(path) for path in sorted(disk.glob("run-*.rrd"))]
        return Row(
            ended["t"] - began,
            resumed["t"] - undone,
            gap_s,
            "0 of the tracking",
            memory_mb,
            f"{len(lines)} line; {sum(whole)} of {len(whole)} files whole; room is looked for once "
            "a minute",
        )
    finally:
        subprocess.run(["umount", "-l", disk], check=False)


@fault("kill -9, started again at once")
def killed(folder: Path) -> Row:
    record = str(folder / "run.rrd")
    with camera_run(folder, record=record, rotate="1h") as (scene, run):
        run.settle(120)
        run.process.kill()
        run.process.wait()
        began, last = time.time(), run.of("frame")[-1]["index"]
        given = {"source": CAMERA, "target": scene.target, "record": record, "rotate": "1h"}
        with Run(folder, scene.emulator.env(), **given) as again:
            mended = again.wait(lambda: again.said("mended", began), "mended file")
            recovered_s = again.wait(lambda: again.of("frame"), "frame")[0]["t"] - began
            again.stop()
    frames = rrd_columns(Path(record).with_stem("run-000001"), "/metrics/ms", "Scalars:scalars")[0]
    return Row(
        None,
        recovered_s,
        None,
        f"{last - max(frames, default=-1)} of {last + 1}",
        None,
        f"mended {mended['t'] - began:.1f} s after the kill, while tracking",
    )


@fault("SIGTERM while streaming, recording and live view on")
def terminated(folder: Path) -> Row:
    record = folder / "run.rrd"
    with camera_run(folder, record=str(record), live=str(LIVE_PORT)) as (_, run):
        run.settle()
        took_s = run.stop()
        code = run.process.returncode
    return Row(remark=f"ended after {took_s:.2f} s, exit {code}, file whole: {is_whole(record)}")


@fault("SIGTERM while the camera is away")
def terminated_away(folder: Path) -> Row:
    record = folder / "run.rrd"
    with camera_run(folder, record=str(record), live=str(LIVE_PORT)) as (scene, run):
        run.settle()
        scene.camera.unplug()
        time.sleep(5.0)
        took_s = run.stop()
        code = run.process.returncode
    states = rrd_columns(record, "/source/state", "StateChange:state")[1]
    return Row(
        remark=f"ended after {took_s:.2f} s, exit {code}, file whole: {is_whole(record)}, "
        f"its last state: {states[-1][0]}"
    )


def cell(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)


def main() -> None:
    parts = [text for text in sys.argv[1:] if text != "--first"]
    if "--first" in sys.argv:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    chosen = [
        (name, measure)
        for name, measure in FAULTS
        if not parts or any(part in name for part in parts)
    ]
    print(f"# Faults of live sources, measured {time.strftime('%Y-%m-%d')}\n")
    print(
        f"Emulated camera (tests/v4l2_shim.c) 640x480 MJPG at 30 fps, real servers, "
        f"{os.cpu_count()} cores {platform.machine()}; load when begun {os.getloadavg()[0]:.1f}"
        f"{', served first' if '--first' in sys.argv else ''}. "
        "Made by `scripts/live_faults.py`, which says what the columns mean. A stall is one after "
        "5 s of silence (`live.stall_timeout_s`); openings are tried again after 1, 2, 4 ... 60 "
        "s.\n"
    )
    print(
        "| fault | noticed after | recovered after | without a picture | not seen | memory | |\n"
        "|---|---|---|---|---|---|---|"
    )
    for name, measure in chosen:
        with tempfile.TemporaryDirectory(prefix="streamtrack-faults-") as folder:
            try:
                row = measure(Path(folder))
            except AssertionError as error:
                row = Row(remark=f"FAILED: {error}")
        print(
            f"| {name} | {cell(row.noticed_s, '.2f')} | {cell(row.recovered_s, '.2f')} "
            f"| {cell(row.gap_s, '.2f')} | {row.not_seen} | {cell(row.memory_mb, '+.1f')} "
            f"| {row.remark} |",
            flush=True,
        )
    print("\nTimes in seconds, memory in MB.")


if __name__ == "__main__":
    main()
