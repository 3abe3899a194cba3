"""Track objects in video by local features and homographies.

    from streamtrack import open_source, parse_targets, track

    with open_source("clip.mp4") as source:
        for step in track(source, parse_targets(["card=64,85,250,245"])):
            print(step.frame.index, step.tracks[0].state, step.tracks[0].quad)

Names are imported when first used, so that ``import streamtrack`` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from streamtrack.camera.auto import make_camera
    from streamtrack.errors import (
        OutputError,
        SourceError,
        StreamtrackError,
        TargetError,
        UsageError,
    )
    from streamtrack.mosaic.stream.growing import StreamMosaic
    from streamtrack.pipeline import track
    from streamtrack.settings import Settings, build_settings
    from streamtrack.sources import open_source
    from streamtrack.sources.base import FrameSource
    from streamtrack.targets import AutoTarget, Target, parse_targets
    from streamtrack.types import (
        CameraPose,
        Evidence,
        Features,
        Frame,
        Matches,
        Model,
        Registration,
        SourceInfo,
        Step,
        Track,
        TrackState,
        Verdict,
        WorldPlace,
    )

__all__ = [
    "AutoTarget",
    "CameraPose",
    "Evidence",
    "Features",
    "Frame",
    "FrameSource",
    "Matches",
    "Model",
    "OutputError",
    "Registration",
    "Settings",
    "SourceError",
    "SourceInfo",
    "Step",
    "StreamMosaic",
    "StreamtrackError",
    "Target",
    "TargetError",
    "Track",
    "TrackState",
    "UsageError",
    "Verdict",
    "WorldPlace",
    "build_settings",
    "make_camera",
    "open_source",
    "parse_targets",
    "track",
]

_HOMES = {
    "streamtrack.camera.auto": ("make_camera",),
    "streamtrack.errors": (
        "OutputError",
        "SourceError",
        "StreamtrackError",
        "TargetError",
        "UsageError",
    ),
    "streamtrack.mosaic.stream.growing": ("StreamMosaic",),
    "streamtrack.pipeline": ("track",),
    "streamtrack.settings": ("Settings", "build_settings"),
    "streamtrack.sources": ("open_source",),
    "streamtrack.sources.base": ("FrameSource",),
    "streamtrack.targets": ("AutoTarget", "Target", "parse_targets"),
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'streamtrack' has no attribute '{name}'")
    home = next((home for home, names in _HOMES.items() if name in names), "streamtrack.types")
    return getattr(import_module(home), name)


def __dir__() -> list[str]:
    return sorted(__all__)
