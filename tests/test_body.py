"""Targets with moving limbs: kept in sight by appearance, and given up where they are gone."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from conftest import FrameList, MakePicture

from streamtrack import geometry
from streamtrack.pipeline import track
from streamtrack.targets import Target
from streamtrack.tracking.body import Body
from streamtrack.tracking.correlation_filter import CorrelationFilter
from streamtrack.types import Frame, Image, Matrix, Track, TrackState

_SIZE = (320, 240)
_STEPS, _GONE = 36, 6
_PACE_PX, _SWING_PX = 3, 16
_LEFT, _TOP, _WIDTH, _BODY_HEIGHT, _LEG_HEIGHT = 60, 50, 70, 60, 50


def _walker(make_picture: MakePicture) -> list[Image]:
    """A body on two legs that swing under it walks to the right, and then is not there."""
    background, texture = make_picture(1, _SIZE), make_picture(2, _SIZE)
    images = []
    for number in range(_STEPS + _GONE):
        image = background.copy()
        if number < _STEPS:
            left = _LEFT + _PACE_PX * number
            foot = _TOP + _BODY_HEIGHT
            image[_TOP:foot, left : left + _WIDTH] = texture[:_BODY_HEIGHT, :_WIDTH]
            for sign, start in ((1, 100), (-1, 150)):
                at = left + 24 + round(sign * _SWING_PX * np.sin(number / 2))
                leg = texture[100 : 100 + _LEG_HEIGHT, start : start + 22]
                image[foot : foot + _LEG_HEIGHT, at : at + 22] = leg
        images.append(image)
    return images


@pytest.fixture(scope="module")
def walk(make_picture: MakePicture) -> list[Track]:
    images = _walker(make_picture)
    source = FrameList([Frame(i, i / 30, image) for i, image in enumerate(images)])
    box = geometry.box_quad(_LEFT, _TOP, _WIDTH, _BODY_HEIGHT + _LEG_HEIGHT)
    return [step.tracks[0] for step in track(source, [Target("walker", box)])]


def test_a_walker_is_kept_and_the_box_stays_on_it(walk: list[Track]) -> None:
    walking = walk[:_STEPS]
    assert np.mean([t.state is TrackState.TRACKING for t in walking]) >= 0.95
    middle = np.array([_LEFT + _WIDTH / 2, _TOP + (_BODY_HEIGHT + _LEG_HEIGHT) / 2])
    for number, found in enumerate(walking):
        if found.quad is not None:
            off = found.quad.mean(axis=0) - middle - (_PACE_PX * number, 0)
            assert np.linalg.norm(off) < 10, f"frame {number}"


def test_where_it_is_gone_nothing_is_claimed(walk: list[Track]) -> None:
    assert all(t.state is TrackState.LOST and t.reason for t in walk[_STEPS:])


_QUAD = geometry.box_quad(100, 70, 80, 60)


def _seen_through(image: Image, pose: Matrix) -> Image:
    warped = cv2.warpPerspective(image, pose, _SIZE, borderMode=cv2.BORDER_REFLECT)
    return np.asarray(warped, np.uint8)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (7.0, -5.0), (-12.0, 9.0)])
@pytest.mark.parametrize("is_grey", [False, True])
def test_the_filter_finds_a_shift(
    shift: tuple[float, float], is_grey: bool, make_picture: MakePicture
) -> None:
    image = make_picture(3, _SIZE)
    image = image if is_grey == (image.ndim == 2) else np.dstack([image] * 3)
    moved = geometry.translation(*shift)
    found = CorrelationFilter(image, np.eye(3), _QUAD).locate(
        _seen_through(image, moved), np.eye(3)
    )
    off = geometry.transform_points(found.pose, _QUAD) - geometry.transform_points(moved, _QUAD)
    assert np.abs(off).max() < 1.5
    assert found.answer > 0.5


def test_growth_is_followed(make_picture: MakePicture) -> None:
    image = make_picture(3, _SIZE)
    body = Body(image, np.eye(3), _QUAD)
    pose = np.eye(3)
    about = geometry.translation(140, 100), geometry.translation(-140, -100)
    for number in range(1, 21):
        true = about[0] @ geometry.scaling(1.02**number) @ about[1]
        found = body.follow(_seen_through(image, true), pose, was_lost=False)
        assert found is not None
        pose = found
    assert geometry.local_scale(pose, np.array([140.0, 100.0])) == pytest.approx(1.02**20, rel=0.06)


@pytest.mark.parametrize("was_lost", [False, True])
def test_another_picture_is_not_the_body(was_lost: bool, make_picture: MakePicture) -> None:
    body = Body(make_picture(3, _SIZE), np.eye(3), _QUAD)
    for seed in range(4, 12):
        assert body.follow(make_picture(seed, _SIZE), np.eye(3), was_lost=was_lost) is None
