"""Every mesh file at hand, by our readers and by other people's: pymeshlab, and trimesh for glTF.

Compared are the positions that triangles with an area use, the sides of the bounding box, area and volume. Files that the other
reader cannot read, or reads otherwise, are listed with the reason.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.errors import Reject
from stages.graphics.geometry import load
from tests.graphics.habits import HABITS

Mesh = tuple[np.ndarray, np.ndarray]

EXPLAINED: dict[str, str] = {
}  # fmt: skip


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
    """vertices: how many positions, to a millionth of the size, triangles with an area use; sides; area; volume."""
    corners = np.asarray(mesh[0], np.float64)[mesh[1]]
    corners = corners / np.ptp(corners.reshape(-1, 3), axis=0).max()
    first, a, b = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(a, b)
    solid = np.linalg.norm(normal, axis=1) > 1e-14
    used = corners[solid].reshape(-1, 3)
    return {
        "vertices": np.array(len(np.unique((used - used.min(axis=0)).round(6), axis=0))),
        "sides": np.ptp(used, axis=0),
        "area": np.linalg.norm(normal, axis=1).sum() / 2,
        "volume": ((first - used.mean(axis=0)) * normal)[solid].sum() / 6,
    }


def files(shared_data: Path, tmp_path: Path) -> list[Path]:
    for name, data in HABITS.items():
        (tmp_path / name).write_bytes(data)
    roots = [shared_data / name for name in ("meshes", "scenes", "cases")] + [tmp_path]
    return sorted(path for root in roots for path in root.rglob("*") if path.suffix.lower() in load.SUFFIXES)


def test_other_readers_see_the_same(shared_data: Path, tmp_path: Path) -> None:
    differences: dict[str, str] = {}
    compared = 0
    for path in files(shared_data, tmp_path):
        try:
            ours = load.load_mesh(path, path.parent, 1 << 28, 4_000_000)
        except Reject:
            continue
        other = by_trimesh if path.suffix.lower() in (".glb", ".gltf") else by_pymeshlab
        try:
            theirs = measures(other(path))
        except Exception as error:
            differences[path.name] = f"{other.__name__} cannot read it: {str(error)[:60]}"
            continue
        found = measures((ours.vertices, ours.faces))
        wrong = [name for name in found if not np.allclose(found[name], theirs[name], rtol=1e-4, atol=1e-5)]
        compared += 1
        if wrong:
            differences[path.name] = "; ".join(f"{name}: {found[name]}, {other.__name__} {theirs[name]}" for name in wrong)
    print(compared)
    assert differences == {}
