"""Settings of every stage; command-line flags and a TOML file build the same objects.

Unknown names are refused. All settings are frozen: a run has one set from start to end. They are
dataclasses that check themselves (`sections`), for models of pydantic took a quarter of a second to
import and build, more than joining two pictures does.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeAlias, get_args

from streamtrack.errors import UsageError, unknown_name
from streamtrack.recording.series import check_keep, parse_keep, parse_rotate
from streamtrack.sections import Range, Section

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


_POSITIVE = Range(above=0)


@dataclass(frozen=True)
class FeatureSettings(Section):
    """Detection and description of keypoints; ``threshold`` None is the detector's default."""

    section: ClassVar[str] = "features"
    detector: Detector = "harris"
    threshold: float | None = None
    descriptor: Descriptor = "freak"
    max_features: Annotated[int, Range(least=8, most=100_000)] = 1000

    @property
    def threshold_or_default(self) -> float:
        return DEFAULT_THRESHOLDS[self.detector] if self.threshold is None else self.threshold


@dataclass(frozen=True)
class MatchingSettings(Section):
    """Matching of descriptors; ``max_ratio`` is the best over the second-best distance."""

    section: ClassVar[str] = "matching"
    max_ratio: Annotated[float, Range(above=0, most=1)] = 0.8


@dataclass(frozen=True)
class RegistrationSettings(Section):
    """Robust estimate and its gate."""

    section: ClassVar[str] = "registration"
    model: ModelChoice = "auto"
    inlier_threshold_px: Annotated[float, _POSITIVE] = 3.0
    min_inliers: Annotated[int, Range(least=4)] = 10
    seed: Annotated[int, Range(least=0, most=2**31 - 1)] = 1


@dataclass(frozen=True)
class TrackerSettings(Section):
    """Following of targets; ``budget_ms`` is the time a frame, None without limit."""

    section: ClassVar[str] = "tracker"
    method: Method = "hybrid"
    budget_ms: Annotated[float | None, _POSITIVE] = None


@dataclass(frozen=True)
class RecordingSettings(Section):
    """Recording for the Rerun viewer.

    max_asset_mb  largest file that is embedded whole
    rotate        a new file after this size or time: 100MB, 10min, or both
    keep          remove the oldest files beyond this size or age: 2GB, 7d
    """

    section: ClassVar[str] = "recording"
    video: VideoMode = VideoMode.AUTO
    jpeg_quality: Annotated[int, Range(least=1, most=100)] = 80
    max_asset_mb: Annotated[float, _POSITIVE] = 200.0
    rotate: str | None = None
    keep: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_keep(parse_rotate(self.rotate), parse_keep(self.keep))


@dataclass(frozen=True)
class MosaicSettings(Section):
    """Mosaics of pictures and of streams.

    max_megapixels  largest canvas that is written
    max_memory_mb   tiles kept in memory; more go to disk
    """

    section: ClassVar[str] = "mosaic"
    warping: Warping = "linear"
    blending: Blending = "multiband"
    projection: Projection = "auto"
    max_megapixels: Annotated[float, _POSITIVE] = 100.0
    max_memory_mb: Annotated[float, _POSITIVE] = 400.0


@dataclass(frozen=True)
class LiveSettings(Section):
    """Cameras and network streams.

    max_fps          pictures beyond are left out
    stall_timeout_s  silence after which a source is reopened
    open_timeout_s   to the first picture of a network
    retries          openings in a row; None = for ever
    newest_only      false: read every picture, however late it gets
    """

    section: ClassVar[str] = "live"
    max_fps: Annotated[float | None, _POSITIVE] = None
    stall_timeout_s: Annotated[float, _POSITIVE] = 5.0
    open_timeout_s: Annotated[float, _POSITIVE] = 15.0
    retries: Annotated[int | None, Range(least=0)] = None
    newest_only: bool = True
    rtsp_transport: Literal["tcp", "udp"] = "tcp"


@dataclass(frozen=True)
class WorldSettings(Section):
    """What a world pixel is on the ground; nothing of it is known unless given.

    ``ground`` are known points: x, y in pixels of the first frame, X, Y in units.
    """

    section: ClassVar[str] = "world"
    px_per_unit: Annotated[float | None, _POSITIVE] = None
    ground: tuple[tuple[float, float, float, float], ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.px_per_unit is not None and self.ground:
            raise UsageError(
                "setting world: a scale and known points contradict each other: give one of them"
            )


@dataclass(frozen=True)
class StabilizeSettings(Section):
    """How a video is held still; ``reach_s`` is how far a smooth path looks back and ahead."""

    section: ClassVar[str] = "stabilize"
    path: StabilizePath = "smooth"
    reach_s: Annotated[float, Range(above=0, most=10)] = 0.8


@dataclass(frozen=True)
class Settings(Section):
    """All of them; pictures wider than ``max_width`` are worked on smaller, None as they are."""

    features: FeatureSettings = field(default_factory=FeatureSettings)
    matching: MatchingSettings = field(default_factory=MatchingSettings)
    registration: RegistrationSettings = field(default_factory=RegistrationSettings)
    tracker: TrackerSettings = field(default_factory=TrackerSettings)
    camera: CameraMode = "fixed"
    max_width: Annotated[int | None, Range(least=32)] = None
    recording: RecordingSettings = field(default_factory=RecordingSettings)
    mosaic: MosaicSettings = field(default_factory=MosaicSettings)
    world: WorldSettings = field(default_factory=WorldSettings)
    stabilize: StabilizeSettings = field(default_factory=StabilizeSettings)
    live: LiveSettings = field(default_factory=LiveSettings)


_SECTIONS: dict[str, type[Section]] = {
    kind.section: kind
    for kind in (
        FeatureSettings,
        MatchingSettings,
        RegistrationSettings,
        TrackerSettings,
        RecordingSettings,
        MosaicSettings,
        WorldSettings,
        StabilizeSettings,
        LiveSettings,
    )
}


def build_settings(values: dict[str, Any]) -> Settings:
    """Settings from nested plain values, as a TOML file holds them.

    Raises UsageError, in one line, for unknown names and values out of range.
    """
    known = {one.name for one in fields(Settings)}
    built: dict[str, Any] = {}
    for name, value in values.items():
        if name not in known:
            raise unknown_name("setting", name, _setting_names())
        kind = _SECTIONS.get(name)
        if kind is None or isinstance(value, kind):
            built[name] = value
            continue
        if not isinstance(value, dict):
            raise UsageError(f"setting {name} = {value!r}: must be a table of settings")
        keys = {one.name for one in fields(kind)}
        for key in value:
            if key not in keys:
                raise unknown_name("setting", f"{name}.{key}", _setting_names())
        built[name] = kind(**value)
    return Settings(**built)


def _setting_names() -> list[str]:
    return [
        f"{one.name}.{key.name}" if one.name in _SECTIONS else one.name
        for one in fields(Settings)
        for key in (fields(_SECTIONS[one.name]) if one.name in _SECTIONS else [one])
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
