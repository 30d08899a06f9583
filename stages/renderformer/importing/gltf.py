"""A glTF scene as `Described`: nodes, cameras, KHR_lights_punctual and materials with the extensions that have a counterpart.

Reads a ``.glb`` or ``.gltf`` and what lies beside it, by the checks of `stages.graphics.geometry.load`. Emission is taken as
radiance, since Blender writes its own strength there; candela and lux are divided by 683 lm/W, since Blender multiplies by it.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import Reject, UserError
from stages.graphics.geometry import colours
from stages.graphics.geometry.load import DRACO, open_gltf, split_glb
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
TRIANGLE_MODES = (4, 5, 6)  # list, strip, fan
# Properties of a material that have no counterpart, and what stands for them.
REPLACED = {
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
        data = path.read_bytes()
        tree = split_glb(data)[0] if path.suffix.lower() == ".glb" else json.loads(data)
        nodes, materials = tree.get("nodes", []), tree.get("materials", [])
        seen = any("camera" in node for node in nodes)
        lamps = any(PUNCTUAL in node.get("extensions", {}) for node in nodes)
        return seen and (lamps or any(any(material.get("emissiveFactor", ())) for material in materials))
    except (Reject, OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError, struct.error):
        return False


def read_gltf(path: Path) -> Described:
    """The file's scene. UserError says what is wrong with it."""
    try:
        tree, joined = open_gltf(path.read_bytes(), path.suffix.lower(), path.parent, path.parent, MAX_BYTES, MAX_FACES)
        return _Reader(tree, bytes(joined), path).scene()
    except Reject as error:
        raise UserError(f"{path} cannot be read: {error.detail or error.reason}") from None
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError, RecursionError, struct.error) as error:
        raise UserError(f"{path} is not glTF as the specification says: {str(error)[:200] or 'broken'}") from None


class _Reader:
    def __init__(self, tree: dict[str, Any], joined: bytes, path: Path):
        self.tree, self.joined, self.folder = tree, joined, path.parent
        self.images = colours.Images()
        self.notes: list[str] = []
        self.surfaces: dict[int | None, Surface] = {}

    def scene(self) -> Described:
        described = Described([], [], [], "y", self.notes)
        for name, node, to_world in self.nodes():
            if "mesh" in node:
                described.parts += self.parts(name, int(node["mesh"]), to_world)
            if "camera" in node:
                described.viewpoints.append(self.viewpoint(name, self.tree["cameras"][int(node["camera"])], to_world))
            lamp = node.get("extensions", {}).get(PUNCTUAL)
            if lamp is not None:
                described.lamps.append(
                    self.lamp(name, self.tree["extensions"][PUNCTUAL]["lights"][int(lamp["light"])], to_world)
                )
            if "skin" in node:
                self.notes.append(f"{name!r} is moved by a skeleton: it is drawn in its rest pose")
            if "EXT_mesh_gpu_instancing" in node.get("extensions", {}):
                self.notes.append(f"{name!r} has instances (EXT_mesh_gpu_instancing): one of them is drawn")
        if self.tree.get("animations"):
            self.notes.append("the file is animated: it is drawn as its nodes stand without animation")
        self.notes += self.images.notes
        return described

    def nodes(self) -> Iterator[tuple[str, dict[str, Any], np.ndarray]]:
        """Every node of the file's scene: a name of its own, the node, its (4, 4) transform to the world."""
        nodes = self.tree.get("nodes", [])
        scenes = self.tree.get("scenes", [])
        chosen = int(self.tree.get("scene", 0))
        children = {child for node in nodes for child in node.get("children", [])}
        roots = scenes[chosen].get("nodes", []) if scenes else [index for index in range(len(nodes)) if index not in children]
        taken: set[str] = set()
        queue = [(int(index), np.eye(4)) for index in reversed(roots)]
        while queue:
            index, above = queue.pop()
            node = nodes[index]
            to_world = above @ _transform(node)
            name = str(node.get("name") or f"node {index}")[:80]
            while name in taken:
                name = f"{name}.{index}"
            taken.add(name)
            yield name, node, to_world
            queue += [(int(child), to_world) for child in reversed(node.get("children", []))]

    def parts(self, name: str, number: int, to_world: np.ndarray) -> Iterator[Part]:
        linear = to_world[:3, :3]
        mirrored = np.linalg.det(linear) < 0
        for primitive in self.tree["meshes"][number]["primitives"]:
            mode = int(primitive.get("mode", 4))
            if mode not in TRIANGLE_MODES:
                self.notes.append(f"{name!r} has points or lines: they are left out")
                continue
            if primitive.get("targets"):
                self.notes.append(f"{name!r} has shape keys: it is drawn without them")
            attributes, index = self.attributes(primitive)
            faces = _triangles(mode, index)
            if mirrored:  # it turns faces inside out
                faces = faces[:, ::-1]
            if len(faces) == 0:
                continue
            if faces.min() < 0 or faces.max() >= len(attributes["POSITION"]):
                raise ValueError(f"{name!r} names vertex {faces.max()} of {len(attributes['POSITION'])}")
            part = Part(
                name, (attributes["POSITION"] @ linear.T + to_world[:3, 3])[faces], self.surface(primitive.get("material"))
            )
            if "NORMAL" in attributes:
                normals = attributes["NORMAL"] @ np.linalg.pinv(linear)
                part.normals = normals[faces]
            part.uv = {
                int(key[9:]): values[faces]
                for key, values in attributes.items()
                if key.startswith("TEXCOORD_") and key[9:].isdigit()
            }
            if "COLOR_0" in attributes:
                part.tint = attributes["COLOR_0"][:, :3][faces]
            yield part

    def attributes(self, primitive: dict[str, Any]) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """The vertices' values by name, each (V, n) float64, and the (N,) indices of the corners."""
        stated = primitive["attributes"]
        draco = primitive.get("extensions", {}).get(DRACO)
        if draco is not None:
            return self.draco(draco)
        wanted = {
            key: read_accessor(self.tree, self.joined, int(number))
            for key, number in stated.items()
            if key in ("POSITION", "NORMAL", "COLOR_0") or key.startswith("TEXCOORD_")
        }
        count = len(wanted["POSITION"])
        for key, values in wanted.items():
            if len(values) != count:
                raise ValueError(f"{key} has {len(values)} values for {count} vertices")
        if not np.isfinite(wanted["POSITION"]).all():
            raise ValueError("a vertex is not finite")
        if "indices" in primitive:
            index = read_accessor(self.tree, self.joined, int(primitive["indices"]))[:, 0].astype(np.int64)
        else:
            index = np.arange(count)
        return wanted, index

    def draco(self, stated: dict[str, Any]) -> tuple[dict[str, np.ndarray], np.ndarray]:
        try:
            import DracoPy
        except ImportError:
            raise ValueError("it requires Draco compression: install the package DracoPy") from None
        view = self.tree["bufferViews"][int(stated["bufferView"])]
        mesh = DracoPy.decode(self.joined[view["byteOffset"] :][: view["byteLength"]])
        points = np.asarray(mesh.points, np.float64).reshape(-1, 3)
        found = {"POSITION": points, "NORMAL": mesh.normals, "TEXCOORD_0": mesh.tex_coord, "COLOR_0": mesh.colors}
        out = {}
        for key, values in found.items():
            if values is not None and len(values) == len(points):
                divisor = np.iinfo(values.dtype).max if np.asarray(values).dtype.kind == "u" else 1
                out[key] = np.asarray(values, np.float64).reshape(len(points), -1) / divisor
        return out, np.asarray(mesh.faces, np.int64).reshape(-1)

    def surface(self, number: int | None) -> Surface:
        if number not in self.surfaces:
            self.surfaces[number] = (
                Surface() if number is None else self._surface(self.tree["materials"][int(number)], int(number))
            )
        return self.surfaces[number]

    def _surface(self, stated: dict[str, Any], number: int) -> Surface:
        name = str(stated.get("name") or f"material {number}")[:80]
        base, extensions = stated.get("pbrMetallicRoughness", {}), stated.get("extensions", {})
        surface = Surface(
            name,
            self.colour(base.get("baseColorFactor", [1, 1, 1])[:3], name, "base colour"),
            float(np.clip(base.get("metallicFactor", 1.0), 0, 1)),
            float(np.clip(base.get("roughnessFactor", 1.0), 0, 1)),
        )
        older = extensions.get("KHR_materials_pbrSpecularGlossiness")
        colour_texture = base.get("baseColorTexture")
        if older is not None and not base:
            surface.colour = self.colour(older.get("diffuseFactor", [1, 1, 1])[:3], name, "diffuse colour")
            surface.dielectric = self.colour(older.get("specularFactor", [1, 1, 1]), name, "specular colour")
            surface.metallic, surface.roughness = 0.0, float(1 - np.clip(older.get("glossinessFactor", 1.0), 0, 1))
            colour_texture = older.get("diffuseTexture")
        index_of_refraction = float(extensions.get("KHR_materials_ior", {}).get("ior", 1.5))
        specular = extensions.get("KHR_materials_specular", {})
        if "KHR_materials_ior" in extensions or specular:
            reflectance = ((index_of_refraction - 1) / (index_of_refraction + 1)) ** 2 if index_of_refraction else 1.0
            tint = np.asarray(specular.get("specularColorFactor", [1, 1, 1]), np.float64)
            surface.dielectric = np.clip(reflectance * tint, 0, 1) * float(specular.get("specularFactor", 1.0))
        strength = float(extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0))
        emission = np.asarray(stated.get("emissiveFactor", [0, 0, 0]), np.float64) * strength
        if emission.shape != (3,) or not np.isfinite(emission).all() or (emission < 0).any():
            raise ValueError(f"material {name!r} has an emission of {emission.tolist()}")
        surface.emission = emission
        textures = {"colour": colour_texture, "metal_rough": base.get("metallicRoughnessTexture")}
        if surface.emits:
            textures["emission"] = stated.get("emissiveTexture")
        for use, texture in textures.items():
            if texture is not None:
                found = colours.gltf_texture(self.tree, texture, self.joined, self.folder, self.folder, MAX_BYTES, self.images)
                if found[0] is not None:
                    surface.textures[use] = Texture(*found)
        self._say_replaced(stated, name)
        return surface

    def _say_replaced(self, stated: dict[str, Any], name: str) -> None:
        extensions = stated.get("extensions", {})
        said = [text for extension, text in REPLACED.items() if extensions.get(extension) is not None]
        if stated.get("alphaMode", "OPAQUE") != "OPAQUE":
            said.append("it is see-through in places: it is opaque here")
        if "normalTexture" in stated:
            said.append("its normal map is left out")
        self.notes += [f"material {name!r}: {text}" for text in said]

    def colour(self, factor: Any, name: str, what: str) -> np.ndarray:
        values = np.asarray(factor, np.float64)
        if values.shape != (3,) or not np.isfinite(values).all():
            raise ValueError(f"material {name!r} has a {what} of {factor!r}")
        if (values > 1).any() or (values < 0).any():
            self.notes.append(f"material {name!r}: its {what} {np.round(values, 3).tolist()} is cut to 0 .. 1")
        return values.clip(0, 1)

    def lamp(self, name: str, stated: dict[str, Any], to_world: np.ndarray) -> Lamp:
        kind, colour = stated["type"], np.asarray(stated.get("color", [1, 1, 1]), np.float64)
        if kind not in ("point", "spot", "directional"):
            raise ValueError(f"light {name!r} is of the unknown kind {kind!r}")
        strength = float(stated.get("intensity", 1.0)) / LUMENS_PER_WATT
        if colour.shape != (3,) or not np.isfinite([*colour, strength]).all() or min(*colour, strength) < 0:
            raise ValueError(f"light {name!r} has a colour or intensity that is none")
        if "range" in stated:
            self.notes.append(f"light {name!r} ends at a distance of {float(stated['range']):g} in the file: here it does not")
        spot = stated.get("spot", {})
        cone = float(spot.get("innerConeAngle", 0.0)), float(spot.get("outerConeAngle", np.pi / 4))
        direction = -to_world[:3, 2] / max(float(np.linalg.norm(to_world[:3, 2])), 1e-300)
        return Lamp(name, kind, colour, strength, to_world[:3, 3], direction, cone)

    def viewpoint(self, name: str, stated: dict[str, Any], to_world: np.ndarray) -> Viewpoint:
        pose = rigid(to_world)
        if stated.get("type") == "orthographic":
            lens = stated["orthographic"]
            return Viewpoint(name, pose, 0.0, float(lens["xmag"]) / float(lens["ymag"]), 2 * float(lens["ymag"]))
        lens = stated["perspective"]
        fov = float(np.degrees(float(lens["yfov"])))
        if not 0 < fov < 180:
            raise ValueError(f"camera {name!r} has a field of view of {fov:g} degrees")
        return Viewpoint(name, pose, fov, float(lens.get("aspectRatio", 1.0)))


def _transform(node: dict[str, Any]) -> np.ndarray:
    """(4, 4) of a node, to its parent."""
    if "matrix" in node:
        return np.asarray(node["matrix"], np.float64).reshape(4, 4).T
    from scipy.spatial.transform import Rotation

    out = np.eye(4)
    turn = np.asarray(node.get("rotation", [0, 0, 0, 1]), np.float64)  # x, y, z, w
    turn = Rotation.from_quat(turn if np.linalg.norm(turn) > 0 else [0, 0, 0, 1]).as_matrix()
    out[:3, :3] = turn * np.asarray(node.get("scale", [1, 1, 1]), np.float64)
    out[:3, 3] = node.get("translation", [0, 0, 0])
    if not np.isfinite(out).all():
        raise ValueError(f"node {node.get('name', '')!r} has a transform that is not finite")
    return out


def _triangles(mode: int, index: np.ndarray) -> np.ndarray:
    """(F, 3) of a list, strip or fan of corner indices."""
    if mode == 4:
        return index[: len(index) // 3 * 3].reshape(-1, 3)
    if len(index) < 3:
        return np.zeros((0, 3), np.int64)
    if mode == 6:
        return np.stack([np.full(len(index) - 2, index[0]), index[1:-1], index[2:]], axis=1)
    faces = np.stack([index[:-2], index[1:-1], index[2:]], axis=1)
    faces[1::2] = faces[1::2][:, [1, 0, 2]]
    return faces


DTYPES = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def read_accessor(tree: dict[str, Any], joined: bytes, number: int) -> np.ndarray:
    """(N, n) float64 values: strides, normalised integers and sparse changes as the specification says."""
    accessor = tree["accessors"][number]
    count, width, dtype = int(accessor["count"]), COMPONENTS[accessor["type"]], np.dtype(DTYPES[accessor["componentType"]])

    def table(view: dict[str, Any], offset: int, rows: int, dtype: np.dtype, width: int) -> np.ndarray:
        size = dtype.itemsize * width
        stride, start = view.get("byteStride", size), view.get("byteOffset", 0) + offset
        if rows and offset + stride * (rows - 1) + size > view["byteLength"]:
            raise ValueError(f"accessor {number} reads past the end of its buffer view")
        data = np.frombuffer(joined, np.uint8)
        return np.ndarray((rows, width), dtype.newbyteorder("<"), data, start, (stride, dtype.itemsize)).copy()

    values = np.zeros((count, width), dtype)
    if "bufferView" in accessor:
        values = table(tree["bufferViews"][accessor["bufferView"]], accessor.get("byteOffset", 0), count, dtype, width)
    if "sparse" in accessor:
        sparse = accessor["sparse"]
        where, what = sparse["indices"], sparse["values"]
        view = tree["bufferViews"][where["bufferView"]]
        rows = table(view, where.get("byteOffset", 0), sparse["count"], np.dtype(DTYPES[where["componentType"]]), 1)[:, 0]
        view = tree["bufferViews"][what["bufferView"]]
        values[rows.astype(np.int64)] = table(view, what.get("byteOffset", 0), sparse["count"], dtype, width)
    values = values.astype(np.float64)
    if accessor.get("normalized") and dtype.kind in "iu":
        values = np.maximum(values / np.iinfo(dtype).max, -1.0)
    return values
