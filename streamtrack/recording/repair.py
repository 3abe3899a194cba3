"""Recordings that were never closed: found by their end, and made whole.

An .rrd file ends with a table of what is in it. A file whose writer was killed has none, and its
last message may be cut. Viewers open such a file, slower and up to the cut; ``rerun rrd optimize``
reads what is complete and writes it anew with its table.
"""

from __future__ import annotations

import os
import subprocess
import threading
from pathlib import Path

from streamtrack.errors import StreamtrackError
from streamtrack.recording.series import held
from streamtrack.viewer import viewer_executable

_END_MAGIC = b"RRF2FOOT"
_END_BYTES = 12
"""The end magic and the number of tables, as Rerun 0.41 writes them."""
_POLL_S = 0.1
_NICE = ("nice", "-n", "10")


def is_whole(path: Path) -> bool:
    """Whether the file was closed properly. Raises OSError."""
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        if size < _END_BYTES:
            return False
        file.seek(size - _END_BYTES)
        return file.read(len(_END_MAGIC)) == _END_MAGIC


def mend(path: Path, stop: threading.Event | None = None) -> str:
    """Make an unfinished recording whole; what was done in words, empty if nothing was.

    An empty file is removed. The file is left as it is, and the words say why, if it cannot be
    mended; if another process holds it, or ``stop`` is set meanwhile, nothing is done. Its time
    of modification stays. Reads the file into memory.
    """
    with held(path) as is_ours:
        if not is_ours:
            return ""
        try:
            status = path.stat()
            if is_whole(path):
                return ""
            if status.st_size == 0:
                path.unlink()
                return f"removed {path}: a killed run had left it empty"
            part = path.with_name(f".{path.name[:200]}.part")  # one name: a kill leaves one at most
            try:
                trouble = _optimize(path, part, stop)
                if trouble is None:
                    return ""
                if trouble:
                    return f"{path} was not closed and cannot be mended: {trouble}"
                os.utime(part, ns=(status.st_atime_ns, status.st_mtime_ns))
                part.replace(path)
            finally:
                part.unlink(missing_ok=True)
        except (OSError, StreamtrackError) as error:
            return f"{path} was not closed and cannot be mended: {error}"
    return f"mended {path}: a killed run had left it without its end"


def _optimize(path: Path, part: Path, stop: threading.Event | None) -> str | None:
    """Write the whole file to ``part``: empty if done, else the trouble; None if stopped."""
    command = [*_NICE, str(viewer_executable()), "rrd", "optimize", str(path), "-o", str(part)]
    with subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        env={**os.environ, "RUST_LOG": "error"},
    ) as process:
        output = b""
        while True:
            try:
                output += process.communicate(timeout=_POLL_S)[1] or b""
                break
            except subprocess.TimeoutExpired:
                if stop is not None and stop.is_set():
                    process.kill()
                    return None
    if process.returncode == 0 and part.exists() and is_whole(part):
        return ""
    lines = output.decode("utf-8", "replace").strip().splitlines()
    return lines[-1] if lines else f"exit code {process.returncode}"
