"""What a recording is made of: entity paths, colours, and the layout that the viewer opens with.

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

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from streamtrack.settings import Settings
from streamtrack.types import Size, TrackState

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
NO_PICTURE = "no picture"
"""What a target's lane says while a live source is away."""
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
_MAX_SIDE_BY_SIDE = 3


class World(StrEnum):
    """What a recording shows of the world: nothing, or paths, alone or over a picture of it.

    The picture is the background of a camera that stands, or a growing mosaic.
    """

    NONE = "none"
    PATHS = "paths"
    BACKGROUND = "background"
    MOSAIC = "mosaic"


def world_shown(settings: Settings, has_mosaic: bool) -> World:
    """What the recording of a run shows."""
    if has_mosaic:
        return World.MOSAIC
    return World.BACKGROUND if settings.camera == "fixed" else World.PATHS


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


def build(
    size_wh: Size,
    target_names: Sequence[str],
    timeline: str,
    world: World = World.NONE,
    is_live: bool = False,
    is_following: bool = False,
) -> rrb.Blueprint:
    """The layout for a screen of about 1920x1080: what the camera sees, and the world.

    They are two tabs where there is a world to show; the one with the targets that were named is
    in front. ``is_following`` keeps to the newest data, as a live view should.
    """
    targets = [(name, TargetEntities.of(name)) for name in target_names]
    states = [entities.state for _, entities in targets]
    states += [MOSAIC_STATE] if world is World.MOSAIC else []
    states += [SOURCE_STATE] if is_live else []
    lanes_share = [0.75 + 0.42 * min(len(states), 6)] if states else []
    camera = rrb.Vertical(
        _camera_row(size_wh, targets, timeline),
        _curves(targets, [], is_live),
        *_lanes(states),
        row_shares=[6.0, 2.6, *lanes_share],
        name="Camera",
    )
    if world is World.NONE:
        return whole_layout(camera, timeline, is_following)
    around = rrb.Vertical(
        _camera_view(size_wh), _tracks_view(), text_tabs(timeline), row_shares=[3.0, 2.4, 2.2]
    )
    curves = [_curve("Mosaic", [f"{MOSAIC_CURVES}/**"])] if world is World.MOSAIC else []
    world_tab = rrb.Vertical(
        rrb.Horizontal(_mosaic_view(), around, column_shares=[6.6, 3.4]),
        *([_curves([], curves, is_live)] if curves else []),
        *_lanes(states),
        row_shares=[7.0, *([1.8] if curves else []), *lanes_share],
        name="World",
    )
    tabs = rrb.Tabs(camera, world_tab, active_tab=0 if targets else 1)
    return whole_layout(tabs, timeline, is_following)


def _camera_row(
    size_wh: Size, targets: Sequence[tuple[str, TargetEntities]], timeline: str
) -> rrb.Horizontal:
    """The picture, and beside it close-ups of the targets and the texts."""
    rows_of_targets = len(targets) if len(targets) <= _MAX_SIDE_BY_SIDE else 1
    side = rrb.Vertical(
        *_close_ups(targets),
        text_tabs(timeline, _tracks_view()),
        row_shares=[1.0 + rows_of_targets, 3.0] if targets else [1.0],
    )
    return rrb.Horizontal(_camera_view(size_wh), side, column_shares=[5.0, 3.0])


def _lanes(states: Sequence[str]) -> list[rrb.StateTimelineView]:
    """A view of the states, one of its own for each tab, if there are any."""
    contents = [f"/{path.lstrip('/')}" for path in states]
    view = rrb.StateTimelineView(name="State", origin="/", contents=contents)
    return [view] if states else []


def _tracks_view() -> rrb.TextDocumentView:
    return rrb.TextDocumentView(name="Tracks", origin=f"/{TRACKS}")


def whole_layout(root: Any, timeline: str, is_following: bool = False) -> rrb.Blueprint:
    """The panels about ``root`` closed, nothing added by itself."""
    return rrb.Blueprint(
        root,
        rrb.TimePanel(
            state="collapsed",
            timeline=timeline,
            play_state="following" if is_following else None,
            loop_mode="off" if is_following else "all",
        ),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )


def text_tabs(timeline: str, *more: Any) -> rrb.Tabs:
    """The summary, in front, the log, and more."""
    return rrb.Tabs(
        rrb.TextLogView(
            name="Log",
            origin=f"/{LOG}",
            columns=rrb.TextLogColumns(
                timeline_columns=[timeline], text_log_columns=["loglevel", "body"]
            ),
        ),
        rrb.TextDocumentView(name="Summary", origin=f"/{SUMMARY}"),
        *more,
        active_tab=1,
    )


def _mosaic_view() -> rrb.Spatial2DView:
    return rrb.Spatial2DView(
        name="World", origin=f"/{MOSAIC}", contents=[f"/{MOSAIC}/**", f"- /{MOSAIC_STATE}"]
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


def _curves(
    targets: Sequence[tuple[str, TargetEntities]], first: Sequence[Any], is_live: bool
) -> rrb.Horizontal | rrb.Tabs:
    more: list[Any] = list(first)
    if is_live:
        age = _curve("Age of the frame in ms", [AGE_MS])
        more.append(rrb.Tabs(age, _curve("Frames not seen", [f"{SOURCE_COUNTS}/**"]), active_tab=0))
    if len(targets) <= _MAX_SIDE_BY_SIDE:
        return _curve_row([entities for _, entities in targets], more)
    rows = [_curve_row([entities], more, name) for name, entities in targets]
    return rrb.Tabs(*rows, active_tab=0)


def _curve_row(
    targets: Sequence[TargetEntities], more: Sequence[Any], name: str | None = None
) -> rrb.Horizontal:
    counts = [path for target in targets for path in (target.matches, target.inliers)]
    agreement = rrb.Tabs(
        _curve("RMSE in px", [target.rmse_px for target in targets]),
        _curve("Correlation", [target.correlation for target in targets]),
        active_tab=0,
    )
    return rrb.Horizontal(
        _curve("Features, matches, inliers", [FEATURE_COUNT, f"{FOUND_CURVES}/**", *counts]),
        *([agreement] if targets else []),
        _curve("Milliseconds a frame", [f"{TOTAL_MS}/**"]),
        *more,
        name=name,
    )


def _curve(name: str, contents: list[str]) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        name=name, origin="/metrics", contents=contents, plot_legend=rrb.Corner2D.LeftTop
    )
