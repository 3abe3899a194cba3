"""A camera's path that shears on the word of minorities is not believed; any other is."""

from __future__ import annotations

import math

import numpy as np
import pytest

from streamtrack import geometry
from streamtrack.camera.shear import ShearWatch
from streamtrack.camera.view_verdict import ViewAlignment
from streamtrack.types import Matrix, Verdict

SIZE = (320, 240)


def aligned(reference_from_view: Matrix, share: float) -> ViewAlignment:
    nowhere = np.zeros((100, 2), np.float32)
    agrees = np.arange(100) < 100 * share
    return ViewAlignment(Verdict.OK, reference_from_view, nowhere, nowhere, agrees)


def first_refused(step: Matrix, share: float, frames_at_rest: float = 0.0) -> int | None:
    """The first of 30 keyframes, each ``step`` from the one before, that is not believed.

    Between two of them one frame more is seen, with which that share of the cells agrees.
    """
    watch = ShearWatch()
    watch.begin(0)
    for index in range(30):
        if frames_at_rest:
            watch.is_sheared(index, aligned(np.eye(3), frames_at_rest), SIZE)
        if watch.is_sheared(index, aligned(step, share), SIZE):
            return index + 1
        watch.extend(index, aligned(step, share), index + 1)
    return None


SHEAR = np.array([[1, 0.01, -3], [0, 1, 0], [0, 0, 1.0]])


def turned_and_zoomed() -> Matrix:
    c, s = 1.02 * math.cos(0.05), 1.02 * math.sin(0.05)
    return np.array([[c, -s, 8], [s, c, -5], [0, 0, 1.0]])


def test_shear_is_noticed_where_a_minority_vouches_for_it() -> None:
    refused = first_refused(SHEAR, 0.4)
    assert refused is not None and 8 <= refused <= 11  # 0.01 each, 0.1 in all


@pytest.mark.parametrize("share", [0.55, 0.9])
def test_what_most_of_the_view_agrees_with_is_believed(share: float) -> None:
    assert first_refused(SHEAR, share) is None


def test_a_minority_at_the_very_end_of_a_keyframe_is_no_doubt() -> None:
    assert first_refused(SHEAR, 0.4, frames_at_rest=0.8) is None


@pytest.mark.parametrize(
    "step", [turned_and_zoomed(), geometry.translation(40, 9), np.diag([0.97, 0.97, 1.0])]
)
def test_turning_zooming_and_going_are_no_shear(step: Matrix) -> None:
    assert first_refused(step, 0.4) is None
