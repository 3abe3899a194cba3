"""The benchmark's figures: what they mean, and how they come from trials.

Frames of all trials are pooled. Definitions of errors, precision, jitter and frames to re-acquire,
with their sources, are those of `streamtrack.evaluation`; here is what the benchmark adds:

    p1 .. p15         precision at so many px over the scored frames (`scenarios` says which); a
                      miss is an infinite error
    error_median_px   median alignment error over the scored frames, None if half are misses
    tracked           share of the scored frames in which the target was claimed to be seen
    false_locks       frames without the target (less than 2 % visible) in which it was claimed
    wrong_locks       frames with it in which it was claimed more than 10 px from the truth
    reacquire         frames that each return took, from half visible to within 5 px
    jitter_px         over the sequences of ``static``
    centre            between the centres of the upright boxes about found and true corners: median,
                      and share within 20 px (precision of OTB, Wu et al., CVPR 2013). The one
                      measure in which box trackers can be compared
    cpu_ms            processor time a frame; quantiles are nearest-rank; ``with_decoding`` adds to
                      each frame the time to read it from an H.264 file
    memory_mb         most that the process grew while the method ran on one sequence
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np

from streamtrack.bench.measure import Trial
from streamtrack.bench.scenarios import Floats
from streamtrack.evaluation import (
    alignment_error,
    false_lock_share,
    frames_to_reacquire,
    jitter_px,
    precision_at,
)
from streamtrack.types import Mask, Points

Figures: TypeAlias = dict[str, Any]
THRESHOLDS_PX = (1, 2, 5, 15)
WRONG_ABOVE_PX = 10.0
CENTRE_WITHIN_PX = 20.0
PROMPT_FRAMES = 3
_STILL = "static"


def figures(trials: Sequence[Trial]) -> Figures:
    """All figures of some trials of one method; None is what cannot be measured in them."""
    is_box = any(trial.method.is_box for trial in trials)
    return {
        "sequences": len(trials),
        "frames": sum(len(trial.quads) for trial in trials),
        **_accuracy(trials, is_box),
        **_honesty(trials, is_box),
        "reacquire": None if is_box else _reacquire(trials),
        "jitter_px": None if is_box else _jitter(trials),
        "centre": _centre(trials),
        "cpu_ms": _times(trials),
        "memory_mb": _most([trial.memory_mb for trial in trials]),
    }


def errors_px(trial: Trial) -> Floats:
    """Alignment errors (N,), infinite without a quad; only known where the truth is."""
    true_quads = trial.footage.truth.quads
    pairs = zip(trial.quads, true_quads, strict=True)
    return np.array([alignment_error(quad, true) for quad, true in pairs])


def is_claimed(trial: Trial) -> Mask:
    """Frames (N,) in which the method says that it sees the target."""
    return np.array([quad is not None for quad in trial.quads], np.bool_)


def _accuracy(trials: Sequence[Trial], is_box: bool) -> Figures:
    scored = _joined([errors_px(trial)[trial.footage.truth.is_scored] for trial in trials])
    claims = _joined([is_claimed(trial)[trial.footage.truth.is_scored] for trial in trials])
    precision = {
        f"p{threshold}": None if is_box else _known(precision_at(scored, threshold))
        for threshold in THRESHOLDS_PX
    }
    median = float(np.median(scored)) if len(scored) and not is_box else float("nan")
    return {
        "scored_frames": len(scored),
        **precision,
        "error_median_px": _known(median),
        "tracked": _known(float(np.mean(claims)) if len(claims) else float("nan")),
    }


def _honesty(trials: Sequence[Trial], is_box: bool) -> Figures:
    absent_claims = _joined([is_claimed(t)[t.footage.truth.is_absent] for t in trials]) > 0
    nothing = [0.0] * len(absent_claims)
    present = [
        (is_claimed(t) & (errors_px(t) > WRONG_ABOVE_PX))[t.footage.truth.is_present]
        for t in trials
    ]
    wrong = _joined(present)
    return {
        "absent_frames": len(absent_claims),
        "false_locks": int(absent_claims.sum()),
        "false_lock_share": _known(false_lock_share(absent_claims.tolist(), nothing, nothing)),
        "present_frames": len(wrong),
        "wrong_locks": None if is_box else int(wrong.sum()),
        "wrong_lock_share": None if is_box or not len(wrong) else float(np.mean(wrong)),
    }


def _reacquire(trials: Sequence[Trial]) -> Figures | None:
    counts: list[float] = []
    for trial in trials:
        visible = trial.footage.truth.visible_share.tolist()
        counts += frames_to_reacquire(is_claimed(trial).tolist(), visible, errors_px(trial))
    if not counts:
        return None
    return {
        "returns": len(counts),
        "never": int(np.sum(np.isinf(counts))),
        "median_frames": _known(quantile(np.array(counts), 0.5)),
        "worst_frames": _known(max(counts)),
        f"within_{PROMPT_FRAMES}": float(np.mean(np.array(counts) <= PROMPT_FRAMES)),
    }


def _jitter(trials: Sequence[Trial]) -> float | None:
    """Root of the mean square over the clips at rest."""
    still = [jitter_px(t.quads) for t in trials if t.footage.factor == _STILL]
    known = [value for value in still if np.isfinite(value)]
    return float(np.sqrt(np.mean(np.square(known)))) if known else None


def _centre(trials: Sequence[Trial]) -> Figures:
    offs: list[float] = []
    for trial in trials:
        truth = trial.footage.truth
        for row in np.flatnonzero(truth.is_scored):
            quad = trial.quads[row]
            apart = None if quad is None else _box_centre(quad) - _box_centre(truth.quads[row])
            offs.append(float("inf") if apart is None else float(np.hypot(*apart)))
    return {
        "error_median_px": _known(float(np.median(offs)) if offs else float("nan")),
        "within_20": _known(precision_at(offs, CENTRE_WITHIN_PX)),
    }


def _box_centre(quad: Points | Floats) -> Floats:
    corners = np.asarray(quad, np.float64)
    centre: Floats = (corners.min(axis=0) + corners.max(axis=0)) / 2.0
    return centre


def _times(trials: Sequence[Trial]) -> Figures:
    """Over all frames but the first of each sequence."""
    cpu = [trial.cpu_ms[1:] for trial in trials]
    claims = [is_claimed(trial)[1:] for trial in trials]
    decodings = [trial.footage.decode_ms for trial in trials]
    decode = [ms[1:] for ms in decodings if ms is not None]
    both = [ms + extra[1:] for ms, extra in zip(cpu, decodings, strict=True) if extra is not None]
    lost = [~claim for claim in claims]
    return {
        **spread(_joined(cpu)),
        "tracking": spread(_joined([ms[c] for ms, c in zip(cpu, claims, strict=True)])),
        "lost": spread(_joined([ms[c] for ms, c in zip(cpu, lost, strict=True)])),
        "decoding": spread(_joined(decode)),
        "with_decoding": spread(_joined(both)),
        "set_up": spread(np.array([trial.cpu_ms[0] for trial in trials])),
        "stages": _stages(trials),
    }


def _stages(trials: Sequence[Trial]) -> Figures | None:
    """Mean processor milliseconds a frame by stage, over all frames and over those it ran in."""
    frames = [stages for trial in trials for stages in trial.stages_ms[1:] if stages]
    names = dict.fromkeys(name for stages in frames for name in stages)
    if not names:
        return None
    return {
        name: {
            "mean": float(np.mean([stages.get(name, 0.0) for stages in frames])),
            "ran_in": float(np.mean([name in stages for stages in frames])),
            "mean_where_it_ran": float(np.mean([s[name] for s in frames if name in s])),
        }
        for name in names
    }


def spread(values: Floats) -> Figures:
    """Count, p50, p95, mean and maximum; NaN is left out."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return {"count": 0, "p50": None, "p95": None, "mean": None, "max": None}
    return {
        "count": len(finite),
        "p50": quantile(finite, 0.5),
        "p95": quantile(finite, 0.95),
        "mean": float(np.mean(finite)),
        "max": float(np.max(finite)),
    }


def quantile(values: Floats, share: float) -> float:
    """Nearest rank: the smallest value that ``share`` of all do not exceed."""
    ranked = np.sort(values)
    return float(ranked[max(int(np.ceil(share * len(ranked) - 1e-9)) - 1, 0)])


def _joined(parts: Sequence[Any]) -> Floats:
    return np.concatenate([np.zeros(0), *(np.asarray(part, np.float64) for part in parts)])


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _most(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return max(known) if known else None
