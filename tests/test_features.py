"""Keypoints and descriptors: found again after a known warp, spread, honest about bad pictures."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from conftest import MakePicture

from streamtrack import geometry
from streamtrack.errors import UsageError
from streamtrack.features import (
    COMPATIBLE,
    FeatureExtractor,
    no_features,
)
from streamtrack.matching import match
from streamtrack.settings import (
    DEFAULT_THRESHOLDS,
    DESCRIPTORS,
    DETECTORS,
    FeatureSettings,
    MatchingSettings,
    build_settings,
)
from streamtrack.types import Features, Image, Matrix

SIZE = (400, 300)
PAIRS = [(detector, descriptor) for detector, fit in COMPATIBLE.items() for descriptor in fit]
MISFITS = [pair for pair in [(a, b) for a in DETECTORS for b in DESCRIPTORS] if pair not in PAIRS]


def settings_of(detector: str, descriptor: str | None = None, **more: object) -> FeatureSettings:
    values = {"detector": detector, "descriptor": descriptor or COMPATIBLE[detector][0], **more}
    return build_settings({"features": values}).features


def extract(grey: Image, detector: str, descriptor: str | None = None, **more: object) -> Features:
    return FeatureExtractor(settings_of(detector, descriptor, **more)).extract(grey)


def warped(grey: Image, zoom: float, degrees: float) -> tuple[Image, Matrix]:
    """The picture turned about its middle and enlarged, and the mapping to it."""
    height, width = grey.shape
    turned = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), degrees, 1.0)
    to_from = geometry.scaling(zoom) @ np.vstack([turned, [0, 0, 1]])
    size = int(width * zoom), int(height * zoom)
    picture = cv2.warpPerspective(
        grey, to_from, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )
    return np.asarray(picture, np.uint8), to_from


def correct_matches(a: Features, b: Features, b_from_a: Matrix) -> tuple[int, int]:
    """(matches within 3 px of the truth, all matches)."""
    found = match(a, b, MatchingSettings())
    miss = geometry.transform_points(b_from_a, a.points[found.ref]) - b.points[found.cur]
    return int(np.count_nonzero(np.linalg.norm(miss, axis=1) <= 3)), len(found)


def checkerboard(cell: float, degrees: float) -> tuple[Image, npt.NDArray[np.float64]]:
    """A turned checkerboard drawn by averaging 8x8 samples a pixel, and where its corners are."""
    fine = (np.arange(SIZE[0] * 8) + 0.5) / 8 - 0.5
    x, y = np.meshgrid(fine, fine[: SIZE[1] * 8])
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    u, v = (c * x + s * y - 3.3) / cell, (-s * x + c * y + 4.7) / cell
    value = np.where((np.floor(u) + np.floor(v)) % 2 == 0, 40.0, 210.0)
    value = value.reshape(SIZE[1], 8, SIZE[0], 8).mean(axis=(1, 3))
    grid = np.stack(np.meshgrid(np.arange(-60, 60), np.arange(-60, 60)), axis=-1).reshape(-1, 2)
    moved = grid * cell + [3.3, -4.7]
    corners = moved @ np.array([[c, s], [-s, c]])
    margin = 12
    inside = ((corners > margin) & (corners < np.array(SIZE) - margin)).all(axis=1)
    return np.rint(value).astype(np.uint8), corners[inside]


@pytest.mark.parametrize(("detector", "descriptor"), PAIRS)
def test_features_are_found_again_after_a_known_warp(
    detector: str, descriptor: str, make_picture: MakePicture
) -> None:
    """Measured: 71 % right at worst (agast + sift), mostly above 90 %."""
    picture = make_picture(1, SIZE)
    turned, turned_from_picture = warped(picture, 1.3, 10)
    extractor = FeatureExtractor(settings_of(detector, descriptor, max_features=400))
    correct, matches = correct_matches(
        extractor.extract(picture), extractor.extract(turned), turned_from_picture
    )
    assert correct >= 10
    assert correct >= 0.6 * matches


@pytest.mark.parametrize("detector", ["harris", "fast", "agast", "gftt"])
def test_the_pyramid_bridges_a_twofold_zoom(detector: str, make_picture: MakePicture) -> None:
    picture = make_picture(2, SIZE)
    zoomed, zoomed_from_picture = warped(picture, 2.0, 0)
    a, b = (extract(image, detector, "freak", max_features=600) for image in (picture, zoomed))
    correct, matches = correct_matches(a, b, zoomed_from_picture)
    assert correct >= 60
    assert correct >= 0.8 * matches


@pytest.mark.parametrize(("detector", "descriptor"), MISFITS)
def test_what_does_not_fit_is_refused_with_what_does(detector: str, descriptor: str) -> None:
    with pytest.raises(UsageError, match=f"'{descriptor}' does not fit .*'{detector}'") as caught:
        FeatureExtractor(settings_of(detector, descriptor))
    assert str(caught.value).endswith(", ".join(COMPATIBLE[detector]))


def test_every_detector_has_a_threshold_and_a_descriptor() -> None:
    assert set(DEFAULT_THRESHOLDS) == set(COMPATIBLE) == set(DETECTORS)
    assert {descriptor for _, descriptor in PAIRS} == set(DESCRIPTORS)


@pytest.mark.parametrize("detector", DETECTORS)
def test_a_higher_threshold_never_finds_more(detector: str, make_picture: MakePicture) -> None:
    picture, threshold = make_picture(3, SIZE), DEFAULT_THRESHOLDS[detector]
    counts = [
        len(extract(picture, detector, threshold=factor * threshold, max_features=10**5))
        for factor in (0.5, 1, 2, 4, 9)
    ]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] > counts[-1]


@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize("threshold", [0.0, -1.0, float("nan"), float("inf"), 1e12, 1e300])
def test_thresholds_out_of_range_are_refused(detector: str, threshold: float) -> None:
    """Refused at construction, or harmless: a picture then simply has no features."""
    try:
        extractor = FeatureExtractor(settings_of(detector, threshold=threshold))
    except UsageError as error:
        assert "threshold" in str(error)
        return
    assert 1e11 < threshold < float("inf")
    assert len(extractor.extract(np.eye(100, dtype=np.uint8) * 200)) == 0


def test_weak_texture_is_not_starved_by_a_strong_corner(rng: np.random.Generator) -> None:
    coarse = rng.normal(128, 6, (SIZE[1] // 4, SIZE[0] // 4))
    picture = np.asarray(cv2.resize(coarse, SIZE, interpolation=cv2.INTER_CUBIC), np.float64)
    picture[:75, :100] = 128 + 8 * (picture[:75, :100] - 128)
    grey = np.clip(picture, 0, 255).astype(np.uint8)
    found = extract(grey, "harris", "teblid", threshold=1e-9, max_features=300)
    assert 250 <= len(found) <= 310
    quarters = (found.points >= np.array(SIZE) / 2) @ np.array([1, 2])
    counts = np.bincount(quarters, minlength=4)
    assert counts.min() >= 0.15 * len(found)
    everything = extract(grey, "harris", "teblid", threshold=1e-9, max_features=10**5)
    strongest = everything.points[np.argsort(-everything.responses)[: len(found)]]
    assert np.mean((strongest < [100, 75]).all(axis=1)) > 0.5  # what responses alone would choose


@pytest.mark.parametrize("count", [8, 50, 300])
@pytest.mark.parametrize("detector", DETECTORS)
def test_no_more_features_than_asked_for(
    detector: str, count: int, make_picture: MakePicture
) -> None:
    """Up to one a pyramid level more, by rounding."""
    assert len(extract(make_picture(4, SIZE), detector, max_features=count)) <= count + 6


BAD_PICTURES = {
    "1x1": np.zeros((1, 1)),
    "2x3": np.arange(6).reshape(2, 3) * 40,
    "7x7": np.random.default_rng(1).integers(0, 256, (7, 7)),
    "16x16": np.random.default_rng(1).integers(0, 256, (16, 16)),
    "row": np.random.default_rng(2).integers(0, 256, (1, 400)),
    "column": np.random.default_rng(3).integers(0, 256, (400, 1)),
    "strip": np.random.default_rng(4).integers(0, 256, (3, 500)),
    "ribbon": np.random.default_rng(5).integers(0, 256, (24, 1500)),
    "black": np.zeros((120, 160)),
    "white": np.full((120, 160), 255),
    "grey ramp": np.tile(np.arange(160), (120, 1)),
    "noise": np.random.default_rng(6).integers(0, 256, (120, 160)),
}


@pytest.mark.parametrize("name", BAD_PICTURES)
@pytest.mark.parametrize("detector", DETECTORS)
def test_bad_pictures_have_few_or_no_features_and_do_no_harm(detector: str, name: str) -> None:
    grey = BAD_PICTURES[name].astype(np.uint8)
    height, width = grey.shape
    for descriptor in COMPATIBLE[detector]:
        found = extract(grey, detector, descriptor)
        assert np.all(found.points >= -1)
        assert np.all(found.points <= [width, height])
        if name in ("1x1", "black", "white", "grey ramp"):
            assert len(found) == 0


@pytest.mark.parametrize("detector", DETECTORS)
def test_the_mask_is_respected(detector: str, make_picture: MakePicture) -> None:
    picture = make_picture(5, SIZE)
    mask = np.zeros(picture.shape, np.uint8)
    mask[80:220, 100:300] = 255
    extractor = FeatureExtractor(settings_of(detector))
    inside = extractor.extract(picture, mask)
    assert len(inside) >= 8
    x, y = inside.points.T
    slack = 6  # half a pixel of the coarsest level, and what refinement may move a corner
    assert x.min() >= 100 - slack and x.max() < 300 + slack
    assert y.min() >= 80 - slack and y.max() < 220 + slack
    assert len(extractor.extract(picture, np.zeros_like(mask))) == 0
    everywhere = extractor.extract(picture, np.full_like(mask, 255))
    np.testing.assert_array_equal(everywhere.points, extractor.extract(picture).points)


@pytest.mark.parametrize(("detector", "descriptor"), PAIRS)
def test_dtypes_shapes_and_the_same_every_time(
    detector: str, descriptor: str, make_picture: MakePicture
) -> None:
    picture = make_picture(6, (320, 240))
    extractor = FeatureExtractor(settings_of(detector, descriptor, max_features=120))
    first, second = extractor.extract(picture), extractor.extract(picture)
    fresh = extract(picture, detector, descriptor, max_features=120)
    for other in (second, fresh):
        np.testing.assert_array_equal(first.points, other.points)
        np.testing.assert_array_equal(first.descriptors, other.descriptors)
    assert first.points.dtype == first.sizes.dtype == first.responses.dtype == np.float32
    assert np.isfinite(first.points).all() and (first.sizes > 0).all()
    length = {"freak": 64, "brisk": 64, "orb": 32, "teblid": 32, "sift": 128, "akaze": 61}
    assert first.descriptors.shape == (len(first), length[descriptor])
    assert first.descriptors.dtype == (np.float32 if descriptor == "sift" else np.uint8)


def finest_level(found: Features) -> npt.NDArray[np.float32]:
    return found[found.sizes == found.sizes.min()].points


def misses(true_points: npt.NDArray[np.float64], found: Features) -> npt.NDArray[np.float64]:
    """Distance of each true point to the nearest one found on the finest level."""
    away = np.linalg.norm(true_points[:, None] - finest_level(found)[None], axis=2)
    nearest: npt.NDArray[np.float64] = away.min(axis=1)
    return nearest


@pytest.mark.parametrize("detector", ["harris", "gftt"])
@pytest.mark.parametrize("sigma", [0.8, 1.2, 1.5])
def test_corners_find_dots_to_sub_pixel(
    rng: np.random.Generator, sigma: float, detector: str
) -> None:
    """Dots small enough to be one corner; at the nearest whole pixel the errors reach 0.7 px."""
    grid = np.stack(np.meshgrid(np.arange(30, 380, 25), np.arange(30, 280, 25)), axis=-1)
    dots = grid.reshape(-1, 2) + rng.uniform(-0.5, 0.5, (grid.size // 2, 2))
    y, x = np.mgrid[: SIZE[1], : SIZE[0]].astype(np.float64)
    light = sum(np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * sigma**2)) for u, v in dots)
    found = extract(np.rint(50 + 160 * light).astype(np.uint8), detector, "teblid")
    assert misses(dots, found).max() < 0.3


@pytest.mark.parametrize(("cell", "degrees"), [(23.0, 7.0), (31.0, 20.0), (19.5, 40.0)])
def test_refined_corners_are_where_the_checkerboards_are(cell: float, degrees: float) -> None:
    """Crossings have several cornerness peaks around them, so only near, unlike dots."""
    grey, corners = checkerboard(cell, degrees)
    assert len(corners) > 80
    assert misses(corners, extract(grey, "gftt", "teblid", max_features=10_000)).max() < 1.0


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_harris_follows_a_shift_by_parts_of_a_pixel(
    quarters: int, make_picture: MakePicture
) -> None:
    scene = cv2.GaussianBlur(make_picture(8, (1600, 1200)), (0, 0), 1.6)
    shown = []
    for shift in (0, quarters):
        part = scene[shift : 1196 + shift, shift : 1596 + shift]
        grey = np.asarray(cv2.resize(part, (399, 299), interpolation=cv2.INTER_AREA), np.uint8)
        found = extract(grey, "harris", "teblid", max_features=3000)
        shown.append(found[found.sizes == found.sizes.min()])
    before, after = shown
    pairs = match(before, after, MatchingSettings())
    moved = after.points[pairs.cur] - before.points[pairs.ref]
    miss = np.linalg.norm(moved + quarters / 4, axis=1)
    assert len(pairs) > 300
    assert np.mean(miss < 1) > 0.95
    assert np.sqrt(np.mean(miss[miss < 1] ** 2)) < 0.42
    assert np.abs(moved[miss < 1].mean(axis=0) + quarters / 4).max() < 0.07


def test_no_features_are_no_features() -> None:
    none = no_features()
    assert len(none) == 0
    assert len(none[np.zeros(0, np.bool_)]) == 0


def test_rows_of_features_stay_together(make_picture: MakePicture) -> None:
    found = extract(make_picture(7, SIZE), "harris")
    rows = np.array([3, 0, 7])
    chosen = found[rows]
    np.testing.assert_array_equal(chosen.points, found.points[rows])
    np.testing.assert_array_equal(chosen.descriptors, found.descriptors[rows])
    assert len(found[found.responses > np.median(found.responses)]) <= len(found) / 2 + 1
