"""A prediction goes on as the target went, in the way that was right lately."""

from __future__ import annotations

import numpy as np
import pytest

from streamtrack import geometry
from streamtrack.tracking.prediction import Prediction, rms_distance_px
from streamtrack.types import Matrix, Model

_QUAD = geometry.box_quad(100, 80, 200, 150)
_REST, _FRAMES = np.eye(3), 30


def _turned(degrees: float) -> Matrix:
    angle = np.deg2rad(degrees)
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    return geometry.translation(200, 155) @ turn @ geometry.translation(-200, -155)


def _followed(poses: list[Matrix]) -> Prediction:
    prediction = Prediction(_QUAD, Model.SIMILARITY, poses[0])
    for pose in poses[1:]:
        prediction.follow(pose, is_clear=True)
    return prediction


@pytest.mark.parametrize(
    "pose_at",
    [
        lambda t: geometry.translation(0.0 * t, 0.0),
        lambda t: geometry.translation(7.0 * t, -3.0 * t),
        lambda t: _turned(4.0 * t),
        lambda t: geometry.translation(0.4 * t * t, 0),
    ],
    ids=["rest", "shift", "turn", "faster and faster"],
)
def test_steady_motion_is_foreseen(pose_at) -> None:  # type: ignore[no-untyped-def]
    prediction = _followed([pose_at(t) for t in range(_FRAMES)])
    assert rms_distance_px(prediction.guess, pose_at(_FRAMES), _QUAD) < 0.01
    assert prediction.surprise_px < 0.2


def test_trembling_is_not_taken_for_motion() -> None:
    shifts = np.random.default_rng(3).normal(0, 1.0, (60, 2))
    prediction = _followed([geometry.translation(*shift) for shift in shifts])
    assert np.allclose(prediction.guess, geometry.translation(*shifts[-1]))
    assert prediction.motion_px == 0.0
    assert 1.0 < prediction.surprise_px < 4.0


def test_what_was_hardly_seen_teaches_nothing_of_how_good_guesses_are() -> None:
    prediction = _followed([_REST] * _FRAMES)
    before = prediction.surprise_px
    prediction.follow(geometry.translation(50, 0), is_clear=False)
    assert prediction.surprise_px <= before


def test_a_target_found_anew_may_be_anywhere_next() -> None:
    prediction = _followed([geometry.translation(7.0 * t, 0) for t in range(_FRAMES)])
    prediction.begin_at(_REST, share=0.5)
    assert np.array_equal(prediction.guess, _REST)
    assert prediction.surprise_px >= 10.0


def test_poses_with_hidden_corners_do_not_run_away() -> None:
    """Where corners are guessed, a guess must not feed the change of motion that made it."""
    prediction = _followed([geometry.translation(0.4 * t * t, 0) for t in range(_FRAMES)])
    steps = []
    for _ in range(10):
        guess = prediction.guess
        assert prediction.pose is not None
        steps.append(rms_distance_px(guess, prediction.pose, _QUAD))
        prediction.follow(guess, is_clear=False)
    assert max(steps[1:]) <= steps[0] + 0.01
