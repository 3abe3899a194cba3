from __future__ import annotations

import logging
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rrd import rrd_columns, rrd_entities
from test_recording import BLOB, blob, source, step_of, tracked

import streamtrack.recording.live_server as live_server
import streamtrack.recording.live_view as live_view
from streamtrack.errors import OutputError, UsageError
from streamtrack.geometry import scaling, transform_points
from streamtrack.recording.live_server import LiveAddress, parse_live
from streamtrack.recording.live_view import LiveView
from streamtrack.settings import Settings
from streamtrack.types import CameraPose, Frame, Step
from streamtrack.viewer import viewer_executable

NOISE = np.random.default_rng(0).integers(0, 255, (8, 360, 480, 3), np.uint8)


@pytest.fixture
def address():
    """A pair of free ports, below those that the system gives to others."""
    for port in range(21000 + os.getpid() % 5000, 32000, 2):
        with socket.socket() as one, socket.socket() as two:
            try:
                one.bind(("127.0.0.1", port))
                two.bind(("127.0.0.1", port + 1))
            except OSError:
                continue
            return LiveAddress(port=port)
    raise AssertionError


@pytest.mark.parametrize(
    ("text", "host", "port"),
    [
        ("", "127.0.0.1", 9876),
        ("9000", "127.0.0.1", 9000),
        (" 0.0.0.0:9000 ", "0.0.0.0", 9000),
        ("192.168.1.4:80", "192.168.1.4", 80),
        ("[::1]:9000", "::1", 9000),
        (":9000", "127.0.0.1", 9000),
    ],
)
def test_addresses(text, host, port):
    assert parse_live(text) == LiveAddress(host, port)


@pytest.mark.parametrize(
    "text", ["x", "0", "65535", "70000", "-1", "localhost", "no host:1", "1.2.3:x", "a.b.c.d:80"]
)
def test_nonsense_addresses_are_refused(text):
    with pytest.raises(UsageError, match="live"):
        parse_live(text)


def test_urls_say_where_the_data_is():
    assert LiveAddress().page_url == (
        "http://127.0.0.1:9877/?url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A9876%2Fproxy"
        "&hide_welcome_screen=1"
    )
    assert LiveAddress("::1", 80).data_url == "rerun+http://[::1]:80/proxy"
    assert "0.0.0.0" not in LiveAddress("0.0.0.0", 80).page_url


def test_a_taken_port_is_refused(address):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", address.page_port))
        taken.listen()
        with pytest.raises(OutputError, match=rf"port {address.page_port}.*choose another"):
            LiveView(address, source(), Settings(), [])


class FileServer:
    """Takes the place of the serving process: what it is given goes into a file."""

    path = Path()

    def __init__(self, address):
        self.is_broken = False

    def start(self):
        self.path.write_bytes(b"")

    def wait(self):
        pass

    def write(self, data):
        with self.path.open("ab") as file:
            file.write(data)

    def check(self):
        if self.is_broken:
            self.is_broken = False
            raise live_server.ServerError("it ended")

    def kill(self):
        pass

    stop = kill


@pytest.fixture
def file_server(monkeypatch, tmp_path):
    monkeypatch.setattr(FileServer, "path", tmp_path / "live.rrd")
    monkeypatch.setattr(live_view, "LiveServer", FileServer)
    monkeypatch.setattr(live_view, "_MAX_RATE_HZ", 1e9)


def shown():
    """What was received, as one whole recording: the stream is many small ones end to end."""
    whole = FileServer.path.with_name("whole.rrd")
    command = [str(viewer_executable()), "rrd", "optimize", str(FileServer.path), "-o", str(whole)]
    subprocess.run(command, check=True, capture_output=True)
    return whole


def wait_until(condition, seconds=15.0):
    deadline = time.monotonic() + seconds
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.02)
    assert condition()


def big_step(index):
    """Step as the tests of recordings make them, in a picture of 1280x960."""
    step = step_of(index)
    large_from_step = scaling(8.0)
    back = np.linalg.inv(large_from_step)
    tracks = tuple(
        track
        if track.quad is None
        else replace(
            track,
            quad=transform_points(large_from_step, track.quad),
            frame_from_template=large_from_step @ track.frame_from_template @ back,
        )
        for track in step.tracks
    )
    image = cv2.resize(step.frame.image, (1280, 960))
    return replace(step, frame=replace(step.frame, image=image), tracks=tracks)


def test_steps_are_shown_small_and_in_place(file_server, address):
    info = source(size_wh=(1280, 960))
    with LiveView(address, info, Settings(), ["board"]) as live:
        for index in range(9):
            live.log(big_step(index))
            wait_until(lambda: live._waiting.empty())
        logging.getLogger("streamtrack.sources").warning("hello")
        live.log_source("stalled", {"dropped": 3})
        live.close("# Done")
    received = shown()
    frames, pictures = rrd_columns(received, "/camera/image", BLOB)
    assert frames == list(range(9))
    small_picture = cv2.imdecode(np.frombuffer(blob(pictures[3]), np.uint8), cv2.IMREAD_COLOR)
    assert small_picture.shape == (480, 640, 3)
    small = transform_points(scaling(4.0), tracked("board", 3).quad)
    corners = rrd_columns(received, "/camera/targets/board/corners", "Points2D:positions")[1]
    np.testing.assert_allclose(corners[3], small, atol=0.01)
    assert "/targets/board/view" in rrd_entities(received)
    states = rrd_columns(received, "/targets/board/state", "StateChange:state")[1]
    assert states == [["tracking"], ["lost"], ["no picture"]]
    lines = [line for (line,) in rrd_columns(received, "/log", "TextLog:text")[1]]
    assert "hello" in lines
    assert rrd_columns(received, "/source/state", "StateChange:state")[1] == [["stalled"]]
    assert rrd_columns(received, "/summary", "TextDocument:text", None)[1][-1] == ["# Done"]


def test_no_more_than_can_be_seen(file_server, address, monkeypatch):
    monkeypatch.setattr(live_view, "_MAX_RATE_HZ", 5.0)
    with LiveView(address, source(), Settings(), []) as live:
        since = time.monotonic()
        for index in range(100):
            live.log(step_of(index, ()))
            time.sleep(0.01)
        seconds = time.monotonic() - since
    count = len(rrd_columns(shown(), "/camera/image", BLOB)[0])
    assert 3 <= count <= 5.0 / 0.9 * seconds + 1
    assert live.dropped == 0


def test_the_oldest_goes_where_there_is_no_room(file_server, address, monkeypatch):
    def stuck(self, data):
        time.sleep(0.2)

    with LiveView(address, source(), Settings(), []) as live:
        monkeypatch.setattr(FileServer, "write", stuck)
        worst = 0.0
        for index in range(200):
            since = time.perf_counter()
            live.log(step_of(index, ()))
            worst = max(worst, time.perf_counter() - since)
        assert live._waiting.qsize() <= 8
        assert live.dropped >= 180
        assert worst < 0.1


def test_a_new_process_is_told_everything_again(file_server, address, monkeypatch, caplog):
    monkeypatch.setattr(live_view, "_RESTART_S", (0.05, 60.0))
    with LiveView(address, source(), Settings(), ["board"]) as live:
        live.log(step_of(0))
        wait_until(lambda: live._waiting.empty())
        live._server.is_broken = True
        wait_until(lambda: "started anew: it ended" in caplog.text)
        time.sleep(0.3)
        live.log(step_of(1))
        wait_until(lambda: live._waiting.empty())
    received = shown()
    assert rrd_columns(received, "/camera/image", BLOB)[0] == [1]
    assert rrd_columns(received, "/__properties/run", "detector", None)[1] == [["harris"]]
    states = rrd_columns(received, "/targets/board/state", "StateChange:state")[1]
    assert states == [["tracking"]]


def noisy_step(index):
    frame = Frame(index, index / 100, NOISE[index % 8])
    return Step(frame, (tracked("board", index % 50),), CameraPose(np.eye(3)), None, {"total": 3.0})


def log_for(live, seconds, hertz=100.0):
    """Log at a rate; the longest time that a call took, in milliseconds."""
    worst, since = 0.0, time.monotonic()
    for index in range(int(seconds * hertz)):
        step = noisy_step(index)
        started = time.perf_counter()
        live.log(step)
        worst = max(worst, time.perf_counter() - started)
        time.sleep(max(0.0, since + index / hertz - time.monotonic()))
    return 1e3 * worst


@pytest.mark.slow
def test_frozen_and_killed_viewers_slow_nothing(address, monkeypatch, caplog):
    """A real server with a real client, which is stopped, and later a server that is stopped."""
    monkeypatch.setattr(live_server, "_STUCK_S", 1.0)
    monkeypatch.setattr(live_view, "_MAX_RATE_HZ", 1e9)
    with LiveView(address, source(size_wh=(480, 360)), Settings(), ["board"]) as live:
        with urllib.request.urlopen(f"http://127.0.0.1:{address.page_port}/", timeout=5) as page:
            assert b"html" in page.read(500).lower()
        client = subprocess.Popen(
            [str(viewer_executable()), address.data_url, "--save", os.devnull],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            log_for(live, 0.5)
            client.send_signal(signal.SIGSTOP)
            worst = [log_for(live, 1.0)]
            first = live._server._process
            first.send_signal(signal.SIGSTOP)
            worst.append(log_for(live, 3.0))
            assert first.poll() is not None
            assert "it took nothing" in caplog.text
        finally:
            client.kill()
            client.wait()
        wait_until(lambda: live._server._process is not None)
        worst.append(log_for(live, 0.5))
        since = time.monotonic()
    assert time.monotonic() - since < 2.5
    assert live.dropped > 0
    assert max(worst) < 100  # 12 ms where nothing else runs; here others share the cores


ORPHAN = """
import sys, time
from test_recording import Settings, source
from streamtrack.recording.live_server import LiveAddress
from streamtrack.recording.live_view import LiveView
live = LiveView(LiveAddress(port=int(sys.argv[1])), source(), Settings(), [])
print(live._server._process.pid, flush=True)
time.sleep(60)
"""


@pytest.mark.slow
def test_a_killed_run_leaves_no_process(address):
    folder = Path(__file__).parent
    with subprocess.Popen(
        [sys.executable, "-c", ORPHAN, str(address.port)],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(folder.parent)])},
        text=True,
    ) as process:
        assert process.stdout is not None
        server = int(process.stdout.readline())
        process.kill()
    wait_until(lambda: not _is_alive(server))


def _is_alive(pid):
    try:
        status = Path(f"/proc/{pid}/stat").read_text("ascii").rpartition(")")[2].split()[0]
    except OSError:
        return False
    return status != "Z"
