"""What the tests share: textured pictures, random homographies and clips with exact truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Self, TypeAlias

import cv2
import numpy as np
import pytest

from streamtrack import geometry
from streamtrack.sources.synthetic import SyntheticSource, Truth
from streamtrack.types import Frame, Image, Matrix, Points, Size, Skipped, SourceInfo

MakePicture: TypeAlias = Callable[[int, Size], Image]
MakeHomography: TypeAlias = Callable[[np.random.Generator, Size], Matrix]


class FrameList:
    """Frames at hand as a source."""

    def __init__(self, frames: Sequence[Frame]) -> None:
        self._frames = iter(frames)
        size_wh = frames[0].size_wh if frames else (0, 0)
        self.info = SourceInfo("frames", size_wh, 30.0, len(frames))
        self.skipped: Sequence[Skipped] = ()
        self.corrupt_packets = 0
        self.shortfall = ""

    def __iter__(self) -> Iterator[Frame]:
        return self._frames

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        return None


@dataclass(frozen=True)
class Clip:
    """Rendered frames of a synthetic scene with the truth of each."""

    frames: tuple[Frame, ...]
    truths: tuple[Truth, ...]

    @property
    def quad(self) -> Points:
        """The target in the first frame."""
        return self.truths[0].quad

    def source(self) -> FrameList:
        return FrameList(self.frames)

    def with_images(self, images: dict[int, Image]) -> FrameList:
        """The clip with some of its pictures exchanged."""
        return FrameList(
            [replace(f, image=images.get(f.index, f.image), packets=()) for f in self.frames]
        )


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20240607)


@cache
def _picture(seed: int, size_wh: Size) -> Image:
    """Grey noise of several grain sizes with shapes laid over it: corners at every scale."""
    rng = np.random.default_rng(seed)
    width, height = size_wh
    mixed = np.full((height, width), 128.0)
    for grain in (3, 6, 12, 24):
        small = rng.normal(0, 14, (height // grain + 2, width // grain + 2))
        big = cv2.resize(small, None, fx=grain, fy=grain, interpolation=cv2.INTER_CUBIC)
        mixed += big[:height, :width]
    picture = np.clip(mixed, 0, 255).astype(np.uint8)
    for _ in range(width * height // 1500):
        x, y = (int(v) for v in rng.uniform((0, 0), size_wh))
        angle, grey = float(rng.uniform(0, 90)), int(rng.integers(0, 256))
        box = cv2.boxPoints(((x, y), tuple(rng.uniform(6, 45, 2)), angle))
        cv2.fillPoly(picture, [np.rint(box).astype(np.int32)], grey, cv2.LINE_AA)
    picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.7), np.uint8)
    picture.setflags(write=False)
    return picture


@pytest.fixture(scope="session")
def make_picture() -> MakePicture:
    """A grey textured picture for a seed and a size, not to be written to."""
    return _picture


def _random_homography(rng: np.random.Generator, size_wh: Size) -> Matrix:
    corners = geometry.image_quad(size_wh)
    moved = corners + rng.uniform(-0.2, 0.2, (4, 2)) * min(size_wh)
    turned = cv2.getRotationMatrix2D(
        (size_wh[0] / 2, size_wh[1] / 2),
        float(rng.uniform(-180, 180)),
        float(rng.uniform(0.6, 1.5)),
    )
    bent = cv2.getPerspectiveTransform(corners, moved.astype(np.float32))
    return geometry.normalized(np.vstack([turned, [0, 0, 1]]) @ bent)


@pytest.fixture(scope="session")
def random_homography() -> MakeHomography:
    """A sane random mapping of a picture of a size: any rotation, some zoom and perspective."""
    return _random_homography


@cache
def _clip(uri: str, count: int, start: int, step: int) -> Clip:
    source = SyntheticSource(uri)
    indices = range(start, start + count * step, step)
    frames = tuple(replace(source.frame(i), index=n, time_s=n / 30) for n, i in enumerate(indices))
    return Clip(frames, tuple(source.truth(i) for i in indices))


@pytest.fixture(scope="session")
def make_clip() -> Callable[..., Clip]:
    """``make_clip("board?size=320x240", count, start=0, step=1)``, rendered once per session."""

    def make(scene: str, count: int, start: int = 0, step: int = 1) -> Clip:
        return _clip(f"synthetic://{scene}", count, start, step)

    return make
