"""One thing that moves: where it is, how fast, what it looks like, and what became of it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.auto.blobs import Blob
from streamtrack.types import Matrix, Points, Size

Doubles: TypeAlias = npt.NDArray[np.float64]

_POSITION_GAIN = 0.7  # share of what was found in the place of the next frame
_SIZE_GAIN = 0.25
_SPEED_GAIN = 0.3
_COLOR_RATE = 0.1
_EDGE_PX = 3.0


class Life(Enum):
    """Where a thing is in its life."""

    NEW = "new"
    """Not yet known to be a thing that moves."""
    SEEN = "seen"
    CARRIED = "carried"
    """Not told from its neighbours in this frame, but seen to move on."""
    LOST = "lost"
    OVER = "over"


@dataclass(slots=True, eq=False)
class Followed:
    """State of one thing; boxes are x0, y0, x1, y1 in pixels of the last frame.

    ``velocity`` (2,) px/s is against the background. ``origin`` (2,) is where it was first seen, as
    the camera now sees that place. ``home`` are the box and, by then, the name's template.
    """

    box: Doubles
    colors: Doubles
    velocity: Doubles
    origin: Doubles
    time_s: float
    life: Life = Life.NEW
    name: str = ""
    home: Doubles | None = None
    hits: int = 1
    misses: int = 0
    path_px: float = 0.0
    flow_px: Doubles | None = None
    lost_s: float = 0.0
    still: int = 0
    reason: str = ""

    @classmethod
    def begun(cls, blob: Blob, time_s: float, step_s: float) -> Followed:
        moved = np.where(np.isfinite(blob.motion), blob.motion, 0.0)
        return cls(
            blob.box.copy(),
            blob.colors,
            moved / step_s,
            blob.center,
            time_s,
            flow_px=moved.copy(),
        )

    @property
    def center(self) -> Doubles:
        return 0.5 * (self.box[:2] + self.box[2:])

    @property
    def size(self) -> Doubles:
        return self.box[2:] - self.box[:2]

    @property
    def quad(self) -> Points:
        x0, y0, x1, y1 = self.box
        return geometry.box_quad(x0, y0, x1 - x0, y1 - y0)

    @property
    def moved_px(self) -> float:
        """How far it has come from where it was first seen."""
        return float(np.hypot(*(self.center - self.origin)))

    def predict(self, frame_from_before: Matrix, time_s: float) -> None:
        """Move on to the next frame: with the picture, and at its own speed."""
        step_s = max(0.0, time_s - self.time_s)
        center, scale = _carried(frame_from_before, self.center)
        self.origin, _ = _carried(frame_from_before, self.origin)
        center = center + self.velocity * step_s
        self.place(center, self.size * scale)
        self.velocity = self.velocity * scale
        self.time_s = time_s

    def place(self, center: Doubles, size: Doubles) -> None:
        self.box = np.concatenate([center - 0.5 * size, center + 0.5 * size])

    def take(self, blob: Blob, step_s: float, size_wh: Size) -> None:
        """It was found as this blob."""
        before = self.center - self.velocity * step_s
        predicted = self.box
        touches = touched_edges(blob.box, size_wh) | touched_edges(predicted, size_wh)
        is_whole = not touches.any()
        off = blob.box - predicted
        if self.life is Life.LOST or not is_whole:
            self.box = blob.box.copy()
        else:
            shift = 0.5 * (off[:2] + off[2:])
            growth = 0.5 * (off[2:] - off[:2])
            center = self.center + _POSITION_GAIN * shift
            self.place(center, self.size + 2 * _SIZE_GAIN * growth)
        if self.life is not Life.LOST:
            self._learn_speed(blob, 0.5 * (off[:2] + off[2:]), step_s, is_whole)
        self.path_px += float(np.hypot(*(self.center - before)))
        self.colors = self.colors + _COLOR_RATE * (blob.colors - self.colors)
        self.hits += 1
        self.misses = 0

    def resume(self, life: Life) -> None:
        """It was met with again; what has no name yet stays new."""
        if self.life is not Life.NEW:
            self.life, self.lost_s, self.reason = life, 0.0, ""

    def note_rest(self, least_px: float, step_s: float) -> None:
        """Count the frames in a row in which it has hardly moved."""
        is_still = float(np.hypot(*self.velocity)) * step_s < least_px
        self.still = self.still + 1 if is_still else 0

    def carry(self, moved: Doubles, step_s: float) -> None:
        """It was seen to move by ``moved`` (2,) px against the background, though not its edge."""
        self.box = self.box + np.tile(moved - self.velocity * step_s, 2)
        self.velocity = self.velocity + _SPEED_GAIN * (moved / step_s - self.velocity)
        self.misses = 0

    def _learn_speed(self, blob: Blob, shift: Doubles, step_s: float, is_whole: bool) -> None:
        by_place = self.velocity + shift / step_s
        by_flow = blob.motion / step_s
        has_flow = bool(np.isfinite(by_flow).all())
        if has_flow and self.flow_px is not None:
            self.flow_px = self.flow_px + blob.motion
        if is_whole:
            measured = 0.5 * (by_place + by_flow) if has_flow else by_place
        elif has_flow:
            measured = by_flow
        else:
            return
        gain = max(_SPEED_GAIN, 1 / (self.hits + 1))
        self.velocity = self.velocity + gain * (measured - self.velocity)


def _carried(frame_from_before: Matrix, point: Doubles) -> tuple[Doubles, float]:
    """A point (2,) seen by the camera of the next frame, and how much larger things are there."""
    moved = geometry.transform_points(frame_from_before, point)[0].astype(np.float64)
    if not np.isfinite(moved).all():
        return point, 1.0
    return moved, float(np.clip(geometry.local_scale(frame_from_before, point), 0.5, 2.0))


def touched_edges(box: Doubles, size_wh: Size) -> npt.NDArray[np.bool_]:
    """Which of the picture's edges (4,) left, top, right, bottom a box reaches."""
    low = box[:2] <= _EDGE_PX - 0.5
    high = box[2:] >= np.array(size_wh) - 0.5 - _EDGE_PX
    return np.concatenate([low, high])


def overlap(one: Doubles, other: Doubles) -> tuple[float, float]:
    """Intersection of two boxes over their union, and over the first."""
    sides = np.minimum(one[2:], other[2:]) - np.maximum(one[:2], other[:2])
    if sides[0] <= 0 or sides[1] <= 0:
        return 0.0, 0.0
    common = float(sides[0] * sides[1])
    area = float(np.prod(one[2:] - one[:2]))
    union = area + float(np.prod(other[2:] - other[:2])) - common
    return common / union, common / area
