"""Points, quads and 3x3 matrices against pictures, masks and each other."""

from __future__ import annotations

import warnings

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from conftest import MakeHomography

from streamtrack import geometry
from streamtrack.types import Size

SIZE = (320, 240)
SQUARE = [[0, 0], [10, 0], [10, 10], [0, 10]]


def masked_share(quad: npt.NDArray[np.float64], size_wh: Size, pad: int = 170) -> float:
    """Share of a quad inside a picture, by counting fine pixels of a larger canvas."""
    fine = 4
    width, height = size_wh[0] + 2 * pad, size_wh[1] + 2 * pad
    mask = np.zeros((height * fine, width * fine), np.uint8)
    corners = (quad + pad + 0.5) * fine - 0.5
    cv2.fillConvexPoly(mask, np.rint(corners).astype(np.int32), 1)
    own = slice(pad * fine, -pad * fine)
    return float(np.count_nonzero(mask[own, own]) / np.count_nonzero(mask))


@pytest.mark.parametrize("seed", range(20))
def test_inverse_brings_points_back(seed: int, random_homography: MakeHomography) -> None:
    rng = np.random.default_rng(seed)
    b_from_a = random_homography(rng, SIZE)
    points = rng.uniform((0, 0), SIZE, (50, 2))
    back = geometry.transform_points(
        geometry.inverted(b_from_a), geometry.transform_points(b_from_a, points)
    )
    np.testing.assert_allclose(back, points, atol=2e-3)
    np.testing.assert_allclose(
        geometry.normalized(b_from_a @ geometry.inverted(b_from_a)), np.eye(3), atol=1e-9
    )


@pytest.mark.parametrize("seed", range(10))
def test_matrices_chain_as_their_names_say(seed: int, random_homography: MakeHomography) -> None:
    rng = np.random.default_rng(seed)
    b_from_a, c_from_b = (random_homography(rng, SIZE) for _ in range(2))
    points = rng.uniform((60, 60), (180, 180), (30, 2))
    at_once = geometry.transform_points(c_from_b @ b_from_a, points)
    one_by_one = geometry.transform_points(c_from_b, geometry.transform_points(b_from_a, points))
    depths = geometry.projective_depths(c_from_b @ b_from_a, points)
    near = np.abs(depths) > 0.2 * np.abs(depths).max()
    np.testing.assert_allclose(at_once[near], one_by_one[near], rtol=1e-3, atol=0.02)


def test_mapping_does_not_depend_on_the_matrix_scale(
    rng: np.random.Generator, random_homography: MakeHomography
) -> None:
    matrix = random_homography(rng, SIZE)
    points = rng.uniform(0, 200, (10, 2))
    expected = geometry.transform_points(matrix, points)
    for factor in (-3.0, 1e-6, 1e6):
        np.testing.assert_allclose(
            geometry.transform_points(factor * matrix, points), expected, rtol=1e-4, atol=1e-3
        )
    assert geometry.normalized(-3.0 * matrix)[2, 2] == 1.0


@pytest.mark.parametrize(
    ("matrix", "expected"),
    [
        (np.eye(3), [[3, 4]]),
        (geometry.translation(-3, 2), [[0, 6]]),
        (np.diag([2.0, 2.0, 1.0]), [[6, 8]]),
        (geometry.scaling(2, 1), [[6.5, 4]]),
        (np.array([[1.0, 0, 0], [0, 1, 0], [0.1, 0, 1]]), [[3 / 1.3, 4 / 1.3]]),
    ],
)
def test_known_mappings(matrix: npt.NDArray[np.float64], expected: list[list[float]]) -> None:
    mapped = geometry.transform_points(matrix, [[3, 4]])
    assert mapped.dtype == np.float32
    np.testing.assert_allclose(mapped, expected, rtol=1e-6)


def test_no_points_stay_no_points() -> None:
    assert geometry.transform_points(np.eye(3), np.zeros((0, 2))).shape == (0, 2)
    assert geometry.projective_depths(np.eye(3), np.zeros((0, 2))).shape == (0,)


@pytest.mark.parametrize("factors", [(0.5, 0.5), (0.25, 0.25), (2.0, 2.0), (3.0, 3.0), (0.5, 2.0)])
def test_scaling_puts_a_blob_where_resize_puts_it(factors: tuple[float, float]) -> None:
    y, x = np.mgrid[:240, :320].astype(np.float64)
    centre = 141.3, 97.6
    blob = np.exp(-((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / (2 * 9.0**2))
    size = round(320 * factors[0]), round(240 * factors[1])
    way = cv2.INTER_AREA if max(factors) < 1 else cv2.INTER_LINEAR
    resized = cv2.resize(blob, size, interpolation=way)
    rows, columns = np.mgrid[: size[1], : size[0]]
    found = [(resized * columns).sum() / resized.sum(), (resized * rows).sum() / resized.sum()]
    mapped = geometry.transform_points(geometry.scaling(*factors), [centre])
    np.testing.assert_allclose(mapped, [found], atol=0.02)


@pytest.mark.parametrize("factor", [0.1, 0.5, 1.0, 2.0, 7.0])
def test_scaling_keeps_the_outer_pixel_edges(factor: float) -> None:
    edges = geometry.box_quad(-0.5, -0.5, 320, 240)
    scaled = geometry.transform_points(geometry.scaling(factor), edges)
    wanted = geometry.box_quad(-0.5, -0.5, 320 * factor, 240 * factor)
    np.testing.assert_allclose(scaled, wanted, atol=1e-4)


@pytest.mark.parametrize("seed", range(12))
def test_visible_share_is_the_share_of_counted_pixels(seed: int) -> None:
    rng = np.random.default_rng(seed)
    angles = np.sort(rng.uniform(0, 2 * np.pi, 4) * 0.3 + np.arange(4) * np.pi / 2)
    centre = rng.uniform((-20, -20), (SIZE[0] + 20, SIZE[1] + 20))
    quad = centre + rng.uniform(60, 140) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    assert geometry.is_convex(quad)
    expected = masked_share(quad, SIZE)
    assert geometry.visible_share(quad, SIZE) == pytest.approx(expected, abs=0.01)
    assert geometry.visible_share(quad[::-1], SIZE) == pytest.approx(expected, abs=0.01)
    assert geometry.visible_share(np.roll(quad, 1, axis=0), SIZE) == pytest.approx(
        expected, abs=0.01
    )


@pytest.mark.parametrize(
    ("quad", "expected"),
    [
        (geometry.box_quad(10, 10, 50, 50), 1.0),
        (geometry.box_quad(-0.5, -0.5, 320, 240), 1.0),
        (geometry.image_quad(SIZE), 1.0),
        (geometry.box_quad(-50.5, 20, 100, 50), 0.5),
        (geometry.box_quad(-320.5, -240.5, 640, 480), 0.25),
        (geometry.box_quad(400, 20, 50, 50), 0.0),
        (geometry.box_quad(20, -80, 50, 50), 0.0),
        (geometry.box_quad(5, 5, 0, 0), 0.0),
        (np.array([[5, 5], [50, 50], [100, 100], [60, 60]]), 0.0),
    ],
)
def test_visible_share_of_boxes(quad: npt.NDArray[np.float32], expected: float) -> None:
    assert geometry.visible_share(quad, SIZE) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    ("polygon", "expected"),
    [
        (SQUARE, True),
        (SQUARE[::-1], True),
        ([[0, 0], [20, 1], [15, 9], [-3, 7]], True),
        ([[0, 0], [10, 0], [5, 8]], True),
        ([[0, 0], [10, 0], [2, 2], [0, 10]], False),
        ([[0, 0], [10, 10], [10, 0], [0, 10]], False),
        ([[0, 0], [5, 0], [10, 0], [5, 8]], False),
        ([[0, 0], [0, 0], [10, 0], [10, 10]], False),
        ([[3, 3]] * 4, False),
        ([[0, 0], [1, 1], [2, 2], [3, 3]], False),
        ([[0, 0], [10, 0], [10, float("nan")], [0, 10]], False),
    ],
)
def test_convexity(polygon: list[list[float]], expected: bool) -> None:
    assert geometry.is_convex(polygon) is expected


def test_points_at_the_horizon_are_infinite_and_say_nothing() -> None:
    matrix = np.array([[1.0, 0, 0], [0, 1, 0], [-0.01, 0, 1]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mapped = geometry.transform_points(matrix, [[100, 20], [99, 20], [101, 20]])
        nowhere = geometry.transform_points(np.zeros((3, 3)), [[1, 2]])
    assert not np.isfinite(mapped[0]).any()
    assert np.isfinite(mapped[1:]).all()
    assert np.isnan(nowhere).all()
    depths = geometry.projective_depths(matrix, [[100, 20], [99, 20], [101, 20]])
    assert depths[0] == 0 and depths[1] > 0 > depths[2]


def test_points_almost_at_the_horizon_are_infinite_and_say_nothing() -> None:
    """Beyond float32's range is as good as infinitely far."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mapped = geometry.transform_points(np.diag([1e30, 1e30, 1.0]), [[1e10, 1e10]])
    assert np.isinf(mapped).all()


@pytest.mark.parametrize("matrix", [np.zeros((3, 3)), np.diag([1.0, 0.0, 1.0])])
def test_a_singular_matrix_has_no_inverse(matrix: npt.NDArray[np.float64]) -> None:
    with pytest.raises(np.linalg.LinAlgError):
        geometry.inverted(matrix)


def test_quads_go_clockwise_from_the_top_left() -> None:
    quad = geometry.box_quad(3, 4, 10, 20)
    np.testing.assert_array_equal(quad, [[3, 4], [13, 4], [13, 24], [3, 24]])
    assert quad.dtype == np.float32
    assert geometry.signed_area(quad) == 200
    assert geometry.signed_area(quad[::-1]) == -200
    np.testing.assert_array_equal(geometry.image_quad(SIZE)[2], [319, 239])
    assert geometry.bounding_box(quad[[2, 0, 3, 1]]) == (3, 4, 13, 24)


@pytest.mark.parametrize("seed", range(5))
def test_area_is_opencvs(seed: int) -> None:
    points = np.random.default_rng(seed).uniform(0, 300, (9, 2)).astype(np.float32)
    hull = cv2.convexHull(points).reshape(-1, 2)
    assert abs(geometry.signed_area(hull)) == pytest.approx(cv2.contourArea(hull), rel=1e-5)


def test_grey_is_grey() -> None:
    grey = np.arange(12, dtype=np.uint8).reshape(3, 4)
    assert geometry.grey_of(grey) is grey
    np.testing.assert_array_equal(geometry.grey_of(np.dstack([grey] * 3)), grey)


@pytest.mark.parametrize("is_turned", [False, True])
def test_a_grown_quad_has_its_sides_further_out(is_turned: bool) -> None:
    quad = geometry.box_quad(10, 20, 200, 30)
    wanted = geometry.box_quad(4, 14, 212, 42)
    if is_turned:
        quad, wanted = quad[::-1], wanted[::-1]
    np.testing.assert_allclose(geometry.grown_quad(quad, 6), wanted, atol=1e-4)


def test_a_quad_that_is_not_convex_is_not_grown() -> None:
    crossed = np.array([[0, 0], [10, 10], [10, 0], [0, 10]], np.float32)
    np.testing.assert_array_equal(geometry.grown_quad(crossed, 5), crossed)
