"""Every mesh file at hand, by our readers and by other people's: pymeshlab, and trimesh for glTF.

Compared are the positions that triangles with an area use, the sides of the bounding box, area and volume. Files that the other
reader cannot read, or reads otherwise, are listed with the reason.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import Reject
from stages.graphics.geometry import load, measure

Mesh = tuple[np.ndarray, np.ndarray]

EXPLAINED = {  # what the other reader does otherwise
    "cr-line-ends.ply": "cannot read it: lines of the header end with CR",
    "leading-blank.off": "cannot read it: counts in the line of the word OFF",
    "comments.off": "cannot read it: comments before the header",
    "faces-across-lines.off": "crashes: faces go on in the next line",
    "ngons.off": "turns a hexagon inside out: its volume is half of the prism's",
    "wallhole.obj": "leaves out polygons of eight corners, some of them in one line",
    "quantised-beside-float.glb": "does not divide normalised integers",
    "sparse-changes.glb": "does not apply the changes of a sparse accessor",
    "sparse-only.glb": "does not apply the changes of a sparse accessor",
}  # fmt: skip
CRASHES = {"faces-across-lines.off"}  # a segmentation fault of pymeshlab, which would end the tests


def by_pymeshlab(path: Path) -> Mesh:
    import pymeshlab

    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.load_new_mesh(str(path))
    parts = [meshes.mesh(index) for index in range(meshes.mesh_number())]
    return joined([(part.vertex_matrix(), part.face_matrix()) for part in parts])


def by_trimesh(path: Path) -> Mesh:
    import trimesh

    scene = trimesh.load_scene(path, process=False)
    scene.graph.repair_rigid = None
    mesh = scene.to_mesh()
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def joined(parts: list[Mesh]) -> Mesh:
    starts = np.cumsum([0, *(len(points) for points, _ in parts)])
    faces = [triangles + start for (_, triangles), start in zip(parts, starts[:-1], strict=True)]
    return np.concatenate([points for points, _ in parts]), np.concatenate(faces)


def measures(mesh: Mesh) -> dict[str, np.ndarray]:
    """Of the triangles with an area: how many positions they use, to a millionth of the size; sides; area; volume."""
    corners = np.asarray(mesh[0], np.float64)[mesh[1]]
    corners = corners / np.ptp(corners.reshape(-1, 3), axis=0).max()
    corners = corners[np.linalg.norm(measure.normal_vectors(corners), axis=1) > 1e-14]
    used = corners.reshape(-1, 3)
    used = (used - used.min(axis=0)) / np.ptp(used, axis=0).max()
    normals = measure.normal_vectors(used.reshape(-1, 3, 3))
    return {
        "vertices": np.array(len(np.unique(used.round(6), axis=0))),
        "sides": np.ptp(used, axis=0),
        "area": np.linalg.norm(normals, axis=1).sum() / 2,
        "volume": ((used[::3] - used.mean(axis=0)) * normals).sum() / 6,
    }


@pytest.mark.slow
def test_other_readers_see_the_same(shared_data: Path) -> None:
    """In every file below the sample data; what is written in tests/graphics/habits.py, no other reader reads whole."""
    differences, compared = {}, 0
    paths = (path for path in sorted(shared_data.rglob("*")) if path.suffix.lower() in load.SUFFIXES)
    for path in paths:
        try:
            ours = load.load_mesh(path, path.parent, 1 << 28, 4_000_000)
        except Reject:
            continue
        if path.name in CRASHES:
            differences[path.name] = "crashes"
            continue
        other = by_trimesh if path.suffix.lower() in (".glb", ".gltf") else by_pymeshlab
        try:
            found, theirs = measures((ours.vertices, ours.faces)), measures(other(path))
        except Exception as error:
            differences[path.name] = f"{other.__name__} cannot read it: {str(error)[:200]}"
            continue
        compared += 1
        wrong = [name for name in found if not np.allclose(found[name], theirs[name], rtol=1e-4, atol=1e-5)]
        if wrong:
            differences[path.name] = "; ".join(f"{name}: {found[name]}, {other.__name__} {theirs[name]}" for name in wrong)
    assert set(differences) == set(EXPLAINED), differences
    assert compared > 100
