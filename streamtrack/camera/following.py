"""A frame against the keyframe of the frame before: several starts, and the one best borne out.

The usual start is where the motion so far leads, and a short way from there is all that is looked
at. A longer way may end in a wrong place, as a camera that jerks and a thing that goes along are
alike at first; then whatever passes the gate from other starts is compared with it.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from streamtrack import geometry
from streamtrack.camera.frame_motion import guessed_motion
from streamtrack.camera.layers import SURE_SHARE
from streamtrack.camera.placed import Sight, State
from streamtrack.camera.view_alignment import align, align_near
from streamtrack.camera.view_levels import ReferenceView
from streamtrack.camera.view_verdict import ViewAlignment
from streamtrack.types import Matrix, Size, Verdict

_NEAR_SHARE = 0.015  # of the view: a way from where the motion leads that needs no second opinion
_MAJORITY = 0.5  # of the cells; what they agree on needs no third one
_MAX_AREA_JUMP = 1.5


class PointMotion:
    """Where points' motion since the frame last placed puts a frame; asked for once, if at all."""

    def __init__(self, reference: ReferenceView, state: State, sight: Sight) -> None:
        self._reference, self._state, self._sight = reference, state, sight

    @cached_property
    def guess(self) -> Matrix | None:
        """``keyframe_from_frame``, in the keyframe of the frame last placed."""
        before, here = self._state.sight.levels, self._state.keyframe_from_frame
        sight = self._sight
        return guessed_motion(before, sight.levels, self._reference, here, sight.hidden)


def followed(
    reference: ReferenceView, state: State, sight: Sight, points: PointMotion
) -> ViewAlignment:
    """How a frame lies in the keyframe of the frame last placed, or why that is not known."""
    levels, hidden = sight.levels, sight.hidden
    guess, size_wh = state.predicted(sight.time_s), sight.size_wh
    best: ViewAlignment | None = None
    if state.step is not None:
        best = _without_jump(align_near(reference, levels, guess, hidden), guess, size_wh)
        if _is_expected(best, state, sight):
            return best
    best = _better(best, _without_jump(align(reference, levels, guess, hidden), guess, size_wh))
    if best.reference_from_view is not None and is_majority(best):
        return best
    if points.guess is not None:
        found = align_near(reference, levels, points.guess, hidden)
        best = _better(best, _without_jump(found, guess, size_wh))
    if best.reference_from_view is not None:
        return best
    guess = state.keyframe_from_frame
    found = align(reference, levels, guess, hidden, is_searched=True)
    return _better(best, _without_jump(found, guess, size_wh))


def is_majority(found: ViewAlignment) -> bool:
    """Whether most of what both views show agrees."""
    return found.inliers >= _MAJORITY * len(found.is_inlier)


def _is_expected(found: ViewAlignment, state: State, sight: Sight) -> bool:
    """Whether a frame is where the motion so far has led."""
    if state.step is None or found.reference_from_view is None:
        return False
    corners = geometry.image_quad(sight.size_wh)
    there = geometry.transform_points(found.reference_from_view, corners)
    expected = geometry.transform_points(state.predicted(sight.time_s), corners)
    return float(np.abs(there - expected).max()) <= _NEAR_SHARE * sight.size_wh[0]


def is_surprising(found: ViewAlignment, state: State, sight: Sight) -> bool:
    """Whether a part of the view only says that a frame is not where the motion has led."""
    if state.step is None or found.inliers >= SURE_SHARE * len(found.is_inlier):
        return False
    return not _is_expected(found, state, sight)


def _better(one: ViewAlignment | None, other: ViewAlignment) -> ViewAlignment:
    """Of those that passed the gate the one with more support, else the last."""
    if one is None or one.reference_from_view is None:
        return other
    return one if other.reference_from_view is None or one.support >= other.support else other


def _without_jump(found: ViewAlignment, guess: Matrix, size_wh: Size) -> ViewAlignment:
    """The alignment, refused if the view's area is not about what was expected."""
    if found.reference_from_view is None:
        return found
    quad = geometry.image_quad(size_wh)
    area = geometry.signed_area(geometry.transform_points(found.reference_from_view, quad))
    expected = geometry.signed_area(geometry.transform_points(guess, quad))
    if 1 / _MAX_AREA_JUMP <= area / expected <= _MAX_AREA_JUMP:
        return found
    return found.refused(Verdict.AREA)
