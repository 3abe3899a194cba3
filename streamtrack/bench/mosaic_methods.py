"""What registers two pictures: streamtrack with any features, and plain peers from OpenCV."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.features import COMPATIBLE
from streamtrack.geometry import grey_of
from streamtrack.mosaic.pairs.registering import PictureRegistrar
from streamtrack.settings import build_settings
from streamtrack.types import Image, Matrix, Points

PEER_FEATURES = 1000
PEER_RATIO = 0.8
PEER_THRESHOLD_PX = 3.0
OWN = "streamtrack"


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What a method said of two pictures.

    ``b_from_a`` is None where it claims nothing, ``reason`` then says why. ``a_inliers`` and
    ``b_inliers`` (N, 2) are the pairs that its estimate rests on, ``pairs`` is how many it was
    estimated from. ``a_points``, ``b_points`` are all keypoints and ``matches`` (K, 2) the rows
    of either that descriptor matching paired.
    """

    b_from_a: Matrix | None
    reason: str
    a_inliers: Points
    b_inliers: Points
    pairs: int
    a_points: Points
    b_points: Points
    matches: npt.NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class PairMethod:
    """One row of the benchmark; ``make`` sets it up, once."""

    name: str
    title: str
    make: Callable[[], Callable[[Image, Image], Outcome]]
    parameters: Mapping[str, Any] = field(default_factory=dict)


def own_method(detector: str, descriptor: str, name: str = "") -> PairMethod:
    """streamtrack's own registration with a detector and a descriptor, defaults otherwise."""
    settings = build_settings({"features": {"detector": detector, "descriptor": descriptor}})
    parameters = settings.model_dump(mode="json", include={"features", "matching", "registration"})

    def make() -> Callable[[Image, Image], Outcome]:
        registrar = PictureRegistrar(settings)
        return lambda a, b: _linked(registrar, a, b)

    title = f"{detector} + {descriptor}"
    return PairMethod(name or f"{detector}+{descriptor}", title, make, {"settings": parameters})


def _linked(registrar: PictureRegistrar, a: Image, b: Image) -> Outcome:
    first, second = registrar.picture(0, "a", a), registrar.picture(1, "b", b)
    link = registrar.link(first, second)
    is_inlier = link.registration.is_inlier
    return Outcome(
        link.b_from_a,
        "" if link.b_from_a is not None else str(link.verdict),
        link.a_points[is_inlier],
        link.b_points[is_inlier],
        len(link.a_points),
        first.features.points,
        second.features.points,
        np.stack([link.matches.ref, link.matches.cur], axis=1),
    )


def compatible_methods() -> list[PairMethod]:
    """streamtrack with every detector and each descriptor that fits it."""
    return [
        own_method(detector, descriptor)
        for detector, descriptors in COMPATIBLE.items()
        for descriptor in descriptors
    ]


def main_methods() -> list[PairMethod]:
    """streamtrack as it comes, and OpenCV's own features used plainly."""
    settings = build_settings({}).features
    own = own_method(settings.detector, settings.descriptor, OWN)
    return [PairMethod(OWN, "streamtrack", own.make, own.parameters), *map(_peer, _PEERS)]


_PEERS: dict[str, Callable[[], cv2.Feature2D]] = {
    "SIFT": lambda: cv2.SIFT.create(PEER_FEATURES),
    "ORB": lambda: cv2.ORB.create(PEER_FEATURES),
    "BRISK": lambda: cv2.xfeatures2d.BRISK.create(),
    "AKAZE": lambda: cv2.xfeatures2d.AKAZE.create(),
}


def _peer(name: str) -> PairMethod:
    """detectAndCompute, brute-force matching with ratio test, USAC_MAGSAC."""
    parameters = {
        "features": f"the {PEER_FEATURES} strongest",
        "max_ratio": PEER_RATIO,
        "estimator": "cv2.findHomography, USAC_MAGSAC",
        "threshold_px": PEER_THRESHOLD_PX,
    }

    def make() -> Callable[[Image, Image], Outcome]:
        features = _PEERS[name]()
        norm = cv2.NORM_L2 if name == "SIFT" else cv2.NORM_HAMMING
        return lambda a, b: _plainly(features, cv2.BFMatcher(norm), a, b)

    return PairMethod(name.lower(), f"{name} + MAGSAC", make, parameters)


def _plainly(features: cv2.Feature2D, matcher: cv2.BFMatcher, a: Image, b: Image) -> Outcome:
    (a_points, a_rows), (b_points, b_rows) = (_strongest(features, image) for image in (a, b))
    matches = np.zeros((0, 2), np.intp)
    if len(a_points) and len(b_points) > 1:
        best = [
            (first.queryIdx, first.trainIdx)
            for first, second in matcher.knnMatch(a_rows, b_rows, k=2)
            if first.distance < PEER_RATIO * second.distance
        ]
        matches = np.array(best, np.intp).reshape(-1, 2)
    found, mask = None, None
    ours, theirs = a_points[matches[:, 0]], b_points[matches[:, 1]]
    if len(matches) >= 4:
        found, mask = cv2.findHomography(ours, theirs, cv2.USAC_MAGSAC, PEER_THRESHOLD_PX)
    is_inlier = np.zeros(len(matches), np.bool_) if mask is None else mask.ravel() > 0
    return Outcome(
        None if found is None else np.asarray(found, np.float64),
        "" if found is not None else "no estimate",
        ours[is_inlier],
        theirs[is_inlier],
        len(matches),
        a_points,
        b_points,
        matches,
    )


def _strongest(
    features: cv2.Feature2D, image: Image
) -> tuple[Points, npt.NDArray[np.uint8 | np.float32]]:
    """The strongest keypoints (N, 2) and their descriptors."""
    keypoints, descriptors = features.detectAndCompute(grey_of(image), None)
    if descriptors is None or not len(keypoints):
        return np.zeros((0, 2), np.float32), np.zeros((0, 1), np.uint8)
    responses = np.array([keypoint.response for keypoint in keypoints])
    rows = np.argsort(-responses, kind="stable")[:PEER_FEATURES]
    points = np.asarray(cv2.KeyPoint.convert(keypoints), np.float32).reshape(-1, 2)
    return points[rows], np.ascontiguousarray(descriptors[rows])
