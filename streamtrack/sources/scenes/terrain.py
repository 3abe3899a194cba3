"""Land from the air: fields with rows, hedges, roads, a river, villages, woods."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.sources.scenes.canvas import (
    Colour,
    box,
    cloud,
    disc,
    mixed,
    plain,
    shade,
    shape,
    soft_shadow,
    stroke,
    tinted,
    turned_box,
    varied,
)
from streamtrack.types import Image, Size

Line = npt.NDArray[np.float64]
CROPS: tuple[Colour, ...] = (
    (66, 128, 104),
    (84, 156, 164),
    (120, 176, 198),
    (70, 104, 134),
    (54, 108, 76),
    (98, 150, 128),
    (60, 140, 150),
)
ROOFS: tuple[Colour, ...] = ((62, 82, 168), (74, 92, 128), (96, 98, 104), (52, 66, 120))


def paint_tree(land: Image, rng: np.random.Generator, x: float, y: float, radius: float) -> None:
    """A crown of leaves with its shadow, lit from the upper left."""
    height, width = land.shape[:2]
    if not (-radius < x < width + radius and -radius < y < height + radius):
        return
    around = np.arange(12) * np.pi / 6
    crown = np.column_stack([x + radius * np.cos(around), y + radius * np.sin(around)])
    soft_shadow(land, crown, 2.5, 0.55, (0.45 * radius, 0.55 * radius))
    base = varied(rng, (44, 92, 58), 16)
    disc(land, x, y, radius, shade(base, 0.75))
    for _ in range(9):
        angle, reach = rng.uniform(0, 2 * np.pi), rng.uniform(0.2, 0.75) * radius
        dx, dy = reach * np.cos(angle), reach * np.sin(angle)
        light = 1.0 - 0.38 * (dx + dy) / radius
        disc(land, x + dx, y + dy, radius * rng.uniform(0.22, 0.42), shade(base, light))


def paint_house(
    land: Image,
    rng: np.random.Generator,
    middle: tuple[float, float],
    size: tuple[float, float],
    angle: float,
) -> None:
    """A gabled or hipped roof with tiles, a chimney, perhaps solar panels."""
    corners = turned_box(middle, size, angle)
    height, width = land.shape[:2]
    if (corners.max(axis=0) < -30).any() or (corners.min(axis=0) > (width + 30, height + 30)).any():
        return
    soft_shadow(land, corners, 4, 0.6, (9, 11))
    roof = varied(rng, ROOFS[int(rng.integers(len(ROOFS)))], 7)
    right, down = (corners[1] - corners[0]), (corners[3] - corners[0])
    hip = float(rng.choice([0.0, 0.22]))
    ridge = corners[0] + 0.5 * down + np.array([[hip], [1 - hip]]) * right
    shape(land, [corners[0], corners[1], ridge[1], ridge[0]], shade(roof, 1.25))
    shape(land, [corners[3], corners[2], ridge[1], ridge[0]], shade(roof, 0.82))
    shape(land, [corners[0], ridge[0], corners[3]], shade(roof, 1.08))
    shape(land, [corners[1], ridge[1], corners[2]], shade(roof, 0.95))
    for k in np.arange(0.1, 0.95, 0.09):
        inset = hip * (1 - abs(2 * k - 1)) if hip == 0 else hip * min(k, 1 - k) * 2
        ends = corners[0] + k * down + np.array([[inset], [1 - inset]]) * right
        stroke(land, ends, shade(roof, 1.1 if k < 0.5 else 0.7), 1)
    stroke(land, ridge, shade(roof, 1.5), 2)
    _on_roof(land, rng, corners, right, down)


def _on_roof(land: Image, rng: np.random.Generator, corners: Line, right: Line, down: Line) -> None:
    at = corners[0] + rng.uniform(0.25, 0.75) * right + 0.36 * down
    soft_shadow(land, turned_box(at, (10, 10), 0), 2, 0.6, (5, 6))
    shape(land, turned_box(at, (11, 11), 0), (92, 104, 140))
    shape(land, turned_box(at, (5, 5), 0), (30, 30, 34))
    if rng.random() < 0.4:
        first = corners[0] + rng.uniform(0.2, 0.4) * right + 0.6 * down
        for k in range(3):
            panel = first + k * 0.12 * right
            shape(
                land,
                [
                    panel,
                    panel + 0.11 * right,
                    panel + 0.11 * right + 0.26 * down,
                    panel + 0.26 * down,
                ],
                (96, 58, 36),
            )


def paint_terrain(rng: np.random.Generator, size_wh: Size, landmark: Line) -> Image:
    """Land of any size with a big farmhouse that fills the quad ``landmark`` (4, 2)."""
    land = _fields(rng, size_wh)
    land = tinted(land, cloud(rng, size_wh, 420, 6), 14)
    _water(land, rng)
    roads = _roads(land, rng)
    grain = cloud(rng, size_wh, 5, 2)
    land = tinted(land, grain, 12)
    middle = landmark.mean(axis=0)
    _villages(land, rng, roads, middle)
    _woods(land, rng, middle)
    _farm(land, rng, landmark)
    return land


def _fields(rng: np.random.Generator, size_wh: Size) -> Image:
    """Patchwork: every cell of a jittered lattice is a field with rows in its own direction."""
    width, height = size_wh
    land = plain(size_wh, (74, 112, 92))
    step = 330
    cols, rows = width // step + 3, height // step + 3
    lattice = np.stack(np.meshgrid(np.arange(cols), np.arange(rows)), axis=-1) - 0.7
    corners = lattice * step + rng.uniform(-90, 90, (rows, cols, 2))
    for row in range(rows - 1):
        for col in range(cols - 1):
            field = corners[[row, row, row + 1, row + 1], [col, col + 1, col + 1, col]]
            for part in _split(rng, field):
                _field(land, rng, part)
    for row in range(rows):
        stroke(land, corners[row], (60, 88, 70), 5)
    for col in range(cols):
        stroke(land, corners[:, col], (60, 88, 70), 5)
    return land


def _split(rng: np.random.Generator, field: Line) -> list[Line]:
    if rng.random() < 0.45:
        return [field]
    share = rng.uniform(0.35, 0.65)
    a, b, c, d = field
    upper, lower = a + share * (b - a), d + share * (c - d)
    return [np.array([a, upper, lower, d]), np.array([upper, b, c, lower])]


def _field(land: Image, rng: np.random.Generator, field: Line) -> None:
    """One crop: its ground, rows of plants or ploughing, tracks of a tractor."""
    low = np.floor(field.min(axis=0)).astype(int)
    high = np.ceil(field.max(axis=0)).astype(int) + 1
    size = int(high[0] - low[0]), int(high[1] - low[1])
    crop = varied(rng, CROPS[int(rng.integers(len(CROPS)))], 12)
    patch = tinted(plain(size, crop), cloud(rng, size, 90, 4), 13)
    angle = rng.choice(
        [np.arctan2(*(field[1] - field[0])[::-1]), np.arctan2(*(field[3] - field[0])[::-1])]
    )
    y, x = np.mgrid[: size[1], : size[0]].astype(np.float32)
    across = x * np.float32(-np.sin(angle)) + y * np.float32(np.cos(angle))
    across += 2.5 * cloud(rng, size, 60, 2)
    spacing, depth = float(rng.uniform(6, 15)), float(rng.uniform(0, 13))
    patch = tinted(patch, np.sin(across * np.float32(2 * np.pi / spacing)), depth)
    tracks = (np.mod(across, 70) < 3) | (np.mod(across + 12, 70) < 3)
    patch = mixed(patch, shade(crop, 0.72), tracks.astype(np.float32) * 0.7)
    mask = np.zeros((size[1], size[0]), np.uint8)
    cv2.fillPoly(mask, [np.rint((field - low) * 16).astype(np.int32)], (255,), cv2.LINE_AA, 4)
    x0, y0 = np.maximum(low, 0)
    x1, y1 = np.minimum(high, (land.shape[1], land.shape[0]))
    if x1 <= x0 or y1 <= y0:
        return
    cut = np.s_[y0 - low[1] : y1 - low[1], x0 - low[0] : x1 - low[0]]
    land[y0:y1, x0:x1] = mixed(land[y0:y1, x0:x1], patch[cut], mask[cut].astype(np.float32) / 255.0)


def _winding(rng: np.random.Generator, size_wh: Size, bend: float) -> Line:
    """A smooth line across the land from one side to the other."""
    reach = float(np.hypot(*size_wh))
    along = np.linspace(-0.6, 0.6, 80) * reach
    angle = rng.uniform(0, np.pi)
    aside = bend * (np.sin(along / 310 + rng.uniform(0, 6)) + 0.5 * np.sin(along / 127))
    start = rng.uniform((0.2 * size_wh[0], 0.2 * size_wh[1]), (0.8 * size_wh[0], 0.8 * size_wh[1]))
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    course: Line = np.column_stack([along, aside]) @ turn + start
    return course


def _water(land: Image, rng: np.random.Generator) -> None:
    height, width = land.shape[:2]
    course = _winding(rng, (width, height), 110)
    mask = np.zeros((height, width), np.uint8)
    cv2.polylines(mask, [np.rint(course).astype(np.int32)], False, (255,), 58, cv2.LINE_AA)
    for _ in range(max(width * height // 2_000_000, 1)):
        x, y = rng.uniform((0, 0), (width, height))
        cv2.ellipse(
            mask, (int(x), int(y)), (110, 64), float(rng.uniform(0, 180)), 0, 360, (255,), -1
        )
    stroke(land, course, (88, 128, 128), 76)
    share = cv2.GaussianBlur(mask, (0, 0), 3.0).astype(np.float32) / 255.0
    water = tinted(plain((width, height), (112, 88, 52)), cloud(rng, (width, height), 36, 4), 8)
    land[:] = mixed(land, water, share)


def _roads(land: Image, rng: np.random.Generator) -> list[Line]:
    height, width = land.shape[:2]
    roads = [_winding(rng, (width, height), 46) for _ in range(3 + width * height // 1_200_000)]
    for k, course in enumerate(roads):
        line = (20, 13, 9)[min(k, 2) if k < 4 else 2]
        stroke(land, course, (98, 132, 138), line + 6)
        stroke(land, course, (122, 122, 122) if line > 10 else (142, 170, 184), line)
        if line == 20:
            for start in range(len(course) - 1):
                ends = course[start] + np.array([[0.1], [0.5]]) * (
                    course[start + 1] - course[start]
                )
                stroke(land, ends, (220, 224, 224), 2)
    return roads


def _villages(land: Image, rng: np.random.Generator, roads: list[Line], keep_out: Line) -> None:
    """Houses in gardens along stretches of the roads."""
    for course in roads:
        for at in range(2, len(course) - 2, 2):
            if rng.random() < 0.45:
                continue
            ahead = course[at + 1] - course[at]
            angle = float(np.arctan2(ahead[1], ahead[0]))
            aside = np.array([-np.sin(angle), np.cos(angle)]) * float(rng.choice([-1, 1]))
            spot = course[at] + aside * rng.uniform(52, 66)
            if np.hypot(*(spot - keep_out)) < 150:
                continue
            garden = turned_box(spot, (100, 84), angle)
            shape(land, garden, varied(rng, (84, 144, 118), 16))
            stroke(land, np.vstack([garden, garden[:1]]), (54, 84, 66), 3)
            size = float(rng.uniform(42, 66)), float(rng.uniform(32, 44))
            paint_house(land, rng, (float(spot[0]), float(spot[1])), size, angle)
            for _ in range(3):
                x, y = spot + rng.uniform(-46, 46, 2)
                paint_tree(land, rng, float(x), float(y), float(rng.uniform(5, 10)))


def _woods(land: Image, rng: np.random.Generator, keep_out: Line) -> None:
    """Woods where a broad random field is high, single trees elsewhere."""
    height, width = land.shape[:2]
    density = cloud(rng, (width, height), 520, 3)
    count = width * height // 1500
    for x, y in rng.uniform((0, 0), (width, height), (count, 2)):
        is_wood = density[int(y), int(x)] > 0.42
        if (is_wood or rng.random() < 0.07) and np.hypot(x - keep_out[0], y - keep_out[1]) > 120:
            paint_tree(land, rng, float(x), float(y), float(rng.uniform(9, 19)))


def _farm(land: Image, rng: np.random.Generator, landmark: Line) -> None:
    """The landmark: a farmhouse on its yard, with a barn, a car and trees."""
    x, y = landmark.mean(axis=0)
    width, height = np.ptp(landmark, axis=0)
    yard = turned_box((x, y), (2.0 * width, 2.0 * height), 0.0)
    shape(land, yard, (150, 172, 184))
    low = np.maximum(yard[0], 0).astype(int)
    part = land[low[1] : int(yard[2][1]), low[0] : int(yard[2][0])]
    part[:] = tinted(part, cloud(rng, (part.shape[1], part.shape[0]), 30, 4), 10)
    paint_house(land, rng, (x, y), (width, height), 0.0)
    for k in range(4):
        box(land, x - 0.4 * width + 0.22 * k * width, y + 0.2 * height, 10, 8, (150, 120, 90))
    paint_house(land, rng, (x - 0.74 * width, y - 0.1 * height), (0.36 * width, 0.9 * height), 0.0)
    shape(land, turned_box((x + 0.72 * width, y + 0.6 * height), (30, 15), 0.5), (60, 60, 190))
    for dx, dy in ((0.8, -0.7), (-0.85, 0.8), (0.5, 0.85)):
        paint_tree(land, rng, x + dx * width, y + dy * height, 15)
