"""A guess at the motion of a scene between two frames where an alignment's own basin misleads.

An alignment goes downhill from where the motion was expected, and ends between two motions where
strong texture moves by itself (a herd) before a wide and weak background. So affine motions are
drawn from triples of points all over the view (Fischler & Bolles 1981), found by pyramidal
Lucas-Kanade (Bouguet 2000; `cv2.calcOpticalFlowPyrLK`), and the one that the pictures bear out best
is taken. Pictures judge, not points: what moves along an edge is not seen of a point on it.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.camera.view_levels import USUAL, ReferenceView, ViewLevels, fill
from streamtrack.types import Image, Matrix, Points

_CELLS = (26, 18)
_EDGE_PX = 6
_CORNER = 2e-5  # least eigenvalue of the structure tensor by `cv2.cornerMinEigenVal`
_WINDOW = (13, 13)
_OCTAVES = 3
_MAX_RETURN_PX = 0.4  # by which a point may miss its place on the way back
_LEAST_POINTS = 12
_DRAWN = 80
_LEAST_TRIANGLE = 0.025  # of the view, twice, between three points that tell of all of it
_MAX_CHANGE = 0.35  # of shape and size, from one frame to the next
_OF_PIXELS = 3  # every third of those that an alignment would take
_SEED = 1


def guessed_motion(
    before: ViewLevels,
    view: ViewLevels,
    reference: ReferenceView,
    reference_from_before: Matrix,
    hidden: Sequence[Points] = (),
) -> Matrix | None:
    """``reference_from_view`` by the motion since the view before, whose place is known.

    ``hidden`` are quads (4, 2) in both views that do not belong to the scene. None if the views
    have too little in common.
    """
    if before.usual.shape != view.usual.shape:
        return None
    starts = _corners(before, hidden)
    ends = _flowed(before.usual, view.usual, starts)
    is_kept = np.linalg.norm(_flowed(view.usual, before.usual, ends) - starts, axis=1)
    starts, ends = starts[is_kept < _MAX_RETURN_PX], ends[is_kept < _MAX_RETURN_PX]
    motions = _drawn(starts, ends, before.usual.shape)
    if not len(motions):
        return None
    level_from_view = view.level_from_view(USUAL)
    before_from_reference = level_from_view @ geometry.inverted(reference_from_before)
    motions = motions @ before_from_reference
    best = motions[np.argmin(_misfits(motions, reference, view))]
    return geometry.normalized(geometry.inverted(best) @ level_from_view)


def _corners(levels: ViewLevels, hidden: Sequence[Points]) -> Points:
    """The best corner (N, 2) of every cell that has one, pixels of the usual level."""
    strength = np.asarray(cv2.cornerMinEigenVal(levels.usual, 5), np.float32)
    fill(strength, hidden, levels.level_from_view(USUAL), 0)
    across, down = _CELLS
    height, width = strength.shape
    cell_w, cell_h = (width - 2 * _EDGE_PX) // across, (height - 2 * _EDGE_PX) // down
    if min(cell_w, cell_h) < 2:
        return np.zeros((0, 2), np.float32)
    inner = strength[_EDGE_PX:, _EDGE_PX:][: down * cell_h, : across * cell_w]
    cells = inner.reshape(down, cell_h, across, cell_w).swapaxes(1, 2).reshape(down * across, -1)
    best = cells.argmax(axis=1)
    cell = np.flatnonzero(cells[np.arange(len(cells)), best] > _CORNER)
    x = _EDGE_PX + (cell % across) * cell_w + best[cell] % cell_w
    y = _EDGE_PX + (cell // across) * cell_h + best[cell] // cell_w
    return np.stack([x, y], axis=1).astype(np.float32)


def _flowed(one: Image, other: Image, points: Points) -> Points:
    """Where points (N, 2) of one picture are in another; NaN where that is not found."""
    if not len(points):
        return points
    moved, status, _ = cv2.calcOpticalFlowPyrLK(  # type: ignore[call-overload]
        one, other, points, None, winSize=_WINDOW, maxLevel=_OCTAVES
    )
    moved[status[:, 0] == 0] = np.nan
    return np.asarray(moved, np.float32)


def _drawn(starts: Points, ends: Points, shape: tuple[int, ...]) -> npt.NDArray[np.float64]:
    """Affine motions (M, 3, 3) of triples of pairs."""
    if len(starts) < _LEAST_POINTS:
        return np.zeros((0, 3, 3))
    rng = np.random.default_rng(_SEED)
    rows = rng.integers(0, len(starts), (_DRAWN, 3))
    corners = np.concatenate([starts[rows], np.ones((_DRAWN, 3, 1))], axis=2)
    is_wide = np.abs(np.linalg.det(corners)) > 2 * _LEAST_TRIANGLE * shape[0] * shape[1]
    solved = np.linalg.solve(corners[is_wide], ends[rows[is_wide]].astype(np.float64))
    motions = np.tile(np.eye(3), (len(solved), 1, 1))
    motions[:, :2] = solved.swapaxes(1, 2)
    changes = np.abs(motions[:, :2, :2] - np.eye(2)).max(axis=(1, 2))
    plausible: npt.NDArray[np.float64] = motions[changes < _MAX_CHANGE]
    return plausible


def _misfits(
    motions: npt.NDArray[np.float64], reference: ReferenceView, view: ViewLevels
) -> npt.NDArray[np.float32]:
    """How badly pictures agree (M,) under mappings (M, 3, 3) from the reference to a level.

    Absolute differences of pixels all over the view, each up to the median of the values.
    """
    pixels = reference.pixels(USUAL)
    points, wanted = pixels.points[:, ::_OF_PIXELS], pixels.values[::_OF_PIXELS]
    mappings = motions @ geometry.inverted(reference.levels.level_from_view(USUAL))
    x, y, depth = np.moveaxis(mappings.astype(np.float32) @ points, 1, 0)
    seen = cv2.remap(view.high_passed(USUAL), x / depth, y / depth, cv2.INTER_LINEAR)
    off = np.minimum(np.abs(seen - wanted), np.median(np.abs(wanted)))
    return np.asarray(off.mean(axis=1), np.float32)
