"""A mesh file as checked arrays: everything that a stranger's file can get wrong is settled here, before native code
runs.

Reads one file and, for glTF, the buffers beside it, never anything outside the given root. The readers are those of
``stages.graphics.geometry.formats``; what they or a library raise becomes a Reject that names the file and the place. Base
colours come along when they are asked for (``stages.graphics.geometry.colours``) and never cost a mesh.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from model.file_kinds import failed_download
from pipeline.errors import Reject
from stages.graphics.geometry import colours
from stages.graphics.geometry.formats import dae, gltf_mesh, obj, off, ply, stl, threemf, usd
from stages.graphics.geometry.formats.faults import at
from stages.graphics.geometry.formats.parts import Part, Source
from stages.graphics.geometry.measure import normal_vectors
from stages.graphics.geometry.paths import check_path, inside
from stages.graphics.geometry.records import TextureRecord

READERS: dict[str, Callable[[bytes, Source], list[Part]]] = {
    ".glb": gltf_mesh.read,
    ".gltf": gltf_mesh.read,
    ".obj": obj.read,
    ".off": off.read,
    ".ply": ply.read,
    ".stl": stl.read,
}
PLAIN = tuple(READERS)  # of these a scene file may name some
READERS |= {".3mf": threemf.read, ".dae": dae.read} | dict.fromkeys(usd.SUFFIXES, usd.read)
SUFFIXES = tuple(READERS)  # what is looked for in a folder
# What is not read, and the export to choose in the program that wrote it.
EXPORTS = {
    ".fbx": "export glTF (.glb) instead, in Blender: File > Export > glTF 2.0",
    ".blend": "open it in Blender, and choose File > Export > glTF 2.0 (.glb), with cameras and punctual lights for a scene",
    ".max": "export glTF (.glb) or USD instead",
    ".ma": "export glTF (.glb) or USD instead",
    ".mb": "export glTF (.glb) or USD instead",
    ".3ds": "export glTF (.glb) or OBJ instead",
    ".abc": "export USD or glTF (.glb) instead",
    ".step": "export STL or glTF (.glb) instead",
    ".stp": "export STL or glTF (.glb) instead",
}
LARGEST = 1e12  # of a coordinate, in the file's own units: beyond, squares of lengths leave the range of float32
SMALLEST = 1e-12  # of the longest side
DIGITS = 1e-6  # longest side, of the largest coordinate: below, a float32 file has less than one digit left for the shape
THINNEST = 1e-6  # area, of the squared longest side: below, float32 cannot hold the thickness beside the length


@dataclass
class Loaded:
    """vertices (V, 3) float64 and faces (F, 3) int64 in the file's units and axes; scene graph flattened, parts
    concatenated."""

    vertices: np.ndarray
    faces: np.ndarray
    parts: int = 1
    about: dict[str, str] = field(default_factory=dict)  # origin and licence where the file states them
    texture: TextureRecord | None = None  # base colours, if they were asked for and there are any; without an id
    notes: list[str] = field(default_factory=list)  # what of the colours could not be had, and why


def load_mesh(path: Path, root: Path, max_bytes: int, max_faces: int, textures: bool = False) -> Loaded:
    """The checked mesh of a file inside ``root``; raises Reject with a reason of *collect*.

    ``textures``: with its base colours. The mesh is the same with and without.
    """
    source = Source(Path(path), Path(root), max_bytes, max_faces, colours.Images() if textures else None)
    parts = read_parts(source)
    with at(source.path.name):
        for name in source.references:  # a file that names one outside its folder is not to be trusted
            check_path(name, source.folder, source.root)
        if not parts:
            raise Reject("no_faces", "no part of it has a triangle")
        parts.sort(key=Part.content)
        starts = np.cumsum([0, *(len(part.points) for part in parts[:-1])])
        faces = np.concatenate([part.triangles + start for part, start in zip(parts, starts, strict=True)])
        vertices, faces, kept = _settled(np.concatenate([part.points for part in parts]), faces, max_faces)
    loaded = Loaded(vertices, faces, len(parts), source.about, notes=source.notes)
    if textures:
        loaded.texture = colours.texture_record([(part.look, len(part.triangles)) for part in parts], kept)
    return loaded


def read_parts(source: Source) -> list[Part]:
    """The parts of a mesh file in the order of its reader, each with indices in range and finite vertices; or a Reject.

    A vertex may be unused, and a triangle without area.
    """
    path = source.path
    with at(path.name):
        if not inside(path, source.root):
            raise Reject("unsafe_path", "it leads outside the folder")
        if not path.is_file():
            raise Reject("unreadable", "it is not a regular file")
        if path.suffix.lower() not in READERS:
            raise Reject("unsupported", f"no kind of mesh file that is read ({', '.join(SUFFIXES)})")
        size = path.stat().st_size
        if size > source.max_bytes:
            raise Reject("too_large", f"{size} bytes, at most {source.max_bytes} are read")
        data = path.read_bytes()
        if (failed := failed_download(data)) is not None:
            raise Reject("unreadable", f"it {failed}")
        return [part for part in READERS[path.suffix.lower()](data, source) if len(part.triangles)]


def checked(vertices: np.ndarray, faces: np.ndarray, max_faces: int) -> tuple[np.ndarray, np.ndarray]:
    """The mesh without unused vertices and zero-area triangles, or a Reject: safe for native code afterwards."""
    return _settled(vertices, faces, max_faces)[:2]


def _settled(vertices: np.ndarray, faces: np.ndarray, max_faces: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``checked``, and the indices of the faces that are left."""
    if len(faces) == 0 or len(vertices) == 0:
        raise Reject("no_faces", f"{len(vertices)} vertices, {len(faces)} faces")
    if len(faces) > max_faces:
        raise Reject("too_large", f"{len(faces)} faces, at most {max_faces} are taken")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise Reject("bad_indices", f"indices {faces.min()}..{faces.max()} for {len(vertices)} vertices")
    used, faces = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], faces.reshape(-1, 3)
    if not np.isfinite(vertices).all():
        raise Reject("not_finite", f"{int((~np.isfinite(vertices)).any(axis=1).sum())} vertices")
    largest = float(np.abs(vertices).max())
    if largest > LARGEST:
        raise Reject("too_large_extent", f"coordinates up to {largest:.3g}, at most {LARGEST:.0e} are taken: scale it down")
    extent = float(np.ptp(vertices, axis=0).max())
    if extent < SMALLEST:
        raise Reject("degenerate", f"the longest side is {extent:.3g}, at least {SMALLEST:.0e} is taken: scale it up")
    if extent < DIGITS * largest:
        raise Reject("degenerate", f"the longest side is {extent:.3g} at coordinates of {largest:.3g}: move it to the origin")
    corners = (vertices / extent)[faces]
    double_area = np.linalg.norm(normal_vectors(corners), axis=1)
    solid = double_area > 1e-14
    area = float(double_area.sum()) / 2
    if not solid.any():
        raise Reject("degenerate", "no triangle of it has an area: all points of each lie on one line")
    if area < THINNEST:
        raise Reject("too_thin", f"its area is {area:.3g} of its squared longest side, at least {THINNEST:.0e} is taken")
    used, faces = np.unique(faces[solid], return_inverse=True)
    return vertices[used], faces.reshape(-1, 3), np.flatnonzero(solid)


def normalise(vertices: np.ndarray) -> np.ndarray:
    """Bounding box centred on the origin, longest side 1; computed in float64, rounded once to float32."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return ((vertices - (low + high) / 2) / (high - low).max()).astype(np.float32)
