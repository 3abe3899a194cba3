"""A road seen from above, endless along x, and the car that drives on it."""

from __future__ import annotations

import cv2
import numpy as np

from streamtrack.sources.scenes.canvas import (
    Colour,
    box,
    cloud,
    frame_box,
    mixed,
    plain,
    round_box_points,
    shade,
    shape,
    stroke,
    tinted,
    varied,
)
from streamtrack.sources.scenes.rendering import Ground, over, premultiplied
from streamtrack.sources.scenes.terrain import paint_house, paint_tree
from streamtrack.types import Image, Size

PERIOD = 1680
CAR_SIZE: Size = (480, 216)
PAINTS: tuple[Colour, ...] = ((40, 40, 190), (170, 96, 40), (214, 214, 210), (50, 150, 220))
GLASS: Colour = (74, 56, 44)
TYRE: Colour = (28, 28, 28)


def paint_road(rng: np.random.Generator, height: int, lane_px: int, margin: int) -> Ground:
    """Two lanes each way in the middle of ``height``, verges, houses and trees beside them."""
    size = PERIOD, height
    grass = plain(size, (62, 112, 92))
    grass = mixed(grass, (82, 140, 142), cloud(rng, size, 210, 5, 1.0, True) * 0.5 + 0.2)
    grass = tinted(grass, cloud(rng, size, 7, 3, 1.0, True), 15)
    half = 2 * lane_px + 26
    middle = height // 2
    _verge(grass, middle - half, middle + half)
    _asphalt(grass, rng, middle, lane_px)
    wide = np.concatenate([grass, grass[:, : margin + PERIOD // 4]], axis=1)
    return Ground(_beside(wide, rng, middle, half, margin), PERIOD)


def _verge(grass: Image, top: int, bottom: int) -> None:
    box(grass, 0, top - 10, PERIOD, 14, (92, 128, 148))
    box(grass, 0, bottom - 4, PERIOD, 14, (92, 128, 148))
    for y in (top - 34, bottom + 14):
        box(grass, 0, y, PERIOD, 22, (158, 166, 170))
        for x in range(0, PERIOD, 28):
            box(grass, x, y, 2, 22, (120, 128, 132))


def _asphalt(grass: Image, rng: np.random.Generator, middle: int, lane_px: int) -> None:
    """The carriageway: grain, patches, cracks, tyre tracks and lane marks."""
    half = 2 * lane_px + 22
    size = PERIOD, 2 * half
    road = tinted(plain(size, (96, 94, 92)), cloud(rng, size, 180, 4, 2.5, True), 9)
    rows = np.arange(2 * half, dtype=np.float32)[:, None].repeat(PERIOD, 1)
    wheels = np.cos((rows - half) * np.float32(4 * np.pi / lane_px))
    road = tinted(road, wheels.astype(np.float32), 4)
    for _ in range(9):
        x, y = rng.uniform((60, 10), (PERIOD - 260, 2 * half - 60))
        patch = rng.uniform(40, 190), rng.uniform(18, 60)
        box(road, x, y, *patch, varied(rng, (80, 78, 76), 5))
        frame_box(road, x, y, *patch, (60, 58, 58), 2)
    for _ in range(26):
        x, y = rng.uniform((120, 10), (PERIOD - 120, 2 * half - 10))
        crack = np.cumsum(rng.normal(0, 9, (10, 2)), axis=0).clip(-110, 110)
        stroke(road, np.add(crack, (x, y)), (58, 56, 56), 2)
    for y in (half - 5, half + 3):
        box(road, 0, y, PERIOD, 3, (90, 190, 228))
    for y in (half - 2 * lane_px - 2, half + 2 * lane_px - 2):
        box(road, 0, y, PERIOD, 5, (222, 226, 226))
    for y in (half - lane_px - 2, half + lane_px - 2):
        for x in range(20, PERIOD, 140):
            box(road, x, y, 62, 5, shade((216, 220, 220), rng.uniform(0.85, 1.0)))
    grain = cv2.GaussianBlur(rng.standard_normal((2 * half, PERIOD)), (0, 0), 0.7)
    grass[middle - half : middle + half] = tinted(road, grain.astype(np.float32), 13)


def _beside(wide: Image, rng: np.random.Generator, middle: int, half: int, margin: int) -> Image:
    """Houses and trees, each drawn where it stands and one period further on."""
    height = wide.shape[0]
    spots: list[tuple[float, float, str]] = []
    for side in (-1, 1):
        for x in np.arange(90, PERIOD - 60, 280):
            y = middle + side * (half + 150 + rng.uniform(0, 50))
            spots.append((float(x) + rng.uniform(-30, 60), y, "house"))
    for _ in range(150):
        side = int(rng.choice([-1, 1]))
        aside = half + 60 + (height / 2 - half - 40) * float(rng.uniform()) ** 0.8
        spots.append((rng.uniform(0, PERIOD), middle + side * aside, "tree"))
    seeds = rng.integers(1 << 30, size=len(spots))
    for (left, y, kind), seed in zip(spots, seeds, strict=True):
        if kind == "tree" and any(
            o[2] == "house" and abs(o[0] - left) < 105 and abs(o[1] - y) < 90 for o in spots
        ):
            continue
        for at in (left, left + PERIOD, left - PERIOD):
            own = np.random.default_rng(int(seed))
            if kind == "house":
                paint_house(wide, own, (at, y), (own.uniform(110, 150), own.uniform(76, 104)), 0.0)
            else:
                paint_tree(wide, own, at, y, own.uniform(13, 30))
    return np.ascontiguousarray(wide[:, : PERIOD + margin])


def paint_bridge(rng: np.random.Generator, size_wh: Size) -> Image:
    """Premultiplied BGRA of a footbridge from above, planks between two railings."""
    width, height = size_wh
    deck = tinted(plain(size_wh, varied(rng, (120, 138, 150), 10)), cloud(rng, size_wh, 24, 3), 12)
    for y in range(0, height, 9):
        box(deck, 0, y, width, 2, (78, 90, 100))
    for x in (0, width - 5):
        box(deck, x, 0, 5, height, (60, 64, 70))
    return premultiplied(deck)


def paint_car(rng: np.random.Generator) -> Image:
    """Premultiplied BGRA of a car from above, its nose to the right, its box filled to the rim."""
    width, height = CAR_SIZE
    paint = varied(rng, PAINTS[int(rng.integers(len(PAINTS)))], 14)
    body = round_box_points(2, 14, width - 4, height - 28, 58)
    body[:, 1] += 7 * np.sign(height / 2 - body[:, 1]) * (body[:, 0] > 0.86 * width)
    cover = np.zeros((height, width), np.uint8)
    cv2.fillPoly(cover, [np.rint(body * 16).astype(np.int32)], (255,), cv2.LINE_AA, 4)
    car = tinted(plain(CAR_SIZE, paint), _roundness(cover), 46)
    _glass(car, paint)
    _details(car, rng, paint)
    mirrors = plain(CAR_SIZE, shade(paint, 0.7))
    ears = np.zeros_like(cover)
    for y in (12, height - 13):
        cv2.ellipse(ears, (300, y), (12, 9), 0, 0, 360, (255,), -1, cv2.LINE_AA)
    car = tinted(car, cloud(rng, CAR_SIZE, 40, 4), 5)
    return over(premultiplied(mirrors, ears), premultiplied(car, cover))


def _roundness(cover: Image) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """Brighter on top, darker towards the rim, lit from the upper left."""
    near = cv2.distanceTransform(cover, cv2.DIST_L2, 5)
    bulge = np.clip(np.asarray(near, np.float32) / 26.0, 0, 1)
    slope = cv2.GaussianBlur(bulge, (0, 0), 5)
    lit = np.gradient(slope, axis=0) * 9 + np.gradient(slope, axis=1) * 5
    return np.asarray(0.8 * bulge - 0.7 + lit, np.float32)


def _glass(car: Image, paint: Colour) -> None:
    """Windscreen, rear window, side windows, and the roof between them."""
    shape(
        car,
        [[318, 42], [262, 54], [262, 162], [318, 174], [338, 140], [342, 108], [338, 76]],
        GLASS,
    )
    shape(car, [[84, 54], [128, 62], [128, 154], [84, 162], [72, 132], [72, 84]], GLASS)
    for flip in (False, True):
        window = np.array([[104, 40], [290, 36], [256, 50], [132, 54]])
        if flip:
            window[:, 1] = CAR_SIZE[1] - window[:, 1]
        shape(car, window, shade(GLASS, 0.8))
        stroke(car, window[[0, 3]] + (96, 0), paint, 6)
    shape(car, round_box_points(128, 52, 136, 112, 18), shade(paint, 1.08))
    shape(car, round_box_points(150, 76, 60, 64, 12), shade(GLASS, 0.9))
    shape(car, [[330, 70], [322, 52], [300, 58], [318, 112]], shade(GLASS, 1.9))
    shape(car, [[80, 84], [92, 62], [104, 64], [88, 110]], shade(GLASS, 1.7))


def _details(car: Image, rng: np.random.Generator, paint: Colour) -> None:
    """Lights, lines of bonnet and doors, handles, a number on the roof, an aerial."""
    height = CAR_SIZE[1]
    for y in (36, height - 36):
        cv2.ellipse(
            car, (455, y), (17, 10), 28 if y < 90 else -28, 0, 360, (236, 244, 246), -1, cv2.LINE_AA
        )
        cv2.ellipse(car, (457, y), (8, 6), 0, 0, 360, (180, 190, 196), -1, cv2.LINE_AA)
        box(car, 6, y - 10, 11, 22, (40, 30, 190))
        box(car, 182, y - 10 if y < 90 else y + 7, 18, 4, shade(paint, 0.45))
    dark = shade(paint, 0.5)
    stroke(car, [[350, 50], [440, 60], [446, 108], [440, 156], [350, 166]], dark, 2)
    stroke(car, [[370, 90], [436, 96]], shade(paint, 1.3), 4)
    stroke(car, [[370, 126], [436, 120]], shade(paint, 1.3), 4)
    stroke(car, [[60, 44], [26, 54], [20, 108], [26, 162], [60, 172]], dark, 2)
    for x in (98, 386):
        for y in (17, height - 17):
            cv2.ellipse(car, (x, y), (30, 4), 0, 0, 360, shade(paint, 0.35), -1, cv2.LINE_AA)
    for x in (208, 296):
        stroke(car, [[x, 18], [x - 6, 40]], dark, 2)
        stroke(car, [[x, height - 18], [x - 6, height - 40]], dark, 2)
    stroke(car, [[138, 108], [120, 108]], TYRE, 3)
    text = str(rng.integers(10, 99))
    cv2.putText(car, text, (216, 126), shade(paint, 0.35), cv2.FontFace("sans"), 40, 700)
