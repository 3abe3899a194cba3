"""Global adjustment against graphs of pictures whose true poses are known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from streamtrack import geometry
from streamtrack.evaluation import corner_error
from streamtrack.fitting import fit
from streamtrack.mosaic import normal_equations
from streamtrack.mosaic.adjustment import adjust
from streamtrack.mosaic.types import Link
from streamtrack.types import Matches, Matrix, Model, Points, Registration, Size, Verdict

SIZE = (640, 480)
NO_MATCHES = Matches(np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros(0, np.float32))
MakeTruth = Callable[[int, np.random.Generator], Matrix]


@dataclass(frozen=True)
class Graph:
    """True poses, rough poses along the chain of pictures, and links with noise."""

    truth: dict[int, Matrix]
    start: dict[int, Matrix]
    links: list[Link]

    @property
    def sizes(self) -> dict[int, Size]:
        return dict.fromkeys(self.truth, SIZE)

    def errors(self, poses: dict[int, Matrix]) -> list[float]:
        return [corner_error(pose, self.truth[i], SIZE) for i, pose in poses.items()]


def link(a: int, b: int, b_from_a: Matrix, rng: np.random.Generator, noise_px: float) -> Link:
    """Up to 60 pairs where picture a, mapped by ``b_from_a``, lies inside picture b."""
    points = rng.uniform((0, 0), SIZE, (400, 2)).astype(np.float32)
    partners = geometry.transform_points(b_from_a, points)
    inside = np.all((partners >= 0) & (partners < SIZE), axis=1)
    points, partners = points[inside][:60], partners[inside][:60]
    partners = (partners + rng.normal(0, noise_px, partners.shape)).astype(np.float32)
    return linked(a, b, points, partners, b_from_a)


def linked(a: int, b: int, points: Points, partners: Points, b_from_a: Matrix) -> Link:
    every = np.ones(len(points), np.bool_)
    registration = Registration(Verdict.OK, b_from_a, Model.HOMOGRAPHY, every, 0.1)
    return Link(a, b, points, partners, registration, NO_MATCHES)


def flight(
    count: int = 24,
    bend: float = 0.0,
    shear: float = 0.0,
    noise_px: float = 0.1,
    start_px: float = 3.0,
) -> Graph:
    """A camera that flies two lanes and comes back, its rough poses drifting."""
    rng = np.random.default_rng(5)
    unit = np.array([[1 / 320, 0, -1], [0, 1 / 320, -0.75], [0, 0, 1]])
    truth: dict[int, Matrix] = {}
    for i in range(count):
        lane, step = divmod(i, count // 2)
        x = 150.0 * (step if lane == 0 else count // 2 - 1 - step)
        angle, scale = np.deg2rad(6 * np.sin(i / 3)), 1 + 0.08 * np.cos(i / 4)
        c, s = scale * np.cos(angle), scale * np.sin(angle)
        pose = np.array([[c, -s, x], [s, c, 250.0 * lane], [0, 0, 1]])
        change = np.eye(3)
        change[2, :2] = rng.normal(0, bend, 2)
        change[0, :2] += rng.normal(0, shear, 2)
        centred = geometry.translation(-320, -240)
        truth[i] = pose @ centred @ geometry.inverted(unit) @ change @ unit
    first = geometry.inverted(truth[0])
    truth = {i: geometry.normalized(first @ pose) for i, pose in truth.items()}
    centres = {i: geometry.transform_points(pose, [[320, 240]])[0] for i, pose in truth.items()}
    links = []
    for a in truth:
        for b in range(a + 1, count):
            if b - a <= 2 or np.linalg.norm(centres[a] - centres[b]) < 300:
                links.append(link(a, b, between(truth, a, b), rng, noise_px))
    start = {0: np.eye(3)}
    for i in range(1, count):
        drifted = between(truth, i, i - 1)
        drifted[:2, 2] += rng.normal(0, start_px, 2)
        start[i] = geometry.normalized(start[i - 1] @ drifted)
    return Graph(truth, start, links)


def between(truth: dict[int, Matrix], a: int, b: int) -> Matrix:
    """b_from_a."""
    return geometry.normalized(geometry.inverted(truth[b]) @ truth[a])


@pytest.mark.parametrize(
    ("bend", "shear", "model", "limit_px"),
    [
        (0.0, 0.0, Model.SIMILARITY, 0.1),
        (0.0, 0.01, Model.AFFINE, 0.3),
        (0.01, 0.01, Model.HOMOGRAPHY, 1.0),
    ],
)
def test_the_poses_and_their_model_are_found(
    bend: float, shear: float, model: Model, limit_px: float
) -> None:
    graph = flight(bend=bend, shear=shear)
    assert max(graph.errors(graph.start)) > 8
    found = adjust(graph.start, graph.links, graph.sizes, 0)
    assert found.model is model
    assert max(graph.errors(found.world_from_picture)) < limit_px
    assert found.rmse_px == pytest.approx(0.1 * np.sqrt(2), rel=0.15)
    assert found.is_used.all() and found.rejected == ()
    np.testing.assert_allclose(found.world_from_picture[0], np.eye(3), atol=1e-9)


def test_without_noise_the_poses_are_exact() -> None:
    graph = flight(bend=0.01, noise_px=0.0)
    found = adjust(graph.start, graph.links, graph.sizes, 0)
    assert max(graph.errors(found.world_from_picture)) < 0.1
    assert found.rmse_px < 0.01


def straight(count: int, tilt: float, seed: int = 3) -> Graph:
    """A camera that flies straight on and tilts slowly; links and rough poses as measured."""
    rng = np.random.default_rng(seed)
    unit = np.array([[1 / 320, 0, -1], [0, 1 / 320, -0.75], [0, 0, 1]])
    truth, links, start = {}, [], {0: np.eye(3)}
    for i in range(count):
        change = np.eye(3)
        change[2, :2] = tilt * np.sin(i / 9), tilt * np.cos(i / 13)
        tilted = geometry.inverted(unit) @ change @ unit
        truth[i] = geometry.translation(200.0 * i, 0) @ geometry.translation(-320, -240) @ tilted
    first = geometry.inverted(truth[0])
    truth = {i: geometry.normalized(first @ pose) for i, pose in truth.items()}
    for b in range(count):
        for a in range(b + 1, min(b + 3, count)):
            one = link(a, b, between(truth, a, b), rng, 0.1)
            own = fit(Model.HOMOGRAPHY, one.a_points, one.b_points)
            links.append(linked(a, b, one.a_points, one.b_points, own))
            if a == b + 1:
                start[a] = geometry.normalized(start[b] @ own)
    return Graph(truth, start, links)


def bent_px(graph: Graph) -> tuple[float, float]:
    """The largest error of the adjusted poses, and of the rough ones."""
    found = adjust(graph.start, graph.links, graph.sizes, 0, Model.HOMOGRAPHY, is_near=True)
    return max(graph.errors(found.world_from_picture)), max(graph.errors(graph.start))


def test_a_long_way_is_not_bent_for_the_mean_of_slow_tilts() -> None:
    found_px, rough_px = bent_px(straight(80, 0.01))
    assert found_px < rough_px / 2


def test_what_tilts_show_of_the_world_is_used_on_short_ways() -> None:
    found_px, rough_px = np.mean([bent_px(straight(20, 0.01, seed)) for seed in range(8)], axis=0)
    assert found_px < 0.6 * rough_px


def from_above(x: float, tilt_deg: float, roll_deg: float, focal_px: float) -> Matrix:
    """world_from_picture of a real camera over a plane, aimed at (x, 0) and tilted."""
    tilt, roll = np.deg2rad((tilt_deg, roll_deg))
    nod = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    lean = np.array([[np.cos(roll), 0, np.sin(roll)], [0, 1, 0], [-np.sin(roll), 0, np.cos(roll)]])
    turn = nod @ lean
    lens = np.array([[focal_px, 0, 320], [0, focal_px, 240], [0, 0, 1]])
    picture_from_plane = lens @ np.column_stack([turn[:, :2], turn[:, 2] * focal_px])
    pose = geometry.inverted(picture_from_plane)
    aim = geometry.transform_points(pose, [[320, 240]])[0]
    return geometry.translation(x - aim[0], -aim[1]) @ pose


def tilted_way(mean_deg: float, swing_deg: float, focal_px: float, seed: int) -> Graph:
    """A chain of links along a way of 8000 px, the rough poses its product."""
    rng = np.random.default_rng(seed)
    poses = []
    for i in range(40):
        nod, lean = mean_deg + swing_deg * np.sin(i / 7), swing_deg * np.cos(i / 5)
        poses.append(from_above(200.0 * i, nod, lean, focal_px))
    first = geometry.inverted(poses[0])
    truth = {i: geometry.normalized(first @ pose) for i, pose in enumerate(poses)}
    start, links = {0: np.eye(3)}, []
    for i in range(1, len(truth)):
        one = link(i, i - 1, between(truth, i, i - 1), rng, 0.03)
        own = fit(Model.HOMOGRAPHY, one.a_points, one.b_points)
        links.append(linked(i, i - 1, one.a_points, one.b_points, own))
        start[i] = geometry.normalized(start[i - 1] @ own)
    return Graph(truth, start, links)


@pytest.mark.parametrize(
    ("mean_deg", "swing_deg", "focal_px"), [(0, 1, 704.0), (0, 4, 704.0), (20, 3, 900.0)]
)
def test_tilted_pictures_tell_where_level_is(
    mean_deg: float, swing_deg: float, focal_px: float
) -> None:
    """The errors of a chain add up; what each picture shows of the plane's tilt does not."""
    before, after = [], []
    for seed in range(4):
        graph = tilted_way(mean_deg, swing_deg, focal_px, seed)
        start, links = graph.start, graph.links
        found = adjust(start, links, graph.sizes, 0, Model.HOMOGRAPHY, is_near=True)
        before += graph.errors(start)
        after += graph.errors(found.world_from_picture)
    assert np.mean(after) < 0.75 * np.mean(before)


def test_errors_are_about_as_large_as_expected() -> None:
    ratios = []
    for seed in range(6):
        graph = tilted_way(0, 1, 704.0, seed)
        found = adjust(graph.start, graph.links, graph.sizes, 0, Model.HOMOGRAPHY, is_near=True)
        expected = found.expected_errors_px(noise_px=0.03)
        assert expected[0] == pytest.approx(0, abs=1e-3)
        assert expected[39] > 2 * expected[20] > 0
        errors = graph.errors(found.world_from_picture)
        ratios += [errors[i] / expected[i] for i in (10, 20, 30, 39)]
    assert 0.3 < np.sqrt(np.mean(np.square(ratios))) < 2.0


def test_a_closed_loop_is_expected_to_be_right_at_its_end() -> None:
    graph = flight(bend=0.004)
    found = adjust(graph.start, graph.links, graph.sizes, 0, Model.HOMOGRAPHY)
    expected = found.expected_errors_px(noise_px=0.1)
    lane = [link for link in graph.links if abs(link.a - link.b) == 1]
    chain = adjust(graph.start, lane, graph.sizes, 0, Model.HOMOGRAPHY)
    assert expected[23] < chain.expected_errors_px(noise_px=0.1)[23] / 4


def test_a_homography_does_not_drift_where_a_similarity_would_do() -> None:
    """The gauge that links leave open is held by what the poses have in common."""
    graph = flight(count=40)
    found = adjust(graph.start, graph.links, graph.sizes, 0, Model.HOMOGRAPHY)
    assert max(graph.errors(found.world_from_picture)) < 0.2


@pytest.mark.parametrize("wrong", [1, 4])
def test_wrong_links_are_named_and_do_no_harm(wrong: int) -> None:
    graph = flight()
    rng = np.random.default_rng(9)
    bad = []
    for i in range(wrong):
        a, b = 3 + i, 14 + 2 * i
        off = geometry.translation(60 + 10 * i, -45) @ between(graph.truth, a, a + 1)
        bad.append(link(a, b, off, rng, 0.1))
    found = adjust(graph.start, [*bad, *graph.links], graph.sizes, 0)
    assert found.rejected == tuple(range(wrong))
    assert max(graph.errors(found.world_from_picture)) < 0.2
    assert min(found.link_rmse_px[:wrong]) > 10


@pytest.mark.parametrize("anchor", [0, 7, 23])
def test_any_picture_may_be_the_anchor(anchor: int) -> None:
    graph = flight(bend=0.004)
    world = geometry.inverted(graph.truth[anchor])
    truth = {i: geometry.normalized(world @ pose) for i, pose in graph.truth.items()}
    found = adjust(graph.start, graph.links, graph.sizes, anchor)
    # The anchor keeps the pose it was given.
    np.testing.assert_allclose(
        found.world_from_picture[anchor], graph.start[anchor], rtol=1e-6, atol=1e-6
    )
    back = geometry.inverted(graph.start[anchor])
    errors = [
        corner_error(geometry.normalized(back @ pose), truth[i], SIZE)
        for i, pose in found.world_from_picture.items()
    ]
    assert max(errors) < 1.5


def test_fixed_pictures_stay_to_the_last_bit() -> None:
    graph = flight()
    fixed = [0, 1, 2, 3, 4, 5]
    start = {**graph.start, **{i: graph.truth[i] for i in fixed}}
    found = adjust(start, graph.links, graph.sizes, 0, Model.SIMILARITY, fixed=fixed)
    for i in fixed:
        np.testing.assert_array_equal(found.world_from_picture[i], graph.truth[i])
    assert max(graph.errors(found.world_from_picture)) < 0.2


def test_a_camera_that_turns_keeps_its_homographies() -> None:
    rng = np.random.default_rng(4)
    camera = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    truth = {}
    for i in range(9):
        yaw, pitch = np.deg2rad(7 * (i % 5) * (1 if i < 5 else -1)), np.deg2rad(4 * (i // 5))
        turn = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
        nod = np.array(
            [[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]]
        )
        truth[i] = geometry.normalized(camera @ turn @ nod @ geometry.inverted(camera))
    links = [
        link(a, b, between(truth, a, b), rng, 0.1)
        for a in truth
        for b in truth
        if a < b and corner_error(truth[a], truth[b], SIZE) < 260
    ]
    start = {}
    for i, pose in truth.items():
        start[i] = geometry.translation(*(rng.normal(0, 2, 2) * (i > 0))) @ pose
    sizes = dict.fromkeys(truth, SIZE)
    found = adjust(start, links, sizes, 0)
    assert found.model is Model.HOMOGRAPHY
    errors = [corner_error(found.world_from_picture[i], truth[i], SIZE) for i in truth]
    assert max(errors) < 1.5


def test_pictures_without_a_link_have_no_pose() -> None:
    graph = flight(count=8)
    alone = {**graph.start, 50: np.eye(3), 51: np.eye(3)}
    refused = replace(
        graph.links[0],
        a=50,
        b=0,
        registration=replace(graph.links[0].registration, b_from_a=None),
    )
    island = replace(graph.links[0], a=50, b=51)
    sizes = dict.fromkeys(alone, SIZE)
    found = adjust(alone, [*graph.links, refused, island], sizes, 0)
    assert set(found.world_from_picture) == set(graph.truth)
    assert not found.is_used[-2:].any()
    assert np.isnan(found.link_rmse_px[-2:]).all()


@pytest.mark.parametrize("model", ["auto", *Model])
def test_one_picture_and_no_links_are_no_trouble(model: Model) -> None:
    found = adjust({3: np.eye(3)}, [], {3: SIZE}, 3, model)
    np.testing.assert_array_equal(found.world_from_picture[3], np.eye(3))
    assert np.isnan(found.rmse_px)


def test_pairs_on_one_line_leave_finite_poses() -> None:
    line = np.stack([np.linspace(20, 600, 40), np.full(40, 200.0)], axis=1).astype(np.float32)
    shifted = line - np.float32([30, 5])
    links = [linked(0, 1, line, shifted, geometry.translation(-30, -5))]
    found = adjust({0: np.eye(3), 1: np.eye(3)}, links, {0: SIZE, 1: SIZE}, 0)
    seen = geometry.transform_points(found.world_from_picture[1], shifted)
    np.testing.assert_allclose(seen, line, atol=0.05)


def test_sparse_and_dense_equations_have_one_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = flight(count=40, bend=0.004)
    monkeypatch.setattr(normal_equations, "_DENSE_UNKNOWNS", 10**9)
    dense = adjust(graph.start, graph.links, graph.sizes, 0, Model.HOMOGRAPHY)
    monkeypatch.setattr(normal_equations, "_DENSE_UNKNOWNS", 0)
    sparse = adjust(graph.start, graph.links, graph.sizes, 0, Model.HOMOGRAPHY)
    for i, pose in dense.world_from_picture.items():
        assert corner_error(sparse.world_from_picture[i], pose, SIZE) < 1e-3


def test_two_runs_are_equal() -> None:
    graph = flight(count=12, bend=0.004)
    one = adjust(graph.start, graph.links, graph.sizes, 0)
    other = adjust(graph.start, graph.links, graph.sizes, 0)
    for i, pose in one.world_from_picture.items():
        np.testing.assert_array_equal(pose, other.world_from_picture[i])


@pytest.mark.parametrize(
    ("anchor", "sizes", "message"),
    [(9, {0: SIZE, 1: SIZE}, "anchor 9"), (0, {0: SIZE}, "picture 1 has no size")],
)
def test_bad_input_is_refused(anchor: int, sizes: dict[int, Size], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        adjust({0: np.eye(3), 1: np.eye(3)}, [], sizes, anchor)
