"""Pairs of pictures with a known homography: rendered ones, and those of a folder.

Rendered pairs are two views of one texture, each sampled 16 times a pixel, so that the truth is
exact. Two textures that have nothing in common make a pair that is to be refused.

A folder is searched with all folders in it for two layouts: ``img1.png`` .. ``imgN.png`` with
``H1to2p`` .. ``H1toNp`` (Mikolajczyk & Schmid's Oxford set), and ``NAMEA.png``, ``NAMEB.png`` with
``NAME_model.txt``, which maps B to A (the ``homogr`` set of Lebeda, Matas & Chum 2012).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from streamtrack.bench.scenarios import shipped_photos
from streamtrack.errors import SourceError
from streamtrack.geometry import inverted, normalized, translation
from streamtrack.sources.scenes.catalogue import TEXTURES
from streamtrack.types import Image, Matrix, Size

SIZE: Size = (640, 480)
_SAMPLES = 4
_PICTURES = (".ppm", ".pgm", ".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
_MIN_TEXTURE_WIDTH = 960


@dataclass(frozen=True, slots=True, eq=False)
class PicturePair:
    """Two pictures (H, W, 3); ``true_b_from_a`` is None if they have nothing in common."""

    name: str
    group: str
    factor: str
    a: Image
    b: Image
    true_b_from_a: Matrix | None


@dataclass(frozen=True, slots=True)
class PairSource:
    """A pair that is made or read when it is its turn."""

    name: str
    load: Callable[[], PicturePair]


# -- rendered pairs -----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Difficulty:
    """How the second view differs from the first; ranges are drawn from evenly, sign included.

    ``shift`` in shares of the picture's size, ``turn_deg`` in the picture plane, ``tilt`` as the
    share of the picture's size by which its corners move, ``zoom`` as a factor either way;
    ``gain``, ``ramp`` (change of gain from side to side), ``blur_px`` and ``noise`` (grey levels)
    are done to the second picture.
    """

    shift: float = 0.15
    turn_deg: float = 5.0
    tilt: float = 0.02
    zoom: float = 1.05
    gain: float = 1.0
    ramp: float = 0.0
    blur_px: float = 0.0
    noise: float = 2.0


DIFFICULTIES: dict[str, Difficulty] = {
    "overlap": Difficulty(shift=0.6),
    "zoom2": Difficulty(zoom=2.0),
    "zoom3": Difficulty(zoom=3.0, turn_deg=40.0),
    "rotation": Difficulty(turn_deg=180.0),
    "perspective": Difficulty(tilt=0.22, turn_deg=20.0),
    "light": Difficulty(gain=0.45, ramp=0.5),
    "blur": Difficulty(blur_px=2.5),
    "noise": Difficulty(noise=20.0),
    "everything": Difficulty(0.3, 90.0, 0.1, zoom=1.6, gain=0.7, ramp=0.3, blur_px=1.0, noise=8.0),
}
_STRANGERS = "nothing"
_PAINTED = ("map", "board", "poster", "box", "page")


def synthetic_pairs(seeds: Sequence[int], factors: Sequence[str] = ()) -> list[PairSource]:
    """One pair of each difficulty and seed, and one of nothing in common for each seed."""
    sources = [
        PairSource(f"{factor} {seed}", partial(_render_pair, factor, seed, place))
        for place, factor in enumerate(DIFFICULTIES)
        for seed in seeds
        if not factors or factor in factors
    ]
    if not factors or _STRANGERS in factors:
        sources += [PairSource(f"{_STRANGERS} {n}", partial(_render_strangers, n)) for n in seeds]
    return sources


def _render_pair(factor: str, seed: int, place: int) -> PicturePair:
    rng = np.random.default_rng((seed, place))
    texture = _texture(seed + place)
    difficulty = DIFFICULTIES[factor]
    a_from_texture = _first_view(texture)
    b_from_a = _second_view(difficulty, rng)
    a = _degraded(rendered(texture, a_from_texture), Difficulty(), rng)
    b = _degraded(rendered(texture, b_from_a @ a_from_texture), difficulty, rng)
    return PicturePair(f"{factor} {seed}", "synthetic", factor, a, b, b_from_a)


def _render_strangers(seed: int) -> PicturePair:
    rng = np.random.default_rng((seed, len(DIFFICULTIES)))
    a, b = (
        _degraded(rendered(texture, _first_view(texture)), Difficulty(), rng)
        for texture in (_texture(seed), _texture(seed + 1))
    )
    return PicturePair(f"{_STRANGERS} {seed}", "synthetic", _STRANGERS, a, b, None)


def _texture(number: int) -> Image:
    """Painted textures and, where scikit-image is installed, its photographs, in turns."""
    photos = shipped_photos()
    if photos and number % 2:
        picture = cv2.imread(str(photos[number // 2 % len(photos)]), cv2.IMREAD_COLOR)
        if picture is not None:
            return np.asarray(picture, np.uint8)
    kind = _PAINTED[number // 2 % len(_PAINTED)]
    return TEXTURES[kind](np.random.default_rng(number))


def _first_view(texture: Image) -> Matrix:
    """The texture's middle, at about one texel a pixel, on a place of no whole pixel."""
    scale = max(1.0, _MIN_TEXTURE_WIDTH / texture.shape[1])
    middle = np.array([texture.shape[1], texture.shape[0]]) / 2
    view = np.diag([scale, scale, 1.0])
    view[:2, 2] = np.array(SIZE) / 2 - scale * middle + 0.31
    return view


def _second_view(difficulty: Difficulty, rng: np.random.Generator) -> Matrix:
    width, height = SIZE
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    moved = corners + rng.uniform(-1, 1, (4, 2)) * difficulty.tilt * np.array(SIZE)
    bent = cv2.getPerspectiveTransform(corners, moved.astype(np.float32))
    # Between the two thirds and the whole of the range: a difficulty is to be felt.
    strength = rng.uniform(0.67, 1.0, 4) * rng.choice([-1, 1], 4)
    scale = difficulty.zoom ** strength[0]
    angle = np.radians(difficulty.turn_deg * strength[1])
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    direction = rng.uniform(0, 2 * np.pi)
    shift = difficulty.shift * abs(strength[2]) * np.array([np.cos(direction), np.sin(direction)])
    shift_px = shift * np.array(SIZE) * min(scale, 1.0)
    centred = translation(-width / 2, -height / 2)
    back = translation(width / 2 + shift_px[0], height / 2 + shift_px[1])
    return normalized(back @ turn @ centred @ bent)


def rendered(texture: Image, view_from_texture: Matrix) -> Image:
    """The view, each pixel the mean of 16 samples; beyond the texture its mirror image."""
    fine = np.diag([_SAMPLES, _SAMPLES, 1.0])
    fine[:2, 2] = (_SAMPLES - 1) / 2
    size = SIZE[0] * _SAMPLES, SIZE[1] * _SAMPLES
    sampled = cv2.warpPerspective(
        texture,
        fine @ view_from_texture,
        size,
        flags=cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_REFLECT_101,
    )
    return np.asarray(cv2.resize(sampled, SIZE, interpolation=cv2.INTER_AREA), np.uint8)


def _degraded(picture: Image, difficulty: Difficulty, rng: np.random.Generator) -> Image:
    if difficulty.blur_px > 0:
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), difficulty.blur_px), np.uint8)
    across = np.linspace(-0.5, 0.5, picture.shape[1]) * difficulty.ramp
    gain = (difficulty.gain * (1 + across))[None, :, None]
    noisy = picture * gain + rng.normal(0, difficulty.noise, picture.shape)
    result: Image = np.rint(noisy).clip(0, 255).astype(np.uint8)
    return result


# -- pairs of a folder --------------------------------------------------------------------------


def folder_pairs(folder: Path) -> list[PairSource]:
    """All pairs with a known homography in a folder and the folders in it. Raises SourceError."""
    if not folder.is_dir():
        raise SourceError(f"{folder} is no folder: name one that holds pairs with their truth")
    sources = [
        source
        for inner in sorted({folder, *(path for path in folder.rglob("*") if path.is_dir())})
        for source in (*_oxford_pairs(inner), *_model_pairs(inner))
    ]
    if not sources:
        raise SourceError(
            f"no pairs in {folder}: expected img1.png, img2.png with H1to2p, "
            "or NAMEA.png, NAMEB.png with NAME_model.txt"
        )
    return sources


def _oxford_pairs(folder: Path) -> list[PairSource]:
    first = _picture_named(folder, "img1")
    if first is None:
        return []
    sources = []
    for truth in sorted(folder.glob("H1to*p")):
        number = truth.name[len("H1to") : -1]
        second = _picture_named(folder, f"img{number}")
        if number.isdigit() and second is not None:
            name = f"{folder.name} 1-{number}"
            sources.append(_file_source(name, folder.name, first, second, truth, False))
    return sources


def _model_pairs(folder: Path) -> list[PairSource]:
    sources = []
    for truth in sorted(folder.glob("*_model.txt")):
        stem = truth.name[: -len("_model.txt")]
        first, second = _picture_named(folder, f"{stem}A"), _picture_named(folder, f"{stem}B")
        if first is not None and second is not None:
            sources.append(_file_source(stem, folder.name, first, second, truth, True))
    return sources


def _file_source(
    name: str, factor: str, a: Path, b: Path, truth: Path, is_a_from_b: bool
) -> PairSource:
    def load() -> PicturePair:
        matrix = _read_matrix(truth)
        b_from_a = inverted(matrix) if is_a_from_b else normalized(matrix)
        return PicturePair(name, "folder", factor, _read(a), _read(b), b_from_a)

    return PairSource(name, load)


def _picture_named(folder: Path, stem: str) -> Path | None:
    found = (folder / f"{stem}{suffix}" for suffix in _PICTURES)
    return next((path for path in found if path.is_file()), None)


def _read(path: Path) -> Image:
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is None:
        raise SourceError(f"cannot read picture {path}: is it damaged?")
    return np.asarray(picture, np.uint8)


def _read_matrix(path: Path) -> Matrix:
    try:
        rows = [line.split() for line in path.read_text(encoding="ascii").splitlines()]
        matrix = np.array([[float(cell) for cell in row] for row in rows if row], np.float64)
    except (OSError, ValueError) as error:
        raise SourceError(f"cannot read homography {path}: {error}") from None
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or abs(matrix[2, 2]) < 1e-12:
        raise SourceError(f"homography {path}: 3 x 3 numbers expected, found {matrix.shape}")
    if abs(np.linalg.det(matrix)) < 1e-12:
        raise SourceError(f"homography {path} is singular")
    return matrix
