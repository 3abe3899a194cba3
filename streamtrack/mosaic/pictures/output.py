"""A finished mosaic and its poses as files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from streamtrack.errors import OutputError
from streamtrack.mosaic.types import Placement
from streamtrack.outputs import write_file
from streamtrack.poses import PosesWriter
from streamtrack.types import Image, Size

_JPEG_QUALITY = 95
_TRANSPARENT = (".png", ".tif", ".tiff", ".webp")


def write_mosaic(path: Path, size_wh: Size, bands: Iterator[Image], count: int) -> str:
    """Write bands (n, width, 4) of BGR and coverage; returns what lies outside the pictures.

    One band is encoded as a whole, transparent outside in PNG, TIFF and WebP and black in JPEG
    and BMP. More of them go to disk as they come, black outside. The file is written whole or not
    at all. Raises OutputError.
    """
    if count > 1:
        from streamtrack.mosaic.picture_files import open_picture

        with open_picture(path, size_wh) as writer:
            for band in bands:
                writer.write(_on_black(band))
        return "black"
    pixels = next(bands)
    suffix = path.suffix.lower()
    is_transparent = suffix in _TRANSPARENT and bool(np.any(pixels[:, :, 3] < 255))
    options: tuple[int, ...] = ()
    if suffix in (".jpg", ".jpeg"):
        options = (cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY)
    try:
        data = cv2.imencode(suffix, pixels if is_transparent else _on_black(pixels), options)[1]
    except cv2.error:
        raise OutputError(
            f"cannot write {path}: a picture of {size_wh[0]}x{size_wh[1]} does not fit into this "
            "format; choose .png or .tif"
        ) from None
    write_file(path, data.tobytes())
    return "transparent" if is_transparent else "black"


def _on_black(pixels: Image) -> Image:
    cover = cv2.extractChannel(pixels, 3)
    bgr = cv2.cvtColor(pixels, cv2.COLOR_BGRA2BGR)
    return np.asarray(cv2.bitwise_and(bgr, bgr, mask=cover), np.uint8)


def write_poses(path: Path, images: Sequence[Placement]) -> None:
    """CSV of ``world_from_frame``, a row a picture, in full precision. Raises OutputError."""
    with PosesWriter(path) as writer:
        for image in images:
            writer.write_pose(
                image.index, image.name, image.time_s, image.world_from_picture, image.reason
            )
