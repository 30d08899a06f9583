"""Light triangles that shine somewhere: turned to a direction, and the three of the default room."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from stages.graphics.geometry.measure import face_normals
from stages.renderformer.scenes import meshes
from stages.renderformer.scenes.laws import Light

# Direction from the centre -> share of the radiance. Total light is at the lower end of the released range, so that a clamped
# picture shows it without exposure.
LIGHTS: Mapping[tuple[float, float, float], float] = {
    (-0.9, -0.5, 1.0): 0.5, (0.55, -1.0, 0.9): 0.2, (-0.2, -0.1, 1.2): 0.3,
}  # fmt: skip
LIGHT_RADIANCE, LIGHT_SCALE, LIGHT_DISTANCE = 2500.0, 2.0, 2.6
LIGHT_AREA = float(meshes.areas(meshes.LIGHT_TRIANGLE[None])[0]) * LIGHT_SCALE**2


def three_lights() -> list[Light]:
    """Three white lights that shine on the origin, of a scene that brings none."""
    lights = []
    for direction, share in LIGHTS.items():
        away = np.array(direction) / np.linalg.norm(direction)
        position = (LIGHT_DISTANCE * away).tolist()
        turn = turn_to(-away).as_euler("xyz", degrees=True).tolist()
        lights.append(
            Light(away.tolist(), [0.0] * 3, LIGHT_DISTANCE, position, turn, [LIGHT_SCALE] * 3, share * LIGHT_RADIANCE)
        )
    return lights


def turn_to(direction: np.ndarray):
    """The rotation (SciPy's) that turns the light triangle's normal to ``direction``, of length 1."""
    from scipy.spatial.transform import Rotation

    normal = face_normals(meshes.LIGHT_TRIANGLE[None])[0]
    axis = np.cross(normal, direction)
    angle = np.arctan2(np.linalg.norm(axis), normal @ direction)
    if np.linalg.norm(axis) < 1e-9:  # parallel: any axis across it
        axis = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    return Rotation.from_rotvec(axis * (angle / max(np.linalg.norm(axis), 1e-12)))


def light_triangle(position: np.ndarray, direction: np.ndarray, area: float) -> np.ndarray:
    """(3, 3) corners of an equilateral triangle around ``position`` whose normal is ``direction``."""
    scale = LIGHT_SCALE * np.sqrt(area / LIGHT_AREA)
    centred = meshes.LIGHT_TRIANGLE - meshes.LIGHT_TRIANGLE.mean(axis=0)
    return turn_to(direction).apply(centred * scale) + position
