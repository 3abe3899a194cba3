"""A frame as the camera's motion is asked of it, what it came to, and what is expected next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from streamtrack import geometry
from streamtrack.camera.view_levels import ViewLevels
from streamtrack.camera.view_verdict import ViewAlignment
from streamtrack.frame_view import FrameView
from streamtrack.types import CameraPose, Matrix, Points, Size, Verdict

_MAX_STEPS_AHEAD = 8


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """A frame, and quads (4, 2) in it that do not belong to the scene.

    ``targets`` move by themselves, ``overlay`` lies over every picture; ``shown`` is the box
    (x, y, w, h) of the picture within its bars.
    """

    view: FrameView
    targets: Sequence[Points]
    overlay: tuple[Points, ...]
    shown: tuple[int, int, int, int]

    @property
    def hidden(self) -> tuple[Points, ...]:
        """All that does not belong to the scene."""
        return (*self.targets, *self.overlay)

    @property
    def index(self) -> int:
        return self.view.frame.index

    @property
    def time_s(self) -> float:
        return self.view.frame.time_s

    @property
    def levels(self) -> ViewLevels:
        return self.view.levels

    @property
    def size_wh(self) -> Size:
        return self.view.size_wh


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A frame as it was aligned with a keyframe."""

    keyframe: int
    found: ViewAlignment

    @property
    def keyframe_from_frame(self) -> Matrix | None:
        """None if the alignment was refused."""
        return self.found.reference_from_view

    @property
    def pose(self) -> Matrix:
        """``keyframe_from_frame`` of one that was not refused."""
        assert self.found.reference_from_view is not None
        return self.found.reference_from_view

    def overlap(self, sight: Sight) -> float:
        """Share of the frame that the keyframe shows."""
        x, y, width, height = sight.shown
        quad = geometry.transform_points(self.pose, geometry.box_quad(x, y, width - 1, height - 1))
        return geometry.visible_share(quad - np.array([x, y], np.float32), (width, height))

    def camera_pose(
        self, world_from_frame: Matrix | None, why: Verdict | None = None
    ) -> CameraPose:
        """The pose with its evidence, or why there is none."""
        found, reason = self.found, "" if why is None else str(why)
        return CameraPose(
            world_from_frame, len(found.is_inlier), found.inliers, found.rmse_px, reason
        )

    def refusal(self) -> CameraPose:
        found = self.found
        reason = str(found.verdict).replace("the target", "the keyframe").replace("target", "view")
        return CameraPose(None, len(found.is_inlier), found.inliers, reason=reason)


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Where the camera was last known to be.

    ``sight`` is what it saw there, ``placed`` how that was found out, None of the first frame.
    ``step`` is the motion (last frame from next) in ``step_s`` seconds, None if it is
    not known.
    """

    keyframe: int
    keyframe_from_frame: Matrix
    sight: Sight
    placed: Placed | None = None
    step: Matrix | None = None
    step_s: float = 0.0

    def is_old(self, time_s: float) -> bool:
        """Whether frames have gone by since that could not be placed."""
        return time_s - self.sight.time_s > 1.5 * self.step_s

    def predicted(self, time_s: float) -> Matrix:
        """keyframe_from_frame at a time, if the camera goes on as it went."""
        if self.step is None:
            return self.keyframe_from_frame
        steps = (time_s - self.sight.time_s) / self.step_s if self.step_s > 0 else 1.0
        count = min(_MAX_STEPS_AHEAD, max(0, round(steps)))
        ahead = np.linalg.matrix_power(self.step, count)
        return geometry.normalized(self.keyframe_from_frame @ ahead)
