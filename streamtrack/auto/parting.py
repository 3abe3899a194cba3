"""Two things that were taken for one: they show as two parts, and the gap between them goes along.

What stands before a thing parts it as well, but keeps its place while the thing moves on; and where
a thing only looks as the ground does, its pixels are seen to move in the gap.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.auto.blobs import Scene

Doubles: TypeAlias = npt.NDArray[np.float64]

_LEAST_FRAMES = 5
_LEAST_WAY_PX = 3.0  # grid pixels
_ALONG_SHARE = 0.35  # of the thing's way, that the gap may lag behind
_MOVING_SHARE = 0.5  # of the gap's pixels


class Parting:
    """State of the gap in one thing: where it was first seen, and how far the thing went since."""

    def __init__(self) -> None:
        self._first: Doubles | None = None
        self._way = np.zeros(2)
        self._frames = 0

    def note_whole(self) -> None:
        """It was not found in two parts."""
        self._frames = max(0, self._frames - 1)
        if not self._frames:
            self._first = None

    def note_gap(self, gap: Doubles, center: Doubles, moved: Doubles, scene: Scene) -> bool:
        """Take in a gap (4,) of the frame, in a thing that moved on; True if it is two things.

        ``moved`` (2,) frame pixels is the thing's way since the frame before.
        """
        if _moving_share(gap, scene) > _MOVING_SHARE:
            self.note_whole()
            return False
        place = 0.5 * (gap[:2] + gap[2:]) - center
        if self._first is None:
            self._first, self._way, self._frames = place, np.zeros(2), 1
            return False
        self._way = self._way + moved
        self._frames += 1
        way_px = float(np.hypot(*self._way))
        grid_px = 1 / geometry.local_scale(scene.grid_from_frame, center)
        if way_px < _LEAST_WAY_PX * grid_px:
            return False
        lag_px = float(np.hypot(*(place - self._first)))
        if lag_px > _ALONG_SHARE * way_px:
            self._first = None
            return False
        return self._frames >= _LEAST_FRAMES


def gap_between(one: Doubles, other: Doubles) -> Doubles | None:
    """The box (4,) that parts two boxes (4,); None if they overlap."""
    low, high = np.minimum(one[2:], other[2:]), np.maximum(one[:2], other[:2])
    axis = int(np.argmax(high - low))
    if high[axis] <= low[axis]:
        return None
    gap = np.concatenate([np.minimum(low, high), np.maximum(low, high)])
    across = 1 - axis
    if high[across] > low[across]:  # they lie across from one another
        gap[across] = min(one[across], other[across])
        gap[across + 2] = max(one[across + 2], other[across + 2])
    return gap


def _moving_share(gap: Doubles, scene: Scene) -> float:
    """The share of a gap (4,) in which pixels are seen to move."""
    corners = geometry.transform_points(scene.grid_from_frame, gap.reshape(2, 2))
    x0, y0, x1, y1 = np.rint(np.clip(corners.ravel(), 0, 1e5)).astype(int).tolist()
    within = scene.moves[y0 : y1 + 1, x0 : x1 + 1]
    return float(within.mean()) if within.size else 0.0
