"""Surfaces, bounds and layout of a canvas, by their own definitions."""

from __future__ import annotations

import numpy as np
import pytest
from test_mosaic_rotation import FOCAL, SIZE, turned

from streamtrack import geometry
from streamtrack.mosaic.pictures.projection import (
    Kind,
    View,
    field_of_view,
    fitting_kind,
    lay_out,
    natural_size,
    planar_views,
    turned_views,
)
from streamtrack.mosaic.pictures.rotation import Rotations, camera_matrix
from streamtrack.types import Matrix

KINDS: tuple[Kind, ...] = ("planar", "cylindrical", "spherical")


def rotations(cameras: list[Matrix], anchor: int = 0) -> Rotations:
    to_anchor = cameras[anchor].T
    return Rotations(
        {i: to_anchor @ camera for i, camera in enumerate(cameras)},
        dict.fromkeys(range(len(cameras)), FOCAL),
        dict.fromkeys(range(len(cameras)), SIZE),
        anchor,
        0.2,
        np.zeros(0),
    )


def sweep(degrees: float, count: int, pitch: float = 0.0) -> Rotations:
    return rotations([turned(a, pitch) for a in np.linspace(0, degrees, count)], count // 2)


@pytest.mark.parametrize("kind", KINDS)
def test_maps_undo_to_canvas(kind: Kind) -> None:
    views = turned_views(sweep(40, 3, pitch=10), kind)
    for view in lay_out(views, 0.5).patches:
        x0, y0, x1, y1 = view.box
        xs, ys = view.view.maps(view.box)
        inside = (xs > 0) & (xs < SIZE[0] - 1) & (ys > 0) & (ys < SIZE[1] - 1)
        assert inside.mean() > 0.5
        back = view.view.to_canvas(np.column_stack([xs[inside], ys[inside]]))
        grid = np.stack(np.meshgrid(np.arange(x0, x1), np.arange(y0, y1)), axis=-1)
        np.testing.assert_allclose(back, grid[inside], atol=0.01)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("factor", [0.25, 0.5, 2.0])
def test_scaling_the_canvas_is_resizing_it(kind: Kind, factor: float) -> None:
    view = turned_views(sweep(40, 3), kind)[0].shifted(-30, 12)
    points = np.array([[0.0, 0.0], [300.0, 100.0], [639.0, 479.0]])
    resized = geometry.transform_points(geometry.scaling(factor), view.to_canvas(points))
    np.testing.assert_allclose(view.scaled(factor).to_canvas(points), resized, atol=1e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_a_resized_picture_lies_where_the_full_one_does(kind: Kind) -> None:
    view = turned_views(sweep(40, 3), kind)[2]
    half = view.of_resized(0.5, 0.5, (320, 240))
    points = np.array([[100.0, 80.0], [500.0, 400.0]])
    small = geometry.transform_points(geometry.scaling(0.5), points)
    np.testing.assert_allclose(half.to_canvas(small), view.to_canvas(points), atol=1e-3)


@pytest.mark.parametrize(
    ("degrees", "pitch", "kind"),
    [(20, 0, "planar"), (20, 35, "planar"), (100, 0, "cylindrical"), (100, 50, "spherical")],
)
def test_the_surface_follows_the_view(degrees: float, pitch: float, kind: Kind) -> None:
    assert fitting_kind(sweep(degrees, 6, pitch)) == kind


def test_field_of_view_is_that_of_the_sweep() -> None:
    across, high = field_of_view(sweep(60, 5))
    own = np.degrees(2 * np.arctan(SIZE[0] / 2 / FOCAL))
    assert across == pytest.approx(60 + own, abs=0.5)
    assert high == pytest.approx(np.degrees(2 * np.arctan(SIZE[1] / 2 / FOCAL)), abs=0.5)


def test_a_tilted_and_rolled_anchor_is_levelled() -> None:
    # All cameras look 12 degrees down along one horizon; the world is the first one's own frame.
    turns = rotations([turned(a, -12) for a in np.linspace(0, 150, 8)], 0)
    views = turned_views(turns, "cylindrical")
    centre = [[(SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2]]
    heights = [float(view.to_canvas(centre)[0, 1]) for view in views.values()]
    assert np.ptp(heights) < 1.0
    assert abs(heights[0]) == pytest.approx(FOCAL * np.tan(np.radians(12)), rel=0.01)


def test_pictures_that_look_one_way_are_not_rolled() -> None:
    views = turned_views(rotations([turned(0), turned(0.2), turned(0, 0.2)]), "planar")
    left, right = views[0].to_canvas([[0.0, 240.0], [639.0, 240.0]])
    assert abs(left[1] - right[1]) < 1.0


def test_a_full_turn_is_as_wide_as_the_circle_and_covered_all_round() -> None:
    turns = rotations([turned(30 * i) for i in range(12)])
    canvas = lay_out(turned_views(turns, "cylindrical"), 0.25)
    assert canvas.size_wh[0] == pytest.approx(2 * np.pi * FOCAL * 0.25, abs=2)
    seen = np.zeros(canvas.size_wh[0], np.bool_)
    for patch in canvas.patches:
        x0, y0, x1, y1 = patch.box
        assert 0 <= x0 < x1 <= canvas.size_wh[0]
        assert 0 <= y0 < y1 <= canvas.size_wh[1]
        xs, ys = patch.view.maps((x0, canvas.size_wh[1] // 2, x1, canvas.size_wh[1] // 2 + 1))
        seen[x0:x1] |= ((xs >= 0) & (xs < SIZE[0]) & (ys >= 0) & (ys < SIZE[1]))[0]
    assert seen.all()


def test_a_picture_of_the_zenith_covers_all_directions() -> None:
    up = camera_matrix(FOCAL, SIZE) @ turned(0, 80).T
    x0, _, x1, _ = View("spherical", up, SIZE, FOCAL).bounds()
    assert x1 - x0 == pytest.approx(2 * np.pi * FOCAL)


def test_a_plane_at_the_horizon_has_no_bounds() -> None:
    views = turned_views(sweep(130, 4), "planar")
    assert not np.isfinite(natural_size(views)[0])


def test_a_layout_holds_every_corner() -> None:
    poses = {0: np.eye(3), 1: geometry.translation(300.4, -77.3), 2: geometry.translation(-41, 9)}
    views = planar_views(poses, dict.fromkeys(range(3), SIZE))
    canvas = lay_out(views, 1.0)
    assert canvas.size_wh == pytest.approx(natural_size(views), abs=1)
    for patch in canvas.patches:
        corners = patch.view.to_canvas(geometry.image_quad(SIZE))
        assert np.all(corners > -1)
        assert np.all(corners < canvas.size_wh)
        assert patch.box[0] <= corners[:, 0].min() + 0.5
        assert patch.box[3] >= corners[:, 1].max()


def test_scale_and_magnification_of_a_plane() -> None:
    doubled = View("planar", geometry.scaling(2.0), SIZE)
    assert doubled.scale() == pytest.approx(2.0)
    assert doubled.magnification() == pytest.approx(1.0)
    tilted = np.eye(3)
    tilted[2, 0] = 1 / 1278
    assert View("planar", tilted, SIZE).magnification() == pytest.approx(1.5**3, rel=1e-6)
