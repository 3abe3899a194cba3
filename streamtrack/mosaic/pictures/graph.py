"""The match graph of a set of pictures: which links to believe, what they connect, its centre."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from streamtrack import geometry
from streamtrack.evaluation import symmetric_transfer_rmse
from streamtrack.fitting import fit, fit_robustly, transfer_errors
from streamtrack.mosaic.types import Link
from streamtrack.types import Matrix, Model, Points, Registration, Size, Verdict

_MAX_LOOP_ERROR = 0.03
"""Share of a picture's diagonal by which its points may miss themselves around a triangle."""
_DOUBTED = (Verdict.LOW_CORRELATION, Verdict.UNCERTAIN)
_MIN_VOUCHED_INLIERS = 30
_VOUCHED_PX = 3.0
_MIN_CERTAIN_INLIERS, _MIN_CERTAIN_SHARE, _MIN_CERTAIN_NCC = 40, 0.5, 0.8


# -- which links to believe ---------------------------------------------------------------------


def contradicted_links(links: Sequence[Link], sizes: Mapping[int, Size]) -> list[Link]:
    """Links that the triangles of the graph speak against, worst first.

    Around a triangle the points of a picture must come back to themselves, at least in one of the
    three pictures (a homography is only known well near its own pairs). A wrong link spoils
    every triangle it is part of, a right one only those it shares with a wrong one: the link with
    the most spoilt and fewest sound triangles is taken out until no link has more spoilt ones.
    """
    mapping: dict[tuple[int, int], Matrix] = {}
    for link in links:
        if link.b_from_a is not None:
            mapping[link.a, link.b] = link.b_from_a
            mapping[link.b, link.a] = geometry.inverted(link.b_from_a)
    neighbours = _neighbours(links)
    by_pair = {frozenset((link.a, link.b)): link for link in links}
    is_sound: dict[frozenset[int], bool] = {}
    for a, b in [(link.a, link.b) for link in links]:
        for c in neighbours[a] & neighbours[b]:
            corners = frozenset((a, b, c))
            if corners not in is_sound:
                rounds = ((a, b, c), (b, c, a), (c, a, b))
                is_sound[corners] = any(
                    _loop_error(
                        mapping[z, x] @ mapping[y, z] @ mapping[x, y],
                        _inlier_points(by_pair[frozenset((x, y))], x),
                        sizes[x],
                    )
                    < _MAX_LOOP_ERROR
                    for x, y, z in rounds
                )
    wrong: list[Link] = []
    while True:
        spoilt: dict[frozenset[int], int] = {}
        for corners, sound in is_sound.items():
            for corner in corners:
                pair = corners - {corner}
                spoilt[pair] = spoilt.get(pair, 0) + (-1 if sound else 1)
        worst = max(
            spoilt,
            key=lambda pair: (spoilt[pair], -by_pair[pair].registration.inliers),
            default=None,
        )
        if worst is None or spoilt[worst] <= 0:
            return wrong
        wrong.append(by_pair[worst])
        is_sound = {corners: sound for corners, sound in is_sound.items() if not worst <= corners}


def _inlier_points(link: Link, picture: int) -> Points:
    points = link.a_points if link.a == picture else link.b_points
    return points[link.registration.is_inlier]


def _loop_error(a_from_a: Matrix, points: Points, size_wh: Size) -> float:
    """Median distance of points to themselves, as share of the picture's diagonal."""
    moved = geometry.transform_points(a_from_a, points)
    if not np.all(np.isfinite(moved)):
        return float("inf")
    return float(np.median(np.linalg.norm(moved - points, axis=1)) / np.hypot(*size_wh))


def well_supported(link: Link) -> Link | None:
    """A link refused only for its far corners, accepted if its overlap leaves no doubt.

    A mosaic needs pictures to fit where they overlap; what is uncertain lies where they do not.
    """
    found = link.registration
    if (
        link.verdict is not Verdict.UNCERTAIN
        or found.inliers < _MIN_CERTAIN_INLIERS
        or found.inliers < _MIN_CERTAIN_SHARE * len(link.a_points)
        or not link.overlap_ncc >= _MIN_CERTAIN_NCC
    ):
        return None
    return _accepted(*_refitted(link))


def vouched_links(
    refused: Sequence[Link], poses: Mapping[int, Matrix], sizes: Mapping[int, Size]
) -> list[Link]:
    """Refused links of unplaced pictures that vouch for each other, as accepted ones.

    Alone, a link whose pictures hardly correlate (trees seen from two sides) or that holds its
    far corners loosely is not believed. Two such links of one picture to two that are placed,
    which put it in the same place, are not chance.
    """
    doubted: dict[int, list[tuple[Link, Matrix]]] = {}
    for link in refused:
        is_strong = link.registration.inliers >= _MIN_VOUCHED_INLIERS
        if link.verdict in _DOUBTED and is_strong and (link.a in poses) != (link.b in poses):
            doubted.setdefault(link.b if link.a in poses else link.a, []).append(_refitted(link))
    vouched: list[Link] = []
    for picture, links in sorted(doubted.items()):
        quad = geometry.image_quad(sizes[picture])
        places = [
            geometry.transform_points(_pose_by(link, b_from_a, picture, poses), quad)
            for link, b_from_a in links
        ]
        for row, (link, b_from_a) in enumerate(links):
            apart = [
                float(np.mean(np.linalg.norm(places[row] - place, axis=1)))
                for other, place in enumerate(places)
                if other != row
            ]
            if any(value < _MAX_LOOP_ERROR * np.hypot(*sizes[picture]) for value in apart):
                vouched.append(_accepted(link, b_from_a))
    return vouched


def _refitted(link: Link) -> tuple[Link, Matrix]:
    """A refused link keeps its pairs but not its mapping."""
    agree = link.registration.is_inlier
    a, b = link.a_points[agree], link.b_points[agree]
    start = fit(Model.HOMOGRAPHY, a, b)
    return link, fit_robustly(Model.HOMOGRAPHY, start, a, b, _VOUCHED_PX, 3)[0]


def _pose_by(link: Link, b_from_a: Matrix, picture: int, poses: Mapping[int, Matrix]) -> Matrix:
    if picture == link.a:
        return poses[link.b] @ b_from_a
    return poses[link.a] @ geometry.inverted(b_from_a)


def _accepted(link: Link, b_from_a: Matrix) -> Link:
    is_inlier = link.registration.is_inlier
    a, b = link.a_points[is_inlier], link.b_points[is_inlier]
    errors = transfer_errors(b_from_a, a, b)
    rmse_px = float(np.sqrt(np.mean(errors**2)))
    found = Registration(Verdict.OK, b_from_a, Model.HOMOGRAPHY, is_inlier, rmse_px)
    return replace(link, registration=found, rmse_px=symmetric_transfer_rmse(b_from_a, a, b))


# -- parts and centre ---------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Part:
    """Pictures that links connect, and the one in their middle."""

    members: tuple[int, ...]
    centre: int


def largest_part(members: Iterable[int], links: Sequence[Link]) -> Part | None:
    """The connected part with the most pictures (then inliers); None if no link holds any.

    Its centre has the fewest links between itself and the farthest member, then the smallest sum
    of them, then the most inliers.
    """
    neighbours = _neighbours(links)
    inliers: dict[int, int] = {}
    for link in links:
        for end in (link.a, link.b):
            inliers[end] = inliers.get(end, 0) + link.registration.inliers
    left, parts = set(members) & set(neighbours), []
    while left:
        part = set(_hops(min(left), neighbours))
        parts.append(sorted(part))
        left -= part
    if not parts:
        return None
    part_members = max(parts, key=lambda part: (len(part), sum(inliers[i] for i in part)))

    def cost(picture: int) -> tuple[int, int, int]:
        hops = _hops(picture, neighbours)
        return max(hops.values()), sum(hops.values()), -inliers[picture]

    return Part(tuple(part_members), min(part_members, key=cost))


def tree_poses(centre: int, links: Sequence[Link]) -> dict[int, Matrix]:
    """Rough poses by chaining links outwards from the centre, the best supported first (Prim).

    The centre's pose is the identity; pictures that no link reaches are left out.
    """
    steps: dict[int, list[tuple[int, int, Matrix]]] = {}
    for link in links:
        if link.b_from_a is None:
            continue
        support = link.registration.inliers
        steps.setdefault(link.b, []).append((support, link.a, link.b_from_a))
        steps.setdefault(link.a, []).append((support, link.b, geometry.inverted(link.b_from_a)))
    poses: dict[int, Matrix] = {centre: np.eye(3)}
    while True:
        best: tuple[int, int, int, Matrix] | None = None
        for placed in poses:
            for support, other, placed_from_other in steps.get(placed, []):
                if other not in poses and (best is None or support > best[0]):
                    best = (support, placed, other, placed_from_other)
        if best is None:
            return poses
        _, placed, other, placed_from_other = best
        poses[other] = geometry.normalized(poses[placed] @ placed_from_other)


def _neighbours(links: Sequence[Link]) -> dict[int, set[int]]:
    neighbours: dict[int, set[int]] = {}
    for link in links:
        neighbours.setdefault(link.a, set()).add(link.b)
        neighbours.setdefault(link.b, set()).add(link.a)
    return neighbours


def _hops(start: int, neighbours: Mapping[int, set[int]]) -> dict[int, int]:
    """Number of links from ``start`` to each picture it is connected with."""
    hops, queue = {start: 0}, deque([start])
    while queue:
        at = queue.popleft()
        for other in sorted(neighbours[at]):
            if other not in hops:
                hops[other] = hops[at] + 1
                queue.append(other)
    return hops
