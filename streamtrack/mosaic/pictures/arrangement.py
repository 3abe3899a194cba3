"""From links to places: which pictures belong together, on what surface, and how they lie there.

A flat scene (or any pair) is a plane: one homography, or less, a picture. A camera that turns on
the spot is three angles a picture and a focal length; that it does is believed if its far fewer
freedoms explain the pairs about as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from streamtrack import geometry
from streamtrack.errors import StreamtrackError
from streamtrack.mosaic.pictures.graph import (
    Part,
    contradicted_links,
    largest_part,
    tree_poses,
    vouched_links,
    well_supported,
)
from streamtrack.mosaic.pictures.projection import (
    Kind,
    View,
    field_of_view,
    fitting_kind,
    planar_views,
    turned_views,
)
from streamtrack.mosaic.types import Adjusted, Link
from streamtrack.settings import Settings
from streamtrack.types import Matrix, Model, Size

if TYPE_CHECKING:
    from streamtrack.mosaic.pictures.rotation import Rotations

_MAX_MAGNIFICATION = 15.0
_MAX_VIEW_AREA = 12.0  # of a picture's box on a plane, per area that its middle's scale gives it
_TURNING_MISFIT = (1.3, 0.2)  # rotations may misfit by so much more than a plane: factor and px
_ASKED_MISFIT = (2.0, 1.0)  # the same where the user says that the camera turned
_WRONG_LINK_NOISES = 6.0
_MIN_WRONG_PX = 4.0
_ANY_PLANE_DEG = 130.0
"""Beyond this view a plane is not even tried."""


@dataclass(frozen=True, slots=True, eq=False)
class Arrangement:
    """Where the pictures lie.

    ``world_from_picture`` maps to the reference picture's pixels; ``views`` say where each lies
    on the canvas (at the reference's scale), ``refused`` why a linked picture has no place.
    ``links`` are those that hold the arrangement, ``contradicted`` those that it speaks against.
    """

    reference: int
    model: str
    kind: Kind
    world_from_picture: dict[int, Matrix]
    views: dict[int, View]
    refused: dict[int, str]
    links: tuple[Link, ...]
    contradicted: tuple[Link, ...]
    rmse_px: float
    focal_px: float | None


def arrange(links: Sequence[Link], sizes: Mapping[int, Size], settings: Settings) -> Arrangement:
    """Place the pictures that accepted links connect; the largest connected part of them.

    ``sizes`` are (width, height) by picture index. Raises StreamtrackError if no link was
    accepted, or the surface asked for does not fit the pictures.
    """
    certain = [link for link in links if link.b_from_a is not None]
    believed = [found for link in links if (found := well_supported(link)) is not None]
    accepted = [*certain, *believed]
    contradicted = contradicted_links(accepted, sizes)
    sound = [link for link in accepted if link not in contradicted]
    part = largest_part(sizes, sound)
    if part is None:
        raise StreamtrackError("no two of the pictures overlap in a way that can be told")
    inside = [link for link in sound if link.a in part.members]
    wanted = settings.mosaic.projection
    if len(part.members) == 2 and wanted in ("auto", "planar") and inside[0] in certain:
        pair = _best_flat(_pair(inside[0], part), part, sizes, inside, contradicted)
        if not pair.refused or wanted == "planar":
            return pair
    inside, part = _with_vouched(links, inside, sizes, part)
    turning = _turning(inside, sizes, part, settings)
    is_wide = turning is not None and max(field_of_view(turning)) >= _ANY_PLANE_DEG
    plane = None if is_wide and wanted != "planar" else _plane(inside, sizes, part, settings)
    if turning is not None and (plane is None or _explains_as_well(turning, plane, wanted)):
        kind: Kind = fitting_kind(turning) if wanted == "auto" else wanted
        if kind != "planar" or plane is None or _explains_better(turning, plane):
            return _turned(turning, kind, inside, contradicted)
    if plane is None or wanted in ("cylindrical", "spherical"):
        raise StreamtrackError(_no_surface(wanted))
    return _best_flat(plane, part, sizes, inside, contradicted)


def _with_vouched(
    links: Sequence[Link], inside: list[Link], sizes: Mapping[int, Size], part: Part
) -> tuple[list[Link], Part]:
    """The part's links and those refused ones that agree about where else a picture lies."""
    poses = tree_poses(part.centre, inside)
    refused = [link for link in links if link.b_from_a is None]
    found = vouched_links(refused, poses, sizes)
    if not found:
        return inside, part
    joined = [*inside, *found]
    larger = largest_part(sizes, joined)
    return joined, part if larger is None else larger


def _no_surface(wanted: str) -> str:
    if wanted in ("cylindrical", "spherical"):
        return (
            f"--projection {wanted} needs pictures of a camera that turned on the spot, and these "
            "are not: leave the choice to --projection auto"
        )
    return "the pictures' links contradict each other: nothing can be placed"


def _pair(link: Link, part: Part) -> Adjusted:
    """Two pictures need no adjustment: their link is the best there is."""
    assert link.b_from_a is not None and link.model is not None
    matrix = link.b_from_a if link.b == part.centre else geometry.inverted(link.b_from_a)
    other = link.a if link.b == part.centre else link.b
    poses = {part.centre: np.eye(3), other: matrix}
    return Adjusted(poses, link.model, link.rmse_px, np.array([link.rmse_px]), np.array([True]))


# -- a camera that turns ------------------------------------------------------------------------


def _turning(
    links: Sequence[Link], sizes: Mapping[int, Size], part: Part, settings: Settings
) -> Rotations | None:
    """Rotations of all pictures of a part, without links they contradict; None if unfit."""
    if settings.registration.model not in ("auto", "homography"):
        return None
    from streamtrack.mosaic.pictures.rotation import adjust_rotations

    used = list(links)
    for _ in range(3):
        found = adjust_rotations(used, sizes, part.centre)
        if found is None or len(found.world_from_camera) < len(part.members):
            return None
        limit = max(_MIN_WRONG_PX, _WRONG_LINK_NOISES * found.rmse_px)
        kept = [
            link for link, error in zip(used, found.link_error_px, strict=True) if error < limit
        ]
        if len(kept) == len(used):
            return found
        smaller = largest_part(sizes, kept)
        if smaller is None or len(smaller.members) < len(part.members):
            return None
        used = kept
    return None


def _explains_as_well(turning: Rotations, plane: Adjusted, wanted: str) -> bool:
    is_asked_for = wanted in ("cylindrical", "spherical")
    factor, floor_px = _ASKED_MISFIT if is_asked_for else _TURNING_MISFIT
    return turning.rmse_px <= factor * plane.rmse_px + floor_px


def _explains_better(turning: Rotations, plane: Adjusted) -> bool:
    """Rotations have far fewer freedoms: misfitting no more, they are the better model."""
    return turning.rmse_px <= 1.02 * plane.rmse_px


def _turned(
    turning: Rotations, kind: Kind, links: Sequence[Link], contradicted: Sequence[Link]
) -> Arrangement:
    views = turned_views(turning, kind)
    refused = _refused_views(views)
    return Arrangement(
        turning.anchor,
        "rotation",
        kind,
        {i: geometry.normalized(turning.world_from_picture(i)) for i in views if i not in refused},
        {picture: view for picture, view in views.items() if picture not in refused},
        refused,
        tuple(links),
        tuple(contradicted),
        turning.rmse_px,
        turning.focals_px[turning.anchor],
    )


# -- a plane ------------------------------------------------------------------------------------


def _plane(
    links: Sequence[Link], sizes: Mapping[int, Size], part: Part, settings: Settings
) -> Adjusted | None:
    from streamtrack.mosaic.adjustment import adjust

    rough = tree_poses(part.centre, links)
    chosen = settings.registration.model
    model: Model | Literal["auto"] = "auto" if chosen == "auto" else Model(chosen)
    found = adjust(rough, links, {i: sizes[i] for i in rough}, part.centre, model)
    return found if len(found.world_from_picture) > 1 else None


def _best_flat(
    plane: Adjusted,
    part: Part,
    sizes: Mapping[int, Size],
    links: Sequence[Link],
    contradicted: Sequence[Link],
) -> Arrangement:
    """The plane of the part's centre, or of another picture if that holds more of them.

    Seen from a picture taken at a slant the others may reach to the horizon, and not the other
    way round.
    """
    best = _flat(plane, part, sizes, links, contradicted)
    for picture in part.members:
        if not best.refused:
            break
        if picture not in plane.world_from_picture:
            continue
        picture_from_world = geometry.inverted(plane.world_from_picture[picture])
        poses = {i: picture_from_world @ m for i, m in plane.world_from_picture.items()}
        turned = replace(plane, world_from_picture=poses)
        found = _flat(turned, replace(part, centre=picture), sizes, links, contradicted)
        best = found if len(found.refused) < len(best.refused) else best
    return best


def _flat(
    plane: Adjusted,
    part: Part,
    sizes: Mapping[int, Size],
    links: Sequence[Link],
    contradicted: Sequence[Link],
) -> Arrangement:
    views = planar_views(plane.world_from_picture, sizes)
    refused = _refused_views(views)
    for picture in part.members:
        if picture not in views:
            refused[picture] = "its links contradict those of the other pictures"
    rejected = [link for link, used in zip(links, plane.is_used, strict=True) if not used]
    return Arrangement(
        part.centre,
        plane.model.value,
        "planar",
        {
            i: geometry.normalized(m)
            for i, m in plane.world_from_picture.items()
            if i not in refused
        },
        {picture: view for picture, view in views.items() if picture not in refused},
        refused,
        tuple(link for link in links if link not in rejected),
        (*contradicted, *rejected),
        plane.rmse_px,
        None,
    )


def _refused_views(views: Mapping[int, View]) -> dict[int, str]:
    """Pictures that this surface would tear apart, with the reason in numbers."""
    refused: dict[int, str] = {}
    advice = "on a plane; --projection cylindrical or spherical may hold it"
    for picture, view in views.items():
        x0, y0, x1, y1 = view.bounds()
        area = view.size_wh[0] * view.size_wh[1] * view.scale() ** 2
        if not np.all(np.isfinite([x0, y0, x1, y1])):
            refused[picture] = f"reaches the horizon {advice}"
        elif view.magnification() > _MAX_MAGNIFICATION:
            refused[picture] = f"would be stretched {view.magnification():.0f}-fold {advice}"
        elif view.kind == "planar" and (x1 - x0) * (y1 - y0) > _MAX_VIEW_AREA * area:
            times = (x1 - x0) * (y1 - y0) / area
            refused[picture] = f"would be drawn out over {times:.0f} times its area {advice}"
    return refused


def in_full_pixels(
    arrangement: Arrangement, small_from_full: Mapping[int, Matrix], sizes: Mapping[int, Size]
) -> Arrangement:
    """The same arrangement for the pictures before they were reduced; the canvas as before.

    The world becomes the reference picture in its full size (width, height).
    """
    world = np.linalg.inv(small_from_full[arrangement.reference])
    return replace(
        arrangement,
        world_from_picture={
            i: geometry.normalized(world @ matrix @ small_from_full[i])
            for i, matrix in arrangement.world_from_picture.items()
        },
        views={
            i: view.of_resized(1 / small_from_full[i][0, 0], 1 / small_from_full[i][1, 1], sizes[i])
            for i, view in arrangement.views.items()
        },
    )
