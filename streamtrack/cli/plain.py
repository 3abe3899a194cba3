"""Progress, warnings and summary in plain text, for commands that are over in a blink.

Importing Rich would cost more than joining two pictures does.
"""

from __future__ import annotations

import logging
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from streamtrack.mosaic.job import MosaicProgress

_LINE_EVERY_S = 5.0
_REDRAW_EVERY_S = 0.1


class _Lines:
    """A line on a stream now and then; on a terminal one line that is drawn over."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._redraws = stream.isatty()
        self._stage, self._done = "", 0
        self._total: int | None = None
        self._last = time.monotonic()

    def begin(self, stage: str, total: int | None) -> None:
        self._stage, self._total, self._done = stage, total, 0

    def advance(self, text: str = "") -> None:
        self._done += 1
        now = time.monotonic()
        if now - self._last < (_REDRAW_EVERY_S if self._redraws else _LINE_EVERY_S):
            return
        self._last = now
        of = "" if self._total is None else f" of {self._total}"
        line = f"{self._stage} {self._done}{of} {text}".rstrip()
        if self._redraws:
            columns = shutil.get_terminal_size().columns
            self._stream.write(f"\r{line[: columns - 1]}\x1b[K")
        else:
            self._stream.write(f"{line}\n")
        self._stream.flush()

    def clear(self) -> None:
        """Leave the terminal's line empty."""
        if self._redraws:
            self._stream.write("\r\x1b[K")
            self._stream.flush()


@contextmanager
def stage_progress_for(quiet: bool) -> Iterator[MosaicProgress]:
    """Progress on stderr, or none."""
    if quiet:
        from streamtrack.mosaic.job import NoMosaicProgress

        yield NoMosaicProgress()
        return
    lines = _Lines(sys.stderr)
    try:
        yield lines
    finally:
        lines.clear()


@contextmanager
def warnings_on_stderr(quiet: bool) -> Iterator[None]:
    """Log records of the run go to stderr, a line each."""
    handler = logging.StreamHandler()
    start = "\r\x1b[K" if sys.stderr.isatty() else ""
    handler.setFormatter(logging.Formatter(f"{start}streamtrack: warning: %(message)s"))
    handler.setLevel(logging.ERROR if quiet else logging.WARNING)
    logger = logging.getLogger("streamtrack")
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def plain_summary(rows: list[tuple[str, str]], record: Path | None) -> None:
    """Labels and values in two columns on stdout; piped, lines are never wrapped."""
    width = max((len(label) for label, _ in rows), default=0) + 2
    for label, value in rows:
        sys.stdout.write(f"{label:<{width}}{value}".rstrip() + "\n")
    if record is not None:
        sys.stdout.write(f"\nOpen the recording: streamtrack view {record}\n")
