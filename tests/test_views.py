"""Targets that are not flat: followed by how they looked lately, never by what covers them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from conftest import FrameList, MakePicture

from streamtrack import geometry
from streamtrack.pipeline import track
from streamtrack.settings import build_settings
from streamtrack.targets import Target
from streamtrack.types import Frame, Image, Track, TrackState

_FRAMES = 40
_BULGE_PX = 16.0
_SIZE = (320, 240)
_BOX = (90.0, 60.0, 110.0, 110.0)


def _bent_clip(make_picture: MakePicture) -> list[Image]:
    """A textured box that drifts to the right while its surface bulges in and out."""
    background, texture = make_picture(1, _SIZE), make_picture(2, _SIZE)
    x, y = np.meshgrid(np.arange(_SIZE[0], dtype=np.float32), np.arange(_SIZE[1], dtype=np.float32))
    left, top, width, height = _BOX
    across = (y - (top + height / 2)) / height
    images = []
    for number in range(_FRAMES):
        bulge = _BULGE_PX * np.sin(number / 9.0) * np.cos(2 * np.pi * across)
        seen = x - number - bulge.astype(np.float32)
        image = background.copy()
        inside = (x - number >= left) & (x - number < left + width)
        inside &= (y >= top) & (y < top + height)
        moved = cv2.remap(texture, seen, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        image[inside] = moved[inside]
        images.append(image)
    return images


def _follow(images: list[Image], model: str = "auto") -> list[Track]:
    source = FrameList([Frame(i, i / 30, image) for i, image in enumerate(images)])
    settings = build_settings({"registration": {"model": model}})
    target = Target("box", geometry.box_quad(*_BOX))
    return [step.tracks[0] for step in track(source, [target], settings)]


@pytest.fixture(scope="module")
def bent(make_picture: MakePicture) -> list[Image]:
    return _bent_clip(make_picture)


def test_a_bending_target_is_kept_and_the_box_stays_on_it(bent: list[Image]) -> None:
    tracks = _follow(bent)
    kept = [t.state is TrackState.TRACKING for t in tracks]
    assert np.mean(kept) >= 0.95
    assert any(t.means == "body" for t in tracks)
    left, top, width, height = _BOX
    for number, found in enumerate(tracks):
        if found.quad is not None:
            centre = found.quad.mean(axis=0)
            true = np.array([left + width / 2 + number, top + height / 2])
            assert np.linalg.norm(centre - true) < _BULGE_PX + 2, f"frame {number}"


def test_a_target_said_to_be_flat_is_not_followed_by_views(bent: list[Image]) -> None:
    assert all(found.means != "view" for found in _follow(bent, "homography"))


def test_what_covers_a_target_never_becomes_it(
    bent: list[Image], make_picture: MakePicture
) -> None:
    """The target stops; a sheet slides over it and on; where the sheet goes is no track."""
    still = [bent[0]] * _FRAMES
    sheet = make_picture(5, _SIZE)
    covered = []
    for number, image in enumerate(still):
        picture, edge = image.copy(), min(8 * number, 250)
        picture[:, :edge] = np.roll(sheet, edge, axis=1)[:, :edge]
        covered.append(picture)
    tracks = _follow(covered)
    box = geometry.box_quad(*_BOX)
    for number, found in enumerate(tracks):
        if found.quad is not None:
            assert np.abs(found.quad - box).max() < 6.0, f"frame {number}"
    assert tracks[-1].state is not TrackState.TRACKING
