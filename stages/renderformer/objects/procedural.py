"""Families of made-up shapes. With them the pipeline runs without any mesh file.

A family is a function of a random generator. Each call draws proportions, counts, profiles and bends, and so gives another
member. Parts may overlap and need not be joined, because remesh makes one closed surface of them. z is up; units and
placement are free, because later stages normalise.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from stages.graphics.geometry.measure import normal_vectors

Mesh = tuple[np.ndarray, np.ndarray]  # (V, 3) float64, (F, 3) int64, outward where closed

TURN = 2 * np.pi


# -- building blocks


def join(*parts: Mesh) -> Mesh:
    """All parts as one mesh."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    return (
        np.concatenate([vertices for vertices, _ in parts]),
        np.concatenate([faces + start for (_, faces), start in zip(parts, starts, strict=False)]),
    )


def moved(mesh: Mesh, offset: tuple[float, float, float] | np.ndarray) -> Mesh:
    """The mesh, translated."""
    return mesh[0] + np.asarray(offset), mesh[1]


def turned(mesh: Mesh, axis: int, angle: float) -> Mesh:
    """Rotated about a coordinate axis, angle in radians."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    vertices = mesh[0].copy()
    vertices[:, first] = np.cos(angle) * mesh[0][:, first] - np.sin(angle) * mesh[0][:, second]
    vertices[:, second] = np.sin(angle) * mesh[0][:, first] + np.cos(angle) * mesh[0][:, second]
    return vertices, mesh[1]


def quads(points: np.ndarray, wrap_rows: bool = False, wrap_columns: bool = False) -> Mesh:
    """Triangles of a (N, M, 3) grid of points. ``wrap_rows``, ``wrap_columns``: the last row or column joins the first."""
    n, m = points.shape[:2]
    index = np.arange(n * m).reshape(n, m)
    if wrap_rows:
        index = np.concatenate([index, index[:1]])
    if wrap_columns:
        index = np.concatenate([index, index[:, :1]], axis=1)
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    return points.reshape(-1, 3), np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def capped(rings: np.ndarray) -> Mesh:
    """A (N, M, 3) stack of rings, closed at both ends by fans to the rings' centres. Rings must be star-shaped about these."""
    n, m = rings.shape[:2]
    vertices, faces = quads(rings, wrap_columns=True)
    low, high = np.arange(m), np.arange(m) + (n - 1) * m
    ends = np.stack([rings[0].mean(axis=0), rings[-1].mean(axis=0)])
    bottom = np.stack([low, np.roll(low, -1), np.full(m, n * m)], axis=1)
    top = np.stack([np.roll(high, -1), high, np.full(m, n * m + 1)], axis=1)
    return np.concatenate([vertices, ends]), np.concatenate([faces, bottom, top])[:, ::-1]


def lathe(profile: np.ndarray, around: int = 48) -> Mesh:
    """A solid of revolution: a (N, 2) profile of (radius, height) turned about z, capped."""
    angle = np.arange(around) / around * TURN
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(around)], axis=-1)
    points = profile[:, None, :1] * ring + profile[:, None, 1:] * np.array([0, 0, 1.0])
    return capped(points)


def tube(path: np.ndarray, radius: np.ndarray | float, around: int = 14, closed: bool = False) -> Mesh:
    """A round tube along a (N, 3) path, with frames that do not twist. ``radius``: a number, or (N,) along the path."""
    n = len(path)
    tangent = np.roll(path, -1, axis=0) - np.roll(path, 1, axis=0) if closed else np.gradient(path, axis=0)
    tangent = tangent / np.linalg.norm(tangent, axis=1, keepdims=True)
    normal = np.cross(tangent[0], np.eye(3)[np.argmin(np.abs(tangent[0]))])
    normals = np.empty_like(path)
    for index in range(n):  # parallel transport
        normal = normal - (normal @ tangent[index]) * tangent[index]
        normal = normal / np.linalg.norm(normal)
        normals[index] = normal
    binormals = np.cross(tangent, normals)
    angle = np.arange(around) / around * TURN
    radius = np.broadcast_to(radius, (n,))[:, None, None]
    offset = np.cos(angle)[:, None] * normals[:, None] + np.sin(angle)[:, None] * binormals[:, None]
    rings = path[:, None] + radius * offset
    if not closed:
        return capped(rings)
    # the frame comes back turned by some angle: join each last point to the nearest first one
    shift = int(np.argmin(np.linalg.norm(rings[0] - rings[-1][:1], axis=1)))
    rings = np.concatenate([rings, np.roll(rings[:1], -shift, axis=1)])
    return quads(rings[:, ::-1], wrap_columns=True)


def extrude(outline: np.ndarray, levels: np.ndarray, scales: np.ndarray | None = None, twist: float = 0.0) -> Mesh:
    """A solid of one cross section: the (M, 2) outline, star-shaped about the origin, at the heights ``levels`` (N,), capped.

    ``scales`` (N,): size of the outline at each height. ``twist``: its turn from bottom to top, in radians.
    """
    levels = np.asarray(levels, float)
    scales = np.ones(len(levels)) if scales is None else np.asarray(scales)
    angle = twist * (levels - levels[0]) / max(np.ptp(levels), 1e-9)
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    x = scales[:, None] * (cos * outline[:, 0] - sin * outline[:, 1])
    y = scales[:, None] * (sin * outline[:, 0] + cos * outline[:, 1])
    rings = np.stack([x, y, np.broadcast_to(levels[:, None], x.shape)], axis=-1)
    vertices, faces = capped(rings)
    vertices[-2:, :2] = 0  # fans meet on the axis
    return vertices, faces


def ring(outer: np.ndarray, inner: np.ndarray, low: float, high: float) -> Mesh:
    """The flat body between two (M, 2) outlines with equally many points, from height ``low`` to ``high``."""
    loops = [(outer, low), (outer, high), (inner, high), (inner, low)]
    points = np.stack([np.column_stack([loop, np.full(len(loop), z)]) for loop, z in loops])
    return quads(points[::-1], wrap_rows=True, wrap_columns=True)


def box(size: tuple[float, float, float] | np.ndarray, centre: tuple[float, float, float] | np.ndarray = (0, 0, 0)) -> Mesh:
    """An axis-aligned box."""
    square = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) / 2
    vertices, faces = extrude(square, np.array([-0.5, 0.5]))
    return vertices * np.asarray(size) + np.asarray(centre), faces


def circle(number: int, radius: float = 1.0) -> np.ndarray:
    """(N, 2) points on a circle about the origin, counter-clockwise."""
    angle = np.arange(number) / number * TURN
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def sphere_grid(rows: int = 40, columns: int = 64) -> tuple[np.ndarray, np.ndarray]:
    """(latitude (N, 1), longitude (1, M)) in radians, without the poles: ``capped`` closes them."""
    latitude = (np.arange(rows) + 0.5) / rows * np.pi - np.pi / 2
    return latitude[:, None], (np.arange(columns) / columns * TURN)[None]


def power(x: np.ndarray, exponent: float) -> np.ndarray:
    """Power of the absolute value, with the sign of x."""
    return np.sign(x) * np.abs(x) ** exponent


# -- families


def superellipsoid(rng: np.random.Generator) -> Mesh:
    """From star-like over round to boxy."""
    latitude, longitude = sphere_grid()
    e, n = rng.uniform(0.3, 2.2, 2)
    sides = rng.uniform(0.5, 1, 3)
    x = sides[0] * power(np.cos(latitude), e) * power(np.cos(longitude), n)
    y = sides[1] * power(np.cos(latitude), e) * power(np.sin(longitude), n)
    z = sides[2] * power(np.sin(latitude), e) * np.ones_like(longitude)
    return capped(np.stack([x, y, z], axis=-1))


def torus(rng: np.random.Generator) -> Mesh:
    """A ring with a rounded or boxy section that may turn on its way."""
    u, v = np.meshgrid(np.arange(72) / 72 * TURN, np.arange(28) / 28 * TURN, indexing="ij")
    thickness, exponent, turns = rng.uniform(0.15, 0.45), rng.uniform(0.4, 1.3), rng.integers(0, 3)
    a, b = thickness * power(np.cos(v), exponent), thickness * rng.uniform(0.5, 1.6) * power(np.sin(v), exponent)
    spin = turns * u
    radial, height = np.cos(spin) * a - np.sin(spin) * b, np.sin(spin) * a + np.cos(spin) * b
    stretch = rng.uniform(0.7, 1.0)
    points = np.stack([(1 + radial) * np.cos(u), stretch * (1 + radial) * np.sin(u), height], axis=-1)
    return quads(points, wrap_rows=True, wrap_columns=True)


def torus_knot(rng: np.random.Generator) -> Mesh:
    """A tube along a (p, q) knot."""
    p, q = [(2, 3), (3, 2), (2, 5), (3, 4), (1, 3), (1, 4)][rng.integers(6)]
    t = np.arange(240) / 240 * TURN
    spread = rng.uniform(0.35, 0.5)
    radius = 1 + spread * np.cos(q * t)
    path = np.stack([radius * np.cos(p * t), radius * np.sin(p * t), rng.uniform(0.3, 0.6) * np.sin(q * t)], axis=1)
    return tube(path, rng.uniform(0.09, 0.17), closed=True)


def gear(rng: np.random.Generator) -> Mesh:
    """A toothed wheel with a bore, and often a hub."""
    teeth, tooth, height = int(rng.integers(7, 19)), rng.uniform(0.12, 0.3), rng.uniform(0.2, 0.6)
    angle = (np.arange(teeth)[:, None] + np.array([0, 0.12, 0.3, 0.5, 0.62, 0.74, 0.86, 0.93])) / teeth * TURN
    radius = np.tile([1 - tooth, 1 - tooth, 1 - tooth, 1 - tooth, 1, 1, 1, 1 - tooth / 2], teeth)
    outer = radius[:, None] * np.stack([np.cos(angle.ravel()), np.sin(angle.ravel())], axis=1)
    bore = rng.uniform(0.15, 0.4)
    direction = outer / np.linalg.norm(outer, axis=1, keepdims=True)
    parts = [ring(outer, bore * direction, -height / 2, height / 2)]
    if rng.random() < 0.6:
        hub = rng.uniform(bore + 0.08, bore + 0.2)
        parts.append(ring(hub * direction, bore * direction, -height, rng.uniform(0.6, 1.2) * height))
    return join(*parts)


def vase(rng: np.random.Generator) -> Mesh:
    """A turned vessel, hollow, sometimes fluted."""
    from scipy.interpolate import CubicSpline

    knots = np.linspace(0, 1, 6)
    radius = CubicSpline(knots, rng.uniform(0.18, 0.6, 6))(np.linspace(0, 1, 40)).clip(0.12)
    height = np.linspace(0, rng.uniform(1.0, 2.0), 40)
    wall = rng.uniform(0.05, 0.1)
    inner = slice(None, int(rng.integers(2, 5)), -1)
    profile = np.concatenate([np.stack([radius, height], 1), np.stack([radius[inner] - wall, height[inner]], 1)])
    vertices, faces = lathe(profile, 64)
    flutes, depth = int(rng.integers(5, 13)), rng.uniform(0, 0.12) * (rng.random() < 0.5)
    vertices[:, :2] *= 1 + depth * np.cos(flutes * np.arctan2(vertices[:, 1], vertices[:, 0]))[:, None]
    return vertices, faces


def spring(rng: np.random.Generator) -> Mesh:
    """A helix of wire, straight or conical."""
    turns, pitch = rng.uniform(2.5, 5.0), rng.uniform(0.4, 0.65)
    t = np.linspace(0, 1, int(turns * 36))
    radius = 1 - rng.uniform(0, 0.6) * t
    path = np.stack([radius * np.cos(TURN * turns * t), radius * np.sin(TURN * turns * t), turns * pitch * t], axis=1)
    return tube(path, rng.uniform(0.09, 0.16))


def star(rng: np.random.Generator) -> Mesh:
    """A bevelled star or flower."""
    points, depth = int(rng.integers(3, 9)), rng.uniform(0.25, 0.6)
    angle = np.arange(24 * points) / (24 * points) * TURN
    wave = 2 * np.abs((points * angle / TURN) % 1 - 0.5) if rng.random() < 0.6 else 0.5 + 0.5 * np.cos(points * angle)
    outline = (1 - depth * (1 - wave))[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    height, bevel = rng.uniform(0.2, 0.7), rng.uniform(0.5, 0.95)
    return extrude(outline, height * np.array([-0.5, -0.3, 0.3, 0.5]), np.array([bevel, 1, 1, bevel]))


def chair(rng: np.random.Generator) -> Mesh:
    """Seat, four legs, a back of slats or a board, sometimes arms."""
    width, depth, seat, back = (
        rng.uniform(0.8, 1.1),
        rng.uniform(0.8, 1.1),
        rng.uniform(0.7, 1.1),
        rng.uniform(0.7, 1.3),
    )
    leg, board = rng.uniform(0.08, 0.16), rng.uniform(0.08, 0.16)
    x, y = (width - leg) / 2, (depth - leg) / 2
    parts = [box((width, depth, board), (0, 0, seat))]
    parts += [box((leg, leg, seat), (sx * x, sy * y, seat / 2)) for sx in (-1, 1) for sy in (-1, 1)]
    if rng.random() < 0.5:
        slats = int(rng.integers(2, 5))
        parts += [box((leg, leg, back), (s * x, y, seat + back / 2)) for s in (-1, 1)]
        heights = seat + back * (np.arange(slats) + 0.8) / slats
        parts += [box((width, leg * 0.7, back / slats * 0.5), (0, y, h - back / slats * 0.2)) for h in heights]
    else:
        parts.append(turned(box((width, leg, back), (0, 0, back / 2)), 0, -rng.uniform(0, 0.25)))
        parts[-1] = moved(parts[-1], (0, y, seat))
    if rng.random() < 0.4:
        arm = 0.4 * back
        parts += [box((leg, depth, leg), (s * x, 0, seat + arm)) for s in (-1, 1)]
        parts += [box((leg, leg, arm), (s * x, -y, seat + arm / 2)) for s in (-1, 1)]
    return join(*parts)


def table(rng: np.random.Generator) -> Mesh:
    """A round or square top on legs or on one foot."""
    height, top = rng.uniform(0.5, 1.0), rng.uniform(0.08, 0.15)
    round_ = rng.random() < 0.5
    plate = (
        extrude(circle(48, 0.7), np.array([height, height + top]))
        if round_
        else box((1.5, rng.uniform(0.7, 1.5), top), (0, 0, height + top / 2))
    )
    if rng.random() < 0.5:
        stem = rng.uniform(0.07, 0.14)
        profile = np.array([[0.45, 0], [0.45, 0.08], [stem, 0.18], [stem, 0.8 * height], [2 * stem, height + top / 2]])
        return join(plate, lathe(profile))
    corners = circle(3, 0.5) if round_ else (plate[0][:, :2].max(axis=0) - 0.12) * [[1, 1], [-1, 1], [-1, -1], [1, -1]]
    splay, radius = rng.uniform(1, 1.3), rng.uniform(0.05, 0.09)
    legs = []
    for x, y in corners:
        path = np.linspace([splay * x, splay * y, 0], [x, y, height + top / 2], 5)
        legs.append(tube(path, np.linspace(0.8, 1.1, 5) * radius))
    return join(plate, *legs)


def blob(rng: np.random.Generator) -> Mesh:
    """A sphere swollen by low spherical harmonics."""
    from scipy.special import sph_harm_y

    latitude, longitude = sphere_grid(48, 72)
    radius = np.ones(np.broadcast_shapes(latitude.shape, longitude.shape))
    for degree in range(2, 6):
        for order in range(degree + 1):
            harmonic = sph_harm_y(degree, order, np.pi / 2 - latitude, longitude)
            a, b = rng.normal(0, 0.5 / degree, 2)
            radius = radius + a * harmonic.real + b * harmonic.imag
    radius = radius.clip(0.3)
    direction = np.stack(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude) + 0 * longitude],
        -1,
    )
    return capped(radius[..., None] * direction)


def twisted_prism(rng: np.random.Generator) -> Mesh:
    """A polygon that turns, and may narrow, on its way up."""
    sides = int(rng.integers(3, 7))
    corners = circle(sides)
    outline = np.concatenate(
        [np.linspace(a, b, 12, endpoint=False) for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)]
    )
    levels = np.linspace(0, rng.uniform(1.8, 3.5), 40)
    return extrude(outline, levels, np.linspace(1, rng.uniform(0.4, 1.1), 40), rng.uniform(0.4, 2.6) * rng.choice([-1, 1]))


def arch(rng: np.random.Generator) -> Mesh:
    """A gate: half a ring on two pillars, with or without a base and steps."""
    inner, width, depth, pillar = (
        rng.uniform(0.45, 0.75),
        rng.uniform(0.2, 0.4),
        rng.uniform(0.3, 0.7),
        rng.uniform(0.3, 1.2),
    )
    angle = np.linspace(0, np.pi, 40)
    rise = rng.uniform(0.8, 1.5)
    curve = np.stack([np.cos(angle), rise * np.sin(angle)], axis=1)
    legs = np.array([[1.0, 0]]), np.array([[-1.0, 0]])
    outer = np.concatenate(
        [legs[0] * (inner + width) - [0, pillar], curve * (inner + width), legs[1] * (inner + width) - [0, pillar]]
    )
    hollow = np.concatenate([legs[0] * inner - [0, pillar], curve * inner, legs[1] * inner - [0, pillar]])
    loops = [(outer, -depth / 2), (outer, depth / 2), (hollow, depth / 2), (hollow, -depth / 2)]
    points = np.stack([np.stack([loop[:, 0], np.full(len(loop), y), loop[:, 1]], axis=1) for loop, y in loops], axis=1)
    parts = [capped(points)]
    if rng.random() < 0.6:
        parts.append(box((2.3 * (inner + width), depth * 1.4, 0.16), (0, 0, -pillar)))
    return join(*parts)


def mug(rng: np.random.Generator) -> Mesh:
    """A hollow cup with a handle."""
    height, foot, wall = rng.uniform(0.8, 1.5), rng.uniform(0.7, 1.1), rng.uniform(0.06, 0.1)
    z = np.linspace(0, height, 12)
    radius = 0.5 * np.linspace(foot, 1, 12) + rng.uniform(-0.06, 0.1) * np.sin(np.pi * z / height)
    outside, inside = np.stack([radius, z], 1), np.stack([radius - wall, z], 1)[:0:-1]
    cup = lathe(np.concatenate([outside, inside]))
    angle = np.linspace(-np.pi / 2, np.pi / 2, 24)
    reach, grip = rng.uniform(0.25, 0.45), rng.uniform(0.25, 0.38) * height
    start = radius[5:8].min() - wall / 2
    path = np.stack([start + reach * np.cos(angle), 0 * angle, height * 0.52 + grip * np.sin(angle)], axis=1)
    return join(cup, tube(path, rng.uniform(0.05, 0.08)))


def stairs(rng: np.random.Generator) -> Mesh:
    """A straight flight, solid or of treads, or a spiral one about a post."""
    steps, rise = int(rng.integers(4, 10)), rng.uniform(0.12, 0.22)
    if rng.random() < 0.4:
        treads = [box((0.9, 0.36, 0.7 * rise), (0.5, 0, rise * k)) for k in range(steps)]
        spin = rng.uniform(0.35, 0.6)
        treads = [turned(tread, 2, spin * k) for k, tread in enumerate(treads)]
        return join(*treads, extrude(circle(24, 0.14), np.array([-rise, rise * (steps + 0.5)])))
    width, run, solid = rng.uniform(0.5, 1.3), rng.uniform(0.2, 0.32), rng.random() < 0.6
    parts = []
    for k in range(steps):
        top = rise * (k + 1)
        low = 0.0 if solid else max(0.0, top - 1.6 * rise)
        parts.append(box((width, run * 1.05, top - low), (0, run * k, (top + low) / 2)))
    return join(*parts)


def rounded_box(rng: np.random.Generator) -> Mesh:
    """A box with rounded edges, and often rows of round studs on top: keys, buttons or bricks."""
    latitude, longitude = sphere_grid(40, 64)
    direction = np.stack(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude) + 0 * longitude],
        -1,
    )
    sides, radius = rng.uniform(0.3, 1, 3), rng.uniform(0.06, 0.2)
    body = capped(direction * radius + np.sign(direction) * (sides - radius).clip(0.02))
    studs_x, studs_y = int(rng.integers(0, 4)), int(rng.integers(1, 4))
    parts = [body]
    for i in range(studs_x):
        for j in range(studs_y):
            x, y = ((i + 0.5) / studs_x * 2 - 1) * sides[0] * 0.9, ((j + 0.5) / studs_y * 2 - 1) * sides[1] * 0.9
            size = 0.3 * min(sides[0] * 2 / studs_x, sides[1] * 2 / studs_y)
            parts.append(moved(extrude(circle(24, size), np.array([0, 0.1 + sides[2]])), (x, y, 0.08)))
    return join(*parts)


def cone_stack(rng: np.random.Generator) -> Mesh:
    """A conifer: cones of falling size on a stem."""
    layers, sides = int(rng.integers(2, 6)), int(rng.choice([5, 6, 8, 32]))
    parts, z = [extrude(circle(16, 0.12), np.array([-0.5, 0.3]))], 0.0
    for radius in np.linspace(0.75, rng.uniform(0.25, 0.5), layers):
        tall = radius * rng.uniform(1.0, 1.6)
        cone = extrude(circle(sides, radius), np.array([0, tall]), np.array([1, 0.05]))
        parts.append(moved(turned(cone, 2, rng.uniform(0, TURN)), (0, 0, z)))
        z += tall * rng.uniform(0.45, 0.65)
    return join(*parts)


def leaf(rng: np.random.Generator) -> Mesh:
    """An open sheet: a curved, waved leaf, or several on a stem."""
    leaves = []
    number = int(rng.integers(1, 6))
    for k in range(number):
        u, v = np.meshgrid(np.linspace(0, 1, 30), np.linspace(-1, 1, 13), indexing="ij")
        width = rng.uniform(0.2, 0.4) * np.sin(np.pi * u**0.8) + 0.015
        bend, fold, wave = rng.uniform(-0.6, 0.9), rng.uniform(0, 0.3), rng.uniform(0, 0.05)
        z = bend * u * (1 - 0.6 * u) + fold * np.abs(v) * width + wave * np.sin(9 * u) * v
        sheet = quads(np.stack([u, width * v, z], axis=-1))
        leaves.append(moved(turned(sheet, 2, TURN * (k + 0.3 * rng.random()) / number), (0, 0, 0.12 * k)))
    if number > 1:
        leaves.append(tube(np.stack([np.zeros(6), np.zeros(6), np.linspace(-0.5, 0.12 * number, 6)], 1), 0.03))
    return join(*leaves)


def tree(rng: np.random.Generator) -> Mesh:
    """Forking branches, each thinner than the one it grows from."""
    parts = []

    def grow(start: np.ndarray, direction: np.ndarray, length: float, radius: float, level: int) -> None:
        t = np.linspace(0, 1, 7)[:, None]
        bend = rng.normal(0, 0.15, 3)
        path = start + length * (t * direction + t * t * bend)
        parts.append(tube(path, np.linspace(radius, 0.7 * radius, 7), around=10))
        if level:
            for _ in range(int(rng.integers(2, 4))):
                side = rng.normal(size=3)
                side /= np.linalg.norm(side)
                turn = direction + bend + rng.uniform(0.6, 1.1) * side
                turn[2] += 0.25
                grow(
                    path[-1] * 0.98 + path[-2] * 0.02,
                    turn / np.linalg.norm(turn),
                    0.7 * length,
                    0.68 * radius,
                    level - 1,
                )

    grow(np.zeros(3), np.array([0, 0, 1.0]), 1.0, rng.uniform(0.1, 0.16), 2)
    return join(*parts)


def pipe(rng: np.random.Generator) -> Mesh:
    """A hollow pipe with square turns, rounded by a spline, with flanges at its ends."""
    points = [np.zeros(3)]
    axis = -1
    for _ in range(int(rng.integers(3, 6))):
        axis = int(rng.choice([a for a in range(3) if a != axis]))
        points.append(points[-1] + rng.choice([-1, 1, 1]) * rng.uniform(0.7, 1.2) * np.eye(3)[axis])
    corners = np.array(points)
    path = [corners[0]]
    for before, corner, after in zip(corners[:-2], corners[1:-1], corners[2:], strict=True):
        t = np.linspace(0, 1, 10)[:, None]
        a = corner + 0.3 * (before - corner) / np.linalg.norm(before - corner)
        b = corner + 0.3 * (after - corner) / np.linalg.norm(after - corner)
        path += list((1 - t) ** 2 * a + 2 * t * (1 - t) * corner + t * t * b)
    path.append(corners[-1])
    path, radius = np.array(path), rng.uniform(0.14, 0.2)
    parts = [tube(path, radius, around=18)]
    for end, inner in ((path[0], path[1]), (path[-1], path[-2])):
        along = 0.14 * (inner - end) / np.linalg.norm(inner - end)
        parts.append(tube(np.stack([end, end + along / 2, end + along]), 1.6 * radius, around=24))
    return join(*parts)


def shell(rng: np.random.Generator) -> Mesh:
    """A snail's shell: a tube that grows along a spiral."""
    turns = rng.uniform(2.2, 3.5)
    t = np.linspace(0, 1, int(turns * 40))
    growth = np.exp(rng.uniform(1.8, 2.6) * (t - 1))
    rise = rng.uniform(0.3, 1.8)
    angle = TURN * turns * t
    path = np.stack([growth * np.cos(angle), growth * np.sin(angle), -rise * growth], axis=1)
    return tube(path, rng.uniform(0.38, 0.55) * growth, around=28)


def shelf(rng: np.random.Generator) -> Mesh:
    """Boards between two sides, some with blocks standing on them."""
    width, depth, height = rng.uniform(0.7, 1.3), rng.uniform(0.3, 0.5), rng.uniform(1.0, 1.8)
    board, levels = rng.uniform(0.05, 0.08), int(rng.integers(3, 6))
    parts = [box((board, depth, height), (s * (width - board) / 2, 0, height / 2)) for s in (-1, 1)]
    for z in np.linspace(board / 2, height - board / 2, levels):
        parts.append(box((width, depth, board), (0, 0, z)))
    if rng.random() < 0.6:
        parts.append(box((width, board, height), (0, (depth - board) / 2, height / 2)))
    gap = (height - board) / (levels - 1)
    for z in np.linspace(board / 2, height - board / 2, levels)[:-1]:
        x = -width / 2 + board
        while x < width / 2 - 0.3:
            size = np.array([rng.uniform(0.1, 0.28), depth * rng.uniform(0.5, 0.9), gap * rng.uniform(0.3, 0.8)])
            if rng.random() < 0.6:
                parts.append(box(size, (x + size[0] / 2, 0, z + size[2] / 2)))
            x += size[0] + rng.uniform(0.03, 0.2)
    return join(*parts)


# -- colours


def pattern(rng: np.random.Generator) -> np.ndarray:
    """A tile (128, 128, 3) uint8 sRGB that repeats without a seam: checks, stripes, dots or clouds of two to four colours."""
    side = 128
    x, y = np.meshgrid((np.arange(side) + 0.5) / side, (np.arange(side) + 0.5) / side)
    colours = rng.uniform(0, 1, (4, 3))
    number, kind = int(rng.integers(2, 7)), int(rng.integers(4))
    if kind == 0:
        level = (np.floor(2 * number * x) + np.floor(2 * number * y)) % 2
    elif kind == 1:
        level = np.floor(2 * number * ((rng.integers(1, 3) * x + rng.integers(0, 3) * y) % 1)) % 3
    elif kind == 2:
        radius = rng.uniform(0.2, 0.45)
        u, v = number * x % 1 - 0.5, number * y % 1 - 0.5
        level = np.where(np.hypot(u, v) < radius, 1 + (np.floor(number * x) + np.floor(number * y)) % 2, 0)
    else:
        level = np.full((side, side), 1.5)
        for wave in rng.integers(-number, number + 1, (8, 2)):
            level = level + 0.5 * np.sin(TURN * (wave[0] * x + wave[1] * y + rng.random()))
        level = level.clip(0, 3)
    low = np.floor(level).astype(int).clip(0, 2)
    part = (level - low)[..., None]
    return np.round(255 * (colours[low] * (1 - part) + colours[low + 1] * part)).astype(np.uint8)


def box_coordinates(vertices: np.ndarray, faces: np.ndarray, repeats: float = 2.0) -> np.ndarray:
    """(F, 3, 2) texture coordinates of corners: each face is projected along the axis nearest to its normal.

    ``repeats``: how often a tile repeats along the longest side of the bounding box.
    """
    corners = np.asarray(vertices, np.float64)[faces]
    corners = (corners - corners.min(axis=(0, 1))) * (repeats / max(float(np.ptp(corners, axis=(0, 1)).max()), 1e-12))
    axis = np.abs(normal_vectors(corners)).argmax(axis=1)[:, None, None]
    first, second = (np.take_along_axis(corners, np.repeat((axis + step) % 3, 3, axis=1), axis=2)[..., 0] for step in (1, 2))
    return np.stack([first, second], axis=-1)


FAMILIES: dict[str, Callable[[np.random.Generator], Mesh]] = {
    function.__name__: function
    for function in (
        arch, blob, chair, cone_stack, gear, leaf, mug, pipe, rounded_box, shelf, shell, spring, stairs, star,
        superellipsoid, table, torus, torus_knot, tree, twisted_prism, vase,
    )
}  # fmt: skip
