"""A city made of numbers: a street of houses (``street``), blocks with gardens (``drone``) or one ``object``, from a seed.

World: metres, right-handed, z up. The street runs along x and its middle is y = 0; the road's surface is z = 0. The skyline
lies about FAR metres and more beyond the street's ends.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stages.graphics.arrays import pack_arrays, pack_json, unpack_arrays
from stages.neuras.street import buildings, furniture, textures
from stages.neuras.street.buildings import Style, building
from stages.neuras.street.shapes import Shapes

ROAD = 7.2  # metres from the middle to the kerb
PARKING = 6.05  # metres from the middle to a parked car's axis
FRONT = 10.9  # metres from the middle to the houses
KERB = 0.14  # metres
CROSS = 13.0  # width of a side street between its houses
FAR = 200.0
WALLS, ROOFS = 18, 5
Maker = Callable[[np.random.Generator, int], np.ndarray]


@dataclass(frozen=True, eq=False)
class Group:
    """All triangles of one material.

    vertices: (V, 3) float32, world. faces: (F, 3) int32. uvs: (V, 2) float32, v down. texture: (S, S, 3) uint8, sRGB.
    kind: "matt", "satin" (paint, stone, leaves), "gloss" (a clear coat over the texture) or "metal"; roughness: of the coat,
    sheen or metal.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    uvs: np.ndarray
    texture: np.ndarray
    kind: str
    roughness: float


@dataclass(frozen=True, eq=False)
class City:
    """groups: by material. sky: (H, W, 3) float32 radiance, row 0 at the zenith, column 0 towards +y, then clockwise.

    sun: unit vector towards it. houses: how many buildings stand along the streets.
    """

    groups: tuple[Group, ...]
    sky: np.ndarray
    sun: np.ndarray
    houses: int

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (V, 3) and faces (F, 3) of all groups, in their order."""
        starts = np.cumsum([0, *(len(group.vertices) for group in self.groups)])
        faces = np.concatenate([group.faces + start for group, start in zip(self.groups, starts[:-1], strict=True)])
        return np.concatenate([group.vertices for group in self.groups]), faces

    @functools.cached_property
    def owners(self) -> np.ndarray:
        """(F,) which group each face of ``mesh`` is of."""
        return np.repeat(np.arange(len(self.groups)), [len(group.faces) for group in self.groups])

    def save(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        about = {"houses": self.houses, "groups": []}
        arrays = {"sky": self.sky, "sun": self.sun}
        for number, group in enumerate(self.groups):
            about["groups"].append({"name": group.name, "kind": group.kind, "roughness": group.roughness})
            for name in ("vertices", "faces", "uvs", "texture"):
                arrays[f"{number:03d}.{name}"] = getattr(group, name)
        (folder / "city.npz").write_bytes(pack_arrays(arrays))
        (folder / "city.json").write_bytes(pack_json(about))

    @classmethod
    def load(cls, folder: Path) -> City:
        about = json.loads((folder / "city.json").read_bytes())
        arrays = unpack_arrays((folder / "city.npz").read_bytes())
        groups = tuple(
            Group(**values, **{name: arrays[f"{number:03d}.{name}"] for name in ("vertices", "faces", "uvs", "texture")})
            for number, values in enumerate(about["groups"])
        )
        return cls(groups, arrays["sky"], arrays["sun"], about["houses"])


def make(preset: str, seed: int, length: float, texture_size: int = 1024, thing: str = "car") -> City:
    """The city of a seed. ``length``: of the street, or of each side of the blocks, metres. ``thing``: which object."""
    rng = np.random.default_rng([seed, 1])
    shapes = Shapes()
    if preset == "object":
        houses = _object(shapes, rng, thing)
    else:
        houses = _street(shapes, rng, length) if preset == "street" else _blocks(shapes, rng, length)
        _skyline(shapes, rng, length, preset)
    palette = _palette(np.random.default_rng([seed, 2]))
    groups = []
    for number, name in enumerate(sorted(shapes.soups)):
        maker, kind, roughness, scale = palette[name]
        texture = maker(np.random.default_rng([seed, 3, number]), max(32, int(texture_size * scale)))
        groups.append(Group(name, *shapes.soups[name].arrays(), texture, kind, roughness))
    sky_rng = np.random.default_rng([seed, 4])
    elevation, azimuth = np.radians(sky_rng.uniform(36, 52)), np.radians(sky_rng.choice([-1, 1]) * sky_rng.uniform(35, 125))
    sun = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    return City(tuple(groups), sky(sky_rng, sun), sun, houses)


def sky(rng: np.random.Generator, sun: np.ndarray, height: int = 512) -> np.ndarray:
    """(H, 2 H, 3) radiance: blue above, haze below, a glow around the sun, clouds on a plane."""
    elevation = np.pi / 2 - (np.arange(height) + 0.5) / height * np.pi
    azimuth = (np.arange(2 * height) + 0.5) / height * np.pi
    e, a = np.meshgrid(elevation, azimuth, indexing="ij")
    d = np.stack([np.cos(e) * np.sin(a), np.cos(e) * np.cos(a), np.sin(e)], -1)
    up = np.clip(d[..., 2:], 0, 1)
    colours = np.array([0.2, 0.4, 0.85]) * 0.8 * up**0.5 + np.array([0.78, 0.84, 0.92]) * (1 - up**0.5)
    colours = colours + np.array([1.0, 0.85, 0.6]) * (1.2 * np.clip(d @ sun, 0, 1) ** 60)[..., None]
    size = 1024
    noise = 0.6 * textures.fractal(rng, size, 1, 24, 1.3) + 0.5 * textures.fractal(rng, size, 6, 300, 1.4)
    plane = d[..., :2] / np.maximum(d[..., 2:], 0.03) * 0.12 * size
    cover = noise[(plane[..., 1] % size).astype(int), (plane[..., 0] % size).astype(int)]
    shade = noise[((plane[..., 1] + 14 * sun[1]) % size).astype(int), ((plane[..., 0] + 14 * sun[0]) % size).astype(int)]
    thick = np.clip((cover - 0.15) * 1.6, 0, 1) * np.clip(d[..., 2] * 9, 0, 1)
    cloud = np.clip(1.15 - 0.28 * np.clip(shade, -1, 2), 0.5, 1.4)[..., None] * np.array([1.0, 0.99, 0.97])
    colours = colours * (1 - thick[..., None]) + cloud * thick[..., None]
    ground = np.array([0.3, 0.29, 0.27])
    return np.where(d[..., 2:] < 0, ground, colours).astype(np.float32)


MATT = ("grass", "gravel", "bark", "soil", "clay", "flowers", "cloth")
SHEEN = {  # roughness of surfaces by the start of their names
    "asphalt": 0.42,
    "pavement": 0.42,
    "kerb": 0.45,
    "roof": 0.5,
    "tyre": 0.4,
    "leaves": 0.35,
    "paint": 0.35,
    "manhole": 0.25,
    "pool": 0.05,
}
WALL_SHEEN = {
    textures.brick: 0.5,
    textures.plaster: 0.45,
    textures.stone: 0.35,
    textures.siding: 0.3,
    textures.panels: 0.25,
}


def _finish(name: str, maker: Maker) -> tuple[str, float]:
    """Kind and roughness of a surface. Few surfaces of a street are quite matt: asphalt, plaster and leaves shine at grazing
    angles."""
    if name.startswith(MATT):
        return "matt", 0.5
    if name.startswith("wall"):
        return "satin", WALL_SHEEN[maker]
    return "satin", next((roughness for start, roughness in SHEEN.items() if name.startswith(start)), 0.3)


def _palette(rng: np.random.Generator) -> dict[str, tuple[Maker, str, float, float]]:
    """Each material: what makes its texture, its kind, its roughness, and its texture's size as a share of the largest."""
    t = textures
    large: dict[str, Maker] = {"asphalt": t.asphalt, "pavement": t.slabs, "grass": t.grass, "gravel": t.gravel}
    walls = [t.brick, t.plaster, t.stone, t.panels, t.plaster, t.brick, t.siding]
    large |= {f"wall{k}": walls[k % len(walls)] for k in range(WALLS)}
    large |= {f"roof{k}": t.tiles for k in range(ROOFS)}
    small: dict[str, Maker] = {
        "bark": t.bark,
        "planks0": t.planks,
        "planks1": t.planks,
        "shutter0": t.shutter,
        "shutter1": t.shutter,
    }
    small |= {f"trim{k}": t.speckled(t.hue(rng, (0.03, 0.16), (0.03, 0.2), (0.55, 0.92)), 0.1) for k in range(5)}
    small |= {
        f"frame{k}": t.speckled(c, 0.05)
        for k, c in enumerate(([0.9, 0.9, 0.87], [0.33, 0.22, 0.15], [0.24, 0.3, 0.27], [0.75, 0.7, 0.6]))
    }
    small |= {f"door{k}": t.speckled(t.hue(rng, (0, 1), (0.3, 0.8), (0.2, 0.6)), 0.1) for k in range(4)}
    small |= {f"shopfront{k}": t.speckled(t.hue(rng, (0, 1), (0.2, 0.7), (0.25, 0.7)), 0.1) for k in range(4)}
    small |= {f"cloth{k}": t.speckled(t.hue(rng, (0, 1), (0.5, 0.9), (0.4, 0.8)), 0.06) for k in range(3)}
    small |= {f"leaves{k}": t.leaves for k in range(3)}
    small |= {
        "cloth3": t.speckled([0.9, 0.88, 0.8]),
        "flowers": t.speckled(t.hue(rng, (-0.1, 0.15), (0.6, 0.95), (0.7, 0.95)), 0.25),
        "kerb": t.speckled([0.56, 0.55, 0.52], 0.12),
        "soil": t.speckled([0.3, 0.24, 0.18], 0.25),
        "clay": t.speckled([0.65, 0.36, 0.25], 0.1),
        "paintwhite": t.speckled([0.85, 0.85, 0.82], 0.13),
        "paintyellow": t.speckled([0.85, 0.7, 0.2], 0.1),
        "iron": t.speckled([0.17, 0.18, 0.19], 0.15),
        "tyre": t.speckled([0.09, 0.09, 0.09], 0.1),
        "plate_white": t.speckled([0.9, 0.9, 0.88]),
        "manhole": t.speckled([0.24, 0.23, 0.22], 0.3),
        "green": t.speckled([0.12, 0.36, 0.22], 0.1),
        "yellow": t.speckled([0.9, 0.66, 0.1]),
        "pool": t.speckled([0.3, 0.66, 0.78], 0.08),
    }
    paints = [
        [0.75, 0.75, 0.77],
        [0.08, 0.09, 0.1],
        [0.6, 0.08, 0.08],
        [0.12, 0.22, 0.45],
        [0.88, 0.88, 0.86],
        [0.35, 0.37, 0.4],
        t.hue(rng, (0, 1), (0.5, 0.9), (0.3, 0.8)),
        t.hue(rng, (0, 1), (0.3, 0.6), (0.3, 0.6)),
    ]
    palette = {name: (maker, *_finish(name, maker), 1.0) for name, maker in large.items()}
    palette |= {name: (maker, *_finish(name, maker), 0.5) for name, maker in small.items()}
    palette |= {
        name: (t.atlas(draw), "satin", roughness, 1.0)
        for name, draw, roughness in (
            ("posters", t.draw_poster, 0.25),
            ("signs", t.draw_sign, 0.2),
            ("towers", t.draw_tower, 0.15),
            ("plates", t.draw_plate, 0.25),
        )
    }
    palette |= {name: (t.atlas(draw), "gloss", 0.05, 1.0) for name, draw in (("rooms", t.draw_window), ("goods", t.draw_shop))}
    palette |= {f"paint{k}": (t.speckled(c, 0.03), "gloss", 0.08, 0.25) for k, c in enumerate(paints)}
    palette |= {
        "carglass": (t.speckled([0.2, 0.23, 0.25], 0.3), "gloss", 0.04, 0.25),
        "headlamp": (t.speckled([0.9, 0.9, 0.85]), "gloss", 0.1, 0.1),
        "taillamp": (t.speckled([0.75, 0.06, 0.05]), "gloss", 0.1, 0.1),
    }
    palette |= {
        "chrome": (t.speckled([0.75, 0.75, 0.77]), "metal", 0.2, 0.1),
        "zinc": (t.speckled([0.6, 0.62, 0.64], 0.12), "metal", 0.45, 0.25),
        "pole": (t.speckled([0.4, 0.42, 0.43], 0.1), "metal", 0.4, 0.25),
    }
    return palette


# --- the street -------------------------------------------------------------------------------------------------------


def crossings(length: float) -> np.ndarray:
    """x of the side streets' middles, every 75 m or so."""
    count = max(1, int(length // 75))
    return (np.arange(count) + 0.62) * length / count


def _street(shapes: Shapes, rng: np.random.Generator, length: float) -> int:
    crosses = crossings(length)
    edges = np.concatenate([[0.0], np.stack([crosses - CROSS / 2, crosses + CROSS / 2], 1).ravel(), [length]])
    spans = list(zip(edges[::2], edges[1::2], strict=True))
    _ground(shapes, rng, length, spans, crosses)
    houses = 0
    for sign in (-1, 1):
        for start, end in spans:
            houses += _row(shapes, rng, sign, start, end)
        for x in crosses:
            houses += _side_street(shapes, rng, sign, x)
        _pavement_things(shapes, rng, sign, spans)
        _parked(shapes, rng, sign, spans)
    for x in crosses:
        furniture.traffic_light(shapes.at(x - CROSS / 2 + 0.6, -ROAD - 0.5, KERB), rng)
        furniture.traffic_light(shapes.at(x + CROSS / 2 - 0.6, ROAD + 0.5, KERB, np.pi), rng)
    for x in np.arange(18, length, 34):  # wires across
        z = rng.uniform(6.5, 7.6)
        shapes.tube("iron", (x, -FRONT, z), (x, 0, z - 0.5), (0.015, 0.015), 4)
        shapes.tube("iron", (x, 0, z - 0.5), (x, FRONT, z), (0.015, 0.015), 4)
        shapes.box("zinc", x - 0.3, -0.15, z - 0.75, x + 0.3, 0.15, z - 0.5)
    for x, y in zip(
        rng.uniform(length * 0.72, length - 6, 4), (3.0, -2.2, 2.6, -2.4), strict=True
    ):  # cars under way, far ahead
        furniture.car(shapes.at(x, y, 0, np.pi if y > 0 else 0), rng)
    return houses


def frontage(rng: np.random.Generator, start: float, end: float, low: float = 8.0, high: float = 13.5) -> np.ndarray:
    """Where plots of ``low`` to ``high`` metres begin and end."""
    count = max(1, round((end - start) / rng.uniform(0.5 * (low + high) - 0.6, 0.5 * (low + high) + 0.6)))
    shares = rng.uniform(low, high, count)
    return start + (end - start) * np.concatenate([[0], np.cumsum(shares)]) / shares.sum()


def _row(shapes: Shapes, rng: np.random.Generator, sign: int, start: float, end: float) -> int:
    """Houses of one side between two side streets; now and then a small garden."""
    edges = frontage(rng, start, end)
    count = len(edges) - 1
    garden = int(rng.integers(1, count - 1)) if count > 4 and rng.random() < 0.5 else -1
    for number, (a, b) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
        frame = shapes.at(a, -FRONT, KERB) if sign < 0 else shapes.at(b, FRONT, KERB, np.pi)
        if number == garden:
            _garden(frame, rng, b - a)
            continue
        style = Style.draw(rng, WALLS, ROOFS, (1, 5), rng.random() < 0.62, ("flat", "flat", "gable", "mansard"))
        ends = (number == 0 or number - 1 == garden, number == count - 1 or number + 1 == garden)
        setback = rng.choice([0, 0, 0, 0.35])
        building(frame.at(0, -setback), rng, b - a, rng.uniform(10.5, 13.5), style, ends if sign < 0 else ends[::-1])
        frame.box("pavement", 0, -setback - 0.01, -0.1, b - a, 0, 0.0, 4.0)
    return count - (garden >= 0)


def _garden(shapes: Shapes, rng: np.random.Generator, width: float) -> None:
    shapes.floor("grass", 0, -13, width, 0, 0.02, 5.0)
    shapes.floor("gravel", width * 0.4, -12, width * 0.55, 0, 0.03, 3.0)
    for x in (width * 0.2, width * 0.75):
        furniture.hedge(shapes.at(x, -0.6), rng, width * 0.33)
        furniture.tree(shapes.at(x, -rng.uniform(3, 6)), rng, rng.uniform(6, 9))
        furniture.tree(shapes.at(x + 1, -rng.uniform(8, 12)), rng, rng.uniform(7, 10))
    furniture.bench(shapes.at(width * 0.62, -3.2), rng)
    shapes.box("wall0", 0, -13.4, 0, width, -13, 2.4, buildings.WALL)


def _side_street(shapes: Shapes, rng: np.random.Generator, sign: int, x: float) -> int:
    """Houses along a side street behind the corner houses, and one that ends it."""
    count = 0
    for side in (-1, 1):
        y = FRONT + 14.5
        while y < 62:
            width = rng.uniform(9, 12)
            style = Style.draw(rng, WALLS, ROOFS, (1, 4), rng.random() < 0.3, ("flat", "gable", "mansard"))
            low = sign * y if sign > 0 else sign * (y + width)
            frame = (
                shapes.at(x - CROSS / 2, low + width, KERB, -np.pi / 2)
                if side < 0
                else shapes.at(x + CROSS / 2, low, KERB, np.pi / 2)
            )
            building(frame, rng, width, 10, style, (y < FRONT + 15, False))
            y += width
            count += 1
        furniture.street_tree(shapes.at(x + side * 5.2, sign * rng.uniform(22, 30), KERB), rng)
        furniture.car(shapes.at(x + side * 2.4, sign * rng.uniform(16, 40), 0, np.pi / 2), rng)
    style = Style.draw(rng, WALLS, ROOFS, (3, 5), True, ("mansard", "gable"))
    frame = shapes.at(x + 9, 72, KERB, np.pi) if sign > 0 else shapes.at(x - 9, -72, KERB)
    building(frame, rng, 18, 12, style)
    return count + 1


def _ground(
    shapes: Shapes, rng: np.random.Generator, length: float, spans: list[tuple[float, float]], crosses: np.ndarray
) -> None:
    shapes.floor("asphalt", -60, -ROAD, length + 60, ROAD, 0.0, 9.0, 3.0)
    for sign in (-1, 1):
        for a, b in [(-60, 0.0), *spans, (length, length + 60)]:
            y0, y1 = sorted((sign * ROAD, sign * FRONT))
            shapes.floor("pavement", a, y0, b, y1, KERB, 4.0, 2.0)
            e0, e1 = sorted((sign * (ROAD - 0.02), sign * (ROAD + 0.18)))
            stones = np.arange(a, b - 0.5, 1.0)
            shapes.boxes(
                "kerb",
                np.stack([stones, 0 * stones + e0, 0 * stones - 0.05], -1),
                np.stack([stones + 0.985, 0 * stones + e1, 0 * stones + KERB + 0.006], -1),
            )
        for x in crosses:
            y0, y1 = sorted((sign * ROAD, sign * 72))
            shapes.floor("asphalt", x - 4, y0, x + 4, y1, 0.0, 9.0, 3.0)
            for side in (-1, 1):
                x0, x1 = sorted((x + side * 4, x + side * CROSS / 2))
                shapes.box("pavement", x0, y0, -0.1, x1, y1, KERB, 4.0)
    shapes.floor("grass", -FAR, -FAR, length + FAR, FAR, -0.06, 6.0, 40.0)  # under and around everything
    _markings(shapes, rng, length, crosses)


def _markings(shapes: Shapes, rng: np.random.Generator, length: float, crosses: np.ndarray) -> None:
    def patch(material: str, x0, y0, x1, y1) -> None:  # noqa: ANN001
        shapes.floor(material, x0, y0, x1, y1, 0.006, 1.0, 50.0)

    for x in np.arange(-50, length + 50, 6.0):
        if np.abs(x + 1.5 - crosses).min() > CROSS / 2 + 3:
            patch("paintwhite", x, 0.55, x + 3, 0.68)
    for sign in (-1, 1):
        for x in np.arange(2, length, 6.0):
            if np.abs(x - crosses).min() > CROSS / 2 + 2:
                patch("paintwhite", x, sign * 4.98 - 0.05, x + 1.2, sign * 4.98 + 0.05)
                patch("paintwhite", x, min(sign * 4.98, sign * 7.1), x + 0.1, max(sign * 4.98, sign * 7.1))
    for x in crosses:
        for near in (x - CROSS / 2 - 3.2, x + CROSS / 2 + 0.4):
            for y in np.arange(-ROAD + 0.4, ROAD - 0.5, 1.0):
                patch("paintwhite", near, y, near + 2.8, y + 0.5)
        patch("paintwhite", x - CROSS / 2 - 4.4, -4.9, x - CROSS / 2 - 4.0, 0.5)
    for x in np.arange(14, length, 40.0):
        y = -2.4
        patch("paintwhite", x, y - 0.07, x + 2.2, y + 0.07)
        head = np.array([[x + 2.2, y - 0.4, 0.006], [x + 3.4, y, 0.006], [x + 2.2, y + 0.4, 0.006]])
        shapes.mesh("paintwhite", head, [[0, 1, 2]], head[:, :2])
    for x in rng.uniform(0, length, int(length / 9)):
        y = rng.uniform(-4, 4)
        shapes.tube("manhole", (x, y, -0.05), (x, y, 0.008), (0.36, 0.36), 14)


def _pavement_things(shapes: Shapes, rng: np.random.Generator, sign: int, spans: list[tuple[float, float]]) -> None:
    """Trees, lamps and furniture along the kerb and the houses."""
    turn = 0.0 if sign < 0 else np.pi  # so that +y of a thing looks at the road

    def place(x: float, away: float) -> Shapes:
        return shapes.at(x, sign * (ROAD + away), KERB, turn)

    for start, end in spans:
        slots = np.arange(start + 2.2, end - 1.5, 4.1)
        for number, x in enumerate(slots):
            if number % 6 == 0:
                furniture.lamp(place(x, 0.55), rng)
            elif number % 2 == 1 and rng.random() < 0.72:
                furniture.street_tree(place(x, 0.95), rng)
            elif rng.random() < 0.8:
                things = (
                    furniture.bench,
                    furniture.bin_,
                    furniture.billboard,
                    furniture.traffic_sign,
                    furniture.shelter,
                    furniture.cafe,
                )
                pick = int(rng.choice(6, p=[0.2, 0.2, 0.2, 0.2, 0.08, 0.12]))
                frame = place(x, 0.9)
                if things[pick] in (furniture.traffic_sign, furniture.billboard):
                    frame = shapes.at(x, sign * (ROAD + 0.9), KERB)
                things[pick](frame, rng)
            if rng.random() < 0.4:
                furniture.bollard(place(x + 1.6, 0.4), rng)
            if rng.random() < 0.3:
                (furniture.cafe if rng.random() < 0.5 else lambda frame, r: buildings.planter(frame, r, 1.2, 0.4))(
                    place(x + 1.5, 2.6), rng
                )


def _parked(shapes: Shapes, rng: np.random.Generator, sign: int, spans: list[tuple[float, float]]) -> None:
    for start, end in spans:
        x = start + 4.5
        while x < end - 6:
            if rng.random() < 0.7:
                furniture.car(
                    shapes.at(x, sign * (PARKING + rng.normal(0, 0.05)), 0, (0 if sign < 0 else np.pi) + rng.normal(0, 0.012)),
                    rng,
                )
            x += 6.0


def _skyline(shapes: Shapes, rng: np.random.Generator, length: float, preset: str) -> None:
    """Towers, houses and woods in the distance, all around."""
    centre = np.array([length / 2, 0 if preset == "street" else length / 2])
    reach = length / 2 + FAR
    for angle in np.arange(150) * 2 * np.pi / 150 + rng.uniform(0, 0.02, 150):
        away = reach * rng.uniform(1.02, 2.6)
        wide, deep, high = rng.uniform(14, 40), rng.uniform(14, 30), rng.uniform(12, 42) * (1 + 2.2 * (rng.random() < 0.2))
        frame = shapes.at(*(centre + away * np.array([np.cos(angle), np.sin(angle)])), -1, angle + np.pi / 2)
        for x0, y0, x1, y1 in (
            (-wide, -deep, wide, -deep),
            (-wide, deep, wide, deep),
            (-wide, -deep, -wide, deep),
            (wide, -deep, wide, deep),
        ):
            corners = np.array([[x0, y0, 0], [x1, y1, 0], [x1, y1, high], [x0, y0, high]]) / [2, 2, 1]
            frame.pictures("towers", corners, textures.cell(int(rng.integers(16))))
        frame.box("gravel", -wide / 2, -deep / 2, high, wide / 2, deep / 2, high + 1, 6.0)
    for angle in rng.uniform(0, 2 * np.pi, 260):
        away = reach * rng.uniform(0.98, 1.5)
        place = centre + away * np.array([np.cos(angle), np.sin(angle)])
        furniture.tree(shapes.at(*place, -1), rng, rng.uniform(9, 17), 60)
    shapes.floor("grass", centre[0] - 2000, centre[1] - 2000, centre[0] + 2000, centre[1] + 2000, -1.0, 40.0, 500.0)


# --- blocks of houses, for a flight over them ---------------------------------------------------------------------------

BLOCK = (54.0, 46.0)  # metres, between the middles of the roads
LANE = 3.4  # metres from a road's middle to its kerb


def _blocks(shapes: Shapes, rng: np.random.Generator, length: float) -> int:
    """Blocks over a square of this side: each has two rows of houses, back to back, with gardens between."""
    shapes.floor("grass", -FAR, -FAR, length + FAR, length + FAR, -0.12, 6.0, 40.0)
    columns, rows = max(1, round(length / BLOCK[0])), max(1, round(length / BLOCK[1]))
    width, depth = length / columns, length / rows
    houses = 0
    for column in range(columns):
        for row in range(rows):
            houses += _block(shapes.at(column * width, row * depth), rng, width, depth)
    for line in range(columns + 1):
        shapes.floor("asphalt", line * width - LANE, -20, line * width + LANE, length + 20, 0.0, 9.0, 3.0)
        for y in np.arange(0, length, 5.0):
            shapes.floor("paintwhite", line * width - 0.07, y, line * width + 0.07, y + 2.2, 0.012, 1.0, 10.0)
    for line in range(rows + 1):
        shapes.floor("asphalt", -20, line * depth - LANE, length + 20, line * depth + LANE, 0.004, 9.0, 3.0)
        for x in np.arange(4, length, 5.0):
            shapes.floor("paintwhite", x, line * depth - 0.07, x + 2.2, line * depth + 0.07, 0.012, 1.0, 10.0)
    return houses


def _block(shapes: Shapes, rng: np.random.Generator, width: float, depth: float) -> int:
    """One block around whose edge the roads' middles run; a park now and then."""
    x0, x1, y0, y1 = LANE, width - LANE, LANE, depth - LANE
    shapes.box("pavement", x0, y0, -0.1, x1, y1, 0.12, 4.0)
    shapes.floor("grass", x0 + 1.6, y0 + 1.6, x1 - 1.6, y1 - 1.6, 0.14, 6.0)
    for x in np.arange(x0 + 6, x1 - 4, 13):
        for y, turn in ((y0 + 0.8, np.pi), (y1 - 0.8, 0.0)):
            furniture.lamp(shapes.at(x, y, 0.12, turn), rng)
    if rng.random() < 0.12:
        _park(shapes, rng, width, depth)
        return 0
    count = 0
    for turn, frame in ((0, shapes.at(x1, y0, 0.12, np.pi)), (1, shapes.at(x0, y1, 0.12))):
        edges = frontage(rng, 1.8, x1 - x0 - 1.8, 9.5, 15.0)
        for a, b in zip(edges[:-1], edges[1:], strict=True):
            _plot(frame.at(a, 0), rng, b - a, (y1 - y0) / 2)
            count += 1
            if rng.random() < 0.5:
                furniture.car(shapes.at(*(frame.at(a + 3, 1.2).origin[:2] - shapes.origin[:2]), 0, np.pi * turn), rng)
    return count


def _plot(shapes: Shapes, rng: np.random.Generator, width: float, depth: float) -> None:
    """A house with a front yard and a garden: from the pavement (y = 0) to (width, -depth)."""
    front, side = rng.uniform(3.0, 5.5), rng.uniform(0.6, 2.4)
    house, deep = width - side - 1.0, rng.uniform(7.0, 9.0)
    style = Style.draw(rng, WALLS, ROOFS, (0, 2), False, ("gable", "gable", "mansard", "flat"))
    building(shapes.at(0.5, -front), rng, house, deep, style, (True, True))
    shapes.floor(str(rng.choice(["pavement", "gravel"])), 0.5 + house * 0.3, -front, 0.5 + house * 0.3 + 1.3, -1.6, 0.04, 3.0)
    furniture.fence(shapes.at(0, -1.8), rng, width * 0.7)
    back = -front - deep
    if rng.random() < 0.6:
        furniture.hedge(shapes.at(width - 0.3, back - 3.5, 0, np.pi / 2), rng, 6.5, rng.uniform(0.9, 1.8))
    shapes.floor("pavement", 1, back - 2.5, 1 + house * 0.6, back, 0.045, 3.0)
    pick = rng.random()
    if pick < 0.2:
        shapes.box("kerb", 2, back - 7.2, 0, width - 2.5, back - 4.0, 0.1)
        shapes.floor("pool", 2.3, back - 6.9, width - 2.8, back - 4.3, 0.11, 2.0)
    elif pick < 0.6:
        shapes.box("planks1", 1, back - 7.5, 0, 3.6, back - 5, 2.1, 2.0)
        shapes.box("zinc", 0.8, back - 7.7, 2.1, 3.8, back - 4.8, 2.25, 2.0)
    else:
        for y in np.arange(back - 7, back - 4, 0.9):
            buildings.planter(shapes.at(width / 2, y), rng, width * 0.5, 0.5)
    furniture.cafe(shapes.at(2.2, back - 1.4), rng)
    for _ in range(rng.integers(2, 4)):
        furniture.tree(shapes.at(rng.uniform(1, width - 1), back - rng.uniform(2.5, 6.5)), rng, rng.uniform(4, 9), 900)
    furniture.tree(shapes.at(rng.uniform(0.6, width - 0.6), -rng.uniform(2.2, 2.6)), rng, rng.uniform(3, 5), 600)


def _park(shapes: Shapes, rng: np.random.Generator, width: float, depth: float) -> None:
    shapes.floor("gravel", width / 2 - 1.2, LANE + 1, width / 2 + 1.2, depth - LANE - 1, 0.16, 3.0)
    shapes.floor("gravel", LANE + 1, depth / 2 - 1.2, width - LANE - 1, depth / 2 + 1.2, 0.165, 3.0)
    for _ in range(28):
        x, y = rng.uniform(6, width - 6), rng.uniform(6, depth - 6)
        if abs(x - width / 2) > 2 and abs(y - depth / 2) > 2:
            furniture.tree(shapes.at(x, y, 0.1), rng, rng.uniform(5, 11), 900)
    for x in np.arange(8, width - 8, 6):
        furniture.bench(shapes.at(x, depth / 2 - 2, 0.12), rng)


# --- one object, seen from all sides ----------------------------------------------------------------------------------


def _object(shapes: Shapes, rng: np.random.Generator, thing: str) -> int:
    """A thing around the z axis, on z = 0, without anything around it; returns how many houses that is."""
    if thing == "car":
        furniture.car(shapes, rng, "suv")
    elif thing == "tree":
        furniture.tree(shapes, rng, 6.0, 2500)
    else:
        style = Style.draw(rng, WALLS, ROOFS, (1, 2), False, ("gable",))
        building(shapes.at(-4.5, 4.0), rng, 9.0, 8.0, style, (True, True))
    return int(thing == "house")
