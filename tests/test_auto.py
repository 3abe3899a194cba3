"""Automatic targets on drawn scenes with exact truth: one name a thing, and none for nothing."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from rrd import rrd_columns

from streamtrack import AutoTarget, track
from streamtrack.auto import AutoTargets
from streamtrack.auto.anchor import Anchor, align
from streamtrack.auto.assignment import assign
from streamtrack.auto.background import BackgroundModel
from streamtrack.auto.blobs import Scene
from streamtrack.auto.boxes import overlap
from streamtrack.auto.motion import MotionField
from streamtrack.auto.places import motion_within, reduced
from streamtrack.errors import UsageError
from streamtrack.features import FeatureExtractor
from streamtrack.frame_view import FrameView
from streamtrack.geometry import bounding_box, box_quad, translation
from streamtrack.job import TrackJob, run_track
from streamtrack.progress import NoProgress
from streamtrack.pyramid import Pyramid
from streamtrack.settings import Settings
from streamtrack.sources import open_source
from streamtrack.targets import Target, given_targets, parse_targets
from streamtrack.types import CameraPose, Frame, Image, Track, TrackState
from streamtrack.watching import Outputs

SIZE = (320, 240)
RATE_HZ = 25.0
STANDS = CameraPose(np.eye(3))
Boxes = dict[str, npt.NDArray[np.float64]]


def texture(seed: int, size_wh: tuple[int, int], low: int, high: int) -> Image:
    """A smooth random picture in colour."""
    rng = np.random.default_rng(seed)
    small = rng.uniform(low, high, (size_wh[1] // 6 + 1, size_wh[0] // 6 + 1, 3))
    large = cv2.resize(small, size_wh, interpolation=cv2.INTER_CUBIC)
    return np.asarray(large.clip(0, 255), np.uint8)


class World:
    """A wide background and things on it; ``view_x`` is where the camera looks."""

    def __init__(self) -> None:
        self.ground = texture(1, (900, SIZE[1]), 70, 130)
        self.things: dict[str, Image] = {}

    def add(self, name: str, size_wh: tuple[int, int], low: int = 150, high: int = 250) -> None:
        self.things[name] = texture(10 + len(self.things), size_wh, low, high)

    def frame(
        self,
        index: int,
        places: dict[str, tuple[float, float]],
        view_x: int = 0,
        noise: float = 2.0,
        gain: float = 1.0,
    ) -> tuple[Frame, Boxes]:
        """The frame, and the boxes of the things in it; places are their top-left corners."""
        picture = self.ground.copy()
        boxes: Boxes = {}
        for name, (x, y) in places.items():
            thing = self.things[name]
            moved = np.array([[1, 0, x], [0, 1, y]], np.float64)
            cv2.warpAffine(thing, moved, (900, SIZE[1]), picture, borderMode=cv2.BORDER_TRANSPARENT)
            height, width = thing.shape[:2]
            low = np.array([x - view_x, y]) - 0.5
            boxes[name] = np.array([*low, low[0] + width, low[1] + height])
        shown = picture[:, view_x : view_x + SIZE[0]].astype(np.float64) * gain
        shown += np.random.default_rng(index).normal(0, noise, shown.shape)
        return Frame(index, index / RATE_HZ, shown.clip(0, 255).astype(np.uint8)), boxes


def follow(
    frames: Sequence[Frame],
    poses: Sequence[CameraPose] | None = None,
    auto: AutoTargets | None = None,
) -> list[list[Track]]:
    extractor = FeatureExtractor(Settings().features)
    auto = auto or AutoTargets()
    poses = poses or [STANDS] * len(frames)
    return [
        auto.update(FrameView(frame, extractor), pose, [])
        for frame, pose in zip(frames, poses, strict=True)
    ]


def names_on(
    steps: Sequence[Sequence[Track]], truth: Sequence[Boxes], thing: str
) -> list[str | None]:
    """For each frame the name of the track that lies on a thing (IoU >= 0.5)."""
    result: list[str | None] = []
    for tracks, boxes in zip(steps, truth, strict=True):
        hits = [
            track.name
            for track in tracks
            if track.quad is not None
            and thing in boxes
            and overlap(np.array(bounding_box(track.quad)), boxes[thing])[0] >= 0.5
        ]
        result.append(hits[0] if hits else None)
    return result


def all_names(steps: Sequence[Sequence[Track]]) -> set[str]:
    return {track.name for tracks in steps for track in tracks}


def played(
    path: Callable[[int], dict[str, tuple[float, float]]],
    count: int,
    sizes: dict[str, tuple[int, int]],
    **look: float,
) -> tuple[list[Frame], list[Boxes]]:
    world = World()
    for name, size in sizes.items():
        world.add(name, size)
    made = [world.frame(index, path(index), **look) for index in range(count)]  # type: ignore[arg-type]
    return [frame for frame, _ in made], [boxes for _, boxes in made]


def test_assignment_has_the_least_cost() -> None:
    rng = np.random.default_rng(3)
    for rows, columns in itertools.product(range(1, 5), range(1, 5)):
        costs = rng.uniform(0, 1, (rows, columns))
        found = sum(costs[pair] for pair in assign(costs))
        if rows <= columns:
            ways = itertools.permutations(range(columns), rows)
            least = min(sum(costs[r, c] for r, c in enumerate(way)) for way in ways)
        else:
            ways = itertools.permutations(range(rows), columns)
            least = min(sum(costs[r, c] for c, r in enumerate(way)) for way in ways)
        assert found == pytest.approx(least)


def test_assignment_never_pairs_what_is_forbidden_and_pairs_all_it_can() -> None:
    inf = np.inf
    assert assign(np.array([[inf, inf]])) == []
    assert assign(np.zeros((0, 3))) == []
    assert sorted(assign(np.array([[0.1, 5.0], [0.2, inf]]))) == [(0, 1), (1, 0)]


@pytest.mark.parametrize("camera_step", [0, 3])
def test_one_thing_has_one_name_with_either_camera(camera_step: int) -> None:
    world = World()
    world.add("car", (46, 26))
    frames, truth, poses = [], [], []
    for index in range(60):
        view_x = 100 + camera_step * index
        frame, boxes = world.frame(index, {"car": (150 + 5.0 * index, 90 + 0.5 * index)}, view_x)
        frames.append(frame)
        truth.append(boxes)
        poses.append(CameraPose(translation(view_x - 100, 0)))
    steps = follow(frames, poses)
    names = names_on(steps, truth, "car")
    in_view = [i for i, boxes in enumerate(truth) if boxes["car"][2] < SIZE[0] - 4]
    seen = [names[i] for i in in_view if i >= 10]
    assert all_names(steps) == {"auto-1"}
    assert sum(name == "auto-1" for name in seen) >= 0.95 * len(seen)


def test_what_leaves_ends_and_what_comes_next_has_a_new_name() -> None:
    def path(n: int) -> dict[str, tuple[float, float]]:
        return {"a": (20 + 8.0 * n, 60)} if n < 45 else {"b": (400 - 8.0 * (n - 45), 150)}

    frames, _ = played(path, 110, {"a": (40, 30), "b": (40, 30)})
    steps = follow(frames)
    assert [track.name for track in steps[20]] == ["auto-1"]
    assert steps[46] == [] or all(track.state is TrackState.LOST for track in steps[46])
    assert all_names(steps[60:]) == {"auto-2"}
    assert steps[-1] == []


def test_what_stood_at_the_start_leaves_no_ghost() -> None:
    def path(n: int) -> dict[str, tuple[float, float]]:
        return {"car": (60 + max(0, n - 30) * 4.0, 100)}

    frames, truth = played(path, 85, {"car": (44, 28)})
    steps = follow(frames)
    assert names_on(steps, truth, "car")[60:80].count(None) <= 1
    for tracks in steps[60:]:
        assert len([track for track in tracks if track.quad is not None]) <= 1


def test_what_stops_keeps_its_name_and_goes_on_with_it() -> None:
    def path(n: int) -> dict[str, tuple[float, float]]:
        return {"car": (20 + 4.0 * (min(n, 35) + max(0, n - 75)), 100)}

    frames, truth = played(path, 110, {"car": (44, 28)})
    steps = follow(frames)
    names = names_on(steps, truth, "car")[15:]
    assert all_names(steps) == {"auto-1"}
    assert names.count(None) <= 2


def test_two_that_cross_keep_their_names() -> None:
    def path(n: int) -> dict[str, tuple[float, float]]:
        return {"a": (20 + 4.0 * n, 100), "b": (255 - 4.0 * n, 124)}

    frames, truth = played(path, 60, {"a": (44, 28), "b": (38, 34)})
    steps = follow(frames)
    before_a, before_b = (names_on(steps, truth, name)[14] for name in "ab")
    after_a, after_b = (names_on(steps, truth, name)[48] for name in "ab")
    assert before_a is not None and before_b is not None and before_a != before_b
    assert (after_a, after_b) == (before_a, before_b)


def test_one_that_drives_slowly_over_another_keeps_its_name_and_so_does_the_other() -> None:
    world = World()
    world.add("wide", (70, 30), 150, 250)
    world.things["dark"] = texture(5, (18, 30), 0, 60)

    def path(n: int) -> dict[str, tuple[float, float]]:
        return {"wide": (3.0 * n - 72, 104), "dark": (190 - 0.8 * n, 208 - 1.4 * n)}

    made = [world.frame(index, path(index)) for index in range(105)]
    steps, truth = follow([frame for frame, _ in made]), [boxes for _, boxes in made]
    names = {thing: names_on(steps, truth, thing) for thing in ("wide", "dark")}
    assert names["wide"][40] != names["dark"][20]
    for thing in ("wide", "dark"):
        assert names[thing][40] is not None
        assert names[thing][100] == names[thing][40]


@pytest.mark.parametrize("is_estimated", [False, True])
def test_where_nearly_all_that_is_seen_moves_an_estimated_pose_is_not_believed(
    is_estimated: bool,
) -> None:
    """The things may be the scene then, as surf and a herd are for a camera that goes along."""
    world = World()
    world.ground[:] = 100
    places = list(itertools.product(range(30, 300, 60), range(16, 220, 52)))
    for number in range(len(places)):
        world.add(str(number), (34, 30))

    def at(number: int, n: int) -> tuple[float, float]:
        angle, (x, y) = 2.4 * number, places[number]
        return x - 17 + 0.9 * n * np.cos(angle), y - 15 + 0.9 * n * np.sin(angle)

    frames = [world.frame(n, {str(k): at(k, n) for k in range(len(places))})[0] for n in range(14)]
    poses = [CameraPose(translation(0.01 * n, 0)) if is_estimated else STANDS for n in range(14)]
    assert bool(all_names(follow(frames, poses))) is not is_estimated


def test_what_is_hidden_is_lost_and_found_again_under_its_name() -> None:
    world = World()
    world.add("car", (40, 26))
    frames, truth = [], []
    for index in range(70):
        frame, boxes = world.frame(index, {"car": (10 + 4.0 * index, 110)})
        image = frame.image.copy()
        image[:, 130:190] = world.ground[:, 500:560]  # a wall that stands before it
        frames.append(Frame(index, frame.time_s, image))
        truth.append(boxes)
    steps = follow(frames)
    names = names_on(steps, truth, "car")
    hidden = [i for i, b in enumerate(truth) if b["car"][0] > 130 and b["car"][2] < 190]
    assert hidden and all(t.quad is None for i in hidden for t in steps[i])
    assert names[20] == "auto-1"
    assert names[60] == "auto-1"


def test_what_goes_slowly_under_a_bridge_keeps_its_size_place_and_name() -> None:
    world = World()
    world.add("car", (60, 26))
    frames, truth = [], []
    for index in range(110):
        frame, boxes = world.frame(index, {"car": (10 + 2.0 * index, 110)})
        image = frame.image.copy()
        image[:, 120:150] = world.ground[:, 500:530]  # narrower than the car
        frames.append(Frame(index, frame.time_s, image))
        truth.append(boxes)
    steps = follow(frames)
    names = names_on(steps, truth, "car")
    assert all_names(steps) == {"auto-1"}
    assert names[12:].count(None) <= 2


def test_a_small_thing_beside_a_large_one_is_no_part_of_it() -> None:
    def path(n: int) -> dict[str, tuple[float, float]]:
        return {"large": (20 + 2.5 * n, 100), "small": (120 + 1.0 * n, 180 - 1.8 * n)}

    frames, truth = played(path, 95, {"large": (60, 30), "small": (14, 22)})
    steps = follow(frames)
    names = names_on(steps, truth, "large")
    assert set(names[15:]) <= {names[15], None} and names[15] is not None
    assert names[15:].count(None) <= 4
    assert len(all_names(steps)) == 2


def _static(index: int, rng: np.random.Generator, ground: Image) -> Image:
    return np.asarray((ground + rng.normal(0, 3, ground.shape)).clip(0, 255), np.uint8)


def _noise(index: int, rng: np.random.Generator, ground: Image) -> Image:
    return rng.integers(0, 255, ground.shape).astype(np.uint8)


def _black(index: int, rng: np.random.Generator, ground: Image) -> Image:
    return np.zeros_like(ground)


def _flicker(index: int, rng: np.random.Generator, ground: Image) -> Image:
    gain = (1.0, 0.85, 1.12)[index % 3]
    return np.asarray((ground * gain + rng.normal(0, 2, ground.shape)).clip(0, 255), np.uint8)


def _exposure(index: int, rng: np.random.Generator, ground: Image) -> Image:
    gain = 1.0 if index < 20 else 1.35
    return np.asarray((ground * gain + rng.normal(0, 2, ground.shape)).clip(0, 255), np.uint8)


def _cut(index: int, rng: np.random.Generator, ground: Image) -> Image:
    other = ground if index < 20 else 255 - ground[::-1, ::-1]
    return np.asarray((other + rng.normal(0, 2, ground.shape)).clip(0, 255), np.uint8)


def _lamp(index: int, rng: np.random.Generator, ground: Image) -> Image:
    """A lamp that goes on and off: it changes, but goes nowhere."""
    image = ground.copy()
    if index % 10 < 5:
        cv2.circle(image, (100, 100), 12, (255, 255, 255), -1)
    return np.asarray((image + rng.normal(0, 2, ground.shape)).clip(0, 255), np.uint8)


@pytest.mark.parametrize("look", [_static, _noise, _black, _flicker, _exposure, _cut, _lamp])
def test_nothing_that_moves_is_no_target(
    look: Callable[[int, np.random.Generator, Image], Image],
) -> None:
    rng = np.random.default_rng(7)
    ground = texture(1, SIZE, 70, 130)
    frames = [Frame(i, i / RATE_HZ, look(i, rng, ground)) for i in range(40)]
    assert all_names(follow(frames)) == set()


def test_one_black_frame_changes_nothing_after_it() -> None:
    frames, truth = played(lambda n: {"car": (20 + 4.0 * n, 100)}, 50, {"car": (44, 28)})
    frames[25] = Frame(25, 1.0, np.zeros_like(frames[25].image))
    steps = follow(frames)
    names = names_on(steps, truth, "car")
    assert [track.state for track in steps[25]] == [TrackState.LOST]
    assert "most of the picture" in steps[25][0].reason
    assert names[24] == names[27] == names[-1] == "auto-1"


def test_no_pose_no_claims() -> None:
    frames, _ = played(lambda n: {"car": (20 + 4.0 * n, 100)}, 40, {"car": (44, 28)})
    poses = [STANDS if n != 30 else CameraPose(None, reason="fog") for n in range(40)]
    steps = follow(frames, poses)
    assert [track.state for track in steps[30]] == [TrackState.LOST]


def test_a_scene_after_a_cut_begins_anew() -> None:
    frames, _ = played(lambda n: {"car": (20 + 4.0 * n, 100)}, 40, {"car": (44, 28)})
    rng = np.random.default_rng(4)
    other = 255 - texture(77, SIZE, 10, 200)
    frames += [
        Frame(n, n / RATE_HZ, (other + rng.normal(0, 2, other.shape)).clip(0, 255).astype(np.uint8))
        for n in range(40, 70)
    ]
    steps = follow(frames)
    assert all_names(steps[:40]) == {"auto-1"}
    assert all(track.quad is None for tracks in steps[40:] for track in tracks)
    assert steps[-1] == []


@pytest.mark.parametrize("size", [(8, 8), (20, 600), (1, 1)])
def test_pictures_too_small_to_tell_are_survived(size: tuple[int, int]) -> None:
    frames = [Frame(n, n / RATE_HZ, np.full((*size, 3), 9 * n, np.uint8)) for n in range(4)]
    assert all_names(follow(frames)) == set()


def test_names_are_per_stream_and_leave_out_those_given() -> None:
    frames, _ = played(lambda n: {"car": (20 + 4.0 * n, 100)}, 20, {"car": (44, 28)})
    assert all_names(follow(frames)) == {"auto-1"}
    assert all_names(follow(frames)) == {"auto-1"}
    assert all_names(follow(frames, auto=AutoTargets("car", ["car-1"]))) == {"car-2"}


def test_the_word_auto() -> None:
    specs = parse_targets(["a=1,2,30,40", "auto"])
    assert specs[1] == AutoTarget()
    assert [target.name for target in given_targets(specs)] == ["a"]
    assert parse_targets(["car=auto"]) == [AutoTarget("car")]
    with pytest.raises(UsageError, match="twice"):
        parse_targets(["auto", "x=auto"])


def test_given_targets_are_not_found_again() -> None:
    uri = "synthetic://traffic?seed=4&frames=25&cars=2&size=320x240&fps=25"
    with open_source(uri) as source:
        quad = source.initial_quad  # type: ignore[attr-defined]
        steps = list(track(source, [Target("first", quad), AutoTarget()]))
    for step in steps:
        given = next(t for t in step.tracks if t.name == "first")
        assert not given.is_found
        if given.quad is None:
            continue
        box = np.array(bounding_box(given.quad))
        for found in step.tracks:
            if found.is_found and found.quad is not None:
                assert overlap(np.array(bounding_box(found.quad)), box)[0] < 0.5


def test_a_run_writes_all_outputs(tmp_path: Path) -> None:
    outputs = Outputs(
        record=tmp_path / "run.rrd",
        tracks=tmp_path / "run.txt",
        video=tmp_path / "run.avi",
        summary=tmp_path / "run.json",
    )
    uri = "synthetic://traffic?seed=2&frames=40&cars=6&size=320x240&fps=25"
    outcome = run_track(TrackJob(uri, [AutoTarget()], outputs=outputs), NoProgress(), lambda: False)
    assert outcome.error is None
    summary = json.loads((tmp_path / "run.json").read_text())
    assert summary["automatic_targets"]["count"] == len(summary["targets"]) >= 1
    assert all(target["automatic"] for target in summary["targets"])
    lines = (tmp_path / "run.txt").read_text().splitlines()
    assert len(lines) == sum(target["frames_tracked"] for target in summary["targets"])
    assert (tmp_path / "run.rrd").stat().st_size > 0
    assert (tmp_path / "run.avi").stat().st_size > 0


def test_a_recording_shows_a_found_target_in_one_colour_and_within_the_frame(
    tmp_path: Path,
) -> None:
    path = tmp_path / "run.rrd"
    uri = "synthetic://traffic?seed=2&frames=70&cars=6&size=320x180&fps=25&camera=moving"
    settings = Settings.model_validate({"camera": "moving"})
    outputs = Outputs(record=path, shows_mosaic=True)
    job = TrackJob(uri, [AutoTarget()], settings=settings, outputs=outputs)
    assert run_track(job, NoProgress(), lambda: False).error is None
    frames, outlines = rrd_columns(path, "/mosaic/frame", "LineStrips2D:strips")
    outline = {frame: np.float32(strips[0]) for frame, strips in zip(frames, outlines, strict=True)}
    colors = set()
    for name in ("auto-1", "auto-2"):
        at = f"/mosaic/targets/{name}/position"
        last = dict(zip(*rrd_columns(path, at, "Points2D:positions"), strict=True))
        inside = [cv2.pointPolygonTest(outline[f], p[0], True) for f, p in last.items() if p]
        assert len(inside) > 20 and min(inside) > -1.0
        quad = f"/camera/targets/{name}/quad"
        (there,) = rrd_columns(path, at, "Points2D:colors", None)[1][:1]
        (here,) = rrd_columns(path, quad, "LineStrips2D:colors", None)[1][:1]
        assert here == there
        colors.add(tuple(here))
    assert len(colors) == 2


def test_a_summary_says_that_nothing_moved() -> None:
    uri = "synthetic://static?frames=12&size=320x240"
    outcome = run_track(TrackJob(uri, [AutoTarget()]), NoProgress(), lambda: False)
    assert outcome.error is None
    rows = dict(outcome.summary.rows())
    assert rows["Automatic targets"].startswith("none")


def test_boxes_overlap() -> None:
    one = np.array(bounding_box(box_quad(0, 0, 10, 10)))
    assert overlap(one, one + np.array([5, 0, 5, 0])) == pytest.approx((50 / 150, 0.5))


@pytest.mark.parametrize("side", [-60.0, 330.0])
def test_no_motion_is_read_beside_the_picture(side: float) -> None:
    solid = np.ones((SIZE[1], SIZE[0]), np.bool_)
    motion = np.ones((SIZE[1], SIZE[0], 2), np.float32)
    scene = Scene((), solid, motion, np.zeros((SIZE[1], SIZE[0], 3), np.uint8), np.eye(3))
    box = np.array([side, 100.0, side + 40, 140.0])
    assert motion_within(scene, box) is None
    assert motion_within(scene, np.array([100.0, 100.0, 140.0, 140.0])) is not None


def test_the_ground_between_two_that_drive_side_by_side_rests_and_they_move() -> None:
    def path(index: int) -> dict[str, tuple[float, float]]:
        return {"near": (20 + 4.0 * index, 90), "far": (20 + 4.0 * index, 124)}

    frames, truth = played(path, 10, {"near": (50, 24), "far": (50, 24)})
    extractor, field = FeatureExtractor(Settings().features), MotionField()
    background: BackgroundModel | None = None
    for frame in frames:
        small, small_from_frame = reduced(FrameView(frame, extractor))
        if background is None:
            background = BackgroundModel((small.shape[1], small.shape[0]), np.eye(3))
        seen = background.compare(small, np.eye(3), small_from_frame, ())
        motion = field.measure(seen)
        background.learn(seen, motion.moving, np.zeros(seen.clear.shape, np.bool_))
    x0, y0, x1, y1 = (truth[-1]["near"] + 0.5).astype(int)
    assert motion.changing[y0 + 2 : y1 - 2, x0 + 2 : x1 - 2].mean() > 0.9
    gap = slice(y1 + 3, y1 + 7), slice(x0 + 4, x1 - 4)
    assert motion.rests[gap].mean() > 0.7
    assert motion.changing[gap].mean() < 0.1


def test_anchors_are_aligned_to_a_part_of_a_pixel() -> None:
    world = World()
    thing = texture(20, (80, 40), 150, 250)
    box = np.array([99.5, 79.5, 179.5, 119.5])
    solid = np.ones((SIZE[1], SIZE[0]), np.bool_)
    pictures = []
    for x in (100.0, 102.3):
        picture = world.ground[:, : SIZE[0]].copy()
        moved = np.array([[1, 0, x], [0, 1, 80.0]])
        cv2.warpAffine(thing, moved, SIZE, picture, borderMode=cv2.BORDER_TRANSPARENT)
        pictures.append(picture)
    scene = Scene((), solid, None, pictures[0], np.eye(3))
    first, second = (Pyramid(cv2.cvtColor(p, cv2.COLOR_BGR2GRAY)) for p in pictures)
    anchor = Anchor.taken(first, box, scene)
    assert anchor is not None
    middle = np.array([complex(139.5, 99.5)])
    found = align(second, [anchor], middle, np.ones(1, np.complex128))
    assert found.is_near[0] and found.correlations[0] > 0.9
    assert abs(found.centers[0] - (middle[0] + 2.3)) < 0.1
    blank = Pyramid(np.full((SIZE[1], SIZE[0]), 128, np.uint8))
    assert align(blank, [anchor], middle, np.ones(1, np.complex128)).correlations[0] < 0.5
