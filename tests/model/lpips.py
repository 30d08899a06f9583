"""LPIPS by its definition (Zhang et al. 2018, equation 1), written out in float64 numpy: what the network must agree with."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from model.lpips import LPIPS, NETWORKS, Features
from model.weights import WeightFile

# torchvision's networks: convolutions by number, as (stride, padding), after which the features are compared; "pool" between
WRITTEN_OUT = {
    "vgg": (
        [0, 2, "pool", 5, 7, "pool", 10, 12, 14, "pool", 17, 19, 21, "pool", 24, 26, 28], {}, {2, 7, 14, 21, 28}, 2,
    ),
    "alex": ([0, "pool", 3, "pool", 6, 8, 10], {0: (4, 2), 3: (1, 2)}, {0, 3, 6, 8, 10}, 3),
}  # fmt: skip
MEAN, DEVIATION = np.array([-0.030, -0.088, -0.188])[:, None, None], np.array([0.458, 0.448, 0.450])[:, None, None]


def write_weights(folder: Path, network: str) -> None:
    """Random weights in the layout of the published files."""
    torch.manual_seed(1)
    spec = NETWORKS[network]
    metric = LPIPS(Features(network))
    features = {"classifier.0.weight": torch.zeros(1)}
    number = 0
    for layer, stage in zip(spec["layers"], metric.features.stages, strict=True):
        if len(layer) == 4:
            features[f"features.{number}.weight"] = torch.randn_like(stage.weight) / math.sqrt(stage.weight[0].numel())
            features[f"features.{number}.bias"] = torch.randn_like(stage.bias) * 0.1
        number += 2 if len(layer) == 4 else 1  # a ReLU follows each convolution
    linear = {f"lin{i}.model.1.weight": torch.rand_like(parameter) for i, parameter in enumerate(metric.linear)}
    for tensors, file in zip((features, linear), spec["files"], strict=True):
        torch.save(tensors, folder / file.published)


def levels(folder: Path, network: str, image: np.ndarray) -> Iterator[np.ndarray]:
    """(C, h, w) of each compared layer, of a (3, H, W) image in [0, 1]; convolutions are sums over shifted images."""
    features = _arrays(folder, NETWORKS[network]["files"][0])
    layers, geometry, compared, pool_size = WRITTEN_OUT[network]

    def convolve(x, number):
        weight, bias = features[f"features.{number}.weight"], features[f"features.{number}.bias"]
        stride, padding = geometry.get(number, (1, 1))
        x = np.pad(x, ((0, 0), (padding, padding), (padding, padding)))
        rows, columns = ((n - weight.shape[-1]) // stride + 1 for n in x.shape[1:])
        out = np.zeros((len(weight), rows, columns)) + bias[:, None, None]
        for i, j in np.ndindex(weight.shape[2:]):
            window = x[:, i : i + stride * rows : stride, j : j + stride * columns : stride]
            out += np.tensordot(weight[:, :, i, j], window, axes=1)
        return np.maximum(out, 0)

    def pool(x):
        rows, columns = ((n - pool_size) // 2 + 1 for n in x.shape[1:])
        return np.max(
            [x[:, i : i + 2 * rows : 2, j : j + 2 * columns : 2] for i, j in np.ndindex(pool_size, pool_size)], axis=0
        )

    x = (2 * image - 1 - MEAN) / DEVIATION
    for layer in layers:
        x = pool(x) if layer == "pool" else convolve(x, layer)
        if layer in compared:
            yield x


def distance(folder: Path, network: str, a: np.ndarray, b: np.ndarray) -> float:
    """Between (3, H, W) images in [0, 1], by the weight files in ``folder``."""
    linear = _arrays(folder, NETWORKS[network]["files"][1])

    def directions(image):
        return (x / (np.sqrt((x**2).sum(axis=0)) + 1e-10) for x in levels(folder, network, image))

    return sum(
        ((x - y) ** 2 * linear[f"lin{i}.model.1.weight"][0]).sum(axis=0).mean()
        for i, (x, y) in enumerate(zip(directions(a), directions(b), strict=True))
    )


def _arrays(folder: Path, file: WeightFile) -> dict[str, np.ndarray]:
    return {key: value.double().numpy() for key, value in torch.load(folder / file.published, weights_only=True).items()}
