"""Does a camera's path shear its pictures, on the word of a minority? No camera does that.

Where most of a view moves by itself (a herd before the sea) what little agrees still has an
alignment, which can be wrong in a way that no single frame shows. Along the chain of keyframes
such errors add up to a shear. Cameras that turn, zoom or fly do not shear, and one that truly sees
its scene from another side has most of the view agreeing with that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from streamtrack import geometry
from streamtrack.camera.view_verdict import ViewAlignment
from streamtrack.types import Matrix, Size

_MINORITY = 0.5  # of the cells that both views show
_MAX_SHEAR = 1.1  # ratio of a picture's longest to its shortest stretch


@dataclass(slots=True, eq=False)
class _Witnesses:
    """Frames that were aligned with a keyframe, and the doubtful part of the way to it."""

    doubtful_way: Matrix
    frames: int = 0
    minorities: int = 0


class ShearWatch:
    """Keeps that part of the way to each keyframe on which only minorities agreed."""

    def __init__(self) -> None:
        self._keyframes: dict[int, _Witnesses] = {}

    def begin(self, keyframe: int) -> None:
        """The first keyframe, beyond doubt."""
        self._keyframes[keyframe] = _Witnesses(np.eye(3))

    def is_sheared(self, keyframe: int, found: ViewAlignment, size_wh: Size) -> bool:
        """Whether a frame's alignment with a keyframe is not to be believed."""
        witnesses = self._keyframes[keyframe]
        is_minority = found.inliers < _MINORITY * len(found.is_inlier)
        witnesses.frames += 1
        witnesses.minorities += is_minority
        return is_minority and _shear(self._way(keyframe, found), size_wh) > _MAX_SHEAR

    def extend(self, keyframe: int, found: ViewAlignment, index: int) -> None:
        """Frame ``index``, aligned with a keyframe, becomes one itself."""
        self._keyframes[index] = _Witnesses(self._way(keyframe, found))

    def _way(self, keyframe: int, found: ViewAlignment) -> Matrix:
        witnesses = self._keyframes[keyframe]
        if found.reference_from_view is None or 2 * witnesses.minorities <= witnesses.frames:
            return witnesses.doubtful_way
        return geometry.normalized(witnesses.doubtful_way @ found.reference_from_view)


def _shear(b_from_a: Matrix, size_wh: Size) -> float:
    """Ratio of the singular values of a mapping's Jacobian in the middle of a picture."""
    x, y, side = size_wh[0] / 2, size_wh[1] / 2, min(size_wh) / 8
    corner = geometry.transform_points(b_from_a, [[x, y], [x + side, y], [x, y + side]])
    a, c = (corner[1] - corner[0]).tolist()
    b, d = (corner[2] - corner[0]).tolist()
    size: float = a * a + b * b + c * c + d * d
    determinant: float = a * d - b * c
    if not determinant > 0:
        return float("inf")
    half = size / (2 * determinant)
    return half + math.sqrt(max(half * half - 1.0, 0.0))
