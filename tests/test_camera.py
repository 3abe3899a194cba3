"""Camera motion against the truth of scenes whose camera moves."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
import pytest
from conftest import Clip, FrameList, MakePicture

from streamtrack import geometry
from streamtrack.camera.auto import AutoCamera, make_camera
from streamtrack.camera.moving import MovingCamera
from streamtrack.evaluation import corner_error
from streamtrack.features import FeatureExtractor
from streamtrack.frame_view import FrameView
from streamtrack.pipeline import track
from streamtrack.settings import build_settings
from streamtrack.targets import Target
from streamtrack.types import CameraPose, Frame, Image, Matrix, Track, TrackState

MakeClip = Callable[..., Clip]
SIZE = (320, 240)
FLIGHT = "flight?size=320x240&frames=40&step=9"
BLACK = np.zeros((240, 320, 3), np.uint8)


def poses(
    source: FrameList, camera: str = "moving", targets: Sequence[Target] = ()
) -> list[CameraPose]:
    settings = build_settings({"camera": camera})
    return [step.camera for step in track(source, targets, settings)]


def true_poses(clip: Clip, first: int = 0) -> list[Matrix]:
    """world_from_frame with frame ``first`` as the world."""
    world = geometry.inverted(clip.truths[first].world_from_frame)
    return [geometry.normalized(world @ truth.world_from_frame) for truth in clip.truths]


def errors(found: Sequence[CameraPose], clip: Clip, first: int = 0) -> list[float]:
    size_wh = clip.frames[0].size_wh
    return [
        corner_error(pose.world_from_frame, truth, size_wh)
        for pose, truth in zip(found, true_poses(clip, first), strict=True)
    ]


def check_contract(found: Sequence[CameraPose]) -> None:
    for pose in found:
        assert (pose.world_from_frame is None) == (pose.reason != "")
        assert 0 <= pose.inliers <= pose.matches
        if pose.world_from_frame is not None:
            assert np.isfinite(pose.world_from_frame).all()
            assert pose.world_from_frame[2, 2] == pytest.approx(1)


@pytest.mark.parametrize(
    ("scene", "count", "step", "limit_px"),
    [
        (FLIGHT, 16, 1, 0.4),  # measured: 0.1
        ("flight?size=320x240&frames=40&seed=2", 8, 1, 0.5),  # measured: 0.13
        ("car?size=640x480", 7, 5, 1.5),  # measured: 0.4
    ],
)
@pytest.mark.parametrize("has_target", [False, True])
def test_the_camera_is_where_it_truly_is(
    scene: str, count: int, step: int, limit_px: float, has_target: bool, make_clip: MakeClip
) -> None:
    clip = make_clip(scene, count, 0, step)
    found = poses(clip.source(), targets=[Target("t", clip.quad)] if has_target else [])
    check_contract(found)
    np.testing.assert_array_equal(found[0].world_from_frame, np.eye(3))
    assert max(errors(found, clip)) < limit_px
    still = max(corner_error(np.eye(3), truth, SIZE) for truth in true_poses(clip))
    assert still > 30  # what saying "it does not move" would cost


def test_keyframes_carry_the_camera_out_of_the_first_view(make_clip: MakeClip) -> None:
    """The last frames share nothing with the first, so their pose rests on keyframes between."""
    clip = make_clip("flight?size=320x240&frames=60&step=30", 22)
    found = poses(clip.source())
    assert max(errors(found, clip)) < 3.0
    views = [
        geometry.transform_points(truth, geometry.image_quad(SIZE)) for truth in true_poses(clip)
    ]
    assert min(geometry.visible_share(view, SIZE) for view in views) == 0.0


def test_a_moving_target_does_not_move_the_camera(make_clip: MakeClip) -> None:
    clip = make_clip("board?size=320x240", 14, 0, 5)
    found = poses(clip.source(), targets=[Target("t", clip.quad)])
    check_contract(found)
    assert max(errors(found, clip)) < 0.5
    for truth in true_poses(clip):
        np.testing.assert_allclose(truth, np.eye(3), atol=1e-9)


@pytest.mark.parametrize("at", [1, 4, 7])
def test_a_blank_frame_leaves_no_trace(at: int, make_clip: MakeClip) -> None:
    """After it all is as if that frame had never been."""
    clip = make_clip(FLIGHT, 12)
    blanked = poses(clip.with_images({at: BLACK}))
    check_contract(blanked)
    assert blanked[at].world_from_frame is None and blanked[at].reason
    without = poses(FrameList([frame for frame in clip.frames if frame.index != at]))
    for i, (ours, theirs) in enumerate(zip(blanked[:at] + blanked[at + 1 :], without, strict=True)):
        np.testing.assert_array_equal(ours.world_from_frame, theirs.world_from_frame, str(i))
    kept = [error for i, error in enumerate(errors(blanked, clip)) if i != at]
    assert max(kept) < 0.5


def test_another_place_is_not_believed(make_clip: MakeClip, make_picture: MakePicture) -> None:
    clip = make_clip(FLIGHT, 8)
    other = np.dstack([make_picture(11, SIZE)] * 3)
    found = poses(clip.with_images({3: other, 4: other}))
    check_contract(found)
    assert found[3].world_from_frame is None and found[4].world_from_frame is None
    assert max(errors(found, clip)[5:]) < 0.5


@pytest.mark.parametrize("value", [0, 128, 255])
def test_a_featureless_start_waits_for_a_world(value: int, make_clip: MakeClip) -> None:
    clip = make_clip(FLIGHT, 6)
    blank = np.full_like(BLACK, value)
    found = poses(clip.with_images({0: blank, 1: blank}))
    check_contract(found)
    assert found[0].world_from_frame is None and found[1].world_from_frame is None
    assert "features" in found[0].reason
    np.testing.assert_array_equal(found[2].world_from_frame, np.eye(3))
    assert max(errors(found, clip, first=2)[2:]) < 0.5


@pytest.mark.parametrize(
    "image",
    [
        BLACK,
        np.zeros((16, 16, 3), np.uint8),
        np.random.default_rng(1).integers(0, 256, (40, 300), np.uint8),
        np.random.default_rng(2).integers(0, 256, (480, 640, 3), np.uint8),
    ],
)
def test_a_frame_that_does_not_belong_is_a_reason_not_an_end(
    image: Image, make_clip: MakeClip
) -> None:
    clip = make_clip(FLIGHT, 6)
    found = poses(clip.with_images({3: image}))
    check_contract(found)
    assert found[3].world_from_frame is None and found[3].reason
    assert max(errors(found, clip)[4:]) < 0.5


def test_a_fixed_camera_is_the_world(make_clip: MakeClip) -> None:
    clip = make_clip(FLIGHT, 4)
    for pose in poses(clip.with_images({1: BLACK}), "fixed"):
        np.testing.assert_array_equal(pose.world_from_frame, np.eye(3))
        assert pose.reason == ""


def test_a_fixed_camera_needs_no_features(
    make_clip: MakeClip, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FeatureExtractor, "extract", lambda *_: pytest.fail("detected features"))
    assert len(poses(make_clip(FLIGHT, 2).source(), "fixed")) == 2


def test_two_runs_are_equal(make_clip: MakeClip) -> None:
    clip = make_clip(FLIGHT, 8)
    for one, other in zip(poses(clip.source()), poses(clip.source()), strict=True):
        np.testing.assert_array_equal(one.world_from_frame, other.world_from_frame)
        assert (one.matches, one.inliers) == (other.matches, other.inliers)


def test_a_zoom_and_turn_of_a_picture_is_recovered(make_picture: MakePicture) -> None:
    """A camera that turns and zooms over a plane, in greyscale."""
    wide = make_picture(12, (640, 480))
    frames, truths = [], []
    for i in range(8):
        turned = cv2.getRotationMatrix2D((320, 240), 6.0 * i, 1 + 0.05 * i)
        frame_from_wide = geometry.translation(-160, -120) @ np.vstack([turned, [0, 0, 1]])
        image = cv2.warpPerspective(wide, frame_from_wide, SIZE, flags=cv2.INTER_CUBIC)
        frames.append(Frame(i, i / 30, np.asarray(image, np.uint8)))
        truths.append(frame_from_wide)
    found = poses(FrameList(frames))
    for pose, frame_from_wide in zip(found, truths, strict=True):
        truth = truths[0] @ geometry.inverted(frame_from_wide)
        assert corner_error(pose.world_from_frame, truth, SIZE) < 0.6


@pytest.mark.parametrize("at", [1, 5, 9])
def test_a_frozen_frame_leaves_no_trace(at: int, make_clip: MakeClip) -> None:
    """The picture of the frame before, shown twice, has its pose, and the motion goes on."""
    clip = make_clip(FLIGHT, 12)
    frozen = poses(clip.with_images({at: clip.frames[at - 1].image}))
    check_contract(frozen)
    assert corner_error(frozen[at].world_from_frame, true_poses(clip)[at - 1], SIZE) < 0.5
    assert max(error for i, error in enumerate(errors(frozen, clip)) if i != at) < 0.5


def test_a_cut_is_noticed_and_the_return_from_it(
    make_clip: MakeClip, make_picture: MakePicture
) -> None:
    """Another scene is never placed; back over the old one, the camera knows where it is."""
    clip = make_clip("flight?size=320x240&frames=60&step=30", 22)
    elsewhere = np.dstack([make_picture(21, SIZE)] * 3)
    back = list(range(22)) + [22] * 6 + [3, 4, 5]
    frames = [
        Frame(n, n / 30, elsewhere if i == 22 else clip.frames[i].image) for n, i in enumerate(back)
    ]
    found = poses(FrameList(frames))
    check_contract(found)
    assert all(pose.world_from_frame is None for pose in found[22:28])
    truths = true_poses(clip)
    for n in range(29, 31):
        assert corner_error(found[n].world_from_frame, truths[back[n]], SIZE) < 3.0


@pytest.mark.parametrize("jump_px", [12, 25, 45])
def test_a_jerk_is_followed(jump_px: int, make_picture: MakePicture) -> None:
    wide = make_picture(13, (800, 400))
    xs = [0, 2, 4, 6, 6 + jump_px, 8 + jump_px, 10 + jump_px]
    frames = [
        Frame(n, n / 30, np.ascontiguousarray(wide[40:280, 100 + x : 420 + x]))
        for n, x in enumerate(xs)
    ]
    for pose, x in zip(poses(FrameList(frames)), xs, strict=True):
        assert corner_error(pose.world_from_frame, geometry.translation(x, 0), SIZE) < 0.3


@pytest.mark.parametrize("share", [0.2, 0.4])
def test_things_that_move_are_left_out(share: float, make_picture: MakePicture) -> None:
    """An object over a part of the view goes the other way; its quad is known."""
    ground, thing = make_picture(14, (800, 400)), make_picture(15, SIZE)
    side = share**0.5
    width, height = round(320 * side), round(240 * side)
    frames, quads = [], []
    for n in range(10):
        image = ground[60:300, 100 + 20 * n : 420 + 20 * n].copy()
        x, y = 150 - 14 * n if width < 160 else 100 - 9 * n, 20
        image[y : y + height, x : x + width] = thing[:height, :width]
        frames.append(Frame(n, n / 30, image))
        quads.append(geometry.box_quad(x, y, width, height))
    settings = build_settings({"camera": "moving"})
    camera, extractor = MovingCamera(settings), FeatureExtractor(settings.features)
    for n, (frame, quad) in enumerate(zip(frames, quads, strict=True)):
        thing_there = Track("t", TrackState.TRACKING, quad, np.eye(3))
        pose = camera.update(FrameView(frame, extractor), (thing_there,))
        assert corner_error(pose.world_from_frame, geometry.translation(20 * n, 0), SIZE) < 0.5


@pytest.mark.parametrize("things", [1, 2, 4])
def test_unknown_things_that_go_along_are_not_taken_for_the_ground(
    things: int, make_picture: MakePicture
) -> None:
    """Things of more contrast than the ground, over up to 35 %, keep nearly pace with the view."""
    ground = (make_picture(14, (800, 400)).astype(np.float32) * 0.5 + 64).astype(np.uint8)
    thing = make_picture(15, SIZE)
    places = [(25, 25), (199, 145), (199, 25), (25, 145)][:things]
    frames = []
    for n in range(48):
        image = ground[60:300, 100 + 7 * n : 420 + 7 * n].copy()
        for k, (x0, y0) in enumerate(places):
            x, y = x0 + round(12 * np.sin(n / 12 + k)), y0 + round(6 * np.sin(n / 9 + 2 * k))
            image[y : y + 70, x : x + 96] = thing[30 * k : 30 * k + 70, 40 * k : 40 * k + 96]
        frames.append(Frame(n, n / 30, image))
    found = poses(FrameList(frames))
    known = [n for n, pose in enumerate(found) if pose.world_from_frame is not None]
    assert len(known) > 40
    for n in known:
        truth = geometry.translation(7 * n, 0)
        assert corner_error(found[n].world_from_frame, truth, SIZE) < 2.0


def test_a_target_that_hides_much_of_the_view_costs_no_frame(
    make_clip: MakeClip, make_picture: MakePicture
) -> None:
    """Two fifths are hidden, elsewhere in the keyframe than in the frame."""
    clip = make_clip("flight?seed=1&frames=60", 44)
    thing = np.dstack([make_picture(5, (404, 303))] * 3)
    camera, found = MovingCamera(build_settings({"camera": "moving"})), []
    extractor = FeatureExtractor(build_settings({}).features)
    for i, frame in enumerate(clip.frames):
        x, y = int(118 * (1 + np.sin(i / 23))), int(88 * (1 + np.cos(i / 31)))
        image = frame.image.copy()
        image[y : y + 303, x : x + 404] = thing
        quad = geometry.box_quad(x, y, x + 403, y + 302)
        hidden = Track("thing", TrackState.TRACKING, quad, np.eye(3))
        view = FrameView(Frame(i, frame.time_s, image), extractor)
        found.append(camera.update(view, (hidden,)))
    camera.close()
    check_contract(found)
    assert all(pose.world_from_frame is not None for pose in found)
    assert np.mean(errors(found, clip)) < 0.5  # measured: 0.2


def test_a_frame_that_would_cover_too_much_is_refused(make_picture: MakePicture) -> None:
    """The camera backs away until its view is more than twice as wide as the first."""
    wide = make_picture(16, (1280, 960))
    frames, zooms = [], [1.0 + 0.08 * n for n in range(18)]
    for n, zoom in enumerate(zooms):
        wide_from_frame = np.array(
            [[zoom, 0, 640 - 160 * zoom], [0, zoom, 480 - 120 * zoom], [0, 0, 1.0]]
        )
        image = cv2.warpPerspective(wide, geometry.inverted(wide_from_frame), SIZE)
        frames.append(Frame(n, n / 30, np.asarray(image, np.uint8)))
    found = poses(FrameList(frames))
    check_contract(found)
    for pose, zoom in zip(found, zooms, strict=True):
        if zoom < 1.95:
            assert pose.world_from_frame is not None
        if zoom > 2.05:
            assert pose.world_from_frame is None
            assert "four times" in pose.reason


def fixed_clip(make_picture: MakePicture, shifts: Sequence[tuple[int, int]]) -> FrameList:
    """A view that lies elsewhere in its picture in each frame, with noise."""
    wide = make_picture(17, (400, 300))
    rng = np.random.default_rng(3)
    frames = []
    for n, (x, y) in enumerate(shifts):
        noise = rng.normal(0, 2, (240, 320))
        image = np.clip(wide[30 + y : 270 + y, 40 + x : 360 + x] + noise, 0, 255).astype(np.uint8)
        frames.append(Frame(n, n / 30, image))
    return FrameList(frames)


def test_a_tripod_that_was_bumped_is_reported(make_picture: MakePicture) -> None:
    shifts = [(0, 0)] * 60 + [(8, 6)] * 60
    found = poses(fixed_clip(make_picture, shifts), "fixed")
    for pose in found:
        np.testing.assert_array_equal(pose.world_from_frame, np.eye(3))
        assert pose.reason == ""
    assert all(pose.warning == "" for pose in found[:60])
    assert found[-1].warning.startswith("camera moved at frame 60 by ")
    moved_px = float(found[-1].warning.split()[-2])
    assert moved_px == pytest.approx(10, abs=0.5)


def test_a_tripod_that_was_put_back_is_trusted_again(make_picture: MakePicture) -> None:
    shifts = [(0, 0)] * 30 + [(9, 0)] * 40 + [(0, 0)] * 60
    found = poses(fixed_clip(make_picture, shifts), "fixed")
    assert any(pose.warning for pose in found[30:80])
    assert found[-1].warning == ""


def test_a_camera_that_stands_raises_no_alarm(make_clip: MakeClip) -> None:
    clip = make_clip("board?size=320x240", 90)
    assert {pose.warning for pose in poses(clip.source(), "fixed")} == {""}


def test_another_view_than_at_first_is_reported(make_picture: MakePicture) -> None:
    clip = fixed_clip(make_picture, [(0, 0)] * 30)
    other = np.asarray(make_picture(18, SIZE), np.uint8)
    frames = [*clip, *(Frame(n, n / 30, other) for n in range(30, 130))]
    assert poses(FrameList(frames), "fixed")[-1].warning.startswith("view not recognised since")


def test_auto_finds_out_that_a_camera_stands(make_picture: MakePicture) -> None:
    camera, found = run_auto(fixed_clip(make_picture, [(0, 0)] * 60))
    assert camera.is_fixed
    np.testing.assert_array_equal(found[-1].world_from_frame, np.eye(3))
    assert max(corner_error(pose.world_from_frame, np.eye(3), SIZE) for pose in found) < 0.2


def test_the_graph_knows_where_the_frames_of_a_standing_camera_lie(
    make_picture: MakePicture,
) -> None:
    camera, found = run_auto(fixed_clip(make_picture, [(0, 0)] * 60))
    for index, pose in enumerate(found):
        known = camera.graph.world_from_frame(index)
        assert known is not None
        assert corner_error(known, pose.world_from_frame, SIZE) < 0.01


def test_auto_is_not_carried_along_by_traffic(make_picture: MakePicture) -> None:
    """Two thirds of the view flow by; what stands between them tells that the camera does."""
    ground, traffic = make_picture(31, SIZE), make_picture(32, (1000, 240))
    frames = []
    for n in range(60):
        image = ground.copy()
        image[:, 50:270] = traffic[:, 12 * n : 12 * n + 220]
        frames.append(Frame(n, n / 30, image))
    camera, found = run_auto(frames)
    assert camera.is_fixed
    assert corner_error(found[-1].world_from_frame, np.eye(3), SIZE) < 0.2


def test_a_camera_that_stands_goes_on_standing_behind_what_hides_nearly_all(
    make_picture: MakePicture,
) -> None:
    """Something comes close: seven eighths flow by, and the exposure follows it."""
    ground, thing = make_picture(31, SIZE), make_picture(32, (1000, 240))
    frames = []
    for n in range(80):
        image = ground.copy()
        if n >= 40:
            image[:, 40:] = thing[:, 12 * (n - 40) : 12 * (n - 40) + 280]
            image = np.asarray(image * 0.8, np.uint8)
        frames.append(Frame(n, n / 30, image))
    camera, found = run_auto(frames)
    assert camera.is_fixed and kinds(found) == ["moving", "fixed"]
    np.testing.assert_array_equal(found[-1].world_from_frame, np.eye(3))


def test_auto_finds_out_that_a_camera_moves(make_clip: MakeClip) -> None:
    clip = make_clip(FLIGHT, 16)
    camera, found = run_auto(clip.source())
    assert not camera.is_fixed
    assert max(errors(found, clip)) < 0.5


def kinds(found: Sequence[CameraPose]) -> list[str]:
    """What the camera was taken for, each run of frames once."""
    names = [str(pose.kind) for pose in found]
    return [name for n, name in enumerate(names) if n == 0 or name != names[n - 1]]


def test_auto_notices_that_a_camera_begins_to_move(make_picture: MakePicture) -> None:
    """It stands, moves, and stands again elsewhere: the pose is right in every frame."""
    shifts = [(0, 0)] * 40 + [(min(39, n), 0) for n in range(110)]
    _, found = run_auto(fixed_clip(make_picture, shifts))
    assert kinds(found) == ["moving", "fixed", "moving", "fixed"]
    for pose, (x, y) in zip(found, shifts, strict=True):
        assert corner_error(pose.world_from_frame, geometry.translation(x, y), SIZE) < 0.6


def test_auto_follows_a_tripod_that_was_bumped(make_picture: MakePicture) -> None:
    shifts = [(0, 0)] * 50 + [(8, 6)] * 60
    _, found = run_auto(fixed_clip(make_picture, shifts))
    for pose, (x, y) in zip(found, shifts, strict=True):
        assert corner_error(pose.world_from_frame, geometry.translation(x, y), SIZE) < 0.6


@pytest.mark.parametrize("speed", [0.05, 0.2])
def test_auto_is_not_fooled_by_a_slow_pan(speed: float, make_picture: MakePicture) -> None:
    wide = make_picture(19, (400, 300))
    frames = []
    for n in range(200):
        shift = geometry.translation(-30 - speed * n, -30)
        image = cv2.warpPerspective(wide, shift, SIZE, flags=cv2.INTER_CUBIC)
        frames.append(Frame(n, n / 30, np.asarray(image, np.uint8)))
    _, found = run_auto(FrameList(frames))
    for n, pose in enumerate(found):
        assert corner_error(pose.world_from_frame, geometry.translation(speed * n, 0), SIZE) < 1.0


def test_auto_knows_nothing_of_a_black_frame_and_goes_on(make_picture: MakePicture) -> None:
    clip = list(fixed_clip(make_picture, [(0, 0)] * 60))
    clip[40] = Frame(40, 40 / 30, np.zeros_like(clip[40].image))
    _, found = run_auto(FrameList(clip))
    assert found[40].world_from_frame is None and found[40].reason
    for pose in found[41:]:
        np.testing.assert_array_equal(pose.world_from_frame, np.eye(3))


def run_auto(source: FrameList) -> tuple[AutoCamera, list[CameraPose]]:
    settings = build_settings({"camera": "auto"})
    camera, extractor = make_camera(settings), FeatureExtractor(settings.features)
    assert isinstance(camera, AutoCamera)
    found = [camera.update(FrameView(frame, extractor), ()) for frame in source]
    camera.close()
    return camera, found
