"""Poses of frames against keyframes, in bounded memory."""

from __future__ import annotations

import numpy as np

from streamtrack import geometry
from streamtrack.camera.frame_poses import FramePose, FramePoses


def pose(index: int) -> FramePose:
    return FramePose(index // 10, geometry.translation(index / 3, -index))


def is_pose_of(found: FramePose | None, index: int) -> bool:
    expected = pose(index)
    return (
        found is not None
        and found.keyframe == expected.keyframe
        and np.array_equal(found.keyframe_from_frame, expected.keyframe_from_frame)
    )


def test_every_frame_is_found_again_in_whatever_order_it_came() -> None:
    poses, indices = FramePoses(), [5, 7, 20, 6, 3, 21]
    for index in indices:
        poses.add(index, pose(index))
    assert len(poses) == len(indices)
    assert all(is_pose_of(poses.get(index), index) for index in indices)
    assert [poses.get(index) for index in (0, 4, 8, 22)] == [None] * 4


def test_the_last_word_on_a_frame_counts() -> None:
    poses = FramePoses()
    for index in (1, 2, 3):
        poses.add(index, pose(index))
    poses.keep(2)
    poses.add(2, pose(99))
    assert len(poses) == 3
    assert is_pose_of(poses.get(2), 99) and is_pose_of(poses.get(3), 3)


def test_the_oldest_are_forgotten_and_those_to_be_kept_are_not() -> None:
    poses = FramePoses(most=100)
    for index in range(1000):
        poses.add(index, pose(index))
        assert len(poses) <= 125
        if index % 300 == 0:
            poses.keep(index)
    assert all(is_pose_of(poses.get(index), index) for index in (0, 300, 600, 900, 901, 999))
    assert poses.get(1) is None and poses.get(850) is None
    poses.keep(1)
    assert poses.get(1) is None
