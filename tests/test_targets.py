"""What users write to name a target, right and wrong."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from streamtrack import geometry
from streamtrack.errors import StreamtrackError, TargetError, UsageError
from streamtrack.targets import Target, check_quad_in_picture, parse_targets
from streamtrack.types import Points

SIZE = (320, 240)
QUAD = "0,0,90,0,80,60,5,50"


def quad_of(text: str) -> Points:
    return np.array([float(v) for v in text.split(",")], np.float32).reshape(4, 2)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory, with pictures 40 wide and 30 high and some that are none."""
    picture = np.arange(40 * 30 * 3, dtype=np.uint32).astype(np.uint8).reshape(30, 40, 3)
    for name in ("logo.png", "my logo.png", "a=b.png", "at@home.png", "5", "ü.png", "p@1,2,3,4"):
        data = cv2.imencode(".png", picture)[1]
        (tmp_path / name).write_bytes(data.tobytes())
    (tmp_path / "empty.png").write_bytes(b"")
    (tmp_path / "text.png").write_text("no picture")
    (tmp_path / "half.png").write_bytes(cv2.imencode(".png", picture)[1].tobytes()[:40])
    (tmp_path / "folder").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("text", "name", "quad"),
    [
        ("10,20,30,40", "target", geometry.box_quad(10, 20, 30, 40)),
        ("10.5,-2,30,4e1", "target", geometry.box_quad(10.5, -2, 30, 40)),
        (" 10, 20 ,30,40 ", "target", geometry.box_quad(10, 20, 30, 40)),
        ("car=10,20,30,40", "car", geometry.box_quad(10, 20, 30, 40)),
        (" my car = 10,20,30,40", "my car", geometry.box_quad(10, 20, 30, 40)),
        ("=10,20,30,40", None, None),
        (QUAD, "target", quad_of(QUAD)),
        (f"page={QUAD}", "page", quad_of(QUAD)),
        ("0,0,5,50,80,60,90,0", "target", quad_of("0,0,5,50,80,60,90,0")),
    ],
)
def test_boxes_and_quads(text: str, name: str | None, quad: Points | None) -> None:
    if name is None:
        with pytest.raises(UsageError):
            parse_targets([text])
        return
    (target,) = parse_targets([text])
    assert target.name == name
    assert target.picture is None
    assert target.quad is not None and quad is not None
    np.testing.assert_allclose(target.quad, quad)
    assert target.quad.dtype == np.float32


@pytest.mark.parametrize(
    ("text", "name", "quad"),
    [
        ("logo.png", "target", None),
        ("my logo.png", "target", None),
        ("logo=my logo.png", "logo", None),
        ("a=b.png", "target", None),
        ("x=a=b.png", "x", None),
        ("at@home.png", "target", None),
        ("./logo.png", "target", None),
        ("ü=ü.png", "ü", None),
        ("./5", "target", None),
        ("logo.png@1,2,20,20", "target", geometry.box_quad(1, 2, 20, 20)),
        ("logo=logo.png@1,2,20,20", "logo", geometry.box_quad(1, 2, 20, 20)),
        ("at@home.png@1,2,20,20", "target", geometry.box_quad(1, 2, 20, 20)),
        ("x=a=b.png@1,2,20,20", "x", geometry.box_quad(1, 2, 20, 20)),
        ("a=b.png@1,2,20,20", "target", geometry.box_quad(1, 2, 20, 20)),
        ("logo.png@0,0,30,0,30,20,0,20", "target", geometry.box_quad(0, 0, 30, 20)),
    ],
)
def test_pictures(folder: Path, text: str, name: str, quad: Points | None) -> None:
    (target,) = parse_targets([text])
    assert target.name == name
    assert target.picture is not None
    assert target.picture.shape == (30, 40, 3)
    if quad is None:
        assert target.quad is None
    else:
        assert target.quad is not None
        np.testing.assert_allclose(target.quad, quad)


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        ("", UsageError, ""),
        (" ", UsageError, ""),
        ("car=", UsageError, ""),
        ("5", UsageError, "x,y,w,h"),
        ("10,20", UsageError, "x,y,w,h"),
        ("10,20,30", UsageError, "x,y,w,h"),
        ("10,20,30,40,50", UsageError, "x,y,w,h or x1,y1"),
        ("1,2,3,4,5,6,7", UsageError, "x,y,w,h"),
        ("1,2,3,4,5,6,7,8,9", UsageError, "x,y,w,h"),
        ("10,20,30,", UsageError, "x,y,w,h"),
        ("10;20;30;40", UsageError, "x,y,w,h"),
        ("10,20,30,4O", UsageError, "x,y,w,h"),
        ("10,20,0,40", UsageError, "positive"),
        ("10,20,30,0", UsageError, "positive"),
        ("10,20,-30,40", UsageError, "positive"),
        ("nan,20,30,40", UsageError, "finite"),
        ("10,inf,30,40", UsageError, "finite"),
        ("10,20,30,-inf", UsageError, "finite"),
        ("1e999,20,30,40", UsageError, "finite"),
        ("1e300,20,30,40", UsageError, ""),
        ("0,0,90,0,nan,60,5,50", UsageError, "finite"),
        ("0,0,90,0,20,10,5,50", UsageError, "convex"),
        ("0,0,90,60,90,0,0,60", UsageError, "convex"),
        ("0,0,10,0,20,0,30,0", UsageError, "convex"),
        ("5,5,5,5,5,5,5,5", UsageError, "convex"),
        ("missing.png", UsageError, "neither numbers nor a file"),
        ("car=missing.png", UsageError, "neither numbers nor a file"),
        ("missing.png@1,2,3,4", UsageError, "neither numbers nor a file"),
        ("logo.png@1,2,0,4", UsageError, "positive"),
        ("logo.png@1,2,3", UsageError, "x,y,w,h"),
        ("logo.png@nan,2,30,4", UsageError, "finite"),
        ("logo.png@here", UsageError, "neither numbers nor a file"),
        ("empty.png", TargetError, "empty.png cannot be read: give a PNG or JPEG"),
        ("text.png", TargetError, "text.png cannot be read"),
        ("logo=text.png", TargetError, "text.png cannot be read"),
        ("half.png", TargetError, "half.png cannot be read"),
        ("folder", TargetError, "folder cannot be read"),
        ("x" * 5000, UsageError, "neither numbers nor a file"),
        ("bad\0name.png", UsageError, "control characters"),
    ],
)
def test_what_is_no_target_is_refused(
    folder: Path, text: str, error: type[StreamtrackError], message: str
) -> None:
    with pytest.raises(error) as caught:
        parse_targets([text])
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("texts", "names"),
    [
        ([], []),
        (["1,2,30,40"], ["target"]),
        (["1,2,30,40", "5,6,30,40"], ["target1", "target2"]),
        (["a=1,2,30,40", "5,6,30,40"], ["a", "target2"]),
        (["a=1,2,30,40", "b=1,2,30,40"], ["a", "b"]),
        (["a=1,2,30,40", "A=1,2,30,40"], ["a", "A"]),
    ],
)
def test_names(texts: list[str], names: list[str]) -> None:
    assert [target.name for target in parse_targets(texts)] == names


@pytest.mark.parametrize(
    ("texts", "name"),
    [
        (["a=1,2,30,40", "a=5,6,30,40"], "a"),
        (["a=1,2,30,40", " a =5,6,30,40"], "a"),
        (["target2=1,2,30,40", "5,6,30,40"], "target2"),
        (["a=1,2,30,40", "b=1,2,30,40", "a=1,2,30,40"], "a"),
    ],
)
def test_two_targets_of_one_name_are_refused(texts: list[str], name: str) -> None:
    with pytest.raises(UsageError, match=f"two targets are called '{name}'.*NAME="):
        parse_targets(texts)


def test_a_target_is_something() -> None:
    with pytest.raises(ValueError, match="a quad, a picture or both"):
        Target("nothing")


@pytest.mark.parametrize(
    "quad",
    [
        geometry.box_quad(10, 10, 8, 8),
        geometry.box_quad(10, 10, 300, 8),
        geometry.image_quad(SIZE),
        geometry.box_quad(-0.5, -0.5, *SIZE),
        geometry.box_quad(-40, 20, 100, 50),
        geometry.box_quad(-20, -20, 360, 280),
        geometry.box_quad(10, 10, 50, 50)[::-1],
        np.array([[50, 10], [90, 50], [50, 90], [10, 50]], np.float32),
    ],
)
def test_quads_that_can_be_tracked(quad: Points) -> None:
    check_quad_in_picture("logo", quad, SIZE)


@pytest.mark.parametrize(
    ("quad", "message"),
    [
        (geometry.box_quad(10, 10, 7.9, 50), "only 8 px wide or high: it needs at least 8"),
        (geometry.box_quad(10, 10, 50, 2), "only 2 px wide or high"),
        (geometry.box_quad(10, 10, 0, 0), "only 0 px"),
        (geometry.box_quad(400, 10, 50, 50), "lies outside the 320x240 picture"),
        (geometry.box_quad(10, -90, 50, 50), "lies outside"),
        (geometry.box_quad(-60, 20, 100, 50), "mostly outside"),
        (geometry.box_quad(300, 220, 50, 50), "mostly outside"),
        (geometry.box_quad(-1000, -1000, 3000, 3000), "mostly outside"),
        (np.full((4, 2), np.nan, np.float32), ""),
        (np.array([[10, 10], [60, 10], [np.nan, 60], [10, 60]], np.float32), ""),
        (np.array([[10, 10], [np.inf, 10], [np.inf, 60], [10, 60]], np.float32), ""),
        (np.array([[10, 10], [60, 60], [60, 10], [10, 60]], np.float32), ""),
        (np.array([[10, 10], [60, 10], [20, 20], [10, 60]], np.float32), ""),
        (np.array([[0, 0], [50, 0], [100, 0], [150, 0]], np.float32), ""),
    ],
)
def test_quads_that_cannot_be_tracked(quad: Points, message: str) -> None:
    with pytest.raises(TargetError, match="logo") as caught:
        check_quad_in_picture("logo", quad, SIZE)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
