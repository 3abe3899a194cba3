"""Levenberg-Marquardt over the poses of a mosaic's pictures, for one transformation model.

Poses ``world_from_picture`` move by small changes on their right, W <- W N^-1 (I + D) N, where N
maps the picture to unit coordinates and D spans the model's freedoms. The normal equations are
built block by block with analytic Jacobians and are as sparse as the graph of links.

Wrong links are found by graduated non-convexity (Yang et al. 2020, "Graduated non-convexity for
robust spatial perception", the Geman-McClure case) on each link's RMS; the pairs of the others
are weighted by Huber's function.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from streamtrack.mosaic.levelling import levelled
from streamtrack.mosaic.normal_equations import Doubles, Normal, Rows
from streamtrack.mosaic.prior import NO_PRIOR, Prior, first_prior
from streamtrack.types import Mask, Model
from streamtrack.uncertainty import MODEL_BASES, motion_rows

_MAX_ROUNDS = 30
_CONVERGED_PX = 5e-3
MIN_NOISE_PX = 0.05
_MIN_WEIGHED_PX = 0.15
"""Least noise of pairs by which they are weighed against the prior: those that lie on their link's
own mapping show none, but share its error."""
_MIN_TOLERANCE_PX = 1.0  # links are never wrong for less than three times this
_HUBER = 1.345  # times the noise: 95 % efficient for Gaussian errors
_MIN_EXPOSURES = 0.25  # of the links
_DAMPING = 1e-9
_MAX_DAMPING = 1e3

_SIMILARITY_ROWS = np.linalg.pinv(MODEL_BASES[Model.SIMILARITY])


@dataclass(frozen=True, eq=False)
class Problem:
    """Links as padded arrays; every link is there twice, with half of its pairs each way.

    a, b                int (2 L,), rows of the pictures: points of a are mapped into b
    a_points, b_points  (2 L, K, 2), zero where there is no pair
    counts              float (2 L, K), how many of the link's own pairs each stands for
    unit_from_picture   (n, 3, 3)
    unit_px             (n,), picture pixels of one unit
    is_held             bool (n,), poses that do not move
    anchor              row of the anchor, None if held pictures fix the world
    own                 (2 L, 3, 3), b_from_a as the links themselves have it
    """

    a: Rows
    b: Rows
    a_points: Doubles
    b_points: Doubles
    counts: Doubles
    unit_from_picture: Doubles
    unit_px: Doubles
    is_held: Mask
    anchor: int | None
    own: Doubles

    @property
    def links(self) -> int:
        return len(self.a) // 2

    @cached_property
    def tells_noise(self) -> Mask:
        """Which links (L,) are of two exposures: those of a picture and its copy have no noise.

        All of them where hardly any are, as with rendered pictures.
        """
        errors = transfer_errors_of(self, self.own)
        squares = _of_links((self.counts * np.minimum(errors, 1e6) ** 2).sum(axis=1))
        pairs = np.maximum(_of_links(self.counts.sum(axis=1)), 1)
        tells: Mask = np.sqrt(squares / pairs) > MIN_NOISE_PX
        return tells if np.mean(tells) > _MIN_EXPOSURES else np.ones_like(tells)


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Poses (n, 3, 3) of a model; ``errors_px`` (2 L, K) of all pairs, ``is_used`` (L,).

    ``prior`` is what the poses were held to, in a level world.
    """

    poses: Doubles
    model: Model
    errors_px: Doubles
    counts: Doubles
    is_used: Mask
    noise_px: float
    prior: Prior

    def cost(self, noise_px: float) -> float:
        """Bounded sum of squares over all pairs, in units of the noise."""
        squares = np.minimum(self.errors_px**2 * self.counts / noise_px**2, 9.0)
        return float(np.sum(squares))


def _of_links(values: Doubles) -> Doubles:
    """Sums (L,) of what the two halves (2 L,) of each link have."""
    half = len(values) // 2
    total: Doubles = values[:half] + values[half:]
    return total


def solve(
    problem: Problem,
    start: Doubles,
    model: Model,
    is_graduated: bool = True,
    rounds: int = _MAX_ROUNDS,
) -> Solution:
    """Levenberg-Marquardt from ``start``, reweighted at each of at most ``rounds`` rounds.

    ``is_graduated`` lets all links count at first; else the start tells good links from wrong.
    Homographies that no held pose fixes are laid level before (see `mosaic.levelling`).
    """
    unit, prior = problem.unit_from_picture, NO_PRIOR
    if problem.anchor is not None and model in (Model.AFFINE, Model.HOMOGRAPHY):
        prior = first_prior(0.0)
        if model is Model.HOMOGRAPHY:
            level = levelled(start, unit, problem.anchor)
            start, prior = level.poses, first_prior(level.focal)
    poses, errors = start, _errors(problem, start)
    damping, rejection = _DAMPING, _Rejection(problem, errors, is_graduated)
    for tried in range(rounds):
        weights = _weights(problem, errors, rejection)
        before = _cost(problem, weights, poses, errors, prior)
        while True:
            change = _step(problem, poses, weights, prior, model, damping)
            moved = _moved(problem, poses, change)
            moved_errors = _errors(problem, moved)
            if _cost(problem, weights, moved, moved_errors, prior) <= before:
                break
            damping *= 10
            if damping > _MAX_DAMPING:
                return _finished(problem, poses, errors, rejection, model, prior)
        damping = max(damping / 10, _DAMPING)
        moved_px = float(np.max(np.abs(change) * problem.unit_px[:, None]))
        poses, errors = moved, moved_errors
        if prior is not NO_PRIOR:
            prior = prior.learned(poses, unit)
        is_final = rejection.tighten(errors)
        if moved_px < _CONVERGED_PX and is_final and tried > 2:
            break
    return _finished(problem, poses, errors, rejection, model, prior)


def _finished(
    problem: Problem,
    poses: Doubles,
    errors: Doubles,
    rejection: _Rejection,
    model: Model,
    prior: Prior,
) -> Solution:
    is_used = rejection.is_used(errors)
    noise_px = estimated_noise_px(problem, errors, is_used)
    return Solution(poses, model, np.minimum(errors, 1e6), problem.counts, is_used, noise_px, prior)


class _Rejection:
    """Weights of whole links by graduated non-convexity: first all count, then those that agree."""

    def __init__(self, problem: Problem, errors: Doubles, is_graduated: bool) -> None:
        self._counts, self._tells_noise = problem.counts, problem.tells_noise
        self._pairs = np.maximum(_of_links(problem.counts.sum(axis=1)), 1)
        worst, tolerance = float(np.max(self._rms(errors))), self._tolerance(errors)
        self._mu = max(1.0, 2 * (worst / tolerance) ** 2) if is_graduated else 1.0

    def _rms(self, errors: Doubles) -> Doubles:
        squares = self._counts * np.minimum(errors, 1e6) ** 2
        rms: Doubles = np.sqrt(_of_links(squares.sum(axis=1)) / self._pairs)
        return rms

    def _tolerance(self, errors: Doubles) -> float:
        """RMS of a link that counts half: three times what links usually have."""
        usual = float(np.median(self._rms(errors)[self._tells_noise]))
        return 3 * max(_MIN_TOLERANCE_PX, usual)

    def weights(self, errors: Doubles) -> Doubles:
        """What each link (L,) counts, 0..1."""
        slack = self._mu * self._tolerance(errors) ** 2
        weights: Doubles = (slack / (self._rms(errors) ** 2 + slack)) ** 2
        return weights

    def tighten(self, errors: Doubles) -> bool:
        """Go on to the next, less convex stage; True if there is none."""
        is_final = self._mu <= 1.0
        self._mu = max(1.0, self._mu / 4.0)
        return is_final

    def is_used(self, errors: Doubles) -> Mask:
        used: Mask = self._rms(errors) <= self._tolerance(errors)
        return used


def estimated_noise_px(problem: Problem, errors: Doubles, is_used: Mask | None = None) -> float:
    """Standard deviation a coordinate of one pair's error, from the median length."""
    told = problem.tells_noise if is_used is None else problem.tells_noise & is_used
    is_pair = (problem.counts > 0) & np.concatenate([told, told])[:, None]
    if not is_pair.any():
        return MIN_NOISE_PX
    alone = errors[is_pair] * np.sqrt(problem.counts[is_pair])
    return max(MIN_NOISE_PX, float(np.median(alone)) / 1.1774)


def _weights(problem: Problem, errors: Doubles, rejection: _Rejection) -> Doubles:
    """What each pair (2 L, K) counts, a square pixel's worth."""
    noise_px = estimated_noise_px(problem, errors)
    # The mean of n pairs is worth n of them, as far as their errors are independent.
    with np.errstate(divide="ignore", invalid="ignore"):
        alone = errors * np.sqrt(problem.counts)  # no pair, and its place at infinity: NaN
        huber = np.nan_to_num(np.minimum(1.0, 2 * _HUBER * noise_px / alone))
    of_link = rejection.weights(errors)
    both = np.concatenate([of_link, of_link])[:, None]
    weights: Doubles = huber * problem.counts * both / max(noise_px, _MIN_WEIGHED_PX) ** 2
    return weights


def _cost(
    problem: Problem, weights: Doubles, poses: Doubles, errors: Doubles, prior: Prior
) -> float:
    is_counted = weights > 0
    cost = float(np.sum(weights[is_counted] * errors[is_counted] ** 2))
    cost += prior.cost(poses, problem.unit_from_picture)
    return cost if np.isfinite(cost) else float("inf")


def _relative(problem: Problem, poses: Doubles) -> Doubles:
    """b_from_a (2 L, 3, 3) that the poses imply for the links."""
    return np.asarray(np.linalg.inv(poses)[problem.b] @ poses[problem.a], np.float64)


def _mapped(problem: Problem, b_from_a: Doubles) -> tuple[Doubles, Doubles]:
    """Points of a in b (2 L, K, 2), and their depths (2 L, K)."""
    homogeneous = problem.a_points @ b_from_a[:, :, :2].transpose(0, 2, 1) + b_from_a[:, None, :, 2]
    depth = homogeneous[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return homogeneous[..., :2] / depth[..., None], depth


def _errors(problem: Problem, poses: Doubles) -> Doubles:
    """Distance (2 L, K) of each mapped point from its partner; inf behind the horizon."""
    return transfer_errors_of(problem, _relative(problem, poses))


def transfer_errors_of(problem: Problem, b_from_a: Doubles) -> Doubles:
    mapped, depth = _mapped(problem, b_from_a)
    errors = np.hypot(*np.moveaxis(mapped - problem.b_points, -1, 0))
    # Depths keep the sign they have at a's centre as long as no point folds over.
    centre = np.linalg.inv(problem.unit_from_picture[problem.a])[:, :, 2]
    sign = np.sign(np.einsum("li,li->l", b_from_a[:, 2], centre))
    errors[~np.isfinite(errors) | (depth * sign[:, None] <= 0)] = np.inf
    return np.asarray(errors, np.float64)


def _jacobians(problem: Problem, poses: Doubles, model: Model) -> tuple[Doubles, Doubles, Doubles]:
    """Residuals b - mapped (2 L, K, 2), and how mapped points change with both poses' freedoms."""
    freedoms = MODEL_BASES[model]
    mapped, by_a, by_b = _change_of_points(problem, _relative(problem, poses))
    return problem.b_points - mapped, by_a @ freedoms, by_b @ freedoms


def _change_of_points(problem: Problem, b_from_a: Doubles) -> tuple[Doubles, Doubles, Doubles]:
    """Mapped points (2 L, K, 2), and how they change with D of a's and of b's pose (.., 8)."""
    mapped, depth = _mapped(problem, b_from_a)
    unit_a, unit_b = problem.unit_from_picture[problem.a], problem.unit_from_picture[problem.b]

    # d mapped = d pi(h) B^-1 A N^-1 (D N p), with (D N p) linear in D's elements.
    b_from_unit = b_from_a @ np.linalg.inv(unit_a)
    change = b_from_unit[:, None, :2] - mapped[..., None] * b_from_unit[:, None, 2:]
    change = change / depth[..., None, None]
    x, y = np.moveaxis(
        problem.a_points * unit_a[:, None, [0, 1], [0, 1]] + unit_a[:, None, :2, 2], -1, 0
    )
    ray = np.stack([x, y, np.ones_like(x)], axis=-1)
    by_a = (change[..., :, None] * ray[..., None, None, :]).reshape(*change.shape[:-1], 9)[..., :8]

    # B's change stands inverted before the mapped point: -d pi at the point itself.
    factor = unit_b[:, 0, 0]
    places = mapped * factor[:, None, None] + unit_b[:, None, :2, 2]
    rows = motion_rows(places.reshape(-1, 2)).reshape(*places.shape, 8)
    by_b = -rows / factor[:, None, None, None]
    return mapped, by_a, by_b


def _step(
    problem: Problem, poses: Doubles, weights: Doubles, prior: Prior, model: Model, damping: float
) -> Doubles:
    """The change D (n, 8) of every pose that minimises the linearised cost."""
    normal, vector = equations(problem, poses, weights, prior, model, damping)
    change = np.zeros((len(poses), 8))
    change[~problem.is_held] = normal.solved(vector) @ MODEL_BASES[model].T
    return change


def equations(
    problem: Problem,
    poses: Doubles,
    weights: Doubles,
    prior: Prior,
    model: Model,
    damping: float = _DAMPING,
) -> tuple[Normal, Doubles]:
    """The normal equations of the free poses: the matrix, and the vector (n, k)."""
    freedoms = MODEL_BASES[model]
    k, count = freedoms.shape[1], len(poses)
    residuals, by_a, by_b = _jacobians(problem, poses, model)
    links, pairs = problem.counts.shape
    root = np.sqrt(weights)
    is_counted = root > 0
    root = np.where(is_counted, root, 0.0)

    def rows(values: Doubles) -> Doubles:
        scaled = np.where(is_counted[..., None, None], values, 0.0) * root[..., None, None]
        return scaled.reshape(links, 2 * pairs, -1)

    ja, jb, r = rows(by_a), rows(by_b), rows(residuals[..., None])
    ja_t, jb_t = ja.transpose(0, 2, 1), jb.transpose(0, 2, 1)
    diagonal, vector = np.zeros((count, k, k)), np.zeros((count, k))
    np.add.at(diagonal, problem.a, ja_t @ ja)
    np.add.at(diagonal, problem.b, jb_t @ jb)
    np.add.at(vector, problem.a, (ja_t @ r)[..., 0])
    np.add.at(vector, problem.b, (jb_t @ r)[..., 0])
    if prior is not NO_PRIOR:
        unit = problem.unit_from_picture
        by_d = prior.rows(poses, unit) @ freedoms
        held = by_d.transpose(0, 2, 1) * prior.precisions
        diagonal += held @ by_d
        vector -= (held @ prior.deviations(poses, unit)[..., None])[..., 0]
    if problem.anchor is not None:
        pin = _SIMILARITY_ROWS @ freedoms
        strength = 1e3 * max(1.0, float(np.max(diagonal)))
        diagonal[problem.anchor] += strength * pin.T @ pin
    diagonal[:, range(k), range(k)] *= 1 + damping
    diagonal[:, range(k), range(k)] += 1e-9

    is_free = ~problem.is_held
    place = np.where(is_free, np.cumsum(is_free) - 1, -1)
    row, column = place[problem.a], place[problem.b]
    is_between = (row >= 0) & (column >= 0)
    blocks = (ja_t @ jb)[is_between]
    normal = Normal(diagonal[is_free], row[is_between], column[is_between], blocks)
    return normal, vector[is_free]


def _moved(problem: Problem, poses: Doubles, change: Doubles) -> Doubles:
    """Poses after W <- W N^-1 (I + D) N, scaled so that their last element is 1."""
    last = np.zeros((len(change), 1))
    step = np.eye(3) + np.concatenate([change, last], axis=1).reshape(-1, 3, 3)
    unit = problem.unit_from_picture
    moved = poses @ np.linalg.inv(unit) @ step @ unit
    moved[problem.is_held] = poses[problem.is_held]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(moved / moved[:, 2:, 2:], np.float64)
