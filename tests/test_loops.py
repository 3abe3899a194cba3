"""Loop closure on flights that come back to where they began."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from conftest import Clip

from streamtrack import geometry
from streamtrack.camera.moving import MovingCamera
from streamtrack.evaluation import corner_error
from streamtrack.features import FeatureExtractor
from streamtrack.frame_view import FrameView
from streamtrack.settings import build_settings
from streamtrack.types import CameraPose, Matrix

MakeClip = Callable[..., Clip]
LOOP = "flight?size=320x240&frames=64&step=36"
SETTINGS = build_settings({"camera": "moving"})


def fly(clip: Clip, is_live: bool = False) -> tuple[MovingCamera, list[CameraPose]]:
    extractor = FeatureExtractor(SETTINGS.features)
    camera = MovingCamera(SETTINGS, is_live=is_live)
    found = [camera.update(FrameView(frame, extractor), ()) for frame in clip.frames]
    camera.close()
    return camera, found


def true_pose(clip: Clip, i: int) -> Matrix:
    first = geometry.inverted(clip.truths[0].world_from_frame)
    return geometry.normalized(first @ clip.truths[i].world_from_frame)


def final_errors(clip: Clip, camera: MovingCamera) -> list[float]:
    errors = []
    for i in range(len(clip.frames)):
        pose = camera.graph.world_from_frame(i)
        assert pose is not None
        errors.append(corner_error(pose, true_pose(clip, i), clip.frames[0].size_wh))
    return errors


@pytest.fixture(scope="module")
def flown(make_clip: MakeClip) -> tuple[Clip, MovingCamera, list[CameraPose]]:
    clip = make_clip(LOOP, 64)
    camera, found = fly(clip)
    return clip, camera, found


def test_the_flight_closes_on_itself(flown: tuple[Clip, MovingCamera, list[CameraPose]]) -> None:
    clip, camera, found = flown
    graph = camera.graph
    assert any(edge.is_loop for edge in graph.edges)
    errors = final_errors(clip, camera)
    assert np.mean(errors) < 1.0
    assert errors[-1] < 0.3
    assert sum(pose.is_keyframe for pose in found) == len(graph.keyframes) < len(clip.frames) / 2


def test_errors_are_expected(flown: tuple[Clip, MovingCamera, list[CameraPose]]) -> None:
    clip, camera, found = flown
    sigmas = [camera.graph.sigma_px(i) for i in range(len(clip.frames))]
    assert np.isfinite([pose.sigma_px for pose in found]).all()
    assert sigmas[0] < 1e-9 and sigmas[-1] < max(sigmas)
    assert np.isnan(camera.graph.sigma_px(10_000))
    errors = np.array(final_errors(clip, camera))
    assert np.mean(errors[1:] < 3 * np.array(sigmas[1:])) > 0.9


def test_edges_agree_with_the_truth(flown: tuple[Clip, MovingCamera, list[CameraPose]]) -> None:
    clip, camera, _ = flown
    for link in camera.graph.links:
        assert link.b_from_a is not None
        truth = geometry.inverted(true_pose(clip, link.b)) @ true_pose(clip, link.a)
        error = corner_error(link.b_from_a, geometry.normalized(truth), clip.frames[0].size_wh)
        assert error < 1.0, (link.a, link.b)


def test_every_frame_hangs_on_a_keyframe(
    flown: tuple[Clip, MovingCamera, list[CameraPose]],
) -> None:
    _, camera, found = flown
    for i, pose in enumerate(found):
        assert pose.keyframe in camera.graph.keyframes
        assert (pose.keyframe == i) == pose.is_keyframe
        frame = camera.graph.frame_pose(i)
        assert frame is not None and frame.keyframe in camera.graph.keyframes


def test_a_thread_of_its_own_finds_the_same_world(make_clip: MakeClip) -> None:
    clip = make_clip(LOOP, 64)
    camera, found = fly(clip, is_live=True)
    assert all(pose.world_from_frame is not None for pose in found)
    errors = final_errors(clip, camera)
    assert np.mean(errors) < 1.5 and errors[-1] < 0.5


def test_closing_twice_is_harmless(make_clip: MakeClip) -> None:
    camera, _ = fly(make_clip(LOOP, 8), is_live=True)
    before = camera.graph.poses()
    camera.close()
    for index, pose in camera.graph.poses().items():
        np.testing.assert_allclose(pose, before[index], atol=1e-3)


def test_a_failure_in_the_thread_is_not_lost(
    make_clip: MakeClip, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("streamtrack.camera.keyframe_links.overlapping", lambda *_: 1 / 0)
    clip = make_clip(LOOP, 64)
    with pytest.raises(ZeroDivisionError):
        fly(clip, is_live=True)
