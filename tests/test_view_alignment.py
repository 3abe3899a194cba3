"""Direct alignment of two views: exact, honest about its error, silent about what it cannot say."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from conftest import MakePicture

from streamtrack import geometry
from streamtrack.camera.view_alignment import align, align_exactly, align_near
from streamtrack.camera.view_levels import ReferenceView, ViewLevels
from streamtrack.evaluation import corner_error
from streamtrack.types import Image, Matrix, Size, Verdict

SIZE = (640, 480)


def view_of(wide: Image, wide_from_view: Matrix, size_wh: Size, seed: int = 0) -> Image:
    seen = cv2.warpPerspective(
        wide, wide_from_view, size_wh, flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    )
    noise = np.random.default_rng(seed).normal(0, 2, seen.shape)
    return np.clip(seen + noise, 0, 255).astype(np.uint8)


def posed(x: float, y: float, turn_deg: float = 0.0, zoom: float = 1.0) -> Matrix:
    turned = cv2.getRotationMatrix2D((320, 240), turn_deg, zoom)
    return geometry.translation(x, y) @ np.vstack([turned, [0, 0, 1]])


@pytest.fixture
def wide(make_picture: MakePicture) -> Image:
    return make_picture(31, (1400, 1000))


@pytest.mark.parametrize(
    ("x", "y", "turn_deg", "zoom"),
    [(0, 0, 0, 1), (60, 20, 4, 1.05), (200, -80, -8, 0.93), (-240, 60, 6, 1.1)],
)
@pytest.mark.parametrize("off_px", [0.0, 6.0])
def test_the_mapping_is_exact_and_its_error_foretold(
    x: float, y: float, turn_deg: float, zoom: float, off_px: float, wide: Image
) -> None:
    first, second = posed(350, 250), posed(350 + x, 250 + y, turn_deg, zoom)
    reference = ReferenceView(ViewLevels(view_of(wide, first, SIZE, 1)))
    levels = ViewLevels(view_of(wide, second, SIZE, 2))
    truth = geometry.normalized(geometry.inverted(first) @ second)
    found = align(reference, levels, truth @ geometry.translation(off_px, -off_px))
    assert found.verdict is Verdict.OK
    error = corner_error(found.reference_from_view, truth, SIZE)
    assert error < 0.2
    assert error < 3 * found.corner_sigma_px
    assert found.rmse_px < 0.5 and found.correlation > 0.9
    assert found.reference_from_view is not None
    exact = align_exactly(reference, levels, found.reference_from_view)
    assert corner_error(exact.reference_from_view, truth, SIZE) < 0.1


def test_short_steps_that_come_to_no_end_are_no_result(
    wide: Image, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a single round at the usual level a near guess is begun at a coarser one."""
    monkeypatch.setattr("streamtrack.camera.view_alignment._ROUNDS", (6, 1, 8, 8, 8))
    first, second = posed(350, 250), posed(362, 246, 1)
    reference = ReferenceView(ViewLevels(view_of(wide, first, SIZE, 1)))
    levels = ViewLevels(view_of(wide, second, SIZE, 2))
    truth = geometry.normalized(geometry.inverted(first) @ second)
    errors = [
        corner_error(
            align_near(reference, levels, truth @ posed(x, y, turn_deg)).reference_from_view,
            truth,
            SIZE,
        )
        for x, y, turn_deg in [(0.9, 0, 0), (0, -0.9, 0), (0.5, 0.5, 0.1), (0, 0.3, -0.15)]
    ]
    assert max(errors) < 0.035, errors  # what the noise allows; twice that with the one round


@pytest.mark.parametrize("shift", [(90, 0), (0, -100), (-120, 60)])
def test_a_search_finds_far_shifts(shift: tuple[int, int], wide: Image) -> None:
    first, second = posed(350, 250), posed(350 + shift[0], 250 + shift[1])
    reference = ReferenceView(ViewLevels(view_of(wide, first, SIZE, 1)))
    levels = ViewLevels(view_of(wide, second, SIZE, 2))
    found = align(reference, levels, np.eye(3), is_searched=True)
    truth = geometry.translation(*shift)
    assert corner_error(found.reference_from_view, truth, SIZE) < 0.2


def test_gain_and_a_gradient_of_light_do_no_harm(wide: Image) -> None:
    first, second = posed(350, 250), posed(390, 260, 2)
    reference = ReferenceView(ViewLevels(view_of(wide, first, SIZE, 1)))
    seen = view_of(wide, second, SIZE, 2).astype(np.float64)
    lit = np.clip(0.7 * seen + np.linspace(0, 50, SIZE[0]), 0, 255).astype(np.uint8)
    truth = geometry.normalized(geometry.inverted(first) @ second)
    found = align(reference, ViewLevels(lit), truth)
    assert corner_error(found.reference_from_view, truth, SIZE) < 0.2


@pytest.mark.parametrize("kind", ["noise", "other", "flat", "black"])
@pytest.mark.parametrize("is_searched", [False, True])
def test_another_view_is_refused(
    kind: str, is_searched: bool, wide: Image, make_picture: MakePicture
) -> None:
    reference = ReferenceView(ViewLevels(view_of(wide, posed(350, 250), SIZE)))
    images = {
        "noise": np.random.default_rng(5).integers(0, 256, (480, 640), np.uint8),
        "other": make_picture(32, SIZE),
        "flat": np.full((480, 640), 90, np.uint8),
        "black": np.zeros((480, 640), np.uint8),
    }
    levels = ViewLevels(images[kind])
    found = align(reference, levels, np.eye(3), is_searched=is_searched)
    assert found.verdict is not Verdict.OK and found.reference_from_view is None
    assert levels.is_flat() == (kind in ("flat", "black"))


def test_what_is_hidden_is_no_evidence(wide: Image) -> None:
    image = view_of(wide, posed(350, 250), SIZE)
    quad = geometry.box_quad(100, 100, 250, 200)
    everything = ReferenceView(ViewLevels(image))
    rest = ReferenceView(ViewLevels(image), [quad])
    found = align(rest, ViewLevels(image), np.eye(3))
    for points in (
        found.reference_points,
        align(everything, ViewLevels(image), np.eye(3), [quad]).view_points,
    ):
        inside = np.all((points > quad[0] + 30) & (points < quad[2] - 30), axis=1)
        assert not inside.any()
    assert rest.textured_cells < everything.textured_cells


@pytest.mark.parametrize("guess", [np.diag([-1.0, 1, 1]), np.zeros((3, 3)), np.diag([1e-3, 1, 1])])
def test_a_senseless_guess_is_refused(guess: Matrix, wide: Image) -> None:
    reference = ReferenceView(ViewLevels(view_of(wide, posed(350, 250), SIZE)))
    assert align(reference, reference.levels, guess).verdict is not Verdict.OK


@pytest.mark.parametrize(
    ("tilt_px", "most_px"),
    [
        (0.0, 0.1),  # a similarity: what moves by itself must not tilt it
        (2.0, 0.7),  # a tilt: a similarity keeps the cells, but not how well they correlate
        (4.0, 1.2),
    ],
)
def test_a_view_half_of_which_moved_is_a_similarity_only_if_that_explains_it_as_well(
    tilt_px: float, most_px: float, wide: Image, make_picture: MakePicture
) -> None:
    corners = geometry.image_quad(SIZE)
    tilted = corners + tilt_px * np.array([[1, 0], [-1, 0], [1, 0], [-1, 0]], np.float32)
    first = posed(350, 250)
    second = posed(356, 254) @ cv2.getPerspectiveTransform(corners, tilted.astype(np.float32))
    moved_rows = 202 if tilt_px else 240
    image = view_of(wide, second, SIZE, 2)
    image[:moved_rows] = make_picture(77, SIZE)[:moved_rows]
    reference = ReferenceView(ViewLevels(view_of(wide, first, SIZE, 1)))
    found = align(reference, ViewLevels(image), posed(6, 4))
    assert found.inliers < 0.6 * len(found.is_inlier)
    assert found.reference_from_view is not None
    still = geometry.box_quad(0, moved_rows, 639, 479 - moved_rows)
    truth = geometry.inverted(first) @ second
    off = geometry.transform_points(found.reference_from_view, still)
    assert np.abs(off - geometry.transform_points(truth, still)).max() < most_px


def test_texture_as_strong_everywhere_is_more_than_opencv_takes_at_once() -> None:
    """All pixels of a chessboard's edges are as strong as the last that is chosen."""
    y, x = np.mgrid[0:768, 0:1024]
    board = ViewLevels((((x // 8 + y // 8) % 2) * 100 + 60).astype(np.uint8))
    found = align_exactly(ReferenceView(board), board, np.eye(3))
    assert found.reference_from_view is not None
    assert corner_error(found.reference_from_view, np.eye(3), board.size_wh) < 1e-3
