"""How far off a mapping may be where no points say so: the least squares' errors, carried on.

A mapping rests on what was seen and is asked about corners that perhaps were not. First-order
propagation of covariance (Hartley & Zisserman, Multiple View Geometry, 2nd ed., section 5.2).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.types import Evidence, Matrix, Model, Points

Doubles = npt.NDArray[np.float64]

_INDEPENDENT_ERRORS = 25.0
_FEW = 8
_LEAST_POINT_SIGMA_PX = 0.1  # of a target's points
_E = np.eye(8)
MODEL_BASES = {
    Model.TRANSLATION: _E[:, [2, 5]],
    Model.SIMILARITY: np.stack([_E[2], _E[5], _E[0] + _E[4], _E[3] - _E[1]], axis=1),
    Model.AFFINE: _E[:, :6],
    Model.HOMOGRAPHY: _E,
}
"""Columns (8, k): the directions in h11 .. h32 that a model of k freedoms may move in."""


def motion_rows(points: Doubles) -> Doubles:
    """Change of places (N, 2) with h11 .. h32 of a homography at the identity, (2N, 8)."""
    if len(points) <= _FEW:
        # In plain numbers: for the corners of a quad numpy would be ten times as slow.
        rows: list[tuple[float, ...]] = []
        for x, y in points.tolist():
            rows.append((x, y, 1.0, 0.0, 0.0, 0.0, -x * x, -x * y))
            rows.append((0.0, 0.0, 0.0, x, y, 1.0, -x * y, -y * y))
        return np.array(rows)
    x, y = points.T
    one, zero = np.ones_like(x), np.zeros_like(x)
    upper = np.stack([x, y, one, zero, zero, zero, -x * x, -x * y], axis=1)
    lower = np.stack([zero, zero, zero, x, y, one, -x * y, -y * y], axis=1)
    return np.stack([upper, lower], axis=1).reshape(-1, 8)


def corner_sigmas_px(
    b_from_a: Matrix,
    model: Model,
    a_points: Points,
    b_points: Points,
    corners: Points,
    least_sigma_px: float,
) -> Doubles:
    """Standard deviation in b of where each of the corners (C, 2) of a comes to lie, (C,).

    ``a_points``, ``b_points`` (M, 2) are the inliers of a least-squares fit of ``model``; their
    residuals tell how noisy they are, at least ``least_sigma_px`` along x and y. Residuals of what
    is not quite flat, or not quite as it was, are alike among neighbours, so that pairs beyond 25
    count as no further evidence. Infinite where the points determine nothing.
    """
    seen = geometry.transform_points(b_from_a, a_points).astype(np.float64)
    there = geometry.transform_points(b_from_a, corners).astype(np.float64)
    centre, scale = seen.mean(axis=0), float(np.max(np.std(seen, axis=0))) + 1e-6
    basis = MODEL_BASES[model]
    rows = motion_rows((seen - centre) / scale) @ basis
    residuals = b_points - seen
    variance = float(np.mean(residuals**2)) + least_sigma_px**2
    normal = rows.T @ rows * min(1.0, _INDEPENDENT_ERRORS / len(seen))
    try:
        covariance = np.linalg.inv(normal) * variance
    except np.linalg.LinAlgError:
        return np.full(len(corners), np.inf)
    reach = (motion_rows((there - centre) / scale) @ basis).reshape(len(corners), 2, -1)
    spreads = np.einsum("cik,kl,cil->c", reach, covariance, reach)
    sigmas: Doubles = np.sqrt(np.maximum(spreads, 0.0))
    return sigmas


def target_sigma_px(pose: Matrix, model: Model, evidence: Evidence, quad: Points) -> float:
    """RMS over the corners ``quad`` (4, 2) of a target of how far off they may be in the frame.

    ``pose`` (frame_from_template) is a fit of ``model`` to the inliers of ``evidence``.
    """
    seen = evidence.is_inlier
    sigmas_px = corner_sigmas_px(
        pose,
        model,
        evidence.template_points[seen],
        evidence.frame_points[seen],
        quad,
        _LEAST_POINT_SIGMA_PX,
    )
    return float(np.sqrt(np.mean(sigmas_px**2)))
