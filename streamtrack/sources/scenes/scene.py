"""A scene: planes with pictures on them, how they move, and how the light falls."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.geometry import inverted, transform_points
from streamtrack.sources.scenes.motion import Pose, Wave, eased, homography, smooth_step, stream
from streamtrack.sources.scenes.rendering import Floats, Ground, Sprite
from streamtrack.sources.scenes.travel import MatrixAt
from streamtrack.types import Image, Matrix, Points, Size

GRID = 64


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """A sprite that moves before everything below it."""

    sprite: Sprite
    frame_from_sprite: MatrixAt


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """All that is needed to render any moment and to tell the truth about it.

    The backdrop, painted when first asked for, is a picture of the size of the frame if the camera
    is fixed, else a ground with its view. ``target`` is None where the target is part of the
    ground; ``others`` are further things that move, over the target and below the occluders.
    ``exposure`` is a share of the time between frames.
    """

    size_wh: Size
    target_quad: Points
    frame_from_target: MatrixAt
    backdrop: Callable[[], Image | Ground]
    frame_from_ground: MatrixAt | None
    target: Sprite | None
    occluders: tuple[Layer, ...]
    light: Light | None
    exposure: float
    noise: float
    others: tuple[Layer, ...] = ()

    def world_from_frame(self, n: float) -> Matrix:
        """World is the pixel frame of frame 0."""
        if self.frame_from_ground is None:
            return np.eye(3)
        first, now = self.frame_from_ground(0.0), self.frame_from_ground(n)
        return geometry.normalized(first @ np.linalg.inv(now))

    def layers(self) -> tuple[Layer, ...]:
        """What lies over the backdrop, from the bottom up."""
        return (*self.things(), *self.occluders)

    def things(self) -> tuple[Layer, ...]:
        """What moves by itself and is no mere occluder: the target, then the others."""
        if self.target is None:
            return self.others
        return (Layer(self.target, self.frame_from_target), *self.others)

    def visible_share(self, n: float) -> float:
        """Share of the target's area in the frame that is in view and not occluded."""
        above = (*self.others, *self.occluders)
        return self._shown(self.frame_from_target, self.target_quad, above, n)

    def thing_visible_share(self, thing: int, n: float) -> float:
        """The same of one of the `things`."""
        layers = self.layers()
        layer = layers[thing]
        return self._shown(layer.frame_from_sprite, layer.sprite.quad, layers[thing + 1 :], n)

    def _shown(
        self, frame_from_thing: MatrixAt, own_quad: Points, above: tuple[Layer, ...], n: float
    ) -> float:
        matrix = frame_from_thing(n)
        in_view = geometry.visible_share(transform_points(matrix, own_quad), self.size_wh)
        if not above or in_view == 0:
            return in_view
        points, weights = _weighted_grid(own_quad, matrix)
        inside = (points > -0.5) & (points < np.array(self.size_wh) - 0.5)
        is_hidden = covered(above, points, n) & inside.all(axis=1)
        return max(in_view - float(weights[is_hidden].sum()), 0.0)


def _weighted_grid(
    quad: Points, frame_from_target: Matrix
) -> tuple[Points, npt.NDArray[np.float64]]:
    """Points spread evenly over the target, seen in the frame, and their shares of its area."""
    steps = (np.arange(GRID) + 0.5) / GRID
    across, down = np.meshgrid(steps, steps)
    flat = quad[0] + across.reshape(-1, 1) * (quad[1] - quad[0])
    flat = flat + down.reshape(-1, 1) * (quad[3] - quad[0])
    weights = np.abs(geometry.projective_depths(frame_from_target, flat)) ** -3.0
    return transform_points(frame_from_target, flat), weights / weights.sum()


def covered(layers: tuple[Layer, ...], points: Points, n: float) -> npt.NDArray[np.bool_]:
    """Which points (N, 2) of the frame any of the layers hides."""
    hidden = np.zeros(len(points), np.bool_)
    for layer in layers:
        there = transform_points(inverted(layer.frame_from_sprite(n)), points)
        hidden |= layer.sprite.covers(there)
    return hidden


@dataclass(frozen=True, slots=True)
class Pass:
    """When and how an occluder goes before the target: once in ``period`` frames from ``start``.

    It comes within ``share`` of covering the target and stays there for ``dwell`` frames.
    """

    share: float
    start: float = 30.0
    period: float = 110.0
    dwell: float = 12.0
    travel: float = 30.0


class Passing:
    """The motion of an occluder: from out of view to before the target and back, again and again.

    It heads for where the target will be in the middle of its stay and moves on its own.
    """

    def __init__(
        self, seed: int, sprite: Sprite, target_quad: Points, target: MatrixAt, size_wh: Size,
        plan: Pass,
    ) -> None:  # fmt: skip
        self.seed, self.sprite, self.plan = seed, sprite, plan
        self.target_quad, self.target, self.size_wh = target_quad, target, size_wh
        self.goals: dict[int, tuple[float, float, float, float, float]] = {}

    def __call__(self, n: float) -> Matrix:
        plan = self.plan
        visit = max(math.floor((n - plan.start) / plan.period), 0)
        x, y, angle, near, far = self._goal(visit)
        since = n - plan.start - visit * plan.period
        leave = since - plan.travel - plan.dwell
        away = 1.0 - smooth_step(since / plan.travel) + smooth_step(leave / plan.travel)
        sway = smooth_step(since / plan.travel) * math.sin(0.21 * since) * 0.02
        return self._matrix(x, y, angle, near + away * (far - near), sway)

    def _matrix(self, x: float, y: float, angle: float, away: float, sway: float) -> Matrix:
        width, height = self.sprite.size_wh
        pose = Pose(
            x=x + away * math.cos(angle),
            y=y + away * math.sin(angle),
            roll=angle + sway,
        )
        return homography(pose, ((width - 1) / 2.0, (height - 1) / 2.0), self.size_wh)

    def _goal(self, visit: int) -> tuple[float, float, float, float, float]:
        """Where the target then is, the side to come from, and how near and how far to go."""
        if visit not in self.goals:
            if len(self.goals) > 64:
                self.goals.clear()
            middle_of_stay = (
                self.plan.start
                + visit * self.plan.period
                + self.plan.travel
                + self.plan.dwell / 2.0
            )
            matrix = self.target(middle_of_stay)
            points, weights = _weighted_grid(self.target_quad, matrix)
            x, y = (float(v) for v in points.mean(axis=0))
            angle = float(stream(self.seed, f"pass {visit}").uniform(0.0, 2.0 * math.pi))
            far = self._far(x, y)
            near = self._nearest((x, y, angle, far), points, weights)
            self.goals[visit] = (x, y, angle, near, far)
        return self.goals[visit]

    def _far(self, x: float, y: float) -> float:
        """A distance at which the occluder is out of view on whichever side."""
        width, height = self.size_wh
        aside = math.hypot(x - width / 2.0, y - height / 2.0)
        return aside + (math.hypot(width, height) + math.hypot(*self.sprite.size_wh)) / 2.0 + 40.0

    def _nearest(
        self,
        course: tuple[float, float, float, float],
        points: Points,
        weights: npt.NDArray[np.float64],
    ) -> float:
        """The distance at which just the planned share is covered, by bisection."""
        if self.plan.share >= 1.0:
            return 0.0
        x, y, angle, far = course
        low, high = 0.0, far
        for _ in range(14):
            middle = (low + high) / 2.0
            sprite_from_frame = inverted(self._matrix(x, y, angle, middle, 0.0))
            hidden = self.sprite.covers(transform_points(sprite_from_frame, points))
            is_covering_more = float(weights[hidden].sum()) > self.plan.share
            low, high = (middle, high) if is_covering_more else (low, middle)
        return high


class Light:
    """Illumination that changes over time: gain, offset, a slope across, a moving highlight."""

    def __init__(
        self, rng: np.random.Generator, size_wh: Size, amplitude: float, dimming: float = 1.0
    ) -> None:
        self.size_wh, self.amplitude, self.dimming = size_wh, amplitude, dimming
        self.gain, self.offset = Wave(rng, 70.0), Wave(rng, 53.0)
        self.slope_x, self.slope_y = Wave(rng, 110.0), Wave(rng, 95.0)
        self.spot_x, self.spot_y = Wave(rng, 120.0, 2), Wave(rng, 90.0, 2)
        y, x = np.mgrid[0:24, 0:32].astype(np.float32)
        self.x, self.y = x / 15.5 - 1.0, y / 11.5 - 1.0

    def apply(self, picture: Floats, n: float) -> None:
        """Light a float32 picture in place."""
        if self.amplitude == 0:
            picture *= self.dimming
            return
        tau = eased(n)
        slope = 0.6 * (self.slope_x(tau) * self.x + self.slope_y(tau) * self.y)
        factor = np.exp(self.amplitude * (0.75 * self.gain(tau) + slope)) * self.dimming
        away = (self.x - self.spot_x(tau)) ** 2 + (self.y - self.spot_y(tau)) ** 2
        shine = 150.0 * self.amplitude * smooth_step(tau / 25.0) * np.exp(-away / 0.09)
        added = shine + 34.0 * self.amplitude * self.offset(tau)
        picture *= self._large(factor)
        picture += self._large(added)

    def _large(self, field: npt.NDArray[np.floating]) -> Floats:
        large = cv2.resize(field.astype(np.float32), self.size_wh, interpolation=cv2.INTER_LINEAR)
        return np.asarray(cv2.cvtColor(large, cv2.COLOR_GRAY2BGR), np.float32)
