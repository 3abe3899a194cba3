"""A lens that bends straight lines, over ground whose views are known exactly."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from streamtrack import geometry
from streamtrack.camera.lens import STRAIGHT, Lens, agreed, is_news, seen_bend
from streamtrack.camera.moving import MovingCamera
from streamtrack.camera.view_alignment import align, align_exactly
from streamtrack.camera.view_levels import ReferenceView, ViewLevels
from streamtrack.camera.view_verdict import ViewAlignment
from streamtrack.evaluation import corner_error
from streamtrack.features import FeatureExtractor
from streamtrack.frame_view import FrameView
from streamtrack.settings import build_settings
from streamtrack.types import Frame, Image, Matrix

SIZE = (320, 240)
SETTINGS = build_settings({"camera": "moving"})


@pytest.fixture(scope="module")
def ground() -> Image:
    rng = np.random.default_rng(6)
    mixed = np.full((700, 2600), 120, np.float32)
    for grain in (4, 8, 16, 32, 64):
        small = rng.normal(0, 16, (700 // grain + 2, 2600 // grain + 2)).astype(np.float32)
        mixed += cv2.resize(small, None, fx=grain, fy=grain)[:700, :2600]
    return np.clip(cv2.GaussianBlur(mixed, (0, 0), 0.8), 0, 255).astype(np.uint8)


def ground_from_frame(i: int) -> Matrix:
    angle = np.deg2rad(3 * np.sin(i / 9))
    c, s = np.cos(angle), np.sin(angle)
    turned = np.array([[c, -s, 300 + 18.0 * i], [s, c, 340 + 30 * np.sin(i / 17)], [0, 0, 1]])
    return turned @ geometry.translation(-159.5, -119.5)


def seen(ground: Image, i: int, bend: float) -> Image:
    """The picture that a lens with a bend shows."""
    y, x = np.mgrid[0:240, 0:320].astype(np.float32)
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    places = geometry.transform_points(ground_from_frame(i), Lens(bend).straight(pixels, SIZE))
    at = places.reshape(240, 320, 2).astype(np.float32)
    picture = cv2.remap(ground, at[..., 0], at[..., 1], cv2.INTER_CUBIC)
    noise = np.random.default_rng(i).normal(0, 2, picture.shape)
    return np.clip(picture + noise, 0, 255).astype(np.uint8)


def aligned(ground: Image, one: int, other: int, bend: float) -> ViewAlignment:
    reference = ReferenceView(ViewLevels(seen(ground, one, bend)), ())
    view = ViewLevels(seen(ground, other, bend))
    guess = geometry.inverted(ground_from_frame(one)) @ ground_from_frame(other)
    found = align(reference, view, geometry.normalized(guess), ())
    assert found.reference_from_view is not None
    exact = align_exactly(reference, view, found.reference_from_view, ())
    assert exact.reference_from_view is not None
    return exact


@pytest.mark.parametrize("bend", [-0.02, -0.005, 0.0, 0.01])
def test_a_link_tells_the_bend(ground: Image, bend: float) -> None:
    found = aligned(ground, 10, 16, bend)
    assert seen_bend(found, SIZE) == pytest.approx(bend, abs=0.001 + 0.15 * abs(bend))


def test_straight_pixels_take_the_false_perspective_away(ground: Image) -> None:
    found = aligned(ground, 10, 16, -0.02)
    truth = geometry.normalized(geometry.inverted(ground_from_frame(10)) @ ground_from_frame(16))
    assert found.reference_from_view is not None
    as_seen = corner_error(found.reference_from_view, truth, SIZE)
    assert corner_error(Lens(-0.02).flat(found, SIZE), truth, SIZE) < 0.15 * as_seen


def test_a_lens_is_believed_only_where_links_agree() -> None:
    assert agreed([]) == agreed([-0.02] * 3) == STRAIGHT
    assert agreed([-0.02, -0.021, -0.019, -0.02]).bend == -0.02
    assert agreed([0.061, 0.048, 0.042, 0.017]) == STRAIGHT
    assert agreed([-0.02, 0.03, 0.001, -0.01, 0.012]) == STRAIGHT
    assert agreed([1e-5] * 9) == STRAIGHT
    assert is_news(Lens(-0.02), STRAIGHT) and not is_news(Lens(-0.0205), Lens(-0.02))


@pytest.mark.parametrize("bend", [-0.01, 0.0])
def test_a_way_through_a_lens_that_bends_is_no_dome(ground: Image, bend: float) -> None:
    camera, extractor = MovingCamera(SETTINGS), FeatureExtractor(SETTINGS.features)
    count = 100
    for i in range(count):
        camera.update(FrameView(Frame(i, i / 25, seen(ground, i, bend)), extractor), ())
    camera.close()
    first = geometry.inverted(ground_from_frame(0))
    errors = []
    for i in range(count):
        pose = camera.graph.world_from_frame(i)
        assert pose is not None
        truth = geometry.normalized(first @ ground_from_frame(i))
        errors.append(corner_error(pose, truth, SIZE))
    assert (camera.graph.lens == STRAIGHT) == (bend == 0)
    assert np.mean(errors) < 8
