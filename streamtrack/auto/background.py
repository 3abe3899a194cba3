"""The background behind what moves, kept still while the camera moves.

Two models for every pixel, each a mean with an age: the background, and a candidate that gathers
what hides it and takes its place once it has been there for longer (Yi et al. 2013, "Detection of
moving objects with non-stationary cameras in 5.8 ms"). Other than there the models stay where they
are and the frame is warped to them: following the view they move by whole pixels only, so nothing
blurs as long as the camera does not turn or zoom much.

A pixel stands out if its colours lie outside the range of the background's within one pixel, which
forgives poses half a pixel off and a little parallax. Light that changes everywhere, evenly or
gradually over the picture, changes the background with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias, TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.camera.view_levels import filled
from streamtrack.types import Image, Mask, Matrix, Points, Size

Floats: TypeAlias = npt.NDArray[np.float32]
_Number = TypeVar("_Number", bound=np.generic)
_Pixel = TypeVar("_Pixel", np.uint8, np.float32)

_MAX_AGE = 40  # frames: the slowest the background follows
_HEALED_AFTER = 10  # frames that something must have stood to be taken for background
_KNOWN_AGE = 3  # frames before a pixel is judged
_MIN_CONTRAST = 11.0  # grey levels
_NOISE_FACTOR = 4.0
_MAX_CONTRAST = 60.0
_BROKEN_SHARE = 0.5
_LOW_SHARE = 0.55  # of the contrast, for pixels that adjoin clear ones
_MAX_TURN_PX = 8.0  # by which the view may differ from a shifted grid at its corners
_BLOCKS = (8, 6)
_MAX_LOG_GAIN = 0.7
_GAIN_SCALE = 0.06  # of blocks that follow the common change of light, in log units
_LEAST_LOG_GAIN = 0.004
_LEFT_RATIO = 0.7  # of edges now and in the background, along what something left behind
_SAME_COLOR = 14.0  # grey levels within which a candidate is confirmed
_RESTLESS_RATE = 0.08  # at which the noise of what flickers or sways in its place is learned
_DARKEST_SHADE = 0.45
_LOG = np.log(np.arange(256, dtype=np.float32) + 6)
_BOX = np.ones((3, 3), np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class Outstanding:
    """What differs from the background in one frame; all arrays in pixels of the model's grid.

    clear, faint      bool (h, w), differs clearly; differs at least faintly
    shade             bool (h, w), of those: darker in the same colour, as a shadow is
    image             uint8 (h, w, 3), the frame in the grid
    grey, grey_before uint8 (h, w), this frame and the one before, None if that is not known
    grid_from_frame   full-resolution pixels to grid pixels
    known             bool (h, w), what the model and the frame know
    noise             grey levels by which the frame differs from the background in general
    comparable        bool (h, w), what this frame and the one before show
    """

    clear: Mask
    faint: Mask
    shade: Mask
    image: Image
    grey: Image
    grey_before: Image | None
    grid_from_frame: Matrix
    known: Mask
    comparable: Mask
    noise: float

    @property
    def is_explained(self) -> bool:
        """False if the frame is, in most places, not the background at all."""
        is_near = _NOISE_FACTOR * self.noise <= _MAX_CONTRAST
        return is_near and float(np.mean(self.clear)) <= _BROKEN_SHARE


class BackgroundModel:
    """The background of one scene; ``size_wh`` is the reduced size of the frames."""

    def __init__(self, size_wh: Size, world_from_small: Matrix) -> None:
        width, height = size_wh
        self.size_wh = size_wh
        self._grid_from_world = geometry.inverted(world_from_small)
        self._mean: Floats = np.zeros((height, width, 3), np.float32)
        self._deviation: Floats = np.full((height, width), 3.0, np.float32)
        self._age: Floats = np.zeros((height, width), np.float32)
        self._candidate: Floats = np.zeros((height, width, 3), np.float32)
        self._candidate_age: Floats = np.zeros((height, width), np.float32)
        self._grey_before: Image | None = None
        self._seen_before: Mask = np.zeros((height, width), np.bool_)

    def compare(
        self,
        small: Image,
        world_from_small: Matrix,
        small_from_frame: Matrix,
        overlay: Sequence[Points],
    ) -> Outstanding:
        """What stands out in a reduced frame (h, w, 3) whose place in the world is given.

        Quads (4, 2) of the frame that lie over every picture show nothing of the scene.
        """
        grid_from_small = self._follow(world_from_small)
        small = np.asarray(cv2.GaussianBlur(small, (3, 3), 0), np.uint8)
        image, seen = self._in_grid(small, grid_from_small)
        if overlay:
            seen &= ~filled(overlay, grid_from_small @ small_from_frame, seen.shape)
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
        known = seen & (self._age >= _KNOWN_AGE)
        relit = self._relit(grey, known)
        background = np.asarray(cv2.convertScaleAbs(relit), np.uint8)
        distance = _largest_channel(
            cv2.max(
                cv2.subtract(image, cv2.dilate(background, _BOX)),
                cv2.subtract(cv2.erode(background, _BOX), image),
            )
        )
        off = _largest_channel(cv2.absdiff(image, background))
        noise = _noise(off[::3, ::3], known[::3, ::3])
        limit = np.maximum(self._deviation, np.float32(noise)) * np.float32(_NOISE_FACTOR)
        np.clip(limit, _MIN_CONTRAST, _MAX_CONTRAST, out=limit)
        clear = known & (distance > limit)
        limit *= np.float32(_LOW_SHARE)
        faint = known & (distance > limit)
        self._last = (image, off, seen, relit)
        before, self._grey_before = self._grey_before, grey
        comparable, self._seen_before = seen & self._seen_before, seen
        return Outstanding(
            clear,
            faint,
            _shaded(faint, image, background),
            image,
            grey,
            before,
            grid_from_small @ small_from_frame,
            known,
            comparable,
            noise,
        )

    def with_young(self, outstanding: Outstanding, moving: Mask) -> Outstanding:
        """What differs, with what moves (h, w) before a background that is not known yet."""
        young = moving & ~outstanding.known
        if not young.any():
            return outstanding
        return replace(
            outstanding, clear=outstanding.clear | young, faint=outstanding.faint | young
        )

    def learn(self, outstanding: Outstanding, moving: Mask, protected: Mask) -> None:
        """Take in the frame last compared.

        ``moving`` (h, w) is not at rest, and so no background that is not known yet; ``protected``
        belongs to things that are followed.
        """
        image, off, seen, self._mean = self._last
        is_no_ground = moving | protected
        self._age[(self._age < _KNOWN_AGE) & is_no_ground] = 0
        is_new = seen & (self._age == 0)
        if is_new.any():
            cv2.copyTo(image.astype(np.float32), is_new.view(np.uint8), self._mean)
            self._age[is_new & ~is_no_ground] = 1
        matches = seen & ~outstanding.faint & ~is_new
        rate = matches / np.minimum(self._age + 1, np.float32(_MAX_AGE))
        change = cv2.subtract(image, self._mean, dtype=cv2.CV_32F)
        cv2.accumulateProduct(change, cv2.merge([rate, rate, rate]), self._mean)
        restless = outstanding.faint & seen & ~is_no_ground
        rate[restless] = _RESTLESS_RATE
        excess = np.minimum(off, 40) * np.float32(1.2) - self._deviation
        cv2.accumulateProduct(excess, rate, self._deviation)
        self._age += matches
        self._candidate_age -= matches & (self._candidate_age > 0)
        self._candidate_age[moving] = 0
        self._learn_candidates(image, restless)

    def has_left(self, place: Mask) -> bool:
        """Is a place (h, w) that differs just where something stood that was taken for background?

        Its outline is then an edge of the background, and none of what is seen now.
        """
        image, _, _, _ = self._last
        inner = cv2.erode(place.astype(np.uint8), _BOX)
        outline = cv2.dilate(place.astype(np.uint8), _BOX) > inner
        now = np.mean(_edges(image)[outline]) if outline.any() else 0.0
        background = np.asarray(cv2.convertScaleAbs(self._mean), np.uint8)
        then = np.mean(_edges(background)[outline]) if outline.any() else 0.0
        return bool(now < _LEFT_RATIO * then)

    def heal(self, place: Mask) -> None:
        """Take what is seen at a place (h, w) for background from now on."""
        image, _, seen, _ = self._last
        place = place & seen
        self._mean[place] = image[place]
        self._age[place] = _KNOWN_AGE
        self._deviation[place] = 3.0
        self._candidate_age[place] = 0

    def _learn_candidates(self, image: Image, hiding: Mask) -> None:
        """Let what hides the background, and is not followed, become background if it lasts."""
        rows, columns = np.nonzero(hiding)
        if not len(rows):
            return
        now, age = image[rows, columns].astype(np.float32), self._candidate_age[rows, columns]
        mean = self._candidate[rows, columns]
        off = np.abs(now - mean)
        is_same = np.maximum(np.maximum(off[:, 0], off[:, 1]), off[:, 2]) < _SAME_COLOR
        is_same &= age > 0
        age = np.where(is_same, age + 1, 1).astype(np.float32)
        mean = np.where(is_same[:, None], mean + (now - mean) / age[:, None], now)
        self._candidate[rows, columns], self._candidate_age[rows, columns] = mean, age
        lasts = age > np.minimum(self._age[rows, columns], _HEALED_AFTER)
        rows, columns = rows[lasts], columns[lasts]
        self._mean[rows, columns] = mean[lasts]
        self._age[rows, columns] = np.minimum(age[lasts], _KNOWN_AGE)
        self._deviation[rows, columns] = 3.0
        self._candidate_age[rows, columns] = 0

    def _follow(self, world_from_small: Matrix) -> Matrix:
        """Move the grid to the view; grid_from_small."""
        grid_from_small = geometry.normalized(self._grid_from_world @ world_from_small)
        corners = geometry.image_quad(self.size_wh)
        off = geometry.transform_points(grid_from_small, corners) - corners
        if not np.isfinite(off).all():
            off = np.full((4, 2), np.inf)
        shift = np.rint(off.mean(axis=0)) if np.abs(off).max() < 1e6 else np.zeros(2)
        if np.abs(off - shift).max() > _MAX_TURN_PX:
            self._warp(geometry.inverted(grid_from_small))
            self._grid_from_world = geometry.inverted(world_from_small)
            return np.eye(3)
        if not shift.any():
            return grid_from_small
        self._shift(int(shift[0]), int(shift[1]))
        moved = geometry.translation(-shift[0], -shift[1])
        self._grid_from_world = moved @ self._grid_from_world
        return geometry.normalized(moved @ grid_from_small)

    def _shift(self, dx: int, dy: int) -> None:
        """Move the grid by whole pixels over the scene."""
        self._mean = _shifted(self._mean, dx, dy)
        self._deviation = _shifted(self._deviation, dx, dy)
        self._age = _shifted(self._age, dx, dy)
        self._candidate = _shifted(self._candidate, dx, dy)
        self._candidate_age = _shifted(self._candidate_age, dx, dy)
        if self._grey_before is not None:
            self._grey_before = _shifted(self._grey_before, dx, dy)
            self._seen_before = _shifted(self._seen_before, dx, dy)

    def _warp(self, new_from_grid: Matrix) -> None:
        """Lay the models out anew after a turn or a zoom."""
        size = self.size_wh
        smooth, plain = cv2.INTER_LINEAR, cv2.INTER_NEAREST
        if not np.isfinite(new_from_grid).all():
            self._age[:] = 0
            self._grey_before = None
            return
        self._mean = np.asarray(
            cv2.warpPerspective(
                self._mean, new_from_grid, size, flags=smooth, borderMode=cv2.BORDER_REPLICATE
            ),
            np.float32,
        )
        self._deviation = _warped(self._deviation, new_from_grid, size, smooth)
        self._age = _warped(self._age, new_from_grid, size, plain)
        self._candidate_age[:] = 0
        if self._grey_before is not None:
            self._grey_before = _warped(self._grey_before, new_from_grid, size, smooth)
            seen_before = self._seen_before.astype(np.uint8)
            self._seen_before = _warped(seen_before, new_from_grid, size, plain) > 0

    def _in_grid(self, small: Image, grid_from_small: Matrix) -> tuple[Image, Mask]:
        """The frame in the grid, and which of the grid's pixels it shows."""
        corners = geometry.image_quad(self.size_wh)
        off = geometry.transform_points(grid_from_small, corners) - corners
        if np.abs(off).max() < 0.02:
            return small, np.ones(small.shape[:2], np.bool_)
        image = cv2.warpPerspective(
            small, grid_from_small, self.size_wh, borderMode=cv2.BORDER_REPLICATE
        )
        seen = np.zeros(small.shape[:2], np.uint8)
        inner = geometry.box_quad(1, 1, self.size_wh[0] - 3, self.size_wh[1] - 3)
        outline = np.rint(geometry.transform_points(grid_from_small, inner)).astype(np.int32)
        cv2.fillConvexPoly(seen, outline, 1)
        return np.asarray(image, np.uint8), seen > 0

    def _relit(self, grey: Image, known: Mask) -> Floats:
        """The background's mean (h, w, 3) in the light of the frame."""
        if np.mean(known) < 0.2:
            return self._mean
        mean = cv2.convertScaleAbs(self._mean[::3, ::3])
        background = np.asarray(cv2.cvtColor(mean, cv2.COLOR_BGR2GRAY), np.uint8)
        log_gain = _light_change(grey[::3, ::3], background, known[::3, ::3])
        if log_gain is None or np.abs(log_gain).max() < _LEAST_LOG_GAIN:
            return self._mean
        field = cv2.resize(np.exp(log_gain), self.size_wh, interpolation=cv2.INTER_LINEAR)
        relit = cv2.multiply(self._mean, cv2.merge([field, field, field]))
        return np.minimum(np.asarray(relit, np.float32), np.float32(255))


def _shifted(array: npt.NDArray[_Number], dx: int, dy: int) -> npt.NDArray[_Number]:
    """The array seen ``(dx, dy)`` pixels further on; zero where it did not reach."""
    moved = np.zeros(array.shape, array.dtype)  # pages of zeros cost less than `zeros_like`
    height, width = array.shape[:2]
    if abs(dx) >= width or abs(dy) >= height:
        return moved
    to_y, from_y = slice(max(0, -dy), height - max(0, dy)), slice(max(0, dy), height - max(0, -dy))
    to_x, from_x = slice(max(0, -dx), width - max(0, dx)), slice(max(0, dx), width - max(0, -dx))
    moved[to_y, to_x] = array[from_y, from_x]
    return moved


def _warped(
    array: npt.NDArray[_Pixel], matrix: Matrix, size_wh: Size, flags: int
) -> npt.NDArray[_Pixel]:
    return np.asarray(cv2.warpPerspective(array, matrix, size_wh, flags=flags), array.dtype)


def _light_change(grey: Image, background: Image, known: Mask) -> Floats | None:
    """Log of the gain (rows, columns of blocks) by which the frame is brighter than its background.

    A quadratic over the picture, fitted to the blocks' medians by reweighting (Tukey), so that
    things that cover less than half of the picture do not count.
    """
    columns, rows = _BLOCKS
    height, width = grey.shape[0] // rows * rows, grey.shape[1] // columns * columns
    if min(height // rows, width // columns) < 4:
        return None
    change = _LOG[grey[:height, :width]] - _LOG[background[:height, :width]]
    change[~known[:height, :width]] = np.nan
    blocks = change.reshape(rows, height // rows, columns, width // columns)
    blocks = np.sort(blocks.swapaxes(1, 2).reshape(rows * columns, -1), axis=1)  # NaN at the end
    counts = np.count_nonzero(np.isfinite(blocks), axis=1)
    has_values = counts > 0.5 * blocks.shape[1]
    if np.count_nonzero(has_values) < 8:
        return None
    values = np.where(has_values, blocks[np.arange(len(blocks)), counts // 2], 0.0)
    y, x = np.mgrid[-1 : 1 : rows * 1j, -1 : 1 : columns * 1j].reshape(2, -1)
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    fitted = np.full(len(values), np.median(values[has_values]))
    for _ in range(4):
        ratio = np.abs(values - fitted) / _GAIN_SCALE
        weights = np.where(has_values, np.maximum(0, 1 - ratio**2) ** 2, 0)
        if np.count_nonzero(weights) < 8:
            return None
        weighted = terms * weights[:, None]
        normal = weighted.T @ terms + np.diag([1e-6, 0.3, 0.3, 0.6, 0.6, 0.6])
        fitted = terms @ np.linalg.solve(normal, weighted.T @ values)
    clipped = np.clip(fitted, -_MAX_LOG_GAIN, _MAX_LOG_GAIN)
    return np.asarray(clipped.reshape(rows, columns), np.float32)


def _edges(image: Image) -> Image:
    """Strength (h, w) of the edges in a picture (h, w, 3)."""
    gradient = cv2.morphologyEx(image, cv2.MORPH_GRADIENT, _BOX)
    return _largest_channel(gradient)


def _noise(off: Image, known: Mask) -> float:
    """Standard deviation from the median of differences (h, w) where the background is known."""
    values = off[known]
    return 1.4826 * float(np.median(values)) if len(values) else 0.0


def _largest_channel(image: npt.NDArray[np.integer[Any] | np.floating[Any]]) -> Image:
    """Largest value (h, w) of each pixel's channels."""
    blue, green, red = cv2.split(image)
    return np.asarray(cv2.max(cv2.max(blue, green), red), np.uint8)


def _shaded(differing: Mask, image: Image, background: Image) -> Mask:
    """Which of the differing pixels (h, w) are darker than the background in the same colour."""
    now, then = image[differing].astype(np.float32).T, background[differing].astype(np.float32).T
    ratio = (now[0] + now[1] + now[2] + 6) / (then[0] + then[1] + then[2] + 6)
    off = np.abs(now - ratio * then)
    other_color = np.maximum(np.maximum(off[0], off[1]), off[2])
    brightest = np.maximum(np.maximum(then[0], then[1]), then[2])
    shaded = np.zeros(differing.shape, np.bool_)
    is_darker = (ratio > _DARKEST_SHADE) & (ratio < 0.97)
    shaded[differing] = is_darker & (other_color < 4 + 0.05 * brightest)
    return shaded
