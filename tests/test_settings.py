"""Settings: unknown and impossible values are refused in one line that helps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from streamtrack.errors import UsageError
from streamtrack.settings import (
    CAMERA_MODES,
    DESCRIPTORS,
    DETECTORS,
    METHODS,
    MODELS,
    Settings,
    VideoMode,
    build_settings,
    read_settings_file,
)


def test_nothing_given_is_the_defaults() -> None:
    assert build_settings({}) == Settings()


@pytest.mark.parametrize(
    ("section", "key", "names"),
    [
        ("features", "detector", DETECTORS),
        ("features", "descriptor", DESCRIPTORS),
        ("tracker", "method", METHODS),
        ("registration", "model", MODELS),
        ("recording", "video", tuple(VideoMode)),
    ],
)
def test_every_name_is_taken(section: str, key: str, names: tuple[str, ...]) -> None:
    for name in names:
        settings = build_settings({section: {key: name}})
        assert getattr(getattr(settings, section), key) == name


@pytest.mark.parametrize("camera", CAMERA_MODES)
def test_every_camera_mode_is_taken(camera: str) -> None:
    assert build_settings({"camera": camera}).camera == camera


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"features": {"detector": "haris"}}, "unknown detector 'haris': did you mean harris?"),
        ({"features": {"detector": "HARRIS"}}, "unknown detector 'HARRIS'"),
        ({"features": {"detector": 7}}, "unknown detector '7': known are harris, fast"),
        ({"features": {"detector": None}}, "unknown detector"),
        ({"features": {"descriptor": "freek"}}, "did you mean freak?"),
        ({"tracker": {"method": "hibrid"}}, "unknown method 'hibrid': did you mean hybrid?"),
        ({"registration": {"model": "afine"}}, "unknown model 'afine': did you mean affine?"),
        ({"camera": "movin"}, "unknown camera 'movin': did you mean moving?"),
        ({"recording": {"video": "jpg"}}, "unknown video 'jpg': did you mean jpeg?"),
        ({"recording": {"video": "x"}}, "known are auto, jpeg, av1, none"),
    ],
)
def test_unknown_names_suggest_the_nearest(values: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError) as caught:
        build_settings(values)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("values", "key"),
    [
        ({"feature": {"detector": "harris"}}, "feature"),
        ({"features": {"detektor": "harris"}}, "features.detektor"),
        ({"tracker": {"cam": 1}}, "tracker.cam"),
        ({"detector": "harris"}, "detector"),
        ({"": 1}, ""),
    ],
)
def test_unknown_keys_are_named(values: dict[str, Any], key: str) -> None:
    with pytest.raises(UsageError, match=f"unknown setting '{key}'"):
        build_settings(values)


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("section", "key", "value", "is_fine"),
    [
        ("features", "max_features", 8, True),
        ("features", "max_features", 7, False),
        ("features", "max_features", 100_000, True),
        ("features", "max_features", 100_001, False),
        ("features", "max_features", 10.5, False),
        ("features", "max_features", "many", False),
        ("features", "threshold", None, True),
        ("features", "threshold", 0.5, True),
        ("features", "threshold", "high", False),
        ("matching", "max_ratio", 1.0, True),
        ("matching", "max_ratio", 0.0, False),
        ("matching", "max_ratio", 1.01, False),
        ("matching", "max_ratio", NAN, False),
        ("registration", "inlier_threshold_px", 0.5, True),
        ("registration", "inlier_threshold_px", 0, False),
        ("registration", "inlier_threshold_px", -1, False),
        ("registration", "inlier_threshold_px", NAN, False),
        ("registration", "inlier_threshold_px", INF, False),
        ("registration", "min_inliers", 4, True),
        ("registration", "min_inliers", 3, False),
        ("registration", "seed", 0, True),
        ("registration", "seed", 2**31 - 1, True),
        ("registration", "seed", "one", False),
        ("recording", "jpeg_quality", 1, True),
        ("recording", "jpeg_quality", 0, False),
        ("recording", "jpeg_quality", 101, False),
        ("recording", "max_asset_mb", 0.1, True),
        ("recording", "max_asset_mb", 0, False),
    ],
)
def test_ranges(section: str, key: str, value: object, is_fine: bool) -> None:
    if is_fine:
        assert getattr(getattr(build_settings({section: {key: value}}), section), key) == value
        return
    with pytest.raises(UsageError, match=rf"^setting {section}\.{key} = ") as caught:
        build_settings({section: {key: value}})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", [7, "harris", None, []])
def test_a_section_that_is_no_table_is_refused(value: object) -> None:
    with pytest.raises(UsageError, match=r"^setting features = "):
        build_settings({"features": value})


def test_settings_are_frozen() -> None:
    settings = Settings()
    with pytest.raises(ValidationError, match="frozen"):
        settings.camera = "moving"  # type: ignore[misc]
    with pytest.raises(ValidationError, match="frozen"):
        settings.features.detector = "sift"  # type: ignore[misc]


def test_a_file_holds_what_build_settings_takes(tmp_path: Path) -> None:
    path = tmp_path / "settings.toml"
    path.write_text('camera = "moving"\n[features]\ndetector = "sift"\ndescriptor = "sift"\n')
    settings = build_settings(read_settings_file(path))
    assert settings.camera == "moving"
    assert settings.features.detector == settings.features.descriptor == "sift"
    assert settings.matching == Settings().matching


@pytest.mark.parametrize(
    "content",
    [
        b"camera = moving\n",
        b"[features\ndetector = 'sift'\n",
        b"[features]\ndetector = 'sift'\ndetector = 'orb'\n",
        b"\xff\xfe\x00 not text",
        b"\x00\x01\x02",
        None,
    ],
)
def test_a_file_that_cannot_be_read_is_one_line_with_its_name(
    tmp_path: Path, content: bytes | None
) -> None:
    path = tmp_path / "settings.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(UsageError, match=r"settings file .*settings\.toml") as caught:
        read_settings_file(path)
    assert "\n" not in str(caught.value)


def test_a_folder_is_no_settings_file(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="settings file"):
        read_settings_file(tmp_path)


def test_an_empty_file_is_the_defaults(tmp_path: Path) -> None:
    path = tmp_path / "empty.toml"
    path.write_text("")
    assert build_settings(read_settings_file(path)) == Settings()
