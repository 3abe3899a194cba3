"""One thing that moves: where it is, how fast, what it looks like, and what became of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.auto.anchor import Held
from streamtrack.auto.blobs import Blob
from streamtrack.auto.boxes import (
    HasBox,
    box_around,
    moved_boxes,
    moved_points,
    touched_edges,
)
from streamtrack.auto.free_ends import FreeEnds, by_both_ends
from streamtrack.auto.likeness import Likeness
from streamtrack.types import Matrix, Points, Size

Doubles: TypeAlias = npt.NDArray[np.float64]

_POSITION_GAIN = 0.7  # share of what was found in the place of the next frame
_SIZE_GAIN = 0.25
_KNOWN_HITS = 12  # sightings after which its size is known
_SPEED_GAIN = 0.3
_EXACT_SPEED_GAIN = 0.5
_APART_PX = 1.5  # between the motions of a thing's picture and of its pixels
_APART_SHARE = 0.5
_COLOR_RATE = 0.1


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
class Followed(HasBox):
    """State of one thing; boxes are x0, y0, x1, y1 in pixels of the last frame.

    ``velocity`` (2,) px/s is against the background. ``origin`` (2,) is where it was first seen, as
    the camera now sees that place. ``home`` are the box and, by then, the name's template.
    ``is_aligned`` says that its picture gave its exact place in this frame.
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
    ends: FreeEnds = field(default_factory=FreeEnds)
    likeness: Likeness | None = None
    held: Held | None = None
    is_aligned: bool = False
    touches: bool = False
    alone: int = 0
    guessed: int = 0
    joined: int = 0
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
    def quad(self) -> Points:
        x0, y0, x1, y1 = self.box
        return geometry.box_quad(x0, y0, x1 - x0, y1 - y0)

    @property
    def moved_px(self) -> float:
        """How far it has come from where it was first seen."""
        return float(np.hypot(*(self.center - self.origin)))

    def take(self, blob: Blob, step_s: float, size_wh: Size) -> None:
        """It was found as this blob."""
        before = self.center - self.velocity * step_s
        touches = touched_edges(blob.box, size_wh) | touched_edges(self.box, size_wh)
        was_lost = self.life is Life.LOST
        is_cut = touches.reshape(2, 2).any(axis=0) & (not was_lost)  # along which axes
        self.ends.look(blob)
        if self.is_aligned and self._moves_otherwise(blob, step_s):
            self.is_aligned, self.held = False, None
        whole_shift, whole_growth = shift, growth = by_both_ends(self.box, blob.box)
        if self.hits >= _KNOWN_HITS:
            shift, growth = self.ends.correction(self.box, blob.box)
        if self.is_aligned and self.held is not None:
            self._learn_flow(blob)
            if not self.touches and not is_cut.any():
                center = self.held.center_for(self.center)
                self.held.correct(shift, growth)
                self.box = self.held.box_at(center)
        else:
            gain = 1.0 if was_lost else _POSITION_GAIN
            self.box = box_around(
                self.center + np.where(is_cut, whole_shift, gain * shift),
                self.size + np.where(is_cut, whole_growth, _SIZE_GAIN * growth),
            )
            shift = np.where(is_cut, whole_shift, shift)
            if not was_lost:
                self._learn_flow(blob)
                self._learn_speed(blob, shift, step_s, not touches.any())
        self.path_px += float(np.hypot(*(self.center - before)))
        self.colors = self.colors + _COLOR_RATE * (blob.colors - self.colors)
        self.hits += 1
        self.misses = self.guessed = self.joined = 0

    def resume(self, life: Life) -> None:
        """It was met with again; what has no name yet stays new."""
        if self.life not in (Life.NEW, Life.OVER):
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
        self.ends.forget()

    def align(self, center: complex, turn: complex, step_s: float) -> None:
        """Its own picture was found to lie there in the frame."""
        assert self.held is not None
        self.held.turn = turn
        before, self.box = self.center, self.held.box_at(center)
        self.velocity = self.velocity + _EXACT_SPEED_GAIN / step_s * (self.center - before)
        self.is_aligned = True

    def _moves_otherwise(self, blob: Blob, step_s: float) -> bool:
        """Is what was aligned not what moves? False if its motion is not known."""
        apart = float(np.hypot(*(self.velocity * step_s - blob.motion)))
        return apart > max(_APART_PX, _APART_SHARE * float(np.hypot(*blob.motion)))

    def _learn_flow(self, blob: Blob) -> None:
        if self.flow_px is not None and np.isfinite(blob.motion).all():
            self.flow_px = self.flow_px + blob.motion

    def _learn_speed(self, blob: Blob, shift: Doubles, step_s: float, is_whole: bool) -> None:
        by_place = self.velocity + shift / step_s
        by_flow = blob.motion / step_s
        has_flow = bool(np.isfinite(by_flow).all())
        if is_whole:
            measured = 0.5 * (by_place + by_flow) if has_flow else by_place
        elif has_flow:
            measured = by_flow
        else:
            return
        gain = max(_SPEED_GAIN, 1 / (self.hits + 1))
        self.velocity = self.velocity + gain * (measured - self.velocity)


def predict_all(things: Sequence[Followed], frame_from_before: Matrix, time_s: float) -> None:
    """Move all on to the next frame: with the picture, and each at its own speed."""
    if not things:
        return
    boxes, scales = moved_boxes(frame_from_before, np.stack([thing.box for thing in things]))
    origins, _ = moved_points(frame_from_before, np.stack([thing.origin for thing in things]))
    ended = [(thing.ends, thing.ends.box) for thing in things if thing.ends.box is not None]
    if ended:
        moved, _ = moved_boxes(frame_from_before, np.stack([box for _, box in ended]))
        for (ends, _), box in zip(ended, moved, strict=True):
            ends.box = box
    steps_s = np.array([max(0.0, time_s - thing.time_s) for thing in things])
    velocities = np.stack([thing.velocity for thing in things])
    boxes += np.tile(velocities * steps_s[:, None], 2)
    velocities *= scales[:, None]
    for thing, box, velocity, origin in zip(things, boxes, velocities, origins, strict=True):
        thing.box, thing.velocity, thing.origin, thing.time_s = box, velocity, origin, time_s
