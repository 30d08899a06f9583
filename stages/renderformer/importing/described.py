"""A modelled scene as its file describes it: parts with materials, lamps and cameras, before anything is replaced.

Frame and unit are the file's. Radiometric quantities are in watts: readers divide photometric ones by `LUMENS_PER_WATT`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

LUMENS_PER_WATT = 683.0  # of light at 555 nm, which is what glTF exporters multiply watts by
MAX_BYTES, MAX_FACES = 1 << 28, 2_000_000  # of a scene file, as *collect* has them
DIELECTRIC = 0.04  # reflectance at normal incidence of what is no metal


@dataclass
class Texture:
    """An image on a surface. image: (H, W, 3) uint8, row 0 on top. coordinates: which set of texture coordinates it uses.

    wrap, transform: as in `stages.graphics.geometry.colours.Material`.
    """

    image: np.ndarray
    wrap: tuple[str, str]
    transform: np.ndarray
    coordinates: int = 0


@dataclass
class Surface:
    """A material in the metallic-roughness model.

    colour: (3,) linear base colour. dielectric: (3,) reflectance at normal incidence where it is no metal.
    emission: (3,) radiance. textures: ``colour`` (sRGB), ``metal_rough`` (G roughness, B metallic), ``emission`` (sRGB); each
        multiplies its quantities.
    """

    name: str = ""
    colour: np.ndarray = field(default_factory=lambda: np.ones(3))
    metallic: float = 0.0
    roughness: float = 1.0
    dielectric: np.ndarray = field(default_factory=lambda: np.full(3, DIELECTRIC))
    emission: np.ndarray = field(default_factory=lambda: np.zeros(3))
    textures: dict[str, Texture] = field(default_factory=dict)

    @property
    def emits(self) -> bool:
        return bool(self.emission.max() > 0)


@dataclass
class Part:
    """Triangles of one object that share a material, in the world of the file.

    object: what it belongs to. corners: (F, 3, 3). normals: (F, 3, 3) unit, or None for flat shading.
    uv: set of coordinates -> (F, 3, 2). tint: (F, 3, 3) linear colours of the corners, or None.
    """

    object: str
    corners: np.ndarray
    surface: Surface
    normals: np.ndarray | None = None
    uv: dict[int, np.ndarray] = field(default_factory=dict)
    tint: np.ndarray | None = None


@dataclass
class Lamp:
    """A light without a surface.

    strength: W/sr of a point or spot, W/m^2 across a directional one's rays. direction: where it shines.
    cone: angles from the axis in radians, (full brightness, none), of a spot.
    """

    name: str
    kind: Literal["point", "spot", "directional"]
    colour: np.ndarray
    strength: float
    position: np.ndarray
    direction: np.ndarray
    cone: tuple[float, float] = (0.0, np.pi / 4)

    @property
    def shines(self) -> bool:
        """Whether any light leaves it."""
        return self.strength > 0 and self.colour.max() > 0 and (self.kind != "spot" or self.cone[1] > 0)


@dataclass
class Viewpoint:
    """A camera. pose: (4, 4) rigid camera-to-world, looks along -z with +y up; None: nowhere. fov_deg: across the height.

    aspect: width over height. height: of what an orthographic camera sees, in the file's unit; None for a perspective one.
    """

    name: str
    pose: np.ndarray | None
    fov_deg: float
    aspect: float = 1.0
    height: float | None = None


@dataclass
class Described:
    """What a file holds. up: the axis that points up. notes: what of it the reader could not take over, a sentence each."""

    parts: list[Part]
    lamps: list[Lamp]
    viewpoints: list[Viewpoint]
    up: Literal["y", "z"] = "y"
    notes: list[str] = field(default_factory=list)

    def add_camera(self, name: str, viewpoint: Viewpoint) -> None:
        """Add a camera, unless it looks nowhere."""
        if viewpoint.pose is None:
            self.notes.append(f"camera {name!r} is scaled to nothing: it is left out")
        else:
            self.viewpoints.append(viewpoint)

    @property
    def lit(self) -> bool:
        return bool(self.lamps) or any(part.surface.emits for part in self.parts)


def rigid(matrix: np.ndarray) -> np.ndarray | None:
    """(4, 4) without scale, shear and mirroring: the same place and axes at right angles. For cameras, which have no size.

    None where a scale of nothing has taken the axes away.
    """
    up, back = matrix[:3, 1], matrix[:3, 2]
    right = np.cross(up, back)
    lengths = [float(np.linalg.norm(axis)) for axis in (back, right)]
    if min(lengths) < 1e-100:
        return None
    back, right = back / lengths[0], right / lengths[1]
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, matrix[:3, 3]], axis=1)
    return pose
