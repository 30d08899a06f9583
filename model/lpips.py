"""LPIPS: a learned distance between pictures, from published weight files."""

from __future__ import annotations

import os
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.errors import InputError

VGG16_POOL, ALEX_POOL = (2, 2), (3, 2)
NETWORKS = {
    "vgg": {
        "layers": [
            *[(64, 3, 1, 1)] * 2, VGG16_POOL, *[(128, 3, 1, 1)] * 2, VGG16_POOL, *[(256, 3, 1, 1)] * 3, VGG16_POOL,
            *[(512, 3, 1, 1)] * 3, VGG16_POOL, *[(512, 3, 1, 1)] * 3,
        ],  # fmt: skip
        "compared": (1, 4, 8, 12, 16),
        "features": ("vgg16-397923af.pth", "https://download.pytorch.org/models/vgg16-397923af.pth"),
        "linear": ("vgg.pth", "https://github.com/richzhang/PerceptualSimilarity/raw/master/lpips/weights/v0.1/vgg.pth"),
    },
    "alex": {
        "layers": [
            (64, 11, 4, 2), ALEX_POOL, (192, 5, 1, 2), ALEX_POOL, (384, 3, 1, 1), (256, 3, 1, 1), (256, 3, 1, 1),
        ],  # fmt: skip
        "compared": (0, 2, 4, 5, 6),
        "features": ("alexnet-owt-7be5be79.pth", "https://download.pytorch.org/models/alexnet-owt-7be5be79.pth"),
        "linear": ("alex.pth", "https://github.com/richzhang/PerceptualSimilarity/raw/master/lpips/weights/v0.1/alex.pth"),
    },
}  # fmt: skip
FOLDER_VARIABLE = "LIGHTMILL_LPIPS"  # where the weight files lie, if the config does not say


class LPIPS(nn.Module):
    """Learned perceptual distance between images in [0, 1]; frozen, but it passes gradients on to the images."""

    def __init__(self, network: str = "vgg"):
        super().__init__()
        spec = NETWORKS[network]
        self.compared = spec["compared"]
        self.stages = nn.ModuleList()
        self.linear = nn.ParameterList()
        channels = 3
        for index, layer in enumerate(spec["layers"]):
            if len(layer) == 2:
                self.stages.append(nn.MaxPool2d(*layer))
            else:
                self.stages.append(nn.Conv2d(channels, layer[0], layer[1], layer[2], layer[3]))
                channels = layer[0]
            if index in self.compared:
                self.linear.append(nn.Parameter(torch.zeros(1, channels, 1, 1)))
        # ImageNet statistics, in the [-1, 1] range that the published linear layers were fitted with.
        self.register_buffer("shift", torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1))
        self.register_buffer("scale", torch.tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1))
        self.requires_grad_(False).eval()

    @classmethod
    def load(cls, folder: Path | None, network: str = "vgg") -> LPIPS:
        """From the two published files in ``folder``, or else in the one that LIGHTMILL_LPIPS names.

        A missing file is an error that says where to get it.
        """
        spec = NETWORKS[network]
        if folder is None and os.environ.get(FOLDER_VARIABLE):
            folder = Path(os.environ[FOLDER_VARIABLE]).expanduser()
        loaded = []
        for name, url in (spec["features"], spec["linear"]):
            path = None if folder is None else Path(folder) / name
            if path is None or not path.is_file():
                where = f"no folder is named (lpips_folder, or {FOLDER_VARIABLE})" if path is None else f"{path} does not exist"
                without = "go without: train.lpips=0, evaluate.lpips=none"
                raise InputError(f"LPIPS needs {name}, but {where}: get it from {url}, or {without}")
            loaded.append(torch.load(path, map_location="cpu", weights_only=True))
        features, linear = loaded
        metric = cls(network)
        convolutions = [stage for stage in metric.stages if isinstance(stage, nn.Conv2d)]
        numbers = sorted({int(key.split(".")[1]) for key in features if key.startswith("features.")})
        try:
            for number, stage in zip(numbers, convolutions, strict=True):
                stage.weight.data.copy_(features[f"features.{number}.weight"])
                stage.bias.data.copy_(features[f"features.{number}.bias"])
            for index, parameter in enumerate(metric.linear):
                parameter.data.copy_(linear[f"lin{index}.model.1.weight"])
        except (KeyError, RuntimeError, ValueError) as error:
            names = f"{spec['features'][0]} and {spec['linear'][0]}"
            raise InputError(f"{folder}: {names} do not hold the published LPIPS weights: {error}") from None
        return metric

    def _features(self, image: Tensor) -> list[Tensor]:
        x = (2 * image - 1 - self.shift) / self.scale
        features = []
        for index, stage in enumerate(self.stages):
            x = stage(x)
            if isinstance(stage, nn.Conv2d):
                x = F.relu(x)
            if index in self.compared:
                # The tiny number under the root keeps its gradient finite where all features are 0.
                features.append(x / (x.square().sum(dim=1, keepdim=True).add(1e-20).sqrt() + 1e-10))
        return features

    def forward(self, a: Tensor, b: Tensor) -> Tensor:
        """(B, 3, H, W) in [0, 1] each -> (B,) distances."""
        total = a.new_zeros(a.shape[0])
        for x, y, weight in zip(self._features(a), self._features(b), self.linear, strict=True):
            total = total + ((x - y).square() * weight).sum(dim=1).mean(dim=(1, 2))
        return total
