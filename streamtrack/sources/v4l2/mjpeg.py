"""JPEG pictures of cameras: decoded strictly, and made complete so that they can be stored.

What a bus lost shows as a picture whose lower part is grey or shifted, and common decoders return
it without a word. FFmpeg's, told to take errors seriously, refuses each picture that is cut short
or lacks bytes, at the price of the same decoding.
"""

from __future__ import annotations

from functools import cache

import av
import cv2
import numpy as np
from av.video.codeccontext import VideoCodecContext
from av.video.frame import VideoFrame
from av.video.reformatter import VideoReformatter

from streamtrack.types import Image, Size

_FULL_RANGE = 2  # AVCOL_RANGE_JPEG
_START = b"\xff\xd8"
_END = b"\xff\xd9"
_HUFFMAN_TABLE = b"\xff\xc4"
_SCAN = b"\xff\xda"


class JpegDecoder:
    """Decodes the pictures of one stream."""

    def __init__(self, size_wh: Size) -> None:
        self._size_wh = size_wh
        codec = av.CodecContext.create("mjpeg", "r")
        assert isinstance(codec, VideoCodecContext)
        codec.options = {"err_detect": "explode"}
        codec.thread_count = 1  # frame threads would hold pictures back
        self._codec = codec
        self._reformatter = VideoReformatter()

    def decode(self, data: bytes) -> tuple[Image, bytes] | None:
        """The picture and the JPEG without what follows it, or None if it is damaged.

        The picture is BGR (H, W, 3), or (H, W) grey. Cameras that send whole blocks send more
        rows or columns than they granted; these are cut off, and what is smaller is refused.
        """
        jpeg = whole_jpeg(data)
        if jpeg is None:
            return None
        try:
            frames = self._codec.decode(av.Packet(jpeg))
            picture = self._picture(frames[0]) if len(frames) == 1 else None
        except av.FFmpegError:
            return None
        return None if picture is None else (picture, with_tables(jpeg))

    def _picture(self, frame: VideoFrame) -> Image | None:
        width, height = self._size_wh
        if frame.is_corrupt or frame.width < width or frame.height < height:
            return None
        plain = self._reformatter.reformat(
            frame,
            format="gray" if frame.format.name.startswith("gray") else "bgr24",
            src_color_range=_FULL_RANGE,
            dst_color_range=_FULL_RANGE,
            threads=1,
        )
        picture = np.asarray(plain.to_ndarray(), np.uint8)
        if (frame.width, frame.height) == self._size_wh:
            return picture
        return np.ascontiguousarray(picture[:height, :width])


def whole_jpeg(data: bytes) -> bytes | None:
    """From its start to its end marker, without what pads it; None if one of them is missing."""
    end = data.rfind(_END)
    if not data.startswith(_START) or end < 0:
        return None
    return data[: end + len(_END)]


def with_tables(jpeg: bytes) -> bytes:
    """The JPEG with the standard Huffman tables if it has none, as the MJPEG of many cameras.

    FFmpeg takes the standard ones for granted; browsers and viewers do not.
    """
    scan = jpeg.find(_SCAN)
    if scan < 0 or jpeg.find(_HUFFMAN_TABLE, 0, scan) >= 0:
        return jpeg
    return jpeg[:scan] + _standard_tables() + jpeg[scan:]


@cache
def _standard_tables() -> bytes:
    """ITU-T T.81, K.3: what an encoder writes that was not asked to optimise its own."""
    _, encoded = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))
    rest, tables = encoded.tobytes(), b""
    while (at := rest.find(_HUFFMAN_TABLE)) >= 0:
        size = 2 + int.from_bytes(rest[at + 2 : at + 4], "big")
        tables += rest[at : at + size]
        rest = rest[at + size :]
    return tables
