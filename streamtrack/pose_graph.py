"""What a moving camera's keyframes and poses are to those who use them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol

from streamtrack.types import Matrix


@dataclass(frozen=True, slots=True)
class KeyframeEdge:
    """A verified link between keyframes ``a`` and ``b``; ``is_loop`` if it closed a loop."""

    a: int
    b: int
    inliers: int
    rmse_px: float
    is_loop: bool


class Keyframe(Protocol):
    """A frame that others are measured against."""

    @property
    def world_from_keyframe(self) -> Matrix: ...


class PoseGraph(Protocol):
    """Poses that may still change; `revision` counts the changes."""

    @property
    def revision(self) -> int: ...

    @property
    def keyframes(self) -> Mapping[int, Keyframe]: ...

    @property
    def edges(self) -> Iterable[KeyframeEdge]: ...

    def world_from_frame(self, index: int) -> Matrix | None:
        """The pose of a frame as it is known now."""
        ...

    def keep(self, index: int) -> None:
        """A frame of which the pose will always be asked for."""
        ...

    def keyframe_of(self, index: int) -> int | None:
        """The keyframe that a frame moves with; None if that is not known."""
        ...
