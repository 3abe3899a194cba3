"""What a growing mosaic adds to a recording: picture, frame, keyframes, paths of the targets.

All is drawn in pixels of the preview that was recorded last, for a picture in the viewer always
lies at the origin.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
import rerun as rr

from streamtrack import blueprint, recorded_rows
from streamtrack.blueprint import TargetEntities
from streamtrack.geometry import box_quad, inverted, quad_mapping, scaling, transform_points
from streamtrack.mosaic.types import MosaicView
from streamtrack.recorded_video import jpeg_of
from streamtrack.types import Image, Matrix, Points, Size, Step, TrackState

_IMAGE_EVERY_S = 1.0
_MAX_SIDE = 768
_MAX_BYTES = 256_000
_QUALITIES = (80, 65, 50)
_MAX_PATH = 2000
_MIN_STEP_PX = 1.0
_UNIT_SQUARE = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)

_STATE_COLORS: dict[str, blueprint.Rgb] = {
    "placed": blueprint.LANE_GREEN,
    "refused": blueprint.LANE_YELLOW,
    "lost": blueprint.LANE_RED,
}


class MosaicLog:
    """Records a mosaic. The clock of the stream is set by the caller."""

    def __init__(self, stream: rr.RecordingStream) -> None:
        self._stream = stream
        self._preview_from_world: Matrix | None = None
        self._last_image_s = -math.inf
        self._outlines = np.zeros((0, 4, 2), np.float32)
        self._pending: MosaicView | None = None
        self._quality = 0
        self._state = ""
        self._shown_state = ""
        self._paths: dict[str, _Path] = {}
        self._centres: dict[str, Points] = {}
        self._frame_index = -1
        self._curves: dict[str, str] = {}

    def begin(self) -> None:
        """Record what each part needs at its start, if there is a mosaic."""
        self._last_image_s = -math.inf
        self._shown_state = ""
        if self._preview_from_world is not None or self._state:
            self._log_styles()

    def follow(self, step: Step) -> None:
        """Note where the targets are in a frame whose place on the mosaic may come to be known."""
        self._frame_index = step.frame.index
        self._centres = {
            track.name: track.quad.mean(axis=0, keepdims=True)
            for track in step.tracks
            if track.state is TrackState.TRACKING and track.quad is not None
        }

    def is_image_due(self, time_s: float) -> bool:
        """Whether a view of the mosaic would be recorded now, on the source's clock."""
        return not 0.0 <= time_s - self._last_image_s < _IMAGE_EVERY_S

    def log_view(self, view: MosaicView, time_s: float) -> None:
        """Record the mosaic as it is now; a view that comes too soon is kept for the end."""
        self._pending = view
        if self.is_image_due(time_s):
            self._last_image_s = time_s
            self.log_last_view()

    def log_last_view(self) -> None:
        """Record the last view, unless that was done."""
        view, self._pending = self._pending, None
        if view is None:
            return
        if self._preview_from_world is None and not self._state:
            self._log_styles()
        picture, shrink = _bounded(view.preview)
        data = self._jpeg(picture)
        preview_from_world = shrink @ inverted(view.world_from_preview)
        self._preview_from_world = preview_from_world
        self._outlines = np.asarray(view.keyframe_outlines, np.float32).reshape(-1, 4, 2)
        self._stream.log(blueprint.MOSAIC_IMAGE, rr.EncodedImage.from_fields(blob=data))
        outlines = _mapped(preview_from_world, self._outlines)
        self._log_strips(blueprint.MOSAIC_KEYFRAMES, _closed(outlines))
        for path, is_loop in ((blueprint.MOSAIC_LINKS, False), (blueprint.MOSAIC_LOOPS, True)):
            self._log_strips(path, _edge_lines(outlines, view, is_loop))
        if view.frame_outline is not None:
            self._log_outline(view.frame_outline)
        for target in self._paths.values():
            self._log_strips(
                target.entities.mosaic_path,
                _mapped(preview_from_world, target.points(self._outlines)[None]),
            )

    def log_frame(
        self,
        index: int,
        size_wh: Size,
        world_from_frame: Matrix | None,
        state: str,
        metrics: Mapping[str, float],
    ) -> bool:
        """Record where one frame came to lie; whether the state changed."""
        if self._preview_from_world is None and not self._state:
            self._log_styles()
        has_changed, self._state = state != self._state, state
        if state != self._shown_state:
            self._shown_state = state
            self._stream.log(blueprint.MOSAIC_STATE, rr.StateChange(state=state))
        for name, value in metrics.items():
            self._stream.log(self._curve_path(name), recorded_rows.scalar(value))
        if world_from_frame is not None:
            corners = box_quad(0, 0, size_wh[0] - 1, size_wh[1] - 1)
            self._log_outline(transform_points(world_from_frame, corners))
            if index == self._frame_index:
                self._log_targets(world_from_frame)
        elif has_changed:
            self._log_strips(blueprint.MOSAIC_FRAME, np.zeros((0, 5, 2), np.float32))
        return has_changed

    def _jpeg(self, picture: Image) -> bytes:
        """One encoding a view; where it came out large, the next is of lower quality."""
        data = jpeg_of(picture, _QUALITIES[self._quality])
        if len(data) > _MAX_BYTES:
            self._quality = min(self._quality + 1, len(_QUALITIES) - 1)
        return data

    def _log_styles(self) -> None:
        _log_styles(self._stream)
        for number, (name, path) in enumerate(self._curves.items()):
            blueprint.log_stage_style(self._stream, path, name, number)
        for number, (name, target) in enumerate(self._paths.items()):
            _log_target_styles(self._stream, target.entities, name, number)

    def _log_targets(self, world_from_frame: Matrix) -> None:
        for name, centre in self._centres.items():
            if name not in self._paths:
                self._paths[name] = _Path(TargetEntities.of(name))
                number = len(self._paths) - 1
                _log_target_styles(self._stream, self._paths[name].entities, name, number)
            position = transform_points(world_from_frame, centre)
            self._paths[name].append(position[0], self._outlines)
            if self._preview_from_world is not None:
                self._stream.log(
                    self._paths[name].entities.mosaic_position,
                    recorded_rows.points(transform_points(self._preview_from_world, position)),
                )
        for name in self._paths.keys() - self._centres.keys():
            nowhere = recorded_rows.points(np.zeros((0, 2), np.float32))
            self._stream.log(self._paths[name].entities.mosaic_position, nowhere)

    def _log_outline(self, outline: Points) -> None:
        if self._preview_from_world is not None:
            quads = _mapped(self._preview_from_world, np.asarray(outline, np.float32)[None])
            self._log_strips(blueprint.MOSAIC_FRAME, _closed(quads))

    def _log_strips(self, path: str, strips: npt.NDArray[np.float32]) -> None:
        self._stream.log(path, recorded_rows.strips(strips))

    def _curve_path(self, name: str) -> str:
        if name not in self._curves:
            path = rr.new_entity_path([*blueprint.MOSAIC_CURVES.split("/"), name])
            blueprint.log_stage_style(self._stream, path, name, len(self._curves))
            self._curves[name] = path
        return self._curves[name]


@dataclass(frozen=True, slots=True, eq=False)
class _Anchored:
    """A point in the unit square of a keyframe, or in the world where ``keyframe`` is -1."""

    keyframe: int
    xy: npt.NDArray[np.float32]


class _Path:
    """Where a target went. Each point is tied to the keyframe next to it, so that the path is
    moved with the mosaic when that is adjusted. Bounded: a long path loses every second point."""

    def __init__(self, entities: TargetEntities) -> None:
        self.entities = entities
        self._points: list[_Anchored] = []
        self._last = np.full(2, np.inf, np.float32)

    def append(self, position: npt.NDArray[np.float32], outlines: npt.NDArray[np.float32]) -> None:
        """Add a point (2,) of the world, keyframes lying at ``outlines`` (K, 4, 2)."""
        if np.hypot(*(position - self._last)) < _MIN_STEP_PX:
            return
        self._last = position
        if len(self._points) >= _MAX_PATH:
            self._points = self._points[::2]
        self._points.append(_anchored(position, outlines))

    def points(self, outlines: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """The path (N, 2) in the world as it is now; N is at least 1."""
        placed = [one for one in self._points if one.keyframe < len(outlines)]
        result = np.zeros((len(placed), 2), np.float32)
        keyframes = np.array([one.keyframe for one in placed], int)
        for keyframe in np.unique(keyframes):
            rows = np.flatnonzero(keyframes == keyframe)
            points = np.stack([placed[row].xy for row in rows])
            if keyframe >= 0:
                points = transform_points(_from_unit(outlines[keyframe]), points)
            result[rows] = points
        return result


def _anchored(position: npt.NDArray[np.float32], outlines: npt.NDArray[np.float32]) -> _Anchored:
    """The point tied to the keyframe whose centre is next."""
    if not len(outlines):
        return _Anchored(-1, position)
    keyframe = int(np.argmin(np.linalg.norm(outlines.mean(axis=1) - position, axis=1)))
    try:
        unit_from_world = inverted(_from_unit(outlines[keyframe]))
    except np.linalg.LinAlgError:
        return _Anchored(-1, position)
    return _Anchored(keyframe, transform_points(unit_from_world, position[None])[0])


def _from_unit(outline: npt.NDArray[np.float32]) -> Matrix:
    return quad_mapping(_UNIT_SQUARE, outline)


def _mapped(b_from_a: Matrix, lines: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Points of lines (M, K, 2), mapped."""
    return transform_points(b_from_a, lines.reshape(-1, 2)).reshape(lines.shape)


def _closed(quads: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    return np.concatenate([quads, quads[:, :1]], axis=1)


def _edge_lines(
    outlines: npt.NDArray[np.float32], view: MosaicView, is_loop: bool
) -> npt.NDArray[np.float32]:
    """Lines (M, 2, 2) from centre to centre of the keyframes that lie at ``outlines``."""
    places = {name: place for place, name in enumerate(view.keyframes or range(len(outlines)))}
    pairs = [
        (places[edge.a], places[edge.b])
        for edge in view.edges
        if edge.is_loop == is_loop and edge.a in places and edge.b in places
    ]
    if not pairs:
        return np.zeros((0, 2, 2), np.float32)
    centres = outlines.mean(axis=1)
    return np.asarray(centres[np.array(pairs)], np.float32)


def _bounded(picture: Image) -> tuple[Image, Matrix]:
    """The picture made small enough, and what maps its pixels to the small one's."""
    factor = min(1.0, _MAX_SIDE / max(picture.shape[:2]))
    if factor == 1.0:
        return picture, np.eye(3)
    size = max(1, round(picture.shape[1] * factor)), max(1, round(picture.shape[0] * factor))
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8), scaling(factor)


def _log_styles(stream: rr.RecordingStream) -> None:
    """Log once how a growing mosaic is drawn."""
    stream.log(
        blueprint.MOSAIC_IMAGE,
        rr.EncodedImage.from_fields(media_type="image/jpeg", draw_order=-10.0),
        static=True,
    )
    for path, color, radius, order in (
        (blueprint.MOSAIC_KEYFRAMES, (120, 130, 150), 0.5, 10),
        (blueprint.MOSAIC_LINKS, blueprint.BLUE, 0.8, 20),
        (blueprint.MOSAIC_LOOPS, blueprint.ORANGE, 1.6, 21),
        (blueprint.MOSAIC_FRAME, (255, 255, 255), 2.0, 30),
    ):
        stream.log(
            path,
            rr.LineStrips2D.from_fields(
                colors=[color],
                radii=blueprint.ui_points(radius),
                show_labels=False,
                draw_order=order,
            ),
            static=True,
        )
    blueprint.log_lane_style(stream, blueprint.MOSAIC_STATE, _STATE_COLORS)


def _log_target_styles(
    stream: rr.RecordingStream, entities: TargetEntities, name: str, number: int
) -> None:
    """Log once how a target is drawn on the mosaic."""
    color = blueprint.target_color(number)
    stream.log(
        entities.mosaic_path,
        rr.LineStrips2D.from_fields(
            colors=[color], radii=blueprint.ui_points(1.5), show_labels=False, draw_order=40
        ),
        static=True,
    )
    stream.log(
        entities.mosaic_position,
        rr.Points2D.from_fields(
            colors=[color],
            radii=blueprint.ui_points(5.0),
            labels=[name],
            show_labels=True,
            draw_order=41,
        ),
        static=True,
    )
