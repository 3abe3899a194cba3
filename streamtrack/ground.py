"""From world pixels to a plane's own units: metres, or whatever the known points are given in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt

from streamtrack import geometry
from streamtrack.errors import UsageError
from streamtrack.fitting import dlt_homography, gauss_newton_step
from streamtrack.settings import WorldSettings
from streamtrack.types import Matrix

_LEAST_POINTS = 4
_MIN_HEIGHT = 0.02
"""Of a triangle of three known points, against its longest side: flatter ones are a line."""
_MOST_TRIED = 12  # points, of many
_NEAREST_HORIZON_PX = 3.0
_MAX_MISFIT = 0.05
"""Of the known points, RMS, against how far they spread: beyond it one of them is wrong."""

_NO_PLANE = "no plane seen from one side fits the known points: check their order and values"

Doubles = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """The plane that things move on.

    ``ground_from_world`` takes world pixels to units of the plane; ``depth`` has the sign of the
    projective depth of everything before the horizon. ``rmse`` is how far the known points come
    to lie from where they were said to be, in units.
    """

    ground_from_world: Matrix
    depth: float = 1.0
    rmse: float = 0.0

    def positions(self, world: npt.ArrayLike) -> Doubles:
        """Positions (N, 2) of world points (N, 2), NaN beyond the horizon and right before it.

        There a pixel more or less is all of the way to what is seen.
        """
        points = np.asarray(world, np.float64).reshape(-1, 2)
        found = points @ self.ground_from_world[:, :2].T + self.ground_from_world[:, 2]
        nearest = _NEAREST_HORIZON_PX * np.hypot(*self.ground_from_world[2, :2])
        is_before = found[:, 2] * self.depth > nearest
        places: Doubles = found[:, :2] / np.where(is_before, found[:, 2], np.nan)[:, None]
        return places


def make_ground(settings: WorldSettings) -> Ground | None:
    """The ground that the settings describe, None if they describe none. Raises UsageError."""
    if settings.px_per_unit is not None:
        unit = 1 / settings.px_per_unit
        return Ground(np.diag([unit, unit, 1.0]))
    if not settings.ground:
        return None
    known = np.array(settings.ground, np.float64)
    return fit_ground(known[:, :2], known[:, 2:])


def parse_ground(texts: Sequence[str]) -> tuple[tuple[float, float, float, float], ...]:
    """Known points from ``x,y=X,Y``: pixels of the first frame, and units. Raises UsageError."""
    return tuple(_parsed(text) for text in texts)


def _parsed(text: str) -> tuple[float, float, float, float]:
    pixel, _, place = text.partition("=")
    try:
        x, y = (float(part) for part in pixel.split(","))
        far, along = (float(part) for part in place.split(","))
    except ValueError:
        raise UsageError(
            f"--ground {text}: write x,y=X,Y, a pixel of the first frame and where it lies, "
            "as --ground 120,380=0,12.5"
        ) from None
    if not np.isfinite([x, y, far, along]).all():
        raise UsageError(f"--ground {text}: every number must be finite")
    return x, y, far, along


def fit_ground(world: Doubles, ground: Doubles) -> Ground:
    """The homography that takes world points (N, 2) to ground points (N, 2), by least squares.

    Normalised DLT (Hartley & Zisserman, algorithm 4.2). Raises UsageError for fewer than four
    points, for points of which only three or fewer are not in a line, and for points that no
    plane fits.
    """
    count = len(world)
    if count < _LEAST_POINTS:
        raise UsageError(f"--ground needs four known points or more, and {count} are given")
    for points, what in ((world, "pixels"), (ground, "places")):
        if not _has_four_corners(points):
            raise UsageError(
                f"--ground: the {what} of the known points must hold four of which no three are "
                "in a line: choose points that are spread over the ground"
            )
    middle, middle_ground = world.mean(axis=0), ground.mean(axis=0)
    a, b = world - middle, ground - middle_ground
    centred = dlt_homography(a, b)
    depths = geometry.projective_depths(centred, a)
    if not (np.all(depths > 0) or np.all(depths < 0)):
        raise UsageError(f"--ground: {_NO_PLANE}")
    centred = gauss_newton_step(centred, a, b, np.ones(count))
    found = geometry.translation(*middle_ground) @ centred @ geometry.translation(*-middle)
    depth = float(np.sign(geometry.projective_depths(found, world)[0]))
    off = Ground(found, depth).positions(world) - ground
    rmse = float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
    spread = float(np.sqrt(np.mean(np.sum((ground - middle_ground) ** 2, axis=1))))
    if not rmse <= _MAX_MISFIT * spread:
        raise UsageError(f"--ground: {_NO_PLANE}; they are off by {rmse:.3g} units")
    return Ground(found, depth, rmse)


def _has_four_corners(points: Doubles) -> bool:
    """Whether there are four among the points (N, 2) of which no three are in a line."""
    turn = np.argsort(np.arctan2(*(points - points.mean(axis=0)).T[::-1]), kind="stable")
    some = points[turn[np.unique(np.linspace(0, len(turn) - 1, _MOST_TRIED).astype(int))]]
    return any(
        all(_height(some[list(three)]) > _MIN_HEIGHT for three in combinations(four, 3))
        for four in combinations(range(len(some)), 4)
    )


def _height(triangle: Doubles) -> float:
    """Height over the longest side of a triangle (3, 2), as a share of that side."""
    longest = float(max(np.hypot(*(triangle - np.roll(triangle, 1, axis=0)).T)))
    return 2 * abs(geometry.signed_area(triangle)) / longest**2 if longest > 0 else 0.0
