"""The keyframe graph: poses that follow their keyframes, pictures in bounded memory."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from conftest import MakePicture

from streamtrack import geometry
from streamtrack.camera.keyframes import KeyframeGraph
from streamtrack.errors import OutputError
from streamtrack.mosaic.types import Link
from streamtrack.pose_graph import ExpectedDrift
from streamtrack.types import Image, Matches, Model, Registration, Verdict

SIZE = (160, 120)
NO_ROWS = np.zeros(0, np.intp)


def picture(make_picture: MakePicture, seed: int = 1) -> Image:
    return np.dstack([make_picture(seed, SIZE)] * 3)


def graph_of(count: int, image: Image, **limits: float) -> KeyframeGraph:
    graph = KeyframeGraph(**limits)
    for i in range(count):
        graph.add_keyframe(10 * i, i / 3, image, geometry.translation(50.0 * i, 0))
    return graph


def link(a: int, b: int) -> Link:
    points = np.zeros((12, 2), np.float32)
    every = np.ones(12, np.bool_)
    registration = Registration(Verdict.OK, np.eye(3), Model.HOMOGRAPHY, every, 0.2)
    return Link(a, b, points, points, registration, Matches(NO_ROWS, NO_ROWS, points[:0, 0]), 0.2)


def test_keyframes_are_named_by_their_frames(make_picture: MakePicture) -> None:
    image = picture(make_picture)
    graph = graph_of(3, image)
    assert list(graph.keyframes) == [0, 10, 20]
    keyframe = graph.keyframes[20]
    assert (keyframe.index, keyframe.size_wh, keyframe.time_s) == (20, SIZE, pytest.approx(2 / 3))
    assert keyframe.centre == pytest.approx((100 + 79.5, 59.5))
    difference = keyframe.image().astype(int) - image
    assert keyframe.image().shape == image.shape and np.abs(difference).mean() < 4


def test_a_grey_picture_stays_grey(make_picture: MakePicture) -> None:
    graph = graph_of(1, make_picture(2, SIZE))
    assert graph.keyframes[0].image().shape == (120, 160)
    assert graph.keyframes[0].picture.grey().shape == (120, 160)


def test_frames_move_with_their_keyframe(make_picture: MakePicture) -> None:
    graph = graph_of(2, picture(make_picture))
    keyframe_from_frame = geometry.translation(3, 4)
    graph.add_frame(12, 10, keyframe_from_frame)
    np.testing.assert_allclose(graph.world_from_frame(12), geometry.translation(53, 4))
    graph.move({10: geometry.translation(60, 1)})
    np.testing.assert_allclose(graph.world_from_frame(12), geometry.translation(63, 5))
    np.testing.assert_allclose(graph.world_from_frame(10), geometry.translation(60, 1))
    assert graph.revision == 1
    assert graph.world_from_frame(11) is None


def test_frames_that_are_kept_move_however_old_they_are(make_picture: MakePicture) -> None:
    graph = KeyframeGraph(most_frames=20)
    graph.add_keyframe(0, 0.0, picture(make_picture), np.eye(3))
    for index in range(1, 200):
        graph.add_frame(index, 0, geometry.translation(index, 0))
        if index == 7:
            graph.keep(7)
    graph.move({0: geometry.translation(0, 5)})
    for index in (0, 7, 199):
        np.testing.assert_allclose(graph.world_from_frame(index), geometry.translation(index, 5))
    assert graph.world_from_frame(8) is None


def test_what_was_taken_since_is_carried_along(make_picture: MakePicture) -> None:
    graph = graph_of(4, picture(make_picture))
    graph.move({0: np.eye(3), 10: geometry.translation(57, 2)})
    np.testing.assert_allclose(graph.poses()[30], geometry.translation(157, 2))


def test_a_move_that_nobody_sees_is_no_revision(make_picture: MakePicture) -> None:
    graph = graph_of(2, picture(make_picture))
    graph.move({10: geometry.translation(50.001, 0)})
    assert graph.revision == 0


def test_what_was_handed_out_never_changes(make_picture: MakePicture) -> None:
    graph = graph_of(2, picture(make_picture))
    before, keyframe = graph.keyframes, graph.keyframes[10]
    graph.move({10: geometry.translation(80, 0)})
    graph.add_keyframe(20, 1.0, picture(make_picture), np.eye(3))
    assert list(before) == [0, 10]
    np.testing.assert_array_equal(keyframe.world_from_keyframe, geometry.translation(50, 0))


def test_readers_see_whole_states(make_picture: MakePicture) -> None:
    """Every keyframe moves by the same: a reader must never find two that do not agree."""
    graph = graph_of(12, picture(make_picture))
    torn: list[float] = []
    done = threading.Event()

    def read() -> None:
        while not done.is_set():
            x = [pose[0, 2] - 50.0 * i for i, pose in enumerate(graph.poses().values())]
            torn.append(max(x) - min(x))

    reader = threading.Thread(target=read)
    reader.start()
    for step in range(200):
        graph.move({10 * i: geometry.translation(50.0 * i + step, 0) for i in range(12)})
    done.set()
    reader.join()
    assert torn and max(torn) < 1e-9
    assert graph.revision == 199


def test_edges_say_what_hangs_together(make_picture: MakePicture) -> None:
    graph = graph_of(3, picture(make_picture))
    graph.add_link(link(0, 10), is_loop=False)
    graph.add_link(link(0, 20), is_loop=True)
    assert [(e.a, e.b, e.is_loop, e.inliers) for e in graph.edges] == [
        (0, 10, False, 12),
        (0, 20, True, 12),
    ]
    graph.drop_links({(0, 20)})
    assert [(e.a, e.b) for e in graph.edges] == [(0, 10)]
    assert len(graph.links) == 1


def test_pictures_beyond_the_limit_lie_in_a_file(make_picture: MakePicture) -> None:
    image = picture(make_picture, 3)
    graph = graph_of(6, image, max_pictures_mb=0.012)
    kept = [isinstance(k.picture.data, bytes) for k in graph.keyframes.values()]
    assert kept[0] and not kept[-1]
    first, last = graph.keyframes[0].image(), graph.keyframes[50].image()
    np.testing.assert_array_equal(first, last)
    graph.close()
    np.testing.assert_array_equal(graph.keyframes[0].image(), first)
    with pytest.raises((OutputError, OSError)):
        graph.keyframes[50].image()


class Sigmas:
    """What is known of keyframes by their numbers."""

    def __init__(self, sigmas: dict[int, float]) -> None:
        self.keyframes = sigmas

    def sigma_px(self, index: int) -> float:
        return self.keyframes[index]


@pytest.mark.parametrize(
    ("sigmas", "end", "most"),
    [({0: 0.0, 4: 2.0, 9: 1.0}, 1.0, 2.0), ({0: 0.0, 4: 2.0, 9: float("nan")}, 2.0, 2.0)],
)
def test_the_drift_told_is_that_of_the_last_known_keyframe(
    sigmas: dict[int, float], end: float, most: float
) -> None:
    assert ExpectedDrift.of(Sigmas(sigmas)) == ExpectedDrift(end, most)


@pytest.mark.parametrize("sigmas", [{}, {0: 0.0}, {0: 0.0, 3: float("nan")}])
def test_no_drift_is_told_of_what_is_not_known(sigmas: dict[int, float]) -> None:
    assert ExpectedDrift.of(Sigmas(sigmas)) is None
