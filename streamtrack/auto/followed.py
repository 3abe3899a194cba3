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
_CUT_SHARE = 0.8  # of its size: when less is found it is partly hidden
_GROWN_SHARE = 1.4  # when more is found it has met something
_ODD_FRAMES = 7  # for which it keeps its size all the same
_KNOWN_HITS = 12  # sightings after which its size is known
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
    odd: int = 0
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
        touches = touched_edges(blob.box, size_wh) | touched_edges(self.box, size_wh)
        was_lost = self.life is Life.LOST
        if touches.any() and not was_lost:
            shift = 0.5 * (blob.box - self.box).reshape(2, 2).sum(axis=0)
            self.box = blob.box.copy()
        else:
            is_odd = bool(_is_odd(self.box, blob.box).any())
            self.odd = self.odd + 1 if is_odd else 0
            if was_lost or (self.hits >= _KNOWN_HITS and self.odd <= _ODD_FRAMES):
                shift, growth = _by_nearer_end(self.box, blob.box)
            else:
                low, high = (blob.box - self.box).reshape(2, 2)
                shift, growth = 0.5 * (low + high), high - low
            gain = 1.0 if was_lost else _POSITION_GAIN
            self.place(self.center + gain * shift, self.size + _SIZE_GAIN * growth)
        if not was_lost:
            self._learn_speed(blob, shift, step_s, not touches.any())
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


def _by_nearer_end(expected: Doubles, found: Doubles) -> tuple[Doubles, Doubles]:
    """Shift (2,) and growth (2,) that take the expected box to a box of another size.

    Where much less is found it is partly hidden, where much more it has met something: it keeps
    its size then, and the end that is nearer to where it should be counts.
    """
    low, high = (found - expected).reshape(2, 2)
    is_odd = _is_odd(expected, found)
    nearer = np.where(np.abs(low) <= np.abs(high), low, high)
    shift = np.where(is_odd, nearer, 0.5 * (low + high))
    return shift, np.where(is_odd, 0.0, high - low)


def _is_odd(expected: Doubles, found: Doubles) -> npt.NDArray[np.bool_]:
    """Along which axes (2,) much less or more is found than expected."""
    ratio = (found[2:] - found[:2]) / np.maximum(expected[2:] - expected[:2], 1e-6)
    odd: npt.NDArray[np.bool_] = (ratio < _CUT_SHARE) | (ratio > _GROWN_SHARE)
    return odd


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
    """Intersection of two boxes (4,) over their union, and over the first."""
    x0, y0, x1, y1 = one.tolist()
    u0, v0, u1, v1 = other.tolist()
    width, height = min(x1, u1) - max(x0, u0), min(y1, v1) - max(y0, v0)
    if width <= 0 or height <= 0:
        return 0.0, 0.0
    common, area = width * height, (x1 - x0) * (y1 - y0)
    return common / (area + (u1 - u0) * (v1 - v0) - common), common / area


def overlaps(ones: Doubles, others: Doubles) -> tuple[Doubles, Doubles]:
    """`overlap` of each of the boxes (N, 4) with each of the others (M, 4), both (N, M)."""
    low = np.maximum(ones[:, None, :2], others[None, :, :2])
    high = np.minimum(ones[:, None, 2:], others[None, :, 2:])
    common = np.prod(np.maximum(high - low, 0.0), axis=2)
    area = np.prod(ones[:, 2:] - ones[:, :2], axis=1)[:, None]
    other_area = np.prod(others[:, 2:] - others[:, :2], axis=1)[None]
    return common / (area + other_area - common), common / area
