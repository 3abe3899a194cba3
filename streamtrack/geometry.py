"""Pure functions on points, quads and 3x3 matrices."""

from __future__ import annotations

from array import array
from math import copysign, hypot, inf, isfinite, sqrt
from typing import Any

import numpy as np
import numpy.typing as npt

from streamtrack.types import Image, Matrix, Points, Size

_FEW = 8
_NEAR_HORIZON = 1e-20


def transform_points(b_from_a: Matrix, points: npt.ArrayLike) -> Points:
    """Map points (N, 2) of a into b, float32 (N, 2).

    Points on the horizon come out as inf or NaN; `registration.judge_mapping` refuses those.
    """
    pts = np.asarray(points).reshape(-1, 2)
    (a, b, c), (d, e, f), (g, h, i) = b_from_a.tolist()
    if len(pts) <= _FEW:
        # Without numpy's overhead, which for the corners of a quad is nearly all there is.
        mapped: list[float] = []
        for x, y in pts.tolist():
            depth = g * x + h * y + i
            if not abs(depth) > _NEAR_HORIZON:
                break
            mapped += (a * x + b * y + c) / depth, (d * x + e * y + f) / depth
        else:
            # Silent where a number is beyond float32's range.
            return np.frombuffer(array("f", mapped), np.float32).reshape(-1, 2)
    matrix = np.asarray(b_from_a, np.float64)
    result: Points = np.empty((len(pts), 2), np.float32)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        u, v, depth = matrix[:, :2] @ np.ascontiguousarray(pts.T, np.float64) + matrix[:, 2:]
        result[:, 0], result[:, 1] = u / depth, v / depth
    return result


def largest_shift(matrix: Matrix, quad: Points) -> float:
    """How far the mapping moves the corner of the quad (4, 2) that it moves most, in x or y."""
    moved = transform_points(matrix, quad) - quad
    return float(np.abs(moved).max())


def projective_depths(b_from_a: Matrix, points: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Third homogeneous coordinate (N,) of the mapped points: one sign means no fold-over."""
    pts = np.asarray(points, np.float64).reshape(-1, 2)
    depths: npt.NDArray[np.float64] = pts @ b_from_a[2, :2] + b_from_a[2, 2]
    return depths


def normalized(matrix: Matrix) -> Matrix:
    """The same mapping, scaled so that its last element is 1."""
    scaled: Matrix = np.asarray(matrix, np.float64) / matrix[2, 2]
    return scaled


def inverted(b_from_a: Matrix) -> Matrix:
    """a_from_b, scaled so that its last element is 1. Raises LinAlgError if singular.

    By cofactors: on 3x3 matrices several times as fast as LAPACK, which is all overhead there.
    """
    (a, b, c), (d, e, f), (g, h, i) = np.asarray(b_from_a, np.float64).tolist()
    p, q, r = e * i - f * h, f * g - d * i, d * h - e * g
    determinant, corner = a * p + b * q + c * r, a * e - b * d
    if determinant == 0 or corner == 0 or not isfinite(determinant):
        raise np.linalg.LinAlgError("Singular matrix")
    cofactors = np.array(
        [
            [p, c * h - b * i, b * f - c * e],
            [q, a * i - c * g, c * d - a * f],
            [r, b * g - a * h, corner],
        ]
    )
    inverse: Matrix = cofactors / corner
    return inverse


def translation(x: float, y: float) -> Matrix:
    """The matrix that moves points by (x, y)."""
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])


def scaling(factor_x: float, factor_y: float | None = None) -> Matrix:
    """The matrix that resizes a picture, keeping pixel *edges* together.

    Pixel centres sit at integers, so p' = (p + 0.5) * factor - 0.5, as `cv2.resize` does.
    """
    fy = factor_x if factor_y is None else factor_y
    return np.array(
        [
            [factor_x, 0.0, 0.5 * factor_x - 0.5],
            [0.0, fy, 0.5 * fy - 0.5],
            [0.0, 0.0, 1.0],
        ]
    )


def local_scale(b_from_a: Matrix, point: npt.NDArray[np.generic]) -> float:
    """Pixels of b per pixel of a at a point of a: root of the Jacobian's determinant."""
    (a, b, c), (d, e, f), (g, h, i) = b_from_a.tolist()
    x, y = point.tolist()
    determinant = a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g)
    depth = g * x + h * y + i
    return sqrt(abs(determinant / depth**3)) if depth else inf


def box_quad(x: float, y: float, width: float, height: float) -> Points:
    """Quad (4, 2) of a box whose top-left corner is (x, y)."""
    return np.array([[x, y], [x + width, y], [x + width, y + height], [x, y + height]], np.float32)


def image_quad(size_wh: Size) -> Points:
    """Centres of the four corner pixels of a picture, as a quad (4, 2)."""
    return box_quad(0, 0, size_wh[0] - 1, size_wh[1] - 1)


def _corner_list(quad: npt.ArrayLike) -> list[Any]:
    # In plain numbers: for the few corners of a polygon numpy would be ten times as slow.
    if isinstance(quad, list):
        return quad
    return list(np.asarray(quad).reshape(-1, 2).tolist())


def grown_quad(quad: npt.ArrayLike, margin: float) -> Points:
    """The quad (4, 2) with each side moved outwards by ``margin``; as it is if it is not convex."""
    corners = _corner_list(quad)
    area = signed_area(corners)
    if not is_convex(corners) or not isfinite(area):
        return np.asarray(corners, np.float32)
    outward = []
    for (x, y), (next_x, next_y) in zip(corners, corners[1:] + corners[:1], strict=True):
        along_x, along_y = next_x - x, next_y - y
        length = copysign(hypot(along_x, along_y), area)
        outward.append((along_y / length, -along_x / length))
    moved = []
    for (x, y), (ax, ay), (bx, by) in zip(corners, outward[-1:] + outward, outward, strict=False):
        # At a corner both sides move: along the bisector, farther the sharper it is, within reason.
        reach = margin / max(1.0 + ax * bx + ay * by, 0.25)
        moved.append((x + reach * (ax + bx), y + reach * (ay + by)))
    return np.array(moved, np.float32)


def signed_area(quad: npt.ArrayLike) -> float:
    """Area of a polygon (N, 2) in px^2; positive when clockwise on the screen (y down)."""
    corners = _corner_list(quad)
    doubled = 0.0
    for (x, y), (next_x, next_y) in zip(corners, corners[1:] + corners[:1], strict=True):
        doubled += x * next_y - y * next_x
    return 0.5 * doubled


def is_convex(quad: npt.ArrayLike) -> bool:
    """True if the polygon (N, 2) is strictly convex, whichever way round."""
    corners = _corner_list(quad)
    turns = [
        (bx - ax) * (cy - by) - (by - ay) * (cx - bx)
        for (ax, ay), (bx, by), (cx, cy) in zip(
            corners, corners[1:] + corners[:1], corners[2:] + corners[:2], strict=True
        )
    ]
    return all(turn > 0 for turn in turns) or all(turn < 0 for turn in turns)


def bounding_box(points: npt.ArrayLike) -> tuple[float, float, float, float]:
    """(x0, y0, x1, y1) of points (N, 2)."""
    pts = np.asarray(points).reshape(-1, 2)
    if len(pts) <= _FEW and np.isfinite(pts).all():
        x, y = pts.T.tolist()
        return min(x), min(y), max(x), max(y)
    x0, y0 = pts.min(axis=0)
    x1, y1 = pts.max(axis=0)
    return float(x0), float(y0), float(x1), float(y1)


def clipped_quad_area(quad: npt.ArrayLike, size_wh: Size) -> float:
    """Area in px^2 of the part of a convex polygon that lies inside a picture.

    Sutherland-Hodgman clipping against the picture's outer pixel edges.
    """
    polygon = _corner_list(quad)
    for axis, bound, sign in (
        (0, -0.5, 1.0),
        (0, size_wh[0] - 0.5, -1.0),
        (1, -0.5, 1.0),
        (1, size_wh[1] - 0.5, -1.0),
    ):
        polygon = _clip_half_plane(polygon, [sign * (corner[axis] - bound) for corner in polygon])
        if len(polygon) < 3:
            return 0.0
    return abs(signed_area(polygon))


def _clip_half_plane(polygon: list[Any], inside: list[float]) -> list[Any]:
    """The part of a polygon where ``inside``, linear and given at its corners, is not negative."""
    kept = []
    corners = zip(polygon, polygon[1:] + polygon[:1], inside, inside[1:] + inside[:1], strict=True)
    for (x, y), (next_x, next_y), here, there in corners:
        if here >= 0:
            kept.append((x, y))
        if (here >= 0) != (there >= 0):
            t = here / (here - there)
            kept.append((x + t * (next_x - x), y + t * (next_y - y)))
    return kept


def visible_share(quad: npt.ArrayLike, size_wh: Size) -> float:
    """Share (0..1) of a convex quad's area that lies inside a picture."""
    area = abs(signed_area(quad))
    return clipped_quad_area(quad, size_wh) / area if area > 0 else 0.0


def quad_mapping(a: npt.ArrayLike, b: npt.ArrayLike) -> Matrix:
    """b_from_a that takes the quad a (4, 2) exactly to the quad b; no three corners in a line."""
    import cv2

    corners = np.asarray(a, np.float32), np.asarray(b, np.float32)
    return np.asarray(cv2.getPerspectiveTransform(*corners), np.float64)


def grey_of(image: Image) -> Image:
    """The picture as (H, W) grey."""
    import cv2

    if image.ndim == 2:
        return image
    grey: Image = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
    return grey
