"""What one target adds to a recording: outline, state, curves and close-ups."""

from __future__ import annotations

import math

import cv2
import numpy as np
import rerun as rr

from streamtrack.geometry import bounding_box, inverted, scaling, transform_points, translation
from streamtrack.recording import rows, styles
from streamtrack.recording.entities import (
    NO_PICTURE,
    TargetEntities,
)
from streamtrack.recording.video import jpeg_of
from streamtrack.types import Image, Matrix, Points, Size, Step, Track, TrackState

_CLOSE_UP_EVERY = 5
_CLOSE_UP_SIDE = 160
_CLOSE_UP_QUALITY = 80
_BLANK_GREY = 32


class TargetLog:
    """What one target adds to the recording, once a part of it was begun."""

    def __init__(
        self,
        stream: rr.RecordingStream,
        name: str,
        number: int,
        template: Image | None,
    ) -> None:
        self._stream = stream
        self._name = name
        self._number = number
        self._entities = TargetEntities.of(name)
        self._state: TrackState | None = None
        self._frame_from_template: Matrix | None = None
        self._is_given_in_video: bool | None = None
        self._box: tuple[float, float, float, float] | None = None
        self._frames_to_close_up = 0
        self._template = None if template is None else _shrunk(template)
        self._is_state_due = True

    def begin(self, count: int) -> None:
        """Record what each part needs at its start, for one of ``count`` targets."""
        styles.log_target_styles(self._stream, self._entities, self._name, self._number, count)
        if self._template is not None:
            self._log_template(self._template)
        self._is_state_due = True

    def points_before(self, track: Track) -> Points | None:
        """Where the evidence's points were one step earlier, or else in the first frame."""
        if self._frame_from_template is not None:
            return transform_points(self._frame_from_template, track.evidence.template_points)
        return track.evidence.template_points if self._is_given_in_video else None

    def log(self, step: Step, track: Track) -> str:
        """Record the track; a line for the log if its state changed, else empty."""
        if self._is_given_in_video is None:
            pose = track.frame_from_template
            self._is_given_in_video = pose is not None and np.allclose(pose, np.eye(3), atol=1e-3)
        before, self._state = self._state, track.state
        message = ""
        if before is not track.state:
            message = _transition(step.frame.index, track, before)
        if message or self._is_state_due:
            self._is_state_due = False
            self._stream.log(self._entities.state, rr.StateChange(state=str(track.state)))
            self._frames_to_close_up = 0
        if track.quad is not None:
            self._log_quad(track.quad)
            self._log_close_up(step.frame.image, track)
        elif before is TrackState.TRACKING:
            self._stream.log(self._entities.drawing, rr.Clear(recursive=True))
            self._log_no_close_up(step.frame.image.shape[2:])
        self._log_numbers(track)
        self._frame_from_template = track.frame_from_template
        return message

    def pause(self) -> None:
        """No more pictures come for now: the state was that of the last one."""
        self._stream.log(self._entities.state, rr.StateChange(state=NO_PICTURE))
        self._is_state_due = True

    def _log_quad(self, quad: Points) -> None:
        outline = np.concatenate([quad, quad[:1]])[None]
        self._stream.log(self._entities.quad, rows.strips(outline))
        self._stream.log(self._entities.corners, rows.points(quad))

    def _log_numbers(self, track: Track) -> None:
        is_tracking = track.state is TrackState.TRACKING
        for path, value in (
            (self._entities.matches, len(track.evidence)),
            (self._entities.inliers, track.evidence.inliers),
            (self._entities.rmse_px, track.rmse_px),
            (self._entities.correlation, track.correlation),
        ):
            self._stream.log(path, rows.scalar(value if is_tracking else math.nan))

    def _log_close_up(self, image: Image, track: Track) -> None:
        if self._frames_to_close_up > 0:
            self._frames_to_close_up -= 1
            return
        self._frames_to_close_up = _CLOSE_UP_EVERY - 1
        assert track.frame_from_template is not None
        assert track.quad is not None
        try:
            template_from_frame = inverted(track.frame_from_template)
        except np.linalg.LinAlgError:
            return
        if self._box is None:
            self._box = bounding_box(transform_points(template_from_frame, track.quad))
        close_up = _upright(image, template_from_frame, self._box)
        if self._template is None:
            self._template = close_up
            self._log_template(close_up)
        self._stream.log(self._entities.view, _jpeg(close_up))

    def _log_no_close_up(self, channels: tuple[int, ...]) -> None:
        """A blank picture, for the viewer goes on showing a cleared one, and of the same kind, for
        it takes pictures in a row for a video."""
        if self._box is not None:
            size_wh, _ = _box_view(self._box)
            blank = np.full((size_wh[1], size_wh[0], *channels), _BLANK_GREY, np.uint8)
            self._stream.log(self._entities.view, _jpeg(blank))

    def _log_template(self, picture: Image) -> None:
        self._stream.log(self._entities.template, _jpeg(picture), static=True)


def _transition(index: int, track: Track, before: TrackState | None) -> str:
    change = f"{track.state}" if before is None else f"{before} -> {track.state}"
    why = track.reason or track.means
    return f"frame {index}: {track.name} {change}" + (f": {why}" if why else "")


def _upright(
    image: Image, template_from_frame: Matrix, box: tuple[float, float, float, float]
) -> Image:
    """The part of the frame that shows the template's ``box``, small and as it was given."""
    size, factor = _box_view(box)
    close_up_from_frame = scaling(factor) @ translation(-box[0], -box[1]) @ template_from_frame
    return np.asarray(cv2.warpPerspective(image, close_up_from_frame, size), np.uint8)


def _box_view(box: tuple[float, float, float, float]) -> tuple[Size, float]:
    x0, y0, x1, y1 = box
    return _close_up_size((round(x1 - x0) + 1, round(y1 - y0) + 1))


def _shrunk(picture: Image) -> Image:
    size, _ = _close_up_size((picture.shape[1], picture.shape[0]))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


def _close_up_size(size_wh: Size) -> tuple[Size, float]:
    factor = min(1.0, _CLOSE_UP_SIDE / max(size_wh))
    return (max(1, round(size_wh[0] * factor)), max(1, round(size_wh[1] * factor))), factor


def _jpeg(picture: Image) -> rr.EncodedImage:
    data = jpeg_of(picture, _CLOSE_UP_QUALITY)
    return rr.EncodedImage.from_fields(blob=data, media_type="image/jpeg")
