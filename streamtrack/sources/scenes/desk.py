"""What is behind and in front of a target: a desk with things on it, and occluders."""

from __future__ import annotations

import cv2
import numpy as np

from streamtrack.sources.scenes.canvas import (
    Colour,
    box,
    cloud,
    disc,
    mixed,
    plain,
    round_box_points,
    shade,
    shape,
    soft_shadow,
    stroke,
    tinted,
    turned_box,
    varied,
    write,
)
from streamtrack.sources.scenes.prints import paint_book, paint_letter
from streamtrack.sources.scenes.rendering import premultiplied
from streamtrack.types import Image, Size

CANVAS_WIDTH = 1280
SKIN: Colour = (142, 172, 222)


def paint_desk(rng: np.random.Generator, size_wh: Size) -> Image:
    """Wood, cloth or a cutting mat with other things lying around, at the size of the frame."""
    canvas = CANVAS_WIDTH, max(round(CANVAS_WIDTH * size_wh[1] / size_wh[0]), 16)
    desk = (_wood, _cloth, _mat)[int(rng.integers(3))](rng, canvas)
    _crumbs(desk, rng)
    for paint in (_sheet, _sheet, _screws, _cup, _pens, _pens, _ruler, _cable, _note, _note):
        paint(desk, rng)
    desk = tinted(desk, cloud(rng, canvas, 900, 2), 12)
    is_smaller = size_wh[0] < canvas[0]
    return np.asarray(
        cv2.resize(desk, size_wh, interpolation=cv2.INTER_AREA if is_smaller else cv2.INTER_CUBIC),
        np.uint8,
    )


def _wood(rng: np.random.Generator, size_wh: Size) -> Image:
    """Boards side by side, each with its own tone and grain."""
    width, height = size_wh
    desk = plain(size_wh, (92, 132, 172))
    tall = 170
    for y in range(0, height, tall):
        rows = min(tall, height - y)
        board = plain((width, rows), varied(rng, (88, 128, 168), 14))
        warp = cloud(rng, (width, rows), 130, 2, 5.0) * 34
        rings = np.sin((np.arange(rows, dtype=np.float32)[:, None] * 0.5 + warp) * 0.9)
        board = tinted(board, rings.astype(np.float32), 7)
        board = tinted(board, cloud(rng, (width, rows), 14, 3, 12.0), 15)
        desk[y : y + rows] = board
        box(desk, 0, y, width, 3, (48, 70, 92))
    return desk


def _cloth(rng: np.random.Generator, size_wh: Size) -> Image:
    """Woven cloth with a woven-in check."""
    width, height = size_wh
    x, y = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)[:, None]
    weave = (np.sin(x * 1.15) + np.sin(y * 1.15)).astype(np.float32)
    cloth = plain(size_wh, varied(rng, (132, 112, 92), 20))
    stripe = ((x % 210 < 46).astype(np.float32) + (y % 210 < 46)) * 0.34
    cloth = mixed(cloth, (70, 62, 120), stripe.astype(np.float32))
    return tinted(tinted(cloth, weave, 7), cloud(rng, size_wh, 260, 6), 16)


def _mat(rng: np.random.Generator, size_wh: Size) -> Image:
    """A worn green cutting mat with its grid."""
    width, height = size_wh
    mat = tinted(plain(size_wh, (92, 98, 52)), cloud(rng, size_wh, 300, 6), 14)
    for k, x in enumerate(range(0, width, 52)):
        box(mat, x, 0, 3 if k % 5 == 0 else 1, height, (150, 164, 122))
        write(mat, str(k), (x + 6, 20), 17, (160, 176, 136))
    for k, y in enumerate(range(0, height, 52)):
        box(mat, 0, y, width, 3 if k % 5 == 0 else 1, (150, 164, 122))
    for _ in range(40):
        start = rng.uniform((0, 0), size_wh)
        stroke(mat, [start, start + rng.normal(0, 90, 2)], (108, 118, 72), 1)
    return mat


def _spot(desk: Image, rng: np.random.Generator) -> tuple[float, float]:
    """A place near the rim, where the target seldom is."""
    height, width = desk.shape[:2]
    angle = rng.uniform(0.0, 2 * np.pi)
    reach = rng.uniform(0.78, 1.0)
    x = width * (0.5 + 0.48 * reach * np.sign(np.cos(angle)) * abs(np.cos(angle)) ** 0.6)
    y = height * (0.5 + 0.48 * reach * np.sign(np.sin(angle)) * abs(np.sin(angle)) ** 0.6)
    return float(x), float(y)


def _sheet(desk: Image, rng: np.random.Generator) -> None:
    """A book or a letter, laid down at an angle."""
    print_ = paint_book(rng) if rng.random() < 0.6 else paint_letter(rng)
    height, width = print_.shape[:2]
    lying = turned_box(_spot(desk, rng), (0.5 * width, 0.5 * height), rng.uniform(-0.6, 0.6))
    soft_shadow(desk, lying, 9, 0.5, (7, 9))
    small = cv2.resize(print_, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    corners = np.array([[0, 0], [width, 0], [width, height]], np.float32) / 2 - 0.5
    low = np.maximum(np.floor(lying.min(axis=0)), 0).astype(int) - (2, 2)
    low = np.maximum(low, 0)
    high = np.ceil(lying.max(axis=0)).astype(int) + 3
    part = desk[low[1] : max(high[1], 0), low[0] : max(high[0], 0)]
    if part.size == 0:
        return
    matrix = cv2.getAffineTransform(corners, (lying[:3] - low).astype(np.float32))
    size = part.shape[1], part.shape[0]
    cover = np.full(small.shape[:2], 255, np.uint8)
    share = cv2.warpAffine(cover, matrix, size).astype(np.float32) / 255.0
    warped = cv2.warpAffine(small, matrix, size, borderMode=cv2.BORDER_REPLICATE)
    part[:] = mixed(part, np.asarray(warped, np.uint8), share)


def _pens(desk: Image, rng: np.random.Generator) -> None:
    x, y = _spot(desk, rng)
    angle, colour = rng.uniform(0, np.pi), varied(rng, (60, 60, 150), 60)
    along = np.array([np.cos(angle), np.sin(angle)])
    body = turned_box((x, y), (250, 17), angle)
    soft_shadow(desk, body, 5, 0.5, (5, 7))
    shape(desk, body, colour)
    shape(desk, turned_box((x, y), (250, 5), angle), shade(colour, 1.6))
    middle = np.array([x, y])
    tip = [body[1], middle + along * 158, body[2]]
    shape(desk, tip, (150, 192, 222))
    shape(
        desk,
        [middle + along * 148 + (-3, -3), middle + along * 158, middle + along * 148],
        (30, 30, 30),
    )
    shape(desk, turned_box(middle - along * 116, (22, 18), angle), (180, 186, 190))


def _ruler(desk: Image, rng: np.random.Generator) -> None:
    x, y = _spot(desk, rng)
    angle = rng.uniform(0, np.pi)
    body = turned_box((x, y), (430, 52), angle)
    soft_shadow(desk, body, 5, 0.45, (4, 6))
    shape(desk, body, (196, 206, 208))
    along, across = (body[1] - body[0]) / 430, (body[3] - body[0]) / 52
    for k, at in enumerate(range(8, 424, 8)):
        start = body[0] + along * at
        stroke(desk, [start, start + across * (24 if k % 5 == 0 else 13)], (40, 40, 40), 2)


def _cup(desk: Image, rng: np.random.Generator) -> None:
    """A cup of coffee from above."""
    x, y = _spot(desk, rng)
    around = np.arange(40) * np.pi / 20
    rim = np.column_stack([x + 76 * np.cos(around), y + 76 * np.sin(around)])
    soft_shadow(desk, rim, 12, 0.55, (12, 14))
    colour = varied(rng, (206, 198, 190), 30)
    shape(desk, turned_box((x + 84, y), (46, 24), 0.3), shade(colour, 0.85))
    for radius, tone in ((78, colour), (68, shade(colour, 0.7)), (62, (26, 44, 70))):
        disc(desk, x, y, radius, tone)
    cv2.ellipse(desk, (round(x), round(y)), (46, 46), 20, 0, 70, (60, 92, 130), 4, cv2.LINE_AA)


def _screws(desk: Image, rng: np.random.Generator) -> None:
    x, y = _spot(desk, rng)
    for at in rng.normal((x, y), 66, (12, 2)):
        angle = rng.uniform(0, np.pi)
        soft_shadow(desk, turned_box(at, (22, 22), angle), 3, 0.5, (3, 4))
        disc(desk, at[0], at[1], 13, (150, 158, 162))
        disc(desk, at[0] - 1, at[1] - 1, 10, (192, 198, 200))
        shape(desk, turned_box(at, (16, 4), angle), (70, 74, 78))
        shape(desk, turned_box(at, (4, 16), angle), (70, 74, 78))


def _crumbs(desk: Image, rng: np.random.Generator) -> None:
    """Specks, paper snippets and stains all over the desk."""
    height, width = desk.shape[:2]
    for x, y in rng.uniform((0, 0), (width, height), (150, 2)):
        size = rng.uniform(3, 13, 2)
        snippet = turned_box((x, y), size, rng.uniform(0, np.pi))
        soft_shadow(desk, snippet, 2, 0.4, (2, 2))
        shape(desk, snippet, varied(rng, (140, 160, 170), 50))


def _cable(desk: Image, rng: np.random.Generator) -> None:
    x, y = _spot(desk, rng)
    t = np.linspace(0, 1, 60)
    waves = np.sin(t * rng.uniform(5, 9)) * 90 * t, np.cos(t * rng.uniform(4, 8)) * 80
    course = np.column_stack([x + 500 * (t - 0.5) + waves[1], y + waves[0]])
    stroke(desk, np.add(course, (4, 6)), (40, 46, 52), 11)
    stroke(desk, course, (36, 34, 34), 10)
    stroke(desk, np.subtract(course, (1, 2)), (92, 90, 90), 3)


def _note(desk: Image, rng: np.random.Generator) -> None:
    x, y = _spot(desk, rng)
    paper = turned_box((x, y), (130, 130), rng.uniform(-0.5, 0.5))
    soft_shadow(desk, paper, 7, 0.4, (5, 8))
    shape(desk, paper, varied(rng, (130, 226, 244), 30))
    right, down = (paper[1] - paper[0]) / 130, (paper[3] - paper[0]) / 130
    for row in range(5):
        t = np.linspace(0, 1, 30)[:, None]
        base = paper[0] + right * 14 + down * (26 + 21 * row)
        scrawl = base + right * t * rng.uniform(50, 100) + down * 6 * rng.uniform(-1, 1, (30, 1))
        stroke(desk, scrawl, (90, 60, 50), 2)


def paint_occluder(rng: np.random.Generator, kind: str, width: int, height: int) -> Image:
    """Premultiplied BGRA of a ``book``, a ``card`` or a ``hand`` (fingers towards the left)."""
    size = width, height
    if kind == "hand":
        picture, cover = _hand(rng)
    else:
        picture = paint_book(rng) if kind == "book" else _card(rng)
        cover = np.full(picture.shape[:2], 255, np.uint8)
    whole = premultiplied(picture, cover)
    return np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA), np.uint8)


def _card(rng: np.random.Generator) -> Image:
    card = tinted(
        plain((860, 540), varied(rng, (150, 90, 60), 50)), cloud(rng, (860, 540), 200, 5), 22
    )
    box(card, 80, 190, 130, 100, (110, 190, 214))
    for k in range(4):
        write(card, str(rng.integers(1000, 9999)), (80 + 180 * k, 380), 64, (226, 232, 234), 600)
    write(card, "GOOD THRU 09/31", (300, 440), 30, (226, 232, 234))
    write(card, "STREAM BANK", (420, 100), 58, (240, 244, 244), 800)
    return card


def _hand(rng: np.random.Generator) -> tuple[Image, Image]:
    """A hand with a sleeve: thick strokes for fingers, lit from one side."""
    size_wh: Size = (900, 640)
    cover = np.zeros((640, 900), np.uint8)
    fingers = [
        ([[60, 300], [250, 262], [430, 280]], 92),
        ([[30, 390], [240, 366], [430, 350]], 96),
        ([[80, 478], [260, 450], [430, 410]], 90),
        ([[170, 556], [300, 522], [440, 460]], 76),
        ([[240, 110], [360, 180], [520, 300]], 104),
    ]
    for course, line in fingers:
        cv2.polylines(cover, [np.array(course, np.int32)], False, (255,), line, cv2.LINE_AA)
    palm = round_box_points(330, 225, 360, 300, 120).astype(np.int32)
    wrist = np.array([[560, 250], [900, 210], [900, 540], [560, 500], [420, 400]])
    for part in (palm, wrist):
        cv2.fillPoly(cover, [part], (255,), cv2.LINE_AA)
    outline, _ = cv2.findContours(cover, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(cover, outline, -1, (255,), cv2.FILLED)
    skin = tinted(plain(size_wh, varied(rng, SKIN, 14)), cloud(rng, size_wh, 60, 5), 9)
    near = cv2.distanceTransform(cover, cv2.DIST_L2, 5)
    rounded = np.clip(np.asarray(near, np.float32) / 46.0, 0, 1)
    skin = mixed(shade_of(skin, 0.5), skin, rounded)
    for course, line in fingers:
        x, y = course[0]
        cv2.ellipse(
            skin, (x - 8, y), (line // 5, line // 4), 0, 0, 360, (176, 196, 236), -1, cv2.LINE_AA
        )
        knuckle = course[1]
        for dx in (-8, 6):
            ends = [
                [knuckle[0] + dx, knuckle[1] - line // 3],
                [knuckle[0] + dx - 4, knuckle[1] + line // 3],
            ]
            stroke(skin, ends, (104, 132, 184), 3)
    cloth = tinted(plain(size_wh, varied(rng, (110, 70, 50), 40)), cloud(rng, size_wh, 30, 5), 20)
    mask = np.zeros_like(cover)
    cv2.fillPoly(mask, [np.array([[690, 190], [900, 160], [900, 590], [690, 560]])], (255,))
    skin[mask > 0] = cloth[mask > 0]
    box(skin, 690, 190, 12, 370, (60, 40, 30))
    return skin, np.asarray(np.maximum(cover, mask), np.uint8)


def shade_of(picture: Image, factor: float) -> Image:
    """The whole picture, darker."""
    return (picture * np.float32(factor)).astype(np.uint8)
