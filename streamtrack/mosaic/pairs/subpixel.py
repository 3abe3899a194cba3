"""Point pairs to a fraction of a pixel, from the grey values where two pictures overlap.

Given a mapping good to some pixels, the part that both pictures show is rendered twice on one
grid, the coarser picture's: zoom, rotation and perspective are gone, and what is left is a small
shift at each corner, which pyramidal Lucas-Kanade finds (Bouguet 2000; `cv2.calcOpticalFlowPyrLK`).
For that both renderings are high-pass filtered and brought to one contrast, so that light drops
out. Each corner is followed there and back, and the two shifts are averaged: a bias of the one
way is that of the other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.pyramid import Pyramid
from streamtrack.types import Image, Matrix, Points, Size

_MAX_GRID_PX = 400_000
_MIN_GRID_SIDE_PX = 24
_CORNERS = 250
_CORNER_QUALITY = 0.003
_HIGH_PASS_PX = 31
_CONTRAST = 16.0
_MAX_CONTRAST_GAIN = 8.0
_EDGE_PX = 3
_COVERAGE_STEP = 4
_WINDOW_PX = 31
_MAX_RETURN_PX = 1.0


@dataclass(frozen=True, eq=False)
class Overlap:
    """What two pictures have in common, on one grid; "near" is the coarser of the two.

    ``near`` and ``far`` (h, w) are renderings of either; ``covered`` (h, w) is 255 where both
    show something. ``near_from_grid`` and ``far_from_grid`` map its pixels to the pictures' own.
    """

    near: Image
    far: Image
    covered: Image
    near_from_grid: Matrix
    far_from_grid: Matrix

    @cached_property
    def near_detail(self) -> Image:
        """``near`` without what varies slowly, at the usual contrast."""
        return _high_passed(self.near)

    @cached_property
    def far_detail(self) -> Image:
        """``far`` without what varies slowly, at the usual contrast."""
        return _high_passed(self.far)

    @property
    def size_wh(self) -> Size:
        return self.near.shape[1], self.near.shape[0]


def render_overlap(near: Pyramid, far: Pyramid, far_from_near: Matrix) -> Overlap | None:
    """Both pictures where they overlap, at most 400 000 pixels; None if that is next to nothing."""
    box = _overlap_box(far_from_near, near.size_wh, far.size_wh)
    if box is None:
        return None
    x0, y0, width, height = box
    # Whole halvings only: anything between would blur and alias one rendering.
    halvings = max(0, int(np.ceil(np.log2(width * height / _MAX_GRID_PX) / 2)))
    size = width >> halvings, height >> halvings
    if min(size) < _MIN_GRID_SIDE_PX:
        return None
    grid_scale = geometry.scaling(2.0**halvings)
    near_from_grid = geometry.translation(x0, y0) @ grid_scale
    covered = _coverage(far_from_near @ near_from_grid, far.size_wh, size)
    rendered = near.warped(near_from_grid, size)
    far_from_grid = far_from_near @ near_from_grid
    return Overlap(
        rendered, far.warped(far_from_grid, size), covered, near_from_grid, far_from_grid
    )


def rendered_again(overlap: Overlap, far: Pyramid, far_from_near: Matrix) -> Overlap:
    """The same grid, with the far picture seen through another mapping."""
    far_from_grid = far_from_near @ overlap.near_from_grid
    covered = _coverage(far_from_grid, far.size_wh, overlap.size_wh)
    seen = far.warped(far_from_grid, overlap.size_wh)
    again = Overlap(overlap.near, seen, covered, overlap.near_from_grid, far_from_grid)
    again.__dict__["near_detail"] = overlap.near_detail
    return again


def opaque_part(overlap: Overlap, near_cover: Image | None, far_cover: Image | None) -> Overlap:
    """The overlap without what is transparent: covers (H, W) are 255 where a picture is opaque."""
    covered = overlap.covered
    for cover, picture_from_grid in (
        (near_cover, overlap.near_from_grid),
        (far_cover, overlap.far_from_grid),
    ):
        if cover is not None:
            flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
            seen = cv2.warpPerspective(cover, picture_from_grid, overlap.size_wh, flags=flags)
            covered = np.asarray(cv2.bitwise_and(covered, seen), np.uint8)
    return overlap if covered is overlap.covered else replace(overlap, covered=covered)


def _overlap_box(
    far_from_near: Matrix, near_wh: Size, far_wh: Size
) -> tuple[int, int, int, int] | None:
    """x, y, width and height in near of what both show; None if nothing, or past the horizon."""
    try:
        near_from_far = geometry.inverted(far_from_near)
    except np.linalg.LinAlgError:
        return None
    quad = geometry.image_quad(far_wh)
    depths = geometry.projective_depths(near_from_far, quad)
    if not (np.all(depths > 0) or np.all(depths < 0)):
        # The far picture reaches past near's horizon, but what both show does not.
        return 0, 0, near_wh[0], near_wh[1]
    x0, y0, x1, y1 = geometry.bounding_box(geometry.transform_points(near_from_far, quad))
    left, top = max(0, int(x0)), max(0, int(y0))
    right, bottom = min(near_wh[0] - 1, int(x1)), min(near_wh[1] - 1, int(y1))
    if right <= left or bottom <= top:
        return None
    return left, top, right - left + 1, bottom - top + 1


def _coverage(picture_from_grid: Matrix, picture_wh: Size, size_wh: Size) -> Image:
    """255 where a grid pixel lies well inside the picture and inside the grid, else 0."""
    width, height = size_wh
    x, y = np.meshgrid(np.arange(0, width, _COVERAGE_STEP), np.arange(0, height, _COVERAGE_STEP))
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    there = geometry.transform_points(picture_from_grid, points)
    depths = geometry.projective_depths(picture_from_grid, points)
    middle = geometry.projective_depths(picture_from_grid, [[width / 2, height / 2]])[0]
    # A rim of the far picture, as wide as the smoothing reaches, is left out.
    reach = _EDGE_PX * geometry.local_scale(picture_from_grid, np.array([width / 2, height / 2]))
    inside = (
        (depths * middle > 0)
        & (there[:, 0] >= reach)
        & (there[:, 1] >= reach)
        & (there[:, 0] <= picture_wh[0] - 1 - reach)
        & (there[:, 1] <= picture_wh[1] - 1 - reach)
    )
    small = inside.reshape(x.shape).astype(np.uint8) * 255
    covered = np.asarray(cv2.resize(small, size_wh, interpolation=cv2.INTER_NEAREST), np.uint8)
    covered[:_EDGE_PX] = covered[-_EDGE_PX:] = 0
    covered[:, :_EDGE_PX] = covered[:, -_EDGE_PX:] = 0
    return covered


def _high_passed(image: Image) -> Image:
    """Grey values minus their local mean, around 128 and at one contrast."""
    smooth = cv2.blur(image, (_HIGH_PASS_PX, _HIGH_PASS_PX))
    spread = float(np.mean(cv2.absdiff(image[::2, ::2], smooth[::2, ::2]))) + 0.5
    gain = min(_MAX_CONTRAST_GAIN, _CONTRAST / spread)
    return np.asarray(cv2.addWeighted(image, gain, smooth, -gain, 128.0), np.uint8)


def tracked_corners(overlap: Overlap, levels: int) -> tuple[Points, Points]:
    """Corners (N, 2) of the near rendering and where they lie in the far one, in grid pixels.

    ``levels`` halvings of the grid are searched first: each doubles the reach of about 15 px.
    """
    points = _corners_of(overlap)
    there, is_there = _lucas_kanade(overlap.near_detail, overlap.far_detail, points, points, levels)
    points, there = points[is_there], there[is_there]
    back, is_back = _lucas_kanade(overlap.far_detail, overlap.near_detail, there, points, 0)
    off = back - points
    kept = is_back & (np.hypot(off[:, 0], off[:, 1]) <= _MAX_RETURN_PX)
    kept &= _is_covered(overlap.covered, there)
    return points[kept], (there - off / 2)[kept]


def _corners_of(overlap: Overlap) -> Points:
    """Shi-Tomasi corners (N, 2) of the near rendering, evenly spread, where both are seen."""
    area = float(np.count_nonzero(overlap.covered))
    apart = max(4.0, 0.7 * float(np.sqrt(area / _CORNERS)))
    found = cv2.goodFeaturesToTrack(
        overlap.near_detail, _CORNERS, _CORNER_QUALITY, apart, mask=overlap.covered, blockSize=5
    )
    if found is None:
        return np.zeros((0, 2), np.float32)
    return np.asarray(found, np.float32).reshape(-1, 2)


def _lucas_kanade(
    a: Image, b: Image, points: Points, guess: Points, levels: int
) -> tuple[Points, npt.NDArray[np.bool_]]:
    if not len(points):
        return points, np.zeros(0, np.bool_)
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        a,
        b,
        points.reshape(-1, 1, 2),
        guess.reshape(-1, 1, 2).copy(),
        winSize=(_WINDOW_PX, _WINDOW_PX),
        maxLevel=levels,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 12, 0.01),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return np.asarray(moved, np.float32).reshape(-1, 2), status.ravel() == 1


def _is_covered(covered: Image, points: Points) -> npt.NDArray[np.bool_]:
    height, width = covered.shape
    column, row = np.rint(points).astype(np.intp).T
    inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    hit = covered[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)] > 0
    return np.asarray(inside & hit, np.bool_)
