"""How far off adjusted poses may be: the links' errors carried on from the anchor.

The covariance of the poses is the inverse of the adjustment's normal equations (Hartley &
Zisserman, Multiple View Geometry, 2nd ed., section 5.2; Triggs et al. 2000, "Bundle adjustment - a
modern synthesis", section 9). The anchor's own tilt is as uncertain as any, and with it all that
lies far from it.
"""

from __future__ import annotations

import numpy as np

from streamtrack.mosaic.bundle import Problem, Solution, equations
from streamtrack.mosaic.normal_equations import Doubles, Rows
from streamtrack.uncertainty import MODEL_BASES

_MOST = 48  # poses for which it is solved; between them it is interpolated


def expected_errors_px(problem: Problem, solution: Solution, noise_px: float) -> Doubles:
    """Expected root mean square error (n,) of the corners of each picture, in world pixels.

    The world is that of the anchor; ``noise_px`` is the standard deviation of a pair's error along
    x and y.
    """
    assert problem.anchor is not None
    count, model = len(solution.poses), solution.model
    weights = problem.counts * np.tile(solution.is_used, 2)[:, None] / noise_px**2
    normal, _ = equations(problem, solution.poses, weights, solution.prior, model)
    chosen = np.unique(np.linspace(0, count - 1, min(count, _MOST)).round().astype(np.intp))
    by_own, by_anchor = _changes_of_corners(problem, solution.poses, chosen)
    freedoms = MODEL_BASES[model]
    by_own, by_anchor = by_own @ freedoms, by_anchor @ freedoms
    by_all = np.zeros((count, freedoms.shape[1], len(chosen), 8))
    by_all[chosen, :, np.arange(len(chosen))] += by_own.transpose(0, 2, 1)
    by_all[problem.anchor] += by_anchor.transpose(2, 0, 1)
    by_all = by_all.reshape(count, freedoms.shape[1], -1)
    variances = np.sum(by_all * normal.solved(by_all), axis=(0, 1)).reshape(len(chosen), 8)
    errors = np.sqrt(np.maximum(variances.sum(axis=1) / 4, 0.0))
    every: Doubles = np.interp(np.arange(count), chosen, errors)
    return every


def _changes_of_corners(problem: Problem, poses: Doubles, chosen: Rows) -> tuple[Doubles, Doubles]:
    """How the four corners of pictures, in the anchor's pixels, change with D, each (C, 8, 8).

    With D of their own pose, and with that of the anchor's.
    """
    anchor, unit = problem.anchor, problem.unit_from_picture
    assert anchor is not None
    half = -unit[chosen][:, :2, 2]
    signs = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    corners = np.concatenate([half[:, None] * signs, np.ones((len(chosen), 4, 1))], axis=2)
    anchor_from_own = unit[anchor] @ np.linalg.inv(poses[anchor]) @ poses[chosen]
    anchor_from_own = anchor_from_own @ np.linalg.inv(unit[chosen])
    places = corners @ anchor_from_own.transpose(0, 2, 1)
    by_own = np.einsum("nir,ncs->ncirs", anchor_from_own, corners).reshape(-1, 4, 3, 9)
    by_anchor = -np.einsum("ir,ncs->ncirs", np.eye(3), places).reshape(-1, 4, 3, 9)
    depth = places[..., 2, None, None]

    def projected(change: Doubles) -> Doubles:
        flat = change[:, :, :2] - places[..., :2, None] / depth * change[:, :, 2:]
        seen: Doubles = problem.unit_px[anchor] * (flat / depth)[..., :8]
        return seen.reshape(-1, 8, 8)

    return projected(by_own), projected(by_anchor)
