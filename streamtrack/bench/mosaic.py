"""``streamtrack bench mosaic``: from what the user asked for to tables and a file."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from streamtrack.bench.command import check_writable
from streamtrack.bench.mosaic_measure import run_pairs
from streamtrack.bench.mosaic_methods import PairMethod, compatible_methods, main_methods
from streamtrack.bench.mosaic_pairs import PairSource, folder_pairs, synthetic_pairs
from streamtrack.bench.mosaic_report import build_pair_report, print_pair_tables
from streamtrack.errors import StreamtrackError
from streamtrack.outputs import write_file

_SEEDS = (1, 2, 3)
_QUICK_SEEDS = (1,)
_QUICK_FACTORS = ("overlap", "zoom2", "rotation", "light", "everything", "nothing")
_QUICK_DETECTORS = ("harris", "fast")
_QUICK_DESCRIPTORS = ("freak", "brisk")


@dataclass(frozen=True, slots=True)
class PairRequest:
    """The options; None stands for what is usual."""

    folder: Path | None = None
    is_quick: bool = False
    json_path: Path | None = None


def run_pair_request(
    request: PairRequest,
    console: Console,
    tell: Callable[[str], None],
    should_stop: Callable[[], bool],
) -> None:
    """Run the benchmark, print its tables and write its file.

    Raises StreamtrackError; after an interruption, what was measured until then is reported first.
    """
    sources = _sources(request)
    methods = _methods(request)
    if request.json_path is not None:
        check_writable(request.json_path)
    run = run_pairs(sources, methods, tell, should_stop)
    report = build_pair_report(run, methods, _options(request))
    if run.trials:
        print_pair_tables(console, report)
        if request.json_path is not None:
            text = json.dumps(report, indent=1, ensure_ascii=False, allow_nan=False)
            write_file(request.json_path, (text + "\n").encode())
    if not run.is_whole:
        done = len({trial.pair for trial in run.trials})
        raise StreamtrackError(
            f"interrupted after {done} of {len(sources)} pairs: those are reported"
        )


def _sources(request: PairRequest) -> list[PairSource]:
    if request.is_quick:
        sources = synthetic_pairs(_QUICK_SEEDS, _QUICK_FACTORS)
    else:
        sources = synthetic_pairs(_SEEDS)
    return sources if request.folder is None else [*sources, *folder_pairs(request.folder)]


def _methods(request: PairRequest) -> list[PairMethod]:
    every = compatible_methods()
    if request.is_quick:
        quick = {f"{det}+{desc}" for det in _QUICK_DETECTORS for desc in _QUICK_DESCRIPTORS}
        every = [method for method in every if method.name in quick]
    return [*main_methods(), *every]


def _options(request: PairRequest) -> dict[str, Any]:
    """What decides the figures, for the report; no paths of this machine."""
    return {
        "quick": request.is_quick,
        "pairs": None if request.folder is None else request.folder.name,
    }
