"""Encoding pictures to AV1, which the Rerun viewer decodes by itself."""

from __future__ import annotations

import math
import os
from fractions import Fraction

import av
import cv2
import numpy as np

from streamtrack.errors import OutputError
from streamtrack.types import Image, Packet, Size

_ENCODER = "libsvtav1"
_OPTIONS = {
    "preset": "10",  # faster ones leave wrong blocks standing in sharp, sudden changes
    "crf": "35",
    "svtav1-params": "rtc=1:pred-struct=1:lp=1",  # low delay, no B-frames; one thread
}
_FALLBACK_RATE_HZ = 30.0


class Av1Encoder:
    """Pictures of one size to packets without B-frames, a keyframe about every second.

    Odd sizes are padded by one repeated row or column, for chroma is stored at half size.
    Raises OutputError if the encoder is missing or refuses the size.
    """

    def __init__(self, size_wh: Size, rate_hz: float | None) -> None:
        rate = rate_hz if rate_hz and math.isfinite(rate_hz) and rate_hz > 0 else _FALLBACK_RATE_HZ
        self.size_wh = size_wh
        self._coded_wh = (size_wh[0] + size_wh[0] % 2, size_wh[1] + size_wh[1] % 2)
        self._times: dict[int, float] = {}
        self._count = 0
        os.environ.setdefault("SVT_LOG", "0")  # else it writes thirty lines to stderr
        try:
            codec = av.CodecContext.create(_ENCODER, "w")
            assert isinstance(codec, av.VideoCodecContext)
            codec.width, codec.height = self._coded_wh
            codec.pix_fmt = "yuv420p"
            codec.framerate = Fraction(rate).limit_denominator(1001)
            codec.time_base = 1 / codec.framerate
            codec.gop_size = max(1, round(rate))
            codec.max_b_frames = 0
            codec.thread_count = 1
            codec.options = dict(_OPTIONS)
            codec.open()
        except (av.FFmpegError, ValueError) as error:
            raise OutputError(
                f"cannot encode {size_wh[0]}x{size_wh[1]} as AV1: {error}; use --record-video jpeg"
            ) from None
        self._codec = codec

    def encode(self, image: Image, time_s: float) -> list[Packet]:
        """The packets that are ready once ``image`` went in; there may be none yet."""
        pad_x = self._coded_wh[0] - image.shape[1]
        pad_y = self._coded_wh[1] - image.shape[0]
        if pad_x or pad_y:
            padded = cv2.copyMakeBorder(image, 0, pad_y, 0, pad_x, cv2.BORDER_REPLICATE)
            image = np.asarray(padded, np.uint8)
        layout = "gray" if image.ndim == 2 else "bgr24"
        picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format=layout)
        picture = picture.reformat(format="yuv420p")
        picture.pts = self._count
        picture.time_base = self._codec.time_base
        self._times[self._count] = time_s
        self._count += 1
        return self._packets(picture)

    def flush(self) -> list[Packet]:
        """The packets still inside; the encoder is finished then."""
        return self._packets(None)

    def _packets(self, picture: av.VideoFrame | None) -> list[Packet]:
        return [
            Packet(self._times.pop(packet.pts), bytes(packet), packet.is_keyframe)
            for packet in self._codec.encode(picture)
            if packet.pts in self._times
        ]
