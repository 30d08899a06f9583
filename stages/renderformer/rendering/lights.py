"""The light arrays of one pass of the JIT integrator, and the table to pick light triangles from by power."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from stages.graphics.geometry.measure import normal_vectors
from stages.renderformer.records import SceneRecord
from stages.renderformer.rendering.surfaces import gatherable

SLOTS = 8  # lights per pass; more lights take several passes of the same kernel
OTHER = SLOTS  # slot of a light that belongs to another pass: hidden like any light, black here


def alias_table(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Walker's alias method: (threshold, alias); cell floor(u n) keeps itself with its threshold's probability."""
    count = len(weights)
    scaled = weights * count / weights.sum()
    threshold, alias = np.ones(count), np.arange(count)
    small = [index for index in range(count) if scaled[index] < 1]
    large = [index for index in range(count) if scaled[index] >= 1]
    while small and large:
        low, high = small.pop(), large.pop()
        threshold[low], alias[low] = scaled[low], high
        scaled[high] -= 1 - scaled[low]
        (small if scaled[high] < 1 else large).append(high)
    return threshold, alias


class LightTable:
    """The lights ``first`` to ``first + SLOTS``: slot, radiance and sampling density per triangle, and the alias table."""

    def __init__(self, scene: SceneRecord, first: int):
        index = scene.light_index.astype(np.int64)
        in_table = (index >= first) & (index < first + SLOTS)
        slot = np.where(in_table, index - first, np.where(index >= 0, OTHER, -1))
        emission = np.where(in_table[:, None], scene.emission, 0).astype(np.float32)
        cross = normal_vectors(scene.triangles.astype(np.float64))
        length = np.linalg.norm(cross, axis=1)
        power = emission.sum(axis=1, dtype=np.float64) * length
        chosen = np.nonzero(power > 0)[0]  # lights without power get no samples
        if len(chosen) == 0:  # radiance is 0: any table does
            chosen, power = np.array([0]), np.where(np.arange(len(power)) == 0, 1.0, 0.0)
        threshold, alias = alias_table(power[chosen])
        density = np.zeros(len(power))  # per unit area
        density[chosen] = power[chosen] / power[chosen].sum() / np.maximum(0.5 * length[chosen], 1e-30)

        self.slots = min(max(scene.n_lights - first, 1), SLOTS)  # in use, one at least
        self.slot = gatherable(slot, mi.Int32)
        self.emission = gatherable(emission)
        self.density = gatherable(density)
        self.normal = gatherable(cross / np.maximum(length, 1e-30)[:, None])
        self.vertices = gatherable(scene.triangles)
        self.count = dr.opaque(mi.UInt32, len(chosen))
        self.triangle = gatherable(chosen, mi.UInt32)
        self.threshold = gatherable(threshold)
        self.alias = gatherable(alias, mi.UInt32)

    def sample(self, pick: mi.Float, spot: mi.Point2f) -> tuple[mi.UInt32, mi.Point3f]:
        """A light triangle by power, and a point spread evenly over it, from numbers in [0, 1)."""
        u = pick * self.count
        cell = dr.minimum(mi.UInt32(u), self.count - 1)
        keep = u - mi.Float(cell) < dr.gather(mi.Float, self.threshold, cell)
        cell = dr.select(keep, cell, dr.gather(mi.UInt32, self.alias, cell))
        triangle = dr.gather(mi.UInt32, self.triangle, cell)
        return triangle, point_within(self.vertices, triangle, spot)


def point_within(vertices: mi.Float, triangle: mi.UInt32, spot: mi.Point2f) -> mi.Point3f:
    """A point spread evenly over a triangle, from numbers in [0, 1). ``vertices``: three for each triangle."""
    a, b, c = [dr.gather(mi.Point3f, vertices, 3 * triangle + corner) for corner in range(3)]
    root = dr.sqrt(spot.x)
    return a * (1 - root) + b * (root * (1 - spot.y)) + c * (root * spot.y)
