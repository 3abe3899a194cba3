"""Following a target that is not flat: a running animal, a walking person, a car that turns.

Legs, folds and sides that turn away follow no plane, but from frame to frame a body looks much the
same against its surroundings. So its box is moved and scaled to where a correlation filter answers
most. Two views answer together. The first is kept for ever, and where it alone would see nothing,
nothing is claimed and nothing learnt; the other is renewed by frames in which all of the target is
in view. So neither an occluder nor the frame's edge becomes the target.
"""

from __future__ import annotations

import numpy as np

from streamtrack import geometry
from streamtrack.fitting import fit
from streamtrack.tracking.correlation_filter import CorrelationFilter, Sighting
from streamtrack.tracking.template import Template
from streamtrack.tracking.views import Sight
from streamtrack.types import Image, Matrix, Model, Points

_LEAST_ANSWER = 0.18
_LEAST_FIRST_ANSWER = 0.15
"""Of the first view. What it never saw answers with up to 0.13, another like body with 0.3."""
_LEAST_ANSWER_AGAIN = 0.3  # of both, for a target that was lost
_LEAST_PROMINENCE = 7.0
_LEARNT_ANSWER = 0.22
_LEARNT_IN_VIEW = 0.9
_LEAST_IN_VIEW = 0.25
_LEAST_PART = 0.5  # of the answer, for a target that is partly out of view
_FRAMES_BETWEEN_SCALES = 2
_TURNED_ADVANTAGE = 1.2  # in the answer, of a size and turn that a plane would have
_RATE = 0.03  # share of a new frame in the renewed filter


def begun_body(template: Template, sight: Sight, *, is_same_camera: bool) -> Body:
    """The template's target as a body, as a later sight of it shows it.

    A template picture of another camera is no first view: what surrounds the target is not in it.
    """
    if not is_same_camera:
        return Body(sight.image, sight.frame_from_template, template.quad)
    body = Body(template.picture, np.eye(3), template.quad)
    body.take_over(sight.image, sight.template_points, sight.shown)
    return body


class Body:
    """A target with corners ``quad`` (4, 2) in template pixels, begun as it was in a first view.

    ``image`` is that view (BGR or grey, as all frames), ``frame_from_template`` its place there.
    """

    def __init__(self, image: Image, frame_from_template: Matrix, quad: Points) -> None:
        self._quad = quad
        seen = geometry.transform_points(frame_from_template, quad)
        self._pose = fit(Model.SIMILARITY, quad, seen)
        self._filter = CorrelationFilter(image, self._pose, quad)
        self._is_growing = False
        self._frames = 0
        self.frames_seen = 0

    def take_over(self, image: Image, template_points: Points, frame_points: Points) -> None:
        """Go on from a later view, in which the pairs of points (N, 2) agreed as if it were flat.

        Their shift is taken; their turn and change of size, which may be those of one part alone,
        only if the target then looks much more like the first view.
        """
        shifted, turned = (
            fit(model, template_points, frame_points)
            for model in (Model.TRANSLATION, Model.SIMILARITY)
        )
        answers = [self._filter.locate(image, pose).answer for pose in (shifted, turned)]
        is_turned = answers[1] > _TURNED_ADVANTAGE * answers[0]
        self._pose = turned if is_turned else shifted
        # The less it looks like the first view, the less that helps from now on.
        self._filter.learn(image, self._pose, max(0.0, 1.0 - max(answers)))

    def follow(self, image: Image, guess: Matrix, *, was_lost: bool) -> Matrix | None:
        """The pose (a similarity) in the next frame, None if the target is not seen there.

        It is looked for near ``guess``, of which only the place counts, as sizes do not go on as
        they were; and where it last was, as steps and leaps do not either. More is asked of a
        target that was lost, and of the first frame.
        """
        self._frames += 1
        was_lost = was_lost or self.frames_seen == 0
        for pose in (self._moved_to(guess), self._pose):
            # Scales are looked at now and then, and while the target grows or shrinks.
            at_scales = not was_lost and (
                self._is_growing or self._frames % _FRAMES_BETWEEN_SCALES == 0
            )
            found = self._filter.locate(image, pose, at_other_scales=at_scales)
            seen = geometry.transform_points(found.pose, self._quad)
            in_view = geometry.visible_share(seen, (image.shape[1], image.shape[0]))
            if _is_seen(found, in_view, was_lost=was_lost):
                self._is_growing = found.is_scaled
                self._pose = found.pose
                self.frames_seen += 1
                if in_view >= _LEARNT_IN_VIEW and found.answer >= _LEARNT_ANSWER:
                    self._filter.learn(image, found.pose, _RATE)
                return found.pose
        return None

    def _moved_to(self, guess: Matrix) -> Matrix:
        """The last pose, shifted to where a guess puts the target's middle."""
        places = (
            geometry.transform_points(p, self._quad).mean(axis=0) for p in (self._pose, guess)
        )
        last, expected = (place.tolist() for place in places)
        shift = geometry.translation(expected[0] - last[0], expected[1] - last[1])
        return np.asarray(shift @ self._pose, np.float64)


def _is_seen(found: Sighting, in_view: float, *, was_lost: bool) -> bool:
    part = max(_LEAST_PART, in_view)
    return (
        in_view >= _LEAST_IN_VIEW
        and found.answer >= (_LEAST_ANSWER_AGAIN if was_lost else _LEAST_ANSWER * part)
        and found.first_answer >= (_LEAST_ANSWER_AGAIN if was_lost else _LEAST_FIRST_ANSWER * part)
        and found.prominence >= _LEAST_PROMINENCE
    )
