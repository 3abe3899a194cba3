"""The gate that a mapping between two pictures has to pass: better refused than wrong."""

from __future__ import annotations

import cv2
import numpy as np

from streamtrack import geometry
from streamtrack.mosaic.pairs.agreement import Agreement
from streamtrack.types import Mask, Matrix, Model, Points, Size, Verdict
from streamtrack.uncertainty import corner_sigmas_px

_MIN_SUPPORT = 12
_MIN_SUPPORT_SHARE = 0.2
_MIN_SPREAD_SHARE = 0.1
_MIN_OVERLAP_SHARE = 0.02
_MAX_AREA_RATIO = 60.0
_MAX_PERSPECTIVE_RATIO = 100.0
_MIN_TILES = 6
_MIN_ALIKE = 0.18
_MIN_DETAIL = 0.12
_MAX_SIGMA_SHARE = 0.03
_LEAST_SIGMA_PX = 0.01


def judge_link(
    b_from_a: Matrix,
    model: Model,
    a_wh: Size,
    b_wh: Size,
    points: tuple[Points, Points],
    is_inlier: Mask,
    agreement: Agreement,
) -> Verdict:
    """OK, or the first reason to doubt that ``b_from_a`` is right.

    ``points`` are the pairs (M, 2) that corners were followed by, ``is_inlier`` (M,) which agree.
    """
    inliers = int(np.count_nonzero(is_inlier))
    if inliers < _MIN_SUPPORT or inliers < _MIN_SUPPORT_SHARE * len(is_inlier):
        return Verdict.TOO_FEW_INLIERS
    verdict = _judge_shape(b_from_a, a_wh, b_wh)
    if verdict is not Verdict.OK:
        return verdict
    a_points, b_points = (side[is_inlier] for side in points)
    if _spread_share(b_from_a, a_points, a_wh, b_wh) < _MIN_SPREAD_SHARE:
        return Verdict.NOT_SPREAD
    if (
        agreement.tiles < _MIN_TILES
        or agreement.alike < _MIN_ALIKE
        or agreement.detail < _MIN_DETAIL
    ):
        return Verdict.LOW_CORRELATION
    corners = geometry.image_quad(a_wh)
    sigmas_px = corner_sigmas_px(b_from_a, model, a_points, b_points, corners, _LEAST_SIGMA_PX)
    if not np.max(sigmas_px) <= _MAX_SIGMA_SHARE * max(b_wh):
        return Verdict.UNCERTAIN
    return Verdict.OK


def overlap_in(b_from_a: Matrix, a_wh: Size, b_wh: Size) -> Points:
    """The upright box (4, 2) around what both pictures show, in pixels of a; empty if nothing."""
    try:
        seen = geometry.transform_points(geometry.inverted(b_from_a), geometry.image_quad(b_wh))
    except np.linalg.LinAlgError:
        return np.zeros((0, 2), np.float32)
    x0, y0, x1, y1 = geometry.bounding_box(seen)
    x0, y0 = max(x0, 0.0), max(y0, 0.0)
    x1, y1 = min(x1, a_wh[0] - 1.0), min(y1, a_wh[1] - 1.0)
    if not (x1 > x0 and y1 > y0):
        return np.zeros((0, 2), np.float32)
    return geometry.box_quad(x0, y0, x1 - x0, y1 - y0)


def _judge_shape(b_from_a: Matrix, a_wh: Size, b_wh: Size) -> Verdict:
    """Could two pictures of one plane lie so? Strictly where they overlap, mildly elsewhere."""
    whole = geometry.image_quad(a_wh)
    depths = geometry.projective_depths(b_from_a, whole)
    if not np.isfinite(b_from_a).all() or not (np.all(depths > 0) or np.all(depths < 0)):
        return Verdict.MIRRORED
    magnification = np.abs(depths) ** -3
    if np.max(magnification) > _MAX_PERSPECTIVE_RATIO * np.min(magnification):
        return Verdict.PERSPECTIVE
    shared = overlap_in(b_from_a, a_wh, b_wh)
    if len(shared) == 0:
        return Verdict.NOT_SPREAD
    quad = geometry.transform_points(b_from_a, whole)
    if geometry.signed_area(quad) <= 0:
        return Verdict.MIRRORED
    share = geometry.clipped_quad_area(quad, b_wh) / min(
        geometry.signed_area(quad), float(b_wh[0] * b_wh[1])
    )
    if share < _MIN_OVERLAP_SHARE:
        return Verdict.NOT_SPREAD
    there = geometry.transform_points(b_from_a, shared)
    if not geometry.is_convex(there):
        return Verdict.NOT_CONVEX
    zoom = geometry.signed_area(there) / geometry.signed_area(shared)
    return Verdict.OK if 1 / _MAX_AREA_RATIO <= zoom <= _MAX_AREA_RATIO else Verdict.AREA


def _spread_share(b_from_a: Matrix, a_points: Points, a_wh: Size, b_wh: Size) -> float:
    """Area spanned by the inliers, as a share of the overlap."""
    hull = cv2.convexHull(geometry.transform_points(b_from_a, a_points))
    quad = geometry.transform_points(b_from_a, geometry.image_quad(a_wh))
    return float(cv2.contourArea(hull)) / max(geometry.clipped_quad_area(quad, b_wh), 1.0)
