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


class Chooser:
    """Compares samples of one block as they come, so that the work can be spread over time.

    Samples are BGRW (H, W, 4), oldest first, with sides that are multiples of 4.
    """

    def __init__(self, size_wh: Size) -> None:
        self._size_wh = size_wh
        self._samples: list[Image] = []
        self._is_primary: list[bool] = []
        self._moments: list[int] = []
        self._small = np.zeros((0, size_wh[1] // 4 + _GAP, size_wh[0] // 4, 4), np.uint8)
        self._differs: dict[tuple[int, int], Mask] = {}

    def __len__(self) -> int:
        return len(self._samples)

    def add(self, pixels: Image, is_primary: bool = True, moment: int | None = None) -> None:
        """Compare a sample, taken at a moment, with all before; one without weight is left out.

        One that is not primary votes as the others do, but its pixels stand back behind theirs.
        """
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
        self._samples.append(pixels)
        self._is_primary.append(is_primary)
        self._moments.append(count if moment is None else moment)

    def _compare(self, small: Image, count: int) -> None:
        """The samples before are one tall picture, a gap below each: a few calls for all."""
        before = self._small[:count].reshape(-1, small.shape[1], 4)
        mask = disagreement(before, np.tile(small, (count, 1, 1)))
        masks = mask.reshape(count, *small.shape[:2])[:, :-_GAP] > 0
        for number in np.flatnonzero(masks.any(axis=(1, 2))).tolist():
            self._differs[number, count] = masks[number]

    def choice(self) -> Choice | None:
        """What the samples so far are worth; None if there is none."""
        if not self._samples:
            return None
        weights = [
            _weight(pixels, is_primary)
            for pixels, is_primary in zip(self._samples, self._is_primary, strict=True)
        ]
        covered = self._small[: len(self), :-_GAP, :, 3] > 0
        times = covered.sum(axis=0, dtype=np.int16)
        overlap = int(np.count_nonzero(times > 1)) * 16
        if not self._differs and len(self) < MANY:
            return Choice(tuple(self._samples), tuple(weights), Tally(overlap))
        votes = vote(self._small[: len(self), :-_GAP], self._differs, self._moments)
        judged = [
            self._shut_out(weight, outlier) if outlier.any() else weight
            for weight, outlier in zip(weights, votes.outliers, strict=True)
        ]
        tally = Tally(overlap, votes.contested * 16, votes.undecided * 16)
        return Choice(tuple(self._samples), _without_holes(weights, judged), tally)

    def _shut_out(self, weight: Image, outlier: Mask) -> Image:
        # Judged in cells of 4 pixels, shut out within a smooth outline around these.
        cells = outlier.view(np.uint8) * np.uint8(255)
        full = cv2.resize(cells, self._size_wh, interpolation=cv2.INTER_LINEAR)
        smooth = cv2.blur(full, _SMOOTH)
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
