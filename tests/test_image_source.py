"""ImageSource: order, formats and everything a folder of pictures may hold."""

from __future__ import annotations

import re
import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from streamtrack.errors import SourceError
from streamtrack.sources.base import FrameSource
from streamtrack.sources.images import PICTURE_RATE_HZ, ImageSource, read_picture
from streamtrack.types import Image

EXIF_TURN_CLOCKWISE = 6


def picture(shade: int = 200) -> Image:
    """A picture (24, 32, 3), bright at the top left."""
    image = np.full((24, 32, 3), 40, np.uint8)
    image[:12, :16] = shade, shade // 2, shade // 4
    return image


def save(path: Path, image: Any = None) -> Path:
    """Write a picture through memory: `cv2.imwrite` has its own ideas about some names."""
    data = cv2.imencode(path.suffix, picture() if image is None else image)[1]
    path.write_bytes(data.tobytes())
    return path


def save_with_exif(path: Path, image: Image, orientation: int) -> Path:
    jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
    tiff = b"II*\0\x08\0\0\0\x01\0" + struct.pack("<HHII", 0x0112, 3, 1, orientation) + b"\0" * 4
    exif = b"Exif\0\0" + tiff
    path.write_bytes(jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:])
    return path


def names(source: ImageSource) -> list[str]:
    return [frame.name for frame in source]


def test_a_folder_is_read_in_natural_order(tmp_path: Path) -> None:
    for name in ("p10.png", "p2.png", "p1.JPG", "P03 ä.png"):
        save(tmp_path / name)
    for name in ("notes.txt", ".hidden.png", "clip.mp4"):
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "sub.png").mkdir()
    with ImageSource(tmp_path) as source:
        assert isinstance(source, FrameSource)
        frames = list(source)
    assert [f.name for f in frames] == ["p1.JPG", "p2.png", "P03 ä.png", "p10.png"]
    assert [f.index for f in frames] == [0, 1, 2, 3]
    assert [f.time_s for f in frames] == [i / PICTURE_RATE_HZ for i in range(4)]
    assert source.info.frame_count == 4
    assert source.info.size_wh == (32, 24)
    assert source.skipped == ()
    assert source.corrupt_packets == 0


def test_a_glob_and_a_list(tmp_path: Path) -> None:
    paths = [save(tmp_path / f"p {i}.png") for i in (10, 9, 1)]
    (tmp_path / "p 2.txt").write_bytes(b"x")
    assert names(ImageSource(f"{tmp_path}/p*")) == ["p 1.png", "p 9.png", "p 10.png"]
    assert names(ImageSource(paths)) == ["p 10.png", "p 9.png", "p 1.png"]
    assert names(ImageSource([paths[0], paths[0]])) == ["p 10.png", "p 10.png"]
    assert names(ImageSource(paths[2])) == ["p 1.png"]


def test_pictures_can_be_read_again(tmp_path: Path) -> None:
    (tmp_path / "1.png").write_bytes(b"bad")
    save(tmp_path / "2.png")
    (tmp_path / "3.png").write_bytes(b"bad")
    source = ImageSource(tmp_path)
    assert names(source) == names(source) == ["2.png"]
    assert [s.index for s in source.skipped] == [0, 2]


def test_names_that_look_like_patterns_are_files(tmp_path: Path) -> None:
    path = save(tmp_path / "a[1]*.png")
    assert names(ImageSource(str(path))) == ["a[1]*.png"]


def sixteen_bit(shape: tuple[int, ...]) -> np.ndarray:
    return np.linspace(0, 65535, int(np.prod(shape))).reshape(shape).astype(np.uint16)


FORMATS: list[tuple[str, Any, Any]] = [
    ("a.png", picture(), picture()),
    ("a.bmp", picture(), picture()),
    ("a.webp", picture(), picture()),
    ("a.tiff", picture(), picture()),
    ("grey.png", picture()[:, :, 0], picture()[:, :, 0]),
    ("grey16.png", sixteen_bit((24, 32)), (sixteen_bit((24, 32)) / 257).round()),
    ("colour16.tif", sixteen_bit((24, 32, 3)), (sixteen_bit((24, 32, 3)) / 257).round()),
    ("opaque.png", np.dstack([picture(), np.full((24, 32), 255, np.uint8)]), picture()),
    ("clear.png", np.dstack([picture(), np.zeros((24, 32), np.uint8)]), 0 * picture()),
    ("half.png", np.dstack([picture(), np.full((24, 32), 51, np.uint8)]), picture() / 5),
    (
        "half16.png",
        np.dstack([picture(), np.full((24, 32), 51, np.uint8)]).astype(np.uint16) * 257,
        picture() / 5,
    ),
]


@pytest.mark.parametrize(("name", "stored", "expected"), FORMATS, ids=[f[0] for f in FORMATS])
def test_formats_become_eight_bit_bgr_or_grey(
    tmp_path: Path, name: str, stored: Any, expected: Any
) -> None:
    tolerance = 12 if name.endswith("webp") else 1
    (frame,) = ImageSource([save(tmp_path / name, stored)])
    assert frame.image.dtype == np.uint8
    assert frame.image.shape == expected.shape
    assert np.abs(frame.image.astype(float) - expected).max() <= tolerance


@pytest.mark.parametrize("is_grey", [False, True])
def test_exif_orientation_is_applied(tmp_path: Path, is_grey: bool) -> None:
    lying = picture()[:, :, 0] if is_grey else picture()
    path = save_with_exif(tmp_path / "a.jpg", lying, EXIF_TURN_CLOCKWISE)
    upright = np.rot90(lying, -1)
    image = read_picture(path)
    assert image.shape == upright.shape
    assert np.abs(image.astype(int) - upright).mean() < 8


@pytest.mark.parametrize(("first", "other"), [(0, 1), (1, 0)])
def test_all_frames_have_the_channels_of_the_first(tmp_path: Path, first: int, other: int) -> None:
    images = (picture(), picture()[:, :, 0])
    paths = [save(tmp_path / "1.png", images[first]), save(tmp_path / "2.png", images[other])]
    frames = list(ImageSource(paths))
    assert frames[0].image.shape == frames[1].image.shape == images[first].shape


def truncated(path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (24, 32, 3)).astype(np.uint8)
    path.write_bytes(save(path, noise).read_bytes()[:60])


def far_too_large(path: Path) -> None:
    """A PNG header that promises 100,000 x 100,000 pixels."""
    header = b"IHDR" + struct.pack(">IIBBBBB", 100_000, 100_000, 8, 2, 0, 0, 0)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + struct.pack(">I", 13)
        + header
        + struct.pack(">I", zlib.crc32(header))
    )


BAD: list[tuple[str, Any, str]] = [
    ("bad.png", lambda p: p.write_bytes(b""), r"is empty \(0 bytes\)"),
    ("bad.jpg", lambda p: p.write_text("hello"), "is damaged or no picture"),
    ("bad.png", truncated, "is damaged or no picture"),
    ("bad.jpg", truncated, "is damaged or no picture"),
    ("bad.png", far_too_large, "is damaged or no picture"),
    ("bad.png", lambda p: save(p, picture()[:20]), "is 32x20, the first is 32x24"),
    ("bad.png", lambda p: p.mkdir(), "cannot be read: Is a directory"),
    ("bad.png", lambda _: None, "no such file"),
]


@pytest.mark.parametrize(("name", "make", "reason"), BAD)
def test_a_bad_picture_is_named_and_left_out(
    tmp_path: Path,
    name: str,
    make: Any,
    reason: str,
    caplog: pytest.LogCaptureFixture,
    capfd: pytest.CaptureFixture[str],
) -> None:
    make(tmp_path / name)
    paths = [save(tmp_path / "1.png"), tmp_path / name, save(tmp_path / "2.png")]
    with ImageSource(paths) as source:
        frames = list(source)
    assert [(f.index, f.name) for f in frames] == [(0, "1.png"), (2, "2.png")]
    (skipped,) = source.skipped
    assert (skipped.index, skipped.name) == (1, name)
    assert re.search(reason, skipped.reason)
    assert any(f"{name} is left out: {skipped.reason}" in m for m in caplog.messages)
    assert capfd.readouterr().err == ""


def test_the_first_readable_picture_sets_the_size(tmp_path: Path) -> None:
    (tmp_path / "1.png").write_bytes(b"bad")
    save(tmp_path / "2.png")
    save(tmp_path / "3.png", picture()[:20])
    source = ImageSource(tmp_path)
    assert [s.name for s in source.skipped] == ["1.png"]
    assert [f.index for f in source] == [1]
    assert [s.name for s in source.skipped] == ["1.png", "3.png"]


def test_sources_without_a_picture(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(SourceError, match=r"holds no pictures: known endings are .*\.jpg"):
        ImageSource(tmp_path)
    (tmp_path / "1.png").write_bytes(b"bad")
    with pytest.raises(SourceError, match=r"none of the 1 pictures .* the first: is damaged"):
        ImageSource(tmp_path)
    with pytest.raises(SourceError, match="no file matches"):
        ImageSource(f"{tmp_path}/*.webp")
    with pytest.raises(SourceError, match="no such file or folder"):
        ImageSource(tmp_path / "missing")
    with pytest.raises(SourceError, match="no pictures were given"):
        ImageSource([])


def test_pictures_are_read_only_when_their_turn_comes(tmp_path: Path) -> None:
    paths = [save(tmp_path / f"{i}.png") for i in range(3)]
    frames = iter(ImageSource(paths))
    next(frames)
    paths[1].unlink()
    assert [f.name for f in frames] == ["2.png"]
