"""Which keyframe does a frame show? Asked when the camera is lost, answered by features.

A few keyframes a frame, so that no lost frame takes long: the one last seen first, then those
around it, then all others in an order that spreads over the whole flight.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Sequence

import numpy as np

from streamtrack import geometry
from streamtrack.camera.keyframes import KeyframeGraph
from streamtrack.camera.placed import Sight
from streamtrack.camera.view_levels import USUAL, ViewLevels, filled
from streamtrack.features import FeatureExtractor
from streamtrack.matching import match
from streamtrack.registration import register
from streamtrack.settings import FeatureSettings, Settings
from streamtrack.types import Features, Matrix, Points

_FEATURES = 500
_KEYFRAMES_A_FRAME = 3
_NEAREST = 6
_FEATURES_KEPT = 256


class Relocaliser:
    """Proposes keyframes and poses for frames of a lost camera; the caller confirms them."""

    def __init__(self, graph: KeyframeGraph, settings: Settings) -> None:
        self._graph = graph
        self._settings = settings
        self._extractor = FeatureExtractor(FeatureSettings(max_features=_FEATURES))
        self._features: OrderedDict[int, Features] = OrderedDict()
        self._turn = 0

    def rest(self) -> None:
        """The camera is found: the next search starts anew."""
        self._turn = 0

    def candidates(self, last: int, sight: Sight) -> Iterator[tuple[int, Matrix]]:
        """(keyframe, keyframe_from_frame) of the keyframes whose features agree with a frame's."""
        chosen = self._chosen(last)
        self._turn += 1
        seen = self._extracted(sight.levels, sight.hidden)
        if len(seen) < self._settings.registration.min_inliers:
            return
        for keyframe in chosen:
            guess = self._registered(seen, sight.levels, keyframe)
            if guess is not None:
                yield keyframe, guess

    def _chosen(self, last: int) -> list[int]:
        """The keyframe last seen, and the next of all others, each once in a round."""
        every = list(self._graph.keyframes)
        place = every.index(last)
        around = sorted(every, key=lambda i: abs(every.index(i) - place))[1 : 1 + _NEAREST]
        rest = [index for index in every if index != last and index not in around]
        order = around + [rest[row] for row in _spread_order(len(rest))]
        count = _KEYFRAMES_A_FRAME - 1
        start = self._turn * count % max(len(order), 1)
        return [last, *order[start : start + count]]

    def _registered(self, seen: Features, levels: ViewLevels, keyframe: int) -> Matrix | None:
        """keyframe_from_frame by matched features."""
        there = self._features.get(keyframe)
        if there is None:
            shown = self._graph.keyframes[keyframe]
            there = self._extracted(ViewLevels(shown.picture.grey()), shown.hidden)
            self._features[keyframe] = there
            if len(self._features) > _FEATURES_KEPT:
                self._features.popitem(last=False)
        matches = match(seen, there, self._settings.matching)
        width, height = self._graph.keyframes[keyframe].size_wh
        found = register(
            seen.points[matches.ref],
            there.points[matches.cur],
            self._settings.registration,
            geometry.image_quad(levels.size_wh),
            float(width * height),
        )
        return found.b_from_a

    def _extracted(self, levels: ViewLevels, hidden: Sequence[Points]) -> Features:
        """Features of what is not hidden in a view's usual level, in pixels of the view."""
        found = self._extractor.extract(levels.usual)
        if hidden:
            covered = filled(hidden, levels.level_from_view(USUAL), levels.usual.shape)
            columns, rows = np.rint(found.points).astype(np.intp).T
            found = found[np.flatnonzero(~covered[rows, columns])]
        view_from_level = geometry.inverted(levels.level_from_view(USUAL))
        points = geometry.transform_points(view_from_level, found.points)
        return Features(points, found.sizes, found.responses, found.descriptors)


def _spread_order(count: int) -> list[int]:
    """0 .. count - 1 so that every beginning of the list is spread over all of them."""
    bits = max(1, (count - 1).bit_length())
    reversed_bits = (int(f"{n:0{bits}b}"[::-1], 2) for n in range(2**bits))
    return [n for n in reversed_bits if n < count] if count else []
