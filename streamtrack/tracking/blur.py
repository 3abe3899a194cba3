"""Motion blur: how a frame is smeared against the template, and the template smeared alike.

A picture moving along d while the shutter is open loses gradient energy along d and none across
it. So the direction is the generalised eigenvector of the two pictures' structure tensors that
lost most, and the length is the one that costs the template as much.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.types import Image, Mask

Doubles = npt.NDArray[np.float64]

_SHARP_RATIO = 0.7
_FACTORS = (0.6, 0.8, 1.0, 1.2, 1.45, 1.75)
_LENGTHS_PX = (2.0, 3.0, 4.5, 6.5, 9.0, 12.5, 17.0)


def motion_blur(template: Image, seen: Image, area: Mask) -> Doubles:
    """The vector (2,), in pixels, along which ``seen`` is smeared against ``template``.

    Both (h, w) and about aligned; ``area`` (h, w) is where they show the same. Zero if the
    picture is as sharp as the template, or equally blurred in all directions.
    """
    sharp, smeared = _structure(template, area), _structure(seen, area)
    try:
        values, vectors = np.linalg.eig(np.linalg.solve(sharp, smeared))
    except np.linalg.LinAlgError:
        return np.zeros(2)
    lost_most = int(np.argmin(np.real(values)))
    if np.real(values[lost_most]) > _SHARP_RATIO * np.real(values[1 - lost_most]):
        return np.zeros(2)
    along: Doubles = np.real(vectors[:, lost_most]).astype(np.float64)
    along = along / np.hypot(along[0], along[1])
    across = np.array([-along[1], along[0]])
    wanted = _energy_ratio(smeared, sharp, along, across)
    shorter_px, more_left = 0.0, 1.0
    for length_px in _LENGTHS_PX:
        tried = _structure(smeared_along(template, along * length_px), area)
        left = _energy_ratio(tried, sharp, along, across)
        if left <= wanted:
            share = (more_left - wanted) / max(more_left - left, 1e-6)
            return along * (shorter_px + min(1.0, share) * (length_px - shorter_px))
        shorter_px, more_left = length_px, left
    return along * shorter_px


def with_best_length(template: Image, seen: Image, area: Mask, vector: Doubles) -> Doubles:
    """``vector`` made longer or shorter, as ``seen``, now well aligned, correlates best."""
    values = seen[area].astype(np.float32)
    values -= values.mean()

    @cache
    def correlation(place: int) -> float:
        smeared = smeared_along(template, vector * _FACTORS[place])[area].astype(np.float32)
        smeared -= smeared.mean()
        return float(smeared @ values) / (float(np.linalg.norm(smeared)) + 1e-6)

    # There is one best length, so from no change it is uphill.
    best = _FACTORS.index(1.0)
    for step in (-1, 1):
        while 0 <= best + step < len(_FACTORS) and correlation(best + step) > correlation(best):
            best += step
    return vector * _FACTORS[best]


def smeared_along(image: Image, vector: Doubles) -> Image:
    """``image`` averaged along a line of length and direction ``vector`` (2,), in pixels."""
    reach = int(np.ceil(np.abs(vector).max() / 2)) + 1
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    samples = 4 * int(np.ceil(np.linalg.norm(vector))) + 1
    places = reach + np.linspace(-0.5, 0.5, samples)[:, None] * vector
    whole = places.astype(np.intp)
    fx, fy = (places - whole).T
    column, row = whole.T
    for dy, weight_y in ((0, 1 - fy), (1, fy)):
        for dx, weight_x in ((0, 1 - fx), (1, fx)):
            np.add.at(kernel, (row + dy, column + dx), weight_y * weight_x)
    kernel /= samples
    smeared = cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(smeared, np.uint8)


def _structure(image: Image, area: Mask) -> Doubles:
    """Sum of the gradients' outer products (2, 2) over an area, kept away from singular."""
    gx = np.asarray(cv2.Sobel(image, cv2.CV_32F, 1, 0, ksize=3), np.float64)[area]
    gy = np.asarray(cv2.Sobel(image, cv2.CV_32F, 0, 1, ksize=3), np.float64)[area]
    gradients = np.stack([gx, gy])
    return np.asarray(gradients @ gradients.T + np.eye(2), np.float64)


def _energy_ratio(smeared: Doubles, sharp: Doubles, along: Doubles, across: Doubles) -> float:
    """Share of the gradient energy left along a direction, against that left across it."""
    left_along = float(along @ smeared @ along) / float(along @ sharp @ along)
    left_across = float(across @ smeared @ across) / float(across @ sharp @ across)
    return left_along / max(left_across, 1e-12)
