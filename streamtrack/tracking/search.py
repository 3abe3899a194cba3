"""Finding a lost target again by its features."""

from __future__ import annotations

from streamtrack import geometry
from streamtrack.frame_view import FrameView
from streamtrack.matching import match, match_guided
from streamtrack.settings import Settings
from streamtrack.tracking.template import Template
from streamtrack.tracking.tracker import register_features
from streamtrack.types import Evidence, Matrix, Registration, Verdict

_GUIDED_RADIUS_PX = 60.0
_FULL_SEARCH_EVERY = 24  # searches: less than 5 in 100 frames take longer


class FeatureSearch:
    """Matches the target's features with a frame's, near its last place or everywhere.

    Once the target was seen, most searches see only a part of the frame's features, so that they
    do not take long; a few see nearly all, for a target that no part is enough to find.
    """

    def __init__(self, template: Template, settings: Settings) -> None:
        self._template = template
        self._settings = settings
        self._searches = 0

    def rest(self) -> None:
        """The target is seen: the next search is the first."""
        self._searches = 0

    def find(
        self, view: FrameView, last_pose: Matrix | None, *, was_seen: bool
    ) -> tuple[Registration, Evidence, str]:
        """frame_from_template, its evidence and the means, ``guided`` or ``global``.

        ``last_pose`` is where to look first, if that is worth while.
        """
        is_turn = self._searches % _FULL_SEARCH_EVERY == _FULL_SEARCH_EVERY - 1
        part = None if is_turn else self._searches
        features = view.part_of_features(part) if was_seen else view.features()
        self._searches += 1
        template, matching = self._template.features, self._settings.matching
        if last_pose is not None:
            predicted = geometry.transform_points(last_pose, template.points)
            matches = match_guided(template, features, predicted, _GUIDED_RADIUS_PX, matching)
            found, evidence = register_features(
                self._template, view, features, matches, self._settings
            )
            if found.verdict is Verdict.OK:
                return found, evidence, "guided"
        matches = match(template, features, matching)
        found, evidence = register_features(self._template, view, features, matches, self._settings)
        return found, evidence, "global"
