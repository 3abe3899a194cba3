"""A camera that turns on the spot: focal length from homographies, rotations by bundle adjustment.

Between pictures of such a camera lies H = K_b R K_a^-1, whatever the scene. The focal length is
started as in Szeliski & Shum 1997 ("Creating full view panoramic image mosaics and environment
maps", section 4: two constraints on the rows and columns of H), and refined together with all
rotations by Levenberg-Marquardt on the pairs of all links (Brown & Lowe 2007, section 4) with
analytic Jacobians and weights that fall for large errors.

The principal point is taken to be the picture's centre. One focal length, in units of the longer
side, serves all pictures; each may differ from it a little, as far as the pairs demand.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.fitting import median
from streamtrack.mosaic.types import Link
from streamtrack.types import Matrix, Points, Size

Doubles: TypeAlias = npt.NDArray[np.float64]

_MAX_PAIRS = 120  # of each link
_ROUNDS = 25
_FEW_POINTS = 30  # of each link, to tell focal lengths apart
_FREE_FOCAL = 0.01  # relative deviation of one picture's focal length from the common one
_FOCAL_RANGE = (0.25, 20.0)  # of the longer side: 127 to 3 degrees of view
_MIN_NOISE_PX = 0.1
_COPY_PX = 0.05
_HOPELESS = 0.12  # of the longer side: homographies that miss rotations by so much are none


@dataclass(frozen=True, slots=True, eq=False)
class Rotations:
    """Cameras that share one centre.

    ``world_from_camera`` are rotations (3, 3), the anchor's the identity; ``focals_px`` the focal
    lengths; ``rmse_px`` the transfer error of the pairs within three times the noise, and
    ``link_rms_px`` the median transfer error of each given link.
    """

    world_from_camera: dict[int, Matrix]
    focals_px: dict[int, float]
    sizes: dict[int, Size]
    anchor: int
    rmse_px: float
    link_error_px: Doubles

    def camera_matrix(self, picture: int) -> Matrix:
        """K: pixels of a picture from directions in its camera."""
        return camera_matrix(self.focals_px[picture], self.sizes[picture])

    def world_from_picture(self, picture: int) -> Matrix:
        """The homography to the anchor's picture, exact for a camera that only turns."""
        rotation = self.world_from_camera[picture]
        return (
            self.camera_matrix(self.anchor) @ rotation @ np.linalg.inv(self.camera_matrix(picture))
        )


def camera_matrix(focal_px: float, size_wh: Size) -> Matrix:
    """K with the principal point at the picture's centre."""
    cx, cy = (size_wh[0] - 1) / 2, (size_wh[1] - 1) / 2
    return np.array([[focal_px, 0.0, cx], [0.0, focal_px, cy], [0.0, 0.0, 1.0]])


# -- a start ------------------------------------------------------------------------------------


def focals_from_homography(b_from_a: Matrix, size_a: Size, size_b: Size) -> list[float]:
    """Focal lengths (of a, of b) that H allows, in px; empty where it does not tell.

    With the principal points moved to the origin, K_b^-1 H K_a is a rotation times a number: its
    columns, and its rows, have equal lengths and right angles between them.
    """
    h = np.linalg.inv(camera_matrix(1, size_b)) @ b_from_a @ camera_matrix(1, size_a)
    h = h / np.cbrt(np.linalg.det(h))
    rows = _focal_squared(
        -(h[0, 0] * h[0, 1] + h[1, 0] * h[1, 1]),
        h[2, 0] * h[2, 1],
        h[0, 0] ** 2 + h[1, 0] ** 2 - h[0, 1] ** 2 - h[1, 1] ** 2,
        h[2, 1] ** 2 - h[2, 0] ** 2,
    )
    columns = _focal_squared(
        -h[0, 2] * h[1, 2],
        h[0, 0] * h[1, 0] + h[0, 1] * h[1, 1],
        h[1, 2] ** 2 - h[0, 2] ** 2,
        h[0, 0] ** 2 + h[0, 1] ** 2 - h[1, 0] ** 2 - h[1, 1] ** 2,
    )
    return [float(np.sqrt(value)) for value in (rows, columns) if value is not None]


def _focal_squared(top_1: float, under_1: float, top_2: float, under_2: float) -> float | None:
    """f^2 from f^2 under = top twice: by the better conditioned of the two, if it is positive."""
    tops = [top_1, top_2] if abs(under_1) > abs(under_2) else [top_2, top_1]
    unders = [under_1, under_2] if abs(under_1) > abs(under_2) else [under_2, under_1]
    for top, under in zip(tops, unders, strict=True):
        if abs(under) > 1e-12 and top / under > 0:
            return top / under
    return None


def rotation_between(b_from_a: Matrix, k_a: Matrix, k_b: Matrix) -> Matrix:
    """The rotation nearest to K_b^-1 H K_a (polar decomposition)."""
    m = np.linalg.inv(k_b) @ b_from_a @ k_a
    u, _, vt = np.linalg.svd(m / np.cbrt(np.linalg.det(m)))
    rotation: Matrix = u @ np.diag([1.0, 1.0, float(np.linalg.det(u @ vt))]) @ vt
    return rotation


def _starting_focal(links: Sequence[Link], sizes: Mapping[int, Size]) -> tuple[float, float]:
    """The common focal length in units of the longer side, and the median error it leaves, px.

    Candidates are what the homographies say, and a few fixed ones where they say nothing.
    """
    told: list[float] = []
    for link in links:
        assert link.b_from_a is not None
        found = focals_from_homography(link.b_from_a, sizes[link.a], sizes[link.b])
        told += [f / max(sizes[link.a]) for f in found]
    low, high = _FOCAL_RANGE
    candidates = [f for f in told if low <= f <= high]
    if candidates:
        candidates = [float(v) for v in np.quantile(candidates, [0.1, 0.3, 0.5, 0.7, 0.9])]
    candidates += [0.6, 0.9, 1.3, 2.0, 3.5, 7.0]
    looks = [_few_inliers(link) for link in links]
    misfits = [_median_misfit(focal, links, looks, sizes) for focal in candidates]
    best = int(np.argmin(misfits))
    return candidates[best], misfits[best]


def _few_inliers(link: Link) -> tuple[Points, Points]:
    """Some inliers of a, evenly chosen, and where the link's homography sees them in b."""
    assert link.b_from_a is not None
    points = link.a_points[link.registration.is_inlier]
    few = points[:: max(1, len(points) // _FEW_POINTS)]
    return few, geometry.transform_points(link.b_from_a, few)


def _median_misfit(
    focal: float,
    links: Sequence[Link],
    looks: Sequence[tuple[Points, Points]],
    sizes: Mapping[int, Size],
) -> float:
    errors = []
    for link, (points, seen) in zip(links, looks, strict=True):
        assert link.b_from_a is not None
        k_a = camera_matrix(focal * max(sizes[link.a]), sizes[link.a])
        k_b = camera_matrix(focal * max(sizes[link.b]), sizes[link.b])
        turned = k_b @ rotation_between(link.b_from_a, k_a, k_b) @ np.linalg.inv(k_a)
        error = geometry.transform_points(turned, points) - seen
        errors.append(median(np.linalg.norm(error, axis=1)))
    return float(np.median(errors))


# -- adjustment ---------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """Inlier pairs of one link about the pictures' centres, rows of the pictures it joins.

    ``tells_noise`` is False between a picture and its copy, which say nothing about a camera.
    """

    a: int
    b: int
    xy_a: Doubles
    xy_b: Doubles
    tells_noise: bool = True


def adjust_rotations(
    links: Sequence[Link], sizes: Mapping[int, Size], anchor: int
) -> Rotations | None:
    """Rotations and focal lengths that the links' inlier pairs agree with best.

    ``links`` must be accepted ones; pictures they do not connect with the anchor are left out.
    Returns None if the links cannot be those of a turning camera at all.
    """
    focal, misfit_px = _starting_focal(links, sizes)
    if misfit_px > _HOPELESS * max(max(size) for size in sizes.values()):
        return None
    rotations = _tree_rotations(links, sizes, anchor, focal)
    ids = sorted(rotations)
    row = {picture: i for i, picture in enumerate(ids)}
    used = [link for link in links if link.a in row and link.b in row]
    pairs = [_pairs_of(link, row, sizes) for link in used]
    scales = np.array([float(max(sizes[i])) for i in ids])
    state = _State(np.array([rotations[i] for i in ids]), np.log(focal), np.zeros(len(ids)))
    state, noise_px = _minimise(state, pairs, scales, row[anchor])
    if not _FOCAL_RANGE[0] < float(np.exp(state.log_focal)) < _FOCAL_RANGE[1]:
        return None
    focals = scales * np.exp(state.log_focal + state.deviations)
    errors = [_lengths(_residuals(state, scales, p)[0]) for p in pairs]
    joined = np.concatenate([errors[i] for i, p in enumerate(pairs) if p in _telling(pairs)])
    near = joined[joined < 3 * noise_px]
    medians = dict(zip(map(id, used), (median(e) for e in errors), strict=True))
    to_anchor = state.rotations[row[anchor]].T
    return Rotations(
        {picture: to_anchor @ state.rotations[i] for picture, i in row.items()},
        {picture: float(focals[i]) for picture, i in row.items()},
        {picture: sizes[picture] for picture in ids},
        anchor,
        float(np.sqrt(np.mean(near**2))) if len(near) else float("inf"),
        np.array([medians.get(id(link), np.nan) for link in links]),
    )


def _pairs_of(link: Link, row: Mapping[int, int], sizes: Mapping[int, Size]) -> _Pairs:
    inliers = np.flatnonzero(link.registration.is_inlier)
    kept = inliers[np.linspace(0, len(inliers) - 1, min(len(inliers), _MAX_PAIRS)).astype(int)]
    centre_a = (np.array(sizes[link.a]) - 1) / 2
    centre_b = (np.array(sizes[link.b]) - 1) / 2
    return _Pairs(
        row[link.a],
        row[link.b],
        link.a_points[kept].astype(np.float64) - centre_a,
        link.b_points[kept].astype(np.float64) - centre_b,
        not link.rmse_px < _COPY_PX,
    )


def _tree_rotations(
    links: Sequence[Link], sizes: Mapping[int, Size], anchor: int, focal: float
) -> dict[int, Matrix]:
    """world_from_camera by chaining links outwards from the anchor, best supported first."""
    found: dict[int, Matrix] = {anchor: np.eye(3)}
    ordered = sorted(links, key=lambda link: -link.registration.inliers)
    while True:
        for link in ordered:
            if (link.a in found) == (link.b in found):
                continue
            assert link.b_from_a is not None
            k_a = camera_matrix(focal * max(sizes[link.a]), sizes[link.a])
            k_b = camera_matrix(focal * max(sizes[link.b]), sizes[link.b])
            b_from_a = rotation_between(link.b_from_a, k_a, k_b)
            if link.a in found:
                found[link.b] = found[link.a] @ b_from_a.T
            else:
                found[link.a] = found[link.b] @ b_from_a
            break
        else:
            return found


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """``rotations`` (N, 3, 3) world_from_camera, the common log focal length, and each picture's
    deviation (N,) from it."""

    rotations: Doubles
    log_focal: float
    deviations: Doubles

    def moved(self, change: Doubles) -> _State:
        """``change``: three rotation angles a picture, then N deviations, then the common one."""
        count = len(self.deviations)
        angles = change[: 3 * count].reshape(count, 3)
        turns = np.array([_rotation(angle) for angle in angles])
        return _State(
            self.rotations @ turns,
            self.log_focal + float(change[-1]),
            self.deviations + change[3 * count : 4 * count],
        )


def _rotation(angle: Doubles) -> Matrix:
    """Rodrigues' formula."""
    theta = float(np.linalg.norm(angle))
    cross: Matrix = _cross(angle[None])[0]
    if theta < 1e-9:
        return np.asarray(np.eye(3) + cross, np.float64)
    turn: Matrix = (
        np.eye(3) + np.sin(theta) / theta * cross + (1 - np.cos(theta)) / theta**2 * (cross @ cross)
    )
    return turn


def _cross(v: Doubles) -> Doubles:
    """Matrices (M, 3, 3) of the cross product with v (M, 3)."""
    matrices = np.zeros((len(v), 3, 3))
    matrices[:, 0, 1], matrices[:, 0, 2], matrices[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    crosses: Doubles = matrices - matrices.transpose(0, 2, 1)
    return crosses


def _residuals(
    state: _State, scales: Doubles, pairs: _Pairs
) -> tuple[Doubles, Doubles, Doubles, Matrix, float]:
    """Transfer errors (M, 2) in b, the rays in a and in b's camera, the rotation, b's focal."""
    focals = scales * np.exp(state.log_focal + state.deviations)
    f_a, f_b = float(focals[pairs.a]), float(focals[pairs.b])
    rays_a = np.column_stack([pairs.xy_a / f_a, np.ones(len(pairs.xy_a))])
    b_from_a = state.rotations[pairs.b].T @ state.rotations[pairs.a]
    rays_b = rays_a @ b_from_a.T
    depth = np.maximum(rays_b[:, 2:], 1e-3)
    return f_b * rays_b[:, :2] / depth - pairs.xy_b, rays_a, rays_b, b_from_a, f_b


def _jacobian(rays_a: Doubles, rays_b: Doubles, b_from_a: Matrix, f_b: float) -> Doubles:
    """(2 M, 9): by the rotation of a (3) and of b (3), the log focals of a and b, both at once."""
    depth = np.maximum(rays_b[:, 2], 1e-3)
    projection = np.zeros((len(depth), 2, 3))
    projection[:, 0, 0] = projection[:, 1, 1] = f_b / depth
    projection[:, :, 2] = -f_b * rays_b[:, :2] / depth[:, None] ** 2
    jacobian = np.empty((len(depth), 2, 9))
    jacobian[:, :, 0:3] = projection @ (b_from_a @ -_cross(rays_a))
    jacobian[:, :, 3:6] = projection @ _cross(rays_b)
    shrunk = np.column_stack([-rays_a[:, :2], np.zeros(len(depth))]) @ b_from_a.T
    jacobian[:, :, 6] = np.einsum("mij,mj->mi", projection, shrunk)
    jacobian[:, :, 7] = f_b * rays_b[:, :2] / depth[:, None]
    jacobian[:, :, 8] = jacobian[:, :, 6] + jacobian[:, :, 7]
    return jacobian.reshape(-1, 9)


def _lengths(residuals: Doubles) -> Doubles:
    return np.asarray(np.hypot(residuals[:, 0], residuals[:, 1]), np.float64)


def _minimise(
    state: _State, pairs: Sequence[_Pairs], scales: Doubles, anchor: int
) -> tuple[_State, float]:
    """Levenberg-Marquardt; returns the state and the noise of its residuals, one axis, px."""
    damping, noise_px = 1e-3, 0.0
    cost = np.inf
    normal, gradient = np.zeros((1, 1)), np.zeros(1)
    for round_ in range(_ROUNDS):
        if np.isinf(cost):
            noise_px = _noise(state, scales, pairs)
            normal, gradient = _normal_equations(state, scales, pairs, noise_px, anchor)
            cost = _cost(state, scales, pairs, noise_px)
        diagonal = np.diag(np.diag(normal) * damping + 1e-12)
        change = np.asarray(np.linalg.solve(normal + diagonal, -gradient), np.float64)
        moved = state.moved(change)
        moved_cost = _cost(moved, scales, pairs, noise_px)
        if moved_cost < cost:
            gain = (cost - moved_cost) / cost
            state, damping, cost = moved, damping / 10, np.inf
            if gain < 1e-6 and round_ > 3:
                break
        else:
            damping *= 10
            if damping > 1e6:
                break
    return state, _noise(state, scales, pairs)


def _telling(pairs: Sequence[_Pairs]) -> Sequence[_Pairs]:
    """The pairs of two exposures; all of them where there are none but copies."""
    return [p for p in pairs if p.tells_noise] or pairs


def _noise(state: _State, scales: Doubles, pairs: Sequence[_Pairs]) -> float:
    """Standard deviation of one coordinate, from the median length of all residuals."""
    told = _telling(pairs)
    lengths = np.concatenate([_lengths(_residuals(state, scales, p)[0]) for p in told])
    return max(_MIN_NOISE_PX, median(lengths) / 1.1774)


def _cost(state: _State, scales: Doubles, pairs: Sequence[_Pairs], noise_px: float) -> float:
    """Geman & McClure's cost of all residuals, 3 times the noise as scale, and the prior's."""
    width = (3 * noise_px) ** 2
    total = float(np.sum((state.deviations / _FREE_FOCAL) ** 2)) * noise_px**2
    for p in pairs:
        squared = np.sum(_residuals(state, scales, p)[0] ** 2, axis=1)
        total += float(np.sum(width * squared / (width + squared)))
    return total


def _normal_equations(
    state: _State, scales: Doubles, pairs: Sequence[_Pairs], noise_px: float, anchor: int
) -> tuple[Doubles, Doubles]:
    count = len(scales)
    normal, gradient = np.zeros((4 * count + 1,) * 2), np.zeros(4 * count + 1)
    width = (3 * noise_px) ** 2
    for p in pairs:
        residual, rays_a, rays_b, b_from_a, f_b = _residuals(state, scales, p)
        jacobian = _jacobian(rays_a, rays_b, b_from_a, f_b)
        squared = np.sum(residual**2, axis=1)
        weights = np.repeat((width / (width + squared)) ** 2, 2)
        columns = np.concatenate(
            [
                3 * p.a + np.arange(3),
                3 * p.b + np.arange(3),
                [3 * count + p.a, 3 * count + p.b, 4 * count],
            ]
        )
        weighted = (jacobian * weights[:, None]).T
        normal[np.ix_(columns, columns)] += weighted @ jacobian
        gradient[columns] += weighted @ residual.reshape(-1)
    prior = (noise_px / _FREE_FOCAL) ** 2
    own = 3 * count + np.arange(count)
    normal[own, own] += prior
    gradient[own] += prior * state.deviations
    # The anchor does not turn: its rows and columns say "no change".
    held = 3 * anchor + np.arange(3)
    normal[held, :] = normal[:, held] = 0.0
    normal[held, held] = 1.0
    gradient[held] = 0.0
    return normal, gradient
