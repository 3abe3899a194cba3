"""The report as tables on a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

from streamtrack.bench.report import Report

_WIDTH = 120
_OWN = "streamtrack"
_SCORES = ("P@1", "P@2", "P@5", "P@15", "error", "false", "wrong", "re-acq.")
_LEGEND = (
    "P@n: share of scored frames (at least {scored:.0%} visible, not the first) within n px, RMS "
    "over the corners, misses counted. error: median, px. false: locks in frames without the "
    "target, of those. wrong: locks off by more than {wrong:g} px, of the frames with it. "
    "re-acq.: returns found within {prompt} frames. jitter: px, target at rest. centre: within "
    "{centre:g} px. CPU: ms a frame, one thread. memory: MB by which the process grew."
)


def print_tables(console: Console, report: Report, *, is_verbose: bool) -> None:
    """Print the report, never narrower than the tables are: a line may wrap but not be cut."""
    wide = Console(
        file=console.file,
        width=max(console.width, _WIDTH),
        force_terminal=console.is_terminal,
    )
    for part in _parts(report, is_verbose):
        wide.print(part)


def _parts(report: Report, is_verbose: bool) -> Iterable[RenderableType]:
    methods = report["methods"]
    for group, title in (("all", "All synthetic sequences"), ("pot", "POT sequences")):
        if any(method[group] for method in methods):
            yield _accuracy(title, methods, group)
            yield _cost(methods, group)
    for method in methods:
        if method["all"] and (is_verbose or method["name"] == _OWN):
            yield _factors(method)
    for method in methods:
        if method["name"] == _OWN and method["by_size"]:
            yield _times(method)
    definitions = report["definitions"]
    legend = _LEGEND.format(
        scored=definitions["scored_from_visible_share"],
        wrong=definitions["wrong_lock_above_px"],
        prompt=definitions["prompt_frames"],
        centre=definitions["centre_within_px"],
    )
    yield Text(f"\n{legend}", style="dim")
    frames = sum(sequence["frames"] for sequence in report["sequences"])
    packages = ", ".join(f"{name} {number}" for name, number in report["versions"].items())
    yield Text(
        f"Sequences: {len(report['sequences'])}, frames: {frames}; {packages}; peak memory of the "
        f"whole run {report['peak_rss_mb']:.0f} MB",
        style="dim",
    )
    for method in methods:
        for sequence, reason in method["refusals"].items():
            yield Text(f"{method['name']} would not begin on {sequence}: {reason}", style="yellow")


def _table(title: str, columns: Sequence[str]) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold", box=None, padding=(0, 1))
    for number, column in enumerate(columns):
        table.add_column(column, justify="right" if number else "left", no_wrap=True)
    return table


def _accuracy(title: str, methods: Sequence[Report], group: str) -> RenderableType:
    """How well each method did, one line each."""
    table = _table(title, ("method", *_SCORES, "jitter", "centre"))
    for method in methods:
        figures = method[group]
        if figures is not None:
            jitter, centre = figures["jitter_px"], figures["centre"]["within_20"]
            cells = [*_scores(figures), number(jitter, 3), number(centre, 3)]
            table.add_row(method["title"], *cells, style=_style(method))
    return table


def _cost(methods: Sequence[Report], group: str) -> RenderableType:
    """What each method took, one line each; by picture size where there are several."""
    sizes = list(dict.fromkeys(size for method in methods for size in method["by_size"]))
    parts = sorted(sizes, key=len) if group == "all" else [""]
    heads = [head for size in parts for head in (f"CPU {size}".strip(), "with decoding")]
    table = _table("\nCPU ms a frame: p50 / p95", ("method", *heads, "memory"))
    for method in methods:
        if method[group] is None:
            continue
        cells = []
        for size in parts:
            timed = (method["by_size"].get(size) if size else method[group]) or {"cpu_ms": {}}
            cells += [_pair(timed["cpu_ms"]), _pair(timed["cpu_ms"].get("with_decoding"))]
        memory = number(method[group]["memory_mb"], 0)
        table.add_row(method["title"], *cells, memory, style=_style(method))
    return table


def _style(method: Report) -> str | None:
    return "bold" if method["name"] == _OWN else None


def _factors(method: Report) -> RenderableType:
    table = _table(f"\n{method['title']}, by factor", ("factor", *_SCORES, "CPU p50 / p95"))
    for factor, figures in method["by_factor"].items():
        table.add_row(factor, *_scores(figures), _pair(figures["cpu_ms"]))
    return table


def _times(method: Report) -> RenderableType:
    """Where the time goes, by picture size."""
    sizes = method["by_size"]
    table = _table(f"\n{method['title']}, CPU ms a frame: p50 / p95", ("", *sizes))
    rows = (
        ("tracking", "tracking"),
        ("lost", "lost"),
        ("decoding H.264", "decoding"),
        ("all frames with decoding", "with_decoding"),
        ("set-up, once", "set_up"),
    )
    for label, key in rows:
        table.add_row(label, *(_pair(figures["cpu_ms"][key]) for figures in sizes.values()))
    stages = [figures["cpu_ms"]["stages"] or {} for figures in sizes.values()]
    for name in dict.fromkeys(name for stage in stages for name in stage):
        table.add_row(
            f"stage {name}: mean, and share of frames", *(_stage(s, name) for s in stages)
        )
    return table


def _stage(stages: Mapping[str, Any], name: str) -> str:
    if name not in stages:
        return "-"
    return f"{stages[name]['mean_where_it_ran']:.1f}, {stages[name]['ran_in']:.0%}"


def _scores(figures: Mapping[str, Any]) -> list[str]:
    again = figures["reacquire"]
    return [
        *(number(figures[key], 3) for key in ("p1", "p2", "p5", "p15")),
        number(figures["error_median_px"], 2),
        _of(figures["false_locks"], figures["absent_frames"]),
        _of(figures["wrong_locks"], figures["present_frames"]),
        "-" if again is None else f"{again['within_3'] * again['returns']:.0f}/{again['returns']}",
    ]


def _of(count: int | None, total: int) -> str:
    return "-" if count is None or not total else f"{count}/{total}"


def _pair(spread: Mapping[str, Any] | None) -> str:
    if not spread or spread["p50"] is None:
        return "-"
    return f"{spread['p50']:.1f} / {spread['p95']:.1f}"


def number(value: float | None, decimals: int) -> str:
    """The number, or a dash for what is not known."""
    return "-" if value is None else f"{value:.{decimals}f}"
