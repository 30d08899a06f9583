"""Buildings: facades with recessed windows, sills, surrounds, balconies, cornices and shops; roofs and what stands on them.

A facade is written in its own frame: x along it, y = 0 its face and +y outwards, z up. Its walls are a grid of cells in which
the windows' cells are left out, so no two faces overlap.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.neuras.street.shapes import Shapes
from stages.neuras.street.textures import cell

WALL = 7.5  # metres that a wall's texture spans
RECESS = 0.22  # metres of a window's depth


@dataclass(frozen=True)
class Style:
    """How one building looks. Heights and widths in metres; materials by name."""

    wall: str
    trim: str
    frame: str
    floors: int
    floor_height: float
    ground_height: float
    bay: float
    window: tuple[float, float]
    surround: int  # 0 none, 1 sill and lintel, 2 full frame, 3 frame and pediment
    balconies: float  # share of windows that have one
    shop: bool
    roof: str  # flat, gable, mansard
    roof_material: str

    @property
    def height(self) -> float:
        return self.ground_height + self.floors * self.floor_height

    @classmethod
    def draw(
        cls, rng: np.random.Generator, walls: int, roofs: int, floors: tuple[int, int], shop: bool, roof_kinds: tuple[str, ...]
    ) -> Style:
        floor_height = rng.uniform(2.9, 3.6)
        return cls(
            wall=f"wall{rng.integers(walls)}",
            trim=f"trim{rng.integers(5)}",
            frame=f"frame{rng.integers(4)}",
            floors=int(rng.integers(floors[0], floors[1] + 1)),
            floor_height=floor_height,
            ground_height=rng.uniform(3.6, 4.6) if shop else floor_height,
            bay=rng.uniform(2.0, 3.3),
            window=(rng.uniform(0.45, 0.66), rng.uniform(0.5, 0.68)),
            surround=int(rng.integers(4)),
            balconies=rng.choice([0.0, 0.0, 0.25, 0.6]),
            shop=shop,
            roof=str(rng.choice(roof_kinds)),
            roof_material=f"roof{rng.integers(roofs)}",
        )


def building(
    shapes: Shapes,
    rng: np.random.Generator,
    width: float,
    depth: float,
    style: Style,
    sides: tuple[bool, bool] = (False, False),
) -> None:
    """A building whose front runs from the origin along x and faces +y: it reaches to (width, -depth).

    ``sides``: whether the walls at x = 0 and at x = width have windows.
    """
    facade(shapes, rng, width, style, style.shop)
    back = shapes.at(width, -depth, 0, np.pi)
    facade(back, rng, width, style, False, plain=True)
    for side, (frame, windows) in enumerate(
        ((shapes.at(0, -depth, 0, np.pi / 2), sides[0]), (shapes.at(width, 0, 0, -np.pi / 2), sides[1]))
    ):
        if windows:
            facade(frame, rng, depth, style, False, plain=bool(side % 2))
        else:
            _blank_wall(frame, rng, depth, style)
    _roof(shapes, rng, width, depth, style)


def facade(shapes: Shapes, rng: np.random.Generator, width: float, style: Style, shop: bool, plain: bool = False) -> None:
    """One wall with its openings. ``plain``: no balconies and no ledges."""
    count = max(1, int((width - 0.8) // style.bay))
    bay = (width - 0.8) / count
    wide, high = bay * style.window[0], style.floor_height * style.window[1]
    left = 0.4 + bay * np.arange(count) + 0.5 * (bay - wide)
    bottoms = style.ground_height + style.floor_height * np.arange(style.floors) + 0.26 * style.floor_height
    if not shop:
        bottoms = np.concatenate([[0.3 * style.ground_height], bottoms])
    door = None if shop or plain else int(rng.integers(count))
    x0, z0 = np.meshgrid(left, bottoms, indexing="ij")
    open_cells = np.ones(x0.shape, bool)
    if door is not None:
        open_cells[door, 0] = False
    start = style.ground_height if shop else 0.0
    _wall_around(shapes, style, width, (start, style.height), (left, left + wide), (bottoms, bottoms + high), open_cells, door)
    x0, z0 = x0[open_cells], z0[open_cells]
    rect = np.stack([x0, z0, x0 + wide, z0 + high], axis=1)
    _windows(shapes, rng, rect, style)
    _surrounds(shapes, rect, style, 0 if plain else style.surround)
    if door is not None:
        x = left[door] + 0.5 * (wide - 1.1)
        _door(shapes, rng, x, x + 1.1, 0.0, 2.3, style)
    if not plain:
        _ledges(shapes, width, style, shop)
        _balconies(shapes, rng, rect[rect[:, 1] > style.ground_height], style)
        _clutter(shapes, rng, width, style)
    if shop:
        _shops(shapes, rng, width, style)


def _wall_around(shapes, style, width, heights, columns, rows, open_cells, door) -> None:  # noqa: ANN001
    """The wall as a grid, without the cells of the windows (and of the door)."""
    xs = np.unique(np.concatenate([[0, width], *columns]))
    zs = np.unique(np.concatenate([heights, *rows, [2.3] if door is not None else []]))
    middle_x, middle_z = 0.5 * (xs[1:] + xs[:-1]), 0.5 * (zs[1:] + zs[:-1])
    in_column = (middle_x[:, None] > columns[0]) & (middle_x[:, None] < columns[1])
    in_row = (middle_z[:, None] > rows[0]) & (middle_z[:, None] < rows[1])
    hole = np.einsum("xi,ij,zj->xz", in_column.astype(int), open_cells.astype(int), in_row.astype(int)) > 0
    if door is not None:
        hole |= in_column[:, door][:, None] & (middle_z < 2.3)
    shapes.sheet(style.wall, xs, zs, lambda x, z: np.stack([x, np.zeros_like(x), z], -1), WALL, ~hole)
    if door is not None:  # the wall beside a door narrower than its column
        x0, x1 = columns[0][door], columns[1][door]
        inner = 0.5 * (x0 + x1)
        for a, b in ((x0, inner - 0.55), (inner + 0.55, x1)):
            if b > a:
                shapes.sheet(
                    style.wall, np.array([a, b]), np.array([0, 2.3]), lambda x, z: np.stack([x, np.zeros_like(x), z], -1), WALL
                )


def _windows(shapes: Shapes, rng: np.random.Generator, rect: np.ndarray, style: Style) -> None:
    """Reveals, frames with bars, and glass that shows rooms. ``rect`` (N, 4): x0, z0, x1, z1."""
    if not len(rect):
        return
    x0, z0, x1, z1 = rect.T
    o, r = np.zeros_like(x0), np.full_like(x0, -RECESS)

    def quad(*corners):  # noqa: ANN002, ANN202
        return np.stack([np.stack(corner, -1) for corner in corners], axis=1)

    reveals = np.concatenate(
        [
            quad((x0, o, z0), (x0, r, z0), (x0, r, z1), (x0, o, z1)),
            quad((x1, r, z0), (x1, o, z0), (x1, o, z1), (x1, r, z1)),
            quad((x0, o, z0), (x1, o, z0), (x1, r, z0), (x0, r, z0)),
            quad((x0, r, z1), (x1, r, z1), (x1, o, z1), (x0, o, z1)),
        ]
    )
    shapes.quads(style.wall, reveals, reveals[..., [0, 2]] / WALL + reveals[..., [1, 1]] / WALL)
    shapes.pictures("rooms", quad((x0, r, z0), (x1, r, z0), (x1, r, z1), (x0, r, z1)), cell(rng.integers(0, 16, len(rect))))
    bar, front, back = 0.06, -RECESS + 0.06, -RECESS
    mid_x, mid_z = 0.5 * (x0 + x1), z0 + 0.68 * (z1 - z0)
    bars = [
        (x0, x0 + bar, z0, z1),
        (x1 - bar, x1, z0, z1),
        (x0, x1, z0, z0 + bar),
        (x0, x1, z1 - bar, z1),
        (mid_x - bar / 2, mid_x + bar / 2, z0, z1),
        (x0, x1, mid_z - bar / 2, mid_z + bar / 2),
    ]
    for a, b, low, high in bars:
        shapes.boxes(style.frame, np.stack([a, o + back, low], -1), np.stack([b, o + front, high], -1))


def _surrounds(shapes: Shapes, rect: np.ndarray, style: Style, kind: int) -> None:
    x0, z0, x1, z1 = rect.T
    if not len(rect):
        return

    def boxes(a, b, low, high, deep, back=-0.02) -> None:  # noqa: ANN001
        shapes.boxes(
            style.trim, np.stack([a, np.full_like(a, back), low], -1), np.stack([b, np.full_like(a, deep), high], -1), 2.0
        )

    boxes(x0 - 0.1, x1 + 0.1, z0 - 0.09, z0, 0.13)
    if kind >= 1:
        boxes(x0 - 0.12, x1 + 0.12, z1, z1 + 0.2, 0.05)
    if kind >= 2:
        boxes(x0 - 0.14, x0, z0, z1, 0.06)
        boxes(x1, x1 + 0.14, z0, z1, 0.06)
    if kind == 3:
        boxes(x0 - 0.2, x1 + 0.2, z1 + 0.2, z1 + 0.3, 0.18)
        boxes(0.5 * (x0 + x1) - 0.09, 0.5 * (x0 + x1) + 0.09, z1 - 0.06, z1 + 0.2, 0.1)


def _door(shapes: Shapes, rng: np.random.Generator, x0: float, x1: float, z0: float, z1: float, style: Style) -> None:
    material = f"door{rng.integers(4)}"
    shapes.box(style.trim, x0 - 0.12, -0.1, z0, x0, 0.08, z1 + 0.12)
    shapes.box(style.trim, x1, -0.1, z0, x1 + 0.12, 0.08, z1 + 0.12)
    shapes.box(style.trim, x0, -0.1, z1, x1, 0.08, z1 + 0.12)
    shapes.box(material, x0, -0.2, z0, x1, -0.12, z1)
    for low, high in ((0.15, 0.9), (1.05, 1.9)):
        shapes.box(style.frame, x0 + 0.15, -0.12, z0 + low, x1 - 0.15, -0.09, z0 + high)
    shapes.box("chrome", x1 - 0.12, -0.12, 1.0, x1 - 0.07, -0.05, 1.15)
    shapes.box("kerb", x0 - 0.2, 0, z0, x1 + 0.2, 0.5, z0 + 0.15)
    number = rng.integers(16)
    shapes.pictures(
        "plates", [[[x1 + 0.2, 0.03, 1.7], [x1 + 0.5, 0.03, 1.7], [x1 + 0.5, 0.03, 2.0], [x1 + 0.2, 0.03, 2.0]]], cell(number)
    )


def _ledges(shapes: Shapes, width: float, style: Style, shop: bool) -> None:
    """A ledge above the ground floor and a cornice with dentils under the roof."""
    top = style.height
    if shop or style.surround >= 2:
        shapes.box(style.trim, 0, -0.05, style.ground_height - 0.02, width, 0.16, style.ground_height + 0.22, 3.0)
    shapes.box(style.trim, -0.02, -0.05, top - 0.35, width + 0.02, 0.22, top - 0.1, 3.0)
    shapes.box(style.trim, -0.02, -0.05, top - 0.1, width + 0.02, 0.38, top + 0.08, 3.0)
    if style.surround >= 1:
        x = np.arange(0.1, width - 0.15, 0.34)
        shapes.boxes(
            style.trim, np.stack([x, 0 * x, 0 * x + top - 0.55], -1), np.stack([x + 0.16, 0 * x + 0.17, 0 * x + top - 0.35], -1)
        )
    if style.surround == 3:
        for level in range(1, style.floors):
            z = style.ground_height + level * style.floor_height
            shapes.box(style.trim, 0, -0.05, z - 0.06, width, 0.07, z + 0.06, 3.0)


def _balconies(shapes: Shapes, rng: np.random.Generator, rect: np.ndarray, style: Style) -> None:
    for x0, z0, x1, _ in rect[rng.random(len(rect)) < style.balconies]:
        low, deep = z0 - 0.35, 0.95
        a, b = x0 - 0.3, x1 + 0.3
        shapes.box(style.trim, a, 0, low - 0.15, b, deep, low, 2.0)
        x = np.append(np.arange(a + 0.03, b - 0.05, 0.16), b - 0.05)
        shapes.boxes(
            "iron",
            np.stack([x, 0 * x + deep - 0.05, 0 * x + low], -1),
            np.stack([x + 0.03, 0 * x + deep - 0.02, 0 * x + low + 0.95], -1),
        )
        shapes.box("iron", a, deep - 0.06, low + 0.95, b, deep, low + 1.0)
        for side in (a, b - 0.03):
            y = np.arange(0.1, deep - 0.05, 0.2)
            shapes.boxes(
                "iron",
                np.stack([0 * y + side, y, 0 * y + low], -1),
                np.stack([0 * y + side + 0.03, y + 0.03, 0 * y + low + 0.95], -1),
            )
            shapes.box("iron", side, 0, low + 0.95, side + 0.03, deep, low + 1.0)
        if rng.random() < 0.6:
            planter(shapes.at(0.5 * (a + b), deep + 0.08, low + 0.62), rng, 0.8 * (b - a))


def planter(shapes: Shapes, rng: np.random.Generator, width: float, depth: float = 0.22) -> None:
    """A box of flowers, its middle at the origin."""
    shapes.box(f"door{rng.integers(4)}", -width / 2, -depth / 2, 0, width / 2, depth / 2, 0.2)
    n = int(60 * width)
    centres = np.stack(
        [rng.uniform(-width / 2, width / 2, n), rng.normal(0, depth / 2.5, n), 0.2 + rng.uniform(-0.06, 0.24, n)], -1
    )
    normals = rng.normal(size=(n, 3))
    shapes.cards(
        str(rng.choice(["leaves0", "leaves1", "flowers"])),
        centres,
        normals / np.linalg.norm(normals, axis=1, keepdims=True),
        rng.uniform(0.05, 0.1, n),
        rng.uniform(0, 6.3, n),
        rng.random((n, 2)),
    )


def _clutter(shapes: Shapes, rng: np.random.Generator, width: float, style: Style) -> None:
    """Drain pipes, cables, lamps, air conditioners, flags and signs that hang out."""
    x = rng.choice([0.18, width - 0.18])
    shapes.tube("zinc", (x, 0.08, 0.1), (x, 0.08, style.height), (0.06, 0.06), 6)
    for _ in range(rng.integers(0, 4)):
        x, z = (
            rng.uniform(1, width - 1.2),
            style.ground_height + 0.05 + style.floor_height * rng.integers(0, max(1, style.floors)),
        )
        shapes.box("zinc", x, 0, z, x + 0.7, 0.32, z + 0.5)
        shapes.box("iron", x + 0.08, 0.32, z + 0.06, x + 0.46, 0.33, z + 0.44)
    z = style.ground_height * rng.uniform(0.97, 1.05)
    shapes.tube("iron", (0, 0.24, z), (width, 0.24, z + rng.normal(0, 0.08)), (0.014, 0.014), 4)
    if style.shop or rng.random() < 0.3:
        x, z = rng.uniform(1, width - 1), rng.uniform(3.0, 4.2)
        shapes.box("iron", x - 0.03, 0, z + 0.95, x + 0.03, 1.05, z + 1.0)
        for sign in (-1, 1):
            a, b = (0.15, 1.0) if sign < 0 else (1.0, 0.15)
            corners = [
                [[x + sign * 0.03, a, z], [x + sign * 0.03, b, z], [x + sign * 0.03, b, z + 0.9], [x + sign * 0.03, a, z + 0.9]]
            ]
            shapes.pictures("signs", corners, cell(rng.integers(16)))


def _shops(shapes: Shapes, rng: np.random.Generator, width: float, style: Style) -> None:
    """A ground floor of shop windows, doors, shutters and posters, with signs and awnings."""
    top = style.ground_height
    count = max(1, round(width / rng.uniform(4.5, 6.5)))
    edges = np.linspace(0, width, count + 1)
    for a, b in zip(edges[:-1], edges[1:], strict=True):
        shapes.box(style.trim, a, -0.3, 0, a + 0.3, 0.06, top, 2.0)
        shapes.box(style.trim, b - 0.3, -0.3, 0, b, 0.06, top, 2.0)
        a, b, lintel, base = a + 0.3, b - 0.3, top - 0.95, 0.45
        wall = f"shopfront{rng.integers(4)}"
        shapes.box(wall, a, -0.3, lintel, b, 0.0, top, 2.0)
        kind = rng.random()
        if kind < 0.14:
            shapes.box(f"shutter{rng.integers(2)}", a, -0.15, 0, b, -0.1, lintel, 3.0)
        else:
            door = rng.uniform(a + 0.1, b - 1.2)
            shapes.box(f"door{rng.integers(4)}", door, -0.3, 0, door + 1.1, -0.25, 2.3)
            shapes.pictures(
                "goods",
                [[[door + 0.15, -0.24, 0.5], [door + 0.95, -0.24, 0.5], [door + 0.95, -0.24, 2.1], [door + 0.15, -0.24, 2.1]]],
                cell(rng.integers(16)),
            )
            shapes.box(wall, door, -0.3, 2.3, door + 1.1, -0.2, lintel)
            for low, high in ((a, door), (door + 1.1, b)):
                if high - low < 0.3:
                    shapes.box(wall, low, -0.3, 0, high, -0.1, lintel)
                    continue
                shapes.box(wall, low, -0.3, 0, high, -0.02, base, 2.0)
                panes = max(1, round((high - low) / 1.7))
                cuts = np.linspace(low, high, panes + 1)
                for x0, x1 in zip(cuts[:-1], cuts[1:], strict=True):
                    shapes.pictures(
                        "goods",
                        [[[x0, -0.18, base], [x1, -0.18, base], [x1, -0.18, lintel], [x0, -0.18, lintel]]],
                        cell(rng.integers(16)),
                    )
                    shapes.box(style.frame, x0 - 0.04, -0.2, base, x0 + 0.04, -0.08, lintel)
                    if rng.random() < 0.35:
                        x, z = rng.uniform(x0, max(x0 + 0.01, x1 - 0.5)), rng.uniform(0.6, 1.2)
                        shapes.pictures(
                            "posters",
                            [[[x, -0.16, z], [x + 0.45, -0.16, z], [x + 0.45, -0.16, z + 0.65], [x, -0.16, z + 0.65]]],
                            cell(rng.integers(16)),
                        )
        inset = rng.uniform(0.1, 0.5)
        board = (a + inset, lintel + 0.14, b - inset, top - 0.12)
        shapes.box(style.frame, board[0] - 0.05, 0, board[1] - 0.05, board[2] + 0.05, 0.08, board[3] + 0.05)
        x0, z0, x1, z1 = board
        shapes.pictures("signs", [[[x0, 0.09, z0], [x1, 0.09, z0], [x1, 0.09, z1], [x0, 0.09, z1]]], cell(rng.integers(16)))
        if rng.random() < 0.5:
            _awning(shapes, rng, a, b, lintel + 0.05)


def _awning(shapes: Shapes, rng: np.random.Generator, a: float, b: float, z: float) -> None:
    out, drop = rng.uniform(1.0, 1.6), rng.uniform(0.4, 0.7)
    stripes = np.linspace(a, b, max(3, int((b - a) / 0.3)) + 1)
    cloth = rng.integers(3)
    for number, (x0, x1) in enumerate(zip(stripes[:-1], stripes[1:], strict=True)):
        material = f"cloth{cloth}" if number % 2 else "cloth3"
        corners = np.array(
            [
                [[x0, out, z - drop], [x1, out, z - drop], [x1, 0.02, z], [x0, 0.02, z]],
                [[x0, out, z - drop - 0.22], [x1, out, z - drop - 0.22], [x1, out, z - drop], [x0, out, z - drop]],
            ]
        )
        shapes.quads(material, corners, corners[..., [0, 1]])


def _blank_wall(shapes: Shapes, rng: np.random.Generator, width: float, style: Style) -> None:
    xs = np.linspace(0, width, max(2, int(width / 3)) + 1)
    zs = np.linspace(0, style.height, style.floors + 2)
    shapes.sheet(style.wall, xs, zs, lambda x, z: np.stack([x, np.zeros_like(x), z], -1), WALL)
    if rng.random() < 0.6 and width > 6:
        w, h = rng.uniform(3, min(6, width - 1)), rng.uniform(3, 5)
        x, z = rng.uniform(0.5, width - w), max(3.0, style.height - h - rng.uniform(1, 4))
        shapes.pictures(
            "posters", [[[x, 0.03, z], [x + w, 0.03, z], [x + w, 0.03, z + h], [x, 0.03, z + h]]], cell(rng.integers(16))
        )


def _roof(shapes: Shapes, rng: np.random.Generator, width: float, depth: float, style: Style) -> None:
    top = style.height
    if style.roof == "flat":
        shapes.floor("gravel", 0, -depth, width, 0, top, 4.0)
        for box in (
            (0, -0.25, width, 0),
            (0, -depth, width, -depth + 0.25),
            (0, -depth, 0.25, 0),
            (width - 0.25, -depth, width, 0),
        ):
            shapes.box(style.wall, box[0], box[1], top, box[2], box[3], top + 0.7, WALL)
    else:
        rise, flat = (depth * rng.uniform(0.28, 0.42), 0.0) if style.roof == "gable" else (rng.uniform(2.4, 3.2), 0.6)
        over = 0.35
        run = depth / 2 * (1 - flat)
        xs = np.linspace(-over * (style.roof == "gable"), width + over * (style.roof == "gable"), max(2, int(width / 2)) + 1)
        slope = np.hypot(run, rise)
        for side in (0, 1):
            frame = shapes if side == 0 else shapes.at(width, -depth, 0, np.pi)
            ts = np.linspace(-over / run * (style.roof == "gable"), 1, 5)
            frame.sheet(
                style.roof_material,
                xs,
                ts * slope,
                lambda x, t: np.stack([x, -t / slope * run, top + t / slope * rise], -1),
                5.0,
            )
            if style.roof == "mansard":
                _dormers(frame, rng, width, style, top)
        if style.roof == "mansard":
            shapes.floor("gravel", 0, -depth + run, width, -run, top + rise, 4.0)
        for x in (0.0, width):
            outline = np.array([[x, 0, top], [x, -run, top + rise], [x, -depth + run, top + rise], [x, -depth, top]])
            shapes.mesh(style.wall, outline, [[0, 1, 2], [0, 2, 3]], outline[:, [1, 2]] / WALL)
        top += rise * 0.75
    for _ in range(rng.integers(1, 4)):
        x, y = rng.uniform(0.5, width - 1.5), -depth * rng.uniform(0.3, 0.7)
        shapes.box(f"wall{rng.integers(4)}", x, y, top, x + 0.8, y + 0.6, top + rng.uniform(1.2, 2.4), WALL)
        shapes.tube("clay", (x + 0.25, y + 0.3, top + 1.2), (x + 0.25, y + 0.3, top + 2.8), (0.12, 0.1), 6)
    if style.roof == "flat":
        for _ in range(rng.integers(2, 6)):
            x, y, size = rng.uniform(1, width - 2.5), -rng.uniform(1.5, depth - 1.5), rng.uniform(0.7, 1.8)
            shapes.box(
                str(rng.choice(["zinc", "trim1", "wall0"])),
                x,
                y - size * 0.4,
                top,
                x + size,
                y + size * 0.4,
                top + rng.uniform(0.6, 2.2),
                3.0,
            )
        x = rng.uniform(1, width - 1)
        shapes.tube("iron", (x, -2, top), (x, -2, top + 3.2), (0.03, 0.02), 5)
        for z in np.arange(1.6, 3.2, 0.3):
            shapes.box("iron", x - 0.5, -2.01, top + z, x + 0.5, -1.99, top + z + 0.02)


def _dormers(shapes: Shapes, rng: np.random.Generator, width: float, style: Style, top: float) -> None:
    count = max(1, int((width - 1) // style.bay))
    for x in 0.5 + (width - 1) / count * (np.arange(count) + 0.5):
        a, b = x - 0.55, x + 0.55
        shapes.box(style.trim, a - 0.15, -2.2, top + 0.3, b + 0.15, -0.25, top + 2.0)
        shapes.box(style.roof_material, a - 0.25, -2.4, top + 2.0, b + 0.25, -0.1, top + 2.15, 5.0)
        shapes.pictures(
            "rooms",
            [[[a, -0.23, top + 0.5], [b, -0.23, top + 0.5], [b, -0.23, top + 1.9], [a, -0.23, top + 1.9]]],
            cell(rng.integers(16)),
        )
        shapes.box(style.frame, x - 0.03, -0.24, top + 0.5, x + 0.03, -0.2, top + 1.9)
