"""How summaries are written: numbers, Markdown tables and JSON, alike for tracking and mosaics."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from streamtrack.outputs import write_file


def known(value: float | None) -> float | None:
    """The value as a plain number, None if it was never measured (None, NaN or infinite)."""
    return None if value is None or not math.isfinite(value) else float(value)


def number(value: float | None, decimals: int, unit: str = "", unknown: str = "-") -> str:
    """The value for a person, or what is said in its place."""
    value = known(value)
    return unknown if value is None else f"{value:.{decimals}f}{unit}"


def cell(text: str) -> str:
    """Text as it can stand in a Markdown table."""
    return " ".join(text.split()).replace("\\", "\\\\").replace("|", "\\|").replace("<", "&lt;")


def markdown(title: str, rows: Sequence[tuple[str, str]]) -> list[str]:
    """Lines of a heading and a table of (label, value) pairs."""
    lines = [f"# {title}", "", "| what | value |", "|---|---|"]
    return lines + [f"| {cell(label)} | {cell(value)} |" for label, value in rows]


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Write plain values as a whole file or not at all. Raises OutputError."""
    text = json.dumps(values, indent=2, ensure_ascii=False, allow_nan=False)
    write_file(path, (text + "\n").encode("utf-8", "replace"))
