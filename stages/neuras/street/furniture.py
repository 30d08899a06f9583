"""What stands in a street beside its houses: trees, cars, poles, lamps, signs, benches, bins, billboards.

Each function adds one thing around the origin of its frame; its front looks along +y, a car's along +x.
"""

from __future__ import annotations

import numpy as np

from stages.neuras.street.buildings import planter
from stages.neuras.street.shapes import Shapes
from stages.neuras.street.textures import cell

# Outlines of cars, metres: length, width, height, height of the belt. Then x of the cabin's base and roof, as shares of the
# length.
CARS = {
    "hatchback": (4.0, 1.75, 1.48, 0.92, (0.06, 0.72), (0.14, 0.52)),
    "saloon": (4.7, 1.82, 1.45, 0.93, (0.16, 0.72), (0.28, 0.56)),
    "estate": (4.7, 1.82, 1.5, 0.94, (0.02, 0.72), (0.07, 0.54)),
    "suv": (4.6, 1.9, 1.75, 1.08, (0.03, 0.74), (0.1, 0.58)),
    "van": (5.2, 1.98, 2.3, 1.2, (0.0, 0.88), (0.01, 0.72)),
}
CAR_PAINTS = 8


def tree(shapes: Shapes, rng: np.random.Generator, height: float, leaves: int = 1500) -> None:
    """A trunk, branches, and a crown of single leaves around a few blobs."""
    kind = rng.integers(3)
    trunk = height * rng.uniform(0.3, 0.42)
    shapes.tube("bark", (0, 0, 0), (0.1, 0.05, trunk), (0.035 * height, 0.024 * height), 8)
    blobs = int(rng.integers(7, 13))
    spread = height * rng.uniform(0.17, 0.25)
    centres = np.stack(
        [
            rng.normal(0, spread * 0.62, blobs),
            rng.normal(0, spread * 0.62, blobs),
            rng.uniform(trunk + 0.1 * height, height * 0.88, blobs),
        ],
        -1,
    )
    taper = 1.15 - 0.6 * (centres[:, 2] - trunk) / (height - trunk)
    centres[:, :2] *= taper[:, None]
    for centre in centres:
        shapes.tube("bark", (0.1, 0.05, trunk * 0.95), centre, (0.013 * height, 0.004 * height), 5)
    which = rng.integers(0, blobs, leaves)
    offset = rng.normal(size=(leaves, 3))
    offset /= np.linalg.norm(offset, axis=1, keepdims=True)
    radius = height * 0.13 * rng.uniform(0.25, 1.15, leaves) ** 0.6
    normals = offset + rng.normal(0, 0.6, (leaves, 3)) + [0, 0, 0.4]
    shapes.cards(
        f"leaves{kind}",
        centres[which] + offset * radius[:, None],
        normals / np.linalg.norm(normals, axis=1, keepdims=True),
        rng.uniform(0.1, 0.21, leaves) * height / 7,
        rng.uniform(0, 6.3, leaves),
        rng.random((leaves, 2)),
    )


def street_tree(shapes: Shapes, rng: np.random.Generator) -> None:
    """A tree in its pit, with a guard of iron or a stake."""
    shapes.box("kerb", -0.75, -0.75, 0, 0.75, 0.75, 0.05)
    shapes.box("soil", -0.65, -0.65, 0.04, 0.65, 0.65, 0.07)
    tree(shapes, rng, rng.uniform(5.5, 8.5))
    if rng.random() < 0.5:
        for angle in np.arange(8) * np.pi / 4:
            shapes.tube(
                "iron",
                (0.4 * np.cos(angle), 0.4 * np.sin(angle), 0),
                (0.5 * np.cos(angle), 0.5 * np.sin(angle), 1.3),
                (0.015, 0.015),
                4,
            )


def hedge(shapes: Shapes, rng: np.random.Generator, length: float, height: float = 1.1, width: float = 0.7) -> None:
    n = int(length * 260 * height)
    face = rng.integers(0, 5, n)
    at = rng.uniform(-0.5, 0.5, (n, 3))
    side = np.array([[0.5, 0, 0], [-0.5, 0, 0], [0, 0.5, 0], [0, -0.5, 0], [0, 0, 0.5]])[face]
    at = np.where(side != 0, side, at) * [length, width, height] + [0, 0, height / 2] + rng.normal(0, 0.05, (n, 3))
    normals = side * 2 + rng.normal(0, 0.5, (n, 3))
    shapes.box("soil", -length / 2, -width / 2, 0, length / 2, width / 2, height * 0.9)
    shapes.cards(
        f"leaves{rng.integers(3)}",
        at,
        normals / np.linalg.norm(normals, axis=1, keepdims=True),
        rng.uniform(0.07, 0.14, n),
        rng.uniform(0, 6.3, n),
        rng.random((n, 2)),
    )


def car(shapes: Shapes, rng: np.random.Generator, kind: str | None = None) -> None:
    """A car along x around the origin: painted body, glass cabin, wheels, lamps, plates, mirrors."""
    kind = kind or str(rng.choice(list(CARS)))
    length, width, height, belt, base, roof = CARS[kind]
    paint = f"paint{rng.integers(CAR_PAINTS)}"
    half = width / 2
    body = shapes.at(-length / 2, 0)
    # The body: sections from tail to nose, each an outline across.
    share = np.array([0.0, 0.015, 0.05, 0.3, 0.6, base[1], 0.86, 0.95, 0.985, 1.0])
    nose = belt - (0.1 if kind == "van" else 0.17)
    top = np.interp(share, [0, 0.03, base[1], 0.93, 1.0], [belt - 0.12, belt, belt, nose, nose - 0.2])
    narrow = np.interp(share, [0, 0.05, 0.2, 0.8, 0.95, 1.0], [0.86, 0.95, 1, 1, 0.94, 0.8])
    sections = []
    for x, z, w in zip(share * length, top, narrow * half, strict=True):
        outline = [(0.86, 0.22), (0.97, 0.34), (1.0, 0.55), (0.98, z - 0.1), (0.9, z - 0.02), (0.5, z + 0.02), (0, z + 0.03)]
        sections.append([(x, w * y, h) for y, h in outline] + [(x, -w * y, h) for y, h in outline[-2::-1]])
    body.loft(paint, np.array(sections))
    # The cabin: glass all around, painted roof and pillars.
    x0, x1 = base[0] * length + 0.02, base[1] * length
    r0, r1 = roof[0] * length, roof[1] * length
    low, high, z0, z1 = half * 0.92, half * 0.74, belt - 0.02, height - 0.05
    ring = np.array([[x0, low, z0], [x1, low, z0], [x1, -low, z0], [x0, -low, z0]])
    lid = np.array([[r0, high, z1], [r1, high, z1], [r1, -high, z1], [r0, -high, z1]])
    for k in range(4):
        corners = np.array([[ring[k], ring[(k + 1) % 4], lid[(k + 1) % 4], lid[k]]])
        if kind == "van" and k in (0, 2, 3):
            body.quads(paint, corners, corners[..., [0, 2]])
        else:
            body.quads("carglass", corners, corners[..., [0, 2]] * 0.4 + corners[..., [1, 1]] * 0.3)
        body.tube(paint, ring[k], lid[k], (0.05, 0.04), 5)
    middle = 0.5 * (x0 + x1) * 0.5 + 0.25 * (r0 + r1)
    for sign in (-1, 1):
        body.tube(paint, (middle, sign * low, z0), (middle, sign * high, z1), (0.045, 0.04), 4)
        for x in (middle, x1 - 0.15):
            body.box(
                "tyre", x, sign * half * 0.985 - 0.008, 0.32, x + 0.012, sign * half * 0.985 + 0.008, belt - 0.08
            )  # gaps of a door
        body.box(
            "chrome",
            middle - 0.35,
            sign * half * 0.99 - 0.02,
            belt - 0.2,
            middle - 0.18,
            sign * half * 0.99 + 0.02,
            belt - 0.16,
        )
        body.box(
            paint, x1 - 0.32, sign * (half + 0.09) - 0.08, belt + 0.02, x1 - 0.18, sign * (half + 0.09) + 0.08, belt + 0.17
        )
        body.box("tyre", 0.1, sign * half * 0.97 - 0.03, 0.2, length - 0.1, sign * half * 0.97 + 0.03, 0.34)
    body.loft(
        paint,
        np.array(
            [
                [(x, y * high, z1 + 0.05 * (1 - y * y) + 0.01) for y in np.linspace(-1, 1, 7)]
                for x in np.linspace(r0 - 0.03, r1 + 0.03, 5)
            ]
        ),
        lids=False,
    )
    for x in (0.19 * length, 0.81 * length):
        for sign in (-1, 1):
            inner, outer = sign * (half - 0.24), sign * (half + 0.01)
            body.tube("tyre", (x, inner, 0.36), (x, outer - sign * 0.012, 0.36), (0.39, 0.39), 18)  # the arch
            body.tube("tyre", (x, inner, 0.32), (x, outer, 0.32), (0.32, 0.31), 18)
            body.tube("chrome", (x, inner, 0.32), (x, outer + sign * 0.01, 0.32), (0.2, 0.17), 10)
    for sign in (-1, 1):
        body.box(
            "headlamp",
            length - 0.14,
            sign * half * 0.62 - 0.17,
            nose - 0.3,
            length + 0.0,
            sign * half * 0.62 + 0.17,
            nose - 0.15,
        )
        body.box("taillamp", -0.01, sign * half * 0.7 - 0.12, belt - 0.36, 0.08, sign * half * 0.7 + 0.12, belt - 0.15)
    for x, z in ((-0.02, 0.55), (length - 0.03, 0.38)):
        body.box("plate_white", x, -0.26, z, x + 0.05, 0.26, z + 0.12)
        body.box("tyre", x - 0.005, -0.2, z + 0.03, x + 0.055, 0.2, z + 0.09)
    body.box("tyre", length - 0.06, -half * 0.6, 0.5, length + 0.005, half * 0.6, 0.62)  # the grille


def lamp(shapes: Shapes, rng: np.random.Generator, height: float = 6.5, reach: float = 1.7) -> None:
    shapes.tube("pole", (0, 0, 0), (0, 0, 0.9), (0.11, 0.09), 10)
    shapes.tube("pole", (0, 0, 0.9), (0, 0, height), (0.07, 0.045), 8)
    shapes.tube("pole", (0, 0, height - 0.3), (0, reach, height), (0.035, 0.03), 6)
    shapes.box("zinc", -0.13, reach - 0.3, height - 0.04, 0.13, reach + 0.35, height + 0.1)
    shapes.box("headlamp", -0.1, reach - 0.25, height - 0.07, 0.1, reach + 0.3, height - 0.04)
    if rng.random() < 0.4:
        corners = [[[0.06, 0.02, 3.0], [0.66, 0.02, 3.0], [0.66, 0.02, 4.3], [0.06, 0.02, 4.3]]]
        shapes.pictures("posters", corners, cell(rng.integers(16)))


def traffic_light(shapes: Shapes, rng: np.random.Generator) -> None:
    """Lamps that look along -x, who drives along +x sees them."""
    shapes.tube("pole", (0, 0, 0), (0, 0, 3.6), (0.07, 0.06), 8)
    shapes.tube("pole", (0, 0, 5.2), (0, 3.2, 5.5), (0.05, 0.04), 8)
    shapes.tube("pole", (0, 0, 3.6), (0, 0, 5.2), (0.06, 0.05), 8)
    for y, z in ((0.0, 2.5), (3.0, 4.5)):
        shapes.box("iron", -0.24, y - 0.16, z, 0.0, y + 0.16, z + 0.95)
        for material, low in (("taillamp", 0.65), ("yellow", 0.36), ("green", 0.07)):
            shapes.tube(material, (-0.2, y, z + low + 0.11), (-0.27, y, z + low + 0.11), (0.1, 0.1), 10)


def traffic_sign(shapes: Shapes, rng: np.random.Generator) -> None:
    """A plate that looks along -x."""
    shapes.tube("zinc", (0, 0, 0), (0, 0, 2.9), (0.035, 0.035), 6)
    for z in (2.2, 1.5)[: rng.integers(1, 3)]:
        corners = [[[-0.045, -0.32, z], [-0.045, 0.32, z], [-0.045, 0.32, z + 0.64], [-0.045, -0.32, z + 0.64]]]
        shapes.pictures("plates", corners, cell(rng.integers(16)))


def bench(shapes: Shapes, rng: np.random.Generator) -> None:
    for y in (0.0, 0.13, 0.26, 0.39):
        shapes.box("planks0", -0.8, y, 0.42, 0.8, y + 0.1, 0.46)
    for z in (0.58, 0.72, 0.86):
        shapes.box("planks0", -0.8, -0.08, z, 0.8, -0.04, z + 0.1)
    for x in (-0.65, 0.6):
        shapes.box("iron", x, -0.06, 0, x + 0.05, 0.46, 0.42)
        shapes.box("iron", x, -0.09, 0.42, x + 0.05, -0.04, 0.98)


def bin_(shapes: Shapes, rng: np.random.Generator) -> None:
    material = str(rng.choice(["green", "iron", "zinc", "yellow"]))
    shapes.tube(material, (0, 0, 0.05), (0, 0, 0.95), (0.22, 0.28), 12)
    shapes.tube("iron", (0, 0, 0.95), (0, 0, 1.08), (0.29, 0.16), 12)


def bollard(shapes: Shapes, rng: np.random.Generator) -> None:
    shapes.tube("iron", (0, 0, 0), (0, 0, 0.9), (0.07, 0.06), 8)
    shapes.tube("plate_white", (0, 0, 0.7), (0, 0, 0.8), (0.072, 0.072), 8)


def billboard(shapes: Shapes, rng: np.random.Generator) -> None:
    """An advertising column or a board on two legs, looking along -x and +x."""
    if rng.random() < 0.5:
        shapes.tube("green", (0, 0, 0), (0, 0, 0.3), (0.68, 0.66), 20)
        angle = np.linspace(0, 2 * np.pi, 6)
        for number in range(5):
            arc = np.linspace(angle[number], angle[number + 1], 6)
            for a, b, u in zip(arc[:-1], arc[1:], np.linspace(0, 1, 6)[:-1], strict=True):
                low, high = np.array([np.cos(a), np.sin(a)]) * 0.62, np.array([np.cos(b), np.sin(b)]) * 0.62
                u0, v0, u1, v1 = cell(number + 3)
                part = np.array([1 - u, 1 - u - 0.2]) * (u1 - u0) + u0
                shapes.pictures(
                    "posters", [[[*high, 0.3], [*low, 0.3], [*low, 2.9], [*high, 2.9]]], np.array([part[1], v0, part[0], v1])
                )
        shapes.tube("green", (0, 0, 2.9), (0, 0, 3.5), (0.75, 0.1), 20)
        return
    shapes.box("iron", -0.08, -0.95, 0.0, 0.08, 0.95, 2.5)
    for sign, side in ((-1, 1), (1, -1)):
        corners = [
            [
                [sign * 0.09, -0.85 * side, 0.4],
                [sign * 0.09, 0.85 * side, 0.4],
                [sign * 0.09, 0.85 * side, 2.4],
                [sign * 0.09, -0.85 * side, 2.4],
            ]
        ]
        shapes.pictures("posters", corners, cell(rng.integers(16)))


def cafe(shapes: Shapes, rng: np.random.Generator) -> None:
    """A table, chairs, an umbrella."""
    shapes.tube("iron", (0, 0, 0), (0, 0, 0.72), (0.04, 0.04), 6)
    shapes.tube("planks1", (0, 0, 0.7), (0, 0, 0.74), (0.38, 0.38), 12)
    for angle in rng.uniform(0, 6.3) + np.arange(3) * 2.1:
        chair = shapes.at(0.75 * np.cos(angle), 0.75 * np.sin(angle), 0, angle)
        chair.box("planks1", -0.2, -0.2, 0.42, 0.2, 0.2, 0.46)
        chair.box("planks1", 0.17, -0.2, 0.46, 0.21, 0.2, 0.88)
        for x, y in ((-0.18, -0.18), (-0.18, 0.15), (0.15, -0.18), (0.15, 0.15)):
            chair.box("iron", x, y, 0, x + 0.03, y + 0.03, 0.42)
    if rng.random() < 0.7:
        cloth = f"cloth{rng.integers(4)}"
        shapes.tube("iron", (0, 0, 0.7), (0, 0, 2.5), (0.025, 0.025), 5)
        shapes.tube(cloth, (0, 0, 2.1), (0, 0, 2.6), (1.35, 0.05), 8)
    else:
        planter(shapes.at(0, 1.2), rng, 1.0, 0.35)


def shelter(shapes: Shapes, rng: np.random.Generator) -> None:
    """A bus stop, open to +y."""
    for x in (-1.7, -0.57, 0.57, 1.7):
        shapes.box("iron", x - 0.04, -0.6, 0, x + 0.04, -0.52, 2.4)
    shapes.box("zinc", -1.9, -0.7, 2.4, 1.9, 0.8, 2.5)
    shapes.box("carglass", -1.66, -0.57, 0.3, 0.53, -0.55, 2.2)
    shapes.pictures(
        "posters", [[[0.6, -0.5, 0.4], [1.66, -0.5, 0.4], [1.66, -0.5, 2.2], [0.6, -0.5, 2.2]]], cell(rng.integers(16))
    )
    shapes.pictures(
        "posters", [[[-1.74, 0.6, 0.4], [-1.74, -0.5, 0.4], [-1.74, -0.5, 2.2], [-1.74, 0.6, 2.2]]], cell(rng.integers(16))
    )
    bench(shapes.at(-0.4, -0.35), rng)


def fence(shapes: Shapes, rng: np.random.Generator, length: float) -> None:
    """Pickets along x from the origin."""
    x = np.arange(0, length, 0.16)
    material = str(rng.choice(["planks0", "planks1", "frame0"]))
    shapes.boxes(
        material, np.stack([x, 0 * x, 0 * x + 0.05], -1), np.stack([x + 0.1, 0 * x + 0.03, 1.0 + 0.08 * np.sin(x * 9)], -1)
    )
    for z in (0.3, 0.8):
        shapes.box(material, 0, 0.03, z, length, 0.06, z + 0.08)
