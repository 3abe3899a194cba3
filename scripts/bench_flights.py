"""Closed flights over photographs with exact truth: corner error and CPU time of camera motion.

    scripts/bench_flights.py PHOTO... [--scale 2] [--size 480x360] [--step 13.5] [--frames 300]

Several photographs are laid side by side in rows. A virtual camera flies a rounded rectangle over
them and comes back to its start, with rotation of 6 degrees and zoom of 8 per cent either way,
slight perspective, noise of sigma 2 and gain of 8 per cent either way. Whole laps are flown, one at
least, so that the true step may differ from --step; it is printed. Errors are mean distances
of a frame's four corners from the truth, in pixels of the first frame, which is the world; nothing
is aligned afterwards.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the program does; before numpy

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.camera.auto import make_camera
from streamtrack.evaluation import corner_error
from streamtrack.features import FeatureExtractor
from streamtrack.frame_view import FrameView
from streamtrack.settings import build_settings
from streamtrack.types import Frame, Image, Matrix, Size

_ROLL_DEG = 6.0
_ZOOM = 0.08
_BEND = 0.006  # change of magnification from the middle to the longer side's end
_NOISE = 2.0
_GAIN = 0.08


@dataclass(frozen=True, slots=True)
class Flight:
    """A photograph and a closed course over it of ``frames`` pictures, ``step_px`` apart."""

    photo: Image
    size_wh: Size
    step_px: float
    frames: int
    seed: int

    def photo_from_frame(self, index: int) -> Matrix:
        """The exact pose of a frame."""
        rng = np.random.default_rng(self.seed)
        phases = rng.uniform(0, 2 * math.pi, 8)
        turn = 2 * math.pi * index / self.frames

        def wave(which: int, laps: int) -> float:
            return math.sin(laps * turn + phases[which])

        width, height = self.size_wh
        x, y = self._place(index * self.true_step_px)
        angle = math.radians(_ROLL_DEG) * 0.5 * (wave(0, 3) + wave(1, 5))
        scale = 1 + _ZOOM * 0.5 * (wave(2, 2) + wave(3, 7))
        c, s = scale * math.cos(angle), scale * math.sin(angle)
        bend = np.eye(3)
        bend[2, :2] = _BEND * wave(4, 4), _BEND * wave(5, 6)
        unit = np.array(
            [[2 / width, 0, -(width - 1) / width], [0, 2 / width, -(height - 1) / width], [0, 0, 1]]
        )
        half = width / 2
        turned = np.array([[c * half, -s * half, x], [s * half, c * half, y], [0, 0, 1]])
        return geometry.normalized(turned @ bend @ unit)

    @property
    def _course(self) -> tuple[float, tuple[float, float], float]:
        """Margin, straight parts along both sides and radius of the corners."""
        height, width = self.photo.shape[:2]
        margin = 0.5 * math.hypot(*self.size_wh) * (1 + _ZOOM) * 1.03
        w, h = width - 2 * margin, height - 2 * margin
        radius = 0.35 * min(w, h)
        return margin, (w - 2 * radius, h - 2 * radius), radius

    @property
    def _lap_px(self) -> float:
        _, straights, radius = self._course
        return 2 * sum(straights) + 2 * math.pi * radius

    @property
    def true_step_px(self) -> float:
        """The step with which whole laps are flown, one at least."""
        laps = max(1, round(self.frames * self.step_px / self._lap_px))
        return laps * self._lap_px / self.frames

    def _place(self, run: float) -> tuple[float, float]:
        """The middle of the view after ``run`` px on a rectangle with rounded corners."""
        margin, (straight_w, straight_h), radius = self._course
        arc = 0.5 * math.pi * radius
        run %= self._lap_px
        x, y, heading = margin + radius, margin, 0.0
        for length in (straight_w, straight_h, straight_w, straight_h):
            part = min(run, length)
            x, y = x + part * math.cos(heading), y + part * math.sin(heading)
            run -= part
            bent = min(max(run, 0.0), arc) / radius
            x += radius * (math.sin(heading + bent) - math.sin(heading))
            y -= radius * (math.cos(heading + bent) - math.cos(heading))
            heading += bent
            run -= arc
            if run <= 0:
                break
        return x, y

    def frame(self, index: int) -> Frame:
        """The rendered picture."""
        rng = np.random.default_rng((self.seed, index))
        seen = cv2.warpPerspective(
            self.photo,
            self.photo_from_frame(index),
            self.size_wh,
            flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
        ).astype(np.float32)
        gain = 1 + _GAIN * math.sin(2 * math.pi * index / 90)
        noise = rng.standard_normal(seen.shape, np.float32) * np.float32(_NOISE)
        image = np.clip(seen * np.float32(gain) + noise, 0, 255).astype(np.uint8)
        return Frame(index, index / 30, image)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a flight gave: errors (n,) of each frame when it came, and with the last poses.

    ``stream_ms`` is the CPU time (n,) of the stream's own thread, ``cpu_ms`` that of the whole
    process a frame, loop closure on the second core included.
    """

    live_px: npt.NDArray[np.float64]
    final_px: npt.NDArray[np.float64]
    stream_ms: npt.NDArray[np.float64]
    cpu_ms: float
    reasons: dict[str, int]
    keyframes: int
    loops: int


def fly(flight: Flight, camera_mode: str = "moving") -> Outcome:
    """Every frame through the camera; the rendering of the frames is not timed."""
    settings = build_settings({"camera": camera_mode})
    extractor, camera = FeatureExtractor(settings.features), make_camera(settings)
    first = geometry.inverted(flight.photo_from_frame(0))
    live, final, stream_ms, reasons = [], [], [], dict[str, int]()
    process_began, rendering_s = time.process_time(), 0.0
    for index in range(flight.frames):
        began = time.thread_time()
        frame = flight.frame(index)
        rendered = time.thread_time()
        pose = camera.update(FrameView(frame, extractor), ())
        rendering_s += rendered - began
        stream_ms.append((time.thread_time() - rendered) * 1e3)
        truth = geometry.normalized(first @ flight.photo_from_frame(frame.index))
        live.append(_error(pose.world_from_frame, truth, flight.size_wh))
        if pose.world_from_frame is None:
            reasons[pose.reason] = reasons.get(pose.reason, 0) + 1
    graph = getattr(camera, "graph", None)
    if graph is not None:
        camera.close()
    spent_s = time.process_time() - process_began - rendering_s
    for index in range(flight.frames):
        truth = geometry.normalized(first @ flight.photo_from_frame(index))
        pose = None if graph is None else graph.world_from_frame(index)
        final.append(_error(pose, truth, flight.size_wh) if graph else live[index])
    return Outcome(
        np.array(live),
        np.array(final),
        np.array(stream_ms),
        spent_s * 1e3 / flight.frames,
        reasons,
        len(graph.keyframes) if graph else 0,
        sum(edge.is_loop for edge in graph.edges) if graph else 0,
    )


def _error(pose: Matrix | None, truth: Matrix, size_wh: Size) -> float:
    return math.nan if pose is None else corner_error(pose, truth, size_wh)


def _side_by_side(photos: list[Image]) -> Image:
    """One ground of all pictures, in rows of about the square root of their number."""
    height, width = photos[0].shape[:2]
    columns = max(1, round(math.sqrt(len(photos) * height / width)))
    rows = []
    for start in range(0, len(photos) - columns + 1, columns):
        rows.append(np.hstack([cv2.resize(p, (width, height)) for p in photos[start:][:columns]]))
    return np.vstack(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("photos", type=Path, nargs="+", metavar="PHOTO")
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--step", type=float, default=27.0)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--save", type=Path, help="write the errors and times as .npz")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    photos = [cv2.imread(str(path)) for path in arguments.photos]
    for path, picture in zip(arguments.photos, photos, strict=True):
        if picture is None:
            parser.error(f"{path} cannot be read as a picture")
    photo = _side_by_side([np.asarray(picture, np.uint8) for picture in photos])
    if arguments.scale != 1.0:
        photo = cv2.resize(
            photo, None, fx=arguments.scale, fy=arguments.scale, interpolation=cv2.INTER_CUBIC
        )
    width, height = (int(side) for side in arguments.size.split("x"))
    if min(photo.shape[:2]) < 1.3 * math.hypot(width, height):
        parser.error(f"a ground of {photo.shape[1]}x{photo.shape[0]} is too small: raise --scale")
    flight = Flight(
        np.asarray(photo, np.uint8),
        (width, height),
        arguments.step,
        arguments.frames,
        arguments.seed,
    )
    outcome = fly(flight)
    print(f"step : {flight.true_step_px:.1f} px a frame")
    for name, errors in (("live", outcome.live_px), ("final", outcome.final_px)):
        known = errors[np.isfinite(errors)]
        end = errors[-1]
        print(
            f"{name:5}: mean {known.mean():.2f}  max {known.max():.2f}  end {end:.2f} px, "
            f"{len(known)} of {len(errors)} frames placed"
        )
    stream_ms = outcome.stream_ms
    print(
        f"CPU  : {outcome.cpu_ms:.2f} ms a frame in all; of the stream's thread median "
        f"{np.median(stream_ms):.2f}  p95 {np.percentile(stream_ms, 95):.2f}  "
        f"max {stream_ms.max():.2f} ms"
    )
    print(f"graph: {outcome.keyframes} keyframes, {outcome.loops} loop links")
    for reason, count in outcome.reasons.items():
        print(f"refused: {count} x {reason}")
    if arguments.save is not None:
        np.savez(arguments.save, live=outcome.live_px, final=outcome.final_px, ms=stream_ms)


if __name__ == "__main__":
    main()
