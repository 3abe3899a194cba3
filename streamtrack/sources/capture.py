"""What a live device promises to the loop that reads it (`streamtrack.sources.live`)."""

from __future__ import annotations

from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self, TypeVar

from streamtrack.errors import SourceError
from streamtrack.types import Image, Packet, SourceInfo


class CaptureEndedError(SourceError):
    """The device or the peer is gone, or the stream is broken: close it and open it again."""


class CaptureFinishedError(CaptureEndedError):
    """A finished file was read to its end: there is nothing to open again."""


class CaptureRefusedError(SourceError):
    """The peer knows us and does not want us (credentials): trying soon again would not help."""


_Error = TypeVar("_Error", bound=Exception)


def without_frames(error: _Error) -> _Error:
    """The error, to be kept, without the program's frames that it came through.

    These hold the device and its last picture, which would stay, in a cycle with the error, until
    a full garbage collection; while frames stream there may be none for days.
    """
    error.__traceback__ = error.__context__ = error.__cause__ = None
    return error


@dataclass(frozen=True, slots=True, eq=False)
class Captured:
    """One picture as a device delivered it.

    ``time_s`` is on the device's own clock (driver stamp, pts x time base); ``captured_s`` is the
    moment of capture on `time.monotonic`'s clock, as near as the device tells. ``lost`` counts the
    pictures that the device reports lost since the one before, ``damaged`` those that were
    rejected, ``dropped`` those that newer ones replaced before they were read, and ``thinned``
    those that were left out because fewer were asked for.
    """

    image: Image
    time_s: float
    captured_s: float
    lost: int = 0
    damaged: int = 0
    packets: tuple[Packet, ...] = ()
    dropped: int = 0
    thinned: int = 0


class Capture(Protocol):
    """An open live device; one that fails to open leaves nothing behind.

    The constructor raises SourceError (device missing, busy, forbidden: nothing to read) or
    UsageError (an address that cannot be right, so that trying again is pointless).
    """

    @property
    def info(self) -> SourceInfo:
        """What was granted: size, rate, codec."""
        ...

    def read(self, timeout_s: float) -> Captured | None:
        """The next picture, or None if none came in time. Raises CaptureEndedError when it is over.

        Always returns or raises within about ``timeout_s``, whatever the device does.
        """
        ...

    def close(self) -> None:
        """Give everything back, within two seconds, whatever the device does."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None: ...
