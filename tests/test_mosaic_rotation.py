"""Focal length and rotations of a camera that turns, against exact truth."""

from __future__ import annotations

import numpy as np
import pytest

from streamtrack import geometry
from streamtrack.mosaic.pictures import rotation
from streamtrack.mosaic.pictures.rotation import (
    Rotations,
    adjust_rotations,
    camera_matrix,
    focals_from_homography,
    rotation_between,
)
from streamtrack.mosaic.types import Link
from streamtrack.types import Matches, Matrix, Model, Points, Registration, Size, Verdict

SIZE: Size = (640, 480)
FOCAL = 600.0


def turned(yaw: float, pitch: float = 0.0, roll: float = 0.0) -> Matrix:
    """world_from_camera for angles in degrees."""
    y, p, r = np.radians([yaw, pitch, roll])
    about_y = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(p), -np.sin(p)], [0, np.sin(p), np.cos(p)]])
    about_z = np.array([[np.cos(r), -np.sin(r), 0], [np.sin(r), np.cos(r), 0], [0, 0, 1]])
    return about_y @ about_x @ about_z


def homography(a: Matrix, b: Matrix, focal: float = FOCAL) -> Matrix:
    """b_from_a of two cameras given by world_from_camera."""
    k = camera_matrix(focal, SIZE)
    return geometry.normalized(k @ b.T @ a @ np.linalg.inv(k))


def make_link(
    a: int, b: int, b_from_a: Matrix, rng: np.random.Generator, noise_px: float = 0.2
) -> Link:
    """A link with pairs spread over what the pictures have in common."""
    points = rng.uniform((0, 0), SIZE, (1500, 2)).astype(np.float32)
    mapped = geometry.transform_points(b_from_a, points)
    depths = geometry.projective_depths(b_from_a, points)
    inside = np.all((mapped >= 0) & (mapped < SIZE), axis=1) & (depths > 0)
    a_points, b_points = points[inside][:200], mapped[inside][:200]
    b_points = (b_points + rng.normal(0, noise_px, b_points.shape)).astype(np.float32)
    return link_of(a, b, a_points, b_points, b_from_a)


def link_of(a: int, b: int, a_points: Points, b_points: Points, b_from_a: Matrix) -> Link:
    all_in = np.ones(len(a_points), np.bool_)
    rows = np.arange(len(a_points))
    return Link(
        a,
        b,
        a_points,
        b_points,
        Registration(Verdict.OK, b_from_a, Model.HOMOGRAPHY, all_in, 0.2),
        Matches(rows, rows, np.zeros(len(rows), np.float32)),
    )


def adjusted(cameras: list[Matrix], rng: np.random.Generator, reach: int = 2) -> Rotations | None:
    links = [
        make_link(a, b, homography(cameras[a], cameras[b]), rng)
        for a in range(len(cameras))
        for b in range(a + 1, min(len(cameras), a + reach + 1))
    ]
    return adjust_rotations(links, dict.fromkeys(range(len(cameras)), SIZE), 0)


def angle_between(a: Matrix, b: Matrix) -> float:
    """Degrees of the rotation that is left between two."""
    return float(np.degrees(np.arccos(np.clip((np.trace(a.T @ b) - 1) / 2, -1, 1))))


def test_focal_lengths_are_read_off_an_exact_homography() -> None:
    found = focals_from_homography(homography(turned(0), turned(20, 5, 3)), SIZE, SIZE)
    assert found == pytest.approx([FOCAL, FOCAL], rel=1e-6)


def test_a_shift_tells_nothing_of_the_focal_length() -> None:
    assert focals_from_homography(geometry.translation(30, 0), SIZE, SIZE) == []


def test_rotation_between_is_that_of_the_cameras() -> None:
    a, b = turned(3, -4, 1), turned(18, 6, -7)
    k = camera_matrix(FOCAL, SIZE)
    np.testing.assert_allclose(rotation_between(homography(a, b), k, k), b.T @ a, atol=1e-9)


def test_rotations_and_focal_length_come_back(rng: np.random.Generator) -> None:
    cameras = [turned(22 * i, 4 * np.sin(i), 2 * np.cos(i)) for i in range(6)]
    found = adjusted(cameras, rng)
    assert found is not None
    for picture, camera in enumerate(cameras):
        truth = cameras[0].T @ camera
        assert angle_between(found.world_from_camera[picture], truth) < 0.2
        assert found.focals_px[picture] == pytest.approx(FOCAL, rel=0.01)
    assert found.rmse_px == pytest.approx(0.2 * np.sqrt(2), rel=0.2)


def test_a_full_turn_closes(rng: np.random.Generator) -> None:
    cameras = [turned(30 * i, 3 * np.cos(i)) for i in range(12)]
    links = [
        make_link(i, (i + 1) % 12, homography(cameras[i], cameras[(i + 1) % 12]), rng)
        for i in range(12)
    ]
    found = adjust_rotations(links, dict.fromkeys(range(12), SIZE), 0)
    assert found is not None
    assert angle_between(found.world_from_camera[11], cameras[0].T @ cameras[11]) < 0.2


def test_a_wrong_link_does_not_bend_the_rest(rng: np.random.Generator) -> None:
    cameras = [turned(20 * i) for i in range(5)]
    links = [
        make_link(a, b, homography(cameras[a], cameras[b]), rng)
        for a in range(5)
        for b in range(a + 1, min(5, a + 3))
    ]
    wrong = make_link(0, 3, homography(cameras[0], turned(25, 12)), rng)
    found = adjust_rotations([*links, wrong], dict.fromkeys(range(5), SIZE), 0)
    assert found is not None
    assert angle_between(found.world_from_camera[4], cameras[4]) < 0.3
    assert found.link_error_px[-1] > 20 * np.max(found.link_error_px[:-1])


def test_a_flat_scene_seen_from_elsewhere_is_no_rotation(rng: np.random.Generator) -> None:
    zoomed = np.array([[1.5, 0.02, 40.0], [0.01, 1.1, -60.0], [1e-4, 3e-4, 1.0]])
    found = adjust_rotations([make_link(0, 1, zoomed, rng)], {0: SIZE, 1: SIZE}, 0)
    assert found is None or found.link_error_px[0] > 5


def test_the_jacobian_is_the_derivative_of_the_residuals(rng: np.random.Generator) -> None:
    state = rotation._State(
        np.array([turned(2, 3, 4), turned(14, -5, 9)]), float(np.log(0.95)), np.array([0.01, -0.02])
    )
    scales = np.array([640.0, 640.0])
    pairs = rotation._Pairs(0, 1, rng.uniform(-200, 200, (5, 2)), rng.uniform(-200, 200, (5, 2)))
    start, rays_a, rays_b, b_from_a, f_b = rotation._residuals(state, scales, pairs)
    found = rotation._jacobian(rays_a, rays_b, b_from_a, f_b)
    columns = [0, 1, 2, 3, 4, 5, 6, 7, 8]
    for column in columns:
        step = np.zeros(9)
        step[column] = 1e-6
        moved = rotation._residuals(state.moved(step), scales, pairs)[0]
        numeric = (moved - start).reshape(-1) / 1e-6
        np.testing.assert_allclose(found[:, column], numeric, rtol=1e-3, atol=0.05)
