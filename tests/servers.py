"""Servers on 127.0.0.1 that send what a test tells them to, and break off as it wishes."""

from __future__ import annotations

import base64
import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

import av
import cv2
import numpy as np

from streamtrack.types import Image, Size

Handler: TypeAlias = Callable[[socket.socket], None]

SIZE_WH = (160, 120)
BOUNDARY = b"--picture\r\nContent-Type: image/jpeg\r\nContent-Length: "


class Server:
    """Accepts on a free port and gives each connection to ``handler`` in a thread."""

    def __init__(self, handler: Handler, port: int = 0) -> None:
        self.handler = handler
        self.accepted = 0
        self._open: list[socket.socket] = []
        self._socket = socket.create_server(("127.0.0.1", port), backlog=64)
        self.port: int = self._socket.getsockname()[1]
        self._thread = threading.Thread(target=self._accept, daemon=True)
        self._thread.start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self._socket.accept()
                self.accepted += 1
                self._open.append(connection)
                threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection: socket.socket) -> None:
        with contextlib.suppress(OSError), connection:
            self.handler(connection)

    def close(self) -> None:
        """Stop listening and hang up."""
        for one in (self._socket, *self._open):
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()
        self._thread.join(5)

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def free_port() -> int:
    """A port that nobody listens on."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        return int(taken.getsockname()[1])


@cache
def picture(number: int, size_wh: Size = SIZE_WH) -> Image:
    """A picture that tells its number (0..255): see `number_of`."""
    width, height = size_wh
    image = np.zeros((height, width, 3), np.uint8)
    for bit in range(8):
        if number >> bit & 1:
            image[:, bit * width // 8 : (bit + 1) * width // 8] = 255
    image.setflags(write=False)
    return image


def number_of(image: Image) -> int:
    """The number in a `picture`, whatever its size."""
    width = image.shape[1]
    middle = image[image.shape[0] // 2].reshape(width, -1).mean(axis=1)
    bits = [middle[(2 * bit + 1) * width // 16] > 127 for bit in range(8)]
    return sum(1 << bit for bit, is_set in enumerate(bits) if is_set)


@cache
def jpeg(number: int, size_wh: Size = SIZE_WH) -> bytes:
    """A `picture` as a JPEG file."""
    return bytes(cv2.imencode(".jpg", picture(number, size_wh))[1])


def part(data: bytes) -> bytes:
    """One picture of an MJPEG stream."""
    return BOUNDARY + str(len(data)).encode() + b"\r\n\r\n" + data + b"\r\n"


MJPEG_HEADER = (
    b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=picture\r\n\r\n"
)


def read_request(connection: socket.socket) -> bytes:
    """Head of an HTTP request."""
    head = b""
    while b"\r\n\r\n" not in head:
        head += connection.recv(65536) or b"\r\n\r\n"
    return head


def mjpeg(
    numbers: Sequence[int] | range,
    *,
    size_wh: Size = SIZE_WH,
    fps: float = 50.0,
    then: Callable[[socket.socket], None] | None = None,
) -> Handler:
    """Sends pictures as HTTP MJPEG at a rate, then does ``then`` and hangs up."""

    def handle(connection: socket.socket) -> None:
        read_request(connection)
        connection.sendall(MJPEG_HEADER)
        for number in numbers:
            connection.sendall(part(jpeg(number % 256, size_wh)))
            time.sleep(1 / fps)
        if then is not None:
            then(connection)

    return handle


def silence(connection: socket.socket) -> None:
    """Say nothing until the other side hangs up."""
    while connection.recv(65536):
        pass


def protected(user: str, password: str, inner: Handler) -> Handler:
    """Asks for the password (HTTP basic)."""
    token = base64.b64encode(f"{user}:{password}".encode())

    def handle(connection: socket.socket) -> None:
        head = connection.recv(65536, socket.MSG_PEEK)
        if b"Basic " + token in head:
            inner(connection)
            return
        read_request(connection)
        connection.sendall(
            b'HTTP/1.0 401 Unauthorized\r\nWWW-Authenticate: Basic realm="x"\r\n'
            b"Content-Length: 0\r\n\r\n"
        )

    return handle


def files(folder: Path) -> Handler:
    """Serves the files of a folder, whole."""

    def handle(connection: socket.socket) -> None:
        name = read_request(connection).split(b" ")[1].decode().lstrip("/").partition("?")[0]
        path = folder / name
        if not path.is_file():
            connection.sendall(b"HTTP/1.0 404 Not Found\r\nContent-Length: 0\r\n\r\n")
            return
        data = path.read_bytes()
        connection.sendall(b"HTTP/1.0 200 OK\r\nContent-Length: %d\r\n\r\n" % len(data) + data)

    return handle


def encode(
    target: str | Path,
    numbers: Sequence[int] | range,
    *,
    container_format: str | None = None,
    rate: int = 25,
    keyframes: int = 10,
    pace: Callable[[int], object] = id,
    options: dict[str, str] | None = None,
) -> None:
    """Write pictures as H.264, a keyframe every ``keyframes``, to a file or ``udp://``."""
    with av.open(str(target), "w", format=container_format, options=options or {}) as container:
        stream = container.add_stream("libx264", rate=rate)
        stream.width, stream.height = SIZE_WH
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = Fraction(1, rate)
        stream.options = {"tune": "zerolatency", "g": str(keyframes), "preset": "ultrafast"}
        for place, number in enumerate(numbers):
            pace(number)
            frame = av.VideoFrame.from_ndarray(picture(number % 256), format="bgr24")
            frame.pts = place
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def eventually(is_so: Callable[[], Any], timeout_s: float = 5.0) -> bool:
    """True as soon as ``is_so`` is; False if it is not in time."""
    end_s = time.monotonic() + timeout_s
    while not is_so():
        if time.monotonic() > end_s:
            return False
        time.sleep(0.01)
    return True


def children_of(pid: int) -> Iterator[int]:
    """Processes started by a process and still there."""
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(OSError):
            yield from map(int, task.read_text().split())
