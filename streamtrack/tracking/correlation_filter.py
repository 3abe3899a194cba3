"""A discriminative correlation filter: finds a target among its surroundings by its appearance.

The filter is learnt to answer with a peak where the target is and with nothing beside it (MOSSE,
Bolme et al., CVPR 2010), over several feature maps and scales (DSST, Danelljan et al., BMVC 2014):
gradients by direction and colours, in cells of a few pixels, which legs and folds that move blur
but do not upset. It knows shifts and scales, no turns and no perspective. Two filters answer
together: that of the first view, which is kept for ever, and one that is renewed.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import NamedTuple, TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.types import Image, Matrix, Points, Size

Floats = npt.NDArray[np.float32]
Spectrum = npt.NDArray[np.complex64]
_Value = TypeVar("_Value", bound=np.generic)

_WINDOW_AREA_PX = 96 * 96
_CELL_PX = 4
_LEAST_CELLS = 8
_SURROUNDINGS = 1.0  # mean side lengths added to the target's sides
_DIRECTIONS = 8
_NOISE_GRADIENT = 8.0  # of cv2.Sobel: below it a gradient's direction is noise
_LIGHTNESS_RANGE, _CHROMA_RANGE = 60.0, 30.0  # CIELAB units taken as one
_LABEL_SIGMA = 0.06  # of the target's size
_REGULARISATION = 0.01  # of the mean energy
_FIRST_SHARE = 0.3  # of the first view's filter in the answer
_SCALE_STEP = 1.03
_OTHER_SCALE_HANDICAP = 0.985
_SIDELOBE_CELLS = 3  # around the peak, not counted to what lies beside it


@dataclass(frozen=True, slots=True)
class Sighting:
    """Where the filter answers most.

    pose           frame_from_template
    answer         of both filters, 1 in the frame that was learnt
    first_answer   of the first view's filter alone, at the same place
    prominence     by how many standard deviations the answer stands out from those beside it
    is_scaled      is it at another scale than the guess?
    """

    pose: Matrix
    answer: float
    first_answer: float
    prominence: float
    is_scaled: bool


class _Filter(NamedTuple):
    """Numerator (C, rows, columns) and denominator (rows, columns) of a filter in frequencies."""

    products: Spectrum
    energy: Floats


def _mixed(one: _Filter, other: _Filter, share: float) -> _Filter:
    """The one filter with a ``share`` of the other."""
    part = np.float32(share)
    products = one.products + part * (other.products - one.products)
    return _Filter(products, one.energy + part * (other.energy - one.energy))


class _Answered(NamedTuple):
    """What both filters answer (rows, columns) about a pose, and to which spectra."""

    guess: Matrix
    seen: Spectrum
    answers: Floats


class CorrelationFilter:
    """The filter of a target with corners ``quad`` (4, 2), begun where ``pose`` puts it in a frame.

    Frames are BGR or grey, all alike; poses (frame_from_template) are similarities.
    """

    def __init__(self, image: Image, pose: Matrix, quad: Points) -> None:
        x0, y0, x1, y1 = geometry.bounding_box(quad)
        sides = np.array([x1 - x0, y1 - y0])
        window = sides + _SURROUNDINGS * sides.mean()
        cells = window * np.sqrt(_WINDOW_AREA_PX / window.prod()) / _CELL_PX
        columns, rows = (max(_LEAST_CELLS, round(float(count))) for count in cells)
        self._cells: Size = columns, rows
        self._template_px = float(np.mean(window / (np.array(self._cells) * _CELL_PX)))
        self._centre = float(x0 + x1) / 2, float(y0 + y1) / 2
        sigma = _LABEL_SIGMA * float(np.sqrt(sides.prod())) / (self._template_px * _CELL_PX)
        self._label = np.fft.rfft2(_peak(self._cells, sigma)).astype(np.complex64)
        taper = np.hanning(rows + 2)[1:-1, None] * np.hanning(columns + 2)[None, 1:-1]
        self._taper = taper.astype(np.float32)
        self._first = self._newest = self._both = self._learnt(image, pose)

    def locate(self, image: Image, guess: Matrix, *, at_other_scales: bool = False) -> Sighting:
        """The best place near ``guess`` in a frame (BGR or grey), no farther than its own size."""
        best = self._answered(image, guess)
        is_scaled = False
        for factor in (1 / _SCALE_STEP, _SCALE_STEP) if at_other_scales else ():
            other = self._answered(image, self._scaled(guess, factor))
            if other.answers.max() * _OTHER_SCALE_HANDICAP > best.answers.max():
                best, is_scaled = other, True
        return self._sighting(best, is_scaled=is_scaled)

    def learn(self, image: Image, pose: Matrix, share: float) -> None:
        """Renew by a ``share`` (0..1) the one filter, by a frame with the target at ``pose``."""
        self._newest = _mixed(self._newest, self._learnt(image, pose), share)
        self._both = _mixed(self._newest, self._first, _FIRST_SHARE)

    def _answered(self, image: Image, guess: Matrix) -> _Answered:
        seen = self._spectra(image, guess)
        return _Answered(guess, seen, self._answers(self._both, seen))

    def _sighting(self, found: _Answered, *, is_scaled: bool) -> Sighting:
        columns, rows = self._cells
        answers = found.answers
        row, column = (int(place) for place in divmod(int(answers.argmax()), columns))
        shift = np.array(
            [
                column - columns // 2 + _between(answers[row], column),
                row - rows // 2 + _between(answers[:, column], row),
            ]
        )
        moved = geometry.translation(*(shift * _CELL_PX * self._template_px))
        first = _around(self._answers(self._first, found.seen), row, column, 1)
        return Sighting(
            found.guess @ moved,
            float(answers[row, column]),
            float(first.max()),
            _prominence(answers, row, column),
            is_scaled,
        )

    def _answers(self, one: _Filter, seen: Spectrum) -> Floats:
        """What a filter answers (rows, columns), the middle standing for the guess."""
        columns, rows = self._cells
        spectrum = (np.conj(one.products) * seen).sum(axis=0)
        spectrum /= one.energy + np.float32(_REGULARISATION) * one.energy.mean()
        answers = np.asarray(np.fft.irfft2(spectrum, s=(rows, columns)), np.float32)
        return np.roll(answers, (rows // 2, columns // 2), axis=(0, 1))

    def _scaled(self, pose: Matrix, factor: float) -> Matrix:
        x, y = self._centre
        about_centre = geometry.translation(x, y) @ geometry.scaling(factor)
        return np.asarray(pose @ about_centre @ geometry.translation(-x, -y), np.float64)

    def _learnt(self, image: Image, pose: Matrix) -> _Filter:
        """The filter that one frame gives."""
        seen = self._spectra(image, pose)
        energy = (seen.real**2 + seen.imag**2).sum(axis=0)
        return _Filter(np.conj(self._label) * seen, np.asarray(energy, np.float32))

    def _spectra(self, image: Image, pose: Matrix) -> Spectrum:
        """Spectra of the feature maps of the window that a pose puts into a frame."""
        columns, rows = self._cells
        size = columns * _CELL_PX, rows * _CELL_PX
        template_from_window = geometry.translation(*self._centre) @ geometry.scaling(
            self._template_px
        )
        to_corner = geometry.translation(-(size[0] - 1) / 2, -(size[1] - 1) / 2)
        frame_from_window = pose @ template_from_window @ to_corner
        window = cv2.warpAffine(
            image,
            frame_from_window[:2],
            size,
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        maps = _feature_maps(np.asarray(window, np.uint8), self._cells)
        spectra = np.fft.rfft2(maps * self._taper)
        return np.asarray(spectra, np.complex64)


def _feature_maps(window: Image, cells: Size) -> Floats:
    """Gradients by direction, relative to their surroundings, and colours: (C, rows, columns)."""
    grey = geometry.grey_of(window)
    gx, gy = (cv2.Sobel(grey, cv2.CV_32F, dx, dy, ksize=3) for dx, dy in ((1, 0), (0, 1)))
    directions = []
    for number in range(_DIRECTIONS):
        angle = 2 * pi * number / _DIRECTIONS
        along = cv2.addWeighted(gx, float(np.cos(angle)), gy, float(np.sin(angle)), 0)
        _, positive = cv2.threshold(along, 0, 0, cv2.THRESH_TOZERO)
        directions.append(cv2.resize(positive, cells, interpolation=cv2.INTER_AREA))
    gradients = np.asarray(directions, np.float32)
    around = cv2.blur(np.square(gradients).sum(axis=0), (3, 3))
    gradients /= np.sqrt(around) + np.float32(_NOISE_GRADIENT)
    small = cv2.resize(window, cells, interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    bgr = cv2.cvtColor(small, cv2.COLOR_GRAY2BGR) if small.ndim == 2 else small
    ranges = np.array([_LIGHTNESS_RANGE, _CHROMA_RANGE, _CHROMA_RANGE], np.float32)
    colors = (cv2.cvtColor(bgr, cv2.COLOR_BGR2LAB) / ranges).transpose(2, 0, 1)
    colors = colors - colors.mean(axis=(1, 2), keepdims=True)
    return np.asarray(np.concatenate([gradients, colors]), np.float32)


def _peak(cells: Size, sigma: float) -> Floats:
    """The wished-for answer (rows, columns): a Gaussian about the first cell, going round."""
    across, down = (np.minimum(np.arange(n), n - np.arange(n)) for n in cells)
    peak = np.exp(-0.5 * (across[None] ** 2 + down[:, None] ** 2) / sigma**2)
    return np.asarray(peak, np.float32)


def _between(values: Floats, place: int) -> float:
    """How far beside ``place`` the parabola through it and its neighbours peaks, in cells."""
    left, middle, right = (float(values[(place + k) % len(values)]) for k in (-1, 0, 1))
    bend = left - 2 * middle + right
    return 0.0 if bend >= 0 else max(-0.5, min(0.5, 0.5 * (left - right) / bend))


def _prominence(answers: Floats, row: int, column: int) -> float:
    """The peak-to-sidelobe ratio of Bolme et al. (2010)."""
    beside = np.ones(answers.shape, np.bool_)
    _around(beside, row, column, _SIDELOBE_CELLS)[:] = False
    others = answers[beside]
    return float((answers[row, column] - others.mean()) / (others.std() + 1e-6))


def _around(values: npt.NDArray[_Value], row: int, column: int, reach: int) -> npt.NDArray[_Value]:
    """A view of the values up to ``reach`` rows and columns away."""
    return values[
        max(0, row - reach) : row + reach + 1, max(0, column - reach) : column + reach + 1
    ]
