"""What part of a thing a blob shows: an end that stands while its pixels move is a hidden one.

A thing that goes under a bridge is found ever shorter: the end behind still moves as its pixels do,
the one in front stays where the bridge begins. The free end then tells where the thing is, and its
size is kept, until both ends go along again. Where much more is found than it is large, it has met
something: it keeps its size for a while, too.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from streamtrack.auto.blobs import Blob

Doubles: TypeAlias = npt.NDArray[np.float64]

_LEAST_MOTION_PX = 1.5  # a frame, below which no end is told from another
_RATE = 0.3
_CUT_SHARE = 0.8  # of its size: when less is found it is partly hidden
_GROWN_SHARE = 1.4  # when more is found it has met something
_ODD_FRAMES = 7  # for which it keeps its size all the same


class FreeEnds:
    """State of the ends of one thing, along x and y.

    ``share`` is the part of its pixels' motion by which the ends left, top, right and bottom moved
    on; ``box`` (4,) is where they were in the frame before, None if that is not known.
    """

    def __init__(self) -> None:
        self.share = [1.0, 1.0, 1.0, 1.0]
        self.box: Doubles | None = None
        self._odd = [0, 0]

    def forget(self) -> None:
        """Its ends were not seen in this frame."""
        self.box = None

    def look(self, blob: Blob) -> None:
        """Note how the ends of the blob, as which it was found, moved since the frame before."""
        before, self.box = self.box, blob.box.copy()
        motion = blob.motion.tolist()
        if before is None or not math.isfinite(motion[0] + motion[1]):
            return
        moved = (blob.box - before).tolist()
        least = max(_LEAST_MOTION_PX, 0.5 * max(abs(motion[0]), abs(motion[1])))
        if max(abs(motion[0]), abs(motion[1])) <= least:
            return
        for end in range(4):
            along = motion[end % 2]
            if abs(along) > least:
                share = min(2.0, max(-1.0, moved[end] / along))
                self.share[end] += _RATE * (share - self.share[end])
            else:
                self.share[end] = 1.0

    def correction(self, box: Doubles, found: Doubles) -> tuple[Doubles, Doubles]:
        """Shift (2,) and growth (2,) that take a thing's box towards the blob's."""
        ends, found_ends = box.tolist(), found.tolist()
        shift, growth = [0.0, 0.0], [0.0, 0.0]
        for axis in (0, 1):
            low, high = found_ends[axis] - ends[axis], found_ends[axis + 2] - ends[axis + 2]
            size = max(ends[axis + 2] - ends[axis], 1e-6)
            ratio = (found_ends[axis + 2] - found_ends[axis]) / size
            is_odd = not _CUT_SHARE <= ratio <= _GROWN_SHARE
            self._odd[axis] = self._odd[axis] + 1 if is_odd else 0
            is_free = self.share[axis] > 0.5
            if is_free != (self.share[axis + 2] > 0.5) and high < low:
                shift[axis] = low if is_free else high
            elif is_odd and self._odd[axis] <= _ODD_FRAMES:
                shift[axis] = low if abs(low) <= abs(high) else high
            else:
                shift[axis], growth[axis] = 0.5 * (low + high), high - low
        return np.array(shift), np.array(growth)


def by_both_ends(box: Doubles, found: Doubles) -> tuple[Doubles, Doubles]:
    """Shift (2,) and growth (2,) that take one box to another."""
    low, high = (found - box).reshape(2, 2)
    return 0.5 * (low + high), high - low
