"""One mosaic run: what it is given, where its results go, and what came of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from streamtrack.errors import StreamtrackError
from streamtrack.mosaic.summary import MosaicSummary
from streamtrack.settings import Settings

if TYPE_CHECKING:
    from streamtrack.recording.live_server import LiveAddress


@dataclass(frozen=True, slots=True)
class MosaicOutputs:
    """Where the results go; None where they are not wanted."""

    image: Path | None = None
    poses: Path | None = None
    summary: Path | None = None
    record: Path | None = None
    live: LiveAddress | None = None


@dataclass(frozen=True, slots=True)
class MosaicJob:
    """All that one run needs to know.

    ``inputs`` are pictures, folders and globs, or one stream (video file or URI). ``truth`` is a
    text file with the true homography from the first picture to the second, for two pictures.
    ``start``, ``step`` and ``frames`` choose frames of a stream, or pictures of a folder.
    """

    inputs: tuple[str, ...]
    settings: Settings = field(default_factory=Settings)
    outputs: MosaicOutputs = field(default_factory=MosaicOutputs)
    truth: Path | None = None
    start: int = 0
    step: int = 1
    frames: int | None = None


@dataclass(frozen=True, slots=True)
class MosaicOutcome:
    """What came of a run: its summary, and what went wrong after it had begun, if anything."""

    summary: MosaicSummary
    error: StreamtrackError | None


class MosaicProgress(Protocol):
    """Told of the run's progress, so that a person can be.

    ``begin`` opens a stage (``reading``, ``matching``, ``painting``; a stream has one) of ``total``
    parts, None if unknown; ``advance`` says that one is done, in a few words.
    """

    def begin(self, stage: str, total: int | None) -> None: ...

    def advance(self, text: str = "") -> None: ...


class NoMosaicProgress:
    """Says nothing."""

    def begin(self, stage: str, total: int | None) -> None:
        return None

    def advance(self, text: str = "") -> None:
        return None
