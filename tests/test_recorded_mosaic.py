from __future__ import annotations

import math
from dataclasses import replace
from typing import ClassVar

import cv2
import numpy as np
import pytest
from rerun.chunk import RrdReader
from rrd import rrd_columns, rrd_entities
from test_recording import BLOB, SIZE, blob, picture, source, step_of, tracked

from streamtrack.errors import OutputError
from streamtrack.geometry import box_quad, scaling, transform_points, translation
from streamtrack.mosaic.types import (
    Link,
    MosaicView,
    Picture,
    PlacedFrame,
    Placement,
    Status,
)
from streamtrack.pose_graph import KeyframeEdge
from streamtrack.recording import pictures as recorded_pictures
from streamtrack.recording.pictures import record_picture_mosaic
from streamtrack.recording.recorder import Recorder
from streamtrack.settings import Settings, build_settings
from streamtrack.types import (
    CameraPose,
    Features,
    Matches,
    Model,
    Registration,
    Track,
    TrackState,
    Verdict,
)
from streamtrack.world import WorldMotion, crossing

STRIPS = "LineStrips2D:strips"
FRAME = box_quad(0, 0, SIZE[0] - 1, SIZE[1] - 1)


def pose(index):
    return translation(3.0 * index, 5.0)


def keyframes(shift=0.0):
    outlines = [transform_points(pose(index), FRAME) for index in (0, 20)]
    return np.stack(outlines) + np.float32(shift)


def mosaic_view(width=400, shift=0.0, edges=(), names=()):
    """A preview at half size whose top left is the world's (-10, -20)."""
    preview = np.random.default_rng(0).integers(0, 255, (200, width, 3), np.uint8)
    world_from_preview = translation(-10, -20) @ scaling(2.0)
    return MosaicView(preview, world_from_preview, None, keyframes(shift), edges, names)


def framed_from_world():
    """The preview of 400 x 200 fills the 1024 x 576 from side to side."""
    preview_from_world = np.linalg.inv(translation(-10, -20) @ scaling(2.0))
    return translation(0, (576 - 512) / 2) @ scaling(2.56) @ preview_from_world


class Graph:
    """Poses of which all since frame 1 are found to lie ``shift`` px further."""

    keyframes: ClassVar = {}
    edges = ()

    def __init__(self):
        self.revision, self.shift = 0, 0.0

    def keep(self, index: int) -> None:
        return None

    def world_from_frame(self, index):
        return translation(self.shift, self.shift) @ pose(index)

    def keyframe_of(self, index):
        return None

    def sigma_px(self, index):
        return math.nan

    def move(self, shift):
        self.revision += shift != self.shift
        self.shift = shift


def in_world(step, world, is_placed):
    known = CameraPose(pose(step.frame.index)) if is_placed else CameraPose(None, reason="lost")
    return world.placed(replace(step, camera=known))


def log_mosaic(recorder, index, view=None, is_placed=True, world=None):
    step = step_of(index, lost=range(30, 40))
    recorder.log(in_world(step, world or WorldMotion(), is_placed))
    time_s, metrics = index / 25, {"keyframes": 2}
    if is_placed:
        placed = PlacedFrame(index, time_s, SIZE, "placed", pose(index), metrics=metrics)
    else:
        placed = PlacedFrame(index, time_s, SIZE, "lost", reason="too few inliers", metrics=metrics)
    recorder.log_mosaic_frame(placed)
    recorder.log_mosaic(view or mosaic_view(), index, index / 25)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("mosaic") / "run.rrd"
    edges = (
        KeyframeEdge(7, 90, 50, 0.5, False),
        KeyframeEdge(90, 7, 40, 0.6, True),
        KeyframeEdge(7, 8, 40, 0.6, True),  # a keyframe that is not shown
    )
    graph = Graph()
    world = WorldMotion(graph)
    with Recorder(path, source(), Settings(), ["board"], has_mosaic=True) as recorder:
        for index in range(60):
            graph.move(40.0 if index >= 50 else 0.0)
            log_mosaic(
                recorder,
                index,
                mosaic_view(400, graph.shift, edges, (7, 90)),
                is_placed=not 10 <= index < 15,
                world=world,
            )
    return path


def test_entities_of_the_mosaic_are_there(recorded):
    assert {
        "/mosaic/image",
        "/mosaic/frame",
        "/mosaic/keyframes",
        "/mosaic/links",
        "/mosaic/loops",
        "/mosaic/state",
        "/mosaic/targets/board/path",
        "/metrics/mosaic/keyframes",
    } <= set(rrd_entities(recorded))
    assert RrdReader(recorded).blueprints()


def test_the_picture_comes_once_a_second_and_at_the_end(recorded):
    frames, pictures = rrd_columns(recorded, "/mosaic/image", BLOB)
    assert frames == [0, 25, 50, 59]
    assert cv2.imdecode(np.frombuffer(blob(pictures[0]), np.uint8), 1).shape == (576, 1024, 3)


def test_the_frame_lies_where_it_was_placed(recorded):
    frames, outlines = rrd_columns(recorded, "/mosaic/frame", STRIPS)
    outlines = dict(zip(frames, outlines, strict=True))
    assert frames == [*range(1, 11), *range(15, 60)]
    assert outlines[10] == []  # lost: nothing is drawn
    expected = transform_points(framed_from_world() @ pose(30), FRAME)
    np.testing.assert_allclose(outlines[30][0][:4], expected, atol=1e-3)


def test_keyframes_links_and_loops(recorded):
    quads = rrd_columns(recorded, "/mosaic/keyframes", STRIPS)[1][0]
    expected = transform_points(framed_from_world(), keyframes()[1])
    np.testing.assert_allclose(quads[1][:4], expected, atol=1e-3)
    centres = [np.mean(quad[:4], axis=0) for quad in quads]
    (link,) = rrd_columns(recorded, "/mosaic/links", STRIPS)[1][0]
    (loop,) = rrd_columns(recorded, "/mosaic/loops", STRIPS)[1][0]
    np.testing.assert_allclose(link, centres, atol=1e-3)
    np.testing.assert_allclose(loop, centres[::-1], atol=1e-3)


def test_paths_follow_the_targets_and_the_adjusted_keyframes(recorded):
    frames, paths = rrd_columns(recorded, "/mosaic/targets/board/path", STRIPS)
    paths = dict(zip(frames, paths, strict=True))
    seen = [index for index in range(26) if not 10 <= index < 15]
    centres = [
        transform_points(pose(index), crossing(tracked("board", index).quad))[0] for index in seen
    ]
    expected = transform_points(framed_from_world(), centres)
    np.testing.assert_allclose(paths[25][0], expected, atol=0.01)
    moved = np.array(paths[50][0])[: len(expected)]
    np.testing.assert_allclose(moved, expected + 20.0 * 2.56, atol=0.02)  # 40 px at half size
    frames, places = rrd_columns(recorded, "/mosaic/targets/board/position", "Points2D:positions")
    places = dict(zip(frames, places, strict=True))
    np.testing.assert_allclose(places[20][0], expected[seen.index(20)], atol=0.01)
    assert places[30] == []


def test_the_table_of_tracks_says_where_they_are(recorded):
    frames, tables = rrd_columns(recorded, "/tracks", "TextDocument:text")
    tables = dict(zip(frames, (text for (text,) in tables), strict=True))
    assert frames[0] == 0 and 26 in frames
    x, y = transform_points(pose(26), crossing(tracked("board", 26).quad))[0]
    assert f"| board | tracking | {x:.0f}, {y:.0f} |" in tables[26]
    lost = next(tables[frame] for frame in frames if 30 <= frame < 40)
    assert "| board | lost | - | - |" in lost


def test_without_a_mosaic_a_moving_camera_has_its_paths(tmp_path):
    path, world = tmp_path / "paths.rrd", WorldMotion()
    with Recorder(path, source(), build_settings({"camera": "auto"}), ["board"]) as recorder:
        for index in range(40):
            recorder.log(in_world(step_of(index, lost=()), world, index != 20))
    frames, outlines = rrd_columns(path, "/mosaic/frame", STRIPS)
    outlines = dict(zip(frames, outlines, strict=True))
    np.testing.assert_allclose(outlines[30][0][:4], transform_points(pose(30), FRAME), atol=1e-3)
    assert outlines[20] == []
    paths = rrd_columns(path, "/mosaic/targets/board/path", STRIPS)[1]
    assert len(paths[-1][0]) == 39
    assert rrd_columns(path, "/mosaic/image", BLOB)[0] == []


def test_a_fixed_camera_has_its_paths_on_the_background(tmp_path):
    """A bar passes over the ground; it is in no picture of it once it has been elsewhere."""
    path, world = tmp_path / "fixed.rrd", WorldMotion()
    with Recorder(path, source(), Settings(), ["board"]) as recorder:
        for index in range(100):
            step = step_of(index, lost=())
            image = np.full_like(step.frame.image, 90)
            image[:, index : index + 10] = 255
            fixed = CameraPose(np.eye(3))
            frame = replace(step.frame, image=image)
            recorder.log(world.placed(replace(step, frame=frame, camera=fixed)))
    pictures = rrd_columns(path, "/mosaic/image", BLOB)[1]
    assert 2 <= len(pictures) < 8
    shown = cv2.imdecode(np.asarray(pictures[-1][0], np.uint8), cv2.IMREAD_COLOR)
    assert shown[shown.shape[0] // 2].max() < 110
    framed_from_world = translation((1024 - 4 * 160) / 2, (576 - 4 * 120) / 2) @ scaling(4.0)
    (line,) = rrd_columns(path, "/mosaic/targets/board/path", STRIPS)[1][-1]
    expected = transform_points(framed_from_world, crossing(tracked("board", 0).quad))
    np.testing.assert_allclose(line[0], expected[0], atol=1)


def test_states_and_their_reasons(recorded):
    states = rrd_columns(recorded, "/mosaic/state", "StateChange:state")
    assert states == ([0, 10, 15], [["placed"], ["lost"], ["placed"]])
    lines = [line for (line,) in rrd_columns(recorded, "/log", "TextLog:text")[1]]
    assert "frame 10: mosaic lost: too few inliers" in lines


def test_each_file_has_the_mosaic(tmp_path):
    settings = build_settings({"recording": {"video": "jpeg", "rotate": "1s"}})
    with Recorder(tmp_path / "a.rrd", source(), settings, ["board"], has_mosaic=True) as recorder:
        for index in range(50):
            log_mosaic(recorder, index)
    for path in sorted(tmp_path.glob("*.rrd")):
        first = 25 * (int(path.stem[-6:]) - 1)
        assert rrd_columns(path, "/mosaic/image", BLOB)[0][0] == first
        assert rrd_columns(path, "/mosaic/state", "StateChange:state")[0] == [first]
        assert rrd_columns(path, "/mosaic/frame", "LineStrips2D:colors", None)[1]


def test_a_large_mosaic_is_recorded_small(tmp_path):
    path = tmp_path / "large.rrd"
    with Recorder(path, source(), Settings(), [], has_mosaic=True) as recorder:
        for second in range(4):
            recorder.log(step_of(25 * second, ()))
            assert recorder.is_mosaic_due(float(second))
            recorder.log_mosaic(mosaic_view(width=3000), 25 * second, float(second))
            assert not recorder.is_mosaic_due(second + 0.5)
    pictures = [blob(one) for one in rrd_columns(path, "/mosaic/image", BLOB)[1]]
    assert cv2.imdecode(np.frombuffer(pictures[0], np.uint8), 1).shape == (576, 1024, 3)
    assert all(len(data) < 600_000 for data in pictures)


def test_a_growing_picture_keeps_its_size_and_what_is_drawn_its_place(tmp_path):
    """The viewer complains of a picture that changes its size."""
    path = tmp_path / "growing.rrd"
    with Recorder(path, source(), Settings(), [], has_mosaic=True) as recorder:
        for second, (width, height) in enumerate([(90, 40), (300, 500), (3000, 400)]):
            preview = np.full((height, width, 3), 30, np.uint8)
            x0, y0, x1, y1 = width // 4, height // 4, width // 2, height // 2
            preview[y0:y1, x0:x1] = 255
            outline = box_quad(x0 - 0.5, y0 - 0.5, x1 - x0, y1 - y0)
            view = MosaicView(preview, np.eye(3), outline, outline[None], (), ())
            recorder.log(step_of(25 * second, ()))
            recorder.log_mosaic(view, 25 * second, float(second))
    pictures = [blob(one) for one in rrd_columns(path, "/mosaic/image", BLOB)[1]]
    outlines = rrd_columns(path, "/mosaic/frame", STRIPS)[1]
    for data, outline in zip(pictures, outlines, strict=True):
        shown = cv2.imdecode(np.frombuffer(data, np.uint8), 0)
        assert shown.shape == (576, 1024)
        x, y, width, height = cv2.boundingRect((shown > 127).astype(np.uint8))
        expected = box_quad(x - 0.5, y - 0.5, width, height)
        np.testing.assert_allclose(outline[0][:4], expected, atol=1.0)


def test_the_table_of_tracks_never_shows_what_is_over(tmp_path):
    path = tmp_path / "tracks.rrd"
    with Recorder(path, source(), Settings(), []) as recorder:
        for index in range(60):
            tracks = (replace(tracked("a", index), is_found=True),) if 6 <= index < 40 else ()
            if index in (16, 17, 18):
                tracks = (Track("a", TrackState.LOST, reason="hidden", is_found=True),)
            recorder.log(replace(step_of(index, ()), tracks=tracks))
    frames, tables = rrd_columns(path, "/tracks", "TextDocument:text")
    for index in range(60):
        now = [text for frame, (text,) in zip(frames, tables, strict=True) if frame <= index]
        if 23 <= index < 40:
            assert "tracking" in now[-1]
        elif index == 18:
            assert "hidden" in now[-1]
        elif index >= 45:
            assert now[-1] == "no target now\n"


def test_what_is_not_covered_takes_no_room(tmp_path):
    """The canvas is of whole tiles; what there is of a mosaic fills the picture all the same."""
    path = tmp_path / "part.rrd"
    preview = np.zeros((800, 900, 3), np.uint8)
    preview[500:600, 300:700] = 200
    outline = box_quad(299.5, 499.5, 400, 100)
    with Recorder(path, source(), Settings(), [], has_mosaic=True) as recorder:
        recorder.log(step_of(0, ()))
        recorder.log_mosaic(MosaicView(preview, np.eye(3), outline, outline[None], (), ()), 0, 0.0)
    (data,) = rrd_columns(path, "/mosaic/image", BLOB)[1]
    shown = cv2.imdecode(np.frombuffer(blob(data), np.uint8), 0)
    x, y, width, height = cv2.boundingRect((shown > 100).astype(np.uint8))
    assert (width, height) == pytest.approx((1024, 256), abs=2)
    (drawn,) = rrd_columns(path, "/mosaic/frame", STRIPS)[1]
    np.testing.assert_allclose(drawn[0][:4], box_quad(x - 0.5, y - 0.5, width, height), atol=1.0)


def test_a_moving_camera_has_its_paths_over_the_first_frame(tmp_path):
    path, world = tmp_path / "moving.rrd", WorldMotion()
    settings = build_settings({"camera": "moving"})
    with Recorder(path, source(), settings, ["board"]) as recorder:
        for index in range(40):
            step = step_of(index, lost=())
            frame = replace(step.frame, image=np.full_like(step.frame.image, 90 + index))
            camera = CameraPose(translation(3.0 * index, 0))
            recorder.log(world.placed(replace(step, frame=frame, camera=camera)))
    (data,) = rrd_columns(path, "/mosaic/image", BLOB)[1]
    assert np.median(cv2.imdecode(np.asarray(data[0], np.uint8), 0)[200:400, 300:700]) == 90
    outline = rrd_columns(path, "/mosaic/frame", STRIPS)[1][-1]
    np.testing.assert_allclose(outline[0][0][0] - (1024 - 640) / 2, 4 * (3 * 39 + 0.5), atol=2.1)


def features(count):
    rng = np.random.default_rng(2)
    points = rng.uniform(0, 100, (count, 2)).astype(np.float32)
    ones = np.ones(count, np.float32)
    return Features(points, ones, ones, np.zeros((count, 64), np.uint8))


def link_of(a, b, verdict=Verdict.OK, count=12):
    points = features(count).points
    is_inlier = np.arange(count) % 3 > 0
    b_from_a = translation(-40, 0) if verdict is Verdict.OK else None
    found = Registration(
        verdict, b_from_a, Model.TRANSLATION if b_from_a is not None else None, is_inlier, 0.5
    )
    rows = np.arange(count)
    matches = Matches(rows, rows, np.ones(count, np.float32))
    return Link(a, b, points, points - np.float32([40, 0]), found, matches, 0.5, 0.9)


def pictures_and_placements():
    pictures = [Picture(i, f"p {i}.jpg", picture(40 * i), features(9)) for i in range(3)]
    pictures[1] = Picture(1, "grey.png", cv2.cvtColor(picture(40), 6), features(0))
    placements = [
        Placement(0, "p 0.jpg", 9, Status.USED, "", np.eye(3)),
        Placement(1, "grey.png", 0, Status.USED, "", translation(40, 0)),
        Placement(2, "p 2.jpg", 9, Status.SKIPPED, "no overlap with the others"),
        Placement(3, "broken.jpg", 0, Status.SKIPPED, "cannot be read"),
    ]
    return pictures, placements


def test_a_mosaic_of_pictures(tmp_path):
    path = tmp_path / "new" / "pictures.rrd"
    pictures, placements = pictures_and_placements()
    links = [link_of(0, 1), link_of(1, 2, Verdict.TOO_FEW_INLIERS), link_of(0, 2, count=0)]
    mosaic = np.full((130, 230, 3), 90, np.uint8)
    outlines = {i: box_quad(5 + 40 * i, 6, 160, 120) for i in range(2)}
    record_picture_mosaic(path, pictures, links, placements, mosaic, outlines, "# Mosaic")
    shown = rrd_columns(path, "/mosaic/image", BLOB, None)[1]
    assert cv2.imdecode(np.frombuffer(blob(shown[0]), np.uint8), 1).shape == (130, 230, 3)
    (outlines,) = rrd_columns(path, "/mosaic/outlines", STRIPS, None)[1]
    np.testing.assert_allclose(outlines[1][0], [45, 6], atol=1e-4)
    assert rrd_columns(path, "/mosaic/outlines", "LineStrips2D:labels", None)[1] == [
        ["p 0.jpg", "grey.png"]
    ]
    assert len(rrd_columns(path, "/pictures/2/keypoints", "Points2D:positions", None)[1][0]) == 9
    (lines,) = rrd_columns(path, "/links/0-1/matches", STRIPS, None)[1]
    (classes,) = rrd_columns(path, "/links/0-1/matches", "LineStrips2D:class_ids", None)[1]
    assert classes == [2] * 4 + [1] * 8  # agreeing ones are drawn last
    start, end = np.array(lines[-1])
    np.testing.assert_allclose(end - start, [SIZE[0] + 8 - 40, 0], atol=1e-3)
    assert {"/links/1-2/matches", "/links/0-2/image"} <= set(rrd_entities(path))
    log = [line for (line,) in rrd_columns(path, "/log", "TextLog:text", "picture")[1]]
    assert "p 2.jpg: skipped: no overlap with the others" in log
    assert "broken.jpg: skipped: cannot be read" in log
    assert "1 - 2: 12 matches, refused (too few inliers), 8 of 12 agree" in log
    assert rrd_columns(path, "/summary", "TextDocument:text", None)[1] == [["# Mosaic"]]
    assert RrdReader(path).blueprints()


def test_many_links_are_bounded(tmp_path):
    path = tmp_path / "many.rrd"
    pictures = [Picture(i, f"{i}", picture(i), features(4)) for i in range(14)]
    links = [link_of(a, b, count=3 + a) for a in range(14) for b in range(a + 1, 14)]
    mosaic = np.zeros((3000, 20, 3), np.uint8)
    record_picture_mosaic(path, pictures, links, [], mosaic, {}, "")
    shown = {name for name in rrd_entities(path) if name.startswith("/links/") and "image" in name}
    assert len(shown) == 48
    assert "/links/12-13/image" in shown
    log = [line for (line,) in rrd_columns(path, "/log", "TextLog:text", "picture")[1]]
    assert f"{len(links) - 48} of {len(links)} links are not shown as pictures" in log


def test_without_a_mosaic_the_links_say_why(tmp_path):
    path = tmp_path / "none.rrd"
    pictures, placements = pictures_and_placements()
    links = [link_of(0, 1, Verdict.TOO_FEW_INLIERS)]
    record_picture_mosaic(path, pictures, links, placements, None, {}, "")
    entities = set(rrd_entities(path))
    assert "/links/0-1/image" in entities
    assert "/mosaic/image" not in entities


def test_a_disk_that_fills_up_is_said_and_the_file_is_closed(tmp_path, monkeypatch):
    # Rerun waits for ever for a full disk, so the end must come before that.
    free = iter([10**12, 10**12, 10**12])
    monkeypatch.setattr(recorded_pictures, "free_bytes", lambda _folder: next(free, 10**6))
    path = tmp_path / "full.rrd"
    pictures, placements = pictures_and_placements()
    with pytest.raises(OutputError, match="no space left"):
        record_picture_mosaic(path, pictures, [link_of(0, 1)], placements, picture(0), {}, "")
    entities = set(rrd_entities(path))
    assert "/pictures/1/image" in entities
    assert "/pictures/2/image" not in entities


def test_an_unwritable_place_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    pictures, placements = pictures_and_placements()
    with pytest.raises(OutputError, match="recording"):
        record_picture_mosaic(
            tmp_path / "file" / "x.rrd", pictures, [], placements, picture(0), {}, ""
        )
