"""Printed things: a poster, a label of a box, a page, a map, a facade, a nearly blank card."""

from __future__ import annotations

import cv2
import numpy as np

from streamtrack.sources.scenes.canvas import (
    Colour,
    box,
    cloud,
    disc,
    frame_box,
    mixed,
    plain,
    round_box_points,
    shade,
    shape,
    stroke,
    text_block,
    tinted,
    turned_box,
    varied,
    write,
)
from streamtrack.types import Image, Size

LANDSCAPE: Size = (960, 720)
PORTRAIT: Size = (720, 940)
INK: Colour = (48, 42, 40)
PAPER: Colour = (226, 236, 240)
BRIGHT: tuple[Colour, ...] = (
    (52, 84, 214),
    (40, 156, 236),
    (150, 116, 36),
    (96, 150, 62),
    (132, 60, 148),
    (70, 190, 220),
)


def _colour(rng: np.random.Generator) -> Colour:
    return varied(rng, BRIGHT[int(rng.integers(len(BRIGHT)))], 18)


def _landscape(rng: np.random.Generator, size_wh: Size) -> Image:
    """A small picture: sky with a sun, ranges of hills one before the other, fir trees."""
    width, height = size_wh
    ramp = np.linspace(0.0, 1.0, height, dtype=np.float32)[:, None].repeat(width, 1)
    sky = mixed(plain(size_wh, (206, 150, 84)), (166, 206, 244), ramp * 1.6)
    sky = mixed(sky, (250, 250, 250), np.maximum(cloud(rng, size_wh, 130, 5, 2.2) - 0.1, 0))
    disc(sky, width * rng.uniform(0.2, 0.8), height * 0.26, height * 0.09, (150, 226, 255))
    along = np.arange(0, width + 8, 4)
    for k in range(4):
        rise = cloud(rng, (len(along), 2), 60 >> k, 4)[0] * height * 0.11
        ridge = np.column_stack([along, height * (0.42 + 0.14 * k) - rise])
        closed = np.vstack([ridge, [[width + 8, height], [0, height]]])
        shape(
            sky, closed, varied(rng, ((152, 120, 96), (112, 104, 62), (66, 92, 44))[min(k, 2)], 12)
        )
        if k >= 2:
            _firs(sky, rng, ridge, height * (0.05 + 0.03 * k))
    return tinted(sky, cloud(rng, size_wh, 12, 3), 7)


def _firs(
    picture: Image,
    rng: np.random.Generator,
    ridge: np.ndarray[tuple[int, ...], np.dtype],
    size: float,
) -> None:
    for row in rng.integers(len(ridge), size=26):
        x, y = ridge[row]
        tall = size * rng.uniform(0.6, 1.2)
        tree = [[x - 0.28 * tall, y + 4], [x, y - tall], [x + 0.28 * tall, y + 4]]
        shape(picture, tree, varied(rng, (40, 62, 30), 12))


def paint_poster(rng: np.random.Generator) -> Image:
    """A concert poster: a picture, a headline, coloured shapes, small print."""
    width, height = PORTRAIT
    ground = _colour(rng)
    page = tinted(plain(PORTRAIT, shade(ground, 0.75)), cloud(rng, PORTRAIT, 200, 5), 9)
    page[40 : 40 + 430, 40 : width - 40] = _landscape(rng, (width - 80, 430))
    frame_box(page, 40, 40, width - 80, 430, PAPER, 5)
    for _ in range(14):
        at = rng.uniform((40, 480), (width - 40, height - 60))
        kind, size, colour = int(rng.integers(3)), rng.uniform(14, 70), _colour(rng)
        if kind == 0:
            disc(page, at[0], at[1], size, colour)
        elif kind == 1:
            shape(
                page, turned_box((at[0], at[1]), (2 * size, 0.5 * size), rng.uniform(0, 3)), colour
            )
        else:
            ring = (round(at[0]), round(at[1]))
            cv2.circle(page, ring, round(size), colour, 9, cv2.LINE_AA)
    write(page, "SUMMER", (56, 575), 104, PAPER, 800)
    write(page, "NIGHTS", (56, 672), 104, shade(PAPER, 0.9), 800)
    write(page, f"Open air  {rng.integers(10, 29)} - 30 June", (60, 722), 38, (120, 220, 255), 600)
    text_block(page, rng, (60, 744, width - 330, 150), 21, PAPER)
    _barcode(page, rng, (width - 230, 780, 170, 100))
    return page


def _barcode(
    picture: Image, rng: np.random.Generator, area: tuple[float, float, float, float]
) -> None:
    x, y, w, h = area
    box(picture, x - 10, y - 10, w + 20, h + 34, (244, 246, 246))
    at = x
    while at < x + w - 8:
        bar = int(rng.integers(2, 8))
        box(picture, at, y, bar, h, (20, 20, 20))
        at += bar + int(rng.integers(2, 8))
    digits = "".join(str(d) for d in rng.integers(10, size=12))
    write(picture, digits, (x, y + h + 18), 20, (20, 20, 20))


def paint_box(rng: np.random.Generator) -> Image:
    """The face of a packaging box: a logo, bands, a table of facts, symbols, a bar code."""
    width = LANDSCAPE[0]
    main, second = _colour(rng), _colour(rng)
    face = tinted(plain(LANDSCAPE, (214, 224, 228)), cloud(rng, LANDSCAPE, 160, 5), 5)
    wave = np.arange(0, width + 1, 8)
    edge = 300 + 46 * np.sin(wave / 130.0 + rng.uniform(0, 6))
    shape(face, np.vstack([np.column_stack([wave, edge]), [[width, 0], [0, 0]]]), main)
    for k, colour in enumerate((second, shade(main, 0.6))):
        stroke(face, np.column_stack([wave, edge + 14 + 20 * k]), colour, 11)
    write(face, "AURORA", (48, 150), 128, (246, 248, 248), 800)
    write(face, "roasted whole beans", (54, 206), 42, shade(main, 1.9), 500)
    _badge(face, (790, 190), second)
    _beans(face, rng)
    box(face, 40, 420, 330, 262, (246, 248, 248))
    frame_box(face, 40, 420, 330, 262, INK, 3)
    for row, word in enumerate(("Energy", "Fat", "Protein", "Fibre", "Salt", "Sugar")):
        write(face, word, (54, 456 + 40 * row), 28, INK, 600)
        write(face, f"{rng.uniform(0.1, 99):.1f} g", (258, 456 + 40 * row), 28, INK)
        stroke(face, [[48, 466 + 40 * row], [362, 466 + 40 * row]], INK, 2)
    _barcode(face, rng, (700, 540, 210, 110))
    text_block(face, rng, (394, 560, 280, 120), 20, INK)
    return face


def _badge(face: Image, middle: tuple[int, int], colour: Colour) -> None:
    angle = np.arange(48) * np.pi / 24
    radius = np.where(np.arange(48) % 2 == 0, 108, 92)
    star = np.column_stack([middle[0] + radius * np.cos(angle), middle[1] + radius * np.sin(angle)])
    shape(face, star, colour)
    cv2.circle(face, middle, 80, (240, 244, 244), 4, cv2.LINE_AA)
    write(face, "500 g", (middle[0] - 58, middle[1] + 4), 48, (246, 248, 248), 800)
    write(face, "NET WEIGHT", (middle[0] - 54, middle[1] + 36), 20, (246, 248, 248), 600)


def _beans(face: Image, rng: np.random.Generator) -> None:
    for _ in range(46):
        x, y = rng.uniform((410, 400), (920, 530))
        angle, colour = rng.uniform(0, 180), varied(rng, (46, 72, 108), 14)
        at, size = (round(x), round(y)), (24, 15)
        cv2.ellipse(
            face, (at[0] + 3, at[1] + 4), size, angle, 0, 360, (120, 130, 134), -1, cv2.LINE_AA
        )
        cv2.ellipse(face, at, size, angle, 0, 360, colour, -1, cv2.LINE_AA)
        cv2.ellipse(face, at, (20, 4), angle, 0, 180, shade(colour, 0.45), 2, cv2.LINE_AA)
        cv2.ellipse(face, at, (17, 10), angle, 200, 260, shade(colour, 1.5), 2, cv2.LINE_AA)


def paint_page(rng: np.random.Generator) -> Image:
    """A magazine page: a headline, columns of text, two pictures, a quotation."""
    width, height = PORTRAIT
    page = tinted(plain(PORTRAIT, PAPER), cloud(rng, PORTRAIT, 400, 3), 4)
    box(page, 36, 34, width - 72, 9, _colour(rng))
    write(page, "Rivers and Ridges", (36, 112), 64, INK, 800)
    write(
        page, f"A walk of {rng.integers(3, 40)} days, by J. Hill", (38, 152), 28, (96, 92, 90), 500
    )
    page[176:446, 36 : 36 + 430] = _landscape(rng, (430, 270))
    page[690:880, 486:684] = _landscape(rng, (198, 190))
    text_block(page, rng, (486, 172, 200, 500), 19, INK)
    text_block(page, rng, (36, 462, 200, 420), 19, INK)
    text_block(page, rng, (262, 640, 204, 240), 19, INK)
    box(page, 262, 476, 204, 140, shade(_colour(rng), 1.5))
    text_block(page, rng, (274, 484, 190, 124), 26, (250, 250, 250))
    write(page, str(rng.integers(10, 99)), (width - 70, height - 20), 26, INK, 700)
    return page


def paint_map(rng: np.random.Generator) -> Image:
    """A town map: parks, a river, a web of streets with names, blocks, symbols."""
    width, height = LANDSCAPE
    town = tinted(plain(LANDSCAPE, (216, 228, 234)), cloud(rng, LANDSCAPE, 300, 3), 3)
    field = cloud(rng, LANDSCAPE, 330, 2)
    town[field > 0.42] = (178, 222, 190)
    _blocks(town, rng)
    along = np.linspace(-20, width + 20, 60)
    river = 400 + 130 * np.sin(along / 190 + rng.uniform(0, 6)) + 40 * np.sin(along / 67)
    stroke(town, np.column_stack([along, river]), (214, 178, 132), 46)
    stroke(town, np.column_stack([along, river]), (226, 196, 154), 36)
    for _ in range(15):
        start, angle = rng.uniform((0, 0), (width, height)), rng.uniform(0, np.pi)
        reach = 1400 * np.array([np.cos(angle), np.sin(angle)])
        bend = start + rng.uniform(-70, 70, 2)
        course = np.array([start - reach, bend, start + reach])
        line = int(rng.choice([7, 9, 15]))
        stroke(town, course, (140, 150, 156), line + 4)
        stroke(town, course, (120, 208, 250) if line == 15 else (250, 252, 252), line)
    for _ in range(26):
        x, y = rng.uniform((10, 30), (width - 150, height - 20))
        name = f"{rng.choice(['Mill', 'Oak', 'King', 'Bridge', 'Park', 'West', 'Harbour'])} St"
        write(town, name, (x, y), int(rng.choice([20, 24, 30])), (70, 62, 60), 600)
    for _ in range(22):
        x, y = rng.uniform((20, 20), (width - 20, height - 20))
        disc(town, x, y, 14, _colour(rng))
        write(town, str(rng.choice(list("PHTM?i"))), (x - 6, y + 8), 22, (250, 250, 250), 800)
    frame_box(town, 5, 5, width - 10, height - 10, (90, 90, 90), 6)
    return town


def _blocks(town: Image, rng: np.random.Generator) -> None:
    for _ in range(170):
        x, y = rng.uniform((0, 0), LANDSCAPE)
        size = rng.uniform(14, 62, 2)
        block = turned_box((x, y), (size[0], size[1]), float(rng.choice([0.2, 0.2, 1.1])))
        shape(town, block, varied(rng, (186, 200, 212), 10))
        stroke(town, np.vstack([block, block[:1]]), (150, 166, 178), 2)


def paint_facade(rng: np.random.Generator) -> Image:
    """A front of like windows; only a few marks tell one from another."""
    width, height = LANDSCAPE
    wall = plain(LANDSCAPE, (150, 176, 196))
    for y in range(0, height, 120):
        for x in range(0, width, 96):
            _window(wall, x, y)
    wall = tinted(wall, cloud(rng, LANDSCAPE, 500, 2), 5)
    for x, y in rng.integers((0, 0), (10, 6), (4, 2)):
        box(wall, x * 96 + 26, y * 120 + 28, 44, int(rng.integers(20, 60)), _colour(rng))
    return wall


def _window(wall: Image, x: int, y: int) -> None:
    box(wall, x, y, 96, 4, (126, 150, 170))
    box(wall, x + 20, y + 22, 56, 80, (216, 224, 226))
    box(wall, x + 26, y + 28, 44, 68, (92, 74, 58))
    shape(
        wall,
        [[x + 26, y + 70], [x + 58, y + 28], [x + 70, y + 28], [x + 26, y + 92]],
        (128, 108, 90),
    )
    box(wall, x + 46, y + 28, 4, 68, (216, 224, 226))
    box(wall, x + 14, y + 102, 68, 8, (186, 196, 200))


def paint_faint(rng: np.random.Generator) -> Image:
    """A card with hardly anything on it: a few faint marks and a soft stain."""
    card = tinted(plain(LANDSCAPE, (206, 210, 212)), cloud(rng, LANDSCAPE, 600, 2), 3)
    for _ in range(9):
        x, y = rng.uniform((60, 60), (LANDSCAPE[0] - 60, LANDSCAPE[1] - 60))
        size = rng.uniform(16, 50, 2)
        shape(card, turned_box((x, y), size, rng.uniform(0, 3)), varied(rng, (190, 194, 198), 6))
    for _ in range(3):
        ends = rng.uniform((40, 40), (LANDSCAPE[0] - 40, LANDSCAPE[1] - 40), (2, 2))
        stroke(card, ends, (184, 188, 192), 4)
    return card


def paint_letter(rng: np.random.Generator) -> Image:
    """A letter: its head, lines of text, a signature."""
    width, height = 600, 780
    sheet = tinted(plain((width, height), (232, 238, 238)), cloud(rng, (width, height), 300, 3), 4)
    disc(sheet, 90, 80, 38, _colour(rng))
    text_block(sheet, rng, (380, 40, 180, 90), 20, INK)
    for top in (200, 400):
        text_block(sheet, rng, (60, top, 480, rng.uniform(100, 180)), 21, INK)
    along = np.linspace(0, 1, 40)
    pen = np.column_stack([90 + 220 * along, 680 + 30 * np.sin(along * rng.uniform(20, 40))])
    stroke(sheet, pen, (120, 60, 40), 4)
    return sheet


def paint_book(rng: np.random.Generator) -> Image:
    """The cover of a book, to lie about or to hide things."""
    size_wh = 520, 720
    cover = tinted(plain(size_wh, shade(_colour(rng), 0.7)), cloud(rng, size_wh, 90, 5), 10)
    box(cover, 0, 0, 34, 720, shade(_colour(rng), 0.5))
    write(cover, str(rng.choice(["ATLAS", "NOVEL", "FIELDS"])), (70, 150), 92, PAPER, 800)
    shape(cover, round_box_points(70, 200, 390, 330, 30), _colour(rng))
    cover[226:506, 96:434] = _landscape(rng, (338, 280))
    text_block(cover, rng, (72, 560, 400, 110), 30, PAPER)
    return cover
