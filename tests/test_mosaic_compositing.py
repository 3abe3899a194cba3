"""Seams, brightness and blending on canvases whose content is known."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from streamtrack import geometry
from streamtrack.mosaic.pictures.compositing import _tone_curve, band_count, painted_bands, plan
from streamtrack.mosaic.pictures.exposure import compensation_gains, overlap_ncc
from streamtrack.mosaic.pictures.projection import Canvas, View, lay_out, planar_views
from streamtrack.mosaic.pictures.seams import SmallPatch, seam_masks
from streamtrack.mosaic.pictures.warping import warp
from streamtrack.settings import BLENDINGS, WARPINGS, MosaicSettings
from streamtrack.types import Image

SIZE = 160, 120


@pytest.fixture
def scene(make_picture: object) -> Image:
    grey = make_picture(5, (260, 150))  # type: ignore[operator]
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), np.uint8)


def cut(scene: Image, x: int, y: int) -> Image:
    return scene[y : y + SIZE[1], x : x + SIZE[0]].copy()


def painted(
    pictures: dict[int, Image],
    places: dict[int, tuple[float, float]],
    settings: MosaicSettings,
) -> tuple[Image, Canvas]:
    poses = {i: geometry.translation(*place) for i, place in places.items()}
    views = planar_views(poses, dict.fromkeys(poses, SIZE))
    canvas = lay_out(views, 1.0)
    planned = plan(canvas, pictures, {}, settings)
    bands = list(painted_bands(planned, pictures.__getitem__, settings, lambda: None))
    return np.concatenate(bands), canvas


@pytest.mark.parametrize("blending", BLENDINGS)
def test_pictures_of_one_scene_give_that_scene(scene: Image, blending: str) -> None:
    places = {0: (0.0, 0.0), 1: (90.0, 25.0), 2: (60.0, 5.0)}
    pictures = {i: cut(scene, int(x), int(y)) for i, (x, y) in places.items()}
    found, canvas = painted(pictures, places, MosaicSettings.model_validate({"blending": blending}))
    assert canvas.size_wh == (250, 145)
    covered = found[:, :, 3] == 255
    truth = np.zeros(found.shape[:2], np.bool_)
    for x, y in places.values():
        truth[int(y) : int(y) + SIZE[1], int(x) : int(x) + SIZE[0]] = True
    np.testing.assert_array_equal(covered, truth)
    error = np.abs(found[:, :, :3].astype(int) - scene[:145, :250])[truth]
    # Pyramids see beyond the edge of a picture what is mirrored there: a few pixels are off.
    assert np.quantile(error, 0.95) <= 1
    assert np.max(error) <= (20 if blending == "multiband" else 1)


@pytest.mark.parametrize("blending", BLENDINGS)
def test_bands_make_the_same_picture_as_one(scene: Image, blending: str) -> None:
    tall = cv2.resize(scene, (260, 600))
    pictures = {i: tall[120 * i : 120 * i + 120, 10 : 10 + 160].copy() for i in range(5)}
    places = {i: (float(7 * i % 3), 100.0 * i) for i in range(5)}
    settings = MosaicSettings.model_validate({"blending": blending})
    whole, canvas = painted(pictures, places, settings)
    narrow = settings.model_copy(update={"max_memory_mb": 0.1})
    assert band_count(canvas, settings) == 1
    assert band_count(canvas, narrow) > 3
    banded, _ = painted(pictures, places, narrow)
    np.testing.assert_array_equal(whole[:, :, 3], banded[:, :, 3])
    error = np.abs(whole[:, :, :3].astype(int) - banded[:, :, :3])
    assert np.quantile(error, 0.999) <= 2
    assert np.max(error) <= 8


def small(image: Image, x: int, y: int) -> SmallPatch:
    height, width = image.shape[:2]
    cover = np.full((height, width), 255, np.uint8)
    return SmallPatch(image, cover, (x, y, x + width, y + height))


def test_seams_share_the_canvas_out(scene: Image) -> None:
    patches = [small(cut(scene, x, y), x, y) for x, y in ((0, 0), (50, 20), (90, 30))]
    total = np.zeros((150, 250), int)
    covered = np.zeros((150, 250), np.bool_)
    for patch, mask in zip(patches, seam_masks(patches, (250, 150)), strict=True):
        x0, y0, x1, y1 = patch.box
        total[y0:y1, x0:x1] += mask > 0
        covered[y0:y1, x0:x1] = True
        assert set(np.unique(mask)) <= {0, 255}
        assert mask.any()
    np.testing.assert_array_equal(total, covered.astype(int))


def test_a_seam_goes_round_what_moved(scene: Image) -> None:
    left, right = cut(scene, 0, 0), cut(scene, 60, 0)
    # In the right picture something stands across the middle of the overlap.
    right[40:80, 30:70] = (0, 0, 255)
    masks = seam_masks([small(left, 0, 0), small(right, 60, 0)], (220, 120))
    shown = masks[1][42:78, 32:68] > 0
    assert shown.mean() < 0.02 or shown.mean() > 0.98


def test_gains_even_out_brightness(scene: Image) -> None:
    dark = np.asarray(scene.astype(np.float32) * (0.7, 0.8, 0.9), np.uint8)
    patches = [small(cut(scene, 0, 0), 0, 0), small(cut(dark, 60, 10), 60, 10)]
    gains = compensation_gains(patches, [0, 1])
    np.testing.assert_allclose(gains[1] / gains[0], 1 / np.array([0.7, 0.8, 0.9]), rtol=0.05)
    np.testing.assert_allclose(gains[0] * gains[1], 1.0, rtol=1e-6)


def test_pictures_that_do_not_meet_keep_their_brightness(scene: Image) -> None:
    patches = [small(cut(scene, 0, 0), 0, 0), small(cut(scene, 0, 0), 300, 0)]
    gains = compensation_gains(patches, [0, 1])
    np.testing.assert_allclose(np.array(list(gains.values())), 1.0)
    assert np.isnan(overlap_ncc(patches))


def test_overlap_ncc_tells_alike_from_different(scene: Image) -> None:
    same = [small(cut(scene, 0, 0), 0, 0), small(cut(scene, 60, 0), 60, 0)]
    other = [same[0], replace(same[1], image=np.ascontiguousarray(same[1].image[::-1, ::-1]))]
    assert overlap_ncc(same) > 0.99
    assert abs(overlap_ncc(other)) < 0.4


@pytest.mark.parametrize("warping", WARPINGS)
def test_warping_by_whole_pixels_changes_nothing(scene: Image, warping: str) -> None:
    view = View("planar", geometry.translation(12, 7), (260, 150))
    image, cover = warp(scene, view, (0, 0, 300, 200), warping)  # type: ignore[arg-type]
    np.testing.assert_array_equal(image[7:157, 12:272], scene)
    assert cover[7:157, 12:272].all()
    assert np.count_nonzero(cover) == 150 * 260


def test_a_reduced_canvas_does_not_alias() -> None:
    stripes = np.zeros((256, 256), np.uint8)
    stripes[:, ::2] = 255
    view = View("planar", geometry.scaling(1 / 8), (256, 256))
    image, _ = warp(stripes, view, (0, 0, 32, 32), "linear")
    assert np.all(np.abs(image[2:-2, 2:-2].astype(int) - 128) <= 2)


@pytest.mark.parametrize("gain", [0.5, 0.9, 1.0, 1.1, 1.6, 2.0])
def test_brightening_keeps_every_shade_apart(gain: float) -> None:
    curve = _tone_curve(gain).astype(int)
    dark = np.arange(int(0.7 * 255 / max(gain, 1)))
    np.testing.assert_allclose(curve[dark], gain * dark, atol=0.51)
    assert curve[255] == (255 if gain >= 1 else round(255 * gain))
    assert np.all(np.diff(curve) >= 0)
    assert len(np.unique(curve[128:])) >= 25  # plain multiplication by 2 leaves one
