"""A camera on a tripod: the world is the picture, and whether that is still so is checked.

Every few frames a glance tells whether the picture has shifted (`standing`); then, and now and
then anyway, a frame is aligned with the first one, at reduced resolution. If its corners have
moved, the frames since the check before are gone through for the first that had. The pose stays
the identity all the same, as it is what was asked for; its ``warning`` says what is wrong.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from streamtrack import geometry
from streamtrack.camera.keyframes import KeyframeGraph
from streamtrack.camera.standing import StandCheck
from streamtrack.camera.view_alignment import align
from streamtrack.camera.view_levels import ReferenceView, ViewLevels
from streamtrack.frame_view import FrameView
from streamtrack.types import CameraPose, Frame, Image, Points, Track

_EVERY = 25  # frames between two checks
_GLANCE_EVERY = 5
_LONGEST_PX = 320
_MOVED_PX = 1.5
_UNKNOWN_CHECKS = 3  # in a row that recognise nothing, before it is said


@dataclass(frozen=True, slots=True, eq=False)
class _Small:
    """A frame at reduced resolution, with what moves of itself in it."""

    index: int
    image: Image
    hidden: tuple[Points, ...]


class FixedCamera:
    """A camera that stands; ``every`` says how many frames lie between two checks."""

    graph: KeyframeGraph | None = None

    def __init__(self, every: int = _EVERY) -> None:
        self._every = every
        self._reference: ReferenceView | None = None
        self._glance: StandCheck | None = None
        self._recent: deque[_Small] = deque(maxlen=every)
        self._frames = 0
        self._glanced = -every
        self._unknown = 0
        self._unknown_since = 0
        self._moved_at = 0
        self._warning = ""
        self.moved_px = 0.0
        """How far the corner that moved most is from where it was, by the last check."""

    def update(self, view: FrameView, tracks: Sequence[Track]) -> CameraPose:
        """The identity; ``tracks`` are the targets, whose places are left out of the check."""
        step = _step(view.frame)
        hidden = tuple(track.quad / np.float32(step) for track in tracks if track.quad is not None)
        small = _Small(view.frame.index, _reduced(view, step), hidden)
        if self._reference is None:
            self._start(small)
        else:
            self._recent.append(small)
            self._frames += 1
            if self._frames % self._every == 0 or self._looks_moved(small, step):
                self._check(small, step)
        return CameraPose(np.eye(3), warning=self._warning)

    def close(self) -> None:
        """Nothing is left to do."""

    def _start(self, small: _Small) -> None:
        levels = ViewLevels(small.image)
        glance = StandCheck(levels, small.hidden)
        if glance.is_possible:
            self._reference, self._glance = glance.reference, glance

    def _looks_moved(self, small: _Small, step: int) -> bool:
        """Whether a check is due at once; after one that found nothing none is for a while."""
        if self._glance is None or self._warning or self._frames % _GLANCE_EVERY:
            return False
        if self._frames - self._glanced < self._every or not self._fits(small):
            return False
        levels = ViewLevels(small.image)
        if levels.is_flat() or self._glance.of(levels, small.hidden).moved_px * step <= _MOVED_PX:
            return False
        self._glanced = self._frames
        return True

    def _fits(self, small: _Small) -> bool:
        assert self._reference is not None
        return (small.image.shape[1], small.image.shape[0]) == self._reference.size_wh

    def _check(self, small: _Small, step: int) -> None:
        moved_px = self._moved_px(small, step)
        if moved_px is None:
            self._unknown += 1
            if self._unknown == 1:
                self._unknown_since = small.index
            if self._unknown >= _UNKNOWN_CHECKS:
                self._warning = f"view not recognised since frame {self._unknown_since}"
            return
        self._unknown = 0
        self.moved_px = moved_px
        if moved_px <= _MOVED_PX:
            self._warning = ""
        else:
            if not self._warning.startswith("camera moved"):
                self._moved_at = self._first_moved(step, max(_MOVED_PX, moved_px / 2))
            self._warning = f"camera moved at frame {self._moved_at} by {moved_px:.1f} px"

    def _first_moved(self, step: int, limit_px: float) -> int:
        """Index of the first of the last frames that lies as far off, by halving."""
        frames = list(self._recent)
        low, high = 0, len(frames) - 1
        while low < high:
            middle = (low + high) // 2
            moved_px = self._moved_px(frames[middle], step)
            if moved_px is not None and moved_px > limit_px:
                high = middle
            else:
                low = middle + 1
        return frames[high].index

    def _moved_px(self, small: _Small, step: int) -> float | None:
        """How far the frame's corners are from the first frame's, None if it shows another view."""
        assert self._reference is not None
        if not self._fits(small):
            return None
        levels = ViewLevels(small.image)
        found = align(self._reference, levels, np.eye(3), small.hidden)
        if found.reference_from_view is None:
            found = align(self._reference, levels, np.eye(3), small.hidden, is_searched=True)
        if found.reference_from_view is None:
            return None
        quad = geometry.image_quad(levels.size_wh)
        off = geometry.transform_points(found.reference_from_view, quad) - quad
        uncertain_px = 2 * found.corner_sigma_px
        return max(0.0, float(np.max(np.hypot(off[:, 0], off[:, 1]))) - uncertain_px) * step


def _step(frame: Frame) -> int:
    return max(1, round(max(frame.size_wh) / _LONGEST_PX))


def _reduced(view: FrameView, step: int) -> Image:
    """Every ``step``-th grey pixel: coarse, but it costs next to nothing in every frame."""
    return np.ascontiguousarray(view.grey[::step, ::step])
