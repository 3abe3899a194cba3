"""Raw pictures of cameras, in V4L2's pixel formats, turned into BGR.

Layouts: kernel documentation, "Image Formats" of the Linux Media Infrastructure userspace API.
Colours are BT.601 (ITU-R BT.601-7), 16..235 or full range as the driver says.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.types import Image, Size

_Plane: TypeAlias = npt.NDArray[np.uint8]

_BYTES_PER_PIXEL = {"YUYV": 2, "UYVY": 2, "BGR3": 3, "RGB3": 3}
_LIMITED = {
    "YUYV": cv2.COLOR_YUV2BGR_YUY2,
    "UYVY": cv2.COLOR_YUV2BGR_UYVY,
    "NV12": cv2.COLOR_YUV2BGR_NV12,
    "YU12": cv2.COLOR_YUV2BGR_I420,
}
_PLANAR = ("NV12", "YU12")


@dataclass(frozen=True, slots=True)
class Layout:
    """How the bytes of a raw picture lie; ``stride`` is the length of a row of luma or of pixels.

    Formats: YUYV, UYVY, NV12, YU12, BGR3, RGB3, GREY. Sizes of formats that share chroma between
    pixels are even.
    """

    fourcc: str
    size_wh: Size
    stride: int = 0
    is_full_range: bool = False

    @property
    def row_bytes(self) -> int:
        """Of a row of luma or of pixels, without what pads it."""
        return self.size_wh[0] * _BYTES_PER_PIXEL.get(self.fourcc, 1)

    @property
    def step(self) -> int:
        """From row to row; drivers that leave the stride open do not pad."""
        return max(self.stride, self.row_bytes)

    @property
    def size_bytes(self) -> int:
        """Of a whole picture."""
        rows = self.size_wh[1]
        return self.step * (rows + rows // 2 if self.fourcc in _PLANAR else rows)


def to_picture(data: bytes, layout: Layout) -> Image | None:
    """BGR (H, W, 3), or (H, W) for GREY, in memory of its own. None if bytes are missing."""
    if len(data) < layout.size_bytes:
        return None
    rows = _rows(data, layout)
    width, height = layout.size_wh
    if layout.fourcc == "GREY":
        return rows.copy()
    if layout.fourcc == "BGR3":
        return rows.reshape(height, width, 3).copy()
    if layout.fourcc == "RGB3":
        return _converted(rows.reshape(height, width, 3), cv2.COLOR_RGB2BGR)
    if layout.is_full_range:
        return _from_full_range(rows, layout)
    if layout.fourcc in _PLANAR:
        return _converted(rows, _LIMITED[layout.fourcc])
    return _converted(rows.reshape(height, width, 2), _LIMITED[layout.fourcc])


def _converted(picture: _Plane, code: int) -> Image:
    return np.asarray(cv2.cvtColor(picture, code), np.uint8)


def _rows(data: bytes, layout: Layout) -> _Plane:
    """The rows without padding, (rows, row_bytes); planes of half size as OpenCV wants them."""
    height = layout.size_wh[1]
    whole = np.frombuffer(data, np.uint8, layout.size_bytes)
    if layout.step == layout.row_bytes:
        return whole.reshape(-1, layout.row_bytes)
    if layout.fourcc != "YU12":
        return np.ascontiguousarray(whole.reshape(-1, layout.step)[:, : layout.row_bytes])
    # Two planes of half the width, each row padded by half as much.
    luma = whole[: height * layout.step].reshape(height, layout.step)[:, : layout.row_bytes]
    chroma = whole[height * layout.step :].reshape(height, -1)[:, : layout.row_bytes // 2]
    return np.concatenate([luma, chroma.reshape(height // 2, -1)])


def _from_full_range(rows: _Plane, layout: Layout) -> Image:
    """OpenCV's direct conversions know only 16..235; chroma is repeated, as they do."""
    width, height = layout.size_wh
    if layout.fourcc in _PLANAR:
        luma, chroma = rows[:height], rows[height:]
        if layout.fourcc == "NV12":
            pairs = chroma.reshape(height // 2, width // 2, 2)
            u, v = pairs[..., 0], pairs[..., 1]
        else:
            u, v = chroma.reshape(2, height // 2, width // 2)
    else:
        first = 0 if layout.fourcc == "YUYV" else 1
        luma = np.ascontiguousarray(rows[:, first::2])
        u, v = rows[:, 1 - first :: 4], rows[:, 3 - first :: 4]
    luma_v_u = [luma, *(_enlarged(plane, layout.size_wh) for plane in (v, u))]
    return _converted(np.asarray(cv2.merge(luma_v_u), np.uint8), cv2.COLOR_YCrCb2BGR)


def _enlarged(plane: _Plane, size_wh: Size) -> _Plane:
    whole = cv2.resize(np.ascontiguousarray(plane), size_wh, interpolation=cv2.INTER_NEAREST)
    return np.asarray(whole, np.uint8)
