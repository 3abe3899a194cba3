"""Camera and targets in the world on exact scenes: errors in world pixels, speeds, CPU time.

    scripts/bench_world.py [SCENE...] [--frames 300] [--seed 1] [--ground PHOTO] [--further 3]

A camera with a little roll and zoom looks down on ground; textured boards go along with it at
1 to 3 px a frame in the picture, which is the hardest for the camera, as they go together. Scenes:

    sweep   to and fro at 20 px a frame over 600 px, one board that stands and one that goes
    drive   2100 px at 7 px a frame, one board that goes and one that stands
    pan     6000 px straight on at 20 px a frame
    crowd   as drive, boards over 40 % of the view, all of them targets
    strays  as crowd, but none of them is a target
    tripod  the camera stands, two boards go

Errors are mean distances of corners from the truth in pixels of the first frame; nothing is
aligned afterwards. Speeds are errors against the velocity of the true positions over the same
half second. CPU is process time of one thread, pictures rendered before, of tracking, camera and
the growing mosaic together; what a further target costs is measured with as many more targets of
the same place (``--further``).
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.camera.auto import make_camera
from streamtrack.evaluation import corner_error
from streamtrack.mosaic.stream.growing import StreamMosaic
from streamtrack.pipeline import track
from streamtrack.settings import build_settings
from streamtrack.targets import Target
from streamtrack.types import Frame, Image, Matrix, Points, Skipped, SourceInfo, Step
from streamtrack.world import crossing, mean_velocity

SIZE = (640, 480)
RATE_HZ = 25.0
SCENES = ("sweep", "drive", "pan", "crowd", "strays", "tripod")
_MARGIN = 480
_NOISE = 2.0
_WARM_UP = 10
_HALTING_PACE = 9.0


def texture(seed: int, size_wh: tuple[int, int], contrast: float = 14.0) -> Image:
    """Coloured noise of several grains with shapes over it, (H, W, 3)."""
    rng = np.random.default_rng(seed)
    width, height = size_wh
    mixed = np.full((height, width, 3), 120, np.float32) + rng.normal(0, 25, 3).astype(np.float32)
    for grain in (3, 6, 12, 24, 48):
        small = rng.normal(0, contrast, (height // grain + 2, width // grain + 2, 3))
        big = cv2.resize(small.astype(np.float32), None, fx=grain, fy=grain)
        mixed += big[:height, :width]
    picture = np.clip(mixed, 0, 255).astype(np.uint8)
    for _ in range(width * height // 4000):
        centre = tuple(rng.uniform((0, 0), size_wh))
        box = cv2.boxPoints((centre, tuple(rng.uniform(6, 40, 2)), float(rng.uniform(0, 90))))
        color = rng.integers(20, 236, 3).tolist()
        cv2.fillPoly(picture, [np.rint(box).astype(np.int32)], color, cv2.LINE_AA)
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.7), np.uint8)


@dataclass(frozen=True, slots=True)
class Board:
    """A textured rectangle at an offset from the view's middle, or on the ground if it stands.

    With ``halt`` (first and last frame) it comes along the ground at 9 px a frame, stands between
    these at the offset from the first view's middle, and goes on. ``picture`` is BGR, or BGRA.
    """

    name: str
    picture: Image
    offset: tuple[float, float]
    stands: bool
    phase: float = 0.0
    halt: tuple[int, int] | None = None


@dataclass(slots=True)
class Scene:
    """Ground, camera and boards of one scene, with exact poses."""

    name: str
    frames: int
    seed: int
    ground: Image
    boards: list[Board] = field(default_factory=list)

    def run_px(self, n: float) -> float:
        """How far along x the camera has come."""
        if self.name == "tripod":
            return 0.0
        if self.name == "sweep":
            there = (20.0 * n) % 1200.0
            return min(there, 1200.0 - there)
        return {"pan": 20.0}.get(self.name, 7.0) * n

    def ground_from_frame(self, n: float) -> Matrix:
        if self.name == "tripod":
            return geometry.translation(_MARGIN, _MARGIN - 240)
        angle = math.radians(4) * math.sin(n / 31)
        zoom = 1 + 0.06 * math.sin(n / 47)
        c, s = zoom * math.cos(angle), zoom * math.sin(angle)
        x, y = _MARGIN + 320 + self.run_px(n), _MARGIN + 60 * math.sin(n / 40)
        turned = np.array([[c, -s, x], [s, c, y], [0, 0, 1]])
        bend = np.eye(3)
        bend[2, :2] = 4e-5 * math.sin(n / 53), 4e-5 * math.sin(n / 61)
        return turned @ bend @ geometry.translation(-319.5, -239.5)

    def world_from_frame(self, n: float) -> Matrix:
        world_from_ground = geometry.inverted(self.ground_from_frame(0))
        return geometry.normalized(world_from_ground @ self.ground_from_frame(n))

    def ground_from_board(self, board: Board, n: float) -> Matrix:
        height, width = board.picture.shape[:2]
        x, y = board.offset
        if board.halt is not None:
            x += _HALTING_PACE * (min(0.0, n - board.halt[0]) + max(0.0, n - board.halt[1]))
        if board.stands or board.halt is not None:
            place = self.ground_from_frame(0) @ [319.5 + x, 239.5 + y, 1]
            angle = 0.0
        else:
            x += 45 * math.sin(n / 23 + board.phase) - 45 * math.sin(board.phase)
            y += 18 * math.sin(n / 17 + 2 * board.phase) - 18 * math.sin(2 * board.phase)
            place = np.array([_MARGIN + 320 + self.run_px(n) + x, _MARGIN + y, 1.0])
            angle = 0.1 * math.sin(n / 29 + board.phase)
        c, s = math.cos(angle), math.sin(angle)
        turned = np.array([[c, -s, place[0] / place[2]], [s, c, place[1] / place[2]], [0, 0, 1]])
        return turned @ geometry.translation(-(width - 1) / 2, -(height - 1) / 2)

    def frame_from_board(self, board: Board, n: float) -> Matrix:
        ground = self.ground_from_board(board, n)
        return geometry.normalized(geometry.inverted(self.ground_from_frame(n)) @ ground)

    def frame_quad(self, board: Board, n: float) -> Points:
        height, width = board.picture.shape[:2]
        return geometry.transform_points(
            self.frame_from_board(board, n), geometry.image_quad((width, height))
        )

    def world_quad(self, board: Board, n: float) -> Points:
        return geometry.transform_points(self.world_from_frame(n), self.frame_quad(board, n))

    def cover(self, n: int) -> float:
        """Share of the view that the boards that go cover."""
        seen = np.zeros((SIZE[1], SIZE[0]), np.uint8)
        for board in self.boards:
            if not board.stands:
                quad = np.rint(self.frame_quad(board, n)).astype(np.int32)
                cv2.fillConvexPoly(seen, quad, 1)
        return float(seen.mean())

    def frame(self, n: int) -> Frame:
        rng = np.random.default_rng((self.seed, n))
        frame_from_ground = geometry.inverted(self.ground_from_frame(n))
        picture = cv2.warpPerspective(self.ground, frame_from_ground, SIZE, flags=cv2.INTER_CUBIC)
        for board in self.boards:
            matrix = self.frame_from_board(board, n)
            shown = np.ascontiguousarray(board.picture[..., :3])
            warped = cv2.warpPerspective(shown, matrix, SIZE, flags=cv2.INTER_CUBIC)
            full = np.full(board.picture.shape[:2], 255, np.uint8)
            full = full if board.picture.shape[2] == 3 else board.picture[..., 3]
            alpha = cv2.warpPerspective(full, matrix, SIZE)[..., None].astype(np.float32) / 255
            picture = (picture + (warped.astype(np.float32) - picture) * alpha).astype(np.float32)
        noise = rng.standard_normal(picture.shape, np.float32) * np.float32(_NOISE)
        image = np.clip(picture + noise, 0, 255).astype(np.uint8)
        return Frame(n, n / RATE_HZ, image)


def make_scene(name: str, frames: int, seed: int, photo: Image | None) -> Scene:
    length = {"pan": 20 * frames, "sweep": 600, "tripod": 0}.get(name, 7 * frames)
    size = length + 2 * _MARGIN + SIZE[0], 2 * _MARGIN
    ground = texture(seed, size) if photo is None else _tiled(photo, size)
    scene = Scene(name, frames, seed, ground)
    if name in ("crowd", "strays"):
        places = [(-215, -120), (0, -130), (215, -110), (-215, 110), (0, 125), (215, 120)]
        scene.boards = [
            Board(f"board{k}", texture(seed + 10 + k, (155, 132), 25.0), place, False, 0.4 * k)
            for k, place in enumerate(places)
        ]
        return scene
    goes = Board("goes", texture(seed + 10, (120, 90), 25.0), (-60, 40), False)
    second = Board("stands", texture(seed + 11, (110, 90), 25.0), (190, -60), True)
    if name == "sweep":  # always in view
        second = Board("stands", texture(seed + 11, (110, 90), 25.0), (300, -60), True)
    if name == "tripod":
        second = Board("goes2", texture(seed + 11, (110, 90), 25.0), (150, -60), False, 2.0)
    scene.boards = [goes, second]
    return scene


def _tiled(photo: Image, size_wh: tuple[int, int]) -> Image:
    """The photo and its mirror images side by side until they cover the size."""
    width, height = size_wh
    pair = np.concatenate([photo, photo[:, ::-1]], axis=1)
    tile = np.concatenate([pair, pair[::-1]], axis=0)
    times = -(-height // tile.shape[0]), -(-width // tile.shape[1]), 1
    return np.ascontiguousarray(np.tile(tile, times)[:height, :width])


class Rendered:
    """Frames that were rendered before, as a source."""

    def __init__(self, frames: Sequence[Frame]) -> None:
        self._frames = frames
        self.info = SourceInfo("scene", SIZE, RATE_HZ, len(frames))
        self.skipped: Sequence[Skipped] = ()
        self.corrupt_packets = 0
        self.shortfall = ""

    def __iter__(self):
        return iter(self._frames)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one run over one scene gave."""

    steps: list[Step]
    final: dict[int, Matrix | None]
    cpu_ms: npt.NDArray[np.float64]


def run(frames: Sequence[Frame], targets: Sequence[Target], camera_mode: str) -> Outcome:
    """Track, estimate the camera and grow the mosaic, timed."""
    settings = build_settings({"camera": camera_mode})
    camera = make_camera(settings)
    steps, times = [], []
    with StreamMosaic(settings.mosaic, camera.graph) as mosaic:
        began = time.process_time()
        source = Rendered(frames)
        for step in track(source, targets, settings, camera=camera):  # type: ignore[arg-type]
            mosaic.add(step.frame, step.camera, step.tracks)
            now = time.process_time()
            times.append((now - began) * 1e3)
            steps.append(step)
            began = time.process_time()
        camera.close()
    final = {}
    if camera.graph is not None:
        final = {
            step.frame.index: camera.graph.world_from_frame(step.frame.index) for step in steps
        }
        camera.graph.close()
    return Outcome(steps, final, np.array(times))


def report(scene: Scene, frames: Sequence[Frame], camera_mode: str, further: int) -> None:
    targets = [
        Target(board.name, scene.frame_quad(board, 0))
        for board in scene.boards
        if scene.name != "strays"
    ]
    outcome = run(frames, targets, camera_mode)
    camera_px = _camera_errors(scene, outcome)
    known = np.isfinite(camera_px)
    cover = max(scene.cover(n) for n in range(0, scene.frames, 10))
    print(
        f"{scene.name:7s} {camera_mode:6s} cover {cover:4.0%}  camera known {known.mean():6.1%} "
        f"mean {camera_px[known].mean():5.2f} max {camera_px[known].max():5.2f} px"
    )
    for board in scene.boards if targets else []:
        print(f"    {board.name:8s} {_target_line(scene, board, outcome)}")
    print(f"    CPU {_cpu(outcome):5.2f} ms a frame, {len(targets)} targets", end="")
    if further and targets:
        one, more = run(frames, targets[:1], camera_mode), _more(targets[0], further)
        costs = run(frames, more, camera_mode)
        each = (_cpu(costs) - _cpu(one)) / further
        print(f"; one target {_cpu(one):5.2f}, each further {each:5.2f}", end="")
    print(flush=True)


def _more(target: Target, further: int) -> list[Target]:
    """The target, and others of the same place."""
    return [target, *(Target(f"more{k}", target.quad) for k in range(further))]


def _cpu(outcome: Outcome) -> float:
    return float(outcome.cpu_ms[_WARM_UP:].mean())


def _camera_errors(scene: Scene, outcome: Outcome) -> npt.NDArray[np.float64]:
    return np.array(
        [
            np.nan
            if (pose := step.camera.world_from_frame) is None
            else corner_error(pose, scene.world_from_frame(step.frame.index), SIZE)
            for step in outcome.steps
        ]
    )


def _target_line(scene: Scene, board: Board, outcome: Outcome) -> str:
    errors, frame_errors, speeds, ratios = [], [], [], []
    seen = 0
    for step in outcome.steps:
        n = step.frame.index
        found = next(one for one in step.tracks if one.name == board.name)
        quad = scene.frame_quad(board, n)
        seen += geometry.visible_share(quad, SIZE) > 0.6
        if found.quad is not None:
            frame_errors.append(np.linalg.norm(found.quad - quad, axis=1).mean())
        if found.world is None:
            continue
        errors.append(np.linalg.norm(found.world.quad - scene.world_quad(board, n), axis=1).mean())
        ratios.append(errors[-1] / max(found.world.sigma_px, 1e-9))
        if found.world.velocity_px_s is not None:
            true = _true_velocity(scene, board, n)
            speeds.append(np.hypot(*(found.world.velocity_px_s - true)) / RATE_HZ)
    if not errors:
        return "never known"
    return (
        f"known {len(errors)} of {seen} frames in view, world error mean {np.mean(errors):5.2f} "
        f"max {np.max(errors):5.2f} px (in the frame {np.mean(frame_errors):4.2f}), "
        f"of that expected median {np.median(ratios):4.2f} p90 {np.percentile(ratios, 90):4.2f}, "
        f"speed error mean {np.mean(speeds):5.3f} p95 {np.percentile(speeds, 95):5.3f} "
        f"max {np.max(speeds):5.3f} px a frame"
    )


def _true_velocity(scene: Scene, board: Board, n: int) -> npt.NDArray[np.float64]:
    """By the true positions of the half second before, px a second."""
    moments = np.arange(max(0, n - int(0.5 * RATE_HZ)), n + 1)
    places = [crossing(scene.world_quad(board, k)) for k in moments]
    found = mean_velocity(moments / RATE_HZ, np.array(places))
    assert found is not None
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="*", default=SCENES, metavar="SCENE")
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--ground", type=Path, help="photograph instead of painted ground")
    parser.add_argument("--further", type=int, default=0, help="measure so many further targets")
    parser.add_argument("--camera", default="auto", choices=("fixed", "moving", "auto"))
    given = parser.parse_args()
    if not set(given.scenes) <= set(SCENES):
        parser.error(f"scenes are {', '.join(SCENES)}")
    cv2.setNumThreads(1)
    photo = None if given.ground is None else cv2.imread(str(given.ground))
    if given.ground is not None and photo is None:
        parser.error(f"{given.ground} is no picture that can be read")
    for name in given.scenes:
        scene = make_scene(name, given.frames, given.seed, photo)
        frames = [scene.frame(n) for n in range(given.frames)]
        report(scene, frames, given.camera, given.further)


if __name__ == "__main__":
    main()
