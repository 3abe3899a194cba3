"""Which links are believed, what they connect, and where the middle is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from streamtrack import geometry
from streamtrack.mosaic.pictures.graph import (
    contradicted_links,
    largest_part,
    tree_poses,
    vouched_links,
    well_supported,
)
from streamtrack.mosaic.types import Link
from streamtrack.registration import refused
from streamtrack.types import Matches, Matrix, Model, Registration, Size, Verdict

SIZE: Size = (400, 300)


def make_link(a: int, b: int, b_from_a: Matrix, pairs: int = 60) -> Link:
    rng = np.random.default_rng(a * 100 + b)
    a_points = rng.uniform((0, 0), SIZE, (pairs, 2)).astype(np.float32)
    b_points = geometry.transform_points(b_from_a, a_points)
    rows = np.arange(pairs)
    found = Registration(Verdict.OK, b_from_a, Model.HOMOGRAPHY, np.ones(pairs, np.bool_), 0.1)
    matches = Matches(rows, rows, np.zeros(pairs, np.float32))
    return Link(a, b, a_points, b_points, found, matches, 0.1, 0.95)


def shifted(a: int, b: int, step_px: float = 100.0, **kwargs: int) -> Link:
    """Picture i lies i steps to the right."""
    return make_link(a, b, geometry.translation((a - b) * step_px, 0), **kwargs)


def doubted(link: Link, verdict: Verdict, ncc: float = 0.95) -> Link:
    inside = link.registration.is_inlier
    return replace(
        link, registration=refused(verdict, len(inside), inside), overlap_ncc=ncc, rmse_px=np.nan
    )


def sizes(count: int) -> dict[int, Size]:
    return dict.fromkeys(range(count), SIZE)


def test_links_that_agree_are_not_contradicted() -> None:
    links = [shifted(0, 1), shifted(1, 2), shifted(0, 2), shifted(2, 3), shifted(1, 3)]
    assert contradicted_links(links, sizes(4)) == []


def test_the_one_wrong_link_is_named() -> None:
    wrong = make_link(0, 3, geometry.translation(-120, 90))
    links = [shifted(a, b) for a in range(4) for b in range(a + 1, 4) if (a, b) != (0, 3)]
    assert contradicted_links([*links, wrong], sizes(4)) == [wrong]


def test_without_a_triangle_nothing_speaks_against_a_link() -> None:
    wrong = make_link(1, 2, geometry.translation(55, 90))
    assert contradicted_links([shifted(0, 1), wrong], sizes(3)) == []


def test_the_largest_part_and_its_middle() -> None:
    links = [shifted(0, 1), shifted(1, 2), shifted(2, 3), shifted(3, 4), shifted(6, 7)]
    part = largest_part(range(8), links)
    assert part is not None
    assert part.members == (0, 1, 2, 3, 4)
    assert part.centre == 2


def test_of_two_equal_parts_the_better_supported_is_taken() -> None:
    part = largest_part(range(4), [shifted(0, 1, pairs=30), shifted(2, 3, pairs=90)])
    assert part is not None
    assert part.members == (2, 3)


def test_no_links_no_part() -> None:
    assert largest_part(range(3), []) is None


def test_poses_are_chained_from_the_middle() -> None:
    poses = tree_poses(1, [shifted(0, 1), shifted(1, 2), shifted(2, 3)])
    for picture, pose in poses.items():
        np.testing.assert_allclose(pose, geometry.translation((picture - 1) * 100, 0), atol=1e-9)
    assert sorted(poses) == [0, 1, 2, 3]


def test_poses_prefer_the_better_supported_way() -> None:
    thin = make_link(0, 2, geometry.translation(-150, 0), pairs=15)
    poses = tree_poses(0, [shifted(0, 1), shifted(1, 2), thin])
    np.testing.assert_allclose(poses[2], geometry.translation(200, 0), atol=1e-9)


def test_two_doubted_links_that_agree_vouch_for_each_other() -> None:
    poses = {0: np.eye(3), 1: geometry.translation(100, 0)}
    weak = [
        doubted(shifted(0, 2), Verdict.LOW_CORRELATION, 0.5),
        doubted(shifted(1, 2), Verdict.LOW_CORRELATION, 0.5),
    ]
    found = vouched_links(weak, poses, sizes(3))
    assert [(link.a, link.b) for link in found] == [(0, 2), (1, 2)]
    assert all(link.b_from_a is not None and link.verdict is Verdict.OK for link in found)


@pytest.mark.parametrize(
    "weak",
    [
        [doubted(shifted(0, 2), Verdict.LOW_CORRELATION)],
        [
            doubted(shifted(0, 2), Verdict.LOW_CORRELATION),
            doubted(make_link(1, 2, geometry.translation(0, 120)), Verdict.LOW_CORRELATION),
        ],
        [
            doubted(shifted(0, 2), Verdict.TOO_FEW_INLIERS),
            doubted(shifted(1, 2), Verdict.TOO_FEW_INLIERS),
        ],
        [
            doubted(shifted(0, 2, pairs=12), Verdict.LOW_CORRELATION),
            doubted(shifted(1, 2, pairs=12), Verdict.LOW_CORRELATION),
        ],
    ],
    ids=["alone", "disagreeing", "refused for less", "thin"],
)
def test_no_other_doubted_links_are_believed(weak: list[Link]) -> None:
    poses = {0: np.eye(3), 1: geometry.translation(100, 0)}
    assert vouched_links(weak, poses, sizes(3)) == []


def test_a_link_with_loose_corners_but_a_sure_overlap_is_believed() -> None:
    found = well_supported(doubted(shifted(0, 1), Verdict.UNCERTAIN))
    assert found is not None
    assert found.b_from_a is not None
    np.testing.assert_allclose(found.b_from_a, geometry.translation(-100, 0), atol=0.02)


@pytest.mark.parametrize(
    "link",
    [
        shifted(0, 1),
        doubted(shifted(0, 1), Verdict.LOW_CORRELATION),
        doubted(shifted(0, 1), Verdict.UNCERTAIN, ncc=0.3),
        doubted(shifted(0, 1), Verdict.UNCERTAIN, ncc=float("nan")),
        doubted(shifted(0, 1, pairs=20), Verdict.UNCERTAIN),
    ],
    ids=["accepted already", "other doubt", "no agreement", "not measured", "thin"],
)
def test_no_other_link_is_believed_by_its_overlap(link: Link) -> None:
    assert well_supported(link) is None
