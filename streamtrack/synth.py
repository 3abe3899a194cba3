"""Writing a made-up scene to files: a video or a folder of pictures, and the truth as CSV."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import cv2

from streamtrack.errors import OutputError
from streamtrack.sources.synthetic import SyntheticSource, Truth
from streamtrack.sources.writer import VideoWriter
from streamtrack.types import Frame

HEADER = (
    *("frame", "time_s", "x1", "y1", "x2", "y2", "x3", "y3", "x4", "y4", "visible_share"),
    *(f"h{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3)),
)
Write = Callable[[Frame], None]


def write_synthetic(
    uri: str,
    output: str | Path,
    truth_path: str | Path | None = None,
    should_stop: Callable[[], bool] = lambda: False,
) -> int:
    """Render a ``synthetic://`` scene frame by frame; returns how many frames were written.

    ``output`` is a video (``.mkv`` is lossless) or, without an ending, a folder for PNG pictures.
    ``truth_path`` is a CSV file with the corners of the target, the share of it that is visible and
    ``world_from_frame`` row by row. Ends early, files closed, when ``should_stop`` says so.
    Raises UsageError for the URI and OutputError for the files.
    """
    written = 0
    with ExitStack() as stack:
        source = stack.enter_context(SyntheticSource(uri))
        assert source.info.rate_hz is not None
        write = stack.enter_context(_pictures(Path(output), source.info.rate_hz))
        note = stack.enter_context(_truths(None if truth_path is None else Path(truth_path)))
        for frame in source:
            write(frame)
            note(frame, source.truth(frame.index))
            written += 1
            if should_stop():
                break
    return written


@contextmanager
def _pictures(output: Path, rate_hz: float) -> Iterator[Write]:
    """A function that appends a frame to the video or folder."""
    if output.suffix:
        with VideoWriter(output, rate_hz=rate_hz, lossless=output.suffix == ".mkv") as writer:
            yield lambda frame: writer.write(frame.image, frame.time_s)
        return
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot make the folder {output}: {error.strerror}") from None
    yield lambda frame: _save(output / f"{frame.index:06d}.png", frame)


def _save(path: Path, frame: Frame) -> None:
    """One picture as PNG."""
    _, data = cv2.imencode(".png", frame.image, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from None


@contextmanager
def _truths(path: Path | None) -> Iterator[Callable[[Frame, Truth], None]]:
    """A function that appends a row of truth; without a path it does nothing."""
    if path is None:
        yield lambda _frame, _truth: None
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("w", encoding="utf-8", newline="") as file:
            rows = csv.writer(file, lineterminator="\n")
            rows.writerow(HEADER)
            yield lambda frame, truth: rows.writerow(_row(frame, truth))
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from None


def _row(frame: Frame, truth: Truth) -> list[str]:
    """Numbers in the shortest form that reads back as the same number."""
    numbers = [
        frame.time_s,
        *(float(value) for value in truth.quad.ravel()),
        truth.visible_share,
        *(float(value) for value in truth.world_from_frame.ravel()),
    ]
    return [str(frame.index), *(repr(float(number)) for number in numbers)]
