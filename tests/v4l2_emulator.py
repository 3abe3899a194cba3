"""Emulated V4L2 cameras: builds tests/v4l2_shim.c and lays out what it reads.

    emulator = Emulator(folder)                       # builds the library (needs a C compiler)
    camera = emulator.add(40, ["MJPG 640 480 30,15", "YUYV 640 480 30"])
    subprocess.Popen([sys.executable, ...], env=emulator.env())      # sees /dev/video40
    camera.fault("drop=20")  ...  camera.fault()      # v4l2_shim.c lists the faults
    camera.unplug()  ...  camera.plug()

Only programs started with `Emulator.env` see the cameras. Each frame carries its number in a row of
black and white squares (`encode_number`, `decode_number`); the number is the driver's sequence
number modulo the count of frames.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]

SHIM = Path(__file__).with_name("v4l2_shim.c")
SQUARE_PX = 16
BITS = 8
MOST_FRAMES = 1 << BITS
DEFAULT_FRAMES = 64


def compiler() -> str | None:
    """The C compiler, or None: tests that need it are skipped then."""
    return shutil.which(os.environ.get("CC", "cc"))


def encode_number(picture: Image, number: int) -> Image:
    """A copy with the number in squares at the top left: white, black, then bits, low first."""
    marked = picture.copy()
    for place, bit in enumerate([1, 0, *((number >> k & 1) for k in range(BITS))]):
        marked[:SQUARE_PX, place * SQUARE_PX : (place + 1) * SQUARE_PX] = 235 if bit else 20
    return marked


def decode_number(picture: Image) -> int | None:
    """The number of `encode_number`, or None if the picture does not show one."""
    grey = picture if picture.ndim == 2 else picture.mean(axis=2)
    middle = slice(SQUARE_PX // 4, SQUARE_PX * 3 // 4)
    bits = []
    for place in range(BITS + 2):
        left = place * SQUARE_PX
        square = grey[middle, left + middle.start : left + middle.stop]
        if square.size == 0 or 70 < square.mean() < 185 or np.ptp(square) > 60:
            return None
        bits.append(bool(square.mean() > 128))
    if bits[:2] != [True, False]:
        return None
    return sum(bit << k for k, bit in enumerate(bits[2:]))


def default_picture(width: int, height: int, number: int) -> Image:
    """A coloured square on a coloured slope, moving to the right 4 px a frame."""
    slope = np.broadcast_to(np.linspace(60, 180, width, dtype=np.uint8), (height, width))
    picture = np.dstack([slope, slope, 255 - slope])
    side = min(width, height) // 6
    x, y = number * 4 % (width - side), height // 2
    picture[y : y + side, x : x + side] = (40, 200, 60)
    return picture


def encoded(picture: Image, fourcc: str, stride: int = 0, is_full_range: bool = False) -> bytes:
    """A BGR picture in a V4L2 pixel format; raw rows are padded to ``stride`` bytes.

    Empty for formats that nobody here can make.
    """
    if fourcc == "MJPG":
        # 4:2:2, as cameras do.
        flags = [cv2.IMWRITE_JPEG_QUALITY, 90, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x211111]
        return cv2.imencode(".jpg", picture, flags)[1].tobytes()
    if fourcc in ("BGR3", "RGB3"):
        rows = picture if fourcc == "BGR3" else picture[..., ::-1]
        return _padded(rows.reshape(len(picture), -1), stride)
    y, u, v = _yuv(picture, is_full_range)
    if fourcc == "GREY":
        return _padded(y, stride)
    if fourcc in ("YUYV", "UYVY"):
        rows = np.empty((*y.shape, 2), np.uint8)
        luma, chroma = (0, 1) if fourcc == "YUYV" else (1, 0)
        rows[..., luma] = y
        rows[:, 0::2, chroma] = (u[:, 0::2].astype(int) + u[:, 1::2] + 1) // 2
        rows[:, 1::2, chroma] = (v[:, 0::2].astype(int) + v[:, 1::2] + 1) // 2
        return _padded(rows.reshape(len(y), -1), stride)
    half = (picture.shape[1] // 2, picture.shape[0] // 2)
    u, v = (np.asarray(cv2.resize(c, half, interpolation=cv2.INTER_AREA)) for c in (u, v))
    if fourcc == "NV12":
        return _padded(y, stride) + _padded(np.dstack([u, v]).reshape(half[1], -1), stride)
    if fourcc == "YU12":
        return _padded(y, stride) + _padded(u, stride // 2) + _padded(v, stride // 2)
    return b""


def _yuv(picture: Image, is_full_range: bool) -> tuple[Image, Image, Image]:
    """BT.601 (ITU-R BT.601-7), 16..235 or 0..255."""
    b, g, r = (picture[..., k].astype(float) for k in range(3))
    y = 0.299 * r + 0.587 * g + 0.114 * b
    u, v = (b - y) / 1.772, (r - y) / 1.402
    if not is_full_range:
        y, u, v = 16 + y * 219 / 255, u * 224 / 255, v * 224 / 255
    planes = (np.clip(np.rint(plane), 0, 255).astype(np.uint8) for plane in (y, u + 128, v + 128))
    return tuple(planes)  # type: ignore[return-value]


def _padded(rows: Image, stride: int) -> bytes:
    extra = max(0, stride - rows.shape[1])
    return np.pad(rows, ((0, 0), (0, extra)), constant_values=99).tobytes()


class EmulatedCamera:
    """One camera; `Emulator.add` makes it. Programs that see it can make a handle of their own:
    ``EmulatedCamera(Path(os.environ["V4L2_SHIM_DIR"]), 40)``.
    """

    def __init__(self, root: Path, number: int) -> None:
        self.root = root
        self.number = number
        self.path = f"/dev/video{number}"
        self.by_id = f"/dev/v4l/by-id/usb-Emulated_Camera_{number & ~1}-video-index{number & 1}"
        self._folder = root / f"video{number}"
        self._node = root / "dev" / f"video{number}"
        self._link = root / self.by_id.lstrip("/")
        self._folder.mkdir(parents=True, exist_ok=True)

    def set_modes(self, modes: Sequence[str], pictures: Sequence[Image] | None = None) -> None:
        """What it offers from its next opening on; ``pictures`` (BGR) are resized to each mode."""
        for mode in modes:
            fourcc, width, height, *rest = mode.split()
            self._write_frames(fourcc, (int(width), int(height)), rest, pictures)
        self._replace("modes", "\n".join(modes) + "\n")

    def _write_frames(
        self,
        fourcc: str,
        size_wh: tuple[int, int],
        options: list[str],
        pictures: Sequence[Image] | None,
    ) -> None:
        folder = self._folder / f"{fourcc}-{size_wh[0]}x{size_wh[1]}"
        if folder.exists() and pictures is None:
            return
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        stride = next((int(o.partition("=")[2]) for o in options if o.startswith("stride=")), 0)
        for number in range(min(len(pictures), MOST_FRAMES) if pictures else DEFAULT_FRAMES):
            if pictures:
                sized = cv2.resize(pictures[number], size_wh, interpolation=cv2.INTER_AREA)
            else:
                sized = default_picture(*size_wh, number)
            data = encoded(
                encode_number(np.asarray(sized, np.uint8), number),
                fourcc,
                stride,
                "full" in options,
            )
            (folder / f"{number:05d}.bin").write_bytes(data)

    def set_kind(self, kind: str) -> None:
        """``capture``, ``meta``, ``output`` or ``m2m``."""
        self._replace("kind", kind)

    def fault(self, words: str = "") -> None:
        """What goes wrong from now on, in the words of v4l2_shim.c; none ends all faults."""
        self._replace("fault", words)

    def unplug(self) -> None:
        self._link.unlink(missing_ok=True)
        self._node.unlink(missing_ok=True)

    def plug(self) -> None:
        self._node.touch()
        self._link.parent.mkdir(parents=True, exist_ok=True)
        self._link.unlink(missing_ok=True)
        self._link.symlink_to(f"../../video{self.number}")

    def log(self) -> list[str]:
        """What programs asked of it so far: OPEN, S_FMT ..., S_CTRL ..., STREAMON, CLOSE."""
        path = self._folder / "log"
        return path.read_text().splitlines() if path.exists() else []

    def _replace(self, leaf: str, text: str) -> None:
        """At once, so that the shim never reads half a file."""
        new = self._folder / f".{leaf}"
        new.write_text(text)
        new.replace(self._folder / leaf)


class Emulator:
    """The emulated cameras of one folder."""

    def __init__(self, folder: Path) -> None:
        """Build the shim there. Raises RuntimeError without a C compiler (see `compiler`)."""
        self.root = folder.resolve() / "v4l2"
        (self.root / "dev").mkdir(parents=True)
        self.library = build_shim(self.root)

    def env(self) -> dict[str, str]:
        """The environment in which a program sees the cameras."""
        preload = " ".join(filter(None, [str(self.library), os.environ.get("LD_PRELOAD")]))
        return {**os.environ, "LD_PRELOAD": preload, "V4L2_SHIM_DIR": str(self.root)}

    def add(
        self,
        number: int,
        modes: Sequence[str],
        pictures: Sequence[Image] | None = None,
        kind: str = "capture",
    ) -> EmulatedCamera:
        """A plugged-in camera ``/dev/videoNUMBER``; modes as in v4l2_shim.c, the default first."""
        camera = EmulatedCamera(self.root, number)
        camera.set_modes(modes, pictures)
        camera.set_kind(kind)
        camera.plug()
        return camera


def build_shim(folder: Path) -> Path:
    """Compile tests/v4l2_shim.c into a folder; the path of the library."""
    cc = compiler()
    if cc is None:
        raise RuntimeError("no C compiler (cc) to build the emulated camera with")
    library = folder / "v4l2_shim.so"
    command = [cc, "-O2", "-shared", "-fPIC", "-o", library, SHIM, "-ldl", "-lpthread"]
    subprocess.run(command, check=True, capture_output=True)
    return library
