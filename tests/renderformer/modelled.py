"""A small glTF scene as Blender exports one: y up, metres, nodes with transforms, punctual lights in candela and lux."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

WATT = 683 / (4 * np.pi)  # candela per watt of a point light, as Blender writes it


class Gltf:
    """A glTF tree in the making, and its buffer."""

    def __init__(self) -> None:
        self.tree: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "Khronos glTF Blender I/O v4.2.70"},
            "scene": 0, "scenes": [{"name": "Scene", "nodes": []}],
            "extensionsUsed": ["KHR_lights_punctual", "KHR_materials_emissive_strength"],
            "extensions": {"KHR_lights_punctual": {"lights": []}},
            "nodes": [], "meshes": [], "accessors": [], "bufferViews": [], "materials": [], "cameras": [],
        }  # fmt: skip
        self.data = bytearray()

    def view(self, data: bytes) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        self.tree["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)})
        self.data += data
        return len(self.tree["bufferViews"]) - 1

    def accessor(self, values: np.ndarray) -> int:
        kind = {np.dtype(np.float32): 5126, np.dtype(np.uint16): 5123}[values.dtype]
        shape = {1: "SCALAR", 2: "VEC2", 3: "VEC3"}[1 if values.ndim == 1 else values.shape[1]]
        entry = {"bufferView": self.view(values.tobytes()), "componentType": kind, "count": len(values), "type": shape}
        self.tree["accessors"].append(entry)
        return len(self.tree["accessors"]) - 1

    def material(self, name: str, **fields: Any) -> int:
        self.tree["materials"].append({"name": name, "doubleSided": True, **fields})
        return len(self.tree["materials"]) - 1

    def mesh(self, name: str, mesh: trimesh.Trimesh, material: int, smooth: bool = False, uv: np.ndarray | None = None) -> int:
        if smooth:
            points, faces, normals = mesh.vertices, mesh.faces, mesh.vertex_normals
        else:  # flat: every face has corners of its own
            points, faces = mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3)
            normals = np.repeat(mesh.face_normals, 3, axis=0)
        attributes = {"POSITION": self.accessor(np.float32(points)), "NORMAL": self.accessor(np.float32(normals))}
        if uv is not None:
            attributes["TEXCOORD_0"] = self.accessor(np.float32(uv))
        primitive = {"attributes": attributes, "indices": self.accessor(np.uint16(faces.ravel())), "material": material}
        self.tree["meshes"].append({"name": name, "primitives": [primitive]})
        return len(self.tree["meshes"]) - 1

    def node(self, name: str, parent: int | None = None, **fields: Any) -> int:
        self.tree["nodes"].append({"name": name, **fields})
        number = len(self.tree["nodes"]) - 1
        above = self.tree["scenes"][0]["nodes"] if parent is None else self.tree["nodes"][parent].setdefault("children", [])
        above.append(number)
        return number

    def light(self, name: str, kind: str, intensity: float, parent: int | None = None, spot: Any = None, **fields: Any) -> int:
        lights = self.tree["extensions"]["KHR_lights_punctual"]["lights"]
        lights.append(
            {"name": name, "type": kind, "intensity": intensity, "color": [1, 1, 1]} | ({"spot": spot} if spot else {})
        )
        extensions = {"KHR_lights_punctual": {"light": len(lights) - 1}}
        return self.node(name, parent, extensions=extensions, **fields)

    def camera(self, name: str, yfov: float, aspect: float, **fields: Any) -> int:
        lens = {"yfov": yfov, "aspectRatio": aspect, "znear": 0.1, "zfar": 100}
        self.tree["cameras"].append({"name": name, "type": "perspective", "perspective": lens})
        return self.node(name, camera=len(self.tree["cameras"]) - 1, **fields)

    def write(self, path: Path) -> Path:
        tree = {**self.tree, "buffers": [{"byteLength": len(self.data)}]}
        text = json.dumps({name: value for name, value in tree.items() if value != []}).encode()
        text += b" " * (-len(text) % 4)
        data = bytes(self.data) + b"\0" * (-len(self.data) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(data), 0x004E4942) + data
        path.write_bytes(struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks)
        return path


def looking(position: Any, target: Any) -> dict[str, list[float]]:
    """translation and rotation of a camera or light that looks from one point to another."""
    back = np.subtract(position, target).astype(float)
    back /= np.linalg.norm(back)
    right = np.cross([0, 1, 0], back)
    right /= np.linalg.norm(right)
    turn = Rotation.from_matrix(np.stack([right, np.cross(back, right), back], axis=1)).as_quat()
    return {"translation": [float(x) for x in position], "rotation": turn.tolist()}


def studio() -> Gltf:
    """A floor, a red cube and a smooth metal sphere; a point light and a spot light; a camera of 16:9.

    Y is up, one unit a metre, the floor is 6 m wide. The cube hangs from an empty node that moves and scales it.
    """
    gltf = Gltf()
    checks = np.kron(np.indices((8, 8)).sum(axis=0) % 2, np.ones((8, 8))).astype(np.uint8)
    picture = np.where(checks[..., None] == 1, np.uint8([200, 190, 170]), np.uint8([90, 100, 120])).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(picture).save(file, format="png")
    gltf.tree["images"] = [{"bufferView": gltf.view(file.getvalue()), "mimeType": "image/png"}]
    gltf.tree["textures"] = [{"source": 0}]
    checked = {"baseColorTexture": {"index": 0}, "metallicFactor": 0, "roughnessFactor": 0.8}
    tiles = gltf.material("Tiles", pbrMetallicRoughness=checked)
    red = gltf.material(
        "Red", pbrMetallicRoughness={"baseColorFactor": [0.8, 0.05, 0.03, 1], "metallicFactor": 0, "roughnessFactor": 0.5}
    )
    metal = gltf.material(
        "Metal", pbrMetallicRoughness={"baseColorFactor": [0.9, 0.8, 0.5, 1], "metallicFactor": 1, "roughnessFactor": 0.3}
    )
    corners = np.array([[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]], float)
    plane = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    uv = np.array([[0, 0], [0, 1], [1, 1], [1, 0]], float)[plane.faces].reshape(-1, 2)
    cube, sphere = trimesh.creation.box((1, 1, 1)), trimesh.creation.icosphere(3, 0.7)
    gltf.node("Floor", mesh=gltf.mesh("Plane", plane, tiles, uv=uv), scale=[3, 1, 3])
    empty = gltf.node("Empty", translation=[-1, 0, 0.3], scale=[1.2, 1.2, 1.2])
    turn = Rotation.from_euler("y", 30, degrees=True).as_quat().tolist()
    gltf.node("Cube", empty, mesh=gltf.mesh("Cube", cube, red), translation=[0, 0.5, 0], rotation=turn)
    gltf.node("Ball", mesh=gltf.mesh("Sphere", sphere, metal, smooth=True), translation=[1, 0.7, 0])
    gltf.light("Lamp", "point", 500 * WATT, translation=[2, 4, 2])
    cone = {"innerConeAngle": 0.3, "outerConeAngle": 0.5}
    gltf.light("Spot", "spot", 400 * WATT, spot=cone, **looking([-3, 4, 2], [-1, 0.6, 0.3]))
    gltf.camera("Camera", 0.6, 16 / 9, **looking([3, 3.2, 7], [0, 0.6, 0]))
    return gltf
