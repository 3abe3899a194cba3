"""The benchmark: its definitions on hand-made input, and a tiny run of everything."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from streamtrack import cli
from streamtrack.bench.measure import Footage, Trial, one_thread, run_bench
from streamtrack.bench.methods import METHODS, choose_methods
from streamtrack.bench.report import build_report
from streamtrack.bench.scenarios import (
    SCENES,
    PotScenario,
    Scenario,
    SyntheticScenario,
    Truth,
    pot_scenarios,
    shipped_photos,
    synthetic_scenarios,
)
from streamtrack.bench.score import figures, quantile
from streamtrack.errors import SourceError, UsageError
from streamtrack.geometry import box_quad
from streamtrack.sources.synthetic import SyntheticSource
from streamtrack.types import Points

SIZE = (320, 240)
SCENARIOS: tuple[Scenario, ...] = (
    SyntheticScenario("static", 1, SIZE, 5),
    SyntheticScenario("scale", 2, SIZE, 5),
)
Report = dict[str, Any]


@pytest.fixture(scope="module")
def report() -> Report:
    methods = list(METHODS.values())
    return build_report(run_bench(SCENARIOS, methods), methods, {})


def by_name(report: Report) -> dict[str, Report]:
    return {method["name"]: method for method in report["methods"]}


def test_a_tiny_run_measures_every_method(report: Report) -> None:
    assert [sequence["factor"] for sequence in report["sequences"]] == ["static", "scale"]
    assert set(by_name(report)) == set(METHODS)
    for method in report["methods"]:
        whole = method["all"]
        assert whole["scored_frames"] == 8 and whole["frames"] == 10
        assert whole["absent_frames"] == 0 and whole["false_lock_share"] is None
        cpu = whole["cpu_ms"]
        assert 0 < cpu["p50"] <= cpu["p95"] <= cpu["max"] and cpu["count"] == 8
        assert cpu["with_decoding"]["p50"] > cpu["p50"]
        assert cpu["tracking"]["count"] + cpu["lost"]["count"] == 8
        assert list(method["by_factor"]) == ["static", "scale"]
        assert list(method["by_size"]) == ["320x240"]
        assert len(method["by_sequence"]) == 2
        assert method["pot"] is None and not method["refusals"]
        assert method["parameters"]
    assert report["is_whole"] and report["peak_rss_mb"] > 50


def test_followers_of_corners_are_precise_on_easy_frames(report: Report) -> None:
    for name in ("streamtrack", "sift", "lk-chain", "prewarp-lk", "prewarp-dis"):
        whole = by_name(report)[name]["all"]
        assert whole["p5"] == 1.0, name
        assert whole["p1"] <= whole["p2"] <= whole["p5"] <= whole["p15"]
        assert whole["error_median_px"] < 1.0
        assert whole["wrong_locks"] == 0
        assert whole["jitter_px"] < 0.5
        assert whole["centre"]["within_20"] == 1.0


def test_box_trackers_are_measured_by_their_centre_alone(report: Report) -> None:
    for name in ("csrt", "kcf"):
        whole = by_name(report)[name]["all"]
        assert whole["p5"] is None and whole["wrong_locks"] is None and whole["jitter_px"] is None
        assert whole["centre"]["error_median_px"] < 10


def test_stages_share_out_the_processor_time(report: Report) -> None:
    cpu = by_name(report)["streamtrack"]["all"]["cpu_ms"]
    assert sum(stage["mean"] for stage in cpu["stages"].values()) == pytest.approx(
        cpu["mean"], rel=0.2
    )
    assert by_name(report)["lk-chain"]["all"]["cpu_ms"]["stages"] is None


def test_two_runs_differ_in_times_only() -> None:
    methods = choose_methods(["streamtrack", "plane-tracker", "prewarp-lk", "lk-chain"])
    first, second = (run_bench(SCENARIOS[1:], methods).trials for _ in range(2))
    for a, b in zip(first, second, strict=True):
        for quad, again in zip(a.quads, b.quads, strict=True):
            assert (quad is None) == (again is None)
            assert quad is None or again is None or np.array_equal(quad, again)


def test_opencv_has_its_threads_back_afterwards() -> None:
    before = cv2.getNumThreads()
    with pytest.raises(RuntimeError), one_thread():
        assert cv2.getNumThreads() == 1
        raise RuntimeError
    assert cv2.getNumThreads() == before


TRUE = box_quad(100, 100, 50, 40)


def moved(x: float, y: float) -> Points:
    """The true corners, all off by (x, y)."""
    return np.asarray(TRUE + np.array([x, y]), np.float32)


def trial(
    quads: Sequence[Points | None],
    visible: Sequence[float],
    cpu_ms: Sequence[float] | None = None,
    factor: str = "static",
    method: str = "streamtrack",
) -> Trial:
    """A trial whose target stands still at `TRUE`; scored where a fifth of it is visible."""
    count = len(quads)
    shares = np.array(visible, np.float64)
    is_scored = shares >= 0.2
    is_scored[0] = False
    truth = Truth(np.repeat(TRUE[None].astype(np.float64), count, axis=0), shares, is_scored)
    footage = Footage("made up", "synthetic", factor, 1, "none", (640, 480), truth, None)
    times = np.array(cpu_ms if cpu_ms is not None else [1.0] * count)
    return Trial(METHODS[method], footage, tuple(quads), times, ({},) * count, None)


def test_misses_count_and_the_first_frame_does_not() -> None:
    quads = [moved(99, 99), TRUE, moved(1.5, 0), None, moved(9, 12), TRUE]
    found = figures([trial(quads, [1] * 6)])
    assert found["scored_frames"] == 5
    assert [found[f"p{px}"] for px in (1, 2, 5, 15)] == pytest.approx([0.4, 0.6, 0.6, 0.8])
    assert found["error_median_px"] == pytest.approx(1.5)
    assert found["tracked"] == pytest.approx(0.8)
    assert (found["wrong_locks"], found["present_frames"]) == (1, 5)


def test_locks_without_the_target_are_false_and_far_off_ones_wrong() -> None:
    far = moved(40, 0)
    visible = [1, 0.5, 0.1, 0.01, 0, 0, 0.1, 0.6, 0.7, 1]
    found = figures([trial([TRUE, TRUE, far, far, None, TRUE, far, None, TRUE, TRUE], visible)])
    assert (found["false_locks"], found["absent_frames"]) == (2, 3)
    assert found["false_lock_share"] == pytest.approx(2 / 3)
    # Between absent and scored a lock can be wrong too, but a miss costs nothing.
    assert (found["wrong_locks"], found["present_frames"]) == (2, 6)
    assert found["scored_frames"] == 4
    again = found["reacquire"]
    assert (again["returns"], again["never"], again["within_3"]) == (1, 0, 1.0)
    assert again["median_frames"] == again["worst_frames"] == 1.0


def test_jitter_is_measured_at_rest_only() -> None:
    shaking = [moved(0.1 * (n % 2), 0) for n in range(6)]
    assert figures([trial(shaking, [1] * 6)])["jitter_px"] == pytest.approx(0.2, abs=1e-3)
    assert figures([trial(shaking, [1] * 6, factor="fast")])["jitter_px"] is None


def test_times_leave_the_set_up_out_and_are_split_by_state() -> None:
    cpu = figures([trial([TRUE, TRUE, None, TRUE, None], [1] * 5, [90, 1, 10, 3, 20])])["cpu_ms"]
    assert (cpu["p50"], cpu["p95"], cpu["max"], cpu["mean"]) == (3, 20, 20, 8.5)
    assert (cpu["tracking"]["mean"], cpu["lost"]["mean"]) == (2, 15)
    assert cpu["set_up"]["p50"] == 90
    assert cpu["with_decoding"]["p50"] is None


def test_quantile_is_the_nearest_rank() -> None:
    values = np.arange(1.0, 21.0)
    assert [quantile(values, share) for share in (0.0, 0.5, 0.95, 1.0)] == [1, 10, 19, 20]


def test_nothing_seen_has_no_median() -> None:
    found = figures([trial([TRUE, None, None], [1] * 3)])
    assert found["p5"] == 0.0 and found["error_median_px"] is None
    json.dumps(found, allow_nan=False)


def test_the_usual_set_has_every_scene_both_sizes_and_both_kinds_of_texture() -> None:
    chosen = synthetic_scenarios(None, [1, 2, 3, 4], None, is_quick=False)
    kinds = [scenario for scenario in chosen if isinstance(scenario, SyntheticScenario)]
    assert {scenario.factor for scenario in kinds} == set(SCENES)
    for scene in SCENES:
        own = [scenario for scenario in kinds if scenario.factor == scene]
        assert sorted(scenario.size_wh[0] for scenario in own) == [640, 640, 640, 1280]
    if shipped_photos():
        assert 0.3 < np.mean([scenario.photo is not None for scenario in kinds]) < 0.6
    assert len({scenario.name for scenario in kinds}) == len(kinds)


def test_the_help_says_what_is_run_without_options() -> None:
    chosen = synthetic_scenarios(None, [1], None, is_quick=False)
    kinds = [scenario for scenario in chosen if isinstance(scenario, SyntheticScenario)]
    assert len(kinds) == 17 and sum(scenario.frames for scenario in kinds) == 1440
    assert sum(scenario.size_wh == (1280, 720) for scenario in kinds) == 4
    quick = synthetic_scenarios(None, [1], None, is_quick=True)
    assert len(quick) == 9


@pytest.fixture
def pot_folder(tmp_path: Path) -> Path:
    """A POT sequence that begins with a row that is not annotated, and one odd flag."""
    with SyntheticSource(
        f"synthetic://rotation?seed=1&frames=8&size={SIZE[0]}x{SIZE[1]}"
    ) as source:
        rows = []
        (tmp_path / "V01_2").mkdir()
        for frame in source:
            cv2.imwrite(str(tmp_path / "V01_2" / f"{frame.index + 1:08d}.jpg"), frame.image)
            is_annotated = frame.index % 2 == 1
            quad = source.truth(frame.index).quad.ravel() * is_annotated
            rows.append(" ".join(f"{value:.4f}" for value in quad))
    # Truth goes on where the pictures end, as in the part of POT that is commonly at hand.
    rows += [rows[-1]] * 4
    (tmp_path / "V01_2_gt_points.txt").write_text("\n".join(rows))
    (tmp_path / "V01_2_flag.txt").write_text("\n".join("1" if n == 5 else "0" for n in range(12)))
    return tmp_path


def test_pot_begins_with_the_first_annotated_frame(pot_folder: Path) -> None:
    (scenario,) = pot_scenarios(pot_folder, None)
    assert isinstance(scenario, PotScenario)
    assert (scenario.name, scenario.factor) == ("POT V01_2", "rotation")
    clip = scenario.load()
    assert len(clip.images) == 7
    assert np.flatnonzero(clip.truth.is_scored).tolist() == [2, 6]
    methods = choose_methods(["streamtrack"])
    whole = build_report(run_bench([scenario], methods), methods, {})["methods"][0]
    assert whole["all"] is None
    assert whole["pot"]["scored_frames"] == 2 and whole["pot"]["p5"] == 1.0


def test_a_folder_without_pot_sequences_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="holds no POT sequence"):
        pot_scenarios(tmp_path, None)
    with pytest.raises(SourceError, match="is no folder"):
        pot_scenarios(tmp_path / "absent", None)


def test_unknown_names_are_refused_with_the_nearest() -> None:
    with pytest.raises(UsageError, match="did you mean plane-tracker"):
        choose_methods(["plane_tracker"])
    with pytest.raises(UsageError, match="did you mean blur"):
        synthetic_scenarios(["blurr"], [1], None, is_quick=False)


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., int]:
    def run(*arguments: object) -> int:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["streamtrack", "bench", "track", *map(str, arguments)])
        try:
            cli.main()
        except SystemExit as stop:
            return int(stop.code or 0)
        return 0

    return run


def test_the_command_writes_table_json_and_plot(
    run: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--scenes", "small", "--seeds", "3", "--methods", "streamtrack,plane-tracker")
    files = ("--json", "out/bench.json", "--plot", "out/bench.png")
    assert run(*options, "--frames", 5, *files) == 0
    out, err = capsys.readouterr()
    assert "OpenCV plane_tracker" in out and "streamtrack, by factor" in out
    assert err.startswith("1 of 1: small, seed 3")
    report = json.loads((tmp_path / "out" / "bench.json").read_text())
    assert [method["name"] for method in report["methods"]] == ["streamtrack", "plane-tracker"]
    assert report["options"]["frames"] == 5
    assert str(tmp_path) not in json.dumps(report)
    picture = cv2.imread(str(tmp_path / "out" / "bench.png"))
    assert picture is not None and picture.shape == (1000, 1600, 3) and picture.std() > 5


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("--methods", "shift"), 2, "did you mean sift?"),
        (("--scenes", "statics"), 2, "did you mean static?"),
        (("--scenes", "none"), 2, "add --pot FOLDER"),
        (("--seeds", "1,x"), 2, "give whole numbers"),
        (("--plot", "plot.svg"), 2, "name it plot.png"),
        (("--json", "."), 1, "name a file in it"),
        (("--pot", "absent"), 1, "is no folder"),
    ],
)
def test_wrong_usage_is_one_line(
    run: Callable[..., int],
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    code: int,
    message: str,
) -> None:
    assert run(*arguments) == code
    _, err = capsys.readouterr()
    assert err.startswith("streamtrack: error: ") and message in err
    assert err.count("\n") == 1


def test_an_interrupted_run_reports_what_is_done() -> None:
    calls = iter([False] * 10)
    methods = choose_methods(["plane-tracker"])
    run = run_bench(SCENARIOS, methods, should_stop=lambda: next(calls, True))
    assert not run.is_whole
    assert [trial.footage.factor for trial in run.trials] == ["static"]
