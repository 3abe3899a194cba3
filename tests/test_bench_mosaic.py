"""The registration benchmark: exact pairs, folders of pairs, definitions, and a tiny run."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import MakePicture
from rich.console import Console

from streamtrack import cli, geometry
from streamtrack.bench import mosaic
from streamtrack.bench.mosaic import PairRequest, run_pair_request
from streamtrack.bench.mosaic_measure import PairTrial, pair_figures, run_pairs
from streamtrack.bench.mosaic_methods import compatible_methods, main_methods, own_method
from streamtrack.bench.mosaic_pairs import (
    DIFFICULTIES,
    SIZE,
    PairSource,
    PicturePair,
    folder_pairs,
    rendered,
    synthetic_pairs,
)
from streamtrack.bench.mosaic_report import build_pair_report, print_pair_tables
from streamtrack.errors import OutputError, SourceError, StreamtrackError
from streamtrack.evaluation import RecallPrecision, visible_error
from streamtrack.features import COMPATIBLE
from streamtrack.types import Image, Matrix

SHIFT = geometry.translation(-30.0, 12.0)
Report = dict[str, Any]


def shifted(make_picture: MakePicture, seed: int) -> tuple[Image, Image]:
    """Two views of one picture, 320 x 240, related by `SHIFT`."""
    scene = make_picture(seed, (500, 400))
    return (np.ascontiguousarray(scene[y : y + 240, x : x + 320]) for x, y in ((50, 60), (80, 48)))  # type: ignore[return-value]


def source(name: str, a: Image, b: Image, truth: Matrix | None) -> PairSource:
    return PairSource(name, lambda: PicturePair(name, "synthetic", "made up", a, b, truth))


@pytest.fixture(scope="module")
def report(make_picture: MakePicture) -> Report:
    a, b = shifted(make_picture, 1)
    other = make_picture(2, (320, 240))
    sources = [source("easy", a, b, SHIFT), source("strangers", a, other, None)]
    methods = [*main_methods(), own_method("fast", "brisk")]
    return build_pair_report(run_pairs(sources, methods), methods, {})


def by_name(report: Report) -> dict[str, Report]:
    return {method["name"]: method["groups"]["synthetic"] for method in report["methods"]}


# -- pairs --------------------------------------------------------------------------------------


def test_rendered_pairs_have_every_difficulty_and_strangers() -> None:
    names = [one.name for one in synthetic_pairs([1, 2])]
    assert len(set(names)) == len(names) == 2 * (len(DIFFICULTIES) + 1)
    assert [one.name for one in synthetic_pairs([4], ["noise", "nothing"])] == [
        "noise 4",
        "nothing 4",
    ]


def test_rendering_keeps_places_to_a_hundredth_of_a_pixel() -> None:
    """The centroid of a soft blob comes to lie where the view takes the blob's centre."""
    y, x = np.mgrid[:600, :800]
    blob = 250 * np.exp(-((x - 410.0) ** 2 + (y - 290.0) ** 2) / (2 * 9.0**2))
    texture = np.asarray(cv2.cvtColor(np.rint(blob).astype(np.uint8), cv2.COLOR_GRAY2BGR), np.uint8)
    for scale, degrees in ((1.0, 0.0), (0.5, 30.0), (2.3, -77.0)):
        turn = cv2.getRotationMatrix2D((410.0, 290.0), degrees, scale)
        view = geometry.translation(-90.63, -41.28) @ np.vstack([turn, [0, 0, 1]])
        seen = rendered(texture, view)[..., 0].astype(np.float64)
        rows, columns = np.mgrid[: SIZE[1], : SIZE[0]]
        true = geometry.transform_points(view, [[410.0, 290.0]])[0]
        # Beyond the texture lies its mirror image, with the blob once more.
        seen[np.hypot(columns - true[0], rows - true[1]) > 40 * scale] = 0
        found = np.array([(seen * columns).sum(), (seen * rows).sum()]) / seen.sum()
        np.testing.assert_allclose(found, true, atol=0.01 * max(scale, 1))


def test_the_same_seed_makes_the_same_pair() -> None:
    first, second = (synthetic_pairs([3], ["everything"])[0].load() for _ in range(2))
    np.testing.assert_array_equal(first.b, second.b)
    np.testing.assert_array_equal(first.true_b_from_a, second.true_b_from_a)


def write_oxford(folder: Path, make_picture: MakePicture) -> None:
    folder.mkdir()
    a, b = shifted(make_picture, 3)
    cv2.imwrite(str(folder / "img1.png"), a)
    cv2.imwrite(str(folder / "img2.png"), b)
    np.savetxt(folder / "H1to2p", SHIFT)
    np.savetxt(folder / "H1to3p", SHIFT)  # its picture is missing: left out


def test_both_layouts_of_a_folder_are_read(tmp_path: Path, make_picture: MakePicture) -> None:
    write_oxford(tmp_path / "graf", make_picture)
    a, b = shifted(make_picture, 3)
    cv2.imwrite(str(tmp_path / "wallA.png"), a)
    cv2.imwrite(str(tmp_path / "wallB.png"), b)
    np.savetxt(tmp_path / "wall_model.txt", 2 * geometry.inverted(SHIFT))
    pairs = [one.load() for one in folder_pairs(tmp_path)]
    assert sorted(pair.name for pair in pairs) == ["graf 1-2", "wall"]
    for pair in pairs:
        assert pair.group == "folder"
        np.testing.assert_allclose(pair.true_b_from_a, SHIFT, atol=1e-9)
        np.testing.assert_array_equal(pair.b[..., 0], b)


@pytest.mark.parametrize("text", ["1 2 3", "a b c", "", "0 0 0\n0 0 0\n0 0 1\n", "nan " * 9])
def test_a_truth_that_is_none_is_told(text: str, tmp_path: Path, make_picture: MakePicture) -> None:
    write_oxford(tmp_path / "graf", make_picture)
    (tmp_path / "graf" / "H1to2p").write_text(text)
    with pytest.raises(SourceError, match="H1to2p"):
        folder_pairs(tmp_path)[0].load()


def test_a_folder_without_pairs_is_told(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no pairs in"):
        folder_pairs(tmp_path)
    with pytest.raises(SourceError, match="is no folder"):
        folder_pairs(tmp_path / "missing")


def test_a_damaged_picture_is_told(tmp_path: Path, make_picture: MakePicture) -> None:
    write_oxford(tmp_path / "graf", make_picture)
    (tmp_path / "graf" / "img2.png").write_bytes(b"no picture")
    with pytest.raises(SourceError, match="damaged"):
        folder_pairs(tmp_path)[0].load()


# -- methods and definitions --------------------------------------------------------------------


def test_every_compatible_pair_is_a_method() -> None:
    names = [method.name for method in compatible_methods()]
    assert len(names) == sum(len(fitting) for fitting in COMPATIBLE.values())
    assert {"harris+freak", "akaze+akaze", "orb+orb"} <= set(names)
    assert [method.name for method in main_methods()] == [
        *("streamtrack", "sift", "orb", "brisk", "akaze")
    ]


def test_a_tiny_run_measures_every_method(report: Report) -> None:
    figures = by_name(report)
    for name, one in figures.items():
        assert (one["pairs"], one["strangers"]) == (1, 1), name
        assert one["claimed"] == 1, name
        assert one["corner_median_px"] < 2, name
        assert 0 < one["recall"] <= 1 and 0 <= one["one_minus_precision"] < 1, name
        assert one["cpu_ms"] > 0 and one["inliers"] > 10 and 0 <= one["rmse_px"] < 3, name
        assert one["auc"]["1"] <= one["auc"]["3"] <= one["auc"]["5"] <= 1, name
    assert figures["streamtrack"]["wrong"] == figures["fast+brisk"]["wrong"] == 0
    assert figures["streamtrack"]["corner_median_px"] < 0.05
    json.dumps(report, allow_nan=False)


def test_tables_show_every_method(report: Report, tmp_path: Path) -> None:
    path = tmp_path / "out.txt"
    with path.open("w", encoding="utf-8") as file:
        print_pair_tables(Console(file=file, width=80), report)
    text = path.read_text(encoding="utf-8")
    for words in ("streamtrack", "SIFT + MAGSAC", "AUC@5", "RMSE, px", "recall", "CPU", "fast"):
        assert words in text


def trial(corner_px: float, *, is_claimed: bool = True, **values: Any) -> PairTrial:
    given: dict[str, Any] = {
        "has_truth": True,
        "is_wrong": False,
        "matching": RecallPrecision(0.5, 0.8, 40, 50, 80),
        "cpu_ms": 10.0,
        **values,
    }
    return PairTrial(
        method="m",
        pair="p",
        group="synthetic",
        factor="f",
        is_claimed=is_claimed,
        corner_px=corner_px,
        visible_px=corner_px,
        rmse_px=0.5,
        inliers=30,
        pairs=60,
        reason="",
        **given,
    )


def test_failures_are_infinite_and_matches_are_pooled() -> None:
    few = RecallPrecision(0.1, 0.2, 2, 10, 20)
    found = pair_figures([trial(0.5), trial(float("inf"), is_claimed=False, matching=few)])
    assert found["auc"]["1"] == pytest.approx(0.5 * (0.5 + 1) / 2 - 0.0, abs=0.2)
    assert found["auc"]["1"] < 0.5 and found["claimed"] == 1 and found["pairs"] == 2
    assert found["recall"] == pytest.approx(42 / 100)
    assert found["one_minus_precision"] == pytest.approx(1 - 42 / 60)
    assert found["inlier_share"] == pytest.approx(0.5)


def test_a_claim_about_strangers_is_wrong(make_picture: MakePicture) -> None:
    """`orb` claims something even of noise; what has no truth has no corner error."""
    a, b = make_picture(5, (320, 240)), make_picture(6, (320, 240))
    sift = next(method for method in main_methods() if method.name == "orb")
    run = run_pairs([source("strangers", a, b, None)], [sift])
    (only,) = run.trials
    assert not only.has_truth and math.isnan(only.corner_px)
    assert only.is_wrong == only.is_claimed
    figures = pair_figures(run.trials)
    assert figures["pairs"] == 0 and figures["strangers"] == 1
    assert figures["auc"]["1"] is None and figures["wrong"] == int(only.is_claimed)


def test_visible_error_asks_for_no_extrapolation() -> None:
    """A mapping that is right where b shows a, and wild elsewhere."""
    truth = geometry.translation(-80.0, 0.0)
    bent = truth @ np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
    assert visible_error(bent, truth, (100, 100), (100, 100)) == pytest.approx(0, abs=1e-9)
    off = geometry.translation(3.0, 4.0) @ truth
    assert visible_error(off, truth, (100, 100), (100, 100)) == pytest.approx(5.0)
    stretched = truth @ np.diag([1.1, 1.0, 1.0])
    right_edge = visible_error(stretched, truth, (100, 100), (100, 100))
    assert 8.0 < right_edge < 10.0  # a tenth of x, x from 80 to 99
    assert math.isinf(visible_error(None, truth, (100, 100), (100, 100)))
    assert math.isnan(visible_error(truth, geometry.translation(500, 0), (100, 100), (100, 100)))


def test_what_was_measured_is_reported_when_stopped(
    make_picture: MakePicture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    a, b = shifted(make_picture, 7)
    monkeypatch.setattr(
        mosaic, "_sources", lambda _request: [source(n, a, b, SHIFT) for n in "xyz"]
    )
    monkeypatch.setattr(mosaic, "_methods", lambda _request: main_methods()[:2])
    calls = iter([False] * 3)
    with (
        (tmp_path / "out.txt").open("w", encoding="utf-8") as file,
        pytest.raises(StreamtrackError, match="interrupted after 1 of 3"),
    ):
        run_pair_request(
            PairRequest(json_path=tmp_path / "r.json"),
            Console(file=file, width=100),
            lambda _line: None,
            lambda: next(calls, True),
        )
    written = json.loads((tmp_path / "r.json").read_text())
    assert not written["is_whole"] and {t["pair"] for t in written["trials"]} == {"x"}


def test_a_report_that_cannot_be_written_is_told_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(OutputError):
        run_pair_request(
            PairRequest(is_quick=True, json_path=tmp_path),
            Console(),
            lambda _line: None,
            lambda: True,
        )


def test_command_line(
    capfd: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["streamtrack", "bench", "mosaic", "--pairs", str(tmp_path / "missing"), "--quick"]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 1
    assert "is no folder" in capfd.readouterr().err
