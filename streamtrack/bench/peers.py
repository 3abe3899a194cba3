"""The peers, from what OpenCV offers and from what its users commonly write.

They stand on OpenCV alone, so that a change of streamtrack never changes what it is measured
against.
"""

from __future__ import annotations

import cv2
import numpy as np

from streamtrack.bench.follower import (
    LK_WINDOW_PX,
    MAX_RETURN_PX,
    Follower,
    bgr_of,
    corners_in,
    grey_of,
    lucas_kanade,
    mapped,
    quad_mask,
)
from streamtrack.geometry import bounding_box, box_quad, inverted
from streamtrack.types import Image, Matrix, Points

_ORB_FEATURES = 1000
_MAX_RATIO = 0.75
_RANSAC_PX = 3.0
_MIN_INLIERS = 10
_CHAIN_POINTS = 400
_SOW_BELOW = 150
PLANE_TRACKER_PARAMETERS = {
    "detector": "orb",
    "features": _ORB_FEATURES,
    "matcher": "brute force",
    "max_ratio": _MAX_RATIO,
    "ransac_px": _RANSAC_PX,
    "min_matches": _MIN_INLIERS,
}
CHAIN_PARAMETERS = {
    "points": _CHAIN_POINTS,
    "sow_below": _SOW_BELOW,
    "window_px": LK_WINDOW_PX,
    "max_return_px": MAX_RETURN_PX,
    "ransac_px": _RANSAC_PX,
    "min_inliers": _MIN_INLIERS,
}


class PlaneTracker(Follower):
    """OpenCV's samples/python/plane_tracker.py: ORB 1000, ratio 0.75, RANSAC 3 px, >= 10 matches.

    No state from frame to frame. Matched by brute force in place of FLANN-LSH: the exact answer
    to the same question, and the same in every run. The target is the quad, not its bounding box.
    """

    def __init__(self, image: Image, quad: Points) -> None:
        self._orb = cv2.ORB.create(nfeatures=_ORB_FEATURES)
        self._matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
        self._quad = quad
        points, descriptors = self._orb.detectAndCompute(grey_of(image), None)
        kept = [
            i
            for i, point in enumerate(points)
            if cv2.pointPolygonTest(quad.reshape(-1, 1, 2), point.pt, False) >= 0
        ]
        self._points = np.array([points[i].pt for i in kept], np.float32).reshape(-1, 2)
        self._descriptors = descriptors[kept] if kept else np.zeros((0, 32), np.uint8)

    def update(self, image: Image) -> Points | None:
        points, descriptors = self._orb.detectAndCompute(grey_of(image), None)
        if len(points) < _MIN_INLIERS or len(self._points) < _MIN_INLIERS:
            return None
        pairs = [
            best
            for best, *second in self._matcher.knnMatch(descriptors, self._descriptors, k=2)
            if second and best.distance < _MAX_RATIO * second[0].distance
        ]
        if len(pairs) < _MIN_INLIERS:
            return None
        source = self._points[[pair.trainIdx for pair in pairs]]
        found = np.array([points[pair.queryIdx].pt for pair in pairs], np.float32)
        matrix, is_inlier = cv2.findHomography(source, found, cv2.RANSAC, _RANSAC_PX)
        if matrix is None or int(is_inlier.sum()) < _MIN_INLIERS:
            return None
        return mapped(np.asarray(matrix, np.float64), self._quad)


class LucasKanadeChain(Follower):
    """Corners followed from frame to frame by Lucas-Kanade, a homography through all that are left.

    Points carry their place in the first frame, and new ones are sown when few are left, through
    the pose of that moment: from there on errors add up. A frame that fails is left out, and the
    next one is measured against the last good one.
    """

    def __init__(self, image: Image, quad: Points) -> None:
        self._quad = quad
        self._pose: Matrix = np.eye(3)
        self._grey = grey_of(image)
        self._first_points = np.zeros((0, 2), np.float32)
        self._points = np.zeros((0, 2), np.float32)
        self._sow()

    def update(self, image: Image) -> Points | None:
        grey = grey_of(image)
        found, is_found = lucas_kanade(self._grey, grey, self._points)
        if int(is_found.sum()) < _MIN_INLIERS:
            return None
        source, found = self._first_points[is_found], found[is_found]
        matrix, inliers = cv2.findHomography(source, found, cv2.RANSAC, _RANSAC_PX)
        if matrix is None or int(inliers.sum()) < _MIN_INLIERS:
            return None
        kept = inliers.ravel().astype(bool)
        self._pose = np.asarray(matrix, np.float64)
        self._grey = grey
        self._first_points, self._points = source[kept], found[kept]
        if len(self._points) < _SOW_BELOW:
            self._sow()
        return mapped(self._pose, self._quad)

    def _sow(self) -> None:
        """New corners where there are none, with their places in the first frame."""
        mask = quad_mask(mapped(self._pose, self._quad), self._grey.shape, 2)
        for x, y in np.rint(self._points).astype(int):
            cv2.circle(mask, (int(x), int(y)), 5, 0, -1)
        most = _CHAIN_POINTS - len(self._points)
        new = corners_in(self._grey, mask, most, 5.0)
        first_from_frame = inverted(self._pose)
        first = mapped(first_from_frame, new)
        self._points = np.vstack([self._points, new])
        self._first_points = np.vstack([self._first_points, first])


class BoxTracker(Follower):
    """One of OpenCV's box trackers: an upright box, so good for its centre only."""

    def __init__(self, image: Image, quad: Points, tracker: cv2.Tracker) -> None:
        height, width = image.shape[:2]
        x0, y0, x1, y1 = bounding_box(quad)
        left, top = max(round(x0), 0), max(round(y0), 0)
        right, bottom = min(round(x1), width - 1), min(round(y1), height - 1)
        self._tracker = tracker
        self._tracker.init(bgr_of(image), (left, top, right - left, bottom - top))

    def update(self, image: Image) -> Points | None:
        is_found, box = self._tracker.update(bgr_of(image))
        return box_quad(*box) if is_found else None


def csrt(image: Image, quad: Points) -> Follower:
    """Discriminative correlation filter with channel and spatial reliability."""
    return BoxTracker(image, quad, cv2.TrackerCSRT.create())


def kcf(image: Image, quad: Points) -> Follower:
    """Kernelized correlation filters."""
    return BoxTracker(image, quad, cv2.TrackerKCF.create())
