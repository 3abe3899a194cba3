"""The synthetic scenes: the truth must agree with the pixels, and the scenes do what they claim."""

from __future__ import annotations

import csv
import math
import tracemalloc
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from streamtrack import geometry
from streamtrack.errors import OutputError, UsageError
from streamtrack.sources.base import FrameSource
from streamtrack.sources.scenes.catalogue import SCENES
from streamtrack.sources.scenes.motion import stream
from streamtrack.sources.scenes.scene import covered
from streamtrack.sources.synthetic import SyntheticSource
from streamtrack.synth import HEADER, write_synthetic
from streamtrack.types import Matrix

CLEAN = "noise=0&blur=0&light=0&occluders=0"
SMALL = "size=320x240"


def source_of(scene: str, query: str = "") -> SyntheticSource:
    return SyntheticSource(f"synthetic://{scene}?{query}")


def quads_of(source: SyntheticSource) -> npt.NDArray[np.float64]:
    return np.array([source.truth(n).quad for n in range(len(source))], np.float64)


def waves(x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Grey value of the test photo at any point of its plane: smooth, known exactly."""
    value: npt.NDArray[np.float64] = (
        128 + 45 * np.sin(x / 13.0 + 0.4 * np.sin(y / 90.0)) + 45 * np.sin(y / 15.0 + x / 70.0)
    )
    return value


@pytest.fixture(scope="module")
def photo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A picture of 800x600 smooth waves."""
    path = tmp_path_factory.mktemp("photo") / "smooth waves.png"
    y, x = np.mgrid[:600, :800].astype(np.float64)
    cv2.imwrite(str(path), np.rint(waves(x, y)).astype(np.uint8))
    return path


def misses(source: SyntheticSource, index: int) -> npt.NDArray[np.float64]:
    """How far, in px (N, 2), patches of the target are from where the truth puts them.

    The pixels are compared with the exact values at the points of the photo that they show.
    """
    assert source.scene.target is not None
    width, height = source.scene.target.size_wh
    texture_from_photo = geometry.scaling(width / 800, height / 600)
    photo_from_frame = geometry.inverted(source.truth(index).frame_from_target @ texture_from_photo)
    grey = geometry.grey_of(source.frame(index).image).astype(np.float64)
    y, x = np.mgrid[: grey.shape[0], : grey.shape[1]].astype(np.float64)
    depth = photo_from_frame[2, 0] * x + photo_from_frame[2, 1] * y + 1.0
    px = (photo_from_frame[0, 0] * x + photo_from_frame[0, 1] * y + photo_from_frame[0, 2]) / depth
    py = (photo_from_frame[1, 0] * x + photo_from_frame[1, 1] * y + photo_from_frame[1, 2]) / depth
    inside = (px > 16) & (px < 783) & (py > 16) & (py < 583) & (depth > 0)
    exact = waves(px, py)
    slope_y, slope_x = np.asarray(np.gradient(exact))
    found = []
    for top in range(0, grey.shape[0] - 32, 32):
        for left in range(0, grey.shape[1] - 32, 32):
            cut = np.s_[top : top + 32, left : left + 32]
            if inside[cut].all():
                columns = [-slope_x[cut].ravel(), -slope_y[cut].ravel(), np.ones(1024)]
                fit = np.column_stack([*columns, exact[cut].ravel() - 128])
                found.append((np.linalg.pinv(fit) @ (grey - exact)[cut].ravel())[:2])
    return np.array(found).reshape(-1, 2)


@pytest.mark.parametrize(
    ("scene", "indices"),
    [
        ("board", (0, 30, 71)),
        ("rotation", (17, 40)),
        ("perspective", (20, 140)),
        ("scale", (40, 80, 110, 130, 150)),
        ("large", (0, 33)),
        ("outofview", (30,)),
    ],
)
def test_truth_agrees_with_pixels(photo: Path, scene: str, indices: tuple[int, ...]) -> None:
    source = source_of(scene, f"seed=3&{CLEAN}&image={photo}")
    for index in indices:
        away = misses(source, index)
        assert len(away) >= 1
        assert np.abs(away.mean(axis=0)).max() < 0.01
        assert np.abs(away).max() < 0.06


@pytest.mark.parametrize("camera", ["fixed", "moving"])
def test_a_photo_is_the_ground_of_traffic_for_ever(photo: Path, camera: str) -> None:
    plain, own = (
        source_of("traffic", f"seed=3&frames=120&camera={camera}&{CLEAN}{image}")
        for image in ("", f"&image={photo}")
    )
    for index in (0, 119):
        thing = own.things(index)[0]
        assert np.array_equal(thing.quad, plain.things(index)[0].quad)
        picture = own.frame(index).image
        assert np.abs(np.diff(picture.astype(int), axis=1)).mean() > 0.5  # no border drawn out
        assert not np.array_equal(picture, plain.frame(index).image)


def test_truth_is_the_middle_of_the_exposure(photo: Path) -> None:
    source = source_of("board", f"noise=0&blur=0.5&image={photo}")
    for index in (30, 71):
        assert np.abs(misses(source, index).mean(axis=0)).max() < 0.01


def refined(source: SyntheticSource, a: int, b: int) -> npt.NDArray[np.float64]:
    """How far ECC moves the middle of frame b away from where the truth puts it in frame a."""
    grey_a, grey_b = (geometry.grey_of(source.frame(n).image) for n in (a, b))
    a_from_b = (
        geometry.inverted(source.truth(a).world_from_frame) @ source.truth(b).world_from_frame
    )
    warped = cv2.warpPerspective(grey_b, a_from_b, source.info.size_wh)
    mask = cv2.warpPerspective(np.full_like(grey_b, 255), a_from_b, source.info.size_wh)
    if source.scene.target is not None:
        for index, world in ((a, np.eye(3)), (b, a_from_b)):
            quad = geometry.transform_points(world, source.truth(index).quad)
            cv2.fillConvexPoly(mask, np.rint(quad).astype(np.int32), (0,))
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 1e-6)
    mask = cv2.erode(mask, np.ones((31, 31), np.uint8))
    start = np.eye(2, 3, dtype=np.float32)
    score, found = cv2.findTransformECC(
        grey_a, warped, start, cv2.MOTION_TRANSLATION, stop, mask, 5
    )
    assert score > 0.9
    moved: npt.NDArray[np.float64] = found[:, 2].astype(np.float64)
    return moved


@pytest.mark.parametrize("seed", [1, 2])
def test_flight_truth_agrees_with_pixels_and_closes(seed: int) -> None:
    source = source_of("flight", f"seed={seed}&frames=40&noise=0")
    for a, b in ((0, 3), (15, 19), (0, 39)):
        assert np.abs(refined(source, a, b)).max() < 0.05
    end = source.truth(39).world_from_frame
    middle = geometry.transform_points(end, [[319.5, 239.5]])[0]
    assert np.hypot(*(middle - (319.5, 239.5))) < 0.1


def test_same_uri_same_bytes_in_any_order() -> None:
    query = f"seed=5&frames=12&{SMALL}"
    one, two = source_of("unconstrained", query), source_of("unconstrained", query)
    in_order = [frame.image for frame in one]
    assert len(in_order) == 12
    for index in (11, 3, 7):
        assert np.array_equal(two.frame(index).image, in_order[index])
    other = source_of("unconstrained", f"seed=6&{SMALL}")
    assert not np.array_equal(other.frame(0).image, in_order[0])


def test_is_a_frame_source_and_yields_once() -> None:
    with source_of("static", f"frames=3&fps=30000/1001&{SMALL}") as source:
        assert isinstance(source, FrameSource)
        info = source.info
        assert (info.size_wh, info.frame_count, info.is_live) == ((320, 240), 3, False)
        assert info.rate_hz == 30000 / 1001
        assert info.name == "synthetic-static"
        frames = list(source)
        assert [frame.index for frame in frames] == [0, 1, 2]
        assert frames[2].time_s == float(Fraction(2 * 1001, 30000))
        assert list(source) == []
        assert (source.skipped, source.corrupt_packets) == ((), 0)
    with pytest.raises(IndexError):
        source.frame(3)


@pytest.mark.parametrize("scene", SCENES)
def test_frame_0_shows_the_whole_target(scene: str) -> None:
    frames = "frames=30" if scene == "flight" else ""
    source = source_of(scene, f"seed=2&{SMALL}&{frames}")
    truth = source.truth(0)
    assert truth.visible_share == pytest.approx(1.0, abs=1e-6)
    assert np.array_equal(source.initial_quad, truth.quad)
    assert np.allclose(truth.world_from_frame, np.eye(3), atol=1e-9)
    top = truth.quad[1] - truth.quad[0]
    assert abs(math.degrees(math.atan2(top[1], top[0]))) < 5
    x0, y0, x1, y1 = geometry.bounding_box(truth.quad)
    assert x0 >= -0.5 and y0 >= -0.5 and x1 <= 319.5 and y1 <= 239.5
    image = source.frame(0).image
    assert image.shape == (240, 320, 3)
    assert geometry.grey_of(image)[int(y0) + 1 : int(y1), int(x0) + 1 : int(x1)].std() > 2.5


def test_noise_is_what_was_asked_for() -> None:
    quiet = source_of("static", f"noise=0&{SMALL}")
    noisy = source_of("static", f"{SMALL}")
    assert np.array_equal(quiet.frame(0).image, quiet.frame(7).image)
    change = noisy.frame(4).image.astype(float) - noisy.frame(9).image
    clear = (quiet.frame(0).image > 12) & (quiet.frame(0).image < 243)
    assert change[clear].std() == pytest.approx(3.0 * math.sqrt(2), rel=0.03)
    assert noisy.scene.noise == 3.0


def shares(source: SyntheticSource, step: int = 1) -> npt.NDArray[np.float64]:
    frames = range(0, len(source), step)
    return np.array([source.scene.visible_share(n) for n in frames])


@pytest.mark.parametrize(("scene", "indices"), [("occlusion", (62, 75)), ("outofview", (50, 60))])
def test_visible_share_counts_pixels(scene: str, indices: tuple[int, ...]) -> None:
    source = source_of(scene, "seed=4")
    for index in indices:
        truth = source.truth(index)
        canvas = np.zeros((480 + 1600, 640 + 1600), np.uint8)
        cv2.fillConvexPoly(canvas, np.rint((truth.quad + 800) * 16).astype(np.int32), 255, 8, 4)
        whole = np.count_nonzero(canvas)
        y, x = np.nonzero(canvas[800:1280, 800:1440])
        points = np.column_stack([x, y]).astype(np.float32)
        hidden = covered(source.scene.occluders, points, index)
        assert 0.1 < truth.visible_share < 0.95
        assert truth.visible_share == pytest.approx(np.count_nonzero(~hidden) / whole, abs=0.02)


def side_scales(source: SyntheticSource) -> npt.NDArray[np.float64]:
    quads = quads_of(source)
    areas = np.array([geometry.signed_area(quad) for quad in quads])
    result: npt.NDArray[np.float64] = np.sqrt(areas / areas[0])
    return result


def test_scale_reaches_both_ends() -> None:
    scales = side_scales(source_of("scale", SMALL))
    assert scales.min() < 0.32 and 1.8 < scales.max() < 2.3


def test_rotation_makes_full_turns() -> None:
    quads = quads_of(source_of("rotation", SMALL))
    top = quads[:, 1] - quads[:, 0]
    angle = np.degrees(np.unwrap(np.arctan2(top[:, 1], top[:, 0])))
    assert abs(angle[-1] - angle[0]) > 700


def lean_of(matrix: Matrix, size_wh: tuple[int, int]) -> float:
    """Tilt in degrees of the plane behind frame_from_target."""
    focal = 1.2 * max(size_wh)
    middle = (size_wh[0] - 1) / 2, (size_wh[1] - 1) / 2
    camera = np.array([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1]])
    axes = np.linalg.inv(camera) @ matrix
    normal = np.cross(axes[:, 0], axes[:, 1])
    return math.degrees(math.acos(abs(normal[2]) / np.linalg.norm(normal)))


def test_perspective_tilts_by_60_degrees() -> None:
    source = source_of("perspective", SMALL)
    leans = [lean_of(source.truth(n).frame_from_target, (320, 240)) for n in range(300)]
    assert leans[0] < 0.01
    assert 58 < max(leans) < 61


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_blur_peaks_at_20_to_35_px(seed: int) -> None:
    source = source_of("blur", f"seed={seed}")
    motion = np.linalg.norm(np.gradient(quads_of(source), axis=0), axis=2).max(axis=1)
    streak = motion * source.scene.exposure
    assert 20 < streak.max() < 37
    assert streak[0] < 2
    assert np.median(streak) > 8


def test_blur_darkens_nothing_and_smears() -> None:
    sharp = geometry.grey_of(source_of("blur", "blur=0&noise=0").frame(45).image)
    smeared = geometry.grey_of(source_of("blur", "noise=0").frame(45).image)
    assert smeared.mean() == pytest.approx(sharp.mean(), abs=1.5)
    assert cv2.Laplacian(smeared, cv2.CV_32F).std() < cv2.Laplacian(sharp, cv2.CV_32F).std()


@pytest.mark.parametrize("seed", [1, 2])
def test_scenes_hide_the_target_as_they_claim(seed: int) -> None:
    query = f"seed={seed}&{SMALL}&frames=200"
    occlusion = shares(source_of("occlusion", query), 4)
    assert 0.33 < occlusion.min() < 0.5
    assert shares(source_of("outofview", query), 4).min() < 0.5
    full = 2 * np.count_nonzero(shares(source_of("fullocclusion", query), 2) == 0.0)
    assert 12 <= full <= 40
    unconstrained = shares(source_of("unconstrained", query), 4)
    assert 0.2 < unconstrained.min() < 0.75


def test_absence_ends_elsewhere_and_turned() -> None:
    source = source_of("absence", SMALL)
    away = np.flatnonzero(shares(source) == 0)
    assert len(away) > 20
    before, after = source.truth(0).quad, source.truth(150).quad
    angles = [math.degrees(math.atan2(*(q[1] - q[0])[::-1])) for q in (before, after)]
    assert 45 < angles[1] - angles[0] < 75
    assert np.linalg.norm(before.mean(axis=0) - after.mean(axis=0)) > 4


def test_fast_small_large_and_static_are_so() -> None:
    fast = quads_of(source_of("fast", "frames=120")).mean(axis=1)
    step = np.linalg.norm(np.diff(fast[40:], axis=0), axis=1)
    assert 36 < np.median(step) < 44
    small = source_of("small").initial_quad
    assert 36 < np.ptp(small[:, 0]) <= 41 or 36 < np.ptp(small[:, 1]) <= 41
    large = source_of("large").initial_quad
    assert max(np.ptp(large[:, 0]) / 640, np.ptp(large[:, 1]) / 480) > 0.95
    still = quads_of(source_of("static", f"{SMALL}&frames=9"))
    assert np.array_equal(still[0], still[-1])


def test_car_moves_in_the_world_and_so_does_the_camera() -> None:
    source = source_of("car", SMALL)
    places = []
    for n in range(0, 300, 10):
        truth = source.truth(n)
        assert truth.visible_share > 0.6
        places.append(geometry.transform_points(truth.world_from_frame, truth.quad).mean(axis=0))
    assert np.linalg.norm(places[-1] - places[0]) > 800
    late = source_of("car", f"{SMALL}&frames=20000")
    assert late.frame(19_999).image.std() > 10
    assert late.truth(19_999).visible_share > 0.6


def test_car_truth_agrees_with_pixels() -> None:
    source = source_of("car", "noise=0")
    assert np.abs(refined(source, 60, 64)).max() < 0.05


def test_light_changes_and_can_be_put_out() -> None:
    lit = source_of("light", f"{SMALL}&noise=0")
    means = [lit.frame(n).image.mean() for n in range(0, 120, 12)]
    assert max(means) - min(means) > 25
    even = source_of("light", f"{SMALL}&noise=0&light=0")
    assert abs(even.frame(40).image.mean() - even.frame(60).image.mean()) < 4


def test_flight_keeps_its_step_and_ends_at_home() -> None:
    source = source_of("flight", f"{SMALL}&frames=60&step=20")
    centres = np.array(
        [
            geometry.transform_points(source.truth(n).world_from_frame, [[159.5, 119.5]])[0]
            for n in range(60)
        ]
    )
    steps = np.linalg.norm(np.diff(centres[30:], axis=0), axis=1)
    assert np.median(steps) == pytest.approx(20, rel=0.1)
    assert np.hypot(*(centres[-1] - centres[0])) < 0.1


def test_memory_stays_flat() -> None:
    source = source_of("unconstrained", f"{SMALL}&frames=20000")
    source.frame(100)
    tracemalloc.start()
    for index in range(0, 20_000, 2000):
        source.truth(index)
        source.frame(index)
    grown, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert grown < 1_000_000


@pytest.mark.parametrize(
    ("uri", "words"),
    [
        ("synthetic://baord", "did you mean board"),
        ("synthetic://", "unknown scene"),
        ("video.mp4", "synthetic://SCENE"),
        ("synthetic://board?sed=1", "did you mean seed"),
        ("synthetic://board?seed=1&seed=2", "twice"),
        ("synthetic://board?seed=x", "seed=x"),
        ("synthetic://board?seed=-1", "seed=-1"),
        ("synthetic://board?seed=--", "whole number"),
        ("synthetic://board?frames=0", "frames=0"),
        ("synthetic://board?frames=-3", "frames=-3"),
        ("synthetic://board?size=0x480", "size=0x480"),
        ("synthetic://board?size=640", "WIDTHxHEIGHT"),
        ("synthetic://board?fps=nan", "fps=nan"),
        ("synthetic://board?fps=0", "fps=0"),
        ("synthetic://board?fps=1/0", "fps=1/0"),
        ("synthetic://board?noise=nan", "noise=nan"),
        ("synthetic://board?blur=1.5", "from 0 to 1"),
        ("synthetic://board?occluders=99", "occluders=99"),
        ("synthetic://board?image=nowhere.png", "no such file"),
        ("synthetic://board?texture=mop", "did you mean map"),
        ("synthetic://board?step=3", "flight"),
        ("synthetic://car?texture=map", "car"),
    ],
)
def test_bad_uris_are_refused_in_one_line(uri: str, words: str) -> None:
    with pytest.raises(UsageError) as caught:
        SyntheticSource(uri)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_no_picture_is_refused(tmp_path: Path) -> None:
    for data in (b"", b"no picture"):
        (tmp_path / "photo.png").write_bytes(data)
        with pytest.raises(UsageError, match="no picture"):
            source_of("scale", f"image={tmp_path / 'photo.png'}")


def test_streams_differ_by_purpose() -> None:
    assert stream(1, "a").random() == stream(1, "a").random() != stream(1, "b").random()


def test_synth_writes_pictures_and_truth(tmp_path: Path) -> None:
    uri = f"synthetic://car?frames=4&{SMALL}"
    assert write_synthetic(uri, tmp_path / "frames", tmp_path / "truth.csv") == 4
    source = SyntheticSource(uri)
    with (tmp_path / "truth.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == HEADER
    assert [row["frame"] for row in rows] == ["0", "1", "2", "3"]
    pictures = sorted((tmp_path / "frames").iterdir())
    for n, (path, row) in enumerate(zip(pictures, rows, strict=True)):
        assert np.array_equal(np.array(cv2.imread(str(path)), np.uint8), source.frame(n).image)
        quad = [float(row[f"{axis}{k}"]) for k in (1, 2, 3, 4) for axis in "xy"]
        assert quad == source.truth(n).quad.ravel().tolist()
        matrix = [float(row[f"h{i}{j}"]) for i in (1, 2, 3) for j in (1, 2, 3)]
        assert matrix == source.truth(n).world_from_frame.ravel().tolist()


def test_synth_writes_lossless_video(tmp_path: Path) -> None:
    uri = f"synthetic://static?frames=3&{SMALL}"
    write_synthetic(uri, tmp_path / "clip.mkv")
    video = cv2.VideoCapture(str(tmp_path / "clip.mkv"))
    image = np.array(video.read()[1], np.uint8)
    video.release()
    assert np.array_equal(image, SyntheticSource(uri).frame(0).image)


def test_synth_says_what_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    uri = "synthetic://small?frames=1&size=96x96"
    with pytest.raises(OutputError):
        write_synthetic(uri, tmp_path / "file" / "frames")
    with pytest.raises(OutputError):
        write_synthetic(uri, tmp_path / "frames", tmp_path / "file" / "truth.csv")


@pytest.mark.parametrize("camera", ["fixed", "moving"])
def test_traffic_tells_where_everything_is(camera: str) -> None:
    source = source_of("traffic", f"seed=5&size=320x180&frames=60&cars=10&camera={camera}")
    first, later = source.things(0), source.things(40)
    assert len({thing.number for thing in later}) == len(later) >= 2
    assert first[0].number == 0 and first[0].visible_share == pytest.approx(1.0, abs=1e-6)
    np.testing.assert_allclose(first[0].quad, source.truth(0).quad, atol=1e-4)
    is_moving = not np.allclose(source.truth(40).world_from_frame, np.eye(3), atol=1e-6)
    assert is_moving == (camera == "moving")


def test_a_footbridge_hides_what_passes_below() -> None:
    source = source_of("traffic", "seed=5&size=320x180&frames=120&cars=12&occluders=1")
    shares = [thing.visible_share for index in range(0, 120, 6) for thing in source.things(index)]
    assert any(0.02 < share < 0.8 for share in shares)


@pytest.mark.parametrize("query", ["cars=0", "cars=x", "camera=drone", "camera=auto"])
def test_bad_parameters_of_traffic(query: str) -> None:
    with pytest.raises(UsageError):
        source_of("traffic", query)


def test_cars_belong_to_traffic() -> None:
    with pytest.raises(UsageError, match="traffic"):
        source_of("board", "cars=3")
