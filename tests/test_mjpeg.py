"""JPEG pictures of cameras: whole ones are decoded, damaged ones refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from v4l2_emulator import encoded

from streamtrack.sources.v4l2.mjpeg import JpegDecoder, whole_jpeg, with_tables


@pytest.fixture(scope="module")
def jpeg() -> bytes:
    rng = np.random.default_rng(5)
    noise = cv2.GaussianBlur(rng.integers(0, 256, (144, 192, 3)).astype(np.uint8), (0, 0), 1.5)
    return encoded(noise, "MJPG")


def test_whole_jpegs_are_decoded(jpeg: bytes) -> None:
    result = JpegDecoder((192, 144)).decode(jpeg + bytes(500))
    assert result is not None
    picture, packet = result
    expected = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert np.abs(picture.astype(int) - expected).mean() < 4
    assert packet == jpeg


def test_grey_jpegs_stay_grey() -> None:
    grey = np.full((48, 64), 77, np.uint8)
    result = JpegDecoder((64, 48)).decode(cv2.imencode(".jpg", grey)[1].tobytes())
    assert result is not None
    assert np.array_equal(result[0], grey)


def test_blocks_beyond_the_granted_size_are_cut_off_and_small_pictures_refused(jpeg: bytes) -> None:
    result = JpegDecoder((188, 140)).decode(jpeg)
    assert result is not None
    assert result[0].shape == (140, 188, 3)
    assert JpegDecoder((192, 145)).decode(jpeg) is None


def test_damaged_jpegs_are_refused_and_the_next_good_one_is_not(jpeg: bytes) -> None:
    decoder = JpegDecoder((192, 144))
    start = jpeg.index(b"\xff\xda") + 14
    rng = np.random.default_rng(1)
    for at in rng.integers(start, len(jpeg) - 600, 20).tolist():
        assert decoder.decode(jpeg[:at]) is None, "cut short"
        assert decoder.decode(jpeg[:at] + b"\xff\xd9") is None, "cut short, with an end"
        assert decoder.decode(jpeg[:at] + jpeg[at + 500 :]) is None, "bytes lost in the middle"
        assert decoder.decode(jpeg) is not None
    for data in (b"", b"\xff\xd8", b"\xff\xd8\xff\xd9", bytes(1000), jpeg[1:]):
        assert decoder.decode(data) is None


def test_missing_huffman_tables_are_put_in(jpeg: bytes) -> None:
    assert with_tables(jpeg) == jpeg
    bare, rest = b"", jpeg
    while (at := rest.find(b"\xff\xc4")) >= 0:
        bare += rest[:at]
        rest = rest[at + 2 + int.from_bytes(rest[at + 2 : at + 4], "big") :]
    bare += rest
    assert b"\xff\xc4" not in bare[:700]
    result = JpegDecoder((192, 144)).decode(bare)
    assert result is not None
    picture, packet = result
    assert len(packet) == len(jpeg)
    shown = cv2.imdecode(np.frombuffer(packet, np.uint8), cv2.IMREAD_COLOR)
    assert np.abs(picture.astype(int) - shown).mean() < 4
    assert whole_jpeg(packet) == packet
