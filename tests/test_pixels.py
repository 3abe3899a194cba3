"""Raw pictures of cameras against exact pictures."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from v4l2_emulator import default_picture, encoded

from streamtrack.sources.v4l2.pixels import Layout, to_picture


@pytest.mark.parametrize("is_full_range", [False, True], ids=["limited", "full"])
@pytest.mark.parametrize("padding", [0, 24], ids=["packed", "padded"])
@pytest.mark.parametrize("fourcc", ["YUYV", "UYVY", "NV12", "YU12", "BGR3", "RGB3", "GREY"])
def test_raw_formats_give_the_picture_back(fourcc: str, padding: int, is_full_range: bool) -> None:
    picture = cv2.GaussianBlur(default_picture(96, 64, 3), (0, 0), 2)
    layout = Layout(fourcc, (96, 64), is_full_range=is_full_range)
    stride = layout.row_bytes + padding
    data = encoded(picture, fourcc, stride, is_full_range)
    layout = Layout(fourcc, (96, 64), stride, is_full_range)
    assert len(data) == layout.size_bytes
    result = to_picture(data + b"more", layout)
    assert result is not None
    expected = picture
    if fourcc == "GREY":
        expected = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
        if not is_full_range:
            expected = np.rint(16 + expected * (219 / 255)).astype(np.uint8)
    assert result.shape == expected.shape
    result[0, 0] = 7  # in memory of its own
    difference = np.abs(result.astype(int) - expected)[1:]
    # Chroma of half resolution blurs the edges of the square.
    assert np.mean(difference) < 1.5
    assert np.percentile(difference, 95) <= 6
    assert to_picture(data[: layout.size_bytes - 1], layout) is None
