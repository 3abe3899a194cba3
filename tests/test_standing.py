"""What is laid over pictures does not join them: stamps, frames, dirt on the lens."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from conftest import MakePicture

from streamtrack.evaluation import corner_error
from streamtrack.geometry import translation
from streamtrack.mosaic.pairs.registering import PictureRegistrar
from streamtrack.mosaic.pairs.standing import overlay_like
from streamtrack.mosaic.types import Link
from streamtrack.settings import Settings
from streamtrack.types import Image, Size, Verdict

SIZE: Size = (400, 300)

Overlay = Callable[[Image], Image]


@pytest.fixture(scope="module")
def registrar() -> PictureRegistrar:
    return PictureRegistrar(Settings())


@pytest.fixture(scope="module")
def pattern(make_picture: MakePicture) -> Image:
    return make_picture(99, SIZE)


def linked(registrar: PictureRegistrar, a: Image, b: Image) -> Link:
    return registrar.link(registrar.picture(0, "a", a), registrar.picture(1, "b", b))


def stamped(image: Image) -> Image:
    """A date and a line of figures."""
    out = image.copy()
    for row, text in enumerate(("ALT 120.5 m  HDG 271", "'98  7 21  14:35:07  N52 31 E13 24")):
        place = 10, image.shape[0] - 16 - 26 * row
        cv2.putText(out, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.7, 0, 4)
        cv2.putText(out, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.7, 255, 2)
    return out


def framed(pattern: Image) -> Overlay:
    """A patterned frame that hides 50 pixels on each side."""

    def overlay(image: Image) -> Image:
        out = pattern.copy()
        out[50:-50, 50:-50] = image[50:-50, 50:-50]
        return out

    return overlay


def dirty(image: Image) -> Image:
    """A hundred spots on the lens."""
    rng = np.random.default_rng(5)
    light = np.ones(image.shape[:2], np.float32)
    for _ in range(100):
        spot = np.ones_like(light)
        x, y = (int(rng.uniform(0, n)) for n in (image.shape[1], image.shape[0]))
        cv2.circle(spot, (x, y), int(rng.integers(2, 7)), 0.4, -1)
        light *= spot
    return (image * cv2.GaussianBlur(light, (0, 0), 1.0)).astype(np.uint8)


@pytest.fixture(params=["stamp", "frame", "dirt"])
def overlay(request: pytest.FixtureRequest, pattern: Image) -> Overlay:
    return {"stamp": stamped, "frame": framed(pattern), "dirt": dirty}[request.param]


def flat_scene(seed: int) -> Image:
    """Soft shades without a corner, so that only the overlay has any, and a little noise."""
    rng = np.random.default_rng(seed)
    coarse = rng.uniform(40, 220, (6, 8)).astype(np.float32)
    soft = cv2.resize(coarse, SIZE, interpolation=cv2.INTER_CUBIC)
    return np.clip(soft + rng.normal(0, 1.5, soft.shape), 0, 255).astype(np.uint8)


def test_two_scenes_under_one_overlay_are_refused(
    registrar: PictureRegistrar, overlay: Overlay, make_picture: MakePicture
) -> None:
    for a, b in (
        (make_picture(1, SIZE), make_picture(2, SIZE)),
        (flat_scene(1), flat_scene(2)),
    ):
        link = linked(registrar, overlay(a), overlay(b))
        assert link.b_from_a is None


def test_the_reason_says_what_agrees(registrar: PictureRegistrar, pattern: Image) -> None:
    link = linked(registrar, *(framed(pattern)(flat_scene(seed)) for seed in (1, 2)))
    assert link.verdict is Verdict.OVERLAY


def test_the_scene_leads_where_it_moves_under_an_overlay(
    registrar: PictureRegistrar, overlay: Overlay, make_picture: MakePicture
) -> None:
    scene = make_picture(3, (700, 400))
    a, b = scene[40:340, 40:440], scene[52:352, 130:530]
    link = linked(registrar, overlay(a), overlay(b))
    assert link.b_from_a is not None
    assert corner_error(link.b_from_a, translation(-90, -12), SIZE) < 1.0


def test_one_scene_under_an_overlay_is_joined(
    registrar: PictureRegistrar, overlay: Overlay, make_picture: MakePicture
) -> None:
    rng = np.random.default_rng(4)
    scene = make_picture(4, SIZE)
    a, b = (
        overlay(np.clip(scene + rng.normal(0, 4, scene.shape), 0, 255).astype(np.uint8))
        for _ in range(2)
    )
    link = linked(registrar, a, b)
    assert link.b_from_a is not None
    assert corner_error(link.b_from_a, np.eye(3), SIZE) < 0.5


def test_a_mover_before_a_standing_camera_is_no_new_scene(
    registrar: PictureRegistrar, make_picture: MakePicture
) -> None:
    a, other = make_picture(5, SIZE), make_picture(6, SIZE)
    b = a.copy()
    b[100:200, 150:250] = other[100:200, 150:250]
    assert linked(registrar, a, b).b_from_a is not None


@pytest.mark.parametrize(
    ("b_wh", "moved", "is_overlay"),
    [
        (SIZE, (0.0, 0.0), True),
        (SIZE, (3.0, -2.0), True),
        (SIZE, (30.0, 0.0), False),
        ((500, 360), (100.0, 60.0), True),  # at the bottom right
        ((500, 360), (50.0, 0.0), True),  # in the middle above
        ((500, 360), (70.0, 0.0), False),
    ],
)
def test_overlays_keep_their_place(
    b_wh: Size, moved: tuple[float, float], is_overlay: bool
) -> None:
    rng = np.random.default_rng(0)
    a = rng.uniform(0, 300, (40, 2)).astype(np.float32)
    b = a + np.float32(moved)
    assert (overlay_like(a, b, SIZE, b_wh) is not None) == is_overlay


def test_an_overlay_may_be_scaled_with_its_picture() -> None:
    a = np.random.default_rng(0).uniform(0, 300, (40, 2)).astype(np.float32)
    assert overlay_like(a, a * 2, SIZE, (800, 600)) is not None


def test_no_pairs_are_no_overlay() -> None:
    none = np.zeros((0, 2), np.float32)
    assert overlay_like(none, none, SIZE, SIZE) is None
