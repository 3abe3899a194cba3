"""Writers of results as files: they watch the Steps go by and never decide anything.

    CSV, JSON Lines, MOT text    a record is on its way to the disk when `write` returns, so
                                        a killed process loses nothing; a record that a full disk
                                        cut in half is taken back
    Parquet                             row groups of 65 536 rows; readable only once closed

All of them are context managers that leave a complete file, whatever ended the run. Files are
opened (and emptied), and missing folders made, in the constructor: what cannot be written is
known before the first frame. What goes wrong is an `OutputError` of one line.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Protocol, Self

import numpy as np

from streamtrack.closing import Closing
from streamtrack.errors import UsageError
from streamtrack.geometry import bounding_box
from streamtrack.outputs import (
    RecordFile,
    csv_line,
    encodable,
    open_output,
    output_error,
)
from streamtrack.types import Step, Track

_BATCH_ROWS = 1024
_GROUP_BATCHES = 64


class TrackRow(NamedTuple):
    """One target in one frame, in the order of the columns of CSV, JSON Lines and Parquet.

    Corners x1, y1 .. x4, y4 in full-resolution pixels, ``model`` and ``rmse_px`` are None unless
    the state is tracking (``rmse_px`` also where it was not estimated). ``world_x1 .. world_y4``
    are the corners in pixels of the first keyframe, ``speed_px_s`` the speed there and
    ``world_sigma_px`` the expected RMS error of these corners, None where the camera's place is
    not known (the speed also in the first frames). The last three are in the table only where a
    ground is given: place and speed in its units.
    """

    frame: int
    time_s: float | None
    target: str
    state: str
    x1: float | None
    y1: float | None
    x2: float | None
    y2: float | None
    x3: float | None
    y3: float | None
    x4: float | None
    y4: float | None
    model: str | None
    matches: int
    inliers: int
    rmse_px: float | None
    world_x1: float | None
    world_y1: float | None
    world_x2: float | None
    world_y2: float | None
    world_x3: float | None
    world_y3: float | None
    world_x4: float | None
    world_y4: float | None
    speed_px_s: float | None
    world_sigma_px: float | None
    ground_x: float | None
    ground_y: float | None
    speed_units_s: float | None


GROUND_COLUMNS = ("ground_x", "ground_y", "speed_units_s")
TRACK_COLUMNS = TrackRow._fields[: -len(GROUND_COLUMNS)]
WORLD_COLUMNS = tuple(name for name in TRACK_COLUMNS if name.startswith("world_"))
_DECIMALS = (
    dict.fromkeys((*TRACK_COLUMNS[4:12], *WORLD_COLUMNS, "speed_px_s"), 3)
    | dict.fromkeys(GROUND_COLUMNS, 4)
    | {"time_s": 6, "rmse_px": 4}
)


def track_rows(step: Step) -> list[TrackRow]:
    """The rows of one frame, one a target, in the order of ``step.tracks``."""
    return [_track_row(step, track) for track in step.tracks]


def _track_row(step: Step, track: Track) -> TrackRow:
    quad = _finite_quad(track)
    cells: list[str | float | None] = [
        step.frame.index,
        _finite(step.frame.time_s),
        encodable(track.name),
        track.state.value,
        *([None] * 8 if quad is None else quad),
        None if quad is None or track.model is None else track.model.value,
        len(track.evidence),
        track.evidence.inliers,
        None if quad is None else _finite(track.rmse_px),
        *_world_cells(track),
    ]
    return TrackRow._make(cells)


def _world_cells(track: Track) -> tuple[float | None, ...]:
    """The cells from ``world_x1`` on."""
    world = track.world
    if world is None:
        return (None,) * 13
    corners = [float(value) for value in world.quad.ravel()]
    cells = (*corners, world.speed_px_s, _finite(world.sigma_px))
    if world.ground is None:
        return (*cells, None, None, None)
    x, y = world.ground.position.tolist()
    return (*cells, x, y, world.ground.speed_units_s)


def _finite_quad(track: Track) -> list[float] | None:
    if track.quad is None or not np.isfinite(track.quad).all():
        return None
    return [float(value) for value in track.quad.ravel()]


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _csv_cell(column: str, value: str | float | None) -> str:
    if value is None:
        return ""
    return f"{value:z.{_DECIMALS[column]}f}" if column in _DECIMALS else str(value)


def _csv_lines(step: Step, columns: Sequence[str]) -> str:
    return "".join(
        csv_line(_csv_cell(column, getattr(row, column)) for column in columns)
        for row in track_rows(step)
    )


def _json_value(column: str, value: str | float | None) -> str | float | None:
    return round(value, _DECIMALS[column]) if isinstance(value, float) else value


def _json_lines(step: Step, columns: Sequence[str]) -> str:
    records = (
        {column: _json_value(column, getattr(row, column)) for column in columns}
        for row in track_rows(step)
    )
    return "".join(
        json.dumps(record, ensure_ascii=False, allow_nan=False) + "\n" for record in records
    )


class _MotLines:
    """Lines of MOT Challenge text, for the targets that are tracked.

    ``frame,id,bb_left,bb_top,bb_width,bb_height,conf,-1,-1,-1``: frames count from 1, ids from 1 in
    the order in which targets first appear, conf is 1. The box is the axis-aligned bounding box of
    the quad, in the same pixels as everywhere else: (0, 0) is the centre of the top-left pixel.
    """

    def __init__(self) -> None:
        self._ids: dict[str, int] = {}
        self._count = itertools.count(1)

    def __call__(self, step: Step) -> str:
        lines = []
        # Whatever is not in a step has ended, and its name does not come again.
        self._ids = {
            track.name: self._ids.get(track.name) or next(self._count) for track in step.tracks
        }
        for track in step.tracks:
            target = self._ids[track.name]
            quad = _finite_quad(track)
            if quad is not None:
                x0, y0, x1, y1 = bounding_box(quad)
                box = ",".join(f"{value:z.3f}" for value in (x0, y0, x1 - x0, y1 - y0))
                lines.append(f"{step.frame.index + 1},{target},{box},1,-1,-1,-1\n")
        return "".join(lines)


class TracksWriter(Protocol):
    """A file of tracks, written one Step at a time; leaving the context closes it."""

    def write(self, step: Step) -> None:
        """Add the rows of one frame. Raises OutputError."""
        ...

    def close(self) -> None:
        """Complete the file; further calls do nothing. Raises OutputError."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None: ...


class _TextTracksWriter(RecordFile):
    def __init__(self, path: Path, header: str, lines_of: Callable[[Step], str]) -> None:
        super().__init__(path, header)
        self._lines_of = lines_of

    def write(self, step: Step) -> None:
        self.append(self._lines_of(step))


class _ParquetTracksWriter(Closing):
    """Rows wait as compact batches until they fill a row group: memory stays flat for weeks."""

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        import pyarrow.parquet

        self._path = path
        self._schema = _parquet_schema(columns)
        self._rows: list[TrackRow] = []
        self._batches: list[Any] = []
        self._file = io.BufferedWriter(open_output(path))
        self._writer: Any = pyarrow.parquet.ParquetWriter(
            self._file, self._schema, compression="zstd"
        )

    def write(self, step: Step) -> None:
        if self._file.closed:
            raise ValueError(f"{self._path} is closed")
        self._rows += track_rows(step)
        if len(self._rows) >= _BATCH_ROWS:
            self._end_batch()
        if len(self._batches) >= _GROUP_BATCHES:
            try:
                self._end_group()
            except OSError as error:
                self._abandon()
                raise output_error(self._path, error) from None

    def close(self) -> None:
        if self._file.closed:
            return
        try:
            self._end_batch()
            self._end_group()
            self._writer.close()
            self._file.close()
        except OSError as error:
            self._abandon()
            raise output_error(self._path, error) from None

    def _end_batch(self) -> None:
        import pyarrow as pa

        if not self._rows:
            return
        arrays = [
            pa.array([getattr(row, field.name) for row in self._rows], field.type)
            for field in self._schema
        ]
        self._batches.append(pa.record_batch(arrays, schema=self._schema))
        self._rows.clear()

    def _end_group(self) -> None:
        import pyarrow as pa

        if self._batches:
            table = pa.Table.from_batches(self._batches, self._schema)
            self._writer.write_table(table, row_group_size=table.num_rows)
            self._batches.clear()

    def _abandon(self) -> None:
        """Let go of a file that took no more: without this pyarrow tries again when collected."""
        self._writer.is_open = False
        with contextlib.suppress(OSError):
            self._file.close()


def _parquet_schema(columns: Sequence[str]) -> Any:
    import pyarrow as pa

    types = {"frame": pa.int64(), "time_s": pa.float64(), "matches": pa.int32()}
    types |= {"inliers": pa.int32()} | dict.fromkeys(("target", "state", "model"), pa.string())
    # Places on the ground may be map coordinates, with more digits than float32 has.
    types |= dict.fromkeys(GROUND_COLUMNS, pa.float64())
    return pa.schema([(column, types.get(column, pa.float32())) for column in columns])


_OPENERS: dict[str, Callable[[Path, Sequence[str]], TracksWriter]] = {
    ".csv": lambda path, columns: _TextTracksWriter(
        path, csv_line(columns), partial(_csv_lines, columns=columns)
    ),
    ".jsonl": lambda path, columns: _TextTracksWriter(
        path, "", partial(_json_lines, columns=columns)
    ),
    ".parquet": _ParquetTracksWriter,
    ".txt": lambda path, _columns: _TextTracksWriter(path, "", _MotLines()),
}


def check_tracks_path(path: Path) -> None:
    """Raise UsageError unless the ending of ``path`` names a format of tracks."""
    if path.suffix.lower() not in _OPENERS:
        raise UsageError(
            f"no format of tracks belongs to the ending of '{path}': "
            f"known are {', '.join(_OPENERS)} (MOT Challenge)"
        )


def open_tracks_writer(path: Path, columns: Sequence[str] = TRACK_COLUMNS) -> TracksWriter:
    """A writer of tracks in the format of the file's ending, ready to be written to.

    ``columns`` are names of `TrackRow`; MOT text has its own. An existing file is replaced.
    Raises UsageError for an unknown ending, OutputError if the file cannot be written.
    """
    check_tracks_path(path)
    return _OPENERS[path.suffix.lower()](path, columns)
