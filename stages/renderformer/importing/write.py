"""A scene record as a file in a released format: HDF5 as it is, JSON with its meshes in a folder beside it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.atomic import write_atomic
from pipeline.errors import UserError
from stages.graphics.geometry.measure import face_normals
from stages.renderformer.dataset.interchange import write_hdf5
from stages.renderformer.records import SceneRecord

FORMATS = (".json", ".h5", ".hdf5")
MOST_MATERIALS = 16  # of one object in JSON, each a mesh of its own; with more it gets their mean
MATERIAL = ("diffuse", "specular", "roughness", "emission")


def check_out(path: Path) -> None:
    """UserError unless a scene can be written there."""
    if path.suffix.lower() not in FORMATS:
        raise UserError(f"{path}: the scene's file must end in {', '.join(FORMATS)}")
    if not path.parent.is_dir():
        raise UserError(f"the folder {path.parent} does not exist: make it first")


def write_scene(path: Path, scene: SceneRecord) -> list[str]:
    """Write the scene. Returns what of it the format could not take, a sentence each."""
    check_out(path)
    if path.suffix.lower() == ".json":
        return _write_json(path, scene)
    write_hdf5(path, scene)
    return []


def _write_json(path: Path, scene: SceneRecord) -> list[str]:
    notes, objects = [], {}
    folder = path.with_name(f"{path.stem}-meshes")
    folder.mkdir(exist_ok=True)
    look = np.hstack([np.reshape(getattr(scene, name), (len(scene.triangles), -1)) for name in MATERIAL])
    for number, described in enumerate(scene.meta["objects"]):
        rows = np.flatnonzero(scene.object_index == number)
        groups = np.unique(np.round(look[rows], 4), axis=0, return_inverse=True)[1].reshape(-1)
        if groups.max() >= MOST_MATERIALS:
            notes.append(
                f"{described['name']!r} has {groups.max() + 1:,} materials, JSON has one for each mesh: it gets their mean "
                "(.h5 keeps all)"
            )
            groups = np.zeros_like(groups)
        smooth = (np.einsum("fci,fi->fc", scene.vertex_normals[rows], face_normals(scene.triangles[rows])) < 1 - 1e-4).any()
        for group in range(groups.max() + 1):
            faces = rows[groups == group]
            name = f"{number}-{group}"
            write_atomic(folder / f"{name}.obj", _obj(scene.triangles[faces]))
            objects[f"{name} {described['name']}"] = {
                "mesh_path": f"{folder.name}/{name}.obj",
                "material": _material(look[faces].mean(axis=0), bool(smooth)),
                "transform": {"translation": [0, 0, 0], "rotation": [0, 0, 0], "scale": [1, 1, 1], "normalize": False},
                "remesh": False,
                "remesh_target_face_num": len(faces),
            }
        if smooth:
            notes.append(
                f"{described['name']!r} is shaded smoothly, but for creases of 30 degrees (.h5 keeps the file's normals)"
            )
    aspects = scene.meta.get("aspect", [1.0] * len(scene.fov_deg))
    cameras = [_camera(*camera) for camera in zip(scene.camera_to_world, scene.fov_deg, aspects, strict=True)]
    data = {"scene_name": scene.id, "version": "1.0", "objects": objects, "cameras": cameras}
    write_atomic(path, json.dumps(data, indent=1).encode())
    return notes


def _material(look: np.ndarray, smooth: bool) -> dict[str, Any]:
    values = [float(f"{value:.6g}") for value in look]
    return {
        "diffuse": values[:3],
        "specular": values[3:6],
        "roughness": values[6],
        "emissive": values[7:10],
        "smooth_shading": smooth,
        "rand_tri_diffuse_seed": None,
    }


def _camera(pose: np.ndarray, fov_deg: float, aspect: float) -> dict[str, Any]:
    pose = pose.astype(np.float64)
    camera = {
        "position": pose[:3, 3].tolist(),
        "look_at": (pose[:3, 3] - pose[:3, 2]).tolist(),
        "up": pose[:3, 1].tolist(),
        "fov": float(fov_deg),
    }
    return camera if abs(aspect - 1) < 1e-3 else {**camera, "aspect": float(aspect)}


def _obj(triangles: np.ndarray) -> bytes:
    """(F, 3, 3) triangles as an OBJ; equal corners are one vertex, so that shading can be smooth."""
    points, index = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in points]
    lines += [f"f {a} {b} {c}" for a, b, c in index.reshape(-1, 3) + 1]
    return ("\n".join(lines) + "\n").encode()
