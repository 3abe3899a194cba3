"""The pictures of a set, read one by one and kept small: features, small copies, skipped ones."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from streamtrack import geometry
from streamtrack.errors import SourceError
from streamtrack.mosaic.pairs.registering import PictureRegistrar
from streamtrack.mosaic.types import Picture
from streamtrack.settings import Settings
from streamtrack.sources.images import read_coverage, read_picture
from streamtrack.types import Image, Matrix, Size, Skipped

_log = logging.getLogger("streamtrack.mosaic")

_MOST_REGISTERED_PX = 2_000_000
_LEAST_REGISTERED_PX = 300_000
_THUMBNAIL_PX = 120_000


class PictureCache:
    """Pictures read again when needed; the last ones stay in memory, up to ``max_bytes``."""

    def __init__(self, paths: Sequence[Path], max_bytes: float) -> None:
        self._paths = paths
        self._max_bytes = max_bytes
        self._kept: dict[int, Image] = {}

    def keep(self, index: int, image: Image) -> None:
        """Remember a picture, and forget the longest unused ones to make room."""
        self._kept[index] = image
        while len(self._kept) > 1 and sum(i.nbytes for i in self._kept.values()) > self._max_bytes:
            self._kept.pop(next(iter(self._kept)))

    def read(self, index: int) -> Image:
        """A picture (H, W) or (H, W, 3) by its place in the list. Raises SourceError."""
        image = self._kept.pop(index, None)
        if image is None:
            try:
                image = read_picture(self._paths[index])
            except SourceError as error:
                raise SourceError(f"{self._paths[index]}, a second time: {error}") from None
        self.keep(index, image)
        return image


@dataclass(slots=True)
class PictureSet:
    """What is known of the pictures of a set, by their place in the list of paths.

    ``pictures`` hold reduced grey images with their features, ``small_from_full`` maps to their
    pixels from those of the files, whose sizes are ``full_sizes``; ``thumbnails`` are small copies
    in colour. ``covers`` (H, W) are 255 where a picture with transparency is opaque; opaque ones
    have none. ``skipped`` could not be read.
    """

    paths: tuple[Path, ...]
    cache: PictureCache
    pictures: dict[int, Picture] = field(default_factory=dict)
    small_from_full: dict[int, Matrix] = field(default_factory=dict)
    full_sizes: dict[int, Size] = field(default_factory=dict)
    thumbnails: dict[int, Image] = field(default_factory=dict)
    covers: dict[int, Image] = field(default_factory=dict)
    skipped: list[Skipped] = field(default_factory=list)

    def name(self, index: int) -> str:
        """The file's name without its folder."""
        return self.paths[index].name

    @property
    def sizes(self) -> dict[int, Size]:
        """Sizes of the reduced pictures."""
        return {index: picture.size_wh for index, picture in self.pictures.items()}

    @property
    def factors(self) -> dict[int, float]:
        """By how much each picture was reduced, 0..1."""
        return {index: float(matrix[0, 0]) for index, matrix in self.small_from_full.items()}


def load_pictures(
    paths: Sequence[Path],
    registrar: PictureRegistrar,
    settings: Settings,
    advance: Callable[[str], None],
    should_stop: Callable[[], bool],
) -> PictureSet:
    """Read all pictures and find their features; those that cannot be read are skipped.

    Large pictures are registered at up to 2 megapixels, less if there are very many.
    """
    max_bytes = settings.mosaic.max_memory_mb * 1e6
    found = PictureSet(tuple(paths), PictureCache(paths, max_bytes / 2))
    most_px = max(_LEAST_REGISTERED_PX, min(_MOST_REGISTERED_PX, max_bytes / 2 / len(paths)))
    for index, path in enumerate(paths):
        if should_stop():
            found.skipped.append(Skipped(index, path.name, "not read: interrupted before it"))
            continue
        try:
            image = read_picture(path)
            opacity = read_coverage(path)
        except (SourceError, OSError) as error:
            found.skipped.append(Skipped(index, path.name, str(error)))
            _log.warning("%s is left out: %s", path.name, error)
            continue
        found.cache.keep(index, image)
        if opacity is not None and opacity.shape == image.shape[:2]:
            found.covers[index] = np.asarray(opacity > 127, np.uint8) * np.uint8(255)
        found.full_sizes[index] = image.shape[1], image.shape[0]
        found.thumbnails[index] = _reduced(image, _THUMBNAIL_PX)
        small = _reduced(geometry.grey_of(image), most_px)
        found.small_from_full[index] = geometry.scaling(
            small.shape[1] / image.shape[1], small.shape[0] / image.shape[0]
        )
        picture = registrar.picture(index, path.name, small)
        if index in found.covers:
            size = picture.size_wh
            cover = cv2.resize(found.covers[index], size, interpolation=cv2.INTER_NEAREST)
            picture = replace(picture, cover=np.asarray(cover, np.uint8))
        found.pictures[index] = picture
        advance(path.name)
    return found


def _reduced(image: Image, most_px: float) -> Image:
    height, width = image.shape[:2]
    factor = float(np.sqrt(most_px / (height * width)))
    if factor >= 1:
        return image
    size = max(1, round(width * factor)), max(1, round(height * factor))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
