"""Which of several samples of a place to believe where they disagree.

The sample that most others agree with leads; of equals, the oldest. Where a vote is close (two
samples that disagree, or a thing that stood there for about half of the time) the outlines tell:
a thing that lies on the ground has edges where the difference of the two samples has its own, the
bare ground has none there. After the test for removed objects in video surveillance (Connell et
al., "Detection and tracking in the IBM PeopleVision system", ICME 2004), made pairwise.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.types import Image, Mask

_CALM = 9
_CLOSE_VOTE = 0.6
_CLEARLY = 1.15
_RIM_LEVELS = 14.0
_LEAST_CELLS = 16
_MOST_DISPUTES = 12
_KERNEL_3 = np.ones((3, 3), np.uint8)

Floats: TypeAlias = npt.NDArray[np.float32]
Differs: TypeAlias = Mapping[tuple[int, int], Mask]


@dataclass(frozen=True, slots=True, eq=False)
class Votes:
    """Where each sample is outvoted, bool (h, w); and how many cells are disputed.

    ``contested`` cells have samples that disagree; in ``undecided`` ones no majority exists.
    """

    outliers: list[Mask]
    contested: int
    undecided: int


def vote(samples: Image, differs: Differs) -> Votes:
    """Judge BGRW samples (n, h, w, 4), oldest first.

    ``differs`` has, for pairs (a, b) with a < b that disagree anywhere, where they do (h, w).
    """
    covered = samples[..., 3] > 0
    times = covered.sum(axis=0, dtype=np.int16)
    support = np.where(covered, times[None], 0).astype(np.float32)
    contested = np.zeros(times.shape, np.bool_)
    for (a, b), mask in differs.items():
        support[a][mask] -= 1
        support[b][mask] -= 1
        contested |= mask
    # Averaged, so that one sample leads in all of a place.
    smooth = np.stack([cv2.blur(votes, (_CALM, _CALM)) for votes in support])
    smooth = np.where(covered, smooth, 0.0).astype(np.float32)
    leader = np.argmax(smooth, axis=0)
    _settle_close_votes(samples, support, leader, differs)
    outliers = [np.zeros(times.shape, np.bool_) for _ in samples]
    for (a, b), mask in differs.items():
        outliers[b] |= mask & (leader == a)
        outliers[a] |= mask & (leader == b)
    undecided = contested & (2 * support.max(axis=0) <= times)
    return Votes(outliers, int(np.count_nonzero(contested)), int(np.count_nonzero(undecided)))


def _settle_close_votes(
    samples: Image, support: Floats, leader: npt.NDArray[np.intp], differs: Differs
) -> None:
    """Change the leader, in place, where another with nearly as many votes shows the ground."""
    leads = leader.copy()
    for first in np.unique(leads).tolist():
        is_first = leads == first
        rivals = [a + b - first for a, b in differs if first in (a, b)]
        for rival in sorted(rivals, key=lambda number: -float(support[number][is_first].sum())):
            mask = differs[min(first, rival), max(first, rival)]
            seen = (support[first] > 0) & (support[rival] > 0)
            for roi, inside in _parts(mask & seen & is_first & (leader == first)):
                votes, votes_first = (np.median(support[n][roi][inside]) for n in (rival, first))
                is_close = votes >= _CLOSE_VOTE * votes_first
                if is_close and _is_ground(samples[rival][roi], samples[first][roi], inside):
                    leader[roi][inside] = rival


def _parts(mask: Mask) -> Iterator[tuple[tuple[slice, slice], Mask]]:
    """The larger connected parts of a mask, largest first: where, and what of that."""
    _, parts, stats, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8))
    sizes = stats[1:, cv2.CC_STAT_AREA]
    for part in (np.argsort(-sizes, kind="stable")[:_MOST_DISPUTES] + 1).tolist():
        x, y, width, height, size = stats[part].tolist()
        if size < _LEAST_CELLS:
            break
        roi = slice(max(y - 1, 0), y + height + 1), slice(max(x - 1, 0), x + width + 1)
        yield roi, np.asarray(parts[roi] == part)


def _is_ground(one: Image, other: Image, inside: Mask) -> bool:
    """Whether ``one`` shows the ground where ``other`` shows a thing on it (BGRW, h, w, 4).

    They must agree all around, else the difference is one of light or of poses; and what is inside
    must have clearly less outline, against its own brightness.
    """
    core = cv2.erode(inside.view(np.uint8), _KERNEL_3)
    rim = inside & (core == 0)
    differs = cv2.absdiff(one, other)[..., :3].max(axis=2)
    if not rim.any() or float(np.percentile(differs[rim], 80)) > _RIM_LEVELS:
        return False
    grey, grey_other = (cv2.cvtColor(p, cv2.COLOR_BGRA2GRAY) for p in (one, other))
    weight = np.where(inside, _edges(cv2.absdiff(grey, grey_other)), 0.0)
    outline, outline_other = (
        float(np.sum(_edges(p) * weight)) / (1.0 + float(p[inside].mean()))
        for p in (grey, grey_other)
    )
    return outline_other > _CLEARLY * outline


def _edges(grey: npt.NDArray[np.generic]) -> Floats:
    gradient = cv2.morphologyEx(np.asarray(grey, np.uint8), cv2.MORPH_GRADIENT, _KERNEL_3)
    return np.asarray(gradient, np.float32)
