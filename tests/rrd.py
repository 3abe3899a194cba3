"""Reading recordings back in tests, with nothing but what the rerun-sdk wheel holds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow as pa
from rerun.chunk import RrdReader


def rrd_columns(
    path: Path, entity: str, component: str, timeline: str | None = "frame"
) -> tuple[list[Any], list[Any]]:
    """Times (frame numbers or nanoseconds) and values of one component, sorted by time.

    ``timeline`` None means static.
    """
    rows: list[tuple[Any, Any]] = []
    stream = RrdReader(path).stream()
    for chunk in stream.filter(content=entity, is_static=timeline is None, components=component):
        batch = chunk.to_record_batch()
        if component not in batch.schema.names:
            continue
        if timeline is None:
            times: list[Any] = [None] * batch.num_rows
        else:
            times = batch.column(timeline).cast(pa.int64()).to_pylist()
        values = batch.column(component).to_pylist()
        rows += [
            (time, value) for time, value in zip(times, values, strict=True) if value is not None
        ]
    if timeline is not None:
        rows.sort(key=lambda row: row[0])
    return [row[0] for row in rows], [row[1] for row in rows]


def rrd_entities(path: Path) -> dict[str, int]:
    """Number of rows of each entity."""
    counts: dict[str, int] = {}
    for chunk in RrdReader(path).stream():
        counts[chunk.entity_path] = counts.get(chunk.entity_path, 0) + chunk.num_rows
    return counts


def rrd_timelines(path: Path, entity: str) -> set[str]:
    """The timelines that an entity has values on, apart from Rerun's own."""
    names: set[str] = set()
    for chunk in RrdReader(path).stream().filter(content=entity, is_static=False):
        schema = chunk.to_record_batch().schema
        for field in schema:
            kind = (field.metadata or {}).get(b"rerun:kind", b"")
            if kind == b"index":
                names.add(field.name)
    return names - {"log_time", "log_tick"}
