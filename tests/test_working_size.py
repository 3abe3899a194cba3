"""Work on smaller pictures: results stay in the pixels of the frames as they came."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from conftest import Clip, FrameList

from streamtrack import geometry
from streamtrack.camera.moving import MovingCamera
from streamtrack.errors import TargetError
from streamtrack.pipeline import track
from streamtrack.settings import METHODS, build_settings
from streamtrack.targets import Target
from streamtrack.types import TrackState
from streamtrack.working_size import FullSizeGraph, full_from_small, resized, size_at

MakeClip = Callable[..., Clip]
WIDTH = 320


@pytest.mark.parametrize(
    ("size", "width", "expected"),
    [
        ((640, 480), 320, (320, 240)),
        ((640, 480), None, (640, 480)),
        ((640, 480), 640, (640, 480)),
        ((320, 240), 640, (320, 240)),
        ((1000, 333), 300, (300, 100)),
        ((5000, 20), 32, (32, 1)),
    ],
)
def test_sizes_to_work_at(size, width, expected) -> None:
    assert size_at(size, width) == expected
    corners = geometry.image_quad(expected)
    outer = geometry.transform_points(full_from_small(size, width), corners)
    # The corners of the outermost pixels: a large pixel covers several small ones.
    half = 0.5 * np.array(size) / expected - 0.5
    np.testing.assert_allclose(outer[0], half, atol=1e-3)
    np.testing.assert_allclose(outer[2], np.array(size) - 1 - half, atol=1e-3)


def test_a_resized_picture_lies_where_the_matrix_says() -> None:
    picture = np.zeros((120, 160), np.uint8)
    picture[40:80, 60:100] = 255
    small = resized(picture, (80, 60)).astype(float)
    ys, xs = np.mgrid[:60, :80]
    middle = [[(xs * small).sum() / small.sum(), (ys * small).sum() / small.sum()]]
    full = geometry.transform_points(full_from_small((160, 120), 80), middle)
    np.testing.assert_allclose(full, [[79.5, 59.5]], atol=1e-3)


@pytest.mark.parametrize("method", METHODS)
def test_tracks_are_exact_in_full_pixels(make_clip: MakeClip, method: str) -> None:
    clip = make_clip("board?size=640x480", 12, 0, 2)
    settings = build_settings({"max_width": WIDTH, "tracker": {"method": method}})
    steps = list(track(clip.source(), [Target("board", clip.quad)], settings))
    assert len(steps) == len(clip.frames)
    errors = []
    for step, frame, truth in zip(steps, clip.frames, clip.truths, strict=True):
        found = step.tracks[0]
        assert step.frame is frame
        assert found.state is TrackState.TRACKING and found.quad is not None
        errors.append(np.abs(found.quad - truth.quad).max())
        carried = geometry.transform_points(found.frame_from_template, clip.quad)
        np.testing.assert_allclose(carried, found.quad, atol=0.05)
        inliers = found.evidence.is_inlier
        mapped = geometry.transform_points(
            found.frame_from_template, found.evidence.template_points[inliers]
        )
        residuals = np.linalg.norm(mapped - found.evidence.frame_points[inliers], axis=1)
        assert np.median(residuals) < 3.0
    assert np.median(errors) < 1.0
    assert max(errors) < 3.0


def test_a_target_picture_is_found_in_full_pixels(make_clip: MakeClip) -> None:
    clip = make_clip("board?size=640x480", 4)
    target = Target("board", clip.quad, clip.frames[0].image)
    steps = list(track(clip.source(), [target], build_settings({"max_width": WIDTH})))
    last = steps[-1].tracks[0]
    assert last.quad is not None and last.frame_from_template is not None
    np.testing.assert_allclose(last.quad, clip.truths[-1].quad, atol=3.0)
    carried = geometry.transform_points(last.frame_from_template, clip.quad)
    np.testing.assert_allclose(carried, last.quad, atol=0.05)


def test_poses_and_keyframes_are_in_full_pixels(make_clip: MakeClip) -> None:
    clip = make_clip("flight?size=640x480", 12, 0, 3)
    settings = build_settings({"max_width": WIDTH, "camera": "moving"})
    camera = MovingCamera(settings)
    steps = list(track(clip.source(), [], settings, camera=camera))
    graph = FullSizeGraph(camera.graph, full_from_small((640, 480), WIDTH))
    corners = geometry.image_quad((640, 480))
    for step, truth in zip(steps, clip.truths, strict=True):
        pose = step.camera.world_from_frame
        assert pose is not None
        error = geometry.transform_points(pose, corners) - geometry.transform_points(
            truth.world_from_frame, corners
        )
        assert np.abs(error).max() < 3.0
        known = graph.world_from_frame(step.frame.index)
        assert known is not None
        np.testing.assert_allclose(
            geometry.transform_points(known, corners),
            geometry.transform_points(pose, corners),
            atol=1.0,
        )
    assert set(graph.keyframes) == set(camera.graph.keyframes)
    first = graph.keyframes[min(graph.keyframes)].world_from_keyframe
    np.testing.assert_allclose(first, np.eye(3), atol=1e-9)


def test_smaller_frames_are_left_as_they_are(make_clip: MakeClip) -> None:
    clip = make_clip("board?size=320x240", 5)
    target = [Target("board", clip.quad)]
    plain, limited = (
        list(track(clip.source(), target, build_settings(values)))
        for values in ({}, {"max_width": 320})
    )
    for one, other in zip(plain, limited, strict=True):
        np.testing.assert_array_equal(one.tracks[0].quad, other.tracks[0].quad)


def test_frames_that_change_their_size_are_followed(make_clip: MakeClip) -> None:
    """From 640x480 to 480x360, both worked on at 320x240: quads in each frame's own pixels."""
    clip = make_clip("board?size=640x480", 6)
    frames = [
        replace(frame, image=resized(frame.image, (480, 360)), epoch=1)
        if frame.index >= 3
        else frame
        for frame in clip.frames
    ]
    settings = build_settings({"max_width": WIDTH, "camera": "moving"})
    steps = list(track(FrameList(frames), [Target("board", clip.quad)], settings))
    smaller = geometry.scaling(0.75)
    for step, truth in zip(steps[3:], clip.truths[3:], strict=True):
        found = step.tracks[0].quad
        assert found is not None
        expected = geometry.transform_points(smaller, truth.quad)
        np.testing.assert_allclose(found, expected, atol=3.0)
        assert step.camera.world_from_frame is None
    carried = geometry.transform_points(steps[-1].tracks[0].frame_from_template, clip.quad)
    np.testing.assert_allclose(carried, steps[-1].tracks[0].quad, atol=0.05)


def test_targets_that_do_not_fit_are_refused(make_clip: MakeClip) -> None:
    clip = make_clip("board?size=640x480", 1)
    settings = build_settings({"max_width": 64})
    small = Target("dot", geometry.box_quad(100, 100, 40, 40))
    with pytest.raises(TargetError, match=r"only 4 px .* raise --max-width"):
        next(track(clip.source(), [small], settings))
    outside = Target("far", geometry.box_quad(900, 100, 400, 400))
    with pytest.raises(TargetError, match="640x480 picture"):
        next(track(clip.source(), [outside], settings))
