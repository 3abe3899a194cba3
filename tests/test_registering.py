"""Registration of two pictures: exact where they share something, a refusal where they do not."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from conftest import MakePicture

from streamtrack import geometry
from streamtrack.errors import UsageError
from streamtrack.evaluation import corner_error, visible_error
from streamtrack.features import no_features
from streamtrack.fitting import transfer_errors
from streamtrack.mosaic.pairs import direct
from streamtrack.mosaic.pairs.agreement import Agreement, measure_agreement
from streamtrack.mosaic.pairs.first_estimate import estimate, estimate_by_zoom
from streamtrack.mosaic.pairs.link_gate import judge_link, overlap_in
from streamtrack.mosaic.pairs.registering import PictureRegistrar
from streamtrack.mosaic.pairs.subpixel import render_overlap, tracked_corners
from streamtrack.mosaic.types import Link
from streamtrack.pyramid import Pyramid
from streamtrack.settings import Settings, build_settings
from streamtrack.types import Image, Matrix, Model, Size, Verdict

SIZE: Size = (400, 300)
SCENE: Size = (1000, 800)


@pytest.fixture(scope="module")
def registrar() -> PictureRegistrar:
    return PictureRegistrar(Settings())


def view(scene: Image, view_from_scene: Matrix, size_wh: Size = SIZE) -> Image:
    """What a picture shows of the scene, each pixel the mean of 16 samples."""
    fine = np.diag([4.0, 4.0, 1.0])
    fine[:2, 2] = 1.5
    big = cv2.warpPerspective(
        scene, fine @ view_from_scene, (4 * size_wh[0], 4 * size_wh[1]), flags=cv2.INTER_CUBIC
    )
    return np.asarray(cv2.resize(big, size_wh, interpolation=cv2.INTER_AREA), np.uint8)


def similarity(scale: float, degrees: float, x: float, y: float) -> Matrix:
    """Zoom and turn about the middle of a picture, then shift."""
    turn = cv2.getRotationMatrix2D((SIZE[0] / 2, SIZE[1] / 2), degrees, scale)
    turn[:, 2] += (x, y)
    return np.vstack([turn, [0, 0, 1]])


FIRST = geometry.translation(-300.3, -250.4)
BENT = np.array([[1.02, 0.05, 12.0], [-0.04, 0.97, 20.0], [4e-4, -3e-4, 1.0]])
MAPPINGS = {
    "identity": np.eye(3),
    "shift": geometry.translation(150.6, -40.3),
    "rotation": similarity(1.0, 137.0, 10.0, 5.0),
    "zoom in": similarity(2.2, 30.0, 0.0, 10.0),
    "zoom out": similarity(0.45, -60.0, 20.0, 0.0),
    "perspective": BENT,
}


def pair_of(scene: Image, b_from_a: Matrix) -> tuple[Image, Image]:
    return view(scene, FIRST), view(scene, b_from_a @ FIRST)


def linked(registrar: PictureRegistrar, a: Image, b: Image) -> Link:
    return registrar.link(registrar.picture(3, "a", a), registrar.picture(7, "b", b))


# -- what is right ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", MAPPINGS)
def test_link_is_exact_to_a_fraction_of_a_pixel(
    name: str, registrar: PictureRegistrar, make_picture: MakePicture
) -> None:
    truth = MAPPINGS[name]
    link = linked(registrar, *pair_of(make_picture(1, SCENE), truth))
    assert link.verdict is Verdict.OK
    assert corner_error(link.b_from_a, truth, SIZE) < 0.15
    assert (link.a, link.b) == (3, 7)
    assert link.overlap_ncc > 0.9
    assert 0 <= link.rmse_px < 0.6
    assert len(link.a_points) == len(link.b_points) == len(link.registration.is_inlier)
    inliers = link.registration.is_inlier
    assert link.b_from_a is not None
    errors = transfer_errors(truth, link.a_points[inliers], link.b_points[inliers])
    assert np.median(errors) < 0.25


def test_light_blur_and_noise_cost_little(
    registrar: PictureRegistrar, make_picture: MakePicture, rng: np.random.Generator
) -> None:
    a, b = pair_of(make_picture(2, SCENE), BENT)
    dark = cv2.GaussianBlur(b, (0, 0), 1.5) * np.linspace(0.4, 0.8, SIZE[0]) + 20
    b = np.rint(dark + rng.normal(0, 4, dark.shape)).clip(0, 255).astype(np.uint8)
    link = linked(registrar, a, b)
    assert corner_error(link.b_from_a, BENT, SIZE) < 0.5


def test_grey_and_colour_and_size_may_differ(
    registrar: PictureRegistrar, make_picture: MakePicture
) -> None:
    scene = make_picture(3, SCENE)
    truth = geometry.translation(60.5, 30.25)
    a = cv2.cvtColor(view(scene, FIRST), cv2.COLOR_GRAY2BGR)
    b = view(scene, truth @ FIRST, (520, 240))
    link = linked(registrar, np.asarray(a, np.uint8), b)
    assert corner_error(link.b_from_a, truth, SIZE) < 0.15


def test_big_pictures_are_searched_small_and_registered_in_full(
    registrar: PictureRegistrar, make_picture: MakePicture
) -> None:
    scene = make_picture(4, (1100, 900))
    big = cv2.resize(scene, None, fx=1.5, fy=1.5, interpolation=cv2.INTER_CUBIC)
    truth = geometry.translation(-310.0, -200.0)
    a, b = np.ascontiguousarray(big[:1000, :1200]), np.ascontiguousarray(big[200:1200, 310:1510])
    picture = registrar.picture(0, "a", a)
    assert picture.size_wh == (1200, 1000)
    assert np.ptp(picture.features.points[:, 0]) > 1000
    link = registrar.link(picture, registrar.picture(1, "b", b))
    assert corner_error(link.b_from_a, truth, picture.size_wh) < 0.2


def test_the_other_way_round_is_the_inverse(
    registrar: PictureRegistrar, make_picture: MakePicture
) -> None:
    a, b = pair_of(make_picture(5, SCENE), MAPPINGS["zoom in"])
    there, back = linked(registrar, a, b).b_from_a, linked(registrar, b, a).b_from_a
    assert there is not None and back is not None
    assert corner_error(back @ there, np.eye(3), SIZE) < 0.2


@pytest.mark.parametrize("model", ["translation", "similarity", "affine", "homography"])
def test_a_model_that_is_asked_for_is_the_one_given(model: str, make_picture: MakePicture) -> None:
    registrar = PictureRegistrar(build_settings({"registration": {"model": model}}))
    truth = MAPPINGS["shift"]
    link = linked(registrar, *pair_of(make_picture(6, SCENE), truth))
    assert link.model == model and link.b_from_a is not None
    assert corner_error(link.b_from_a, truth, SIZE) < 0.3
    assert model == "homography" or np.allclose(link.b_from_a[2], [0, 0, 1], atol=1e-7)


def test_same_input_same_output(registrar: PictureRegistrar, make_picture: MakePicture) -> None:
    a, b = pair_of(make_picture(7, SCENE), BENT)
    first, second = linked(registrar, a, b), linked(PictureRegistrar(Settings()), a, b)
    np.testing.assert_array_equal(first.b_from_a, second.b_from_a)
    np.testing.assert_array_equal(first.a_points, second.a_points)


@pytest.mark.parametrize(("detector", "descriptor"), [("fast", "brisk"), ("orb", "orb")])
def test_any_features_lead_to_the_same_place(
    detector: str, descriptor: str, make_picture: MakePicture
) -> None:
    features = {"detector": detector, "descriptor": descriptor}
    registrar = PictureRegistrar(build_settings({"features": features}))
    link = linked(registrar, *pair_of(make_picture(8, SCENE), BENT))
    assert corner_error(link.b_from_a, BENT, SIZE) < 0.15


def test_a_large_zoom_is_found_at_the_second_look(make_picture: MakePicture) -> None:
    """Few keypoints of a picture have a partner in one that shows 1/7 of it, 2.6 times as large."""
    settings = build_settings({"features": {"max_features": 400}})
    registrar = PictureRegistrar(settings)
    found = []
    for seed in range(10, 14):
        scene, truth = make_picture(seed, SCENE), similarity(2.6, 20.0, 0.0, 0.0)
        a, b = (registrar.picture(i, "", p).features for i, p in enumerate(pair_of(scene, truth)))
        area = float(SIZE[0] * SIZE[1])
        first = estimate(a, b, area, settings)
        second = estimate_by_zoom(a, b, area, settings)
        for looked in (first, second):
            if looked.b_from_a is not None:
                assert visible_error(looked.b_from_a, truth, SIZE, SIZE) < 10
        found.append((int(first.is_inlier.sum()), int(second.is_inlier.sum())))
    assert sum(second for _, second in found) > sum(first for first, _ in found)


# -- what is refused ----------------------------------------------------------------------------


def noise(seed: int) -> Image:
    return np.random.default_rng(seed).integers(0, 256, (300, 400), np.uint8)


def tiled(shift: int) -> Image:
    """A pattern that repeats every 80 px, from another place, with a little noise of its own."""
    rng = np.random.default_rng(5)
    grain = rng.integers(0, 256, (40, 40), np.uint8)
    one = cv2.GaussianBlur(cv2.resize(grain, (80, 80)), (0, 0), 1.2)
    whole = np.tile(one, (5, 12))[:300, shift : shift + 400]
    own = np.random.default_rng(shift).normal(0, 3, whole.shape)
    return np.rint(whole + own).clip(0, 255).astype(np.uint8)


def blank() -> Image:
    return np.full((300, 400), 128, np.uint8)


def tiny() -> Image:
    return np.full((1, 1, 3), 7, np.uint8)


@pytest.mark.parametrize(
    ("a", "b"),
    [
        (noise(1), noise(2)),
        (blank(), blank()),
        (blank(), noise(1)),
        (tiny(), noise(1)),
        (noise(1), tiny()),
        (tiny(), tiny()),
        (noise(1), noise(1)[:10]),
        (tiled(0), tiled(240)),
        (tiled(0), tiled(430)),
    ],
)
def test_nothing_in_common_is_refused_with_a_reason(
    a: Image, b: Image, registrar: PictureRegistrar
) -> None:
    link = linked(registrar, a, b)
    assert link.verdict is not Verdict.OK
    assert link.b_from_a is None and link.model is None
    assert np.isnan(link.rmse_px)
    assert len(link.a_points) == len(link.b_points) == len(link.registration.is_inlier)


def test_repeated_texture_is_told_by_name(registrar: PictureRegistrar) -> None:
    assert linked(registrar, tiled(0), tiled(240)).verdict in (
        Verdict.AMBIGUOUS,
        Verdict.TOO_FEW_INLIERS,
        Verdict.TOO_FEW_MATCHES,
    )


def test_pictures_of_different_places_are_refused(
    registrar: PictureRegistrar, make_picture: MakePicture
) -> None:
    pictures = [
        registrar.picture(n, "", view(make_picture(n, SCENE), FIRST)) for n in range(20, 25)
    ]
    for n, a in enumerate(pictures):
        for b in pictures[n + 1 :]:
            assert registrar.link(a, b).verdict is not Verdict.OK
            assert registrar.link(a, b, is_thorough=False).verdict is not Verdict.OK


def test_features_that_do_not_fit_are_refused_at_once() -> None:
    with pytest.raises(UsageError, match="does not fit"):
        PictureRegistrar(build_settings({"features": {"detector": "sift", "descriptor": "orb"}}))


# -- the parts ----------------------------------------------------------------------------------


def test_corners_are_followed_under_zoom_and_turn(make_picture: MakePicture) -> None:
    truth = MAPPINGS["zoom in"]
    a, b = pair_of(make_picture(30, SCENE), truth)
    rough = geometry.translation(3.0, -2.0) @ truth
    overlap = render_overlap(Pyramid(a), Pyramid(b), rough)
    assert overlap is not None
    ours, theirs = tracked_corners(overlap, 2)
    assert len(ours) > 30
    near = geometry.transform_points(overlap.near_from_grid, ours)
    far = geometry.transform_points(overlap.far_from_grid, theirs)
    assert np.median(transfer_errors(truth, near, far)) < 0.3


@pytest.mark.parametrize("beside", [geometry.translation(900, 0), geometry.translation(0, -299)])
def test_no_overlap_is_none(beside: Matrix) -> None:
    assert render_overlap(Pyramid(noise(1)), Pyramid(noise(2)), beside) is None


@pytest.mark.parametrize("model", list(Model))
def test_direct_alignment_is_exact_in_every_model(model: Model, make_picture: MakePicture) -> None:
    truth = geometry.translation(0.63, -0.41)
    a, b = pair_of(make_picture(31, SCENE), truth)
    found = direct.align(a, b, np.full(a.shape, 255, np.uint8), np.eye(3), model)
    assert found is not None
    assert corner_error(found.far_from_near, truth, SIZE) < 0.05
    assert found.corner_sigma_px < 0.1 and found.pixels > 1000


def test_direct_alignment_needs_something_to_go_by() -> None:
    covered = np.full((300, 400), 255, np.uint8)
    assert direct.align(blank(), blank(), covered, np.eye(3), Model.HOMOGRAPHY) is None
    nowhere = np.zeros_like(covered)
    assert direct.align(noise(1), noise(1), nowhere, np.eye(3), Model.HOMOGRAPHY) is None


def test_agreement_tells_right_from_wrong(make_picture: MakePicture) -> None:
    a, b = pair_of(make_picture(32, SCENE), BENT)
    right = render_overlap(Pyramid(a), Pyramid(b), BENT)
    wrong = render_overlap(Pyramid(a), Pyramid(b), geometry.translation(25, 18) @ BENT)
    assert right is not None and wrong is not None
    good, bad = measure_agreement(right), measure_agreement(wrong)
    assert good.alike > 0.95 and good.detail > 0.8 and good.tiles > 50
    assert bad.alike < 0.15 and bad.detail < 0.1


def gate(b_from_a: Matrix, points: int = 60, inliers: int = 60, spread: float = 1.0) -> Verdict:
    """The gate on points in the overlap, with pictures that agree."""
    rng = np.random.default_rng(1)
    middle, half = np.array(SIZE) / 2, np.array(SIZE) / 2 * spread
    a = rng.uniform(middle - half, middle + half, (points, 2)).astype(np.float32)
    b = geometry.transform_points(b_from_a, a)
    is_inlier = np.arange(points) < inliers
    agreement = Agreement(0.95, 200, 0.9, 0.9)
    return judge_link(b_from_a, Model.HOMOGRAPHY, SIZE, SIZE, (a, b), is_inlier, agreement)


@pytest.mark.parametrize(
    ("verdict", "asked"),
    [
        (Verdict.OK, gate(np.eye(3))),
        (Verdict.OK, gate(BENT)),
        (Verdict.TOO_FEW_INLIERS, gate(np.eye(3), inliers=8)),
        (Verdict.TOO_FEW_INLIERS, gate(np.eye(3), points=400, inliers=40)),
        (Verdict.NOT_SPREAD, gate(np.eye(3), spread=0.1)),
        (
            Verdict.MIRRORED,
            gate(np.diag([-1.0, 1.0, 1.0]) + geometry.translation(400, 0) - np.eye(3)),
        ),
        (Verdict.MIRRORED, gate(np.array([[1.0, 0, 0], [0, 1.0, 0], [-0.004, 0, 1.0]]))),
        (Verdict.PERSPECTIVE, gate(np.array([[1.0, 0, 0], [0, 1.0, 0], [-0.00245, 0, 1.0]]))),
        (Verdict.NOT_SPREAD, gate(geometry.translation(500, 0))),
    ],
)
def test_gate_names_its_reason(verdict: Verdict, asked: Verdict) -> None:
    assert asked is verdict


def test_overlap_box_is_what_both_show() -> None:
    box = overlap_in(geometry.translation(-100, 50), SIZE, SIZE)
    np.testing.assert_allclose(box, geometry.box_quad(100, 0, 299, 249), atol=1e-3)
    assert len(overlap_in(geometry.translation(1000, 0), SIZE, SIZE)) == 0


def test_no_features_no_estimate() -> None:
    nothing = no_features()
    for looked in (estimate, estimate_by_zoom):
        assert looked(nothing, nothing, 1e5, Settings()).verdict is not Verdict.OK
