"""Cameras that travel over a ground, and the car they follow.

Grounds are pictures whose pixels are the units of the plane; a view is ``frame_from_ground``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from streamtrack.geometry import translation
from streamtrack.sources.scenes.motion import Pose, Wave, eased, homography
from streamtrack.types import Matrix, Size

MatrixAt: TypeAlias = Callable[[float], Matrix]
LONGEST_LAP = 15_000.0
BEND_PX = 160.0
FLIGHT_ROLL = math.radians(6.0)
FLIGHT_ZOOM = math.log(1.08)


@dataclass(frozen=True, slots=True, eq=False)
class Lap:
    """A closed course (N, 2) with the length run at each of its points; it starts at its first."""

    points: npt.NDArray[np.float64]
    lengths: npt.NDArray[np.float64]

    @property
    def length(self) -> float:
        return float(self.lengths[-1])

    def at(self, run: float) -> tuple[float, float]:
        """Where one is after ``run`` px, lap after lap."""
        run %= self.length
        return (
            float(np.interp(run, self.lengths, self.points[:, 0])),
            float(np.interp(run, self.lengths, self.points[:, 1])),
        )


def mower_lap(length: float, lane_px: float) -> Lap:
    """A closed lawn-mower course of just that length, its lanes ``lane_px`` apart."""
    lanes = 2 if length < 5_000 else 4
    lane_px = min(lane_px, length / (4.0 * lanes))
    wanted = length
    lap = _rounded(_mower_corners(wanted, lanes, lane_px))
    for _ in range(5):
        wanted *= length / lap.length
        lap = _rounded(_mower_corners(wanted, lanes, lane_px))
    return Lap(lap.points * (length / lap.length), lap.lengths * (length / lap.length))


def _mower_corners(length: float, lanes: int, lane_px: float) -> npt.NDArray[np.float64]:
    """Corners of the course: up and down the lanes, and home along their left ends."""
    side = (lanes - 1) * lane_px
    run = max((length - 2.0 * side) / lanes, 8.0)
    corners = [(run / 2.0, 0.0)]
    for lane in range(lanes):
        ends = [(0.0, lane * lane_px), (run, lane * lane_px)]
        corners += ends[1:] if lane == 0 else (ends if lane % 2 == 0 else ends[::-1])
    corners.append((0.0, 0.0))
    return np.array(corners)


def _rounded(corners: npt.NDArray[np.float64]) -> Lap:
    """The closed polygon with its corners rounded by a running mean along its length."""
    closed = np.vstack([corners, corners[:1]])
    run = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(closed, axis=0).T))])
    count = max(int(run[-1] / 2.0), 64)
    even = np.linspace(0.0, run[-1], count, endpoint=False)
    points = np.column_stack([np.interp(even, run, closed[:, axis]) for axis in (0, 1)])
    half = max(int(min(BEND_PX, run[-1] / 16.0) / 2.0 / (run[-1] / count)), 1)
    for _ in range(2):
        points = _running_mean(points, half)
    points = np.vstack([points, points[:1]])
    lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    return Lap(points, lengths)


def _running_mean(points: npt.NDArray[np.float64], half: int) -> npt.NDArray[np.float64]:
    around = np.vstack([points[-half:], points, points[:half]])
    sums = np.cumsum(np.vstack([np.zeros((1, 2)), around]), axis=0)
    mean: npt.NDArray[np.float64] = (sums[2 * half + 1 :] - sums[: -2 * half - 1]) / (2 * half + 1)
    return mean


def flight_view(
    rng: np.random.Generator, size_wh: Size, frames: int, step: float
) -> tuple[MatrixAt, Size, tuple[float, float]]:
    """View of a closed flight at ``step`` px a frame, the ground's size, and its first centre."""
    total = max(step * eased(frames - 1), 64.0)
    laps = math.ceil(total / LONGEST_LAP)
    lap = mower_lap(total / laps, 0.62 * min(size_wh))
    margin = math.ceil(math.hypot(*size_wh) / 2.0 * 1.09) + 4
    low, high = lap.points.min(axis=0) - margin, lap.points.max(axis=0) + margin
    roll, zoom = Wave(rng, 95.0, 2), Wave(rng, 140.0, 2)
    middle = (size_wh[0] - 1) / 2.0, (size_wh[1] - 1) / 2.0

    def view(n: float) -> Matrix:
        tau = eased(n)
        x, y = lap.at(step * tau)
        pose = Pose(*middle, scale=math.exp(FLIGHT_ZOOM * zoom(tau)), roll=FLIGHT_ROLL * roll(tau))
        return homography(pose, (x - low[0], y - low[1]), size_wh)

    extent = np.ceil(high - low).astype(int)
    start = lap.at(0.0)
    return view, (int(extent[0]), int(extent[1])), (start[0] - low[0], start[1] - low[1])


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A car driving along x and a camera that follows it imperfectly."""

    frame_from_ground: MatrixAt
    ground_from_car: MatrixAt


def drive(
    rng: np.random.Generator,
    size_wh: Size,
    lane_y: float,
    lane_px: float,
    car_centre: tuple[float, float],
    car_scale: float,
) -> Drive:
    """A drive at about 7 px a frame with changes of lane; ``lane_px`` is a lane's width."""
    pace, weave = Wave(rng, 150.0), Wave(rng, 37.0, 2)
    lag_x, lag_y = Wave(rng, 90.0), Wave(rng, 70.0)
    roll, zoom, tilt = Wave(rng, 160.0), Wave(rng, 120.0), Wave(rng, 100.0)
    middle = (size_wh[0] - 1) / 2.0, (size_wh[1] - 1) / 2.0
    reach = 0.11 * min(size_wh)
    azimuth = rng.uniform(0.0, 2.0 * math.pi)

    def place(tau: float) -> tuple[float, float]:
        change = 0.5 - 0.5 * math.cos(2.0 * math.pi * tau / 220.0)
        y = lane_y - lane_px * change**2 * (3.0 - 2.0 * change) + 0.05 * lane_px * weave(tau)
        return size_wh[0] / 2.0 + 7.0 * tau + 60.0 * pace(tau), y

    def ground_from_car(n: float) -> Matrix:
        tau = eased(n)
        (x, y), (ahead_x, ahead_y) = place(tau), place(tau + 2.0)
        heading = math.atan2(ahead_y - y, ahead_x - x) if n > 0 else 0.0
        heading *= min(tau / 8.0, 1.0)
        c, s = car_scale * math.cos(heading), car_scale * math.sin(heading)
        turned = np.array([[c, -s, x], [s, c, y], [0.0, 0.0, 1.0]])
        matrix: Matrix = turned @ translation(-car_centre[0], -car_centre[1])
        return matrix

    def frame_from_ground(n: float) -> Matrix:
        tau = eased(n)
        x, _ = place(tau)
        looked_at = x + 1.3 * reach * lag_x(tau), lane_y - 0.5 * lane_px + reach * lag_y(tau)
        pose = Pose(
            *middle,
            scale=math.exp(0.11 * zoom(tau)),
            roll=math.radians(9.0) * roll(tau),
            tilt=math.radians(6.0) * tilt(tau),
            azimuth=azimuth,
        )
        return homography(pose, looked_at, size_wh)

    return Drive(frame_from_ground, ground_from_car)
