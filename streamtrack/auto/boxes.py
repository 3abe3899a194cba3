"""Upright boxes (4,) x0, y0, x1, y1: their middles, sizes and how much of them is common."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.types import Matrix, Size

Doubles: TypeAlias = npt.NDArray[np.float64]

_EDGE_PX = 3.0
_LEAST_DEPTH = 1e-20


class HasBox:
    """What lies in a ``box``, pixels of the frame."""

    __slots__ = ()
    box: Doubles

    @property
    def center(self) -> Doubles:
        return 0.5 * (self.box[:2] + self.box[2:])

    @property
    def size(self) -> Doubles:
        return self.box[2:] - self.box[:2]


def box_around(center: Doubles, size: Doubles) -> Doubles:
    return np.concatenate([center - 0.5 * size, center + 0.5 * size])


def moved_point(b_from_a: Matrix, point: Doubles) -> tuple[Doubles, float]:
    """A point (2,) in the other picture, and how much larger things are there."""
    row_x, row_y, row_depth = b_from_a.tolist()
    x, y = point.tolist()
    depth = row_depth[0] * x + row_depth[1] * y + row_depth[2]
    if abs(depth) < _LEAST_DEPTH:
        return point, 1.0
    moved_x, moved_y = ((row[0] * x + row[1] * y + row[2]) / depth for row in (row_x, row_y))
    if not (math.isfinite(moved_x) and math.isfinite(moved_y)):
        return point, 1.0
    scale = min(max(geometry.local_scale(b_from_a, point), 0.5), 2.0)
    return np.array([moved_x, moved_y]), scale


def turning(b_from_a: Matrix, point: Doubles) -> complex:
    """How much larger and by which angle turned things are at a point (2,) of the other picture."""
    around = point + np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]])
    low_x, high_x, low_y, high_y = (
        complex(*place) for place in geometry.transform_points(b_from_a, around).tolist()
    )
    return 0.25 * ((high_x - low_x) - 1j * (high_y - low_y))


def moved_points(b_from_a: Matrix, points: Doubles) -> tuple[Doubles, Doubles]:
    """`moved_point` of each of the points (N, 2): places (N, 2), and scales (N,)."""
    depths = points @ b_from_a[2, :2] + b_from_a[2, 2]
    is_flat = np.abs(depths) < _LEAST_DEPTH
    depths = np.where(is_flat, 1.0, depths)
    moved = (points @ b_from_a[:2, :2].T + b_from_a[:2, 2]) / depths[:, None]
    is_lost = is_flat | ~np.isfinite(moved).all(axis=1)
    scales = np.sqrt(np.abs(np.linalg.det(b_from_a) / depths**3))
    scales = np.where(is_lost, 1.0, np.clip(scales, 0.5, 2.0))
    return np.where(is_lost[:, None], points, moved), scales


def moved_boxes(b_from_a: Matrix, boxes: Doubles) -> tuple[Doubles, Doubles]:
    """Boxes (N, 4) in the other picture, upright as before, and how much larger they are (N,)."""
    middles, scales = moved_points(b_from_a, 0.5 * (boxes[:, :2] + boxes[:, 2:]))
    halves = 0.5 * scales[:, None] * (boxes[:, 2:] - boxes[:, :2])
    return np.concatenate([middles - halves, middles + halves], axis=1), scales


def touched_edges(box: Doubles, size_wh: Size) -> npt.NDArray[np.bool_]:
    """Which of the picture's edges (4,) left, top, right, bottom a box reaches."""
    x0, y0, x1, y1 = box.tolist()
    width, height = size_wh
    near, far = _EDGE_PX - 0.5, -0.5 - _EDGE_PX
    return np.array([x0 <= near, y0 <= near, x1 >= width + far, y1 >= height + far])


def overlap(one: Doubles, other: Doubles) -> tuple[float, float]:
    """Intersection of two boxes (4,) over their union, and over the first."""
    x0, y0, x1, y1 = one.tolist()
    u0, v0, u1, v1 = other.tolist()
    width, height = min(x1, u1) - max(x0, u0), min(y1, v1) - max(y0, v0)
    if width <= 0 or height <= 0:
        return 0.0, 0.0
    common, area = width * height, (x1 - x0) * (y1 - y0)
    return common / (area + (u1 - u0) * (v1 - v0) - common), common / area


def overlaps(ones: Doubles, others: Doubles) -> tuple[Doubles, Doubles]:
    """`overlap` of each of the boxes (N, 4) with each of the others (M, 4), both (N, M)."""
    low = np.maximum(ones[:, None, :2], others[None, :, :2])
    high = np.minimum(ones[:, None, 2:], others[None, :, 2:])
    common = np.prod(np.maximum(high - low, 0.0), axis=2)
    area = np.prod(ones[:, 2:] - ones[:, :2], axis=1)[:, None]
    other_area = np.prod(others[:, 2:] - others[:, :2], axis=1)[None]
    return common / (area + other_area - common), common / area
