"""Which faces the cameras see, and how finely; and which faces beams went through."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from stages.graphics.cameras import Camera
from stages.graphics.casting import Caster
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
    return Mesh.compact(mesh.vertices, mesh.faces[visible])


def carved(mesh: Mesh, points: np.ndarray, sensors: np.ndarray, slack: float, rounds: int = 4) -> Mesh:
    """Without the faces that more beams went through than ended at.

    A beam goes from ``sensors`` (P, 3) to ``points`` (P, 3), and nothing stands between. Reconstruction closes such gaps:
    between the leaves of a tree, say, or a lamp and the wall behind. A beam goes through a face that it meets more than
    ``slack`` (world units, or 2 % of its length if that is more) before its end. Each round looks behind the faces that the
    one before removed.
    """
    for _ in range(rounds):
        passed, stopped = beams_at(mesh, points, sensors, slack)
        empty = passed > stopped
        if not empty.any() or empty.all():
            break
        mesh = Mesh.compact(mesh.vertices, mesh.faces[~empty])
    return mesh


def beams_at(mesh: Mesh, points: np.ndarray, sensors: np.ndarray, slack: float) -> tuple[np.ndarray, np.ndarray]:
    """(F,) beams that go through each face, and that end at it; of each beam the first face counts. As of `carved`."""
    ways = points - sensors
    lengths = np.linalg.norm(ways, axis=1)
    ways = ways / np.maximum(lengths, 1e-12)[:, None]
    near_end = np.maximum(slack, 0.02 * lengths)
    face, _, distance = Caster(mesh.vertices, mesh.faces).cast(sensors, ways)
    met = face >= 0
    through = met & (distance < lengths - near_end)
    ended = met & (np.abs(distance - lengths) <= near_end)
    passed, stopped = (np.bincount(face[which], minlength=len(mesh.faces)) for which in (through, ended))
    return passed, stopped


def pixels_per_unit(mesh: Mesh, cameras: Iterable[Camera]) -> np.ndarray:
    """(F,) float32: pixels that a world unit at the face covers in the camera nearest to it; 0 for unseen faces."""
    caster = Caster(mesh.vertices, mesh.faces)
    finest = np.zeros(len(mesh.faces), np.float32)
    for camera in cameras:
        view = caster.view(camera)
        np.maximum.at(finest, view.face[view.hit], (camera.fx / view.depth[view.hit]).astype(np.float32))
    return finest
