from __future__ import annotations

import configparser
import os
import shlex
import socket
import sys
from pathlib import Path

import pytest

import streamtrack.job
import streamtrack.service as service
import streamtrack.targets
from streamtrack import cli
from streamtrack.errors import UsageError
from streamtrack.recording.live_server import LiveAddress
from streamtrack.recording.series import parse_rotate
from streamtrack.service import ServiceNotifier


@pytest.fixture(params=["file", "abstract"])
def manager(request, tmp_path):
    """A service manager's socket, and the environment it would give."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.setblocking(False)
        if request.param == "file":
            address = str(tmp_path / "notify")
            receiver.bind(address)
        else:
            address = f"@streamtrack-test-{os.getpid()}"
            receiver.bind("\0" + address[1:])
        yield receiver, {"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "3000000"}


def received(receiver):
    messages = []
    while True:
        try:
            messages.append(receiver.recv(4096).decode())
        except BlockingIOError:
            return messages


@pytest.fixture
def clock(monkeypatch):
    now = {"s": 100.0}
    monkeypatch.setattr(service.time, "monotonic", lambda: now["s"])
    return now


def test_ready_is_said_once_and_stopping_at_the_end(manager):
    receiver, environment = manager
    notifier = ServiceNotifier(environment)
    assert notifier.is_used
    notifier.ready("tracking 2\ntargets")
    notifier.ready()
    notifier.stopping("closing files")
    assert received(receiver) == [
        "READY=1\nSTATUS=tracking 2 targets",
        "STOPPING=1\nSTATUS=closing files",
    ]


def test_watchdog_is_fed_at_a_third_of_its_time(manager, clock):
    receiver, environment = manager
    notifier = ServiceNotifier(environment)
    times = []
    for frame in range(90):
        notifier.alive()
        if received(receiver) == ["WATCHDOG=1"]:
            times.append(frame / 30)
        clock["s"] += 1 / 30
    assert times == pytest.approx([0.0, 1.0, 2.0], abs=0.11)


def test_status_is_sent_now_and_then(manager, clock):
    receiver, environment = manager
    notifier = ServiceNotifier({**environment, "WATCHDOG_USEC": "0"})
    for second in range(21):
        notifier.alive(f"frame {second}")
        clock["s"] += 1.0
    assert received(receiver) == ["STATUS=frame 0", "STATUS=frame 10", "STATUS=frame 20"]


@pytest.mark.parametrize(
    "changes",
    [
        {"WATCHDOG_USEC": "soon"},
        {"WATCHDOG_USEC": "-5"},
        {"WATCHDOG_PID": "1"},
        {"WATCHDOG_PID": "me"},
    ],
)
def test_no_watchdog_that_is_not_ours(manager, changes):
    receiver, environment = manager
    ServiceNotifier({**environment, **changes}).alive()
    assert received(receiver) == []


@pytest.mark.parametrize(
    "address", ["", "/nowhere/notify", "@nobody-listens-here", "/" + 200 * "x", "relative"]
)
def test_nobody_listens(address):
    notifier = ServiceNotifier({"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "1000"})
    notifier.ready()
    notifier.alive("frame 1")
    notifier.stopping()
    assert notifier.is_used == bool(address)


def test_a_full_socket_blocks_nobody(tmp_path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(str(tmp_path / "notify"))
        notifier = ServiceNotifier({"NOTIFY_SOCKET": str(tmp_path / "notify")})
        for _ in range(2000):
            notifier.stopping()
        receiver.setblocking(False)
        assert 0 < len(received(receiver)) < 2000


def test_the_unit_file_fits_the_service(monkeypatch):
    path = Path(__file__).parent.parent / "scripts" / "streamtrack.service"
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str  # type: ignore[assignment,method-assign]
    unit.read(path)
    assert unit["Service"]["Type"] == "notify"
    assert int(unit["Service"]["WatchdogSec"]) >= 10
    assert unit["Service"]["Restart"] == "always"
    program, *arguments = shlex.split(unit["Service"]["ExecStart"])
    assert program.endswith("/bin/streamtrack")
    jobs = []

    def run_track(job, progress, should_stop):
        jobs.append(job)
        raise UsageError("enough")

    monkeypatch.setattr(streamtrack.job, "run_track", run_track)
    monkeypatch.setattr(streamtrack.targets, "parse_targets", lambda texts: texts)
    monkeypatch.setattr(sys, "argv", ["streamtrack", *arguments])
    with pytest.raises(SystemExit):
        cli.main()
    assert jobs, "its command line is refused"
    assert jobs[0].source == "/dev/video0"
    assert jobs[0].outputs.live == LiveAddress()
    assert parse_rotate(jobs[0].settings.recording.rotate).age_s == 600
    assert jobs[0].settings.recording.keep == "2GB"
