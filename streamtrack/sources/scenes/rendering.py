"""Pictures of textured planes: warping without aliasing, exact to the hundredth of a pixel.

A `Sprite` is a picture with coverage (premultiplied BGRA) and its mip pyramid. It is warped from
the level that fits the local scale and, where the plane is seen smaller than painted, onto a grid
twice as fine which is then averaged, so edges are soft and centres stay where they are.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.geometry import (
    bounding_box,
    box_quad,
    inverted,
    scaling,
    transform_points,
    translation,
)
from streamtrack.types import Image, Matrix, Points, Size

Floats = npt.NDArray[np.float32]
Box = tuple[int, int, int, int]
"""x0, y0, x1, y1 in whole pixels of the frame, the last ones left out."""

LEVELS = 5
MARGIN = 32
DENSITY = 1.3
"""Most texels a sample may stand for before the next coarser level is taken."""


def premultiplied(bgr: Image, coverage: Image | None = None) -> Image:
    """BGRA with the colours already weighted by their coverage (H, W)."""
    if coverage is None:
        coverage = np.full(bgr.shape[:2], 255, np.uint8)
    weight = coverage.astype(np.float32)[..., None] / 255.0
    colour = np.rint(bgr.astype(np.float32) * weight).astype(np.uint8)
    return np.dstack([colour, coverage])


def over(below: Image, above: Image) -> Image:
    """Lay one premultiplied BGRA picture over another of the same size."""
    rest = 1.0 - above[..., 3:].astype(np.float32) / 255.0
    result: Image = np.rint(above + below * rest).clip(0, 255).astype(np.uint8)
    return result


class Sprite:
    """A premultiplied BGRA picture ready to be warped; its own pixels are the plane's units."""

    def __init__(self, bgra: Image, shadow: float = 0.0) -> None:
        self.size_wh: Size = (bgra.shape[1], bgra.shape[0])
        self.levels = _pyramid(_with_margin(bgra, shadow))
        self.coverage = np.ascontiguousarray(bgra[..., 3])
        height, width = self.levels[0].shape[:2]
        self.outline = box_quad(-MARGIN - 0.5, -MARGIN - 0.5, width, height)

    @property
    def quad(self) -> Points:
        """The picture's outer pixel edges."""
        return box_quad(-0.5, -0.5, *self.size_wh)

    def box_in(self, frame_from_sprite: Matrix, size_wh: Size) -> Box:
        """The part of the frame that the sprite and its shadow can reach."""
        x0, y0, x1, y1 = bounding_box(transform_points(frame_from_sprite, self.outline))
        left, top = max(math.floor(x0), 0), max(math.floor(y0), 0)
        return left, top, min(math.ceil(x1) + 1, size_wh[0]), min(math.ceil(y1) + 1, size_wh[1])

    def warped(self, frame_from_sprite: Matrix, box: Box, is_quick: bool = False) -> Image:
        """Premultiplied BGRA of the sprite inside ``box``; quick means no finer grid."""
        density = texel_density(frame_from_sprite, self.quad)
        matrix = frame_from_sprite @ translation(-MARGIN, -MARGIN)
        return warp(self.levels, matrix, density, box, is_quick, cv2.BORDER_CONSTANT)

    def covers(self, sprite_points: Points) -> npt.NDArray[np.bool_]:
        """Which points (N, 2) of the plane the picture covers by more than half."""
        found = np.rint(sprite_points).astype(np.int64)
        width, height = self.size_wh
        is_inside = ((found >= 0) & (found < (width, height))).all(axis=1)
        column, row = np.clip(found, 0, (width - 1, height - 1)).T
        hit: npt.NDArray[np.bool_] = is_inside & (self.coverage[row, column] > 127)
        return hit


def _with_margin(bgra: Image, shadow: float) -> Image:
    """Pad for the shadow and so that every level halves evenly; cast the shadow."""
    height, width = bgra.shape[:2]
    unit = 1 << (LEVELS - 1)
    extra_x, extra_y = -(width + 2 * MARGIN) % unit, -(height + 2 * MARGIN) % unit
    padded: Image = np.pad(
        bgra, ((MARGIN, MARGIN + extra_y), (MARGIN, MARGIN + extra_x), (0, 0))
    ).astype(np.uint8)
    if shadow <= 0:
        return padded
    moved = np.roll(padded[..., 3], (9, 7), (0, 1)).astype(np.float32)
    soft = cv2.GaussianBlur(moved, (0, 0), 6.0) * shadow
    dark = np.zeros_like(padded)
    dark[..., 3] = np.rint(soft).astype(np.uint8)
    return over(dark, padded)


def _pyramid(picture: Image, levels: int = LEVELS) -> list[Image]:
    result = [np.ascontiguousarray(picture)]
    for _ in range(levels - 1):
        height, width = result[-1].shape[:2]
        half = cv2.resize(result[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA)
        result.append(np.asarray(half, np.uint8))
    return result


def texel_density(frame_from_texture: Matrix, quad: Points) -> float:
    """Texels a frame pixel spans along the worst direction, typically over the quad."""
    points = np.vstack([quad, quad.mean(axis=0)]).astype(np.float64)
    homogeneous = points @ frame_from_texture[:, :2].T + frame_from_texture[:, 2]
    depth = homogeneous[:, 2, None, None]
    seen = homogeneous[:, :2] / homogeneous[:, 2:]
    outer = seen[:, :, None] * frame_from_texture[None, 2:, :2]
    jacobians = (frame_from_texture[None, :2, :2] - outer) / depth
    return float(1.0 / np.median(np.linalg.svd(jacobians, compute_uv=False)[:, 1]))


def warp(
    levels: list[Image], matrix: Matrix, density: float, box: Box, is_quick: bool, border: int
) -> Image:
    """Warp the level of a pyramid that fits into a box of the frame."""
    fine = 1 if is_quick or density <= 1.1 else 2
    level = min(max(math.ceil(math.log2(density / fine / DENSITY)), 0), len(levels) - 1)
    into_box = scaling(fine) @ translation(-box[0], -box[1])
    whole = into_box @ matrix @ inverted(scaling(0.5**level))
    size = fine * (box[2] - box[0]), fine * (box[3] - box[1])
    warped = cv2.warpPerspective(
        levels[level], whole, size, flags=cv2.INTER_LINEAR, borderMode=border
    )
    if fine == 2:
        half = size[0] // 2, size[1] // 2
        warped = cv2.resize(warped, half, interpolation=cv2.INTER_AREA)
    return np.asarray(warped, np.uint8)


class Ground:
    """A textured plane that fills the frame; ``period`` > 0 repeats it along x for ever."""

    def __init__(self, picture: Image, period: int = 0) -> None:
        self.picture = np.ascontiguousarray(picture)
        self.period = period

    def warped(self, frame_from_ground: Matrix, size_wh: Size) -> Image:
        """The whole frame; beyond the picture its border goes on."""
        matrix = frame_from_ground
        if self.period:
            corners = box_quad(0, 0, size_wh[0] - 1, size_wh[1] - 1)
            left = float(np.min(transform_points(inverted(matrix), corners)[:, 0]))
            matrix = matrix @ translation(self.period * math.floor((left - 2) / self.period), 0)
        box = (0, 0, *size_wh)
        return warp([self.picture], matrix, 1.0, box, True, cv2.BORDER_REPLICATE)


def laid_over(canvas: Floats, layer: Image, box: Box) -> None:
    """Composite a premultiplied layer onto float32 BGR, in place, inside ``box``."""
    part = canvas[box[1] : box[3], box[0] : box[2]]
    rest = cv2.cvtColor(255 - layer[..., 3], cv2.COLOR_GRAY2BGR)
    cv2.multiply(part, rest, part, 1.0 / 255.0, cv2.CV_32F)
    cv2.add(part, cv2.cvtColor(layer, cv2.COLOR_BGRA2BGR), part, None, cv2.CV_32F)


class NoiseBank:
    """Gaussian noise of unit deviation, cut from one stored block at random places."""

    SLACK = 256

    def __init__(self, rng: np.random.Generator, size_wh: Size) -> None:
        shape = (size_wh[1] + self.SLACK, size_wh[0] + self.SLACK, 3)
        self.block = rng.standard_normal(shape, np.float32)
        self.size_wh = size_wh

    def cut(self, rng: np.random.Generator) -> Floats:
        """Noise (H, W, 3) for one frame, a view not to be written to."""
        y, x = rng.integers(self.SLACK, size=2)
        part = self.block[y : y + self.size_wh[1], x : x + self.size_wh[0]]
        return part[:: int(rng.choice([-1, 1]))]
