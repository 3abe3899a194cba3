"""Backward warping of one picture into a box of the canvas."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.mosaic.pictures.projection import Box, View
from streamtrack.settings import Warping
from streamtrack.types import Image

_FLAGS: dict[str, int] = {
    "nearest": cv2.INTER_NEAREST,
    "linear": cv2.INTER_LINEAR,
    "cubic": cv2.INTER_CUBIC,
    "lanczos": cv2.INTER_LANCZOS4,
}
_GRID = 8
_MIN_SCALE = 0.7
MOST_SIDE = 32_000
"""Longest side that OpenCV's warping takes (coordinates are 16-bit) is 32,767."""


def warp(
    image: Image, view: View, box: Box, warping: Warping, opaque: Image | None = None
) -> tuple[Image, Image]:
    """The part of a picture that falls into a box of the canvas, and where it covers it.

    ``image`` (H, W) or (H, W, 3); ``opaque`` (H, W) is 0 where it shows nothing. Returns (h, w) or
    (h, w, 3), continued by reflection outside the picture, and the coverage (h, w), 0 or 255.
    Where the canvas is much smaller than the picture, the picture is reduced by areas first, so
    that nothing aliases.
    """
    image, view = _reduced(image, view)
    x0, y0, x1, y1 = box
    size = x1 - x0, y1 - y0
    solid = _solid(image, opaque)
    flags, border = _FLAGS[warping], cv2.BORDER_REFLECT
    if view.kind == "planar":
        picture_from_box = np.linalg.inv(view.matrix) @ geometry.translation(x0, y0)
        backward = flags | cv2.WARP_INVERSE_MAP
        warped = cv2.warpPerspective(
            image, picture_from_box, size, flags=backward, borderMode=border
        )
        nearest = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        cover = cv2.warpPerspective(solid, picture_from_box, size, flags=nearest)
    else:
        xs, ys = _maps(view, box)
        warped = cv2.remap(image, xs, ys, flags, borderMode=border)
        cover = cv2.remap(solid, xs, ys, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
    return np.asarray(warped, np.uint8), np.asarray(cover, np.uint8)


def _solid(image: Image, opaque: Image | None) -> Image:
    if opaque is None:
        return np.full(image.shape[:2], 255, np.uint8)
    size = image.shape[1], image.shape[0]
    if opaque.shape != image.shape[:2]:
        opaque = np.asarray(cv2.resize(opaque, size, interpolation=cv2.INTER_AREA), np.uint8)
        opaque = np.asarray(opaque >= 254, np.uint8) * np.uint8(255)
    # A pixel less all round: interpolation reaches over the edge.
    return np.asarray(cv2.erode(opaque, np.ones((3, 3), np.uint8)), np.uint8)


def _reduced(image: Image, view: View) -> tuple[Image, View]:
    height, width = image.shape[:2]
    factor = min(1.0, MOST_SIDE / max(width, height))
    if view.scale() < _MIN_SCALE:
        factor = min(factor, view.scale())
    if factor == 1.0:
        return image, view
    size = max(1, round(width * factor)), max(1, round(height * factor))
    small = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return small, view.of_resized(size[0] / width, size[1] / height, size)


def _maps(view: View, box: Box) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """`View.maps` of a box, computed on every eighth pixel and interpolated between.

    At the curvatures there are (a radius of hundreds of pixels) that is right to 0.02 px.
    """
    x0, y0, x1, y1 = box
    width, height = x1 - x0, y1 - y0
    coarse = view.on_grid(x0, y0, -(-width // _GRID) + 2, -(-height // _GRID) + 2, _GRID)
    if min(float(np.min(values)) for values in coarse) <= -1e5:
        return view.maps(box)  # parts lie behind the camera: no interpolating across that
    fine_from_coarse = np.array([[1 / _GRID, 0.0, 0.0], [0.0, 1 / _GRID, 0.0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    xs, ys = (
        cv2.warpAffine(values, fine_from_coarse, (width, height), flags=flags) for values in coarse
    )
    return np.asarray(xs, np.float32), np.asarray(ys, np.float32)
