"""Pre-warp trackers: warp the frame back by the last pose, flow to the first frame, compose.

The way of WOFT (Serych and Matas, WACV 2023) with classical flow in place of a network: no drift,
for every pose is measured against the first frame. A pose that failed is tried again for ten
frames; ORB keypoints with TEBLID descriptors find the target again.
"""

from __future__ import annotations

from abc import abstractmethod

import cv2
import numpy as np

from streamtrack.bench.follower import (
    MAX_RETURN_PX,
    Follower,
    corners_in,
    grey_of,
    is_sane,
    lucas_kanade,
    mapped,
    quad_mask,
)
from streamtrack.geometry import bounding_box, translation
from streamtrack.types import Image, Mask, Matrix, Points

_MARGIN_PX = 24
_EDGE_PX = 3
_POINTS = 500
_MIN_INLIERS = 10
_MIN_INLIER_SHARE = 0.2
_STALE_AFTER = 10
PARAMETERS = {
    "points": _POINTS,
    "max_return_px": MAX_RETURN_PX,
    "estimator": "USAC_MAGSAC 3 px, then least squares over the inliers",
    "min_inliers": _MIN_INLIERS,
    "min_inlier_share": _MIN_INLIER_SHARE,
    "stale_after": _STALE_AFTER,
    "redetection": "ORB 1000, TEBLID, mutual, ratio 0.8, USAC_MAGSAC 3 px, >= 12 inliers",
}


class PreWarp(Follower):
    """All but the flow itself."""

    def __init__(self, image: Image, quad: Points) -> None:
        grey = grey_of(image)
        height, width = grey.shape
        x0, y0, x1, y1 = bounding_box(quad)
        left, top = max(int(x0) - _MARGIN_PX, 0), max(int(y0) - _MARGIN_PX, 0)
        right, bottom = min(int(x1) + _MARGIN_PX, width), min(int(y1) + _MARGIN_PX, height)
        self._crop_from_first = translation(-left, -top)
        self._first_from_crop = translation(left, top)
        self._template = np.ascontiguousarray(grey[top:bottom, left:right])
        own = mapped(self._crop_from_first, quad)
        self._mask = quad_mask(own, self._template.shape, _EDGE_PX)
        self._quad = quad
        self._points = self._choose(self._template, self._mask)
        self._detector = _Detector(grey, quad)
        self._pose: Matrix = np.eye(3)
        self._frames_lost = 0

    @abstractmethod
    def _choose(self, template: Image, mask: Image) -> Points:
        """The points (N, 2) of the template to be found again."""

    @abstractmethod
    def _flow(self, template: Image, warped: Image, points: Points) -> tuple[Points, Mask]:
        """Where they lie in the frame warped back, and which of them can be trusted."""

    def update(self, image: Image) -> Points | None:
        grey = grey_of(image)
        pose = self._aligned(grey, self._pose) if self._frames_lost <= _STALE_AFTER else None
        if pose is None:
            guess = self._detector.find(grey)
            pose = None if guess is None else self._aligned(grey, guess)
        if pose is None:
            self._frames_lost += 1
            return None
        self._frames_lost = 0
        self._pose = pose
        return mapped(pose, self._quad)

    def _aligned(self, grey: Image, guess: Matrix) -> Matrix | None:
        """The pose near ``guess`` (frame_from_first), None if there is none to be trusted."""
        height, width = self._template.shape
        frame_from_crop = guess @ self._first_from_crop
        way = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        warped = cv2.warpPerspective(grey, frame_from_crop, (width, height), flags=way)
        found, is_found = self._flow(self._template, np.asarray(warped, np.uint8), self._points)
        seen = mapped(frame_from_crop, self._points)
        is_inside = ((seen >= 0) & (seen < (grey.shape[1], grey.shape[0]))).all(axis=1)
        kept = is_found & is_inside
        if int(kept.sum()) < _MIN_INLIERS:
            return None
        step = _homography(self._points[kept], found[kept])
        if step is None or step[1] < max(_MIN_INLIERS, _MIN_INLIER_SHARE * is_inside.sum()):
            return None
        pose: Matrix = frame_from_crop @ step[0] @ self._crop_from_first
        pose = pose / pose[2, 2]
        return pose if is_sane(mapped(pose, self._quad), self._quad) else None


class PreWarpLK(PreWarp):
    """Lucas-Kanade at corners, forward and backward."""

    def _choose(self, template: Image, mask: Image) -> Points:
        return corners_in(template, mask, _POINTS, 4.0)

    def _flow(self, template: Image, warped: Image, points: Points) -> tuple[Points, Mask]:
        return lucas_kanade(template, warped, points)


class PreWarpDIS(PreWarp):
    """Dense inverse search (medium preset), forward and backward, read on a regular grid."""

    def __init__(self, image: Image, quad: Points) -> None:
        self._dis = cv2.DISOpticalFlow.create(cv2.DISOpticalFlow_PRESET_MEDIUM)
        super().__init__(image, quad)

    def _choose(self, template: Image, mask: Image) -> Points:
        step = max(int(np.sqrt(np.count_nonzero(mask) / _POINTS)), 1)
        rows, columns = np.nonzero(mask[::step, ::step])
        return (step * np.column_stack([columns, rows])).astype(np.float32)

    def _flow(self, template: Image, warped: Image, points: Points) -> tuple[Points, Mask]:
        there = self._dis.calc(template, warped, None)  # type: ignore[call-overload]
        back = self._dis.calc(warped, template, None)  # type: ignore[call-overload]
        x, y = points.astype(np.intp).T
        moved = points + there[y, x]
        returned = cv2.remap(back, moved[:, None], None, cv2.INTER_LINEAR)  # type: ignore[call-overload]
        off = np.linalg.norm(moved + returned.reshape(-1, 2) - points, axis=1)
        height, width = template.shape
        is_inside = ((moved >= 0) & (moved <= (width - 1, height - 1))).all(axis=1)
        return moved, is_inside & (off <= MAX_RETURN_PX)


class _Detector:
    """The target anywhere in a picture, by its features."""

    def __init__(self, grey: Image, quad: Points) -> None:
        self._orb = cv2.ORB.create(nfeatures=1000)
        self._teblid = cv2.xfeatures2d.TEBLID.create(1.0)
        self._matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
        self._quad = quad
        self._points, self._descriptors = self._features(grey, quad_mask(quad, grey.shape))

    def find(self, grey: Image) -> Matrix | None:
        """frame_from_first, None if the target is not seen."""
        points, descriptors = self._features(grey, None)
        if min(len(points), len(self._points)) < 12:
            return None
        forth = self._matcher.knnMatch(self._descriptors, descriptors, k=2)
        back = {
            pair.queryIdx: pair.trainIdx
            for pair in self._matcher.match(descriptors, self._descriptors)
        }
        pairs = [
            (best.queryIdx, best.trainIdx)
            for best, second in forth
            if best.distance < 0.8 * second.distance and back.get(best.trainIdx) == best.queryIdx
        ]
        if len(pairs) < 12:
            return None
        own, other = np.array(pairs).T
        result = _homography(self._points[own], points[other])
        if result is None or result[1] < 12:
            return None
        return result[0] if is_sane(mapped(result[0], self._quad), self._quad) else None

    def _features(self, grey: Image, mask: Image | None) -> tuple[Points, Image]:
        found = self._orb.detect(grey, mask)
        found, descriptors = self._teblid.compute(grey, found)
        points = np.array([point.pt for point in found], np.float32).reshape(-1, 2)
        if descriptors is None:
            return points, np.zeros((0, 32), np.uint8)
        return points, np.asarray(descriptors, np.uint8)


def _homography(source: Points, found: Points) -> tuple[Matrix, int] | None:
    """MAGSAC, then least squares over its inliers, whose number comes second."""
    matrix, mask = cv2.findHomography(source, found, cv2.USAC_MAGSAC, 3.0, None, 1000, 0.999)
    if matrix is None or mask is None:
        return None
    kept = mask.ravel().astype(bool)
    if int(kept.sum()) < 4:
        return None
    better, _ = cv2.findHomography(source[kept], found[kept], 0)
    chosen = matrix if better is None else better
    return np.asarray(chosen, np.float64), int(kept.sum())
