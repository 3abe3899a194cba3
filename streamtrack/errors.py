"""The exceptions of streamtrack.

    StreamtrackError
     +-- UsageError        an option or argument that cannot be right        (exit code 2)
     +-- SourceError       a file, folder or camera that cannot be read      (exit code 1)
     +-- TargetError       a target that this picture cannot be searched for (exit code 1)
     +-- OutputError       a file that cannot be written                     (exit code 1)

A bad *frame* is no exception: it is a verdict with a reason, carried in the results.
Each message is one line that says what is wrong and what to do about it.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class StreamtrackError(Exception):
    """Base of everything that streamtrack raises on purpose."""


class UsageError(StreamtrackError):
    """An option or argument that cannot be right, whatever the input."""


class SourceError(StreamtrackError):
    """A source that cannot be opened or holds nothing that can be read."""


class TargetError(StreamtrackError):
    """A target that cannot be tracked in this picture: outside it, too small, without texture."""


class OutputError(StreamtrackError):
    """An output that cannot be written."""


def unknown_name(kind: str, name: str, known: Iterable[str]) -> UsageError:
    """The error for a name that is not in the list, with the nearest one suggested."""
    known = list(known)
    nearest = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    hint = f"did you mean {nearest[0]}? " if nearest else ""
    return UsageError(f"unknown {kind} '{name}': {hint}known are {', '.join(known)}")
