"""Files that are written whole or record by record, with errors that say what to do.

Missing folders are made; what goes wrong is an `OutputError` of one line.
"""

from __future__ import annotations

import contextlib
import csv
import errno
import io
import os
from collections.abc import Iterable
from pathlib import Path

from streamtrack.closing import Closing
from streamtrack.errors import OutputError

_ADVICE = {
    errno.ENOSPC: ("no space left on the disk", "free some or choose another disk"),
    errno.EDQUOT: ("disk quota used up", "free some space or choose another disk"),
    errno.EFBIG: ("the file grew too large for its disk", "choose another disk"),
    errno.EACCES: ("permission denied", "choose a place that you may write to"),
    errno.EPERM: ("not permitted", "choose a place that you may write to"),
    errno.EROFS: ("the disk is read-only", "choose another place"),
    errno.EISDIR: ("this is a folder", "name a file in it"),
    errno.EEXIST: ("a file stands where its folder should be", "choose another folder"),
    errno.ENOTDIR: ("a file stands where its folder should be", "choose another folder"),
}


def output_error(path: Path, error: OSError) -> OutputError:
    """The one-line error for a file that cannot be written: what is wrong and what to do."""
    problem, advice = _ADVICE.get(
        error.errno or 0, (error.strerror or str(error), "choose another file")
    )
    return OutputError(f"cannot write {path}: {problem}; {advice}")


def open_output(path: Path) -> io.FileIO:
    """Open a file for unbuffered writing, emptied. Raises OutputError."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return path.open("wb", buffering=0)
    except OSError as error:
        raise output_error(path, error) from None


def write_file(path: Path, data: bytes) -> None:
    """Write a whole file or leave what was there before: a neighbour that takes its name.

    Missing folders are made. Pipes and devices are written directly. Raises OutputError.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        real = path.resolve()
        if real.exists() and not real.is_file():
            real.write_bytes(data)
            return
        part = _neighbour(real)
        try:
            part.write_bytes(data)
            part.replace(real)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise output_error(path, error) from None


def check_writable(path: Path) -> None:
    """Raise OutputError now if `write_file` could not write there later. Makes missing folders."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        real = path.resolve()
        if real.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if not real.exists() or real.is_file():
            part = _neighbour(real)
            part.touch()
            part.unlink()
    except OSError as error:
        raise output_error(path, error) from None


def _neighbour(path: Path) -> Path:
    return path.with_name(f".{path.name[:100]}.{os.getpid()}.part")


def encodable(text: str) -> str:
    """The text without lone surrogates (undecodable bytes of file names), which no format holds."""
    return text.encode("utf-8", "replace").decode("utf-8")


def csv_line(cells: Iterable[str]) -> str:
    r"""One line of CSV ending in ``\n``, line breaks within cells quoted.

    The csv module of Python < 3.13 quotes only the breaks of its own line ending, hence the detour.
    """
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\r\n").writerow(cells)
    return buffer.getvalue().removesuffix("\r\n") + "\n"


class RecordFile(Closing):
    """A file that grows by whole records, unbuffered: each is with the system once appended."""

    def __init__(self, path: Path, header: str = "") -> None:
        self._path = path
        self._size = 0
        self._file = open_output(path)
        try:
            self.append(header)
        except OutputError:
            self._file.close()
            raise

    def append(self, record: str) -> None:
        """Add text. Raises OutputError, and then the file ends after the record before."""
        data = record.encode("utf-8")
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[self._file.write(rest) or 0 :]
        except OSError as error:
            with contextlib.suppress(OSError):
                self._file.seek(self._size)
                self._file.truncate()
            raise output_error(self._path, error) from None
        self._size += len(data)

    def close(self) -> None:
        try:
            self._file.close()
        except OSError as error:
            raise output_error(self._path, error) from None
