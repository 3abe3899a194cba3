"""Tests of network streams and pipes against real servers on 127.0.0.1, with their faults."""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from streamtrack.errors import SourceError, UsageError
from streamtrack.settings import LiveSettings
from streamtrack.sources import open_source
from streamtrack.sources.capture import (
    Captured,
    CaptureEndedError,
    CaptureFinishedError,
    CaptureRefusedError,
)
from streamtrack.sources.live import LiveSource
from streamtrack.sources.network.stream import NetworkCapture
from streamtrack.sources.video import VideoSource
from tests import rtsp_server, servers
from tests.servers import Server, eventually, jpeg, mjpeg, number_of, part, silence

QUICK = LiveSettings(open_timeout_s=8.0, stall_timeout_s=0.6)
EXACT = QUICK.model_copy(update={"newest_only": False})
"""Nothing is left out however slow the machine that runs the test is."""


def url(server: Server, rest: str = "cam", scheme: str = "http") -> str:
    return f"{scheme}://127.0.0.1:{server.port}/{rest}"


def read_all(capture: NetworkCapture, limit: int = 1000) -> list[Captured]:
    """Pictures until the stream ends or is silent for two seconds."""
    pictures: list[Captured] = []
    with contextlib.suppress(CaptureEndedError):
        while len(pictures) < limit and (got := capture.read(2.0)) is not None:
            pictures.append(got)
    return pictures


def is_running(pid: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False


# -- HTTP MJPEG ---------------------------------------------------------------------------------


def test_mjpeg_comes_picture_by_picture_with_its_packets() -> None:
    with (
        Server(mjpeg(range(30), then=silence)) as server,
        NetworkCapture(url(server), EXACT, with_packets=True) as capture,
    ):
        info = capture.info
        assert (info.size_wh, info.is_live, info.packet_codec) == ((160, 120), True, "mjpeg")
        assert "mjpeg" in capture.description
        pictures = read_all(capture, 30)
        assert capture.read(0.05) is None
        assert time.monotonic() - pictures[-1].captured_s < 5
    assert [number_of(p.image) for p in pictures] == list(range(30))
    assert [p.packets[0].data for p in pictures] == [jpeg(n) for n in range(30)]
    times = [p.captured_s for p in pictures]
    assert all(b > a for a, b in pairwise(times))
    assert 0.3 < times[-1] - times[0] < 3  # 30 pictures at 50 a second, nominally.


def test_damaged_jpeg_is_rejected_and_counted() -> None:
    def handle(connection: socket.socket) -> None:
        servers.read_request(connection)
        connection.sendall(servers.MJPEG_HEADER)
        for number in range(20):
            data = jpeg(number)
            connection.sendall(part(data[: len(data) // 2] if number % 5 == 3 else data))
            time.sleep(0.02)
        silence(connection)

    with Server(handle) as server, NetworkCapture(url(server), EXACT) as capture:
        pictures = read_all(capture, 16)
    assert [number_of(p.image) for p in pictures] == [n for n in range(20) if n % 5 != 3]
    assert sum(p.damaged for p in pictures) == 4


def test_a_picture_of_another_size_comes_as_it_is() -> None:
    def two_sizes(connection: socket.socket) -> None:
        def more(connection: socket.socket) -> None:
            for number in range(5, 10):
                connection.sendall(part(jpeg(number, (320, 240))))
                time.sleep(0.02)

        mjpeg(range(5), then=more)(connection)

    with Server(two_sizes) as server, NetworkCapture(url(server), EXACT) as capture:
        pictures = read_all(capture)
    assert [p.image.shape for p in pictures] == [(120, 160, 3)] * 5 + [(240, 320, 3)] * 5
    assert [number_of(p.image) for p in pictures] == list(range(10))


def test_thinning_happens_before_the_pictures_are_passed_on() -> None:
    settings = EXACT.model_copy(update={"max_fps": 10.0})
    with (
        Server(mjpeg(range(60), fps=60)) as server,
        NetworkCapture(url(server), settings, with_packets=True) as capture,
    ):
        pictures = read_all(capture)
    assert 6 <= len(pictures) <= 16
    assert sum(p.thinned for p in pictures) >= 40
    for one in pictures:  # Each JPEG stands alone: those left out are not recorded either.
        assert [packet.data for packet in one.packets] == [jpeg(number_of(one.image))]


# -- faults -------------------------------------------------------------------------------------


def test_a_server_that_never_answers_is_given_up_in_time() -> None:
    began = time.monotonic()
    with Server(silence) as server:
        for scheme in ("http", "https", "rtsp", "tcp"):
            with pytest.raises(SourceError, match=r"no picture within 0\.5 s"):
                NetworkCapture(url(server, "", scheme), LiveSettings(open_timeout_s=0.5))
    assert time.monotonic() - began < 6


def test_waiting_for_the_first_picture_ends_on_a_wish() -> None:
    began = time.monotonic()
    with Server(silence) as server, pytest.raises(SourceError, match="interrupted"):
        NetworkCapture(url(server), EXACT, should_stop=lambda: time.monotonic() - began > 0.3)
    assert time.monotonic() - began < 2


def test_a_stall_is_no_end_and_the_stream_goes_on_after_it() -> None:
    resume = threading.Event()

    def pause(connection: socket.socket) -> None:
        resume.wait(10)
        connection.sendall(part(jpeg(99)))
        silence(connection)

    with (
        Server(mjpeg(range(5), then=pause)) as server,
        NetworkCapture(url(server), EXACT) as capture,
    ):
        assert len(read_all(capture, 5)) == 5
        began = time.monotonic()
        assert capture.read(0.3) is None
        assert 0.25 < time.monotonic() - began < 0.6
        resume.set()
        got = capture.read(3.0)
        assert got is not None and number_of(got.image) == 99


def test_a_peer_that_hangs_up_ends_the_capture() -> None:
    with Server(mjpeg(range(5))) as server, NetworkCapture(url(server), EXACT) as capture:
        for _ in range(5):
            assert capture.read(2) is not None
        with pytest.raises(CaptureEndedError, match=r"hung up|the stream ended") as ended:
            capture.read(2)
        assert not isinstance(ended.value, CaptureFinishedError)


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: f"http://u:geheim@127.0.0.1:{servers.free_port()}/x", "Connection refused"),
        (lambda: f"rtsp://u:geheim@127.0.0.1:{servers.free_port()}/x", "cannot be opened"),
        (lambda: "http://u:geheim@no-such-host.invalid/x", "cannot be opened|404"),
    ],
)
def test_nobody_there_is_said_without_the_password(
    make: Callable[[], str], match: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SourceError, match=match) as failed:
        NetworkCapture(make(), EXACT)
    assert "geheim" not in str(failed.value)
    assert "\n" not in str(failed.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    "body",
    [b"<html>No picture here</html>" * 50, bytes(range(256)) * 400, b""],
    ids=["html", "noise", "nothing"],
)
def test_what_is_no_video_is_refused_in_one_line(body: bytes) -> None:
    def handle(connection: socket.socket) -> None:
        servers.read_request(connection)
        connection.sendall(b"HTTP/1.0 200 OK\r\nContent-Type: video/mp4\r\n\r\n" + body)

    with Server(handle) as server, pytest.raises(SourceError) as failed:
        NetworkCapture(url(server), EXACT)
    assert str(failed.value).startswith(f"http://127.0.0.1:{server.port}/cam: ")
    assert "\n" not in str(failed.value)


def test_a_playlist_may_not_open_local_files(tmp_path: Path) -> None:
    clip = tmp_path / "secret.ts"
    servers.encode(clip, range(5), container_format="mpegts")
    (tmp_path / "list.m3u8").write_text(
        f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nfile://{clip}\n#EXT-X-ENDLIST\n"
    )
    with Server(servers.files(tmp_path)) as server, pytest.raises(SourceError):
        NetworkCapture(url(server, "list.m3u8"), LiveSettings(open_timeout_s=3))


def test_a_wrong_password_is_refused_and_never_shown(
    caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    with Server(servers.protected("me", "ge/heim", mjpeg(range(9), then=silence))) as server:
        with pytest.raises(CaptureRefusedError, match="check user and password") as refused:
            NetworkCapture(f"http://me:falsch@127.0.0.1:{server.port}/cam", EXACT)
        assert "falsch" not in str(refused.value) and "me:" not in str(refused.value)
        address = f"http://me:ge%2Fheim@127.0.0.1:{server.port}/cam?token=geheim"
        with caplog.at_level(logging.DEBUG), NetworkCapture(address, EXACT) as capture:
            assert capture.read(2) is not None
            info = capture.info
            assert info.uri == f"http://127.0.0.1:{server.port}/cam?token=***"
            # The address is in no process list: neither arguments nor environment.
            for name in ("cmdline", "environ"):
                assert b"heim" not in Path(f"/proc/{capture.reader_pid}/{name}").read_bytes()
    assert "heim" not in caplog.text + "".join(capfd.readouterr()) + info.name


def test_an_unknown_protocol_is_a_mistake_of_the_user() -> None:
    with pytest.raises(UsageError, match=r"srt://127\.0\.0\.1:9: this FFmpeg cannot read it"):
        NetworkCapture("srt://127.0.0.1:9", EXACT)


# -- the reader process -------------------------------------------------------------------------


def test_a_reader_that_dies_or_freezes_neither_hangs_nor_stays() -> None:
    with Server(mjpeg(range(1000), then=silence)) as server:
        capture = NetworkCapture(url(server), EXACT)
        os.kill(capture.reader_pid, signal.SIGKILL)
        with pytest.raises(CaptureEndedError, match=r"ended unexpectedly \(code -9\)"):
            while capture.read(2) is not None:
                pass
        capture.close()
        capture = NetworkCapture(url(server), EXACT)
        os.kill(capture.reader_pid, signal.SIGSTOP)
        while capture.read(0.2) is not None:  # What was on its way.
            pass
        began = time.monotonic()
        capture.close()
        assert time.monotonic() - began < 2
        assert not is_running(capture.reader_pid)


def test_a_reader_ends_with_its_user() -> None:
    program = (
        "import os, sys; from streamtrack.sources.network.stream import NetworkCapture; "
        "c = NetworkCapture(sys.argv[1]); c.read(5); print(c.reader_pid, flush=True); "
        "os.kill(os.getpid(), 9)"
    )
    with Server(mjpeg(range(10), then=silence)) as server:
        user = subprocess.run(
            [sys.executable, "-c", program, url(server)], capture_output=True, timeout=30
        )
        pid = int(user.stdout)
        # It reads from a silent peer, so it cannot notice by writing.
        assert eventually(lambda: not is_running(pid), 3)


def test_a_reader_is_light() -> None:
    program = (
        "import sys, streamtrack.sources.network.reader_process; "
        "print(*{'numpy', 'cv2', 'pydantic', 'rerun'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, timeout=30)
    assert (done.stdout, done.stderr) == (b"\n", b"")


def test_closing_says_good_bye_to_the_peer() -> None:
    gone = threading.Event()

    def notice(connection: socket.socket) -> None:
        silence(connection)
        gone.set()

    with Server(mjpeg(range(5), then=notice)) as server:
        capture = NetworkCapture(url(server), EXACT)
        began = time.monotonic()
        capture.close()
        capture.close()
        assert time.monotonic() - began < 2
        assert gone.wait(3)


def test_failed_openings_leave_nothing() -> None:
    def standing() -> tuple[int, int, int]:
        gc.collect()
        children = len(list(servers.children_of(os.getpid())))
        return len(list(Path("/proc/self/fd").iterdir())), threading.active_count(), children

    address = f"http://127.0.0.1:{servers.free_port()}/x"

    def fail() -> None:
        with pytest.raises(SourceError):
            NetworkCapture(address, EXACT)

    fail()
    before = standing()
    for _ in range(8):
        fail()
    assert standing() == before


# -- finished files and HLS ---------------------------------------------------------------------


@pytest.mark.parametrize("name", ["clip.mkv", "clip.mp4", "clip.ts"])
def test_a_file_on_a_server_is_read_whole_as_from_a_disk(name: str, tmp_path: Path) -> None:
    servers.encode(tmp_path / name, range(60))
    with Server(servers.files(tmp_path)) as server, open_source(url(server, name)) as source:
        assert not source.info.is_live
        frames = []
        for frame in source:
            time.sleep(0.002)  # Slower than the server: nothing is dropped all the same.
            frames.append(frame)
    assert [number_of(f.image) for f in frames] == list(range(60))
    with VideoSource(tmp_path / name) as local:
        for there, here in zip(frames, local, strict=True):
            np.testing.assert_array_equal(there.image, here.image)
            assert there.time_s == pytest.approx(here.time_s, abs=1e-4)


def test_a_file_that_a_server_cuts_off_ends_with_an_error(tmp_path: Path) -> None:
    servers.encode(tmp_path / "clip.mkv", range(60))
    data = (tmp_path / "clip.mkv").read_bytes()

    def cut(connection: socket.socket) -> None:
        servers.read_request(connection)
        head = b"HTTP/1.0 200 OK\r\nContent-Length: %d\r\n\r\n" % len(data)
        connection.sendall(head + data[: len(data) * 2 // 3])

    with (
        Server(cut) as server,
        open_source(url(server, "clip.mkv")) as source,
        pytest.raises(SourceError, match="not read to its end"),
    ):
        for frame in source:
            last = frame
    assert 20 < last.index < 50


def write_segment(folder: Path, number: int) -> None:
    servers.encode(
        folder / f"{number}.ts",
        range(number * 20, number * 20 + 20),
        container_format="mpegts",
        options={"output_ts_offset": str(number * 20 / 25)},
    )


def test_live_hls_follows_the_playlist(tmp_path: Path) -> None:
    def publish(first: int, last: int) -> None:
        lines = ["#EXTM3U", "#EXT-X-VERSION:3", "#EXT-X-TARGETDURATION:1"]
        lines += [f"#EXT-X-MEDIA-SEQUENCE:{first}"]
        for number in range(first, last + 1):
            lines += ["#EXTINF:0.8,", f"{number}.ts"]
        (tmp_path / "new").write_text("\n".join(lines) + "\n")
        (tmp_path / "new").replace(tmp_path / "live.m3u8")

    for number in range(5):
        write_segment(tmp_path, number)
    publish(0, 2)
    with (
        Server(servers.files(tmp_path)) as server,
        NetworkCapture(url(server, "live.m3u8"), EXACT) as capture,
    ):
        assert capture.info.is_live
        seen = [number_of(p.image) for p in read_all(capture, 30)]
        publish(2, 4)
        seen += [number_of(p.image) for p in read_all(capture, 65)]
    assert seen == list(range(95))


# -- UDP ----------------------------------------------------------------------------------------


def test_udp_carries_mpegts() -> None:
    port = servers.free_port()
    stop = threading.Event()

    def pace(number: int) -> None:
        if stop.is_set():
            raise EOFError
        time.sleep(0.02)

    def send() -> None:
        with contextlib.suppress(EOFError):
            servers.encode(
                f"udp://127.0.0.1:{port}?pkt_size=1316",
                range(100_000),
                container_format="mpegts",
                rate=50,
                pace=pace,
            )

    sender = threading.Thread(target=send)
    sender.start()
    try:
        with NetworkCapture(f"udp://127.0.0.1:{port}", EXACT, with_packets=True) as capture:
            assert (capture.info.is_live, capture.info.packet_codec) == (True, "h264")
            pictures = read_all(capture, 40)
            stop.set()
            sender.join(5)
            read_all(capture)
            assert capture.read(0.1) is None
    finally:
        stop.set()
    numbers = [number_of(p.image) for p in pictures]
    assert numbers == [(numbers[0] + n) % 256 for n in range(40)]
    check_decodable(pictures)


def check_decodable(pictures: list[Captured]) -> None:
    """The packets give the pictures, for a decoder that knows nothing else."""
    decoder: Any = av.CodecContext.create("h264", "r")
    packets = [packet for p in pictures for packet in p.packets]
    assert packets[0].is_keyframe
    decoded = [f for p in packets for f in decoder.decode(av.Packet(p.data))]
    decoded += decoder.decode(None)
    numbers = [number_of(f.to_ndarray(format="bgr24")) for f in decoded]
    assert set(numbers) <= {number_of(p.image) for p in pictures}
    assert len(numbers) >= len(pictures) - 12


def test_a_stream_joined_between_keyframes_begins_with_the_next(tmp_path: Path) -> None:
    clip = tmp_path / "clip.ts"
    servers.encode(clip, [n // 2 for n in range(300)], container_format="mpegts", keyframes=220)
    packets = clip.stat().st_size // 188

    def from_the_middle(connection: socket.socket) -> None:
        connection.sendall(clip.read_bytes()[packets // 4 * 188 :])
        silence(connection)

    with (
        Server(from_the_middle) as server,
        NetworkCapture(url(server, "", "tcp"), EXACT, with_packets=True) as capture,
    ):
        pictures = read_all(capture, 78)
    assert [number_of(p.image) for p in pictures] == [n // 2 for n in range(220, 298)]
    assert sum(p.damaged for p in pictures) == 0
    check_decodable(pictures)


# -- standard input -----------------------------------------------------------------------------

_STDIN_PROGRAM = """
import sys, time
from streamtrack.settings import LiveSettings
from streamtrack.sources import open_source
from tests.servers import number_of
settings = LiveSettings(**eval(sys.argv[1]))
try:
    with open_source("-", live=settings) as source:
        print(source.info.is_live, *(number_of(frame.image) for frame in source))
except Exception as error:
    print(type(error).__name__, error)
"""


def run_on_stdin(stdin: Any, data: bytes | None = None, **settings: Any) -> list[str]:
    done = subprocess.run(
        [sys.executable, "-c", _STDIN_PROGRAM, repr(settings)],
        stdin=stdin if data is None else None,
        input=data,
        capture_output=True,
        timeout=40,
        cwd=Path(__file__).parents[1],
    )
    assert done.stderr == b""
    return done.stdout.decode().split()


def test_a_file_on_standard_input_is_read_whole(tmp_path: Path) -> None:
    servers.encode(tmp_path / "clip.mp4", range(40))  # Its index is at its end.
    with (tmp_path / "clip.mp4").open("rb") as file:
        assert run_on_stdin(file) == ["False", *map(str, range(40))]
    servers.encode(tmp_path / "clip.mkv", range(40))  # Its header tells the length.
    data = (tmp_path / "clip.mkv").read_bytes()
    assert run_on_stdin(None, data) == ["False", *map(str, range(40))]


def test_a_pipe_without_a_length_is_live_unless_all_is_wanted(tmp_path: Path) -> None:
    servers.encode(tmp_path / "clip.ts", range(40))
    data = (tmp_path / "clip.ts").read_bytes()
    assert run_on_stdin(None, data)[0] == "True"
    assert run_on_stdin(None, data, newest_only=False) == ["True", *map(str, range(40))]


def test_a_silent_or_senseless_pipe_ends_in_one_line() -> None:
    reading, writing = os.pipe()
    try:
        answer = " ".join(run_on_stdin(reading, open_timeout_s=1.0))
    finally:
        os.close(reading)
        os.close(writing)
    assert answer.startswith("SourceError standard input: no picture within 1 s")
    answer = " ".join(run_on_stdin(None, bytes(range(256)) * 200))
    assert answer.startswith("SourceError standard input: cannot be opened")


# -- together with the loop ---------------------------------------------------------------------


def test_a_camera_that_stalls_breaks_off_and_changes_its_size_is_followed(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("streamtrack.sources._backoff._FIRST_S", 0.05)
    monkeypatch.setattr("streamtrack.sources._backoff._LONGEST_S", 0.2)
    acts = iter(
        [
            mjpeg(range(10), then=silence),  # Stalls.
            mjpeg(range(10, 20)),  # Hangs up.
            lambda connection: connection.sendall(b"nonsense"),
            mjpeg(range(20, 30), size_wh=(320, 240), then=silence),
        ]
    )
    address = "http://me:geheim@127.0.0.1:{}/cam"
    with Server(lambda connection: next(acts)(connection)) as server:
        source = open_source(address.format(server.port), live=QUICK)
        assert isinstance(source, LiveSource)
        with source:
            frames = []
            for frame in source:
                frames.append(frame)
                source.note_output(frame)
                if number_of(frame.image) == 29:
                    break
            status = source.status()
    # What came while the stream was being looked at comes at once, and the newest is taken.
    assert status.dropped < 9
    assert len(frames) == 30 - status.dropped
    assert [f.epoch for f in frames] == [number_of(f.image) // 10 for f in frames]
    assert all(number_of(b.image) > number_of(a.image) for a, b in pairwise(frames))
    assert {f.size_wh for f in frames if f.epoch == 2} == {(320, 240)}
    assert (status.openings, status.stalls, status.failed_openings) == (3, 1, 1)
    assert status.age_ms_p95 is not None and status.age_ms_p95 < 200
    assert all(b.time_s > a.time_s for a, b in pairwise(frames))
    assert "geheim" not in caplog.text and "me:" not in caplog.text


SECRETS = ("geheimnis", "nutzer", "abrakadabra")


def _processes_below(pid: int) -> list[int]:
    below = list(servers.children_of(pid))
    return below + [deeper for child in below for deeper in _processes_below(child)]


@pytest.mark.parametrize("leaf", ["cam", "no-such-thing"])
def test_secrets_of_an_address_appear_nowhere(
    tmp_path: Path, leaf: str, make_picture: Callable[..., Any]
) -> None:
    """The whole program: its lines, all its files and their names, and what `ps` shows."""
    textured = bytes(cv2.imencode(".jpg", make_picture(1, (320, 240)))[1])

    def camera(connection: socket.socket) -> None:
        servers.read_request(connection)
        connection.sendall(servers.MJPEG_HEADER)
        for _ in range(12):
            connection.sendall(part(textured))
            time.sleep(0.1)

    def handle(connection: socket.socket) -> None:
        if b"/cam" in connection.recv(65536, socket.MSG_PEEK):
            servers.protected("nutzer", "geheimnis", camera)(connection)
        else:
            connection.recv(65536)
            has_looked.wait(60)  # the program ends with this answer
            connection.sendall(b"HTTP/1.0 404 Not Found\r\nContent-Length: 0\r\n\r\n")

    titles, has_looked = b"", threading.Event()
    with Server(handle) as server:
        address = f"http://nutzer:geheimnis@127.0.0.1:{server.port}/{leaf}?token=abrakadabra"
        outputs = ("--output", "tracks.csv", "--poses", "poses.csv", "--summary", "summary.json")
        command = [sys.executable, "-m", "streamtrack.cli", "track", address, *outputs]
        with subprocess.Popen(
            [*command, "--target", "10,10,120,90", "--retries", "0", "--record-video", "jpeg"],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent)},
        ) as program:
            assert program.stdout is not None
            # Python itself has to start before it can hide anything.
            assert eventually(lambda: server.accepted or program.poll() is not None, 60)
            for pid in (program.pid, *_processes_below(program.pid)):
                with contextlib.suppress(OSError):
                    titles += Path(f"/proc/{pid}/cmdline").read_bytes()
            has_looked.set()
            said = program.stdout.read()
    assert b"127.0.0.1" in titles
    assert b"127.0.0.1" in said
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert (leaf == "cam") == any(path.suffix == ".rrd" for path in files)
    shown = [titles, said, *(path.read_bytes() + path.name.encode() for path in files)]
    for secret in SECRETS:
        assert not any(secret.encode() in text for text in shown), secret


_SIGNALLED_PROGRAM = """
import signal, sys
from streamtrack.errors import SourceError
from streamtrack.settings import LiveSettings
from streamtrack.sources import open_source
came = []
signal.signal(signal.SIGINT, lambda number, frame: came.append(number))
print("ready", flush=True)
try:
    with open_source(sys.argv[1], live=LiveSettings(), should_stop=lambda: bool(came)) as source:
        for number, frame in enumerate(source):
            if number == 4:
                print("streaming", flush=True)
        print("left the loop", source.status().state)
except SourceError as error:
    print(error)
"""


def interrupted_answer(address: str, wait_for: str) -> tuple[str, float]:
    """What the program says after Ctrl-C, and how long it took."""
    with subprocess.Popen(
        [sys.executable, "-c", _SIGNALLED_PROGRAM, address],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
        text=True,
    ) as program:
        assert program.stdout is not None
        for line in program.stdout:
            if line.strip() == wait_for:
                break
        time.sleep(0.5)
        began = time.monotonic()
        os.killpg(program.pid, signal.SIGINT)  # As a terminal does: the reader gets it too.
        answer = program.stdout.read()
        assert program.wait(10) == 0
        return answer.strip(), time.monotonic() - began


@pytest.mark.slow
def test_ctrl_c_ends_a_running_and_a_hung_stream_at_once() -> None:
    with Server(mjpeg(range(1000), fps=30)) as server:
        answer, took_s = interrupted_answer(url(server), "streaming")
    assert answer == "left the loop streaming"
    assert took_s < 3
    with Server(mjpeg(range(6), then=silence)) as server:
        answer, took_s = interrupted_answer(url(server), "streaming")
    assert answer.startswith("left the loop")
    assert took_s < 3
    with Server(silence) as server:
        answer, took_s = interrupted_answer(url(server), "ready")
    assert answer.splitlines()[-1].endswith("interrupted before the first picture")
    assert took_s < 3


# -- RTSP ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def start_rtsp() -> Iterator[Callable[..., tuple[subprocess.Popen[str], int]]]:
    """``start_rtsp(port=0, *credentials)`` gives the server's process and its port."""
    if reason := rtsp_server.missing():
        pytest.skip(f"GStreamer's RTSP server: {reason}")
    running: list[subprocess.Popen[str]] = []

    def start(port: int = 0, *credentials: str) -> tuple[subprocess.Popen[str], int]:
        server, port = rtsp_server.start(port, *credentials)
        running.append(server)
        return server, port

    yield start
    for server in running:
        rtsp_server.stop(server)


RtspStarter = Callable[..., tuple[subprocess.Popen[str], int]]


def test_rtsp_delivers_pictures_and_decodable_packets(start_rtsp: RtspStarter) -> None:
    _, port = start_rtsp()
    with NetworkCapture(f"rtsp://127.0.0.1:{port}/cam", with_packets=True) as capture:
        info = capture.info
        pictures = read_all(capture, 45)
        now = time.monotonic()
    assert (info.size_wh, info.rate_hz, info.packet_codec) == ((320, 240), 30.0, "h264")
    assert len(pictures) == 45
    assert -0.001 < now - pictures[-1].captured_s < 0.3
    steps = np.diff([p.time_s for p in pictures[5:]]) * 30
    assert np.median(steps) == pytest.approx(1, abs=0.06)  # a loaded server leaves frames out
    np.testing.assert_allclose(steps, np.rint(steps), atol=0.06)
    # The parameter sets were in the answer to DESCRIBE only; each keyframe carries them now.
    packets = [packet for p in pictures for packet in p.packets]
    keyframes = [packet for packet in packets if packet.is_keyframe]
    assert keyframes and all(re.search(b"\x00\x00\x01[\x67\x27]", k.data) for k in keyframes)
    decoder: Any = av.CodecContext.create("h264", "r")
    decoded = [f for p in packets for f in decoder.decode(av.Packet(p.data))]
    decoded += decoder.decode(None)
    assert len(decoded) >= 40
    last = decoded[-1].to_ndarray(format="bgr24")
    assert np.mean(np.abs(last.astype(int) - pictures[-1].image)) < 3


def test_rtsp_asks_for_the_password(start_rtsp: RtspStarter) -> None:
    _, port = start_rtsp(0, "me", "geheim")
    with pytest.raises(CaptureRefusedError, match="check user and password") as refused:
        NetworkCapture(f"rtsp://me:falsch@127.0.0.1:{port}/cam")
    assert "falsch" not in str(refused.value)
    with NetworkCapture(f"rtsp://me:geheim@127.0.0.1:{port}/cam") as capture:
        assert capture.read(3) is not None


@pytest.mark.slow
def test_an_rtsp_server_that_freezes_and_restarts_is_found_again(
    start_rtsp: RtspStarter, caplog: pytest.LogCaptureFixture
) -> None:
    server, port = start_rtsp()
    settings = LiveSettings(stall_timeout_s=1.0, open_timeout_s=4.0)
    with open_source(f"rtsp://x:geheim@127.0.0.1:{port}/cam", live=settings) as source:
        assert isinstance(source, LiveSource)
        frames = iter(source)
        assert next(frames).epoch == 0
        server.send_signal(signal.SIGSTOP)
        assert eventually(lambda: source.status().stalls == 1, 5)
        server.send_signal(signal.SIGKILL)
        server.wait()
        start_rtsp(port)
        while (frame := next(frames)).epoch == 0:
            pass
        assert frame.epoch == 1
        assert source.status().reconnects == 1
    assert "geheim" not in caplog.text
