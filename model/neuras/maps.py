"""A texture that is learned: one row of features per texel that a training ray touches, and coarse levels beside them.

A texel's feature is the sum of its own row and of one row of each coarse level, which all texels in the same cell share: for
the mesh a voxel of the world, for a skybox a block of its face. So what one texel learns helps those near it. A texel that no
ray touched has the mean of the touched texels that *lend*, of the smallest cell that holds both.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from model.neuras.tables import Table


def voxels(positions: np.ndarray, size: float) -> np.ndarray:
    """(N,) int64: the world voxel of edge ``size`` in which each of ``positions`` (N, 3) lies, numbered from 0."""
    keys = np.floor(np.asarray(positions, float) / size).astype(np.int64)
    keys -= keys.min(axis=0, initial=0)
    _, y, z = (keys.max(axis=0, initial=0) + 1).tolist()
    return _numbered((keys[:, 0] * y + keys[:, 1]) * z + keys[:, 2])


def blocks(layers: int, side: int, edge: int) -> np.ndarray:
    """(layers * 6 * side * side,) int64: blocks of ``edge`` x ``edge`` texels of skybox faces, numbered from 0."""
    along = np.arange(side) // edge
    count = int(along[-1]) + 1
    face = np.arange(6 * layers)[:, None, None] * count * count
    return (face + along[:, None] * count + along[None, :]).reshape(-1)


def _numbered(keys: np.ndarray) -> np.ndarray:
    return np.unique(keys, return_inverse=True)[1].reshape(-1)


class Maps:
    """Texels that are learned, and those that follow from them.

    touched: (T,) bool over all texels. lending: (T,) bool, those whose values others may take. shared: cells (T,) int64 of each
    coarse level. filling: cells of each size in which untouched texels look for lending ones, small to large; what none of
    them fills has the mean of all. start: (R, D) features of the touched texels.

    ``row_of``: (T,) int32: rows below R are touched texels, rows from R on are means of cells (``features_of_all``).
    """

    def __init__(
        self,
        touched: np.ndarray,
        lending: np.ndarray,
        shared: Sequence[np.ndarray],
        filling: Sequence[np.ndarray],
        start: Tensor,
    ):
        rows, device = np.flatnonzero(touched), start.device
        self.count = len(rows)
        row_of = np.full(len(touched), -1, np.int32)
        row_of[rows] = np.arange(len(rows))
        self.means: list[tuple[Tensor, Tensor]] = []  # of each level: members, and the mean that each adds to
        last = len(rows)
        lenders = np.flatnonzero(lending[rows] if lending[rows].any() else touched[rows])  # rows
        for level in [*filling, np.zeros(len(touched), np.int64)]:
            open_texels = np.flatnonzero(row_of < 0)
            if not len(open_texels):
                break
            filled = np.zeros(int(level.max()) + 1, bool)
            filled[level[rows[lenders]]] = True
            able = open_texels[filled[level[open_texels]]]
            wanted, where = np.unique(level[able], return_inverse=True)
            row_of[able] = last + where
            number = np.full(len(filled), -1, np.int64)
            number[wanted] = np.arange(len(wanted))
            members = lenders[number[level[rows[lenders]]] >= 0]
            means = last - len(rows) + number[level[rows[members]]]
            self.means.append((torch.from_numpy(members).to(device), torch.from_numpy(means).to(device)))
            last += len(wanted)
        self.mean_count = last - len(rows)
        self.row_of = torch.from_numpy(row_of).to(device)
        self.fine = Table(start)
        self.coarse: list[tuple[Tensor, Table]] = []
        for level in shared:
            used, cell = np.unique(level[rows], return_inverse=True)
            zeros = torch.zeros(len(used), start.shape[1], device=device)
            self.coarse.append((torch.from_numpy(cell.reshape(-1)).to(device), Table(zeros)))

    @property
    def tables(self) -> list[Table]:
        return [self.fine, *(table for _, table in self.coarse)]

    def features(self, rows: Tensor) -> Tensor:
        """(U, D) of touched texels' ``rows`` (U,)."""
        found = self.fine.values.index_select(0, rows)
        for cell, table in self.coarse:
            found += table.values.index_select(0, cell.index_select(0, rows))
        return found

    def update(self, rows: Tensor, gradient: Tensor, rates: Tensor, step: int) -> None:
        """A step of Adam on unique ``rows``, and on the cells that they lie in, at the ``rates`` (D,) of their channels."""
        self.fine.update(rows, gradient, rates, step)
        for cell, table in self.coarse:
            cells, where = cell.index_select(0, rows).unique(return_inverse=True)
            total = torch.zeros(len(cells), gradient.shape[1], device=gradient.device).index_add_(0, where, gradient)
            table.update(cells, total, rates, step)

    def features_of_all(self) -> Tensor:
        """(R + M, D): of every touched texel, and the means that ``row_of`` refers to beside them."""
        device = self.row_of.device
        own = torch.cat([self.features(rows) for rows in torch.arange(self.count, device=device).split(1 << 18)])
        means = torch.zeros(self.mean_count, own.shape[1], device=device)
        members = torch.zeros(self.mean_count, 1, device=device)
        for rows, number in self.means:
            means.index_add_(0, number, own.index_select(0, rows))
            members.index_add_(0, number, torch.ones(len(rows), 1, device=device))
        return torch.cat([own, means / members.clamp(min=1)])
