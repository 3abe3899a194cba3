"""Alignment by grey values alone, from a pose that is nearly right."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from conftest import MakePicture

from streamtrack import geometry
from streamtrack.features import FeatureExtractor
from streamtrack.frame_view import FrameView
from streamtrack.settings import Settings
from streamtrack.tracking.alignment import Alignment, Hope, agreeing_share
from streamtrack.tracking.flow import FlowAligner
from streamtrack.tracking.prediction import rms_distance_px
from streamtrack.tracking.template import Template, make_template
from streamtrack.types import Frame, Image, Matrix, Model, Verdict

_SIZE = (320, 240)
_QUAD = geometry.box_quad(70, 50, 170, 130)
_POSE = np.array([[1.02, -0.05, 8.0], [0.06, 0.98, -4.0], [1e-4, -5e-5, 1.0]])
_HOPE = Hope(0.8, -1.0, 1.0, 0.0, 2.0)


@pytest.fixture(scope="module")
def picture(make_picture: MakePicture) -> Image:
    return make_picture(4, _SIZE)


def _seen(picture: Image, pose: Matrix) -> Image:
    return np.asarray(cv2.warpPerspective(picture, pose, _SIZE), np.uint8)


def _template(picture: Image) -> Template:
    return make_template("t", picture, _QUAD, FeatureExtractor(Settings().features))


def _align(
    picture: Image, frame: Image, guess: Matrix, hope: Hope = _HOPE, model: str = "auto"
) -> Alignment:
    settings = Settings().registration.model_copy(update={"model": model})
    aligner = FlowAligner(_template(picture), settings)
    view = FrameView(Frame(0, 0.0, frame), FeatureExtractor(Settings().features))
    return aligner.align_near(view, guess, hope, 2.0)


def _off_px(found: Alignment, pose: Matrix) -> float:
    assert found.registration.b_from_a is not None
    return rms_distance_px(found.registration.b_from_a, pose, _QUAD)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.4, -0.3), (2.0, 1.5), (-3.0, 2.0)])
def test_it_finds_the_pose_from_a_few_pixels_off(
    picture: Image, shift: tuple[float, float]
) -> None:
    guess = geometry.translation(*shift) @ _POSE
    found = _align(picture, _seen(picture, _POSE), guess)
    assert _off_px(found, _POSE) < 0.1
    assert agreeing_share(found) > 0.9
    assert found.registration.rmse_px < 0.2


def test_points_say_where_they_were_found_and_agree_with_the_pose(picture: Image) -> None:
    found = _align(picture, _seen(picture, _POSE), geometry.translation(1.0, 1.0) @ _POSE)
    true = geometry.transform_points(_POSE, found.template_points)
    off = np.linalg.norm(found.frame_points - true, axis=1)[found.registration.is_inlier]
    assert np.median(off) < 0.1


def test_light_and_contrast_may_change(picture: Image) -> None:
    dim = cv2.convertScaleAbs(_seen(picture, _POSE), alpha=0.6, beta=40)
    found = _align(picture, np.asarray(dim, np.uint8), _POSE)
    assert _off_px(found, _POSE) < 0.15


def test_something_else_is_refused(picture: Image, make_picture: MakePicture) -> None:
    found = _align(picture, make_picture(9, _SIZE), _POSE)
    assert found.registration.verdict is not Verdict.OK
    assert found.registration.b_from_a is None


def test_what_agrees_but_looks_worse_than_ever_is_no_hidden_plane(picture: Image) -> None:
    frame = _seen(picture, _POSE)
    frame[:, 175:] = 128
    hidden = replace(_HOPE, share=0.3, alike=0.5)
    assert _align(picture, frame, _POSE, hidden).registration.verdict is Verdict.OK
    turned = replace(hidden, alike=0.999)
    assert _align(picture, frame, _POSE, turned).registration.verdict is Verdict.LOW_CORRELATION


@pytest.mark.parametrize("model", [Model.TRANSLATION, Model.SIMILARITY, Model.AFFINE])
def test_it_keeps_to_the_model_that_was_asked_for(picture: Image, model: Model) -> None:
    pose = geometry.translation(5.0, -3.0)
    found = _align(picture, _seen(picture, pose), geometry.translation(4.0, -2.5), model=model)
    assert found.registration.model is model
    assert _off_px(found, pose) < 0.1


@pytest.mark.parametrize("shift", [(500.0, 0.0), (0.0, -400.0)])
def test_out_of_view_is_refused(picture: Image, shift: tuple[float, float]) -> None:
    found = _align(picture, _seen(picture, _POSE), geometry.translation(*shift))
    assert found.registration.b_from_a is None
