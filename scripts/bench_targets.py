"""What each further target costs: processor time a frame, decoding included, for 1 to 4 targets.

    scripts/bench_targets.py [--scene rotation] [--seed 1] [--size 640x480] [--frames 90]

The targets are the quarters of a synthetic scene's target, all of one size, so that each has the
same to do. Runs take turns and the machine's load falls on all alike; OpenCV works in one thread.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.pipeline import track
from streamtrack.settings import Settings
from streamtrack.sources import open_source
from streamtrack.sources.synthetic import SyntheticSource
from streamtrack.sources.writer import VideoWriter
from streamtrack.targets import Target
from streamtrack.types import Points

_ROUNDS = 3
_WARM_UP_FRAMES = 3


def quarters(quad: Points) -> list[Target]:
    """The four quarters of a quad (4, 2) as targets."""

    def at(u: float, v: float) -> Points:
        top, bottom = quad[0] + u * (quad[1] - quad[0]), quad[3] + u * (quad[2] - quad[3])
        return np.asarray(top + v * (bottom - top), np.float32)

    targets: list[Target] = []
    for u, v in ((0.0, 0.0), (0.5, 0.5), (0.5, 0.0), (0.0, 0.5)):
        corners = [at(u, v), at(u + 0.5, v), at(u + 0.5, v + 0.5), at(u, v + 0.5)]
        targets.append(Target(f"quarter{len(targets)}", np.array(corners, np.float32)))
    return targets


def frame_ms(path: Path, targets: list[Target]) -> npt.NDArray[np.float64]:
    """Processor milliseconds of each frame, from reading it to its result."""
    spent: list[float] = []
    with open_source(path) as source:
        steps = track(source, targets, Settings())
        while True:
            began = time.process_time()
            if next(steps, None) is None:
                return np.array(spent[_WARM_UP_FRAMES:])
            spent.append((time.process_time() - began) * 1e3)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scene", default="rotation")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--frames", type=int, default=90)
    wanted = parser.parse_args()
    cv2.setNumThreads(1)
    uri = f"synthetic://{wanted.scene}?seed={wanted.seed}&size={wanted.size}&frames={wanted.frames}"
    source = SyntheticSource(uri)
    targets = quarters(source.truth(0).quad)
    with tempfile.TemporaryDirectory(prefix="streamtrack-targets-") as folder:
        path = Path(folder) / "clip.mp4"
        with VideoWriter(path, rate_hz=30.0) as writer:
            for frame in source:
                writer.write(frame.image, frame.time_s)
        counts = range(1, len(targets) + 1)
        spent: dict[int, list[npt.NDArray[np.float64]]] = {count: [] for count in counts}
        for _ in range(_ROUNDS):
            for count in counts:
                spent[count].append(frame_ms(path, targets[:count]))
    medians = {count: float(np.median(np.concatenate(spent[count]))) for count in counts}
    for count in counts:
        p95 = float(np.quantile(np.concatenate(spent[count]), 0.95))
        print(f"{count} targets: median {medians[count]:.1f} ms, p95 {p95:.1f} ms")
    further = (medians[len(targets)] - medians[1]) / (len(targets) - 1)
    print(f"each further target: {further:.1f} ms, {further / medians[1]:.0%} of the first")


if __name__ == "__main__":
    main()
