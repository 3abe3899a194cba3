"""Which of several samples of a place to believe where they disagree.

The sample that most others agree with leads; of equals, the oldest. A sample in which something
moved has hardly a vote. What was seen before and after another thing stood there is the ground,
though that stood for longer. What follows for whole things is `settling`'s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.mosaic.stream.painting import LEAST_WEIGHT
from streamtrack.mosaic.stream.settling import Differs, Floats, Leaders, settle
from streamtrack.types import Image, Mask

_CALM = 9
_DOUBTED_VOTE = 0.03  # of what moved when it was seen
_VISITED = 0.3  # votes of the leader's that suffice to what was seen before and after it
_MOST_SPAN = 4.0
_NEAR = (7, 7)
MANY = 9  # samples that agree, whose scatter tells how far off one may be
_LEAST_OFF, _MOST_OFF = 8.0, 6.0  # levels, and times the median distance from the middle one
_KERNEL_3 = np.ones((3, 3), np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class Votes:
    """Where each sample is outvoted, and which cells are disputed, all bool.

    ``contested`` cells have samples that disagree; in ``undecided`` ones no majority exists.
    """

    outliers: list[Mask]
    contested: Mask
    undecided: Mask


def vote(samples: Image, differs: Differs, moments: Sequence[int], around: int = 0) -> Votes:
    """Judge BGRW samples (n, h, w, 4), oldest first, taken at ``moments`` (n,).

    ``differs`` has, for pairs (a, b) with a < b that disagree anywhere, where they do (h, w).
    A sample's vote counts for the time between its neighbours. Cells less than ``around`` from
    the edge are there for what reaches into the others, and are left out of the votes.
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
    _count_lasting_more(support, leader, stays)
    settle(samples, support / np.maximum(times, 1e-6), leader, differs)
    outliers = np.zeros(support.shape, np.bool_)
    for (a, b), mask in differs.items():
        outliers[b] |= mask & (leader == a)
        outliers[a] |= mask & (leader == b)
    undecided = contested & (2 * support.max(axis=0) <= 1.001 * times)
    inner = tuple(slice(around, side - around) for side in times.shape)
    judged = list(outliers[:, *inner])
    if len(samples) >= MANY:
        judged = _with_odd_ones(samples[:, *inner], judged)
    return Votes(judged, contested[inner], undecided[inner])


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


def _count_lasting_more(
    support: Floats, leader: Leaders, stays: Sequence[npt.NDArray[np.int32]]
) -> None:
    """Raise, in place, the votes of what was there before the leader and after it."""
    leading, (first, last) = leader[None], stays
    lasts = first < np.take_along_axis(first, leading, axis=0)
    lasts &= last > np.take_along_axis(last, leading, axis=0)
    for number in np.flatnonzero(lasts.any(axis=(1, 2))).tolist():
        share = cv2.blur(lasts[number].astype(np.float32), _NEAR)
        lasts[number] &= share > 0.5
        support[number][lasts[number]] /= np.float32(_VISITED)
