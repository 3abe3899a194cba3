"""The growing mosaic of a stream against scenes whose truth is known, and the job that runs it."""

from __future__ import annotations

import csv
import errno
import json
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import Clip, FrameList, MakePicture

from streamtrack import geometry
from streamtrack import job as jobs
from streamtrack.errors import OutputError, SourceError, UsageError
from streamtrack.mosaic.job import MosaicJob, MosaicOutcome, MosaicOutputs, NoMosaicProgress
from streamtrack.mosaic.stream.growing import StreamMosaic
from streamtrack.mosaic.stream.job import run_stream_mosaic
from streamtrack.settings import MosaicSettings, build_settings
from streamtrack.sources.scenes.rendering import Ground
from streamtrack.sources.synthetic import SyntheticSource
from streamtrack.types import CameraPose, Frame, Image, Matrix, Track, TrackState

MakeClip = Callable[..., Clip]
SIZE = (160, 120)


def settings(**values: Any) -> MosaicSettings:
    return build_settings({"mosaic": values}).mosaic


def read(path: Path) -> Image:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return np.asarray(image, np.uint8)


def at(x: float, y: float) -> CameraPose:
    return CameraPose(geometry.translation(x, y))


def cut(picture: Image, x: int, y: int) -> Image:
    return np.ascontiguousarray(picture[y : y + SIZE[1], x : x + SIZE[0]])


# -- what it paints -----------------------------------------------------------------------------


def test_it_is_the_ground_that_was_flown_over(tmp_path: Path) -> None:
    """Canvas and final picture against the texture the frames were rendered from."""
    source = SyntheticSource(
        "synthetic://flight?seed=3&frames=60&size=320x240&noise=0&light=0&blur=0&step=12"
    )
    ground, view = source.scene.backdrop(), source.scene.frame_from_ground
    assert isinstance(ground, Ground) and view is not None
    with StreamMosaic(settings(blending="none")) as mosaic:
        for index in range(60):
            pose = CameraPose(source.truth(index).world_from_frame)
            assert mosaic.add(source.frame(index), pose) == ""
        assert mosaic.views < 40
        mosaic.catch_up()
        seen = mosaic.view()
        exported = mosaic.finish(tmp_path / "m.png")
    assert exported is not None and exported.scale == 1.0 and exported.notes == ()
    picture = read(tmp_path / "m.png")
    assert picture.shape[1::-1] == exported.size_wh
    assert exported.size_wh[0] * exported.size_wh[1] > 2 * 320 * 240
    picture_from_ground = exported.picture_from_world @ view(0)
    check_against(picture[..., :3], picture_from_ground, ground, picture[..., 3] > 0, 3.0)
    preview_from_ground = geometry.inverted(seen.world_from_preview) @ view(0)
    painted = np.asarray(cv2.erode(seen.preview.max(axis=2), np.ones((9, 9))) > 0)
    check_against(seen.preview, preview_from_ground, ground, painted, 4.0)


def check_against(
    picture: Image, picture_from_ground: Matrix, ground: Ground, shown: Any, limit: float
) -> None:
    expected = cv2.warpPerspective(
        ground.picture, picture_from_ground, (picture.shape[1], picture.shape[0])
    )
    whole = cv2.erode(shown.astype(np.uint8), np.ones((5, 5))) > 0
    error = cv2.blur(cv2.absdiff(picture, expected), (3, 3)).max(axis=2)[whole]
    assert shown.mean() > 0.2
    assert error.mean() < limit
    assert np.percentile(error, 99.5) < 5 * limit


def test_it_grows_in_all_directions_in_little_memory(
    tmp_path: Path, make_picture: MakePicture
) -> None:
    land = make_picture(11, (1000, 800))
    shown = {}
    for max_mb in (0.5, 400.0):
        with StreamMosaic(settings(max_memory_mb=max_mb), folder=tmp_path) as mosaic:
            for number in range(44):
                angle = 0.45 * number  # a spiral: to the right, down, left and up
                x = int(420 + 6 * number * np.cos(angle))
                y = int(340 + 5 * number * np.sin(angle))
                frame = Frame(number, number / 30, cut(land, x, y))
                assert mosaic.add(frame, at(x - 420, y - 340)) == ""
            preview = mosaic.view()
            exported = mosaic.finish(tmp_path / f"{max_mb}.png")
            assert (mosaic.spilled_mb > 1) == (max_mb < 1)
        assert exported is not None
        shown[max_mb] = preview.preview, read(tmp_path / f"{max_mb}.png")
    np.testing.assert_array_equal(shown[0.5][1], shown[400.0][1])
    # What is painted again may come from a frame in memory or from its JPEG.
    differences = np.abs(shown[0.5][0].astype(int) - shown[400.0][0])
    assert differences.max() <= 8 and differences.mean() < 0.1
    picture = shown[0.5][1]
    x, y = (exported.picture_from_world[:2, 2] - (420, 340)).astype(int).tolist()
    there = land[-y : -y + picture.shape[0], -x : -x + picture.shape[1]]
    error = np.abs(picture[..., 0].astype(int) - there)[picture[..., 3] > 0]
    assert error.mean() < 2.5 and picture[..., 3].mean() > 0.5 * 255
    assert sorted(p.name for p in tmp_path.iterdir()) == ["0.5.png", "400.0.png"]


def moving_square(background: Image, x: int, y: int, side: int = 34, grey: int = 250) -> Image:
    image = background.copy()
    image[y : y + side, x : x + side] = grey
    return image


@pytest.mark.parametrize("still_share", [0.0, 0.3, 0.5])
def test_what_passes_by_leaves_no_ghost(
    tmp_path: Path, make_picture: MakePicture, still_share: float
) -> None:
    """A thing that crosses a fixed view, or stands there for up to half of the time."""
    background = make_picture(12, SIZE)
    frames, path = 60, tmp_path / "m.png"
    with StreamMosaic(settings()) as mosaic:
        for number in range(frames):
            run = max(0.0, number / frames - still_share) / (1 - still_share)
            image = moving_square(background, int(5 + 150 * run) if run else 5, 40)
            assert mosaic.add(Frame(number, number / 30, image[:, :160]), at(0, 0)) == ""
        mosaic.catch_up()
        preview = mosaic.view().preview[: SIZE[1], : SIZE[0], 0]
        exported = mosaic.finish(path)
    assert exported is not None
    for picture in (read(path)[..., 0], preview):
        error = cv2.blur(cv2.absdiff(picture, background), (5, 5))
        assert np.mean(error[4:-4, 4:-4] > 25) < 0.01
    assert exported.tally.contested > 1000


@pytest.mark.parametrize("stay", [(0, 60), (60, 120), (30, 90)])
def test_a_textured_thing_that_stays_for_half_of_the_time_is_not_the_ground(
    tmp_path: Path, make_picture: MakePicture, stay: tuple[int, int]
) -> None:
    """It comes along, stands there and goes on; the ground has as much texture as it has."""
    ground = cv2.cvtColor(make_picture(12, (320, 240)), cv2.COLOR_GRAY2BGR)
    thing = cv2.cvtColor(make_picture(13, (80, 70)), cv2.COLOR_GRAY2BGR) // 2
    thing += np.array([70, 20, 5], np.uint8)
    with StreamMosaic(settings()) as mosaic:
        for number in range(120):
            away = min(0, number - stay[0]) + max(0, number - stay[1] + 1)
            left, image = 120 + 12 * away, ground.copy()
            part = thing[:, max(0, -left) : max(0, 320 - left)]
            image[80:150, max(0, left) : max(0, left) + part.shape[1]] = part
            assert mosaic.add(Frame(number, number / 30, image), at(0, 0)) == ""
        mosaic.finish(tmp_path / "m.png")
    error = cv2.absdiff(read(tmp_path / "m.png")[..., :3], ground).max(axis=2)
    assert np.mean(cv2.blur(error, (5, 5))[80:150, 120:200] > 25) < 0.08


def test_what_goes_along_with_the_camera_is_not_the_ground(
    tmp_path: Path, make_picture: MakePicture
) -> None:
    """Things that nobody named hide half of the rows for half of the time."""
    size = 320, 240
    land = cv2.cvtColor(make_picture(13, (1100, 240)), cv2.COLOR_GRAY2BGR)
    things = [
        cv2.cvtColor(make_picture(14 + k, (60, 110)), cv2.COLOR_GRAY2BGR) // 2
        + np.array(tint, np.uint8)
        for k, tint in enumerate([(110, 30, 0), (0, 110, 30), (30, 0, 110)])
    ]
    with StreamMosaic(settings()) as mosaic:
        for number in range(120):
            x = 6 * number
            image = land[:, x : x + size[0]].copy()
            for left, thing in zip((20, 130, 240), things, strict=True):
                place = left + int(10 * np.sin(number / 9 + left))
                image[60:170, place : place + 60] = thing
            assert mosaic.add(Frame(number, number / 30, image), at(x, 0)) == ""
        mosaic.finish(tmp_path / "m.png")
    picture = read(tmp_path / "m.png")[..., :3]
    error = cv2.absdiff(picture, land[:, : picture.shape[1]]).max(axis=2)
    # At both ends there are too few frames that show what lies behind.
    assert np.mean(cv2.blur(error, (5, 5))[:, 160:-160] > 25) < 0.1


def test_targets_are_not_painted(tmp_path: Path, make_picture: MakePicture) -> None:
    """Not even one that is in every frame, as long as the camera or the target moves."""
    land = make_picture(13, (400, 120))
    with StreamMosaic(settings()) as mosaic:
        for number in range(50):
            x = 4 * number
            quad = geometry.box_quad(60, 45, 30, 30)
            image = moving_square(cut(land, x, 0), 60, 45, 31)
            track = Track("t", TrackState.TRACKING, quad, np.eye(3))
            mosaic.add(Frame(number, number / 30, image), at(x, 0), [track])
        exported = mosaic.finish(tmp_path / "m.png")
    assert exported is not None and exported.tally.contested == 0
    picture = read(tmp_path / "m.png")
    inside = picture[5:-5, 100:-100, 0], land[5:-5, 100 : picture.shape[1] - 100]
    assert np.abs(inside[0].astype(int) - inside[1]).max() < 60  # noise of JPEG, no square (250)
    assert picture[45:75, 100:-100, 3].all()


def test_what_is_found_late_to_lie_over_every_picture_is_taken_out_of_earlier_ones(
    tmp_path: Path, make_picture: MakePicture
) -> None:
    land = make_picture(13, (400, 120))
    logo = geometry.box_quad(60, 45, 30, 30)
    with StreamMosaic(settings()) as mosaic:
        for number in range(50):
            x = 4 * number
            image = moving_square(cut(land, x, 0), 60, 45, 30)
            pose = replace(at(x, 0), overlay=(logo,) if number >= 20 else ())
            mosaic.add(Frame(number, number / 30, image), pose)
        mosaic.catch_up()
        shown = mosaic.view().preview
        mosaic.finish(tmp_path / "m.png")
    picture = read(tmp_path / "m.png")
    ground = land[5:-5, 100 : picture.shape[1] - 100].astype(int)
    assert np.abs(picture[5:-5, 100:-100, 0] - ground).max() < 60  # no logo (250)
    assert picture[45:75, 100:-100, 3].all()
    assert shown.max() < 250


def test_changes_of_light_leave_no_steps(tmp_path: Path, make_picture: MakePicture) -> None:
    land = cv2.GaussianBlur(make_picture(14, (900, 120)), (0, 0), 1.0)
    land = np.asarray(cv2.convertScaleAbs(land, alpha=0.5, beta=50), np.uint8)
    with StreamMosaic(settings(blending="none")) as mosaic:
        for number in range(90):
            x = 8 * number
            gain = 1.0 + 0.25 * np.sin(number / 5)
            image = np.asarray(cv2.convertScaleAbs(cut(land, x, 0), alpha=gain), np.uint8)
            mosaic.add(Frame(number, number / 30, image), at(x, 0))
        preview = mosaic.view().preview[10:110, 10:800, 0]
        mosaic.finish(tmp_path / "m.png")
    for picture, limit in ((preview, 0.06), (read(tmp_path / "m.png")[10:110, 10:800, 0], 0.04)):
        ratio = picture.astype(float) / land[10:110, 10 : 10 + picture.shape[1]]
        columns = np.median(ratio, axis=0)
        assert np.ptp(np.log(columns)) < 0.25  # the light swings by 0.51
        assert np.abs(np.diff(np.log(columns))).max() < limit


# -- what it keeps ------------------------------------------------------------------------------


def test_what_is_kept_does_not_grow_with_time(make_picture: MakePicture) -> None:
    land = make_picture(15, (360, 120))
    kept = []
    with StreamMosaic(settings()) as mosaic:
        for number in range(1200):
            x = int(100 + 100 * np.sin(number / 20))
            mosaic.add(Frame(number, number / 30, cut(land, x, 0)), at(x, 0))
            kept.append(mosaic.views)
    assert max(kept) < 40
    assert mosaic.figures.painted < 120
    assert mosaic.tiles <= 4


def test_a_turning_point_is_not_lost(tmp_path: Path, make_picture: MakePicture) -> None:
    """The farthest frame adds less than is painted at once, and yet it is there in the end."""
    land = make_picture(16, (300, 120))
    with StreamMosaic(settings()) as mosaic:
        for number, x in enumerate([0, 5, 10, 15, 10, 5, 0, 0, 0]):
            mosaic.add(Frame(number, number / 30, cut(land, x, 0)), at(x, 0))
        exported = mosaic.finish(tmp_path / "m.png")
    assert exported is not None and exported.size_wh == (SIZE[0] + 15, SIZE[1])


@dataclass
class Graph:
    """Poses that the test changes as it likes."""

    poses: dict[int, Matrix] = field(default_factory=dict)
    revision: int = 0
    keyframes: dict[int, Any] = field(default_factory=dict)
    edges: tuple[Any, ...] = ()

    def keep(self, index: int) -> None:
        return None

    def world_from_frame(self, index: int) -> Matrix | None:
        return self.poses.get(index)

    def keyframe_of(self, index: int) -> int | None:
        return None

    def sigma_px(self, index: int) -> float:
        return float("nan")


def test_moved_keyframes_are_painted_anew(tmp_path: Path, make_picture: MakePicture) -> None:
    """As after a loop closure: poses had drifted, then they are put right."""
    land = make_picture(17, (700, 120))
    graph = Graph()
    with StreamMosaic(settings(), graph) as mosaic:
        for number in range(60):
            x = 9 * number
            graph.poses[number] = geometry.translation(0.93 * x, 0.02 * x)
            frame = Frame(number, number / 30, cut(land, x, 0))
            mosaic.add(frame, CameraPose(graph.poses[number]))
        drifted = mosaic.view().preview
        graph.poses = {number: geometry.translation(9 * number, 0) for number in graph.poses}
        graph.revision += 1
        mosaic.add(Frame(60, 2.0, cut(land, 531, 0)), at(531, 0))
        np.testing.assert_array_equal(  # one bounded piece of work: most of the old is shown still
            mosaic.view().preview[:100, :150], drifted[:100, :150]
        )
        assert mosaic.catch_up()
        assert mosaic.figures.moved_views >= 5
        picture = mosaic.view().preview[2:-2, 2:650, 0]
        exported = mosaic.finish(tmp_path / "m.png")
    assert exported is not None
    error = cv2.absdiff(picture[:116], land[2:118, 2:650])
    assert error.mean() < 2.5
    error = cv2.absdiff(read(tmp_path / "m.png")[..., 0], land[:, : exported.size_wh[0]])
    assert error.mean() < 2.5


def test_moves_below_half_a_pixel_are_let_be(make_picture: MakePicture) -> None:
    graph = Graph({0: np.eye(3)})
    with StreamMosaic(settings(), graph) as mosaic:
        mosaic.add(Frame(0, 0.0, make_picture(1, SIZE)), at(0, 0))
        graph.poses[0] = geometry.translation(0.4, 0)
        graph.revision += 1
        assert mosaic.catch_up()
        assert mosaic.figures.moved_views == 0


@pytest.mark.parametrize(
    ("pose", "said"),
    [
        (CameraPose(None, reason="too few inliers"), "too few inliers"),
        (CameraPose(np.diag([2.5, 2.5, 1.0])), "times its area"),
        (CameraPose(np.full((3, 3), np.nan)), "not finite"),
        (CameraPose(np.diag([1.0, -1.0, 1.0])), "mirrored"),
        (at(1e9, 0), "from the origin"),
    ],
)
def test_a_refused_frame_changes_nothing(
    make_picture: MakePicture, pose: CameraPose, said: str
) -> None:
    with StreamMosaic(settings()) as mosaic:
        mosaic.add(Frame(0, 0.0, make_picture(1, SIZE)), at(0, 0))
        before = mosaic.view().preview
        assert said in mosaic.add(Frame(1, 0.1, make_picture(2, SIZE)), pose)
        np.testing.assert_array_equal(mosaic.view().preview, before)
        assert (mosaic.views, sum(mosaic.figures.refused.values())) == (1, 1)


def test_a_full_disk_ends_the_growth_and_is_said(
    tmp_path: Path, make_picture: MakePicture, monkeypatch: pytest.MonkeyPatch
) -> None:
    land = make_picture(18, (1000, 400))

    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "pwrite", full)
    with StreamMosaic(settings(max_memory_mb=0.2), folder=tmp_path) as mosaic:
        for number in range(40):
            x = 20 * number
            assert mosaic.add(Frame(number, number / 30, cut(land, x, 0)), at(x, 0)) == ""
        (note,) = mosaic.notes
        assert "grows no further since frame" in note and "no space left" in note
        exported = mosaic.finish(tmp_path / "m.png")
    assert exported is not None and 160 <= exported.size_wh[0] < 900


def test_large_pictures_are_scaled_and_it_is_said(
    tmp_path: Path, make_picture: MakePicture
) -> None:
    land = make_picture(19, (700, 120))
    with StreamMosaic(settings(max_megapixels=0.02)) as mosaic:
        for number in range(50):
            mosaic.add(Frame(number, number / 30, cut(land, 10 * number, 0)), at(10 * number, 0))
        exported = mosaic.finish(tmp_path / "m.png")
    assert exported is not None
    width, height = exported.size_wh
    assert width * height <= 20_500 and width / height == pytest.approx(650 / 120, rel=0.03)
    assert "--max-megapixels" in exported.notes[0]
    expected = cv2.resize(land[:, :650], (width, height), interpolation=cv2.INTER_AREA)
    assert np.abs(read(tmp_path / "m.png")[..., 0].astype(int) - expected)[2:-2, 2:-2].mean() < 4


@pytest.mark.parametrize("size", [(160, 120), (1, 1), (1, 300), (3, 200), (16, 16)])
@pytest.mark.parametrize("is_grey", [False, True])
def test_one_frame_is_a_mosaic(
    tmp_path: Path, make_picture: MakePicture, size: tuple[int, int], is_grey: bool
) -> None:
    grey = make_picture(1, size)
    image = grey if is_grey else np.dstack([grey, 255 - grey, grey])
    with StreamMosaic(settings()) as mosaic:
        reason = mosaic.add(Frame(0, 0.0, image), at(0, 0))
        assert reason == ("it would shrink to nothing" if min(size) == 1 else "")
        if reason:
            with pytest.raises(OutputError, match="no frame could be placed"):
                mosaic.finish(tmp_path / "m.png")
            return
        exported = mosaic.finish(tmp_path / "m.png")
    assert exported is not None and exported.size_wh == size
    found = read(tmp_path / "m.png").astype(int)
    expected = np.dstack([image] * 3) if is_grey else image
    assert np.abs(found[..., :3] - expected).mean() < 6
    assert (found[..., 3] == 255).all()


def test_frames_of_another_size_fit_in(tmp_path: Path, make_picture: MakePicture) -> None:
    land = make_picture(20, (400, 240))
    with StreamMosaic(settings()) as mosaic:
        mosaic.add(Frame(0, 0.0, np.ascontiguousarray(land[:, :240])), at(0, 0))
        half = cv2.resize(land[:, 160:], (120, 120), interpolation=cv2.INTER_AREA)
        pose = CameraPose(geometry.translation(160, 0) @ geometry.scaling(2.0))
        assert mosaic.add(Frame(1, 0.1, np.asarray(half, np.uint8)), pose) == ""
        exported = mosaic.finish(tmp_path / "m.png")
    assert exported is not None and exported.size_wh[0] in (399, 400)
    picture = read(tmp_path / "m.png")[4:-6, 4:-6, 0]
    error = np.abs(picture.astype(int) - land[4 : 4 + len(picture), 4 : 4 + picture.shape[1]])
    assert error[:, :140].mean() < 3 and error.mean() < 12  # the right half had half the detail


# -- the job ------------------------------------------------------------------------------------

FLIGHT = "synthetic://flight?seed=1&frames=14&size=320x240&step=12"


def job(folder: Path, source: str = FLIGHT, **values: Any) -> MosaicJob:
    outputs = MosaicOutputs(folder / "m.png", folder / "poses.csv", folder / "summary.json")
    return MosaicJob((source,), outputs=values.pop("outputs", outputs), **values)


def run(given: MosaicJob, should_stop: Callable[[], bool] = lambda: False) -> MosaicOutcome:
    return run_stream_mosaic(given, NoMosaicProgress(), should_stop)


def poses_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "poses.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_stream_becomes_picture_poses_and_summary(tmp_path: Path) -> None:
    outcome = run(job(tmp_path))
    assert outcome.error is None and outcome.summary.ended == "end of source"
    rows, truth = poses_of(tmp_path), SyntheticSource(FLIGHT)
    assert [row["frame"] for row in rows] == [str(n) for n in range(14)]
    for row in rows:
        assert (row["status"], row["reason"]) == ("used", "")
        found = np.array([float(row[f"h{r}{c}"]) for r in (1, 2, 3) for c in (1, 2, 3)])
        expected = truth.truth(int(row["frame"])).world_from_frame
        corners = geometry.image_quad((320, 240))
        moved = geometry.transform_points(found.reshape(3, 3), corners)
        assert np.abs(moved - geometry.transform_points(expected, corners)).max() < 1.5
    summary = json.loads((tmp_path / "summary.json").read_text())
    picture = read(tmp_path / "m.png")
    assert summary["canvas"] == {
        "width": picture.shape[1],
        "height": picture.shape[0],
        "scale": 1.0,
    }
    assert summary["frames"] == {"used": 14, "skipped": {}}
    assert summary["blending"] == "multiband" and summary["keyframes"] >= 1
    assert picture.shape[1] * picture.shape[0] > 1.15 * 320 * 240


def test_the_same_input_gives_the_same_output(tmp_path: Path) -> None:
    folders = [tmp_path / "a", tmp_path / "b"]
    for folder in folders:
        assert run(job(folder)).error is None
    for name in ("m.png", "poses.csv"):
        assert (folders[0] / name).read_bytes() == (folders[1] / name).read_bytes()


def test_frames_are_chosen(tmp_path: Path) -> None:
    outcome = run(job(tmp_path, start=2, step=3, frames=3))
    assert [row["frame"] for row in poses_of(tmp_path)] == ["2", "5", "8"]
    assert outcome.summary.ended == "3 frames, as asked"


def test_a_wish_to_stop_writes_the_mosaic_so_far(tmp_path: Path) -> None:
    calls = iter([False] * 4 + [True])
    outcome = run(job(tmp_path), lambda: next(calls))
    assert str(outcome.error) == "interrupted after frame 4: everything up to there is written"
    assert len(poses_of(tmp_path)) == 5
    assert read(tmp_path / "m.png").size > 0
    assert json.loads((tmp_path / "summary.json").read_text())["ended"].startswith("interrupted")


class Breaking(FrameList):
    """A source that breaks after its last frame."""

    def __iter__(self) -> Iterator[Frame]:
        yield from self._frames
        raise SourceError("the cable was pulled")


def given_source(monkeypatch: pytest.MonkeyPatch, source: FrameList) -> None:
    monkeypatch.setattr(jobs, "open_source", lambda *_, **__: source)


def test_what_a_broken_source_gave_is_kept(
    tmp_path: Path, make_clip: MakeClip, monkeypatch: pytest.MonkeyPatch
) -> None:
    clip = make_clip("flight?size=320x240&frames=40&step=9", 6)
    given_source(monkeypatch, Breaking(clip.frames))
    outcome = run(job(tmp_path))
    assert str(outcome.error) == "the cable was pulled" == outcome.summary.ended
    assert len(poses_of(tmp_path)) == 6 and (tmp_path / "m.png").exists()


def test_a_stream_that_shows_nothing_is_no_success(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    black = [Frame(n, n / 30, np.zeros((240, 320, 3), np.uint8)) for n in range(5)]
    given_source(monkeypatch, FrameList(black))
    outcome = run(job(tmp_path))
    assert "no frame could be placed" in str(outcome.error)
    assert "too few features" in str(outcome.error)
    assert not (tmp_path / "m.png").exists()
    assert {row["status"] for row in poses_of(tmp_path)} == {"skipped"}
    assert all(row["reason"] for row in poses_of(tmp_path))


def test_another_size_midway_is_another_camera_until_the_first_is_back(
    tmp_path: Path, make_clip: MakeClip, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pictures of another size have no place in this world, and leave no trace in it."""
    clip = make_clip("flight?size=320x240&frames=40&step=9", 10)
    other = make_clip("flight?size=160x120&frames=40&seed=2", 10)
    mixed = {n: other.frames[n].image for n in (4, 5, 6)}
    given_source(monkeypatch, clip.with_images(mixed))
    outcome = run(job(tmp_path))
    assert outcome.error is None
    rows, truths = poses_of(tmp_path), clip.truths
    said = ["the picture's size changed" if n in mixed else "" for n in range(10)]
    assert [row["reason"] for row in rows] == said
    assert outcome.summary.frames_skipped == {"the picture's size changed": 3}
    for row, truth in zip(rows, truths, strict=True):
        if row["status"] == "used":
            shift = float(row["h13"]) - truth.world_from_frame[0, 2]
            assert abs(shift) < 1.0


def test_a_cut_is_left_out_and_told(
    tmp_path: Path, make_clip: MakeClip, make_picture: MakePicture, monkeypatch: pytest.MonkeyPatch
) -> None:
    clip = make_clip("flight?size=320x240&frames=40&step=9", 8)
    other = np.dstack([make_picture(99, (320, 240))] * 3)
    given_source(monkeypatch, clip.with_images({5: other, 6: other}))
    outcome = run(job(tmp_path))
    assert outcome.error is None
    rows = poses_of(tmp_path)
    assert [row["status"] for row in rows] == ["used"] * 5 + ["skipped"] * 2 + ["used"]
    assert all(row["reason"] and not row["h11"] for row in rows[5:7])
    assert sum(outcome.summary.frames_skipped.values()) == 2


@pytest.mark.parametrize(
    ("outputs", "values", "said"),
    [
        ({"image": "m.gif"}, {}, "no picture format"),
        ({"image": "m.png", "summary": "m.png"}, {}, "would replace the summary output"),
        ({"record": "m.png"}, {}, r"ending \.rrd"),
        ({}, {"truth": Path("H.txt")}, "--truth is for two pictures"),
    ],
)
def test_wrong_usage_is_refused_before_anything_is_written(
    tmp_path: Path, outputs: dict[str, str], values: dict[str, Any], said: str
) -> None:
    places = {name: tmp_path / place for name, place in outputs.items()}
    with pytest.raises(UsageError, match=said):
        run(job(tmp_path, outputs=MosaicOutputs(**places), **values))
    assert not list(tmp_path.iterdir())


def test_a_picture_that_cannot_be_written_is_told_before_the_first_frame(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    outputs = MosaicOutputs(tmp_path / "file" / "m.png", tmp_path / "poses.csv")
    with pytest.raises(OutputError, match="file stands where its folder should be"):
        run(job(tmp_path, outputs=outputs))
    assert not (tmp_path / "poses.csv").exists()


def test_a_camera_that_is_not_there_is_waited_for_until_the_wish_to_stop(tmp_path: Path) -> None:
    asked = iter(range(10**6))
    with pytest.raises(SourceError, match="interrupted before the first picture"):
        run(job(tmp_path, "rtsp://127.0.0.1:1/nothing"), lambda: next(asked) >= 20)
    assert not list(tmp_path.iterdir())
