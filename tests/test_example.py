"""The README's example from Python: tracks, builds the mosaic and reads positions."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from streamtrack.sources.synthetic import SyntheticSource

EXAMPLE = """\
from pathlib import Path
from streamtrack import StreamMosaic, build_settings, make_camera, open_source, parse_targets, track

settings = build_settings({"camera": "auto"})
camera = make_camera(settings)
with open_source("car.mp4") as source, StreamMosaic(settings.mosaic, camera.graph) as mosaic:
    for step in track(source, parse_targets(["car=238,231,162,73"]), settings, camera=camera):
        mosaic.add(step.frame, step.camera, step.tracks)
        place = step.tracks[0].world
        if place is not None:  # target and camera are known
            print(step.frame.time_s, place.position, place.speed_px_s)
    camera.close()  # loops are closed, poses final
    mosaic.finish(Path("mosaic.png"))
print(place.path)
"""
SCENE = "synthetic://car?seed=2&frames=25"


def test_the_example_does_what_it_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(EXAMPLE.replace("car.mp4", SCENE), names)
    assert len(capsys.readouterr().out.splitlines()) > 25
    mosaic = cv2.imread("mosaic.png")
    assert mosaic is not None and mosaic.shape[1] > 640
    truth = SyntheticSource(SCENE).truth(24)
    quad = names["step"].tracks[0].world.quad
    there = truth.world_from_frame @ np.append(truth.quad.mean(axis=0), 1)
    np.testing.assert_allclose(quad.mean(axis=0), there[:2] / there[2], atol=3)


def test_the_readme_shows_the_same() -> None:
    readme = Path(__file__).parents[1] / "README.md"
    blocks = re.findall(r"```python\n(.*?)```", readme.read_text(), flags=re.S)
    shown = [block for block in blocks if "StreamMosaic" in block]
    assert shown in ([], [EXAMPLE])
