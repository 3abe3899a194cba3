"""Frames annotated for people: quads, names, states and points drawn into a copy of the picture."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Mapping
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from streamtrack.geometry import inverted, transform_points
from streamtrack.targets import color_number
from streamtrack.types import Image, Mask, Points, Size, Step, Track, TrackState

Color: TypeAlias = tuple[int, int, int]
"""Blue, green, red, 0..255."""

_WHITE: Color = (255, 255, 255)
_BLACK: Color = (0, 0, 0)
_OUTLIER: Color = (60, 60, 230)
_PALETTE_RGB = (
    *("#3ddc84", "#33b5ff", "#ffc533", "#ff6fb5", "#c77dff"),
    *("#2ee6d6", "#ff8c42", "#b8e044", "#8aa4ff", "#ff5a5f"),
)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_SHIFT = 4
_MAX_STATUS_LINES = 6


def target_color(index: int) -> Color:
    """The (b, g, r) of the target at ``index``: ten bright, distinct colours, then again."""
    red, green, blue = bytes.fromhex(_PALETTE_RGB[index % len(_PALETTE_RGB)][1:])
    return blue, green, red


def _color_of(index: int, track: Track) -> Color:
    return target_color(color_number(track, index))


class Trails:
    """The last ``length`` centres of each tracked target, carried along with a moving camera.

    A trail starts anew when its target is lost, the camera's place becomes unknown or the
    picture changes its size.
    """

    def __init__(self, length: int = 45) -> None:
        self._length = length
        self._world: dict[str, deque[npt.NDArray[np.float64]]] = {}
        self._size_wh: Size | None = None

    def follow(self, step: Step) -> dict[str, Points]:
        """Take in one frame; centres by target name, (N, 2) px of this frame, oldest first."""
        if step.frame.size_wh != self._size_wh:
            self._world, self._size_wh = {}, step.frame.size_wh
        world_from_frame = step.camera.world_from_frame
        tracked = {track.name: track for track in step.tracks if track.quad is not None}
        if world_from_frame is None:
            tracked = {}
        self._world = {name: trail for name, trail in self._world.items() if name in tracked}
        if world_from_frame is None:
            return {}
        for name, track in tracked.items():
            trail = self._world.setdefault(name, deque(maxlen=self._length))
            center = np.mean(np.asarray(track.quad, np.float64), axis=0)
            trail.append(transform_points(world_from_frame, center)[0].astype(np.float64))
        frame_from_world = inverted(world_from_frame)
        return {
            name: transform_points(frame_from_world, np.array(trail))
            for name, trail in self._world.items()
        }


class _Pen(NamedTuple):
    """Sizes that suit one picture: line width and dot radius in px, scale of the font."""

    width: int
    radius: float
    font: float


def draw_step(step: Step, *, trail: Mapping[str, npt.ArrayLike] | None = None) -> Image:
    """An annotated copy of the frame, uint8 (H, W, 3) BGR.

    Quads with their names and states in a colour a target, the point pairs behind them (inliers
    in the target's colour, outliers red), and a header with the time and what is not tracked, and
    why. ``trail`` maps target names to points (N, 2) px, oldest first, as `Trails.follow` gives.
    """
    picture = _copy_bgr(step.frame.image)
    pen = _pen_for(step.frame.size_wh)
    for index, track in enumerate(step.tracks):
        color = _color_of(index, track)
        _draw_evidence(picture, track, color, pen)
        if trail is not None and track.name in trail:
            _draw_trail(picture, trail[track.name], color, pen)
        if track.quad is not None:
            _draw_quad(picture, track.quad, color, pen)
    for index, track in enumerate(step.tracks):
        if track.quad is not None:
            _draw_label(picture, track, _color_of(index, track), pen)
    _draw_header(picture, step, pen)
    return picture


def _copy_bgr(image: Image) -> Image:
    if image.ndim == 3:
        return np.ascontiguousarray(image).copy()
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)


def _pen_for(size_wh: Size) -> _Pen:
    scale = min(size_wh) / 480
    return _Pen(max(2, round(2 * scale)), max(1.0, 1.8 * scale), max(0.35, 0.5 * scale))


def _draw_quad(picture: Image, quad: Points, color: Color, pen: _Pen) -> None:
    closed = np.vstack([quad, quad[:1]])
    _draw_path(picture, closed, _BLACK, pen.width + 2)
    _draw_path(picture, closed, color, pen.width)
    _draw_dots(picture, quad[:1], color, 2.0 * pen.radius)


def _draw_trail(picture: Image, points: npt.ArrayLike, color: Color, pen: _Pen) -> None:
    path = np.asarray(points, np.float64).reshape(-1, 2)
    _draw_path(picture, path, _BLACK, pen.width + 1)
    _draw_path(picture, path, color, max(1, pen.width - 1))


def _draw_path(picture: Image, points: npt.ArrayLike, color: Color, width: int) -> None:
    """Draw the open polyline (N, 2); parts outside the picture, inf and NaN are left out."""
    path = np.asarray(points, np.float64).reshape(-1, 2)
    size_wh = (picture.shape[1], picture.shape[0])
    for start, end in itertools.pairwise(path):
        ends = clip_segment(start, end, size_wh, margin=2.0 * width)
        if ends is not None:
            cv2.line(picture, _fixed(ends[0]), _fixed(ends[1]), color, width, cv2.LINE_AA, _SHIFT)


def clip_segment(
    start: npt.NDArray[np.float64], end: npt.NDArray[np.float64], size_wh: Size, margin: float
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]] | None:
    """The part of a segment within a picture grown by ``margin`` px.

    ``start`` and ``end`` are (2,) px, however far out; None if nothing is left or not finite.
    """
    if not (np.isfinite(start).all() and np.isfinite(end).all()):
        return None
    for axis in (0, 1):
        low, high = -margin, size_wh[axis] - 1 + margin
        if max(start[axis], end[axis]) < low or min(start[axis], end[axis]) > high:
            return None
        start, end = (
            _pulled(start, end, axis, low, high),
            _pulled(end, start, axis, low, high),
        )
    return start, end


def _pulled(
    point: npt.NDArray[np.float64],
    other: npt.NDArray[np.float64],
    axis: int,
    low: float,
    high: float,
) -> npt.NDArray[np.float64]:
    """The point moved towards the other until one coordinate is, exactly, within bounds."""
    value = min(max(point[axis], low), high)
    if value == point[axis]:
        return point
    moved: npt.NDArray[np.float64] = point + (other - point) * (
        (value - point[axis]) / (other[axis] - point[axis])
    )
    moved[axis] = value
    return moved


def _fixed(point: npt.NDArray[np.float64]) -> tuple[int, int]:
    """Fixed-point coordinates with `_SHIFT` fractional bits, as OpenCV draws them."""
    x, y = point.tolist()
    return round(x * (1 << _SHIFT)), round(y * (1 << _SHIFT))


def _draw_evidence(picture: Image, track: Track, color: Color, pen: _Pen) -> None:
    evidence = track.evidence
    _draw_dots(picture, evidence.frame_points[~evidence.is_inlier], _OUTLIER, 0.8 * pen.radius)
    _draw_dots(picture, evidence.frame_points[evidence.is_inlier], color, pen.radius)


def _draw_dots(picture: Image, points: Points, color: Color, radius: float) -> None:
    """Draw discs of ``radius`` px with a dark rim at the points (N, 2) that lie in the picture."""
    height, width = picture.shape[:2]
    inside: Mask = np.all((points >= 0) & (points <= (width - 1, height - 1)), axis=1)
    fixed_radius = round(radius * (1 << _SHIFT))
    for center in np.rint(points[inside] * (1 << _SHIFT)).astype(np.intp).tolist():
        cv2.circle(picture, center, fixed_radius + 12, _BLACK, -1, cv2.LINE_AA, _SHIFT)
        cv2.circle(picture, center, fixed_radius, color, -1, cv2.LINE_AA, _SHIFT)


def _draw_label(picture: Image, track: Track, color: Color, pen: _Pen) -> None:
    assert track.quad is not None
    if not np.isfinite(track.quad).all():
        return
    tag = f"{track.name}: {track.state.value}" + (f" ({track.means})" if track.means else "")
    if track.is_found:  # there may be many
        tag = track.name
    text = _fitted(tag, picture.shape[1] - 2 * _margin(pen), pen)
    (width, height), _ = cv2.getTextSize(text, _FONT, pen.font, 1)
    margin = _margin(pen)
    x, y = track.quad[np.argmin(track.quad[:, 1])].astype(np.float64) - (0, margin)
    lowest = margin + 2 * height
    x = float(np.clip(x, margin, max(margin, picture.shape[1] - width - margin)))
    y = float(np.clip(y, lowest, max(lowest, picture.shape[0] - margin)))
    _draw_text(picture, text, (round(x), round(y)), color, pen)


def _draw_header(picture: Image, step: Step, pen: _Pen) -> None:
    """The frame's number, time and name, then a line for each target that is not tracked."""
    frame = step.frame
    parts = [f"frame {frame.index}", f"{frame.time_s:.3f} s", *([frame.name] if frame.name else [])]
    lines: list[tuple[str, Color]] = [(" | ".join(parts), _WHITE)]
    for index, track in enumerate(step.tracks):
        if track.state is not TrackState.TRACKING and not track.is_found:
            lines.append(
                (_status(track.name, track.state.value, track.reason), _color_of(index, track))
            )
    if step.camera.world_from_frame is None:
        lines.append((_status("camera", "unknown", step.camera.reason), _WHITE))
    margin = _margin(pen)
    _, line_height = cv2.getTextSize("Ag", _FONT, pen.font, 1)[0]
    for row, (text, color) in enumerate(lines[: 1 + _MAX_STATUS_LINES]):
        origin = (margin, margin + round(line_height * (1 + 1.5 * row)))
        _draw_text(picture, _fitted(text, picture.shape[1] - 2 * margin, pen), origin, color, pen)


def _status(name: str, state: str, reason: str) -> str:
    return f"{name}: {state}" + (f", {reason}" if reason else "")


def _margin(pen: _Pen) -> int:
    return 3 * pen.width + 2


def _fitted(text: str, width: int, pen: _Pen) -> str:
    """The text on one line, cut with an ellipsis if it is wider than ``width`` px."""
    text = " ".join(text.encode("utf-8", "replace").decode("utf-8").split())[:200]
    (full, _), _ = cv2.getTextSize(text, _FONT, pen.font, 1)
    kept = text
    while full > width and kept:
        kept = kept[: min(len(kept) - 1, len(kept) * width // full)].rstrip()
        (full, _), _ = cv2.getTextSize(kept + "...", _FONT, pen.font, 1)
    return kept if kept == text else f"{kept}..." if kept else ""


def _draw_text(picture: Image, text: str, origin: tuple[int, int], color: Color, pen: _Pen) -> None:
    """Draw text with its baseline from ``origin``, outlined so that any background will do.

    The outline is the text itself moved about: a thicker font would also be a wider one.
    """
    reach = max(1, round(pen.font * 2))
    x, y = origin
    for dx in (-reach, 0, reach):
        for dy in (-reach, 0, reach):
            cv2.putText(picture, text, (x + dx, y + dy), _FONT, pen.font, _BLACK, 1, cv2.LINE_AA)
    cv2.putText(picture, text, origin, _FONT, pen.font, color, 1, cv2.LINE_AA)
