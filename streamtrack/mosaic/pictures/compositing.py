"""Painting a laid-out canvas: brightness, seams and blending, in bands of bounded memory.

Seams and gains are found on a small canvas from small copies of the pictures. The canvas itself
is painted in bands of rows, each with a margin that blending reaches into; within a band pictures
are warped one after the other and added up, so that memory does not grow with their number.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.mosaic.pictures.exposure import compensation_gains, overlap_ncc
from streamtrack.mosaic.pictures.projection import Box, Canvas, Patch
from streamtrack.mosaic.pictures.seams import SmallPatch, seam_masks
from streamtrack.mosaic.pictures.warping import warp
from streamtrack.settings import Blending, MosaicSettings
from streamtrack.types import Image, Size

_SEAM_PX = 60_000  # of one picture on the small canvas
_MOST_SMALL_PX = 6_000_000  # of the small canvas's patches together
_BYTES_A_PIXEL = 40  # that blending needs at most
_BLEND_SHARE = 0.05  # of the root of the canvas's area: how far pictures fade into each other
_MOST_LEVELS = 6
_FINE = 16  # OpenCV cuts off fractions at every level of the pyramids: of these, not of greys
_SHOULDER = 0.75  # of white: where brightening begins to spare what is bright already
_REACH = 3  # of a pyramid, in pixels of its coarsest level

_T = TypeVar("_T", np.uint8, np.float32)

PictureReader = Callable[[int], Image]
"""Reads a picture again by its index, (H, W) or (H, W, 3)."""


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """What is known before the canvas is painted.

    ``seams`` are the small masks of `Canvas.patches`, None where pictures are simply averaged;
    ``small`` is the small canvas they belong to. ``covers`` (H, W) tell where pictures with
    transparency are opaque.
    """

    canvas: Canvas
    small: Canvas
    seams: tuple[Image, ...] | None
    gains: dict[int, npt.NDArray[np.float64]]
    overlap_ncc: float
    covers: Mapping[int, Image]


def plan(
    canvas: Canvas,
    thumbnails: Mapping[int, Image],
    covers: Mapping[int, Image],
    settings: MosaicSettings,
) -> Plan:
    """Seams, gains and agreement of a canvas from ``thumbnails``, small copies of the pictures.

    ``covers`` are 0 where a picture with transparency shows nothing, by picture, in any size.
    """
    area = sum((p.box[2] - p.box[0]) * (p.box[3] - p.box[1]) for p in canvas.patches)
    share = min(_SEAM_PX * len(canvas.patches), _MOST_SMALL_PX) / max(area, 1)
    factor = min(1.0, float(np.sqrt(share)))
    small = _small_canvas(canvas, factor)
    patches = [_small_patch(patch, thumbnails, covers) for patch in small.patches]
    gains = compensation_gains(patches, [patch.picture for patch in small.patches])
    evened = [
        replace(p, image=_brightened(p.image, gains[patch.picture]))
        for p, patch in zip(patches, small.patches, strict=True)
    ]
    wants_seams = settings.blending != "average"
    seams = tuple(seam_masks(evened, small.size_wh)) if wants_seams else None
    return Plan(canvas, small, seams, gains, overlap_ncc(patches), covers)


def _small_canvas(canvas: Canvas, factor: float) -> Canvas:
    """The canvas reduced; its patches stay the same ones in the same order."""
    size = tuple(max(1, round(n * factor)) for n in canvas.size_wh)
    patches = []
    for patch in canvas.patches:
        x0, y0, x1, y1 = (np.array(patch.box) * factor).tolist()
        box = (
            min(int(x0), size[0] - 1),
            min(int(y0), size[1] - 1),
            max(int(x0) + 1, min(int(np.ceil(x1)), size[0])),
            max(int(y0) + 1, min(int(np.ceil(y1)), size[1])),
        )
        box = box[0], box[1], min(box[2], size[0]), min(box[3], size[1])
        patches.append(Patch(patch.picture, patch.view.scaled(factor), box))
    return Canvas((size[0], size[1]), tuple(patches), canvas.scale * factor)


def _small_patch(
    patch: Patch, thumbnails: Mapping[int, Image], covers: Mapping[int, Image]
) -> SmallPatch:
    image = thumbnails[patch.picture]
    full_width, full_height = patch.view.size_wh
    height, width = image.shape[:2]
    view = patch.view.of_resized(width / full_width, height / full_height, (width, height))
    warped, cover = warp(image, view, patch.box, "linear", covers.get(patch.picture))
    return SmallPatch(_in_colour(warped), cover, patch.box)


def _in_colour(image: Image) -> Image:
    if image.ndim == 3:
        return image
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)


def _brightened(image: Image, gain: npt.NDArray[np.float64]) -> Image:
    """BGR (h, w, 3) times a factor a colour; what would become whiter than white keeps shades."""
    if np.max(np.abs(gain - 1)) < 1 / 512:
        return image
    curves = np.stack([_tone_curve(float(one)) for one in gain], axis=1)
    return np.asarray(cv2.LUT(image, curves[None]), np.uint8)


def _tone_curve(gain: float) -> Image:
    """Grey levels (256,) times ``gain``, those beyond the shoulder bent so that white is white."""
    levels = np.arange(256) / 255.0
    if gain <= 1:
        return np.asarray(np.round(255 * gain * levels), np.uint8)
    start = _SHOULDER / gain
    beyond = (levels - start).clip(0) / (1 - start)
    steep = gain * (1 - start) / (1 - _SHOULDER)  # continues the straight part's slope
    bent = _SHOULDER + (1 - _SHOULDER) * steep * beyond / (1 + (steep - 1) * beyond)
    curve = np.where(levels < start, gain * levels, bent)
    return np.asarray(np.round(255 * curve), np.uint8)


# -- painting -----------------------------------------------------------------------------------


def painted_bands(
    planned: Plan, read: PictureReader, settings: MosaicSettings, advance: Callable[[], None]
) -> Iterator[Image]:
    """The mosaic from top to bottom in bands (n, width, 4): BGR, and 255 where there is any.

    ``read`` is called once for each picture in each band it touches.
    """
    width, height = planned.canvas.size_wh
    margin = _margin(planned.canvas, settings.blending)
    room = settings.max_memory_mb * 1e6 / _BYTES_A_PIXEL / width
    rows = height if room >= height else max(64, int(room) - 2 * margin)
    for top in range(0, height, rows):
        bottom = min(height, top + rows)
        band = max(0, top - margin), min(height, bottom + margin)
        painted = _painted(planned, band, read, settings, advance)
        yield painted[top - band[0] : bottom - band[0]]


def band_count(canvas: Canvas, settings: MosaicSettings) -> int:
    """How many bands `painted_bands` will give."""
    room = settings.max_memory_mb * 1e6 / _BYTES_A_PIXEL / canvas.size_wh[0]
    if room >= canvas.size_wh[1]:
        return 1
    rows = max(64, int(room) - 2 * _margin(canvas, settings.blending))
    return -(-canvas.size_wh[1] // rows)


def _blend_width(canvas: Canvas) -> float:
    return max(2.0, _BLEND_SHARE * float(np.sqrt(canvas.size_wh[0] * canvas.size_wh[1])))


def _levels(canvas: Canvas) -> int:
    """Levels of the pyramids: the coarsest fades over the blend width (as OpenCV's stitcher)."""
    levels = int(np.ceil(np.log2(_blend_width(canvas)))) - 1
    return max(1, min(_MOST_LEVELS, levels))


def _margin(canvas: Canvas, blending: Blending) -> int:
    if blending == "multiband":
        return int(_REACH * 2 ** _levels(canvas))
    return int(2 * _blend_width(canvas)) if blending == "feather" else 0


def _painted(
    planned: Plan,
    band: tuple[int, int],
    read: PictureReader,
    settings: MosaicSettings,
    advance: Callable[[], None],
) -> Image:
    size = planned.canvas.size_wh[0], band[1] - band[0]
    boxes = [
        _reached(planned, row, settings.blending) for row in range(len(planned.canvas.patches))
    ]
    zone = _zone(boxes, (0, band[0], size[0], band[1]), _REACH * 2 ** _levels(planned.canvas))
    blend = _BLENDS[settings.blending](size, planned.canvas, zone)
    for row, patch in enumerate(planned.canvas.patches):
        box = _common(boxes[row], (0, band[0], size[0], band[1]))
        if box[0] >= box[2] or box[1] >= box[3]:
            continue
        warped, cover = warp(
            read(patch.picture),
            patch.view,
            box,
            settings.warping,
            planned.covers.get(patch.picture),
        )
        image = _brightened(_in_colour(warped), planned.gains[patch.picture])
        mask = cover if planned.seams is None else _full_mask(planned, row, box)
        own = np.asarray(cv2.bitwise_and(mask, cover), np.uint8)
        blend.add(image, cover, own, (box[0], box[1] - band[0]))
        advance()
    return blend.result()


def _full_mask(planned: Plan, row: int, box: Box) -> Image:
    """A patch's seam mask on the full canvas: the small one, grown by a pixel and enlarged.

    Grown, so that neighbours meet: where two overlap, blending shares the pixel out.
    """
    assert planned.seams is not None
    small_box = planned.small.patches[row].box
    small_size, size = planned.small.size_wh, planned.canvas.size_wh
    grown = cv2.dilate(planned.seams[row], np.ones((3, 3), np.uint8))
    full_from_small = (
        np.linalg.inv(geometry.translation(box[0], box[1]))
        @ geometry.scaling(size[0] / small_size[0], size[1] / small_size[1])
        @ geometry.translation(small_box[0], small_box[1])
    )
    out = box[2] - box[0], box[3] - box[1]
    mask = cv2.warpAffine(
        grown, full_from_small[:2], out, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(cv2.threshold(mask, 127, 255, cv2.THRESH_BINARY)[1], np.uint8)


class _Blend(Protocol):
    """Pictures are added one by one; the result is BGR and coverage (h, w, 4)."""

    def add(self, image: Image, cover: Image, mask: Image, corner: tuple[int, int]) -> None:
        """``image`` (h, w, 3) covers ``cover`` and owns ``mask`` (h, w) of it."""
        ...

    def result(self) -> Image: ...


class _Overwriting:
    """No blending: each pixel is its owner's, hard seams."""

    def __init__(self, size_wh: Size, canvas: Canvas, zone: Box) -> None:
        self._pixels = np.zeros((size_wh[1], size_wh[0], 4), np.uint8)

    def add(self, image: Image, cover: Image, mask: Image, corner: tuple[int, int]) -> None:
        part = _part(self._pixels, mask, corner)
        # What is its own, and what nobody has taken so far (masks may miss a pixel at a border).
        is_empty = cv2.bitwise_and(cover, cv2.bitwise_not(cv2.extractChannel(part, 3)))
        pixels = cv2.cvtColor(image, cv2.COLOR_BGR2BGRA)
        cv2.copyTo(pixels, cv2.bitwise_or(mask, is_empty), part)

    def result(self) -> Image:
        return self._pixels


class _Weighting:
    """Weighted mean of all pictures at a pixel; the subclasses say with what weights."""

    def __init__(self, size_wh: Size, canvas: Canvas, zone: Box) -> None:
        self._sum = np.zeros((size_wh[1], size_wh[0], 3), np.float32)
        self._weight = np.zeros((size_wh[1], size_wh[0]), np.float32)
        self._width = _blend_width(canvas)

    def _weights(self, cover: Image, mask: Image) -> npt.NDArray[np.float32]:
        return np.asarray(cover, np.float32)

    def add(self, image: Image, cover: Image, mask: Image, corner: tuple[int, int]) -> None:
        weights = self._weights(cover, mask)
        _part(self._sum, mask, corner)[...] += image * weights[:, :, None]
        _part(self._weight, mask, corner)[...] += weights

    def result(self) -> Image:
        mean = self._sum / np.maximum(self._weight, 1e-6)[:, :, None]
        cover = np.where(self._weight > 0, 255, 0).astype(np.uint8)
        return np.dstack([np.rint(mean).astype(np.uint8), cover])


class _Feathering(_Weighting):
    """Seams fade over the blend width: the owner's mask, blurred, within the coverage."""

    def _weights(self, cover: Image, mask: Image) -> npt.NDArray[np.float32]:
        side = int(self._width) // 2 * 2 + 1
        soft = mask.astype(np.float32)
        for _ in range(2):
            soft = np.asarray(
                cv2.blur(soft, (side, side), borderType=cv2.BORDER_REPLICATE), np.float32
            )
        # A trace of every picture that covers a pixel, so that none is left empty.
        return np.where(cover > 0, soft + np.float32(0.01), np.float32(0))


class _Multiband:
    """Laplacian pyramids, coarse parts faded widely and fine ones sharply.

    Burt & Adelson 1983, "A multiresolution spline with application to image mosaics", as in
    OpenCV's `detail::MultiBandBlender`. Only the box that blending reaches from the overlaps is
    put through it; elsewhere a picture is itself.
    """

    def __init__(self, size_wh: Size, canvas: Canvas, zone: Box) -> None:
        self._plain = _Overwriting(size_wh, canvas, zone)
        self._zone = zone
        x0, y0, x1, y1 = zone
        self._is_empty = x0 >= x1 or y0 >= y1
        if not self._is_empty:
            self._blender = cv2.detail.MultiBandBlender(0, _levels(canvas), cv2.CV_32F)
            self._blender.prepare((0, 0, x1 - x0, y1 - y0))

    def add(self, image: Image, cover: Image, mask: Image, corner: tuple[int, int]) -> None:
        self._plain.add(image, cover, mask, corner)
        box = *corner, corner[0] + mask.shape[1], corner[1] + mask.shape[0]
        x0, y0, x1, y1 = _common(box, self._zone)
        if self._is_empty or x0 >= x1 or y0 >= y1:
            return
        part = slice(y0 - box[1], y1 - box[1]), slice(x0 - box[0], x1 - box[0])
        if cv2.countNonZero(mask[part]):
            place = x0 - self._zone[0], y0 - self._zone[1]
            fine = np.multiply(image[part], _FINE, dtype=np.int16)
            self._blender.feed(fine, mask[part], place)

    def result(self) -> Image:
        pixels = self._plain.result()
        x0, y0, x1, y1 = self._zone
        if self._is_empty:
            return pixels
        zone = pixels[y0:y1, x0:x1]
        cover = np.ascontiguousarray(zone[:, :, 3])
        if not cv2.countNonZero(cover):
            return pixels
        found, found_cover = self._blender.blend(np.zeros(0, np.int16), np.zeros(0, np.uint8))
        levels = np.asarray(found, np.int16)
        blended = np.asarray(cv2.convertScaleAbs(np.maximum(levels, 0), alpha=1 / _FINE), np.uint8)
        mixed = cv2.bitwise_and(np.asarray(found_cover, np.uint8), cover)
        cv2.copyTo(cv2.cvtColor(blended, cv2.COLOR_BGR2BGRA), mixed, zone)
        return pixels


def _common(a: Box, b: Box) -> Box:
    return max(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), min(a[3], b[3])


def _reached(planned: Plan, row: int, blending: Blending) -> Box:
    """The part of a patch's box in which the mosaic is its, or blending reaches that; or none."""
    box = planned.canvas.patches[row].box
    if planned.seams is None:
        return box
    x, y, width, height = cv2.boundingRect(planned.seams[row])
    if not width:
        return 0, 0, 0, 0
    small_box, small_size = planned.small.patches[row].box, planned.small.size_wh
    x_factor, y_factor = np.array(planned.canvas.size_wh) / small_size
    # The small mask grows by a pixel, and its own pixels lie half a pixel off.
    margin = _margin(planned.canvas, blending) + 2 * max(x_factor, y_factor)
    x0, y0 = x + small_box[0], y + small_box[1]
    reached = (
        int(x0 * x_factor - margin),
        int(y0 * y_factor - margin),
        int((x0 + width) * x_factor + margin) + 1,
        int((y0 + height) * y_factor + margin) + 1,
    )
    return _common(box, reached)


def _zone(reached: Sequence[Box], band: Box, margin: int) -> Box:
    """The box within a band, its first row 0, that holds all overlaps and what blends into them."""
    boxes = [_common(a, b) for i, a in enumerate(reached) for b in reached[:i]]
    real = [box for box in boxes if box[0] < box[2] and box[1] < box[3]]
    if not real:
        return 0, 0, 0, 0
    corners = np.array(real)
    x0, y0 = (int(v) - margin for v in corners[:, :2].min(axis=0))
    x1, y1 = (int(v) + margin for v in corners[:, 2:].max(axis=0))
    box = _common((x0, y0, x1, y1), band)
    return box[0], box[1] - band[1], box[2], box[3] - band[1]


def _part(canvas: npt.NDArray[_T], patch: Image, corner: tuple[int, int]) -> npt.NDArray[_T]:
    x, y = corner
    return canvas[y : y + patch.shape[0], x : x + patch.shape[1]]


_BLENDS: dict[str, Callable[[Size, Canvas, Box], _Blend]] = {
    "none": _Overwriting,
    "average": _Weighting,
    "feather": _Feathering,
    "multiband": _Multiband,
}
