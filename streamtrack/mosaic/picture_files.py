"""Pictures written from top to bottom, a few rows at a time, in bounded memory.

PNG and TIFF are written as the rows come; other formats (JPEG above all) wait in an unnamed
temporary file until OpenCV encodes them. A file takes its name only once it is complete.
"""

from __future__ import annotations

import os
import struct
import tempfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, Protocol

import cv2
import numpy as np

from streamtrack.errors import UsageError
from streamtrack.outputs import output_error
from streamtrack.types import Image, Size

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp")
_MOST_SIDE = {".jpg": 65_500, ".jpeg": 65_500, ".webp": 16_383, ".bmp": 32_767}
_JPEG_QUALITY = 95
_DEFLATE_LEVEL = 1
_BIG_TIFF_BYTES = 3_500_000_000


class RowsWriter(Protocol):
    """Takes the rows of a picture in order."""

    def write(self, rows: Image) -> None:
        """Add rows (n, width, channels), BGR or BGRA. Raises OSError."""
        ...

    def finish(self) -> None:
        """Complete the file once all rows are there. Raises OSError."""
        ...


def check_picture_path(path: Path) -> None:
    """Raise UsageError unless the ending of ``path`` names a picture format that is written."""
    if path.suffix.lower() not in PICTURE_SUFFIXES:
        raise UsageError(
            f"no picture format belongs to the ending of '{path}': "
            f"known are {', '.join(PICTURE_SUFFIXES)}"
        )


def most_side(path: Path) -> int | None:
    """Longest side in pixels that the format can hold, None if there is no such limit."""
    return _MOST_SIDE.get(path.suffix.lower())


def holds_alpha(path: Path) -> bool:
    """True if a picture of this format may be written with four channels, the last opacity."""
    return path.suffix.lower() in (".png", ".tif", ".tiff", ".webp")


@contextmanager
def open_picture(path: Path, size_wh: Size, channels: int = 3) -> Iterator[RowsWriter]:
    """A writer for a picture of a size; the file appears whole when the context is left well.

    Rows have ``channels``: 3 for BGR, 4 for BGRA in the formats that hold it (`holds_alpha`).
    Missing folders are made; pipes and devices are written directly. Raises UsageError for an
    unknown ending, OutputError if the file cannot be written: what was there before then stays.
    """
    check_picture_path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        real = path.resolve()
        if real.is_dir():
            raise IsADirectoryError(21, "is a folder")
        is_device = real.exists() and not real.is_file()
        part = real if is_device else real.with_name(f".{real.name[:100]}.{os.getpid()}.part")
        try:
            with part.open("wb") as file:
                writer = _WRITERS[path.suffix.lower()](file, size_wh, channels, path.suffix.lower())
                yield writer
                writer.finish()
            if not is_device:
                part.replace(real)
        finally:
            if not is_device:
                part.unlink(missing_ok=True)
    except OSError as error:
        raise output_error(path, error) from None


def _differences(rows: Image) -> Image:
    """BGR or BGRA rows as RGB or RGBA, each pixel less the one to its left (modulo 256)."""
    has_alpha = rows.shape[2] == 4
    code = cv2.COLOR_BGRA2RGBA if has_alpha else cv2.COLOR_BGR2RGB
    rgb = np.asarray(cv2.cvtColor(rows, code), np.uint8)
    rgb[:, 1:] -= rgb[:, :-1].copy()
    return rgb


class _PngWriter:
    """PNG with 8 bits a channel, rows filtered by their left neighbours (ISO 15948, section 9)."""

    def __init__(self, file: BinaryIO, size_wh: Size, channels: int, suffix: str) -> None:
        self._file = file
        self._deflate = zlib.compressobj(_DEFLATE_LEVEL)
        file.write(b"\x89PNG\r\n\x1a\n")
        color_type = 6 if channels == 4 else 2
        self._chunk(b"IHDR", struct.pack(">IIBBBBB", *size_wh, 8, color_type, 0, 0, 0))

    def write(self, rows: Image) -> None:
        height, width, channels = rows.shape
        filtered = np.empty((height, 1 + channels * width), np.uint8)
        filtered[:, 0] = 1  # filter type Sub
        filtered[:, 1:] = _differences(rows).reshape(height, -1)
        self._data(self._deflate.compress(filtered.tobytes()))

    def finish(self) -> None:
        self._data(self._deflate.flush())
        self._chunk(b"IEND", b"")

    def _data(self, data: bytes) -> None:
        if data:
            self._chunk(b"IDAT", data)

    def _chunk(self, kind: bytes, data: bytes) -> None:
        check = zlib.crc32(data, zlib.crc32(kind))
        self._file.write(struct.pack(">I", len(data)) + kind + data + struct.pack(">I", check))


class _TiffWriter:
    """TIFF 6.0 in RGB strips, deflated with horizontal differencing; BigTIFF above 3.5 GB."""

    def __init__(self, file: BinaryIO, size_wh: Size, channels: int, suffix: str) -> None:
        self._file = file
        self._size_wh = size_wh
        self._channels = channels
        self._is_big = size_wh[0] * size_wh[1] * channels > _BIG_TIFF_BYTES
        self._rows_a_strip = max(1, min(size_wh[1], 65_536 * 8 // max(1, size_wh[0])))
        self._rest = np.zeros((0, size_wh[0], channels), np.uint8)
        self._offsets: list[int] = []
        self._lengths: list[int] = []
        file.write(b"\0" * 16)

    def write(self, rows: Image) -> None:
        waiting = np.concatenate([self._rest, rows]) if len(self._rest) else rows
        step = self._rows_a_strip
        whole = len(waiting) // step * step
        for start in range(0, whole, step):
            self._strip(waiting[start : start + step])
        self._rest = waiting[whole:].copy()

    def finish(self) -> None:
        if len(self._rest):
            self._strip(self._rest)
        self._directory()

    def _strip(self, rows: Image) -> None:
        data = zlib.compress(_differences(rows).tobytes(), _DEFLATE_LEVEL)
        self._offsets.append(self._file.tell())
        self._lengths.append(len(data))
        self._file.write(data)

    def _directory(self) -> None:
        word = "Q" if self._is_big else "I"
        kind = 16 if self._is_big else 4
        width, height = self._size_wh
        entries: list[tuple[int, int, list[int]]] = [
            (256, 4, [width]),
            (257, 4, [height]),
            (258, 3, [8] * self._channels),
            (259, 3, [8]),  # Adobe deflate
            (262, 3, [2]),  # RGB
            (273, kind, self._offsets),
            (277, 3, [self._channels]),
            (278, 4, [self._rows_a_strip]),
            (279, kind, self._lengths),
            (284, 3, [1]),
            (317, 3, [2]),  # horizontal differencing
        ]
        if self._channels == 4:
            entries.append((338, 3, [2]))  # the last channel is opacity
        entries = [self._placed(*entry) for entry in entries]
        self._align()
        at = self._file.tell()
        self._file.write(struct.pack("<Q" if self._is_big else "<H", len(entries)))
        for tag, of_kind, values in entries:
            self._file.write(self._entry(tag, of_kind, values))
        self._file.write(struct.pack("<" + word, 0))
        self._file.seek(0)
        header = struct.pack("<2sHHHQ", b"II", 43, 8, 0, at)
        self._file.write(header if self._is_big else struct.pack("<2sHI", b"II", 42, at))

    def _placed(self, tag: int, kind: int, values: list[int]) -> tuple[int, int, list[int]]:
        """Values that do not fit into their entry are written here; a bad offset never arises."""
        data = struct.pack(f"<{len(values)}{_TIFF_CODES[kind]}", *values)
        if len(data) <= (8 if self._is_big else 4):
            return tag, kind, values
        self._align()
        at = self._file.tell()
        self._file.write(data)
        return tag, -kind, [len(values), at]

    def _entry(self, tag: int, kind: int, values: list[int]) -> bytes:
        word = "Q" if self._is_big else "I"
        if kind < 0:
            return struct.pack(f"<HH{word}{word}", tag, -kind, *values)
        data = struct.pack(f"<{len(values)}{_TIFF_CODES[kind]}", *values)
        head = struct.pack(f"<HH{word}", tag, kind, len(values))
        return head + data.ljust(8 if self._is_big else 4, b"\0")

    def _align(self) -> None:
        self._file.write(b"\0" * (-self._file.tell() % 8))


_TIFF_CODES = {3: "H", 4: "I", 16: "Q"}


class _WholeWriter:
    """Any format of OpenCV: rows wait on disk, for the encoder wants the whole picture."""

    def __init__(self, file: BinaryIO, size_wh: Size, channels: int, suffix: str) -> None:
        self._file = file
        self._shape = size_wh[1], size_wh[0], channels
        self._suffix = suffix
        # Plain writes, then a map to read from: a map that is written to dies of a full disk.
        self._rows = tempfile.TemporaryFile()  # noqa: SIM115 - closed in finish, unnamed anyway

    def write(self, rows: Image) -> None:
        self._rows.write(np.ascontiguousarray(rows).data)

    def finish(self) -> None:
        with self._rows:
            self._rows.flush()
            shape = self._shape
            picture = np.memmap(self._rows, np.uint8, "r", shape=shape)
            options = (cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY)
            is_jpeg = self._suffix in (".jpg", ".jpeg")
            try:
                data = cv2.imencode(self._suffix, picture, options if is_jpeg else ())[1]
            except cv2.error:
                raise OSError(None, f"a picture of {shape[1]}x{shape[0]} does not fit") from None
        self._file.write(data.tobytes())


_WRITERS: dict[str, Callable[[BinaryIO, Size, int, str], RowsWriter]] = dict.fromkeys(
    PICTURE_SUFFIXES, _WholeWriter
)
_WRITERS |= {".png": _PngWriter, ".tif": _TiffWriter, ".tiff": _TiffWriter}
