"""What passes between a stream's reader (`reader_process`) and its user (`stream`), and how.

Two inherited descriptors join them: a stream socket, and a memory file that both map.

To the reader    a JSON line with the request; then one byte for each slot of the memory file that
                 may be written to again. End of stream: close and end.
From the reader  messages: `_HEADER` (two lengths), a JSON object, and the data of its packets.
                 ``info`` once, ``picture`` (in a slot), and ``error`` or ``end`` as the last.

Standard library only: the reader shall start fast and stay small.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import queue
import socket
import struct
import threading
import time
from typing import Any

_HEADER = struct.Struct("<II")
SLOTS = 4
_POLITE_S = 0.5
"""Time for a proper good-bye: cameras have few sessions and keep a lost one for a minute."""
_SLOT_PATIENCE_S = 0.02


class User:
    """The reader's side: messages to its user, free slots from it, and its wish to end."""

    def __init__(self, channel: socket.socket, memory_fd: int) -> None:
        self.is_closing = False
        self._channel = channel
        self._memory_fd = memory_fd
        self._memory: mmap.mmap | None = None
        self._start = self._slot_bytes = 0
        self._free: queue.SimpleQueue[int] = queue.SimpleQueue()
        for slot in range(SLOTS):
            self._free.put(slot)

    def request(self) -> dict[str, Any]:
        """What to read; blocks until it came."""
        line = b""
        while not line.endswith(b"\n"):
            part = self._channel.recv(65536)
            if not part:
                os._exit(0)
            line += part
        threading.Thread(target=self._listen, daemon=True).start()
        return dict(json.loads(line))

    def _listen(self) -> None:
        with contextlib.suppress(OSError):
            while slots := self._channel.recv(64):
                for slot in slots:
                    self._free.put(slot)
        self.is_closing = True
        self._free.put(0)  # Wake who waits for a slot.
        time.sleep(_POLITE_S)
        os._exit(0)

    def send(self, message: dict[str, Any], parts: tuple[bytes, ...] = ()) -> None:
        """Send a message and the data that it announces."""
        text = json.dumps(message).encode()
        size = sum(map(len, parts))
        self._channel.sendall(b"".join((_HEADER.pack(len(text), size), text, *parts)))

    def free_slot(self, is_patient: bool) -> int | None:
        """A slot to write to, or None if there is none: then the picture is left out."""
        try:
            return self._free.get(timeout=None if is_patient else _SLOT_PATIENCE_S)
        except queue.Empty:
            return None

    def put(self, slot: int, plane: memoryview) -> int:
        """Copy a picture into a slot. Returns its offset in the memory file."""
        if plane.nbytes > self._slot_bytes:
            # Slots of the old size that are still being read keep their place before the new ones.
            start = 0 if self._memory is None else len(self._memory)
            self._slot_bytes = -(-plane.nbytes // mmap.PAGESIZE) * mmap.PAGESIZE
            self._start = start
            os.ftruncate(self._memory_fd, start + SLOTS * self._slot_bytes)
            self._memory = mmap.mmap(self._memory_fd, start + SLOTS * self._slot_bytes)
        assert self._memory is not None
        offset = self._start + slot * self._slot_bytes
        self._memory[offset : offset + plane.nbytes] = plane
        return offset


class Messages:
    """The user's view of the reader's messages; what has come in part is kept for the next call."""

    def __init__(self, channel: socket.socket) -> None:
        self._channel = channel
        self._buffer = bytearray()

    def receive(self, timeout_s: float) -> tuple[dict[str, Any], bytes] | None:
        """The next message with its data, or None if it is not complete in time.

        Raises EOFError if the reader is gone.
        """
        end_s = time.monotonic() + timeout_s
        while (message := self._complete()) is None:
            # Zero would not block but raise another error.
            self._channel.settimeout(max(1e-3, end_s - time.monotonic()))
            try:
                part = self._channel.recv(1 << 18)
            except TimeoutError:
                return None
            except OSError:
                part = b""
            if not part:
                raise EOFError
            self._buffer += part
        return message

    def _complete(self) -> tuple[dict[str, Any], bytes] | None:
        if len(self._buffer) < _HEADER.size:
            return None
        text_size, data_size = _HEADER.unpack_from(self._buffer)
        data_start = _HEADER.size + text_size
        end = data_start + data_size
        if len(self._buffer) < end:
            return None
        message = json.loads(self._buffer[_HEADER.size : data_start])
        data = bytes(self._buffer[data_start:end])
        del self._buffer[:end]
        return message, data
