"""VideoWriter: what it writes is read back with PyAV and VideoSource."""

from __future__ import annotations

import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from streamtrack.errors import OutputError, UsageError
from streamtrack.sources.video import VideoSource
from streamtrack.sources.writer import VideoWriter
from streamtrack.types import Frame, Image

TIMES_S = [5.0, 5.01, 5.1, 5.14, 6.0]
"""Not evenly spaced, and not from 0."""


def picture(index: int, size_wh: tuple[int, int] = (64, 48)) -> Image:
    width, height = size_wh
    y, x = np.mgrid[:height, :width]
    image = np.stack([2 * x % 250, 3 * y % 250, 20 * index + 0 * x], -1).astype(np.uint8)
    return cv2.GaussianBlur(image, (0, 0), 2).astype(np.uint8)


def write(path: Path, images: list[Image], times_s: list[float], **options: Any) -> None:
    with VideoWriter(path, rate_hz=25, **options) as writer:
        for image, time_s in zip(images, times_s, strict=True):
            writer.write(image, time_s)


def read(path: Path) -> list[Frame]:
    with VideoSource(path) as source:
        return list(source)


@pytest.mark.parametrize(
    ("name", "codec", "options", "grain_s", "tolerance"),
    [
        ("a.mp4", "h264", {}, 1e-5, 6),
        ("a.MOV", "h264", {}, 1e-5, 6),
        ("a.mkv", "h264", {}, 1e-3, 6),
        ("a.webm", "vp9", {}, 1e-3, 8),
        ("a.avi", "mjpeg", {}, 0.04, 6),
        ("a.mkv", "ffv1", {"lossless": True}, 1e-3, 0),
        ("new/folder/ä b.mp4", "h264", {}, 1e-5, 6),
    ],
)
def test_pictures_and_times_come_back(
    tmp_path: Path, name: str, codec: str, options: dict[str, Any], grain_s: float, tolerance: float
) -> None:
    path = tmp_path / name
    images = [picture(i) for i in range(len(TIMES_S))]
    write(path, images, TIMES_S, **options)
    with av.open(str(path)) as container:
        assert container.streams.video[0].codec_context.name == codec
        assert not container.streams.video[0].codec_context.has_b_frames
    frames = read(path)
    assert [f.time_s for f in frames] == pytest.approx([t - 5 for t in TIMES_S], abs=grain_s)
    for frame, image in zip(frames, images, strict=True):
        assert np.abs(frame.image.astype(int) - image).mean() <= tolerance


def test_gaps_in_avi_are_no_damage(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write(tmp_path / "a.avi", [picture(0), picture(1)], [0, 4])
    assert [f.time_s for f in read(tmp_path / "a.avi")] == pytest.approx([0, 4])
    assert not caplog.messages


def test_what_was_written_can_be_copied_packet_by_packet(tmp_path: Path) -> None:
    write(tmp_path / "a.mp4", [picture(i) for i in range(5)], TIMES_S)
    with VideoSource(tmp_path / "a.mp4", with_packets=True) as source:
        assert source.info.packet_codec == "h264"


def test_odd_sizes_are_padded_unless_lossless(tmp_path: Path) -> None:
    image = picture(3, (63, 47))
    write(tmp_path / "a.mp4", [image], [0])
    write(tmp_path / "a.mkv", [image], [0], lossless=True)
    (padded,), (exact,) = read(tmp_path / "a.mp4"), read(tmp_path / "a.mkv")
    assert padded.size_wh == (64, 48)
    assert np.abs(padded.image[:47, :63].astype(int) - image).mean() < 6
    assert np.array_equal(exact.image, image)


def test_grey_pictures(tmp_path: Path) -> None:
    grey = np.tile(np.arange(0, 256, 4, dtype=np.uint8), (48, 1))
    write(tmp_path / "a.mp4", [grey], [0])
    (frame,) = read(tmp_path / "a.mp4")
    assert np.abs(frame.image.astype(int) - grey[:, :, None]).mean() < 4


def test_a_picture_of_another_size_is_fitted_in(tmp_path: Path) -> None:
    white = np.full((48, 48, 3), 255, np.uint8)
    images = [picture(0), white, white[:24, :24], np.full((96, 20), 255, np.uint8)]
    write(tmp_path / "a.mkv", images, [0, 1, 2, 3], lossless=True)
    frames = read(tmp_path / "a.mkv")
    assert {f.size_wh for f in frames} == {(64, 48)}
    for frame in frames[1:3]:
        assert np.all(frame.image[:, 8:56] == 255)
        assert not frame.image[:, :8].any()
    assert np.all(frames[3].image[:, 32] == 255)


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.avi"])
def test_times_that_do_not_increase_are_moved_on(tmp_path: Path, name: str) -> None:
    write(tmp_path / name, [picture(i) for i in range(5)], [1.0, 1.0, 0.5, 1.2, 1.2])
    times = [f.time_s for f in read(tmp_path / name)]
    assert len(times) == 5
    assert np.all(np.diff(times) > 0)


def test_the_file_is_finished_when_the_loop_raises(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), VideoWriter(tmp_path / "a.mp4", rate_hz=25) as writer:
        for i in range(5):
            writer.write(picture(i), i / (3 - i) if i == 3 else i / 25)
    assert len(read(tmp_path / "a.mp4")) == 3


def test_nothing_written_makes_no_file(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "a.mp4", rate_hz=25):
        pass
    assert not (tmp_path / "a.mp4").exists()


@pytest.mark.parametrize(
    ("name", "options", "match"),
    [
        ("a.gif", {}, r"unknown video ending '.gif' of a.gif: known are .mp4, .mov, .mkv"),
        ("a", {}, "unknown video ending '' of a"),
        ("a.mp4", {"lossless": True}, "lossless video is .mkv only"),
        ("a.mp4", {"rate_hz": 0}, "rate_hz must be in"),
        ("a.mp4", {"rate_hz": float("nan")}, "rate_hz must be in"),
    ],
)
def test_what_cannot_be_right(
    tmp_path: Path, name: str, options: dict[str, Any], match: str
) -> None:
    with pytest.raises(UsageError, match=match):
        VideoWriter(tmp_path / name, **{"rate_hz": 25, **options})


def test_what_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    (tmp_path / "folder.mp4").mkdir()
    with pytest.raises(OutputError, match=r"cannot write .*: check the folder's mode"):
        VideoWriter(tmp_path / "file" / "a.mp4", rate_hz=25)
    with pytest.raises(OutputError, match="it is a folder"):
        VideoWriter(tmp_path / "folder.mp4", rate_hz=25)
    with (
        pytest.raises(OutputError, match=r"cannot write .*a.mp4"),
        VideoWriter(tmp_path / "gone" / "a.mp4", rate_hz=25) as writer,
    ):
        (tmp_path / "gone").rmdir()
        writer.write(picture(0), 0)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.avi"])
def test_a_full_disk(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.symlink_to("/dev/full")
    for frames in (3, 60):  # Fails on closing, or on writing.
        writer = VideoWriter(path, rate_hz=25)
        with pytest.raises(OutputError, match=r"No space left on device.*free space"), writer:
            for i in range(frames):
                writer.write(picture(i), i / 25)
        writer.close()


def test_writing_on_after_a_failure_is_refused(tmp_path: Path) -> None:
    writer = VideoWriter(tmp_path / "gone" / "a.mp4", rate_hz=25)
    (tmp_path / "gone").rmdir()
    with pytest.raises(OutputError, match="cannot write"):
        for i in range(60):
            writer.write(picture(i), i / 25)
    with pytest.raises(OutputError, match="cannot go on writing"):
        writer.write(picture(0), 9)


_CHILD = """
import os, resource, sys
import numpy as np
from streamtrack.errors import OutputError
from streamtrack.sources.writer import VideoWriter

if sys.argv[2] == "full":
    resource.setrlimit(resource.RLIMIT_FSIZE, (150_000, 150_000))
rng = np.random.default_rng(0)
with VideoWriter(sys.argv[1], rate_hz=25) as writer:
    for n in range(200):
        try:
            writer.write(rng.integers(0, 255, (48, 64), np.uint8), n / 25)
        except OutputError:
            sys.exit(3)
    if sys.argv[2] == "killed":
        os.kill(os.getpid(), 9)
"""


@pytest.mark.parametrize(("how", "code"), [("killed", -9), ("full", 3), ("closed", 0)])
@pytest.mark.parametrize("name", ["a.mp4", "a.mov", "a.mkv"])
def test_what_was_written_until_a_bad_end_can_be_played(
    tmp_path: Path, name: str, how: str, code: int
) -> None:
    path = tmp_path / name
    command = [sys.executable, "-c", _CHILD, str(path), how]
    assert subprocess.run(command, check=False).returncode == code
    count = 0
    with av.open(str(path)) as container, suppress(av.FFmpegError):  # the last may be cut in two
        for _ in container.decode(video=0):
            count += 1
    assert count == 200 if how == "closed" else count >= 40
