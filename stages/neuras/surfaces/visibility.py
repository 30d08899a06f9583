"""Which faces the cameras see, and how finely."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from stages.graphics.cameras import Camera
from stages.graphics.geometry import measure
from stages.neuras.rasterizing.casting import Caster
from stages.neuras.records import Mesh


def cameras_beside(cameras: Iterable[Camera], shifts: Sequence[float]) -> list[Camera]:
    """The cameras and their copies moved by ``shifts`` (world units) to the right."""
    return [camera.moved(np.array([shift, 0.0, 0.0])) for camera in cameras for shift in (0.0, *shifts)]


def seen(mesh: Mesh, cameras: Iterable[Camera], rays_per_side: int) -> np.ndarray:
    """(F,) bool: faces that a ray hits, with ``rays_per_side`` squared rays through each pixel."""
    caster = Caster(mesh.vertices, mesh.faces)
    result = np.zeros(len(mesh.faces), bool)
    for camera in cameras:
        face = caster.view(camera, rays_per_side).face
        result[face[face >= 0]] = True
    return result


def kept_faces(mesh: Mesh, visible: np.ndarray, rings: int) -> Mesh:
    """The visible faces and ``rings`` rings of faces around them, which close the gaps between rays."""
    for _ in range(rings):
        touched = np.zeros(len(mesh.vertices), bool)
        touched[mesh.faces[visible]] = True
        visible = touched[mesh.faces].any(axis=1)
    vertices, faces = measure.compact(mesh.vertices.astype(np.float64), mesh.faces[visible].astype(np.int64))
    return Mesh(vertices.astype(np.float32), faces.astype(np.int32))


def pixels_per_unit(mesh: Mesh, cameras: Iterable[Camera]) -> np.ndarray:
    """(F,) float32: pixels that a world unit at the face covers in the camera nearest to it; 0 for unseen faces."""
    caster = Caster(mesh.vertices, mesh.faces)
    finest = np.zeros(len(mesh.faces), np.float32)
    for camera in cameras:
        view = caster.view(camera)
        np.maximum.at(finest, view.face[view.hit], (camera.fx / view.depth[view.hit]).astype(np.float32))
    return finest
