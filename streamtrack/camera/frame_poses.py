"""Where every frame lies against its keyframe, in little memory."""

from __future__ import annotations

from array import array
from bisect import bisect_left
from dataclasses import dataclass

import numpy as np

from streamtrack.types import Matrix

_SPARE_SHARE = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class FramePose:
    """A frame's pose against a keyframe."""

    keyframe: int
    keyframe_from_frame: Matrix


class FramePoses:
    """Poses by the index of their frame, 88 bytes each, for the thread that adds them.

    With ``most`` about so many are held: the oldest are forgotten, except those to be kept.
    """

    def __init__(self, most: int | None = None) -> None:
        self._most = most
        self._indices, self._keyframes = array("q"), array("q")
        self._elements = array("d")
        self._kept: dict[int, FramePose] = {}

    def __len__(self) -> int:
        return len(self._indices)

    def add(self, index: int, pose: FramePose) -> None:
        """Remember a frame's pose, instead of an earlier one of the same frame."""
        self._kept.pop(index, None)
        elements = array("d", np.asarray(pose.keyframe_from_frame, np.float64).tobytes())
        at = self._place(index)
        is_known = at < len(self._indices) and self._indices[at] == index
        row = slice(at, at + is_known)
        self._indices[row] = array("q", [index])
        self._keyframes[row] = array("q", [pose.keyframe])
        self._elements[9 * row.start : 9 * row.stop] = elements
        if self._most is not None and len(self) > self._most * (1 + _SPARE_SHARE):
            gone = len(self) - self._most
            del self._indices[:gone], self._keyframes[:gone], self._elements[: 9 * gone]

    def get(self, index: int) -> FramePose | None:
        """None for a frame that was not added, or is forgotten."""
        kept = self._kept.get(index)
        at = self._place(index)
        if kept is not None or at == len(self._indices) or self._indices[at] != index:
            return kept
        elements = np.array(self._elements[9 * at : 9 * at + 9])
        return FramePose(self._keyframes[at], elements.reshape(3, 3))

    def keep(self, index: int) -> None:
        """Never forget this frame, if it is known."""
        pose = self.get(index)
        if pose is not None:
            self._kept[index] = pose

    def _place(self, index: int) -> int:
        if not self._indices or index > self._indices[-1]:
            return len(self._indices)
        return bisect_left(self._indices, index)
