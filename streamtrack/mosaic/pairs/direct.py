"""A mapping made exact on the grey values themselves, edges and corners alike.

Efficient second-order minimisation (Malis 2004; Benhimane & Malis 2007): the Jacobian is that of
the mean gradient of both pictures, which converges faster than either alone and is not biased
towards the sharper. Residuals are weighted by Tukey's biweight; the gain between the pictures is
a plane fitted along (after Bartoli 2008). Where one picture is more blurred, the sharper one is
blurred until both agree best.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.fitting import median
from streamtrack.types import Image, Matrix, Model
from streamtrack.uncertainty import MODEL_BASES

Floats = npt.NDArray[np.float32]
Doubles = npt.NDArray[np.float64]

_PIXELS = 4000
_MIN_PIXELS = 200
_MIN_GRADIENT = 1.5
_HIGH_PASS_PX = 25
_ROUNDS = 4
_CONVERGED_PX = 0.01
_MAX_MOVE_PX = 6.0
_MAX_MOVE_SHARE = 0.02
_BLURS_PX = (0.8, 1.2, 1.8, 2.6, 3.6)
_MIN_BLUR_GAIN = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """``far_from_near`` on the grid of both renderings.

    ``corner_sigma_px`` is the standard deviation of the grid's worst corner, as the residuals
    tell it, ``pixels`` how many of them had a say.
    """

    far_from_near: Matrix
    corner_sigma_px: float
    pixels: int


def align(near: Image, far: Image, covered: Image, start: Matrix, model: Model) -> Alignment | None:
    """``start`` improved, None if there is too little to go by or the alignment runs away.

    ``near``, ``far`` (h, w) are renderings of two pictures on one grid, ``covered`` is not 0
    where both show something. ``start`` maps near's grid into far's and is good to about 2 px.
    """
    sharp_near, sharp_far = _smoothed(near), _smoothed(far)
    index = _informative(sharp_near, covered)
    if len(index) < _MIN_PIXELS:
        return None
    x, y = (index % near.shape[1]).astype(np.float64), (index // near.shape[1]).astype(np.float64)
    points = np.stack([x, y], axis=1)
    near_detail, far_detail = _equally_blurred(sharp_near, sharp_far, covered, index, points, start)
    return _minimised(near_detail, far_detail, index, points, start, model)


def _minimised(
    near: Floats,
    far: Floats,
    index: npt.NDArray[np.intp],
    points: Doubles,
    start: Matrix,
    model: Model,
) -> Alignment | None:
    height, width = near.shape
    unit = 2.0 / max(width, height)
    unit_from_grid = np.array(
        [[unit, 0, -unit * (width - 1) / 2], [0, unit, -unit * (height - 1) / 2], [0, 0, 1]]
    )
    grid_from_unit = geometry.inverted(unit_from_grid)
    u, v = (points * unit + unit_from_grid[:2, 2]).astype(np.float32).T
    near_gx, near_gy = _gradients(near)
    values, gx0, gy0 = (picture.ravel()[index] for picture in (near, near_gx, near_gy))
    far_planes = np.asarray(cv2.merge([far, *_gradients(far)]), np.float32)
    basis = MODEL_BASES[model].astype(np.float32)
    corners = geometry.image_quad((width, height))
    plane = np.stack([np.ones_like(u), u, v], axis=1)
    pose, moved_px = start, 0.0
    inverse, variance, used = np.zeros((0, 0)), 0.0, 0.0
    for _ in range(_ROUNDS):
        sampled, inside = _sampled(far_planes, pose, points)
        # The far gradient is taken in far's own axes: near enough, as the renderings agree
        # to a few pixels.
        seen, gx1, gy1 = (np.ascontiguousarray(column) for column in sampled.T)
        if np.count_nonzero(inside) < _MIN_PIXELS:
            return None
        gain = _gain(plane, seen, values, inside)
        residual = gain * seen - values
        noise = 1.4826 * median(np.abs(residual[inside])) + 0.3
        weights = np.maximum(0, 1 - (residual / np.float32(4.685 * noise)) ** 2) ** 2 * inside
        jacobian = _jacobian((gx0 + gain * gx1) / (2 * unit), (gy0 + gain * gy1) / (2 * unit), u, v)
        jacobian = jacobian @ basis
        weighted = jacobian * weights[:, None]
        normal = (weighted.T @ jacobian).astype(np.float64)
        normal[np.diag_indices(len(normal))] *= 1 + 1e-6
        try:
            inverse = np.linalg.inv(normal)
        except np.linalg.LinAlgError:
            return None
        used = max(float(np.sum(weights)), 1.0)
        variance = float(np.sum(weights * residual**2)) / used
        step = inverse @ (weighted.T @ residual).astype(np.float64)
        unit_step = np.eye(3) - np.append(basis @ step, 0.0).reshape(3, 3)
        grid_step = grid_from_unit @ unit_step @ unit_from_grid
        change_px = float(np.max(np.abs(geometry.transform_points(grid_step, corners) - corners)))
        moved_px += change_px
        if not moved_px < _MAX_MOVE_PX + _MAX_MOVE_SHARE * max(width, height):
            return None
        pose = geometry.normalized(pose @ grid_step)
        if change_px < _CONVERGED_PX:
            break
    return Alignment(pose, _corner_sigma(inverse * variance, basis, unit), round(used))


def _corner_sigma(covariance: Doubles, basis: Floats, unit: float) -> float:
    """Largest standard deviation, in pixels, of where the corners (+-1, +-1) come to lie."""
    worst = 0.0
    for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
        rows = np.array([[x, y, 1, 0, 0, 0, -x * x, -x * y], [0, 0, 0, x, y, 1, -x * y, -y * y]])
        spread = rows @ basis @ covariance @ basis.T @ rows.T
        worst = max(worst, float(np.trace(spread)))
    return float(np.sqrt(max(worst, 0.0))) / unit


def _gain(plane: Floats, seen: Floats, values: Floats, inside: npt.NDArray[np.bool_]) -> Floats:
    """Gain (N,) as a plane over the picture that brings what is seen to the values."""
    rows = plane[inside] * seen[inside, None]
    target = values[inside]
    base = (median(np.abs(target)) + 0.5) / (median(np.abs(seen[inside])) + 0.5)
    residual = np.float32(base) * seen[inside] - target
    scale = np.float32(4.685 * 1.4826 * median(np.abs(residual)) + 1.0)
    weighted = rows * (np.maximum(0, 1 - (residual / scale) ** 2) ** 2)[:, None]
    normal = (weighted.T @ rows).astype(np.float64)
    normal[np.diag_indices(3)] *= 1 + 1e-3
    try:
        solved = np.linalg.solve(normal, (weighted.T @ target).astype(np.float64))
    except np.linalg.LinAlgError:
        return np.full(len(plane), base, np.float32)
    gain = np.clip(plane @ solved.astype(np.float32), 0.2 * base, 5 * base)
    return np.asarray(gain, np.float32)


def _smoothed(image: Image) -> Floats:
    """Slightly smoothed grey values, so that noise does not make gradients."""
    return np.asarray(cv2.GaussianBlur(image, (3, 3), 0.8), np.float32)


def _detail(values: Floats, seen: Floats, seen_around: Floats) -> Floats:
    """The values minus their local mean, over what is seen (1, else 0) of the surroundings."""
    window = (_HIGH_PASS_PX, _HIGH_PASS_PX)
    return np.asarray(values - cv2.blur(values * seen, window) / seen_around, np.float32)


def _gradients(values: Floats) -> tuple[Floats, Floats]:
    gx = np.asarray(cv2.Sobel(values, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8), np.float32)
    gy = np.asarray(cv2.Sobel(values, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8), np.float32)
    return gx, gy


def _informative(values: Floats, covered: Image) -> npt.NDArray[np.intp]:
    """Places of the strongest gradients, each judged against its surroundings."""
    gx, gy = _gradients(values)
    strength = np.asarray(cv2.magnitude(gx, gy), np.float32)
    strength[covered == 0] = 0
    worth = strength / np.sqrt(cv2.blur(strength, (31, 31)) + np.float32(1))
    flat = worth.ravel()
    count = min(_PIXELS, len(flat) - 1)
    index = np.argpartition(-flat, count)[:count]
    return np.sort(index[strength.ravel()[index] > _MIN_GRADIENT])


def _equally_blurred(
    near: Floats,
    far: Floats,
    covered: Image,
    index: npt.NDArray[np.intp],
    points: Doubles,
    pose: Matrix,
) -> tuple[Floats, Floats]:
    """The detail of both, the sharper one blurred so that they correlate best."""
    seen = (covered > 0).astype(np.float32)
    around = cv2.blur(seen, (_HIGH_PASS_PX, _HIGH_PASS_PX)) + np.float32(1e-3)
    details = [_detail(near, seen, around), _detail(far, seen, around)]

    def likeness(pair: list[Floats]) -> float:
        seen, inside = _sampled(pair[1], pose, points)
        return _correlation(pair[0].ravel()[index][inside], seen[inside, 0])

    best = likeness(details)
    for side, sharp in enumerate((near, far)):
        improved = False
        for sigma in _BLURS_PX:
            blurred = cv2.GaussianBlur(sharp, (0, 0), sigma)
            trial = [*details]
            trial[side] = _detail(np.asarray(blurred, np.float32), seen, around)
            reached = likeness(trial)
            if reached < best + _MIN_BLUR_GAIN:
                break
            best, details, improved = reached, trial, True
        if improved:
            break
    return details[0], details[1]


def _sampled(
    picture: Floats, pose: Matrix, points: Doubles
) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """The picture's channels (N, C) where ``pose`` takes the points, and which lie inside it."""
    there = geometry.transform_points(pose, points)
    height, width = picture.shape[:2]
    inside = (
        (there[:, 0] >= 1)
        & (there[:, 1] >= 1)
        & (there[:, 0] <= width - 2)
        & (there[:, 1] <= height - 2)
    )
    # remap takes pictures of less than 32768 columns, so the points are laid out in rows.
    x, y = (np.ascontiguousarray(there[:, axis]).reshape(-1, 1) for axis in (0, 1))
    values = cv2.remap(picture, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, np.float32).reshape(len(points), -1), inside


def _correlation(a: Floats, b: Floats) -> float:
    if len(a) < 2:
        return float("nan")
    a0, b0 = a - np.mean(a), b - np.mean(b)
    scale = float(np.sqrt(float(a0 @ a0) * float(b0 @ b0)))
    return float(a0 @ b0) / scale if scale > 0 else float("nan")


def _jacobian(gx: Floats, gy: Floats, x: Floats, y: Floats) -> Floats:
    """Gradient times the derivative of a homography at the identity (Baker & Matthews, eq. 99)."""
    radial = gx * x + gy * y
    return np.stack(
        [gx * x, gx * y, gx, gy * x, gy * y, gy, -x * radial, -y * radial], axis=1
    ).astype(np.float32)
