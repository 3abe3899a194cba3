"""Why a camera cannot be opened, in one line that says what to do."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from pathlib import Path

from streamtrack.errors import SourceError, UsageError
from streamtrack.sources.v4l2.formats import Node, NodeKind, describe, node_paths, opened

_GONE = (errno.ENODEV, errno.ENXIO, errno.ENOENT)


def check_path(path: str) -> None:
    """Raises SourceError if there is no such device, UsageError if it is something else."""
    try:
        mode = Path(path).stat().st_mode
    except OSError as error:
        if error.errno == errno.ENOTDIR:
            error.errno = errno.ENOENT
        raise trouble(path, error) from None
    if not stat.S_ISCHR(mode):
        kind = "folder" if stat.S_ISDIR(mode) else "file"
        raise UsageError(f"{path} is a {kind}, not a camera: give it without v4l2://")


def trouble(path: str, error: OSError) -> SourceError:
    """What an error of the kernel means to who wants to open the device, and has closed it."""
    number = error.errno
    if number == errno.ENOENT:
        return SourceError(f"no such device {path}: {_connected()}")
    if number in _GONE:
        return SourceError(f"{path} is not connected any more: plug it in again")
    if number in (errno.EACCES, errno.EPERM):
        return SourceError(f"no permission to open {path}: {_permission(path)}")
    if number == errno.EBUSY:
        return SourceError(f"{path} is in use by {_holder(path)}: close it first")
    if number == errno.ENOSPC:
        return SourceError(
            f"{path}: not enough bandwidth on its bus: ask for format=mjpeg, a smaller size or a "
            "lower fps, or use a port of another bus"
        )
    if number in (errno.EIO, errno.ETIMEDOUT, errno.EPROTO, errno.EPIPE):
        return SourceError(
            f"{path} does not answer ({error.strerror}): plug it in again, or try another cable "
            "or port"
        )
    return SourceError(f"cannot open {path}: {error.strerror or error}; see streamtrack devices")


def not_a_camera(path: str) -> UsageError:
    """For a device that is no V4L2 device at all."""
    return UsageError(f"{path} is a device, but no camera: streamtrack devices lists cameras")


def check_kind(node: Node) -> None:
    """Raises UsageError unless the node captures pictures in a way that can be read."""
    if node.kind is not NodeKind.CAPTURE:
        raise UsageError(f"{node.path} ({node.name}) {_OF_KIND[node.kind]}: {_sibling(node)}")
    if not node.is_streaming:
        raise UsageError(
            f"{node.path} ({node.name}) has no streaming interface: its driver is too old"
        )


_OF_KIND = {
    NodeKind.METADATA: "carries metadata, no pictures",
    NodeKind.OUTPUT: "shows pictures, it takes none",
    NodeKind.CONVERTER: "converts pictures, it takes none",
    NodeKind.OTHER: "carries no pictures",
}


def _sibling(node: Node) -> str:
    """The node of the same camera that captures, or where to find one."""
    for other in _nodes():
        if other.bus == node.bus and other.kind is NodeKind.CAPTURE:
            return f"use {other.path}, of the same device"
    return "streamtrack devices lists cameras"


def _nodes() -> Iterator[Node]:
    for path in node_paths():
        try:
            with opened(path) as fd:
                yield describe(fd, path)
        except OSError:
            continue


def _connected() -> str:
    cameras = [f"{node.path} ({node.name})" for node in _nodes() if node.kind is NodeKind.CAPTURE]
    if cameras:
        return f"connected are {', '.join(cameras)}"
    return "no camera is connected; plug one in (streamtrack devices lists cameras)"


def _permission(path: str) -> str:
    group = "video"
    try:
        found = Path(path).stat()
        if found.st_gid != 0:
            import grp

            group = grp.getgrgid(found.st_gid).gr_name
    except (OSError, KeyError):
        pass
    return f"sudo usermod -aG {group} $USER, then log in again"


def _holder(path: str) -> str:
    """The processes that have it open, as far as we may see."""
    names = [
        "this program itself" if pid == os.getpid() else f"process {pid} ({_command(pid)})"
        for pid in _holders(path)
    ]
    return " and ".join(names) or f"another program (sudo fuser -v {path} names it)"


def _holders(path: str) -> list[int]:
    device = os.path.realpath(path)
    found: list[int] = []
    for process in Path("/proc").iterdir():
        if not process.name.isdigit():
            continue
        try:
            fds = list((process / "fd").iterdir())
        except OSError:
            continue
        if any(_link(fd) == device for fd in fds):
            found.append(int(process.name))
    return sorted(found)


def _link(path: Path) -> str:
    try:
        return str(path.readlink())
    except OSError:
        return ""


def _command(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/comm").read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return "?"
