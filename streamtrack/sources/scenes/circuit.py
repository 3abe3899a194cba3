"""A circuit board."""

from __future__ import annotations

import cv2
import numpy as np

from streamtrack.sources.scenes.canvas import (
    Colour,
    box,
    cloud,
    disc,
    frame_box,
    label,
    plain,
    shade,
    shape,
    soft_shadow,
    stroke,
    tinted,
    turned_box,
    varied,
    write,
)
from streamtrack.types import Image, Size

SIZE: Size = (960, 720)
MASK: Colour = (58, 92, 18)
COPPER: Colour = (74, 122, 34)
GOLD: Colour = (96, 186, 222)
SOLDER: Colour = (188, 192, 190)
SILK: Colour = (228, 234, 232)
PACKAGE: Colour = (44, 42, 40)
CELL = 24
Area = tuple[float, float, float, float]


class _Plan:
    """Which cells of the board are taken, and what to call the next part."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.taken = np.zeros((SIZE[1] // CELL, SIZE[0] // CELL), np.bool_)
        self.taken[:1], self.taken[-1:], self.taken[:, :1], self.taken[:, -1:] = (True,) * 4
        self.counts: dict[str, int] = {}

    def name(self, letter: str) -> str:
        self.counts[letter] = self.counts.get(letter, 0) + 1
        return f"{letter}{self.counts[letter]}"

    def take(self, col: int, row: int, cols: int, rows: int) -> Area:
        self.taken[row : row + rows, col : col + cols] = True
        return col * CELL, row * CELL, cols * CELL, rows * CELL

    def find(self, cols: int, rows: int, tries: int = 40) -> Area | None:
        """A free place, taken at once."""
        for _ in range(tries):
            col = int(self.rng.integers(1, self.taken.shape[1] - cols))
            row = int(self.rng.integers(1, self.taken.shape[0] - rows))
            if not self.taken[row : row + rows, col : col + cols].any():
                return self.take(col, row, cols, rows)
        return None


def paint_board(rng: np.random.Generator) -> Image:
    """Green solder mask, routed copper, chips, small parts, connectors and print."""
    board = tinted(plain(SIZE, MASK), cloud(rng, SIZE, 240, 5), 6)
    plan = _Plan(rng)
    _traces(board, rng)
    _fixtures(board, plan)
    for size in ((7, 7), (9, 5), (5, 4), (4, 5), (4, 3), (5, 3), (3, 4)):
        if area := plan.find(*size):
            _chip(board, plan, area)
    for cols, rows, paint in ((2, 2, _can), (2, 2, _can), (3, 2, _crystal), (2, 2, _can)):
        if area := plan.find(cols, rows):
            paint(board, plan, area)
    for k in range(110):
        if area := plan.find(*((2, 1) if k % 2 else (1, 2)), 12):
            _small_part(board, plan, area)
    write(board, "STREAMTRACK  REV C", (300, 704), 19, SILK, 700)
    frame_box(board, 5, 5, SIZE[0] - 11, SIZE[1] - 11, shade(MASK, 0.7), 3)
    return board


def _traces(board: Image, rng: np.random.Generator) -> None:
    """Buses and single traces that run along the axes and turn by 45 degrees, with vias."""
    vias = []
    for _ in range(64):
        lanes, width = int(rng.choice([1, 1, 2, 4, 6])), int(rng.choice([3, 4, 5]))
        course = _route(rng)
        for lane in range(lanes):
            moved = course + np.array([1.0, 0.55]) * lane * (2.6 * width)
            stroke(board, moved, shade(MASK, 0.8), width + 3)
            stroke(board, moved, varied(rng, COPPER, 5), width)
            vias += [moved[0], moved[-1]]
    for x, y in vias:
        disc(board, x, y, 6.5, COPPER)
        disc(board, x, y, 5.0, GOLD)
        disc(board, x, y, 2.4, (24, 30, 20))


def _route(rng: np.random.Generator) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    points = [rng.uniform((20, 20), (SIZE[0] - 20, SIZE[1] - 20))]
    direction = int(rng.integers(4)) * 2
    for _ in range(int(rng.integers(3, 7))):
        angle = direction * np.pi / 4
        length = rng.uniform(30, 130) * (1.4 if direction % 2 == 0 else 0.5)
        goal = points[-1] + length * np.array([np.cos(angle), np.sin(angle)])
        points.append(np.clip(goal, 20, (SIZE[0] - 20, SIZE[1] - 20)))
        direction += int(rng.choice([-1, 1]))
    return np.array(points)


def _fixtures(board: Image, plan: _Plan) -> None:
    """Mounting holes in the corners, a pin header, a connector and an edge of pads."""
    for col, row in ((0, 0), (37, 0), (0, 27), (37, 27)):
        x, y, _, _ = plan.take(max(col - 1, 0), max(row - 1, 0), 4, 4)
        x, y = (34 if col == 0 else SIZE[0] - 35), (34 if row == 0 else SIZE[1] - 35)
        disc(board, x, y, 25, GOLD)
        disc(board, x, y, 23, varied(plan.rng, GOLD, 12))
        disc(board, x, y, 14, (52, 78, 104))
    _header(board, plan, plan.take(8, 1, 14, 2))
    _connector(board, plan.take(0, 9, 5, 6))
    _connector(board, plan.take(0, 17, 5, 5))
    _header(board, plan, plan.take(24, 26, 12, 2))


def _header(board: Image, plan: _Plan, area: Area) -> None:
    x, y, w, h = area
    box(board, x, y, w, h, (30, 30, 30))
    frame_box(board, x - 3, y - 3, w + 6, h + 6, SILK, 2)
    for px in np.arange(x + CELL / 2, x + w, CELL):
        for py in (y + CELL / 2, y + 3 * CELL / 2):
            box(board, px - 6, py - 6, 12, 12, (16, 16, 16))
            box(board, px - 4, py - 4, 8, 8, varied(plan.rng, GOLD, 15))
    write(board, plan.name("J"), (x + w + 8, y + h - 6), 18, SILK)


def _connector(board: Image, area: Area) -> None:
    """A metal shell at the left edge."""
    x, y, w, h = area
    shell = np.array([[x + 2, y], [x + w - 8, y], [x + w - 8, y + h - 8], [x + 2, y + h - 8]])
    soft_shadow(board, shell, 5, 0.55, (4, 6))
    shape(board, shell, (176, 180, 182))
    box(board, x + 2, y, w - 12, 10, (214, 218, 220))
    box(board, x + 2, y + h - 22, w - 12, 12, (126, 130, 134))
    for k in (0.3, 0.62):
        box(board, x + w * 0.28, y + h * k, w * 0.36, 12, (92, 96, 100))


def _chip(board: Image, plan: _Plan, area: Area) -> None:
    """A package with pins on two or four sides, its marking and its name."""
    x, y, w, h = (area[0] + 13, area[1] + 13, area[2] - 26, area[3] - 26)
    for px in np.arange(x + 7, x + w - 8, 12):
        for py in (y - 11, y + h):
            box(board, px, py, 6, 11, SOLDER)
    if area[2] == area[3]:
        for py in np.arange(y + 7, y + h - 8, 12):
            for px in (x - 11, x + w):
                box(board, px, py, 11, 6, SOLDER)
    body = turned_box((x + w / 2, y + h / 2), (w, h), 0.0)
    soft_shadow(board, body, 4, 0.6, (4, 5))
    shape(board, body, varied(plan.rng, PACKAGE, 6))
    stroke(board, body[[3, 0, 1]], (86, 84, 82), 3)
    disc(board, x + 13, y + 13, 5, (74, 72, 70))
    size = int(min(24, h / 3.4, w / 5.2))
    letters = "".join(plan.rng.choice(list("ABCDEFGHKLMNPRSTXZ"), 3))
    for k, text in enumerate((f"{letters}{plan.rng.integers(100, 9999)}", "2614 KR")):
        write(board, text, (x + 12, y + h * 0.58 + 1.2 * size * k), size, (176, 178, 176), 500)
    write(board, plan.name("U"), (x + 2, y - 13), 17, SILK, 500)


def _can(board: Image, plan: _Plan, area: Area) -> None:
    """An electrolytic capacitor seen from above."""
    x, y, radius = area[0] + area[2] / 2, area[1] + area[3] / 2, area[2] / 2 - 3
    soft_shadow(board, turned_box((x, y), (1.5 * radius, 1.5 * radius), 0.0), 5, 0.6, (5, 6))
    box(board, x - radius, y - radius, 2 * radius, 2 * radius, (34, 32, 30))
    disc(board, x, y, radius - 1, (206, 208, 206))
    disc(board, x, y, radius - 4, (178, 180, 180))
    across = np.array([[-0.6, -0.75], [-0.6, 0.75]]) * radius + (x, y)
    stroke(board, across, (40, 36, 34), 7)
    label(board, str(plan.rng.choice(["47", "100", "220"])), (x + 4, y), 15, (50, 46, 44))
    write(board, plan.name("C"), (area[0], area[1] - 2), 15, SILK)


def _crystal(board: Image, plan: _Plan, area: Area) -> None:
    x, y, w, h = area[0] + 4, area[1] + 8, area[2] - 8, area[3] - 16
    body = turned_box((x + w / 2, y + h / 2), (w, h), 0.0)
    soft_shadow(board, body, 4, 0.5, (3, 5))
    shape(board, body, (168, 172, 174))
    stroke(board, body[[3, 0, 1]], (226, 228, 228), 3)
    label(board, f"{plan.rng.integers(8, 49)}.000", (x + w / 2, y + h / 2), 15, (70, 70, 70))
    write(board, plan.name("Y"), (area[0] + 6, area[1] + 4), 14, SILK)


def _small_part(board: Image, plan: _Plan, area: Area) -> None:
    """A resistor, a ceramic capacitor or a light-emitting diode with its two pads."""
    x, y, w, h = area
    is_flat = w > h
    kind = plan.rng.choice(["R", "R", "C", "D"])
    colour = {"R": (38, 36, 36), "C": (108, 146, 178), "D": (206, 222, 222)}[str(kind)]
    length, across = 30, 15
    wide, tall = (length, across) if is_flat else (across, length)
    cx, cy = x + w / 2, y + h / 2
    box(board, cx - wide / 2 - 3, cy - tall / 2 - 3, wide + 6, tall + 6, shade(MASK, 0.75))
    box(board, cx - wide / 2, cy - tall / 2, wide, tall, SOLDER)
    inner = (length - 14, across) if is_flat else (across, length - 14)
    box(board, cx - inner[0] / 2, cy - inner[1] / 2, *inner, varied(plan.rng, colour, 10))
    if kind == "R" and is_flat:
        label(board, str(plan.rng.choice(["103", "472", "10R"])), (cx + 1, cy), 10, (210, 210, 210))
    text = plan.name(str(kind))
    write(board, text, (x + 2, y - 1) if is_flat else (x + w - 3, y + 16), 13, SILK)


def dusty(board: Image, rng: np.random.Generator) -> Image:
    """Fine grain and a broad sheen."""
    height, width = board.shape[:2]
    sheen = cloud(rng, (width, height), 500, 2)
    grain = cv2.GaussianBlur(rng.standard_normal((height, width)).astype(np.float32), (0, 0), 1.0)
    return tinted(tinted(board, sheen, 6), np.asarray(grain, np.float32), 5)
