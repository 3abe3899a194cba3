"""Made-up scenes with exact truth: ``synthetic://SCENE?seed=1&frames=300&size=640x480&fps=30``.

Frames are computed when asked for, each on its own, so any of them can be had at any time, and the
same URI always gives the same bytes. Parameters: ``seed``, ``frames``, ``size``, ``fps`` (may be a
fraction as 30000/1001), ``noise`` (standard deviation of each channel in grey levels), ``blur``
(exposure as a share of the time between frames, 0..1), ``light`` (strength of changes of light,
0..1), ``occluders`` (how many), ``image`` (a picture of yours as the target's texture, or as the
land of ``flight`` or the ground of ``traffic``), ``texture`` (one of the painted kinds), for
``flight`` ``step`` (px a frame), and for ``traffic`` ``cars`` (how many come by) and ``camera``
(``fixed`` or ``moving``); there ``occluders`` are footbridges.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Self, TypeVar
from urllib.parse import unquote

import cv2
import numpy as np

from streamtrack.errors import UsageError, unknown_name
from streamtrack.geometry import inverted, transform_points
from streamtrack.sources.scenes.catalogue import RECIPES, SCENES, TEXTURES, Request, build
from streamtrack.sources.scenes.motion import stream
from streamtrack.sources.scenes.rendering import Box, Floats, Ground, NoiseBank, laid_over
from streamtrack.sources.scenes.scene import Layer
from streamtrack.types import Frame, Image, Matrix, Points, Size, Skipped, SourceInfo

T = TypeVar("T")
D = TypeVar("D")
PREFIX = "synthetic://"
PARAMETERS = (
    *("seed", "frames", "size", "fps", "noise", "blur", "light", "occluders"),
    *("image", "texture", "step", "cars", "camera"),
)
BLUR_STEP_PX = 1.5
MOST_RENDERS = 40


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Where everything is in the middle of a frame's exposure.

    ``frame_from_target`` takes pixels of the target's texture; ``world_from_frame`` ends in the
    pixels of frame 0; ``visible_share`` is 0 while the target is wholly hidden or out of view.
    """

    quad: Points
    frame_from_target: Matrix
    world_from_frame: Matrix
    visible_share: float


@dataclass(frozen=True, slots=True, eq=False)
class ThingTruth:
    """One of the things that move in a scene: its number there, quad (4, 2) and visible share."""

    number: int
    quad: Points
    visible_share: float


class SyntheticSource:
    """A made-up scene as a source of frames; see the module for its URI."""

    def __init__(self, uri: str) -> None:
        """Paint the scene. Raises UsageError for a scene or parameter that cannot be right."""
        name, options = _split(uri)
        rate = _read(options, "fps", _rate, Fraction(30))
        request = _request(name, options)
        self.scene = build(request)
        self._request = request
        self._rate = rate
        self._next = 0
        self._info = SourceInfo(uri, request.size_wh, float(rate), request.frames)

    @property
    def info(self) -> SourceInfo:
        return self._info

    @property
    def skipped(self) -> Sequence[Skipped]:
        return ()

    @property
    def corrupt_packets(self) -> int:
        return 0

    @property
    def shortfall(self) -> str:
        return ""

    @property
    def initial_quad(self) -> Points:
        """The target's corners in frame 0."""
        return self.truth(0).quad

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        return None

    @cached_property
    def _noise(self) -> NoiseBank:
        return NoiseBank(stream(self._request.seed, "noise"), self._request.size_wh)

    @cached_property
    def _still(self) -> Floats | None:
        """The backdrop of a fixed camera, None if the camera travels."""
        backdrop = self.scene.backdrop()
        return None if isinstance(backdrop, Ground) else backdrop.astype(np.float32)

    def __len__(self) -> int:
        return self._request.frames

    def __iter__(self) -> Iterator[Frame]:
        while self._next < len(self):
            self._next += 1
            yield self.frame(self._next - 1)

    def truth(self, index: int) -> Truth:
        """What is exactly so in a frame. Raises IndexError if there is no such frame."""
        self._check(index)
        frame_from_target = self.scene.frame_from_target(index)
        return Truth(
            quad=transform_points(frame_from_target, self.scene.target_quad),
            frame_from_target=frame_from_target,
            world_from_frame=self.scene.world_from_frame(index),
            visible_share=self.scene.visible_share(index),
        )

    def things(self, index: int) -> tuple[ThingTruth, ...]:
        """All that moves by itself and is in view, the target among it. Raises IndexError."""
        self._check(index)
        found = []
        for number, layer in enumerate(self.scene.things()):
            share = self.scene.thing_visible_share(number, index)
            if share > 0:
                quad = transform_points(layer.frame_from_sprite(index), layer.sprite.quad)
                found.append(ThingTruth(number, quad, share))
        return tuple(found)

    def frame(self, index: int) -> Frame:
        """Render one frame, whatever was rendered before. Raises IndexError if out of range."""
        self._check(index)
        picture = self._exposed(index)
        if self.scene.light is not None:
            self.scene.light.apply(picture, index)
        if self.scene.noise > 0:
            grain = self._noise.cut(stream(self._request.seed, f"noise {index}"))
            picture += grain * np.float32(self.scene.noise)
        np.maximum(picture, 0.0, out=picture)
        image = cv2.convertScaleAbs(picture)
        return Frame(index, float(index / self._rate), np.asarray(image, np.uint8))

    def _check(self, index: int) -> None:
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} is not in 0..{len(self) - 1}")

    def _exposed(self, index: int) -> Floats:
        """The mean over the exposure, in float32 without noise."""
        times = self._moments(index)
        if self._still is None:
            total = self._travelled(times[0], len(times) > 1)
            for n in times[1:]:
                total += self._travelled(n, True)
            total *= 1.0 / len(times)
            return total
        picture: Floats = self._still.copy()
        box = self._reach(times)
        if box is None:
            return picture
        if len(times) == 1:
            self._lay(picture, times[0], (0, 0, *self.scene.size_wh), False)
            return picture
        part = self._still[box[1] : box[3], box[0] : box[2]]
        total = np.zeros_like(part)
        for n in times:
            now = part.copy()
            self._lay(now, n, box, True)
            total += now
        picture[box[1] : box[3], box[0] : box[2]] = total * (1.0 / len(times))
        return picture

    def _moments(self, index: int) -> list[float]:
        """Times spread evenly over the exposure, closer together the faster things move."""
        exposure = self.scene.exposure
        if exposure == 0:
            return [float(index)]
        count = math.ceil(self._streak(index) / BLUR_STEP_PX)
        count = min(max(count, 1), MOST_RENDERS)
        return [index + exposure * ((k + 0.5) / count - 0.5) for k in range(count)]

    def _streak(self, index: int) -> float:
        """How far, in px, the fastest corner in the frame moves during the exposure."""
        half, longest = self.scene.exposure / 2.0, 0.0
        width, height = self.scene.size_wh
        tracked = [(layer.frame_from_sprite, layer.sprite.quad) for layer in self.scene.layers()]
        if self.scene.frame_from_ground is not None:
            view = self.scene.frame_from_ground
            corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
            tracked.append((view, transform_points(inverted(view(index)), corners)))
        for motion, quad in tracked:
            seen = [transform_points(motion(index + d), quad) for d in (-half, 0.0, half)]
            run = np.linalg.norm(seen[1] - seen[0], axis=1)
            run = run + np.linalg.norm(seen[2] - seen[1], axis=1)
            if self._is_in_frame(seen[1]):
                longest = max(longest, float(run.max()))
        return longest

    def _is_in_frame(self, quad: Points) -> bool:
        low, high = quad.min(axis=0) - 40, quad.max(axis=0) + 40
        return bool((high > 0).all() and (low < np.array(self.scene.size_wh)).all())

    def _travelled(self, n: float, is_quick: bool) -> Floats:
        ground, view = self.scene.backdrop(), self.scene.frame_from_ground
        assert isinstance(ground, Ground) and view is not None
        picture: Floats = ground.warped(view(n), self.scene.size_wh).astype(np.float32)
        self._lay(picture, n, (0, 0, *self.scene.size_wh), is_quick)
        return picture

    def _boxes(self, n: float) -> list[tuple[Layer, Matrix, Box]]:
        """The layers that reach into the frame, with where they are."""
        found = []
        for layer in self.scene.layers():
            matrix = layer.frame_from_sprite(n)
            box = layer.sprite.box_in(matrix, self.scene.size_wh)
            if box[2] > box[0] and box[3] > box[1]:
                found.append((layer, matrix, box))
        return found

    def _reach(self, times: list[float]) -> Box | None:
        """The part of the frame that any layer touches during the exposure."""
        boxes = [box for n in times for _, _, box in self._boxes(n)]
        if not boxes:
            return None
        x0, y0, x1, y1 = zip(*boxes, strict=True)
        return min(x0), min(y0), max(x1), max(y1)

    def _lay(self, canvas: Floats, n: float, region: Box, is_quick: bool) -> None:
        for layer, matrix, box in self._boxes(n):
            warped = layer.sprite.warped(matrix, box, is_quick)
            x, y = region[:2]
            laid_over(canvas, warped, (box[0] - x, box[1] - y, box[2] - x, box[3] - y))


def _split(uri: str) -> tuple[str, Mapping[str, str]]:
    """Scene and parameters of the URI."""
    if not uri.startswith(PREFIX):
        raise UsageError(f"'{uri}' is no synthetic scene: write {PREFIX}SCENE?seed=1&frames=300")
    name, _, query = uri.removeprefix(PREFIX).partition("?")
    name = name.strip("/")
    if name not in SCENES:
        raise unknown_name("scene", name, SCENES)
    options: dict[str, str] = {}
    for item in filter(None, query.split("&")):
        key, _, value = item.partition("=")
        if key not in PARAMETERS:
            raise unknown_name(f"parameter of {PREFIX}{name}", key, PARAMETERS)
        if key in options:
            raise UsageError(f"{key} is given twice in '{uri}': give it once")
        options[key] = unquote(value)
    return name, options


def _request(name: str, options: Mapping[str, str]) -> Request:
    if "step" in options and name != "flight":
        raise UsageError(f"step belongs to the scene flight, not to {name}: leave it out")
    if "texture" in options and name not in RECIPES:
        raise UsageError(f"the scene {name} takes no texture=: leave it out or use image=PHOTO")
    for key in ("cars", "camera"):
        if key in options and name != "traffic":
            raise UsageError(f"{key} belongs to the scene traffic, not to {name}: leave it out")
    if options.get("occluders", "0") != "0" and name not in (*RECIPES, "traffic"):
        raise UsageError(f"the scene {name} takes no occluders: leave it out")
    if "texture" in options and options["texture"] not in TEXTURES:
        raise unknown_name("texture", options["texture"], TEXTURES)
    return Request(
        scene=name,
        seed=_read(options, "seed", _whole(0, 2**63), 1),
        frames=_read(options, "frames", _whole(1, 10**9), 300),
        size_wh=_read(options, "size", _size, (640, 480)),
        noise=_read(options, "noise", _real(0.0, 255.0), None),
        exposure=_read(options, "blur", _real(0.0, 1.0), None),
        light=_read(options, "light", _real(0.0, 1.0), None),
        occluders=_read(options, "occluders", _whole(0, 8), None),
        image=_read(options, "image", _photo, None),
        texture=options.get("texture"),
        step=_read(options, "step", _real(0.5, 400.0), 27.0),
        cars=_read(options, "cars", _whole(1, 200), 12),
        camera=_read(options, "camera", _camera, "fixed"),
    )


def _read(options: Mapping[str, str], key: str, parse: Callable[[str], T], default: D) -> T | D:
    if key not in options:
        return default
    try:
        return parse(options[key])
    except (ValueError, ZeroDivisionError) as error:
        raise UsageError(f"{key}={options[key]} cannot be right: {error}") from None


def _whole(low: int, high: int) -> Callable[[str], int]:
    def parse(text: str) -> int:
        if not text.isascii() or not text.lstrip("-").isdigit() or not low <= int(text) <= high:
            raise ValueError(f"give a whole number from {low} to {high}")
        return int(text)

    return parse


def _real(low: float, high: float) -> Callable[[str], float]:
    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise ValueError(f"give a number from {low:g} to {high:g}")
        return value

    return parse


def _camera(text: str) -> str:
    if text not in ("fixed", "moving"):
        raise ValueError("give fixed or moving")
    return text


def _rate(text: str) -> Fraction:
    try:
        rate = Fraction(text)
    except (ValueError, ZeroDivisionError):
        rate = Fraction(0)
    if not Fraction(1, 1000) <= rate <= 100_000:
        raise ValueError("give frames per second from 0.001 to 100000, as 30 or 30000/1001")
    return rate


def _size(text: str) -> Size:
    width, _, height = text.partition("x")
    if not (width.isascii() and height.isascii() and width.isdigit() and height.isdigit()):
        raise ValueError("give WIDTHxHEIGHT, as 640x480")
    size = int(width), int(height)
    if not all(96 <= side <= 4096 for side in size):
        raise ValueError("width and height must be from 96 to 4096")
    return size


def _photo(text: str) -> Image:
    if not Path(text).is_file():
        raise ValueError("there is no such file: give the path of a picture")
    data = np.frombuffer(Path(text).read_bytes(), np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
    if picture is None or min(picture.shape[:2]) < 16:
        raise ValueError("it is no picture of at least 16x16 that can be read")
    return np.asarray(picture, np.uint8)
