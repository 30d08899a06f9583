"""Guided lobes and first directions: where pixels get their light from, in the random numbers of the first scattering.

A glossy wall that mirrors a highlight: most directions of its lobe miss it, and the few that find it are very bright. Which
random numbers find it hardly changes from a pixel to the next. So cells of a view's pixels keep a histogram of them for either
lobe, diffuse and specular: how much light they brought, squared. Later paths draw their numbers, and the lobe, by its root,
which leaves the least noise, and count by one over the density. So the lobe stays part of each direction, and the mean is exact
whatever was learned. After Guo et al., "Primary Sample Space Path Guiding" (2018), of the first bounce alone.

Behind it nothing is learned. But what narrow lobes show of a surface are its own reflections, lamps among them, so there narrow
lobes are preferred (`ODDS`).

What is learned adds up in whole numbers, per view: bytes depend neither on the order of threads nor on which other views are
rendered.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import convolve

from stages.renderformer.rendering.material import Lobes
from stages.renderformer.rendering.surfaces import gatherable

CELL, CELLS = 4, 64  # pixels along a cell's side, at least; cells along a view's side, at most
SIDE = 8  # bins of each of a direction's two numbers
BINS = SIDE * SIDE
EDGES = SIDE + 1
FLOOR = 0.3  # share of what was not learned: even, in the density of a lobe's bins and in the weights of lobes
BLUR, BIN_BLUR = 0.5, 0.3  # what counts of a neighbouring cell and of a neighbouring bin
ODDS = 3.0  # by which a narrow lobe is preferred that is seen in narrow ones alone: lamps keep their full brightness there
BRIGHTEST = 16.0  # a path counts as this much at most
MOST = 2.0**20  # and its square, over its density
UNIT = 2.0**-16  # of the whole numbers that squares add up in
NOWHERE = 0xFFFFFFFF


@dataclass
class FirstStep:
    """How a path has left the first surface, and what it has brought since."""

    bin: mi.UInt32  # NOWHERE: it has not
    factor: mi.Float  # from the square of what it brought to what counts in the bin
    brought: mi.Float  # light, mean over RGB

    @classmethod
    def none(cls) -> FirstStep:
        return cls(mi.UInt32(NOWHERE), mi.Float(0), mi.Float(0))

    def bring(self, light: mi.Color3f, active: mi.Bool) -> FirstStep:
        # not dr.mean, which multiplies and divides by the launch's size too: bytes would depend on chunks
        return FirstStep(self.bin, self.factor, self.brought + dr.select(active, dr.sum(light) * (1 / 3), 0))


class PrimaryGuide:
    """What is known of the first directions of some views' paths, in one pass over the lights. ``size``: (height, width)."""

    def __init__(self, views: int, size: tuple[int, int]):
        cell = max(CELL, -(-max(size) // CELLS))
        self.shape = (views, *(-(-side // cell) for side in size))
        count = int(np.prod(self.shape))
        self.squares = dr.zeros(mi.UInt64, count * 2 * BINS)  # in UNITs, by cell, lobe (the specular one second) and bin
        # cumulative shares of a lobe's bins: over the first number, then over the second within each bin of the first
        self._edges = np.empty((count, 2, 1 + SIDE, EDGES), np.float32)
        self._edges[:] = np.linspace(0, 1, EDGES)
        self._specular = np.full(count, 0.5, np.float32)  # weight of the specular lobe over that of both
        self.rows, self.columns = (dr.opaque(mi.UInt32, side) for side in self.shape[1:])
        self.cell_side = dr.opaque(mi.UInt32, cell)
        self._publish()

    def _publish(self) -> None:
        self.edges, self.specular = gatherable(self._edges), gatherable(self._specular)

    def learn(self, views: list[int]) -> None:
        """Take up what the paths of these views have brought so far."""
        squares = self.squares.numpy().reshape(*self.shape, 2, SIDE, SIDE)
        of_views = [array.reshape(self.shape[0], -1, *array.shape[1:]) for array in (self._edges, self._specular)]
        for view in views:
            learned = squares[view].astype(np.float64)
            learned = convolve(learned, _kernel(BLUR)[:, :, None, None, None], mode="nearest")
            learned = convolve(learned, _kernel(BIN_BLUR)[None, None, None], mode="nearest")
            weight = np.sqrt(learned).reshape(-1, 2, SIDE, SIDE)
            of_lobe = weight.mean(axis=(2, 3))
            mean = of_lobe[..., None, None]
            density = FLOOR + (1 - FLOOR) * np.divide(weight, mean, out=np.ones_like(weight), where=mean > 0)
            edges, specular = (array[view] for array in of_views)
            edges[:, :, 0] = _cumulative(density.sum(axis=3))
            edges[:, :, 1:] = _cumulative(density)
            of_lobe = FLOOR * of_lobe.mean(axis=1, keepdims=True) + (1 - FLOOR) * of_lobe
            total = of_lobe.sum(axis=1)
            specular[:] = np.divide(of_lobe[:, 1], total, out=np.full(len(total), 0.5), where=total > 0)
        self._publish()

    def cell(self, view: mi.UInt32, row: mi.UInt32, column: mi.UInt32) -> mi.UInt32:
        """That of a pixel."""
        return (view * self.rows + row // self.cell_side) * self.columns + column // self.cell_side

    def leave(
        self, cell: mi.UInt32, lobes: Lobes, pick: mi.Float, u: mi.Point2f, first: mi.Bool, chain: mi.Bool
    ) -> tuple[mi.Bool, mi.Point2f, mi.Float, FirstStep]:
        """Of a path that goes on from a surface, by numbers in [0, 1): whether the specular lobe is taken, the numbers for a
        direction by the lobe, the probability of both over what it would have been, and the step.

        ``first``: it is the first surface. ``chain``: it is seen in narrow lobes alone.
        """
        usual = lobes.specular_share
        learned = dr.gather(mi.Float, self.specular, cell, first)
        odds = dr.select(first, learned / (1 - learned), dr.select(chain & lobes.is_narrow, ODDS, 1))
        share = usual * odds / (usual * odds + (1 - usual))  # exact where there is one lobe
        specular = pick < share
        usual, share = (dr.select(specular, x, 1 - x) for x in (usual, share))
        chance = dr.select(usual > 0, share / usual, 1)

        lobe = cell * 2 + dr.select(specular, 1, 0)
        table = lobe * ((1 + SIDE) * EDGES)
        column, x, width = self._drawn(table, u.x, first)
        row, y, height = self._drawn(table + (column + 1) * EDGES, u.y, first)
        u = dr.select(first, mi.Point2f(x, y), u)
        chance *= dr.select(first, width * height * BINS, 1)
        step = FirstStep(lobe * BINS + column * SIDE + row, chance / dr.maximum(usual, 1e-3), mi.Float(0))
        return specular, u, chance, step

    def _drawn(self, table: mi.UInt32, u: mi.Float, active: mi.Bool) -> tuple[mi.UInt32, mi.Float, mi.Float]:
        """A bin by its share, a number within it, and that share."""
        index, step = mi.UInt32(0), SIDE // 2
        while step:  # binary search
            below = dr.gather(mi.Float, self.edges, table + index + step, active) <= u
            index = dr.select(below, index + step, index)
            step //= 2
        low, high = (dr.gather(mi.Float, self.edges, table + index + end, active) for end in (0, 1))
        inside = dr.clip((u - low) / dr.maximum(high - low, 1e-9), 0, 1 - 2.0**-24)
        return index, dr.minimum((mi.Float(index) + inside) / SIDE, 1 - 2.0**-24), high - low

    def add(self, step: FirstStep, active: mi.Bool) -> None:
        """Learn of paths that have ended."""
        active = active & (step.bin != NOWHERE) & (step.brought > 0)
        brought = dr.minimum(step.brought, BRIGHTEST)
        amount = mi.UInt64(dr.minimum(brought * brought * step.factor, MOST) / UNIT + 0.5)
        dr.scatter_reduce(dr.ReduceOp.Add, self.squares, amount, step.bin, active)


def _kernel(beside: float) -> np.ndarray:
    """(3, 3) weights of a cell and its neighbours."""
    along = np.array([beside, 1, beside])
    return along[:, None] * along


def _cumulative(density: np.ndarray) -> np.ndarray:
    """(.., EDGES) from 0 to 1, of (.., SIDE)."""
    sums = np.cumsum(density, axis=-1)
    return np.concatenate([np.zeros_like(sums[..., :1]), sums / sums[..., -1:]], axis=-1)
