"""Follows an emulated camera for a long time with a fault every 20 s; is all that it holds flat?

    .venv/bin/python scripts/soak.py --minutes 60 [--every 20] [--folder soak] [--no-live]

The run records with rotation, writes a table and serves a live view, at 30 pictures a second of
640x480. Every five seconds memory, file descriptors, threads and child processes are read from
/proc. The slope of each is a least-squares line through the means of the minutes after the
warm-up (the first tenth, at least one minute, at most five), with its 95 % bound. Ends with exit
code 1 if something grew.
"""

from __future__ import annotations

import argparse
import itertools
import math
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path

import numpy as np
from emulated_run import VGA, Sample, Scene, TrackerProcess, make_scene

CAMERA = "v4l2:///dev/video40?size=640x480&fps=30&format=mjpeg"
SAMPLE_EVERY_S = 5.0
MEMORY_BOUND_MB_H = 10.0
"""A leak of a thousandth of a frame's bytes a frame would be 100 MB/h."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--every", type=float, default=20.0, metavar="S", help="a fault each S s")
    parser.add_argument("--folder", type=Path, help="keeps logs, recordings and samples.csv")
    parser.add_argument("--live", type=int, default=9890, metavar="PORT", help="0 for none")
    options = parser.parse_args()
    folder = options.folder or Path(tempfile.mkdtemp(prefix="streamtrack-soak-"))
    folder.mkdir(parents=True, exist_ok=True)
    scene = make_scene(folder, [VGA, "YUYV 640 480 30", "MJPG 320 240 30"])
    arguments = [
        *(CAMERA, "--target", scene.target),
        *("--record", str(folder / "soak.rrd"), "--rotate", "50MB|2min", "--keep", "200MB"),
        *("--output", str(folder / "tracks.csv")),
        *(() if not options.live else ("--live", str(options.live))),
    ]
    print(f"streamtrack track {' '.join(arguments)}\nin {folder}", flush=True)
    with TrackerProcess(folder, arguments, scene.emulator.env()) as tracker:
        samples, faults = watch(tracker, scene, options.minutes * 60.0, options.every)
        if tracker.process.poll() is not None:
            print((folder / "stderr").read_text()[-2000:])
            print(f"FAILED: it ended by itself after {samples[-1].at_s:.0f} s")
            return 1
        cpu_share = tracker.cpu_s() / samples[-1].at_s
        ended_s = tracker.stop()
        code = tracker.process.returncode
    write_samples(folder / "samples.csv", samples)
    return report(samples, faults, tracker, cpu_share, ended_s, code)


# --- the faults ---------------------------------------------------------------------------------


def fault_list(scene: Scene, every_s: float) -> list[tuple[str, Callable[[], Iterator[float]]]]:
    """Name and course of each fault: a generator that yields how long to wait for its next act."""
    camera = scene.camera

    def words(text: str, share: float) -> Callable[[], Iterator[float]]:
        def course() -> Iterator[float]:
            camera.fault(text)
            yield share * every_s
            camera.fault()

        return course

    def away(fault: str, share: float) -> Callable[[], Iterator[float]]:
        """Unplugged, then back with a fault that ends only when it was unplugged once more."""

        def course() -> Iterator[float]:
            camera.unplug()
            yield share * every_s
            camera.fault(fault)
            camera.plug()
            if fault:
                yield 0.3 * every_s
                camera.fault()
            if fault.startswith("grant"):
                camera.unplug()
                yield 0.05 * every_s
                camera.plug()

        return course

    return [
        ("stall", words("stall", 0.35)),
        ("lost frames", words("drop=30", 0.3)),
        ("error flags", words("errflag=50", 0.3)),
        ("EIO", words("eio", 0.05)),
        ("unplug and return", away("", 0.15)),
        ("busy at return", away("busy", 0.05)),
        ("short MJPG", words("short=60", 0.3)),
        ("damaged MJPG", words("damage", 0.3)),
        ("empty buffers", words("empty", 0.1)),
        ("other format at return", away("grant=1", 0.05)),
        ("other size at return", away("grant=2", 0.05)),
    ]


def watch(
    tracker: TrackerProcess, scene: Scene, duration_s: float, every_s: float
) -> tuple[list[Sample], int]:
    """Makes the faults and takes the samples until it is over; the samples and faults made."""
    samples: list[Sample] = []
    courses = itertools.cycle(fault_list(scene, every_s))
    began_s = time.monotonic()
    next_fault_s, next_sample_s, next_line_s = every_s, 0.0, 0.0
    acting: Iterator[float] = iter(())
    next_act_s = math.inf
    faults = 0
    while (now_s := time.monotonic() - began_s) < duration_s:
        if now_s >= next_sample_s:
            next_sample_s += SAMPLE_EVERY_S
            sample = tracker.sample()
            if sample is None:
                break
            samples.append(sample)
            if now_s >= next_line_s:
                next_line_s += 60.0
                print(line_of(sample, faults), flush=True)
        if now_s >= next_fault_s:
            next_fault_s += every_s
            acting = next(courses)[1]()
            next_act_s = now_s
            faults += 1
        if now_s >= next_act_s:
            wait_s = next(acting, None)
            next_act_s = math.inf if wait_s is None else now_s + wait_s
        time.sleep(0.05)
    for _ in acting:
        pass
    scene.camera.fault()
    scene.camera.plug()
    return samples, faults


# --- the report ---------------------------------------------------------------------------------


def line_of(sample: Sample, faults: int) -> str:
    return (
        f"{sample.at_s / 60:5.1f} min  faults {faults:3d}  RSS {sample.rss_mb:6.1f} MB  "
        f"files {sample.files}  threads {sample.threads}  children {sample.children} "
        f"({sample.children_rss_mb:.0f} MB)  load {os.getloadavg()[0]:.1f}"
    )


def write_samples(path: Path, samples: list[Sample]) -> None:
    names = [field.name for field in fields(Sample)]
    lines = [",".join(f"{getattr(sample, name):.3f}" for name in names) for sample in samples]
    path.write_text("\n".join([",".join(names), *lines]) + "\n")


def slope_per_hour(times_s: np.ndarray, values: np.ndarray) -> tuple[float, float]:
    """Least-squares slope of the minutes' means and its 95 % bound (2 standard errors)."""
    minutes = np.floor(times_s / 60.0)
    places = np.unique(minutes)
    means = np.array([values[minutes == place].mean() for place in places])
    hours = (places - places.mean()) / 60.0
    spread = float((hours**2).sum())
    if len(places) < 3:
        return math.nan, math.nan
    slope = float((hours * (means - means.mean())).sum()) / spread
    rest = means - means.mean() - slope * hours
    error = math.sqrt(float((rest**2).sum()) / (len(places) - 2) / spread)
    return slope, 2.0 * error


def report(
    samples: list[Sample],
    faults: int,
    tracker: TrackerProcess,
    cpu_share: float,
    ended_s: float,
    code: int,
) -> int:
    lasted_s = samples[-1].at_s
    warm_up_s = min(300.0, max(60.0, 0.1 * lasted_s))
    kept = [sample for sample in samples if sample.at_s >= warm_up_s]
    times_s = np.array([sample.at_s for sample in kept])
    grown: list[str] = []
    print(
        f"\n{lasted_s / 60:.1f} min, {faults} faults, the first {warm_up_s / 60:.1f} min left out"
    )
    print("| held | least | most | last | slope an hour | 95 % bound | allowed |")
    print("|---|---|---|---|---|---|---|")
    for name, allowed in (
        ("rss_mb", MEMORY_BOUND_MB_H),
        ("files", 1.0),
        ("threads", 1.0),
        ("children", 1.0),
        ("children_rss_mb", math.inf),
    ):
        values = np.array([float(getattr(sample, name)) for sample in kept])
        slope, bound = slope_per_hour(times_s, values)
        print(
            f"| {name} | {values.min():.1f} | {values.max():.1f} | {values[-1]:.1f} "
            f"| {slope:+.2f} | ±{bound:.2f} | {allowed:g} |"
        )
        if slope - bound > allowed:
            grown.append(name)
    live = tracker.summary()["live"]
    print(f"live: {live}")
    print(f"frames: {tracker.summary()['targets']}")
    print(f"CPU {100 * cpu_share:.0f} % of a core; SIGTERM to exit {ended_s:.2f} s, exit {code}")
    files = sorted(tracker.folder.glob("soak-*.rrd"))
    print(f"recordings: {len(files)}, {sum(file.stat().st_size for file in files) / 1e6:.0f} MB")
    if grown or code:
        print(f"FAILED: {', '.join(grown) or 'exit code'}")
        return 1
    print("flat")
    return 0


if __name__ == "__main__":
    sys.exit(main())
