"""What a recording is made of: entity paths, colours, and the layout that the viewer opens with.

Entities:
    camera/image, camera/keypoints, camera/matches       the picture and what was found in it
    camera/targets/<name>/quad, /corners                 where each target is
    targets/<name>/state, /template, /view               its state, how it was given, as seen now
    metrics/features, metrics/<name>/..., metrics/ms/... curves
    summary, log                                         text
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from streamtrack.types import Size, TrackState

APPLICATION_ID = "streamtrack"

IMAGE = "camera/image"
KEYPOINTS = "camera/keypoints"
MATCHES = "camera/matches"
FEATURE_COUNT = "metrics/features"
TOTAL_MS = "metrics/ms"
SUMMARY = "summary"
LOG = "log"

INLIER, OUTLIER, UNMATCHED = 1, 2, 3

Rgb = tuple[int, int, int]
_GREEN: Rgb = (70, 225, 110)
_RED: Rgb = (255, 75, 75)
_GREY: Rgb = (175, 180, 195)
_BLUE: Rgb = (80, 160, 255)
_ORANGE: Rgb = (255, 160, 40)
_VIOLET: Rgb = (190, 130, 255)
_STATE_COLORS: dict[TrackState, Rgb] = {
    TrackState.SEARCHING: (66, 140, 230),
    TrackState.TRACKING: (64, 160, 80),
    TrackState.LOST: (214, 72, 66),
}
_TARGET_COLORS: tuple[Rgb, ...] = (
    (255, 205, 0),
    (0, 210, 255),
    (255, 110, 220),
    (255, 140, 50),
    (170, 255, 90),
    (190, 150, 255),
)
_STAGE_COLORS: tuple[Rgb, ...] = (_BLUE, _GREEN, _ORANGE, (240, 100, 160), (0, 200, 200), _GREY)
_MAX_SIDE_BY_SIDE = 3


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
        )


def _ui_points(radius: float) -> list[float]:
    """A radius on the screen, whatever the zoom; Rerun encodes it as a negative number."""
    return [-radius]


def target_color(number: int) -> Rgb:
    """The colour of the target with this number, from 0."""
    return _TARGET_COLORS[number % len(_TARGET_COLORS)]


def log_styles(stream: rr.RecordingStream) -> None:
    """Log once how the entities that every recording has are drawn."""
    stream.log(
        "camera",
        rr.AnnotationContext(
            [
                rr.AnnotationInfo(INLIER, "inlier", _GREEN),
                rr.AnnotationInfo(OUTLIER, "outlier", _RED),
                rr.AnnotationInfo(UNMATCHED, "unmatched", _GREY),
            ]
        ),
        static=True,
    )
    stream.log(
        KEYPOINTS,
        rr.Points2D.from_fields(radii=_ui_points(1.8), show_labels=False, draw_order=20),
        static=True,
    )
    stream.log(
        MATCHES,
        rr.LineStrips2D.from_fields(radii=_ui_points(0.7), show_labels=False, draw_order=10),
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
            radii=_ui_points(2.0),
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
            radii=_ui_points(4.0),
            show_labels=False,
            draw_order=31,
        ),
        static=True,
    )
    stream.log(
        entities.state,
        rr.StateConfiguration(
            values=[str(state) for state in _STATE_COLORS],
            labels=[str(state) for state in _STATE_COLORS],
            colors=np.array(
                [(r << 24) | (g << 16) | (b << 8) | 0xFF for r, g, b in _STATE_COLORS.values()],
                np.uint32,
            ),
        ),
        static=True,
    )
    is_alone = count == 1
    prefix = "" if is_alone else f"{name} "
    faint: Rgb = (color[0] * 5 // 9, color[1] * 5 // 9, color[2] * 5 // 9)
    log_curve_style(stream, entities.matches, f"{prefix}matches", _BLUE if is_alone else faint)
    log_curve_style(stream, entities.inliers, f"{prefix}inliers", _GREEN if is_alone else color)
    log_curve_style(stream, entities.rmse_px, f"{prefix}RMSE", _ORANGE if is_alone else color)
    log_curve_style(
        stream, entities.correlation, f"{prefix}correlation", _VIOLET if is_alone else color
    )


def log_stage_style(stream: rr.RecordingStream, path: str, stage: str, number: int) -> None:
    """Log once how the curve of one stage's time is drawn."""
    log_curve_style(stream, path, stage, _STAGE_COLORS[number % len(_STAGE_COLORS)])


def log_curve_style(
    stream: rr.RecordingStream, path: str, name: str, color: Rgb, width: float = 1.5
) -> None:
    stream.log(path, rr.SeriesLines(colors=[color], names=[name], widths=[width]), static=True)


def build(size_wh: Size, target_names: Sequence[str], timeline: str) -> rrb.Blueprint:
    """The layout for a screen of about 1920x1080: picture and targets above, curves below."""
    targets = [(name, TargetEntities.of(name)) for name in target_names]
    lanes = rrb.StateTimelineView(
        name="State",
        origin="/targets",
        contents=[entities.state for _, entities in targets] or "/targets/**",
    )
    text = rrb.Tabs(
        rrb.TextLogView(
            name="Log",
            origin=f"/{LOG}",
            columns=rrb.TextLogColumns(
                timeline_columns=[timeline], text_log_columns=["loglevel", "body"]
            ),
        ),
        rrb.TextDocumentView(name="Summary", origin=f"/{SUMMARY}"),
        active_tab=1,
    )
    rows_of_targets = len(targets) if len(targets) <= _MAX_SIDE_BY_SIDE else 1
    side = rrb.Vertical(
        *_close_ups(targets), text, row_shares=[1.0 + rows_of_targets, 3.0] if targets else [1.0]
    )
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(_camera_view(size_wh), side, column_shares=[5.0, 3.0]),
            _curves(targets),
            lanes,
            row_shares=[6.0, 2.6, 0.75 + 0.42 * min(len(targets), 6)],
        ),
        rrb.TimePanel(state="collapsed", timeline=timeline, loop_mode="all"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )


def _camera_view(size_wh: Size) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(
        name="Camera",
        origin="/camera",
        contents="/camera/**",
        visual_bounds=rrb.VisualBounds2D(x_range=[0, size_wh[0]], y_range=[0, size_wh[1]]),
    )


def _close_ups(targets: Sequence[tuple[str, TargetEntities]]) -> list[Any]:
    """For each target how it was given beside how it looks now, both upright."""
    pairs = [
        rrb.Horizontal(
            rrb.Spatial2DView(
                name=f"{name}: as given", origin=entities.template, contents=entities.template
            ),
            rrb.Spatial2DView(name=f"{name}: now", origin=entities.view, contents=entities.view),
            name=name,
        )
        for name, entities in targets
    ]
    if len(pairs) <= 1:
        return pairs
    if len(pairs) <= _MAX_SIDE_BY_SIDE:
        return [rrb.Vertical(*pairs)]
    return [rrb.Tabs(*pairs, active_tab=0)]


def _curves(targets: Sequence[tuple[str, TargetEntities]]) -> rrb.Horizontal | rrb.Tabs:
    if len(targets) <= _MAX_SIDE_BY_SIDE:
        return _curve_row([entities for _, entities in targets])
    rows = [_curve_row([entities], name) for name, entities in targets]
    return rrb.Tabs(*rows, active_tab=0)


def _curve_row(targets: Sequence[TargetEntities], name: str | None = None) -> rrb.Horizontal:
    counts = [path for target in targets for path in (target.matches, target.inliers)]
    agreement = rrb.Tabs(
        _curve("RMSE in px", [target.rmse_px for target in targets]),
        _curve("Correlation", [target.correlation for target in targets]),
        active_tab=0,
    )
    return rrb.Horizontal(
        _curve("Features, matches, inliers", [FEATURE_COUNT, *counts]),
        agreement,
        _curve("Milliseconds a frame", [f"{TOTAL_MS}/**"]),
        name=name,
    )


def _curve(name: str, contents: list[str]) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        name=name, origin="/metrics", contents=contents, plot_legend=rrb.Corner2D.LeftTop
    )
