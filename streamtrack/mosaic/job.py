"""One mosaic run: what it is given, where its results go, and what came of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from streamtrack.errors import StreamtrackError, UsageError
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


def run_mosaic(
    job: MosaicJob, progress: MosaicProgress, should_stop: Callable[[], bool]
) -> MosaicOutcome:
    """Run the job, of pictures or of a stream; all outputs are closed when it returns.

    Raises StreamtrackError if it cannot even start or an output cannot be written.
    """
    from streamtrack.mosaic.pictures.inputs import is_stream

    if len(job.inputs) == 1 and is_stream(job.inputs[0]):
        from streamtrack.mosaic.stream.job import run_stream_mosaic

        return run_stream_mosaic(job, progress, should_stop)
    if job.outputs.live is not None:
        raise UsageError("--live shows a stream as it goes, and these are pictures: leave it out")
    from streamtrack.mosaic.pictures.job import run_picture_mosaic

    return run_picture_mosaic(job, progress, should_stop)
