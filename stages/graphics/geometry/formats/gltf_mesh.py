"""The triangles of a glTF file's scene, each primitive in its place with its colours."""

from __future__ import annotations

from typing import Any

from stages.graphics.geometry.formats import gltf_materials
from stages.graphics.geometry.formats.gltf import Gltf, Primitive
from stages.graphics.geometry.formats.gltf_pose import Poses
from stages.graphics.geometry.formats.json_values import integer
from stages.graphics.geometry.formats.parts import Part, Source


def read(data: bytes, source: Source) -> list[Part]:
    """The triangles of the file's scene, one part for each placed primitive."""
    gltf = Gltf(data, source)
    source.about |= about(gltf.tree)
    materials = gltf_materials.read(gltf, source) if source.images is not None else []
    poses = Poses(gltf, source)
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
            if not len(primitive.triangles):
                continue
            for placed in poses.placed(index, matrix, primitive):
                if source.images is not None:
                    placed.part.look = gltf_materials.look(primitive, placed.part.triangles, materials, source)
                parts.append(placed.part)
    return parts


def about(tree: dict[str, Any]) -> dict[str, str]:
    """Licence and origin as the common exporters write them: asset.copyright, and asset.extras of Sketchfab."""
    asset = tree.get("asset")
    asset = asset if isinstance(asset, dict) else {}
    extras = asset.get("extras", {}) if isinstance(asset.get("extras"), dict) else {}
    licence = extras.get("license") or asset.get("copyright") or ""
    origin = extras.get("source") or ""
    return {name: str(value)[:300] for name, value in (("licence", licence), ("origin", origin)) if value}
