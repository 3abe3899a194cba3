"""``streamtrack bench track``: from what the user asked for to tables and files."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.text import Text

from streamtrack.bench.measure import run_bench
from streamtrack.bench.methods import METHODS, QUICK_METHODS, choose_methods
from streamtrack.bench.plot import check_plot_path, write_plot
from streamtrack.bench.report import build_report
from streamtrack.bench.scenarios import (
    Scenario,
    parse_seeds,
    pot_scenarios,
    synthetic_scenarios,
)
from streamtrack.bench.tables import print_tables
from streamtrack.errors import StreamtrackError, UsageError
from streamtrack.outputs import output_error, write_file

_NO_SCENES = "none"
_SEEDS = "1"


@dataclass(frozen=True, slots=True)
class Request:
    """The options; None stands for what is usual."""

    is_quick: bool = False
    scenes: str | None = None
    seeds: str | None = None
    methods: str | None = None
    frames: int | None = None
    pot: Path | None = None
    json_path: Path | None = None
    plot_path: Path | None = None
    is_verbose: bool = False


def run_request(
    request: Request,
    console: Console,
    tell: Callable[[str], None],
    should_stop: Callable[[], bool],
) -> None:
    """Run the benchmark, print its tables and write its files.

    Raises StreamtrackError; after an interruption, what was measured until then is reported first.
    """
    chosen = _names(request.methods) or (QUICK_METHODS if request.is_quick else tuple(METHODS))
    methods = choose_methods(chosen)
    scenarios = _scenarios(request)
    if request.plot_path is not None:
        check_plot_path(request.plot_path)
    for path in (request.json_path, request.plot_path):
        if path is not None:
            check_writable(path)
    run = run_bench(scenarios, methods, tell, should_stop)
    report = build_report(run, methods, _options(request))
    if run.trials:
        print_tables(console, report, is_verbose=request.is_verbose)
        if request.json_path is not None:
            text = json.dumps(report, indent=1, ensure_ascii=False, allow_nan=False)
            write_file(request.json_path, (text + "\n").encode())
        if request.plot_path is not None:
            write_plot(request.plot_path, report)
    if not run.is_whole:
        done = len(report["sequences"])
        raise StreamtrackError(
            f"interrupted after {done} of {len(scenarios)} sequences: those are reported"
        )


def _scenarios(request: Request) -> list[Scenario]:
    scenes = _names(request.scenes)
    result: list[Scenario] = []
    if scenes != [_NO_SCENES]:
        seeds = parse_seeds(_SEEDS if request.seeds is None else request.seeds)
        result += synthetic_scenarios(scenes, seeds, request.frames, is_quick=request.is_quick)
    elif request.pot is None:
        raise UsageError("--scenes none leaves nothing to do: add --pot FOLDER")
    if request.pot is not None:
        result += pot_scenarios(request.pot, request.frames)
    return result


def check_writable(path: Path) -> None:
    """Raise OutputError now rather than when all is measured."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, "is a folder")
        if not os.access(path if path.exists() else path.parent, os.W_OK):
            raise PermissionError(errno.EACCES, "permission denied")
    except OSError as error:
        raise output_error(path, error) from None


def _names(text: str | None) -> list[str]:
    return [] if text is None else [name.strip() for name in text.split(",")]


def _options(request: Request) -> dict[str, Any]:
    """What decides the figures, for the report; no paths of this machine."""
    return {
        "quick": request.is_quick,
        "scenes": request.scenes,
        "seeds": request.seeds,
        "methods": request.methods,
        "frames": request.frames,
        "pot": None if request.pot is None else request.pot.name,
    }


def tell_on(console: Console) -> Callable[[str], None]:
    """A function that says a line of progress."""
    return lambda line: console.print(Text(line), soft_wrap=True)
