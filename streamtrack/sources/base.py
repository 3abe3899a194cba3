"""What every source of frames promises."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from types import TracebackType
from typing import Protocol, Self, runtime_checkable

from streamtrack.types import Frame, Skipped, SourceInfo


@runtime_checkable
class FrameSource(Protocol):
    """An open source: a context manager that yields frames once, in the order of time.

    Opening happens in the constructor, and a source that fails to open leaves nothing open.
    What goes wrong while reading and does not end the source is logged as a warning on the
    logger ``streamtrack.sources`` and counted here; what ends it is raised as `SourceError`,
    after all frames that could be read were yielded.
    """

    @property
    def info(self) -> SourceInfo:
        """Size, rate, length and kind of the source."""
        ...

    @property
    def skipped(self) -> Sequence[Skipped]:
        """Pictures left out so far, in order."""
        ...

    @property
    def corrupt_packets(self) -> int:
        """Damaged packets skipped so far."""
        ...

    @property
    def shortfall(self) -> str:
        """After the last frame: how the source fell short of what it promised, or empty."""
        ...

    def __iter__(self) -> Iterator[Frame]: ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None: ...
