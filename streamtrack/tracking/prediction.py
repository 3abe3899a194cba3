"""Where a target will be in the next frame, and how far off such predictions were lately."""

from __future__ import annotations

from math import sqrt

import numpy as np

from streamtrack import geometry
from streamtrack.fitting import fit
from streamtrack.types import Matrix, Model, Points

_FIRST_SURPRISE_PX = 5.0
_RATE = 0.2  # share of a new frame in the running means; more in the first few


class Prediction:
    """The motion of one target's corners (4, 2) from frame to frame.

    Three ways to go on are kept, and the one is used that was least off lately: to rest where it
    is, to move as between the last two frames, to change that motion as it last changed.
    """

    def __init__(self, quad: Points, model: Model, pose: Matrix | None) -> None:
        self._quad = quad
        self._model = model
        self.pose = pose
        self._steps: list[Matrix] = []
        self._off_px = [_FIRST_SURPRISE_PX] * 3
        self._judged = [1] * 3
        self._guesses: list[Matrix] = []

    @property
    def guess(self) -> Matrix:
        """The expected frame_from_template; only while there is a pose."""
        guesses = self._all_guesses()
        return guesses[self._best(len(guesses))]

    @property
    def surprise_px(self) -> float:
        """How far off the corners were from such a guess, RMS over them and the last frames."""
        return self._off_px[self._best(len(self._steps) + 1)]

    @property
    def motion_px(self) -> float:
        """How far the target is expected to move, RMS over the corners."""
        assert self.pose is not None
        return rms_distance_px(self.guess, self.pose, self._quad)

    def _best(self, count: int) -> int:
        return min(range(min(count, 3)), key=self._off_px.__getitem__)

    def _all_guesses(self) -> list[Matrix]:
        assert self.pose is not None
        if not self._guesses:
            self._guesses = [self.pose, *(step @ self.pose for step in self._expected_steps())]
        return self._guesses

    def _expected_steps(self) -> list[Matrix]:
        if len(self._steps) < 2:
            return self._steps
        before, last = self._steps
        return [last, last @ geometry.inverted(before) @ last]

    def follow(self, pose: Matrix, *, is_clear: bool) -> None:
        """The target was followed to a pose; a clear sight of it tells how good guesses are."""
        assert self.pose is not None
        before, after = (geometry.transform_points(p, self._quad) for p in (self.pose, pose))
        if is_clear:
            for order, guess in enumerate(self._all_guesses()):
                off_px = _rms_px(geometry.transform_points(guess, self._quad) - after)
                self._judged[order] += 1
                rate = max(_RATE, 1 / self._judged[order])
                self._off_px[order] += rate * (off_px - self._off_px[order])
        # Few freedoms extrapolate well; those of perspective would mostly extrapolate noise.
        # Poses with hidden corners would make a change of motion run away.
        kept = self._steps[-1:] if is_clear else []
        self._steps = [*kept, fit(self._model, before, after)]
        self.pose, self._guesses = pose, []

    def begin_at(self, pose: Matrix, share: float) -> None:
        """The target was found anew, with a ``share`` of its points; its motion is unknown."""
        self._off_px = [max(off, _FIRST_SURPRISE_PX / max(share, 0.1)) for off in self._off_px]
        self.pose, self._steps, self._guesses = pose, [], []

    def forget(self) -> None:
        """Nothing is known any more of where it is."""
        self.pose, self._steps, self._guesses = None, [], []


def rms_distance_px(one: Matrix, other: Matrix, quad: Points) -> float:
    """How far apart two poses put the quad's corners (4, 2), in frame pixels."""
    return _rms_px(geometry.transform_points(one, quad) - geometry.transform_points(other, quad))


def _rms_px(offsets: Points) -> float:
    return sqrt(float(np.vdot(offsets, offsets)) / len(offsets))
