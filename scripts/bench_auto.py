"""Automatic targets against exact truth: MOTA, IDF1 and HOTA by TrackEval, beside other trackers.

    python scripts/bench_auto.py --seeds 1-5 --frames 300

Scenes are `synthetic://traffic` before a fixed and a moving camera, with and without footbridges
that hide the cars. The other trackers get the same detections (the blobs that streamtrack itself
associates), in pixels of the frame. Measures are TrackEval's own code at IoU 0.5 (HOTA: all of its
thresholds). A true box is the upright box of a car's corners inside the picture; cars that are
shown to less than `SHOWN_SHARE` count neither way. `off` is how far the middles of wholly shown
cars are off, `strays` by how much that changes from one frame to the next.

Needs, beside streamtrack: pip install trackeval; and for the others what of them is to take part:
pip install --no-deps norfair filterpy trackers "supervision<0.28" (plus what these import).
"""

from __future__ import annotations

import argparse
import contextlib
import io
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.auto import AutoTargets
from streamtrack.auto.assignment import assign
from streamtrack.auto.boxes import overlaps
from streamtrack.camera.auto import make_camera
from streamtrack.features import FeatureExtractor
from streamtrack.frame_view import FrameView
from streamtrack.geometry import bounding_box
from streamtrack.settings import Settings
from streamtrack.sources.synthetic import SyntheticSource

SHOWN_SHARE = 0.3
MIN_IOU = 0.5
EDGE_PX = 2.0
Boxes = npt.NDArray[np.float64]
Named = tuple[list[str], Boxes]
"""Names and boxes (N, 4) x0, y0, x1, y1 of one frame."""


@dataclass(frozen=True)
class Run:
    """One scene, all frames of it: truth, what was found, and the detections behind it."""

    truth: list[Named]
    is_shown: list[npt.NDArray[np.bool_]]
    is_whole: list[npt.NDArray[np.bool_]]
    size_wh: tuple[int, int]
    found: list[Named]
    detections: list[Boxes]
    auto_ms: float
    camera_ms: float
    most_at_once: int


def run_own(uri: str, camera_mode: str) -> Run:
    settings = Settings.model_validate({"camera": camera_mode})
    source = SyntheticSource(uri)
    extractor, camera, auto = (
        FeatureExtractor(settings.features),
        make_camera(settings),
        AutoTargets(),
    )
    truth, shown, whole, found, detections = [], [], [], [], []
    auto_s = camera_s = 0.0
    for frame in source:
        view = FrameView(frame, extractor)
        began = time.process_time()
        pose = camera.update(view, auto.expected())
        between = time.process_time()
        tracks = auto.update(view, pose, [])
        auto_s += time.process_time() - between
        camera_s += between - began
        names, boxes, is_shown = true_boxes(source, frame.index)
        truth.append((names, boxes))
        shown.append(is_shown)
        whole.append(np.array([t.visible_share > 0.98 for t in source.things(frame.index)], bool))
        tracking = [track for track in tracks if track.quad is not None]
        quads = [bounding_box(track.quad) for track in tracking if track.quad is not None]
        found.append(([track.name for track in tracking], as_boxes(quads)))
        detections.append(as_boxes([blob.box for blob in auto.blobs]))
    count = len(truth)
    most = max(int(np.count_nonzero(is_shown)) for is_shown in shown)
    size_wh = source.info.size_wh
    costs_ms = 1e3 * auto_s / count, 1e3 * camera_s / count
    return Run(truth, shown, whole, size_wh, found, detections, *costs_ms, most)


def true_boxes(
    source: SyntheticSource, index: int
) -> tuple[list[str], Boxes, npt.NDArray[np.bool_]]:
    things = source.things(index)
    width, height = source.info.size_wh
    boxes = as_boxes([bounding_box(thing.quad) for thing in things])
    boxes = np.clip(boxes, -0.5, np.array([width, height, width, height]) - 0.5)
    is_shown = np.array([thing.visible_share >= SHOWN_SHARE for thing in things], bool)
    return [str(thing.number) for thing in things], boxes, is_shown


def as_boxes(rows: Sequence[npt.ArrayLike]) -> Boxes:
    return np.array(rows, np.float64).reshape(-1, 4)


def evaluation_data(run: Run, found: Sequence[Named]) -> dict[str, object]:
    """What TrackEval takes; what was found at hidden things is left out with them."""
    true_ids: dict[str, int] = {}
    found_ids: dict[str, int] = {}
    per_frame: list[tuple[npt.NDArray[np.intp], npt.NDArray[np.intp], npt.NDArray[np.float64]]] = []
    for (names, boxes), is_shown, (found_names, found_boxes) in zip(
        run.truth, run.is_shown, found, strict=True
    ):
        ious, _ = overlaps(boxes, found_boxes)
        costs = np.where(ious >= MIN_IOU, -ious - is_shown[:, None], np.inf)
        hidden = {column for row, column in assign(costs) if not is_shown[row]}
        kept = [column for column in range(len(found_names)) if column not in hidden]
        shown = np.flatnonzero(is_shown)
        per_frame.append(
            (
                np.array([true_ids.setdefault(names[r], len(true_ids)) for r in shown], int),
                np.array([found_ids.setdefault(found_names[c], len(found_ids)) for c in kept], int),
                ious[np.ix_(shown, np.array(kept, int))],
            )
        )
    return {
        "num_timesteps": len(per_frame),
        "num_gt_ids": len(true_ids),
        "num_tracker_ids": len(found_ids),
        "num_gt_dets": sum(len(ids) for ids, _, _ in per_frame),
        "num_tracker_dets": sum(len(ids) for _, ids, _ in per_frame),
        "gt_ids": [ids for ids, _, _ in per_frame],
        "tracker_ids": [ids for _, ids, _ in per_frame],
        "similarity_scores": [scores for _, _, scores in per_frame],
    }


def position_errors(run: Run, found: Sequence[Named]) -> tuple[Boxes, Boxes]:
    """How far off the middles (N,), px, of wholly shown things are, and how far they then stray.

    The second (M,) is how much that offset changes from one frame to the next: the error of the
    motion, free of where a box is drawn around a thing.
    """
    width, height = run.size_wh
    offsets: list[tuple[int, str, Boxes]] = []
    for index, ((names, boxes), is_whole, (_, found_boxes)) in enumerate(
        zip(run.truth, run.is_whole, found, strict=True)
    ):
        inside = (boxes[:, :2] > EDGE_PX).all(axis=1)
        inside &= (boxes[:, 2:] < np.array([width, height]) - EDGE_PX).all(axis=1)
        ious, _ = overlaps(boxes, found_boxes)
        for row, column in assign(np.where(ious >= MIN_IOU, -ious, np.inf)):
            if is_whole[row] and inside[row]:
                off = (found_boxes[column] - boxes[row]).reshape(2, 2).mean(axis=0)
                offsets.append((index, names[row], off))
    before = {(index + 1, name): off for index, name, off in offsets}
    strayed = [off - before[index, name] for index, name, off in offsets if (index, name) in before]
    return (
        np.hypot(*np.reshape([off for _, _, off in offsets], (-1, 2)).T),
        np.hypot(*np.reshape(strayed, (-1, 2)).T),
    )


def score(run: Run, found: Sequence[Named]) -> dict[str, float]:
    off_px, strayed_px = position_errors(run, found)
    with contextlib.redirect_stdout(io.StringIO()):
        from trackeval.metrics import CLEAR, HOTA, Identity

        data = evaluation_data(run, found)
        clear = CLEAR({"THRESHOLD": MIN_IOU, "PRINT_CONFIG": False}).eval_sequence(data)
        identity = Identity({"THRESHOLD": MIN_IOU, "PRINT_CONFIG": False}).eval_sequence(data)
        hota = HOTA().eval_sequence(data)
    return {
        "MOTA": float(clear["MOTA"]),
        "IDF1": float(identity["IDF1"]),
        "HOTA": float(np.mean(hota["HOTA"])),
        "off_px": float(np.mean(off_px)) if len(off_px) else float("nan"),
        "strayed_px": float(np.mean(strayed_px)) if len(strayed_px) else float("nan"),
        "switches": float(clear["IDSW"]),
        "false": float(clear["CLR_FP"]),
        "missed": float(clear["CLR_FN"]),
        "true": float(data["num_gt_dets"]),  # type: ignore[arg-type]
        "ids": float(data["num_tracker_ids"]),  # type: ignore[arg-type]
        "things": float(data["num_gt_ids"]),  # type: ignore[arg-type]
    }


# -- the other trackers --------------------------------------------------------------------------

Peer = Callable[[Sequence[Boxes], float], list[Named]]


def norfair(detections: Sequence[Boxes], rate_hz: float) -> list[Named]:
    from norfair import Detection, Tracker

    tracker = Tracker(
        distance_function="iou", distance_threshold=0.7, hit_counter_max=round(rate_hz / 2)
    )
    result: list[Named] = []
    for boxes in detections:
        seen = [Detection(points=box.reshape(2, 2)) for box in boxes]
        active = [t for t in tracker.update(detections=seen) if t.live_points.any()]
        now = [t for t in active if t.hit_counter >= t.hit_counter_max - 1]
        result.append(([str(t.id) for t in now], as_boxes([t.estimate.reshape(-1) for t in now])))
    return result


def _by_supervision(tracker: object, update: str, detections: Sequence[Boxes]) -> list[Named]:
    import supervision as sv

    result: list[Named] = []
    for boxes in detections:
        seen = sv.Detections(
            xyxy=boxes.astype(np.float32),
            confidence=np.full(len(boxes), 0.9, np.float32),
            class_id=np.zeros(len(boxes), int),
        )
        now = getattr(tracker, update)(seen)
        ids = np.full(len(now), -1) if now.tracker_id is None else now.tracker_id
        keep = ids >= 0
        result.append(([str(i) for i in ids[keep]], as_boxes(now.xyxy[keep])))
    return result


def supervision_bytetrack(detections: Sequence[Boxes], rate_hz: float) -> list[Named]:
    import supervision as sv

    tracker = sv.ByteTrack(frame_rate=round(rate_hz), minimum_consecutive_frames=3)
    return _by_supervision(tracker, "update_with_detections", detections)


def trackers_sort(detections: Sequence[Boxes], rate_hz: float) -> list[Named]:
    import trackers

    return _by_supervision(trackers.SORTTracker(frame_rate=rate_hz), "update", detections)


def trackers_ocsort(detections: Sequence[Boxes], rate_hz: float) -> list[Named]:
    import trackers

    return _by_supervision(trackers.OCSORTTracker(frame_rate=rate_hz), "update", detections)


def trackers_bytetrack(detections: Sequence[Boxes], rate_hz: float) -> list[Named]:
    import trackers

    return _by_supervision(trackers.ByteTrackTracker(frame_rate=rate_hz), "update", detections)


PEERS: dict[str, Peer] = {
    "norfair": norfair,
    "trackers SORT": trackers_sort,
    "trackers OC-SORT": trackers_ocsort,
    "trackers ByteTrack": trackers_bytetrack,
    "supervision ByteTrack": supervision_bytetrack,
}


# -- the table -----------------------------------------------------------------------------------


def scenes(
    seeds: Sequence[int], frames: int, cars: int, size: str, image: Path | None
) -> Iterator[tuple[str, str, str]]:
    """Name, URI and the camera to assume."""
    for camera in ("fixed", "moving"):
        for bridges in (0, 1):
            for seed in seeds:
                uri = f"synthetic://traffic?seed={seed}&frames={frames}&cars={cars}&fps=25"
                uri += f"&size={size}&camera={camera}&occluders={bridges}"
                uri += "" if image is None else f"&image={image}"
                yield f"{camera}{' bridge' if bridges else ''}", uri, camera


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", default="1-3", help="first-last")
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--cars", type=int, default=20)
    parser.add_argument("--size", default="640x360")
    parser.add_argument("--image", type=Path, help="a photograph as the ground")
    parser.add_argument("--no-peers", action="store_true")
    parser.add_argument("--each", action="store_true", help="a line a scene, too")
    parser.add_argument("--output", type=Path, help="write the table there as well")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    first, _, last = args.seeds.partition("-")
    seeds = range(int(first), int(last or first) + 1)
    rows: dict[tuple[str, str], list[dict[str, float]]] = {}
    costs: dict[str, list[tuple[float, float, int]]] = {}
    for name, uri, camera in scenes(seeds, args.frames, args.cars, args.size, args.image):
        run = run_own(uri, camera)
        costs.setdefault(name, []).append((run.auto_ms, run.camera_ms, run.most_at_once))
        results = {"streamtrack": run.found}
        for peer, follow in {} if args.no_peers else PEERS.items():
            try:
                results[peer] = follow(run.detections, 25.0)
            except ImportError as error:
                print(f"{peer}: left out, {error}")
        for method, found in results.items():
            scored = score(run, found)
            rows.setdefault((name, method), []).append(scored)
            if args.each and method == "streamtrack":
                print(uri, line(method, [scored]), flush=True)
    lines = [
        "| scene | by | MOTA | IDF1 | HOTA | switches | false | missed | off px | strays | ids |"
    ]
    lines.append("|---|---|---|---|---|---|---|---|---|---|---|")
    lines += [f"| {name} {line(method, scored)}" for (name, method), scored in rows.items()]
    for name, cost in costs.items():
        auto, camera_ms, most = (
            max(v) if k == 2 else np.mean(v) for k, v in enumerate(zip(*cost, strict=True))
        )
        lines.append(
            f"\n{name}: {auto:.1f} ms CPU a frame, camera {camera_ms:.1f} ms more; "
            f"at most {most:.0f} things at once"
        )
    text = "\n".join(lines)
    print(text)
    if args.output is not None:
        args.output.write_text(text + "\n", encoding="utf-8")


def line(method: str, scored: Sequence[dict[str, float]]) -> str:
    def mean(key: str) -> float:
        return float(np.mean([one[key] for one in scored]))

    def share(key: str) -> float:
        return sum(one[key] for one in scored) / max(1.0, sum(one["true"] for one in scored))

    return (
        f"| {method} | {mean('MOTA'):.3f} | {mean('IDF1'):.3f} | {mean('HOTA'):.3f} "
        f"| {mean('switches'):.1f} | {share('false'):.1%} | {share('missed'):.1%} "
        f"| {mean('off_px'):.2f} | {mean('strayed_px'):.2f} "
        f"| {mean('ids'):.1f} / {mean('things'):.1f} |"
    )


if __name__ == "__main__":
    main()
