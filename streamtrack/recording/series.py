"""Which files a long recording is made of: their names, when the next begins, which ones go.

A series is all files ``<stem>-000001.rrd``, ``<stem>-000002.rrd`` ... of one folder; sorted by name
they are sorted by time, and a later run goes on counting. Only they are ever removed, oldest first,
and none that some process holds open: the writer of a file keeps a lock on it.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from stat import S_ISREG

from streamtrack.errors import OutputError, UsageError
from streamtrack.outputs import output_error

_DIGITS = 6
_BYTES = {"KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}
_BYTES |= {"KIB": 1 << 10, "MIB": 1 << 20, "GIB": 1 << 30, "TIB": 1 << 40}
_SECONDS = {"S": 1.0, "MIN": 60.0, "H": 3600.0, "D": 86400.0}
_AMOUNT = re.compile(r"\s*(\d+(?:\.\d+)?)\s*([A-Za-z]+)\s*")
_MIN_FILE_BYTES = 10**6
_MIN_FILE_S = 1.0


@dataclass(frozen=True, slots=True)
class Limit:
    """A size, an age, or both, whichever is reached first; None = no such limit."""

    size_bytes: int | None = None
    age_s: float | None = None

    def is_reached(self, size_bytes: float, age_s: float) -> bool:
        return (self.size_bytes is not None and size_bytes >= self.size_bytes) or (
            self.age_s is not None and age_s >= self.age_s
        )


def parse_limit(text: str, option: str) -> Limit:
    """A limit from words such as ``100MB``, ``10min``, ``2GB|7d``; ``option`` is for the message.

    Sizes in KB, MB, GB, TB (powers of ten) or KiB ... TiB, ages in s, min, h, d; between the two
    stands ``|`` or a comma, which shells leave alone. Raises UsageError.
    """
    size_bytes: int | None = None
    age_s: float | None = None
    for part in re.split(r"[|,]", text):
        match = _AMOUNT.fullmatch(part)
        unit = match[2].upper() if match else ""
        if match and unit in _BYTES and size_bytes is None:
            size_bytes = int(float(match[1]) * _BYTES[unit])
        elif match and unit in _SECONDS and age_s is None:
            age_s = float(match[1]) * _SECONDS[unit]
        else:
            raise UsageError(
                f"{option} '{text}': give a size (100MB, 2GB), an age (10min, 12h, 7d), "
                "or both: 100MB,10min"
            )
    if size_bytes == 0 or age_s == 0.0:
        raise UsageError(f"{option} '{text}': give more than nothing")
    return Limit(size_bytes, age_s)


def parse_rotate(text: str | None) -> Limit | None:
    """When the next file begins. Raises UsageError, also for files too small to be of use."""
    if text is None:
        return None
    limit = parse_limit(text, "rotate")
    if limit.size_bytes is not None and limit.size_bytes < _MIN_FILE_BYTES:
        raise UsageError(f"rotate '{text}': files of at least 1MB, please")
    if limit.age_s is not None and limit.age_s < _MIN_FILE_S:
        raise UsageError(f"rotate '{text}': files of at least 1s, please")
    return limit


def parse_keep(text: str | None) -> Limit | None:
    """What is kept of the files. Raises UsageError."""
    return None if text is None else parse_limit(text, "keep")


def check_keep(rotate: Limit | None, keep: Limit | None) -> None:
    """Raise UsageError where ``keep`` could not be held to with files as ``rotate`` makes them."""
    if keep is None:
        return
    if rotate is None:
        raise UsageError("keep removes whole files: say with rotate when a new one begins")
    if keep.size_bytes and rotate.size_bytes and keep.size_bytes < 2 * rotate.size_bytes:
        raise UsageError("keep must hold two files of the size given by rotate, or more")


@dataclass(frozen=True, slots=True)
class _Entry:
    path: Path
    size_bytes: int
    modified_s: float


class FileSeries:
    """The files of one recording, ``path`` with a number before its ending."""

    def __init__(self, path: Path) -> None:
        self._base = path
        self._pattern = re.compile(
            re.escape(path.stem) + rf"-(\d{{{_DIGITS}}})" + re.escape(path.suffix)
        )

    def next_path(self) -> Path:
        """A new file, made empty, after all that are there. Raises OutputError."""
        folder = self._base.parent
        try:
            folder.mkdir(parents=True, exist_ok=True)
            number = max((self._number(entry.path) for entry in self._entries()), default=0)
            while True:
                number += 1
                path = self._base.with_stem(f"{self._base.stem}-{number:0{_DIGITS}d}")
                with contextlib.suppress(FileExistsError):
                    path.open("xb").close()  # two runs never take the same file
                    return path
        except OSError as error:
            raise output_error(self._base, error) from None

    def paths(self) -> list[Path]:
        """The files there are, oldest first. Raises OSError."""
        return [entry.path for entry in self._entries()]

    def remove_beyond(self, keep: Limit, reserve_bytes: int = 0) -> list[tuple[Path, str]]:
        """Remove what ``keep`` does not allow; each file that went, with the reason.

        Files in use stay, and count by their size or ``reserve_bytes``, whichever is more.
        """
        entries = self._entries()
        free = [entry for entry in entries if not is_in_use(entry.path)]
        total = sum(
            entry.size_bytes if entry in free else max(entry.size_bytes, reserve_bytes)
            for entry in entries
        )
        removed: list[tuple[Path, str]] = []
        for entry in free:
            reason = ""
            age_s = time.time() - entry.modified_s
            if keep.age_s is not None and age_s > keep.age_s:
                reason = f"it is {_age_text(age_s)} old, of {_age_text(keep.age_s)} to keep"
            elif keep.size_bytes is not None and total > keep.size_bytes:
                reason = (
                    f"{total / 1e6:.1f} MB are more than the {keep.size_bytes / 1e6:.1f} MB to keep"
                )
            if not reason:
                continue
            entry.path.unlink(missing_ok=True)
            total -= entry.size_bytes
            removed.append((entry.path, reason))
        return removed

    def _entries(self) -> list[_Entry]:
        """Own regular files; a link or folder of such a name is not our own."""
        entries: list[_Entry] = []
        with os.scandir(self._base.parent) as folder:
            for item in folder:
                if not self._pattern.fullmatch(item.name):
                    continue
                with contextlib.suppress(FileNotFoundError):
                    status = item.stat(follow_symlinks=False)
                    if S_ISREG(status.st_mode):
                        path = self._base.parent / item.name
                        entries.append(_Entry(path, status.st_size, status.st_mtime))
        return sorted(entries, key=lambda entry: entry.path.name)

    def _number(self, path: Path) -> int:
        match = self._pattern.fullmatch(path.name)
        return int(match[1]) if match else 0


class Hold:
    """Marks a file as in use, for all processes, until it is released or this process ends."""

    def __init__(self, path: Path) -> None:
        """Raises OutputError if another process holds the file."""
        try:
            self._descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            raise output_error(path, error) from None
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(self._descriptor)
            raise OutputError(f"{path} is being written by another process") from None
        except OSError:
            pass  # a file system without locks: nothing can be marked there

    def release(self) -> None:
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


def is_in_use(path: Path) -> bool:
    """Whether some process, this one included, holds the file."""
    try:
        Hold(path).release()
    except OutputError:
        return True
    return False


@contextlib.contextmanager
def held(path: Path) -> Iterator[bool]:
    """Holds the file for a while; False if another process does."""
    try:
        hold = Hold(path)
    except OutputError:
        yield False
        return
    try:
        yield True
    finally:
        hold.release()


def _age_text(age_s: float) -> str:
    for unit in ("d", "h", "min"):
        if age_s >= _SECONDS[unit.upper()]:
            return f"{age_s / _SECONDS[unit.upper()]:.3g} {unit}"
    return f"{age_s:.3g} s"
