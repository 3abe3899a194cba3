"""How old frames are when all is done with them: emulated camera, recording and live view on.

    .venv/bin/python scripts/latency.py [--seconds 60] [--cores 2] [--first]

The camera gives 640x480 MJPG at 30 fps; its drivers' stamps are the moments of capture. The run is
held to two cores; --first (needs root) has it served before other programs of a busy machine.
Ends with exit code 1 unless the age's p95 is at most 50 ms and no frame was dropped.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

from emulated_run import Run, make_scene

CAMERA = "v4l2:///dev/video40?size=640x480&fps=30&format=mjpeg"
MOST_P95_MS = 50.0
WARM_UP_S = 5.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--first", action="store_true", help="real-time scheduling")
    options = parser.parse_args()
    cores = sorted(os.sched_getaffinity(0))[: options.cores]
    with tempfile.TemporaryDirectory(prefix="streamtrack-latency-") as name:
        folder = Path(name)
        scene = make_scene(folder)
        os.sched_setaffinity(0, cores)
        if options.first:
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
        given = {"source": CAMERA, "target": scene.target, "live": "9896"}
        record = str(folder / "run.rrd")
        with Run(folder, scene.emulator.env(), record=record, rotate="100MB", **given) as run:
            run.settle(30)
            time.sleep(WARM_UP_S)
            began, cpu_s = time.time(), run.cpu_s()
            time.sleep(options.seconds)
            cpu_share = (run.cpu_s() - cpu_s) / options.seconds
            frames = run.of("frame", began)
            ended_s = run.stop()
            end = run.of("end")[-1]
    ages = sorted(line["age_ms"] for line in frames)
    missing = frames[-1]["index"] - frames[0]["index"] + 1 - len(frames)
    p50, p95, p99 = (ages[round(share * (len(ages) - 1))] for share in (0.5, 0.95, 0.99))
    tracked = sum(line["tracking"] for line in frames)
    print(
        f"{len(frames)} frames in {options.seconds:g} s, tracking in {tracked}, "
        f"{missing} left out (dropped in the whole run, its start included: {end['dropped']})\n"
        f"age at output: p50 {p50:.1f} ms, p95 {p95:.1f} ms, p99 {p99:.1f} ms, "
        f"most {ages[-1]:.1f} ms\n"
        f"{len(cores)} cores{', served first' if options.first else ''}, "
        f"load {os.getloadavg()[0]:.1f}; the tracker took {100 * cpu_share:.0f} % of a core; "
        f"SIGTERM to exit {ended_s:.2f} s"
    )
    return 0 if p95 <= MOST_P95_MS and missing == 0 else 1


if __name__ == "__main__":
    sys.exit(main())
