"""What lies over every picture and does not belong to the scene: bars, figures, logos, a bonnet.

Such things stand still in the picture while the scene moves, and pull a camera's estimate towards
standing still. Black bars show in one picture. The rest is found by its edges: one that should have
moved across itself and is still there, with the same gradient, has been laid over the scene; once
may be chance, several times it is not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.camera.view_levels import USUAL, Floats, ViewLevels, gradient
from streamtrack.types import Image, Mask, Matrix, Points

Vectors: TypeAlias = tuple[Floats, Floats]
"""Along x and y, (h, w) each."""
Margins: TypeAlias = tuple[int, int, int, int]
"""Black rows above and below, black columns left and right, of the usual level."""

_BLACK = 24  # grey levels; video's own black and what coding leaves of it
_MOST_BAR = 0.4  # of a side; beyond it the whole picture is dark
_MIN_MOTION_PX = 4.0  # of the usual level, of the scene between two looks
_MIN_CROSSING_PX = 2.5  # of an edge, across itself
_MIN_GRADIENT = 6.0  # grey levels a pixel
_MIN_ALIKE, _MOST_CHANGE = 0.95, 2.5
"""Cosine between the gradients of an edge that is still there, and the factor by which they may
differ in size, as what lies behind it changes."""
_BELIEVED, _DROPPED, _MOST_VOTES = 6, 2, 8
_MARGIN_PX = 5  # around such edges; between those as close to each other all is covered
_MIN_EDGE_PIXELS = 20  # of one thing
_CELL_PX = 4
_FIRST_LOOKS, _EVERY = 20, 5  # frames, once so many looks were taken
_MOST_COVER = 0.6  # of the picture; more is no overlay
_GROWN_BAR_PX = 3


@dataclass(frozen=True, slots=True, eq=False)
class Looked:
    """What lies over a picture: quads (4, 2), and the box (x, y, w, h) within black bars."""

    quads: tuple[Points, ...]
    shown: tuple[int, int, int, int]


class OverlayWatch:
    """Finds what lies over the pictures of a moving camera; given every frame with its pose."""

    def __init__(self) -> None:
        self._margins: Margins | None = None
        self._frames = self._looks = 0
        self._last: Matrix | None = None
        self._gradient: Vectors | None = None
        self._votes: npt.NDArray[np.int8] | None = None
        self._is_over: Mask | None = None
        self._edges: tuple[Points, ...] = ()

    def look(self, levels: ViewLevels) -> Looked:
        """What is known to lie over the next picture, whose pose is not known yet."""
        seen = _black_margins(levels.usual)
        if seen is not None:
            pairs = zip(self._margins or seen, seen, strict=True)
            top, bottom, left, right = (min(pair) for pair in pairs)
            self._margins = top, bottom, left, right
        grown = [margin + _GROWN_BAR_PX if margin else 0 for margin in self._margins or ()]
        if not any(grown):
            return Looked(self._edges, (0, 0, *levels.size_wh))
        width, height = levels.size_wh
        px = width / levels.usual.shape[1]
        top, bottom, left, right = (math.ceil(margin * px) for margin in grown)
        bars = [
            (-0.5, -0.5, width, top),
            (-0.5, height - bottom - 0.5, width, bottom),
            (-0.5, -0.5, left, height),
            (width - right - 0.5, -0.5, right, height),
        ]
        quads = tuple(geometry.box_quad(*bar) for bar in bars if bar[2] > 0 and bar[3] > 0)
        shown = left, top, width - left - right, height - top - bottom
        return Looked(quads + self._edges, shown)

    def note(self, levels: ViewLevels, world_from_frame: Matrix) -> tuple[Points, ...]:
        """Look for edges that stay while the scene moves; quads (4, 2) if some are newly known."""
        self._frames += 1
        if self._last is None:
            self._begin(levels, world_from_frame)
            return ()
        if self._looks >= _FIRST_LOOKS and self._frames % _EVERY:
            return ()
        to_level = levels.level_from_view(USUAL)
        frame_from_last = geometry.inverted(world_from_frame) @ self._last
        motion = geometry.normalized(to_level @ frame_from_last @ geometry.inverted(to_level))
        assert self._gradient is not None and self._votes is not None
        if not _typical_motion_px(motion, self._votes.shape) >= _MIN_MOTION_PX:
            return ()
        self._looks += 1
        self._vote(gradient(levels.usual), motion)
        self._last = world_from_frame
        return self._judge(levels)

    def _begin(self, levels: ViewLevels, world_from_frame: Matrix) -> None:
        self._last = world_from_frame
        self._gradient = gradient(levels.usual)
        self._votes = np.zeros(levels.usual.shape, np.int8)
        self._is_over = np.zeros(levels.usual.shape, bool)

    def _vote(self, now: Vectors, motion: Matrix) -> None:
        """For edges that stayed although they should have moved, against those that went.

        An edge is compared with how it was when it got its first vote.
        """
        assert self._gradient is not None and self._votes is not None
        votes, (gx, gy) = self._votes, self._gradient
        moved_x, moved_y = _motion_field(motion, votes.shape)
        size, size_now = cv2.magnitude(gx, gy), cv2.magnitude(*now)
        crossing = np.abs(moved_x * gx + moved_y * gy)
        should_go = (crossing >= _MIN_CROSSING_PX * size) & (size >= _MIN_GRADIENT)
        stayed = gx * now[0] + gy * now[1] >= _MIN_ALIKE * size * size_now
        stayed &= (_MOST_CHANGE * size_now >= size) & (size_now <= _MOST_CHANGE * size)
        votes += should_go & stayed
        votes -= should_go & ~stayed
        np.clip(votes, 0, _MOST_VOTES, out=votes)
        for kept, seen in zip(self._gradient, now, strict=True):
            np.copyto(kept, seen, where=votes == 0)

    def _judge(self, levels: ViewLevels) -> tuple[Points, ...]:
        assert self._votes is not None and self._is_over is not None
        is_over = (self._votes >= _BELIEVED) | (self._is_over & (self._votes >= _DROPPED))
        if (is_over == self._is_over).all():
            return ()
        has_more = np.count_nonzero(is_over & ~self._is_over) >= _MIN_EDGE_PIXELS
        self._is_over = is_over
        boxes = _boxes(is_over)
        if sum(width * height for _, _, width, height in boxes) > _MOST_COVER * is_over.size:
            boxes = []
        view_from_level = geometry.inverted(levels.level_from_view(USUAL))
        self._edges = tuple(
            geometry.transform_points(view_from_level, geometry.box_quad(*box)) for box in boxes
        )
        return self._edges if has_more else ()


def _motion_field(motion: Matrix, shape: tuple[int, ...]) -> Vectors:
    """How far each pixel moves along x and y, (h, w) each."""
    x = np.arange(shape[1], dtype=np.float32)
    y = np.arange(shape[0], dtype=np.float32)[:, None]
    h = motion.astype(np.float32)
    depth = h[2, 0] * x + h[2, 1] * y + h[2, 2]
    moved_x = (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / depth - x
    moved_y = (h[1, 0] * x + h[1, 1] * y + h[1, 2]) / depth - y
    return moved_x, moved_y


def _typical_motion_px(motion: Matrix, shape: tuple[int, ...]) -> float:
    """How far the corners of a picture move, in the median."""
    corners = geometry.image_quad((shape[1], shape[0]))
    moved = geometry.transform_points(motion, corners) - corners
    return float(np.median(np.hypot(moved[:, 0], moved[:, 1])))


def _black_margins(image: Image) -> Margins | None:
    """Black rows above and below, black columns left and right; None of a picture all dark."""
    rows, columns = image.max(axis=1) > _BLACK, image.max(axis=0) > _BLACK
    margins: list[int] = []
    for is_bright in (rows, columns):
        bright = np.flatnonzero(is_bright)
        if not len(bright):
            return None
        ends = int(bright[0]), len(is_bright) - 1 - int(bright[-1])
        if max(ends) > _MOST_BAR * len(is_bright):
            return None
        margins += ends
    return margins[0], margins[1], margins[2], margins[3]


def _boxes(is_over: Mask) -> list[tuple[float, float, float, float]]:
    """Boxes (x, y, w, h) that cover the edges and what lies between close ones."""
    size = 2 * _MARGIN_PX + 1
    grown = cv2.dilate(is_over.astype(np.uint8), np.ones((size, size), np.uint8))
    count, labels = cv2.connectedComponents(grown)
    pixels = np.bincount(labels[is_over], minlength=count)
    is_thing = pixels >= _MIN_EDGE_PIXELS
    is_thing[0] = False
    covered = is_thing[labels]
    height, width = covered.shape
    down, across = -(-height // _CELL_PX), -(-width // _CELL_PX)
    padded = np.zeros((down * _CELL_PX, across * _CELL_PX), bool)
    padded[:height, :width] = covered
    blocks = padded.reshape(down, _CELL_PX, across, _CELL_PX)
    cells = np.asarray(blocks.any(axis=(1, 3)), bool)
    return [
        (x * _CELL_PX - 0.5, y * _CELL_PX - 0.5, w * _CELL_PX, h * _CELL_PX)
        for x, y, w, h in _merged(cells)
    ]


def _merged(cells: Mask) -> list[tuple[int, int, int, int]]:
    """Runs of cells along rows, those of equal ends in successive rows joined: (x, y, w, h)."""
    done: list[tuple[int, int, int, int]] = []
    growing: dict[tuple[int, int], tuple[int, int]] = {}
    for row in range(cells.shape[0] + 1):
        line = np.zeros(cells.shape[1] + 2, np.int8)
        if row < cells.shape[0]:
            line[1:-1] = cells[row]
        steps = np.diff(line)
        runs = zip(np.flatnonzero(steps > 0), np.flatnonzero(steps < 0), strict=True)
        here = {(int(a), int(b)): growing.get((int(a), int(b)), (row, 0)) for a, b in runs}
        for (a, b), (top, rows) in growing.items():
            if (a, b) not in here:
                done.append((a, top, b - a, rows))
        growing = {ends: (top, rows + 1) for ends, (top, rows) in here.items()}
    return done
