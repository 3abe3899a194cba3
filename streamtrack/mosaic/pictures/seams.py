"""Which picture each pixel of a mosaic comes from: seams where two pictures differ least.

Pictures are laid down one after the other, on a small canvas. Where a new one overlaps what lies
there, each side keeps what is clearly nearer to its own middle than to the other's; in the strip
between, connected things that only one picture shows go to one side whole, and then both sides
grow, first over pixels where the two differ most and last where they agree, so that they meet
where the seam shows least. Growing so is a watershed of the difference, flooded from markers
(Gracias et al. 2009, "Fast image blending using watersheds and graph cuts"); it takes
milliseconds and cannot fail.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.fitting import median
from streamtrack.mosaic.pictures.projection import Box
from streamtrack.types import Image, Size

_STRIP = 0.5  # of the middle's distance from the edge: how far a seam may leave the bisector
_LEVELS = 20
_STEPS = 5  # of growth at each level
_MIN_DIFFERENCE, _MANIFOLD = 24.0, 3.0  # a thing differs by so many grey levels, times the median
_MIN_THING_PX = 6
_MOST_OF_STRIP = 0.4  # where more of it differs, it is parallax and no thing
_CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class SmallPatch:
    """One picture on the small canvas: BGR (h, w, 3), coverage (h, w) 0 or 255, its box."""

    image: Image
    cover: Image
    box: Box


def seam_masks(patches: Sequence[SmallPatch], size_wh: Size) -> list[Image]:
    """For each patch, (h, w) 255 where the mosaic is its; each covered pixel is exactly one's."""
    owner = np.full((size_wh[1], size_wh[0]), -1, np.int32)
    weight = np.zeros(owner.shape, np.float32)
    seen = np.zeros((*owner.shape, 3), np.uint8)
    for row in _from_the_middle(patches, size_wh):
        patch = patches[row]
        x0, y0, x1, y1 = patch.box
        there = slice(y0, y1), slice(x0, x1)
        own_weight = _weight(patch.cover)
        is_new = _won(
            patch, own_weight, seen[there], weight[there], np.asarray(owner[there] >= 0, np.bool_)
        )
        np.copyto(owner[there], row, where=is_new)
        np.copyto(weight[there], own_weight, where=is_new)
        cv2.copyTo(patch.image, is_new.astype(np.uint8), seen[there])
    return [
        np.asarray(owner[p.box[1] : p.box[3], p.box[0] : p.box[2]] == row, np.uint8) * np.uint8(255)
        for row, p in enumerate(patches)
    ]


def _from_the_middle(patches: Sequence[SmallPatch], size_wh: Size) -> list[int]:
    def distance(row: int) -> float:
        x0, y0, x1, y1 = patches[row].box
        return float(np.hypot((x0 + x1 - size_wh[0]) / 2, (y0 + y1 - size_wh[1]) / 2))

    return sorted(range(len(patches)), key=distance)


def _weight(cover: Image) -> npt.NDArray[np.float32]:
    """Distance (h, w) from the edge of the coverage, the box's edges included."""
    padded = cv2.copyMakeBorder(cover, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    distance = cv2.distanceTransform(padded, cv2.DIST_L2, 3)
    return np.asarray(distance[1:-1, 1:-1], np.float32)


def _won(
    patch: SmallPatch,
    own_weight: npt.NDArray[np.float32],
    seen: Image,
    weight: npt.NDArray[np.float32],
    is_taken: npt.NDArray[np.bool_],
) -> npt.NDArray[np.bool_]:
    """Pixels (h, w) of the patch's box that become its own."""
    covered = patch.cover > 0
    overlap = covered & is_taken
    won = covered & ~is_taken
    if not overlap.any():
        return won
    lead = own_weight - weight
    reach = _STRIP * float(np.max(own_weight[overlap]))
    old = np.asarray(is_taken & (~covered | (lead < -reach)), np.uint8) * np.uint8(255)
    new = np.asarray(won | (overlap & (lead > reach)), np.uint8) * np.uint8(255)
    free = np.asarray(overlap & (np.abs(lead) <= reach), np.uint8) * np.uint8(255)
    if old.any() and new.any():
        blue, green, red = cv2.split(cv2.absdiff(patch.image, seen))
        cost = np.asarray(cv2.blur(cv2.max(cv2.max(blue, green), red), (3, 3)), np.uint8)
        _give_away_things(cost, lead, old, new, free)
        new, free = _flooded(cost, old, new, free)
    return np.asarray((new > 0) | ((free > 0) & (lead > 0)), np.bool_)


def _give_away_things(
    cost: Image, lead: npt.NDArray[np.float32], old: Image, new: Image, free: Image
) -> None:
    """Give each connected thing that only one picture shows to one side, whole, in place.

    It goes to the side whose pixels it touches or, free all round, to the nearer one.
    """
    typical = median(cost[free > 0]) if free.any() else 0.0
    things = np.asarray((cost > max(_MIN_DIFFERENCE, _MANIFOLD * typical)) & (free > 0), np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(things, connectivity=8)
    most = _MOST_OF_STRIP * np.count_nonzero(free)
    touches_old = np.bincount(labels[cv2.dilate(old, _CROSS) > 0], minlength=count)
    touches_new = np.bincount(labels[cv2.dilate(new, _CROSS) > 0], minlength=count)
    leads = np.bincount(labels.ravel(), weights=lead.ravel(), minlength=count)
    for label in range(1, count):
        area = int(stats[label, cv2.CC_STAT_AREA])
        if not _MIN_THING_PX <= area <= most:
            continue
        contact = int(touches_new[label]) - int(touches_old[label])
        is_new = contact > 0 or (contact == 0 and leads[label] > 0)
        x0, y0, width, height = stats[label, :4].tolist()
        part = slice(y0, y0 + height), slice(x0, x0 + width)
        own = labels[part] == label
        np.copyto((new if is_new else old)[part], 255, where=own)
        np.copyto(free[part], 0, where=own)


def _flooded(cost: Image, old: Image, new: Image, free: Image) -> tuple[Image, Image]:
    """Both sides grown into the free pixels, high costs first; returns ``new`` and what is left."""
    ys, xs = np.nonzero(free)
    y0, y1 = max(0, int(ys.min()) - 1), int(ys.max()) + 2
    x0, x1 = max(0, int(xs.min()) - 1), int(xs.max()) + 2
    part = slice(y0, y1), slice(x0, x1)
    cost, old, grown, left = cost[part], old[part].copy(), new[part].copy(), free[part].copy()
    costs = np.sort(cost[left > 0])
    shares = np.linspace(0, 1, _LEVELS, endpoint=False)
    levels = {int(costs[round(share * (len(costs) - 1))]) for share in shares}
    for level in sorted(levels, reverse=True):
        high = np.asarray(cost >= level, np.uint8) * np.uint8(255)
        allowed = cv2.bitwise_and(left, high)
        for _ in range(_STEPS):
            if not cv2.countNonZero(allowed):
                break
            for side in (old, grown):
                step = cv2.bitwise_and(cv2.dilate(side, _CROSS), allowed)
                cv2.bitwise_or(side, step, dst=side)
                cv2.subtract(allowed, step, dst=allowed)
        for side in (old, grown):
            cv2.subtract(left, side, dst=left)
    new, free = new.copy(), free.copy()
    new[part], free[part] = grown, left
    return new, free
