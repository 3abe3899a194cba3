"""What a growing mosaic adds to a recording: picture, frame, keyframes, paths of the targets.

All is drawn in pixels of the preview that was recorded last, for a picture in the viewer always
lies at the origin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
import rerun as rr

from streamtrack.geometry import (
    box_quad,
    image_quad,
    inverted,
    largest_shift,
    scaling,
    transform_points,
    translation,
)
from streamtrack.mosaic.types import MosaicView, PlacedFrame
from streamtrack.recording import rows, styles
from streamtrack.recording.background import BackgroundPicture
from streamtrack.recording.entities import (
    MOSAIC_CURVES,
    MOSAIC_FRAME,
    MOSAIC_IMAGE,
    MOSAIC_KEYFRAMES,
    MOSAIC_LINKS,
    MOSAIC_LOOPS,
    MOSAIC_STATE,
    TargetEntities,
)
from streamtrack.recording.video import jpeg_of
from streamtrack.targets import color_number
from streamtrack.types import Frame, Image, Matrix, Points, Size, Step, WorldPlace

_IMAGE_EVERY_S = 1.0
_SHOWN_WH, _MOST_ENLARGED = (1024, 576), 4.0  # as wide as the view on a common screen
_MAX_BYTES = 256_000
_QUALITIES = (80, 65, 50)
_MAX_PATH = 1000
_MOST_TARGETS = 64
_MOST_OFF_PX = 1.0
"""Corners of a frame that are off by less: the camera looks where it did in the first frame."""

_STATE_COLORS: dict[str, styles.Rgb] = {
    "placed": styles.LANE_GREEN,
    "refused": styles.LANE_YELLOW,
    "lost": styles.LANE_RED,
}


class MosaicLog:
    """Records a mosaic. The clock of the stream is set by the caller."""

    def __init__(self, stream: rr.RecordingStream) -> None:
        self._stream = stream
        self._preview_from_world: Matrix | None = None
        self._last_image_s = -math.inf
        self._outlines = np.zeros((0, 4, 2), np.float32)
        self._background = BackgroundPicture()
        self._pending: MosaicView | None = None
        self._quality = 0
        self._state = ""
        self._shown_state = ""
        self._targets: dict[str, _Target] = {}
        self._numbers: dict[str, int] = {}
        self._places: dict[str, WorldPlace] = {}
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
        self._places = {track.name: track.world for track in step.tracks if track.world is not None}
        self._numbers = {t.name: color_number(t, place) for place, t in enumerate(step.tracks)}

    def log_world(self, step: Step) -> None:
        """Record the camera's view and the targets' paths where no mosaic is made.

        They lie over what a camera that stands shows behind the targets, or over the first frame.
        """
        if self._preview_from_world is None:
            self._preview_from_world = np.eye(3)
            self._log_styles()
        self.follow(step)
        pose, size_wh = step.camera.world_from_frame, step.frame.size_wh
        if pose is not None:
            is_at_start = largest_shift(pose, image_quad(size_wh)) < _MOST_OFF_PX
            if is_at_start and not step.camera.warning:
                self._log_background(step.frame)
            self._log_outline(_outline(pose, size_wh))
        else:
            self._log_strips(MOSAIC_FRAME, np.zeros((0, 5, 2), np.float32))
        self._log_targets()
        if self.is_image_due(step.frame.time_s):
            self._last_image_s = step.frame.time_s
            self.log_paths()

    def _log_background(self, frame: Frame) -> None:
        """Record what lies behind the targets, where that is known anew."""
        picture = self._background.seen(frame)
        if picture is None:
            return
        framed, framed_from_picture = _framed(picture)
        width, height = frame.size_wh
        small = scaling(picture.shape[1] / width, picture.shape[0] / height)
        self._preview_from_world = framed_from_picture @ small
        self._stream.log(MOSAIC_IMAGE, rr.EncodedImage.from_fields(blob=self._jpeg(framed)))

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
        picture, framed_from_preview = _framed(view.preview)
        data = self._jpeg(picture)
        preview_from_world = framed_from_preview @ inverted(view.world_from_preview)
        self._preview_from_world = preview_from_world
        self._outlines = np.asarray(view.keyframe_outlines, np.float32).reshape(-1, 4, 2)
        self._stream.log(MOSAIC_IMAGE, rr.EncodedImage.from_fields(blob=data))
        outlines = _mapped(preview_from_world, self._outlines)
        self._log_strips(MOSAIC_KEYFRAMES, _closed(outlines))
        for path, is_loop in ((MOSAIC_LINKS, False), (MOSAIC_LOOPS, True)):
            self._log_strips(path, _edge_lines(outlines, view, is_loop))
        if view.frame_outline is not None:
            self._log_outline(view.frame_outline)
        for target in self._targets.values():
            if target.is_shown:  # in the same frame it may lie where the view before had it
                self._log_position(target)
        self.log_paths()

    def log_paths(self) -> None:
        """Record where the targets went so far, as it is known now."""
        preview_from_world = self._preview_from_world
        if preview_from_world is None:
            return
        for target in self._targets.values():
            path = _thinned(target.place.path)
            self._log_strips(target.entities.mosaic_path, _mapped(preview_from_world, path[None]))

    def log_frame(self, placed: PlacedFrame) -> bool:
        """Record where one frame came to lie; whether the state changed."""
        if self._preview_from_world is None and not self._state:
            self._log_styles()
        has_changed, self._state = placed.state != self._state, placed.state
        if placed.state != self._shown_state:
            self._shown_state = placed.state
            self._stream.log(MOSAIC_STATE, rr.StateChange(state=placed.state))
        for name, value in placed.metrics.items():
            self._stream.log(self._curve_path(name), rows.scalar(value))
        if placed.world_from_frame is not None:
            self._log_outline(_outline(placed.world_from_frame, placed.size_wh))
            if placed.index == self._frame_index:
                self._log_targets()
        elif has_changed:
            self._log_strips(MOSAIC_FRAME, np.zeros((0, 5, 2), np.float32))
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
            styles.log_stage_style(self._stream, path, name, number)
        for name, target in self._targets.items():
            _log_target_styles(self._stream, target.entities, name, target.number)

    def _log_targets(self) -> None:
        for name, place in self._places.items():
            target = self._target(name, place)
            target.place, target.is_shown = place, True
            self._log_position(target)
        for name, target in self._targets.items():
            if target.is_shown and name not in self._places:
                target.is_shown = False
                nowhere = rows.points(np.zeros((0, 2), np.float32))
                self._stream.log(target.entities.mosaic_position, nowhere)

    def _log_position(self, target: _Target) -> None:
        if self._preview_from_world is not None:
            position = transform_points(self._preview_from_world, target.place.position)
            self._stream.log(target.entities.mosaic_position, rows.points(position))

    def _target(self, name: str, place: WorldPlace) -> _Target:
        """The target's part of the recording, begun when it is first seen in the world."""
        found = self._targets.pop(name, None)
        if found is None:
            found = _Target(TargetEntities.of(name), self._numbers[name], place)
            _log_target_styles(self._stream, found.entities, name, found.number)
        self._targets[name] = found  # the last in the order of when they were seen
        if len(self._targets) > _MOST_TARGETS:
            first = next(iter(self._targets))
            gone = self._targets.pop(first)
            self._log_strips(gone.entities.mosaic_path, np.zeros((0, 2, 2), np.float32))
        return found

    def _log_outline(self, outline: Points) -> None:
        if self._preview_from_world is not None:
            quads = _mapped(self._preview_from_world, np.asarray(outline, np.float32)[None])
            self._log_strips(MOSAIC_FRAME, _closed(quads))

    def _log_strips(self, path: str, strips: npt.NDArray[np.float32]) -> None:
        self._stream.log(path, rows.strips(strips))

    def _curve_path(self, name: str) -> str:
        if name not in self._curves:
            path = rr.new_entity_path([*MOSAIC_CURVES.split("/"), name])
            styles.log_stage_style(self._stream, path, name, len(self._curves))
            self._curves[name] = path
        return self._curves[name]


@dataclass(slots=True, eq=False)
class _Target:
    """A target on the mosaic: where it was last, and with that its path."""

    entities: TargetEntities
    number: int
    place: WorldPlace
    is_shown: bool = False


def _thinned(path: Points) -> Points:
    """At most `_MAX_PATH` points of a path (N, 2), the last among them."""
    step = -(-len(path) // _MAX_PATH)
    return path[(len(path) - 1) % step :: step] if step > 1 else path


def _outline(world_from_frame: Matrix, size_wh: Size) -> Points:
    corners = box_quad(0, 0, size_wh[0] - 1, size_wh[1] - 1)
    return transform_points(world_from_frame, corners)


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


def _framed(picture: Image) -> tuple[Image, Matrix]:
    """What there is of the picture, as large as fits, amid black; and what maps its pixels.

    The size is always the same: the viewer takes JPEGs for a video and complains of a change.
    """
    left, top, width, height = _covered(picture)
    factor = min(_MOST_ENLARGED, _SHOWN_WH[0] / width, _SHOWN_WH[1] / height)
    size_wh = max(1, round(width * factor)), max(1, round(height * factor))
    method = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
    framed = np.zeros((*_SHOWN_WH[::-1], *picture.shape[2:]), np.uint8)
    x, y = ((most - side) // 2 for most, side in zip(_SHOWN_WH, size_wh, strict=True))
    framed[y : y + size_wh[1], x : x + size_wh[0]] = cv2.resize(
        picture[top : top + height, left : left + width], size_wh, interpolation=method
    )
    return framed, translation(x, y) @ scaling(factor) @ translation(-left, -top)


def _covered(picture: Image) -> tuple[int, int, int, int]:
    """The box x, y, width, height of what is not black; all of a picture that is black."""
    is_covered = picture if picture.ndim == 2 else picture.max(axis=2)
    left, top, width, height = cv2.boundingRect(is_covered)
    if not (width and height):
        return 0, 0, picture.shape[1], picture.shape[0]
    return left, top, width, height


def _log_styles(stream: rr.RecordingStream) -> None:
    """Log once how a growing mosaic is drawn."""
    stream.log(
        MOSAIC_IMAGE,
        rr.EncodedImage.from_fields(media_type="image/jpeg", draw_order=-10.0),
        static=True,
    )
    for path, color, radius, order in (
        (MOSAIC_KEYFRAMES, (120, 130, 150), 0.5, 10),
        (MOSAIC_LINKS, styles.BLUE, 0.8, 20),
        (MOSAIC_LOOPS, styles.ORANGE, 1.6, 21),
        (MOSAIC_FRAME, (255, 255, 255), 2.0, 30),
    ):
        stream.log(
            path,
            rr.LineStrips2D.from_fields(
                colors=[color],
                radii=styles.ui_points(radius),
                show_labels=False,
                draw_order=order,
            ),
            static=True,
        )
    styles.log_lane_style(stream, MOSAIC_STATE, _STATE_COLORS)


def _log_target_styles(
    stream: rr.RecordingStream, entities: TargetEntities, name: str, number: int
) -> None:
    """Log once how a target is drawn on the mosaic."""
    color = styles.target_color(number)
    stream.log(
        entities.mosaic_path,
        rr.LineStrips2D.from_fields(
            colors=[color], radii=styles.ui_points(1.5), show_labels=False, draw_order=40
        ),
        static=True,
    )
    stream.log(
        entities.mosaic_position,
        rr.Points2D.from_fields(
            colors=[color],
            radii=styles.ui_points(5.0),
            labels=[name],
            show_labels=True,
            draw_order=41,
        ),
        static=True,
    )
