"""Photos that know what their pixels see of the mesh, so that points of the scene can be looked up in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates

from stages.graphics.cameras import Camera
from stages.graphics.casting import GBuffer

TOLERANCE = 0.02  # relative difference of depth under which a source sees the same point
ELSEWHERE = np.cos(np.radians(60))  # of the angle between where two cameras look that hardly show the same
FAR = 1e6  # in scene radii: where a pixel without a point is taken to lie


@dataclass(frozen=True, eq=False)
class Source:
    """A photo, and what its pixels see of the scaffold. image: (H, W, 3) float32 in [0, 1]; counts: (H, W) bool, its mask."""

    camera: Camera
    image: np.ndarray
    counts: np.ndarray
    view: GBuffer


def look_up(source: Source, points: np.ndarray, on_mesh: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colours (.., 3) of world ``points`` (.., 3) in a source, and (..) bool: whether the source sees them.

    It sees a point on the mesh where its own depth agrees, and one off the mesh where it hits nothing itself.
    """
    pixels, ahead = source.camera.project(points)
    width, height = source.camera.width, source.camera.height
    x, y = pixels[..., 0] - 0.5, pixels[..., 1] - 0.5
    inside = (ahead > 0) & (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    x, y = np.where(inside, x, 0), np.where(inside, y, 0)
    column, row = np.rint(x).astype(int), np.rint(y).astype(int)
    distance = np.linalg.norm(points - source.camera.position, axis=-1)
    stored = source.view.depth[row, column]
    same = np.abs(stored - distance) <= TOLERANCE * distance
    sees = inside & source.counts[row, column] & np.where(on_mesh, same & (stored > 0), stored == 0)
    colour = np.stack([map_coordinates(source.image[..., c], [y, x], order=1, mode="nearest") for c in range(3)], axis=-1)
    return colour, sees


def nearest(cameras: Sequence[Camera], camera: Camera, count: int) -> list[int]:
    """The ``count`` cameras nearest to ``camera``, nearest first; those that look elsewhere behind all others, however near."""
    away = np.linalg.norm(np.array([other.position for other in cameras]) - camera.position, axis=1)
    elsewhere = np.array([other.forward for other in cameras]) @ camera.forward < ELSEWHERE
    return [int(number) for number in np.lexsort((away, elsewhere))[:count]]


def beside(cameras: Sequence[Camera], number: int, count: int) -> list[int]:
    """The ``count`` other cameras `nearest` to one of them."""
    return [other for other in nearest(cameras, cameras[number], count + 1) if other != number][:count]
