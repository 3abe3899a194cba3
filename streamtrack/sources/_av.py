"""Opening files with PyAV and turning its frames into pictures; its errors end here."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import av
import cv2
import numpy as np
from av.container import InputContainer
from av.stream import Discard, Disposition
from av.video.frame import VideoFrame
from av.video.reformatter import VideoReformatter
from av.video.stream import VideoStream

from streamtrack.errors import SourceError
from streamtrack.types import Image

_FULL_RANGE = 2  # AVCOL_RANGE_JPEG: black is 0 and white is 255
_GREY_PREFIXES = ("gray", "ya8", "ya16", "mono")
# By quarter turns counterclockwise: transpose first, then flip x, flip y.
_TURNS = ((False, False, False), (True, False, True), (False, True, True), (True, True, False))
_TOP_LEVEL_BOXES = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot")


def open_file(path: Path) -> tuple[InputContainer, VideoStream]:
    """Open a video file and choose its video stream. The caller closes the container.

    Raises SourceError, with nothing left open, if there is no video to read.
    """
    _check_readable(path)
    try:
        # "file:" keeps FFmpeg from reading a colon in the name as a protocol.
        container = av.open(f"file:{path}", mode="r", metadata_errors="ignore")
    except (av.FFmpegError, ValueError) as error:
        raise _open_error(path, error) from None
    try:
        return container, _video_stream(container, path)
    except BaseException:
        container.close()
        raise


def _check_readable(path: Path) -> None:
    if path.is_dir():
        raise SourceError(
            f"{path} is a folder, not a video: give a video file or a folder that holds pictures"
        )
    try:
        if not path.exists():
            raise SourceError(f"no such file: {path}: check the path")
        if not path.is_file():
            raise SourceError(f"{path} is not a regular file: record it to a file first")
        with path.open("rb") as file:
            is_empty = not file.read(1)
    except OSError as error:
        raise SourceError(_os_error_text(path, error)) from None
    if is_empty:
        raise SourceError(f"{path} is empty (0 bytes): record or copy it again")


def _os_error_text(path: Path, error: OSError) -> str:
    if isinstance(error, PermissionError):
        return f"no permission to read {path}: change its mode or owner"
    return f"cannot read {path}: {error.strerror or error}"


def _open_error(path: Path, error: Exception) -> SourceError:
    if isinstance(error, OSError):  # A failing disk rather than something wrong in the bytes.
        return SourceError(_os_error_text(path, error))
    if _lacks_index(path):
        return SourceError(
            f"{path}: truncated or unfinished recording: no index (moov); recover it with "
            "e.g. untrunc, and record to .mkv, which needs none"
        )
    return SourceError(
        f"{path} is not a video that FFmpeg can read: check the file, or convert it to .mp4 or .mkv"
    )


def _lacks_index(path: Path) -> bool:
    """True if the file is built like MP4 or MOV but has no ``moov`` box at its top level."""
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            offset = 0
            while offset + 8 <= size:
                file.seek(offset)
                header = file.read(16)
                kind, length = header[4:8], int.from_bytes(header[:4], "big")
                if kind == b"moov" or (offset == 0 and kind not in _TOP_LEVEL_BOXES):
                    return False
                if length == 1:
                    length = int.from_bytes(header[8:16], "big")
                if length < 8:
                    break
                offset += length
            return offset > 0
    except OSError:
        return False


def _video_stream(container: InputContainer, path: Path) -> VideoStream:
    # FFmpeg plays any .txt as terminal art, and shows the cover of a song as a video.
    is_text = container.format.name == "tty"
    streams = [] if is_text else [s for s in container.streams.video if not _is_cover(s)]
    if not streams:
        if is_text or not container.streams.audio:
            raise SourceError(
                f"{path} is not a video: it holds no pictures; give a video file or pictures"
            )
        raise SourceError(f"{path} has no video stream, only sound: give a file with pictures")
    # PyAV has no codec context for what it cannot decode, whatever its types say.
    streams = [s for s in streams if getattr(s, "codec_context", None) is not None]
    if not streams:
        raise SourceError(
            f"{path} is in a format that this FFmpeg cannot decode: convert it to H.264"
        )
    stream = max(streams, key=lambda s: s.width * s.height)
    for other in container.streams:
        if other is not stream:
            other.discard = Discard.all
    # Frame threads decode ahead while the caller works on the frame before; each one costs
    # memory for whole pictures and a frame of delay, and beyond four they gain little.
    stream.codec_context.thread_type = cast(Any, "AUTO")
    stream.codec_context.thread_count = min(4, os.cpu_count() or 1)
    return stream


def _is_cover(stream: VideoStream) -> bool:
    return bool(stream.disposition & Disposition.attached_pic)


class PictureMaker:
    """Turns decoded frames into upright uint8 pictures.

    Grey formats give (H, W), all others (H, W, 3) BGR, both full range. The turn comes from the
    first frame's display matrix, which belongs to the whole stream.
    """

    def __init__(self, first: VideoFrame) -> None:
        self._reformatter = VideoReformatter()
        self._turn = _turn_of(first)

    @property
    def is_turned(self) -> bool:
        """True if pictures are turned or mirrored on the way."""
        return self._turn != (False, False, False)

    def picture(self, frame: VideoFrame) -> Image:
        """The picture (H, W) or (H, W, 3). Raises av.FFmpegError if it cannot be converted."""
        is_grey = frame.format.name.startswith(_GREY_PREFIXES)
        # One thread: for these sizes waking a pool costs more than it saves (0.11 ms a frame of
        # 640x480 yuv420p against 0.18 ms with PyAV's default).
        plain = self._reformatter.reformat(
            frame,
            format="gray" if is_grey else "bgr24",
            src_color_range=frame.color_range,
            dst_color_range=_FULL_RANGE,
            threads=1,
        )
        return self._upright(np.asarray(plain.to_ndarray(), np.uint8))

    def _upright(self, image: Image) -> Image:
        is_transposed, flip_x, flip_y = self._turn
        if is_transposed:
            image = np.asarray(cv2.transpose(image), np.uint8)
        if flip_x or flip_y:
            code = -1 if flip_x and flip_y else 1 if flip_x else 0
            image = np.asarray(cv2.flip(image, code), np.uint8)
        return np.ascontiguousarray(image)


def _turn_of(frame: VideoFrame) -> tuple[bool, bool, bool]:
    """(transpose first, then flip x, flip y): the multiple of 90 degrees nearest to the matrix."""
    try:
        matrix = cast(Mapping[str, Any], frame.side_data).get("DISPLAYMATRIX")
    except ValueError:  # Some other side data is newer than PyAV: only the angle can be had.
        return _TURNS[round(frame.rotation / 90) % 4]
    if matrix is None:
        return False, False, False
    # Row vectors: x' = a x + c y and y' = b x + d y; sixteen fractional bits.
    a, b, _, c, d = np.frombuffer(bytes(matrix), np.int32)[:5].tolist()
    if abs(a) + abs(d) >= abs(b) + abs(c):
        return False, a < 0, d < 0
    return True, c < 0, b < 0
