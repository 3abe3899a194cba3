"""Global adjustment of a flat mosaic: one pose a picture that all links agree with best.

A homography for each picture lets the mosaic's perspective drift, because links fix only what
pictures have in common. So the models are climbed from poor to rich (after Elibol et al., who go
from similarities to homographies in two steps), the world is laid level (`mosaic.levelling`), and
poses are held to what a camera with square pixels can show of a plane (`mosaic.prior`).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from math import log
from typing import Literal

import numpy as np

from streamtrack import geometry
from streamtrack.fitting import DEGREES_OF_FREEDOM, fit, transfer_errors
from streamtrack.mosaic.bundle import (
    MIN_NOISE_PX,
    Problem,
    Solution,
    estimated_noise_px,
    solve,
    transfer_errors_of,
)
from streamtrack.mosaic.drift import expected_errors_px
from streamtrack.mosaic.normal_equations import Doubles, Rows
from streamtrack.mosaic.prior import NO_PRIOR
from streamtrack.mosaic.types import Adjusted, Link
from streamtrack.types import Matrix, Model, Size

_CELLS = 4  # along each side of the box around a link's points: their pairs are averaged
_MAX_CELL_PAIRS = 40.0  # more in one cell count no more
_LADDER = (Model.SIMILARITY, Model.AFFINE, Model.HOMOGRAPHY)
_NEAR_ROUNDS = 12
_GAIN_OF_FREEDOM = 0.02  # share of the noise that a richer model must take away


@dataclass(frozen=True, slots=True, eq=False)
class Solved(Adjusted):
    """Poses, and what they rest on; ``pictures`` are those of the solution's rows."""

    problem: Problem
    solution: Solution
    pictures: Sequence[int]

    def expected_errors_px(self, noise_px: float) -> dict[int, float]:
        """Expected RMS error of each picture's corners in the world, the anchor's pixels.

        ``noise_px`` is the standard deviation of a pair's error along x and y.
        """
        if self.problem.links == 0:
            return {}
        expected = expected_errors_px(self.problem, self.solution, noise_px)
        return {picture: float(expected[i]) for i, picture in enumerate(self.pictures)}


def adjust(
    world_from_picture: Mapping[int, Matrix],
    links: Sequence[Link],
    sizes: Mapping[int, Size],
    anchor: int,
    model: Model | Literal["auto"] = "auto",
    *,
    fixed: Collection[int] = (),
    is_near: bool = False,
) -> Solved:
    """The poses that the links' inlier pairs agree with best, the anchor's kept as it is.

    ``world_from_picture`` are rough poses to start from, ``sizes`` the (width, height) of the
    same pictures; links to pictures that are not among them are left out. ``model`` is that of
    the poses against the anchor's; under ``auto`` the richest that pays. Pictures in ``fixed``
    keep their poses to the last bit: with them, a part of a large graph is adjusted to the rest
    (``anchor`` then only names a picture that is not dropped). ``is_near`` says that the given
    poses are of the model and nearly right, so that the poorer models need not be climbed.

    Raises ValueError if the anchor has no pose or a picture no size.
    """
    if anchor not in world_from_picture:
        raise ValueError(f"anchor {anchor} has no pose")
    for picture in world_from_picture:
        if picture not in sizes:
            raise ValueError(f"picture {picture} has no size")
    usable = [
        row
        for row, link in enumerate(links)
        if link.b_from_a is not None
        and link.a != link.b
        and link.a in world_from_picture
        and link.b in world_from_picture
        and np.count_nonzero(link.registration.is_inlier) >= 2
    ]
    held = {picture for picture in fixed if picture in world_from_picture}
    roots = held | {anchor}
    pictures = _connected(roots, [links[row] for row in usable])
    is_within = [row for row in usable if links[row].a in pictures]
    order = sorted(pictures)
    problem = _make_problem(order, [links[row] for row in is_within], sizes, anchor, held)
    start = np.stack([world_from_picture[picture] for picture in order])
    solution = _climb(problem, start, model, is_near or bool(held))

    link_rmse_px, is_used = np.full(len(links), np.nan), np.zeros(len(links), np.bool_)
    row_of = {picture: row for row, picture in enumerate(order)}
    for row in is_within:
        a, b = row_of[links[row].a], row_of[links[row].b]
        implied = geometry.inverted(solution.poses[b]) @ solution.poses[a]
        link_rmse_px[row] = _pairs_rmse_px(links[row], implied)
    is_used[is_within] = solution.is_used
    # Without the rejected links some pictures may hang on nothing.
    kept = _connected(roots, [links[row] for row in is_within if is_used[row]])
    poses = {p: solution.poses[i] for i, p in enumerate(order) if p in kept}
    for picture in held & kept:
        poses[picture] = world_from_picture[picture]
    rmse_px = float(np.sqrt(np.mean(link_rmse_px[is_used] ** 2))) if is_used.any() else float("nan")
    return Solved(poses, solution.model, rmse_px, link_rmse_px, is_used, problem, solution, order)


def _pairs_rmse_px(link: Link, b_from_a: Matrix) -> float:
    """Root mean square transfer error of a link's inlier pairs under a mapping, at most 1e6."""
    is_inlier = link.registration.is_inlier
    errors = transfer_errors(b_from_a, link.a_points[is_inlier], link.b_points[is_inlier])
    return float(np.sqrt(np.mean(np.minimum(errors, 1e6) ** 2)))


def _connected(roots: Collection[int], links: Sequence[Link]) -> set[int]:
    """The pictures that links connect with any of the roots."""
    neighbours: dict[int, list[int]] = {}
    for link in links:
        neighbours.setdefault(link.a, []).append(link.b)
        neighbours.setdefault(link.b, []).append(link.a)
    found, open_ends = set(roots), list(roots)
    while open_ends:
        for other in neighbours.get(open_ends.pop(), ()):
            if other not in found:
                found.add(other)
                open_ends.append(other)
    return found


# -- the problem as arrays ----------------------------------------------------------------------


def _make_problem(
    order: Sequence[int],
    links: Sequence[Link],
    sizes: Mapping[int, Size],
    anchor: int,
    held: Collection[int],
) -> Problem:
    row_of = {picture: row for row, picture in enumerate(order)}
    count, half = len(links), _CELLS * _CELLS // 2
    a_points, b_points = np.zeros((2 * count, half, 2)), np.zeros((2 * count, half, 2))
    counts = np.zeros((2 * count, half))
    if count:
        link, one, other, pairs = _condensed(links)
        starts = np.searchsorted(link, link)
        place = np.arange(len(link)) - starts
        for half_of_links, p, q in ((0, one, other), (1, other, one)):
            chosen = place % 2 == half_of_links
            at = link[chosen] + half_of_links * count, place[chosen] // 2
            a_points[at], b_points[at], counts[at] = p[chosen], q[chosen], pairs[chosen]
    a = np.array([row_of[link.a] for link in links], np.intp)
    b = np.array([row_of[link.b] for link in links], np.intp)
    own = np.array([link.b_from_a for link in links], np.float64).reshape(-1, 3, 3)
    unit_px = np.array([max(sizes[picture]) / 2 for picture in order])
    units = np.stack([_unit_from_picture(sizes[picture]) for picture in order])
    is_held = np.array([picture in held for picture in order])
    return Problem(
        np.concatenate([a, b]),
        np.concatenate([b, a]),
        a_points,
        b_points,
        counts,
        units,
        unit_px,
        is_held,
        None if held else row_of[anchor],
        np.concatenate([own, np.linalg.inv(own)]) if count else np.zeros((0, 3, 3)),
    )


def _unit_from_picture(size_wh: Size) -> Matrix:
    """Picture pixels to coordinates in which the longer side goes from -1 to 1."""
    factor = 2 / max(size_wh)
    x, y = (factor * (side - 1) / 2 for side in size_wh)
    return np.array([[factor, 0.0, -x], [0.0, factor, -y], [0.0, 0.0, 1.0]])


def _condensed(links: Sequence[Link]) -> tuple[Rows, Doubles, Doubles, Doubles]:
    """The links' inlier pairs averaged cell by cell of a grid over each link's own points.

    Returns the row of its link, the point of a, the point of b (C, 2) and the number of pairs of
    each cell. What is averaged in b is the distance from where the link's own mapping takes each
    point, so that cells need not be small against perspective.
    """
    a = np.concatenate([link.a_points[link.registration.is_inlier] for link in links])
    b = np.concatenate([link.b_points[link.registration.is_inlier] for link in links])
    a, b = a.astype(np.float64), b.astype(np.float64)
    sizes = np.array([np.count_nonzero(link.registration.is_inlier) for link in links])
    own = np.array([link.b_from_a for link in links], np.float64).reshape(-1, 3, 3)
    link_of_pair = np.repeat(np.arange(len(links)), sizes)
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    low = np.minimum.reduceat(a, starts)
    span = np.maximum(np.maximum.reduceat(a, starts) - low, 1e-6)
    column, row = ((a - low[link_of_pair]) / span[link_of_pair] * (_CELLS - 1e-3)).astype(int).T
    cells = (link_of_pair * _CELLS + row) * _CELLS + column
    kept, cell = np.unique(cells, return_inverse=True)
    pairs = np.bincount(cell).astype(np.float64)
    link = kept // _CELLS**2

    def mean(values: Doubles) -> Doubles:
        sums = [np.bincount(cell, values[:, axis]) for axis in (0, 1)]
        return np.stack(sums, axis=1) / pairs[:, None]

    points = mean(a)
    partners = _each_mapped(own[link], points) + mean(b - _each_mapped(own[link_of_pair], a))
    return link.astype(np.intp), points, partners, np.minimum(pairs, _MAX_CELL_PAIRS)


def _each_mapped(matrices: Doubles, points: Doubles) -> Doubles:
    """Each point (N, 2) under its own matrix (N, 3, 3)."""
    moved = (matrices[:, :, :2] @ points[:, :, None])[..., 0] + matrices[:, :, 2]
    mapped: Doubles = moved[:, :2] / moved[:, 2:]
    return mapped


# -- climbing the models ------------------------------------------------------------------------


def _climb(
    problem: Problem, start: Doubles, model: Model | Literal["auto"], is_near: bool
) -> Solution:
    """The solution of one model, reached over the poorer ones, or of the model that pays."""
    anchor = start[problem.anchor] if problem.anchor is not None else np.eye(3)
    anchored = np.stack([geometry.normalized(geometry.inverted(anchor) @ pose) for pose in start])
    top = Model.HOMOGRAPHY if model == "auto" else model
    if problem.links == 0:
        empty = np.zeros((0, 1))
        return Solution(start, top, empty, empty, np.zeros(0, np.bool_), MIN_NOISE_PX, NO_PRIOR)
    if is_near:
        return _rooted(problem, anchor, solve(problem, anchored, top, rounds=_NEAR_ROUNDS))
    ladder = [step for step in _LADDER if step is top or step in _LADDER[: _rung(top)]]
    ladder = ladder or [top]
    found = [solve(problem, _reduced(problem, anchored, ladder[0]), ladder[0])]
    for step in ladder[1:]:
        # A model too poor for a picture's links rejects them all: the next one hears them again.
        is_graduated = _linked(problem, found[-1]) < len(start)
        found.append(solve(problem, found[-1].poses, step, is_graduated))
    own_noise_px = estimated_noise_px(
        problem, transfer_errors_of(problem, problem.own), found[-1].is_used
    )
    if top is Model.HOMOGRAPHY and found[-1].noise_px > 2 * own_noise_px:
        # A camera that turns is far from any affine map: the given poses may be a better start.
        given = solve(problem, anchored, top)
        noise_px = min(found[-1].noise_px, given.noise_px)
        if given.cost(noise_px) < found[-1].cost(noise_px):
            found[-1] = given
    if model != "auto":
        return _rooted(problem, anchor, found[-1])
    whole = [one for one in found if _linked(problem, one) >= _linked(problem, found[-1])]
    best = _that_pays(whole)
    return _rooted(problem, anchor, best)


def _linked(problem: Problem, solution: Solution) -> int:
    """How many pictures have a link that the solution does not reject."""
    used = np.concatenate([solution.is_used, solution.is_used])
    return len(set(problem.a[used].tolist()) | set(problem.b[used].tolist()))


def _rooted(problem: Problem, anchor: Matrix, solution: Solution) -> Solution:
    """The solution moved as a whole to where the anchor has its given pose."""
    if problem.anchor is None:
        return solution
    moved = anchor @ geometry.inverted(solution.poses[problem.anchor])
    poses = np.stack([geometry.normalized(moved @ pose) for pose in solution.poses])
    return replace(solution, poses=poses)


def _rung(model: Model) -> int:
    return _LADDER.index(model) if model in _LADDER else 0


def _that_pays(found: Sequence[Solution]) -> Solution:
    """The richest model whose freedoms pay in residuals, by the Bayesian criterion.

    With thousands of pairs any freedom pays a little; it must also take away a part of the noise.
    """
    noise_px = max(MIN_NOISE_PX, found[-1].noise_px)
    best = found[-1]
    for poorer in found[-2::-1]:
        pairs = float(np.sum(poorer.counts))
        freedoms = DEGREES_OF_FREEDOM[best.model] - DEGREES_OF_FREEDOM[poorer.model]
        price = log(max(pairs, 2.0)) * freedoms * (len(best.poses) - 1)
        price += 2 * _GAIN_OF_FREEDOM * pairs
        if poorer.cost(noise_px) - best.cost(noise_px) <= price:
            best = poorer
    return best


def _reduced(problem: Problem, poses: Doubles, model: Model) -> Doubles:
    """The poses brought to a model: what they do to a grid of their picture's points, refitted."""
    if model is Model.HOMOGRAPHY:
        return poses
    axis = np.linspace(-1, 1, 4)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    reduced = []
    for pose, unit in zip(poses, problem.unit_from_picture, strict=True):
        points = geometry.transform_points(geometry.inverted(unit), grid)
        seen = geometry.transform_points(pose, points)
        is_sane = np.isfinite(seen).all(axis=1)
        is_sane &= geometry.projective_depths(pose, points) > 0
        enough = np.count_nonzero(is_sane) >= 4
        reduced.append(fit(model, points[is_sane], seen[is_sane]) if enough else np.eye(3))
    return np.stack(reduced)
