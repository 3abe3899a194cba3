"""What a moving camera's keyframes and poses are to those who use them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import isfinite
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


class _Drifting(Protocol):
    @property
    def keyframes(self) -> Mapping[int, object]: ...

    def sigma_px(self, index: int) -> float: ...


@dataclass(frozen=True, slots=True)
class ExpectedDrift:
    """Expected RMS errors of corners in world pixels: of the last keyframe, and the largest."""

    end_px: float
    most_px: float

    @classmethod
    def of(cls, graph: _Drifting | None) -> ExpectedDrift | None:
        """None as long as nothing is known of any keyframe but the first, which cannot drift."""
        if graph is None:
            return None
        sigmas = [graph.sigma_px(index) for index in graph.keyframes]
        known = [sigma for sigma in sigmas if isfinite(sigma)]
        return cls(known[-1], max(known)) if len(known) > 1 else None

    def to_json(self) -> dict[str, float]:
        return {"end": round(self.end_px, 3), "most": round(self.most_px, 3)}

    def to_text(self) -> str:
        return f"expected drift {self.end_px:.2g} px at the end, {self.most_px:.2g} px at most"


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

    def sigma_px(self, index: int) -> float:
        """Expected RMS error of a frame's corners in the world, NaN if not known."""
        ...

    def keep(self, index: int) -> None:
        """A frame of which the pose will always be asked for."""
        ...

    def keyframe_of(self, index: int) -> int | None:
        """The keyframe that a frame moves with; None if that is not known."""
        ...
