"""Which poses place all corners well enough to be told."""

from __future__ import annotations

import numpy as np
import pytest

from streamtrack import geometry
from streamtrack.tracking.certainty import (
    MAX_SIGMA_FOLLOWED_PX,
    MAX_SIGMA_FOUND_PX,
    are_corners_certain,
)
from streamtrack.types import Evidence, Model

QUAD = geometry.box_quad(100, 80, 300, 200)


def evidence(rng: np.random.Generator, seen_share: float, noise_px: float) -> Evidence:
    """60 points in the left part of the quad, and where they were found."""
    places = rng.uniform((100, 80), (100 + 300 * seen_share, 280), (60, 2)).astype(np.float32)
    found = places + rng.normal(0, noise_px, places.shape).astype(np.float32)
    return Evidence(places, found, np.ones(60, np.bool_))


@pytest.mark.parametrize(
    ("seen_share", "noise_px", "is_certain"),
    [(1.0, 0.3, True), (1.0, 1.5, True), (0.5, 0.3, True), (0.3, 1.5, False), (0.15, 0.5, False)],
)
def test_corners_far_from_what_is_seen_are_not_certain(
    rng: np.random.Generator, seen_share: float, noise_px: float, is_certain: bool
) -> None:
    seen = evidence(rng, seen_share, noise_px)
    for model in (Model.HOMOGRAPHY, Model.SIMILARITY):
        told = are_corners_certain(np.eye(3), model, seen, QUAD, MAX_SIGMA_FOLLOWED_PX)
        assert told == (is_certain or model is Model.SIMILARITY)


def test_more_is_asked_of_what_was_found_anew(rng: np.random.Generator) -> None:
    seen = evidence(rng, 0.3, 0.5)
    limits = MAX_SIGMA_FOLLOWED_PX, MAX_SIGMA_FOUND_PX
    told = [are_corners_certain(np.eye(3), Model.HOMOGRAPHY, seen, QUAD, most) for most in limits]
    assert told == [True, False]
