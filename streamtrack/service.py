"""Telling systemd how a service does (the protocol of sd_notify(3)), without a dependency.

Does nothing where the environment has no NOTIFY_SOCKET, so that it may be called anywhere.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Mapping


class ServiceNotifier:
    """Sends READY, STATUS, WATCHDOG and STOPPING to the service manager.

    `alive` is called once a frame (and while waiting for a source): a run that hangs calls it no
    more, and is restarted. It sends at a third of the watchdog's time, and a new status at most
    once in ten seconds. No call ever blocks or raises.
    """

    _STATUS_EVERY_S = 10.0

    def __init__(self, environment: Mapping[str, str] | None = None) -> None:
        values = os.environ if environment is None else environment
        address = values.get("NOTIFY_SOCKET", "")
        # A leading @ stands for the zero byte of an abstract socket.
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._watchdog_s = _watchdog_s(values)
        self._is_ready = False
        self._next_watchdog_s = 0.0
        self._next_status_s = 0.0

    @property
    def is_used(self) -> bool:
        """Whether a service manager listens."""
        return bool(self._address)

    def ready(self, status: str = "") -> None:
        """The service has begun its work; said once."""
        if not self._is_ready:
            self._is_ready = True
            self._send("READY=1", *_status(status))

    def alive(self, status: str = "") -> None:
        """The run is at work; ``status`` in a few words."""
        if not self._address:
            return
        now = time.monotonic()
        lines: list[str] = []
        if self._watchdog_s is not None and now >= self._next_watchdog_s:
            self._next_watchdog_s = now + self._watchdog_s / 3.0
            lines.append("WATCHDOG=1")
        if status and now >= self._next_status_s:
            self._next_status_s = now + self._STATUS_EVERY_S
            lines += _status(status)
        if lines:
            self._send(*lines)

    def stopping(self, status: str = "") -> None:
        """The service is about to end."""
        self._send("STOPPING=1", *_status(status))

    def _send(self, *lines: str) -> None:
        if not self._address:
            return
        with (
            contextlib.suppress(OSError, ValueError),
            socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as notify,
        ):
            notify.setblocking(False)
            notify.sendto("\n".join(lines).encode(), self._address)


def _status(status: str) -> list[str]:
    return [f"STATUS={' '.join(status.split())}"] if status else []


def _watchdog_s(environment: Mapping[str, str]) -> float | None:
    """The watchdog's time, if there is one and it is meant for this process."""
    try:
        if int(environment.get("WATCHDOG_PID", os.getpid())) != os.getpid():
            return None
        duration_us = int(environment.get("WATCHDOG_USEC", "0"))
    except ValueError:
        return None
    return duration_us / 1e6 if duration_us > 0 else None
