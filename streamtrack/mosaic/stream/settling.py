"""Who is shown where, brought to order: of a thing all is shown, or nothing.

A sample takes over a whole part in which it shows something else than what is shown now, if that
has more votes, or leaves fewer borders that cut through a thing; with about as many votes, or
clearly with half as many, if it shows the ground there. (Regions of difference: Uyttendaele et al.,
"Eliminating ghosting and exposure artifacts in image mosaics", CVPR 2001; cost of visible seams:
Agarwala et al., "Interactive digital photomontage", SIGGRAPH 2004.) What is the ground the outlines
tell: a thing that lies on the ground ends at its outline, in colour and in edges, and the ground
goes on. After the test for removed objects in video surveillance (Connell et al., "Detection and
tracking in the IBM PeopleVision system", ICME 2004), made pairwise.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.mosaic.stream.painting import LEAST_WEIGHT
from streamtrack.types import Image, Mask

_CLOSE_VOTE, _CLOSE_BY = 0.6, 3.0  # votes of the leader's, or fewer by so many: of many, more
_CUT_COST = 8.0  # votes of all for so many cells outweigh a cell's side that cuts a thing
_MOST_OUTVOTED = 0.25  # share of the votes that a whole thing may lack, for all the cuts it saves
_CUT_LEVELS = 30
_FEW_CUTS = 0.5  # times the square root of a part's cells: at its outline not all is disputed
_LEAST_GAIN = 1.0
_MOST_ROUNDS = 4
_CLEARLY, _VERY_CLEARLY = 1.15, 1.4
_OUTVOTED = 0.4  # votes of the leader's, or more: what shows the ground very clearly
_AROUND_LEVELS = 16.0
_LEAST_AROUND = 12
_LEAST_STEP = 6.0
_NEAR = (7, 7)
_LEAST_NEAR = 0.12
_LEAST_CELLS = 16
_EDGE = 4  # cells around a dispute that are looked at
_MOST_DISPUTES = 12
_KERNEL_3, _KERNEL_7 = (np.ones((side, side), np.uint8) for side in (3, 7))

Floats: TypeAlias = npt.NDArray[np.float32]
Leaders: TypeAlias = npt.NDArray[np.intp]
Roi: TypeAlias = tuple[slice, slice]
Differs: TypeAlias = Mapping[tuple[int, int], Mask]


def settle(samples: Image, support: Floats, leader: Leaders, differs: Differs) -> None:
    """Change the ``leader`` (h, w) of BGRW samples (n, h, w, 4), in place, until nothing gains.

    ``support`` (n, h, w) is each sample's share of the votes, ``differs`` where pairs disagree.
    """
    settlement = _Settlement(samples, support, leader, differs)
    rows = sorted({row for pair in differs for row in pair})
    for _ in range(_MOST_ROUNDS):
        if not sum(settlement.put_forward(row) for row in rows):
            return


class _Settlement:
    """The votes, and who leads by now."""

    def __init__(self, samples: Image, support: Floats, leader: Leaders, differs: Differs) -> None:
        self._samples, self._support, self._leader = samples, support.copy(), leader
        self._differs = differs
        self._is_sure = samples[..., 3] >= LEAST_WEIGHT
        self._closeness = max(_CLOSE_VOTE, 1 - _CLOSE_BY / len(samples))
        leading = leader[None]
        self._shown = np.take_along_axis(samples, leading[..., None], axis=0)[0]
        self._leading = np.take_along_axis(self._support, leading, axis=0)[0]
        self._cuts = _cuts(samples, leader)

    def put_forward(self, row: int) -> bool:
        """Let one sample take over what it can; whether that was anything."""
        dissent = np.zeros(self._leader.shape, np.bool_)
        for rival in np.flatnonzero(np.bincount(self._leader.ravel())).tolist():
            mask = self._differs.get((min(row, rival), max(row, rival)))
            if mask is not None:
                dissent |= mask & (self._leader == rival)
        dissent &= self._is_sure[row]
        ahead = dissent & (self._support[row] > self._leading)
        taken = False
        for roi, part in _parts(dissent):
            for candidate in (part, part & ahead[roi]):
                if candidate.any() and self._is_better(row, roi, candidate, dissent[roi]):
                    self._take_over(row, roi, candidate)
                    taken = True
                    break
        return taken

    def _take_over(self, row: int, roi: Roi, part: Mask) -> None:
        self._leader[roi][part] = row
        self._shown[roi][part] = self._samples[row][roi][part]
        self._leading[roi][part] = self._support[row][roi][part]
        # The sides of the last cells lie beyond the part, and were not counted.
        cuts = _cuts(self._samples[:, *roi], self._leader[roi])
        self._cuts[roi][:-1, :-1] = cuts[:-1, :-1]

    def _is_better(self, row: int, roi: Roi, part: Mask, dissent: Mask) -> bool:
        votes, leading = self._support[row][roi][part], self._leading[roi][part]
        gain = float((votes - leading).sum())
        now = int(self._cuts[roi].sum())
        share = float(np.median(votes)) / max(float(np.median(leading)), 1e-6)
        is_close = share >= _OUTVOTED
        if gain + min(_CUT_COST * now, _MOST_OUTVOTED * len(votes)) <= _LEAST_GAIN and not is_close:
            return False
        then = int(_cuts(self._samples[:, *roi], np.where(part, row, self._leader[roi])).sum())
        if gain + min(_CUT_COST * (now - then), _MOST_OUTVOTED * len(votes)) > _LEAST_GAIN:
            return True
        if not is_close or then - now > _FEW_CUTS * math.sqrt(len(votes)):
            return False
        clearly = _CLEARLY if share >= self._closeness else _VERY_CLEARLY
        if not _is_ground(self._samples[row][roi], self._shown[roi], part, dissent, clearly):
            return False
        self._hold_down(row, roi, part)
        return True

    def _hold_down(self, row: int, roi: Roi, part: Mask) -> None:
        """What disagrees with a sample in a part of the picture has no votes there any more."""
        for (a, b), mask in self._differs.items():
            if row in (a, b):
                self._support[a + b - row][roi][part & mask[roi]] = 0.0


def _cuts(samples: Image, leader: Leaders) -> npt.NDArray[np.uint8]:
    """How many of a cell's two sides, to the right and below, show (h, w).

    A border shows where the samples (n, h, w, 4) on either side have other colours at it.
    """
    cuts = np.zeros(leader.shape, np.uint8)
    for down, right in ((1, 0), (0, 1)):
        y, x = np.nonzero(
            leader[down:, right:] != leader[: len(leader) - down, : leader.shape[1] - right]
        )
        one, other = leader[y, x], leader[y + down, x + right]
        shows = np.zeros(len(y), np.bool_)
        for place in ((y, x), (y + down, x + right)):
            a, b = (samples[(rows, *place)].astype(np.int16) for rows in (one, other))
            seen = (a[:, 3] > 0) & (b[:, 3] > 0)
            shows |= seen & (np.abs(a - b)[:, :3].max(axis=1) > _CUT_LEVELS)
        cuts[y, x] += shows
    return cuts


def _parts(mask: Mask) -> Iterator[tuple[tuple[slice, slice], Mask]]:
    """The larger connected parts of a mask, largest first: where, and what of that."""
    _, parts, stats, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8))
    sizes = stats[1:, cv2.CC_STAT_AREA]
    for part in (np.argsort(-sizes, kind="stable")[:_MOST_DISPUTES] + 1).tolist():
        x, y, width, height, size = stats[part].tolist()
        if size < _LEAST_CELLS:
            break
        rows = slice(max(y - _EDGE, 0), y + height + _EDGE)
        roi = rows, slice(max(x - _EDGE, 0), x + width + _EDGE)
        yield roi, np.asarray(parts[roi] == part)


def _is_ground(one: Image, other: Image, inside: Mask, disputed: Mask, clearly: float) -> bool:
    """Whether ``one`` shows the ground where ``other`` shows a thing on it (BGRW, h, w, 4).

    ``inside`` is a part of the cells that are ``disputed``. Around it they must agree, else the
    difference is one of light or of poses. Then the ground goes on across the outline, in colour
    and in edges, and a thing does not.
    """
    around = cv2.dilate(inside.view(np.uint8), _KERNEL_7) > 0
    around &= ~disputed & (one[..., 3] > 0) & (other[..., 3] > 0)
    differs = cv2.blur(cv2.absdiff(one, other), (3, 3))[..., :3].max(axis=2)
    if np.count_nonzero(around) < _LEAST_AROUND:
        return False
    if float(np.percentile(differs[around], 60)) > _AROUND_LEVELS:
        return False
    core = inside & (differs > _AROUND_LEVELS)
    step, step_other = (_step_across(p, core, around) for p in (one, other))
    if max(step, step_other) < _LEAST_STEP:
        return _outline(other, one, core) > clearly * _outline(one, other, core)
    return step_other > clearly * step


def _step_across(picture: Image, core: Mask, around: Mask) -> float:
    """Mean difference of colour between the two sides of an outline, in grey levels."""
    colours = picture[..., :3].astype(np.float32)
    means, is_near = [], []
    for side in (core, around):
        share = cv2.blur(side.astype(np.float32), _NEAR)
        total = cv2.blur(colours * side[..., None].astype(np.float32), _NEAR)
        means.append(total / np.maximum(share, 1e-6)[..., None])
        is_near.append(share > _LEAST_NEAR)
    both = is_near[0] & is_near[1]
    if not both.any():
        return 0.0
    return float(np.abs(means[0] - means[1])[both].max(axis=1).mean())


def _outline(picture: Image, rival: Image, inside: Mask) -> float:
    """Edges where the difference from the rival has its own, against the brightness there."""
    grey, grey_rival = (cv2.cvtColor(p, cv2.COLOR_BGRA2GRAY) for p in (picture, rival))
    weight = np.where(inside, _edges(cv2.absdiff(grey, grey_rival)), 0.0)
    brightness = float(grey[inside].mean()) if inside.any() else 0.0
    return float(np.sum(_edges(grey) * weight)) / (1.0 + brightness)


def _edges(grey: npt.NDArray[np.generic]) -> Floats:
    gradient = cv2.morphologyEx(np.asarray(grey, np.uint8), cv2.MORPH_GRADIENT, _KERNEL_3)
    return np.asarray(gradient, np.float32)
