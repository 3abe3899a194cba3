"""Putting chosen samples together without visible seams, block by block.

Multiband after Burt and Adelson (ACM Trans. Graphics 1983): each frequency band fades over a
width of its own. What a sample does not show (beyond its edge, or shut out) is filled with the
composite before, so that neither black borders nor moving objects bleed across a seam.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.mosaic.stream.consensus import Choice
from streamtrack.mosaic.stream.painting import quartered
from streamtrack.mosaic.stream.tiles import Box
from streamtrack.settings import Blending
from streamtrack.types import Image, Mask

LEVELS = 4
HALO = 64
"""How far, in pixels, a block must see beyond its edge: the reach of the coarsest band."""

Floats: TypeAlias = npt.NDArray[np.float32]


def blended(choice: Choice, blending: Blending) -> Image:
    """The block's picture, BGRW (H, W, 4); sides must be multiples of 2 ** LEVELS for multiband."""
    if blending == "none":
        return choice.heaviest()
    if blending == "average":
        return choice.averaged()
    if blending == "feather":
        return choice.feathered()
    return _multiband(choice)


def _multiband(choice: Choice) -> Image:
    labels = choice.labels
    composite = choice.heaviest()
    counts = np.bincount(labels.ravel() + 1, minlength=len(choice.samples) + 1)
    used = (np.flatnonzero(counts) - 1).tolist()
    if np.count_nonzero(counts[1:]) < 2:
        return composite
    is_painted = labels >= 0
    ground = filled(composite[..., :3], is_painted)
    bands = [np.zeros_like(level) for level in _gaussian(ground.astype(np.float32))]
    for label in used:
        share = np.asarray(labels == label, np.uint8)
        x0, y0, x1, y1 = _reach(share)
        part = slice(y0, y1), slice(x0, x1)
        layer = ground[part]
        if label >= 0:
            shown = choice.weights[label][part]
            sample = choice.samples[label][part][..., :3]
            layer = np.asarray(cv2.copyTo(sample, shown, layer.copy()), np.uint8)
        weights = _gaussian(share[part].astype(np.float32))
        for level, band in enumerate(_laplacian(layer.astype(np.float32))):
            at = slice(y0 >> level, (y0 >> level) + band.shape[0])
            across = slice(x0 >> level, (x0 >> level) + band.shape[1])
            share3 = np.asarray(cv2.merge([weights[level]] * 3), np.float32)
            cv2.accumulateProduct(band, share3, bands[level][at, across])
    total = bands[-1]
    for band in reversed(bands[:-1]):
        total = _doubled(total, band) + band
    bgr = cv2.copyTo(cv2.convertScaleAbs(np.maximum(total, 0.0)), is_painted.view(np.uint8))
    return np.asarray(cv2.merge([*cv2.split(bgr), composite[..., 3]]), np.uint8)


def _reach(share: Image) -> Box:
    """The part of the block that the bands of a layer can touch, in units of the coarsest."""
    x, y, width, height = cv2.boundingRect(share)
    unit = 1 << LEVELS
    x0, y0 = max(x - HALO, 0) // unit * unit, max(y - HALO, 0) // unit * unit
    x1 = min(-(-(x + width + HALO) // unit) * unit, share.shape[1])
    y1 = min(-(-(y + height + HALO) // unit) * unit, share.shape[0])
    return x0, y0, x1, y1


def _gaussian(values: Floats) -> list[Floats]:
    pyramid = [values]
    for _ in range(LEVELS):
        pyramid.append(np.asarray(cv2.pyrDown(pyramid[-1]), np.float32))
    return pyramid


def _laplacian(values: Floats) -> list[Floats]:
    levels = _gaussian(values)
    bands = [fine - _doubled(coarse, fine) for fine, coarse in pairwise(levels)]
    return [*bands, levels[-1]]


def _doubled(coarse: Floats, like: Floats) -> Floats:
    size = like.shape[1], like.shape[0]
    return np.asarray(cv2.pyrUp(coarse, dstsize=size), np.float32)


def filled(bgr: Image, is_known: Mask) -> Image:
    """The picture with unknown pixels taken roughly from their surroundings (push and pull).

    Sides must be multiples of 4. Works at a quarter of the size: nobody sees these pixels, they
    only keep the coarse bands at the edge from turning dark.
    """
    if is_known.all():
        return bgr
    height, width = is_known.shape
    known = is_known.view(np.uint8) * np.uint8(255)
    pixels = np.asarray(cv2.merge([*cv2.split(cv2.copyTo(bgr, known)), known]), np.uint8)
    levels = [np.asarray(quartered(pixels), np.float32)]
    while min(levels[-1].shape[:2]) > 1:
        size = max(1, levels[-1].shape[1] // 2), max(1, levels[-1].shape[0] // 2)
        smaller = cv2.resize(levels[-1], size, interpolation=cv2.INTER_AREA)
        levels.append(np.asarray(smaller, np.float32))
    guess = levels[-1]
    for finer in reversed(levels[:-1]):
        size = finer.shape[1], finer.shape[0]
        coarser = np.asarray(cv2.resize(guess, size), np.float32)
        guess = finer + (1.0 - finer[..., 3:] / 255.0) * coarser
    colours = guess[..., :3] / np.maximum(guess[..., 3:] / 255.0, 1e-6)
    full = cv2.resize(cv2.convertScaleAbs(colours), (width, height))
    return np.asarray(cv2.copyTo(bgr, known, full), np.uint8)
