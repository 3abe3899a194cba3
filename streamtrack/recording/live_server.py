"""The process that serves viewers of a run: its address, its life, and the pipe that feeds it."""

from __future__ import annotations

import contextlib
import os
import select
import shutil
import socket
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from streamtrack.errors import OutputError, UsageError
from streamtrack.viewer import viewer_executable

DEFAULT_PORT = 9876
_LOOPBACK = "127.0.0.1"
_MEMORY = "64MB"
_MAX_RSS = 400 << 20
_CHUNK = 1 << 16
_STUCK_S = 10.0
_START_TIMEOUT_S = 10.0


@dataclass(frozen=True, slots=True)
class LiveAddress:
    """Where viewers connect: gRPC at ``port``, the page at the port after it."""

    host: str = _LOOPBACK
    port: int = DEFAULT_PORT

    @property
    def page_port(self) -> int:
        return self.port + 1

    @property
    def page_url(self) -> str:
        """To open in a browser."""
        data = quote(self.data_url, safe="")
        return f"http://{self._reachable}:{self.page_port}/?url={data}&hide_welcome_screen=1"

    @property
    def data_url(self) -> str:
        """For ``rerun URL``, the viewer's own window."""
        return f"rerun+http://{self._reachable}:{self.port}/proxy"

    @property
    def _reachable(self) -> str:
        host = socket.gethostname() if self.host in ("0.0.0.0", "::") else self.host
        return f"[{host}]" if ":" in host else host


def parse_live(text: str) -> LiveAddress:
    """``PORT``, ``HOST:PORT`` or ``[IPV6]:PORT``; empty = 127.0.0.1:9876. Raises UsageError."""
    host, _, port = text.strip().rpartition(":")
    host, port = host or _LOOPBACK, port or str(DEFAULT_PORT)
    host = host[1:-1] if host.startswith("[") and host.endswith("]") else host
    if not (port.isascii() and port.isdigit() and 0 < int(port) < 65535):
        raise UsageError(f"live '{text}': give a port below 65535, or ADDRESS:PORT")
    try:
        socket.getaddrinfo(host, int(port), flags=socket.AI_NUMERICHOST)
    except OSError:
        raise UsageError(
            f"live '{text}': give an address of this machine in numbers, 0.0.0.0 for all"
        ) from None
    return LiveAddress(host, int(port))


class ServerError(Exception):
    """The process that serves viewers is of no use any more."""


class LiveServer:
    """The process that keeps the last data and serves viewers, fed by a pipe."""

    def __init__(self, address: LiveAddress) -> None:
        self._address = address
        self._process: subprocess.Popen[bytes] | None = None
        self._pipe = -1

    def wait(self) -> None:
        """Until viewers can connect, which is once it was fed. Raises OutputError."""
        deadline = time.monotonic() + _START_TIMEOUT_S
        while not _answers(self._address):
            if self._process is None or self._process.poll() is not None:
                raise OutputError(f"the live view at {self._address.data_url} could not be started")
            if time.monotonic() > deadline:
                raise OutputError(f"the live view at {self._address.data_url} does not answer")
            time.sleep(0.05)

    def start(self) -> None:
        """Raises SourceError if there is no viewer installed, OSError."""
        host, port = self._address.host, self._address.port
        origins = (
            []
            if host == _LOOPBACK
            else ["--cors-allow-origin", f"http://*:{self._address.page_port}"]
        )
        command = [
            *_dying_with_parent(),
            *(str(viewer_executable()), "-", "--serve-web", "--bind", host),
            *("--port", str(port), "--web-viewer-port", str(self._address.page_port)),
            *("--server-memory-limit", _MEMORY, *origins),
        ]
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for the run, which closes this one itself
            env={**os.environ, "RUST_LOG": "error"},
        )
        assert self._process.stdin is not None
        self._pipe = self._process.stdin.fileno()
        os.set_blocking(self._pipe, False)

    def write(self, data: bytes) -> None:
        """Hand data over, which takes as long as it takes. Raises ServerError if it cannot be."""
        rest = memoryview(data)
        deadline = time.monotonic() + _STUCK_S
        while rest:
            left = deadline - time.monotonic()
            try:
                if left <= 0 or not select.select([], [self._pipe], [], left)[1]:
                    raise ServerError(f"it took nothing for {_STUCK_S:g} s (a frozen viewer?)")
                rest = rest[os.write(self._pipe, rest[:_CHUNK]) :]
            except BlockingIOError:
                continue
            except (OSError, ValueError):
                raise ServerError("it ended") from None

    def check(self) -> None:
        """Raises ServerError if it is gone, or too large."""
        process = self._process
        if process is None or process.poll() is not None:
            raise ServerError("it ended")
        with contextlib.suppress(OSError, ValueError):
            pages = int(Path(f"/proc/{process.pid}/statm").read_text("ascii").split()[1])
            size = pages * os.sysconf("SC_PAGE_SIZE")
            if size > _MAX_RSS:
                raise ServerError(f"it grew to {size / 1e6:.0f} MB (a frozen viewer?)")

    def kill(self) -> None:
        """End the process, from any thread; who is writing to it gets a ServerError."""
        if self._process is not None:
            self._process.kill()

    def stop(self) -> None:
        """End the process and give everything back; not while another thread is writing."""
        process, self._process, self._pipe = self._process, None, -1
        if process is None:
            return
        process.kill()
        process.wait()
        if process.stdin is not None:
            with contextlib.suppress(OSError):
                process.stdin.close()


def check_free(address: LiveAddress) -> None:
    """Raises OutputError unless both ports can be had."""
    for port in (address.port, address.page_port):
        family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
        with socket.socket(family) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((address.host, port))
            except OSError as error:
                raise OutputError(
                    f"the live view cannot listen on {address.host} port {port} "
                    f"({error.strerror}): choose another port"
                ) from None


def _answers(address: LiveAddress) -> bool:
    host = {"0.0.0.0": _LOOPBACK, "::": "::1"}.get(address.host, address.host)
    for port in (address.port, address.page_port):
        try:
            socket.create_connection((host, port), timeout=1.0).close()
        except OSError:
            return False
    return True


def _dying_with_parent() -> list[str]:
    """A command before a command: should this process be killed, that one ends too."""
    setpriv = shutil.which("setpriv")
    return [] if setpriv is None else [setpriv, "--pdeathsig", "KILL"]
