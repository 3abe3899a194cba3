"""Running methods over pairs of pictures with known truth, and scoring what they said."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from streamtrack.bench.measure import one_thread
from streamtrack.bench.mosaic_methods import Outcome, PairMethod
from streamtrack.bench.mosaic_pairs import PairSource, PicturePair
from streamtrack.evaluation import (
    RecallPrecision,
    auc_at,
    corner_error,
    recall_precision,
    symmetric_transfer_rmse,
    visible_error,
)
from streamtrack.types import Image, Size

AUC_PX = (1, 3, 5)
WRONG_ABOVE_PX = 10.0
RECALL_WITHIN_PX = 2.5

Figures = dict[str, Any]


@dataclass(frozen=True, slots=True)
class PairTrial:
    """One method on one pair. Errors are infinite where nothing was claimed, NaN without truth."""

    method: str
    pair: str
    group: str
    factor: str
    is_claimed: bool
    is_wrong: bool
    has_truth: bool
    corner_px: float
    visible_px: float
    rmse_px: float
    inliers: int
    pairs: int
    matching: RecallPrecision | None
    cpu_ms: float
    reason: str


@dataclass(frozen=True, slots=True)
class PairRun:
    """Everything that was measured. ``is_whole``: nobody stopped it."""

    trials: tuple[PairTrial, ...]
    is_whole: bool


def run_pairs(
    sources: Sequence[PairSource],
    methods: Sequence[PairMethod],
    tell: Callable[[str], None] = lambda _line: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> PairRun:
    """All methods on all pairs, one pair after the other; OpenCV in one thread.

    When it is to stop, the pair in work is left out. Raises SourceError.
    """
    trials: list[PairTrial] = []
    with one_thread():
        ready = [(method, method.make()) for method in methods]
        for number, source in enumerate(sources, start=1):
            began = time.perf_counter()
            pair = source.load()
            if number == 1:
                # What happens once in a process, such as loading code, is not to be measured.
                for _, register in ready:
                    _timed(register, pair)
            new = []
            for method, register in ready:
                if should_stop():
                    return PairRun(tuple(trials), is_whole=False)
                outcome, cpu_ms = _timed(register, pair)
                new.append(_scored(method, pair, outcome, cpu_ms))
            trials += new
            spent_s = time.perf_counter() - began
            tell(f"{number} of {len(sources)}: {source.name} ({spent_s:.0f} s)")
    return PairRun(tuple(trials), is_whole=True)


def _timed(register: Callable[[Image, Image], Outcome], pair: PicturePair) -> tuple[Outcome, float]:
    cv2.setRNGSeed(1)
    began = time.process_time()
    outcome = register(pair.a, pair.b)
    return outcome, (time.process_time() - began) * 1e3


def _size(image: Image) -> Size:
    return image.shape[1], image.shape[0]


def _scored(method: PairMethod, pair: PicturePair, said: Outcome, cpu_ms: float) -> PairTrial:
    truth, found = pair.true_b_from_a, said.b_from_a
    is_claimed = found is not None
    corner_px = visible_px = float("nan")
    matching = None
    is_wrong = is_claimed
    if truth is not None:
        corner_px = corner_error(found, truth, _size(pair.a))
        visible_px = visible_error(found, truth, _size(pair.a), _size(pair.b))
        is_wrong = is_claimed and not visible_px <= WRONG_ABOVE_PX
        matching = recall_precision(
            said.a_points, said.b_points, said.matches, truth, RECALL_WITHIN_PX
        )
    rmse_px = symmetric_transfer_rmse(found, said.a_inliers, said.b_inliers)
    return PairTrial(
        method.name,
        pair.name,
        pair.group,
        pair.factor,
        is_claimed,
        is_wrong,
        truth is not None,
        corner_px,
        visible_px,
        rmse_px if np.isfinite(rmse_px) else float("nan"),
        len(said.a_inliers),
        said.pairs,
        matching,
        cpu_ms,
        said.reason,
    )


def pair_figures(trials: Iterable[PairTrial]) -> Figures:
    """The figures of one method over some pairs; None stands for what is not known."""
    every = list(trials)
    known = [trial for trial in every if trial.has_truth]
    claimed = [trial for trial in known if trial.is_claimed]
    errors = [trial.corner_px for trial in known]
    matching = [trial.matching for trial in known if trial.matching is not None]
    correct, matches, possible = (
        sum(getattr(one, name) for one in matching)
        for name in ("correct", "matches", "correspondences")
    )
    cpu_ms = [trial.cpu_ms for trial in every]
    return {
        "pairs": len(known),
        "strangers": len(every) - len(known),
        "claimed": len(claimed),
        "wrong": sum(trial.is_wrong for trial in every),
        "auc": {str(px): _known(auc_at(errors, px)) for px in AUC_PX},
        "corner_median_px": _known(float(np.median(errors)) if errors else float("nan")),
        "rmse_px": _mean([trial.rmse_px for trial in claimed]),
        "inliers": _mean([trial.inliers for trial in claimed]),
        "inlier_share": _mean([trial.inliers / max(trial.pairs, 1) for trial in claimed]),
        "recall": correct / possible if possible else None,
        "one_minus_precision": 1 - correct / matches if matches else None,
        "cpu_ms": _mean(cpu_ms),
        "cpu_max_ms": _known(max(cpu_ms)) if cpu_ms else None,
    }


def _mean(values: Sequence[float]) -> float | None:
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else None


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
