"""Cameras around a scene: an orbit of one of its cameras, for animations (paper section 3.3).

Reads and returns a ``SceneRecord``; only its cameras change. One design choice: the orbit is a full turn where nothing is in
the way, else it swings between the walls. It never shows the backs of surfaces, because no training scene does. Frame 0 is
the scene's own camera, and the last frame leads back to it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.errors import UserError
from stages.renderformer.records import SceneRecord

STEP_DEG = 5.0  # between cameras that are tried out
RAYS = 24  # per side of a camera's grid of rays
MORE_BACKS = 0.02  # share of rays, beyond those of the scene's own camera, that may meet the back of a surface
LEAST_DEG = 10.0  # to each side, however narrow the room


def orbit(scene: SceneRecord, frames: int, view: int = 0, arc_deg: float | None = None) -> SceneRecord:
    """The scene with ``frames`` cameras: camera ``view`` turned about a vertical axis through what it looks at.

    arc_deg: 360 is a full turn. With less, the camera swings that far in all. None: as far as nothing is in the way.
    UserError: no frame, or an arc outside (0, 360].
    """
    if frames < 1:
        raise UserError(f"an orbit of {frames} frames: give at least 1")
    if arc_deg is not None and not 0 < arc_deg <= 360:
        raise UserError(f"an arc of {arc_deg:g} degrees: give more than 0 and at most 360")
    pose, pivot = scene.camera_to_world[view].astype(np.float64), centre(scene, view)
    back, ahead = free_arc(scene, view, pivot) if arc_deg is None else (arc_deg / 2, arc_deg / 2)
    notes = list(scene.meta.get("notes", ()))
    if arc_deg is None and back + ahead < 360:
        notes.append(f"the orbit swings {back + ahead:g} degrees, between walls (--arc 360 goes all around)")
    phase = 2 * np.pi * np.arange(frames) / frames
    if back + ahead >= 360:
        turns = np.degrees(phase)
    else:  # from one end to the other and back, starting at 0
        middle, half = (ahead - back) / 2, (ahead + back) / 2
        turns = middle + half * np.sin(phase - np.arcsin(middle / half))
    poses = np.stack([turned(pose, pivot, turn) for turn in turns])
    fov_deg, meta = np.repeat(scene.fov_deg[view], frames), {**scene.meta, "notes": notes}
    if "aspect" in meta:
        meta["aspect"] = [meta["aspect"][view]] * frames
    return replace(scene, camera_to_world=poses.astype(np.float32), fov_deg=fov_deg, meta=meta)


def centre(scene: SceneRecord, view: int) -> np.ndarray:
    """(3,) the point on the camera's axis nearest to the middle of all that does not emit; always in front of the camera."""
    solid = scene.triangles[scene.light_index < 0].reshape(-1, 3)
    points = (solid if len(solid) else scene.triangles.reshape(-1, 3)).astype(np.float64)
    pose = scene.camera_to_world[view].astype(np.float64)
    ahead = ((points.min(axis=0) + points.max(axis=0)) / 2 - pose[:3, 3]) @ -pose[:3, 2]
    return pose[:3, 3] - max(ahead, 1e-3) * pose[:3, 2]


def turned(pose: np.ndarray, pivot: np.ndarray, degrees: float) -> np.ndarray:
    """(4, 4) camera-to-world pose, turned about the vertical axis through the pivot."""
    about_z = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    out = pose.copy()
    out[:3] = about_z @ pose[:3]
    out[:3, 3] += pivot - about_z @ pivot
    return out


def free_arc(scene: SceneRecord, view: int, pivot: np.ndarray) -> tuple[float, float]:
    """Degrees that the camera may turn back and ahead until it sees more backs of surfaces. (180, 180): all around."""
    from stages.graphics.geometry.measure import embree_scene

    solid = np.flatnonzero(scene.light_index < 0)
    if len(solid) == 0:
        return 180.0, 180.0
    corners = scene.triangles[solid].astype(np.float64)
    casts = embree_scene(corners.reshape(-1, 3), np.arange(3 * len(solid)).reshape(-1, 3))
    normals = scene.vertex_normals[solid].mean(axis=1)
    pose = scene.camera_to_world[view].astype(np.float64)
    reach = np.tan(np.radians(scene.fov_deg[view]) / 2) * (2 * (np.arange(RAYS) + 0.5) / RAYS - 1)
    x, y = (axis.ravel() for axis in np.meshgrid(reach, reach))
    rays = np.stack([x, y, -np.ones_like(x)], axis=1)

    def backs(degrees: float) -> float:
        """Share of the camera's rays that first meet the back of a surface."""
        camera = turned(pose, pivot, degrees)
        directions = rays @ camera[:3, :3].T
        origins = np.repeat(camera[None, :3, 3], len(rays), axis=0)
        hit = np.asarray(casts.run(origins.astype(np.float32), directions.astype(np.float32)))
        return float(((hit >= 0) & (np.einsum("ij,ij->i", normals[hit], directions) > 0)).mean())

    allowed = backs(0.0) + MORE_BACKS
    free = []
    for sign in (-1, 1):
        steps = np.arange(STEP_DEG, 180 + STEP_DEG, STEP_DEG)
        blocked = (step for step in steps if backs(sign * step) > allowed)
        free.append(max(float(next(blocked, steps[-1] + STEP_DEG)) - STEP_DEG, LEAST_DEG))
    return min(free[0], 180.0), min(free[1], 180.0)
