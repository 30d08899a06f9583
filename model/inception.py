"""Inception-v3 of 2015 up to its last pooling: the features that FID and KID are defined by.

The network is torchvision's with what the original does otherwise: average pooling does not count the padding, and the last
block pools by the maximum. Classes are left out. So the features equal those of ``pytorch-fid``, whose published file it reads.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.errors import InputError
from model.weights import INCEPTION_2015, INCEPTION_SET, read

SIDE = 299  # pixels of what the network sees
FEATURES = 2048
ROW, COLUMN = (1, 7), (7, 1)
BOTH = ((1, 3), (3, 1))  # two convolutions of one input side by side

# A block: its branches as chains of (channels, kernel), and how its input is pooled. A chain's last kernel may be ``BOTH``.
# Where a block halves the picture ("half"), every chain ends with a stride of 2, and the pooled input has no convolution.
Branches = Mapping[str, list[tuple[int, Any]]]


def _a(pooled: int) -> Branches:
    return {
        "branch1x1": [(64, 1)],
        "branch5x5": [(48, 1), (64, 5)],
        "branch3x3dbl": [(64, 1), (96, 3), (96, 3)],
        "branch_pool": [(pooled, 1)],
    }


def _c(inner: int) -> Branches:
    return {
        "branch1x1": [(192, 1)],
        "branch7x7": [(inner, 1), (inner, ROW), (192, COLUMN)],
        "branch7x7dbl": [(inner, 1), (inner, COLUMN), (inner, ROW), (inner, COLUMN), (192, ROW)],
        "branch_pool": [(192, 1)],
    }


E: Branches = {
    "branch1x1": [(320, 1)],
    "branch3x3": [(384, 1), (384, BOTH)],
    "branch3x3dbl": [(448, 1), (384, 3), (384, BOTH)],
    "branch_pool": [(192, 1)],
}
BLOCKS: dict[str, tuple[Branches, str]] = {
    "Mixed_5b": (_a(32), "mean"),
    "Mixed_5c": (_a(64), "mean"),
    "Mixed_5d": (_a(64), "mean"),
    "Mixed_6a": ({"branch3x3": [(384, 3)], "branch3x3dbl": [(64, 1), (96, 3), (96, 3)]}, "half"),
    "Mixed_6b": (_c(128), "mean"),
    "Mixed_6c": (_c(160), "mean"),
    "Mixed_6d": (_c(160), "mean"),
    "Mixed_6e": (_c(192), "mean"),
    "Mixed_7a": (
        {"branch3x3": [(192, 1), (320, 3)], "branch7x7x3": [(192, 1), (192, ROW), (192, COLUMN), (192, 3)]},
        "half",
    ),
    "Mixed_7b": (E, "mean"),
    "Mixed_7c": (E, "max"),
}


class Convolution(nn.Module):
    """A convolution, batch normalization and ReLU."""

    def __init__(self, channels: int, out: int, kernel: Any, stride: int = 1, padding: Any = 0):
        super().__init__()
        self.conv = nn.Conv2d(channels, out, kernel, stride, padding, bias=False)
        self.bn = nn.BatchNorm2d(out, eps=0.001)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.bn(self.conv(x)))


class Block(nn.Module):
    """Branches of one input, their outputs one after the other in the channels. Names are those of the published file."""

    def __init__(self, channels: int, branches: Branches, pooling: str):
        super().__init__()
        self.pooling, self.out, self.chains = pooling, 0, {}
        for branch, chain in branches.items():
            inner, self.chains[branch] = channels, []
            for place, (out, kernel) in enumerate(chain, 1):
                name = branch if len(chain) == 1 else f"{branch}_{place}"
                kernels = {f"{name}a": BOTH[0], f"{name}b": BOTH[1]} if kernel is BOTH else {name: kernel}
                stride = 2 if pooling == "half" and place == len(chain) else 1
                for each, size in kernels.items():
                    padding = 0 if stride == 2 else tuple(n // 2 for n in size) if isinstance(size, tuple) else size // 2
                    self.add_module(each, Convolution(inner, out, size, stride, padding))
                self.chains[branch].append(tuple(kernels))
                inner = out * len(kernels)
            self.out += inner
        if pooling == "half":
            self.out += channels

    def forward(self, x: Tensor) -> Tensor:
        pooled = self._pooled(x)
        found = []
        for branch, chain in self.chains.items():
            y = pooled if branch == "branch_pool" else x
            for names in chain:
                y = torch.cat([self.get_submodule(name)(y) for name in names], dim=1)
            found.append(y)
        return torch.cat([*found, pooled] if self.pooling == "half" else found, dim=1)

    def _pooled(self, x: Tensor) -> Tensor:
        if self.pooling == "half":
            return F.max_pool2d(x, 3, stride=2)
        if self.pooling == "max":
            return F.max_pool2d(x, 3, stride=1, padding=1)
        return F.avg_pool2d(x, 3, stride=1, padding=1, count_include_pad=False)


class Inception(nn.Module):
    """Images in [0, 1] to features. Frozen."""

    def __init__(self) -> None:
        super().__init__()
        self.Conv2d_1a_3x3 = Convolution(3, 32, 3, stride=2)
        self.Conv2d_2a_3x3 = Convolution(32, 32, 3)
        self.Conv2d_2b_3x3 = Convolution(32, 64, 3, padding=1)
        self.Conv2d_3b_1x1 = Convolution(64, 80, 1)
        self.Conv2d_4a_3x3 = Convolution(80, 192, 3)
        channels = 192
        for name, (branches, pooling) in BLOCKS.items():
            block = Block(channels, branches, pooling)
            self.add_module(name, block)
            channels = block.out
        self.requires_grad_(False).eval()

    @staticmethod
    def file(folder: Path | str | None) -> Path:
        """The published file in ``folder``, or else where `lightmill weights inception` puts it. A missing one is an error."""
        return INCEPTION_SET.find(INCEPTION_2015, folder, "FID", "evaluate.inception=false")

    @classmethod
    def load(cls, folder: Path | str | None) -> Inception:
        path = cls.file(folder)
        network, tensors = cls(), read(path)
        own = {name for name in network.state_dict() if not name.endswith("num_batches_tracked")}
        try:
            network.load_state_dict({name: tensors[name] for name in own}, strict=False)
        except (KeyError, RuntimeError) as error:
            raise InputError(f"{path} does not hold the Inception network of FID: {error}") from None
        return network

    def forward(self, images: Tensor) -> Tensor:
        """(B, 3, H, W) -> (B, 2048). Resized by bilinear samples without a filter, as the metric's authors do."""
        x = 2 * F.interpolate(images, (SIDE, SIDE), mode="bilinear", align_corners=False) - 1
        x = self.Conv2d_2b_3x3(self.Conv2d_2a_3x3(self.Conv2d_1a_3x3(x)))
        x = F.max_pool2d(x, 3, stride=2)
        x = F.max_pool2d(self.Conv2d_4a_3x3(self.Conv2d_3b_1x1(x)), 3, stride=2)
        for name in BLOCKS:
            x = self.get_submodule(name)(x)
        return x.mean(dim=(2, 3))
