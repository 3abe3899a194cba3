"""Would another shift fit as well? Repeated texture cannot tell where it lies."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.mosaic.pairs.subpixel import Overlap

Floats = npt.NDArray[np.float32]

_SIDE_PX = 128
_MIN_SHARED = 0.3
_MIN_SHIFT_PX = 4.0
_RIVAL = 0.985
_VALLEY = 0.7
_MIN_CORRELATION = 0.3
_STEPS = 24


def is_ambiguous(overlap: Overlap) -> bool:
    """Do the two renderings correlate as well when one is moved against the other?

    Normalised cross-correlation over all shifts that leave 30 % in common, by Fourier transform
    (Padfield 2012, "Masked object registration in the Fourier domain"), at 128 pixels. A rival
    is a peak of its own, with a valley between: an edge moved along itself is none.
    """
    near, far, seen = _reduced(overlap)
    surface, shared = _correlation_surface(near, far, seen)
    height, width = surface.shape
    centre_y, centre_x = height // 2, width // 2
    at_rest = float(np.max(surface[centre_y - 1 : centre_y + 2, centre_x - 1 : centre_x + 2]))
    if at_rest < _MIN_CORRELATION:
        return False
    peaks = surface >= cv2.dilate(surface, np.ones((7, 7), np.uint8))
    peaks &= (surface >= _RIVAL * at_rest) & (shared >= _MIN_SHARED)
    for y, x in np.argwhere(peaks).tolist():
        if np.hypot(y - centre_y, x - centre_x) < _MIN_SHIFT_PX:
            continue
        way = np.linspace(0, 1, _STEPS)
        ys = np.rint(centre_y + way * (y - centre_y)).astype(np.intp)
        xs = np.rint(centre_x + way * (x - centre_x)).astype(np.intp)
        if float(np.min(surface[ys, xs])) < _VALLEY * at_rest:
            return True
    return False


def _reduced(overlap: Overlap) -> tuple[Floats, Floats, Floats]:
    """Both details, zero where not both are seen, and the mask (1, else 0), at 128 pixels."""
    width, height = overlap.size_wh
    factor = min(1.0, _SIDE_PX / max(width, height))
    size = max(8, round(width * factor)), max(8, round(height * factor))

    def small(picture: npt.NDArray[np.uint8]) -> Floats:
        return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.float32)

    # Smoothed, so that a rival between two pixels loses nothing against no shift at all.
    seen = (small(overlap.covered) > 250).astype(np.float32)
    details = []
    for picture in (overlap.near_detail, overlap.far_detail):
        values = np.asarray(cv2.GaussianBlur(small(picture), (0, 0), 1.2), np.float32)
        mean = float(np.sum(values * seen)) / max(float(np.sum(seen)), 1.0)
        details.append((values - np.float32(mean)) * seen)
    return details[0], details[1], seen


def _correlation_surface(near: Floats, far: Floats, seen: Floats) -> tuple[Floats, Floats]:
    """Normalised correlation for every shift, no shift in the middle, and the share in common."""
    height, width = (cv2.getOptimalDFTSize(2 * side) for side in near.shape)

    def spectrum(values: Floats) -> Floats:
        padded = np.zeros((height, width), np.float32)
        padded[: values.shape[0], : values.shape[1]] = values
        return np.asarray(cv2.dft(padded), np.float32)

    def correlated(a: Floats, b: Floats) -> Floats:
        product = cv2.mulSpectrums(a, b, 0, conjB=True)
        plane = cv2.dft(product, flags=cv2.DFT_INVERSE | cv2.DFT_SCALE | cv2.DFT_REAL_OUTPUT)
        half = height // 2, width // 2
        return np.asarray(np.roll(plane, half, axis=(0, 1)), np.float32)

    mask = spectrum(seen)
    both = correlated(spectrum(near), spectrum(far))
    near_energy = correlated(spectrum(near * near), mask)
    far_energy = correlated(mask, spectrum(far * far))
    shared = correlated(mask, mask) / max(float(np.sum(seen)), 1.0)
    energy = np.sqrt(np.maximum(near_energy, 0) * np.maximum(far_energy, 0))
    floor = 1e-3 * float(np.max(energy)) + 1e-6
    return np.asarray(both / np.maximum(energy, floor), np.float32), shared
