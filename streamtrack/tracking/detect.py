"""The ancestor's loop: every frame by itself, its features against the target's."""

from __future__ import annotations

from streamtrack.frame_view import FrameView
from streamtrack.matching import match
from streamtrack.settings import Settings
from streamtrack.tracking.template import Template
from streamtrack.tracking.tracker import make_track, register_features
from streamtrack.types import Track, Verdict


class DetectTracker:
    """Stateless: the frame's features against the target's, everywhere, in every frame."""

    def __init__(self, template: Template, settings: Settings) -> None:
        self.template = template
        self._settings = settings
        self._was_seen = False

    def update(self, view: FrameView) -> Track:
        features = view.features()
        matches = match(self.template.features, features, self._settings.matching)
        found, evidence = register_features(self.template, view, features, matches, self._settings)
        self._was_seen |= found.verdict is Verdict.OK
        return make_track(self.template, found, evidence, "detect", self._was_seen)

    def forget_place(self) -> None:
        """Every frame is searched everywhere anyway."""
