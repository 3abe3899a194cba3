"""Camera poses as a table: as they come, or all of them at the end of a run, as known then."""

from __future__ import annotations

import math
from array import array
from pathlib import Path
from typing import Protocol

from streamtrack.outputs import RecordFile, csv_line, encodable
from streamtrack.types import Matrix, Skipped

_COLUMNS = (
    *("frame", "name", "time_s", "status", "reason"),
    *(f"h{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3)),
    "world_sigma_px",
)
_GIVEN_UP = "its pose was given up later"


class PosesWriter(RecordFile):
    """CSV of camera poses: ``world_from_frame`` row by row, in full precision.

    ``world_sigma_px`` is the expected RMS error of the frame's corners in the world, empty where
    it is not known. Status is ``used``, or ``skipped`` with a reason and no matrix where the pose
    is not known.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, csv_line(_COLUMNS))

    def write_pose(
        self,
        index: int,
        name: str,
        time_s: float,
        world_from_frame: Matrix | None,
        reason: str,
        sigma_px: float = math.nan,
    ) -> None:
        """Add a frame's pose, or why it has none. Raises OutputError."""
        time_cell = f"{time_s:.6f}" if math.isfinite(time_s) else ""
        if world_from_frame is None:
            self._add(index, name, time_cell, "skipped", reason, [""] * 10)
        else:
            elements = [str(float(value)) for value in world_from_frame.ravel()]
            elements.append(f"{sigma_px:.3f}" if math.isfinite(sigma_px) else "")
            self._add(index, name, time_cell, "used", "", elements)

    def write_skipped(self, skipped: Skipped) -> None:
        """Add a picture that the source left out; its time is not known. Raises OutputError."""
        self._add(skipped.index, skipped.name, "", "skipped", skipped.reason, [""] * 10)

    def _add(
        self, index: int, name: str, time_s: str, status: str, reason: str, elements: list[str]
    ) -> None:
        cells = (str(index), encodable(name), time_s, status, encodable(reason), *elements)
        self.append(csv_line(cells))


class _Poses(Protocol):
    def world_from_frame(self, index: int) -> Matrix | None: ...

    def sigma_px(self, index: int) -> float: ...


class FinalPoses:
    """Rows of poses that may change until the end of a run; about 20 bytes a frame till then."""

    def __init__(self, writer: PosesWriter, poses: _Poses) -> None:
        self._writer = writer
        self._poses = poses
        self._indices, self._times_s, self._reasons = array("q"), array("d"), array("I")
        self._names: dict[int, str] = {}
        self._numbers = {"": 0}

    def add(
        self,
        index: int,
        name: str,
        time_s: float,
        world_from_frame: Matrix | None,
        reason: str,
        _sigma_px: float = math.nan,
    ) -> None:
        """Note a frame, as `PosesWriter.write_pose` would write it."""
        if world_from_frame is None and not reason:
            reason = "its pose is not known"
        self._indices.append(index)
        self._times_s.append(time_s)
        self._reasons.append(self._numbers.setdefault(reason, len(self._numbers)))
        if name:
            self._names[index] = name

    def write(self) -> None:
        """Write all rows with the poses as they are known now. Raises OutputError."""
        reasons = list(self._numbers)
        for index, time_s, number in zip(self._indices, self._times_s, self._reasons, strict=True):
            reason = reasons[number]
            pose = None if reason else self._poses.world_from_frame(index)
            reason = reason or ("" if pose is not None else _GIVEN_UP)
            name, sigma_px = self._names.get(index, ""), self._poses.sigma_px(index)
            self._writer.write_pose(index, name, time_s, pose, reason, sigma_px)
