"""One view at several resolutions, and the textured pixels by which others are aligned with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.pyramid import high_passed
from streamtrack.types import Image, Mask, Matrix, Points, Size

Floats: TypeAlias = npt.NDArray[np.float32]
Rows: TypeAlias = npt.NDArray[np.intp]

EXACT, USUAL = 0, 1  # levels: the one for links between keyframes, and the finest for frames
_LONGEST_PX = (1024, 512)  # side of these two levels
_COARSEST_PX = 40
_MAX_LEVELS = 5
_CELLS = (12, 9)
_CELL_PIXELS = (500, 44, 20, 12, 8)  # chosen of each cell, by level
_HIGH_PASS_PX = 25
EDGE_PX = (9, 3, 3, 3, 3)
"""Left out at the edges, by level: local means reach over them, and keyframes' links feel that."""
_MIN_GRADIENT = 0.8  # grey levels a pixel, RMS of a cell's chosen pixels
_TINY = np.finfo(np.float32).tiny


class ViewLevels:
    """One view (H, W) in grey at halved resolutions, each high-passed when first needed.

    The levels `EXACT` and `USUAL` are one for small pictures.
    """

    def __init__(self, grey: Image) -> None:
        self.size_wh: Size = (grey.shape[1], grey.shape[0])
        exact = _halved_to(grey, _LONGEST_PX[EXACT])
        levels = [exact, _halved_to(exact, _LONGEST_PX[USUAL])]
        while len(levels) < _MAX_LEVELS and max(levels[-1].shape) // 2 >= _COARSEST_PX:
            levels.append(_halved(levels[-1]))
        self.images: tuple[Image, ...] = tuple(levels)
        self._high_passed: dict[int, Floats] = {}

    @property
    def usual(self) -> Image:
        """The picture at the level at which frames are followed."""
        return self.images[USUAL]

    def level_from_view(self, level: int) -> Matrix:
        """Pixels of the full view to pixels of a level."""
        height, width = self.images[level].shape
        return geometry.scaling(width / self.size_wh[0], height / self.size_wh[1])

    def high_passed(self, level: int) -> Floats:
        """Grey values, slightly smoothed, minus their local mean."""
        if self.images[level] is self.images[USUAL]:
            level = USUAL
        found = self._high_passed.get(level)
        if found is None:
            found = high_passed(self.images[level], _HIGH_PASS_PX)
            if level != EXACT:  # large, and needed once or twice
                self._high_passed[level] = found
        return found

    def is_flat(self) -> bool:
        """True if the view shows next to nothing: black, white, fog."""
        return float(self.high_passed(len(self.images) - 1).std()) < 1.0


def _halved(image: Image) -> Image:
    size = max(1, image.shape[1] // 2), max(1, image.shape[0] // 2)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _halved_to(image: Image, longest_px: int) -> Image:
    while max(image.shape) > longest_px:
        image = _halved(image)
    return image


@dataclass(frozen=True, slots=True, eq=False)
class Pixels:
    """The chosen pixels of one level of a keyframe.

    points     float32 (3, N), level pixels, with ones
    values     float32 (N,), high-passed grey values
    jacobian   float32 (8, N), change of a value with each parameter of a homography in units
    cell       int (N,), the cell each lies in, rising
    """

    points: Floats
    values: Floats
    jacobian: Floats
    cell: Rows
    unit_from_level: Matrix

    def of(self, rows: Rows) -> Pixels:
        """Those of the pixels in the rows (M,), which rise."""
        return Pixels(
            self.points.take(rows, axis=1),
            self.values.take(rows),
            self.jacobian.take(rows, axis=1),
            self.cell.take(rows),
            self.unit_from_level,
        )


class ReferenceView:
    """A view that others are aligned with: its textured pixels at every level."""

    def __init__(
        self, levels: ViewLevels, hidden: Sequence[Points] = (), masked: Mask | None = None
    ) -> None:
        """``hidden`` are quads (4, 2) in the view that do not belong to the scene.

        Nor does what is ``masked`` (h, w), a mask of the view at any resolution.
        """
        self.levels = levels
        self.size_wh = levels.size_wh
        self.hidden = tuple(hidden)
        self._masked = masked
        self._pixels: dict[int, Pixels] = {}

    @property
    def textured_cells(self) -> int:
        """Cells that hold enough texture to be judged."""
        return int(np.count_nonzero(np.diff(self.pixels(USUAL).cell, prepend=-1)))

    def pixels(self, level: int) -> Pixels:
        """The chosen pixels of a level, chosen when first asked for."""
        if level not in self._pixels:
            self._pixels[level] = _choose_pixels(self.levels, level, self.hidden, self._masked)
        return self._pixels[level]


def filled(quads: Sequence[Points], picture_from_view: Matrix, shape: tuple[int, ...]) -> Mask:
    """Which pixels (h, w) of a picture lie in quads (4, 2) of a view; not finite ones are none."""
    inside = np.zeros(shape, np.uint8)
    fill(inside, quads, picture_from_view, 1)
    return inside > 0


def fill(
    picture: Image | Floats, quads: Sequence[Points], picture_from_view: Matrix, value: int
) -> None:
    """Set the pixels (h, w) that lie in quads (4, 2) of a view; not finite ones are none."""
    for quad in quads:
        seen = geometry.transform_points(picture_from_view, quad)
        if np.isfinite(seen).all():
            cv2.fillConvexPoly(picture, np.rint(np.clip(seen, -1e6, 1e6)).astype(np.int32), value)


def gradient(values: Floats | Image) -> tuple[Floats, Floats]:
    """Change of values (h, w) a pixel along x and y, (h, w) each."""
    gx = cv2.Sobel(values, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    gy = cv2.Sobel(values, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
    return np.asarray(gx, np.float32), np.asarray(gy, np.float32)


def _choose_pixels(
    levels: ViewLevels, level: int, hidden: Sequence[Points], masked: Mask | None
) -> Pixels:
    values = levels.high_passed(level)
    gx, gy = gradient(values)
    strength = np.asarray(gx * gx + gy * gy, np.float32)
    edge = EDGE_PX[level]
    strength[:edge] = strength[-edge:] = 0
    strength[:, :edge] = strength[:, -edge:] = 0
    strength[filled(hidden, levels.level_from_view(level), values.shape)] = 0
    if masked is not None:
        size = values.shape[1], values.shape[0]
        spread = cv2.resize(masked.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        strength[spread > 0] = 0
    row, column, cell = _strongest(strength, _CELL_PIXELS[level])
    height, width = values.shape
    unit = np.float32(2.0 / max(width, height))
    unit_from_level = np.array(
        [[unit, 0, -unit * (width - 1) / 2], [0, unit, -unit * (height - 1) / 2], [0, 0, 1]]
    )
    places = row * width + column
    points = np.stack([column, row, np.ones_like(row)]).astype(np.float32)
    x, y, _ = unit_from_level.astype(np.float32) @ points
    u, v = (along.take(places) / unit for along in (gx, gy))
    radial = u * x + v * y
    jacobian = np.stack([u * x, u * y, u, v * x, v * y, v, -x * radial, -y * radial])
    return Pixels(points, values.take(places), jacobian, cell, unit_from_level)


def _strongest(strength: Floats, count: int) -> tuple[Rows, Rows, Rows]:
    """Row, column and cell of the ``count`` strongest pixels of every cell that has texture.

    What is as strong as the last of them is taken, too.
    """
    height, width = strength.shape
    across, down = _CELLS
    cell_w, cell_h = -(-width // across), -(-height // down)
    padded = np.zeros((down * cell_h, across * cell_w), np.float32)
    padded[:height, :width] = strength
    cells = padded.reshape(down, cell_h, across, cell_w).swapaxes(1, 2).reshape(down * across, -1)
    first = max(cells.shape[1] - count, 0)
    best = np.partition(cells, first, axis=1)[:, first:]
    is_textured = best.mean(axis=1) >= _MIN_GRADIENT**2
    least = np.where(is_textured, np.maximum(best[:, 0], _TINY), np.inf).astype(np.float32)
    cell, within = np.divmod(np.flatnonzero(cells >= least[:, None]), cells.shape[1])
    row = (cell // across) * cell_h + within // cell_w
    column = (cell % across) * cell_w + within % cell_w
    return row, column, cell
