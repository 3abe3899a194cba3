"""What the user asks to be tracked: a box, a quad, or a template picture, with a name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np

from streamtrack import geometry
from streamtrack.errors import TargetError, UsageError
from streamtrack.types import Image, Points, Size, Track

_FORMS = "x,y,w,h or x1,y1,x2,y2,x3,y3,x4,y4 or PICTURE or PICTURE@x,y,w,h or auto"
_AUTO = "auto"
MIN_SIDE_PX = 8.0
_MAX_COORDINATE = 1e6


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """A named thing to follow.

    Without ``picture`` (BGR or grey), ``quad`` (4, 2) are pixels of the first frame. With it, the
    thing is searched for in every frame until found; ``quad`` are then pixels of the picture,
    and the whole picture if None.
    """

    name: str
    quad: Points | None = None
    picture: Image | None = None

    def __post_init__(self) -> None:
        if self.quad is None and self.picture is None:
            raise ValueError("a target has a quad, a picture or both")


@dataclass(frozen=True, slots=True)
class AutoTarget:
    """Whatever moves against the background; its names are ``<name>-1``, ``<name>-2`` ..."""

    name: str = _AUTO


TargetSpec: TypeAlias = Target | AutoTarget


def parse_targets(texts: Sequence[str]) -> list[TargetSpec]:
    """Targets from ``[NAME=]`` and ``x,y,w,h``, ``x1,...,y4``, ``PICTURE[@region]`` or ``auto``.

    The region of a picture is given as a box or a quad too, in the picture's pixels.

    Without a name, the only target is called ``target``, several ``target1``, ``target2`` ...
    Raises UsageError for what is no target, TargetError for a picture that cannot be read.
    """
    targets: list[TargetSpec] = []
    for number, text in enumerate(texts, start=1):
        if not text.isprintable():
            raise UsageError(f"target {text!r}: leave out line breaks and control characters")
        default = "target" if len(texts) == 1 else f"target{number}"
        targets.append(_parse_target(text, default))
    if sum(isinstance(target, AutoTarget) for target in targets) > 1:
        raise UsageError("auto is given twice: once finds all that moves")
    names = [target.name for target in targets]
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f"two targets are called '{name}': give each its own NAME=")
    return targets


def given_targets(targets: Sequence[TargetSpec]) -> list[Target]:
    """Those that the user has shown."""
    return [target for target in targets if isinstance(target, Target)]


def auto_target(targets: Sequence[TargetSpec]) -> AutoTarget | None:
    """The wish for automatic targets, if it is among them."""
    return next((target for target in targets if isinstance(target, AutoTarget)), None)


def _parse_target(text: str, default_name: str) -> TargetSpec:
    if text.strip() == _AUTO:
        return AutoTarget()
    name, separator, rest = text.partition("=")
    if not separator or not name.strip() or _is_picture(text):
        name, rest = default_name, text
    name, rest = name.strip(), rest.strip()
    if not rest:
        raise UsageError(f"target '{text}' is empty: give {_FORMS}")
    if rest == _AUTO:
        return AutoTarget(name)
    numbers = _parse_numbers(rest)
    if numbers is not None:
        return Target(name, quad=_quad_from_numbers(numbers, rest))
    path, _, region = rest.rpartition("@")
    region_numbers = _parse_numbers(region)
    if not path or region_numbers is None:
        return Target(name, picture=_read_picture(rest))
    return Target(name, _quad_from_numbers(region_numbers, rest), _read_picture(path))


def _is_picture(text: str) -> bool:
    """True if all of the text is the path of a picture, with or without a region."""
    return any(Path(part).is_file() for part in (text, text.rpartition("@")[0]) if part)


def _parse_numbers(text: str) -> list[float] | None:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        return None


def _quad_from_numbers(numbers: list[float], text: str) -> Points:
    if not np.all(np.abs(numbers) <= _MAX_COORDINATE):
        raise UsageError(
            f"target '{text}': every coordinate must be a finite number of pixels below a million"
        )
    if len(numbers) == 4:
        x, y, width, height = numbers
        if width <= 0 or height <= 0:
            raise UsageError(f"target '{text}': width and height must be positive")
        return geometry.box_quad(x, y, width, height)
    if len(numbers) == 8:
        quad = np.array(numbers, np.float32).reshape(4, 2)
        if not geometry.is_convex(quad):
            raise UsageError(
                f"target '{text}': the four corners must form a convex quad, "
                "given in order around it from the top-left"
            )
        return quad
    raise UsageError(f"target '{text}': give {_FORMS}")


def _read_picture(text: str) -> Image:
    import cv2

    path = Path(text)
    if not _exists(path):
        raise UsageError(f"target '{text}' is neither numbers nor a file: give {_FORMS}")
    data = np.fromfile(path, np.uint8) if path.is_file() else np.zeros(0, np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
    if picture is None:
        raise TargetError(f"template picture {text} cannot be read: give a PNG or JPEG file")
    return np.asarray(picture, np.uint8)


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:  # a name that no file can have, such as one of 5000 letters
        return False


def least_side_px(quad: Points) -> float:
    """Length of the shortest side of a quad (4, 2)."""
    return float(np.linalg.norm(np.roll(quad, -1, axis=0) - quad, axis=1).min())


def check_quad_in_picture(
    name: str, quad: Points, size_wh: Size, where: str = "the first frame"
) -> None:
    """Raise TargetError unless the quad is convex, large enough and mostly inside a picture."""
    if not np.all(np.isfinite(quad)):
        raise TargetError(f"target '{name}' has coordinates that are not finite numbers")
    if least_side_px(quad) < MIN_SIDE_PX:
        raise TargetError(
            f"target '{name}' is only {least_side_px(quad):.0f} px wide or high: "
            f"it needs at least {MIN_SIDE_PX:.0f} px"
        )
    if not geometry.is_convex(quad):
        raise TargetError(f"target '{name}' is no convex quad: give its corners in order around it")
    share = geometry.visible_share(quad, size_wh)
    if share < 0.5:
        x0, y0, x1, y1 = geometry.bounding_box(quad)
        outside = "outside" if share == 0 else "mostly outside"
        raise TargetError(
            f"target '{name}' ({x0:.0f},{y0:.0f} to {x1:.0f},{y1:.0f}) lies {outside} the "
            f"{size_wh[0]}x{size_wh[1]} picture: give it in pixels of {where}"
        )


def color_number(track: Track, place: int) -> int:
    """Which colour a track has: by its place in the list, or by its number if it was found."""
    number = track.name.rpartition("-")[2]
    return int(number) if track.is_found and number.isdecimal() else place
