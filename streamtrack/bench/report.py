"""The result of a benchmark as plain values for JSON: everything that tables and plot show."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from streamtrack.bench.environment import environment
from streamtrack.bench.measure import Footage, Run, Trial
from streamtrack.bench.methods import Method
from streamtrack.bench.scenarios import ABSENT_BELOW, MIN_VISIBLE
from streamtrack.bench.score import (
    CENTRE_WITHIN_PX,
    PROMPT_FRAMES,
    THRESHOLDS_PX,
    WRONG_ABOVE_PX,
    Figures,
    figures,
)
from streamtrack.types import Size

Report = dict[str, Any]


def build_report(run: Run, methods: Sequence[Method], options: dict[str, Any]) -> Report:
    """Everything that was measured, how, and with what. None stands for what is not known."""
    return {
        "benchmark": "track",
        "options": options,
        "is_whole": run.is_whole,
        **environment(),
        "definitions": {
            "precision_px": list(THRESHOLDS_PX),
            "scored_from_visible_share": MIN_VISIBLE,
            "absent_below_visible_share": ABSENT_BELOW,
            "wrong_lock_above_px": WRONG_ABOVE_PX,
            "centre_within_px": CENTRE_WITHIN_PX,
            "prompt_frames": PROMPT_FRAMES,
        },
        "peak_rss_mb": run.peak_rss_mb,
        "sequences": [_footage(footage) for footage in _footages(run.trials)],
        "methods": [_method(method, run.trials) for method in methods],
    }


def size_name(size_wh: Size) -> str:
    """``640x480``."""
    return f"{size_wh[0]}x{size_wh[1]}"


def _footages(trials: Sequence[Trial]) -> list[Footage]:
    return list({trial.footage.name: trial.footage for trial in trials}.values())


def _footage(footage: Footage) -> Report:
    truth = footage.truth
    return {
        "name": footage.name,
        "group": footage.group,
        "factor": footage.factor,
        "seed": footage.seed,
        "texture": footage.texture,
        "size": size_name(footage.size_wh),
        "frames": len(truth.quads),
        "scored_frames": int(np.count_nonzero(truth.is_scored)),
        "absent_frames": int(np.count_nonzero(truth.is_absent)),
    }


def _method(method: Method, all_trials: Sequence[Trial]) -> Report:
    """One method: figures of the synthetic sequences in all and by kind, and of POT apart."""
    trials = [trial for trial in all_trials if trial.method is method]
    synthetic = [trial for trial in trials if trial.footage.group == "synthetic"]
    pot = [trial for trial in trials if trial.footage.group == "pot"]
    return {
        "name": method.name,
        "title": method.title,
        "is_box": method.is_box,
        "parameters": dict(method.parameters),
        "all": figures(synthetic) if synthetic else None,
        "pot": figures(pot) if pot else None,
        "by_factor": _grouped(synthetic, lambda trial: trial.footage.factor),
        "by_size": _grouped(synthetic, lambda trial: size_name(trial.footage.size_wh)),
        "by_sequence": _grouped(trials, lambda trial: trial.footage.name),
        "refusals": {trial.footage.name: trial.refusal for trial in trials if trial.refusal},
    }


def _grouped(trials: Sequence[Trial], key: Callable[[Trial], str]) -> dict[str, Figures]:
    """Figures of the trials that share a key, keys in order of their first appearance."""
    groups: dict[str, list[Trial]] = {}
    for trial in trials:
        groups.setdefault(key(trial), []).append(trial)
    return {name: figures(members) for name, members in groups.items()}
