"""What the painters paint with: noise, soft shapes and text on BGR pictures."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.types import Image, Size

Colour = tuple[int, int, int]
Floats = npt.NDArray[np.float32]
WORDS = (
    *("lorem", "ipsum", "dolor", "sit", "amet", "consectetur", "adipiscing", "elit"),
    *("sed", "do", "eiusmod", "tempor", "incididunt", "ut", "labore", "et"),
    *("dolore", "magna", "aliqua", "enim", "ad", "minim", "veniam", "quis"),
    *("nostrud", "exercitation", "ullamco", "laboris", "nisi", "aliquip", "ex", "ea"),
    *("commodo", "consequat", "duis", "aute", "irure", "in", "reprehenderit", "voluptate"),
    *("velit"),
)


def plain(size_wh: Size, colour: Colour) -> Image:
    """A picture of one colour."""
    return np.full((size_wh[1], size_wh[0], 3), colour, np.uint8)


def cloud(
    rng: np.random.Generator,
    size_wh: Size,
    cell: float,
    octaves: int = 4,
    stretch: float = 1.0,
    is_periodic: bool = False,
) -> Floats:
    """Natural variation within about -1..1: octaves of smooth noise, the coarsest ``cell`` px.

    ``stretch`` > 1 draws it out along x; periodic means that left and right edges meet.
    """
    total = np.zeros((size_wh[1], size_wh[0]), np.float32)
    weight = 1.0
    for _ in range(octaves):
        cols = max(round(size_wh[0] / (cell * stretch)), 2)
        rows = max(round(size_wh[1] / cell), 2)
        total += weight * _smooth_noise(rng, size_wh, cols, rows, is_periodic)
        cell, weight = max(cell / 2.0, 1.0), weight * 0.55
    return total / np.float32(0.8)


def _smooth_noise(
    rng: np.random.Generator, size_wh: Size, cols: int, rows: int, is_periodic: bool
) -> Floats:
    grid = rng.uniform(-1.0, 1.0, (rows, cols)).astype(np.float32)
    if not is_periodic:
        return np.asarray(cv2.resize(grid, size_wh, interpolation=cv2.INTER_CUBIC), np.float32)
    pad = 2
    wide = np.pad(grid, ((0, 0), (pad, pad)), mode="wrap")
    width = round(size_wh[0] * (cols + 2 * pad) / cols)
    big = cv2.resize(wide, (width, size_wh[1]), interpolation=cv2.INTER_CUBIC)
    left = (width - size_wh[0]) // 2
    return np.asarray(big[:, left : left + size_wh[0]], np.float32)


def tinted(picture: Image, field: Floats, strength: float) -> Image:
    """Brighten and darken by a field (H, W) of -1..1; ``strength`` in grey levels."""
    change = cv2.cvtColor(np.float32(strength) * field, cv2.COLOR_GRAY2BGR)
    return np.asarray(cv2.add(picture, change, dtype=cv2.CV_8U), np.uint8)


def mixed(base: Image, other: Image | Colour, share: Floats) -> Image:
    """Blend towards another picture or colour by a share (H, W) of 0..1."""
    weight = cv2.cvtColor(np.clip(share, 0.0, 1.0), cv2.COLOR_GRAY2BGR)
    goal = plain((base.shape[1], base.shape[0]), other) if isinstance(other, tuple) else other
    change = cv2.multiply(cv2.subtract(goal, base, dtype=cv2.CV_32F), weight)
    return np.asarray(cv2.add(base, change, dtype=cv2.CV_8U), np.uint8)


def varied(rng: np.random.Generator, colour: Colour, spread: int) -> Colour:
    """The colour, a little different each time."""
    blue, green, red = np.clip(np.array(colour) + rng.integers(-spread, spread + 1, 3), 0, 255)
    return int(blue), int(green), int(red)


def shade(colour: Colour, factor: float) -> Colour:
    """The colour, darker (< 1) or lighter (> 1)."""
    blue, green, red = (int(min(max(c * factor, 0), 255)) for c in colour)
    return blue, green, red


def box(picture: Image, x: float, y: float, w: float, h: float, colour: Colour) -> None:
    """A filled box."""
    cv2.rectangle(
        picture, (round(x), round(y)), (round(x + w) - 1, round(y + h) - 1), colour, cv2.FILLED
    )


def frame_box(
    picture: Image, x: float, y: float, w: float, h: float, colour: Colour, line: int
) -> None:
    """The outline of a box."""
    corners = [(x, y), (x + w, y), (x + w, y + h), (x, y + h)]
    polygon = np.rint(corners).astype(np.int32)
    cv2.polylines(picture, [polygon], True, colour, line, cv2.LINE_AA)


def disc(picture: Image, x: float, y: float, radius: float, colour: Colour) -> None:
    """A filled disc with soft edges."""
    centre = round(x * 16), round(y * 16)
    cv2.circle(picture, centre, max(round(radius * 16), 1), colour, cv2.FILLED, cv2.LINE_AA, 4)


def shape(picture: Image, points: npt.ArrayLike, colour: Colour) -> None:
    """A filled polygon (N, 2) with soft edges."""
    polygon = np.rint(np.asarray(points, np.float64) * 16).astype(np.int32)
    cv2.fillPoly(picture, [polygon], colour, cv2.LINE_AA, 4)


def stroke(picture: Image, points: npt.ArrayLike, colour: Colour, line: int) -> None:
    """A line through points (N, 2)."""
    course = np.rint(np.asarray(points, np.float64) * 16).astype(np.int32)
    cv2.polylines(picture, [course], False, colour, line, cv2.LINE_AA, 4)


def round_box_points(x: float, y: float, w: float, h: float, radius: float) -> Floats:
    """Outline (N, 2) of a box with rounded corners."""
    radius = min(radius, w / 2, h / 2)
    arcs = []
    for k, (cx, cy) in enumerate(
        (
            (x + w - radius, y + h - radius),
            (x + radius, y + h - radius),
            (x + radius, y + radius),
            (x + w - radius, y + radius),
        )
    ):
        angle = np.linspace(k, k + 1, 9) * np.pi / 2
        arcs.append(np.column_stack([cx + radius * np.cos(angle), cy + radius * np.sin(angle)]))
    return np.vstack(arcs).astype(np.float32)


def turned_box(middle: npt.ArrayLike, size: npt.ArrayLike, angle: float) -> npt.NDArray[np.float64]:
    """Corners (4, 2) of a box about ``middle`` (x, y), of ``size`` (w, h), turned by ``angle``."""
    half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.asarray(size, np.float64) / 2.0
    c, s = np.cos(angle), np.sin(angle)
    turned = half @ np.array([[c, s], [-s, c]])
    corners: npt.NDArray[np.float64] = turned + np.asarray(middle, np.float64)
    return corners


def write(
    picture: Image,
    text: str,
    at: tuple[float, float],
    size: int,
    colour: Colour,
    weight: int = 400,
    face: str = "sans",
) -> float:
    """Text with its base line's left end ``at``; returns the x where it ends."""
    end, _ = cv2.putText(
        picture, text, (round(at[0]), round(at[1])), colour, cv2.FontFace(face), size, weight
    )
    return float(end[0])


def label(
    picture: Image, text: str, middle: tuple[float, float], size: int, colour: Colour
) -> None:
    """Text about a middle."""
    write(
        picture, text, (middle[0] - 0.29 * size * len(text), middle[1] + 0.36 * size), size, colour
    )


def soft_shadow(
    picture: Image, points: npt.ArrayLike, blur: float, dark: float, shift: tuple[float, float]
) -> None:
    """Darken under a polygon (N, 2) moved by ``shift``, in place."""
    moved = np.asarray(points, np.float64) + shift
    reach = 3 * blur + 2
    x0, y0 = np.maximum(np.floor(moved.min(axis=0) - reach), 0).astype(int)
    x1, y1 = np.ceil(moved.max(axis=0) + reach).astype(int)
    part = picture[y0:y1, x0:x1]
    if part.size == 0:
        return
    mask = np.zeros(part.shape[:2], np.uint8)
    cv2.fillPoly(mask, [np.rint((moved - (x0, y0)) * 16).astype(np.int32)], (255,), cv2.LINE_AA, 4)
    share = cv2.GaussianBlur(mask, (0, 0), blur).astype(np.float32) * (dark / 255.0)
    part[:] = (part * (1.0 - share[..., None])).astype(np.uint8)


def text_block(
    picture: Image,
    rng: np.random.Generator,
    area: tuple[float, float, float, float],
    size: int,
    colour: Colour,
    words: Sequence[str] = WORDS,
) -> None:
    """Fill an area (x, y, w, h) with lines of words."""
    x, y, width, height = area
    base = y + size
    while base <= y + height:
        at = x
        while True:
            word = str(rng.choice(words))
            if at + 0.56 * size * len(word) > x + width:
                break
            at = write(picture, word, (at, base), size, colour) + 0.3 * size
        base += 1.4 * size
