"""Tables of camera poses."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from streamtrack.errors import OutputError
from streamtrack.geometry import translation
from streamtrack.poses import FinalPoses, PosesWriter
from streamtrack.types import Matrix, Skipped


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def matrix_of(row: dict[str, str]) -> Matrix:
    values = [float(row[f"h{i}{j}"]) for i in (1, 2, 3) for j in (1, 2, 3)]
    return np.array(values).reshape(3, 3)


def test_poses_read_back_exactly(tmp_path: Path) -> None:
    pose = translation(0.1, -1e6 / 3)
    pose[2, :2] = 1.23456789e-7, -3e-12
    path = tmp_path / "poses.csv"
    with PosesWriter(path) as writer:
        writer.write_pose(0, 'a,"b".png', 0.0, pose, "", 0.25)
        writer.write_pose(1, "", 1 / 30, None, "too few matches")
        writer.write_skipped(Skipped(2, "c.png", "not a picture, or broken"))
    rows = rows_of(path)
    assert list(rows[0])[:7] == ["frame", "name", "time_s", "status", "reason", "h11", "h12"]
    assert list(rows[0])[-2:] == ["h33", "world_sigma_px"]
    np.testing.assert_array_equal(matrix_of(rows[0]), pose)
    assert [(row["frame"], row["status"], row["reason"]) for row in rows] == [
        ("0", "used", ""),
        ("1", "skipped", "too few matches"),
        ("2", "skipped", "not a picture, or broken"),
    ]
    assert rows[0]["name"] == 'a,"b".png'
    assert [row["time_s"] for row in rows] == ["0.000000", "0.033333", ""]
    assert [row["world_sigma_px"] for row in rows] == ["0.250", "", ""]
    assert rows[1]["h11"] == rows[2]["h33"] == ""


def test_a_full_disk_is_told(tmp_path: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full")
    path = tmp_path / "poses.csv"
    path.symlink_to("/dev/full")
    with pytest.raises(OutputError, match="no space left"):
        PosesWriter(path)


class Moved:
    """Poses as they are known at the end."""

    def world_from_frame(self, index: int) -> Matrix | None:
        return None if index == 3 else translation(10.0 * index, 0.0)

    def sigma_px(self, index: int) -> float:
        return 0.25 * index


def test_final_poses_are_those_known_at_the_end(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    with PosesWriter(path) as writer:
        final = FinalPoses(writer, Moved())
        final.add(1, "one.png", 0.5, np.eye(3), "")
        final.add(2, "", 0.6, None, "blank")
        final.add(3, "", 0.7, np.eye(3), "")
        final.add(4, "", 0.8, None, "")
        assert rows_of(path) == []
        final.write()
    rows = rows_of(path)
    assert [(row["frame"], row["name"], row["time_s"], row["reason"]) for row in rows] == [
        ("1", "one.png", "0.500000", ""),
        ("2", "", "0.600000", "blank"),
        ("3", "", "0.700000", "its pose was given up later"),
        ("4", "", "0.800000", "its pose is not known"),
    ]
    np.testing.assert_array_equal(matrix_of(rows[0]), translation(10.0, 0.0))
    assert [row["status"] for row in rows] == ["used", "skipped", "skipped", "skipped"]
