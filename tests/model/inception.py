"""The Inception network by pytorch-fid's description, on the published file's tensors: what ours must agree with."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from model.inception import Inception
from model.weights import INCEPTION_2015


def write_weights(folder: Path) -> None:
    """Random weights in the layout of the published file, with what it holds besides."""
    generator = torch.Generator().manual_seed(1)
    tensors = {"fc.weight": torch.zeros(1008, 2048), "fc.bias": torch.zeros(1008)}
    for name, like in Inception().state_dict().items():
        if name.endswith("conv.weight"):
            tensors[name] = torch.randn(like.shape, generator=generator) * (2 / like[0].numel()) ** 0.5
        elif name.endswith(("bn.weight", "running_var")):
            tensors[name] = 0.5 + torch.rand(like.shape, generator=generator)
        elif not name.endswith("num_batches_tracked"):
            tensors[name] = 0.2 * torch.randn(like.shape, generator=generator)
    torch.save(tensors, folder / INCEPTION_2015.published)


def features(w: Mapping[str, Tensor], images: Tensor) -> Tensor:
    """(B, 3, 299, 299) in [0, 1] -> (B, 2048)."""

    def conv(x: Tensor, name: str, stride: int = 1, padding: int | tuple[int, int] = 0) -> Tensor:
        x = F.conv2d(x, w[f"{name}.conv.weight"], stride=stride, padding=padding)
        mean, variance = w[f"{name}.bn.running_mean"], w[f"{name}.bn.running_var"]
        x = (x - mean[:, None, None]) / (variance[:, None, None] + 0.001).sqrt()
        return (x * w[f"{name}.bn.weight"][:, None, None] + w[f"{name}.bn.bias"][:, None, None]).clamp(min=0)

    def mean_of_neighbours(x: Tensor) -> Tensor:
        inside = torch.ones_like(x[:1, :1])
        return F.avg_pool2d(x, 3, 1, 1) / F.avg_pool2d(inside, 3, 1, 1)

    def a(x: Tensor, n: str) -> Tensor:
        five = conv(conv(x, f"{n}.branch5x5_1"), f"{n}.branch5x5_2", padding=2)
        three = conv(conv(x, f"{n}.branch3x3dbl_1"), f"{n}.branch3x3dbl_2", padding=1)
        three = conv(three, f"{n}.branch3x3dbl_3", padding=1)
        return torch.cat([conv(x, f"{n}.branch1x1"), five, three, conv(mean_of_neighbours(x), f"{n}.branch_pool")], 1)

    def b(x: Tensor, n: str) -> Tensor:
        three = conv(conv(x, f"{n}.branch3x3dbl_1"), f"{n}.branch3x3dbl_2", padding=1)
        three = conv(three, f"{n}.branch3x3dbl_3", stride=2)
        return torch.cat([conv(x, f"{n}.branch3x3", stride=2), three, F.max_pool2d(x, 3, 2)], 1)

    def c(x: Tensor, n: str) -> Tensor:
        seven = conv(conv(x, f"{n}.branch7x7_1"), f"{n}.branch7x7_2", padding=(0, 3))
        seven = conv(seven, f"{n}.branch7x7_3", padding=(3, 0))
        long = conv(x, f"{n}.branch7x7dbl_1")
        for place, padding in ((2, (3, 0)), (3, (0, 3)), (4, (3, 0)), (5, (0, 3))):
            long = conv(long, f"{n}.branch7x7dbl_{place}", padding=padding)
        return torch.cat([conv(x, f"{n}.branch1x1"), seven, long, conv(mean_of_neighbours(x), f"{n}.branch_pool")], 1)

    def d(x: Tensor, n: str) -> Tensor:
        three = conv(conv(x, f"{n}.branch3x3_1"), f"{n}.branch3x3_2", stride=2)
        seven = conv(conv(x, f"{n}.branch7x7x3_1"), f"{n}.branch7x7x3_2", padding=(0, 3))
        seven = conv(conv(seven, f"{n}.branch7x7x3_3", padding=(3, 0)), f"{n}.branch7x7x3_4", stride=2)
        return torch.cat([three, seven, F.max_pool2d(x, 3, 2)], 1)

    def e(x: Tensor, n: str, pooled: Tensor) -> Tensor:
        def two(y: Tensor, name: str) -> list[Tensor]:
            return [conv(y, f"{name}a", padding=(0, 1)), conv(y, f"{name}b", padding=(1, 0))]

        three = two(conv(x, f"{n}.branch3x3_1"), f"{n}.branch3x3_2")
        double = conv(conv(x, f"{n}.branch3x3dbl_1"), f"{n}.branch3x3dbl_2", padding=1)
        double = two(double, f"{n}.branch3x3dbl_3")
        return torch.cat([conv(x, f"{n}.branch1x1"), *three, *double, conv(pooled, f"{n}.branch_pool")], 1)

    x = conv(conv(2 * images - 1, "Conv2d_1a_3x3", stride=2), "Conv2d_2a_3x3")
    x = F.max_pool2d(conv(x, "Conv2d_2b_3x3", padding=1), 3, 2)
    x = F.max_pool2d(conv(conv(x, "Conv2d_3b_1x1"), "Conv2d_4a_3x3"), 3, 2)
    for kind, letters in ((a, "bcd"), (b, None), (c, "bcde")):
        for letter in letters or "a":
            x = kind(x, f"Mixed_{5 if kind is a else 6}{letter}")
    x = d(x, "Mixed_7a")
    x = e(x, "Mixed_7b", mean_of_neighbours(x))
    x = e(x, "Mixed_7c", F.max_pool2d(x, 3, 1, 1))
    return x.flatten(2).mean(dim=2)
