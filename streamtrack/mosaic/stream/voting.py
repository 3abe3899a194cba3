"""Which of several samples of a place to believe where they disagree.

The sample that most others agree with leads; of equals, the oldest. A sample in which something
moved has hardly a vote. What was seen before and after another thing stood there is the ground,
though that stood for longer. Where that is not known and a vote is close (two samples that
disagree, or a thing that stood there for about half of the time) the outlines tell:
a thing that lies on the ground ends at its outline, in colour and in edges, and the ground goes on.
After the test for removed objects in video surveillance (Connell et al., "Detection and tracking in
the IBM PeopleVision system", ICME 2004), made pairwise.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.mosaic.stream.painting import LEAST_WEIGHT
from streamtrack.types import Image, Mask

_CALM = 9
_DOUBTED_VOTE = 0.03  # of what moved when it was seen
_CLOSE_VOTE, _CLOSE_BY = 0.6, 3.0  # votes of the leader's, or fewer by so many: of many, more
_VISITED = 0.3  # votes of the leader's that suffice to what was seen before and after it
_MOST_SPAN = 4.0
_CLEARLY, _VERY_CLEARLY = 1.15, 1.4
_AROUND_LEVELS = 16.0
_LEAST_AROUND = 12
_LEAST_STEP = 6.0
_NEAR = (7, 7)
_LEAST_NEAR = 0.12
_LEAST_CELLS = 16
_EDGE = 4  # cells around a dispute that are looked at
_MOST_DISPUTES = 12
MANY = 9  # samples that agree, whose scatter tells how far off one may be
_LEAST_OFF, _MOST_OFF = 8.0, 6.0  # levels, and times the median distance from the middle one
_KERNEL_3, _KERNEL_7 = (np.ones((side, side), np.uint8) for side in (3, 7))

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


def vote(samples: Image, differs: Differs, moments: Sequence[int]) -> Votes:
    """Judge BGRW samples (n, h, w, 4), oldest first, taken at ``moments`` (n,).

    ``differs`` has, for pairs (a, b) with a < b that disagree anywhere, where they do (h, w).
    A sample's vote counts for the time between its neighbours.
    """
    covered = samples[..., 3] > 0
    votes = _spans(moments)[:, None, None] * _trust(samples[..., 3])
    times = votes.sum(axis=0)
    support = np.where(covered, times[None], 0).astype(np.float32)
    contested = np.zeros(times.shape, np.bool_)
    for (a, b), mask in differs.items():
        support[a][mask] -= votes[b][mask]
        support[b][mask] -= votes[a][mask]
        contested |= mask
    # Averaged, so that one sample leads in all of a place.
    smooth = np.stack([cv2.blur(votes, (_CALM, _CALM)) for votes in support])
    smooth = (smooth * _trust(samples[..., 3])).astype(np.float32)
    leader = np.argmax(smooth, axis=0)
    stays = _stays(samples[..., 3] >= LEAST_WEIGHT, differs, moments)
    _let_lasting_lead(smooth, leader, stays)
    _settle_close_votes(samples, support, leader, differs)
    outliers = [np.zeros(times.shape, np.bool_) for _ in samples]
    for (a, b), mask in differs.items():
        outliers[b] |= mask & (leader == a)
        outliers[a] |= mask & (leader == b)
    if len(samples) >= MANY:
        outliers = _with_odd_ones(samples, outliers)
    undecided = contested & (2 * support.max(axis=0) <= 1.001 * times)
    return Votes(outliers, int(np.count_nonzero(contested)), int(np.count_nonzero(undecided)))


def _trust(weights: Image) -> Floats:
    """The share of a vote that samples of such weights have, 0 if they show nothing."""
    trust = np.where(np.arange(256) < LEAST_WEIGHT, _DOUBTED_VOTE, 1.0).astype(np.float32)
    trust[0] = 0.0
    return np.asarray(trust[weights], np.float32)


def _with_odd_ones(samples: Image, outliers: list[Mask]) -> list[Mask]:
    """Where many samples (n, h, w, 4) agree, those too that differ by more than these scatter.

    A dark car on a dark road differs by less than two views of one place may. The limit is six
    times the median distance from the median, about nine standard deviations.
    """
    colours = np.stack([cv2.blur(sample[..., :3], (3, 3)) for sample in samples]).astype(np.int16)
    is_out = np.stack(outliers) | (samples[..., 3] == 0)
    count = len(samples) - np.count_nonzero(is_out, axis=0)
    off = np.abs(colours - _middle(colours, is_out, count))
    limit = np.maximum(_LEAST_OFF, _MOST_OFF * _middle(off, is_out, count))
    is_odd = (off > limit).any(axis=3) & (count >= MANY)
    odd = [cv2.morphologyEx(one.view(np.uint8), cv2.MORPH_OPEN, _KERNEL_3) for one in is_odd]
    return [
        mask | (cv2.dilate(one, _KERNEL_3) > 0) for mask, one in zip(outliers, odd, strict=True)
    ]


def _middle(
    values: npt.NDArray[np.int16], is_out: Mask, count: npt.NDArray[np.intp]
) -> npt.NDArray[np.int16]:
    """Median (h, w, 3) over the samples (n, h, w, 3) that are not out, ``count`` (h, w) of them."""
    ordered = np.sort(np.where(is_out[..., None], np.int16(999), values), axis=0)
    row = np.clip(count // 2, 0, len(values) - 1)
    return np.asarray(np.take_along_axis(ordered, row[None, ..., None], axis=0)[0])


def _spans(moments: Sequence[int]) -> Floats:
    """The time (n,) that each sample stands for, a mean of 1; none for very much or little."""
    if len(moments) < 3:
        return np.ones(len(moments), np.float32)
    gaps = np.diff(np.asarray(moments, np.float64))
    spans = 0.5 * (np.append(gaps, gaps[-1]) + np.append(gaps[0], gaps))
    usual = float(np.median(spans))
    if usual <= 0:
        return np.ones(len(moments), np.float32)
    spans = np.clip(spans, usual / _MOST_SPAN, usual * _MOST_SPAN)
    return np.asarray(spans / spans.mean(), np.float32)


def _stays(
    shown: Mask, differs: Differs, moments: Sequence[int]
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
    """The first and the last moment (n, h, w) of what each sample shows, as seen in ``shown`` ones.

    Samples show the same where both show something and do not differ.
    """
    first = np.broadcast_to(np.asarray(moments, np.int32)[:, None, None], shown.shape).copy()
    last = first.copy()
    for b in range(len(shown)):
        for a in range(b):
            same = shown[a] & shown[b]
            if (a, b) in differs:
                same &= ~differs[a, b]
            np.minimum(first[b], moments[a], out=first[b], where=same)
            np.maximum(last[a], moments[b], out=last[a], where=same)
    return first, last


def _let_lasting_lead(
    smooth: Floats, leader: npt.NDArray[np.intp], stays: Sequence[npt.NDArray[np.int32]]
) -> None:
    """Change the leader, in place, where another was there before it and after it."""
    leading, (first, last) = leader[None], stays
    votes = np.take_along_axis(smooth, leading, axis=0)
    lasts = first < np.take_along_axis(first, leading, axis=0)
    lasts &= last > np.take_along_axis(last, leading, axis=0)
    lasts &= smooth >= np.float32(_VISITED) * votes
    for number in np.flatnonzero(lasts.any(axis=(1, 2))).tolist():
        share = cv2.blur(lasts[number].astype(np.float32), _NEAR)
        lasts[number] &= share > 0.5
    rival = np.argmax(np.where(lasts, smooth, -1.0), axis=0)
    np.copyto(leader, rival, where=lasts.any(axis=0))


def _settle_close_votes(
    samples: Image,
    support: Floats,
    leader: npt.NDArray[np.intp],
    differs: Differs,
) -> None:
    """Change the leader, in place, where another with nearly as many votes shows the ground."""
    is_sure = samples[..., 3] >= LEAST_WEIGHT
    leads = leader.copy()
    closeness = max(_CLOSE_VOTE, 1 - _CLOSE_BY / len(samples))
    for first in np.unique(leads).tolist():
        is_first = leads == first
        disputes = {a + b - first: mask for (a, b), mask in differs.items() if first in (a, b)}
        weight = {
            rival: float(support[rival][mask & is_first & is_sure[rival]].sum())
            for rival, mask in disputes.items()
        }
        for rival, mask in sorted(disputes.items(), key=lambda item: -weight[item[0]]):
            seen = (
                mask
                & (support[first] > 0)
                & (support[rival] > _VISITED * support[first])
                & is_sure[rival]
            )
            if not (seen & is_first & (leader == first)).any():
                continue
            pair, votes = (samples[rival], samples[first]), (support[rival], support[first])
            # A thing may have several leaders: a part of it is judged with the whole as well.
            for roi, part in _parts(seen & is_first & (leader == first)):
                is_close = _is_close(votes, roi, part, closeness)
                if is_close and _is_ground(pair[0][roi], pair[1][roi], part, mask[roi], _CLEARLY):
                    leader[roi][part] = rival
            for roi, whole in _parts(seen):
                led = whole & is_first[roi] & (leader[roi] == first)
                is_close = led.any() and _is_close(votes, roi, led, closeness)
                one, other = pair[0][roi], pair[1][roi]
                if is_close and _is_ground(one, other, whole, mask[roi], _VERY_CLEARLY):
                    leader[roi][led] = rival


def _is_close(
    votes: tuple[Floats, Floats], roi: tuple[slice, slice], inside: Mask, share: float
) -> bool:
    """Whether the first of a pair has such a share of the other's votes in a part, or more."""
    one, other = (float(np.median(some[roi][inside])) for some in votes)
    return one >= share * other


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
