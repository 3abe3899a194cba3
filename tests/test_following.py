"""Which of several motions in a view is the camera's, where the usual start leads astray."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from conftest import MakePicture

from streamtrack import geometry
from streamtrack.camera.frame_motion import guessed_motion
from streamtrack.camera.moving import MovingCamera
from streamtrack.camera.view_levels import ReferenceView, ViewLevels
from streamtrack.evaluation import corner_error
from streamtrack.features import FeatureExtractor
from streamtrack.frame_view import FrameView
from streamtrack.settings import build_settings
from streamtrack.sources.synthetic import SyntheticSource
from streamtrack.types import Frame, Image, Matrix

SETTINGS = build_settings({})
SIZE = 360, 240
SHEAR = 0.045  # of a beach that is passed by, a frame
HERD = geometry.box_quad(30, 120, 290, 70).astype(np.int32)


def world_from_beach(n: int) -> Matrix:
    """A plane that reaches to its horizon shears as a camera goes along it: more in its front."""
    return np.array([[1, SHEAR * n, -0.5 * n], [0, 1, 0], [0, 0, 1.0]])


def beach(make_picture: MakePicture, count: int) -> Iterator[Image]:
    """A weak and wide ground, and a herd of strong texture that goes along with the camera."""
    ground = cv2.convertScaleAbs(make_picture(3, (900, 240)), alpha=0.2, beta=90)
    herd = make_picture(4, SIZE)
    rng = np.random.default_rng(5)
    for n in range(count):
        seen_from_ground = geometry.inverted(world_from_beach(n)) @ geometry.translation(-100, 0)
        picture = cv2.warpPerspective(ground, seen_from_ground, SIZE, flags=cv2.INTER_CUBIC)
        goes = np.roll(herd, (n % 2, -n // 3), axis=(0, 1))
        cv2.copyTo(goes, cv2.fillPoly(np.zeros(SIZE[::-1], np.uint8), [HERD], 255), picture)
        noisy = picture + rng.normal(0, 1, picture.shape)
        yield np.clip(noisy, 0, 255).astype(np.uint8)


def test_points_all_over_the_view_tell_a_wide_background(make_picture: MakePicture) -> None:
    before, view = (ViewLevels(geometry.grey_of(image)) for image in beach(make_picture, 2))
    found = guessed_motion(before, view, ReferenceView(before), np.eye(3))
    assert found is not None
    assert corner_error(found, world_from_beach(1), SIZE) < 1.5


@pytest.mark.parametrize("image", [np.zeros((240, 360), np.uint8), np.zeros((8, 8), np.uint8)])
def test_no_motion_is_guessed_without_points(image: Image) -> None:
    view = ViewLevels(image)
    assert guessed_motion(view, view, ReferenceView(view), np.eye(3)) is None


def test_a_ground_that_shears_is_followed_behind_a_herd(make_picture: MakePicture) -> None:
    camera, extractor = MovingCamera(SETTINGS), FeatureExtractor(SETTINGS.features)
    for n, image in enumerate(beach(make_picture, 12)):
        pose = camera.update(FrameView(Frame(n, n / 25, image), extractor), ())
        assert pose.world_from_frame is not None, pose.reason
        assert corner_error(pose.world_from_frame, world_from_beach(n), SIZE) < 4
    camera.close()


@pytest.mark.parametrize(("seed", "step", "frames"), [(5, 1, 20), (3, 5, 12)])
def test_a_thing_that_goes_along_carries_nothing_away(seed: int, step: int, frames: int) -> None:
    source = SyntheticSource(f"synthetic://car?seed={seed}")
    camera, extractor = MovingCamera(SETTINGS), FeatureExtractor(SETTINGS.features)
    for index in range(0, frames * step, step):
        frame = source.frame(index)
        pose = camera.update(FrameView(frame, extractor), ())
        assert pose.world_from_frame is not None, pose.reason
        truth = source.truth(index).world_from_frame
        assert corner_error(pose.world_from_frame, truth, frame.size_wh) < 3
    camera.close()


def test_a_truck_that_fills_the_view_is_not_taken_for_the_ground(make_picture: MakePicture) -> None:
    """What comes in at the side, and hides three quarters: lost, or where it truly is."""
    camera, extractor = MovingCamera(SETTINGS), FeatureExtractor(SETTINGS.features)
    ground, truck = make_picture(8, (700, 240)), make_picture(9, (300, 210))
    for n in range(36):
        picture = np.ascontiguousarray(ground[:, 40 + 3 * n : 40 + 3 * n + SIZE[0]])
        left = SIZE[0] - 22 * max(0, n - 6)
        shown = picture[15:225, max(left, 0) : left + 300]
        shown[:] = truck[:, max(-left, 0) :][:, : shown.shape[1]]
        pose = camera.update(FrameView(Frame(n, n / 25, picture), extractor), ())
        if pose.world_from_frame is not None:
            assert corner_error(pose.world_from_frame, geometry.translation(3 * n, 0), SIZE) < 3
    camera.close()
    assert pose.world_from_frame is not None
