"""What truly stands at a place, from several samples of it: the answer to moving objects.

Every pair of samples is compared at a quarter of the size; samples that show something else than
the one that leads at a place (see `voting`) are shut out there. Among those that are left the
heaviest wins, as in painting.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.mosaic.stream.painting import FEATHER, disagreement, quartered
from streamtrack.mosaic.stream.settling import Differs
from streamtrack.mosaic.stream.voting import MANY, vote
from streamtrack.types import Image, Mask, Size

_STOOD_BACK = np.where(np.arange(256) > 0, np.maximum(np.arange(256) // 6, 1), 0).astype(np.uint8)
"""Weights of samples that stand back: they win where no primary one shows anything."""

_SMOOTH, _HALF = (7, 7), 120  # of 255: a little more is shut out than the cells
_GAP = 8

Labels: TypeAlias = npt.NDArray[np.int16]


@dataclass(frozen=True, slots=True)
class Tally:
    """Pixels seen more than once, those where samples disagree, and those left without majority."""

    overlap: int = 0
    contested: int = 0
    undecided: int = 0

    def __add__(self, other: Tally) -> Tally:
        return Tally(
            self.overlap + other.overlap,
            self.contested + other.contested,
            self.undecided + other.undecided,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """What each sample of a block is worth: ``weights`` uint8 (H, W), 0 where it is shut out."""

    samples: tuple[Image, ...]
    weights: tuple[Image, ...]
    tally: Tally

    @property
    def labels(self) -> Labels:
        """Row of the heaviest sample, int16 (H, W), the oldest of equals; -1 where none is."""
        best = np.zeros(self.weights[0].shape, np.uint8)
        labels = np.full(best.shape, -1, np.int16)
        for number, weight in enumerate(self.weights):
            labels[weight > best] = number
            best = np.asarray(cv2.max(best, weight), np.uint8)
        return labels

    def heaviest(self) -> Image:
        """Each pixel from its heaviest sample alone, BGRW (H, W, 4)."""
        labels = self.labels
        result = np.zeros((*labels.shape, 4), np.uint8)
        for number, pixels in enumerate(self.samples):
            cv2.copyTo(pixels, (labels == number).view(np.uint8), result)
        return self._with_weight(result)

    def feathered(self) -> Image:
        """As `heaviest`, samples of nearly the same weight mixed, BGRW."""
        least = cv2.subtract(self._most(), np.full_like(self._most(), FEATHER))
        return self._mixed([np.asarray(cv2.subtract(w, least), np.uint8) for w in self.weights])

    def averaged(self) -> Image:
        """The mean of the samples that are not shut out, BGRW."""
        return self._mixed([np.minimum(w, np.uint8(1)) for w in self.weights])

    def _mixed(self, shares: Sequence[Image]) -> Image:
        height, width = self.weights[0].shape
        total, colours = np.zeros((2, height, width, 4), np.float32)
        for pixels, share in zip(self.samples, shares, strict=True):
            x, y, across, down = cv2.boundingRect(share)
            if across:
                part = slice(y, y + down), slice(x, x + across)
                wide = cv2.merge([share[part]] * 4)
                total[part] += wide
                colours[part] += cv2.multiply(pixels[part], wide, dtype=cv2.CV_32F)
        mean = cv2.divide(colours, np.maximum(total, 1.0))
        return self._with_weight(np.asarray(cv2.convertScaleAbs(mean), np.uint8))

    def _with_weight(self, pixels: Image) -> Image:
        return np.asarray(cv2.insertChannel(self._most(), pixels, 3), np.uint8)

    def _most(self) -> Image:
        most = self.weights[0]
        for weight in self.weights[1:]:
            most = np.asarray(cv2.max(most, weight), np.uint8)
        return most


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """One view of a block, taken at a moment.

    ``pixels`` BGRW (H, W, 4), None if it shows nothing there; ``small`` (h, w, 4) the same at a
    quarter of the size, and as much around it as votes are taken of. One that is not primary votes
    as the others do, but its pixels stand back behind theirs.
    """

    pixels: Image | None
    small: Image
    is_primary: bool
    moment: int


def choose(samples: Sequence[Sample], differs: Differs, around: int = 0) -> Choice | None:
    """What samples of a block, oldest first, are worth; None if none shows anything.

    ``differs`` has where pairs of them disagree, ``around`` cells beyond the block as well.
    """
    showing = [n for n, sample in enumerate(samples) if sample.pixels is not None]
    if not showing:
        return None
    shown = [(samples[n].pixels, samples[n].is_primary) for n in showing]
    pixels = tuple(one for one, _ in shown if one is not None)
    weights = [_weight(one, is_primary) for one, is_primary in shown if one is not None]
    small = np.stack([sample.small for sample in samples])
    rows, columns = (slice(around, side - around) for side in small.shape[1:3])
    times = np.count_nonzero(small[:, rows, columns, 3], axis=0)
    overlap = int(np.count_nonzero(times > 1)) * 16
    if not differs and len(samples) < MANY:
        return Choice(pixels, tuple(weights), Tally(overlap))
    votes = vote(small, differs, [sample.moment for sample in samples], around)
    outliers = [votes.outliers[n] for n in showing]
    judged = [
        _shut_out(weight, outlier) if outlier.any() else weight
        for weight, outlier in zip(weights, outliers, strict=True)
    ]
    contested, undecided = (
        int(np.count_nonzero(cells)) * 16 for cells in (votes.contested, votes.undecided)
    )
    return Choice(pixels, _without_holes(weights, judged), Tally(overlap, contested, undecided))


class Chooser:
    """Compares samples of one block as they come, so that the work can be spread over time.

    Samples are BGRW (H, W, 4), oldest first, with sides that are multiples of 4.
    """

    def __init__(self, size_wh: Size) -> None:
        self._samples: list[Sample] = []
        self._small = np.zeros((0, size_wh[1] // 4 + _GAP, size_wh[0] // 4, 4), np.uint8)
        self._differs: dict[tuple[int, int], Mask] = {}

    def __len__(self) -> int:
        return len(self._samples)

    def add(self, pixels: Image, moment: int | None = None) -> None:
        """Compare a sample, taken at a moment, with all before; one without weight is left out."""
        if not cv2.countNonZero(cv2.extractChannel(pixels, 3)):
            return
        count, (_, height, width, _) = len(self), self._small.shape
        if count == len(self._small):
            more = np.zeros((max(4, count), height, width, 4), np.uint8)
            self._small = np.concatenate([self._small, more])
        small = np.zeros((height, width, 4), np.uint8)
        small[:-_GAP] = quartered(pixels)
        if count:
            self._compare(small, count)
        self._small[count] = small
        now = count if moment is None else moment
        self._samples.append(Sample(pixels, small[:-_GAP], True, now))

    def _compare(self, small: Image, count: int) -> None:
        """The samples before are one tall picture, a gap below each: a few calls for all."""
        before = self._small[:count].reshape(-1, small.shape[1], 4)
        mask = disagreement(before, np.tile(small, (count, 1, 1)))
        masks = mask.reshape(count, *small.shape[:2])[:, :-_GAP] > 0
        for number in np.flatnonzero(masks.any(axis=(1, 2))).tolist():
            self._differs[number, count] = masks[number]

    def choice(self) -> Choice | None:
        """What the samples so far are worth; None if there is none."""
        return choose(self._samples, self._differs)


def _shut_out(weight: Image, outlier: Mask) -> Image:
    # Judged in cells of 4 pixels, shut out within a smooth outline around these.
    cells = outlier.view(np.uint8) * np.uint8(255)
    size_wh = weight.shape[1], weight.shape[0]
    smooth = cv2.blur(cv2.resize(cells, size_wh, interpolation=cv2.INTER_LINEAR), _SMOOTH)
    return np.asarray(cv2.copyTo(weight, cv2.inRange(smooth, 0, _HALF)), np.uint8)


def _without_holes(weights: Sequence[Image], judged: Sequence[Image]) -> tuple[Image, ...]:
    """The judged weights; where none is left (at a frame's very edge) all count for a little."""
    most, before = judged[0], weights[0]
    for now, then in zip(judged[1:], weights[1:], strict=True):
        most = np.asarray(cv2.max(most, now), np.uint8)
        before = np.asarray(cv2.max(before, then), np.uint8)
    is_hole = (most == 0) & (before > 0)
    if not is_hole.any():
        return tuple(judged)
    return tuple(
        np.where(is_hole, np.minimum(then, 1), now).astype(np.uint8)
        for now, then in zip(judged, weights, strict=True)
    )


def _weight(pixels: Image, is_primary: bool) -> Image:
    weight = np.asarray(cv2.extractChannel(pixels, 3), np.uint8)
    return weight if is_primary else np.asarray(cv2.LUT(weight, _STOOD_BACK), np.uint8)
