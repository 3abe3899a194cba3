"""Brightness of the pictures against each other, and how well they agree where they overlap."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.fitting import median
from streamtrack.mosaic.gains import GainEdge, solve_gains
from streamtrack.mosaic.pictures.seams import SmallPatch
from streamtrack.types import Image, Mask

_MIN_OVERLAP_PX = 60
_ENOUGH_PX = 8000  # every other pixel of a larger overlap tells as much
_DARKEST, _BRIGHTEST = (9, 9, 9), (246, 246, 246)  # beyond, brightness is cut off
Doubles = npt.NDArray[np.float64]


def compensation_gains(
    patches: Sequence[SmallPatch], pictures: Sequence[int]
) -> dict[int, Doubles]:
    """One factor a colour (3,) for each picture, so that overlaps come out equally bright.

    Brown & Lowe 2007, section 6, in logarithms (see `gains`); the ratio of an overlap is that of
    the medians, which moving things do not sway. ``pictures`` names the picture of each patch.
    """
    row = {picture: i for i, picture in enumerate(sorted(set(pictures)))}
    edges = []
    for a, b, image_a, image_b, both in _overlaps(patches):
        if pictures[a] == pictures[b]:
            continue
        if both.size > _ENOUGH_PX:
            image_a, image_b, both = image_a[::2, ::2], image_b[::2, ::2], both[::2, ::2]
        fit = both & _is_exposed(image_a) & _is_exposed(image_b)
        count = int(np.count_nonzero(fit))
        if count < _MIN_OVERLAP_PX:
            continue
        logs_a = np.log(image_a[fit].astype(np.float32))
        logs_b = np.log(image_b[fit].astype(np.float32))
        log_ratio = np.array([median(channel) for channel in (logs_b - logs_a).T])
        share = count / min(patches[a].cover.size, patches[b].cover.size)
        edges.append(GainEdge(row[pictures[a]], row[pictures[b]], log_ratio, min(1.0, share)))
    logs = solve_gains(len(row), edges)
    # Only relations are known: overall, the mosaic stays as bright as its pictures.
    factors = np.exp(logs - logs.mean(axis=0))
    return {picture: factors[i] for picture, i in row.items()}


def _is_exposed(image: Image) -> Mask:
    """Where (h, w) no colour of BGR (h, w, 3) is black or white."""
    return np.asarray(cv2.inRange(image, _DARKEST, _BRIGHTEST) > 0, np.bool_)


def overlap_ncc(patches: Sequence[SmallPatch]) -> float:
    """Normalised cross-correlation of grey values, mean over all overlaps by their area.

    On the small canvas, so it tells of agreement to within a few pixels. NaN without overlap.
    """
    total, weight = 0.0, 0
    for _, _, image_a, image_b, both in _overlaps(patches):
        a = cv2.cvtColor(image_a, cv2.COLOR_BGR2GRAY)[both].astype(np.float64)
        b = cv2.cvtColor(image_b, cv2.COLOR_BGR2GRAY)[both].astype(np.float64)
        deviation = float(a.std() * b.std())
        if len(a) >= _MIN_OVERLAP_PX and deviation > 1e-6:
            total += len(a) * float(np.mean((a - a.mean()) * (b - b.mean()))) / deviation
            weight += len(a)
    return total / weight if weight else float("nan")


def _overlaps(
    patches: Sequence[SmallPatch],
) -> Iterator[tuple[int, int, npt.NDArray[np.uint8], npt.NDArray[np.uint8], npt.NDArray[np.bool_]]]:
    """For each two patches that overlap: their rows, both cut to the common box, both covered."""
    for i in range(len(patches)):
        for j in range(i + 1, len(patches)):
            x0, y0 = np.maximum(patches[i].box[:2], patches[j].box[:2])
            x1, y1 = np.minimum(patches[i].box[2:], patches[j].box[2:])
            if x0 >= x1 or y0 >= y1:
                continue
            cuts = []
            for patch in (patches[i], patches[j]):
                left, top = patch.box[:2]
                cuts.append((slice(y0 - top, y1 - top), slice(x0 - left, x1 - left)))
            both = (patches[i].cover[cuts[0]] > 0) & (patches[j].cover[cuts[1]] > 0)
            if np.count_nonzero(both) >= _MIN_OVERLAP_PX:
                yield i, j, patches[i].image[cuts[0]], patches[j].image[cuts[1]], both
