"""Is a target flat? A plane seen at a slant is still explained by one homography, a body is not.

Turning in the picture plane, coming nearer and moving on prove nothing, as a body's picture does
the same; so what is asked for is a pose that no similarity comes near. Until that is seen, looks
decide: where a plane is partly hidden, what is left of it looks as well as ever, while a body that
turns away becomes less like its first view wherever it still agrees with it.

That a target is a body is seen by points that look as they should but are not where the plane puts
them: what hides or blurs a plane changes how its points look.
"""

from __future__ import annotations

from math import isnan, sqrt

from streamtrack import geometry
from streamtrack.fitting import similarity_misfit_px
from streamtrack.tracking.alignment import CLEAR
from streamtrack.types import Matrix, Points

_FLAT_IF = ((0.95, 0.01), (0.85, 0.03))  # share of points that agree, at a slant
_FRAMES = 5  # like that
_USUAL_RATE = 0.05  # share of a new frame in the usual correlation
_AS_EVER = 0.03  # of correlation, below the usual one
_HARDLY_EVER = 2  # frames, of which the first is one
_BENT_SEEN = 0.5  # share of the points in view that look alike
_BENT_IF = 0.8  # share of those that agree with the plane, below which it is none
_BENT_WEIGHT = 3  # of such a frame against one that is not
_BENT_ENOUGH = 8


class Flatness:
    """What the frames until now say of one target with corners ``quad`` (4, 2)."""

    def __init__(self, quad: Points) -> None:
        self._quad = quad
        self._frames = 0
        self._usual = float("nan")
        self._bent = 0
        self._agreed = 0

    @property
    def is_proven(self) -> bool:
        return self._frames >= _FRAMES

    @property
    def is_disproven(self) -> bool:
        """Is the target a body?"""
        return self._bent >= _BENT_ENOUGH and not self.is_proven

    @property
    def least_correlation(self) -> float:
        """Mean correlation of what agrees, from which on what does not agree is taken as hidden."""
        return -1.0 if self.is_proven else self._usual - _AS_EVER

    def may_be_body(self, alike: float) -> bool:
        """Where no plane was found but a share is ``alike``: is it bent now, was it lately, or was
        it hardly ever seen as a plane?"""
        is_bent = self._bent > 0 or alike >= _BENT_SEEN
        return not self.is_proven and (is_bent or self._agreed <= _HARDLY_EVER)

    def is_plane(self, share: float, alike: float, correlation: float) -> bool:
        """Would a plane look so? The same shares and correlation as `learn` takes."""
        is_bent = share < max(_BENT_SEEN, _BENT_IF * alike)
        return not is_bent and correlation >= self.least_correlation

    def learn(
        self, frame_from_template: Matrix, share: float, alike: float, correlation: float
    ) -> None:
        """Take in a pose with which a ``share`` (0..1) of the points in view agree, that well.

        ``alike`` is the share that looks like the template, wherever it is.
        """
        self._agreed += share >= _FLAT_IF[0][0]
        if share >= CLEAR:
            usual = correlation if isnan(self._usual) else self._usual
            self._usual = usual + _USUAL_RATE * (correlation - usual)
        is_bent = alike >= _BENT_SEEN and share < _BENT_IF * alike
        bent = self._bent + (_BENT_WEIGHT if is_bent else -1)
        self._bent = max(0, min(bent, _BENT_ENOUGH))
        if self.is_proven or share < _FLAT_IF[-1][0]:
            return
        seen_from = slant(frame_from_template, self._quad)
        self._frames += any(share >= least and seen_from >= far for least, far in _FLAT_IF)


def slant(pose: Matrix, quad: Points) -> float:
    """How far (RMS) the quad's corners in the frame are from any similarity, against its size."""
    seen = geometry.transform_points(pose, quad)
    return similarity_misfit_px(quad, seen) / sqrt(abs(geometry.signed_area(seen)))
