"""From pixels that stand out to things: connected, trimmed of their shadows, with their motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.auto.background import Outstanding
from streamtrack.auto.boxes import HasBox, box_around, moved_point
from streamtrack.auto.motion import Motion
from streamtrack.types import Image, Mask, Matrix

Doubles: TypeAlias = npt.NDArray[np.float64]

_CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)
_LEAST_PIXELS = 14  # of the grid
_LEAST_CLEAR = 6
_CLOSING_PX = 3
_SHADE_CLOSING_PX = 9
_MOST_BLOBS = 80
_FASTEST_PX = 14.0  # grid pixels a frame that flow still measures
_BINS = 4  # a channel
_FRAGMENT_GAP_PX = 5.0  # grid pixels
_FRAGMENT_SHARE = 0.3  # of the area of the thing it belongs to
_ALIKE_PX = 0.8  # grid pixels a frame, between motions of parts of one thing
_SPLIT_PIXELS = 60
_SPLIT_SHARE = 0.22
_SPLIT_PX = 1.0  # grid pixels a frame between the motions of two things that touch
_SPLIT_SPEED_SHARE = 0.3  # of the mean motion
_TIGHT = 0.45  # spread within the parts against the distance between them


@dataclass(frozen=True, slots=True, eq=False)
class Blob(HasBox):
    """One thing that stands out.

    box       (4,) x0, y0, x1, y1, full-resolution pixels of the frame
    motion    (2,) full-resolution pixels since the frame before, against the background; NaN if
              that is not known
    colors    (64,) histogram of its colours, sums to 1
    """

    box: Doubles
    motion: Doubles
    colors: Doubles


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What moves in one frame: the blobs, the pixels (h, w) they consist of, and the motion there.

    ``motion`` (h, w, 2) are grid pixels since the frame before, None if that is not known;
    ``image`` (h, w, 3) is the frame in the grid.
    """

    blobs: tuple[Blob, ...]
    solid: Mask
    motion: npt.NDArray[np.float32] | None
    image: Image
    grid_from_frame: Doubles


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """What blobs are described by: `color_bins` (h, w), motion (h, w, 2), frame_from_grid."""

    colors: Image
    motion: npt.NDArray[np.float32] | None
    frame_from_grid: Matrix


def find_blobs(outstanding: Outstanding, hidden: Mask, motion: Motion) -> Scene:
    """The things that stand out outside ``hidden`` (h, w), the largest first."""
    clear = outstanding.clear & ~hidden
    solid = np.zeros(clear.shape, np.bool_)
    blobs: list[Blob] = []
    flow = motion.flow
    if clear.any():
        joined = _joined(clear, outstanding.faint & ~hidden, outstanding.shade)
        joined[motion.rests] = 0
        count, parts, stats, _ = cv2.connectedComponentsWithStats(joined, connectivity=4)
        clear_counts = np.bincount(parts[clear], minlength=count)
        areas = stats[:, cv2.CC_STAT_AREA]
        is_kept = (areas >= _LEAST_PIXELS) & (clear_counts >= _LEAST_CLEAR)
        is_kept[0] = False
        kept = np.flatnonzero(is_kept)
        look = _Look(
            color_bins(outstanding.image), flow, geometry.inverted(outstanding.grid_from_frame)
        )
        for part in kept[np.argsort(-areas[kept])][:_MOST_BLOBS]:
            x, y, width, height = stats[part, :4].tolist()
            window = slice(y, y + height), slice(x, x + width)
            inside = parts[window] == part
            for piece in [inside] if flow is None else _split(inside, flow[window]):
                solid[window] |= piece
                blobs.append(_blob(piece, window, look))
    blobs = _with_fragments(blobs, frame_px(outstanding))
    return Scene(tuple(blobs), solid, flow, outstanding.image, outstanding.grid_from_frame)


def _with_fragments(blobs: list[Blob], grid_px: float) -> list[Blob]:
    """The blobs, the small ones made part of a larger one beside them that moves alike."""
    if len(blobs) < 2:
        return blobs
    blobs = sorted(blobs, key=lambda blob: -float(np.prod(blob.size)))
    boxes = np.stack([blob.box for blob in blobs])
    motions = np.stack([blob.motion for blob in blobs])
    gaps = (boxes[:, None, :2] - boxes[None, :, 2:]).max(axis=2)
    apart = np.linalg.norm(motions[:, None] - motions[None], axis=2)
    is_alike = apart < _ALIKE_PX * grid_px
    may_belong = is_alike & (np.maximum(gaps, gaps.T) <= _FRAGMENT_GAP_PX * grid_px)
    kept: dict[int, Blob] = {}
    for index, blob in enumerate(blobs):
        beside = [row for row in np.flatnonzero(may_belong[index, :index]).tolist() if row in kept]
        whole = next((row for row in beside if _is_fragment(blob, kept[row])), None)
        if whole is None:
            kept[index] = blob
        else:
            kept[whole] = united_blob([kept[whole], blob])
    return list(kept.values())


def _is_fragment(blob: Blob, larger: Blob) -> bool:
    """Is a blob a part of a larger one beside it that moves alike?"""
    sides = np.minimum(blob.box[2:], larger.box[2:]) - np.maximum(blob.box[:2], larger.box[:2])
    area = float(np.prod(blob.size))
    is_inside = bool((sides > 0).all()) and float(np.prod(sides)) > 0.5 * area
    return is_inside or area < _FRAGMENT_SHARE * float(np.prod(larger.size))


def united_blob(parts: Sequence[Blob]) -> Blob:
    """Parts of one thing as one blob, with the motion of the largest."""
    areas = np.array([float(np.prod(part.size)) for part in parts])
    shares = areas / areas.sum()
    largest = parts[int(np.argmax(areas))]
    boxes = np.stack([part.box for part in parts])
    box = np.concatenate([boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)])
    return replace(largest, box=box, colors=shares @ np.stack([part.colors for part in parts]))


def frame_px(outstanding: Outstanding) -> float:
    """Pixels of the frame a pixel of the grid."""
    height, width = outstanding.clear.shape
    frame_from_grid = geometry.inverted(outstanding.grid_from_frame)
    return geometry.local_scale(frame_from_grid, np.array([width / 2, height / 2]))


def _joined(clear: Mask, faint: Mask, shade: Mask) -> Image:
    """What differs (h, w), without its shadows and with its gaps closed."""
    differing = ((faint | clear) & ~shade).astype(np.uint8)
    solid = np.asarray(cv2.morphologyEx(cv2.medianBlur(differing, 3), cv2.MORPH_OPEN, _CROSS))
    closed = cv2.morphologyEx(solid, cv2.MORPH_CLOSE, _ellipse(_CLOSING_PX))
    within = cv2.morphologyEx(solid, cv2.MORPH_CLOSE, _ellipse(_SHADE_CLOSING_PX))
    return np.asarray(cv2.bitwise_or(closed, cv2.bitwise_and(within, shade.astype(np.uint8))))


def _ellipse(side_px: int) -> Image:
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side_px, side_px))
    return np.asarray(kernel, np.uint8)


def _split(inside: Mask, motion: npt.NDArray[np.float32]) -> list[Mask]:
    """Two parts if the pixels move in two ways that keep apart, in the picture too."""
    deviations = cv2.meanStdDev(motion, mask=inside.view(np.uint8))[1]
    if float(np.hypot(*deviations.ravel())) < 0.5 * _SPLIT_PX:
        return [inside]
    moved = motion[inside].astype(np.float64)
    if len(moved) < _SPLIT_PIXELS:
        return [inside]
    middle = moved.mean(axis=0)
    spread = moved - middle
    (xx, xy), (_, yy) = (spread.T @ spread / len(moved)).tolist()
    largest_variance = 0.5 * (xx + yy + math.hypot(xx - yy, 2 * xy))
    if largest_variance < (0.5 * _SPLIT_PX) ** 2:
        return [inside]
    turn = 0.5 * math.atan2(2 * xy, xx - yy)
    along = spread @ np.array([math.cos(turn), math.sin(turn)])
    cut, low, high = 0.0, along, along
    for _ in range(4):  # two means along the main axis of the motions
        low, high = along[along < cut], along[along >= cut]
        if not len(low) or not len(high):
            return [inside]
        cut = 0.5 * (float(low.mean()) + float(high.mean()))
    apart = float(high.mean() - low.mean())
    within = float(np.sqrt((low.var() * len(low) + high.var() * len(high)) / len(along)))
    speed = float(np.hypot(*middle))  # flow errs with it
    if apart < max(_SPLIT_PX, _SPLIT_SPEED_SHARE * speed) or within > _TIGHT * apart:
        return [inside]
    is_high = np.zeros_like(inside)
    is_high[inside] = along >= cut
    is_high = (cv2.medianBlur(is_high.astype(np.uint8), 5) > 0) & inside
    parts = [_largest(is_high), _largest(inside & ~is_high)]
    if min(np.count_nonzero(part) for part in parts) < _SPLIT_SHARE * len(moved):
        return [inside]
    return parts


def _largest(mask: Mask) -> Mask:
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    if count <= 1:
        return mask
    largest: Mask = labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    return largest


def _blob(piece: Mask, window: tuple[slice, slice], look: _Look) -> Blob:
    x, y, width, height = cv2.boundingRect(piece.view(np.uint8))
    low = np.array([window[1].start + x - 0.5, window[0].start + y - 0.5])
    size = np.array([width, height], np.float64)
    center, scale = moved_point(look.frame_from_grid, low + 0.5 * size)
    box = box_around(center, scale * size)
    moved = np.full(2, np.nan)
    if look.motion is not None:
        moves = look.motion[window][piece]
        middle = np.partition(moves, len(moves) // 2, axis=0)[len(moves) // 2].astype(np.float64)
        if np.abs(middle).max() <= _FASTEST_PX:
            moved = middle * scale
    counts = np.bincount(look.colors[window][piece], minlength=_BINS**3)
    return Blob(box, moved, counts / max(1, int(counts.sum())))


def color_bins(image: Image) -> Image:
    """Which of the 64 colours each pixel (h, w) of a picture (h, w, 3) has."""
    blue, green, red = (np.asarray(channel, np.uint8) >> 6 for channel in cv2.split(image))
    return np.asarray((blue << 4) | (green << 2) | red, np.uint8)
