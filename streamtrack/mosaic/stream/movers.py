"""What moves by itself in a frame: it differs from the frame a moment before, laid upon it.

The motion of the ground is known, so whatever stands on the ground looks the same a moment later
and what moves over it does not (motion-compensated differencing, as Irani & Anandan, "A unified
approach to moving object detection in 2D and 3D scenes", PAMI 1998, begin). What is found is not
sure to be a thing: it may be what a thing has just uncovered, water, or a tree's top. So it is not
shut out of a mosaic but stands back, behind any sample of the place that was at rest.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np

from streamtrack import geometry
from streamtrack.mosaic.gains import thumb_matrix as small_matrix
from streamtrack.mosaic.stream import painting
from streamtrack.mosaic.stream.views import View, ViewStore
from streamtrack.types import Frame, Image, Matrix

_MOST_FRAMES, _MOST_CELLS = 3, 3.0  # from one moment to the next

_LEVELS = 9.0
_MOST_SHARE = 0.7
_KERNEL_3 = np.ones((3, 3), np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class _Placed:
    frame: Frame
    world_from_frame: Matrix
    number: int


class Movers:
    """Tells of the views that are kept what moves in them; ``scale`` is that of the masks.

    When a view is kept, by the moment before; a moment later by that as well, which acquits what a
    thing has just uncovered. A moment is a few frames, fewer if the camera moves fast: things that
    go along with it move over the ground as it does.
    """

    def __init__(self, store: ViewStore, scale: float) -> None:
        self._store = store
        self._scale = scale
        self._last: deque[_Placed] = deque(maxlen=_MOST_FRAMES + 1)
        self._unripe: deque[tuple[View, _Placed, Image | None]] = deque()
        self._count = 0

    def follow(self, frame: Frame, world_from_frame: Matrix) -> None:
        """The next frame."""
        self._count += 1
        now = _Placed(frame, world_from_frame, self._count)
        self._last.append(now)
        while self._unripe and self._are_apart(self._unripe[0][1], now):
            view, placed, earlier = self._unripe.popleft()
            later = self._moving(placed, now)
            if later is not None and view.number in self._store.views:
                both = later if earlier is None else cv2.bitwise_and(later, earlier)
                self._store.doubt(view, _whole(np.asarray(both, np.uint8)))

    def forget(self) -> None:
        """A frame had no place: what comes is no moment later."""
        self._last.clear()
        self._unripe.clear()

    def judge(self, view: View) -> None:
        """One of the last frames is a view now."""
        placed = next((p for p in self._last if p.frame.index == view.frame), None)
        if placed is None:
            return
        before = [
            p for p in self._last if p.frame.index < view.frame and self._are_apart(p, placed)
        ]
        earlier = self._moving(placed, before[-1]) if before else None
        if earlier is not None:
            self._store.doubt(view, _whole(earlier))
        self._unripe.append((view, placed, earlier))

    def _are_apart(self, before: _Placed, after: _Placed) -> bool:
        if after.number - before.number >= _MOST_FRAMES:
            return True
        middle = np.array([[side / 2 for side in before.frame.size_wh]])
        places = (geometry.transform_points(p.world_from_frame, middle) for p in (before, after))
        return math.dist(*(p[0] for p in places)) * self._scale >= _MOST_CELLS

    def _moving(self, now: _Placed, other: _Placed) -> Image | None:
        """Where a frame (h, w) moves by itself, 255 there; None if that is not known.

        If most of it seems to, the light has changed, or the frame is not where it is said to be.
        """
        if now.frame.size_wh != other.frame.size_wh:
            return None
        small, there = (painting.weighted(p.frame.image, (), self._scale) for p in (now, other))
        size_wh = small.shape[1], small.shape[0]
        small_from_frame = small_matrix(small, now.frame.size_wh)
        frame_from_other = geometry.inverted(now.world_from_frame) @ other.world_from_frame
        mapping = small_from_frame @ frame_from_other @ geometry.inverted(small_from_frame)
        there = painting.warped(there, mapping, (0, 0, *size_wh))
        found = painting.unlike(there, small, _LEVELS)
        return found if cv2.countNonZero(found) <= _MOST_SHARE * found.size else None


def _whole(found: Image) -> Image:
    """What moves (h, w) without the gaps in it, and a little around."""
    closed = cv2.morphologyEx(found, cv2.MORPH_CLOSE, _KERNEL_3)
    return np.asarray(cv2.dilate(closed, _KERNEL_3), np.uint8)
