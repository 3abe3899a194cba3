"""Two motions in one view: which is the background's, and what moves before it?

An alignment follows whatever most textured pixels agree on, and that can be a group of things that
move together before a weaker background. So where only a part of a view agrees, the motion of the
rest is looked for by phase correlation (Kuglin & Hines 1975), and the two are compared place by
place: the background is what explains more of the view, and of what is near its edges, as
backgrounds go on there. What the other explains is left out from then on.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from streamtrack import geometry
from streamtrack.camera.view_alignment import align, align_near
from streamtrack.camera.view_levels import USUAL, Floats, ReferenceView, ViewLevels, filled
from streamtrack.camera.view_verdict import ViewAlignment
from streamtrack.types import Mask, Matrix, Points, Verdict

_WINDOW, _SMALL_WINDOW = (5, 5), (3, 3)
_ALIKE = 0.7  # correlation in a window from which a motion explains a place
SURE_SHARE = 0.75  # of agreeing cells; above it no other motion can be the background's
_RIVAL_SHARE = 0.5  # of its cells that must agree with another motion
_LEAST_REST = 0.12  # of the view, to have a motion of its own
_BETTER, _BETTER_LEVELS = 1.5, 2.0  # factor and grey levels by which another motion is worse
_AS_MANY, _SHARPER = 0.8, 0.6  # of the cells that agree, and of what is unlike in them
_CONTRADICTING = 0.3  # of the view and of its edges, together
_EDGE_SHARE = 1 / 7  # of the view's sides
_CLEARLY = 1.25
_LEAST_PLACE = 0.004  # of the view, to be left out
_MAX_HIDDEN = 0.6
_MARGIN_PX = 4.0
_CLOSED = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
_OPENED = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))


@dataclass(frozen=True, slots=True, eq=False)
class Layers:
    """The background's alignment, and quads (4, 2) in the reference of what moves before it."""

    background: ViewAlignment
    foreground: tuple[Points, ...]


class Doubts:
    """Of which frames to ask whether another motion is the background's."""

    def __init__(self) -> None:
        self._frames: Counter[int] = Counter()

    def are_due(self, keyframe: int, found: ViewAlignment) -> bool:
        """To be asked of every frame that was aligned with a keyframe, of each once.

        Ever more seldom, as what moves before a keyframe is left out of it from then on.
        """
        if found.inliers >= SURE_SHARE * len(found.is_inlier):
            return False
        self._frames[keyframe] += 1
        return self._frames[keyframe].bit_count() == 1

    def go_on(self, keyframe: int) -> None:
        """Something moves before this keyframe, too."""
        self._frames[keyframe] += 1

    def about(self, keyframe: int) -> bool:
        """Whether there were any about a keyframe or frames that were aligned with it."""
        return self._frames[keyframe] > 0


def separated(
    compared: Compared, hidden: Sequence[Points] = (), proposed: Matrix | None = None
) -> Layers:
    """The background's alignment and what moves before it, by one that a part of a view agrees on.

    ``hidden`` are quads (4, 2) in the view that belong to neither, ``proposed`` is another place
    (``reference_from_view``), taken if the view is much more alike there. If neither motion
    explains clearly more of the view than the other, the alignment is refused as uncertain.
    """
    reference, view, found = compared.reference, compared.view, compared.found
    one = compared.under_found
    if proposed is not None:
        rival = align_near(reference, view, proposed, hidden)
        if _is_sharper(rival, found):
            return Layers(rival, ())
    rest = one.is_seen & ~one.is_alike
    if np.count_nonzero(rest) < _LEAST_REST * rest.size:
        return Layers(found, compared.quads(rest))
    guess = compared.guess_for(rest)
    apart = ReferenceView(reference.levels, reference.hidden, one.is_alike)
    rival = align(apart, view, guess, hidden)
    is_borne_out = rival.inliers >= _RIVAL_SHARE * len(rival.is_inlier)
    if rival.reference_from_view is None or not is_borne_out:
        return Layers(found, ())
    other = compared.under(rival.reference_from_view)
    by_one, by_other = compared.better(one, other), compared.better(other, one)
    extents = _extent(by_one), _extent(by_other)
    if max(extents) < _CLEARLY * min(extents):
        return Layers(found.refused(Verdict.UNCERTAIN), ())
    background, foreground = (found, by_other) if extents[0] > extents[1] else (rival, by_one)
    return Layers(background, compared.quads(foreground))


def is_contradicted(compared: Compared, expected: Matrix) -> bool:
    """Does the place where a view was expected explain much of it that the one found does not?

    Then the one found is rather that of a large thing which has come into view; a camera that
    truly jerked shows nothing more where it would have been.
    """
    here, there = compared.under_found, compared.under(expected)
    return _extent(compared.better(there, here)) > _CONTRADICTING


def _is_sharper(rival: ViewAlignment, found: ViewAlignment) -> bool:
    """Is about as much of the view much more alike under another alignment?

    One that lies between two motions agrees with many places, and exactly with few.
    """
    if rival.reference_from_view is None or rival.inliers < _AS_MANY * found.inliers:
        return False
    return 1 - rival.correlation < _SHARPER * (1 - found.correlation)


def _extent(places: Mask) -> float:
    """Share of the view, and of its edges, that are among the places (h, w), together."""
    height, width = places.shape
    y, x = max(1, round(height * _EDGE_SHARE)), max(1, round(width * _EDGE_SHARE))
    whole, inner = np.count_nonzero(places), np.count_nonzero(places[y:-y, x:-x])
    at_edges = places.size - (height - 2 * y) * (width - 2 * x)
    return float(whole / places.size + (whole - inner) / at_edges)


@dataclass(frozen=True, slots=True, eq=False)
class _Under:
    """The view under a motion in the reference's place (h, w): where it is alike, where seen."""

    values: Floats
    is_alike: Mask
    is_seen: Mask
    off: Floats


class Compared:
    """A reference and a view of it that was ``found`` in it, at the level of following (h, w)."""

    def __init__(self, reference: ReferenceView, view: ViewLevels, found: ViewAlignment) -> None:
        self.reference, self.view, self.found = reference, view, found
        self._level_from_reference = reference.levels.level_from_view(USUAL)
        self._view_from_level = geometry.inverted(view.level_from_view(USUAL))

    @cached_property
    def _wanted(self) -> Floats:
        return self.reference.levels.high_passed(USUAL)

    @cached_property
    def _energy(self) -> Floats:
        return np.asarray(cv2.blur(self._wanted * self._wanted, _WINDOW), np.float32)

    @cached_property
    def _shown(self) -> Mask:
        return ~filled(self.reference.hidden, self._level_from_reference, self._wanted.shape)

    @cached_property
    def under_found(self) -> _Under:
        """The view where it was found."""
        assert self.found.reference_from_view is not None
        return self.under(self.found.reference_from_view)

    def under(self, reference_from_view: Matrix) -> _Under:
        """The view under a mapping, compared with the reference."""
        height, width = self._wanted.shape
        mapping = self._level_from_reference @ reference_from_view @ self._view_from_level
        seen_values = self.view.high_passed(USUAL)
        values = cv2.warpPerspective(seen_values, mapping, (width, height))
        everywhere = np.full(seen_values.shape, 255, np.uint8)
        seen = cv2.warpPerspective(everywhere, mapping, (width, height), flags=cv2.INTER_NEAREST)
        is_seen = np.asarray(self._shown & (cv2.erode(seen, _CLOSED) > 0))
        both = cv2.blur(self._wanted * values, _WINDOW)
        energy = cv2.blur(values * values, _WINDOW)
        is_alike = both > np.float32(_ALIKE) * np.sqrt(np.abs(self._energy * energy))
        off = cv2.blur(cv2.absdiff(values, self._wanted), _SMALL_WINDOW)
        return _Under(
            np.asarray(values, np.float32),
            np.asarray(is_alike & is_seen),
            is_seen,
            np.asarray(off, np.float32),
        )

    def better(self, one: _Under, other: _Under) -> Mask:
        """Where (h, w) one motion explains clearly more than the other."""
        worse = other.off > np.float32(_BETTER) * one.off + np.float32(_BETTER_LEVELS)
        return np.asarray(one.is_seen & other.is_seen & worse)

    def guess_for(self, rest: Mask) -> Matrix:
        """A mapping under which the rest (h, w), unlike where the view was found, agrees better."""
        assert self.found.reference_from_view is not None
        share = np.asarray(cv2.blur(rest.astype(np.float32), _WINDOW), np.float32)
        shift, _ = cv2.phaseCorrelate(self.under_found.values * share, self._wanted * share)
        level = self._level_from_reference
        moved = geometry.inverted(level) @ geometry.translation(*shift) @ level
        return geometry.normalized(moved @ self.found.reference_from_view)

    def quads(self, places: Mask) -> tuple[Points, ...]:
        """Boxes, in pixels of the reference, around the larger connected places (h, w)."""
        filled = cv2.morphologyEx(places.astype(np.uint8), cv2.MORPH_CLOSE, _CLOSED)
        filled = cv2.morphologyEx(filled, cv2.MORPH_OPEN, _OPENED)
        outlines, _ = cv2.findContours(filled, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        least = _LEAST_PLACE * places.size
        boxes = [cv2.minAreaRect(o) for o in outlines if cv2.contourArea(o) >= least]
        if sum(w * h for _, (w, h), _ in boxes) > _MAX_HIDDEN * places.size:
            return ()
        grown = [(xy, (w + 2 * _MARGIN_PX, h + 2 * _MARGIN_PX), a) for xy, (w, h), a in boxes]
        reference_from_level = geometry.inverted(self._level_from_reference)
        return tuple(
            geometry.transform_points(reference_from_level, cv2.boxPoints(b)) for b in grown
        )
