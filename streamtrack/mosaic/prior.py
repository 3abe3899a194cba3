"""What a camera makes of a flat scene, and how an adjustment holds the poses to it.

Links fix only what pictures have in common: any further homography applied to all poses leaves
every residual as it is, and small errors of the links add up along it. But a camera with square
pixels that is tilted by an angle stretches the plane along the tilt by the angle's cosine, and
magnifies it from one side to the other by its tangent over the focal length: of the eight freedoms
of a homography two are not free (Triggs 1998, "Autocalibration from planar scenes"). So each single
picture says how the world is tilted, however long the way is that led to it.

How much poses stretch beyond that, and how much they tilt, is learned from the poses themselves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

Doubles: TypeAlias = npt.NDArray[np.float64]

USUAL_FOCAL = 2.2
"""Focal length in halves of the longer side: 49 degrees of view."""
FOCAL_SIGMA = 0.3
"""Of its logarithm: 0.74 to 1.35 times the usual."""
_MAX_FOCAL_STEP = 0.1
_FIRST_SIGMAS = np.array([1e-3, 5e-2])  # of stretch and of perspective
_LEAST_SIGMA = 3e-5
_MAX_LEAST_STRETCH = 1e-3
_TILT_SHARE = 0.5  # of the stretch that tilt tells, if the camera should not be like that
_STEP = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """How firmly poses are held to what a camera can show.

    focal       focal length in units; with 0 perspective tells nothing of stretch
    precisions  (4,) of the measures of `deviations`
    """

    focal: float
    precisions: Doubles

    def deviations(self, poses: Doubles, unit_from_picture: Doubles) -> Doubles:
        return deviations(poses, unit_from_picture, self.focal)

    def rows(self, poses: Doubles, unit_from_picture: Doubles) -> Doubles:
        """How the deviations change with D (see `mosaic.bundle`), (n, 4, 8), by differences."""
        local = poses @ np.linalg.inv(unit_from_picture)
        steps = _STEP * np.eye(9)[:8].reshape(8, 1, 3, 3)
        ahead, behind = (
            _local_deviations(local @ (np.eye(3) + s), self.focal) for s in (steps, -steps)
        )
        return np.moveaxis((ahead - behind) / (2 * _STEP), 0, 2)

    def cost(self, poses: Doubles, unit_from_picture: Doubles) -> float:
        own = self.deviations(poses, unit_from_picture)
        return float(np.sum(own**2 * self.precisions))

    def learned(self, poses: Doubles, unit_from_picture: Doubles) -> Prior:
        """With the focal length and the widths that these poses show."""
        own = self.deviations(poses, unit_from_picture)
        stretch, bend = _mean_square(own[:, :2]), _mean_square(own[:, 2:]) + _LEAST_SIGMA**2
        least = min(_MAX_LEAST_STRETCH, _LEAST_SIGMA + _TILT_SHARE * self.focal**2 * bend)
        focal = self.focal and self._refocused(poses, unit_from_picture, own)
        return Prior(focal, np.repeat(1 / np.array([stretch + least**2, bend]), 2))

    def _refocused(self, poses: Doubles, unit_from_picture: Doubles, own: Doubles) -> float:
        """One step of Gauss and Newton on the focal length's logarithm."""
        longer = deviations(poses, unit_from_picture, self.focal * np.exp(_STEP))
        change = (longer - own)[:, :2] / _STEP
        precision, usual = self.precisions[0], FOCAL_SIGMA**-2.0
        pull = precision * np.sum(change * own[:, :2])
        pull += usual * np.log(self.focal / USUAL_FOCAL)
        step = -pull / (precision * np.sum(change**2) + usual)
        return float(self.focal * np.exp(np.clip(step, -_MAX_FOCAL_STEP, _MAX_FOCAL_STEP)))


NO_PRIOR = Prior(0.0, np.zeros(4))


def first_prior(focal: float) -> Prior:
    """Before anything is known: hardly any stretch, and any tilt."""
    return Prior(focal, np.repeat(_FIRST_SIGMAS**-2.0, 2))


def deviations(poses: Doubles, unit_from_picture: Doubles, focal: float) -> Doubles:
    """What poses (n, 4) have beyond a similarity: two stretches, and perspective along x and y.

    In unit coordinates, at the picture's centre. Of the stretches (aspect and shear) those are
    taken off that the perspective tells of with this focal length.
    """
    return _local_deviations(poses @ np.linalg.inv(unit_from_picture), focal)


def _local_deviations(local: Doubles, focal: float) -> Doubles:
    """The same (..., 4) of poses (..., 3, 3) from unit coordinates."""
    local = local / local[..., 2:, 2:]
    first, second = np.moveaxis(local[..., :2, :2] - local[..., :2, 2:] * local[..., 2:, :2], -1, 0)
    first_square, second_square = np.sum(first**2, axis=-1), np.sum(second**2, axis=-1)
    trace = first_square + second_square
    bend_x, bend_y = np.moveaxis(local[..., 2, :2], -1, 0)
    x, y = focal * bend_x, focal * bend_y
    tilted = 2 + x * x + y * y
    aspect = (first_square - second_square) / trace - (x * x - y * y) / tilted
    shear = 2 * np.sum(first * second, axis=-1) / trace - 2 * x * y / tilted
    return np.stack([aspect, shear, bend_x, bend_y], axis=-1)


def _mean_square(values: Doubles) -> float:
    """Of a coordinate of values (n, 2), the farthest tenth left out."""
    squares = np.sort(np.sum(values**2, axis=1)) / 2
    return float(np.mean(squares[: max(1, round(0.9 * len(squares)))]))
