"""Settings of every stage; command-line flags and a TOML file build the same objects.

Unknown names are refused. All settings are frozen: a run has one set from start to end.
"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Any, Literal, Self, TypeAlias, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from streamtrack.errors import UsageError, unknown_name

Detector: TypeAlias = Literal["harris", "fast", "agast", "gftt", "brisk", "orb", "sift", "akaze"]
Descriptor: TypeAlias = Literal["freak", "brisk", "orb", "teblid", "sift", "akaze"]
Method: TypeAlias = Literal["hybrid", "detect"]
ModelChoice: TypeAlias = Literal["auto", "homography", "affine", "similarity", "translation"]
CameraMode: TypeAlias = Literal["fixed", "moving", "auto"]
StabilizePath: TypeAlias = Literal["smooth", "world"]
Warping: TypeAlias = Literal["nearest", "linear", "cubic", "lanczos"]
Blending: TypeAlias = Literal["none", "average", "feather", "multiband"]
Projection: TypeAlias = Literal["auto", "planar", "cylindrical", "spherical"]

DETECTORS: tuple[str, ...] = get_args(Detector)
DESCRIPTORS: tuple[str, ...] = get_args(Descriptor)
METHODS: tuple[str, ...] = get_args(Method)
MODELS: tuple[str, ...] = get_args(ModelChoice)
CAMERA_MODES: tuple[str, ...] = get_args(CameraMode)
STABILIZE_PATHS: tuple[str, ...] = get_args(StabilizePath)
WARPINGS: tuple[str, ...] = get_args(Warping)
BLENDINGS: tuple[str, ...] = get_args(Blending)
PROJECTIONS: tuple[str, ...] = get_args(Projection)


class VideoMode(StrEnum):
    """How the picture gets into a recording."""

    AUTO = "auto"
    """Copy the source's packets or embed its file where that works, else JPEG."""
    JPEG = "jpeg"
    AV1 = "av1"
    NONE = "none"


DEFAULT_THRESHOLDS: dict[str, float] = {
    "harris": 1e-7,
    "fast": 12.0,
    "agast": 12.0,
    "gftt": 0.005,
    "brisk": 25.0,
    "orb": 12.0,
    "sift": 0.03,
    "akaze": 0.0007,
}
"""The detectors' own thresholds; features.py says what each means."""


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class FeatureSettings(_Section):
    """Detection and description of keypoints."""

    detector: Detector = "harris"
    threshold: float | None = Field(
        default=None, description="detector's own threshold; None = default"
    )
    descriptor: Descriptor = "freak"
    max_features: int = Field(default=1000, ge=8, le=100_000)

    @property
    def threshold_or_default(self) -> float:
        return DEFAULT_THRESHOLDS[self.detector] if self.threshold is None else self.threshold


class MatchingSettings(_Section):
    """Matching of descriptors."""

    max_ratio: float = Field(default=0.8, gt=0, le=1, description="best over second-best distance")


class RegistrationSettings(_Section):
    """Robust estimate and its gate."""

    model: ModelChoice = "auto"
    inlier_threshold_px: float = Field(default=3.0, gt=0, allow_inf_nan=False)
    min_inliers: int = Field(default=10, ge=4)
    seed: int = Field(default=1, ge=0, le=2**31 - 1)


class TrackerSettings(_Section):
    """Following of targets."""

    method: Method = "hybrid"
    budget_ms: float | None = Field(
        default=None, gt=0, allow_inf_nan=False, description="time a frame; None = no limit"
    )


class RecordingSettings(_Section):
    """Recording for the Rerun viewer."""

    video: VideoMode = VideoMode.AUTO
    jpeg_quality: int = Field(default=80, ge=1, le=100)
    max_asset_mb: float = Field(
        default=200.0, gt=0, description="largest file that is embedded whole"
    )
    rotate: str | None = Field(
        default=None, description="a new file after this size or time: 100MB, 10min, or both"
    )
    keep: str | None = Field(
        default=None, description="remove the oldest files beyond this size or age: 2GB, 7d"
    )

    @model_validator(mode="after")
    def _check_files(self) -> Self:
        if self.rotate is not None or self.keep is not None:
            from streamtrack.recording.series import check_keep, parse_keep, parse_rotate

            check_keep(parse_rotate(self.rotate), parse_keep(self.keep))
        return self


class MosaicSettings(_Section):
    """Mosaics of pictures and of streams."""

    warping: Warping = "linear"
    blending: Blending = "multiband"
    projection: Projection = "auto"
    max_megapixels: float = Field(
        default=100.0, gt=0, allow_inf_nan=False, description="largest canvas that is written"
    )
    max_memory_mb: float = Field(
        default=400.0,
        gt=0,
        allow_inf_nan=False,
        description="tiles kept in memory; more go to disk",
    )


class LiveSettings(_Section):
    """Cameras and network streams."""

    max_fps: float | None = Field(
        default=None, gt=0, allow_inf_nan=False, description="pictures beyond are left out"
    )
    stall_timeout_s: float = Field(
        default=5.0, gt=0, allow_inf_nan=False, description="silence after which it is reopened"
    )
    open_timeout_s: float = Field(
        default=15.0, gt=0, allow_inf_nan=False, description="to the first picture of a network"
    )
    retries: int | None = Field(default=None, ge=0, description="in a row; None = for ever")
    newest_only: bool = Field(
        default=True, description="false: read every picture, however late it gets"
    )
    rtsp_transport: Literal["tcp", "udp"] = "tcp"


class WorldSettings(_Section):
    """What a world pixel is on the ground; nothing of it is known unless given."""

    px_per_unit: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    ground: tuple[tuple[float, float, float, float], ...] = Field(
        default=(), description="known points: x, y in pixels of the first frame, X, Y in units"
    )

    @model_validator(mode="after")
    def _check_one(self) -> Self:
        if self.px_per_unit is not None and self.ground:
            raise ValueError("a scale and known points contradict each other: give one of them")
        return self


class StabilizeSettings(_Section):
    """How a video is held still."""

    path: StabilizePath = "smooth"
    reach_s: float = Field(
        default=0.8, gt=0, le=10, description="how far a smooth path looks back and ahead"
    )


class Settings(_Section):
    """All of them."""

    features: FeatureSettings = FeatureSettings()
    matching: MatchingSettings = MatchingSettings()
    registration: RegistrationSettings = RegistrationSettings()
    tracker: TrackerSettings = TrackerSettings()
    camera: CameraMode = "fixed"
    max_width: int | None = Field(
        default=None, ge=32, description="wider pictures are worked on smaller; None = as they are"
    )
    recording: RecordingSettings = RecordingSettings()
    mosaic: MosaicSettings = MosaicSettings()
    world: WorldSettings = WorldSettings()
    stabilize: StabilizeSettings = StabilizeSettings()
    live: LiveSettings = LiveSettings()


_NAMES = {
    "detector": DETECTORS,
    "descriptor": DESCRIPTORS,
    "method": METHODS,
    "model": MODELS,
    "camera": CAMERA_MODES,
    "video": tuple(VideoMode),
    "path": STABILIZE_PATHS,
    "warping": WARPINGS,
    "blending": BLENDINGS,
    "projection": PROJECTIONS,
}


def build_settings(values: dict[str, Any]) -> Settings:
    """Settings from nested plain values, as a TOML file holds them.

    Raises UsageError, in one line, for unknown names and values out of range.
    """
    try:
        return Settings.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        last = str(first["loc"][-1])
        if first["type"] in ("literal_error", "enum") and last in _NAMES:
            raise unknown_name(last, str(first["input"]), _NAMES[last]) from None
        if first["type"] == "extra_forbidden":
            raise unknown_name("setting", place, _setting_names()) from None
        raise UsageError(f"setting {place} = {first['input']!r}: {first['msg']}") from None


def _setting_names() -> list[str]:
    sections = {name: getattr(Settings(), name) for name in Settings.model_fields}
    return [
        f"{name}.{key}" if isinstance(section, _Section) else name
        for name, section in sections.items()
        for key in (type(section).model_fields if isinstance(section, _Section) else [""])
    ]


def read_settings_file(path: Path) -> dict[str, Any]:
    """Nested values of a TOML settings file. Raises UsageError if it cannot be read."""
    import tomllib

    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"settings file {path}: {error.strerror}; check the path") from None
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise UsageError(f"settings file {path} is no TOML: {error}") from None
