"""Smooth seeded motion: where a plane is at any moment, and the homography that follows from it.

Moments are frame numbers ``n`` as real numbers, so that a scene moves alike at any frame rate.
A path is a function from such a moment to a `Pose`. Every path stands still before frame 0 and
starts gently, so that frame 0 is sharp whatever the exposure.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from streamtrack.geometry import normalized, translation
from streamtrack.types import Matrix, Size

TAU = 2.0 * math.pi
EASE_FRAMES = 8.0
FOCAL_PER_WIDTH = 1.2


@dataclass(frozen=True, slots=True)
class Pose:
    """A plane before the camera.

    ``x, y``           px, where the centre of the plane's picture is seen
    ``scale``          pixels of the frame per unit of the plane, seen at right angles
    ``roll``           rad, turn in the plane, clockwise on the screen
    ``tilt, azimuth``  rad, lean about the axis in the frame that ``azimuth`` gives
    """

    x: float
    y: float
    scale: float = 1.0
    roll: float = 0.0
    tilt: float = 0.0
    azimuth: float = 0.0


Path: TypeAlias = Callable[[float], Pose]


def stream(seed: int, purpose: str) -> np.random.Generator:
    """A generator of its own for each purpose, so that one draw more changes nothing else."""
    return np.random.default_rng([seed, zlib.crc32(purpose.encode())])


def eased(n: float) -> float:
    """Time that stands still until frame 0 and soon runs at full speed."""
    return n - EASE_FRAMES * (1.0 - math.exp(-n / EASE_FRAMES)) if n > 0 else 0.0


def smooth_step(x: float) -> float:
    """0 up to x = 0, 1 from x = 1 on, twice differentiable between."""
    x = min(max(x, 0.0), 1.0)
    return x * x * x * (x * (6.0 * x - 15.0) + 10.0)


def _rotation(pose: Pose) -> Matrix:
    """Roll in the plane, then tilt about an axis in the frame (Rodrigues)."""
    kx, ky = math.cos(pose.azimuth), math.sin(pose.azimuth)
    skew = np.array([[0.0, 0.0, ky], [0.0, 0.0, -kx], [-ky, kx, 0.0]])
    lean = np.eye(3) + math.sin(pose.tilt) * skew + (1.0 - math.cos(pose.tilt)) * (skew @ skew)
    c, s = math.cos(pose.roll), math.sin(pose.roll)
    turned: Matrix = lean @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return turned


def homography(pose: Pose, centre_xy: tuple[float, float], size_wh: Size) -> Matrix:
    """frame_from_plane of a pinhole camera; ``centre_xy`` is the plane's point seen at (x, y)."""
    focal = FOCAL_PER_WIDTH * max(size_wh)
    px, py = (size_wh[0] - 1) / 2.0, (size_wh[1] - 1) / 2.0
    rotation = _rotation(pose)
    depth = focal / pose.scale
    shift = np.array([(pose.x - px) / pose.scale, (pose.y - py) / pose.scale, depth])
    camera = np.array([[focal, 0.0, px], [0.0, focal, py], [0.0, 0.0, 1.0]])
    pinhole: Matrix = camera @ np.column_stack([rotation[:, 0], rotation[:, 1], shift])
    matrix: Matrix = pinhole @ translation(-centre_xy[0], -centre_xy[1])
    return normalized(matrix)


class Wave:
    """A smooth random function of eased time, 0 at 0 and within -1..1: a sum of sinusoids."""

    def __init__(self, rng: np.random.Generator, period: float, terms: int = 3) -> None:
        self.periods = period * np.array([1.0, 0.61, 0.37])[:terms] * rng.uniform(0.9, 1.1, terms)
        weights = np.array([1.0, 0.45, 0.2])[:terms] * rng.choice([-1.0, 1.0], terms)
        self.weights = weights / np.abs(weights).sum()

    def __call__(self, tau: float) -> float:
        return float(self.weights @ np.sin(TAU * tau / self.periods))


@dataclass(frozen=True, slots=True)
class Reach:
    """How far a wandering plane goes: shift in shares of the frame, angles in degrees."""

    shift: float = 0.1
    scale: tuple[float, float] = (0.85, 1.15)
    roll: float = 15.0
    tilt: float = 14.0
    turns: float = 0.0
    period: float = 130.0


def wander(rng: np.random.Generator, size_wh: Size, reach: Reach) -> Path:
    """The plane drifts about the middle of the frame; ``turns`` are full turns per period."""
    width, height = size_wh
    dx, dy = Wave(rng, reach.period), Wave(rng, 0.83 * reach.period)
    roll = Wave(rng, 1.07 * reach.period)
    scale = _scale_wave(rng, reach)
    spin = TAU * reach.turns / reach.period * float(rng.choice([-1.0, 1.0]))
    azimuth, turn = rng.uniform(0.0, TAU), TAU / (2.6 * reach.period)

    def path(n: float) -> Pose:
        tau = eased(n)
        lean = 0.5 - 0.5 * math.cos(TAU * tau / (0.92 * reach.period))
        return Pose(
            x=(width - 1) / 2.0 + reach.shift * width * dx(tau),
            y=(height - 1) / 2.0 + reach.shift * height * dy(tau),
            scale=scale(tau),
            roll=math.radians(reach.roll) * roll(tau) + spin * tau,
            tilt=math.radians(reach.tilt) * lean,
            azimuth=azimuth + turn * tau,
        )

    return path


def _scale_wave(rng: np.random.Generator, reach: Reach) -> Callable[[float], float]:
    """From 1 through the whole range of scales and back, evenly in the logarithm."""
    low, high = math.log(reach.scale[0]), math.log(reach.scale[1])
    middle, half = (low + high) / 2.0, (high - low) / 2.0
    start = math.asin(-middle / half) if half > 0 else 0.0
    if rng.random() < 0.5:
        start = math.pi - start
    return lambda tau: math.exp(middle + half * math.sin(TAU * tau / (1.15 * reach.period) + start))


def shaken(path: Path, rng: np.random.Generator, reach_px: float, period: float) -> Path:
    """Add fast shaking that swells and dies down."""
    px, py = period * rng.uniform(0.92, 1.08), 1.31 * period * rng.uniform(0.92, 1.08)
    swell = 5.3 * period

    def shaking(n: float) -> Pose:
        pose, tau = path(n), eased(n)
        strength = reach_px * (0.62 - 0.38 * math.cos(TAU * tau / swell))
        dx = strength * math.sin(TAU * tau / px)
        dy = 0.6 * strength * math.sin(TAU * tau / py)
        return replace(pose, x=pose.x + dx, y=pose.y + dy)

    return shaking


def racing(path: Path, rng: np.random.Generator, radius: float, step: float) -> Path:
    """Add a run round a circle at ``step`` px a frame, starting at the middle."""
    start = rng.uniform(0.0, TAU)
    sense = float(rng.choice([-1.0, 1.0]))

    def race(n: float) -> Pose:
        pose, tau = path(n), eased(n)
        grown = radius * smooth_step(tau / 12.0)
        angle = start + sense * step / radius * tau
        return replace(pose, x=pose.x + grown * math.cos(angle), y=pose.y + grown * math.sin(angle))

    return race


def excursions(
    path: Path, rng: np.random.Generator, size_wh: Size, beyond_px: float, period: float
) -> Path:
    """Now and then the plane's centre goes ``beyond_px`` past an edge of the frame and returns."""
    first = int(rng.integers(4))

    def roam(n: float) -> Pose:
        pose, tau = path(n), eased(n)
        turn, phase = divmod(tau / period, 1.0)
        away = 0.5 - 0.5 * math.cos(TAU * phase)
        edge = (first + 3 * int(turn)) % 4
        goal_x = (-beyond_px, pose.x, size_wh[0] - 1 + beyond_px, pose.x)[edge]
        goal_y = (pose.y, size_wh[1] - 1 + beyond_px, pose.y, -beyond_px)[edge]
        return replace(
            pose, x=pose.x + away * (goal_x - pose.x), y=pose.y + away * (goal_y - pose.y)
        )

    return roam


def absences(
    path: Path, seed: int, size_wh: Size, radius: float, turn: float, period: float = 150.0
) -> Path:
    """Once a period the plane goes wholly out of view, and back elsewhere and turned by ``turn``.

    It leaves to a circle of ``radius`` round the middle, runs along it and comes in again.
    """
    middle = (size_wh[0] - 1) / 2.0, (size_wh[1] - 1) / 2.0

    def home(visit: int) -> tuple[float, float, float]:
        if visit == 0:
            return 0.0, 0.0, 0.0
        draw = stream(seed, f"absence {visit}").uniform(-1.0, 1.0, 2)
        return 0.14 * size_wh[0] * draw[0], 0.12 * size_wh[1] * draw[1], turn * visit

    def leaving_angle(visit: int) -> float:
        return float(stream(seed, f"leaving {visit}").uniform(0.0, TAU))

    def roam(n: float) -> Pose:
        pose, tau = path(n), eased(n)
        turns, phase = divmod(tau / period, 1.0)
        visit = int(turns)
        out = smooth_step((phase - 0.25) / 0.2) - smooth_step((phase - 0.7) / 0.2)
        change = smooth_step((phase - 0.45) / 0.25)
        before, after = home(visit), home(visit + 1)
        dx, dy, roll = (a + change * (b - a) for a, b in zip(before, after, strict=True))
        angle = leaving_angle(visit) + 2.0 * change
        return replace(
            pose,
            x=pose.x + (1.0 - out) * dx + out * (middle[0] - pose.x + radius * math.cos(angle)),
            y=pose.y + (1.0 - out) * dy + out * (middle[1] - pose.y + radius * math.sin(angle)),
            roll=pose.roll + roll,
        )

    return roam
