"""Accuracy over cost, one dot a method, as PNG. OpenCV draws it, so nothing more is needed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from streamtrack.bench.report import Report
from streamtrack.errors import UsageError
from streamtrack.outputs import write_file
from streamtrack.types import Image

_WIDTH, _HEIGHT = 1600, 1000
_LEFT, _RIGHT, _TOP, _BOTTOM = 130, 60, 190, 120
_INK, _GREY, _GRID = (45, 38, 33), (125, 115, 108), (232, 228, 225)
_OWN_COLOR, _PEER_COLOR = (60, 90, 235), (160, 120, 70)
_RADIUS = 11
_TEXT, _LABEL, _TITLE = 24, 26, 36
_REGULAR, _BOLD = 400, 700
_NEAR_PX = 24.0
_FAR_COST = 4.0
_OWN = "streamtrack"
_Color = tuple[int, int, int]
_Box = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class _Dot:
    """One method; ``p5`` None for box trackers, which stand on the axis."""

    name: str
    title: str
    cpu_ms: float
    p5: float | None


def check_plot_path(path: Path) -> None:
    """Raise UsageError unless the file is to be a PNG."""
    if path.suffix.lower() != ".png":
        raise UsageError(f"the plot is a PNG picture: name it {path.stem}.png")


def write_plot(path: Path, report: Report) -> None:
    """Draw the report's methods into a PNG file. Raises OutputError."""
    _, data = cv2.imencode(".png", draw_plot(report))
    write_file(path, data.tobytes())


def draw_plot(report: Report) -> Image:
    """Share of frames within 5 px over median CPU time, at the smallest picture size."""
    size, dots = _dots(report)
    frame = _Axes(dots)
    canvas = np.full((_HEIGHT, _WIDTH, 3), 255, np.uint8)
    frame.draw(canvas, size)
    _write(canvas, "Accuracy over cost of tracking", (_LEFT, 62), _TITLE, _INK, _BOLD)
    _write(canvas, _subtitle(report, size), (_LEFT, 106), _TEXT, _GREY)
    taken: list[_Box] = [_around(*frame.place(dot), _RADIUS + 3.0) for dot in dots]
    labels: list[tuple[_Dot, _Box]] = []
    for dot in sorted(dots, key=lambda dot: dot.name != _OWN):
        labels.append((dot, _label_box(frame.place(dot), dot, taken)))
        x0, y0, x1, y1 = labels[-1][1]
        taken.append((x0 - 8.0, y0, x1 + 8.0, y1))
    for dot, box in labels:
        _draw_leader(canvas, frame.place(dot), box)
    for dot, box in labels:
        _draw_label(canvas, dot, box)
    for dot in dots:
        _draw_dot(canvas, frame.place(dot), dot)
    return canvas


def _dots(report: Report) -> tuple[str, list[_Dot]]:
    """The methods at the smallest size that was run, POT if nothing else was."""
    sizes = {s: _area(s) for method in report["methods"] for s in method["by_size"]}
    size = min(sizes, key=lambda name: sizes[name]) if sizes else ""
    dots = []
    for method in report["methods"]:
        whole = method["all"] or method["pot"]
        timed = method["by_size"].get(size, whole)
        if whole is not None and timed["cpu_ms"]["p50"] is not None:
            dots.append(_Dot(method["name"], method["title"], timed["cpu_ms"]["p50"], whole["p5"]))
    return size, dots


def _area(size: str) -> int:
    width, _, height = size.partition("x")
    return int(width) * int(height)


def _subtitle(report: Report, size: str) -> str:
    group = "synthetic" if size else "pot"
    own = [sequence for sequence in report["sequences"] if sequence["group"] == group]
    scored = sum(sequence["scored_frames"] for sequence in own)
    what = "synthetic" if size else "POT"
    plural = "" if len(own) == 1 else "s"
    return f"{len(own)} {what} sequence{plural}, {scored:,} scored frames; one thread, no GPU"


class _Axes:
    """From milliseconds and shares to pixels."""

    def __init__(self, dots: Sequence[_Dot]) -> None:
        times = [dot.cpu_ms for dot in dots] or [1.0, 100.0]
        shares = [dot.p5 for dot in dots if dot.p5 is not None] or [0.0]
        self._low = math.log10(min(times) / 1.6)
        self._high = math.log10(max(times) * 1.9)
        # Room under the lowest dot, the axis itself is for boxes.
        self._bottom = max(math.floor((min(shares) - 0.06) * 10.0) / 10.0, 0.0)

    def place(self, dot: _Dot) -> tuple[float, float]:
        """The dot's centre."""
        return self.x(dot.cpu_ms), self.y(self._bottom if dot.p5 is None else dot.p5)

    def x(self, cpu_ms: float) -> float:
        share = (math.log10(max(cpu_ms, 1e-3)) - self._low) / (self._high - self._low)
        return _LEFT + share * (_WIDTH - _LEFT - _RIGHT)

    def y(self, p5: float) -> float:
        share = (p5 - self._bottom) / (1.0 - self._bottom)
        return _HEIGHT - _BOTTOM - share * (_HEIGHT - _TOP - _BOTTOM)

    def draw(self, canvas: Image, size: str) -> None:
        right, bottom = _WIDTH - _RIGHT, _HEIGHT - _BOTTOM
        for tick in np.arange(self._bottom, 1.001, 0.1):
            y = round(self.y(float(tick)))
            cv2.line(canvas, (_LEFT, y), (right, y), _GRID, 2, cv2.LINE_AA)
            _write(canvas, f"{tick:.0%}", (_LEFT - 16, y + 9), _TEXT, _GREY, align=1.0)
        for tick in (n * 10.0**power for power in range(-2, 5) for n in (1, 2, 5)):
            if self._low <= math.log10(tick) <= self._high:
                x = round(self.x(tick))
                cv2.line(canvas, (x, _TOP), (x, bottom), _GRID, 2, cv2.LINE_AA)
                _write(canvas, f"{tick:g}", (x, bottom + 38), _TEXT, _GREY, align=0.5)
        cv2.line(canvas, (_LEFT, bottom), (right, bottom), _GREY, 2, cv2.LINE_AA)
        middle = (_LEFT + right) / 2.0
        at = f" of {size}" if size else ""
        about = f"CPU milliseconds a frame{at}, median, logarithmic"
        _write(canvas, about, (middle, bottom + 84), _TEXT, _INK, align=0.5)
        _write(canvas, "frames within 5 px", (_LEFT, _TOP - 20), _TEXT, _INK)


def _draw_dot(canvas: Image, place: tuple[float, float], dot: _Dot) -> None:
    centre = round(place[0]), round(place[1])
    color = _OWN_COLOR if dot.name == _OWN else _PEER_COLOR
    cv2.circle(canvas, centre, _RADIUS + 3, (255, 255, 255), -1, cv2.LINE_AA)
    if dot.p5 is None:
        cv2.circle(canvas, centre, _RADIUS - 1, _GREY, 3, cv2.LINE_AA)
    else:
        cv2.circle(canvas, centre, _RADIUS, color, -1, cv2.LINE_AA)


def _label_box(place: tuple[float, float], dot: _Dot, taken: Sequence[_Box]) -> _Box:
    """Where the title covers least, and then near its dot."""
    width, height = _extent(dot.title, _LABEL, _weight(dot))
    boxes = [
        (left, top, left + width, top + height)
        for left, top in _places_for(place, width, height, is_on_axis=dot.p5 is None)
    ]

    def cost(box: _Box) -> float:
        hidden = sum(_overlap(box, other) for other in taken) + _outside(box)
        return hidden + _FAR_COST * max(_distance(box, place) - _NEAR_PX, 0.0)

    return min(boxes, key=cost)


def _draw_leader(canvas: Image, place: tuple[float, float], box: _Box) -> None:
    """A line from a dot to its label, if they are apart."""
    if _distance(box, place) <= _NEAR_PX:
        return
    end = min(max(place[0], box[0]), box[2]), min(max(place[1], box[1]), box[3])
    a, b = ((round(point[0]), round(point[1])) for point in (place, end))
    cv2.line(canvas, a, b, _GREY, 2, cv2.LINE_AA)


def _draw_label(canvas: Image, dot: _Dot, box: _Box) -> None:
    """The title on white, so that the grid does not cross it."""
    color = _OWN_COLOR if dot.name == _OWN else _GREY if dot.p5 is None else _INK
    x0, y0, x1, y1 = (round(edge) for edge in box)
    cv2.rectangle(canvas, (x0 - 3, y0 + 3), (x1 + 3, y1 - 3), (255, 255, 255), -1)
    _write(canvas, dot.title, (x0, y1 - 0.22 * (y1 - y0)), _LABEL, color, _weight(dot))


def _weight(dot: _Dot) -> int:
    return _BOLD if dot.name == _OWN else _REGULAR


def _places_for(
    dot: tuple[float, float], width: float, height: float, *, is_on_axis: bool
) -> list[tuple[float, float]]:
    """Top-left corners that a label may have: round the dot, or in rows below and above it."""
    x, y = dot
    away = _RADIUS + 12.0
    level = [(x + away, y - height / 2.0), (x - away - width, y - height / 2.0)]
    above = [
        (x + along, y - away - row * height)
        for row in (0.8, 1.0, *(1.0 + 1.15 * n for n in range(1, 8)))
        for along in (-width / 2.0, 0.7 * away, -0.7 * away - width)
    ]
    if is_on_axis:  # whose numbers stand below
        return above
    below = [(left, 2.0 * y - top - height) for left, top in above]
    return [*level, *below, *above]


def _distance(box: _Box, point: tuple[float, float]) -> float:
    """From the point to the nearest of the box."""
    x = max(box[0] - point[0], point[0] - box[2], 0.0)
    y = max(box[1] - point[1], point[1] - box[3], 0.0)
    return math.hypot(x, y)


def _overlap(a: _Box, b: _Box) -> float:
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    return max(width, 0.0) * max(height, 0.0)


def _outside(box: _Box) -> float:
    """How much of a box leaves the plot, weighed heavily."""
    inside = (float(_LEFT), float(_TOP) - 8.0, float(_WIDTH - 8), float(_HEIGHT - _BOTTOM) - 4.0)
    area = (box[2] - box[0]) * (box[3] - box[1])
    return 10.0 * (area - _overlap(box, inside))


def _around(x: float, y: float, radius: float) -> _Box:
    return x - radius, y - radius, x + radius, y + radius


def _extent(text: str, size: int, weight: int) -> tuple[float, float]:
    """Width of the text, and height of a line of it."""
    box = cv2.getTextSize((_WIDTH, _HEIGHT), text, (0, 0), cv2.FontFace("sans"), size, weight)
    return float(box[2]), 1.2 * size


def _write(
    canvas: Image,
    text: str,
    at: tuple[float, float],
    size: int,
    color: _Color,
    weight: int = _REGULAR,
    align: float = 0.0,
) -> None:
    """Text on a base line; ``align`` 0 begins, 0.5 centres and 1 ends at the point."""
    x = at[0] - align * _extent(text, size, weight)[0]
    cv2.putText(canvas, text, (round(x), round(at[1])), color, cv2.FontFace("sans"), size, weight)
