"""An atlas drawn into its own texture: which face each texel lies on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt

from model.neuras.sampling import Pyramid
from stages.graphics.casting import Caster
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

    def positions(self, atlas: AtlasMesh) -> np.ndarray:
        """(H, W, 3) float32, world, of the texels; of those on no face, the nearest one's that is on a face."""
        face, weights = (values.reshape(-1, *values.shape[2:])[self.nearest] for values in (self.face, self.barycentric))
        second, third = weights[..., :1], weights[..., 1:]
        a, b, c = (atlas.vertices[atlas.faces[:, corner]][face] for corner in range(3))
        return (a * (1 - second - third) + b * second + c * third).astype(np.float32)

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


def sheet(atlas: AtlasMesh, pyramid: Pyramid, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Of all texels of all levels, as they lie in the pyramid's sheet (h, w): world positions (h, w, 3) float32, and whether
    they lie on a face or within ``reach`` texels of their level of one, (h, w) bool.

    A coarse texel lies where the mean of its four finer ones that are on a face lies.
    """
    finest = texels(atlas)
    positions, on_face = finest.positions(atlas), finest.face >= 0
    everywhere, inside = np.zeros((*pyramid.sheet, 3), np.float32), np.zeros(pyramid.sheet, bool)
    for level in range(pyramid.levels):
        if level:
            height, width = pyramid.size(level)
            count = on_face.reshape(height, 2, width, 2).sum(axis=(1, 3))
            sums = (positions * on_face[..., None]).reshape(height, 2, width, 2, 3).sum(axis=(1, 3))
            positions, on_face = (sums / np.maximum(count, 1)[..., None]).astype(np.float32), count > 0
        distance, (rows, columns) = distance_transform_edt(~on_face, return_indices=True)
        (row, column), (height, width) = pyramid.corner(level), pyramid.size(level)
        place = np.s_[row : row + height, column : column + width]
        everywhere[place], inside[place] = positions[rows, columns], distance <= reach
    return everywhere, inside
