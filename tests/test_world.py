"""Targets in the world: places, paths and speeds against known motion, and units on the ground."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from conftest import FrameList, MakeHomography, MakePicture

from streamtrack import geometry
from streamtrack.camera.keyframes import KeyframeGraph
from streamtrack.errors import UsageError
from streamtrack.fitting import fit
from streamtrack.ground import Ground, fit_ground, make_ground, parse_ground
from streamtrack.pipeline import track
from streamtrack.results import GROUND_COLUMNS, TRACK_COLUMNS, open_tracks_writer
from streamtrack.settings import build_settings
from streamtrack.targets import Target
from streamtrack.types import (
    CameraPose,
    Evidence,
    Frame,
    Image,
    Matrix,
    Model,
    Step,
    Track,
    TrackState,
)
from streamtrack.world import WorldMotion, crossing

IMAGE = np.zeros((8, 8, 3), np.uint8)
HZ = 25.0


def frame(index: int) -> Frame:
    return Frame(index, index / HZ, IMAGE)


def seen(quad: np.ndarray, name: str = "car") -> Track:
    return Track(name, TrackState.TRACKING, np.asarray(quad, np.float32), np.eye(3))


def box_at(x: float, y: float) -> np.ndarray:
    return geometry.box_quad(x - 20, y - 10, 40, 20)


def placed_all(
    world: WorldMotion, index: int, tracks: Sequence[Track], pose: CameraPose
) -> tuple[Track, ...]:
    return world.placed(Step(frame(index), tuple(tracks), pose, None, {})).tracks


def placed(world: WorldMotion, index: int, quad: np.ndarray, pose: Matrix) -> Track:
    return placed_all(world, index, [seen(quad)], CameraPose(pose))[0]


def test_the_crossing_is_the_same_point_however_a_quad_is_seen(
    rng: np.random.Generator, random_homography: MakeHomography
) -> None:
    quad = geometry.box_quad(100, 80, 200, 120)
    for _ in range(20):
        mapping = random_homography(rng, (400, 300))
        seen_quad = geometry.transform_points(mapping, quad)
        expected = geometry.transform_points(mapping, [[200, 140]])[0]
        np.testing.assert_allclose(crossing(seen_quad), expected, atol=1e-2)


def test_speed_is_that_of_the_object_and_not_of_the_camera(rng: np.random.Generator) -> None:
    """The camera pans at 20 px a frame; one thing stands, one goes; both are seen with noise."""
    world = WorldMotion()
    stands, goes = None, None
    for n in range(60):
        pose = geometry.translation(20.0 * n, 0)
        noise = rng.normal(0, 0.3, (2, 4, 2))
        quads = [box_at(300 - 20.0 * n, 50) + noise[0], box_at(200 - 17.0 * n, 90) + noise[1]]
        tracks = (seen(quads[0], "stands"), seen(quads[1], "goes"))
        stands, goes = placed_all(world, n, tracks, CameraPose(pose))
        assert stands.world is not None and goes.world is not None
        np.testing.assert_allclose(stands.world.position, [300, 50], atol=1.0)
        if n < 2:
            assert stands.world.speed_px_s is None
        if n > 10:
            assert stands.world.speed_px_s < 0.2 * HZ
            assert goes.world.speed_px_s == pytest.approx(3 * HZ, abs=0.2 * HZ)
    assert goes.world.velocity_px_s[0] > 0
    np.testing.assert_allclose(goes.world.path[[0, -1], 0], [200, 200 + 3 * 59], atol=1.0)
    assert len(goes.world.path) == 60


def test_what_is_not_known_is_none() -> None:
    world = WorldMotion()
    quad = box_at(50, 50)
    for pose in (CameraPose(None, reason="lost"), CameraPose(np.eye(3), warning="moved")):
        assert placed_all(world, 0, (seen(quad),), pose)[0].world is None
    lost = Track("car", TrackState.LOST, reason="gone")
    assert placed_all(world, 1, (lost,), CameraPose(np.eye(3)))[0].world is None
    horizon = np.array([[1, 0, 0], [0, 1, 0], [0, -1 / 50, 1.0]])
    assert placed(world, 2, quad, horizon).world is None


def test_a_path_as_it_was_then_does_not_grow_later() -> None:
    world = WorldMotion()
    steps = [placed(world, n, box_at(2.0 * n, 0), np.eye(3)).world for n in range(10)]
    assert [len(one.path) for one in steps] == list(range(1, 11))


def test_a_long_path_is_thinned_and_keeps_its_ends() -> None:
    world = WorldMotion()
    last = None
    for n in range(10_000):
        last = placed(world, n, box_at(n, 0), np.eye(3)).world
    assert len(last.path) <= 4096
    np.testing.assert_allclose(last.path[[0, -1], 0], [0, 9999])
    assert np.all(np.diff(last.path[:, 0]) > 0)
    assert last.speed_px_s == pytest.approx(HZ)


def test_paths_move_with_the_keyframes_and_speeds_do_not_jump() -> None:
    """A loop closes: everything since keyframe 0 is found to lie 30 px further right."""
    graph = KeyframeGraph()
    graph.add_keyframe(0, 0.0, IMAGE, np.eye(3))
    world = WorldMotion(graph)
    for n in range(1, 40):
        pose = geometry.translation(5.0 * n, 0)
        if n == 30:
            graph.move({0: geometry.translation(30, 0)})
        graph.add_frame(n, 0, pose)
        track_there = placed(world, n, box_at(100, 0), graph.world_from_frame(n))
        assert track_there.world is not None
        if n > 5:
            assert track_there.world.speed_px_s == pytest.approx(5 * HZ, abs=1e-3)
    np.testing.assert_allclose(track_there.world.path[0], [135, 0], atol=1e-3)
    graph.close()


def test_units_come_from_a_scale() -> None:
    world = WorldMotion(None, make_ground(build_settings({"world": {"px_per_unit": 4}}).world))
    for n in range(10):
        found = placed(world, n, box_at(10.0 * n, 40), np.eye(3)).world
    assert found.ground is not None
    np.testing.assert_allclose(found.ground.position, [22.5, 10])
    assert found.ground.speed_units_s == pytest.approx(10 / 4 * HZ)


@pytest.mark.parametrize("count", [4, 9])
@pytest.mark.parametrize("offset", [0.0, 4.5e6])
def test_units_come_from_known_points(
    count: int, offset: float, rng: np.random.Generator, random_homography: MakeHomography
) -> None:
    """Also in map coordinates, which have more digits than float32 holds."""
    truth = random_homography(rng, (640, 480))
    corners = geometry.image_quad((640, 480)).astype(np.float64)
    pixels = np.vstack([corners, rng.uniform((0, 0), (639, 479), (count - 4, 2))])

    def place(points: np.ndarray) -> np.ndarray:
        mapped = points @ truth[:, :2].T + truth[:, 2]
        return mapped[:, :2] / mapped[:, 2:] / 50 + offset

    ground = fit_ground(pixels, place(pixels))
    inside = rng.uniform((0, 0), (639, 479), (30, 2))
    np.testing.assert_allclose(ground.positions(inside), place(inside), atol=2e-3)
    assert ground.rmse < 1e-2


def test_nothing_is_placed_beyond_the_horizon() -> None:
    """A road seen at a slant: the horizon is at y = 100."""
    ground_from_world = np.array([[1, 0, -320], [0, 0, 500], [0, 0.01, -1.0]])
    pixels = np.array([[100, 400], [500, 400], [400, 200], [200, 200.0]])
    ground = fit_ground(pixels, Ground(ground_from_world).positions(pixels))
    places = ground.positions([[300, 300], [300, 104], [300, 102], [300, 100], [300, 50]])
    assert np.isfinite(places[:2]).all() and np.isnan(places[2:]).all()
    world = WorldMotion(None, ground)
    found = placed(world, 0, box_at(300, 60), np.eye(3)).world
    assert found is not None and found.ground is None


GOOD = ["0,0=0,0", "100,0=10,0", "100,100=10,10", "0,100=0,10"]


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (GOOD[:3], "four known points or more, and 3"),
        (["x,0=0,0", *GOOD], "write x,y=X,Y"),
        (["0,0", *GOOD], "write x,y=X,Y"),
        (["0,0=0", *GOOD], "write x,y=X,Y"),
        (["nan,0=0,0", *GOOD], "finite"),
        (["0,inf=0,0", *GOOD], "finite"),
        ([f"{n},{n}={n},{2 * n % 5}" for n in range(5)], "pixels of the known points"),
        ([f"{n},{n * n}={n},{n}" for n in range(5)], "places of the known points"),
        ([GOOD[0]] * 4, "no three are in a line"),
        ([*GOOD[:3], "50,0=5,0"], "no three are in a line"),
        (["0,0=0,0", "100,0=10,10", "100,100=10,0", "0,100=0,10"], "fits the known points"),
        ([*GOOD, "50,50=9,1"], "fits the known points"),
    ],
)
def test_known_points_that_cannot_be_right_are_refused(points: list[str], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        make_ground(build_settings({"world": {"ground": parse_ground(points)}}).world)


@pytest.mark.parametrize(
    "world",
    [
        {"px_per_unit": 0},
        {"px_per_unit": -1},
        {"px_per_unit": float("nan")},
        {"px_per_unit": float("inf")},
        {"px_per_unit": 2, "ground": [[0, 0, 0, 0]]},
        {"scale": 2},
    ],
)
def test_settings_that_cannot_be_right_are_refused(world: dict[str, object]) -> None:
    with pytest.raises(UsageError):
        build_settings({"world": world})


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda step: pickle.loads(pickle.dumps(step))])
def test_steps_can_be_kept_and_sent_elsewhere(
    copied: Callable[[Step], Step], make_picture: MakePicture
) -> None:
    wide = make_picture(31, (500, 300))
    frames = [Frame(n, n / HZ, np.ascontiguousarray(_view(wide, 4 * n)), "") for n in range(6)]
    settings = build_settings({"camera": "moving"})
    target = Target("poster", geometry.box_quad(180, 60, 110, 90))
    for step in track(FrameList(frames), [target], settings):
        there = copied(step)
        np.testing.assert_array_equal(there.frame.image, step.frame.image)
        assert step.tracks[0].world is not None and there.tracks[0].world is not None
        np.testing.assert_array_equal(there.tracks[0].world.path, step.tracks[0].world.path)
        assert len(there.tracks[0].world.path) == step.frame.index + 1


def test_tables_hold_the_ground_after_the_world(tmp_path: Path) -> None:
    world = WorldMotion(None, Ground(np.diag([0.1, 0.1, 1.0])))
    track_there = [placed(world, n, box_at(10.0 * n, 5), np.eye(3)) for n in range(5)][-1]
    path = tmp_path / "t.csv"
    with open_tracks_writer(path, TRACK_COLUMNS + GROUND_COLUMNS) as writer:
        writer.write(Step(frame(4), (track_there,), CameraPose(np.eye(3)), None, {"total": 1.0}))
    header, row = (line.split(",") for line in path.read_text().splitlines())
    assert header[-5:] == ["speed_px_s", "world_sigma_px", *GROUND_COLUMNS]
    assert row[-5:] == ["250.000", "0.000", "4.0000", "0.5000", "25.0000"]


def test_what_a_world_position_is_worth(rng: np.random.Generator) -> None:
    """The camera's drift and the target's own noise add up, at the scale of the world."""
    x, y = np.meshgrid(np.linspace(0, 39, 6), np.linspace(0, 29, 5))
    there = np.stack([x, y], axis=-1).reshape(-1, 2).astype(np.float32)
    pose, box = geometry.translation(50, 50), geometry.box_quad(0, 0, 39, 29)
    errors, expected = [], []
    for n in range(200):
        pairs = there + np.float32(50) + rng.normal(0, 0.5, there.shape).astype(np.float32)
        found = fit(Model.AFFINE, there, pairs)
        quad = geometry.transform_points(found, box)
        evidence = Evidence(there, pairs, np.ones(len(there), np.bool_))
        one = Track("a", TrackState.TRACKING, quad, found, Model.AFFINE, evidence)
        camera = CameraPose(geometry.scaling(2.0, 2.0), sigma_px=3.0)
        world = placed_all(WorldMotion(), n, (one,), camera)[0].world
        assert world is not None
        off = world.quad - 2 * geometry.transform_points(pose, box)
        errors.append(np.mean(np.sum(off**2, axis=1)) + 3.0**2)
        expected.append(world.sigma_px**2)
    assert np.sqrt(np.mean(expected)) == pytest.approx(np.sqrt(np.mean(errors)), rel=0.1)
    unknown = placed_all(WorldMotion(), 0, (one,), CameraPose(geometry.scaling(2.0, 2.0)))[0]
    assert unknown.world is not None and np.isnan(unknown.world.sigma_px)


def test_a_run_puts_targets_into_the_world(make_picture: MakePicture) -> None:
    """The camera pans over a poster that stands: its world corners stay, its speed is none."""
    wide = make_picture(31, (700, 300))
    frames = [Frame(n, n / HZ, np.ascontiguousarray(_view(wide, 8 * n)), "") for n in range(20)]
    quad = geometry.box_quad(180, 60, 110, 90)
    settings = build_settings({"camera": "moving"})
    for step in track(FrameList(frames), [Target("poster", quad)], settings):
        found = step.tracks[0].world
        assert found is not None
        np.testing.assert_allclose(found.quad, quad, atol=1.0)
        if step.frame.index > 6:
            assert found.speed_px_s < 0.2 * HZ


def _view(wide: Image, x: int) -> Image:
    return wide[20:260, x : x + 320]
