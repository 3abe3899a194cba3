"""Least squares for each transformation model, and the choice between the models."""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot, log, sqrt
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.types import Mask, Matrix, Model, Points

Doubles = npt.NDArray[np.float64]
Quad = list[list[float]]

DEGREES_OF_FREEDOM = {
    Model.TRANSLATION: 2,
    Model.SIMILARITY: 4,
    Model.AFFINE: 6,
    Model.HOMOGRAPHY: 8,
}
_FEW = 8
_MIN_NOISE_PX = 0.05
"""Smaller differences between models are not worth a further freedom."""


def fit_robustly(
    model: Model, start: Matrix, a: Points, b: Points, threshold_px: float, rounds: int
) -> tuple[Matrix, Mask]:
    """``start`` improved by rounds of least squares with Tukey's biweight as weights.

    Returns b_from_a and the pairs (M,) within ``threshold_px`` of it. The weights fall to zero
    at 4.685 times the residuals' own scale (Huber & Ronchetti 2009), never beyond the threshold,
    so that good pairs sharpen the result and doubtful ones do not blur it.
    """
    b_from_a = start
    for _ in range(rounds):
        weights = _biweights(transfer_errors(b_from_a, a, b), threshold_px)
        if np.count_nonzero(weights) < DEGREES_OF_FREEDOM[model]:
            break
        if model is Model.HOMOGRAPHY:
            used = weights > 0
            b_from_a = gauss_newton_step(
                b_from_a, a[used].astype(np.float64), b[used].astype(np.float64), weights[used]
            )
        else:
            b_from_a = fit(model, a, b, weights)
    return b_from_a, transfer_errors(b_from_a, a, b) < threshold_px


def solved(normal: Doubles, gradient: Doubles) -> Doubles | None:
    """The step (k,) of a least-squares problem with normal matrix (k, k); None if there is none.

    By OpenCV's Cholesky decomposition: for so few freedoms LAPACK would be mostly overhead.
    """
    is_solved, column = cv2.solve(normal, gradient[:, None], flags=cv2.DECOMP_CHOLESKY)
    step: Doubles = np.asarray(column, np.float64).ravel()
    return step if is_solved and np.isfinite(step).all() else None


def step_matrix(step: Doubles) -> Matrix:
    """The homography that is off the identity by h11 .. h32 (8,)."""
    a, b, c, d, e, f, g, h = step.tolist()
    return np.array([[1 + a, b, c], [d, 1 + e, f], [g, h, 1.0]])


def _biweights(errors: Doubles, threshold_px: float) -> Doubles:
    """Tukey's biweight of each error (M,), its scale taken from the errors below the threshold."""
    near = errors[errors < threshold_px]
    if len(near) == 0:
        return np.zeros(len(errors))
    # The median length of a 2-D Gaussian error is 1.1774 times its standard deviation.
    scale = median(near) / 1.1774
    cut = min(max(4.685 * scale, 0.25), threshold_px)
    weights: Doubles = np.where(errors < cut, (1 - (errors / cut) ** 2) ** 2, 0.0)
    return weights


def median(values: npt.NDArray[Any]) -> float:
    """The upper median of values (M,), M > 0: as good here as the mean of the two, and faster.

    (`np.median` is three times as slow and first loads numpy's masked arrays: 25 ms.)
    """
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])


def fit(model: Model, a: Points, b: Points, weights: Doubles | None = None) -> Matrix:
    """Weighted least-squares mapping of a model from pairs (M, 2); ``weights`` (M,)."""
    if model is Model.SIMILARITY and weights is None and len(a) <= _FEW:
        return _similarity_of_few(a, b)[0]
    pa, pb = a.astype(np.float64), b.astype(np.float64)
    w = np.ones(len(a))
    if weights is not None:
        used = weights > 0
        pa, pb, w = pa[used], pb[used], np.asarray(weights[used], np.float64)
    if model is Model.TRANSLATION:
        return geometry.translation(*_mean(pb - pa, w))
    if model is Model.SIMILARITY:
        return _fit_similarity(pa, pb, w)
    if model is Model.AFFINE:
        return _fit_affine(pa, pb, w)
    return gauss_newton_step(dlt_homography(pa, pb, w), pa, pb, w)


def _fit_similarity(a: Doubles, b: Doubles, w: Doubles) -> Matrix:
    """Scale, rotation and shift as one complex number each: b = s a + t."""
    za, zb = (points.view(np.complex128).ravel() for points in (a, b))
    mean_a = complex(w @ za) / float(w.sum())
    za_weighted = w * (za - mean_a).conj()
    spread = complex(za_weighted @ za).real
    s = complex(za_weighted @ zb) / spread if spread > 0 else 1.0 + 0j
    t = complex(w @ zb) / float(w.sum()) - s * mean_a
    return np.array([[s.real, -s.imag, t.real], [s.imag, s.real, t.imag], [0.0, 0.0, 1.0]])


def similarity_misfit_px(a: Points, b: Points) -> float:
    """How far (RMS) few points b (M, 2) are from any similarity of a."""
    return _similarity_of_few(a, b)[1]


def _similarity_of_few(a: Points, b: Points) -> tuple[Matrix, float]:
    """As `_fit_similarity`, unweighted, with the RMS of what is left.

    In plain numbers: for four corners numpy would be several times as slow.
    """
    za, zb = ([complex(x, y) for x, y in points.tolist()] for points in (a, b))
    mean_a, mean_b = sum(za) / len(za), sum(zb) / len(zb)
    za, zb = [z - mean_a for z in za], [z - mean_b for z in zb]
    spread = sum(abs(z) ** 2 for z in za)
    both = sum(from_a.conjugate() * from_b for from_a, from_b in zip(za, zb, strict=True))
    s = both / spread if spread > 0 else 1.0 + 0j
    t = mean_b - s * mean_a
    left = sum(abs(from_b - s * from_a) ** 2 for from_a, from_b in zip(za, zb, strict=True))
    matrix = np.array([[s.real, -s.imag, t.real], [s.imag, s.real, t.imag], [0.0, 0.0, 1.0]])
    return matrix, sqrt(left / len(za))


def _fit_affine(a: Doubles, b: Doubles, w: Doubles) -> Matrix:
    mean_a, mean_b = _mean(a, w), _mean(b, w)
    centred = a - mean_a
    weighted = (centred * w[:, None]).T
    linear = (_pseudo_inverse(weighted @ centred) @ (weighted @ (b - mean_b))).T
    return _affine_matrix(linear, mean_b - linear @ mean_a)


def _pseudo_inverse(symmetric: Doubles) -> Doubles:
    """Pseudo-inverse of a (2, 2) matrix, which leaves alone what collinear points leave open."""
    (a, b), (_, d) = symmetric.tolist()
    determinant = a * d - b * b
    if determinant > 1e-9 * (a + d) ** 2:
        inverse: Doubles = np.array([[d, -b], [-b, a]]) / determinant
        return inverse
    return np.asarray(np.linalg.pinv(symmetric), np.float64)


def _mean(points: Doubles, weights: Doubles) -> Doubles:
    """Weighted mean of points (N, 2)."""
    mean: Doubles = weights @ points / weights.sum()
    return mean


def _affine_matrix(linear: Doubles, shift: Doubles) -> Matrix:
    matrix = np.eye(3)
    matrix[:2, :2] = linear
    matrix[:2, 2] = shift
    return matrix


def dlt_homography(a: Doubles, b: Doubles, weights: Doubles | None = None) -> Matrix:
    """Homography by the normalised Direct Linear Transformation, b ~ H a.

    Hartley & Zisserman, Multiple View Geometry, 2nd ed., algorithm 4.2. Each pair
    (x, y) -> (u, v) gives two rows of A h = 0 (equation 4.3 with w = 1):

        [ 0  0  0  -x -y -1   vx  vy  v ]
        [ x  y  1   0  0  0  -ux -uy -u ]

    h, the rows of H one after the other, is the right singular vector of the smallest singular
    value. Both point sets are first moved to their centroid and scaled to a mean distance of
    sqrt(2), without which the equations are badly conditioned (Hartley 1997):
    H = T_b^-1 H' T_a. A pair's two rows are multiplied by the root of its weight.

    Needs at least 4 pairs, no three of which are collinear; ``a``, ``b`` (M, 2).
    """
    a_to_unit, b_to_unit = _normaliser(a), _normaliser(b)
    x, y = (a @ a_to_unit[:2, :2].T + a_to_unit[:2, 2]).T
    u, v = (b @ b_to_unit[:2, :2].T + b_to_unit[:2, 2]).T
    root = np.ones(len(a)) if weights is None else np.sqrt(weights)
    zero, one = np.zeros(len(a)), np.ones(len(a))
    upper = np.stack([zero, zero, zero, -x, -y, -one, v * x, v * y, v], axis=1)
    lower = np.stack([x, y, one, zero, zero, zero, -u * x, -u * y, -u], axis=1)
    rows = np.concatenate([upper * root[:, None], lower * root[:, None]])
    # The right singular vectors of A are the eigenvectors of A^T A, which is only 9 x 9; the
    # normalisation keeps the squared condition number harmless in double precision.
    smallest = np.linalg.eigh(rows.T @ rows)[1][:, 0].reshape(3, 3)
    matrix = np.linalg.solve(b_to_unit, smallest @ a_to_unit)
    corner = matrix[2, 2]
    return np.asarray(matrix / corner if abs(corner) > 1e-12 else matrix, np.float64)


def _normaliser(points: Doubles) -> Matrix:
    centre = points.mean(axis=0)
    distance = float(np.mean(np.linalg.norm(points - centre, axis=1)))
    factor = np.sqrt(2) / distance if distance > 0 else 1.0
    return np.array(
        [[factor, 0.0, -factor * centre[0]], [0.0, factor, -factor * centre[1]], [0.0, 0.0, 1.0]]
    )


def gauss_newton_step(start: Matrix, a: Doubles, b: Doubles, weights: Doubles) -> Matrix:
    """``start`` moved by one step on the weighted transfer error in b.

    The DLT minimises an algebraic error, this the geometric one (Hartley & Zisserman, section
    4.2.3). A pair's Jacobian (equation 4.21) is [ray 0 -u ray_xy; 0 ray -v ray_xy] with
    ray = (x, y, 1) / depth. Every product that the normal equations need stands in one Gram
    matrix of ray, -u ray_xy, -v ray_xy and the residuals. Parameters are scaled to a unit
    diagonal for conditioning.
    """
    start = start / start[2, 2]
    depth, residual = _residuals(start, a, b)
    minus_u, minus_v = residual - b.T
    gram = np.empty((9, len(a)))
    ray = gram[0:3]
    with np.errstate(divide="ignore", invalid="ignore"):
        np.divide(1.0, depth, out=ray[2])
        np.multiply(a.T, ray[2], out=ray[:2])
        np.multiply(ray[:2], minus_u, out=gram[3:5])
        np.multiply(ray[:2], minus_v, out=gram[5:7])
    gram[7:9] = residual
    products = (gram * weights) @ gram.T
    normal = np.zeros((8, 8))
    normal[0:3, 0:3] = normal[3:6, 3:6] = products[0:3, 0:3]
    normal[0:3, 6:8] = products[0:3, 3:5]
    normal[3:6, 6:8] = products[0:3, 5:7]
    normal[6:8, 0:6] = normal[0:6, 6:8].T
    normal[6:8, 6:8] = products[3:5, 3:5] + products[5:7, 5:7]
    gradient = np.concatenate(
        [products[0:3, 7], products[0:3, 8], products[3:5, 7] + products[5:7, 8]]
    )
    length = np.sqrt(normal.diagonal()) + 1e-300
    normal /= length[:, None] * length
    normal[np.diag_indices(8)] *= 1 + 1e-9
    try:
        change = np.linalg.solve(normal, gradient / length) / length
    except np.linalg.LinAlgError:
        return start
    moved = start + np.append(change, 0.0).reshape(3, 3)
    return moved if np.all(np.isfinite(moved)) else start


def _residuals(b_from_a: Matrix, a: Points | Doubles, b: Points | Doubles) -> tuple[Doubles, ...]:
    """Depths (M,) of the points of a seen from b, and what b has beyond their places (2, M)."""
    (p, q, r), (s, t, u), (v, w, z) = b_from_a.tolist()
    x, y = np.array(a.T, np.float64, order="C")
    depth = v * x + w * y + z
    residual = np.empty((2, len(a)))
    with np.errstate(divide="ignore", invalid="ignore"):
        np.subtract(b[:, 0], (p * x + q * y + r) / depth, out=residual[0])
        np.subtract(b[:, 1], (s * x + t * y + u) / depth, out=residual[1])
    return depth, residual


def transfer_errors(b_from_a: Matrix, a: Points, b: Points) -> Doubles:
    """Distance (M,) in b between each mapped point of a and its partner; inf at the horizon."""
    _, residual = _residuals(b_from_a, a, b)
    distances: Doubles = np.hypot(residual[0], residual[1])
    distances[np.isnan(distances)] = np.inf
    return distances


def fit_best_model(
    a: Points, b: Points, ladder: Sequence[Model], near: Matrix | None = None
) -> tuple[Model, Matrix]:
    """The model of a ladder, poorest first, with the least GRIC, and its fit to the pairs.

    ``near``, if given, is a homography about right, from which the best one is reached in a step.

    Geometric Robust Information Criterion (Torr 1998, "Geometric motion segmentation and model
    selection"): sum of min(e^2 / s^2, 2 (r - d)) + l1 d n + l2 k with r = 4 coordinates a pair,
    d = 2 dimensions of the manifold, k degrees of freedom, l1 = ln r (the same for all four
    models, so left out) and l2 = ln(r n). The noise s is that of the richest model's residuals,
    at least `_MIN_NOISE_PX`. It asks of each further freedom that it pays in residuals.
    """
    fits = {model: _fit_near(model, a, b, near) for model in ladder}
    if len(ladder) == 1:
        return ladder[0], fits[ladder[0]]
    residuals = {model: transfer_errors(fits[model], a, b) for model in ladder}
    noise_px = max(_MIN_NOISE_PX, median(residuals[ladder[-1]]) / 1.1774)
    penalty = log(4 * len(a))

    def gric(model: Model) -> float:
        cost = np.minimum((residuals[model] / noise_px) ** 2, 4.0)
        return float(cost.sum()) + penalty * DEGREES_OF_FREEDOM[model]

    best = min(ladder, key=gric)
    return best, fits[best]


def _fit_near(model: Model, a: Points, b: Points, near: Matrix | None) -> Matrix:
    if model is not Model.HOMOGRAPHY or near is None:
        return fit(model, a, b)
    pairs = a.astype(np.float64), b.astype(np.float64)
    return gauss_newton_step(near, *pairs, np.ones(len(a)))


def poorest_model(b_from_a: Matrix, region: Points) -> Model:
    """The model of fewest freedoms that maps the quad ``region`` (4, 2) like ``b_from_a``."""
    quad = geometry.transform_points(b_from_a, region)
    if _affine_misfit_px(region.tolist(), quad.tolist()) > _MIN_NOISE_PX:
        return Model.HOMOGRAPHY
    linear = fit(Model.AFFINE, region, quad)[:2, :2]
    reach_px = float(np.max(np.linalg.norm(region - region.mean(axis=0), axis=1)))
    cosine, sine = linear[0, 0] + linear[1, 1], linear[1, 0] - linear[0, 1]
    similar = np.array([[cosine, -sine], [sine, cosine]]) / 2
    if np.linalg.norm(linear - similar) * reach_px > _MIN_NOISE_PX:
        return Model.AFFINE
    is_shift = np.linalg.norm(linear - np.eye(2)) * reach_px <= _MIN_NOISE_PX
    return Model.TRANSLATION if is_shift else Model.SIMILARITY


def _affine_misfit_px(quad: Quad, seen: Quad) -> float:
    """How far the best affine mapping of four corners puts the worst of them from where it is.

    Four points of a plane have one affine dependency, weights w with sum w p = 0 and sum w = 0;
    every affine image keeps it, so what ``seen`` leaves of it is the misfit.
    """
    # In plain numbers: for four corners numpy would be ten times as slow.
    areas = [geometry.signed_area([*quad[:i], *quad[i + 1 :]]) for i in range(4)]
    weights = [area * (-1) ** i for i, area in enumerate(areas)]
    left = [sum(w * place[axis] for w, place in zip(weights, seen, strict=True)) for axis in (0, 1)]
    misfit_px: float = max(map(abs, weights)) * hypot(*left) / sum(w * w for w in weights)
    return misfit_px
