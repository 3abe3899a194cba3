"""What a recording is made of: entity paths and classes.

Entities:
    camera/image, camera/keypoints, camera/matches       the picture and what was found in it
    camera/targets/<name>/quad, /corners                 where each target is
    targets/<name>/state, /template, /view               its state, how it was given, as seen now
    mosaic/image, mosaic/frame                           the mosaic so far, where the frame lies
    mosaic/keyframes, mosaic/links, mosaic/loops         its keyframes and what joins them
    mosaic/targets/<name>/path, /position                where each target went on the mosaic
    mosaic/state, source/state                           states of the mosaic, of a live source
    metrics/features, metrics/<name>/..., metrics/ms/... curves
    metrics/found/tracking, /lost                        how many automatic targets there are
    metrics/mosaic/..., metrics/age_ms, metrics/source/...
    tracks                                               table of the targets, as it is now
    summary, log                                         text
"""

from __future__ import annotations

from dataclasses import dataclass

import rerun as rr

APPLICATION_ID = "streamtrack"

IMAGE = "camera/image"
KEYPOINTS = "camera/keypoints"
MATCHES = "camera/matches"
FEATURE_COUNT = "metrics/features"
TOTAL_MS = "metrics/ms"
AGE_MS = "metrics/age_ms"
SOURCE_STATE = "source/state"
SOURCE_COUNTS = "metrics/source"
MOSAIC = "mosaic"
MOSAIC_IMAGE = "mosaic/image"
MOSAIC_FRAME = "mosaic/frame"
MOSAIC_KEYFRAMES = "mosaic/keyframes"
MOSAIC_LINKS = "mosaic/links"
MOSAIC_LOOPS = "mosaic/loops"
MOSAIC_STATE = "mosaic/state"
MOSAIC_CURVES = "metrics/mosaic"
TRACKS = "tracks"
FOUND_CURVES = "metrics/found"
SUMMARY = "summary"
LOG = "log"

INLIER, OUTLIER, UNMATCHED = 1, 2, 3
NO_PICTURE = "no picture"
"""What a target's lane says while a live source is away."""


@dataclass(frozen=True, slots=True)
class TargetEntities:
    """Entity paths of one target; any name makes a valid path, and different names differ."""

    quad: str
    corners: str
    drawing: str
    state: str
    template: str
    view: str
    matches: str
    inliers: str
    rmse_px: str
    correlation: str
    mosaic_path: str
    mosaic_position: str

    @classmethod
    def of(cls, name: str) -> TargetEntities:
        def path(*parts: str) -> str:
            return rr.new_entity_path(list(parts))

        return cls(
            quad=path("camera", "targets", name, "quad"),
            corners=path("camera", "targets", name, "corners"),
            drawing=path("camera", "targets", name),
            state=path("targets", name, "state"),
            template=path("targets", name, "template"),
            view=path("targets", name, "view"),
            matches=path("metrics", name, "matches"),
            inliers=path("metrics", name, "inliers"),
            rmse_px=path("metrics", name, "rmse_px"),
            correlation=path("metrics", name, "correlation"),
            mosaic_path=path("mosaic", "targets", name, "path"),
            mosaic_position=path("mosaic", "targets", name, "position"),
        )
