"""Traffic seen from above: cars that enter, stop, pass each other and leave, and things that cross.

Cars of one lane keep their distance and stop together, each lane at times of its own. Every fifth
thing is small, slow and goes straight across the road, before or behind the cars.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from streamtrack.geometry import normalized, translation
from streamtrack.sources.scenes import roadside
from streamtrack.sources.scenes.motion import Pose, Wave, eased, homography, smooth_step, stream
from streamtrack.sources.scenes.rendering import Sprite
from streamtrack.sources.scenes.scene import Layer
from streamtrack.sources.scenes.travel import MatrixAt
from streamtrack.types import Matrix, Size

LANES = 4
CROSSING_EVERY = 5
CAR_PER_LANE = 1.75  # length against the lane's width
SMALL = 0.5
BRIDGE_PX = 46.0


@dataclass(frozen=True, slots=True)
class Road:
    """Where the lanes are on the ground: the middle's height, and a lane's width."""

    middle_y: float
    lane_px: float

    def lane_y(self, lane: int) -> float:
        return self.middle_y + (lane - (LANES - 1) / 2) * self.lane_px

    @staticmethod
    def direction(lane: int) -> float:
        """Right (1) on the near side, left (-1) on the far side."""
        return 1.0 if lane >= LANES // 2 else -1.0


def camera_over(seed: int, size_wh: Size, road: Road, is_moving: bool) -> MatrixAt:
    """frame_from_ground of a camera that stands, or that goes along the road by and by."""
    middle = (size_wh[0] - 1) / 2.0, (size_wh[1] - 1) / 2.0
    if not is_moving:
        fixed = homography(Pose(*middle), (size_wh[0] / 2.0, road.middle_y), size_wh)
        return lambda _: fixed
    rng = stream(seed, "camera")
    sway_x, sway_y, roll = Wave(rng, 130.0), Wave(rng, 75.0), Wave(rng, 170.0)
    zoom, tilt = Wave(rng, 120.0), Wave(rng, 100.0)
    azimuth = rng.uniform(0.0, 2.0 * math.pi)
    pace = float(rng.uniform(2.0, 4.0) * rng.choice([-1.0, 1.0]))

    def view(n: float) -> Matrix:
        tau = eased(n)
        pose = Pose(
            *middle,
            scale=math.exp(0.08 * zoom(tau)),
            roll=math.radians(5.0) * roll(tau),
            tilt=math.radians(4.0) * tilt(tau),
            azimuth=azimuth,
        )
        x = size_wh[0] / 2.0 + pace * tau + 90.0 * sway_x(tau)
        return homography(pose, (x, road.middle_y + 0.08 * size_wh[1] * sway_y(tau)), size_wh)

    return view


class Lane:
    """How far the cars of one lane have come, in px; they stop once in a while."""

    def __init__(self, seed: int, lane: int) -> None:
        rng = stream(seed, f"lane {lane}")
        self.speed = float(rng.uniform(3.0, 6.5))
        self.first_stop = float(rng.uniform(70.0, 160.0))
        self.stop = float(rng.uniform(25.0, 50.0))
        self.period = float(rng.uniform(190.0, 260.0))

    def run(self, n: float) -> float:
        if n < 0:
            return self.speed * n
        stops, since = divmod(max(n - self.first_stop, 0.0), self.period)
        whole = self.stop + 20.0
        lost = stops * whole + whole * smooth_step(since / (2.0 * whole))
        return self.speed * (n - 0.9 * lost)


def cars_on(
    seed: int, road: Road, frames: int, size_wh: Size, view: MatrixAt, count: int
) -> tuple[Layer, ...]:
    """The cars and what crosses, the lowest first; all are in view at some time.

    The first stands in the middle of frame 0.
    """
    lanes = [Lane(seed, lane) for lane in range(LANES)]
    starts: list[list[tuple[float, int]]] = [[] for _ in range(LANES)]
    crossing: list[int] = []
    for number in range(count):
        if number % CROSSING_EVERY == CROSSING_EVERY - 1:
            crossing.append(number)
            continue
        rng = stream(seed, f"place {number}")
        lane = (number + LANES // 2) % LANES
        if number == 0:
            starts[lane].append((_looked_at(view, 0.0, size_wh), number))
            continue
        met = float(rng.uniform(-0.05, 1.0)) * frames
        x = _looked_at(view, met, size_wh) + float(rng.uniform(-0.45, 0.45)) * size_wh[0]
        starts[lane].append((x - road.direction(lane) * lanes[lane].run(met), number))
    layers: list[Layer] = []
    for lane in (*range(LANES // 2, LANES), *range(LANES // 2)):
        for x, number in _apart(starts[lane], 1.5 * CAR_PER_LANE * road.lane_px):
            layers.append(_car(seed, number, road, (lane, lanes[lane], x), view))
    layers += [_crossing(seed, n, road, frames, size_wh, view) for n in crossing]
    return tuple(layers)


def _apart(places: list[tuple[float, int]], gap_px: float) -> list[tuple[float, int]]:
    """Places along a lane with their numbers, moved away from the first until none are too near."""
    if not places:
        return []
    kept = [places[0]]
    right = left = places[0][0]
    for x, number in sorted(place for place in places[1:] if place[0] >= right):
        right = max(x, right + gap_px)
        kept.append((right, number))
    for x, number in sorted((p for p in places[1:] if p[0] < places[0][0]), reverse=True):
        left = min(x, left - gap_px)
        kept.append((left, number))
    return kept


def bridges_over(seed: int, road: Road, size_wh: Size, view: MatrixAt, count: int) -> list[Layer]:
    """Footbridges that hide what passes beneath."""
    height = math.ceil(LANES * road.lane_px + 90.0)
    layers = []
    for number in range(count):
        rng = stream(seed, f"bridge {number}")
        picture = roadside.paint_bridge(rng, (round(BRIDGE_PX), height))
        sprite = Sprite(picture, shadow=0.5)
        x = size_wh[0] * (0.62 + 0.9 * number) + float(rng.uniform(-30, 30))
        place = translation(x - BRIDGE_PX / 2, road.middle_y - height / 2)
        layers.append(Layer(sprite, _seen(view, lambda _, place=place: place)))  # type: ignore[misc]
    return layers


def _looked_at(view: MatrixAt, n: float, size_wh: Size) -> float:
    ground_from_frame = np.linalg.inv(view(max(n, 0.0)))
    x, _, depth = ground_from_frame @ np.array([size_wh[0] / 2.0, size_wh[1] / 2.0, 1.0])
    return float(x / depth)


def _seen(view: MatrixAt, ground_from_sprite: MatrixAt) -> MatrixAt:
    def frame_from_sprite(n: float) -> Matrix:
        matrix: Matrix = view(n) @ ground_from_sprite(n)
        return normalized(matrix)

    return frame_from_sprite


def _sprite(seed: int, number: int, length_px: float) -> Sprite:
    """A painted car, twice as fine as it is seen."""
    car = roadside.paint_car(stream(seed, f"car {number}"))
    factor = min(2.0 * length_px / car.shape[1], 1.0)
    size = max(round(car.shape[1] * factor), 2), max(round(car.shape[0] * factor), 2)
    small = cv2.resize(car, size, interpolation=cv2.INTER_AREA)
    return Sprite(np.asarray(small, np.uint8), shadow=0.45)


def _placed(sprite: Sprite, length_px: float, x: float, y: float, heading: float) -> Matrix:
    """ground_from_sprite of a car with its middle at (x, y)."""
    width, height = sprite.size_wh
    scale = length_px / width
    c, s = scale * math.cos(heading), scale * math.sin(heading)
    turned = np.array([[c, -s, x], [s, c, y], [0.0, 0.0, 1.0]])
    matrix: Matrix = turned @ translation(-(width - 1) / 2.0, -(height - 1) / 2.0)
    return matrix


def _car(
    seed: int, number: int, road: Road, place: tuple[int, Lane, float], view: MatrixAt
) -> Layer:
    lane, course, start = place
    length = CAR_PER_LANE * road.lane_px
    sprite = _sprite(seed, number, length)
    rng = stream(seed, f"drive {number}")
    pace, weave = Wave(rng, 120.0, 2), Wave(rng, 90.0, 2)
    direction = road.direction(lane)
    heading = 0.0 if direction > 0 else math.pi

    def ground_from_car(n: float) -> Matrix:
        tau = eased(n)
        ahead = course.run(n) + 0.2 * road.lane_px * pace(tau)
        y = road.lane_y(lane) + 0.05 * road.lane_px * weave(tau)
        return _placed(sprite, length, start + direction * ahead, y, heading)

    return Layer(sprite, _seen(view, ground_from_car))


def _crossing(
    seed: int, number: int, road: Road, frames: int, size_wh: Size, view: MatrixAt
) -> Layer:
    length = SMALL * CAR_PER_LANE * road.lane_px
    sprite = _sprite(seed, number, length)
    rng = stream(seed, f"crossing {number}")
    met = float(rng.uniform(0.1, 0.9)) * frames
    x0 = _looked_at(view, met, size_wh) + float(rng.uniform(-0.35, 0.35)) * size_wh[0]
    direction = float(rng.choice([-1.0, 1.0]))
    speed, drift = float(rng.uniform(1.2, 2.4)), float(rng.uniform(-0.5, 0.5))
    if abs(x0 - drift * met - size_wh[0] / 2.0) < 0.2 * size_wh[0]:
        x0 += 0.4 * size_wh[0]  # the first car is to be seen in frame 0
    heading = math.atan2(direction * speed, drift)

    def ground_from_thing(n: float) -> Matrix:
        since = n - met
        y = road.middle_y + direction * speed * since
        return _placed(sprite, length, x0 + drift * since, y, heading)

    return Layer(sprite, _seen(view, ground_from_thing))
