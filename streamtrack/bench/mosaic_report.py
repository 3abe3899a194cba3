"""The result of the registration benchmark, as plain values for JSON and as tables."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

from streamtrack.bench.environment import environment
from streamtrack.bench.mosaic_measure import (
    AUC_PX,
    RECALL_WITHIN_PX,
    WRONG_ABOVE_PX,
    PairRun,
    PairTrial,
    pair_figures,
)
from streamtrack.bench.mosaic_methods import OWN, PEER_THRESHOLD_PX, PairMethod
from streamtrack.bench.tables import number
from streamtrack.features import COMPATIBLE
from streamtrack.settings import DESCRIPTORS

Report = dict[str, Any]
_WIDTH = 120
_GROUPS = {"synthetic": "Rendered pairs, exact truth", "folder": "Pairs of the folder"}
_LEGEND = (
    "AUC@n: area under the recall curve of the mean corner error up to n px, in %, failures "
    "infinite (SuperGlue, LoFTR). corner: its median, px. claimed: pairs with an answer, of those "
    "that have one. wrong: answers off by more than {wrong:g} px on average where the pictures "
    "truly overlap, or given for pictures that share nothing. RMSE: symmetric transfer error of "
    "the inliers, px, mean over claimed pairs; threshold {threshold:g} px, inliers: how many and "
    "their share. recall: correct matches of all correspondences within {within:g} px, 1-prec.: "
    "false of all matches (Mikolajczyk & Schmid 2005), pooled over the pairs. CPU: ms a pair, "
    "both pictures and the link, one thread."
)


def build_pair_report(
    run: PairRun, methods: Sequence[PairMethod], options: dict[str, Any]
) -> Report:
    """Everything that was measured, how, and with what. None stands for what is not known."""
    return {
        "benchmark": "mosaic",
        "options": options,
        "is_whole": run.is_whole,
        **environment(),
        "definitions": {
            "auc_px": list(AUC_PX),
            "wrong_above_visible_error_px": WRONG_ABOVE_PX,
            "recall_within_px": RECALL_WITHIN_PX,
            "rmse": "symmetric transfer, inliers of the method's own estimate",
            "rmse_threshold_px": PEER_THRESHOLD_PX,
        },
        "methods": [_method(method, run.trials) for method in methods],
        "trials": [_plain(trial) for trial in run.trials],
    }


def _method(method: PairMethod, all_trials: Sequence[PairTrial]) -> Report:
    trials = [trial for trial in all_trials if trial.method == method.name]
    groups = {
        group: pair_figures(t for t in trials if t.group == group)
        for group in dict.fromkeys(trial.group for trial in trials)
    }
    return {
        "name": method.name,
        "title": method.title,
        "parameters": dict(method.parameters),
        "groups": groups,
        "by_factor": _grouped(trials, lambda trial: f"{trial.group}/{trial.factor}"),
    }


def _grouped(trials: Iterable[PairTrial], key: Callable[[PairTrial], str]) -> Report:
    members: dict[str, list[PairTrial]] = {}
    for trial in trials:
        members.setdefault(key(trial), []).append(trial)
    return {name: pair_figures(group) for name, group in members.items()}


def _plain(trial: PairTrial) -> Report:
    """A trial for JSON, which knows neither infinity nor NaN."""
    values = asdict(trial)
    matching = trial.matching
    values["matching"] = None if matching is None else matching._asdict()
    return {key: _finite(value) for key, value in values.items()}


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(inner) for key, inner in value.items()}
    return None if isinstance(value, float) and not np.isfinite(value) else value


def print_pair_tables(console: Console, report: Report) -> None:
    """Print the report, never narrower than the tables are."""
    width = max(console.width, _WIDTH)
    wide = Console(file=console.file, width=width, force_terminal=console.is_terminal)
    for part in _parts(report):
        wide.print(part)


def _parts(report: Report) -> Iterable[RenderableType]:
    methods = report["methods"]
    grid = {method["name"] for method in methods if "+" in method["name"]}
    main = [method for method in methods if method["name"] not in grid]
    for group, title in _GROUPS.items():
        if main and group in main[0]["groups"]:
            yield _overview(title, main, group)
    for method in main:
        if method["name"] == OWN:
            yield _factors(method)
    pairs = {method["name"]: method for method in methods if method["name"] in grid}
    for group, title in _GROUPS.items():
        if pairs and group in next(iter(pairs.values()))["groups"]:
            for head, key, decimals in (
                ("RMSE, px", "rmse_px", 3),
                ("recall", "recall", 3),
                ("CPU ms a pair", "cpu_ms", 0),
                ("AUC@3, %", "auc", 1),
                ("wrong", "wrong", 0),
            ):
                # Apart from the table, which is too narrow to hold it in one line.
                yield Text(f"\n{head}: {title.lower()}", style="bold")
                yield _grid(pairs, group, key, decimals)
    definitions = report["definitions"]
    legend = _LEGEND.format(
        wrong=definitions["wrong_above_visible_error_px"],
        threshold=definitions["rmse_threshold_px"],
        within=definitions["recall_within_px"],
    )
    yield Text(f"\n{legend}", style="dim")
    packages = ", ".join(f"{name} {number}" for name, number in report["versions"].items())
    yield Text(packages, style="dim")


def _table(title: str | None, columns: Sequence[str]) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold", box=None, padding=(0, 1))
    for place, column in enumerate(columns):
        table.add_column(column, justify="right" if place else "left", no_wrap=True)
    return table


_COLUMNS = (
    *(f"AUC@{px}" for px in AUC_PX),
    *("corner", "claimed", "wrong", "RMSE", "inliers", "recall", "1-prec.", "CPU"),
)


def _cells(figures: Report) -> list[str]:
    share = figures["inlier_share"]
    inliers = figures["inliers"]
    return [
        *(_percent(figures["auc"][str(px)]) for px in AUC_PX),
        number(figures["corner_median_px"], 2),
        f"{figures['claimed']}/{figures['pairs']}",
        f"{figures['wrong']}/{figures['pairs'] + figures['strangers']}",
        number(figures["rmse_px"], 3),
        "-" if inliers is None else f"{inliers:.0f} ({share:.0%})",
        number(figures["recall"], 3),
        number(figures["one_minus_precision"], 3),
        number(figures["cpu_ms"], 0),
    ]


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f}"


def _overview(title: str, methods: Sequence[Report], group: str) -> RenderableType:
    table = _table(f"\n{title}", ("method", *_COLUMNS))
    for method in methods:
        style = "bold" if method["name"] == OWN else None
        table.add_row(method["title"], *_cells(method["groups"][group]), style=style)
    return table


def _factors(method: Report) -> RenderableType:
    table = _table(f"\n{method['title']}, by difficulty or set", ("", *_COLUMNS))
    for factor, figures in method["by_factor"].items():
        table.add_row(factor.partition("/")[2], *_cells(figures))
    return table


def _grid(methods: dict[str, Report], group: str, key: str, decimals: int) -> RenderableType:
    """One figure for each detector (rows) and descriptor (columns)."""
    used = [d for d in DESCRIPTORS if any(name.endswith(f"+{d}") for name in methods)]
    table = _table(None, ("detector", *used))
    for detector in COMPATIBLE:
        cells = []
        for descriptor in used:
            method = methods.get(f"{detector}+{descriptor}")
            if method is None:
                cells.append("")
                continue
            value = method["groups"][group][key]
            if key == "auc":
                value = value["3"] if value["3"] is None else 100 * value["3"]
            cells.append(number(value, decimals))
        if any(cells):
            table.add_row(detector, *cells)
    return table
