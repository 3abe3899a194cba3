"""How entities are drawn: colours, sizes and names, logged once."""

from __future__ import annotations

import numpy as np
import rerun as rr

from streamtrack.recording.entities import (
    AGE_MS,
    FEATURE_COUNT,
    INLIER,
    KEYPOINTS,
    MATCHES,
    NO_PICTURE,
    OUTLIER,
    SOURCE_STATE,
    TOTAL_MS,
    UNMATCHED,
    TargetEntities,
)
from streamtrack.types import TrackState

Rgb = tuple[int, int, int]
_GREEN: Rgb = (70, 225, 110)
_RED: Rgb = (255, 75, 75)
_GREY: Rgb = (175, 180, 195)
BLUE: Rgb = (80, 160, 255)
ORANGE: Rgb = (255, 160, 40)
_VIOLET: Rgb = (190, 130, 255)
LANE_BLUE: Rgb = (66, 140, 230)
LANE_GREEN: Rgb = (64, 160, 80)
LANE_RED: Rgb = (214, 72, 66)
LANE_YELLOW: Rgb = (205, 150, 40)
_ENDED_GREY: Rgb = (110, 115, 125)
_STATE_COLORS: dict[str, Rgb] = {
    TrackState.SEARCHING: LANE_BLUE,
    TrackState.TRACKING: LANE_GREEN,
    TrackState.LOST: LANE_RED,
    NO_PICTURE: _ENDED_GREY,
}
_SOURCE_COLORS: dict[str, Rgb] = {
    "connecting": LANE_BLUE,
    "streaming": LANE_GREEN,
    "stalled": LANE_YELLOW,
    "waiting": LANE_RED,
    "ended": _ENDED_GREY,
}
_TARGET_COLORS: tuple[Rgb, ...] = (
    (255, 205, 0),
    (0, 210, 255),
    (255, 110, 220),
    (255, 140, 50),
    (170, 255, 90),
    (190, 150, 255),
)
_STAGE_COLORS: tuple[Rgb, ...] = (BLUE, _GREEN, ORANGE, (240, 100, 160), (0, 200, 200), _GREY)


def ui_points(radius: float) -> list[float]:
    """A radius on the screen, whatever the zoom; Rerun encodes it as a negative number."""
    return [-radius]


def target_color(number: int) -> Rgb:
    """The colour of the target with this number, from 0."""
    return _TARGET_COLORS[number % len(_TARGET_COLORS)]


def point_classes() -> rr.AnnotationContext:
    """The colours of points and lines by what became of them."""
    return rr.AnnotationContext(
        [
            rr.AnnotationInfo(INLIER, "inlier", _GREEN),
            rr.AnnotationInfo(OUTLIER, "outlier", _RED),
            rr.AnnotationInfo(UNMATCHED, "unmatched", _GREY),
        ]
    )


def log_styles(stream: rr.RecordingStream) -> None:
    """Log once how the entities that every recording has are drawn."""
    stream.log("camera", point_classes(), static=True)
    stream.log(
        KEYPOINTS,
        rr.Points2D.from_fields(radii=ui_points(1.8), show_labels=False, draw_order=20),
        static=True,
    )
    stream.log(
        MATCHES,
        rr.LineStrips2D.from_fields(radii=ui_points(0.7), show_labels=False, draw_order=10),
        static=True,
    )
    log_curve_style(stream, FEATURE_COUNT, "features", _GREY)
    log_curve_style(stream, TOTAL_MS, "total", _VIOLET, width=2.0)


def log_target_styles(
    stream: rr.RecordingStream, entities: TargetEntities, name: str, number: int, count: int
) -> None:
    """Log once how one of ``count`` targets is drawn, its curves, and the colours of its states."""
    color = target_color(number)
    stream.log(
        entities.quad,
        rr.LineStrips2D.from_fields(
            colors=[color],
            radii=ui_points(2.0),
            labels=[name],
            show_labels=True,
            draw_order=30,
        ),
        static=True,
    )
    stream.log(
        entities.corners,
        rr.Points2D.from_fields(
            colors=[(255, 255, 255), color, color, color],  # white marks its top left
            radii=ui_points(4.0),
            show_labels=False,
            draw_order=31,
        ),
        static=True,
    )
    log_lane_style(stream, entities.state, _STATE_COLORS)
    is_alone = count == 1
    prefix = "" if is_alone else f"{name} "
    faint: Rgb = (color[0] * 5 // 9, color[1] * 5 // 9, color[2] * 5 // 9)
    log_curve_style(stream, entities.matches, f"{prefix}matches", BLUE if is_alone else faint)
    log_curve_style(stream, entities.inliers, f"{prefix}inliers", _GREEN if is_alone else color)
    log_curve_style(stream, entities.rmse_px, f"{prefix}RMSE", ORANGE if is_alone else color)
    log_curve_style(
        stream, entities.correlation, f"{prefix}correlation", _VIOLET if is_alone else color
    )


def log_source_styles(stream: rr.RecordingStream) -> None:
    """Log once how the state of a live source and the age of its frames are drawn."""
    log_lane_style(stream, SOURCE_STATE, _SOURCE_COLORS)
    log_curve_style(stream, AGE_MS, "age in ms", _VIOLET)


def log_lane_style(stream: rr.RecordingStream, path: str, colors: dict[str, Rgb]) -> None:
    """Log once the colours of the states of one lane."""
    stream.log(
        path,
        rr.StateConfiguration(
            values=[str(state) for state in colors],
            labels=[str(state) for state in colors],
            colors=np.array(
                [(r << 24) | (g << 16) | (b << 8) | 0xFF for r, g, b in colors.values()],
                np.uint32,
            ),
        ),
        static=True,
    )


def log_stage_style(stream: rr.RecordingStream, path: str, stage: str, number: int) -> None:
    """Log once how the curve of one stage's time is drawn."""
    log_curve_style(stream, path, stage, _STAGE_COLORS[number % len(_STAGE_COLORS)])


def log_curve_style(
    stream: rr.RecordingStream, path: str, name: str, color: Rgb, width: float = 1.5
) -> None:
    stream.log(path, rr.SeriesLines(colors=[color], names=[name], widths=[width]), static=True)
