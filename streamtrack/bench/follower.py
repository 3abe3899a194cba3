"""What the benchmark asks of anything that follows a target."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.types import Image, Matrix, Points


class Follower(ABC):
    """Made with the first picture and the target's quad (4, 2) in it, then given every further one.

    ``stage_ms`` are the wall milliseconds of the last update by stage, ``total`` among them, for
    those that tell.
    """

    stage_ms: Mapping[str, float] = {}

    @abstractmethod
    def update(self, image: Image) -> Points | None:
        """The target's quad (4, 2) in the next picture, None if it is not seen there."""


def grey_of(image: Image) -> Image:
    """The picture (H, W) grey."""
    if image.ndim == 2:
        return image
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


def bgr_of(image: Image) -> Image:
    """The picture (H, W, 3) BGR."""
    if image.ndim == 3:
        return image
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)


def mapped(b_from_a: Matrix, points: Points) -> Points:
    """Points (N, 2) carried by a homography."""
    if not len(points):
        return points
    moved = cv2.perspectiveTransform(points.reshape(-1, 1, 2).astype(np.float32), b_from_a)
    return np.asarray(moved, np.float32).reshape(-1, 2)


def quad_mask(quad: Points, shape_hw: tuple[int, ...], inset_px: int = 0) -> Image:
    """255 inside the quad, ``inset_px`` away from its edge, 0 elsewhere, (H, W)."""
    mask: Image = np.zeros(shape_hw[:2], np.uint8)
    cv2.fillConvexPoly(mask, np.rint(quad).astype(np.int32), 255)
    if inset_px > 0:
        kernel = np.ones((2 * inset_px + 1, 2 * inset_px + 1), np.uint8)
        shrunk = cv2.erode(mask, kernel, borderType=cv2.BORDER_REPLICATE)
        mask = np.asarray(shrunk, np.uint8) if shrunk.any() else mask
    return mask


def corners_in(grey: Image, mask: Image, most: int, apart_px: float) -> Points:
    """Shi-Tomasi corners (N, 2) under the mask."""
    found = cv2.goodFeaturesToTrack(grey, most, 0.01, apart_px, mask=mask)
    if found is None:
        return np.zeros((0, 2), np.float32)
    return np.asarray(found, np.float32).reshape(-1, 2)


LK_WINDOW_PX = 21
_LK = {
    "winSize": (LK_WINDOW_PX, LK_WINDOW_PX),
    "maxLevel": 3,
    "criteria": (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.01),
}
MAX_RETURN_PX = 1.0


def lucas_kanade(a: Image, b: Image, points: Points) -> tuple[Points, npt.NDArray[np.bool_]]:
    """Where points (N, 2) of a lie in b, and whether tracking them back returns to within 1 px."""
    if not len(points):
        return points, np.zeros(0, np.bool_)
    start = points.reshape(-1, 1, 2)
    there, is_found, _ = cv2.calcOpticalFlowPyrLK(a, b, start, None, **_LK)  # type: ignore[call-overload]
    back, is_back, _ = cv2.calcOpticalFlowPyrLK(b, a, there, None, **_LK)  # type: ignore[call-overload]
    off = np.linalg.norm((back - start).reshape(-1, 2), axis=1)
    kept = (is_found.ravel() == 1) & (is_back.ravel() == 1) & (off <= MAX_RETURN_PX)
    return there.reshape(-1, 2), kept


def is_sane(quad: Points, first_quad: Points) -> bool:
    """Convex, not mirrored, and 1/50 to 50 times the first one's area."""
    if not np.isfinite(quad).all():
        return False
    edges = np.roll(quad, -1, axis=0) - quad
    after = np.roll(edges, -1, axis=0)
    turns = edges[:, 0] * after[:, 1] - edges[:, 1] * after[:, 0]
    ratio = cv2.contourArea(quad) / max(cv2.contourArea(first_quad), 1e-6)
    return bool(np.all(turns > 0)) and 0.02 < ratio < 50.0
