"""Places in the background's grid: the reduced frame, what moves in it, and what lies where."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.auto.background import Outstanding
from streamtrack.auto.blobs import Scene
from streamtrack.camera.view_levels import filled
from streamtrack.frame_view import FrameView
from streamtrack.types import Image, Mask, Matrix, Size, Track

Doubles: TypeAlias = npt.NDArray[np.float64]

_WIDTH_PX = 320
_CELL_PX = 8
_CORNER = 2e-4  # least eigenvalue of the structure tensor by `cv2.cornerMinEigenVal`
_LEAST_CORNERS = 12
_STANDS_PX = 0.5  # grid pixels a frame


@dataclass(frozen=True, slots=True)
class Moment:
    """Seconds since the frame before, frame pixels a grid pixel, the frame's size.

    ``is_fixed`` says that the camera stands, so that its pose cannot be wrong.
    """

    step_s: float
    grid_px: float
    size_wh: Size
    is_fixed: bool


def reduced(view: FrameView) -> tuple[Image, Matrix]:
    """The frame in colour at about `_WIDTH_PX`, and small_from_frame."""
    width, height = view.size_wh
    step = max(1, round(max(width, height) / _WIDTH_PX))
    size = max(1, width // step), max(1, height // step)
    image = view.frame.image
    if image.ndim == 2:
        image = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
    if step > 1:
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return image, geometry.scaling(size[0] / width, size[1] / height)


def is_invertible(matrix: Matrix) -> bool:
    try:
        return bool(np.isfinite(geometry.inverted(matrix)).all())
    except np.linalg.LinAlgError:
        return False


def resting_share(
    seen: Outstanding, motion: npt.NDArray[np.float32] | None, elsewhere: Mask
) -> float:
    """Which share of the picture's corners, outside ``elsewhere`` (h, w), is at rest.

    Where few are, the pose tells little of what moves (waves, water and a herd before a camera that
    goes along). 1 where there are too few corners to say so.
    """
    if motion is None:
        return 1.0
    cells = slice(_CELL_PX // 2, None, _CELL_PX), slice(_CELL_PX // 2, None, _CELL_PX)
    strength = cv2.cornerMinEigenVal(seen.grey, 5)[cells]
    told = (strength > _CORNER) & seen.comparable[cells] & ~elsewhere[cells]
    moved = motion[cells][told]
    if len(moved) < _LEAST_CORNERS:
        return 1.0
    return float(np.mean(np.hypot(moved[:, 0], moved[:, 1]) < _STANDS_PX))


def hidden_by(seen: Outstanding, given: Sequence[Track]) -> Mask:
    """The places of the targets that were given."""
    quads = []
    for track in given:
        if track.quad is not None and np.isfinite(track.quad).all():
            middle = track.quad.mean(axis=0)
            quads.append(middle + np.float32(1.15) * (track.quad - middle))
    return filled(quads, seen.grid_from_frame, seen.clear.shape)


def motion_within(scene: Scene, box: Doubles) -> tuple[Doubles, float] | None:
    """Median motion (2,), frame px, of what stands out within a box, and its share of the box."""
    if scene.motion is None:
        return None
    corners = geometry.transform_points(scene.grid_from_frame, box.reshape(2, 2))
    if not np.isfinite(corners).all():
        return None
    x0, y0, x1, y1 = np.rint(np.clip(corners.ravel(), -1e5, 1e5)).astype(int).tolist()
    window = slice(max(0, y0), max(0, y1 + 1)), slice(max(0, x0), max(0, x1 + 1))
    inside = scene.solid[window]
    count = int(np.count_nonzero(inside))
    if count < 6:
        return None
    frame_from_grid = geometry.inverted(scene.grid_from_frame)
    scale = geometry.local_scale(frame_from_grid, corners.mean(axis=0).astype(np.float64))
    moved = np.median(scene.motion[window][inside], axis=0).astype(np.float64) * scale
    return moved, count / max(1, (x1 - x0 + 1) * (y1 - y0 + 1))
