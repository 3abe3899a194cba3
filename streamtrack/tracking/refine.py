"""Sub-pixel refinement of a pose on the grey values themselves.

Inverse compositional alignment (Baker & Matthews 2004, section 3.2) of the frame, warped back by
the pose, with the template's patch: the Jacobian belongs to the template and is computed once.
Both pictures are high-pass filtered, so that light that changes smoothly over the target drops
out, and residuals are weighted by Tukey's biweight, so that occluders and highlights do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.fitting import solved, step_matrix
from streamtrack.geometry import (
    image_quad,
    inverted,
    largest_shift,
    local_scale,
    normalized,
    transform_points,
)
from streamtrack.pyramid import high_passed
from streamtrack.types import Image, Mask, Matrix, Model, Points
from streamtrack.uncertainty import MODEL_BASES, motion_rows

Floats = npt.NDArray[np.float32]
Doubles = npt.NDArray[np.float64]


_PIXELS = 3500
_MIN_PIXELS = 150
_MIN_GRADIENT = 1.0
_HIGH_PASS_PX = 17
_ROUNDS = 4
_CONVERGED_PX = 0.04  # patch pixels
_MAX_MOVE_SHARE = 0.1
_SAMPLE_STEP = 4


@dataclass(frozen=True, slots=True, eq=False)
class Gradients:
    """A patch's most informative pixels.

    index            int (N,), places in the flattened patch
    values           float32 (N,), high-passed grey values there
    jacobian         float32 (8, N), change of a value with each parameter of a homography
    unit_from_patch  the coordinates in which those parameters are well scaled
    smooth, gx, gy   float32 (h, w), the high-passed patch and its derivatives a pixel
    """

    index: npt.NDArray[np.intp]
    values: Floats
    jacobian: Floats
    unit_from_patch: Matrix
    smooth: Floats
    gx: Floats
    gy: Floats


def make_gradients(image: Image, inside: Mask) -> Gradients:
    """The pixels of a patch (h, w) with the strongest gradients, from every part of it."""
    smooth, gx, gy = _derivatives(image)
    return _gradients_at(_informative(np.hypot(gx, gy), inside), smooth, gx, gy)


def changed_gradients(gradients: Gradients, image: Image) -> Gradients:
    """The same pixels of a patch whose grey values (h, w) have changed."""
    return _gradients_at(gradients.index, *_derivatives(image))


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Where motion says the target's corners (4, 2) are, seen through ``frame_from_template``.

    ``sigma_px`` is how far from there, in frame pixels, they usually turn out to be. It hardly
    counts where grey values tell, and decides where they do not: at corners that are hidden.
    """

    pose: Matrix
    corners: Points
    sigma_px: float

    def against(self, trust: float) -> Prior:
        """The prior as it stands against evidence of which only a share ``trust`` is undisputed."""
        return replace(self, sigma_px=self.sigma_px * trust)


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """A refined pose (frame_from_template), and the last look at the frame that led to it.

    seen_through  the pose that was looked through
    seen          (h, w), the frame as the patch sees it through that
    smooth        float32 (h, w), the same high-passed
    """

    pose: Matrix
    seen_through: Matrix
    seen: Image
    smooth: Floats


def refined(
    warp_back: Callable[[Matrix], Image],
    pose: Matrix,
    patch_from_template: Matrix,
    gradients: Gradients,
    support: Mask,
    model: Model,
    prior: Prior | None,
    converged_px: float = _CONVERGED_PX,
) -> Refinement | None:
    """``pose`` (frame_from_template) moved to where the grey values fit best, or None.

    ``warp_back`` gives the frame as the patch (h, w) would see it through a pose, ``support``
    (N,) tells which of the gradients' pixels show the target. None if there are too few of
    them, or if the alignment runs away: the caller then keeps what it has. A step that moves no
    corner of the patch by ``converged_px`` is the last.
    """
    if np.count_nonzero(support) < _MIN_PIXELS:
        return None
    index, values, jacobian = gradients.index, gradients.values, gradients.jacobian
    if not support.all():
        rows = np.flatnonzero(support)
        index, values, jacobian = index[rows], values[rows], jacobian.take(rows, axis=1)
    basis = MODEL_BASES[model]
    if model is not Model.HOMOGRAPHY:
        jacobian = basis.T.astype(np.float32) @ jacobian
    unit_from_patch = gradients.unit_from_patch
    patch_from_unit = inverted(unit_from_patch)
    template_from_patch = inverted(patch_from_template)
    expected = _expectation(prior, pose, unit_from_patch @ patch_from_template) if prior else None
    contrast = _median_size(values)
    moved_px = 0.0
    for left in reversed(range(_ROUNDS)):
        seen_through, image = pose, warp_back(pose)
        smooth = high_passed(image, _HIGH_PASS_PX)
        seen = smooth.ravel().take(index)
        normal, gradient = _normal_equations(jacobian, values, contrast, seen)
        if expected is not None:
            normal = normal + basis.T @ expected.normal @ basis
            gradient = gradient + basis.T @ expected.gradient(pose)
        step = solved(normal, gradient)
        if step is None:
            return None
        unit_step = step_matrix(basis @ step)
        patch_step = patch_from_unit @ unit_step @ unit_from_patch
        change_px = largest_shift(patch_step, image_quad((image.shape[1], image.shape[0])))
        moved_px += change_px
        if not moved_px < _MAX_MOVE_SHARE * max(image.shape):
            return None
        pose = pose @ template_from_patch @ inverted(patch_step) @ patch_from_template
        if change_px < converged_px or not left:
            return Refinement(normalized(pose), seen_through, image, smooth)
    return None


def contrast_gain(contrast: float, seen: Floats) -> np.float32:
    """What the high-passed values ``seen`` are to be multiplied by, to be like the template's."""
    gain = (contrast + 1) / (_median_size(seen) + 1)
    return np.float32(min(3.0, max(0.4, gain)))


def _normal_equations(
    jacobian: Floats, values: Floats, contrast: float, seen: Floats
) -> tuple[Doubles, Doubles]:
    """Information matrix and vector of the warp that takes the template's values to those seen."""
    residual = contrast_gain(contrast, seen) * seen - values
    noise = 1.4826 * _median_size(residual) + 1.0
    weights = 1 - (residual * np.float32(1 / (4.685 * noise))) ** 2
    np.maximum(weights, 0, out=weights)
    weights *= weights
    weights *= np.float32(1 / noise**2)
    weighted = jacobian * weights
    normal = (weighted @ jacobian.T).astype(np.float64)
    normal[np.diag_indices(len(normal))] *= 1 + 1e-6
    return normal, (weighted @ residual).astype(np.float64)


def _median_size(values: Floats) -> float:
    """Median of the absolute values, from every fourth of them."""
    sizes = np.abs(values[::_SAMPLE_STEP])
    middle = len(sizes) // 2
    return float(np.partition(sizes, middle)[middle])


@dataclass(frozen=True, slots=True, eq=False)
class _Expectation:
    """What the expected corners add to the information, in unit coordinates.

    The step's inverse is applied to the pose, so it should take each corner's expected place,
    seen through the pose, to the corner itself.
    """

    corners: Doubles
    template_corners: Points
    rows: Doubles
    normal: Doubles
    weight: float
    expected_pose: Matrix
    unit_from_template: Matrix

    def gradient(self, pose: Matrix) -> Doubles:
        unit_from_frame = self.unit_from_template @ inverted(pose)
        seen = transform_points(unit_from_frame @ self.expected_pose, self.template_corners)
        wanted = (self.corners - seen).ravel() * self.weight
        gradient: Doubles = self.rows.T @ wanted
        return gradient


def _expectation(prior: Prior, pose: Matrix, unit_from_template: Matrix) -> _Expectation:
    corners = transform_points(unit_from_template, prior.corners).astype(np.float64)
    frame_px = local_scale(pose @ inverted(unit_from_template), corners.mean(axis=0))
    weight = frame_px / prior.sigma_px
    rows = motion_rows(corners) * weight
    return _Expectation(
        corners, prior.corners, rows, rows.T @ rows, weight, prior.pose, unit_from_template
    )


def _derivatives(image: Image) -> tuple[Floats, Floats, Floats]:
    """The high-passed values (h, w) and their derivatives a pixel along x and y."""
    smooth = high_passed(image, _HIGH_PASS_PX)
    gx = np.asarray(cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8), np.float32)
    gy = np.asarray(cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8), np.float32)
    return smooth, gx, gy


def _gradients_at(index: npt.NDArray[np.intp], smooth: Floats, gx: Floats, gy: Floats) -> Gradients:
    height, width = smooth.shape
    unit = 2.0 / max(width, height)
    unit_from_patch = np.array(
        [[unit, 0, -unit * (width - 1) / 2], [0, unit, -unit * (height - 1) / 2], [0, 0, 1]]
    )
    x = (index % width) * unit + unit_from_patch[0, 2]
    y = (index // width) * unit + unit_from_patch[1, 2]
    return Gradients(
        index,
        smooth.ravel()[index],
        _jacobian(gx.ravel()[index] / unit, gy.ravel()[index] / unit, x, y),
        unit_from_patch,
        smooth,
        gx,
        gy,
    )


def _informative(strength: Floats, inside: Mask) -> npt.NDArray[np.intp]:
    """Places of the strongest gradients, each judged against its surroundings."""
    strength = np.where(inside, strength, np.float32(0))
    around = cv2.blur(strength, (31, 31)) + 1.0
    against_surroundings = (strength / np.sqrt(around)).ravel()
    best = np.arange(strength.size)
    if strength.size > _PIXELS:
        best = np.sort(np.argpartition(-against_surroundings, _PIXELS)[:_PIXELS])
    return best[strength.ravel()[best] > _MIN_GRADIENT]


def _jacobian(
    gx: Floats, gy: Floats, x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]
) -> Floats:
    """Gradient times the derivative of a homography at the identity (Baker & Matthews, eq. 99)."""
    radial = gx * x + gy * y
    rows: list[npt.NDArray[np.floating[Any]]] = [
        *(gx * x, gx * y, gx, gy * x, gy * y, gy),
        *(-x * radial, -y * radial),
    ]
    return np.stack(rows).astype(np.float32)
