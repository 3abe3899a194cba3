"""How clean mosaics are of things that move, nobody having named them: share of pixels off.

    scripts/bench_clean.py [SCENE...] [--frames 300] [--seed 1] [--ground PHOTO] [--save FOLDER]

Scenes: those of bench_world.py without their targets, and

    halts         a camera that goes to and fro; cars come, stand for half of the clip, go on
    halts-tripod  the same before a camera that stands
    parked        as halts-tripod, but the cars stand for two thirds of the clip: are they ground?
    road          synthetic://traffic, a camera that goes along
    road-tripod   synthetic://traffic, a camera that stands

A pixel is off if it differs from the true ground by more than 20 grey levels, both averaged over
3 x 3 pixels, and by more than the ground itself varies within a pixel; the mosaic is
laid on the ground by its own poses, whose mean error is printed. What stands throughout counts
neither way. ``--auto`` has moving things found and left out as targets.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import bench_world
import cv2
import numpy as np
from bench_world import SIZE, Board, Rendered, Scene, make_scene

from streamtrack import geometry
from streamtrack.camera.auto import make_camera
from streamtrack.evaluation import corner_error
from streamtrack.mosaic.stream.growing import StreamMosaic
from streamtrack.pipeline import track
from streamtrack.settings import build_settings
from streamtrack.sources.scenes import roadside
from streamtrack.sources.scenes.rendering import Ground
from streamtrack.sources.synthetic import SyntheticSource
from streamtrack.targets import AutoTarget, TargetSpec
from streamtrack.types import Frame, Image, Mask, Matrix, Size

OFF_LEVELS = 20
OWN = ("halts", "halts-tripod", "parked", "road", "road-tripod")
SCENES = (*bench_world.SCENES, *OWN)


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """Frames, and what the ground truly looks like in any other picture of the world.

    ``ground`` renders it for (picture_from_world, size); ``standing`` (same) is True where things
    stand all the time. ``world_from_frame`` is exact.
    """

    frames: Sequence[Frame]
    ground: Callable[[Matrix, Size], Image]
    standing: Callable[[Matrix, Size], Mask]
    world_from_frame: Callable[[float], Matrix]


@dataclass(frozen=True, slots=True)
class Clean:
    """A mosaic against the true ground: shares of its pixels, and how far off its poses are."""

    off: float
    error: Image
    picture: Image
    camera_px: float
    tracking_ms: float
    mosaic_ms: float


def world_case(scene: Scene, frames: Sequence[Frame]) -> Case:
    """A scene of bench_world.py."""
    world_from_ground = geometry.inverted(scene.ground_from_frame(0))

    def ground(picture_from_world: Matrix, size_wh: Size) -> Image:
        matrix = picture_from_world @ world_from_ground
        warped = cv2.warpPerspective(scene.ground, matrix, size_wh, flags=cv2.INTER_CUBIC)
        return np.asarray(warped, np.uint8)

    def standing(picture_from_world: Matrix, size_wh: Size) -> Mask:
        found = np.zeros(size_wh[::-1], np.uint8)
        for board in scene.boards:
            if board.stands:
                quad = geometry.transform_points(picture_from_world, scene.world_quad(board, 0))
                cv2.fillConvexPoly(found, np.rint(quad).astype(np.int32), 1)
        return np.asarray(cv2.dilate(found, np.ones((9, 9))) > 0)

    return Case(frames, ground, standing, scene.world_from_frame)


def halting(name: str, frames: int, seed: int, photo: Image | None) -> Scene:
    """Cars that stand for half of the clip, or two thirds of it, each in another part of it."""
    stays = 2 * frames // 3 if name == "parked" else frames // 2
    moves = name == "halts"
    scene = make_scene("sweep" if moves else "tripod", frames, seed, photo)
    scene.boards = []
    for k in range(5):
        rng = np.random.default_rng((seed, k))
        car = cv2.resize(roadside.paint_car(rng), (150, 68), interpolation=cv2.INTER_AREA)
        weight = car[..., 3:].astype(np.float32) / 255
        plain = np.rint(car[..., :3] / np.maximum(weight, 1 / 255)).clip(0, 255)
        picture = np.dstack([plain.astype(np.uint8), car[..., 3]])
        begin = round(k * (frames - stays) / 4)
        offset = (k - 2) * 60.0 + (300.0 if moves else 0.0), (k - 2) * 80.0
        scene.boards.append(Board(f"car{k}", picture, offset, False, halt=(begin, begin + stays)))
    return scene


def road_case(name: str, frames: int, seed: int, photo: Path | None) -> Case:
    """Cars that stop and go on a road."""
    camera = "moving" if name == "road" else "fixed"
    uri = f"synthetic://traffic?seed={seed}&frames={frames}&camera={camera}&cars=16"
    source = SyntheticSource(uri if photo is None else f"{uri}&image={photo}")
    scene = source.scene
    view = scene.frame_from_ground
    backdrop = scene.backdrop()
    assert isinstance(backdrop, Ground) and view is not None
    first = view(0.0)

    def ground(picture_from_world: Matrix, size_wh: Size) -> Image:
        # A ground without end is laid out as far as the picture goes.
        picture_from_ground = picture_from_world @ first
        corners = geometry.image_quad(size_wh)
        x0, _, x1, _ = geometry.bounding_box(
            geometry.transform_points(geometry.inverted(picture_from_ground), corners)
        )
        left, right = math.floor(x0) - 2, math.ceil(x1) + 2
        wide = backdrop.picture[:, np.arange(left, right) % backdrop.period]
        matrix = picture_from_ground @ geometry.translation(left, 0)
        return np.asarray(cv2.warpPerspective(wide, matrix, size_wh), np.uint8)

    def nothing(_: Matrix, size_wh: Size) -> Mask:
        return np.zeros(size_wh[::-1], np.bool_)

    return Case([source.frame(n) for n in range(frames)], ground, nothing, scene.world_from_frame)


def measure(case: Case, targets: Sequence[TargetSpec], camera_mode: str) -> Clean:
    """Run over the frames, write the mosaic, hold it against the ground."""
    settings = build_settings({"camera": camera_mode})
    camera = make_camera(settings)
    placed: list[int] = []
    began = time.process_time()
    mosaic_s = 0.0
    with (
        StreamMosaic(settings.mosaic, camera.graph) as mosaic,
        tempfile.TemporaryDirectory() as tmp,
    ):
        source = Rendered(case.frames)
        for step in track(source, targets, settings, camera=camera):  # type: ignore[arg-type]
            start = time.process_time()
            if not mosaic.add(step.frame, step.camera, step.tracks):
                placed.append(step.frame.index)
            mosaic_s += time.process_time() - start
        camera.close()
        spent_s = time.process_time() - began
        path = Path(tmp) / "mosaic.png"
        exported = mosaic.finish(path)
        picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert exported is not None and picture is not None
    graph = camera.graph
    errors = [
        corner_error(pose, case.world_from_frame(n), SIZE)
        for n in placed
        if (pose := np.eye(3) if graph is None else graph.world_from_frame(n)) is not None
    ]
    if graph is not None:
        graph.close()
    off, error = off_share(np.asarray(picture, np.uint8), exported.picture_from_world, case)
    count = len(case.frames)
    return Clean(
        off,
        error,
        np.asarray(picture, np.uint8),
        float(np.mean(errors)),
        (spent_s - mosaic_s) * 1e3 / count,
        mosaic_s * 1e3 / count,
    )


def off_share(picture: Image, picture_from_world: Matrix, case: Case) -> tuple[float, Image]:
    """Share of the pixels shown that are off, and by how much each is (H, W)."""
    size_wh = picture.shape[1], picture.shape[0]
    truth = cv2.blur(case.ground(picture_from_world, size_wh), (3, 3))
    shown = cv2.blur(np.ascontiguousarray(picture[..., :3]), (3, 3))
    box = np.ones((3, 3), np.uint8)
    beyond = cv2.max(
        cv2.subtract(shown, cv2.dilate(truth, box)), cv2.subtract(cv2.erode(truth, box), shown)
    )
    error = np.asarray(beyond.max(axis=2), np.uint8)
    counts = cv2.erode((picture[..., 3] > 0).astype(np.uint8), np.ones((5, 5))) > 0
    counts &= ~case.standing(picture_from_world, size_wh)
    error[~counts] = 0
    return float(np.count_nonzero(error > OFF_LEVELS) / max(1, np.count_nonzero(counts))), error


def make_case(
    name: str, frames: int, seed: int, photo: Path | None
) -> tuple[Case, list[TargetSpec]]:
    """The scene of a name, and its things as targets."""
    if name.startswith("road"):
        return road_case(name, frames, seed, photo), []
    image = None if photo is None else cv2.imread(str(photo))
    if name in OWN:
        scene = halting(name, frames, seed, image)
    else:
        scene = make_scene(name, frames, seed, image)
    return world_case(scene, [scene.frame(n) for n in range(frames)]), []


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("scenes", nargs="*", default=SCENES, metavar="SCENE")
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--ground", type=Path, help="photograph instead of painted ground")
    parser.add_argument("--camera", default="auto", choices=("fixed", "moving", "auto"))
    parser.add_argument("--auto", action="store_true", help="with --target auto")
    parser.add_argument("--save", type=Path, help="folder for mosaics and what is off in them")
    given = parser.parse_args()
    if not set(given.scenes) <= set(SCENES):
        parser.error(f"scenes are {', '.join(SCENES)}")
    cv2.setNumThreads(1)
    for name in given.scenes:
        case, _ = make_case(name, given.frames, given.seed, given.ground)
        targets: list[TargetSpec] = [AutoTarget()] if given.auto else []
        found = measure(case, targets, given.camera)
        print(
            f"{name:12s} off {found.off:6.2%} of {found.picture.shape[1]}x{found.picture.shape[0]}"
            f", camera {found.camera_px:5.2f} px, mosaic {found.mosaic_ms:5.2f} of "
            f"{found.mosaic_ms + found.tracking_ms:5.2f} ms CPU a frame",
            flush=True,
        )
        if given.save is not None:
            given.save.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(given.save / f"{name}.png"), found.picture)
            cv2.imwrite(
                str(given.save / f"{name}.off.png"), cv2.convertScaleAbs(found.error, alpha=4)
            )


if __name__ == "__main__":
    main()
