"""The networks that turn features into colours: three layers of 32 hidden units (section 3.2).

They start as the identity on the first three channels, and a skybox's opacity as the sigmoid of the fourth: so the first
picture is made of the colours that the texels start from. ReLU lets colours through, because they are not negative.

Further channels learn at a share of the rate (``QUIET``), and the first layer's weights on them begin as many times larger. So
they change the picture as fast as at the full rate, and stay small. Codes are chosen by distance, so they are spent on what is
large: on colours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

COLOUR, OPACITY = slice(0, 3), 3  # channels of a feature at the start
QUIET = 0.1  # how fast channels without such a meaning learn, beside those with one


@dataclass(frozen=True)
class ShaderConfig:
    """channels: D of a feature; hidden: units of a layer; layers: 3 in the paper, 0 for none; view_direction: of the ray."""

    channels: int = 12
    hidden: int = 32
    layers: int = 3
    view_direction: bool = True


class MeshShader(nn.Module):
    """f_T of eq. 2."""

    NAMED = 3  # channels that mean something at the start

    def __init__(self, config: ShaderConfig):
        super().__init__()
        self.view_direction = config.view_direction and config.layers > 0
        widths = [config.channels + 3 * self.view_direction, *[config.hidden] * (config.layers - 1), 3]
        self.layers = _layers(widths) if config.layers else nn.ModuleList()
        for layer in self.layers[:1]:
            _raise(layer, self.NAMED, config.channels)

    def forward(self, features: Tensor, directions: Tensor) -> Tensor:
        """Colours (N, 3) of features (N, D) seen along unit ``directions`` (N, 3)."""
        return _colour(self.layers, torch.cat([features, directions], dim=1) if self.view_direction else features)


class SkyShader(nn.Module):
    """f_S of eq. 3: the first layer reads the feature alone and yields the opacity, so that does not depend on the view."""

    NAMED = 4

    def __init__(self, config: ShaderConfig):
        super().__init__()
        self.view_direction = config.view_direction and config.layers > 0
        widths = [config.hidden + 3 * self.view_direction, *[config.hidden] * (config.layers - 2), 3]
        self.trunk = _layers([config.channels, config.hidden]) if config.layers else nn.ModuleList()
        self.layers = _layers(widths) if config.layers else nn.ModuleList()
        self.opacity = nn.Linear(config.hidden if config.layers else config.channels, 1)
        with torch.no_grad():
            self.opacity.weight.zero_()
            self.opacity.bias.zero_()
            self.opacity.weight[0, OPACITY] = 1.0
            for layer in self.trunk:  # ReLU halves a number: one unit for each sign
                _raise(layer, self.NAMED, config.channels)
                layer.weight[OPACITY : OPACITY + 2] = 0
                layer.bias[OPACITY : OPACITY + 2] = 0
                layer.weight[OPACITY, OPACITY], layer.weight[OPACITY + 1, OPACITY] = 1.0, -1.0
                self.opacity.weight[0, OPACITY + 1] = -1.0

    def forward(self, features: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Colours (N, 3) and opacities (N,)."""
        hidden = features
        for layer in self.trunk:
            hidden = torch.relu(layer(hidden))
        seen = torch.cat([hidden, directions], dim=1) if self.view_direction else hidden
        return _colour(self.layers, seen), torch.sigmoid(self.opacity(hidden))[:, 0]


def composite(colours: Tensor, opacities: Tensor) -> Tensor:
    """(N, 3): layers (N, L, 3) with ``opacities`` (N, L), near to far (eq. 4)."""
    passed = torch.cumprod(1 - opacities, dim=1)
    before = torch.cat([torch.ones_like(passed[:, :1]), passed[:, :-1]], dim=1)
    return ((opacities * before)[:, :, None] * colours).sum(dim=1)


def arrays(layers: nn.ModuleList | list[nn.Linear]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Weights and biases, as ``Baked`` holds them."""
    return [tuple(p.detach().float().cpu().numpy().copy() for p in (layer.weight, layer.bias)) for layer in layers]


def _layers(widths: list[int]) -> nn.ModuleList:
    """Linear layers that pass their first three inputs through."""
    layers = nn.ModuleList(nn.Linear(a, b) for a, b in zip(widths[:-1], widths[1:], strict=True))
    with torch.no_grad():
        for layer in layers:
            if layer.out_features == 3:
                layer.weight *= 0.1  # what else there is begins quietly
            layer.weight[COLOUR] *= layer.out_features == 3
            layer.bias[COLOUR] = 0
            layer.weight[COLOUR, COLOUR] = torch.eye(3)
    return layers


def _raise(layer: nn.Linear, first: int, last: int) -> None:
    """Make the weights on the channels ``first`` to ``last`` larger, by as much as those channels learn more slowly."""
    with torch.no_grad():
        layer.weight[:, first:last] /= QUIET


def _colour(layers: nn.ModuleList, x: Tensor) -> Tensor:
    for layer in layers[:-1]:
        x = torch.relu(layer(x))
    return layers[-1](x) if len(layers) else x[:, COLOUR]
