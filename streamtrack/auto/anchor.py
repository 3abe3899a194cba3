"""Exact motion: the inner picture of each thing is aligned with the frame, all things at once.

Inverse compositional Gauss-Newton under a similarity (Baker & Matthews 2004, section 3.2), with
Tukey's weights, as the tracker of given targets refines its poses (`tracking.refine`); but on a
small grid of samples, so that all things of a frame take one call. Positions and similarities are
complex numbers here: ``place = centre + turn * point``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.auto.blobs import Scene
from streamtrack.auto.boxes import box_around
from streamtrack.pyramid import Pyramid
from streamtrack.types import Mask, Points

Doubles: TypeAlias = npt.NDArray[np.float64]
Floats: TypeAlias = npt.NDArray[np.float32]
Complex: TypeAlias = npt.NDArray[np.complex128]

_COLUMNS, _ROWS = 24, 16  # samples
_CORE_SHARE = 0.8  # of a box: what lies around it does not belong to the thing
_LEAST_SIDE_PX = 16.0  # frame pixels
_LEAST_CONTRAST = 5.0  # grey levels
_LEAST_SHOWN = 0.5  # of the samples
_ROUNDS = 3
_NOISE_STEP = 4
_FURTHEST_SHARE = 0.25  # of the core's diagonal, that a thing may lie off its prediction
_MOST_TURNED = 0.15
_LEAST_CORRELATION = 0.8
_UNUSUAL = 0.04
_USUAL_RATE = 0.2
_STALE_TURN = 0.1
_STALE_CORRELATION = 0.93
_LEAST_GAIN = 0.04  # of one box in the mean of all
_PRIOR_SHARE = np.array([0.1, 0.1, 0.03, 0.03])  # of the core's diagonal; of the similarity

_across, _down = np.meshgrid(
    (np.arange(_COLUMNS) + 0.5) / _COLUMNS - 0.5, (np.arange(_ROWS) + 0.5) / _ROWS - 0.5
)
_ACROSS, _DOWN = _across.ravel().astype(np.float32), _down.ravel().astype(np.float32)
_CORNERS = np.array([0, _COLUMNS - 1, -_COLUMNS, -1])


@dataclass(frozen=True, slots=True, eq=False)
class Anchor:
    """A thing's inner picture, P samples of it; points are frame pixels from its centre.

    values    float32 (P,), of mean 0 and standard deviation 1 where the thing is shown
    jacobian  float32 (4, P), change of a value with a shift along x and y, growth, and turn
    shown     float32 (P,), 1 where the thing is shown, else 0
    points    float32 (P,) each, x and y
    octave    of the pyramid from which it was taken
    """

    values: Floats
    jacobian: Floats
    shown: Floats
    points: tuple[Floats, Floats]
    octave: int
    diagonal_px: float

    @classmethod
    def taken(cls, pyramid: Pyramid, box: Doubles, scene: Scene) -> Anchor | None:
        """What stands out inside of a box (4,); None if that is too little to be aligned."""
        width, height = _CORE_SHARE * (box[2:] - box[:2])
        if min(width, height) < _CORE_SHARE * _LEAST_SIDE_PX:
            return None
        step_px = math.sqrt(width / _COLUMNS * height / _ROWS)
        octave = min(5, max(0, round(math.log2(step_px))))
        x, y = np.float32(width) * _ACROSS, np.float32(height) * _DOWN
        middle = 0.5 * (box[:2] + box[2:])
        shown = _standing_out(scene, np.stack([x, y], axis=1) + middle.astype(np.float32))
        if np.mean(shown) < _LEAST_SHOWN:
            return None
        center, no_turn = np.array([complex(*middle)]), np.ones(1, np.complex128)
        seen = _seen(pyramid, np.array([octave]), (x[None], y[None]), center, no_turn)
        if seen[0, shown > 0].std() < _LEAST_CONTRAST:
            return None
        values = _normalised(seen, shown[None])[0]
        by_row, by_column = np.gradient(values.reshape(_ROWS, _COLUMNS))
        gx = by_column.ravel() * (_COLUMNS / width)
        gy = by_row.ravel() * (_ROWS / height)
        jacobian = np.stack([gx, gy, gx * x + gy * y, gy * x - gx * y])
        diagonal_px = math.hypot(width, height)
        return cls(values, jacobian.astype(np.float32), shown, (x, y), octave, diagonal_px)


@dataclass(slots=True, eq=False)
class Held:
    """An anchor, how it now lies in the frame, and where in it the thing's box is.

    ``turn`` is frame_from_anchor without its shift; ``offset`` of the box's middle and ``size`` are
    pixels of the frame from which the anchor was taken. ``looks`` counts the boxes that led there,
    ``unseen`` the frames since it was last found, and ``usual`` is the correlation when it is.
    """

    anchor: Anchor
    size: Doubles
    turn: complex = 1.0
    offset: complex = 0.0
    looks: int = 6
    unseen: int = 0
    usual: float = 1.0

    def center_for(self, middle: Doubles) -> complex:
        """Where the anchor's centre lies if the box's middle is there."""
        return complex(*middle) - self.turn * self.offset

    def box_at(self, center: complex) -> Doubles:
        """The box (4,), if the anchor's centre lies there."""
        middle = center + self.turn * self.offset
        return box_around(np.array([middle.real, middle.imag]), abs(self.turn) * self.size)

    def correct(self, shift: Doubles, growth: Doubles) -> None:
        """The box was found to lie otherwise in the anchor, and to be larger: the mean counts."""
        self.looks += 1
        gain = max(3 / self.looks, _LEAST_GAIN)
        self.offset += gain * complex(*shift) / self.turn
        self.size = self.size + gain / abs(self.turn) * growth

    @property
    def is_stale(self) -> bool:
        """Does the thing look otherwise by now?"""
        is_turned = abs(self.turn - 1) > _STALE_TURN
        return self.unseen > 1 or is_turned or self.usual < _STALE_CORRELATION

    def is_found(self, correlation: float) -> bool:
        """Is it as like as it usually is? Half hidden it would be found beside its place."""
        if correlation < max(_LEAST_CORRELATION, self.usual - _UNUSUAL):
            self.unseen += 1
            return False
        self.usual += _USUAL_RATE * (correlation - self.usual)
        self.unseen = 0
        return True


@dataclass(frozen=True, slots=True, eq=False)
class Aligned:
    """Where N anchors were found: complex (N,) centres and turns, float (N,) correlations.

    ``is_near`` bool (N,) says which lie in the frame, and not far from where they were looked for.
    """

    centers: Complex
    turns: Complex
    correlations: Floats
    is_near: Mask


def align(pyramid: Pyramid, anchors: Sequence[Anchor], centers: Complex, turns: Complex) -> Aligned:
    """Align anchors with the frame, from where they should be."""
    values = np.stack([anchor.values for anchor in anchors])
    jacobian = np.stack([anchor.jacobian for anchor in anchors])
    shown = np.stack([anchor.shown for anchor in anchors])
    counts = shown.sum(axis=1)
    x, y = (np.stack(axis) for axis in zip(*(anchor.points for anchor in anchors), strict=True))
    octaves = np.array([anchor.octave for anchor in anchors])
    diagonals = np.array([anchor.diagonal_px for anchor in anchors])
    expected, expected_turns = centers, turns
    prior = np.outer(diagonals, _PRIOR_SHARE)
    prior[:, 2:] = _PRIOR_SHARE[2:]
    correlations = np.zeros(len(anchors), np.float32)
    for _ in range(_ROUNDS):
        seen = _normalised(_seen(pyramid, octaves, (x, y), centers, turns), shown)
        correlations = np.einsum("np,np,np->n", seen, values, shown) / counts
        residual = seen - values
        sizes = np.abs(residual[:, ::_NOISE_STEP])
        middle = sizes.shape[1] // 2
        noise = 1.4826 * np.partition(sizes, middle, axis=1)[:, middle] + np.float32(0.05)
        weights = np.maximum(1 - (residual / (np.float32(4.685) * noise[:, None])) ** 2, 0) ** 2
        weighted = jacobian * (weights * shown)[:, None]
        normal = (weighted @ jacobian.transpose(0, 2, 1)).astype(np.float64)
        gradient = (weighted @ residual[:, :, None]).astype(np.float64)
        normal[:, range(4), range(4)] += (noise[:, None] / prior) ** 2
        step = np.linalg.solve(normal, gradient)[:, :, 0]
        grown = 1 + step[:, 2] + 1j * step[:, 3]
        centers = centers - turns * (step[:, 0] + 1j * step[:, 1]) / grown
        turns = turns / grown
    corners = centers[:, None] + turns[:, None] * (x + 1j * y)[:, _CORNERS]
    is_near = (corners.real >= 0).all(axis=1) & (corners.imag >= 0).all(axis=1)
    is_near &= (corners.real <= pyramid.size_wh[0] - 1).all(axis=1)
    is_near &= (corners.imag <= pyramid.size_wh[1] - 1).all(axis=1)
    is_near &= np.abs(centers - expected) < _FURTHEST_SHARE * diagonals
    is_near &= np.abs(turns / expected_turns - 1) < _MOST_TURNED
    return Aligned(centers, turns, correlations, is_near)


def _normalised(seen: Floats, shown: Floats) -> Floats:
    """Samples (N, P) brought to mean 0 and standard deviation 1 where ``shown`` is 1."""
    counts = shown.sum(axis=1, keepdims=True)
    seen = seen - np.einsum("np,np->n", seen, shown)[:, None] / counts
    size = np.sqrt(np.einsum("np,np,np->n", seen, seen, shown)[:, None] / counts)
    return np.asarray(seen / (size + np.float32(1e-3)), np.float32)


def _standing_out(scene: Scene, places: Points) -> Floats:
    """1 (P,) where a thing is seen at places (P, 2) of the frame, else 0."""
    grid = np.rint(geometry.transform_points(scene.grid_from_frame, places)).astype(np.intp)
    height, width = scene.solid.shape
    x, y = np.clip(grid, 0, [width - 1, height - 1]).T
    return np.asarray(scene.solid[y, x], np.float32)


def _seen(
    pyramid: Pyramid,
    octaves: npt.NDArray[np.intp],
    points: tuple[Floats, Floats],
    centers: Complex,
    turns: Complex,
) -> Floats:
    """Grey values (N, P) of the frame at ``center + turn * point``, x and y (N, P) of the points.

    Each row is taken from its level of the pyramid.
    """
    x, y = points
    seen = np.empty(x.shape, np.float32)
    for octave in np.unique(octaves).tolist():
        level = pyramid.level(octave)
        rows = np.flatnonzero(octaves == octave)
        scale = level.shape[1] / pyramid.size_wh[0]
        middle = ((centers[rows] + (0.5 + 0.5j)) * scale - (0.5 + 0.5j)).astype(np.complex64)
        turn = (turns[rows] * scale).astype(np.complex64)
        px, py = x[rows], y[rows]
        level_x = turn.real[:, None] * px - turn.imag[:, None] * py + middle.real[:, None]
        level_y = turn.imag[:, None] * px + turn.real[:, None] * py + middle.imag[:, None]
        seen[rows] = cv2.remap(
            level, level_x, level_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
    return seen
