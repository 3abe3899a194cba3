"""Do two pictures agree where they overlap? The grey values have the last word.

A few dozen wrong pairs can agree on a mapping by chance or by repeated texture; the detail of two
pictures cannot.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.mosaic.pairs.subpixel import Overlap
from streamtrack.types import Image

Floats = npt.NDArray[np.float32]

_TILE_PX = 16
_COVERED_SHARE = 0.9
_MIN_DETAIL = 4.0
_NOISE_VARIANCE = 2.0
_ALIKE = 0.4


@dataclass(frozen=True, slots=True)
class Agreement:
    """How far two renderings on one grid show the same.

    ncc       normalised cross-correlation of the grey values over the overlap; NaN if flat
    tiles     tiles of 16 x 16 grid pixels in which either picture shows detail
    alike     share of them whose detail correlates to more than 0.4
    detail    mean correlation of the tiles' detail
    """

    ncc: float
    tiles: int
    alike: float
    detail: float


def measure_agreement(overlap: Overlap) -> Agreement:
    """Compare the two renderings of an overlap, tile by tile; gain and offset drop out."""
    near, far = (_fine(image) for image in (overlap.near, overlap.far))
    near_mean, far_mean = _means(near), _means(far)
    near_variance = _means(near * near) - near_mean**2
    far_variance = _means(far * far) - far_mean**2
    covariance = _means(near * far) - near_mean * far_mean
    covered = _means(overlap.covered.astype(np.float32)) >= 255 * _COVERED_SHARE
    # Each picture's detail is judged at its own contrast.
    shows = covered & ((near_variance > _MIN_DETAIL) | (far_variance > _MIN_DETAIL))
    scale = np.sqrt((near_variance + _NOISE_VARIANCE) * (far_variance + _NOISE_VARIANCE))
    correlation = (covariance / scale)[shows]
    tiles = len(correlation)
    if not tiles:
        return Agreement(_ncc(overlap), 0, 0.0, 0.0)
    alike = float(np.mean(correlation > _ALIKE))
    return Agreement(_ncc(overlap), tiles, alike, float(np.mean(correlation)))


def _fine(image: Image) -> Floats:
    """What is finer than about a tile and coarser than pixel noise."""
    values = np.asarray(cv2.GaussianBlur(image, (5, 5), 1.0), np.float32)
    return values - cv2.blur(values, (2 * _TILE_PX + 1, 2 * _TILE_PX + 1))


def _means(values: Floats) -> Floats:
    """Mean of each whole tile."""
    rows, columns = (length // _TILE_PX for length in values.shape)
    whole = values[: rows * _TILE_PX, : columns * _TILE_PX]
    return np.asarray(cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA), np.float32)


def _ncc(overlap: Overlap) -> float:
    seen = overlap.covered > 0
    near, far = overlap.near[seen].astype(np.float32), overlap.far[seen].astype(np.float32)
    if len(near) < 2:
        return float("nan")
    near -= np.mean(near)
    far -= np.mean(far)
    scale = float(np.sqrt(float(near @ near) * float(far @ far)))
    return float(near @ far) / scale if scale > 0 else float("nan")
