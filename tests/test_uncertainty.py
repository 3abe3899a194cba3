"""Predicted corner errors against what the errors are."""

from __future__ import annotations

import numpy as np
import pytest

from streamtrack import geometry
from streamtrack.fitting import fit
from streamtrack.types import Matrix, Model
from streamtrack.uncertainty import corner_sigmas_px

CORNERS = geometry.image_quad((400, 300))
TRUTH: Matrix = np.array([[1.1, 0.05, 7.0], [-0.04, 1.05, -3.0], [1e-4, -5e-5, 1.0]])


@pytest.mark.parametrize("model", [Model.SIMILARITY, Model.AFFINE, Model.HOMOGRAPHY])
@pytest.mark.parametrize("half_px", [50, 130])
def test_sigma_is_what_noise_does(rng: np.random.Generator, model: Model, half_px: int) -> None:
    """Against the spread of the least squares over many draws of the noise."""
    truth = fit(model, CORNERS, geometry.transform_points(TRUTH, CORNERS))
    a = rng.uniform((200 - half_px, 150 - half_px), (200 + half_px, 150 + half_px), (25, 2))
    a = a.astype(np.float32)
    clean, places, sigmas = geometry.transform_points(truth, a), [], []
    for _ in range(150):
        b = (clean + rng.normal(0, 0.2, a.shape)).astype(np.float32)
        found = fit(model, a, b)
        places.append(geometry.transform_points(found, CORNERS).astype(np.float64))
        sigmas.append(corner_sigmas_px(found, model, a, b, CORNERS, 0.01))
    deviation = np.sqrt(np.var(np.array(places), axis=0).sum(axis=1))
    assert np.mean(sigmas, axis=0) == pytest.approx(deviation, rel=0.3)


def test_what_points_leave_open_is_not_certain() -> None:
    on_a_line = np.stack([np.linspace(50, 250, 30), np.full(30, 80.0)], axis=1).astype(np.float32)
    sigmas = corner_sigmas_px(np.eye(3), Model.HOMOGRAPHY, on_a_line, on_a_line, CORNERS, 0.1)
    assert not np.any(sigmas < 1e3)


def test_more_of_the_same_neighbours_is_no_more_evidence(rng: np.random.Generator) -> None:
    a = rng.uniform(0, 300, (50, 2)).astype(np.float32)
    b = a + rng.normal(0, 0.5, a.shape).astype(np.float32)
    once = corner_sigmas_px(np.eye(3), Model.AFFINE, a, b, CORNERS, 0.01)
    twice = corner_sigmas_px(
        np.eye(3), Model.AFFINE, np.tile(a, (2, 1)), np.tile(b, (2, 1)), CORNERS, 0.01
    )
    assert twice == pytest.approx(once)
