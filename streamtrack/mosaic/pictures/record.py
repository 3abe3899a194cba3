"""A mosaic of pictures as a recording: what it was made of, gathered from the run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from streamtrack import geometry
from streamtrack.mosaic.pictures.loading import PictureSet
from streamtrack.mosaic.pictures.projection import Canvas
from streamtrack.mosaic.summary import MosaicSummary
from streamtrack.mosaic.types import Link, Picture
from streamtrack.types import Image, Points, Size

_MOST_SIDE = 2048


class SmallCopy:
    """A copy of a picture of at most 2048 px a side, made of its bands as they come by.

    ``image`` (h, w, 3) is black where nothing is painted.
    """

    def __init__(self, size_wh: Size) -> None:
        self.factor = min(1.0, _MOST_SIDE / max(size_wh))
        width, height = (max(1, round(n * self.factor)) for n in size_wh)
        self.image: Image = np.zeros((height, width, 3), np.uint8)

    def watched(self, bands: Iterator[Image]) -> Iterator[Image]:
        """The bands (n, width, 4) of BGR and coverage, from top to bottom, as they are."""
        top = 0
        for band in bands:
            bottom = top + band.shape[0]
            rows = slice(round(top * self.factor), round(bottom * self.factor))
            part = self.image[rows]
            if part.size:
                size = part.shape[1], part.shape[0]
                part[:] = cv2.resize(band[:, :, :3], size, interpolation=cv2.INTER_AREA)
                cover = cv2.resize(band[:, :, 3], size, interpolation=cv2.INTER_NEAREST)
                part[cover == 0] = 0
            top = bottom
            yield band


def record_run(
    path: Path,
    found: PictureSet,
    links: Sequence[Link],
    canvas: Canvas | None,
    copy: SmallCopy | None,
    summary: MosaicSummary,
) -> None:
    """Write the recording of a run, whatever came of it. Raises OutputError, SourceError."""
    from streamtrack.recording.pictures import record_picture_mosaic

    is_painted = canvas is not None and copy is not None
    record_picture_mosaic(
        path,
        [_in_colour(found, index) for index in sorted(found.pictures)],
        links,
        summary.images,
        copy.image if is_painted and copy is not None else None,
        _outlines(canvas, copy.factor) if canvas is not None and copy is not None else {},
        summary.to_markdown(),
    )


def _in_colour(found: PictureSet, index: int) -> Picture:
    """The picture at the size it was registered at, as a person wants to see it."""
    picture = found.pictures[index]
    image = found.cache.read(index)
    if image.shape[1::-1] != picture.size_wh:
        image = np.asarray(cv2.resize(image, picture.size_wh, interpolation=cv2.INTER_AREA))
    return replace(picture, image=np.asarray(image, np.uint8))


def _outlines(canvas: Canvas, factor: float) -> dict[int, Points]:
    small_from_canvas = geometry.scaling(factor)
    return {
        patch.picture: geometry.transform_points(small_from_canvas, patch.view.outline())
        for patch in canvas.patches
    }
