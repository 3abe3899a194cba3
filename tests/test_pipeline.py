"""The loop: one frame in, one step out, and nothing read that is not needed."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from conftest import Clip, FrameList, MakePicture

from streamtrack.errors import SourceError, TargetError, UsageError
from streamtrack.features import FeatureExtractor
from streamtrack.geometry import grey_of
from streamtrack.pipeline import track
from streamtrack.settings import METHODS, build_settings
from streamtrack.sources.base import FrameSource
from streamtrack.targets import Target
from streamtrack.types import Frame, Step, TrackState

MakeClip = Callable[..., Clip]
BOARD = "board?size=320x240"


class CountingSource(FrameList):
    """Counts the frames that were taken, and may break after some of them."""

    def __init__(self, clip: Clip, breaks_after: int | None = None) -> None:
        super().__init__(clip.frames)
        self._clip = clip
        self._breaks_after = breaks_after
        self.taken = 0

    def __iter__(self) -> Iterator[Frame]:
        for frame in self._clip.frames:
            if self.taken == self._breaks_after:
                raise SourceError("the camera was unplugged")
            self.taken += 1
            yield frame


@pytest.fixture(scope="module")
def clip(make_clip: MakeClip) -> Clip:
    return make_clip(BOARD, 14)


def indices(steps: list[Step]) -> list[int]:
    return [step.frame.index for step in steps]


def test_the_test_source_is_a_source(clip: Clip) -> None:
    assert isinstance(clip.source(), FrameSource)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("camera", ["fixed", "moving"])
def test_every_frame_is_one_step(clip: Clip, method: str, camera: str) -> None:
    settings = build_settings({"tracker": {"method": method}, "camera": camera})
    targets = [Target("a", clip.quad), Target("b", clip.quad)]
    steps = list(track(clip.source(), targets, settings, frames=4))
    assert len(steps) == 4
    for step, frame in zip(steps, clip.frames, strict=False):
        assert step.frame is frame
        assert [t.name for t in step.tracks] == ["a", "b"]
        assert all(t.state is TrackState.TRACKING for t in step.tracks)
        assert step.camera.world_from_frame is not None
        assert ("detect" in step.stage_ms) == (step.features is not None)
        assert step.stage_ms["camera"] >= 0  # a fixed camera is checked, which takes time too
        assert all(ms >= 0 for ms in step.stage_ms.values())
        parts = sum(ms for name, ms in step.stage_ms.items() if name != "total")
        assert step.stage_ms["total"] == max(step.stage_ms.values())
        assert parts > 0


def test_features_are_detected_only_where_they_are_needed(clip: Clip) -> None:
    targets = [Target("t", clip.quad)]
    by_flow = list(track(clip.source(), targets, frames=3))
    assert all(step.features is None and "detect" not in step.stage_ms for step in by_flow)
    settings = build_settings({"tracker": {"method": "detect"}})
    for step in track(clip.source(), targets, settings, frames=3):
        assert step.features is not None and len(step.features) > 50
    moving = build_settings({"camera": "moving"})
    for step in track(clip.source(), targets, moving, frames=3):
        assert step.camera.world_from_frame is not None and "camera" in step.stage_ms
        assert step.features is None, "a camera that is followed needs no features"


@pytest.mark.parametrize(
    ("start", "step", "frames", "expected"),
    [
        (0, 1, None, list(range(14))),
        (0, 1, 3, [0, 1, 2]),
        (0, 1, 100, list(range(14))),
        (4, 1, 2, [4, 5]),
        (4, 3, None, [4, 7, 10, 13]),
        (4, 3, 2, [4, 7]),
        (4, 3, 99, [4, 7, 10, 13]),
        (13, 1, None, [13]),
        (13, 5, 4, [13]),
        (0, 100, None, [0]),
        (0, 1, 0, []),
        (3, 2, 0, []),
    ],
)
def test_start_step_and_frames(
    clip: Clip, start: int, step: int, frames: int | None, expected: list[int]
) -> None:
    """Steps carry the source's own indices and times."""
    quad = clip.truths[start].quad
    steps = list(track(clip.source(), [Target("t", quad)], start=start, step=step, frames=frames))
    assert indices(steps) == expected
    assert [s.frame.time_s for s in steps] == [clip.frames[i].time_s for i in expected]
    assert all(s.tracks[0].state is TrackState.TRACKING for s in steps)


@pytest.mark.parametrize(("start", "step"), [(14, 1), (15, 1), (1000, 7)])
def test_a_start_beyond_the_end_is_refused(clip: Clip, start: int, step: int) -> None:
    with pytest.raises(UsageError, match=f"no frame {start}: it ended before"):
        list(track(clip.source(), [Target("t", clip.quad)], start=start, step=step))


@pytest.mark.parametrize(("start", "step", "frames"), [(-1, 1, None), (0, 0, None), (0, -1, 3)])
def test_impossible_ranges_are_refused(
    clip: Clip, start: int, step: int, frames: int | None
) -> None:
    with pytest.raises((UsageError, ValueError)):
        list(track(clip.source(), [], start=start, step=step, frames=frames))


def test_a_source_without_frames_has_no_steps() -> None:
    assert list(track(FrameList([]), [])) == []


@pytest.mark.parametrize(
    ("start", "step", "frames", "most"), [(0, 1, 3, 3), (2, 1, 2, 4), (0, 5, 2, 6), (1, 4, 3, 10)]
)
def test_no_frame_is_taken_after_the_last_one_used(
    clip: Clip, start: int, step: int, frames: int, most: int
) -> None:
    """A live camera would otherwise be waited for in vain."""
    source = CountingSource(clip)
    list(track(source, [], start=start, step=step, frames=frames))
    assert source.taken == most


def test_frames_are_taken_as_they_are_asked_for(clip: Clip) -> None:
    source = CountingSource(clip)
    steps = track(source, [Target("t", clip.quad)])
    assert source.taken == 0
    for n in range(1, 4):
        next(steps)
        assert source.taken == n
    steps.close()
    assert source.taken == 3


def test_a_source_that_breaks_ends_the_steps_after_what_it_gave(clip: Clip) -> None:
    seen = []
    with pytest.raises(SourceError, match="unplugged"):
        for step in track(CountingSource(clip, breaks_after=3), [Target("t", clip.quad)]):
            seen.append(step)
    assert indices(seen) == [0, 1, 2]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"features": {"detector": "orb", "descriptor": "sift"}}, "does not fit"),
        ({"features": {"threshold": -1.0}}, "threshold"),
    ],
)
def test_settings_that_cannot_work_are_refused_before_any_frame(
    clip: Clip, settings: dict[str, object], message: str
) -> None:
    source = CountingSource(clip)
    with pytest.raises(UsageError, match=message):
        next(track(source, [Target("t", clip.quad)], build_settings(settings)))
    assert source.taken == 0


@pytest.mark.parametrize(
    "quad",
    [
        np.array([[400, 10], [450, 10], [450, 60], [400, 60]], np.float32),
        np.array([[10, 10], [14, 10], [14, 60], [10, 60]], np.float32),
        np.array([[-90, 10], [20, 10], [20, 60], [-90, 60]], np.float32),
    ],
)
def test_a_target_that_is_not_in_the_first_frame_is_refused(clip: Clip, quad: np.ndarray) -> None:
    with pytest.raises(TargetError, match="'lost'"):
        next(track(clip.source(), [Target("fine", clip.quad), Target("lost", quad)]))


def test_one_frame_is_enough(clip: Clip) -> None:
    (step,) = track(FrameList(clip.frames[:1]), [Target("t", clip.quad)])
    assert step.tracks[0].state is TrackState.TRACKING


def test_the_frames_are_left_as_they_are(clip: Clip) -> None:
    before = [frame.image.copy() for frame in clip.frames[:4]]
    settings = build_settings({"camera": "moving"})
    list(track(clip.source(), [Target("t", clip.quad)], settings, frames=4))
    for frame, image in zip(clip.frames, before, strict=False):
        np.testing.assert_array_equal(frame.image, image)


def test_a_target_never_seen_is_looked_for_with_all_features(
    make_clip: Callable[..., Clip], make_picture: MakePicture
) -> None:
    """A part of them may never be enough to find it."""
    clip, settings = make_clip("board", 4), build_settings({})
    extractor = FeatureExtractor(settings.features)
    elsewhere = Target("t", picture=make_picture(77, (200, 150)))
    for step in track(clip.source(), [elsewhere], settings):
        assert step.tracks[0].state is TrackState.SEARCHING
        assert step.features is not None
        assert len(step.features) == len(extractor.extract(grey_of(step.frame.image)))
