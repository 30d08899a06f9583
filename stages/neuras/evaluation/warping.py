"""Multi-view warping: a new view from the nearest photos, moved by the scaffold's depth (the paper's first baseline).

A pixel's point on the scaffold is looked up in the nearest source views that see it. Pixels without a point look it up by
their direction alone, as if infinitely far, among source pixels without a point.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.ndimage import distance_transform_edt

from stages.graphics.cameras import Camera
from stages.graphics.casting import Caster
from stages.neuras.rasterizing.photos import FAR, Source, look_up, nearest


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
        self.cameras = cameras
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
        distances = np.linalg.norm(np.array([other.position for other in self.cameras]) - camera.position, axis=1)
        for index in nearest(self.cameras, camera, self.nearest):
            colour, sees = look_up(self.source(index), points, view.hit)
            weight = sees / (distances[index] + max(1e-3 * distances.max(), 1e-9))
            total += colour * weight[..., None]
            weights += weight
        seen = weights > 0
        if not seen.any():
            return np.zeros_like(total, np.float32), seen
        image = total / np.where(seen, weights, 1)[..., None]
        rows, columns = distance_transform_edt(~seen, return_distances=False, return_indices=True)
        return image[rows, columns].astype(np.float32), seen
