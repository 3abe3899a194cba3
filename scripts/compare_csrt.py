"""streamtrack beside OpenCV's CSRT on the same boxes of a video: numbers and contact sheets.

    scripts/compare_csrt.py VIDEO [--start N] [--frames N] [--truth FILE] [--out FOLDER] BOX...

Each BOX is `x,y,w,h` in pixels of frame ``start``; `NAME=` may stand before it. Both trackers
follow each box alone, OpenCV in one thread, time is that of the processor. FOLDER gets
``boxes.csv`` (every frame: what each tracker says), ``summary.json``, and for each target a sheet
of frames, streamtrack in green (a word in red where it says lost) over CSRT in orange.

Without a truth only CPU time, frames claimed and the overlap of the two can be printed. FILE holds
it as CSV, `target,frame,x,y,w,h` with frames of the video, w = 0 where the target is gone; frames
between are not judged. Then a frame is *kept* if the overlap (IoU) with the true box is 0.5 or
more, the success of OTB (Wu et al., CVPR 2013), and *silent drift* if a place is claimed whose
overlap is below 0.1, or any where the target is gone; *said lost* where it is not claimed.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from streamtrack.bench.follower import Follower
from streamtrack.bench.methods import Streamtrack
from streamtrack.bench.peers import csrt
from streamtrack.errors import StreamtrackError
from streamtrack.geometry import bounding_box
from streamtrack.settings import Settings
from streamtrack.sources import open_source
from streamtrack.targets import parse_targets
from streamtrack.types import Image, Points

_KEPT_IOU = 0.5
_DRIFT_IOU = 0.1
_SHEET_FRAMES = 15
_SHEET_COLUMNS = 5
_TILE_WIDTH = 320
_COLUMNS = ["target", "frame", "tracker", "claimed", "x", "y", "w", "h", "iou_of_both"]
_COLORS = {"streamtrack": (80, 230, 80), "csrt": (40, 140, 255)}

Box = tuple[float, float, float, float]
Truth = dict[tuple[str, int], Box]


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """One tracker on one target: its quads and processor milliseconds, frame by frame."""

    quads: tuple[Points | None, ...]
    cpu_ms: tuple[float, ...]


def follow(images: Sequence[Image], quad: Points, tracker: str) -> Run:
    """The quads of all frames; the first is given, and its milliseconds are those of set-up."""
    began = time.process_time()
    follower: Follower
    if tracker == "csrt":
        follower = csrt(images[0], quad)
    else:
        follower = Streamtrack(images[0], quad, Settings())
    quads: list[Points | None] = [quad]
    cpu_ms = [(time.process_time() - began) * 1e3]
    for image in images[1:]:
        began = time.process_time()
        quads.append(follower.update(image))
        cpu_ms.append((time.process_time() - began) * 1e3)
    return Run(tuple(quads), tuple(cpu_ms))


def box_of(quad: Points | None) -> Box | None:
    """The upright box x, y, w, h about a quad."""
    if quad is None:
        return None
    x0, y0, x1, y1 = bounding_box(quad)
    return x0, y0, x1 - x0, y1 - y0


def overlap(a: Box | None, b: Box | None) -> float:
    """Intersection over union of two boxes, 0 if one is missing."""
    if a is None or b is None:
        return 0.0
    width = min(a[0] + a[2], b[0] + b[2]) - max(a[0], b[0])
    height = min(a[1] + a[3], b[1] + b[3]) - max(a[1], b[1])
    shared = max(width, 0.0) * max(height, 0.0)
    return shared / max(a[2] * a[3] + b[2] * b[3] - shared, 1e-9)


def read_truth(path: Path) -> Truth:
    """True boxes by target and frame of the video."""
    truth: Truth = {}
    with path.open(newline="") as file:
        for row in csv.DictReader(file):
            x, y, w, h = (float(row[key]) for key in "xywh")
            truth[row["target"], int(row["frame"])] = x, y, w, h
    return truth


def judged(run: Run, name: str, start: int, truth: Truth) -> dict[str, float | int | None]:
    """The figures of one run; what a truth is needed for is None without one."""
    spent = np.array(run.cpu_ms[1:])
    claimed = sum(quad is not None for quad in run.quads[1:])
    figures: dict[str, float | int | None] = {
        "frames": len(spent),
        "claimed": claimed,
        "cpu_ms_p50": float(np.median(spent)),
        "cpu_ms_p95": float(np.quantile(spent, 0.95)),
        "cpu_ms_mean": float(np.mean(spent)),
    }
    known = [
        (box_of(quad), truth[name, start + row])
        for row, quad in enumerate(run.quads)
        if row > 0 and (name, start + row) in truth
    ]
    if not known:
        return {**figures, "visible": None, "kept": None, "silent_drift": None, "said_lost": None}
    overlaps = [overlap(box, true) if true[2] > 0 else 0.0 for box, true in known]
    pairs = list(zip(known, overlaps, strict=True))
    return {
        **figures,
        "judged": len(known),
        "visible": sum(true[2] > 0 for _, true in known),
        "kept": sum(share >= _KEPT_IOU for share in overlaps),
        "silent_drift": sum(box is not None and share < _DRIFT_IOU for (box, _), share in pairs),
        "said_lost": sum(box is None for box, _ in known),
    }


def table(name: str, runs: dict[str, Run], start: int) -> list[list[object]]:
    """What each tracker said in every frame, and how much the two overlap."""
    boxes = {tracker: [box_of(quad) for quad in run.quads] for tracker, run in runs.items()}
    lines: list[list[object]] = []
    for row, pair in enumerate(zip(*boxes.values(), strict=True)):
        both = f"{overlap(*pair):.3f}"
        for tracker, box in zip(boxes, pair, strict=True):
            numbers = ["", "", "", ""] if box is None else [f"{value:.1f}" for value in box]
            lines.append([name, start + row, tracker, int(box is not None), *numbers, both])
    return lines


def drawn(image: Image, run: Run, row: int, tracker: str, label: str) -> Image:
    """A small copy of the frame with what one tracker says in it."""
    factor = _TILE_WIDTH / image.shape[1]
    tile = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    quad = run.quads[row]
    if quad is None:
        cv2.putText(tile, "lost", (8, 40), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (60, 60, 255), 2)
    else:
        corners = np.rint(quad * factor).astype(np.int32)
        cv2.polylines(tile, [corners], True, _COLORS[tracker], 2, cv2.LINE_AA)
        cv2.circle(tile, corners[0].tolist(), 4, _COLORS[tracker], -1, cv2.LINE_AA)
    cv2.putText(tile, label, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1)
    return np.asarray(tile, np.uint8)


def sheet(images: Sequence[Image], runs: dict[str, Run], start: int) -> Image:
    """Frames spread over the clip, both trackers one above the other in each."""
    rows = np.unique(np.linspace(0, len(images) - 1, _SHEET_FRAMES).astype(int))
    cells = [
        np.vstack(
            [
                drawn(images[row], run, row, tracker, f"{tracker} {start + row}")
                for tracker, run in runs.items()
            ]
        )
        for row in rows
    ]
    while len(cells) % _SHEET_COLUMNS:
        cells.append(np.zeros_like(cells[0]))
    lines = [
        np.hstack(cells[first : first + _SHEET_COLUMNS])
        for first in range(0, len(cells), _SHEET_COLUMNS)
    ]
    return np.vstack(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("video", type=Path)
    parser.add_argument("boxes", nargs="+", metavar="[NAME=]x,y,w,h")
    parser.add_argument("--start", type=int, default=0, help="frame in which the boxes are given")
    parser.add_argument("--frames", type=int, help="how many frames")
    parser.add_argument("--truth", type=Path, help="CSV of true boxes: target,frame,x,y,w,h")
    parser.add_argument("--out", type=Path, default=Path("csrt"))
    wanted = parser.parse_args()
    cv2.setNumThreads(1)
    truth = read_truth(wanted.truth) if wanted.truth else {}
    stop = None if wanted.frames is None else wanted.start + wanted.frames
    with open_source(wanted.video) as source:
        images = [frame.image for frame in islice(source, wanted.start, stop)]
    wanted.out.mkdir(parents=True, exist_ok=True)
    summary: dict[str, dict[str, dict[str, float | int | None]]] = {}
    lines: list[list[object]] = []
    for target in parse_targets(wanted.boxes):
        assert target.quad is not None
        runs = {name: follow(images, target.quad, name) for name in _COLORS}
        lines += table(target.name, runs, wanted.start)
        cv2.imwrite(str(wanted.out / f"{target.name}.png"), sheet(images, runs, wanted.start))
        summary[target.name] = {
            name: judged(run, target.name, wanted.start, truth) for name, run in runs.items()
        }
        for name, figures in summary[target.name].items():
            known = {key: round(value, 1) for key, value in figures.items() if value is not None}
            print(target.name, name, *(f"{key} {value}" for key, value in known.items()))
    with (wanted.out / "boxes.csv").open("w", newline="") as file:
        csv.writer(file).writerows([_COLUMNS, *lines])
    (wanted.out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")


if __name__ == "__main__":
    try:
        main()
    except (StreamtrackError, OSError) as error:
        print(f"compare_csrt: {error}", file=sys.stderr)
        raise SystemExit(1) from None
