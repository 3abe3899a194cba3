"""What lies over every picture is found, and neither holds the camera nor is painted."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from conftest import Clip, FrameList

from streamtrack import geometry
from streamtrack.camera.auto import make_camera
from streamtrack.camera.view_levels import filled
from streamtrack.evaluation import corner_error
from streamtrack.features import FeatureExtractor
from streamtrack.frame_view import FrameView
from streamtrack.mosaic.stream.growing import StreamMosaic
from streamtrack.pipeline import track
from streamtrack.settings import build_settings
from streamtrack.targets import parse_targets
from streamtrack.types import CameraPose, Image, Mask, TrackState

MakeClip = Callable[..., Clip]
FLIGHT = "flight?size=320x240&frames=40&step=12"
FRAMES = 26


def letterboxed(image: Image) -> Image:
    image = image.copy()
    image[:30] = image[-30:] = 0
    return image


def titled(image: Image) -> Image:
    image = image.copy()
    for row, text in enumerate(("ALT 120 M", "SPD 14 KMH", "2026-05-01")):
        cv2.putText(image, text, (8, 24 + 22 * row), 0, 0.6, (255, 255, 255), 2)
    return image


def covered_by(change: Callable[[Image], Image], image: Image) -> Mask:
    """Where a change of the picture shows."""
    return np.asarray(np.abs(change(image).astype(int) - image).max(axis=2) > 40, bool)


def seen(source: FrameList, camera: str) -> list[CameraPose]:
    settings = build_settings({"camera": camera})
    extractor, estimator = FeatureExtractor(settings.features), make_camera(settings)
    found = [estimator.update(FrameView(frame, extractor), ()) for frame in source]
    estimator.close()
    return found


@pytest.mark.parametrize("camera", ["moving", "auto"])
@pytest.mark.parametrize(("change", "limit_px"), [(letterboxed, 1.5), (titled, 1.0)])
def test_it_is_covered_and_does_not_hold_the_camera(
    change: Callable[[Image], Image], limit_px: float, camera: str, make_clip: MakeClip
) -> None:
    clip = make_clip(FLIGHT, FRAMES)
    images = {frame.index: change(frame.image) for frame in clip.frames}
    found = seen(clip.with_images(images), camera)
    world = geometry.inverted(clip.truths[0].world_from_frame)
    for pose, truth in zip(found, clip.truths, strict=True):
        truth_pose = geometry.normalized(world @ truth.world_from_frame)
        assert corner_error(pose.world_from_frame, truth_pose, (320, 240)) < limit_px
    last = clip.frames[-1].image
    over = covered_by(change, last)
    hidden = filled(found[-1].overlay, np.eye(3), last.shape[:2])
    assert (hidden & over).sum() > 0.9 * over.sum()
    assert hidden.mean() < over.mean() + 0.25  # the scene is left


@pytest.mark.parametrize("scene", [FLIGHT, "flight?size=320x240&frames=40&seed=5", "car"])
def test_a_scene_that_moves_is_not_taken_for_it(scene: str, make_clip: MakeClip) -> None:
    clip = make_clip(scene, 16)
    assert all(pose.overlay == () for pose in seen(clip.source(), "moving"))


def mosaic_of(source: FrameList) -> Image:
    """The canvas (300, 400, 3) of a stream, world pixels from (-40, -30) on; black is unseen."""
    settings = build_settings({"camera": "moving"})
    extractor, camera = FeatureExtractor(settings.features), make_camera(settings)
    with StreamMosaic(settings.mosaic, camera.graph) as mosaic:
        for frame in source:
            mosaic.add(frame, camera.update(FrameView(frame, extractor), ()))
        camera.close()
        mosaic.catch_up()
        view = mosaic.view()
    moved = geometry.translation(40, 30) @ view.world_from_preview
    return np.asarray(cv2.warpPerspective(view.preview, moved, (400, 300)), np.uint8)


@pytest.mark.parametrize("change", [letterboxed, titled])
def test_the_mosaic_shows_the_scene_alone(
    change: Callable[[Image], Image], make_clip: MakeClip
) -> None:
    clip = make_clip(FLIGHT, FRAMES)
    images = {frame.index: change(frame.image) for frame in clip.frames}
    plain, found = mosaic_of(clip.source()), mosaic_of(clip.with_images(images))
    both = (plain.max(axis=2) > 0) & (found.max(axis=2) > 0)
    assert both.mean() > 0.4
    off = np.abs(plain.astype(int) - found).max(axis=2)[both] > 60
    assert off.mean() < 0.02


@pytest.mark.parametrize("change", [letterboxed, titled])
def test_it_is_nothing_that_moves_by_itself(
    change: Callable[[Image], Image], make_clip: MakeClip
) -> None:
    """Against a ground that moves, what stands in the picture would seem to."""
    clip = make_clip(FLIGHT, FRAMES)
    images = {frame.index: change(frame.image) for frame in clip.frames}
    settings = build_settings({"camera": "moving"})
    steps = list(track(clip.with_images(images), parse_targets(["auto"]), settings))
    known = next(n for n, step in enumerate(steps) if step.camera.overlay)
    seen = [t for step in steps[known:] for t in step.tracks if t.state is TrackState.TRACKING]
    assert known <= 12
    assert seen == []
