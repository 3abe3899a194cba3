"""What `ps` shows of the program."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Sequence
from pathlib import Path

from streamtrack.sources.addresses import secrets_of

_ARG_START, _ARG_END = 48, 49


def hide_secrets(arguments: Sequence[str]) -> None:
    """Overwrite passwords of addresses in what ``ps`` and /proc show of this process.

    Linux only (proc(5): arg_start, arg_end); the arguments that Python holds stay as they are.
    """
    found = {secret for text in arguments if "://" in text for secret in secrets_of(text)}
    if not found or not sys.platform.startswith("linux"):
        return
    import ctypes

    with contextlib.suppress(OSError, ValueError, IndexError):
        fields = Path("/proc/self/stat").read_text("ascii", errors="replace")
        # The second field, the program's name, may hold anything.
        numbers = fields.rpartition(")")[2].split()
        start, end = (int(numbers[place - 3]) for place in (_ARG_START, _ARG_END))
        shown = Path("/proc/self/cmdline").read_bytes()
        if not 0 < len(shown) <= end - start:
            return
        for secret in sorted(found, key=len, reverse=True):
            raw = secret.encode(errors="surrogateescape")
            shown = shown.replace(raw, b"*" * len(raw))
        ctypes.memmove(start, shown, len(shown))
