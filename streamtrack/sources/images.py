"""Pictures from a folder, a glob or a list, as a source of frames."""

from __future__ import annotations

import glob
import logging
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.errors import SourceError
from streamtrack.types import Frame, Image, Skipped, SourceInfo

_log = logging.getLogger("streamtrack.sources")

PICTURE_RATE_HZ = 30.0
"""Pictures have no clock; they are given this rate: time_s = index / PICTURE_RATE_HZ."""

PICTURE_EXTENSIONS = frozenset(
    {".avif", ".bmp", ".dib", ".exr", ".hdr", ".jp2", ".jpe", ".jpeg", ".jpg", ".pbm"}
    | {".pgm", ".png", ".pnm", ".ppm", ".tif", ".tiff", ".webp"}
)
"""Endings taken for pictures when a folder is read."""


class ImageSource:
    """Pictures, read one at a time in natural order (2 before 10), or in the order of a list.

    Pictures are uint8 (H, W, 3) BGR, or (H, W) if the first one is grey; 16-bit values are scaled
    by 1 / 257, floating-point ones taken from 0..1, transparency is composited on black, and EXIF
    orientation is applied. All frames have the first picture's size and channels: a picture of
    another size, or one that cannot be read, is left out and named in `skipped`.

    ``Frame.index`` is the place in the list, those left out included, ``Frame.name`` the file's
    name, and ``Frame.time_s`` is index / 30. Pictures can be iterated over again.
    """

    def __init__(self, source: str | Path | Sequence[str | Path]) -> None:
        """Find the pictures and read the first. Raises SourceError if none can be read."""
        self._paths = find_pictures(source)
        self._skipped: list[Skipped] = []
        first, self._first_index = self._first_picture(source)
        self._shape = first.shape
        self._info = SourceInfo(
            uri=_uri_of(source),
            size_wh=(first.shape[1], first.shape[0]),
            rate_hz=PICTURE_RATE_HZ,
            frame_count=len(self._paths),
        )
        self._first: Image | None = first

    @property
    def info(self) -> SourceInfo:
        """``frame_count`` counts all pictures found, those left out included."""
        return self._info

    @property
    def skipped(self) -> Sequence[Skipped]:
        """Pictures left out so far, in order."""
        return tuple(self._skipped)

    @property
    def corrupt_packets(self) -> int:
        """Always 0: pictures that cannot be read are named in `skipped`."""
        return 0

    @property
    def shortfall(self) -> str:
        """Always empty: what is missing is named in `skipped`."""
        return ""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self._first = None

    def __iter__(self) -> Iterator[Frame]:
        # Those before the first readable picture were named when the source was opened.
        self._skipped = [s for s in self._skipped if s.index < self._first_index]
        for index in range(self._first_index, len(self._paths)):
            image = self._picture_at(index)
            if image is not None:
                yield Frame(index, index / PICTURE_RATE_HZ, image, self._paths[index].name)

    def _first_picture(self, source: str | Path | Sequence[str | Path]) -> tuple[Image, int]:
        for index, path in enumerate(self._paths):
            try:
                return read_picture(path), index
            except SourceError as error:
                self._skip(index, str(error))
        raise SourceError(
            f"none of the {len(self._paths)} pictures of {_uri_of(source)} can be read; "
            f"the first: {self._skipped[0].reason}"
        )

    def _picture_at(self, index: int) -> Image | None:
        if index == self._first_index and self._first is not None:
            image, self._first = self._first, None
            return image
        try:
            image = read_picture(self._paths[index])
        except SourceError as error:
            self._skip(index, str(error))
            return None
        if image.shape[:2] != self._shape[:2]:
            (height, width), (want_height, want_width) = image.shape[:2], self._shape[:2]
            self._skip(index, f"is {width}x{height}, the first is {want_width}x{want_height}")
            return None
        return _with_channels_of(image, len(self._shape))

    def _skip(self, index: int, reason: str) -> None:
        name = self._paths[index].name
        self._skipped.append(Skipped(index, name, reason))
        _log.warning("%s is left out: %s", name, reason)


def read_picture(path: str | Path) -> Image:
    """Read one picture as uint8 (H, W, 3) BGR or (H, W) grey, upright.

    Raises SourceError if it is missing, empty or no picture that OpenCV can read.
    """
    path = Path(path)
    try:
        # Not cv2.imread: that one prints its own complaints and fails on some names.
        data = np.fromfile(path, np.uint8)
    except FileNotFoundError:
        raise SourceError("no such file: check the path") from None
    except OSError as error:
        raise SourceError(f"cannot be read: {error.strerror or error}") from None
    if not data.size:
        raise SourceError("is empty (0 bytes): copy it again")
    decoded = _decode(data)
    if decoded is None:
        raise SourceError("is damaged or no picture that OpenCV can read")
    return _composited(_eight_bit(decoded))


def read_coverage(path: str | Path) -> Image | None:
    """Opacity (H, W) of a picture that `read_picture` can read; None if it is opaque all over."""
    with Path(path).open("rb") as file:
        start = file.read(32)
    is_opaque_png = start[1:4] == b"PNG" and start[25] not in (4, 6)
    if is_opaque_png or start[:2] in (b"\xff\xd8", b"BM"):
        return None
    decoded = _decode(np.fromfile(path, np.uint8))
    if decoded is None or decoded.ndim == 2 or decoded.shape[2] not in (2, 4):
        return None
    opacity = _eight_bit(np.ascontiguousarray(decoded[:, :, -1]))
    return None if np.min(opacity) == 255 else opacity


def _decode(data: npt.NDArray[np.uint8]) -> npt.NDArray[Any] | None:
    with _quiet_opencv():
        try:
            if _is_jpeg(data):
                return cv2.imdecode(data, cv2.IMREAD_ANYCOLOR)  # grey stays grey, and all stand
            # Unchanged keeps 16 bits and alpha, but also leaves the picture lying.
            raw = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
            if raw is None:
                return None
            if raw.dtype == np.uint8 and (raw.ndim == 2 or raw.shape[2] == 3) and _may_lie(data):
                raw = cv2.imdecode(data, cv2.IMREAD_ANYCOLOR)
        except cv2.error:  # A size beyond OpenCV's limit, for one.
            return None
    return None if raw is None or raw.size == 0 else np.asarray(raw)


def _may_lie(data: npt.NDArray[np.uint8]) -> bool:
    """True if there may be an EXIF orientation: saves decoding twice where there is none."""
    text = data.tobytes()
    return any(mark in text for mark in (b"Exif\0", b"eXIf", b"EXIF"))


def _is_jpeg(data: npt.NDArray[np.uint8]) -> bool:
    return data[:2].tobytes() == b"\xff\xd8"


@contextmanager
def _quiet_opencv() -> Iterator[None]:
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


def _eight_bit(image: npt.NDArray[Any]) -> Image:
    if image.dtype == np.uint8:
        return image
    if image.dtype == np.uint16:
        return cv2.convertScaleAbs(image, alpha=1 / 257).astype(np.uint8, copy=False)
    if np.issubdtype(image.dtype, np.floating):
        return np.asarray(np.clip(np.nan_to_num(image), 0, 1) * 255 + 0.5, np.uint8)
    top = float(np.iinfo(image.dtype).max)
    return np.asarray(np.clip(image / top, 0, 1) * 255 + 0.5, np.uint8)


def _composited(image: Image) -> Image:
    """Drop a channel of transparency after compositing on black."""
    if image.ndim == 2 or image.shape[2] == 3:
        return image
    if image.shape[2] == 1:
        return image[:, :, 0]
    colour, alpha = image[:, :, :-1], image[:, :, -1]
    flat = colour if colour.shape[2] == 3 else colour[:, :, :1]
    if np.any(alpha < 255):
        flat = (flat * (alpha[:, :, None] / np.float32(255)) + np.float32(0.5)).astype(np.uint8)
    return np.ascontiguousarray(flat if flat.shape[2] == 3 else flat[:, :, 0])


def _with_channels_of(image: Image, ndim: int) -> Image:
    if image.ndim == ndim:
        return image
    code = cv2.COLOR_GRAY2BGR if ndim == 3 else cv2.COLOR_BGR2GRAY
    return np.asarray(cv2.cvtColor(image, code), np.uint8)


def find_pictures(source: str | Path | Sequence[str | Path]) -> list[Path]:
    """The files of a folder or glob in natural order, or a list as it is. Raises SourceError."""
    if not isinstance(source, str | Path):
        if not source:
            raise SourceError("no pictures were given: name at least one")
        return [Path(path) for path in source]
    folder = Path(source)
    if folder.is_dir():
        found = _pictures_in(folder, source)
    elif folder.exists():
        return [folder]
    elif glob.has_magic(str(source)):
        found = _pictures_matching(str(source))
    else:
        raise SourceError(f"no such file or folder: {source}: check the path")
    return sorted(found, key=_natural_key)


def _pictures_matching(pattern: str) -> list[Path]:
    # Path.glob takes no absolute patterns.
    files = [Path(name) for name in glob.glob(pattern) if Path(name).is_file()]  # noqa: PTH207
    if not files:
        raise SourceError(f"no file matches {pattern}: check the pattern, and quote it")
    # "folder/*" means its pictures, but a pattern that matches none of those means what it says.
    return [path for path in files if is_picture_name(path)] or files


def _pictures_in(folder: Path, source: str | Path) -> list[Path]:
    try:
        entries = list(folder.iterdir())
    except OSError as error:
        raise SourceError(f"cannot read the folder {source}: {error.strerror}") from None
    found = [p for p in entries if is_picture_name(p) and p.name[0] != "." and p.is_file()]
    if not found:
        raise SourceError(
            f"the folder {source} holds no pictures: known endings are "
            + ", ".join(sorted(PICTURE_EXTENSIONS))
        )
    return found


def is_picture_name(path: Path) -> bool:
    """True if the file's ending is that of a picture."""
    return path.suffix.lower() in PICTURE_EXTENSIONS


def _natural_key(path: Path) -> tuple[list[tuple[int, str]], str]:
    """Digits compare as numbers; the plain name settles what is then still equal."""
    parts = re.split(r"(\d+)", str(path).casefold())
    key = [(int(part), "") if part.isdecimal() else (0, part) for part in parts]
    return key, str(path)


def _uri_of(source: str | Path | Sequence[str | Path]) -> str:
    if isinstance(source, str | Path):
        return str(source)
    return str(source[0]) if len(source) == 1 else f"{source[0]} +{len(source) - 1}"
