"""A target is taken as flat on evidence that only a plane gives."""

from __future__ import annotations

import numpy as np
import pytest

from streamtrack import geometry
from streamtrack.tracking.flatness import Flatness, slant
from streamtrack.types import Matrix

_QUAD = geometry.box_quad(100, 80, 200, 150)
_TURN = np.array([[0.8, -0.6, 120.0], [0.6, 0.8, 10.0], [0.0, 0.0, 1.0]])
_NEARER = geometry.scaling(1.7)
_LEANING = np.array([[0.9, 0.02, 5.0], [-0.01, 1.0, 3.0], [3e-4, 1e-4, 1.0]])


def _learned(pose: Matrix, share: float, frames: int) -> bool:
    flatness = Flatness(_QUAD)
    for _ in range(frames):
        flatness.learn(pose, share, share, 0.9)
    return flatness.is_proven


@pytest.mark.parametrize("pose", [np.eye(3), _TURN, _NEARER, _TURN @ _NEARER])
def test_what_a_body_shows_as_well_proves_nothing(pose: Matrix) -> None:
    assert slant(pose, _QUAD) < 1e-4
    assert not _learned(pose, 1.0, 50)


def test_a_slant_that_nearly_all_points_agree_with_proves_a_plane() -> None:
    assert slant(_LEANING, _QUAD) > 0.03
    assert _learned(_LEANING, 0.9, 5)
    assert not _learned(_LEANING, 0.9, 4)


def test_a_slant_that_many_points_contradict_proves_nothing() -> None:
    assert not _learned(_LEANING, 0.8, 50)


def test_what_is_left_of_a_hidden_thing_looks_as_ever_and_what_turns_away_does_not() -> None:
    flatness = Flatness(_QUAD)
    for correlation in (0.93, 0.9, 0.91, 0.92):
        flatness.learn(np.eye(3), 0.95, 1.0, correlation)
    assert flatness.least_correlation < 0.91
    assert flatness.least_correlation > 0.85


def test_before_it_was_seen_nothing_looks_as_ever() -> None:
    assert not Flatness(_QUAD).least_correlation <= 1.0


def test_a_plane_may_look_otherwise() -> None:
    flatness = Flatness(_QUAD)
    for _ in range(5):
        flatness.learn(_LEANING, 0.9, 0.9, 0.9)
    assert flatness.least_correlation <= -1.0
