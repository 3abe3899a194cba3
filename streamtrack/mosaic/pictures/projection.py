"""Surfaces that a mosaic is painted on: a plane, a cylinder or a sphere, and its bounds.

A `View` says where one picture lies on the canvas. On a plane that is a homography. On the curved
surfaces a canvas point is a direction, x = f theta, y = f h (cylinder) or f phi (sphere), and the
picture is seen through a 3x3 matrix from directions (Szeliski & Shum 1997; Szeliski 2010,
Computer Vision, section 9.1). Directions: x right, y down, z forward, theta = atan2(x, z).

All bounds are known before a pixel is painted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.types import Matrix, Size

if TYPE_CHECKING:
    from streamtrack.mosaic.pictures.rotation import Rotations

Doubles: TypeAlias = npt.NDArray[np.float64]
Kind: TypeAlias = Literal["planar", "cylindrical", "spherical"]
Box: TypeAlias = tuple[int, int, int, int]
"""x0, y0, x1, y1 in canvas pixels; x1 and y1 are outside."""

_BORDER_POINTS = 32  # along each side of a picture
_EPSILON_PX = 1e-6
_WIDEST_PLANE_DEG = 100.0
_HIGHEST_CYLINDER = np.radians(55.0)  # above or below the horizon


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """How one picture lies on the canvas.

    planar: ``matrix`` is canvas_from_picture. Curved: ``matrix`` is picture_from_direction, and
    canvas points are ``focal_px`` times the angles, less ``origin`` (x, y).
    """

    kind: Kind
    matrix: Matrix
    size_wh: Size
    focal_px: float = 1.0
    origin: tuple[float, float] = (0.0, 0.0)

    def scaled(self, factor: float) -> View:
        """The same picture on a canvas ``factor`` times as large."""
        if self.kind == "planar":
            return replace(self, matrix=geometry.scaling(factor) @ self.matrix)
        # Pixel centres sit at integers: p' = (p + 0.5) factor - 0.5, as in geometry.scaling.
        x, y = ((o - 0.5) * factor + 0.5 for o in self.origin)
        return replace(self, focal_px=self.focal_px * factor, origin=(x, y))

    def shifted(self, x: float, y: float) -> View:
        """The same picture on a canvas whose origin lies at (x, y)."""
        if self.kind == "planar":
            return replace(self, matrix=geometry.translation(-x, -y) @ self.matrix)
        return replace(self, origin=(self.origin[0] + x, self.origin[1] + y))

    def of_resized(self, factor_x: float, factor_y: float, size_wh: Size) -> View:
        """The view of the same picture resized by these factors."""
        resized = geometry.scaling(factor_x, factor_y)
        if self.kind == "planar":
            return replace(self, matrix=self.matrix @ np.linalg.inv(resized), size_wh=size_wh)
        return replace(self, matrix=resized @ self.matrix, size_wh=size_wh)

    def to_canvas(self, points: npt.ArrayLike) -> Doubles:
        """Picture points (N, 2) on the canvas, (N, 2)."""
        pts = np.asarray(points, np.float64).reshape(-1, 2)
        homogeneous = np.column_stack([pts, np.ones(len(pts))])
        if self.kind == "planar":
            mapped = homogeneous @ self.matrix.T
            return np.asarray(mapped[:, :2] / mapped[:, 2:], np.float64)
        directions = homogeneous @ np.linalg.inv(self.matrix).T
        theta = np.arctan2(directions[:, 0], directions[:, 2])
        level = np.hypot(directions[:, 0], directions[:, 2])
        # A picture is one piece: angles are counted on from that of its centre.
        centre = np.array([*((n - 1) / 2 for n in self.size_wh), 1.0])
        middle = np.linalg.inv(self.matrix) @ centre
        start = np.arctan2(middle[0], middle[2])
        theta = start + np.mod(theta - start + np.pi, 2 * np.pi) - np.pi
        tangent = directions[:, 1] / np.maximum(level, 1e-12)
        height = tangent if self.kind == "cylindrical" else np.arctan(tangent)
        placed: Doubles = self.focal_px * np.column_stack([theta, height]) - np.array(self.origin)
        return placed

    def maps(self, box: Box) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """For each canvas pixel of a box, where it comes from in the picture: x and y, (h, w).

        Directions behind the camera come from far outside the picture (-1e6).
        """
        x0, y0, x1, y1 = box
        return self.on_grid(x0, y0, x1 - x0, y1 - y0, 1)

    def on_grid(
        self, x0: int, y0: int, columns: int, rows: int, step: int
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """As `maps`, for every ``step``-th pixel from (x0, y0) on: (rows, columns)."""
        xs = x0 + step * np.arange(columns, dtype=np.float64)
        ys = y0 + step * np.arange(rows, dtype=np.float64)
        if self.kind == "planar":
            m = np.linalg.inv(self.matrix)
            rays = [m[i, 0] * xs[None, :] + (m[i, 1] * ys + m[i, 2])[:, None] for i in range(3)]
        else:
            theta = (xs + self.origin[0]) / self.focal_px
            height = (ys + self.origin[1]) / self.focal_px
            level = np.ones_like(height) if self.kind == "cylindrical" else np.cos(height)
            up = height if self.kind == "cylindrical" else np.sin(height)
            m = self.matrix
            rays = [
                level[:, None] * (m[i, 0] * np.sin(theta) + m[i, 2] * np.cos(theta))[None, :]
                + (m[i, 1] * up)[:, None]
                for i in range(3)
            ]
        is_front = rays[2] > 1e-9
        depth = np.where(is_front, rays[2], 1.0)
        x = np.where(is_front, rays[0] / depth, -1e6)
        y = np.where(is_front, rays[1] / depth, -1e6)
        return x.clip(-1e6, 1e6).astype(np.float32), y.clip(-1e6, 1e6).astype(np.float32)

    def bounds(self) -> tuple[float, float, float, float]:
        """(x0, y0, x1, y1) of the picture's outer pixel edges on the canvas; may be infinite."""
        border = _border(self.size_wh)
        if self.kind == "planar":
            depths = geometry.projective_depths(self.matrix, border)
            if not (np.all(depths > 1e-9) or np.all(depths < -1e-9)):
                return -np.inf, -np.inf, np.inf, np.inf
            return geometry.bounding_box(self.to_canvas(border))
        x0, y0, x1, y1 = geometry.bounding_box(self.to_canvas(border))
        for pole in (-1.0, 1.0):
            if self._sees(np.array([0.0, pole, 0.0])):
                half = np.pi * self.focal_px
                x0, x1 = -half - self.origin[0], half - self.origin[0]
                edge = pole * (np.inf if self.kind == "cylindrical" else half / 2) - self.origin[1]
                y0, y1 = min(y0, edge), max(y1, edge)
        return x0, y0, x1, y1

    def _sees(self, direction: Doubles) -> bool:
        x, y, depth = self.matrix @ direction
        if depth <= 1e-9:
            return False
        width, height = self.size_wh
        return bool(-0.5 <= x / depth <= width - 0.5 and -0.5 <= y / depth <= height - 0.5)

    def outline(self) -> Doubles:
        """The picture's border on the canvas as one closed line (N, 2)."""
        top, bottom, left, right = np.split(_border(self.size_wh), 4)
        return self.to_canvas(np.concatenate([top, right, bottom[::-1], left[::-1]]))

    def scale(self) -> float:
        """Canvas pixels per picture pixel at the picture's centre."""
        centre = (np.array(self.size_wh) - 1) / 2
        if self.kind == "planar":
            return geometry.local_scale(self.matrix, centre)
        steps = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        across = self.to_canvas(centre + steps)
        return float(np.sqrt(abs(np.linalg.det(across[1:] - across[0]))))

    def magnification(self) -> float:
        """Largest over least area of a picture pixel on a plane (1 on curved surfaces)."""
        if self.kind != "planar":
            return 1.0
        depths = np.abs(geometry.projective_depths(self.matrix, geometry.image_quad(self.size_wh)))
        least = float(np.min(depths))
        return float(np.max(depths) / least) ** 3 if least > 0 else float("inf")

    @property
    def turn_px(self) -> float:
        """Canvas pixels of a whole turn; infinite on a plane."""
        return float("inf") if self.kind == "planar" else 2 * np.pi * self.focal_px


def _border(size_wh: Size) -> Doubles:
    width, height = size_wh
    along = np.linspace(0, 1, _BORDER_POINTS)
    x, y = along * width - 0.5, along * height - 0.5
    left, right = np.full_like(y, -0.5), np.full_like(y, width - 0.5)
    top, bottom = np.full_like(x, -0.5), np.full_like(x, height - 0.5)
    return np.concatenate(
        [np.column_stack(side) for side in ((x, top), (x, bottom), (left, y), (right, y))]
    )


# -- views of all pictures ----------------------------------------------------------------------


def planar_views(
    canvas_from_picture: Mapping[int, Matrix], sizes: Mapping[int, Size]
) -> dict[int, View]:
    """Pictures on a plane, by their homographies."""
    return {
        picture: View("planar", geometry.normalized(matrix), sizes[picture])
        for picture, matrix in canvas_from_picture.items()
    }


def turned_views(rotations: Rotations, kind: Kind) -> dict[int, View]:
    """Pictures of a turning camera on a surface, levelled and with the middle of the view ahead.

    The canvas has the focal length of the anchor: there its scale is the picture's own. A plane
    faces the middle of the view; cylinder and sphere stand upright, the horizon on row 0.
    """
    ahead = _upright(rotations)
    if kind == "planar":
        ahead = _pitched(rotations, ahead)
    return _views(rotations, kind, ahead)


def _views(rotations: Rotations, kind: Kind, ahead_from_world: Matrix) -> dict[int, View]:
    focal_px = rotations.focals_px[rotations.anchor]
    views: dict[int, View] = {}
    for picture, world_from_camera in rotations.world_from_camera.items():
        picture_from_ahead = (
            rotations.camera_matrix(picture) @ (ahead_from_world @ world_from_camera).T
        )
        size = rotations.sizes[picture]
        if kind == "planar":
            plane = np.diag([focal_px, focal_px, 1.0]) @ np.linalg.inv(picture_from_ahead)
            views[picture] = View(kind, plane, size)
        else:
            views[picture] = View(kind, picture_from_ahead, size, focal_px)
    return views


def _angles(rotations: Rotations, ahead_from_world: Matrix) -> tuple[float, float, float, float]:
    """Left, top, right and bottom of all pictures together, radians from straight ahead."""
    views = _views(rotations, "spherical", ahead_from_world).values()
    box = np.array(_union([view.bounds() for view in views]))
    left, top, right, bottom = box / rotations.focals_px[rotations.anchor]
    return left, top, right, bottom


def _pitched(rotations: Rotations, upright: Matrix) -> Matrix:
    """The upright camera tilted so that the middle of the view's height is straight ahead."""
    _, top, _, bottom = _angles(rotations, upright)
    pitch = (top + bottom) / 2
    cosine, sine = np.cos(pitch), np.sin(pitch)
    tilt = np.array([[1.0, 0.0, 0.0], [0.0, cosine, -sine], [0.0, sine, cosine]])
    tilted: Matrix = tilt @ upright
    return tilted


def field_of_view(rotations: Rotations) -> tuple[float, float]:
    """Degrees across and from top to bottom of all pictures together, about their middle."""
    left, top, right, bottom = _angles(rotations, _pitched(rotations, _upright(rotations)))
    return min(360.0, float(np.degrees(right - left))), float(np.degrees(bottom - top))


def fitting_kind(rotations: Rotations) -> Kind:
    """A plane up to 100 degrees of view, beyond that a cylinder, or a sphere if it is high too."""
    if max(field_of_view(rotations)) <= _WIDEST_PLANE_DEG:
        return "planar"
    _, top, _, bottom = _angles(rotations, _upright(rotations))
    return "cylindrical" if max(-top, bottom) < _HIGHEST_CYLINDER else "spherical"


def _upright(rotations: Rotations) -> Matrix:
    """The rotation that puts the horizon level and the middle of the view straight ahead.

    A person seldom rolls a camera, so the cameras' x axes lie in the plane of the horizon: "up"
    is the direction they vary least in (Brown & Lowe 2007, section 5). They must vary for that:
    from pictures that look one way, up is the mean of the cameras' own.
    """
    cameras = np.array([rotations.world_from_camera[i] for i in sorted(rotations.sizes)])
    x_axes, down_axes, forward_axes = cameras[:, :, 0], cameras[:, :, 1], cameras[:, :, 2]
    values, vectors = np.linalg.eigh(x_axes.T @ x_axes / len(cameras))
    mean_down = down_axes.mean(axis=0)
    down = mean_down / np.linalg.norm(mean_down)
    if values[1] > 0.01 and values[1] > 9 * values[0]:
        levelled = vectors[:, 0] * np.sign(vectors[:, 0] @ down)
        if levelled @ down > 0.7:
            down = levelled
    forward = _middle_direction(forward_axes, down)
    right = np.cross(down, forward)
    return np.array([right, down, forward])


def _middle_direction(forward_axes: Doubles, down: Doubles) -> Doubles:
    """The horizontal direction opposite to the widest gap between the cameras' directions."""
    start = forward_axes.mean(axis=0)
    if np.linalg.norm(start - down * (start @ down)) < 1e-3:
        start = forward_axes[0]
    ahead = start - down * (start @ down)
    ahead /= np.linalg.norm(ahead) + 1e-12
    right = np.cross(down, ahead)
    angles = np.sort(np.arctan2(forward_axes @ right, forward_axes @ ahead))
    gaps = np.diff(np.append(angles, angles[0] + 2 * np.pi))
    widest = int(np.argmax(gaps))
    middle = angles[widest] + gaps[widest] / 2 + np.pi
    return np.asarray(np.cos(middle) * ahead + np.sin(middle) * right, np.float64)


# -- the canvas ---------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """One picture's place on the canvas; a picture across the seam of a full turn has two."""

    picture: int
    view: View
    box: Box


@dataclass(frozen=True, slots=True, eq=False)
class Canvas:
    """The picture to be painted: its size, its patches, its pixels per pixel of the world."""

    size_wh: Size
    patches: tuple[Patch, ...]
    scale: float


def natural_size(views: Mapping[int, View]) -> tuple[float, float]:
    """Width and height of the canvas at scale 1; infinite if a picture reaches the horizon."""
    x0, y0, x1, y1 = _union([view.bounds() for view in views.values()])
    turn_px = next(iter(views.values())).turn_px
    return min(x1 - x0, turn_px), y1 - y0


def lay_out(views: Mapping[int, View], scale: float) -> Canvas:
    """The canvas that holds all pictures, at a scale. `natural_size` must be finite."""
    scaled = {picture: view.scaled(scale) for picture, view in views.items()}
    bounds = {picture: view.bounds() for picture, view in scaled.items()}
    x0, y0, x1, y1 = _union(list(bounds.values()))
    turn_px = next(iter(scaled.values())).turn_px
    if x1 - x0 > turn_px:
        middle = (x0 + x1) / 2
        x0, x1 = middle - turn_px / 2, middle + turn_px / 2
    # The pixels whose centres lie inside; bounds are outer edges, half a pixel further out.
    left, top = int(np.ceil(x0 - _EPSILON_PX)), int(np.ceil(y0 - _EPSILON_PX))
    width = max(1, int(np.floor(x1 + _EPSILON_PX)) - left + 1)
    height = max(1, int(np.floor(y1 + _EPSILON_PX)) - top + 1)
    patches = []
    for picture, view in scaled.items():
        for turn in (0,) if np.isinf(turn_px) else (0, -1, 1):
            moved = view.shifted(left - (turn * turn_px if turn else 0), top)
            box = _clipped_box(bounds[picture], left, top, turn * turn_px if turn else 0)
            box = max(box[0], 0), max(box[1], 0), min(box[2], width), min(box[3], height)
            if box[0] < box[2] and box[1] < box[3]:
                patches.append(Patch(picture, moved, box))
    return Canvas((width, height), tuple(patches), scale)


def _clipped_box(
    bounds: tuple[float, float, float, float], left: int, top: int, shift: float
) -> Box:
    x0, y0, x1, y1 = bounds
    return (
        int(np.floor(x0 + shift - left)),
        int(np.floor(y0 - top)),
        int(np.ceil(x1 + shift - left)) + 1,
        int(np.ceil(y1 - top)) + 1,
    )


def _union(
    boxes: Sequence[tuple[float, float, float, float]],
) -> tuple[float, float, float, float]:
    corners = np.array(boxes)
    x0, y0 = corners[:, :2].min(axis=0)
    x1, y1 = corners[:, 2:].max(axis=0)
    return float(x0), float(y0), float(x1), float(y1)
