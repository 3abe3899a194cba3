"""The layout that the viewer opens with."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import Any

import rerun.blueprint as rrb

from streamtrack.recording.entities import (
    AGE_MS,
    FEATURE_COUNT,
    FOUND_CURVES,
    LOG,
    MOSAIC,
    MOSAIC_CURVES,
    MOSAIC_STATE,
    SOURCE_COUNTS,
    SOURCE_STATE,
    SUMMARY,
    TOTAL_MS,
    TRACKS,
    TargetEntities,
)
from streamtrack.types import Size

_MAX_SIDE_BY_SIDE = 3


class World(StrEnum):
    """What a recording shows of the world: nothing, or paths over a picture of it.

    The picture is the background where the first frame was taken, or a growing mosaic.
    """

    NONE = "none"
    BACKGROUND = "background"
    MOSAIC = "mosaic"


def build(
    size_wh: Size,
    target_names: Sequence[str],
    timeline: str,
    world: World = World.NONE,
    is_live: bool = False,
    is_following: bool = False,
    finds_targets: bool = False,
) -> rrb.Blueprint:
    """The layout for a screen of about 1920x1080: what the camera sees, and the world.

    They are two tabs where there is a world to show; the one with the targets that were named is
    in front. ``is_following`` keeps to the newest data, as a live view should;
    ``finds_targets`` where targets that nobody named may come.
    """
    targets = [(name, TargetEntities.of(name)) for name in target_names]
    states = [entities.state for _, entities in targets]
    states += [MOSAIC_STATE] if world is World.MOSAIC else []
    states += [SOURCE_STATE] if is_live else []
    has_tracks = bool(targets) or finds_targets
    lanes_share = [0.75 + 0.42 * min(len(states), 6)] if states else []
    camera = rrb.Vertical(
        _camera_row(size_wh, targets, _tracks(has_tracks), timeline),
        _curves(targets, [], is_live, finds_targets),
        *_lanes(states),
        row_shares=[6.0, 2.6, *lanes_share],
        name="Camera",
    )
    if world is World.NONE:
        return whole_layout(camera, timeline, is_following)
    around = rrb.Vertical(
        _camera_view(size_wh),
        *_tracks(has_tracks),
        text_tabs(timeline),
        row_shares=[3.0, *([2.4] if has_tracks else []), 2.2],
    )
    curves = [_curve("Mosaic", [f"{MOSAIC_CURVES}/**"])] if world is World.MOSAIC else []
    world_tab = rrb.Vertical(
        rrb.Horizontal(_mosaic_view(), around, column_shares=[6.6, 3.4]),
        *([_curves([], curves, is_live, finds_targets)] if curves else []),
        *_lanes(states),
        row_shares=[7.0, *([1.8] if curves else []), *lanes_share],
        name="World",
    )
    tabs = rrb.Tabs(camera, world_tab, active_tab=0 if targets else 1)
    return whole_layout(tabs, timeline, is_following)


def _camera_row(
    size_wh: Size,
    targets: Sequence[tuple[str, TargetEntities]],
    tracks: Sequence[rrb.TextDocumentView],
    timeline: str,
) -> rrb.Horizontal:
    """The picture, and beside it close-ups of the targets, how they fare, and the texts."""
    rows_of_targets = len(targets) if len(targets) <= _MAX_SIDE_BY_SIDE else 1
    side = rrb.Vertical(
        *_close_ups(targets),
        *tracks,
        text_tabs(timeline),
        row_shares=[
            *([1.0 + rows_of_targets] if targets else []),
            *[0.6 + 0.4 * min(max(len(targets), 1), 4) for _ in tracks],
            2.4,
        ],
    )
    return rrb.Horizontal(_camera_view(size_wh), side, column_shares=[5.0, 3.0])


def _lanes(states: Sequence[str]) -> list[rrb.StateTimelineView]:
    """A view of the states, one of its own for each tab, if there are any."""
    contents = [f"/{path.lstrip('/')}" for path in states]
    view = rrb.StateTimelineView(name="State", origin="/", contents=contents)
    return [view] if states else []


def _tracks(has_tracks: bool) -> list[rrb.TextDocumentView]:
    """A view of the table of tracks, one of its own for each tab, if there may be any."""
    return [rrb.TextDocumentView(name="Tracks", origin=f"/{TRACKS}")] if has_tracks else []


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


def text_tabs(timeline: str) -> rrb.Tabs:
    """The summary, in front, and the log."""
    return rrb.Tabs(
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
    targets: Sequence[tuple[str, TargetEntities]],
    first: Sequence[Any],
    is_live: bool,
    finds_targets: bool,
) -> rrb.Horizontal | rrb.Tabs:
    more: list[Any] = list(first)
    if is_live:
        age = _curve("Age of the frame in ms", [AGE_MS])
        more.append(rrb.Tabs(age, _curve("Frames not seen", [f"{SOURCE_COUNTS}/**"]), active_tab=0))
    if len(targets) <= _MAX_SIDE_BY_SIDE:
        return _curve_row([entities for _, entities in targets], more, finds_targets)
    rows = [_curve_row([entities], more, finds_targets, name) for name, entities in targets]
    return rrb.Tabs(*rows, active_tab=0)


def _curve_row(
    targets: Sequence[TargetEntities],
    more: Sequence[Any],
    finds_targets: bool,
    name: str | None = None,
) -> rrb.Horizontal:
    counts = [path for target in targets for path in (target.matches, target.inliers)]
    agreement = rrb.Tabs(
        _curve("RMSE in px", [target.rmse_px for target in targets]),
        _curve("Correlation", [target.correlation for target in targets]),
        active_tab=0,
    )
    counted = _curve(
        "Features, matches, inliers" if targets else "Targets found",
        [FEATURE_COUNT, f"{FOUND_CURVES}/**", *counts],
    )
    return rrb.Horizontal(
        *([counted] if targets or finds_targets else []),
        *([agreement] if targets else []),
        _curve("Milliseconds a frame", [f"{TOTAL_MS}/**"]),
        *more,
        name=name,
    )


def _curve(name: str, contents: list[str]) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        name=name, origin="/metrics", contents=contents, plot_legend=rrb.Corner2D.LeftTop
    )
