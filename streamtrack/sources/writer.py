"""Writing pictures to a video file."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import cast

import av
import cv2
import numpy as np
from av.container import OutputContainer
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from streamtrack.closing import Closing
from streamtrack.errors import OutputError, UsageError
from streamtrack.types import Image, Size

_TICKS_HZ = 90_000


@dataclass(frozen=True, slots=True)
class _Coding:
    """How an ending is encoded. ``has_fixed_rate``: the container counts frames, not time."""

    codec: str
    pixel_format: str
    options: dict[str, str] = field(default_factory=dict)
    needs_even_size: bool = True
    has_fixed_rate: bool = False
    container: dict[str, str] = field(default_factory=dict)


_H264 = _Coding("libx264", "yuv420p", {"preset": "veryfast", "crf": "20", "g": "60"})
_VP9 = _Coding(
    "libvpx-vp9",
    "yuv420p",
    {"deadline": "realtime", "cpu-used": "8", "crf": "30", "b": "0", "row-mt": "1"},
)
_MJPEG = _Coding(
    "mjpeg", "yuvj420p", {"flags": "+qscale", "global_quality": "354"}, has_fixed_rate=True
)
_FFV1 = _Coding("ffv1", "bgr0", {"level": "3", "slices": "4"}, needs_even_size=False)
# What was written until a disk is full or the process killed can be played all the same.
_MP4 = replace(_H264, container={"movflags": "+hybrid_fragmented"})
_CODINGS = {".mp4": _MP4, ".mov": _MP4, ".mkv": _H264, ".webm": _VP9, ".avi": _MJPEG}


class VideoWriter(Closing):
    """Encodes pictures with their times into a file whose ending names the format.

    ``.mp4``, ``.mov`` and ``.mkv`` are H.264 (x264) without B-frames, ``.webm`` is VP9 and
    ``.avi`` is Motion JPEG. ``lossless=True``, for ``.mkv`` only, keeps every pixel (FFV1).

    Times are kept to 1/90000 s, counted from the first; Matroska and WebM round to 1 ms, and AVI
    to multiples of 1 / rate. Times that do not increase are moved to the next possible moment.
    The file begins with the first picture and is finished on leaving the context, whatever raised.
    """

    def __init__(self, path: str | Path, *, rate_hz: float, lossless: bool = False) -> None:
        """Prepare the folder of ``path``; ``rate_hz`` is the nominal rate for the header.

        Raises UsageError for an unknown ending or a rate that is not positive, OutputError if the
        folder cannot be made.
        """
        self._path = Path(path)
        self._coding = _coding(self._path, lossless)
        if not 0.001 <= rate_hz <= _TICKS_HZ:
            raise UsageError(f"rate_hz must be in 0.001..{_TICKS_HZ}, but is {rate_hz}")
        self._rate = Fraction(rate_hz).limit_denominator(10_000)
        self._container: OutputContainer | None = None
        self._stream: VideoStream | None = None
        self._size_wh: Size = (0, 0)
        self._first_s = 0.0
        self._last_pts = -1
        self._is_broken = False
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise self._error(error) from None
        if self._path.is_dir():
            raise OutputError(f"cannot write {self._path}: it is a folder: give a file name")

    def write(self, image: Image, time_s: float) -> None:
        """Append a picture (H, W, 3) BGR or (H, W) grey, shown at ``time_s``.

        One of another size than the first is fitted into it, with black borders. Raises
        OutputError if the file cannot be written.
        """
        if self._is_broken:
            raise OutputError(f"cannot go on writing {self._path}: it failed before; start again")
        try:
            if self._stream is None:
                self._open(image, time_s)
            self._encode(self._frame(image, time_s))
        except (av.FFmpegError, OSError) as error:
            self._abandon()
            raise self._error(error) from None

    def close(self) -> None:
        """Finish the file. Raises OutputError if that fails; may be called again."""
        container, stream = self._container, self._stream
        self._container = self._stream = None
        if container is None:
            return
        try:
            try:
                if stream is not None:
                    container.mux(stream.encode(None))
            finally:
                container.close()
        except (av.FFmpegError, OSError) as error:
            raise self._error(error) from None

    def _abandon(self) -> None:
        """Close after a failure, writing nothing more than FFmpeg itself still can.

        Another packet after a header that could not be written ends the process (PyAV 18).
        """
        container = self._container
        self._container = self._stream = None
        self._is_broken = True
        if container is not None:
            with suppress(av.FFmpegError, OSError):  # The first failure is the one to tell.
                container.close()

    def _open(self, image: Image, time_s: float) -> None:
        coding = self._coding
        self._container = av.open(f"file:{self._path}", "w", options=dict(coding.container))
        stream = cast(
            VideoStream,
            self._container.add_stream(coding.codec, rate=self._rate, options=dict(coding.options)),
        )
        self._size_wh = image.shape[1], image.shape[0]
        padding = 1 if coding.needs_even_size else 0
        stream.width = self._size_wh[0] + (self._size_wh[0] & padding)
        stream.height = self._size_wh[1] + (self._size_wh[1] & padding)
        stream.pix_fmt = coding.pixel_format
        stream.max_b_frames = 0  # Such files can be copied packet by packet afterwards.
        ticks = 1 / self._rate if coding.has_fixed_rate else Fraction(1, _TICKS_HZ)
        stream.codec_context.time_base = ticks
        self._stream = stream
        self._first_s = time_s

    def _encode(self, frame: VideoFrame) -> None:
        if self._container is not None and self._stream is not None:
            self._container.mux(self._stream.encode(frame))

    def _frame(self, image: Image, time_s: float) -> VideoFrame:
        if (image.shape[1], image.shape[0]) != self._size_wh:
            image = _letterboxed(image, self._size_wh)
        if self._coding.needs_even_size:
            image = _padded_to_even(image)
        pixels = np.ascontiguousarray(image)
        frame = VideoFrame.from_ndarray(pixels, "gray" if image.ndim == 2 else "bgr24")
        ticks_hz = self._rate if self._coding.has_fixed_rate else Fraction(_TICKS_HZ)
        frame.time_base = 1 / ticks_hz
        self._last_pts = max(self._last_pts + 1, round((time_s - self._first_s) * ticks_hz))
        frame.pts = self._last_pts
        return frame

    def _error(self, error: Exception) -> OutputError:
        reason = getattr(error, "strerror", None) or str(error)
        return OutputError(
            f"cannot write {self._path}: {reason}: check the folder's mode and the free space"
        )


def _coding(path: Path, lossless: bool) -> _Coding:
    ending = path.suffix.lower()
    if lossless:
        if ending != ".mkv":
            raise UsageError(f"lossless video is .mkv only, not '{ending}': rename {path.name}")
        return _FFV1
    if ending not in _CODINGS:
        raise UsageError(
            f"unknown video ending '{ending}' of {path.name}: known are {', '.join(_CODINGS)}"
        )
    return _CODINGS[ending]


def _padded_to_even(image: Image) -> Image:
    height, width = image.shape[:2]
    if not (height & 1 or width & 1):
        return image
    padded = cv2.copyMakeBorder(image, 0, height & 1, 0, width & 1, cv2.BORDER_REPLICATE)
    return np.asarray(padded, np.uint8)


def _letterboxed(image: Image, size_wh: Size) -> Image:
    """The picture as large as fits into ``size_wh``, centred, with black borders."""
    width, height = size_wh
    factor = min(width / image.shape[1], height / image.shape[0])
    inner = max(1, round(image.shape[1] * factor)), max(1, round(image.shape[0] * factor))
    canvas: Image = np.zeros((height, width, *image.shape[2:]), np.uint8)
    left, top = (width - inner[0]) // 2, (height - inner[1]) // 2
    interpolation = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
    resized = cv2.resize(image, inner, interpolation=interpolation)
    canvas[top : top + inner[1], left : left + inner[0]] = resized
    return canvas
