"""Multi-view warping: a new view from the nearest photos, moved by the scaffold's depth (the paper's first baseline).

A pixel's point on the scaffold is looked up in the nearest source views that see it. Pixels without a point look it up by
their direction alone, as if infinitely far, among source pixels without a point.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt, map_coordinates

from stages.graphics.cameras import Camera
from stages.graphics.casting import Caster, GBuffer

TOLERANCE = 0.02  # relative difference of depth under which a source sees the same point
FAR = 1e6  # in scene radii: where a pixel without a point is taken to lie


@dataclass(frozen=True, eq=False)
class Source:
    """A photo, and what its pixels see of the scaffold. image: (H, W, 3) float32 in [0, 1]; counts: (H, W) bool, its mask."""

    camera: Camera
    image: np.ndarray
    counts: np.ndarray
    view: GBuffer


class Warping:
    """A renderer of new views from photos.

    cameras: of all sources. source: gives one by its number; photos may be many, so nobody holds them all. radius: the
    scene's, world units. nearest: so many sources are used for a view. rays: along a pixel's side, whose mean is drawn.
    """

    def __init__(
        self,
        caster: Caster,
        cameras: Sequence[Camera],
        source: Callable[[int], Source],
        radius: float,
        nearest: int = 4,
        rays: int = 1,
    ):
        self.caster = caster
        self.positions = np.array([camera.position for camera in cameras])
        self.source = source
        self.far = radius * FAR
        self.nearest, self.rays = nearest, rays

    def render(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """The view, (H, W, 3) float32 in [0, 1], and (H, W) bool: pixels that a source sees with all their rays."""
        images, seen = zip(*(self._cast(ray) for ray in camera.subpixels(self.rays)), strict=True)
        return np.mean(images, axis=0, dtype=np.float32), np.all(seen, axis=0)

    def _cast(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """The same with one ray a pixel.

        Of the sources that see a pixel, the nearer camera weighs more. Pixels that none sees take the nearest pixel's
        colour.
        """
        view = self.caster.view(camera)
        directions = camera.directions()
        points = camera.position + directions * np.where(view.hit, view.depth, self.far)[..., None]
        total = np.zeros((camera.height, camera.width, 3))
        weights = np.zeros((camera.height, camera.width))
        distances = np.linalg.norm(self.positions - camera.position, axis=1)
        for index in np.argsort(distances, kind="stable")[: self.nearest]:
            colour, sees = look_up(self.source(int(index)), points, view.hit)
            weight = sees / (distances[index] + max(1e-3 * distances.max(), 1e-9))
            total += colour * weight[..., None]
            weights += weight
        seen = weights > 0
        if not seen.any():
            return np.zeros_like(total, np.float32), seen
        image = total / np.where(seen, weights, 1)[..., None]
        rows, columns = distance_transform_edt(~seen, return_distances=False, return_indices=True)
        return image[rows, columns].astype(np.float32), seen


def look_up(source: Source, points: np.ndarray, on_mesh: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colours (H, W, 3) of world ``points`` (H, W, 3) in a source, and (H, W) bool: whether the source sees them.

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
