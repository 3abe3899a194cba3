"""The command line as a user sees it: outputs, exit codes and one clear line for bad input."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from streamtrack import cli
from streamtrack.sources.synthetic import SyntheticSource
from streamtrack.sources.writer import VideoWriter

SCENE = "synthetic://board?seed=1&frames=24&size=320x240&fps=30"
Run = Callable[..., int]


@pytest.fixture(scope="session")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene as a video file."""
    path = tmp_path_factory.mktemp("clips") / "board.mp4"
    with SyntheticSource(SCENE) as source, VideoWriter(path, rate_hz=30) as writer:
        for frame in source:
            writer.write(frame.image, frame.time_s)
    return path


@pytest.fixture(scope="session")
def target() -> str:
    return ",".join(f"{value:.3f}" for value in SyntheticSource(SCENE).initial_quad.ravel())


@pytest.mark.parametrize(
    ("given", "parsed"),
    [
        ("clip.mp4 --live", "clip.mp4 --live="),
        ("--live clip.mp4", "--live= clip.mp4"),
        ("clip.mp4 --live --quiet", "clip.mp4 --live= --quiet"),
        ("clip.mp4 --live 9000", "clip.mp4 --live 9000"),
        ("--live 0.0.0.0:9000 clip.mp4", "--live 0.0.0.0:9000 clip.mp4"),
        ("--live [::1]:9000", "--live [::1]:9000"),
        ("--live=9000 x", "--live=9000 x"),
        ("--output --live.csv", "--output --live.csv"),
    ],
)
def test_the_live_address_may_be_left_out(given: str, parsed: str) -> None:
    assert cli.with_live_address(given.split()) == parsed.split()


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """Run the program in an empty folder and return its exit code."""

    def run(*arguments: object) -> int:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["streamtrack", *map(str, arguments)])
        try:
            cli.main()
        except SystemExit as stop:
            return int(stop.code or 0)
        return 0

    return run


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_track_writes_every_output(
    run: Run, clip: Path, target: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    outputs = {
        "--record": "new/run.rrd",
        "--output": "new/tracks.csv",
        "--poses": "new/poses.csv",
        "--video": "new/seen.mp4",
        "--summary": "new/run.json",
    }
    flags = [part for pair in outputs.items() for part in pair]
    assert run("track", clip, "--target", f"board={target}", *flags) == 0
    for name in outputs.values():
        assert (tmp_path / name).stat().st_size > 0
    rows = rows_of(tmp_path / "new/tracks.csv")
    assert [int(row["frame"]) for row in rows] == list(range(24))
    assert {row["target"] for row in rows} == {"board"}
    truth = SyntheticSource(SCENE)
    for row in rows:
        quad = np.array([float(row[f"{axis}{i}"]) for i in range(1, 5) for axis in "xy"])
        assert np.abs(quad - truth.truth(int(row["frame"])).quad.ravel()).max() < 1.0
    summary = json.loads((tmp_path / "new/run.json").read_text())
    assert summary["detector"] == "harris"
    assert summary["targets"][0]["frames_tracked"] == 24
    printed = capsys.readouterr().out
    for words in ("Detector", "Transformation model", "Matches", "streamtrack view"):
        assert words in printed


def test_default_recording_goes_to_recordings(
    run: Run, clip: Path, target: str, tmp_path: Path
) -> None:
    assert run("track", clip, "--target", target, "--frames", 3, "--quiet") == 0
    assert [p.suffix for p in (tmp_path / "recordings").iterdir()] == [".rrd"]


def test_quiet_prints_nothing(
    run: Run, clip: Path, target: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("track", clip, "--target", target, "--no-record", "--frames", 3, "-q") == 0
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("", "")


def test_start_step_and_frames_keep_the_source_numbers(
    run: Run, clip: Path, target: str, tmp_path: Path
) -> None:
    flags = ("--no-record", "-q", "--output", "t.csv", "--start", 2, "--step", 3, "--frames", 4)
    assert run("track", clip, "--target", target, *flags) == 0
    assert [row["frame"] for row in rows_of(tmp_path / "t.csv")] == ["2", "5", "8", "11"]


def test_flags_win_over_the_settings_file(
    run: Run, clip: Path, target: str, tmp_path: Path
) -> None:
    (tmp_path / "s.toml").write_text('[features]\ndetector = "fast"\ndescriptor = "brisk"\n')
    flags = ("--settings", "s.toml", "--descriptor", "freak", "--summary", "s.json")
    assert run("track", clip, "--target", target, "--no-record", "-q", "--frames", 2, *flags) == 0
    summary = json.loads((tmp_path / "s.json").read_text())
    assert (summary["detector"], summary["descriptor"]) == ("fast", "freak")


def test_the_summary_says_how_the_run_ended(
    run: Run, clip: Path, target: str, tmp_path: Path
) -> None:
    whole = tmp_path / "whole.mkv"
    with SyntheticSource(SCENE) as source, VideoWriter(whole, rate_hz=30) as writer:
        for frame in source:
            writer.write(frame.image, frame.time_s)
    data = whole.read_bytes()
    (tmp_path / "cut.mkv").write_bytes(data[: len(data) // 2])
    for name, flags, ended in (
        ("whole.mkv", (), "end of source"),
        ("whole.mkv", ("--frames", 3), "3 frames, as asked"),
        ("cut.mkv", (), "the source ends early"),
    ):
        arguments = ("--no-record", "-q", "--summary", "s.json", *flags)
        assert run("track", tmp_path / name, "--target", target, *arguments) == 0
        assert json.loads((tmp_path / "s.json").read_text())["ended"].startswith(ended)


@pytest.mark.parametrize("camera", ["fixed", "moving"])
def test_poses(run: Run, clip: Path, target: str, tmp_path: Path, camera: str) -> None:
    flags = ("--no-record", "-q", "--camera", camera, "--poses", "p.csv", "--frames", 4)
    assert run("track", clip, "--target", target, *flags) == 0
    rows = rows_of(tmp_path / "p.csv")
    assert [row["status"] for row in rows] == ["used"] * 4
    assert abs(float(rows[3]["h13"])) < 1.0  # the board moves, the desk behind it does not


LINE = [part for n in range(4) for part in ("--ground", f"{n},{n}={n},{n}")]


def test_the_world_is_asked_for_and_told(run: Run, clip: Path, target: str, tmp_path: Path) -> None:
    """Units in the table, the video held still, and the camera found out, which is said."""
    flags = ("--no-record", "-q", "--scale", 10, "--stabilize", "s.mp4", "--output", "t.csv")
    assert run("track", clip, "--target", f"b={target}", *flags, "--summary", "s.json") == 0
    rows = rows_of(tmp_path / "t.csv")
    assert float(rows[-1]["ground_x"]) > 0 and rows[-1]["speed_units_s"]
    assert float(rows[0]["world_x1"]) == float(rows[0]["x1"])
    summary = json.loads((tmp_path / "s.json").read_text())
    assert summary["camera"] == "auto" and summary["camera_notes"] == ["moves from frame 0"]
    held_still = cv2.VideoCapture(str(tmp_path / "s.mp4"))
    assert held_still.get(cv2.CAP_PROP_FRAME_COUNT) == len(rows)


def test_the_camera_alone_needs_no_target(run: Run, clip: Path, tmp_path: Path) -> None:
    flags = ("-q", "--mosaic", "m.png", "--stabilize", "s.mp4", "--output", "t.csv")
    assert run("track", clip, *flags, "--poses", "p.csv", "--record", "r.rrd") == 0
    assert len(rows_of(tmp_path / "p.csv")) == 24 and rows_of(tmp_path / "t.csv") == []
    assert (tmp_path / "m.png").stat().st_size and (tmp_path / "r.rrd").stat().st_size


@pytest.mark.parametrize("flag", ["--mosaic", "--summary"])
@pytest.mark.parametrize(("place", "why"), [("", "folder"), ("file/", "a file stands")])
def test_what_cannot_be_written_in_the_end_is_said_at_once(
    run: Run,
    clip: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    flag: str,
    place: str,
    why: str,
) -> None:
    (tmp_path / "m.png").mkdir()
    (tmp_path / "file").touch()
    outputs = ("--poses", "p.csv", flag, f"{place}m.png")
    assert run("track", clip, "--no-record", *outputs) == 1
    assert why in capsys.readouterr().err
    assert not (tmp_path / "p.csv").exists()


@pytest.mark.parametrize(("flags", "camera"), [((), "fixed"), (("--poses", "p.csv"), "auto")])
def test_the_camera_is_taken_for_fixed_unless_the_world_is_wanted(
    run: Run, clip: Path, target: str, tmp_path: Path, flags: tuple[str, ...], camera: str
) -> None:
    options = ("--no-record", "-q", "--frames", 3, "--summary", "s.json", *flags)
    assert run("track", clip, "--target", target, *options) == 0
    assert json.loads((tmp_path / "s.json").read_text())["camera"] == camera


def bad_files(folder: Path) -> None:
    (folder / "empty.mp4").touch()
    (folder / "text.mp4").write_text("no video")
    (folder / "folder").mkdir()
    (folder / "bad.toml").write_text("[features]\ncolour = 1\n")
    (folder / "bad.png").write_text("no picture")


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["{missing}"], 1, "no such file"),
        (["empty.mp4"], 1, "empty"),
        (["text.mp4"], 1, "not a video"),
        (["folder"], 1, "no pictures"),
        (["foo://x"], 1, "unknown kind of source"),
        (["synthetic://bord"], 2, "did you mean board"),
        (["{clip}", "--target", "1,1,0,9"], 2, "must be positive"),
        (["{clip}", "--target", "nan,1,9,9"], 2, "finite"),
        (["{clip}", "--target", "1,2,3"], 2, "give x,y,w,h"),
        (["{clip}", "--target", "900,900,50,50"], 1, "outside the 320x240 picture"),
        (["{clip}", "--target", "90,90,4,4"], 1, "needs at least 8 px"),
        (["{clip}", "--target", "nothing.png"], 2, "neither numbers nor a file"),
        (["{clip}", "--target", "bad.png"], 1, "cannot be read"),
        (["{clip}", "--detector", "haris"], 2, "did you mean harris"),
        (["{clip}", "--descriptor", "akaze"], 2, "does not fit detector 'harris'"),
        (["{clip}", "--threshold", "nan"], 2, "not a positive number"),
        (["{clip}", "--model", "homografy"], 2, "did you mean homography"),
        (["{clip}", "--settings", "bad.toml"], 2, "unknown setting 'features.colour'"),
        (["{clip}", "--start", "99"], 2, "no frame 99"),
        (["{clip}", "--output", "t.xyz"], 2, ".parquet"),
        (["{clip}", "--output", "folder/"], 2, ".parquet"),
        (["{clip}", "--video", "t.gif"], 2, ".webm"),
        (["{clip}", "--record", "r.rrd"], 2, "contradict"),
        (["{clip}", "--camera", "mooving"], 2, "did you mean moving"),
        (["{clip}", "--scale", "0"], 2, "greater than 0"),
        (["{clip}", "--scale", "nan"], 2, "world.px_per_unit"),
        (["{clip}", "--scale", "5", "--ground", "0,0=0,0"], 2, "give one of them"),
        (["{clip}", "--ground", "0,0=0,0"], 2, "four known points or more, and 1"),
        (["{clip}", "--ground", "0;0=0;0"], 2, "write x,y=X,Y"),
        (["{clip}", *LINE], 2, "no three are in a line"),
        (["{clip}", "--stabilize", "s.gif"], 2, ".webm"),
        (["{clip}", "--stabilize", "{clip}"], 2, "would replace the source"),
        (["{clip}", "--stabilize", "s.mp4", "--video", "s.mp4"], 2, "would replace the video"),
        (["{clip}", "--stabilize-path", "world"], 2, "give --stabilize"),
        (["{clip}", "--stabilize", "s.mp4", "--stabilize-path", "smoth"], 2, "mean smooth"),
        (["{clip}", "--stabilize", "folder"], 2, "unknown video ending"),
    ],
)
def test_bad_input_is_one_clear_line(
    run: Run,
    clip: Path,
    target: str,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    arguments: list[str],
    code: int,
    message: str,
) -> None:
    bad_files(tmp_path)
    filled = [text.format(clip=clip, missing="missing.mp4") for text in arguments]
    if "--target" not in filled:
        filled += ["--target", target]
    assert run("track", *filled, "--no-record") == code
    captured = capfd.readouterr()
    lines = captured.err.strip().splitlines()
    assert len(lines) == 1, captured.err
    assert lines[0].startswith("streamtrack: error: ")
    assert message in lines[0]


def test_unwritable_output_is_refused_before_tracking(
    run: Run, clip: Path, target: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    code = run("track", clip, "--target", target, "--no-record", "--output", "file/t.csv")
    assert code == 1
    assert "cannot write" in capsys.readouterr().err


def test_a_ctrl_c_that_nobody_catches_is_one_line(
    run: Run, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("streamtrack.mosaic.running.run_mosaic", interrupted)
    assert run("mosaic", "a.png", "b.png", "-o", "m.png") == 1
    assert capsys.readouterr().err == "streamtrack: error: interrupted\n"


def test_version_and_help(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--version") == 0
    assert capsys.readouterr().out.startswith("streamtrack ")
    assert run("track", "--help") == 0
    assert "--target" in capsys.readouterr().out


def test_synth_then_track_finds_the_truth(run: Run, tmp_path: Path) -> None:
    assert run("synth", SCENE, "-o", "s.mkv", "--truth", "truth.csv") == 0
    truth = rows_of(tmp_path / "truth.csv")
    corners = [f"{axis}{i}" for i in range(1, 5) for axis in "xy"]
    quad = ",".join(truth[0][name] for name in corners)
    assert run("track", "s.mkv", "--target", quad, "--no-record", "-q", "--output", "t.csv") == 0
    for row, true in zip(rows_of(tmp_path / "t.csv"), truth, strict=True):
        errors = [abs(float(row[name]) - float(true[name])) for name in corners]
        assert max(errors) < 1.0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_closes_all_outputs(tmp_path: Path, target: str, number: int) -> None:
    scene = SCENE.replace("frames=24", "frames=100000")
    command = [sys.executable, "-m", "streamtrack.cli", "track", scene, "--target", target]
    outputs = ["--record", "r.rrd", "--output", "t.parquet", "--summary", "s.json"]
    process = subprocess.Popen(
        [*command, *outputs],
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    process.stderr.readline()  # the first progress line: the run is under way
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "interrupted after frame" in errors.splitlines()[-1]
    import pyarrow.parquet as pq
    from rerun.chunk import RrdReader

    frames = pq.read_table(tmp_path / "t.parquet").num_rows
    assert frames > 0
    assert json.loads((tmp_path / "s.json").read_text())["frames"] == frames
    assert RrdReader(tmp_path / "r.rrd").store() is not None


@pytest.mark.parametrize("arguments", [(), ("bench",)])
def test_without_a_command_the_help_is_shown(
    arguments: tuple[str, ...], run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*arguments) == 2
    assert capsys.readouterr().err.startswith("Usage:")


def test_interrupted_while_it_loads_it_ends_without_a_word() -> None:
    code = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # not ignored, as in a shell's background
class Interrupting:
    def find_spec(self, name, *_):
        if name == "streamtrack.cli.process":
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupting())
from streamtrack.__main__ import main
main()
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=60)
    assert (ended.returncode, ended.stdout, ended.stderr) == (-signal.SIGINT, b"", b"")


def test_a_live_view_of_pictures_is_refused_before_it_is_announced(
    tmp_path: Path, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(tmp_path / name), np.zeros((40, 60), np.uint8))
    assert run("mosaic", "a.png", "b.png", "-o", "m.png", "--live=") == 2
    said = capsys.readouterr()
    assert "--live" in said.err
    assert said.out == ""


def test_broken_pipe_ends_quietly(clip: Path, target: str, tmp_path: Path) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "streamtrack.cli", "track", str(clip), "--target", target]
    result = subprocess.run(
        [*command, "--no-record", "--output", "t.csv", "--frames", "3"],
        cwd=tmp_path,
        stdout=writer,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )
    os.close(writer)
    assert "Traceback" not in result.stderr
    assert len(rows_of(tmp_path / "t.csv")) == 3


@pytest.mark.parametrize(
    ("redirected", "code", "said"),
    [
        ("> /dev/full", 1, "no space left on device"),
        (">&-", 0, ""),
        ("2>&-", 0, ""),
        (">&- 2>&-", 0, ""),
    ],
)
def test_output_that_cannot_be_written_is_one_line(
    clip: Path, tmp_path: Path, redirected: str, code: int, said: str
) -> None:
    flags = f"track {clip} --no-record --poses p.csv --frames 3"
    command = f"exec {sys.executable} -m streamtrack.cli {flags} {redirected}"
    result = subprocess.run(
        command, shell=True, cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert result.returncode == code
    assert "Traceback" not in result.stderr and said in result.stderr
    assert len(rows_of(tmp_path / "p.csv")) == 3


@pytest.mark.parametrize(
    "flags",
    [
        ["--video", "{clip}"],
        ["--output", "same.csv", "--poses", "same.csv"],
        ["--record", "same.mkv"],
    ],
)
def test_no_output_replaces_the_source_or_another(
    run: Run, clip: Path, target: str, capsys: pytest.CaptureFixture[str], flags: list[str]
) -> None:
    before = clip.read_bytes()
    filled = [text.format(clip=clip) for text in flags]
    no_record = [] if "--record" in flags else ["--no-record"]
    for source in (clip, clip.as_uri()):
        assert run("track", source, "--target", target, *no_record, *filled) == 2
        assert clip.read_bytes() == before
    assert capsys.readouterr().err.startswith("streamtrack: error: ")


def test_two_runs_in_one_second_do_not_share_a_recording(
    run: Run, clip: Path, target: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("time.strftime", lambda _: "20260101-000000")
    for _ in range(2):
        assert run("track", clip, "--target", target, "--frames", 1, "--quiet") == 0
    names = sorted(p.name for p in (tmp_path / "recordings").iterdir())
    assert names == ["board-20260101-000000-2.rrd", "board-20260101-000000.rrd"]


def test_a_model_that_was_asked_for_is_the_one_reported(
    run: Run, clip: Path, target: str, tmp_path: Path
) -> None:
    flags = ("--model", "similarity", "--no-record", "-q", "--output", "t.csv", "--frames", 5)
    assert run("track", clip, "--target", target, *flags) == 0
    assert {row["model"] for row in rows_of(tmp_path / "t.csv")} <= {"similarity", ""}


def test_settings_that_are_no_sections_are_refused(
    run: Run, clip: Path, target: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "s.toml").write_text("features = 3\n")
    flags = ("--no-record", "--settings", "s.toml", "--detector", "fast")
    assert run("track", clip, "--target", target, *flags) == 2
    assert "features" in capsys.readouterr().err


def test_interrupted_synth_leaves_a_whole_file(tmp_path: Path) -> None:
    scene = SCENE.replace("frames=24", "frames=100000")
    command = [sys.executable, "-m", "streamtrack.cli", "synth", scene, "-o", "s.mp4"]
    process = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    while not (tmp_path / "s.mp4").exists():
        assert process.poll() is None
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "interrupted after" in errors
    from streamtrack.sources import open_source

    with open_source(tmp_path / "s.mp4") as source:
        assert sum(1 for _ in source) > 0
