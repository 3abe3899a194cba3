"""Does what was found have the colours of what was given?

Grey pictures of two cars of one make match well; their colours tell them apart. Asked only when a
target is found again, where a mistake would be kept.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.geometry import transform_points
from streamtrack.types import Image, Matrix, Points

MAX_CHROMA_DISTANCE = 10.0
"""In CIELAB a*, b* units, for two pictures of one camera."""
MAX_CHROMA_DISTANCE_OTHER_CAMERA = 25.0
"""The same where white balance may differ: a template picture from elsewhere."""


def prepare_colors(picture: Image) -> None:
    """Have OpenCV make its CIELAB tables now: 0.1 to 0.2 s that no frame should have to wait."""
    if picture.ndim == 3:
        _chroma_at(picture, np.zeros((1, 2), np.float32))


def chroma_distance(a: Image, points: Points, b: Image, b_from_a: Matrix, reach_px: float) -> float:
    """Upper quartile of the CIELAB a*, b* distance between two pictures; 0 if either is grey.

    Compared ``reach_px`` (pixels of a) left, right, above and below each of the ``points`` of a,
    because corners themselves lie where colours meet.
    """
    if a.ndim == 2 or b.ndim == 2 or len(points) == 0:
        return 0.0
    steps = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]], np.float32) * np.float32(reach_px)
    around = (points[:, None] + steps).reshape(-1, 2)
    difference = _chroma_at(a, around) - _chroma_at(b, transform_points(b_from_a, around))
    return float(np.percentile(np.linalg.norm(difference, axis=1), 75))


def _chroma_at(picture: Image, points: Points) -> npt.NDArray[np.float32]:
    """a*, b* (N, 2) at places in a BGR picture, interpolated."""
    x, y = (np.ascontiguousarray(column.reshape(-1, 1), np.float32) for column in points.T)
    bgr = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    lab = cv2.cvtColor(np.asarray(bgr, np.float32) / np.float32(255), cv2.COLOR_BGR2LAB)
    return np.asarray(lab[:, 0, 1:], np.float32)
