"""Painting one frame into a canvas: only what is new is warped, and blended at its borders.

A frame is compared with the canvas at a quarter of the size; where the canvas is empty, and a few
pixels around, it is painted. It carries a weight that falls from its centre to nothing at its
edge: of two frames the heavier wins, with a feather a few pixels wide where they weigh the same.
Where a frame and the canvas show different things, what stands stays (first come, first kept)
until re-rendering has samples enough to judge.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.mosaic.stream.tiles import Box, common_box, tile_box, tile_keys
from streamtrack.types import Image, Matrix, Points, Size, Track

MOST_AREA = 4.0
"""A frame whose warped box has more than this many times its area is not painted."""

LEAST_WEIGHT = 8
"""Weight of a frame at its very edge; whatever is lighter after warping lies beyond it."""

FEATHER = 6
"""Weight levels (of 255) over which one frame fades into another."""

SHRINK = 4
"""Frame and canvas are compared so many times smaller."""

_DOUBTED = np.where(np.arange(256) > 0, np.maximum(np.arange(256) >> 5, 1), 0).astype(np.uint8)
_EDGE_PX = 12.0
_LEAST_AREA = 16.0
_TARGET_MARGIN = 0.08
_NOISE_LEVELS = 22.0
_KERNEL_3, _KERNEL_5, _KERNEL_9 = (np.ones((side, side), np.uint8) for side in (3, 5, 9))


def refusal(canvas_from_frame: Matrix, size_wh: Size, extent: float) -> str:
    """Why a frame cannot be painted so, or an empty string.

    ``extent`` is how far from the origin, in pixels, a canvas may reach.
    """
    quad = geometry.image_quad(size_wh)
    if not np.isfinite(canvas_from_frame).all():
        return "its pose is not finite"
    depths = geometry.projective_depths(canvas_from_frame, quad)
    if not (np.all(depths > 0) or np.all(depths < 0)):
        return "it would fold over the horizon"
    warped = geometry.transform_points(canvas_from_frame, quad)
    x0, y0, x1, y1 = geometry.bounding_box(warped)
    if abs(geometry.signed_area(warped)) < _LEAST_AREA:
        return "it would shrink to nothing"
    if not geometry.is_convex(warped) or geometry.signed_area(warped) <= 0:
        return "it would be mirrored or folded"
    times = (x1 - x0) * (y1 - y0) / max(1, (size_wh[0] - 1) * (size_wh[1] - 1))
    if times > MOST_AREA:
        return f"its warped box would have {times:.1f} times its area ({MOST_AREA:g} at most)"
    if max(abs(x0), abs(y0), abs(x1), abs(y1)) > extent:
        return f"it lies more than {extent:.0f} px from the origin"
    return ""


@lru_cache(maxsize=4)
def centre_weight(size_wh: Size) -> Image:
    """Weight (H, W) uint8: 255 at the centre, falling with the distance.

    Over the last few pixels it falls to `LEAST_WEIGHT`, so that no frame ends in a hard edge.
    """
    width, height = size_wh
    x = np.abs(np.arange(width) - (width - 1) / 2)[None, :]
    y = np.abs(np.arange(height) - (height - 1) / 2)[:, None]
    radius = math.hypot(width / 2, height / 2)
    fall = 1.0 - 0.9 * np.hypot(x, y) / radius
    to_edge = np.minimum((width - 1) / 2 - x, (height - 1) / 2 - y)
    ramp = min(_EDGE_PX, min(size_wh) / 8)
    weight = 255.0 * fall * np.clip(to_edge / max(ramp, 1.0), 0.0, 1.0)
    least: Image = np.maximum(np.rint(weight), LEAST_WEIGHT).astype(np.uint8)
    least.setflags(write=False)
    return least


def target_quads(tracks: Sequence[Track]) -> tuple[Points, ...]:
    """The targets' quads, a little larger, for what is on them does not belong to the ground."""
    quads = []
    for track in tracks:
        if track.quad is not None and np.isfinite(track.quad).all():
            centre = track.quad.mean(axis=0)
            grown = centre + (track.quad - centre) * (1 + _TARGET_MARGIN)
            quads.append(np.asarray(grown, np.float32))
    return tuple(quads)


def weighted(image: Image, quads: Sequence[Points] = (), scale: float = 1.0) -> Image:
    """A frame at ``scale`` as BGRW pixels (H, W, 4), weightless inside the quads (frame px)."""
    bgr = image
    if image.ndim == 2:
        bgr = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
    if scale != 1.0:
        bgr = _resized(bgr, scaled_size((image.shape[1], image.shape[0]), scale))
    weight = centre_weight((bgr.shape[1], bgr.shape[0]))
    if quads:
        weight = weight.copy()
        to_scale = geometry.scaling(bgr.shape[1] / image.shape[1], bgr.shape[0] / image.shape[0])
        for quad in quads:
            inside = np.clip(geometry.transform_points(to_scale, quad), -(2**14), 2**14)
            cv2.fillPoly(weight, [np.rint(inside).astype(np.int32)], 0)
    pixels = cv2.cvtColor(bgr, cv2.COLOR_BGR2BGRA)
    return np.asarray(cv2.insertChannel(weight, pixels, 3), np.uint8)


def scaled_size(size_wh: Size, scale: float) -> Size:
    """A size in whole pixels at a scale, at least 1x1."""
    return max(1, round(size_wh[0] * scale)), max(1, round(size_wh[1] * scale))


def box_of(canvas_from_frame: Matrix, size_wh: Size) -> Box:
    """The pixels of the canvas that a frame can touch, in whole blocks of 4 x 4."""
    quad = geometry.transform_points(canvas_from_frame, geometry.image_quad(size_wh))
    x0, y0, x1, y1 = (value / SHRINK for value in geometry.bounding_box(quad))
    left, top = math.floor(x0) * SHRINK, math.floor(y0) * SHRINK
    return left, top, (math.floor(x1) + 1) * SHRINK, (math.floor(y1) + 1) * SHRINK


def warped(
    pixels: Image, canvas_from_pixels: Matrix, box: Box, flags: int = cv2.INTER_LINEAR
) -> Image:
    """BGRW pixels as seen in a box of the canvas; weightless outside the frame."""
    into_box = geometry.translation(-box[0], -box[1]) @ canvas_from_pixels
    size = box[2] - box[0], box[3] - box[1]
    result = cv2.warpPerspective(pixels, into_box, size, flags=flags)
    # Beyond the edge colours and weight fall to 0 together: such mixtures with black are left out.
    weight = cv2.extractChannel(result, 3)
    weight = cv2.threshold(weight, LEAST_WEIGHT - 1, 0, cv2.THRESH_TOZERO)[1]
    return np.asarray(cv2.insertChannel(weight, result, 3), np.uint8)


def doubted(pixels: Image, doubts: Image, canvas_from_doubts: Matrix, box: Box) -> Image:
    """BGRW pixels in a box of the canvas, lighter than `LEAST_WEIGHT` where ``doubts`` are 255.

    Such a pixel is shown only where no other is.
    """
    into_box = geometry.translation(-box[0], -box[1]) @ canvas_from_doubts
    there = cv2.warpPerspective(doubts, into_box, (pixels.shape[1], pixels.shape[0]))
    weight = cv2.extractChannel(pixels, 3)
    cv2.copyTo(cv2.LUT(weight, _DOUBTED), cv2.inRange(there, 128, 255), weight)
    return np.asarray(cv2.insertChannel(weight, pixels.copy(), 3), np.uint8)


def shrunk(pixels: Image) -> Image:
    """Pixels of any size at a quarter of it, in whole pixels."""
    return _resized(pixels, scaled_size((pixels.shape[1], pixels.shape[0]), 1 / SHRINK))


def quarter(box: Box) -> Box:
    """A box of whole blocks of 4 x 4 pixels, in such blocks."""
    return box[0] // SHRINK, box[1] // SHRINK, box[2] // SHRINK, box[3] // SHRINK


def with_gain(pixels: Image, log_gain: npt.NDArray[np.float64]) -> Image:
    """BGRW pixels with each colour multiplied by exp(log_gain), the weight untouched."""
    table = _gain_table(tuple(log_gain.tolist()))
    return pixels if table is None else np.asarray(cv2.LUT(pixels, table), np.uint8)


@lru_cache(maxsize=64)
def _gain_table(log_gain: tuple[float, ...]) -> Image | None:
    """What each value of each channel becomes (1, 256, 4); None if all stay as they are."""
    if max(abs(gain) for gain in log_gain) < 0.004:
        return None
    factors = np.append(np.exp(log_gain), 1.0)
    table: Image = np.rint(np.minimum(np.arange(256.0)[:, None] * factors, 255)).astype(np.uint8)
    return table[None]


def quartered(pixels: Image) -> Image:
    """A picture at a quarter of its size, which must be a multiple of 4; each pixel a mean."""
    return _resized(pixels, (pixels.shape[1] // SHRINK, pixels.shape[0] // SHRINK))


def _resized(pixels: Image, size_wh: Size) -> Image:
    """Pixels at another size, each a mean where it is smaller.

    Halved as often as that comes out even: seven times as fast as all at once.
    """
    height, width = pixels.shape[:2]
    while width >= 2 * size_wh[0] and height >= 2 * size_wh[1] and not (width | height) % 2:
        width, height = width // 2, height // 2
        pixels = np.asarray(cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA))
    if (width, height) != size_wh:
        method = cv2.INTER_AREA if size_wh[0] < width else cv2.INTER_LINEAR
        pixels = np.asarray(cv2.resize(pixels, size_wh, interpolation=method))
    return pixels


def disagreement(small_old: Image, small_new: Image) -> Image:
    """Where two BGRW pictures of one place, at a quarter of their size, show different things.

    255 there: where they are `unlike`, and in gaps, for a thing is as bright as what it hides here
    and there.
    """
    found = unlike(small_old, small_new, _NOISE_LEVELS)
    if cv2.countNonZero(found):
        found = np.asarray(cv2.morphologyEx(found, cv2.MORPH_CLOSE, _KERNEL_9), np.uint8)
        found = np.asarray(cv2.dilate(found, _KERNEL_5), np.uint8)
    return found


def unlike(small_old: Image, small_new: Image, levels: float) -> Image:
    """Where two BGRW pictures of one place, at a quarter of their size, have other colours.

    255 where these, averaged over about 12 px, differ by more than noise (``levels``) and the
    structure itself (a quarter of its local range: edges that are half a pixel off are no objects)
    explain.
    """
    both = cv2.min(cv2.extractChannel(small_old, 3), cv2.extractChannel(small_new, 3))
    b, g, r, _ = cv2.split(cv2.blur(cv2.absdiff(small_old, small_new), (3, 3)))
    worst = cv2.max(cv2.max(b, g), r)
    worst = cv2.min(worst, cv2.threshold(both, 0, 255, cv2.THRESH_BINARY)[1])
    found = cv2.inRange(worst, levels, 255)
    if not cv2.countNonZero(found):
        return np.asarray(found, np.uint8)
    grey = cv2.cvtColor(small_old, cv2.COLOR_BGRA2GRAY)
    spread = cv2.morphologyEx(grey, cv2.MORPH_GRADIENT, _KERNEL_3)
    excess = cv2.subtract(worst, cv2.convertScaleAbs(spread, alpha=0.25, beta=levels))
    found = cv2.threshold(excess, 0, 255, cv2.THRESH_BINARY)[1]
    return np.asarray(cv2.morphologyEx(found, cv2.MORPH_OPEN, _KERNEL_3), np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """A frame against the canvas in a box, at a quarter of its size, uint8 (H / 4, W / 4).

    ``new`` is 255 where the canvas was empty and a few pixels around; ``differs`` is 255 where
    both show something, and not the same.
    """

    box: Box
    new: Image
    differs: Image

    def parts(self) -> list[Box]:
        """The parts of the box that are to be painted, none larger than a tile."""
        x0, y0, _, _ = self.box
        found: list[Box] = []
        for key in tile_keys(self.box):
            left, top, right, bottom = common_box(tile_box(key), self.box)
            inside = self.new[_quarter(top - y0, bottom - y0), _quarter(left - x0, right - x0)]
            x, y, width, height = (side * SHRINK for side in cv2.boundingRect(inside))
            if width:
                found.append((left + x, top + y, left + x + width, top + y + height))
        return found

    def differs_in(self, part: Box) -> Image:
        """``differs`` in a part of the box, at a quarter of its size."""
        x0, y0, _, _ = self.box
        return self.differs[
            _quarter(part[1] - y0, part[3] - y0), _quarter(part[0] - x0, part[2] - x0)
        ]


def _quarter(start: int, stop: int) -> slice:
    return slice(start // SHRINK, stop // SHRINK)


def compared(box: Box, small_old: Image, small_new: Image) -> Comparison:
    """Where in a box of the canvas a frame (both BGRW, a quarter of its size) shows other things.

    The sides of the box are multiples of 4.
    """
    old, now = cv2.extractChannel(small_old, 3), cv2.extractChannel(small_new, 3)
    is_better = cv2.bitwise_and(
        cv2.inRange(old, 1, LEAST_WEIGHT - 1), cv2.inRange(now, LEAST_WEIGHT, 255)
    )
    is_first = cv2.bitwise_and(cv2.inRange(old, 0, 0), cv2.inRange(now, 1, 255))
    new = cv2.dilate(cv2.bitwise_or(is_first, is_better), _KERNEL_9)
    differs = cv2.subtract(disagreement(small_old, small_new), is_better)
    return Comparison(box, np.asarray(new, np.uint8), np.asarray(differs, np.uint8))


def paint(old: Image, new: Image, differs: Image) -> Image:
    """Paint ``new`` over the canvas pixels ``old``, both BGRW (H, W, 4); neither is changed.

    What stands stays where ``differs``, at a quarter of the size, is not 0.
    """
    old_weight, new_weight = cv2.extractChannel(old, 3), cv2.extractChannel(new, 3)
    slope = 128.0 / FEATHER
    lead = cv2.addWeighted(new_weight, slope, old_weight, -slope, 128.0)
    if cv2.countNonZero(differs):
        size = lead.shape[1], lead.shape[0]
        lead = cv2.subtract(lead, cv2.resize(differs, size, interpolation=cv2.INTER_LINEAR))
    lead = cv2.bitwise_or(lead, cv2.inRange(old_weight, 0, 0))
    return _blended(old, new, np.asarray(cv2.copyTo(lead, new_weight), np.uint8))


def _blended(old: Image, new: Image, alpha: Image) -> Image:
    """``new`` over ``old`` (H, W, 4) by the share ``alpha`` (H, W) of 255."""
    result = old.copy()
    cv2.copyTo(new, cv2.inRange(alpha, 255, 255), result)
    mixed = cv2.inRange(alpha, 1, 254) > 0  # thin lines between frames
    share = alpha[mixed].astype(np.float32)[:, None] / np.float32(255)
    before = old[mixed].astype(np.float32)
    result[mixed] = np.rint(before + share * (new[mixed] - before))
    return result
