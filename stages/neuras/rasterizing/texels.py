"""An atlas drawn into its own texture: which face each texel lies on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt

from stages.neuras.rasterizing.casting import Caster
from stages.neuras.records import AtlasMesh


@dataclass(frozen=True, eq=False)
class Texels:
    """face: (H, W) int32, the face that a texel's centre lies on, -1 for none. barycentric: (H, W, 2) float32, weights of its
    second and third corner. nearest: (H, W) int64, flat index of the nearest texel on a face (itself, if it is on one).
    distance: (H, W) float32, to that texel, in texels.
    """

    face: np.ndarray
    barycentric: np.ndarray
    nearest: np.ndarray
    distance: np.ndarray

    def dilated(self, values: np.ndarray, texels: float) -> np.ndarray:
        """``values`` (H, W, ..) with what lies within ``texels`` of a face filled from the nearest texel on one."""
        filled = values.copy()
        rim = (self.face < 0) & (self.distance <= texels)
        filled[rim] = values.reshape(-1, *values.shape[2:])[self.nearest[rim]]
        return filled


def texels(atlas: AtlasMesh) -> Texels:
    """Every texel's face. Texels whose centre is on no face have the nearest one's."""
    size = (atlas.width, atlas.height)
    flat = np.concatenate([atlas.uvs * size, np.zeros((len(atlas.uvs), 1), np.float32)], axis=1)
    caster = Caster(flat, atlas.faces)
    face = np.empty((atlas.height, atlas.width), np.int32)
    barycentric = np.empty((atlas.height, atlas.width, 2), np.float32)
    x = np.arange(atlas.width) + 0.5
    down = np.broadcast_to(np.array([0.0, 0.0, -1.0]), (atlas.width, 3))
    for row in range(atlas.height):
        starts = np.stack([x, np.full_like(x, row + 0.5), np.ones_like(x)], axis=1)
        face[row], barycentric[row], _ = caster.cast(starts, down)
    distance, (rows, columns) = distance_transform_edt(face < 0, return_indices=True)
    return Texels(face, barycentric, rows.astype(np.int64) * atlas.width + columns, distance.astype(np.float32))
