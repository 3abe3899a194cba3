"""A lens that bends straight lines: how much, as keyframes show it, and undone in their links.

A homography fitted to a part of two views takes the bending of the lens for perspective, always
the same way, so that a way over a plane becomes a dome. But bent views do not quite fit: what the
cells of an alignment still disagree in tells the bending, one number for all (after Fitzgibbon
2001, "Simultaneous linear estimation of multiple view geometry and lens distortion").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.camera.view_verdict import ViewAlignment
from streamtrack.fitting import fit
from streamtrack.mosaic.types import Link
from streamtrack.types import Matrix, Model, Points, Size
from streamtrack.uncertainty import motion_rows

Doubles = npt.NDArray[np.float64]

_NEUTRAL = 0.6  # squared radius that stays where it is: what is left is least over the picture
_LEAST_LINKS = 4
_LEAST_CELLS = 12
_SIGNIFICANT = 4.0  # times the standard error of the median
_MAX_SPREAD = 0.2  # of the bend: where a scene is not flat links disagree more
_LEAST_BEND = 1e-4
_NEWS = 0.1  # share by which another bend is worth adjusting all poses anew
_CELL_PX = 0.01


@dataclass(frozen=True, slots=True)
class Lens:
    """``straight = seen (1 + bend (|seen|^2 - 0.6))``, seen from the middle, in half longer sides.

    Poses of frames map straight pixels; those of a picture are off from them by some thousandths of
    its size where a lens bends by as much.
    """

    bend: float

    def straight(self, points: Points, size_wh: Size) -> Points:
        """Points (N, 2) of a picture where a lens that does not bend would show them."""
        seen, half = _in_units(points, size_wh)
        off = self.bend * half * seen * (np.sum(seen**2, axis=1, keepdims=True) - _NEUTRAL)
        straight: Points = (points + off).astype(np.float32)
        return straight

    def flat(self, found: ViewAlignment, size_wh: Size) -> Matrix:
        """``reference_from_view`` of an alignment for straight pixels, both pictures of a size."""
        assert found.reference_from_view is not None
        if not self.bend:
            return found.reference_from_view
        used = found.is_inlier
        view = self.straight(found.view_points[used], size_wh)
        return fit(Model.HOMOGRAPHY, view, self.straight(found.reference_points[used], size_wh))

    def link(self, link: Link, size_wh: Size) -> Link:
        """A link for straight pixels."""
        if not self.bend or link.b_from_a is None:
            return link
        a, b = self.straight(link.a_points, size_wh), self.straight(link.b_points, size_wh)
        own = replace(link.registration, b_from_a=fit(Model.HOMOGRAPHY, a, b))
        return replace(link, a_points=a, b_points=b, registration=own)


STRAIGHT = Lens(0.0)


def seen_bend(found: ViewAlignment, size_wh: Size) -> float:
    """The bend by which two views of a size would agree better, or NaN.

    A step of least squares on the gradients of all agreeing cells, with the bend as the ninth
    freedom beside those of the homography.
    """
    used = found.is_inlier
    if found.reference_from_view is None or np.count_nonzero(used) < _LEAST_CELLS:
        return float("nan")
    here, there = (p[used].astype(np.float64) for p in (found.reference_points, found.view_points))
    unit, half = _in_units(here, size_wh)
    view_from_reference = geometry.inverted(found.reference_from_view)
    steps = _CELL_PX * np.eye(2)
    ahead = [_mapped(view_from_reference, here + step) for step in steps]
    behind = [_mapped(view_from_reference, here - step) for step in steps]
    jacobian = np.stack([(a - b) / (2 * _CELL_PX) for a, b in zip(ahead, behind, strict=True)], 2)
    bent_there = np.linalg.solve(jacobian, _bent(there, size_wh)[..., None])[..., 0]
    by_bend = bent_there - _bent(here, size_wh)
    rows = half * motion_rows(unit).reshape(-1, 2, 8)
    rows = np.concatenate([rows, by_bend[..., None]], axis=2)
    xx, xy, yy, *pull = found.gradients[used].T
    weights = np.stack([np.stack([xx, xy], 1), np.stack([xy, yy], 1)], 1)
    normal = np.einsum("nia,nij,njb->ab", rows, weights, rows)
    vector = np.einsum("nia,in->a", rows, np.stack(pull))
    try:
        return float(np.linalg.solve(normal, vector)[8])
    except np.linalg.LinAlgError:
        return float("nan")


def agreed(bends: Sequence[float]) -> Lens:
    """The lens that alignments agree on; one that does not bend if they do not."""
    if len(bends) < _LEAST_LINKS:
        return STRAIGHT
    middle = float(np.median(bends))
    spread = 1.4826 * float(np.median(np.abs(np.asarray(bends) - middle)))
    error = 1.2533 * spread / np.sqrt(len(bends))
    least = max(spread / _MAX_SPREAD, _SIGNIFICANT * error) + _LEAST_BEND
    return Lens(middle) if abs(middle) > least else STRAIGHT


def is_news(lens: Lens, before: Lens) -> bool:
    """Whether a lens is so different that all poses should be adjusted for it."""
    return abs(lens.bend - before.bend) > _LEAST_BEND + _NEWS * abs(before.bend)


def _in_units(points: npt.NDArray[np.floating], size_wh: Size) -> tuple[Doubles, float]:
    """Points from the middle in halves of the longer side, and how many pixels that is."""
    half = max(size_wh) / 2
    return (points - (np.array(size_wh) - 1) / 2) / half, half


def _bent(points: Doubles, size_wh: Size) -> Doubles:
    """How points move, in pixels, for a bend of 1."""
    unit, half = _in_units(points, size_wh)
    moved: Doubles = half * unit * np.sum(unit**2, axis=1, keepdims=True)
    return moved


def _mapped(matrix: Matrix, points: Doubles) -> Doubles:
    """In full precision."""
    moved = points @ matrix[:, :2].T + matrix[:, 2]
    mapped: Doubles = moved[:, :2] / moved[:, 2:]
    return mapped
