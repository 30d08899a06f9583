"""Path guiding: from where a wide surface gets its indirect light, learned from the first paths of a view.

Space is a grid of cells. Each keeps, for every direction, how much light paths have brought to wide surfaces in it after one
or more further surfaces: a lamp's reflection in a mirror, a brightly lit patch of wall. Later paths take every other direction
at such a surface from this table, the others from the material; each direction counts by the density of both together, so that
the mean stays exact whatever was learned. After Lafortune and Willems, "A 5D Tree to Reduce the Variance of Monte Carlo Ray
Tracing" (1995), with a grid for a tree.

What is learned adds up in whole numbers, per view: bytes depend neither on the order of threads nor on which other views are
rendered.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from stages.renderformer.records import SceneRecord
from stages.renderformer.rendering.material import Lobes
from stages.renderformer.rendering.surfaces import gatherable

GRID = 8  # cells of space per axis
CELLS = GRID**3
HEIGHTS, TURNS = 32, 64  # bins of directions, of equal solid angle
BINS = HEIGHTS * TURNS
SPREAD = 0.1  # of a bin's light that counts for each of its four neighbours too
SHARE = 0.5  # of the directions at a surface whose cell has learned something
WIDE_ALPHA = 0.1  # GGX width from which a specular lobe counts as wide
WIDE_SHARE = 0.3  # of what a wide surface reflects, the least part by wide lobes
UNIT = 2.0**-10  # of the whole numbers that light adds up in, radiance
BRIGHTEST = 64.0  # a contribution counts as this much at most
NOWHERE = 0xFFFFFFFF


@dataclass
class Trail:
    """The last wide surface that a path has left."""

    place: mi.UInt32  # cell and bin of the direction in which it was left, NOWHERE: none yet
    further: mi.Bool  # whether the path has met another surface since
    throughput: mi.Float  # of the path before that surface, mean over RGB

    @classmethod
    def none(cls) -> Trail:
        return cls(mi.UInt32(NOWHERE), mi.Bool(False), mi.Float(1))


@dataclass
class Spot:
    """A surface interaction, as the guide sees it."""

    wide: mi.Bool
    cell: mi.UInt32
    share: mi.Float  # of directions to take from the table


class Unguided:
    """The guide that knows nothing and learns nothing."""

    def at(self, view: mi.UInt32, si: mi.SurfaceInteraction3f, lobes: Lobes, active: mi.Bool) -> Spot | None:
        return None

    def density(self, pdf: mi.Float, spot: Spot | None, direction: mi.Vector3f) -> mi.Float:
        """Per solid angle, of directions by material and table together; ``pdf``: of those by the material."""
        return pdf

    def direction(self, wo: mi.Vector3f, spot: Spot | None, si, u: mi.Point2f, v: mi.Point2f) -> mi.Vector3f:
        """``wo``, the material's direction in the shading frame, or one from the table, by numbers in [0, 1)."""
        return wo

    def add(self, trail: Trail, light: mi.Color3f, active: mi.Bool) -> None:
        """Learn of a contribution to the image."""

    def learn(self, views: list[int]) -> None:
        """Take up what the paths of these views have brought so far."""

    def step(self, trail: Trail, spot: Spot | None, direction: mi.Vector3f, throughput: mi.Color3f, ends: mi.Bool) -> Trail:
        """The trail of a path that goes on from ``spot``, or ends."""
        return trail


class Guide(Unguided):
    """What is known of a scene seen by some of its cameras, in one pass over its lights."""

    def __init__(self, scene: SceneRecord):
        surfaces = scene.triangles[scene.light_index < 0].reshape(-1, 3)
        low, high = (surfaces.min(axis=0), surfaces.max(axis=0)) if len(surfaces) else (np.zeros(3), np.ones(3))
        self.low = [dr.opaque(mi.Float, float(x)) for x in low]
        self.scale = [dr.opaque(mi.Float, float(GRID / max(x, 1e-9))) for x in high - low]
        cells = len(scene.camera_to_world) * CELLS
        self.light = dr.zeros(mi.UInt64, cells * BINS)  # in UNITs
        self._tables = np.zeros((2, cells, BINS), np.float32)  # of each bin in its cell: share, and sum of shares up to it
        self._publish()

    def _publish(self) -> None:
        self.shares, self.cumulative = (gatherable(table) for table in self._tables)
        self.known = gatherable(np.where(self._tables[1, :, -1] > 0, SHARE, 0))

    def learn(self, views):
        light = self.light.numpy().reshape(-1, CELLS, HEIGHTS, TURNS)
        for view in views:
            learned = light[view].astype(np.float64)
            around = np.pad(learned, ((0, 0), (1, 1), (0, 0)))
            beside = np.roll(learned, 1, axis=-1) + np.roll(learned, -1, axis=-1)
            learned = (learned + SPREAD * (around[:, 2:] + around[:, :-2] + beside)).reshape(CELLS, BINS)
            total = learned.sum(axis=1, keepdims=True)
            shares = learned / np.where(total > 0, total, 1)
            cells = slice(view * CELLS, (view + 1) * CELLS)
            self._tables[:, cells] = shares, np.cumsum(shares.astype(np.float32), axis=1, dtype=np.float64)
        self._publish()

    def at(self, view, si, lobes, active):
        bright, dull = dr.max(lobes.specular), dr.max(lobes.diffuse)
        by_wide = dull + dr.select(lobes.alpha > WIDE_ALPHA, bright, 0)
        wide = active & (by_wide > WIDE_SHARE * (bright + dull))
        place = [mi.UInt32(dr.clip((si.p[axis] - self.low[axis]) * self.scale[axis], 0, GRID - 1)) for axis in range(3)]
        cell = ((view * GRID + place[0]) * GRID + place[1]) * GRID + place[2]
        return Spot(wide, cell, dr.gather(mi.Float, self.known, cell, wide))

    def density(self, pdf, spot, direction):
        share = dr.gather(mi.Float, self.shares, spot.cell * BINS + _bin(direction), spot.wide)
        return dr.lerp(pdf, share * (BINS / (4 * np.pi)), spot.share)

    def direction(self, wo, spot, si, u, v):
        guided = u.x < spot.share
        return dr.select(guided, si.to_local(self._draw(dr.select(guided, spot.cell, 0), u.y, v)), wo)

    def _draw(self, cell: mi.UInt32, pick: mi.Float, v: mi.Point2f) -> mi.Vector3f:
        bin_index, step = mi.UInt32(0), BINS // 2
        while step:  # binary search
            below = dr.gather(mi.Float, self.cumulative, cell * BINS + bin_index + (step - 1)) <= pick
            bin_index = dr.select(below, bin_index + step, bin_index)
            step //= 2
        z = (mi.Float(bin_index // TURNS) + v.x) * (2 / HEIGHTS) - 1
        sine, cosine = dr.sincos((mi.Float(bin_index % TURNS) + v.y) * (2 * np.pi / TURNS) - np.pi)
        radius = dr.safe_sqrt(1 - z * z)
        return mi.Vector3f(radius * cosine, radius * sine, z)

    def add(self, trail, light, active):
        brought = dr.mean(light) / trail.throughput
        active = active & (trail.place != NOWHERE) & (brought > 0)
        amount = mi.UInt64(dr.minimum(brought, BRIGHTEST) / UNIT)
        dr.scatter_reduce(dr.ReduceOp.Add, self.light, amount, trail.place, active)

    def step(self, trail, spot, direction, throughput, ends):
        place = dr.select(spot.wide, spot.cell * BINS + _bin(direction), trail.place)
        before = dr.select(spot.wide, dr.maximum(dr.mean(throughput), 1e-6), trail.throughput)
        return Trail(dr.select(ends, NOWHERE, place), ~spot.wide & ~ends, dr.select(ends, 1, before))


def _bin(direction: mi.Vector3f) -> mi.UInt32:
    height = mi.UInt32(dr.clip((direction.z + 1) * (HEIGHTS / 2), 0, HEIGHTS - 1))
    turn = mi.UInt32(dr.clip((dr.atan2(direction.y, direction.x) / (2 * np.pi) + 0.5) * TURNS, 0, TURNS - 1))
    return height * TURNS + turn
