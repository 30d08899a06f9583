"""A glTF scene as `Described`: nodes, cameras, KHR_lights_punctual and materials with the extensions that have a counterpart.

Reads a ``.glb`` or ``.gltf`` and what lies beside it, by the reader of `stages.graphics.geometry.formats`. Emission is taken as
radiance, since Blender writes its own strength there; candela and lux are divided by 683 lm/W, since Blender multiplies by it.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import Reject, UserError
from stages.graphics.geometry.colours import Images, as_colour
from stages.graphics.geometry.formats.faults import at
from stages.graphics.geometry.formats.gltf import Gltf, Primitive, primitives_of, split_glb
from stages.graphics.geometry.formats.gltf_materials import OLDER, one_of, optional, textured, vertex_colours
from stages.graphics.geometry.formats.gltf_pose import Placed, Poses
from stages.graphics.geometry.formats.json_values import MISSING, floats, integer, items, parse, table
from stages.graphics.geometry.formats.parts import Source
from stages.renderformer.importing.described import (
    LUMENS_PER_WATT,
    MAX_BYTES,
    MAX_FACES,
    Described,
    Lamp,
    Part,
    Surface,
    Texture,
    Viewpoint,
    rigid,
)

PUNCTUAL = "KHR_lights_punctual"
# Properties of a material that have no counterpart, and what stands for them.
REPLACED = {
    "KHR_materials_diffuse_transmission": "it lets light through: it is opaque here",
    "KHR_materials_transmission": "it lets light through: it is opaque here",
    "KHR_materials_volume": "it has an inside: only its surface is drawn",
    "KHR_materials_clearcoat": "its clear coat is left out",
    "KHR_materials_sheen": "its sheen is left out",
    "KHR_materials_iridescence": "its iridescence is left out",
    "KHR_materials_anisotropy": "its highlights are the same in all directions here",
    "KHR_materials_unlit": "it is unlit in the file: its colour is a diffuse one here",
}


def holds_scene(path: Path) -> bool:
    """Whether the file has a camera and a light, so that it is a scene and no mere mesh. False where it cannot be read."""
    try:
        with at(path.name):
            data = path.read_bytes()
            tree = split_glb(data)[0] if path.suffix.lower() == ".glb" else parse(data)
            nodes, materials = items(tree, "nodes"), items(tree, "materials")
            seen = any("camera" in node for node in nodes)
            lamps = any(PUNCTUAL in optional(node, "extensions") for node in nodes)
            return seen and (lamps or any(any(material.get("emissiveFactor", ())) for material in materials))
    except Reject:
        return False


def read_gltf(path: Path) -> Described:
    """The file's scene. UserError says what is wrong with it."""
    source = Source(path, path.parent, MAX_BYTES, MAX_FACES, Images())
    try:
        with at(path.name):
            if path.stat().st_size > MAX_BYTES:
                raise Reject("too_large", f"{path.stat().st_size:,} bytes, at most {MAX_BYTES:,} are read")
            return _Reader(Gltf(path.read_bytes(), source), source).scene()
    except Reject as reject:
        raise UserError(f"{path} cannot be read: {reject.detail or reject.reason}") from None


class _Reader:
    def __init__(self, gltf: Gltf, source: Source):
        self.gltf, self.tree, self.source, self.poses = gltf, gltf.tree, source, Poses(gltf, source, normals=True)
        self.notes: list[str] = []
        self.surfaces: dict[int | None, Surface] = {}

    def scene(self) -> Described:
        described = Described([], [], [], "y", self.notes)
        taken: set[str] = set()
        for index, to_world in sorted(self.gltf.placements(), key=lambda placed: placed[0]):
            node = self.gltf.entry("nodes", index)
            name = str(node.get("name") or f"node {index}")[:80]
            name = f"{name}.{index}" if name in taken else name
            taken.add(name)
            with at(f"node {index}"):
                self._add(described, name, index, to_world)
        if self.tree.get("animations"):
            self.notes.append("the file is animated: it is drawn as its nodes stand without animation")
        self.notes += self.source.notes
        return described

    def _add(self, described: Described, name: str, index: int, to_world: np.ndarray) -> None:
        """What a node carries."""
        node = self.gltf.entry("nodes", index)
        extensions = optional(node, "extensions")
        if "mesh" in node:
            described.parts += self.parts(name, integer(node, "mesh"), index, to_world)
        if "camera" in node:
            stated = one_of(self.gltf, "cameras", integer(node, "camera"))
            described.add_camera(name, self.viewpoint(name, stated, to_world))
        if PUNCTUAL in extensions:
            lights = items(table(table(self.tree, "extensions"), PUNCTUAL), "lights")
            number = integer(table(extensions, PUNCTUAL), "light")
            if number >= len(lights):
                raise Reject("unreadable", f"light {number} does not exist, the file has {len(lights)}")
            described.lamps.append(self.lamp(name, lights[number], to_world))

    def parts(self, name: str, mesh: int, index: int, to_world: np.ndarray) -> Iterator[Part]:
        """The triangles of a node's mesh, in each of its places."""
        stated = primitives_of(self.gltf.entry("meshes", mesh))
        primitives = self.gltf.primitives(mesh)
        if len(primitives) < len(stated):
            self.notes.append(f"{name!r} has points or lines: they are left out")
        for primitive, placed in self._placed(index, to_world, primitives):
            faces = placed.part.triangles
            part = Part(name, placed.part.points[faces], self.surface(primitive.material))
            with at(primitive.place):
                if (normals := placed.directions) is not None:
                    part.normals = normals[faces]
                for number in {texture.coordinates for texture in part.surface.textures.values()}:
                    if primitive.has(f"TEXCOORD_{number}"):
                        part.uv[number] = primitive.attribute(f"TEXCOORD_{number}", 2)[faces]
                if primitive.has("COLOR_0"):
                    part.tint = vertex_colours(primitive, self.source)[faces]
            yield part

    def _placed(self, index: int, to_world: np.ndarray, primitives: list[Primitive]) -> Iterator[tuple[Primitive, Placed]]:
        for primitive in primitives:
            if len(primitive.triangles):
                for placed in self.poses.placed(index, to_world, primitive):
                    yield primitive, placed

    def surface(self, number: int | None) -> Surface:
        if number not in self.surfaces:
            entry = {} if number is None else one_of(self.gltf, "materials", number)
            with at(f"material {number}"):
                self.surfaces[number] = Surface() if number is None else self._surface(entry, number)
        return self.surfaces[number]

    def _surface(self, stated: dict[str, Any], number: int) -> Surface:
        name = str(stated.get("name") or f"material {number}")[:80]
        extensions, base = optional(stated, "extensions"), optional(stated, "pbrMetallicRoughness")
        if OLDER in extensions:  # it goes before the core material, as it prescribes
            surface, colour_texture = self._older(table(extensions, OLDER), name)
        else:
            colour = floats(base, "baseColorFactor", 4, [1, 1, 1, 1])[:3]
            surface = Surface(name, as_colour(colour, f"material {name!r}: baseColorFactor", self.source.note))
            surface.metallic, surface.roughness = (share(base, f"{key}Factor") for key in ("metallic", "roughness"))
            surface.dielectric = _dielectric(extensions)
            colour_texture = base.get("baseColorTexture")
        strength = number_of(optional(extensions, "KHR_materials_emissive_strength"), "emissiveStrength", 1.0)
        surface.emission = floats(stated, "emissiveFactor", 3, [0, 0, 0]) * strength
        if surface.emission.min() < 0:
            raise Reject("unreadable", f"an emission of {surface.emission.tolist()}")
        rough_texture = None if OLDER in extensions else base.get("metallicRoughnessTexture")
        textures = {"colour": colour_texture, "metal_rough": rough_texture}
        if surface.emits:
            textures["emission"] = stated.get("emissiveTexture")
        for use, texture in textures.items():
            if texture is not None:
                found, coordinates = textured(self.gltf, texture, (1.0, 1.0, 1.0), self.source)
                if found.image is not None:
                    surface.textures[use] = Texture(found.image, found.wrap, found.transform, coordinates)
        self._say_replaced(stated, name)
        return surface

    def _older(self, stated: dict[str, Any], name: str) -> tuple[Surface, Any]:
        """A material of KHR_materials_pbrSpecularGlossiness, and the texture of its colour."""
        colour = as_colour(floats(stated, "diffuseFactor", 4, [1, 1, 1, 1])[:3], f"material {name!r}", self.source.note)
        specular = as_colour(floats(stated, "specularFactor", 3, [1, 1, 1]), f"material {name!r}", self.source.note)
        surface = Surface(name, colour, 0.0, 1 - share(stated, "glossinessFactor"), specular)
        return surface, stated.get("diffuseTexture")

    def _say_replaced(self, stated: dict[str, Any], name: str) -> None:
        extensions = stated.get("extensions", {})
        said = [text for extension, text in REPLACED.items() if extensions.get(extension) is not None]
        if stated.get("alphaMode", "OPAQUE") != "OPAQUE":
            said.append("it is see-through in places: it is opaque here")
        if "normalTexture" in stated:
            said.append("its normal map is left out")
        self.notes += [f"material {name!r}: {text}" for text in said]

    def lamp(self, name: str, stated: dict[str, Any], to_world: np.ndarray) -> Lamp:
        kind, colour = stated.get("type"), floats(stated, "color", 3, [1, 1, 1])
        if kind not in ("point", "spot", "directional"):
            raise Reject("unreadable", f"light {name!r} is of the unknown kind {str(kind)[:40]!r}")
        strength = number_of(stated, "intensity", 1.0) / LUMENS_PER_WATT
        if min(*colour, strength) < 0:
            raise Reject("unreadable", f"light {name!r} has a negative colour or intensity")
        if "range" in stated:
            reach = number_of(stated, "range", 0.0)
            self.notes.append(f"light {name!r} ends at a distance of {reach:g} in the file: here it does not")
        spot = optional(stated, "spot")
        cone = number_of(spot, "innerConeAngle", 0.0), number_of(spot, "outerConeAngle", np.pi / 4)
        direction = -to_world[:3, 2] / max(float(np.linalg.norm(to_world[:3, 2])), 1e-300)
        return Lamp(name, kind, colour, strength, to_world[:3, 3], direction, cone)

    def viewpoint(self, name: str, stated: dict[str, Any], to_world: np.ndarray) -> Viewpoint:
        pose = rigid(to_world)
        if stated.get("type") == "orthographic":
            lens = table(stated, "orthographic")
            x, y = (abs(number_of(lens, key, 1.0)) for key in ("xmag", "ymag"))
            if min(x, y) == 0:
                raise Reject("unreadable", f"camera {name!r} sees an area of nothing")
            return Viewpoint(name, pose, 0.0, x / y, 2 * y)
        lens = table(stated, "perspective")
        fov, aspect = float(np.degrees(number_of(lens, "yfov"))), number_of(lens, "aspectRatio", 1.0)
        if not (0 < fov < 180 and 0.01 <= aspect <= 100):
            raise Reject("unreadable", f"camera {name!r} has a field of view of {fov:g} degrees and an aspect of {aspect:g}")
        return Viewpoint(name, pose, fov, aspect)


def number_of(entry: dict[str, Any], key: str, default: Any = MISSING) -> float:
    """A finite number."""
    given = {key: [entry[key]]} if key in entry else {}
    return float(floats(given, key, 1, default if default is MISSING else [default])[0])


def share(entry: dict[str, Any], key: str) -> float:
    """A number in 0 .. 1; 1 where there is none."""
    return float(np.clip(number_of(entry, key, 1.0), 0, 1))


def _dielectric(extensions: dict[str, Any]) -> np.ndarray:
    """(3,) reflectance at normal incidence of what is no metal, by KHR_materials_ior and KHR_materials_specular."""
    ior = number_of(optional(extensions, "KHR_materials_ior"), "ior", 1.5)
    specular = optional(extensions, "KHR_materials_specular")
    tint = floats(specular, "specularColorFactor", 3, [1, 1, 1])
    reflectance = ((ior - 1) / (ior + 1)) ** 2 if ior > 0 else 1.0  # 0 stands for infinity
    return np.clip(reflectance * tint, 0, 1) * share(specular, "specularFactor")
