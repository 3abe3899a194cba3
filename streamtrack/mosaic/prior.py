"""What poses have beyond a similarity, and how near zero a mosaic's adjustment holds it.

Links fix only what pictures have in common; the prior fixes what they leave open (see
`mosaic.adjustment`). Its width is that of the links' own mappings, or of the poses if that is more.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

Doubles: TypeAlias = npt.NDArray[np.float64]

_FLOOR = 1e-5
_TILTED = 2.0  # times what noise explains, above which a camera is known to tilt

# Rows: how the four measures of `deviations` change with D.
DEVIATION_ROWS = np.zeros((4, 8))
DEVIATION_ROWS[0, [0, 4]] = 1.0, -1.0
DEVIATION_ROWS[1, [1, 3]] = 1.0
DEVIATION_ROWS[2, 6] = DEVIATION_ROWS[3, 7] = 1.0


def deviations(poses: Doubles, unit_from_picture: Doubles) -> Doubles:
    """What each pose (n, 4) has beyond a similarity: aspect, shear, and perspective along x and y.

    In unit coordinates, at the picture's centre.
    """
    local = poses @ np.linalg.inv(unit_from_picture)
    corner = local[:, 2, 2]
    linear = local[:, :2, :2] / corner[:, None, None]
    linear = linear - local[:, :2, 2:] * local[:, 2:, :2] / corner[:, None, None] ** 2
    metric = linear.transpose(0, 2, 1) @ linear
    trace = metric[:, 0, 0] + metric[:, 1, 1]
    aspect = (metric[:, 0, 0] - metric[:, 1, 1]) / trace
    shear = 2 * metric[:, 0, 1] / trace
    bend = local[:, 2, :2] / corner[:, None]
    return np.stack([aspect, shear, bend[:, 0], bend[:, 1]], axis=1)


def prior_precisions(of_poses: Doubles, of_links: Doubles, noise_variances: Doubles) -> Doubles:
    """Precisions (4,) with which the poses' deviations are held at zero.

    ``of_poses`` (n, 4) and ``of_links`` (L, 4) are the deviations of poses and of the links' own
    mappings, ``noise_variances`` (4,) what noise explains of the latter.

    Poses that are linked and deviate alike, as those of a camera that tilts slowly, are not as
    many witnesses of where zero is: of a first-order process with variance v whose neighbours
    differ by d in the mean square, n count as n d / (4 v - d) (Bayley & Hammersley 1946). Else a
    long way without a loop is bent for the sake of a mean that it cannot know. Where the links
    themselves deviate by no more than their noise, nothing tilts, and all of them count.
    """
    absolute, relative = _variances(of_poses), _variances(of_links)
    is_slow = (relative < 2 * absolute) & (relative > _TILTED * noise_variances)
    witnesses = np.where(is_slow, relative / (4 * absolute - relative), 1.0)
    precisions: Doubles = witnesses / np.maximum(absolute, relative)
    return precisions


def _variances(of_pictures: Doubles) -> Doubles:
    """Mean squares (4,) of deviations (n, 4), the farthest tenth left out."""
    squares = of_pictures**2
    kept = np.sort(squares, axis=0)[: max(1, round(0.9 * len(squares)))]
    return of_each_kind(kept.mean(axis=0)) + _FLOOR**2


def of_each_kind(values: Doubles) -> Doubles:
    """One value (4,) for both measures of a kind: a camera turned by 90 degrees is no other."""
    return np.repeat([np.mean(values[:2]), np.mean(values[2:])], 2)
