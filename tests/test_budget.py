"""Keeping to a time a frame: which level of work is chosen, and what it does to results."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from conftest import FrameList

from streamtrack.budget import LEVELS, Budget
from streamtrack.evaluation import alignment_error
from streamtrack.pipeline import track
from streamtrack.settings import build_settings
from streamtrack.sources.synthetic import SyntheticSource
from streamtrack.summary import SummaryBuilder
from streamtrack.targets import Target
from streamtrack.types import TrackState

_SCENE = "synthetic://board?seed=3&frames=25&size=320x240"


def _levels(budget: Budget, frame_ms: list[float]) -> list[int]:
    levels = []
    for ms in frame_ms:
        levels.append(budget.level.index)
        budget.note(ms)
    return levels


def test_without_a_budget_all_is_done() -> None:
    assert set(_levels(Budget(None), [1e9] * 50)) == {0}


@pytest.mark.parametrize("ms", [1.0, 9.9])
def test_within_the_budget_all_is_done(ms: float) -> None:
    assert set(_levels(Budget(10.0), [ms] * 100)) == {0}


def test_work_is_lowered_step_by_step_and_never_below_the_last() -> None:
    levels = _levels(Budget(10.0), [100.0] * 40)
    assert levels == sorted(levels)
    assert list(dict.fromkeys(levels)) == [level.index for level in LEVELS]


def test_one_slow_frame_changes_nothing() -> None:
    assert set(_levels(Budget(10.0), [8.0] * 10 + [14.0] + [8.0] * 40)) == {0}


def test_work_is_raised_again_when_there_is_room() -> None:
    budget = Budget(10.0)
    _levels(budget, [12.0] * 3)
    assert budget.level.index == 1
    _levels(budget, [8.0] * 100)
    assert budget.level.index == 1, "no room: full work would not fit"
    _levels(budget, [3.0] * 100)
    assert budget.level.index == 0


def test_work_that_does_not_fit_is_tried_ever_more_rarely() -> None:
    """Full work takes too long, one step less has room to spare: no swinging to and fro."""
    budget = Budget(10.0)
    levels = []
    for _ in range(3000):
        levels.append(budget.level.index)
        budget.note(12.0 if budget.level.index == 0 else 4.0)
    rises = [n for n, (a, b) in enumerate(itertools.pairwise(levels)) if b < a]
    waits = np.diff(rises)
    assert len(rises) <= 8
    assert list(waits) == sorted(waits)
    assert levels.count(0) < 0.02 * len(levels)


def test_lateness_lowers_the_work_although_tracking_is_quick() -> None:
    source = SyntheticSource(_SCENE)
    target = Target("t", np.asarray(source.truth(0).quad, np.float32))
    settings = build_settings({"tracker": {"budget_ms": 100_000.0}})
    frames = [replace(source.frame(n), waited_s=0.0 if n < 8 else 450.0) for n in range(25)]
    levels = [step.work_level for step in track(FrameList(frames), [target], settings)]
    assert set(levels[:9]) == {0}
    assert levels[-1] == LEVELS[-1].index


def test_each_level_does_less() -> None:
    for more, less in itertools.pairwise(LEVELS):
        assert less.patch_steps >= more.patch_steps
        assert less.feature_share < more.feature_share
        assert less.search_interval >= more.search_interval


def test_the_summary_tells_what_was_done_and_whether_it_was_enough() -> None:
    for budget_ms, frames_over in ((1e-6, 25), (1e6, 0)):
        source = SyntheticSource(_SCENE)
        target = Target("t", np.asarray(source.truth(0).quad, np.float32))
        settings = build_settings({"tracker": {"budget_ms": budget_ms}})
        builder = SummaryBuilder(source.info, settings)
        for step in track(source, [target], settings):
            builder.add(step)
        summary = builder.build([], 0, "end of source")
        told = summary.to_json()["budget"]
        assert told["frames_over"] == frames_over
        assert sum(told["frames_at_level"]) == 25
        assert (told["frames_at_level"][-1] > 0) == (frames_over > 0)
        assert f"exceeded in {frames_over} of 25 frames" in dict(summary.rows())["Time budget"]


def test_the_least_work_still_tracks_and_is_reported() -> None:
    settings = build_settings({"tracker": {"budget_ms": 1e-6}})
    source = SyntheticSource(_SCENE)
    quads = [source.truth(i).quad for i in range(25)]
    target = Target("t", np.asarray(quads[0], np.float32))
    steps = list(track(source, [target], settings))
    assert steps[0].work_level == 0
    assert steps[-1].work_level == LEVELS[-1].index
    for step, quad in zip(steps, quads, strict=True):
        assert step.tracks[0].state is TrackState.TRACKING
        assert alignment_error(step.tracks[0].quad, quad) < 2.0
