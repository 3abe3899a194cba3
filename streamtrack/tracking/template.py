"""The picture of a target as it was first given: patches at several scales, and features."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.errors import TargetError
from streamtrack.features import FeatureExtractor
from streamtrack.pyramid import Pyramid
from streamtrack.tracking.blur import smeared_along
from streamtrack.tracking.refine import Gradients, changed_gradients, make_gradients
from streamtrack.types import Features, Image, Mask, Matrix, Points, Size

PATCH_AREA_PX = 36_000
"""Area of the finest patch: more costs time and gains no accuracy."""
CORRELATION_WINDOW = 11
"""Patch pixels."""
_MAX_ENLARGEMENT = 2.0
_SCALE_STEP = 2**-0.5
_MOST_SCALES = 12
_PASSING_SCALES = 3
_MIN_PATCH_SIDE_PX = 28
_FLOW_POINTS = 260
MIN_FLOW_POINTS = 12
_FEW_POINTS = 25
_EDGE_PX = 9
_MARGIN_SHARE = 0.06
_MIN_GRADIENT = 2.0
"""Grey levels per pixel in the weaker direction; noise of sigma 3 gives about 1.3."""
_LEAST_STIFFNESS = 1e-3
_FEATURE_BORDER_PX = 48
_SURROUNDINGS_SHARE = 0.03


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """Mean and variance of the grey values around each pixel, float32 (h, w)."""

    mean: npt.NDArray[np.float32]
    variance: npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """The target at one scale.

    image                the upright patch (h, w) with a margin around the target
    patch_from_template  template pixels to patch pixels: a shift and a scale
    scale                patch pixels per template pixel
    points               float32 (N, 2) textured places inside the target, patch pixels
    template_points      the same places in template pixels
    gradients            the pixels on which a pose is refined
    nearest_point        int (gradient pixels,), row of the point nearest to each of them
    windows              what the image's correlation with another needs of it
    softness             float32 (N, 2, 2), by how much each point's window is off per grey value:
                         the inverse of its mean structure tensor
    template_from_patch  the inverse of patch_from_template
    middle               float64 (2,), the patch's centre in template pixels
    """

    image: Image
    patch_from_template: Matrix
    scale: float
    points: Points
    template_points: Points
    gradients: Gradients
    nearest_point: npt.NDArray[np.intp]
    windows: Windows
    softness: npt.NDArray[np.float32]
    template_from_patch: Matrix
    middle: npt.NDArray[np.float64]

    @property
    def size_wh(self) -> Size:
        return self.image.shape[1], self.image.shape[0]

    def smeared(self, vector: npt.NDArray[np.float64]) -> Patch:
        """The patch under a motion blur ``vector`` (2,), in patch pixels."""
        image = smeared_along(self.image, vector)
        gradients = changed_gradients(self.gradients, image)
        softness = _softness(gradients, self.points)
        return replace(
            self, image=image, gradients=gradients, windows=_windows(image), softness=softness
        )

    def frame_px(self, frame_from_template: Matrix) -> float:
        """Frame pixels that one pixel of the patch is wide at its centre."""
        return geometry.local_scale(frame_from_template, self.middle) / self.scale


@dataclass(frozen=True, slots=True, eq=False)
class Template:
    """A target's quad (4, 2) in the picture it was given in, with all that is matched to it."""

    name: str
    picture: Image
    quad: Points
    patches: tuple[Patch, ...]
    features: Features

    @property
    def centre(self) -> npt.NDArray[np.float32]:
        """Mean of the corners (2,)."""
        (ax, ay), (bx, by), (cx, cy), (dx, dy) = self.quad.tolist()
        return np.array([(ax + bx + cx + dx) / 4, (ay + by + cy + dy) / 4], np.float32)


def make_template(name: str, picture: Image, quad: Points, extractor: FeatureExtractor) -> Template:
    """The template of ``quad`` in ``picture`` (BGR or grey).

    Raises TargetError if there is too little texture to follow it.
    """
    grey = geometry.grey_of(picture)
    patches = make_patches(grey, quad)
    if not patches or len(patches[0].points) < MIN_FLOW_POINTS:
        found = len(patches[0].points) if patches else 0
        raise TargetError(
            f"target '{name}' has too little texture: {found} textured spots, "
            f"{MIN_FLOW_POINTS} needed; choose a larger or more structured region"
        )
    features = _features_inside(grey, quad, extractor)
    return Template(name, picture, quad, patches, features)


def make_patches(grey: Image, quad: Points) -> tuple[Patch, ...]:
    """The target inside ``quad`` of a grey picture (H, W) at all its scales, finest first."""
    return _patches(Pyramid(grey), quad, None, _MAX_ENLARGEMENT, _MOST_SCALES)


def make_passing_patches(pyramid: Pyramid, quad: Points, shown: Points) -> tuple[Patch, ...]:
    """The same at the few scales needed as long as the target's size hardly changes.

    Only the surroundings of ``shown`` (N, 2) are compared.
    """
    return _patches(pyramid, quad, shown, 1.0, _PASSING_SCALES)


def _patches(
    pyramid: Pyramid, quad: Points, shown: Points | None, finest: float, most: int
) -> tuple[Patch, ...]:
    x0, y0, x1, y1 = geometry.bounding_box(quad)
    margin = max(2.0, _MARGIN_SHARE * max(x1 - x0, y1 - y0))
    x0, y0, x1, y1 = x0 - margin, y0 - margin, x1 + margin, y1 + margin
    finest = min(finest, (PATCH_AREA_PX / ((x1 - x0) * (y1 - y0))) ** 0.5)
    patches: list[Patch] = []
    for step in range(most):
        scale = finest * _SCALE_STEP**step
        size = round((x1 - x0) * scale), round((y1 - y0) * scale)
        if min(size) < _MIN_PATCH_SIDE_PX and patches:
            break
        size = max(size[0], 12), max(size[1], 12)
        patches.append(_make_patch(pyramid, quad, shown, (x0, y0), scale, size))
    return tuple(patches)


def _make_patch(
    pyramid: Pyramid,
    quad: Points,
    shown: Points | None,
    corner: tuple[float, float],
    scale: float,
    size: tuple[int, int],
) -> Patch:
    patch_from_template = geometry.scaling(scale) @ geometry.translation(-corner[0], -corner[1])
    template_from_patch = geometry.inverted(patch_from_template)
    image = pyramid.warped(template_from_patch, size)
    inside = _polygon_mask(geometry.transform_points(patch_from_template, quad), size)
    if shown is not None:
        inside &= _surroundings(geometry.transform_points(patch_from_template, shown), size)
    # What lies beyond the target's edge changes as it moves, so points keep away from it.
    kernel = np.ones((_EDGE_PX, _EDGE_PX), np.uint8)
    interior = cv2.erode(inside.astype(np.uint8), kernel) > 0
    points = _textured_points(image, interior)
    if len(points) < _FEW_POINTS:
        points = _textured_points(image, inside)
    gradients = make_gradients(image, inside)
    return Patch(
        image,
        patch_from_template,
        scale,
        points,
        geometry.transform_points(template_from_patch, points),
        gradients,
        _nearest_rows(points, gradients.index, size),
        _windows(image),
        _softness(gradients, points),
        template_from_patch,
        geometry.transform_points(template_from_patch, [[size[0] / 2, size[1] / 2]])[0],
    )


def _windows(image: Image) -> Windows:
    window = (CORRELATION_WINDOW, CORRELATION_WINDOW)
    mean = np.asarray(cv2.boxFilter(image, cv2.CV_32F, window), np.float32)
    square = np.asarray(cv2.sqrBoxFilter(image, cv2.CV_32F, window), np.float32)
    return Windows(mean, square - mean * mean)


def _softness(gradients: Gradients, points: Points) -> npt.NDArray[np.float32]:
    columns, rows = points.astype(np.intp).T
    gx, gy = gradients.gx, gradients.gy
    xx, xy, yy = (window_means(a * b)[rows, columns] for a, b in ((gx, gx), (gx, gy), (gy, gy)))
    determinant = np.maximum(xx * yy - xy * xy, _LEAST_STIFFNESS)
    inverse = np.stack([yy, -xy, -xy, xx], axis=1) / determinant[:, None]
    return np.asarray(inverse.reshape(-1, 2, 2), np.float32)


def window_means(values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Mean (h, w) of the values in the window around each pixel."""
    window = (CORRELATION_WINDOW, CORRELATION_WINDOW)
    return np.asarray(cv2.boxFilter(values, cv2.CV_32F, window), np.float32)


def _nearest_rows(points: Points, index: npt.NDArray[np.intp], size: Size) -> npt.NDArray[np.intp]:
    """Row of the point nearest to each pixel, given as a place in the flattened patch."""
    if len(points) == 0:
        return np.zeros(0, np.intp)
    columns, lines = points.astype(np.intp).T
    is_elsewhere = np.ones((size[1], size[0]), np.uint8)
    is_elsewhere[lines, columns] = 0
    _, labels = cv2.distanceTransformWithLabels(
        is_elsewhere, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    row_of_label = np.zeros(int(np.max(labels)) + 1, np.intp)
    row_of_label[labels[lines, columns]] = np.arange(len(points))
    nearest: npt.NDArray[np.intp] = row_of_label[labels.ravel()[index]]
    return nearest


def _surroundings(points: Points, size: Size) -> Mask:
    """Within `_SURROUNDINGS_SHARE` of the patch's longer side from any of the points."""
    columns, lines = np.rint(points).astype(np.intp).T
    is_in = (columns >= 0) & (lines >= 0) & (columns < size[0]) & (lines < size[1])
    near = np.zeros((size[1], size[0]), np.uint8)
    near[lines[is_in], columns[is_in]] = 1
    reach = 2 * round(_SURROUNDINGS_SHARE * max(size)) + 1
    around: Mask = cv2.dilate(near, np.ones((reach, reach), np.uint8)) > 0
    return around


def _polygon_mask(polygon: Points, size: tuple[int, int]) -> Mask:
    mask = np.zeros((size[1], size[0]), np.uint8)
    cv2.fillConvexPoly(mask, np.rint(polygon).astype(np.int32), 1)
    inside: Mask = mask > 0
    return inside


def smallest_gradient(image: Image) -> npt.NDArray[np.float32]:
    """Root of the structure tensor's smaller eigenvalue over 7x7, grey levels per pixel (h, w).

    It is what a shift changes in the direction in which it changes least, and so how well a
    place can be located (Shi & Tomasi 1994).
    """
    eigenvalue = np.asarray(cv2.cornerMinEigenVal(image, 7, ksize=3), np.float32)
    # OpenCV divides 8-bit Sobel responses (gain 8) by 4 * 255 * block and sums block^2 of them.
    gradient = np.sqrt(np.maximum(eigenvalue, 0)) * np.float32(4 * 255 / 8)
    return np.asarray(gradient, np.float32)


def _textured_points(image: Image, inside: Mask) -> Points:
    """The most textured pixel of every grid cell inside the target, where there is texture."""
    strength = np.where(inside, smallest_gradient(image), 0)
    cell = max(3, int(np.sqrt(np.count_nonzero(inside) / _FLOW_POINTS)))
    rows, columns = -(-image.shape[0] // cell), -(-image.shape[1] // cell)
    padded = np.zeros((rows * cell, columns * cell), np.float32)
    padded[: image.shape[0], : image.shape[1]] = strength
    cells = padded.reshape(rows, cell, columns, cell).swapaxes(1, 2).reshape(rows * columns, -1)
    best = cells.argmax(axis=1)
    textured = np.flatnonzero(cells.max(axis=1) >= _MIN_GRADIENT)
    y = (textured // columns) * cell + best[textured] // cell
    x = (textured % columns) * cell + best[textured] % cell
    points: Points = np.stack([x, y], axis=1).astype(np.float32)
    return points


def _features_inside(grey: Image, quad: Points, extractor: FeatureExtractor) -> Features:
    """Features inside the quad; the surroundings are kept so that descriptors see them."""
    x0, y0, x1, y1 = (round(v) for v in geometry.bounding_box(quad))
    border = _FEATURE_BORDER_PX
    padded = cv2.copyMakeBorder(grey, border, border, border, border, cv2.BORDER_REPLICATE)
    height, width = grey.shape
    left, right = max(0, x0), min(width, x1 + 1) + 2 * border
    top, bottom = max(0, y0), min(height, y1 + 1) + 2 * border
    crop = np.ascontiguousarray(padded[top:bottom, left:right], np.uint8)
    offset = np.array([left - border, top - border], np.float32)
    mask = _polygon_mask(quad - offset, (crop.shape[1], crop.shape[0])).astype(np.uint8)
    found = extractor.extract(crop, mask)
    return Features(found.points + offset, found.sizes, found.responses, found.descriptors)
