"""The pixels that a scene is fitted to, all in memory, and batches of them.

A batch is made of square patches, not of single pixels. Neighbours share texels, so a step quantizes and updates a third
as many rows, and differences between neighbours can be compared.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.ndimage import binary_dilation
from torch import Tensor

from model.errors import InputError


@dataclass(frozen=True, eq=False)
class View:
    """What a camera saw. origin: (3,) float64, world. directions: (H, W, 3) float32 unit vectors. uv: (H, W, 2) float32 where
    ``hit`` (H, W) bool, the texture coordinates of the mesh. spread: (H, W, 2), detail: (H, W), float32, the part of the
    texture that a pixel covers there (``Pyramid.sample``). rgb: (H, W, 3) uint8. counts: (H, W) bool, pixels that count.
    """

    origin: np.ndarray
    directions: np.ndarray
    uv: np.ndarray
    spread: np.ndarray
    detail: np.ndarray
    hit: np.ndarray
    rgb: np.ndarray
    counts: np.ndarray


@dataclass(frozen=True, eq=False)
class Batch:
    """Pixels (B,) in patches of n x n, patch after patch, row after row.

    origins, directions: (B, 3), origins from the skyboxes' centre. uv, spread: (B, 2). detail: (B,). hit, counts: (B,) bool.
    open: (B,) bool, neither the pixel nor one around it sees the mesh. rgb: (B, 3) in [0, 1]. views: (B,) int64, the image.
    """

    origins: Tensor
    directions: Tensor
    uv: Tensor
    spread: Tensor
    detail: Tensor
    hit: Tensor
    counts: Tensor
    open: Tensor
    rgb: Tensor
    views: Tensor
    patch: int

    def coarser(self, levels: Tensor) -> Batch:
        """The same pixels, as if each covered 2**levels as many texels along either side; levels: (B,) int64."""
        return replace(self, spread=self.spread * (2.0**levels)[:, None], detail=self.detail + levels)


def _open(hit: np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels that, with their eight neighbours, miss."""
    return ~binary_dilation(hit, np.ones((3, 3), bool))


class Pixels:
    """All pixels of ``views``, flat, on a device."""

    def __init__(self, views: Sequence[View], centre: np.ndarray, patch: int, device: torch.device):
        if not views:
            raise InputError("there is no training frame: the capture's split train is empty")
        self.patch = patch
        self.sizes = [view.hit.shape for view in views]
        if min(min(size) for size in self.sizes) < patch:
            raise InputError(f"patches of {patch} pixels do not fit an image of {min(self.sizes)} pixels: set a smaller patch")
        self.first = np.concatenate([[0], np.cumsum([h * w for h, w in self.sizes])[:-1]])

        def flat(name: str) -> Tensor:
            return torch.from_numpy(np.concatenate([getattr(v, name).reshape(v.hit.size, -1) for v in views])).to(device)

        self.origins = torch.from_numpy(np.stack([v.origin - centre for v in views]).astype(np.float32)).to(device)
        self.directions, self.uv, self.spread, self.rgb = (flat(name) for name in ("directions", "uv", "spread", "rgb"))
        self.detail, self.hit, self.counts = (flat(name)[:, 0] for name in ("detail", "hit", "counts"))
        self.open = torch.from_numpy(np.concatenate([_open(view.hit).ravel() for view in views])).to(device)

    def batch(self, pixels: Tensor, views: Tensor) -> Batch:
        """``pixels``: (B,) flat numbers, of these ``views`` (B,)."""
        return Batch(
            self.origins[views],
            *(
                values.index_select(0, pixels)
                for values in (self.directions, self.uv, self.spread, self.detail, self.hit, self.counts, self.open)
            ),
            self.rgb.index_select(0, pixels).float() / 255,
            views,
            self.patch,
        )

    def everything(self, size: int) -> Iterator[Batch]:
        """All pixels once, in order, at most ``size`` at a time and never of two views."""
        for view, (height, width) in enumerate(self.sizes):
            for start in range(0, height * width, size):
                pixels = torch.arange(start, min(start + size, height * width)) + int(self.first[view])
                pixels = pixels.to(self.uv.device)
                yield self.batch(pixels, torch.full_like(pixels, view))

    def patches(self, seed: int, count: int, start: int, stop: int) -> Iterator[Batch]:
        """The batches of steps ``start`` to ``stop``, of ``count`` patches each: a pure function of seed and step.

        Each epoch lays a grid of patches over every image, at a random offset, and goes through all of them in random order.
        """
        step, epoch, passed = 0, 0, 0
        while step < stop:
            views, corners = self._epoch(seed, epoch)
            whole = max(1, len(views) // count)
            for i in range(max(start - passed, 0), min(whole, stop - passed)):
                chosen = slice(i * count, (i + 1) * count)
                yield self._cut(views[chosen], corners[chosen])
            step = passed = passed + whole
            epoch += 1

    def _epoch(self, seed: int, epoch: int) -> tuple[np.ndarray, np.ndarray]:
        """Views (N,) and upper left corners (N, 2) of all patches of an epoch."""
        rng = np.random.default_rng([seed, epoch])
        views, corners = [], []
        for view, size in enumerate(self.sizes):
            shift = rng.integers(self.patch, size=2)
            rows, columns = (np.clip(np.arange(-shift[k], size[k], self.patch), 0, size[k] - self.patch) for k in range(2))
            grid = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1).reshape(-1, 2)
            views.append(np.full(len(grid), view))
            corners.append(grid)
        order = rng.permutation(sum(map(len, views)))
        return np.concatenate(views)[order], np.concatenate(corners)[order]

    def _cut(self, views: np.ndarray, corners: np.ndarray) -> Batch:
        widths = np.array([width for _, width in self.sizes])[views]
        inside = np.arange(self.patch)
        rows = corners[:, 0, None, None] + inside[:, None]
        columns = corners[:, 1, None, None] + inside
        pixels = self.first[views][:, None, None] + rows * widths[:, None, None] + columns
        device = self.uv.device
        of_view = torch.from_numpy(np.repeat(views, self.patch**2)).to(device)
        return self.batch(torch.from_numpy(pixels.reshape(-1)).to(device), of_view)
