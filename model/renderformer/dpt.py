"""The dense prediction head: four layers' ray tokens to pixels (section 3, item 8).

Names follow the released parameters. Works at 4, 2, 1 and 1/2 times the token grid and fuses from coarse to fine.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch.nn.functional as F
from torch import Tensor, nn


def _resize(x: Tensor, size: tuple[int, int]) -> Tensor:
    return F.interpolate(x, size=size, mode="bilinear", align_corners=True)


def pointwise(conv: nn.Conv2d, x: Tensor) -> Tensor:
    """A 1 x 1 convolution as the matrix product that it is, which also keeps the layout of tokens, channels last."""
    return F.linear(x.permute(0, 2, 3, 1), conv.weight.flatten(1), conv.bias).permute(0, 3, 1, 2)


class ResidualUnit(nn.Module):
    def __init__(self, features: int):
        super().__init__()
        self.conv1 = nn.Conv2d(features, features, 3, padding=1)
        self.conv2 = nn.Conv2d(features, features, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.conv2(F.silu(self.conv1(F.silu(x))))


class FusionBlock(nn.Module):
    """Adds the finer level's features to the coarser path, then brings both to ``size``."""

    def __init__(self, features: int, coarsest: bool):
        super().__init__()
        if not coarsest:  # there is no path yet that the first block could join
            self.resConvUnit1 = ResidualUnit(features)
        self.resConvUnit2 = ResidualUnit(features)
        self.out_conv = nn.Conv2d(features, features, 1)

    def forward(self, level: Tensor, path: Tensor | None, size: tuple[int, int]) -> Tensor:
        x = level if path is None else path + self.resConvUnit1(level)
        # A 1x1 convolution and an interpolation commute; before it, the convolution sees a quarter of the pixels.
        return _resize(pointwise(self.out_conv, self.resConvUnit2(x)), size)


class DPTHead(nn.Module):
    def __init__(self, dim: int, features: int, channels: Sequence[int], patch_size: int):
        super().__init__()
        self.patch_size = patch_size
        self.projects = nn.ModuleList(nn.Conv2d(dim, c, 1) for c in channels)
        self.resize_layers = nn.ModuleList(
            [
                nn.ConvTranspose2d(channels[0], channels[0], 4, stride=4),
                nn.ConvTranspose2d(channels[1], channels[1], 2, stride=2),
                nn.Identity(),
                nn.Conv2d(channels[3], channels[3], 3, stride=2, padding=1),
            ]
        )
        scratch = nn.Module()
        for i, c in enumerate(channels, start=1):
            scratch.add_module(f"layer{i}_rn", nn.Conv2d(c, features, 3, padding=1, bias=False))
            scratch.add_module(f"refinenet{i}", FusionBlock(features, coarsest=i == 4))
        scratch.output_conv1 = nn.Conv2d(features, features // 2, 3, padding=1)
        scratch.output_conv2 = nn.Sequential(nn.Conv2d(features // 2, 32, 3, padding=1), nn.SiLU(), nn.Conv2d(32, 3, 1))
        self.scratch = scratch

    def forward(self, layers: Sequence[Tensor], h: int, w: int) -> Tensor:
        """Four (B, h w, d) -> (B, 3, h p, w p)."""
        levels = []
        for i, tokens in enumerate(layers):
            grid = tokens.transpose(1, 2).unflatten(2, (h, w))
            level = self.resize_layers[i](pointwise(self.projects[i], grid))
            levels.append(getattr(self.scratch, f"layer{i + 1}_rn")(level))
        path = None
        for i in (3, 2, 1, 0):
            size = levels[i - 1].shape[-2:] if i else [2 * n for n in levels[0].shape[-2:]]
            path = getattr(self.scratch, f"refinenet{i + 1}")(levels[i], path, tuple(size))
        x = _resize(self.scratch.output_conv1(path), (h * self.patch_size, w * self.patch_size))
        first, activation, last = self.scratch.output_conv2
        return pointwise(last, activation(first(x)))
