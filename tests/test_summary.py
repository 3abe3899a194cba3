"""The summary: exact sums over a run told by hand, quantiles against numpy, honest JSON."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from streamtrack.errors import OutputError
from streamtrack.geometry import box_quad
from streamtrack.meters import LogHistogram, Mean, peak_rss_mb
from streamtrack.settings import Settings, build_settings
from streamtrack.summary import Summary, SummaryBuilder
from streamtrack.types import (
    AUTO_STAGE,
    CameraPose,
    Evidence,
    Features,
    Frame,
    Model,
    Skipped,
    SourceInfo,
    Step,
    Track,
    TrackState,
)

SOURCE = SourceInfo("rtsp://user:secret@cam.local/main", (640, 480), 30.0, None)
IMAGE = np.zeros((4, 4), np.uint8)
NAN = float("nan")


def _track(
    state: str, name: str = "board", matches: int = 4, inliers: int = 2, rmse_px: float = 0.5
) -> Track:
    if state != "tracking":
        return Track(name, TrackState(state), reason="too few matches")
    points = np.zeros((matches, 2), np.float32)
    evidence = Evidence(points, points, np.arange(matches) < inliers)
    quad = box_quad(0, 0, 4, 4)
    return Track(name, TrackState.TRACKING, quad, np.eye(3), Model.HOMOGRAPHY, evidence, rmse_px)


def _features(count: int) -> Features:
    ones = np.ones(count, np.float32)
    return Features(np.zeros((count, 2), np.float32), ones, ones, np.zeros((count, 8), np.uint8))


def _step(
    index: int, *tracks: Track, features: int | None = None, has_pose: bool = True, ms: float = 4
) -> Step:
    return Step(
        Frame(index, index / 30, IMAGE),
        tracks,
        CameraPose(np.eye(3) if has_pose else None),
        None if features is None else _features(features),
        {"detect": ms / 4, "total": ms},
    )


def _summary(*steps: Step, settings: Settings | None = None, seconds: float = 2.0) -> Summary:
    times = iter([10.0, 10.0 + seconds])
    builder = SummaryBuilder(SOURCE, settings or Settings(), clock=lambda: next(times))
    for step in steps:
        builder.add(step)
    return builder.build([Skipped(3, "bad|name.png", "not a picture")], 2, "end of source")


def _told_run() -> Summary:
    return _summary(
        _step(0, _track("searching"), features=100),
        _step(1, _track("tracking", matches=10, inliers=8, rmse_px=0.5), features=300),
        _step(2, _track("tracking", matches=20, inliers=10, rmse_px=NAN), has_pose=False),
        _step(3, _track("lost")),
        _step(4, _track("tracking", matches=90, inliers=30, rmse_px=1.5), _track("lost", "late")),
        _step(5, _track("lost"), _track("lost", "late")),
    )


def test_a_told_run_is_summed_up_exactly() -> None:
    target, late = _told_run().targets
    assert (target.frames_tracked, target.frames_lost, target.frames_searching) == (3, 2, 1)
    assert (target.losses, target.first_seen, target.share) == (2, 1, 0.5)
    assert (target.rmse_px, target.matches, target.inliers) == (1.0, 40.0, 16.0)
    assert target.models == {"homography": 3}
    assert (late.frames_lost, late.losses, late.first_seen, late.rmse_px) == (2, 0, None, None)


def test_json_holds_the_keys_of_the_contract_and_no_nan() -> None:
    values = json.loads(json.dumps(_told_run().to_json(), allow_nan=False))
    assert values["source"] == "rtsp-cam.local-main"
    assert values["size"] == {"width": 640, "height": 480}
    expected = {
        "frames": 6,
        "frames_with_pose": 5,
        "detector": "harris",
        "threshold": 1e-7,
        "descriptor": "freak",
        "transformation_model": "auto",
        "warping": None,
        "blending": None,
        "method": "hybrid",
        "camera": "fixed",
        "features": 200.0,
        "matches": {"mean": 40.0, "median": 20},
        "inliers": 16.0,
        "models": {"homography": 3},
        "time_s": 2.0,
        "fps": 3.0,
        "skipped": [{"frame": 3, "name": "bad|name.png", "reason": "not a picture"}],
        "corrupt_packets": 2,
        "ended": "end of source",
    }
    assert {key: values[key] for key in expected} == expected
    assert values["ms_per_frame"] == {"median": 4.0, "p95": 4.0, "by_stage": {"detect": 1.0}}
    assert values["peak_rss_mb"] > 1
    assert values["targets"][0]["name"] == "board"
    assert values["targets"][1]["rmse_px"] is None


def test_a_run_without_frames_is_all_unknown() -> None:
    summary = _summary()
    values = json.loads(json.dumps(summary.to_json(), allow_nan=False))
    unknown = ("features", "inliers", "fps")
    assert [values[key] for key in unknown] == [None] * 3
    assert values["matches"] == {"mean": None, "median": None}
    assert values["ms_per_frame"] == {"median": None, "p95": None, "by_stage": {}}
    assert values["targets"] == []
    assert "nan" not in summary.to_markdown().lower()


def test_unknown_figures_are_null_even_when_nothing_was_measured() -> None:
    track = _track("tracking", matches=0, inliers=0, rmse_px=NAN)
    values = _summary(_step(0, track, ms=NAN)).to_json()
    json.dumps(values, allow_nan=False)
    assert values["targets"][0]["rmse_px"] is None
    assert values["ms_per_frame"]["median"] is None


def test_rows_speak_the_words_of_the_ancestor() -> None:
    settings = build_settings({"features": {"threshold": 0.01, "detector": "fast"}})
    rows = dict(_summary(_step(0, _track("tracking"), features=7), settings=settings).rows())
    assert rows["Detector"] == "fast"
    assert rows["Threshold"] == "0.01"
    assert rows["Descriptor"] == "freak"
    assert rows["Features"] == "7 a frame"
    assert rows["Matches"] == "mean 4.0, median 4"
    assert rows["Inliers"] == "2.0"
    assert rows["Transformation model"] == "homography 1"
    assert rows["Target board"].startswith("tracked 1 of 1 (100.0%), lost 0, searching 0")
    assert "RMSE 0.50 px" in rows["Target board"]
    assert rows["Tracking time a frame"].startswith("median 4.0 ms, p95 4.0 ms")
    assert rows["Corrupt packets"] == "2"
    assert rows["Skipped pictures"] == "1"


def test_markdown_survives_any_name() -> None:
    text = _summary(_step(0, _track("lost", "a|b\n<c>"))).to_markdown()
    table = [line for line in text.splitlines() if line.startswith("|")]
    assert any(line.startswith(r"| Target a\|b &lt;c> | tracked 0 of 1") for line in table)
    assert r"| 3 | bad\|name.png | not a picture |" in table
    assert all(line.endswith(" |") or set(line) <= {"|", "-"} for line in table)


def test_a_missing_total_is_the_sum_of_the_stages() -> None:
    step = Step(Frame(0, 0, IMAGE), (), CameraPose(None), None, {"detect": 1.0, "match": 2.0})
    summary = _summary(step)
    assert summary.ms_median == pytest.approx(3.0)
    assert summary.ms_by_stage == {"detect": 1.0, "match": 2.0}


@pytest.mark.parametrize("share", [0.0, 0.5, 0.95, 1.0])
def test_quantiles_are_right_to_half_a_percent(share: float) -> None:
    values = np.random.default_rng(2).lognormal(2, 1.5, 5000)
    histogram = LogHistogram()
    for value in values:
        histogram.add(float(value))
    exact = np.quantile(values, share, method="inverted_cdf")
    assert histogram.quantile(share) == pytest.approx(exact, rel=0.00501)


def test_histogram_of_odd_values_stays_bounded() -> None:
    histogram = LogHistogram()
    assert histogram.quantile(0.5) is None
    for value in (NAN, 0.0, -3.0, math.inf, 1e300, 5e-324):
        histogram.add(value)
    for value in np.geomspace(1e-9, 1e12, 50_000):
        histogram.add(float(value))
    assert len(histogram._bins) < 2600
    median = histogram.quantile(0.5)
    assert median is not None
    assert math.isfinite(median)


def test_mean_leaves_out_what_is_not_finite() -> None:
    mean = Mean()
    assert mean.value is None
    for value in (1.0, NAN, math.inf, 3.0):
        mean.add(value)
    assert mean.value == 2.0


def test_peak_memory_is_that_of_this_process() -> None:
    assert 10 < peak_rss_mb() < 20_000


def test_json_file_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "new" / "summary.json"
    summary = _summary(_step(0, _track("tracking", "caf\udce9 漢")))
    summary.write_json(path)
    assert json.loads(path.read_text(encoding="utf-8"))["targets"][0]["name"] == "caf? 漢"
    assert [entry.name for entry in path.parent.iterdir()] == ["summary.json"]
    with pytest.raises(OutputError, match="this is a folder"):
        summary.write_json(tmp_path)
    (tmp_path / "full.json").symlink_to("/dev/full")
    with pytest.raises(OutputError, match=r"full\.json: no space left"):
        summary.write_json(tmp_path / "full.json")


def test_of_very_many_automatic_targets_all_are_counted_and_the_last_listed() -> None:
    def found(number: int) -> Track:
        return replace(_track("tracking", f"auto-{number}"), is_found=True)

    steps = [
        replace(_step(n, _track("tracking"), found(n), found(n + 1)), stage_ms={AUTO_STAGE: 1.0})
        for n in range(1, 1100)
    ]
    summary = _summary(*steps)
    names = [target.name for target in summary.targets]
    assert len(names) == 1001 and names[0] == "board" and names[-1] == "auto-1100"
    assert summary.auto_count == 1100 and summary.auto_at_once == 2
    assert ("Automatic targets", "1100") in [(a, b[:4]) for a, b in summary.rows()]
