"""The video held still: what is shown against what a still camera would have seen."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import cv2
import numpy as np
import pytest
from conftest import MakePicture

from streamtrack import geometry
from streamtrack.settings import StabilizeSettings
from streamtrack.stabilizing import Shown, SmoothView, Stabilizer, WorldView, make_stabilizer
from streamtrack.types import CameraPose, Frame, Image, Matrix, Step

SIZE = (320, 240)
HZ = 25.0


def step(n: int, image: Image, pose: Matrix | None) -> Step:
    reason = "" if pose is not None else "lost"
    return Step(Frame(n, n / HZ, image), (), CameraPose(pose, reason=reason), None, {})


def shaken(rng: np.random.Generator, count: int, pan_px: float = 0.0) -> list[Matrix]:
    """world_from_frame of a hand-held camera, that of frame 0 first."""
    poses = [np.eye(3)]
    for n in range(1, count):
        x, y = rng.normal(0, 3, 2)
        c, s = np.cos(a := rng.normal(0, 0.004)), np.sin(a)
        poses.append(np.array([[c, -s, x + pan_px * n], [s, c, y], [0, 0, 1]]))
    return poses


def seen(wide: Image, pose: Matrix) -> Image:
    """What a camera sees whose frame 0 shows the wide picture from (100, 100) on."""
    wide_from_frame = geometry.translation(100, 100) @ pose
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpPerspective(wide, wide_from_frame, SIZE, flags=flags), np.uint8)


def run(view: Stabilizer, steps: Sequence[Step]) -> list[Shown]:
    shown = [one for given in steps for one in view.add(given)]
    return [*shown, *view.finish()]


def clip(make_picture: MakePicture, poses: Sequence[Matrix]) -> list[Step]:
    wide = make_picture(41, (1200, 440))
    return [step(n, seen(wide, pose), pose) for n, pose in enumerate(poses)]


def residual_px(shown: Sequence[Shown]) -> list[float]:
    """How far consecutive pictures are apart, by phase correlation of their middles."""
    middles = [one.image[40:200, 40:280].astype(np.float32) for one in shown]
    window = cv2.createHanningWindow((240, 160), cv2.CV_32F)
    pairs = itertools.pairwise(middles)
    return [float(np.hypot(*cv2.phaseCorrelate(a, b, window)[0])) for a, b in pairs]


@pytest.mark.parametrize("path", ["smooth", "world"])
def test_every_frame_is_shown_once_at_its_time(
    path: str, rng: np.random.Generator, make_picture: MakePicture
) -> None:
    steps = clip(make_picture, shaken(rng, 40))
    view = make_stabilizer(StabilizeSettings(path=path))
    assert [one.time_s for one in run(view, steps)] == [n / HZ for n in range(40)]
    assert view.unplaced == 0


def test_the_world_view_stands(rng: np.random.Generator, make_picture: MakePicture) -> None:
    steps = clip(make_picture, shaken(rng, 15))
    shown = run(WorldView(), steps)
    for one in shown:
        inner = one.image[30:-30, 30:-30, 0].astype(float), steps[0].frame.image[30:-30, 30:-30]
        assert np.abs(inner[0] - inner[1]).mean() < 5.0


@pytest.mark.parametrize("pan_px", [0.0, 4.0])
def test_a_smooth_view_shakes_less_and_shows_no_edge(
    pan_px: float, rng: np.random.Generator, make_picture: MakePicture
) -> None:
    steps = clip(make_picture, shaken(rng, 60, pan_px))
    before = [Shown(one.frame.image, 0.0) for one in steps]
    shown = run(SmoothView(0.8), steps)
    steadiness = [np.std(residual_px(some[25:45])) for some in (before, shown)]
    assert steadiness[1] < 0.3 * steadiness[0]
    ones = [step(n, np.full((240, 320), 200, np.uint8), one.camera.world_from_frame)
            for n, one in enumerate(steps)]  # fmt: skip
    for one in run(SmoothView(0.8), ones):
        assert one.image.min() == 200


@pytest.mark.parametrize("make", [WorldView, lambda: SmoothView(0.4)])
@pytest.mark.parametrize("which", [[0], [5], [0, 1, 2, 3], list(range(20))])
def test_frames_without_a_pose_are_counted_and_shown(
    make: object, which: list[int], rng: np.random.Generator, make_picture: MakePicture
) -> None:
    steps = clip(make_picture, shaken(rng, 20))
    gone = [step(n, one.frame.image, None) if n in which else one for n, one in enumerate(steps)]
    view = make()
    shown = run(view, gone)
    assert len(shown) == 20 and view.unplaced == len(which)
    if isinstance(view, WorldView):
        assert all(shown[n].image.max() < 100 for n in which)  # dark: nothing is known now


def test_what_leaves_the_world_view_is_counted(make_picture: MakePicture) -> None:
    poses = [geometry.translation(60.0 * n, 0) for n in range(8)]
    view = WorldView()
    run(view, clip(make_picture, poses))
    assert view.unplaced == 2  # at 360 and 420 px


def test_pictures_of_another_size_and_poses_beyond_belief_end_nothing(
    rng: np.random.Generator, make_picture: MakePicture
) -> None:
    folded = np.array([[1, 0, 0], [0, 1, 0], [-0.01, 0, 1.0]])
    small = step(3, np.zeros((50, 60, 3), np.uint8), None)
    odd = step(4, np.zeros((240, 320, 3), np.uint8), folded)
    steps = [*clip(make_picture, shaken(rng, 3)), small, odd]
    for view in (WorldView(), SmoothView(0.5)):
        assert len(run(view, steps)) == 5


def test_the_frames_held_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("streamtrack.stabilizing._MOST_HELD_MB", 1.0)
    view = SmoothView(10.0)
    image = np.zeros((240, 320), np.uint8)
    held = 0
    for n in range(60):
        held += 1 - len(list(view.add(step(n, image, np.eye(3)))))
        assert held * image.nbytes <= 1.1e6
