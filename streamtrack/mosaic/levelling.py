"""The world's tilt and the focal length by which rough poses are most like a real camera's.

Poses along a chain know the plane only as the first picture saw it. Before they are adjusted under
the prior (see `mosaic.prior`) the plane is laid level: found by Levenberg-Marquardt over the four
freedoms that make a plane metric and the focal length, robustly, from the anchor outwards, as the
poses far off may have drifted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from streamtrack.mosaic.prior import FOCAL_SIGMA, USUAL_FOCAL, Doubles, deviations

_FIRST = 4  # poses, and then twice as many each time
_MOST = 256  # spread evenly over all
_ROUNDS = 20
_SIGMA = 1e-3  # of a pose's stretch, as in the prior
_OUTLYING = 3.0  # times sigma: Cauchy's function
_STEP = 1e-6
_DAMPING = 1e-3
_MAX_DAMPING = 1e5
_CONVERGED = 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class Levelled:
    """Poses (n, 3, 3) moved as a whole by one homography, and the focal length in units."""

    poses: Doubles
    focal: float


def levelled(poses: Doubles, unit_from_picture: Doubles, anchor: int) -> Levelled:
    """The poses in a world that is level; unchanged if none is found."""
    to_unit = unit_from_picture[anchor]
    world = to_unit @ poses
    middles = (world @ np.linalg.inv(unit_from_picture))[:, :, 2]
    places = middles[:, :2] / middles[:, 2:]
    order = np.argsort(np.hypot(*(places - places[anchor]).T), kind="stable")
    rows = order[:: -(-len(order) // _MOST)]
    freedoms, count = np.zeros(5), min(_FIRST, len(rows))
    while True:
        chosen = rows[:count]
        freedoms = _fitted(world[chosen], unit_from_picture[chosen], freedoms)
        if count == len(rows):
            break
        count = min(2 * count, len(rows))
    moved = np.linalg.inv(to_unit) @ _levelling(freedoms) @ world
    return Levelled(moved / moved[:, 2:, 2:], _focal(freedoms))


def _levelling(freedoms: Doubles) -> Doubles:
    x, y, aspect, shear = freedoms[:4]
    return np.array([[1 + aspect, shear, 0], [shear, 1 - aspect, 0], [x, y, 1]])


def _focal(freedoms: Doubles) -> float:
    return float(USUAL_FOCAL * np.exp(freedoms[4]))


def _residuals(world: Doubles, unit_from_picture: Doubles, freedoms: Doubles) -> Doubles:
    """Stretches of all poses and the focal length's deviation, in sigmas; inf beyond a horizon."""
    moved = _levelling(freedoms) @ world
    stretches = deviations(moved, unit_from_picture, _focal(freedoms))[:, :2] / _SIGMA
    depths = (moved @ np.linalg.inv(unit_from_picture))[:, 2, 2]
    stretches[depths <= 0] = np.inf
    return np.append(stretches.ravel(), freedoms[4] / FOCAL_SIGMA)


def _cost(residuals: Doubles) -> float:
    robust = _OUTLYING**2 * np.log1p((residuals[:-1] / _OUTLYING) ** 2)
    cost = float(np.sum(robust) + residuals[-1] ** 2)
    return cost if np.isfinite(cost) else float("inf")


def _fitted(world: Doubles, unit_from_picture: Doubles, freedoms: Doubles) -> Doubles:
    residuals = _residuals(world, unit_from_picture, freedoms)
    cost, damping = _cost(residuals), _DAMPING
    steps = _STEP * np.eye(5)
    for _ in range(_ROUNDS if np.isfinite(cost) else 0):
        ahead = [_residuals(world, unit_from_picture, freedoms + step) for step in steps]
        jacobian = (np.stack(ahead, axis=1) - residuals[:, None]) / _STEP
        weights = 1 / (1 + (residuals / _OUTLYING) ** 2)
        weights[-1] = 1.0
        normal = jacobian.T @ (weights[:, None] * jacobian)
        if not np.isfinite(normal).all():
            break
        vector = -jacobian.T @ (weights * residuals)
        before = cost
        while damping < _MAX_DAMPING:
            damped = normal + np.diag(damping * normal.diagonal() + 1e-6)
            tried = freedoms + np.linalg.solve(damped, vector)
            there = _residuals(world, unit_from_picture, tried)
            if _cost(there) <= before:
                freedoms, residuals, cost = tried, there, _cost(there)
                break
            damping *= 10
        damping /= 10
        if before - cost <= _CONVERGED * before:
            break
    return freedoms
