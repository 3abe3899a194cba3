"""Mosaics of picture files from end to end, against exact truth, and with bad input."""

from __future__ import annotations

import csv
import json
import resource
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from test_mosaic_rotation import turned

from streamtrack import geometry
from streamtrack.errors import OutputError, SourceError, StreamtrackError, UsageError
from streamtrack.evaluation import corner_error
from streamtrack.mosaic.job import (
    MosaicJob,
    MosaicOutcome,
    MosaicOutputs,
    NoMosaicProgress,
)
from streamtrack.mosaic.pictures.rotation import camera_matrix
from streamtrack.mosaic.running import run_mosaic
from streamtrack.mosaic.types import Status
from streamtrack.settings import build_settings
from streamtrack.types import Image, Matrix, Size

SIZE: Size = (320, 240)
Make = Callable[..., MosaicOutcome]


def run(
    folder: Path,
    inputs: list[Path],
    *,
    output: str | None = "m.png",
    stop_after: int = 10**9,
    truth: Path | None = None,
    record: Path | None = None,
    **mosaic: object,
) -> MosaicOutcome:
    asked = iter(range(10**9))
    outputs = MosaicOutputs(
        None if output is None else folder / output,
        folder / "p.csv",
        folder / "s.json",
        record,
    )
    settings = build_settings({"mosaic": dict(mosaic)})
    job = MosaicJob(tuple(str(path) for path in inputs), settings, outputs, truth)
    return run_mosaic(job, NoMosaicProgress(), lambda: next(asked) >= stop_after)


@pytest.fixture(scope="module")
def ground() -> Image:
    """A coloured flat scene, 900 x 700, with detail at every scale."""
    from conftest import _picture

    channels = [_picture(seed, (900, 700)) for seed in (11, 12, 13)]
    luma = _picture(14, (900, 700)).astype(np.float32)
    mixed = np.dstack([0.25 * c.astype(np.float32) + 0.75 * luma for c in channels])
    return np.clip(mixed, 0, 255).astype(np.uint8)


def seen(ground: Image, ground_from_picture: Matrix, size: Size = SIZE) -> Image:
    """The picture that a camera over the ground takes."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpPerspective(ground, ground_from_picture, size, flags=flags), np.uint8)


def pose(x: float, y: float, degrees: float = 0.0, zoom: float = 1.0, tilt: float = 0.0) -> Matrix:
    """ground_from_picture: the picture's middle comes to lie at (x, y)."""
    angle = np.radians(degrees)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) * zoom
    matrix = np.eye(3)
    matrix[:2, :2] = turn
    matrix[2, 0] = tilt
    centred = geometry.translation(-(SIZE[0] - 1) / 2, -(SIZE[1] - 1) / 2)
    return geometry.translation(x, y) @ matrix @ centred


FLIGHT = [
    pose(220 + 150 * column, 180 + 130 * row, 7 * column - 4 * row, 1 + 0.04 * row, 1e-4 * column)
    for row in range(3)
    for column in range(3)
]


@pytest.fixture(scope="module")
def flight(ground: Image, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("flight")
    rng = np.random.default_rng(3)
    paths = []
    for i, place in enumerate(FLIGHT):
        noisy = seen(ground, place) * rng.uniform(0.9, 1.1) + rng.normal(0, 1.5, (240, 320, 3))
        paths.append(folder / f"p{i}.png")
        cv2.imwrite(str(paths[-1]), np.clip(noisy, 0, 255).astype(np.uint8))
    return paths


@pytest.fixture(scope="module")
def stranger(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A picture of something else."""
    from conftest import _picture

    path = tmp_path_factory.mktemp("stranger") / "stranger.png"
    cv2.imwrite(str(path), _picture(99, SIZE))
    return path


def corner_errors(outcome: MosaicOutcome, truth: list[Matrix], reference: int) -> list[float]:
    errors = []
    for image in outcome.summary.images:
        if image.world_from_picture is not None:
            true = np.linalg.inv(truth[reference]) @ truth[image.index]
            quad = geometry.image_quad(SIZE)
            apart = geometry.transform_points(image.world_from_picture, quad)
            apart = apart - geometry.transform_points(true, quad)
            errors.append(float(np.mean(np.linalg.norm(apart, axis=1))))
    return errors


# -- flat scenes --------------------------------------------------------------------------------


def test_copies_of_a_picture_change_nothing(ground: Image, tmp_path: Path) -> None:
    corners = geometry.image_quad(SIZE)
    tilted = corners + np.array([[0, 0], [-30, 20], [-10, -15], [0, 0]], np.float32)
    place = geometry.translation(260, 200) @ cv2.getPerspectiveTransform(corners, tilted)
    y, x = np.mgrid[: SIZE[1], : SIZE[0]].astype(np.float32)
    bent = x + 1.5 * np.sin(y / 30), y + 1.5 * np.sin(x / 40)  # no homography follows it
    pictures = seen(ground, geometry.translation(200, 200)), seen(ground, place)
    pictures = pictures[0], cv2.remap(pictures[1], *bent, cv2.INTER_CUBIC)
    paths = [tmp_path / f"{name}.png" for name in ("a1", "a2", "a3", "a4", "b")]
    for path in paths:
        cv2.imwrite(str(path), pictures[path.stem == "b"].astype(np.uint8))
    alone, together = run(tmp_path, [paths[0], paths[-1]]), run(tmp_path, paths)
    assert together.summary.frames_used == 5
    assert together.summary.transformation_model == alone.summary.transformation_model
    apart = []
    for outcome in (alone, together):
        first, last = (outcome.summary.images[i].world_from_picture for i in (0, -1))
        assert first is not None and last is not None
        apart.append(geometry.inverted(first) @ last)
    assert corner_error(apart[1], apart[0], SIZE) < 1.0


def test_a_flight_is_laid_out_to_half_a_pixel(
    flight: list[Path], stranger: Path, tmp_path: Path
) -> None:
    outcome = run(tmp_path, [*flight, stranger])
    assert outcome.error is None
    summary = outcome.summary
    assert summary.frames_used == 9
    assert summary.projection == "planar"
    assert [image.name for image in summary.images if image.status is Status.SKIPPED] == [
        "stranger.png"
    ]
    assert "no overlap" in summary.images[-1].reason
    reference = int(str(summary.reference)[1])
    assert max(corner_errors(outcome, FLIGHT, reference)) < 0.6
    picture = cv2.imread(str(tmp_path / "m.png"), cv2.IMREAD_UNCHANGED)
    assert picture.shape == (*summary.canvas_wh[::-1], 4)


def test_the_painted_flight_is_the_ground(
    flight: list[Path], ground: Image, tmp_path: Path
) -> None:
    outcome = run(tmp_path, flight)
    picture = cv2.imread(str(tmp_path / "m.png"), cv2.IMREAD_UNCHANGED)
    reference = int(str(outcome.summary.reference)[1])
    # Where the world's origin lies on the canvas is found by correlation; then all must agree.
    truth = cv2.warpPerspective(
        ground,
        geometry.translation(400, 300) @ np.linalg.inv(FLIGHT[reference]),
        (1100, 900),
        borderMode=cv2.BORDER_REPLICATE,
    )
    h, w = picture.shape[:2]
    part = np.ascontiguousarray(picture[h // 3 : 2 * h // 3, w // 3 : 2 * w // 3, :3])
    found = cv2.minMaxLoc(cv2.matchTemplate(truth, part, cv2.TM_CCOEFF_NORMED))[3]
    x, y = found[0] - w // 3, found[1] - h // 3
    inside = cv2.erode(picture[:, :, 3], np.ones((7, 7), np.uint8)) > 0
    a = cv2.cvtColor(picture[:, :, :3], cv2.COLOR_BGR2GRAY)[inside].astype(float)
    b = cv2.cvtColor(truth[y : y + h, x : x + w], cv2.COLOR_BGR2GRAY)[inside].astype(float)
    assert np.corrcoef(a, b)[0, 1] > 0.95


def test_outputs_agree_with_each_other(flight: list[Path], tmp_path: Path) -> None:
    outcome = run(tmp_path, flight[:2])
    summary = json.loads((tmp_path / "s.json").read_text())
    rows = list(csv.DictReader((tmp_path / "p.csv").read_text().splitlines()))
    assert [row["name"] for row in rows] == ["p0.png", "p1.png"]
    assert [row["status"] for row in rows] == ["used", "used"]
    assert rows[0]["time_s"] == ""
    matrix = [float(rows[1][f"h{r}{c}"]) for r in "123" for c in "123"]
    np.testing.assert_allclose(
        np.array(matrix).reshape(3, 3), summary["images"][1]["world_from_frame"]
    )
    assert summary["canvas"]["width"] == outcome.summary.canvas_wh[0]
    (link,) = summary["links"]
    assert link["inliers"] > 50
    assert link["rmse_px"] < 1
    printed = dict(outcome.summary.rows())
    for label in ("Detector", "Features", "Matches", "Transformation model", "Warping", "Inliers"):
        assert printed[label]
    assert "within 3 px" in printed["Inliers"]


@pytest.mark.parametrize("output", ["m.png", None])
def test_the_recording_shows_mosaic_links_and_pictures(
    flight: list[Path], stranger: Path, tmp_path: Path, output: str | None
) -> None:
    from rrd import rrd_columns, rrd_entities

    record = tmp_path / "m.rrd"
    outcome = run(tmp_path, [*flight[:2], stranger], output=output, record=record)
    assert outcome.error is None
    assert outcome.summary.canvas_wh is not None
    assert (tmp_path / "m.png").exists() == (output is not None)
    entities = set(rrd_entities(record))
    assert {"/mosaic/image", "/links/0-1/matches", "/pictures/2/keypoints"} <= entities
    (outlines,) = rrd_columns(record, "/mosaic/outlines", "LineStrips2D:strips", None)[1]
    ends = np.concatenate([np.array(line) for line in outlines])
    np.testing.assert_allclose(ends.min(axis=0), [-0.5, -0.5], atol=1.0)
    np.testing.assert_allclose(ends.max(axis=0), outcome.summary.canvas_wh, atol=1.0)


def test_a_recording_of_nothing_placed_shows_why(
    flight: list[Path], stranger: Path, tmp_path: Path
) -> None:
    from rrd import rrd_columns, rrd_entities

    record = tmp_path / "m.rrd"
    outcome = run(tmp_path, [flight[0], stranger], record=record)
    assert outcome.error is not None
    assert "/links/0-1/image" in rrd_entities(record)
    assert "/mosaic/image" not in rrd_entities(record)
    log = [line for (line,) in rrd_columns(record, "/log", "TextLog:text", "picture")[1]]
    assert any("stranger.png: skipped: no overlap" in line for line in log)


def test_zoom_and_rotation_together_are_painted(ground: Image, tmp_path: Path) -> None:
    # Three times as large and turned by 45 degrees, its box has 18 times the other's area.
    places = [pose(450, 350), pose(450, 350, 45, 3.0)]
    paths = [tmp_path / f"p{i}.png" for i in range(2)]
    for path, place in zip(paths, places, strict=True):
        cv2.imwrite(str(path), seen(ground, place))
    outcome = run(tmp_path, paths)
    assert outcome.error is None
    assert outcome.summary.frames_used == 2
    assert max(corner_errors(outcome, places, int(str(outcome.summary.reference)[1]))) < 3


def test_truth_gives_recall_precision_and_corner_error(flight: list[Path], tmp_path: Path) -> None:
    truth = tmp_path / "H.txt"
    np.savetxt(truth, np.linalg.inv(FLIGHT[1]) @ FLIGHT[0])
    outcome = run(tmp_path, flight[:2], truth=truth)
    (link,) = outcome.summary.links
    assert link.corner_error_px is not None
    assert link.corner_error_px < 0.5
    assert link.recall is not None
    assert 0.2 < link.recall <= 1
    assert link.one_minus_precision is not None
    assert link.one_minus_precision < 0.2
    assert "Recall" in dict(outcome.summary.rows())


def test_poses_are_those_of_the_files_however_large(ground: Image, tmp_path: Path) -> None:
    # Beyond two megapixels pictures are registered at a smaller size.
    places = [geometry.scaling(1 / 7), geometry.translation(200, 0) @ geometry.scaling(1 / 7)]
    paths = [tmp_path / f"{i}.jpg" for i in range(2)]
    for path, place in zip(paths, places, strict=True):
        cv2.imwrite(str(path), seen(ground, place, (2800, 2100)))
    outcome = run(tmp_path, paths, output=None)
    second = outcome.summary.images[1].world_from_picture
    assert second is not None
    quad = geometry.image_quad((2800, 2100))
    apart = geometry.transform_points(second, quad) - quad - np.array([1400.0, 0.0])
    assert np.max(np.abs(apart)) < 3
    assert outcome.summary.links[0].b_from_a is not None
    assert outcome.summary.links[0].b_from_a[0, 2] == pytest.approx(-1400, abs=3)


@pytest.mark.parametrize("blending", ["none", "average", "feather", "multiband"])
@pytest.mark.parametrize("output", ["m.png", "m.jpg", "m.tif"])
def test_every_blending_and_format(
    flight: list[Path], tmp_path: Path, blending: str, output: str
) -> None:
    outcome = run(tmp_path, flight[:2], output=output, blending=blending)
    picture = cv2.imread(str(tmp_path / output), cv2.IMREAD_UNCHANGED)
    assert picture.shape[1::-1] == outcome.summary.canvas_wh
    is_clear = output != "m.jpg"
    assert outcome.summary.more["outside_the_pictures"] == ("transparent" if is_clear else "black")
    assert picture.shape[2] == (4 if is_clear else 3)


# -- a camera that turns ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def panorama(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Eleven pictures over 200 degrees inside a painted cylinder."""
    from conftest import _picture

    focal, folder = 300.0, tmp_path_factory.mktemp("panorama")
    wall = _picture(21, (1900, 900))
    k = camera_matrix(focal, SIZE)
    ys, xs = np.mgrid[0 : SIZE[1], 0 : SIZE[0]]
    pixels = np.stack([xs, ys, np.ones_like(xs)], axis=-1).reshape(-1, 3).astype(float)
    paths = []
    for i, yaw in enumerate(np.linspace(-100, 100, 11)):
        rays = pixels @ np.linalg.inv(k).T @ turned(yaw, 6 * np.sin(i), 2 * np.cos(i)).T
        theta = np.arctan2(rays[:, 0], rays[:, 2])
        height = rays[:, 1] / np.hypot(rays[:, 0], rays[:, 2])
        map_x = (theta * focal + 950).reshape(SIZE[::-1]).astype(np.float32)
        map_y = (height * focal + 450).reshape(SIZE[::-1]).astype(np.float32)
        paths.append(folder / f"{i:02}.png")
        cv2.imwrite(str(paths[-1]), cv2.remap(wall, map_x, map_y, cv2.INTER_CUBIC))
    return paths


@pytest.mark.slow
def test_a_wide_panorama_is_a_level_cylinder(panorama: list[Path], tmp_path: Path) -> None:
    outcome = run(tmp_path, panorama)
    summary = outcome.summary
    assert outcome.error is None
    assert summary.frames_used == 11
    assert (summary.transformation_model, summary.projection) == ("rotation", "cylindrical")
    assert summary.focal_px == pytest.approx(300, rel=0.01)
    own = 2 * np.arctan(160 / 300)
    assert summary.canvas_wh is not None
    assert summary.canvas_wh[0] == pytest.approx(300 * (np.radians(200) + own), rel=0.02)
    # The middle picture's neighbours are mapped to it by the exact homography.
    k, cameras = camera_matrix(300, SIZE), np.linspace(-100, 100, 11)
    reference = int(str(summary.reference)[:2])
    world = turned(cameras[reference], 6 * np.sin(reference), 2 * np.cos(reference))
    near = reference + 1
    camera = turned(cameras[near], 6 * np.sin(near), 2 * np.cos(near))
    true = k @ world.T @ camera @ np.linalg.inv(k)
    found = summary.images[near].world_from_picture
    assert found is not None
    quad = geometry.image_quad(SIZE)
    apart = geometry.transform_points(found, quad) - geometry.transform_points(true, quad)
    assert np.max(np.abs(apart)) < 1.5


def test_few_degrees_stay_planar(panorama: list[Path], tmp_path: Path) -> None:
    outcome = run(tmp_path, panorama[4:7])
    assert outcome.summary.projection == "planar"
    assert outcome.summary.frames_used == 3


def test_a_plane_refuses_what_it_cannot_hold(panorama: list[Path], tmp_path: Path) -> None:
    outcome = run(tmp_path, panorama, projection="planar")
    skipped = [i for i in outcome.summary.images if i.status is Status.SKIPPED]
    assert skipped
    assert all("--projection cylindrical" in image.reason for image in skipped)
    if outcome.summary.canvas_wh is not None:
        assert outcome.summary.canvas_wh[0] < 15 * SIZE[0]


def test_a_flat_flight_is_no_panorama(flight: list[Path], tmp_path: Path) -> None:
    outcome = run(tmp_path, flight, projection="spherical")
    assert outcome.error is not None
    assert "--projection auto" in str(outcome.error)
    assert not (tmp_path / "m.png").exists()


# -- bad input ----------------------------------------------------------------------------------


def test_the_same_picture_twice_is_that_picture(flight: list[Path], tmp_path: Path) -> None:
    outcome = run(tmp_path, [flight[0], flight[0]])
    assert outcome.summary.canvas_wh == SIZE
    picture = cv2.imread(str(tmp_path / "m.png"))
    assert np.mean(cv2.absdiff(picture, cv2.imread(str(flight[0])))) < 1


def grey(image: Image) -> Image:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


def half(image: Image) -> Image:
    return np.asarray(cv2.resize(image, None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA))


def alpha(image: Image) -> Image:
    clear = cv2.cvtColor(image, cv2.COLOR_BGR2BGRA)
    clear[:40] = 0
    return np.asarray(clear, np.uint8)


@pytest.mark.parametrize("change", [grey, half, alpha], ids=["grey", "smaller", "alpha"])
def test_pictures_of_different_kinds_join(
    flight: list[Path], tmp_path: Path, change: Callable[[Image], Image]
) -> None:
    other = tmp_path / "other.png"
    cv2.imwrite(str(other), change(cv2.imread(str(flight[1]))))
    outcome = run(tmp_path, [flight[0], other])
    assert outcome.error is None
    assert outcome.summary.frames_used == 2


def test_what_is_transparent_is_not_painted(flight: list[Path], tmp_path: Path) -> None:
    # Its upper half is clear (and black below that): the other picture shows there.
    clear = cv2.cvtColor(cv2.imread(str(flight[0])), cv2.COLOR_BGR2BGRA)
    clear[:90] = 0
    cv2.imwrite(str(tmp_path / "clear.png"), clear)
    run(tmp_path, [flight[0], tmp_path / "clear.png"])
    picture = cv2.imread(str(tmp_path / "m.png"))
    assert np.mean(cv2.absdiff(picture, cv2.imread(str(flight[0])))) < 1.5


def test_a_sideways_jpeg_is_turned_upright(flight: list[Path], tmp_path: Path) -> None:
    upright = cv2.imread(str(flight[1]))
    data = cv2.imencode(".jpg", np.rot90(upright))[1].tobytes()
    # An EXIF segment that says: turn by 90 degrees clockwise (orientation 6).
    tiff = b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    exif = b"Exif\0\0" + tiff
    segment = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
    lying = tmp_path / "lying.jpg"
    lying.write_bytes(data[:2] + segment + data[2:])
    outcome = run(tmp_path, [flight[0], lying])
    assert max(corner_errors(outcome, FLIGHT[:2], 0)) < 1


def blank(size: Size) -> Image:
    return np.full((size[1], size[0], 3), 128, np.uint8)


@pytest.mark.parametrize("size", [SIZE, (1, 1), (1, 500), (30_000, 40)])
def test_what_shows_nothing_is_skipped_and_named(
    flight: list[Path], tmp_path: Path, size: Size
) -> None:
    empty = tmp_path / "empty.png"
    cv2.imwrite(str(empty), blank(size))
    outcome = run(tmp_path, [flight[0], empty, flight[1]])
    assert outcome.error is None
    assert outcome.summary.images[1].reason.startswith("only 0 features")
    assert outcome.summary.frames_used == 2


def test_a_corrupt_file_and_others_in_a_folder(flight: list[Path], tmp_path: Path) -> None:
    folder = tmp_path / "mixed"
    folder.mkdir()
    for path in flight[:2]:
        (folder / path.name).write_bytes(path.read_bytes())
    (folder / "broken.jpg").write_bytes(b"\xff\xd8\xff\xe0 nothing")
    (folder / "notes.txt").write_text("no picture")
    outcome = run(tmp_path, [folder])
    assert outcome.error is None
    assert outcome.summary.frames_used == 2
    assert [i.name for i in outcome.summary.images if i.status is Status.SKIPPED] == ["broken.jpg"]


def test_no_overlap_writes_no_picture_but_says_why(
    flight: list[Path], stranger: Path, tmp_path: Path
) -> None:
    outcome = run(tmp_path, [flight[0], stranger])
    assert isinstance(outcome.error, StreamtrackError)
    assert not (tmp_path / "m.png").exists()
    assert [image.status for image in outcome.summary.images] == [Status.SKIPPED] * 2
    assert json.loads((tmp_path / "s.json").read_text())["canvas"] is None


@pytest.mark.parametrize(
    ("inputs", "output", "error", "says"),
    [
        (["p0.png"], "m.png", UsageError, "at least two"),
        (["p0.png", "missing.png"], "m.png", SourceError, "no such file"),
        (["p0.png", "p1.png"], "", OutputError, "folder"),
        (["p0.png", "p1.png"], "p0.png", UsageError, "would replace"),
        (["p0.png", "p1.png"], "m.gif", UsageError, "no picture format"),
        (["p0.png", "p1.png"], "p0.png/m.png", OutputError, "stands where its folder"),
        (["p0.png", "synthetic://board"], "m.png", SourceError, "is no picture"),
        (["nothing*.png"], "m.png", SourceError, "no file matches"),
    ],
)
def test_what_cannot_be_is_refused_before_any_work(
    flight: list[Path],
    tmp_path: Path,
    inputs: list[str],
    output: str,
    error: type[StreamtrackError],
    says: str,
) -> None:
    for path in flight[:2]:
        (tmp_path / path.name).write_bytes(path.read_bytes())
    names = [Path(name) if "://" in name else tmp_path / name for name in inputs]
    given = tuple(name if "://" in name else str(tmp_path / name) for name in inputs)
    assert len(names) == len(given)
    job = MosaicJob(given, build_settings({}), MosaicOutputs(tmp_path / output))
    with pytest.raises(error, match=says) as caught:
        run_mosaic(job, NoMosaicProgress(), lambda: False)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("1 0 0 0 1 0", "but holds 6"),
        ("a b c", "no text of numbers"),
        ("0 0 0 0 0 0 0 0 0", "determinant is 0"),
        ("1 0 0 0 nan 0 0 0 1", "not finite"),
    ],
)
def test_a_truth_that_is_none_is_refused(
    flight: list[Path], tmp_path: Path, text: str, says: str
) -> None:
    truth = tmp_path / "H.txt"
    truth.write_text(text)
    with pytest.raises(SourceError, match=rf"H\.txt.*{says}"):
        run(tmp_path, flight[:2], truth=truth)


@pytest.fixture
def small_disk() -> Iterator[None]:
    """No file may grow beyond 20 kB: what a full disk does, without one."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)
    signal.signal(signal.SIGXFSZ, handler)


@pytest.mark.usefixtures("small_disk")
def test_a_full_disk_leaves_no_half_picture(flight: list[Path], tmp_path: Path) -> None:
    outcome = run(tmp_path, flight[:2])
    assert isinstance(outcome.error, OutputError)
    assert [p.name for p in tmp_path.iterdir() if "m.png" in p.name] == []
    assert (tmp_path / "p.csv").exists()


def test_interrupted_the_mosaic_so_far_is_written(flight: list[Path], tmp_path: Path) -> None:
    # Asked once for each picture and each pair: nine, then a few pairs.
    outcome = run(tmp_path, flight, stop_after=9 + 6)
    assert isinstance(outcome.error, StreamtrackError)
    assert "interrupted" in str(outcome.error)
    assert 2 <= outcome.summary.frames_used < 9
    assert cv2.imread(str(tmp_path / "m.png")) is not None
    assert len((tmp_path / "p.csv").read_text().splitlines()) - 1 == 9


def test_interrupted_early_it_says_that_there_is_no_mosaic(
    flight: list[Path], tmp_path: Path
) -> None:
    outcome = run(tmp_path, flight, stop_after=1)
    assert "interrupted before two pictures were joined" in str(outcome.error)
    assert not (tmp_path / "m.png").exists()


# -- bounds -------------------------------------------------------------------------------------


def test_a_large_canvas_is_scaled_and_that_is_said(flight: list[Path], tmp_path: Path) -> None:
    outcome = run(tmp_path, flight[:2], max_megapixels=0.02)
    assert outcome.summary.canvas_wh is not None
    width, height = outcome.summary.canvas_wh
    assert width * height <= 0.0205e6
    assert any("--max-megapixels" in note for note in outcome.summary.notes)
    assert outcome.summary.images[0].world_from_picture is not None


def test_a_side_too_long_for_the_format_is_said_as_such(tmp_path: Path) -> None:
    from conftest import _picture

    strip = cv2.resize(_picture(5, (4000, 40)), (20_000, 200), interpolation=cv2.INTER_CUBIC)
    paths = [tmp_path / "left.png", tmp_path / "right.png"]
    cv2.imwrite(str(paths[0]), strip[:, :12_000])
    cv2.imwrite(str(paths[1]), strip[:, 8_000:])
    outcome = run(tmp_path, paths, output="m.webp")
    assert outcome.error is None
    assert outcome.summary.canvas_wh is not None
    assert 16_000 < outcome.summary.canvas_wh[0] <= 16_383
    (note,) = outcome.summary.notes
    assert "a side" in note and "megapixels allows" not in note


def test_little_memory_gives_the_same_picture(flight: list[Path], tmp_path: Path) -> None:
    run(tmp_path, flight[:3], output="whole.tif")
    run(tmp_path, flight[:3], output="bands.tif", max_memory_mb=0.5)
    whole = cv2.imread(str(tmp_path / "whole.tif"))
    bands = cv2.imread(str(tmp_path / "bands.tif"))
    assert whole.shape == bands.shape
    assert np.quantile(cv2.absdiff(whole, bands), 0.99) <= 2


def test_the_result_is_the_same_every_time(flight: list[Path], tmp_path: Path) -> None:
    run(tmp_path, flight[:4], output="a.png")
    run(tmp_path, flight[:4], output="b.png")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
