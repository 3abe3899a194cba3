"""The scenes by name, and how each is put together."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, lru_cache

import cv2
import numpy as np

from streamtrack.geometry import box_quad, normalized, translation
from streamtrack.sources.scenes import circuit, desk, prints, roadside, terrain, traffic
from streamtrack.sources.scenes.motion import (
    Path,
    Reach,
    absences,
    excursions,
    homography,
    racing,
    shaken,
    stream,
    wander,
)
from streamtrack.sources.scenes.rendering import Ground, Sprite, premultiplied
from streamtrack.sources.scenes.scene import Layer, Light, Pass, Passing, Scene
from streamtrack.sources.scenes.travel import MatrixAt, drive, flight_view
from streamtrack.types import Image, Matrix, Points, Size


def _board(rng: np.random.Generator) -> Image:
    return circuit.dusty(circuit.paint_board(rng), rng)


TEXTURES: Mapping[str, Callable[[np.random.Generator], Image]] = {
    "map": prints.paint_map,
    "board": _board,
    "poster": prints.paint_poster,
    "box": prints.paint_box,
    "page": prints.paint_page,
    "facade": prints.paint_facade,
    "faint": prints.paint_faint,
}
ALTERNATING = ("map", "board", "poster", "box", "page")


@dataclass(frozen=True, slots=True)
class Request:
    """What the user asked for; None stands for the scene's own choice."""

    scene: str
    seed: int
    frames: int
    size_wh: Size
    noise: float | None
    exposure: float | None
    light: float | None
    occluders: int | None
    image: Image | None
    texture: str | None
    step: float
    cars: int = 12
    camera: str = "fixed"


GENTLY = Reach()
MOSTLY = Pass(0.6)
STILL = Reach(0.0, (1.0, 1.0), 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Recipe:
    """A target before a fixed textured background.

    ``share`` is the target's size as a share of the frame; ``passes`` belong to the occluders.
    """

    reach: Reach = GENTLY
    textures: tuple[str, ...] = ALTERNATING
    share: float = 0.42
    noise: float = 2.0
    exposure: float = 0.0
    light: float = 0.0
    dimming: float = 1.0
    occluders: int = 0
    passes: Pass = MOSTLY
    shake: float = 0.0
    beyond: float | None = None
    is_absent: bool = False
    race: float = 0.0


RECIPES: Mapping[str, Recipe] = {
    "board": Recipe(Reach(0.1, (0.8, 1.2), 25.0, 25.0), ("board",), exposure=0.1),
    "scale": Recipe(Reach(0.04, (0.28, 2.0), 6.0, 5.0, period=150.0)),
    "rotation": Recipe(Reach(0.05, (0.95, 1.05), 0.0, 5.0, turns=1.0, period=120.0)),
    "perspective": Recipe(Reach(0.06, (0.9, 1.1), 10.0, 60.0, period=115.0)),
    "blur": Recipe(Reach(0.02, roll=6.0, tilt=6.0), exposure=0.8, shake=96.0),
    "occlusion": Recipe(Reach(0.06, (0.92, 1.08), 12.0, 10.0), occluders=1),
    "outofview": Recipe(Reach(0.05, roll=12.0, tilt=10.0), beyond=0.12),
    "unconstrained": Recipe(
        Reach(0.08, (0.5, 1.6), 70.0, 40.0, period=140.0),
        exposure=0.5,
        light=0.12,
        occluders=1,
        passes=Pass(0.35, start=45.0, period=130.0),
        shake=20.0,
        beyond=-0.1,
    ),
    "absence": Recipe(Reach(0.03, (0.95, 1.05), 5.0, 8.0), is_absent=True),
    "fullocclusion": Recipe(
        Reach(0.03, (0.95, 1.05), 8.0, 8.0),
        occluders=1,
        passes=Pass(1.0, start=40.0, period=130.0, dwell=12.0, travel=34.0),
    ),
    "weak": Recipe(Reach(0.08, (0.9, 1.1), 12.0, 12.0), ("faint",)),
    "repeated": Recipe(Reach(0.08, (0.85, 1.15), 15.0, 15.0), ("facade",)),
    "small": Recipe(Reach(0.2, (0.9, 1.15), 15.0, 12.0), share=40.0),
    "large": Recipe(Reach(0.05, (0.95, 1.1), 6.0, 8.0), ("map", "board", "box"), share=0.97),
    "lowlight": Recipe(Reach(0.09), noise=6.0, dimming=0.2),
    "fast": Recipe(Reach(0.02, (0.95, 1.05), 8.0, 6.0), share=0.36, race=40.0),
    "static": Recipe(STILL, noise=3.0),
    "light": Recipe(Reach(0.06, (0.9, 1.1), 10.0, 10.0), light=0.5),
}
SCENES = ("board", "car", "flight", "traffic", *(name for name in RECIPES if name != "board"))


def build(request: Request) -> Scene:
    """Paint and set up the scene, one of `SCENES`."""
    if request.scene == "flight":
        return _flight(request)
    if request.scene == "car":
        return _car(request)
    if request.scene == "traffic":
        return _traffic(request)
    return _before_desk(RECIPES[request.scene], request)


def _chosen(asked: float | None, own: float) -> float:
    return own if asked is None else asked


def _texture(recipe: Recipe, request: Request) -> Image:
    if request.image is not None:
        return request.image
    kind = request.texture or recipe.textures[request.seed % len(recipe.textures)]
    return _painted(kind, request.seed)


@lru_cache(maxsize=8)
def _painted(kind: str, seed: int) -> Image:
    """A painted texture, not to be written to: many scenes share it."""
    return TEXTURES[kind](stream(seed, "texture"))


def _fitted(picture: Image, limit: Size) -> Image:
    """The picture resized so that it just fits into ``limit``."""
    height, width = picture.shape[:2]
    factor = min(limit[0] / width, limit[1] / height)
    size = max(round(width * factor), 2), max(round(height * factor), 2)
    way = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(picture, size, interpolation=way), np.uint8)


def _target_limit(recipe: Recipe, size_wh: Size) -> tuple[float, float]:
    """Width and height that the target may have in frame 0."""
    if recipe.share > 1:
        return recipe.share, recipe.share
    wide, tall = recipe.share * size_wh[0], recipe.share * size_wh[1]
    return (wide, tall) if recipe.share > 0.8 else (wide, 1.28 * tall)


def _before_desk(recipe: Recipe, request: Request) -> Scene:
    size_wh = request.size_wh
    limit = _target_limit(recipe, size_wh)
    detail = 1 if recipe.share > 0.8 else 2
    picture = _fitted(_texture(recipe, request), (int(detail * limit[0]), int(detail * limit[1])))
    sprite = Sprite(premultiplied(picture), shadow=0.5)
    path = _path(recipe, request, (sprite.size_wh[0] / detail, sprite.size_wh[1] / detail))
    desk_rng = stream(request.seed, f"desk {request.scene}")
    frame_from_target = _seen(path, sprite.size_wh, size_wh, 1.0 / detail)
    return Scene(
        size_wh=size_wh,
        target_quad=sprite.quad,
        frame_from_target=frame_from_target,
        backdrop=cache(lambda: desk.paint_desk(desk_rng, size_wh)),
        frame_from_ground=None,
        target=sprite,
        occluders=_occluders(recipe, request, sprite, frame_from_target, detail),
        light=_light(request, recipe.light, recipe.dimming),
        exposure=_chosen(request.exposure, recipe.exposure),
        noise=_chosen(request.noise, recipe.noise),
    )


def _path(recipe: Recipe, request: Request, target_wh: tuple[float, float]) -> Path:
    rng, size_wh = stream(request.seed, "motion"), request.size_wh
    path = wander(rng, size_wh, recipe.reach)
    half = math.hypot(*target_wh) / 2.0
    if recipe.shake:
        path = shaken(path, rng, recipe.shake * size_wh[0] / 640.0, 17.0)
    if recipe.race:
        path = racing(path, rng, 0.23 * min(size_wh), recipe.race)
    if recipe.beyond is not None:
        path = excursions(path, rng, size_wh, 2.0 * recipe.beyond * half, 110.0)
    if recipe.is_absent:
        radius = math.hypot(*size_wh) / 2.0 + 1.3 * half
        path = absences(path, request.seed, size_wh, radius, math.radians(60.0))
    return path


def _seen(path: Path, texture_wh: Size, size_wh: Size, pixel: float) -> MatrixAt:
    """frame_from_target for a texture whose pixels are ``pixel`` units of the path's plane."""
    middle = (texture_wh[0] - 1) / 2.0, (texture_wh[1] - 1) / 2.0
    shrink = np.diag([pixel, pixel, 1.0]) @ translation(-middle[0], -middle[1])

    def frame_from_target(n: float) -> Matrix:
        matrix: Matrix = homography(path(n), (0.0, 0.0), size_wh) @ shrink
        return normalized(matrix)

    return frame_from_target


def _occluders(
    recipe: Recipe, request: Request, target: Sprite, frame_from_target: MatrixAt, detail: int
) -> tuple[Layer, ...]:
    count = recipe.occluders if request.occluders is None else request.occluders
    side = math.hypot(*target.size_wh) / detail
    result = []
    for k in range(count):
        rng = stream(request.seed, f"occluder {k}")
        kind = ("book", "hand", "card")[(request.seed + k) % 3]
        if recipe.passes.share >= 1.0:
            kind, reach = "book", 1.5
        else:
            reach = 1.15 * min(max(recipe.reach.scale), 1.15)
        width, height = int(reach * side), int(reach * side * 0.8)
        sprite = Sprite(desk.paint_occluder(rng, kind, width, height), shadow=0.45)
        plan = recipe.passes
        shifted = Pass(
            plan.share, plan.start + 41.0 * k, plan.period + 13.0 * k, plan.dwell, plan.travel
        )
        motion = Passing(
            request.seed + 7 * k, sprite, target.quad, frame_from_target, request.size_wh, shifted
        )
        result.append(Layer(sprite, motion))
    return tuple(result)


def _light(request: Request, amplitude: float, dimming: float = 1.0) -> Light | None:
    amplitude = _chosen(request.light, amplitude)
    if amplitude == 0 and dimming == 1:
        return None
    return Light(stream(request.seed, "light"), request.size_wh, amplitude, dimming)


def _car(request: Request) -> Scene:
    """A car seen from above and a camera that follows it imperfectly."""
    size_wh = request.size_wh
    reach = math.ceil(1.25 * math.hypot(*size_wh)) + 40
    unit = min(size_wh) / 480.0
    lane_px = max(round(56 * unit), 24)
    height = max(reach, 4 * lane_px + 400)
    lane_y = height // 2 + 1.5 * lane_px
    own = stream(request.seed, "texture")
    car = roadside.paint_car(own) if request.image is None else premultiplied(request.image)
    factor = 1.32 * lane_px * 2.2 / max(car.shape[1], 2.2 * car.shape[0])
    fine = min(2.0 * factor, 1.0)
    size = max(round(car.shape[1] * fine), 2), max(round(car.shape[0] * fine), 2)
    sprite = Sprite(np.asarray(cv2.resize(car, size, interpolation=cv2.INTER_AREA), np.uint8), 0.5)
    middle = (size[0] - 1) / 2.0, (size[1] - 1) / 2.0
    motion = stream(request.seed, "motion")
    plan = drive(motion, size_wh, lane_y, lane_px, middle, factor / fine)

    def frame_from_target(n: float) -> Matrix:
        matrix: Matrix = plan.frame_from_ground(n) @ plan.ground_from_car(n)
        return normalized(matrix)

    road_rng = stream(request.seed, "road")
    ground = cache(lambda: roadside.paint_road(road_rng, height, lane_px, reach))
    return _travelling(request, ground, plan.frame_from_ground, frame_from_target, sprite)


def _traffic(request: Request) -> Scene:
    """Cars on a road from above, and a camera that stands or goes along it."""
    size_wh = request.size_wh
    lane_px = max(round(0.105 * min(size_wh)), 16)
    reach = math.ceil(1.25 * math.hypot(*size_wh)) + 40
    height = max(reach, 4 * lane_px + 400)
    road = traffic.Road(height / 2.0, lane_px)
    view = traffic.camera_over(request.seed, size_wh, road, request.camera == "moving")
    cars = traffic.cars_on(request.seed, road, request.frames, size_wh, view, request.cars)
    bridges = traffic.bridges_over(request.seed, road, size_wh, view, request.occluders or 0)
    road_rng = stream(request.seed, "road")

    @cache
    def ground() -> Ground:
        if request.image is not None:
            return _mirrored(request.image, height, reach)
        return roadside.paint_road(road_rng, height, lane_px, reach)

    first = cars[0]
    scene = _travelling(request, ground, view, first.frame_from_sprite, first.sprite)
    return replace(scene, others=cars[1:], occluders=tuple(bridges))


def _flight(request: Request) -> Scene:
    """A camera over land, on a closed course; the target is a farmhouse on it."""
    rng = stream(request.seed, "motion")
    view, extent, start = flight_view(rng, request.size_wh, request.frames, request.step)
    half = np.round(np.array([0.1, 0.075]) * min(request.size_wh)) * 1.3
    landmark = box_quad(*(np.round(start) - half), *(2.0 * half))

    @cache
    def ground() -> Ground:
        if request.image is not None:
            return Ground(_filling(request.image, extent))
        paints = stream(request.seed, "texture")
        return Ground(terrain.paint_terrain(paints, extent, landmark.astype(np.float64)))

    return _travelling(request, ground, view, view, landmark)


def _mirrored(picture: Image, height: int, margin: int) -> Ground:
    """The picture at a height, itself and its mirror image by turns along x for ever."""
    width = max(2, round(picture.shape[1] * height / picture.shape[0]))
    once = _filling(picture, (width, height))
    both = np.concatenate([once, once[:, ::-1]], axis=1)
    columns = np.arange(2 * width + margin) % (2 * width)
    return Ground(both[:, columns], 2 * width)


def _filling(picture: Image, extent: Size) -> Image:
    """The picture resized and cropped so that it just covers ``extent``."""
    height, width = picture.shape[:2]
    factor = max(extent[0] / width, extent[1] / height)
    size = max(math.ceil(width * factor), extent[0]), max(math.ceil(height * factor), extent[1])
    way = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    large = cv2.resize(picture, size, interpolation=way)
    return np.asarray(large[: extent[1], : extent[0]], np.uint8)


def _travelling(
    request: Request, ground: Callable[[], Ground], view: MatrixAt, frame_from_target: MatrixAt,
    target: Sprite | Points,
) -> Scene:  # fmt: skip
    """A moving camera; the target is a sprite of its own or a quad on the ground."""
    sprite = target if isinstance(target, Sprite) else None
    return Scene(
        size_wh=request.size_wh,
        target_quad=target.quad if isinstance(target, Sprite) else target,
        frame_from_target=frame_from_target,
        backdrop=ground,
        frame_from_ground=view,
        target=sprite,
        occluders=(),
        light=_light(request, 0.0),
        exposure=_chosen(request.exposure, 0.0),
        noise=_chosen(request.noise, 2.0),
    )
