"""The video held still: what is shown against what a still camera would have seen."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from conftest import MakePicture

from streamtrack import geometry
from streamtrack.settings import StabilizeSettings
from streamtrack.stabilizing import Shown, SmoothView, Stabilizer, WorldView, make_stabilizer
from streamtrack.types import CameraPose, Frame, Image, Matrix, Step

SIZE = (320, 240)
HZ = 25.0
CORNERS = geometry.image_quad(SIZE).astype(np.float64)
Doubles = npt.NDArray[np.float64]


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


def views_of(shown: Sequence[Shown]) -> Doubles:
    """What was shown of each frame, (N, 4, 2) in its pixels."""
    return np.array(
        [
            geometry.transform_points(geometry.inverted(one.shown_from_frame), CORNERS)
            for one in shown
        ],
        np.float64,
    )


def shakes_px(poses: Sequence[Matrix], views: Doubles, times: Doubles) -> Doubles:
    """How much the motion (px a frame at 25 Hz) of what is shown changes, (N - 2,)."""
    quads = np.array([geometry.transform_points(p, v) for p, v in zip(poses, views, strict=True)])
    change = np.diff(np.diff(quads, axis=0) / np.diff(times)[:, None, None], axis=0) / HZ
    return np.asarray(np.sqrt(np.square(change).sum(axis=2).mean(axis=1)), np.float64)


def smoothly(poses: Sequence[Matrix | None], times: Doubles, reach_s: float = 0.8) -> Doubles:
    image = np.zeros((SIZE[1], SIZE[0]), np.uint8)
    steps = [
        replace(step(0, image, pose), frame=Frame(n, float(time), image))
        for n, (pose, time) in enumerate(zip(poses, times, strict=True))
    ]
    return views_of(run(SmoothView(reach_s), steps))


@pytest.mark.parametrize("shake_px", [2.0, 8.0])
@pytest.mark.parametrize("way", ["rest", "pan", "start and stop", "zoom", "turn", "uneven times"])
def test_a_smooth_path_has_no_jerk_and_stays_in_the_frames(
    shake_px: float, way: str, rng: np.random.Generator
) -> None:
    count = 120
    apart = rng.choice([0.02, 0.04, 0.08], count) if way == "uneven times" else np.full(count, 0.04)
    times = np.cumsum(apart)
    pan = {"pan": 3 * np.arange(count), "uneven times": 60 * times}
    pan["start and stop"] = np.clip(6 * (np.arange(count) - 30), 0, 300)
    x, y, angle = (np.convolve(rng.normal(size=count + 4), np.ones(5), "valid") for _ in range(3))
    poses = []
    for n in range(count):
        turned = angle[n] * shake_px * 5e-4 + (0.004 * n if way == "turn" else 0)
        c, s = (1 - 0.003 * n * (way == "zoom")) * np.array([np.cos(turned), np.sin(turned)])
        shaken = x[n] * shake_px / 2.2, y[n] * shake_px / 2.2
        middle = geometry.translation(-159.5, -119.5)
        moved = geometry.translation(shaken[0] + pan.get(way, np.zeros(count))[n], shaken[1])
        poses.append(moved @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ middle)
    views = smoothly(poses, times)
    assert views.min() > -0.01 and (views < np.array(SIZE) - 0.99).all()
    before = shakes_px(poses, np.broadcast_to(CORNERS, views.shape), times)
    after = shakes_px(poses, views, times)
    assert np.sqrt(np.mean(after**2)) < 0.12 * np.sqrt(np.mean(before**2))
    assert after.max() < 0.25 * before.max()


def test_a_path_does_not_lag_behind_a_pan() -> None:
    times = np.arange(60) / HZ
    views = smoothly([geometry.translation(7.0 * n, 0) for n in range(60)], times)
    assert np.abs(views - views[0]).max() < 0.01  # from the first frame to the last
    assert np.abs(views[0].mean(axis=0) - np.array([159.5, 119.5])).max() < 0.01


def test_in_a_gap_pictures_go_on_as_they_were_moved(rng: np.random.Generator) -> None:
    poses: list[Matrix | None] = [*shaken(rng, 100)]
    lost = [30, 31, 32, *range(50, 100)]
    views = smoothly([None if n in lost else poses[n] for n in range(100)], np.arange(100) / HZ)
    for n, share in ((30, 0.25), (31, 0.5), (32, 0.75)):
        np.testing.assert_allclose(views[n], (1 - share) * views[29] + share * views[33], atol=0.02)
    own = views[-1]  # longer than the reach ago: the frame's middle
    np.testing.assert_allclose(own, CORNERS * 0.88 + 0.06 * CORNERS[2], atol=0.02)
    left = np.abs(views[49:72] - own).max(axis=(1, 2))
    assert left[0] > 1.0 and (np.diff(left) < 0.01).all() and left[20] < 0.02


def test_a_cut_is_no_motion(rng: np.random.Generator) -> None:
    times = np.arange(60) / HZ
    poses = shaken(rng, 60)
    there = [geometry.translation(900, 300) @ pose for pose in poses]
    views = smoothly([*poses[:30], *there[30:]], times)
    np.testing.assert_allclose(views[:30], smoothly(poses[:30], times[:30]), atol=0.01)
    np.testing.assert_allclose(views[30:], smoothly(there[30:], times[30:]), atol=0.01)


def test_poses_that_change_later_bring_no_jump(rng: np.random.Generator) -> None:
    """A loop that closes moves all poses by something smooth, between two pictures."""
    poses = shaken(rng, 60, pan_px=2.0)

    class Graph:
        moved = np.eye(3)

        def world_from_frame(self, index: int) -> Matrix:
            return self.moved @ poses[index]

    graph = Graph()
    view = SmoothView(0.8, graph)
    image = np.zeros((SIZE[1], SIZE[0]), np.uint8)
    shown = []
    for n, pose in enumerate(poses):
        if n == 40:
            graph.moved = geometry.translation(40, -25) @ np.diag([1.1, 1.1, 1.0])
        shown += view.add(step(n, image, pose))
    shown += view.finish()
    np.testing.assert_allclose(views_of(shown), smoothly(poses, np.arange(60) / HZ), atol=0.02)


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
