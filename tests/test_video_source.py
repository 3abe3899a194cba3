"""VideoSource: clips made on the spot, good ones and every kind of bad one."""

from __future__ import annotations

import io
import logging
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from streamtrack.errors import SourceError
from streamtrack.sources import open_source
from streamtrack.sources.base import FrameSource
from streamtrack.sources.video import VideoSource
from streamtrack.types import Frame, Image

SIZE_WH = (160, 120)
FFV1 = {"codec": "ffv1", "pixel_format": "bgr0"}
MJPEG = {"codec": "mjpeg", "pixel_format": "yuvj420p"}
VPX = {"deadline": "realtime", "cpu-used": "8"}


def picture(index: int, size_wh: tuple[int, int] = SIZE_WH) -> Image:
    """A smooth picture (H, W, 3) whose top-left quarter is brightest and which tells its index."""
    width, height = size_wh
    y, x = np.mgrid[:height, :width]
    image = np.stack([200 - x % 128, 180 - y % 128, 60 + 0 * x], -1).astype(np.uint8)
    image[: height // 2, : width // 2] = 230
    cv2.circle(image, (10 + 4 * index, 3 * height // 4), 8, (0, 0, 0), -1)
    return image


def make_clip(
    path: Path,
    *,
    codec: str = "libx264",
    pixel_format: str = "yuv420p",
    frames: int = 12,
    size_wh: tuple[int, int] = SIZE_WH,
    b_frames: int = 0,
    rotation: int = 0,
    pts: Sequence[int] | None = None,
    time_base: Fraction = Fraction(1, 25),
    color_range: int = 0,
    options: dict[str, str] | None = None,
    container_options: dict[str, str] | None = None,
    sound: bool = False,
) -> Path:
    """Encode `picture` 0, 1, ... at 25 Hz, or at ``pts`` in ``time_base``."""
    if codec == "libx264":
        options = {"preset": "veryfast", "g": "6", **(options or {})}
    with av.open(str(path), "w", options=container_options or {}) as container:
        stream: Any = container.add_stream(codec, rate=25, options=options or {})
        stream.width, stream.height = size_wh
        stream.pix_fmt = pixel_format
        stream.max_b_frames = b_frames
        stream.codec_context.time_base = time_base
        stream.codec_context.color_range = color_range
        if rotation:
            stream.set_display_rotation(rotation)
        if sound:
            add_sound(container)
        for i in range(frames):
            frame = av.VideoFrame.from_ndarray(picture(i, size_wh), "bgr24")
            frame.pts = i if pts is None else pts[i]
            frame.time_base = time_base
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def add_sound(container: Any) -> None:
    stream = container.add_stream("aac", rate=8000)
    stream.layout = "mono"
    frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
    frame.sample_rate = 8000
    frame.pts = 0
    container.mux(stream.encode(frame))
    container.mux(stream.encode(None))


def read(path: Path, **options: Any) -> tuple[VideoSource, list[Frame]]:
    with VideoSource(path, **options) as source:
        return source, list(source)


def damage(path: Path, seed: int = 0) -> Path:
    data = bytearray(path.read_bytes())
    rng = np.random.default_rng(seed)
    for at in rng.integers(len(data) // 3, 2 * len(data) // 3, 10):
        data[at : at + 20] = rng.bytes(20)
    path.write_bytes(data)
    return path


def cut(path: Path, share: float = 0.5) -> Path:
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])
    return path


def open_files() -> set[str]:
    return {os.readlink(f"/proc/self/fd/{fd}") for fd in fds()}  # noqa: PTH115


def fds() -> list[str]:
    return [fd for fd in os.listdir("/proc/self/fd") if Path("/proc/self/fd", fd).is_symlink()]  # noqa: PTH208


# name, how it is made, mean error allowed
FORMATS: list[tuple[str, dict[str, Any], float]] = [
    ("h264.mp4", {}, 4),
    ("h264.mkv", {}, 4),
    ("h264.ts", {}, 4),
    ("raw.h264", {}, 4),
    ("full range.mp4", {"pixel_format": "yuvj420p", "color_range": 2}, 4),
    ("b_frames.mp4", {"b_frames": 2}, 4),
    ("sound.mp4", {"sound": True}, 4),
    ("ten_bit.mp4", {"pixel_format": "yuv420p10le"}, 4),
    ("odd.mp4", {"pixel_format": "yuv444p", "size_wh": (161, 121)}, 4),
    ("ffv1.mkv", FFV1, 0),
    ("ffv1_odd.mkv", {**FFV1, "size_wh": (161, 121)}, 0),
    ("ffv1_16.mkv", {"codec": "ffv1", "pixel_format": "gbrp16le"}, 1),
    ("motion.avi", MJPEG, 4),
    ("old.avi", {"codec": "mpeg4"}, 5),
    ("raw.mjpeg", MJPEG, 4),
    ("vp9.webm", {"codec": "libvpx-vp9", "options": VPX}, 6),
    ("vp8.webm", {"codec": "libvpx", "options": VPX}, 6),
    ("one.mp4", {"frames": 1}, 4),
    ("take 2:ä%d?.mp4", {}, 4),
]


@pytest.mark.parametrize(("name", "how", "tolerance"), FORMATS, ids=[f[0] for f in FORMATS])
def test_pictures_and_times_come_back(
    tmp_path: Path, name: str, how: dict[str, Any], tolerance: float
) -> None:
    made = {"frames": 12, "size_wh": SIZE_WH, **how}
    source, frames = read(make_clip(tmp_path / name, **how))

    assert isinstance(source, FrameSource)
    assert source.info.size_wh == made["size_wh"]
    assert source.info.rate_hz == pytest.approx(25)
    assert source.info.frame_count in (made["frames"], None)
    assert [f.index for f in frames] == list(range(made["frames"]))
    assert [f.time_s for f in frames] == pytest.approx([i / 25 for i in range(made["frames"])])
    assert source.corrupt_packets == 0
    for frame in frames:
        truth = picture(frame.index, made["size_wh"])
        assert frame.image.shape == truth.shape
        assert frame.image.flags.c_contiguous
        assert np.abs(frame.image.astype(int) - truth).mean() <= tolerance


@pytest.mark.parametrize("pixel_format", ["gray", "gray10le", "gray16le"])
def test_grey_stays_grey_and_eight_bit(tmp_path: Path, pixel_format: str) -> None:
    path = make_clip(tmp_path / "grey.mkv", codec="ffv1", pixel_format=pixel_format)
    _, frames = read(path)
    truth = cv2.cvtColor(picture(3), cv2.COLOR_BGR2GRAY)
    assert frames[3].image.shape == truth.shape
    assert np.abs(frames[3].image.astype(int) - truth).max() <= 3


def test_times_of_a_variable_rate_are_kept(tmp_path: Path) -> None:
    pts = [500, 510, 590, 600, 1500, 1501]
    path = make_clip(tmp_path / "vfr.mp4", frames=6, pts=pts, time_base=Fraction(1, 1000))
    _, frames = read(path)
    assert [f.time_s for f in frames] == pytest.approx([(p - 500) / 1000 for p in pts], abs=2e-4)


@pytest.mark.parametrize(("degrees", "quarter_turns"), [(90, 1), (180, 2), (-90, 3)])
def test_rotated_pictures_are_turned_upright(
    tmp_path: Path, degrees: int, quarter_turns: int
) -> None:
    # set_display_rotation counts clockwise or counterclockwise depending on whom one asks;
    # the decoded frame's `rotation` is defined as counterclockwise.
    path = make_clip(tmp_path / "turned.mp4", rotation=degrees)
    with av.open(str(path)) as container:
        assert next(container.decode(video=0)).rotation % 360 == 90 * quarter_turns
    source, frames = read(path, with_packets=True)
    truth = np.rot90(picture(0), quarter_turns)
    assert source.info.size_wh == (truth.shape[1], truth.shape[0])
    assert np.abs(frames[0].image.astype(int) - truth).mean() < 4
    assert source.info.packet_codec is None
    assert source.info.asset_path is None


# -- packets ------------------------------------------------------------------------------------

COPIED: list[tuple[str, dict[str, Any], str]] = [
    ("a.mp4", {}, "h264"),
    ("a.mkv", {}, "h264"),
    ("a.ts", {}, "h264"),
    ("v.webm", {"codec": "libvpx-vp9", "options": VPX}, "vp9"),
    ("v8.webm", {"codec": "libvpx", "options": {**VPX, "auto-alt-ref": "1"}}, "vp8"),
    ("m.avi", MJPEG, "mjpeg"),
    ("m.mjpeg", MJPEG, "mjpeg"),
]


@pytest.mark.parametrize(("name", "how", "codec"), COPIED, ids=[c[0] for c in COPIED])
def test_copied_packets_decode_to_the_same_frames(
    tmp_path: Path, name: str, how: dict[str, Any], codec: str
) -> None:
    source, frames = read(make_clip(tmp_path / name, **how), with_packets=True)
    assert source.info.packet_codec == codec
    assert source.info.asset_path is None
    assert frames[0].packets[0].is_keyframe

    decoder: Any = av.CodecContext.create(codec, "r")
    decoded = []
    for frame in frames:
        assert frame.packets[-1].time_s == frame.time_s
        for packet in frame.packets:
            if codec == "h264":
                assert packet.data.startswith((b"\0\0\1", b"\0\0\0\1"))
            if codec == "mjpeg":
                jpeg = np.frombuffer(packet.data, np.uint8)
                assert cv2.imdecode(jpeg, cv2.IMREAD_COLOR).shape == frame.image.shape
            decoded += decoder.decode(av.Packet(packet.data))
    decoded += decoder.decode(None)
    assert len(decoded) == len(frames)
    for frame, again in zip(frames, decoded, strict=True):
        assert np.abs(again.to_ndarray(format="bgr24").astype(int) - frame.image).mean() < 1


NOT_COPIED: list[tuple[str, dict[str, Any], bool]] = [
    ("b.mp4", {"b_frames": 2}, True),
    ("b.mov", {"b_frames": 2}, True),
    ("b.mkv", {"b_frames": 2}, False),
    ("raw.h264", {}, False),
    ("ten.mp4", {"pixel_format": "yuv420p10le"}, False),
    ("444.mp4", {"pixel_format": "yuv444p"}, False),
    ("ffv1.mkv", FFV1, False),
]


@pytest.mark.parametrize(("name", "how", "is_asset"), NOT_COPIED, ids=[n[0] for n in NOT_COPIED])
def test_packets_that_a_viewer_would_garble_are_not_copied(
    tmp_path: Path, name: str, how: dict[str, Any], is_asset: bool
) -> None:
    path = make_clip(tmp_path / name, **how)
    source, frames = read(path, with_packets=True)
    assert source.info.packet_codec is None
    assert source.info.asset_path == (path if is_asset else None)
    assert not any(frame.packets for frame in frames)


def test_packets_come_only_when_asked_for(tmp_path: Path) -> None:
    source, frames = read(make_clip(tmp_path / "a.mp4"))
    assert source.info.packet_codec is None
    assert not any(frame.packets for frame in frames)


# -- odd clocks ---------------------------------------------------------------------------------


def copy_packets(path: Path, to: Path, stamp: Callable[[int, Any], tuple[int, int]]) -> Path:
    """Remux, giving packet number i the (pts, dts) of ``stamp(i, packet)``."""
    with av.open(str(path)) as source, av.open(str(to), "w") as container:
        stream = container.add_stream_from_template(source.streams.video[0])
        number = 0
        for packet in source.demux(video=0):
            if packet.size:
                packet.pts, packet.dts = stamp(number, packet)
                packet.stream = stream
                container.mux(packet)
                number += 1
    return to


def test_b_frames_stamped_in_storage_order_are_put_right(tmp_path: Path) -> None:
    good = make_clip(tmp_path / "good.mp4", b_frames=2, frames=20)
    bad = copy_packets(good, tmp_path / "bad.mp4", lambda i, _: (512 * i, 512 * i))
    source, frames = read(bad, with_packets=True)
    assert [f.time_s for f in frames] == pytest.approx([i / 25 for i in range(20)])
    assert np.abs(frames[7].image.astype(int) - picture(7)).mean() < 4
    assert source.info.asset_path is None


def test_times_that_go_back_are_repaired_with_one_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    good = make_clip(tmp_path / "good.mkv", **FFV1)
    pts = [0, 40, 80, 60, 160, 150, 240, 280, 320, 360, 400, 440]
    bad = copy_packets(good, tmp_path / "bad.mkv", lambda i, _: (pts[i], i))
    _, frames = read(bad)
    times = [f.time_s for f in frames]
    assert len(times) == 12
    assert np.all(np.diff(times) > 0)
    assert times[3] == pytest.approx(0.08, abs=1e-4)
    assert times[4] == pytest.approx(0.16)
    assert sum("timestamps go back" in m for m in caplog.messages) == 1


def test_a_clock_that_starts_again_is_continued(tmp_path: Path) -> None:
    path = make_clip(tmp_path / "a.ts", frames=50)
    path.write_bytes(path.read_bytes() * 2)
    _, frames = read(path)
    steps = np.diff([f.time_s for f in frames])
    assert len(frames) == 100
    assert np.all(steps > 0)
    assert np.allclose(steps, 0.04, atol=0.05)


# -- damage -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "how"),
    [
        ("a.mkv", {}),
        ("a.ts", {"b_frames": 2}),
        # Matroska can be picked up again at the next cluster only.
        (
            "v.webm",
            {
                "codec": "libvpx-vp9",
                "options": VPX,
                "container_options": {"cluster_time_limit": "200"},
            },
        ),
        ("m.mjpeg", MJPEG),
    ],
)
def test_damage_in_the_middle_does_not_end_the_source(
    tmp_path: Path, name: str, how: dict[str, Any], caplog: pytest.LogCaptureFixture
) -> None:
    path = damage(make_clip(tmp_path / name, frames=60, **how))
    source, frames = read(path, with_packets=True)
    assert len(frames) >= 20
    assert source.corrupt_packets >= 1
    assert np.all(np.diff([f.time_s for f in frames]) > 0)
    assert any(f"{source.corrupt_packets} damaged packets in all" in m for m in caplog.messages)
    assert len(caplog.messages) <= 6


@pytest.mark.parametrize(
    ("name", "how"),
    [
        ("cut.mkv", FFV1),
        ("cut.avi", MJPEG),
        ("faststart.mp4", {"container_options": {"movflags": "faststart"}}),
    ],
)
def test_a_truncated_file_gives_what_it_holds(
    tmp_path: Path, name: str, how: dict[str, Any], caplog: pytest.LogCaptureFixture
) -> None:
    path = cut(make_clip(tmp_path / name, frames=50, **how), 0.6)
    _, frames = read(path)
    assert 5 < len(frames) < 50
    assert any("ends early, truncated or damaged" in m for m in caplog.messages)
    assert np.abs(frames[2].image.astype(int) - picture(2)).mean() < 4


def test_a_whole_file_is_read_without_a_word(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    read(make_clip(tmp_path / "b.mp4", b_frames=2), with_packets=True)
    assert not caplog.messages
    assert "warn" not in capfd.readouterr().err.lower()


def test_a_change_of_size_is_yielded_and_warned_of_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    first = make_clip(tmp_path / "1.mjpeg", frames=3, **MJPEG)
    other = make_clip(tmp_path / "2.mjpeg", frames=3, size_wh=(80, 64), **MJPEG)
    path = tmp_path / "both.mjpeg"
    path.write_bytes(first.read_bytes() + other.read_bytes() + first.read_bytes())
    source, frames = read(path)
    assert [f.size_wh for f in frames] == [SIZE_WH] * 3 + [(80, 64)] * 3 + [SIZE_WH] * 3
    assert source.info.size_wh == SIZE_WH
    assert [r.levelno for r in caplog.records] == [logging.WARNING]
    assert "picture size changes from 160x120 to 80x64 at frame 3" in caplog.messages[0]


def test_a_header_without_a_rate(tmp_path: Path) -> None:
    # One picture: no rate can be told from it, and Matroska needs none in its header.
    path = make_clip(tmp_path / "one.mkv", frames=1, time_base=Fraction(1, 1000), **FFV1)
    source, frames = read(path)
    assert source.info.rate_hz is None or source.info.rate_hz > 0
    assert [f.time_s for f in frames] == [0.0]


# -- what cannot be opened ----------------------------------------------------------------------


def sound_only(path: Path) -> Path:
    with av.open(str(path), "w") as container:
        add_sound(container)
    return path


def written(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def of_unknown_codec(path: Path) -> Path:
    return written(path, make_clip(path, **FFV1).read_bytes().replace(b"V_FFV1", b"V_XXXX"))


def with_no_picture(path: Path) -> Path:
    """An AVI whose frames are noise."""
    good = make_clip(path.with_name("good.mkv"), codec="mpeg4", frames=3)
    out = io.BytesIO()
    with av.open(str(good)) as source, av.open(out, "w", format="matroska") as container:
        stream = container.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.size:
                noise = av.Packet(bytes([7] * packet.size))
                noise.pts, noise.dts, noise.time_base = packet.pts, packet.dts, packet.time_base
                noise.stream = stream
                container.mux(noise)
    return written(path, out.getvalue())


BAD: list[tuple[str, Callable[[Path], Path], str]] = [
    ("missing.mp4", lambda p: p, "no such file.*check the path"),
    ("folder.mp4", lambda p: p.mkdir() or p, "is a folder, not a video"),
    ("empty.mp4", lambda p: written(p, b""), "is empty"),
    ("text.mp4", lambda p: written(p, b"hello " * 100), "not a video that FFmpeg can read"),
    ("notes.txt", lambda p: written(p, b"hello\n" * 100), "is not a video: it holds no pictures"),
    ("noise.mkv", lambda p: written(p, bytes(range(256)) * 9), "not a video that FFmpeg can read"),
    ("cut.mp4", lambda p: cut(make_clip(p)), r"no index \(moov\); recover it with"),
    ("sound.m4a", sound_only, "no video stream, only sound"),
    ("unknown.mkv", of_unknown_codec, "cannot decode: convert it to H.264"),
    ("noise_inside.mkv", with_no_picture, "no picture that can be decoded"),
]


@pytest.mark.parametrize(("name", "make", "match"), BAD, ids=[b[0] for b in BAD])
def test_what_cannot_be_opened_says_why_and_leaves_nothing_open(
    tmp_path: Path, name: str, make: Callable[[Path], Path], match: str
) -> None:
    path = make(tmp_path / name)
    with pytest.raises(SourceError, match=match) as caught:
        VideoSource(path)
    assert "\n" not in str(caught.value)
    assert not any(str(tmp_path) in name for name in open_files())


def test_no_permission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Simulated, as tests may run as root, who may read everything.
    path = make_clip(tmp_path / "a.mp4")

    def refuse(*_args: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(SourceError, match="no permission to read"):
        VideoSource(path)


def test_a_source_is_read_once_and_closes_its_file(tmp_path: Path) -> None:
    path = make_clip(tmp_path / "a.mp4")
    with VideoSource(path) as source:
        next(iter(source))
        assert str(path) in open_files()
        with pytest.raises(SourceError, match="open it again"):
            iter(source)
    assert str(path) not in open_files()
    with pytest.raises(SourceError, match="already read or closed"):
        list(source)


# -- open_source --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("uri", "match"),
    [
        ("ftp://host/x", "unknown kind of source ftp://: known are synthetic://"),
        ("no/such/file.mp4", "no such file"),
        ("no/such/*.png", "no file matches"),
        ([], "no pictures were given"),
    ],
)
def test_open_source_refuses(uri: Any, match: str) -> None:
    with pytest.raises(SourceError, match=match):
        open_source(uri)


def test_open_source_tells_videos_from_pictures(tmp_path: Path) -> None:
    clip = make_clip(tmp_path / "a.mkv")
    cv2.imwrite(str(tmp_path / "p1.png"), picture(0))
    kinds = {
        "VideoSource": [clip, str(clip)],
        "ImageSource": [tmp_path, f"{tmp_path}/*.png", tmp_path / "p1.png", [tmp_path / "p1.png"]],
    }
    for kind, uris in kinds.items():
        for uri in uris:
            with open_source(uri) as source:  # type: ignore[arg-type]
                assert type(source).__name__ == kind
    with open_source(clip, with_packets=True) as source:
        assert source.info.packet_codec == "h264"


def test_importing_sources_is_light() -> None:
    code = "import sys, streamtrack.sources; print(sorted({'av', 'cv2'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
