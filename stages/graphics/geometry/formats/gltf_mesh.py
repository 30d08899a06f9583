"""The triangles of a glTF file's scene, each primitive in its place with its colours."""

from __future__ import annotations

from typing import Any

import numpy as np

from stages.graphics.geometry.colours import Material
from stages.graphics.geometry.formats import gltf_materials
from stages.graphics.geometry.formats.gltf import Gltf, Primitive
from stages.graphics.geometry.formats.json_values import integer
from stages.graphics.geometry.formats.parts import Part, Source, checked_part


def read(data: bytes, source: Source) -> list[Part]:
    """The triangles of the file's scene, one part for each placed primitive."""
    gltf = Gltf(data, source)
    source.about |= about(gltf.tree)
    materials = gltf_materials.read(gltf, source) if source.images is not None else []
    meshes: dict[int, list[Primitive]] = {}
    parts = []
    for index, matrix in gltf.placements():
        node = gltf.entry("nodes", index)
        if "mesh" not in node:
            continue
        mesh = integer(node, "mesh")
        if mesh not in meshes:
            meshes[mesh] = gltf.primitives(mesh)
        for primitive in meshes[mesh]:
            if len(primitive.triangles):
                parts.append(_part(primitive, matrix, materials, source))
    return parts


def _part(primitive: Primitive, matrix: np.ndarray, materials: list[tuple[Material, int]], source: Source) -> Part:
    """A primitive in its place; a mirrored one with its triangles turned, so that they stay outward."""
    part = checked_part(primitive.points, primitive.triangles, primitive.vertex_place, primitive.triangle_place)
    with np.errstate(invalid="ignore", over="ignore"):
        points = part.points @ matrix[:3, :3].T + matrix[:3, 3]
    triangles = part.triangles
    if np.linalg.det(matrix[:3, :3]) < 0:
        triangles = triangles[:, ::-1]
    part = checked_part(points, triangles, primitive.vertex_place, primitive.triangle_place)
    if source.images is not None:
        part.look = gltf_materials.look(primitive, part.triangles, materials, source)
    return part


def about(tree: dict[str, Any]) -> dict[str, str]:
    """Licence and origin as the common exporters write them: asset.copyright, and asset.extras of Sketchfab."""
    asset = tree.get("asset")
    asset = asset if isinstance(asset, dict) else {}
    extras = asset.get("extras", {}) if isinstance(asset.get("extras"), dict) else {}
    licence = extras.get("license") or asset.get("copyright") or ""
    origin = extras.get("source") or ""
    return {name: str(value)[:300] for name, value in (("licence", licence), ("origin", origin)) if value}
