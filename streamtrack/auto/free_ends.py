"""What part of a thing a blob shows: an end that stands while its pixels move is a hidden one.

A thing that goes under a bridge is found ever shorter: the end behind still moves as its pixels do,
the one in front stays where the bridge begins. The free end then tells where the thing is, and its
size is kept, until both ends go along again. Where much more is found than it is large, it has met
something: it keeps its size for a while, too.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from streamtrack.auto.blobs import Blob
from streamtrack.auto.boxes import moved_box
from streamtrack.types import Matrix

Doubles: TypeAlias = npt.NDArray[np.float64]

_LEAST_MOTION_PX = 1.5  # a frame, below which no end is told from another
_RATE = 0.3
_CUT_SHARE = 0.8  # of its size: when less is found it is partly hidden
_GROWN_SHARE = 1.4  # when more is found it has met something
_ODD_FRAMES = 7  # for which it keeps its size all the same


class FreeEnds:
    """State of the ends of one thing, along x and y.

    ``share`` (2, 2) is the part of its pixels' motion by which the low and the high end moved on.
    """

    def __init__(self) -> None:
        self.share: Doubles = np.ones((2, 2))
        self._box: Doubles | None = None
        self._odd = np.zeros(2, np.intp)

    def predict(self, frame_from_before: Matrix) -> None:
        if self._box is not None:
            self._box = moved_box(frame_from_before, self._box)

    def forget(self) -> None:
        """Its ends were not seen in this frame."""
        self._box = None

    def look(self, blob: Blob) -> None:
        """Note how the ends of the blob, as which it was found, moved since the frame before."""
        before, self._box = self._box, blob.box.copy()
        if before is None or not np.isfinite(blob.motion).all():
            return
        speed = np.abs(blob.motion)
        is_moving = speed > max(_LEAST_MOTION_PX, 0.5 * float(speed.max()))
        if not is_moving.any():
            return
        moved = (blob.box - before).reshape(2, 2) / np.where(is_moving, blob.motion, 1.0)
        share = self.share + _RATE * (np.clip(moved, -1.0, 2.0) - self.share)
        self.share = np.where(is_moving, share, 1.0)

    def correction(self, box: Doubles, found: Doubles) -> tuple[Doubles, Doubles]:
        """Shift (2,) and growth (2,) that take a thing's box towards the blob's."""
        low, high = (found - box).reshape(2, 2)
        shift, growth = by_both_ends(box, found)
        ratio = (found[2:] - found[:2]) / np.maximum(box[2:] - box[:2], 1e-6)
        is_odd = (ratio < _CUT_SHARE) | (ratio > _GROWN_SHARE)
        self._odd = np.where(is_odd, self._odd + 1, 0)
        is_odd &= self._odd <= _ODD_FRAMES
        is_free = self.share > 0.5
        is_hidden = (is_free[0] ^ is_free[1]) & (growth < 0)
        nearer = np.where(np.abs(low) <= np.abs(high), low, high)
        shift = np.where(is_odd, nearer, shift)
        shift = np.where(is_hidden, np.where(is_free[0], low, high), shift)
        return shift, np.where(is_hidden | is_odd, 0.0, growth)


def by_both_ends(box: Doubles, found: Doubles) -> tuple[Doubles, Doubles]:
    """Shift (2,) and growth (2,) that take one box to another."""
    low, high = (found - box).reshape(2, 2)
    return 0.5 * (low + high), high - low
