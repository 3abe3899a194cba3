"""Keypoints and descriptors by name.

Corner detectors (harris, fast, agast, gftt) see one scale only, so they run on an image pyramid
and the descriptor is computed on the pyramid level in which the corner was found. Detectors with
a scale of their own (brisk, orb, sift, akaze) run once on the full picture.

One meaning of ``threshold`` for each detector (`settings.DEFAULT_THRESHOLDS` has the defaults):

harris  cornerness det(M) - 0.04 trace(M)^2 of the structure tensor from 3x3 Sobel gradients,
        summed over 3x3 pixels, grey values in 0..1 (Harris & Stephens 1988; `cv2.cornerHarris`)
fast    grey-level difference between centre and circle, 0..255 (Rosten & Drummond 2006)
agast   the same (Mair et al. 2010)
gftt    share of the strongest corner's smaller eigenvalue, 0..1 (Shi & Tomasi 1994)
brisk   AGAST grey-level difference, 0..255 (Leutenegger et al. 2011)
orb     FAST grey-level difference, 0..255 (Rublee et al. 2011)
sift    contrast of the difference-of-Gaussians extremum, 0..1 (Lowe 2004)
akaze   determinant-of-Hessian response (Alcantarilla et al. 2013)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.errors import UsageError
from streamtrack.feature_pyramid import Band, level_count, part_of_pyramid, pyramid, quotas
from streamtrack.geometry import transform_points
from streamtrack.settings import FeatureSettings
from streamtrack.types import Features, Image, Points

_CORNERS = ("harris", "fast", "agast", "gftt")
COMPATIBLE = {
    **dict.fromkeys(_CORNERS, ("freak", "brisk", "orb", "teblid", "sift")),
    "brisk": ("freak", "brisk", "teblid", "sift"),
    "orb": ("freak", "brisk", "orb", "teblid"),
    "sift": ("freak", "brisk", "teblid", "sift"),
    "akaze": ("freak", "brisk", "teblid", "sift", "akaze"),
}
"""Descriptors that fit each detector. ORB's needs ORB's octaves, AKAZE's its own scale space."""

_BAND_MARGIN_PX = 32
_MIN_PICTURE_PX = 16
_CORNER_SIZE_PX = 7.0
_SPREAD_CELLS = 12
_HIGHEST_THRESHOLD = {
    "harris": 1e6,
    "fast": 255.0,
    "agast": 255.0,
    "gftt": 1.0,
    "brisk": 255.0,
    "orb": 255.0,
}
# ORB calls the whole patch it describes the keypoint's size; FREAK and BRISK the keypoint alone.
_SIZE_OF_ORB_KEYPOINT = {"freak": 7 / 31, "brisk": 12 / 31}
_HARRIS_K = 0.04
# TEBLID's `scale_factor` for each detector's notion of keypoint size (OpenCV's documentation).
_TEBLID_SCALE = {"sift": 6.75, "orb": 1.0}
_TEBLID_SCALE_OTHERS = 5.0

Floats: TypeAlias = npt.NDArray[np.float32]
Corners: TypeAlias = tuple[Points, Floats]


class FeatureExtractor:
    """Detects and describes keypoints as the settings say; keeps OpenCV's objects for reuse.

    Raises UsageError at construction if detector and descriptor do not fit each other or the
    threshold is out of range.
    """

    def __init__(self, settings: FeatureSettings) -> None:
        fitting = COMPATIBLE[settings.detector]
        if settings.descriptor not in fitting:
            raise UsageError(
                f"descriptor '{settings.descriptor}' does not fit detector "
                f"'{settings.detector}': use one of {', '.join(fitting)}"
            )
        self.threshold = settings.threshold_or_default
        if not self.threshold > 0 or not np.isfinite(self.threshold):
            raise UsageError(f"threshold {self.threshold} is not a positive number")
        highest = _HIGHEST_THRESHOLD.get(settings.detector)
        if highest is not None and self.threshold > highest:
            raise UsageError(
                f"threshold {self.threshold:g} is too high for detector "
                f"'{settings.detector}': it goes from 0 to {highest:g}"
            )
        self._settings = settings
        self._describer = _make_describer(settings.detector, settings.descriptor)
        self._needs_angles = settings.descriptor in ("orb", "teblid", "sift")

    def extract(self, grey: Image, mask: Image | None = None) -> Features:
        """Features of a grey picture (H, W), at most ``max_features``, spread over it.

        ``mask`` (H, W) uint8 is zero where no keypoint may lie; descriptors still see the
        pixels there.
        """
        if min(grey.shape) < _MIN_PICTURE_PX:
            return no_features()
        if self._settings.detector in _CORNERS:
            return self._extract_from_pyramid(grey, mask)
        return self._extract_with_own_scale(grey, mask)

    def extract_part(self, grey: Image, part: int | None) -> Features:
        """One of the parts of what `extract` would find, at little cost; ``part`` counts in turns.

        Part None is what of all can be found at once in tolerable time.

        A part is one level of the pyramid, a band of a large one, or all the small ones together:
        a search over several frames sees everything, and no frame takes long. Detectors with a
        scale of their own cannot be divided and give all.
        """
        if self._settings.detector not in _CORNERS or min(grey.shape) < _MIN_PICTURE_PX:
            return self.extract(grey)
        return self._extract_from_pyramid(
            grey, None, part_of_pyramid((grey.shape[1], grey.shape[0]), part)
        )

    def _extract_from_pyramid(
        self, grey: Image, mask: Image | None, bands: Sequence[Band] | None = None
    ) -> Features:
        deepest = None if bands is None else max(band.level for band in bands)
        levels = pyramid(grey, deepest)
        if bands is None:
            bands = [Band(number, 0, len(level)) for number, (level, _) in enumerate(levels)]
        count = level_count((grey.shape[1], grey.shape[0]))
        most = quotas(count, self._settings.max_features)
        parts = []
        for band in bands:
            level, full_from_level = levels[band.level]
            first = max(0, band.first_row - _BAND_MARGIN_PX)
            rows = level[first : band.end_row + _BAND_MARGIN_PX]
            shown = None if mask is None else _resized_mask(mask, level)
            quota = round(most[band.level] * len(rows) / len(level))
            found = self._describe_corners(rows, shown, max(1, quota))
            factor = np.float32(full_from_level[0, 0])
            parts.append(
                Features(
                    transform_points(
                        full_from_level, found.points + np.array([0, first], np.float32)
                    ),
                    found.sizes * factor,
                    found.responses,
                    found.descriptors,
                )
            )
        return _concatenated(parts)

    def _describe_corners(self, level: Image, mask: Image | None, quota: int) -> Features:
        points, responses = _detect_corners(self._settings.detector, level, self.threshold)
        if mask is not None:
            kept = _inside(mask, points)
            points, responses = points[kept], responses[kept]
        rows = _spread_rows(points, responses, (level.shape[1], level.shape[0]), quota)
        points, responses = points[rows], responses[rows]
        if self._settings.detector != "harris":
            points = _refined(level, points)
        angles = _orientations(level, points) if self._needs_angles else np.full(len(rows), -1.0)
        keypoints = [
            cv2.KeyPoint(x, y, _CORNER_SIZE_PX, angle, response, 0, i)
            for i, ((x, y), angle, response) in enumerate(
                zip(points.tolist(), angles.tolist(), responses.tolist(), strict=True)
            )
        ]
        return self._described(level, keypoints)

    def _extract_with_own_scale(self, grey: Image, mask: Image | None) -> Features:
        detector = _make_detector(self._settings.detector, self.threshold)
        keypoints = list(detector.detect(grey, mask))
        points = _points_of(keypoints)
        responses = np.array([k.response for k in keypoints], np.float32)
        size_wh = (grey.shape[1], grey.shape[0])
        rows = _spread_rows(points, responses, size_wh, self._settings.max_features)
        chosen = [keypoints[i] for i in rows]
        if self._settings.descriptor != self._settings.detector:
            # Octaves mean something else to every descriptor; the keypoint's size says it all.
            for keypoint in chosen:
                keypoint.octave = 0
        if self._settings.detector == "orb":
            for keypoint in chosen:
                keypoint.size *= _SIZE_OF_ORB_KEYPOINT.get(self._settings.descriptor, 1.0)
        return self._described(grey, chosen)

    def _described(self, grey: Image, keypoints: Sequence[cv2.KeyPoint]) -> Features:
        if not keypoints:
            return no_features()
        kept, descriptors = self._describer.compute(grey, keypoints)
        if descriptors is None or len(kept) == 0:
            return no_features()
        return Features(
            _points_of(kept),
            np.array([k.size for k in kept], np.float32),
            np.array([k.response for k in kept], np.float32),
            descriptors,
        )


def no_features() -> Features:
    """The features of a picture that has none."""
    none = np.zeros(0, np.float32)
    return Features(np.zeros((0, 2), np.float32), none, none, np.zeros((0, 1), np.uint8))


def _concatenated(parts: Sequence[Features]) -> Features:
    filled = [part for part in parts if len(part)]
    if not filled:
        return no_features()
    return Features(
        np.concatenate([part.points for part in filled]),
        np.concatenate([part.sizes for part in filled]),
        np.concatenate([part.responses for part in filled]),
        np.concatenate([part.descriptors for part in filled]),
    )


def _points_of(keypoints: Sequence[cv2.KeyPoint]) -> Points:
    points: Points = np.asarray(cv2.KeyPoint.convert(keypoints), np.float32).reshape(-1, 2)
    return points


def _resized_mask(mask: Image | None, level: Image) -> Image | None:
    if mask is None or mask.shape == level.shape:
        return mask
    size = level.shape[1], level.shape[0]
    return np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST), np.uint8)


def _inside(mask: Image, points: Points) -> npt.NDArray[np.bool_]:
    column, row = np.rint(points).astype(np.intp).T
    height, width = mask.shape
    inside: npt.NDArray[np.bool_] = (
        mask[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)] > 0
    )
    return inside


def _spread_rows(
    points: Points, responses: Floats, size_wh: tuple[int, int], count: int
) -> npt.NDArray[np.intp]:
    """Rows of at most ``count`` keypoints: the best of every grid cell, then the second-best ...

    Keeps weak corners of poor regions in preference to the hundredth corner on one texture.
    """
    by_response = np.argsort(-responses, kind="stable")
    if len(points) <= count:
        return by_response
    cell_px = max(size_wh) / _SPREAD_CELLS
    column, row = (points[by_response] // cell_px).astype(np.intp).T
    cell = row * (_SPREAD_CELLS + 1) + column
    grouped = np.argsort(cell, kind="stable")
    starts = np.searchsorted(cell[grouped], cell[grouped], side="left")
    rank = np.empty(len(points), np.intp)
    rank[grouped] = np.arange(len(points)) - starts
    return by_response[np.argsort(rank, kind="stable")[:count]]


def _detect_corners(name: str, grey: Image, threshold: float) -> Corners:
    if name == "harris":
        return _detect_harris(grey, threshold)
    if name == "gftt":
        return _detect_gftt(grey, threshold)
    keypoints = _make_detector(name, threshold).detect(grey)
    points = _points_of(keypoints)
    responses = np.array([k.response for k in keypoints], np.float32)
    return points, responses


def _detect_harris(grey: Image, threshold: float) -> Corners:
    """Local maxima (5x5) of the cornerness map above the threshold, to sub-pixel."""
    cornerness = _cornerness(grey)
    is_peak = cornerness == cv2.dilate(cornerness, np.ones((5, 5), np.uint8))
    is_peak &= cornerness > threshold
    is_peak[[0, -1], :] = False
    is_peak[:, [0, -1]] = False
    # `np.nonzero` of two dimensions is eight times as slow.
    row, column = np.divmod(np.flatnonzero(is_peak), is_peak.shape[1])
    return _parabola_peaks(cornerness, row, column), cornerness[row, column]


def _parabola_peaks(
    response: Floats, row: npt.NDArray[np.intp], column: npt.NDArray[np.intp]
) -> Points:
    """Peak of the parabola through each maximum and its neighbours, along x and along y."""

    def offset(before: Floats, centre: Floats, after: Floats) -> Floats:
        curvature = before - 2 * centre + after
        safe = np.where(curvature < 0, curvature, -1.0)
        shift = np.where(curvature < 0, 0.5 * (before - after) / safe, 0.0)
        return np.clip(shift, -0.5, 0.5).astype(np.float32)

    centre = response[row, column]
    dx = offset(response[row, column - 1], centre, response[row, column + 1])
    dy = offset(response[row - 1, column], centre, response[row + 1, column])
    return np.stack([column + dx, row + dy], axis=1).astype(np.float32)


def _detect_gftt(grey: Image, threshold: float) -> Corners:
    no_mask = np.full(grey.shape, 255, np.uint8)
    corners, quality = cv2.goodFeaturesToTrackWithQuality(
        grey, maxCorners=0, qualityLevel=threshold, minDistance=3, mask=no_mask
    )[:2]
    if corners is None:
        return np.zeros((0, 2), np.float32), np.zeros(0, np.float32)
    return np.asarray(corners, np.float32).reshape(-1, 2), np.asarray(quality, np.float32).ravel()


def _refined(grey: Image, points: Points) -> Points:
    """Whole-pixel corners moved to the nearby peak of Harris's cornerness, to sub-pixel.

    Twice as repeatable as `cv2.cornerSubPix`, which leaves two thirds of such corners where
    they are or throws them off.
    """
    if len(points) == 0:
        return points
    cornerness = _cornerness(grey)
    height, width = grey.shape
    column, row = np.clip(np.rint(points), 2, (width - 3, height - 3)).astype(np.intp).T
    around = np.stack([cornerness[row + dy, column + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
    best = around.argmax(axis=0)
    return _parabola_peaks(cornerness, row + best // 3 - 1, column + best % 3 - 1)


def _cornerness(grey: Image) -> Floats:
    return np.asarray(cv2.cornerHarris(grey, 3, 3, _HARRIS_K), np.float32)


def _orientations(grey: Image, points: Points) -> npt.NDArray[np.float64]:
    """Angle in degrees from each point to the intensity centroid around it (Rosin 1999; ORB)."""
    dx, dy = _disc_offsets()
    height, width = grey.shape
    centre = np.rint(points).astype(np.intp)
    columns = np.clip(centre[:, :1] + dx, 0, width - 1)
    rows = np.clip(centre[:, 1:] + dy, 0, height - 1)
    values = grey[rows, columns].astype(np.float64)
    angles: npt.NDArray[np.float64] = np.degrees(np.arctan2(values @ dy, values @ dx)) % 360.0
    return angles


@cache
def _disc_offsets() -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Every second pixel of a disc of radius 15, which halves the reading in each direction."""
    dy, dx = np.mgrid[-14:15:2, -14:15:2]
    in_disc = dx**2 + dy**2 <= 15**2
    return dx[in_disc], dy[in_disc]


@cache
def _make_detector(name: str, threshold: float) -> cv2.Feature2D:
    grey_levels = max(1, round(min(threshold, 255)))
    makers: dict[str, Callable[[], cv2.Feature2D]] = {
        "fast": lambda: cv2.FastFeatureDetector.create(grey_levels),
        "agast": lambda: cv2.xfeatures2d.AgastFeatureDetector.create(grey_levels),
        "brisk": lambda: cv2.xfeatures2d.BRISK.create(grey_levels),
        "orb": lambda: cv2.ORB.create(20_000, fastThreshold=grey_levels),
        "sift": lambda: cv2.SIFT.create(contrastThreshold=threshold),
        "akaze": lambda: cv2.xfeatures2d.AKAZE.create(threshold=threshold),
    }
    return makers[name]()


@cache
def _freak() -> cv2.Feature2D:
    """FREAK, with its table of patterns made: 20 ms, so one serves all.

    Describing only reads the table, from any thread.
    """
    freak = cv2.xfeatures2d.FREAK.create()
    freak.compute(np.zeros((128, 128), np.uint8), [cv2.KeyPoint(64, 64, _CORNER_SIZE_PX)])
    return freak


def _make_describer(detector: str, descriptor: str) -> cv2.Feature2D:
    teblid_scale = _TEBLID_SCALE.get(detector, _TEBLID_SCALE_OTHERS)
    makers: dict[str, Callable[[], cv2.Feature2D]] = {
        "freak": _freak,
        "brisk": lambda: cv2.xfeatures2d.BRISK.create(),
        "orb": lambda: cv2.ORB.create(),
        "teblid": lambda: cv2.xfeatures2d.TEBLID.create(
            teblid_scale, cv2.xfeatures2d.TEBLID_SIZE_256_BITS
        ),
        "sift": lambda: cv2.SIFT.create(),
        "akaze": lambda: cv2.xfeatures2d.AKAZE.create(),
    }
    return makers[descriptor]()
