"""Procedural textures with detail at several scales: what a wall, a road, a window or a poster looks like.

Each function returns (S, S, 3) uint8, sRGB, row 0 on top, and takes its own random generator. Surfaces tile without a seam.
Atlases hold CELLS x CELLS pictures, and ``cell`` gives the texture coordinates of one.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable

import numpy as np
from PIL import Image, ImageDraw, ImageFont

CELLS = 4  # pictures along each side of an atlas
WORDS = [
    "CAFE LUNA",
    "BAKERY",
    "BOOKS",
    "HOTEL",
    "PIZZA",
    "FLOWERS",
    "OPTIK",
    "MARKET",
    "SALON",
    "BANK",
    "TAILOR",
    "RAMEN",
    "CINEMA",
    "RECORDS",
    "PHARMACY",
    "TOYS",
    "BIKES",
    "DELI",
    "SHOES",
    "BAR 21",
    "FRUIT",
    "NOODLES",
    "LAUNDRY",
    "TRAVEL",
    "GALLERY",
    "WINE",
    "KEYS",
    "TEA ROOM",
    "GYM",
    "MUSIC",
    "SUSHI",
    "VINTAGE",
]


def fractal(
    rng: np.random.Generator, size: int, low: float, high: float, slope: float = 1.0, stretch: float = 1.0
) -> np.ndarray:
    """(S, S) float32 noise that tiles, of mean 0 and deviation 1.

    Its frequencies are ``low`` to ``high`` cycles per tile and fall off with ``slope``; ``stretch`` over 1 draws it out
    vertically.
    """
    rows, columns = np.meshgrid(np.fft.fftfreq(size, 1 / size), np.fft.rfftfreq(size, 1 / size), indexing="ij")
    frequency = np.hypot(rows * stretch, columns)
    gain = np.where((frequency >= low) & (frequency <= high), np.maximum(frequency, 1) ** -slope, 0)
    phase = rng.uniform(0, 2 * np.pi, gain.shape)
    out = np.fft.irfft2(gain * np.exp(1j * phase), s=(size, size))
    return (out / max(out.std(), 1e-12)).astype(np.float32)


def hue(
    rng: np.random.Generator, hues: tuple[float, float], saturation: tuple[float, float], value: tuple[float, float]
) -> np.ndarray:
    """(3,) an sRGB colour, drawn from ranges of hue, saturation and value."""
    return np.array(colorsys.hsv_to_rgb(rng.uniform(*hues) % 1, rng.uniform(*saturation), rng.uniform(*value)))


def finished(colours: np.ndarray) -> np.ndarray:
    return (np.clip(colours, 0, 1) * 255 + 0.5).astype(np.uint8)


def _weathered(rng: np.random.Generator, colours: np.ndarray, stains: float = 1.0) -> np.ndarray:
    """Blotches, streaks that run down, soot and grain."""
    size = len(colours)
    blotches = fractal(rng, size, 1, 12, 1.4)
    streaks = np.maximum(fractal(rng, size, 4, size / 4, 0.8, stretch=14) - 0.4, 0)
    grain = fractal(rng, size, 40, size / 2, 0.6)
    shade = 1 + stains * (0.06 * blotches - 0.09 * streaks) + 0.025 * grain
    return finished(colours * shade[..., None])


def _courses(
    rng: np.random.Generator, size: int, rows: int, columns: int, joint: float, stagger: float = 0.5
) -> tuple[np.ndarray, np.ndarray]:
    """Blocks laid in courses: (S, S) a random number per block, and where the joints are.

    ``joint``: share of a course's height.
    """
    v, u = np.meshgrid((np.arange(size) + 0.5) / size, (np.arange(size) + 0.5) / size, indexing="ij")
    row = np.floor(v * rows).astype(int)
    along = u * columns + stagger * (row % 2)
    column = np.floor(along).astype(int) % columns
    block = rng.uniform(size=(rows, columns))[row, column]
    across = joint * columns / rows
    joints = ((v * rows) % 1 < joint) | (along % 1 < across)
    return block.astype(np.float32), joints


def brick(rng: np.random.Generator, size: int) -> np.ndarray:
    base = hue(rng, (0.0, 0.09), (0.2, 0.55), (0.45, 0.75))
    block, joints = _courses(rng, size, 64, 22, 0.16)
    colours = base * (0.82 + 0.3 * block[..., None])
    odd = (block > 0.96)[..., None]
    colours = np.where(odd, base * 0.45, colours)
    return _weathered(rng, np.where(joints[..., None], hue(rng, (0.05, 0.15), (0.02, 0.15), (0.5, 0.85)), colours))


def plaster(rng: np.random.Generator, size: int) -> np.ndarray:
    kind = rng.random()  # mostly ochre, cream and rose; some yellow, pale blue, pale green
    hues, most = (
        ((0.0, 0.11), 0.4)
        if kind < 0.6
        else ((0.11, 0.16), 0.5)
        if kind < 0.78
        else ((0.53, 0.62), 0.28)
        if kind < 0.9
        else ((0.25, 0.42), 0.2)
    )
    base = hue(rng, hues, (0.06, most), (0.68, 0.97))
    chips = fractal(rng, size, 3, 90, 1.0) > 2.2
    under = _courses(rng, size, 64, 22, 0.16)[0][..., None] * 0.3 + 0.35
    colours = np.where(chips[..., None], under * np.array([1.0, 0.8, 0.7]), base * np.ones((size, size, 1)))
    speckle = 1 + 0.02 * fractal(rng, size, 60, size / 2, 0.4)
    return _weathered(rng, colours * speckle[..., None], 1.1)


def stone(rng: np.random.Generator, size: int) -> np.ndarray:
    base = hue(rng, (0.05, 0.16), (0.05, 0.3), (0.5, 0.85))
    block, joints = _courses(rng, size, 18, 9, 0.06)
    vein = np.abs(fractal(rng, size, 6, 120, 1.1))
    colours = base * (0.82 + 0.26 * block + 0.06 * vein)[..., None]
    return _weathered(rng, np.where(joints[..., None], base * 0.6, colours), 1.1)


def panels(rng: np.random.Generator, size: int) -> np.ndarray:
    base = hue(rng, (0.0, 0.7), (0.02, 0.15), (0.5, 0.85))
    block, joints = _courses(rng, size, 6, 8, 0.03, 0)
    pits = np.maximum(fractal(rng, size, 30, size / 3, 0.3) - 1.6, 0)
    return _weathered(rng, np.where(joints[..., None], base * 0.4, base * (0.85 + 0.25 * block - 0.25 * pits)[..., None]), 1.5)


def siding(rng: np.random.Generator, size: int) -> np.ndarray:
    base = hue(rng, (0.0, 0.65), (0.05, 0.3), (0.6, 0.95))
    block, _ = _courses(rng, size, 36, 4, 0.1)
    v = ((np.arange(size) + 0.5) / size * 36) % 1
    wood = fractal(rng, size, 8, size / 2, 0.6, stretch=0.08)
    shade = (0.9 + 0.15 * v - 0.5 * (v > 0.9))[:, None] * (0.85 + 0.25 * block) + 0.05 * wood
    return _weathered(rng, base * shade[..., None], 0.8)


def tiles(rng: np.random.Generator, size: int) -> np.ndarray:
    """Roof tiles."""
    base = (
        hue(rng, (0.0, 0.08), (0.2, 0.6), (0.3, 0.6))
        if rng.random() < 0.7
        else hue(rng, (0.55, 0.65), (0.05, 0.2), (0.25, 0.4))
    )
    block, joints = _courses(rng, size, 32, 40, 0.12)
    v = ((np.arange(size) + 0.5) / size * 32) % 1
    colours = base * ((0.75 + 0.4 * block) * (0.8 + 0.3 * v)[:, None])[..., None]
    moss = np.clip(fractal(rng, size, 2, 60, 1.0) - 0.8, 0, 1)[..., None]
    colours = colours * (1 - moss) + np.array([0.3, 0.34, 0.18]) * moss
    return _weathered(rng, np.where(joints[..., None], base * 0.3, colours))


def asphalt(rng: np.random.Generator, size: int) -> np.ndarray:
    grey = 0.42 + 0.03 * fractal(rng, size, 1, 10, 1.2) + 0.02 * fractal(rng, size, 40, size / 2, 0.3)
    stones = fractal(rng, size, size / 6, size / 2, 0) > 2.4
    grey = np.where(stones, grey + 0.12, grey)
    cracks = np.abs(fractal(rng, size, 2, 30, 1.3)) < 0.016
    cracks |= np.abs(fractal(rng, size, 3, 50, 1.2)) < 0.012
    grey = np.where(cracks, 0.16, grey)
    draw = Image.new("F", (size, size))
    pen = ImageDraw.Draw(draw)
    for _ in range(5):  # patches of a later repair
        x, y = rng.integers(0, size * 3 // 4, 2)
        w, h = rng.integers(size // 14, size // 4, 2)
        pen.rectangle((x, y, x + w, y + h), fill=float(rng.uniform(-0.12, 0.08)), outline=-0.2, width=max(1, size // 250))
    grey = grey + np.array(draw)
    oil = np.maximum(fractal(rng, size, 3, 30, 1.2) - 1.4, 0) * 0.12
    return finished((grey - oil)[..., None] * np.array([1.0, 0.99, 0.96]))


def slabs(rng: np.random.Generator, size: int) -> np.ndarray:
    """Pavement."""
    block, joints = _courses(rng, size, 12, 8, 0.05, 0.5)
    grey = 0.5 + 0.14 * (block - 0.5) + 0.03 * fractal(rng, size, 1, 20, 1.1) + 0.025 * fractal(rng, size, 40, size / 2, 0.4)
    gum = fractal(rng, size, 20, 60, 0.2) > 2.6
    grey = np.where(joints, 0.27, np.where(gum, grey - 0.14, grey))
    return finished(grey[..., None] * (np.array([1.0, 0.97, 0.92]) + 0.03 * (block[..., None] - 0.5)))


def grass(rng: np.random.Generator, size: int) -> np.ndarray:
    blades = fractal(rng, size, 20, size / 2, 0.3)
    dry = np.clip(0.5 + 0.5 * fractal(rng, size, 1, 12, 1.2), 0, 1)[..., None]
    colours = np.array([0.28, 0.42, 0.16]) * (1 - dry) + np.array([0.42, 0.45, 0.23]) * dry
    flowers = (fractal(rng, size, size / 8, size / 3, 0) > 3.4)[..., None]
    return finished(np.where(flowers, np.array([0.9, 0.88, 0.6]), colours * (1 + 0.12 * blades[..., None])))


def gravel(rng: np.random.Generator, size: int) -> np.ndarray:
    grey = 0.52 + 0.07 * fractal(rng, size, 30, size / 3, 0.3) + 0.05 * fractal(rng, size, 1, 8, 1.2)
    return finished(grey[..., None] * hue(rng, (0.05, 0.12), (0.02, 0.14), (0.85, 1)))


def planks(rng: np.random.Generator, size: int) -> np.ndarray:
    base = hue(rng, (0.03, 0.1), (0.3, 0.6), (0.3, 0.65))
    block, joints = _courses(rng, size, 16, 2, 0.05)
    wood = fractal(rng, size, 8, size / 2, 0.6, stretch=0.06)
    return finished(np.where(joints[..., None], 0.1, base * (0.8 + 0.3 * block + 0.12 * wood)[..., None]))


def bark(rng: np.random.Generator, size: int) -> np.ndarray:
    ridges = fractal(rng, size, 6, size / 3, 0.6, stretch=5)
    return finished(np.array([0.36, 0.29, 0.22]) * (1 + 0.35 * ridges[..., None]))


def shutter(rng: np.random.Generator, size: int) -> np.ndarray:
    """Corrugated metal, sprayed over."""
    v = (np.arange(size) + 0.5) / size * 32 * 2 * np.pi
    base = hue(rng, (0, 1), (0.02, 0.25), (0.45, 0.75)) * (1 + 0.22 * np.sin(v))[:, None, None] * np.ones((1, size, 1))
    paint = Image.fromarray(finished(base))
    pen = ImageDraw.Draw(paint)
    for _ in range(12):
        points = np.cumsum(rng.normal(0, size / 14, (9, 2)), axis=0) + rng.uniform(0.15, 0.85, 2) * size
        colour = tuple(int(c * 255) for c in hue(rng, (0, 1), (0.4, 0.95), (0.3, 1)))
        pen.line(
            [tuple(point) for point in points],
            fill=colour,
            width=int(rng.integers(size // 100 + 2, size // 30 + 3)),
            joint="curve",
        )
    return _weathered(rng, np.asarray(paint) / 255.0)


def speckled(colour: np.ndarray, amount: float = 0.06) -> Callable[[np.random.Generator, int], np.ndarray]:
    """A plain colour with grain and wear: paint, metal, cloth."""

    def make(rng: np.random.Generator, size: int) -> np.ndarray:
        shade = 1 + amount * (fractal(rng, size, 1, 10, 1.2) + 0.8 * fractal(rng, size, 20, size / 2, 0.2))
        return finished(np.asarray(colour) * shade[..., None])

    return make


def leaves(rng: np.random.Generator, size: int) -> np.ndarray:
    """A palette: each leaf samples one spot of it."""
    a, b = hue(rng, (0.2, 0.3), (0.45, 0.7), (0.2, 0.4)), hue(rng, (0.14, 0.27), (0.45, 0.75), (0.45, 0.75))
    mix = np.clip(0.5 + 0.22 * fractal(rng, size, 4, size / 2, 0.4), 0, 1)[..., None]
    return finished(a * (1 - mix) + b * mix)


def atlas(draw: Callable[[np.random.Generator, Image.Image], None]) -> Callable[[np.random.Generator, int], np.ndarray]:
    """A texture of CELLS x CELLS pictures, each made by ``draw`` on a blank image."""

    def make(rng: np.random.Generator, size: int) -> np.ndarray:
        sheet = Image.new("RGB", (size, size))
        side = size // CELLS
        for index in range(CELLS * CELLS):
            picture = Image.new("RGB", (side, side))
            draw(rng, picture)
            sheet.paste(picture, (index % CELLS * side, index // CELLS * side))
        grain = fractal(rng, size, 10, size / 2, 0.5)
        return finished(np.asarray(sheet) / 255.0 * (1 + 0.05 * grain[..., None]))

    return make


def cell(index: np.ndarray | int) -> np.ndarray:
    """(.., 4): u0, v0, u1, v1 of an atlas' cells, a little inside."""
    index = np.asarray(index) % (CELLS * CELLS)
    u, v = index % CELLS / CELLS, index // CELLS / CELLS
    rim = 0.015 / CELLS
    return np.stack([u + rim, v + rim, u + 1 / CELLS - rim, v + 1 / CELLS - rim], axis=-1)


def _colour(
    rng: np.random.Generator, hues: tuple[float, float], saturation: tuple[float, float], value: tuple[float, float]
) -> tuple[int, ...]:
    return tuple(int(channel * 255) for channel in hue(rng, hues, saturation, value))


def draw_window(rng: np.random.Generator, picture: Image.Image) -> None:
    """What is seen through a window: a room, curtains or blinds, plants."""
    pen, s = ImageDraw.Draw(picture), picture.width
    room = hue(rng, (0.04, 0.16), (0.1, 0.45), (0.22, 0.5))
    for y in range(s):
        shade = room * (0.55 + 0.75 * y / s)
        pen.line((0, y, s, y), fill=tuple(int(c * 255) for c in shade))
    for _ in range(5):  # furniture, pictures
        x, y = rng.uniform(0, 0.85 * s, 2)
        w, h = rng.uniform(0.08, 0.4, 2) * s
        pen.rectangle((x, y, x + w, y + h), fill=_colour(rng, (0, 1), (0.1, 0.6), (0.15, 0.65)))
    kind = rng.integers(4)
    cloth = hue(rng, (0, 1), (0.05, 0.4), (0.55, 0.95))
    if kind <= 1:
        for side in (0, 1):
            width = rng.uniform(0.15, 0.55) * s
            for x in range(int(width)):
                shade = cloth * (0.8 + 0.2 * np.sin(x / s * rng.uniform(60, 64)))
                column = x if side == 0 else s - 1 - x
                pen.line((column, 0, column, s), fill=tuple(int(c * 255) for c in shade))
    elif kind == 2:
        low = rng.uniform(0.2, 0.95) * s
        for y in range(0, int(low), max(3, s // 28)):
            pen.line((0, y, s, y), fill=tuple(int(c * 255) for c in cloth), width=max(2, s // 45))
    for _ in range(int(rng.integers(0, 4))):  # plants on the sill
        x, h = rng.uniform(0.1, 0.9) * s, rng.uniform(0.1, 0.3) * s
        for _ in range(9):
            pen.line(
                (x, s, x + rng.normal(0, 0.07 * s), s - h * rng.uniform(0.5, 1)),
                fill=_colour(rng, (0.2, 0.38), (0.4, 0.8), (0.25, 0.6)),
                width=max(1, s // 50),
            )


def draw_shop(rng: np.random.Generator, picture: Image.Image) -> None:
    """Behind a shop's window: shelves full of goods, and lamps."""
    pen, s = ImageDraw.Draw(picture), picture.width
    pen.rectangle((0, 0, s, s), fill=_colour(rng, (0.04, 0.16), (0.15, 0.5), (0.35, 0.65)))
    for _ in range(7):
        x = rng.uniform(0, s)
        pen.ellipse((x - 4, 0.06 * s, x + 4, 0.06 * s + 8), fill=(255, 244, 214))
    rows = int(rng.integers(3, 6))
    for row in range(rows):
        floor = s * (0.22 + 0.78 * (row + 1) / rows)
        x = 0.0
        while x < s:
            w, h = rng.uniform(0.03, 0.12) * s, rng.uniform(0.3, 0.95) * 0.78 * s / rows
            pen.rectangle((x, floor - h, max(x, x + w - 1), floor), fill=_colour(rng, (0, 1), (0.1, 0.9), (0.25, 0.95)))
            x += w * rng.uniform(1, 1.35)
        pen.line((0, floor, s, floor), fill=(70, 52, 40), width=max(2, s // 60))


def draw_sign(rng: np.random.Generator, picture: Image.Image) -> None:
    """A shop's name board: the middle quarter of the cell is what shows on a board four times as wide as high."""
    pen, s = ImageDraw.Draw(picture), picture.width
    back, text = _colour(rng, (0, 1), (0.3, 0.95), (0.15, 0.6)), _colour(rng, (0.05, 0.18), (0.0, 0.6), (0.85, 1))
    if rng.random() < 0.4:
        back, text = text, back
    pen.rectangle((0, 0, s, s), fill=back)
    pen.rectangle((s * 0.02, s * 0.08, s * 0.98, s * 0.92), outline=text, width=max(1, s // 64))
    word = WORDS[rng.integers(len(WORDS))]
    font = ImageFont.load_default(size=100)
    box = font.getbbox(word)
    line = Image.new("L", (box[2] + 20, box[3] + 20), 0)
    ImageDraw.Draw(line).text((10, 5), word, fill=255, font=font)
    line = line.crop(line.getbbox()).resize((int(s * 0.84), int(s * 0.56)))
    picture.paste(Image.new("RGB", line.size, text), (int(s * 0.08), int(s * 0.22)), line)


def draw_poster(rng: np.random.Generator, picture: Image.Image) -> None:
    """Posters, billboards and graffiti: shapes and words."""
    pen, s = ImageDraw.Draw(picture), picture.width
    low, high = hue(rng, (0, 1), (0.3, 0.9), (0.3, 0.9)), hue(rng, (0, 1), (0.2, 0.9), (0.5, 1))
    for y in range(s):
        pen.line((0, y, s, y), fill=tuple(int(c * 255) for c in low + (high - low) * y / s))
    for _ in range(14):
        x, y = rng.uniform(-0.1, 1, 2) * s
        w, h = rng.uniform(0.04, 0.4, 2) * s
        shape = (pen.ellipse, pen.rectangle)[rng.integers(2)]
        shape((x, y, x + w, y + h), fill=_colour(rng, (0, 1), (0.2, 1), (0.2, 1)))
    for size, top in ((s // 5, 0.08), (s // 9, 0.42), (s // 14, 0.62), (s // 14, 0.72), (s // 14, 0.82)):
        word = " ".join(WORDS[rng.integers(len(WORDS))] for _ in range(2))
        pen.text(
            (s * 0.06, s * top), word, fill=_colour(rng, (0, 1), (0, 0.3), (0.02, 1)), font=ImageFont.load_default(size=size)
        )
    pen.rectangle((0, 0, s - 1, s - 1), outline=(238, 236, 228), width=max(2, s // 40))


def draw_tower(rng: np.random.Generator, picture: Image.Image) -> None:
    """A far tower's facade: rows of windows."""
    pen, s = ImageDraw.Draw(picture), picture.width
    wall = hue(rng, (0.0, 0.65), (0.03, 0.3), (0.45, 0.85))
    pen.rectangle((0, 0, s, s), fill=tuple(int(c * 255) for c in wall))
    columns, rows = rng.integers(6, 14), rng.integers(10, 22)
    wide, high = rng.uniform(0.45, 0.8), rng.uniform(0.4, 0.75)
    for row in range(rows):
        for column in range(columns):
            x, y = column * s / columns, row * s / rows
            pen.rectangle(
                (x, y, x + wide * s / columns, y + high * s / rows), fill=_colour(rng, (0.5, 0.62), (0.1, 0.5), (0.2, 0.75))
            )


def draw_plate(rng: np.random.Generator, picture: Image.Image) -> None:
    """A traffic sign on a square plate."""
    pen, s = ImageDraw.Draw(picture), picture.width
    kind = rng.integers(4)
    colour = ((200, 30, 35), (30, 80, 180), (240, 200, 40), (30, 120, 70))[kind]
    pen.rectangle((0, 0, s, s), fill=colour)
    pen.rectangle((s * 0.06, s * 0.06, s * 0.94, s * 0.94), outline=(245, 245, 245), width=s // 24)
    pen.ellipse((s * 0.18, s * 0.18, s * 0.82, s * 0.82), fill=(245, 245, 245))
    pen.text(
        (s * 0.24, s * 0.3),
        ("30", "50", "P", "ONE")[rng.integers(4)],
        fill=(20, 20, 20),
        font=ImageFont.load_default(size=s // 3),
    )
