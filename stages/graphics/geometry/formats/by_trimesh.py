"""Formats that trimesh reads by packages that are optional: 3MF by lxml, Collada by pycollada. Geometry alone, from memory."""

from __future__ import annotations

import importlib.util
import io
import zipfile

import numpy as np

from pipeline.errors import Reject
from stages.graphics.geometry.formats.parts import Part, Source, checked_part

PACKAGES = {".3mf": ("lxml", "lxml"), ".dae": ("pycollada", "collada")}  # suffix -> the package, and what it is imported as
MAX_UNPACKED = 100  # bytes of an archive's content for each of its own


class _NoFiles:
    """A resolver that has no file: what trimesh asks for here is never geometry."""

    def get(self, name: str) -> bytes:
        raise FileNotFoundError(name)

    __getitem__ = get

    def keys(self) -> list[str]:
        return []

    def namespaced(self, namespace: str) -> _NoFiles:
        return self


def read(data: bytes, source: Source) -> list[Part]:
    """The triangles of the file's scene."""
    kind = source.path.suffix.lower()
    package, module = PACKAGES[kind]
    if importlib.util.find_spec(module) is None:
        raise Reject("needs_package", f"{kind} files need the package {package}: pip install {package}")
    if kind == ".3mf":
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            unpacked = sum(entry.file_size for entry in archive.infolist())
        if unpacked > MAX_UNPACKED * len(data):
            raise Reject("too_large", f"an archive of {len(data):,} bytes that states {unpacked:,}")
    import trimesh

    scene = trimesh.load_scene(io.BytesIO(data), file_type=kind[1:], process=False, resolver=_NoFiles())
    parts = []
    for name in scene.graph.nodes_geometry:
        matrix, geometry = scene.graph[name]
        mesh = scene.geometry[geometry]
        if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
            continue
        triangles, place = np.asarray(mesh.faces, np.int64), str(geometry)[:60]
        if np.linalg.det(matrix[:3, :3]) < 0:
            triangles = triangles[:, ::-1]
        points = np.asarray(mesh.vertices, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        parts.append(checked_part(points, triangles, f"{place}: vertex {{}}".format, f"{place}: triangle {{}}".format))
    if sum(len(part.triangles) for part in parts) > source.max_faces:
        raise Reject("too_large", f"over {source.max_faces} faces")
    return parts
