"""Annotated pictures: what must be seen is drawn, and nothing in a Step can break the drawing."""

from __future__ import annotations

import numpy as np
import pytest

from streamtrack.geometry import box_quad, translation
from streamtrack.overlay import Trails, clip_segment, draw_step, target_color
from streamtrack.types import (
    CameraPose,
    Evidence,
    Frame,
    Image,
    Matrix,
    Model,
    Points,
    Step,
    Track,
    TrackState,
)


def _grey(width: int = 320, height: int = 240, level: int = 128) -> Image:
    return np.full((height, width, 3), level, np.uint8)


def _tracked(quad: Points, name: str = "board", evidence: Evidence | None = None) -> Track:
    return Track(name, TrackState.TRACKING, quad, np.eye(3), Model.AFFINE, evidence or Evidence())


def _step(image: Image, *tracks: Track, pose: Matrix | None = None, index: int = 0) -> Step:
    camera = CameraPose(np.eye(3) if pose is None else pose)
    return Step(Frame(index, index / 30, image), tracks, camera, None, {})


def _has_color(picture: Image, index: int, x: float, y: float, reach: int = 2) -> bool:
    """True if the target's colour is found around (x, y)."""
    column, row = round(x), round(y)
    patch = picture[row - reach : row + reach + 1, column - reach : column + reach + 1]
    return bool(np.any(np.abs(patch.astype(int) - target_color(index)).max(axis=2) < 60))


def test_quads_are_drawn_in_the_color_of_their_target() -> None:
    image = _grey()
    first, second = box_quad(40, 80, 60, 50), box_quad(180, 100.5, 80, 90)
    drawn = draw_step(_step(image, _tracked(first), _tracked(second, "car")))
    assert drawn.dtype == np.uint8
    assert drawn.shape == image.shape
    for index, quad in enumerate((first, second)):
        for a, b in zip(quad, np.roll(quad, -1, axis=0), strict=True):
            assert _has_color(drawn, index, *((a + b) / 2))
    assert np.all(image == 128), "the frame itself is left alone"


def test_grey_and_read_only_frames_become_bgr_copies() -> None:
    grey = np.full((120, 160), 200, np.uint8)
    grey.setflags(write=False)
    assert draw_step(_step(grey, _tracked(box_quad(20, 30, 50, 40)))).shape == (120, 160, 3)
    reverse = _grey()[:, ::-1]
    assert draw_step(_step(reverse)).shape == reverse.shape


def test_inliers_and_outliers_are_told_apart() -> None:
    points = np.array([[100, 100], [200, 150]], np.float32)
    evidence = Evidence(points, points, np.array([True, False]))
    drawn = draw_step(_step(_grey(), _tracked(box_quad(60, 60, 200, 120), evidence=evidence)))
    assert _has_color(drawn, 0, 100, 100)
    assert not _has_color(drawn, 0, 200, 150)
    blue, green, red = (int(value) for value in drawn[150, 200])
    assert red > blue + 50
    assert red > green + 50


@pytest.mark.parametrize("level", [0, 128, 255])
def test_the_header_is_legible_on_any_background(level: int) -> None:
    header = draw_step(_step(_grey(640, 480, level)))[:40]
    assert np.any(header > 230)
    assert np.any(header < 40)


def test_a_lost_target_is_named_with_the_reason() -> None:
    quiet = draw_step(_step(_grey(640, 480)))
    lost = Track("board", TrackState.LOST, reason="too few matches")
    drawn = draw_step(_step(_grey(640, 480), lost))
    changed = np.argwhere(np.any(drawn != quiet, axis=2))
    assert len(changed) > 500
    assert changed[:, 0].max() < 60, "the status stands at the top"


FAR = [1e4, 1e6, 3e9, 1e20, 3e38]


@pytest.mark.parametrize("far", FAR)
def test_a_quad_far_out_is_drawn_where_it_crosses_the_picture(far: float) -> None:
    quad = np.array([[-far, 60], [far, 60], [far, 180], [-far, 180]], np.float32)
    drawn = draw_step(_step(_grey(), _tracked(quad)))
    assert all(_has_color(drawn, 0, x, 180) for x in (5, 160, 315))
    wholly_out = np.full((4, 2), far, np.float32) + box_quad(0, 0, 9, 9)
    draw_step(_step(_grey(), _tracked(wholly_out), _tracked(-wholly_out, "other")))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_do_no_harm(value: float) -> None:
    quad = box_quad(10, 10, 50, 50)
    quad[2] = value
    points = np.array([[value, 5], [5, 5]], np.float32)
    evidence = Evidence(points, points, np.array([True, False]))
    step = _step(_grey(), _tracked(quad, evidence=evidence))
    draw_step(step, trail={"board": np.array([[0, 0], [value, 1], [5, 5]])})


@pytest.mark.parametrize("size", [(1, 1), (2, 7), (30, 20), (1920, 1080)])
def test_any_picture_size_will_do(size: tuple[int, int]) -> None:
    tracks = [_tracked(box_quad(0, 0, size[0], size[1])), Track("x" * 300, TrackState.SEARCHING)]
    assert draw_step(_step(_grey(*size), *tracks)).shape == (size[1], size[0], 3)


@pytest.mark.parametrize("name", ["", "two\nlines", "žluť 漢", "caf\udce9", "%s {0}", "y" * 500])
def test_any_name_can_be_drawn(name: str) -> None:
    lost = Track(name, TrackState.LOST, reason=name)
    draw_step(_step(_grey(), _tracked(box_quad(9, 9, 90, 90), name), lost))


def test_many_lost_targets_do_not_cover_the_picture() -> None:
    lost = [Track(f"t{i}", TrackState.LOST, reason="out of view") for i in range(100)]
    drawn = draw_step(_step(_grey(640, 480), *lost))
    assert np.all(drawn[240:] == 128)


def test_colors_are_distinct_and_repeat() -> None:
    colors = [target_color(index) for index in range(10)]
    assert len(set(colors)) == 10
    assert target_color(10) == colors[0]
    apart = [np.linalg.norm(np.subtract(a, b)) for i, a in enumerate(colors) for b in colors[:i]]
    assert min(apart) > 50


@pytest.mark.parametrize(
    ("start", "end", "clipped"),
    [
        ((-10, 5), (10, 5), ((-1, 5), (10, 5))),
        ((5, -100), (5, 100), ((5, -1), (5, 50))),
        ((-5, -5), (-5, 90), None),
        ((-30, 20), (20, -30), None),
        ((3, 3), (3, 3), ((3, 3), (3, 3))),
        ((np.nan, 0), (5, 5), None),
    ],
)
def test_clip_segment(
    start: tuple[float, float],
    end: tuple[float, float],
    clipped: tuple[tuple[float, float], ...] | None,
) -> None:
    ends = clip_segment(np.array(start, float), np.array(end, float), (100, 50), 1.0)
    if clipped is None:
        assert ends is None
    else:
        np.testing.assert_allclose(np.array(ends), clipped)


def test_trails_follow_the_camera_and_start_anew_after_a_loss() -> None:
    trails = Trails(length=3)
    trail: dict[str, Points] = {}
    quad = box_quad(10, 10, 20, 20)
    for index in range(5):
        pose = translation(4.0 * index, 0)
        trail = trails.follow(
            _step(_grey(), _tracked(quad + np.array([0, index], np.float32)), pose=pose)
        )
    np.testing.assert_allclose(trail["board"], [[12, 22], [16, 23], [20, 24]], atol=1e-4)
    drawn = draw_step(_step(_grey()), trail=trail)
    assert np.array_equal(drawn, draw_step(_step(_grey()))), "no track, no trail"
    assert trails.follow(_step(_grey(), Track("board", TrackState.LOST))) == {}
    assert len(trails.follow(_step(_grey(), _tracked(quad)))["board"]) == 1


def test_trails_end_where_the_camera_is_lost() -> None:
    trails = Trails()
    track = _tracked(box_quad(10, 10, 20, 20))
    trails.follow(_step(_grey(), track))
    lost = Step(Frame(1, 0, _grey()), (track,), CameraPose(None, reason="blur"), None, {})
    assert trails.follow(lost) == {}
    draw_step(lost, trail={})
