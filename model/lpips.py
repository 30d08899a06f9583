"""LPIPS: a learned distance between pictures, from published weight files."""

from __future__ import annotations

from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.errors import InputError
from model.weights import ALEX_HEADS, ALEXNET, LPIPS_SET, VGG16, VGG_HEADS, read

VGG16_POOL, ALEX_POOL = (2, 2), (3, 2)
NETWORKS = {
    "vgg": {
        "layers": [
            *[(64, 3, 1, 1)] * 2, VGG16_POOL, *[(128, 3, 1, 1)] * 2, VGG16_POOL, *[(256, 3, 1, 1)] * 3, VGG16_POOL,
            *[(512, 3, 1, 1)] * 3, VGG16_POOL, *[(512, 3, 1, 1)] * 3,
        ],
        "compared": (1, 4, 8, 12, 16),
        "files": (VGG16, VGG_HEADS),
    },
    "alex": {
        "layers": [
            (64, 11, 4, 2), ALEX_POOL, (192, 5, 1, 2), ALEX_POOL, (384, 3, 1, 1), (256, 3, 1, 1), (256, 3, 1, 1),
        ],
        "compared": (0, 2, 4, 5, 6),
        "files": (ALEXNET, ALEX_HEADS),
    },
}  # fmt: skip


class Features(nn.Module):
    """The convolutions of a published network: what it sees in images in [0, 1]. Frozen, but it passes gradients on to them."""

    def __init__(self, network: str = "vgg"):
        super().__init__()
        spec = NETWORKS[network]
        self.compared = spec["compared"]
        self.stages = nn.ModuleList()
        self.channels: list[int] = []  # of each compared layer
        channels = 3
        for index, layer in enumerate(spec["layers"]):
            if len(layer) == 2:
                self.stages.append(nn.MaxPool2d(*layer))
            else:
                self.stages.append(nn.Conv2d(channels, layer[0], layer[1], layer[2], layer[3]))
                channels = layer[0]
            if index in self.compared:
                self.channels.append(channels)
        # ImageNet statistics, in the [-1, 1] range that the published linear layers were fitted with.
        self.register_buffer("shift", torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1))
        self.register_buffer("scale", torch.tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1))
        self.requires_grad_(False).eval()

    @classmethod
    def load(cls, path: Path, network: str = "vgg") -> Features:
        """From torchvision's file; what follows the convolutions in it is left out."""
        tensors = read(path)
        features = cls(network)
        convolutions = [stage for stage in features.stages if isinstance(stage, nn.Conv2d)]
        try:
            numbers = sorted({int(key.split(".")[1]) for key in tensors if key.startswith("features.")})
            for number, stage in zip(numbers, convolutions, strict=True):
                stage.weight.data.copy_(tensors[f"features.{number}.weight"])
                stage.bias.data.copy_(tensors[f"features.{number}.bias"])
        except (KeyError, RuntimeError, ValueError) as error:
            raise InputError(f"{path} does not hold the weights of {network}: {error}") from None
        return features

    def forward(self, image: Tensor) -> list[Tensor]:
        """(B, 3, H, W) -> (B, C, h, w) of each compared layer, after its ReLU."""
        x = (2 * image - 1 - self.shift) / self.scale
        features = []
        for index, stage in enumerate(self.stages):
            x = stage(x)
            if isinstance(stage, nn.Conv2d):
                x = F.relu(x)
            if index in self.compared:
                features.append(x)
        return features


class LPIPS(nn.Module):
    """Learned perceptual distance between images in [0, 1]; frozen, but it passes gradients on to the images."""

    def __init__(self, features: Features):
        super().__init__()
        self.features = features
        self.linear = nn.ParameterList(nn.Parameter(torch.zeros(1, count, 1, 1)) for count in features.channels)
        self.requires_grad_(False).eval()

    @staticmethod
    def files(folder: Path | str | None, network: str = "vgg") -> list[Path]:
        """The two published files in ``folder``, or else where `lightmill weights lpips` puts them.

        A missing file is an error that says how to get it.
        """
        without = "train.lpips=0, evaluate.lpips=none"
        return [LPIPS_SET.find(file, folder, "LPIPS", without) for file in NETWORKS[network]["files"]]

    @classmethod
    def load(cls, folder: Path | str | None, network: str = "vgg") -> LPIPS:
        features, heads = cls.files(folder, network)
        metric = cls(Features.load(features, network))
        tensors = read(heads)
        try:
            for index, parameter in enumerate(metric.linear):
                parameter.data.copy_(tensors[f"lin{index}.model.1.weight"])
        except (KeyError, RuntimeError) as error:
            raise InputError(f"{heads} does not hold the linear layers of LPIPS: {error}") from None
        return metric

    def _directions(self, image: Tensor) -> list[Tensor]:
        """The features, each pixel's of length 1. The tiny number under the root keeps its gradient finite where all are 0."""
        return [x / (x.square().sum(dim=1, keepdim=True).add(1e-20).sqrt() + 1e-10) for x in self.features(image)]

    def forward(self, a: Tensor, b: Tensor, counts: Tensor | None = None) -> Tensor:
        """(B, 3, H, W) in [0, 1] each -> (B,) distances.

        counts: (H, W) bool. A place of a layer weighs as much as the share of its pixels that count; None: all do.
        """
        total = a.new_zeros(a.shape[0])
        for x, y, weight in zip(self._directions(a), self._directions(b), self.linear, strict=True):
            apart = ((x - y).square() * weight).sum(dim=1)
            if counts is None:
                total = total + apart.mean(dim=(1, 2))
            else:
                share = F.adaptive_avg_pool2d(counts[None, None].to(apart), apart.shape[1:])[:, 0]
                total = total + (apart * share).sum(dim=(1, 2)) / share.sum()
        return total
