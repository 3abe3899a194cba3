"""The sparse canvas and what paints it: tiles, disk, preview, choosing, blending, files."""

from __future__ import annotations

import errno
import os
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import MakePicture

from streamtrack import geometry
from streamtrack.errors import OutputError, UsageError
from streamtrack.mosaic import gains, picture_files
from streamtrack.mosaic.picture_files import open_picture
from streamtrack.mosaic.spill import SpillFile
from streamtrack.mosaic.stream import bands, painting
from streamtrack.mosaic.stream.canvas import Canvas
from streamtrack.mosaic.stream.consensus import Chooser, Sample, choose
from streamtrack.mosaic.stream.coverage import CellGrid, Footprint, footprint
from streamtrack.mosaic.stream.tiles import TILE_BYTES, tile_box, tile_keys
from streamtrack.types import Image, Matrix


def bgrw(image: Image, weight: int | Image = 200) -> Image:
    colours = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image
    return np.dstack([colours, np.full(image.shape[:2], weight, np.uint8)])


# -- spill --------------------------------------------------------------------------------------


def test_blocks_come_back_and_freed_room_is_used_again(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    spill, held = SpillFile(tmp_path), {}
    for turn in range(300):
        data = rng.bytes(int(rng.integers(1, 60_000)))
        held[turn] = (spill.put(data), data)
        if len(held) > 8:
            slot, expected = held.pop(int(rng.choice(list(held))))
            assert spill.get(slot) == expected
            spill.free(slot)
    for slot, expected in held.values():
        assert spill.get(slot) == expected
    assert spill.size_mb < 2.5  # 9 blocks of 64 kB at most, and some waste: not 300 of them
    assert not list(tmp_path.iterdir())  # no name, so nothing is left whatever happens
    spill.close()
    spill.close()


def test_a_folder_that_cannot_be_written_is_one_clear_line(tmp_path: Path) -> None:
    spill = SpillFile(tmp_path / "missing")
    with pytest.raises(OutputError, match=r"cannot write .*missing.*TMPDIR"):
        spill.put(b"x")


def test_a_full_disk_is_told_and_the_tile_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    canvas = Canvas(4 * TILE_BYTES, SpillFile(tmp_path))
    pixels = np.full((256, 256, 4), 7, np.uint8)
    for x in range(4):
        canvas.write((x * 256, 0, x * 256 + 256, 256), pixels)

    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "pwrite", full)
    with pytest.raises(OutputError, match="no space left on the disk"):
        canvas.write((1024, 0, 1280, 256), pixels)
    assert np.all(canvas.read((0, 0, 1024, 256)) == 7)


# -- canvas -------------------------------------------------------------------------------------


@pytest.mark.parametrize("tiles_in_memory", [4, 1000])
def test_it_is_one_endless_picture(
    tmp_path: Path, rng: np.random.Generator, tiles_in_memory: int
) -> None:
    canvas = Canvas(tiles_in_memory * TILE_BYTES, SpillFile(tmp_path), preview_side=512)
    dense = np.zeros((2400, 2400, 4), np.uint8)  # whose pixel (1200, 1200) is the origin
    for _ in range(40):
        width, height = rng.integers(1, 500, 2)
        x, y = rng.integers(-1200, 1200 - width), rng.integers(-1200, 1200 - height)
        pixels = rng.integers(1, 256, (height, width, 4)).astype(np.uint8)
        canvas.write((int(x), int(y), int(x + width), int(y + height)), pixels)
        dense[y + 1200 : y + height + 1200, x + 1200 : x + width + 1200] = pixels
        assert canvas.tiles.in_memory <= tiles_in_memory
    np.testing.assert_array_equal(canvas.read((-1200, -1200, 1200, 1200)), dense)
    preview = canvas.refresh_preview()
    assert max(preview.size_wh) <= 512
    check_preview(canvas, dense)


def check_preview(canvas: Canvas, dense: Image) -> None:
    """Each preview pixel is the mean of what is painted in its square of the canvas."""
    preview = canvas.preview
    scale = preview.canvas_from_preview[0, 0]
    side = round(scale)
    for y in range(2, preview.size_wh[1], 37):
        for x in range(1, preview.size_wh[0], 31):
            centre = geometry.transform_points(preview.canvas_from_preview, [[x, y]])[0]
            left, top = (np.rint(centre - (scale - 1) / 2).astype(int) + 1200).tolist()
            if min(left, top) < 0 or max(left, top) + side > len(dense):
                continue
            square = dense[top : top + side, left : left + side]
            painted = square[square[..., 3] > 0]
            expected = painted[:, :3].mean(axis=0) if len(painted) else np.zeros(3)
            tolerance = 2.5 if len(painted) == side * side else 40.0  # rounded level by level
            np.testing.assert_allclose(preview.image[y, x], expected, atol=tolerance)


def test_only_touched_tiles_exist(tmp_path: Path) -> None:
    canvas = Canvas(100 * TILE_BYTES, SpillFile(tmp_path))
    canvas.write((-5, -5, 5, 5), np.full((10, 10, 4), 9, np.uint8))
    canvas.write((90_000, 50_000, 90_100, 50_100), np.full((100, 100, 4), 9, np.uint8))
    canvas.write((300, 300, 700, 700), np.zeros((400, 400, 4), np.uint8))  # nothing painted
    assert canvas.tiles.keys() == [(-1, -1), (-1, 0), (0, -1), (0, 0), (351, 195)]
    assert max(canvas.refresh_preview().size_wh) <= 1024


def test_tile_keys_and_boxes_agree() -> None:
    assert list(tile_keys((-1, 0, 257, 1))) == [(-1, 0), (0, 0), (1, 0)]
    assert list(tile_keys((5, 5, 5, 9))) == []
    assert tile_box((-1, 2)) == (-256, 512, 0, 768)


# -- coverage -----------------------------------------------------------------------------------


def test_a_footprint_is_the_cells_whose_centres_are_inside() -> None:
    turned = geometry.translation(100, 50) @ np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]])
    cells = footprint(turned, (200, 100), 10)
    quad = geometry.transform_points(turned, geometry.image_quad((200, 100)))
    rows, columns = np.indices(cells.seen.shape)
    for row, column in zip(rows.ravel(), columns.ravel(), strict=True):
        centre = (cells.x + column + 0.5) * 10.0, (cells.y + row + 0.5) * 10.0
        inside = cv2.pointPolygonTest(quad.reshape(-1, 1, 2), centre, True)
        if abs(inside) > 1e-3:
            assert cells.seen[row, column] == (inside > 0)


def test_cells_count_over_block_borders(rng: np.random.Generator) -> None:
    grid, dense = CellGrid(), np.zeros((300, 300), np.int32)
    for _ in range(50):
        x, y = rng.integers(-150, 100, 2)
        seen = rng.random((40, 30)) < 0.7
        grid.add(Footprint(int(x), int(y), seen), 1)
        dense[y + 150 : y + 190, x + 150 : x + 180] += seen
    whole = Footprint(-150, -150, np.ones((300, 300), np.bool_))
    np.testing.assert_array_equal(grid.read(whole), dense)


# -- painting -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("matrix", "reason"),
    [
        (np.eye(3), ""),
        (np.diag([1.9, 1.9, 1.0]), ""),
        (np.diag([2.1, 2.1, 1.0]), r"4\.4 times its area \(4 at most\)"),
        (np.diag([-1.0, 1.0, 1.0]), "mirrored or folded"),
        (np.array([[1, 0, 0], [0, 1, 0], [-0.01, 0, 1.0]]), "fold over the horizon"),
        (np.full((3, 3), np.nan), "not finite"),
        (geometry.translation(9e5, 0), "more than 100000 px from the origin"),
        (np.diag([1e-3, 1e-3, 1.0]), "shrink to nothing"),
    ],
)
def test_poses_that_cannot_be_painted_are_refused(matrix: np.ndarray, reason: str) -> None:
    said = painting.refusal(matrix, (320, 240), 100_000.0)
    if reason:
        assert re.search(reason, said)
    else:
        assert said == ""


@pytest.mark.parametrize("size_wh", [(640, 480), (96, 97), (5, 4), (2, 2), (1, 1)])
def test_the_weight_falls_from_the_centre(size_wh: tuple[int, int]) -> None:
    weight = painting.centre_weight(size_wh)
    assert weight.shape == (size_wh[1], size_wh[0])
    assert weight.max() > 0
    np.testing.assert_array_equal(weight, weight[::-1])
    np.testing.assert_array_equal(weight, weight[:, ::-1])
    if min(size_wh) > 50:
        assert (weight[0] == painting.LEAST_WEIGHT).all()
        middle = weight[size_wh[1] // 2].astype(int)
        assert (np.diff(middle[: size_wh[0] // 2]) >= 0).all()


def painted(canvas: Canvas, frame: Image, canvas_from_frame: Matrix) -> painting.Comparison:
    """The frame painted into the canvas as the stream does it."""
    box = painting.box_of(canvas_from_frame, (frame.shape[1], frame.shape[0]))
    small_from_frame = geometry.scaling(1 / painting.SHRINK) @ canvas_from_frame
    small_from_pixels = small_from_frame @ geometry.scaling(painting.SHRINK)
    pixels = painting.shrunk(painting.weighted(frame))
    small = painting.warped(pixels, small_from_pixels, painting.quarter(box))
    seen = painting.compared(box, painting.quartered(canvas.read(box)), small)
    for part in seen.parts():
        new = painting.warped(painting.weighted(frame), canvas_from_frame, part)
        canvas.write(part, painting.paint(canvas.read(part), new, seen.differs_in(part)))
    return seen


def test_empty_places_are_filled_and_the_heavier_frame_wins_next_to_them(
    tmp_path: Path, make_picture: MakePicture
) -> None:
    picture = make_picture(3, (400, 200))
    canvas = Canvas(100 * TILE_BYTES, SpillFile(tmp_path))
    painted(canvas, picture[:, :240], np.eye(3))
    before = canvas.read((0, 0, 400, 200))
    seen = painted(canvas, picture[:, 160:], geometry.translation(160, 0))
    assert not seen.differs.any()
    covered = sum((x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in seen.parts())
    assert 160 * 200 < covered < 1.25 * 160 * 200  # of 240 * 200: what is new, and a border
    result = canvas.read((0, 0, 400, 200))
    np.testing.assert_array_equal(result[2:-2, 2:-2, 0], picture[2:-2, 2:-2])
    np.testing.assert_array_equal(result[:, :190], before[:, :190])
    assert (result[100, 232:240, 3] > before[100, 232:240, 3]).all()  # the other's very edge


def test_nothing_new_is_nothing_painted(tmp_path: Path, make_picture: MakePicture) -> None:
    picture = make_picture(3, (320, 240))
    canvas = Canvas(100 * TILE_BYTES, SpillFile(tmp_path))
    painted(canvas, picture, np.eye(3))
    assert painted(canvas, picture[60:180, 80:240], geometry.translation(80, 60)).parts() == []


def test_where_they_differ_what_stands_stays(tmp_path: Path, make_picture: MakePicture) -> None:
    picture = make_picture(4, (320, 240))
    changed = picture.copy()
    changed[80:130, 100:160] = 245
    canvas = Canvas(100 * TILE_BYTES, SpillFile(tmp_path))
    painted(canvas, picture, np.eye(3))
    before = canvas.read((0, 0, 320, 240))
    seen = painted(canvas, changed, np.eye(3))
    assert 0.5 * 3000 < 16 * np.count_nonzero(seen.differs) < 3 * 3000
    np.testing.assert_array_equal(canvas.read((0, 0, 320, 240)), before)
    over = painting.paint(before, bgrw(changed, 255), seen.differs)
    np.testing.assert_array_equal(over[..., 0][82:128, 102:158], picture[82:128, 102:158])
    assert over[20, 20, 3] == 255


def test_targets_have_no_weight() -> None:
    image = np.zeros((100, 200, 3), np.uint8)
    weight = painting.weighted(image, [geometry.box_quad(50, 20, 40, 30)], 0.5)[..., 3]
    assert weight.shape == (50, 100)
    assert not weight[11:24, 26:44].any()
    assert weight[30:45, 60:90].all()


# -- brightness ---------------------------------------------------------------------------------


def test_gains_are_recovered(rng: np.random.Generator) -> None:
    truth = rng.normal(0, 0.1, (30, 3))
    truth -= truth.mean(axis=0)
    edges = [
        gains.GainEdge(a, b, truth[a] - truth[b], 1.0)
        for a in range(30)
        for b in range(max(0, a - 3), a)
    ]
    found = gains.solve_gains(30, edges)
    np.testing.assert_allclose(found, truth, atol=0.02)
    assert not gains.solve_gains(3, []).any()


def test_a_ratio_is_measured_where_two_thumbnails_overlap(make_picture: MakePicture) -> None:
    picture = np.clip(make_picture(5, (48, 36)), 40, 200).astype(np.uint8)
    darker = np.rint(picture * 0.8).astype(np.uint8)
    found = gains.ratio(bgrw(darker), bgrw(picture), np.eye(3))
    assert found is not None
    np.testing.assert_allclose(found[0], -np.log(0.8), atol=0.01)
    assert gains.ratio(bgrw(darker), bgrw(picture), geometry.translation(47, 0)) is None


# -- choosing -----------------------------------------------------------------------------------


def chosen(samples: list[Image]) -> tuple[Image, Chooser]:
    chooser = Chooser((samples[0].shape[1], samples[0].shape[0]))
    for sample in samples:
        chooser.add(sample)
    choice = chooser.choice()
    assert choice is not None
    return choice.heaviest(), chooser


@pytest.mark.parametrize("count", [3, 5])
@pytest.mark.parametrize("heaviest_is_wrong", [0, 1, 2])
def test_the_majority_wins_over_the_heaviest(
    make_picture: MakePicture, count: int, heaviest_is_wrong: int
) -> None:
    background = make_picture(6, (256, 256))
    samples = [bgrw(background, 50 + n) for n in range(count)]
    samples[heaviest_is_wrong][60:120, 60:120, :3] = 250
    samples[heaviest_is_wrong][..., 3] = 255
    picture, chooser = chosen(samples)
    np.testing.assert_array_equal(picture[..., 0], background)
    choice = chooser.choice()
    assert choice is not None
    assert choice.tally.contested > 60 * 60 and choice.tally.undecided == 0


@pytest.mark.parametrize("shape", ["bright", "dark", "striped"])
@pytest.mark.parametrize("is_thing_older", [False, True])
def test_of_two_that_disagree_the_one_without_an_outline_is_the_ground(
    make_picture: MakePicture, shape: str, is_thing_older: bool
) -> None:
    """And never a part of each, though the border between the two runs through the thing."""
    background = cv2.GaussianBlur(make_picture(6, (256, 256)), (0, 0), 4)
    with_thing = background.copy()
    thing = with_thing[80:160, 80:176]
    thing[...] = {"bright": 245, "dark": 10, "striped": 245}[shape]
    if shape == "striped":
        thing[::16] = thing[1::16] = thing[2::16] = 190
    ramp = np.tile(np.linspace(10, 240, 256), (256, 1)).astype(np.uint8)
    samples = [bgrw(np.asarray(background, np.uint8), 255 - ramp), bgrw(with_thing, ramp)]
    if is_thing_older:
        samples.reverse()
    picture, chooser = chosen(samples)
    np.testing.assert_array_equal(picture[..., 0], background)
    choice = chooser.choice()
    assert choice is not None and choice.tally.undecided > 80 * 90


@pytest.mark.parametrize("is_thing_older", [False, True])
def test_a_thing_that_has_the_votes_in_one_half_and_not_in_the_other_is_not_cut(
    make_picture: MakePicture, is_thing_older: bool
) -> None:
    """Two frames end in the middle of it: one shows the thing, the other the ground."""
    background = np.asarray(cv2.GaussianBlur(make_picture(6, (256, 256)), (0, 0), 4), np.uint8)
    with_thing = background.copy()
    with_thing[80:160, 80:176] = 245
    samples = [bgrw(image) for image in (with_thing, with_thing, background, background)]
    samples[1][:, 128:] = 0
    samples[3][:, :128] = 0
    if not is_thing_older:
        samples.reverse()
    picture, _ = chosen(samples)
    np.testing.assert_array_equal(picture[..., 0], background)


@pytest.mark.parametrize("is_thing_older", [False, True])
def test_a_thing_that_stands_for_two_thirds_of_the_time_is_not_the_ground(
    make_picture: MakePicture, is_thing_older: bool
) -> None:
    background = np.asarray(cv2.GaussianBlur(make_picture(6, (256, 256)), (0, 0), 4), np.uint8)
    with_thing = background.copy()
    with_thing[80:160, 80:176] = 245
    samples = [bgrw(with_thing)] * 7 + [bgrw(background)] * 4
    if not is_thing_older:
        samples.reverse()
    picture, _ = chosen(samples)
    np.testing.assert_array_equal(picture[..., 0], background)


def noisy_road(rng: np.random.Generator) -> Image:
    road = 60 + rng.normal(0, 2, (256, 256))
    road[120:124] += 60
    return np.clip(road, 0, 255).astype(np.uint8)


def test_of_many_samples_one_that_is_hardly_darker_loses_too() -> None:
    rng = np.random.default_rng(1)
    images = [noisy_road(rng) for _ in range(12)]
    images[0][40:100, 40:140] -= 12
    picture, _ = chosen([bgrw(image, 255 if n == 0 else 40) for n, image in enumerate(images)])
    assert abs(float(picture[44:96, 44:136, 0].mean()) - 60) < 1
    assert np.array_equal(picture[160:, :, 0], images[0][160:])


def test_a_busy_road_is_empty_in_the_end() -> None:
    rng = np.random.default_rng(2)
    samples = []
    for _ in range(15):
        image = noisy_road(rng)
        for _ in range(4):
            x, y = rng.integers(0, 190), rng.integers(0, 220)
            image[y : y + 36, x : x + 66] = rng.choice([15, 40, 90, 150, 230])
            image[y + 8 : y + 28, x + 16 : x + 50] = rng.choice([30, 70, 120, 200])
        samples.append(bgrw(image))
    picture, _ = chosen(samples)
    empty = np.full((256, 256), 60.0)
    empty[120:124] += 60
    assert np.mean(np.abs(picture[..., 0] - empty) > 15) < 0.005


def test_what_is_shut_out_has_a_smooth_outline(make_picture: MakePicture) -> None:
    """A round thing in one of five samples: stairs of cells would be 1.27 times as long."""
    ground = make_picture(3, (256, 256))
    passing = ground.copy()
    cv2.circle(passing, (128, 128), 70, 255, -1)
    chooser = Chooser((256, 256))
    for image in (ground, ground, passing, ground, ground):
        chooser.add(bgrw(image))
    choice = chooser.choice()
    assert choice is not None
    gone = (choice.weights[2] == 0).astype(np.uint8)
    assert gone[128, 128] and not gone[5, 5]
    (outline,), _ = cv2.findContours(gone, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    smooth = cv2.arcLength(cv2.convexHull(outline), True)
    assert cv2.arcLength(outline, True) < 1.12 * smooth
    covered = cv2.circle(np.zeros((256, 256), np.uint8), (128, 128), 69, 1, -1)
    assert np.count_nonzero(covered & ~gone) == 0


def test_samples_that_agree_are_left_as_they_are(make_picture: MakePicture) -> None:
    picture = make_picture(8, (128, 128))
    pixels = [bgrw(picture, 40), bgrw(picture, 80)]
    samples = [Sample(p, painting.quartered(p), n == 0, n) for n, p in enumerate(pixels)]
    choice = choose(samples, {})
    assert choice is not None
    assert (choice.labels == 0).all()  # the other one stands back, though it is heavier
    assert choice.tally.contested == 0
    for blended in (choice.feathered(), choice.averaged()):
        np.testing.assert_array_equal(blended[..., 0], picture)
    assert Chooser((128, 128)).choice() is None


# -- blending -----------------------------------------------------------------------------------


@pytest.mark.parametrize("blending", ["none", "average", "feather", "multiband"])
def test_one_scene_stays_one_scene(make_picture: MakePicture, blending: str) -> None:
    picture = make_picture(9, (256, 256))
    ramp = np.tile(np.arange(256), (256, 1)).astype(np.uint8)
    chooser = Chooser((256, 256))
    chooser.add(bgrw(picture, 255 - ramp))
    chooser.add(bgrw(picture, ramp))
    choice = chooser.choice()
    assert choice is not None
    result = bands.blended(choice, blending)  # type: ignore[arg-type]
    assert np.abs(result[..., 0].astype(int) - picture).max() <= 1


def test_multiband_hides_a_step_and_does_not_darken_the_outside() -> None:
    left, right = (np.full((256, 256, 3), grey, np.uint8) for grey in (110, 122))
    weight = np.zeros((2, 256, 256), np.uint8)
    fall = np.linspace(200, 20, 128).astype(np.uint8)
    weight[0, 32:-32, 32:64], weight[0, 32:-32, 64:192] = 201, fall
    weight[1, 32:-32, 64:192], weight[1, 32:-32, 192:-32] = fall[::-1], 201
    chooser = Chooser((256, 256))
    for image, w in zip((left, right), weight, strict=True):
        chooser.add(bgrw(image, w))
    choice = chooser.choice()
    assert choice is not None
    result = bands.blended(choice, "multiband")
    line = result[128, 32:-32, 0].astype(int)
    assert line.min() >= 109 and line.max() <= 123
    assert np.abs(np.diff(line)).max() <= 2  # instead of 12
    assert (result[:32] == 0).all()


# -- files --------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", picture_files.PICTURE_SUFFIXES)
@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("is_big", [False, True])
def test_rows_become_a_picture(
    tmp_path: Path,
    rng: np.random.Generator,
    suffix: str,
    channels: int,
    is_big: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = tmp_path / "deep" / f"m{suffix}"
    if channels == 4 and not picture_files.holds_alpha(path):
        pytest.skip("no opacity in this format")
    if is_big:
        monkeypatch.setattr(picture_files, "_BIG_TIFF_BYTES", 1)
    picture = rng.integers(0, 256, (173, 91, channels)).astype(np.uint8)
    picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), 3), np.uint8)
    if channels == 4:  # opaque, or nothing at all
        picture[..., 3] = np.where(picture[..., 3] > 127, 255, 0)
        picture[picture[..., 3] == 0] = 0
    with open_picture(path, (91, 173), channels) as writer:
        for start in range(0, 173, 50):
            writer.write(picture[start : start + 50])
    found = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert found is not None
    is_lossy = suffix in (".jpg", ".jpeg", ".webp")
    shown = np.ones((173, 91), np.bool_) if channels == 3 else picture[..., 3] > 0
    pair = found[shown].astype(int), picture[shown].astype(int)
    np.testing.assert_allclose(*pair, atol=24 if is_lossy else 0)
    np.testing.assert_array_equal(found[..., 3:], picture[..., 3:])
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_what_was_there_stays_if_writing_fails(tmp_path: Path) -> None:
    path = tmp_path / "m.png"
    path.write_bytes(b"precious")
    with pytest.raises(KeyError), open_picture(path, (10, 10)) as writer:
        writer.write(np.zeros((5, 10, 3), np.uint8))
        raise KeyError
    assert path.read_bytes() == b"precious"
    assert [p.name for p in tmp_path.iterdir()] == ["m.png"]


def test_places_that_cannot_be_written_are_told(tmp_path: Path) -> None:
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "file").touch()
    for path, said in (
        (tmp_path / "folder.png", "this is a folder"),
        (tmp_path / "file" / "m.png", "file stands where its folder should be"),
    ):
        with pytest.raises(OutputError, match=said), open_picture(path, (1, 1)):
            pass
    unknown = pytest.raises(UsageError, match=r"m\.gif.*known are \.png")
    with unknown, open_picture(tmp_path / "m.gif", (1, 1)):
        pass
