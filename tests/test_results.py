"""Files of tracks and poses: read back what was written, and fail in one clear line."""

from __future__ import annotations

import csv
import errno
import json
import os
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from streamtrack import results
from streamtrack.errors import OutputError, UsageError
from streamtrack.geometry import box_quad
from streamtrack.outputs import output_error, write_file
from streamtrack.results import open_tracks_writer
from streamtrack.types import (
    CameraPose,
    Evidence,
    Frame,
    Model,
    Points,
    Step,
    Track,
    TrackState,
)

WORLD = [f"world_{axis}{corner}" for corner in "1234" for axis in "xy"]
WORLD += ["speed_px_s", "world_sigma_px"]
HEADER = ",".join(
    ["frame,time_s,target,state,x1,y1,x2,y2,x3,y3,x4,y4,model,matches,inliers,rmse_px", *WORLD]
)
ENDINGS = [".csv", ".jsonl", ".parquet", ".txt"]
NASTY = ['a,b "c"', "two\nlines", "car\rriage", "=cmd()", "žluť 漢", "a|b"]
IMAGE = np.zeros((8, 8, 3), np.uint8)


def _tracked(name: str = "board", quad: Points | None = None, rmse_px: float = 0.25) -> Track:
    points = np.zeros((3, 2), np.float32)
    evidence = Evidence(points, points, np.array([True, True, False]))
    quad = box_quad(1.0625, 2, 10, 20) if quad is None else quad
    return Track(name, TrackState.TRACKING, quad, np.eye(3), Model.AFFINE, evidence, rmse_px)


def _lost(name: str = "board") -> Track:
    return Track(name, TrackState.LOST, reason="too few matches")


def _step(index: int, *tracks: Track, camera: CameraPose | None = None, name: str = "") -> Step:
    frame = Frame(index, index / 30, IMAGE, name)
    return Step(frame, tracks, camera or CameraPose(np.eye(3)), None, {"total": 1.0})


def _write(path: Path, *steps: Step) -> Path:
    with open_tracks_writer(path) as writer:
        for step in steps:
            writer.write(step)
    return path


def _read_csv(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_csv_holds_one_row_a_target_a_frame(tmp_path: Path) -> None:
    path = _write(tmp_path / "tracks.csv", _step(0, _tracked(), _lost("car")), _step(7, _lost()))
    assert path.read_text().splitlines() == [
        HEADER,
        "0,0.000000,board,tracking,1.062,2.000,11.062,2.000,11.062,22.000,1.062,22.000,"
        "affine,3,2,0.2500,,,,,,,,,,",
        "0,0.000000,car,lost,,,,,,,,,,0,0,,,,,,,,,,,",
        "7,0.233333,board,lost,,,,,,,,,,0,0,,,,,,,,,,,",
    ]


@pytest.mark.parametrize("name", NASTY)
def test_csv_reads_back_any_name(tmp_path: Path, name: str) -> None:
    path = _write(tmp_path / "tracks.csv", _step(0, _tracked(name)), _step(1, _lost(name)))
    rows = _read_csv(path)
    assert [row["target"] for row in rows] == [name, name]
    assert [row["state"] for row in rows] == ["tracking", "lost"]
    assert rows[1]["rmse_px"] == ""


@pytest.mark.parametrize("ending", [".csv", ".jsonl", ".parquet"])
def test_undecodable_bytes_of_a_name_do_not_stop_the_run(tmp_path: Path, ending: str) -> None:
    _write(tmp_path / f"t{ending}", _step(0, _tracked("caf\udce9")))


def test_json_lines_hold_the_same_keys_and_null(tmp_path: Path) -> None:
    path = _write(tmp_path / "t.jsonl", _step(3, _tracked(NASTY[0]), _lost(NASTY[1])))
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    assert [list(row) for row in rows] == [HEADER.split(",")] * 2
    assert rows[0]["target"] == NASTY[0]
    assert (rows[0]["time_s"], rows[0]["rmse_px"], rows[0]["x3"]) == (0.1, 0.25, 11.062)
    empty = {key for key, value in rows[1].items() if value is None}
    corners = {"x1", "y1", "x2", "y2", "x3", "y3", "x4", "y4"}
    assert empty == {*corners, "model", "rmse_px", *WORLD}


def test_parquet_reads_back_with_nulls(tmp_path: Path) -> None:
    path = _write(tmp_path / "t.parquet", _step(0, _tracked(NASTY[1]), _lost("car")))
    table = pq.read_table(path)
    assert table.column_names == HEADER.split(",")
    first, second = table.to_pylist()
    assert (first["target"], first["state"], first["model"]) == (NASTY[1], "tracking", "affine")
    assert (first["x1"], first["matches"], first["inliers"]) == (1.0625, 3, 2)
    assert [second[key] for key in ("x1", "y4", "model", "rmse_px")] == [None] * 4
    assert pq.ParquetFile(path).metadata.row_group(0).column(0).compression == "ZSTD"


def test_parquet_memory_is_bounded_by_row_groups(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(results, "_BATCH_ROWS", 10)
    monkeypatch.setattr(results, "_GROUP_BATCHES", 3)
    path = _write(tmp_path / "t.parquet", *(_step(i, _tracked()) for i in range(95)))
    metadata = pq.ParquetFile(path).metadata
    assert [metadata.row_group(i).num_rows for i in range(4)] == [30, 30, 30, 5]
    assert pq.read_table(path)["frame"].to_pylist() == list(range(95))


def test_mot_text_boxes_tracked_targets_only(tmp_path: Path) -> None:
    turned = np.array([[5, 0], [10, 5], [5, 10], [0, 5]], np.float32)
    steps = [_step(0, _lost("a"), _tracked("b", turned)), _step(1, _tracked("a", turned + 0.5))]
    assert _write(tmp_path / "t.txt", *steps).read_text().splitlines() == [
        "1,2,0.000,0.000,10.000,10.000,1,-1,-1,-1",
        "2,1,0.500,0.500,10.000,10.000,1,-1,-1,-1",
    ]


@pytest.mark.parametrize("ending", ENDINGS)
def test_what_is_not_finite_is_left_empty(tmp_path: Path, ending: str) -> None:
    quad = np.full((4, 2), np.nan, np.float32)
    far = np.full((4, 2), 3e38, np.float32)
    path = tmp_path / f"t{ending}"
    _write(path, _step(0, _tracked(quad=quad), _tracked("n", rmse_px=np.nan), _tracked("f", far)))
    if ending == ".csv":
        rows = _read_csv(path)
        assert [row["rmse_px"] for row in rows] == ["", "", "0.2500"]
        assert rows[0]["x1"] == ""
    elif ending == ".jsonl":
        records = [json.loads(line) for line in path.read_text().splitlines()]
        assert [record["rmse_px"] for record in records] == [None, None, 0.25]
    assert b"nan" not in path.read_bytes().lower() or ending == ".parquet"


@pytest.mark.parametrize("ending", [*ENDINGS, ".CSV"])
def test_a_run_without_frames_leaves_a_valid_file_in_a_new_folder(
    tmp_path: Path, ending: str
) -> None:
    path = _write(tmp_path / "new" / "folder" / f"t{ending}")
    if ending == ".parquet":
        assert pq.read_table(path).num_rows == 0
    else:
        assert path.read_text().strip() == (HEADER if ending.lower() == ".csv" else "")


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_run_that_fails_leaves_a_complete_file(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"t{ending}"
    with pytest.raises(RuntimeError, match="camera"), open_tracks_writer(path) as writer:
        writer.write(_step(0, _tracked()))
        raise RuntimeError("camera")
    rows = pq.read_table(path).num_rows if ending == ".parquet" else path.read_text().count("\n")
    assert rows == (2 if ending == ".csv" else 1)


@pytest.mark.parametrize("ending", [".csv", ".jsonl", ".txt"])
def test_rows_are_on_disk_before_closing(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"t{ending}"
    with open_tracks_writer(path) as writer:
        writer.write(_step(0, _tracked()))
        killed_now = path.read_bytes()
    assert killed_now == path.read_bytes()
    assert killed_now.endswith(b"\n")


@pytest.mark.parametrize("name", ["t.xls", "t", ".csv", "t.csv.gz"])
def test_unknown_endings_are_refused_with_the_known_ones(tmp_path: Path, name: str) -> None:
    with pytest.raises(UsageError, match=r"\.csv, \.jsonl, \.parquet, \.txt"):
        open_tracks_writer(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_folder_or_a_file_in_the_way_is_named(tmp_path: Path, ending: str) -> None:
    folder = tmp_path / f"folder{ending}"
    folder.mkdir()
    with pytest.raises(OutputError, match=rf"folder\{ending}: this is a folder; name a file"):
        open_tracks_writer(folder)
    (tmp_path / "file").touch()
    for path in (tmp_path / "file" / f"t{ending}", tmp_path / "file" / "deep" / f"t{ending}"):
        with pytest.raises(OutputError, match="a file stands where its folder should be"):
            open_tracks_writer(path)


def _full(folder: Path, ending: str) -> Path:
    path = folder / f"full{ending}"
    path.symlink_to("/dev/full")
    return path


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_full_disk_is_an_output_error(tmp_path: Path, ending: str) -> None:
    path = _full(tmp_path, ending)
    with pytest.raises(OutputError, match=rf"full\{ending}: no space left on the disk; free some"):
        _write(path, _step(0, _tracked()))


def test_a_full_disk_in_the_middle_of_parquet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(results, "_BATCH_ROWS", 2000)
    monkeypatch.setattr(results, "_GROUP_BATCHES", 1)
    rng = np.random.default_rng(1)
    tracks = [_tracked(quad=rng.random((4, 2), np.float32)) for _ in range(2000)]
    with (
        pytest.raises(OutputError, match="no space left"),
        open_tracks_writer(_full(tmp_path, ".parquet")) as writer,
    ):
        writer.write(_step(0, *tracks))
    with pytest.raises(ValueError, match="is closed"):
        writer.write(_step(1, _tracked()))


def test_a_record_cut_by_a_full_disk_is_taken_back(tmp_path: Path) -> None:
    resource = pytest.importorskip("resource")
    signal = pytest.importorskip("signal")
    path = tmp_path / "t.csv"
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        with pytest.raises(OutputError, match="too large"), open_tracks_writer(path) as writer:
            resource.setrlimit(resource.RLIMIT_FSIZE, (620, limit[1]))
            for index in range(100):
                writer.write(_step(index, _tracked()))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
        signal.signal(signal.SIGXFSZ, handler)
    assert [row["rmse_px"] for row in _read_csv(path)] == ["0.2500"] * 4
    assert path.read_bytes().endswith(b"\n")


def test_an_error_while_closing_does_not_hide_the_first_one(tmp_path: Path) -> None:
    with (
        pytest.raises(RuntimeError, match="camera") as caught,
        open_tracks_writer(_full(tmp_path, ".parquet")) as writer,
    ):
        writer.write(_step(0, _tracked()))
        raise RuntimeError("camera")
    assert "no space left" in caught.value.__notes__[0]


@pytest.mark.parametrize("ending", ENDINGS)
def test_closing_twice_does_no_harm(tmp_path: Path, ending: str) -> None:
    writer = open_tracks_writer(tmp_path / f"t{ending}")
    writer.close()
    writer.close()


@pytest.mark.parametrize(
    ("number", "advice"),
    [
        (errno.EACCES, "permission denied; choose a place that you may write to"),
        (errno.EROFS, "read-only"),
        (errno.EIO, "Input/output error; choose another file"),
    ],
)
def test_output_errors_say_what_to_do(number: int, advice: str) -> None:
    message = str(output_error(Path("out/t.csv"), OSError(number, os.strerror(number))))
    assert message.startswith("cannot write out/t.csv: ")
    assert advice in message
    assert "\n" not in message


def test_whole_files_are_replaced_or_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "deep" / "s.json"
    write_file(path, b"one")
    assert path.read_bytes() == b"one"

    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, "no space")

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(OutputError, match="no space left"):
        write_file(path, b"two")
    assert path.read_bytes() == b"one"
    assert [entry.name for entry in path.parent.iterdir()] == ["s.json"]


def test_whole_files_never_replace_a_device(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="no space left"):
        write_file(_full(tmp_path, ".json"), b"data")
    assert Path("/dev/full").is_char_device()
    with pytest.raises(OutputError, match="this is a folder"):
        write_file(tmp_path, b"data")
