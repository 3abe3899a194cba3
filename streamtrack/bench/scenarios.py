"""The benchmark's sequences: pictures with the target's true corners in each.

Synthetic ones run over scenes and seeds, one seed unless more are asked for. Of the seeds of a
scene about every fourth sequence is 1280x720, the others 640x480, and every second shows a
photograph where scikit-image is installed (only what lies in its package; nothing is fetched), the
others a painted texture. A sequence is held in memory as a whole.

Scored are frames with at least a fifth of the target visible, except the first, in which it is
given; POT sequences as POT says: annotated, flag 0, and not the first annotated one.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Protocol, TypeAlias
from urllib.parse import quote

import numpy as np
import numpy.typing as npt

from streamtrack.errors import SourceError, UsageError, unknown_name
from streamtrack.evaluation import read_pot_ground_truth, read_pot_points
from streamtrack.sources import open_source
from streamtrack.sources.synthetic import SyntheticSource
from streamtrack.types import Image, Mask, Points, Size

Floats: TypeAlias = npt.NDArray[np.float64]

SCENES = (
    *("scale", "rotation", "perspective", "blur", "occlusion", "outofview", "unconstrained"),
    *("absence", "fullocclusion", "weak", "repeated", "small", "large", "lowlight", "fast"),
    *("static", "light"),
)
_OWN_TEXTURE = ("weak", "repeated")
_PHOTOS = (
    *("astronaut.png", "chelsea.png", "coffee.png", "camera.png"),
    *("rocket.jpg", "motorcycle_left.png"),
)
FRAMES = {
    **dict.fromkeys(SCENES, 60),
    **dict.fromkeys(("occlusion", "outofview", "unconstrained", "absence"), 150),
    "fullocclusion": 120,
}
"""Enough for every scene to show what it is made for: in ``absence`` the target is back at 130."""
QUICK_FRAMES = {
    "scale": 40,
    "perspective": 40,
    "blur": 30,
    "unconstrained": 75,
    "absence": 135,
    "weak": 25,
    "small": 25,
    "fast": 25,
    "static": 25,
}
MIN_VISIBLE = 0.2
ABSENT_BELOW = 0.02
_POT_FACTORS = (
    *("scale", "rotation", "perspective", "blur", "occlusion", "outofview", "unconstrained"),
)


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What is true in each of N frames; ``visible_share`` (N,) is NaN where it is not known."""

    quads: Floats
    visible_share: Floats
    is_scored: Mask

    @property
    def is_absent(self) -> Mask:
        """Frames (N,) without the target."""
        return np.asarray(self.visible_share < ABSENT_BELOW, np.bool_)

    @property
    def is_present(self) -> Mask:
        """Frames (N,) after the first with the target, or a part of it, at a known place."""
        is_present = np.asarray(self.is_scored | (self.visible_share >= ABSENT_BELOW), np.bool_)
        is_present[0] = False
        return is_present


@dataclass(frozen=True, slots=True, eq=False)
class Clip:
    """A sequence made ready: its pictures and their truth. The target is given in the first."""

    images: Sequence[Image]
    truth: Truth

    @property
    def first_quad(self) -> Points:
        return np.asarray(self.truth.quads[0], np.float32)


class Scenario(Protocol):
    """A sequence that can be made ready. ``group`` is ``synthetic`` or ``pot``."""

    @property
    def name(self) -> str: ...
    @property
    def group(self) -> str: ...
    @property
    def factor(self) -> str: ...
    @property
    def seed(self) -> int | None: ...
    @property
    def texture(self) -> str: ...

    def load(self) -> Clip: ...


@dataclass(frozen=True, slots=True)
class SyntheticScenario:
    """One scene, seed and texture; ``photo`` None stands for the scene's own painted one."""

    factor: str
    seed: int
    size_wh: Size
    frames: int
    photo: Path | None = None
    group: str = "synthetic"

    @property
    def texture(self) -> str:
        return "painted" if self.photo is None else self.photo.stem

    @property
    def name(self) -> str:
        width, height = self.size_wh
        return f"{self.factor}, seed {self.seed}, {width}x{height}, {self.texture}"

    @property
    def uri(self) -> str:
        width, height = self.size_wh
        options = f"seed={self.seed}&frames={self.frames}&size={width}x{height}"
        picture = "" if self.photo is None else f"&image={quote(str(self.photo), safe='/')}"
        return f"synthetic://{self.factor}?{options}{picture}"

    def load(self) -> Clip:
        source = SyntheticSource(self.uri)
        truths = [source.truth(index) for index in range(len(source))]
        visible = np.array([truth.visible_share for truth in truths])
        is_scored = visible >= MIN_VISIBLE
        is_scored[0] = False
        quads = np.array([truth.quad for truth in truths], np.float64)
        return Clip([frame.image for frame in source], Truth(quads, visible, is_scored))


@dataclass(frozen=True, slots=True)
class PotScenario:
    """A sequence of the POT benchmark: ``NAME/``, ``NAME_gt_points.txt``, ``NAME_flag.txt``."""

    points_path: Path
    frames: int | None = None
    group: str = "pot"
    seed: int | None = None
    texture: str = "film"

    @property
    def _stem(self) -> str:
        return self.points_path.name.removesuffix("_gt_points.txt")

    @property
    def name(self) -> str:
        return f"POT {self._stem}"

    @property
    def factor(self) -> str:
        """What the number after the underscore stands for."""
        number = self._stem.rpartition("_")[2]
        is_known = number.isascii() and number.isdigit() and 1 <= int(number) <= len(_POT_FACTORS)
        return _POT_FACTORS[int(number) - 1] if is_known else "other"

    def load(self) -> Clip:
        """Everything from the first annotated frame on. Raises SourceError."""
        quads = read_pot_points(self.points_path)
        flags = self.points_path.with_name(f"{self._stem}_flag.txt")
        scored, _ = read_pot_ground_truth(self.points_path, flags)
        annotated = np.flatnonzero(np.isfinite(quads).all(axis=(1, 2)))
        if not len(annotated):
            raise SourceError(f"{self.points_path}: no frame is annotated")
        first = int(annotated[0])
        stop = len(quads) if self.frames is None else min(first + self.frames, len(quads))
        with open_source(self.points_path.with_name(self._stem)) as source:
            kept = [frame for frame in islice(source, stop) if first <= frame.index < stop]
        if not kept or kept[0].index != first:
            raise SourceError(f"{self.name}: picture {first} is missing, in which the target is")
        rows = np.array([frame.index for frame in kept])
        is_scored = np.isin(rows, scored) & (rows > first)
        if not is_scored.any():
            raise SourceError(f"{self.name}: none of its {len(rows)} frames can be scored")
        unknown = np.full(len(rows), np.nan)
        return Clip([frame.image for frame in kept], Truth(quads[rows], unknown, is_scored))


def synthetic_scenarios(
    scenes: Sequence[str] | None, seeds: Sequence[int], frames: int | None, *, is_quick: bool
) -> list[Scenario]:
    """The synthetic sequences, scene by scene. Raises UsageError for an unknown scene."""
    chosen = scenes or (tuple(QUICK_FRAMES) if is_quick else SCENES)
    for scene in chosen:
        if scene not in SCENES:
            raise unknown_name("scene", scene, SCENES)
    usual = {**FRAMES, **QUICK_FRAMES} if is_quick else FRAMES
    result: list[Scenario] = []
    for scene in dict.fromkeys(chosen):
        for seed in dict.fromkeys(seeds):
            count = frames or usual[scene]
            size = (640, 480) if is_quick else _size(scene, seed)
            result.append(SyntheticScenario(scene, seed, size, count, _photo(scene, seed)))
    return result


def pot_scenarios(folder: Path, frames: int | None) -> list[Scenario]:
    """The POT sequences of a folder. Raises SourceError if there are none."""
    if not folder.is_dir():
        raise SourceError(f"{folder} is no folder: give one with POT sequences")
    found = [PotScenario(path, frames) for path in _ground_truths(folder)]
    if not found:
        raise SourceError(
            f"{folder} holds no POT sequence: give a folder with NAME/ and NAME_gt_points.txt"
        )
    return list(found)


def _ground_truths(folder: Path) -> Iterator[Path]:
    for path in sorted(folder.glob("*_gt_points.txt")):
        if path.with_name(path.name.removesuffix("_gt_points.txt")).is_dir():
            yield path


def _size(scene: str, seed: int) -> Size:
    return (1280, 720) if (SCENES.index(scene) // 2 + seed) % 4 == 0 else (640, 480)


def _photo(scene: str, seed: int) -> Path | None:
    number = SCENES.index(scene) + seed
    photos = shipped_photos()
    if scene in _OWN_TEXTURE or not photos or number % 2 == 0:
        return None
    return photos[(number // 2 + seed) % len(photos)]


@cache
def shipped_photos() -> tuple[Path, ...]:
    """Photographs that lie in the installed scikit-image, in a fixed order; it is not imported."""
    spec = importlib.util.find_spec("skimage")
    if spec is None or not spec.submodule_search_locations:
        return ()
    folder = Path(next(iter(spec.submodule_search_locations))) / "data"
    return tuple(folder / name for name in _PHOTOS if (folder / name).is_file())


def parse_seeds(text: str) -> list[int]:
    """``1,2,3`` as numbers. Raises UsageError."""
    try:
        seeds = [int(part) for part in text.split(",")]
    except ValueError:
        seeds = []
    if not seeds or min(seeds) < 0:
        raise UsageError(f"seeds '{text}': give whole numbers from 0, as 1,2,3")
    return seeds
