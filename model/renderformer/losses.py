"""The training loss: L1 on log10(1 + radiance), plus LPIPS on the tone-mapped image (section 3.3).

LPIPS (Zhang et al. 2018) comes from two published weight files (``model.lpips``): torchvision's ImageNet network and the
metric's linear layers. A weight of 0 never looks for either.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from model.lpips import LPIPS

# Per network: its layers as (output channels, kernel, stride, padding) or a pooling (kernel, stride), after which layers the
# features are compared, and where the weights come from.


def log_radiance(image: Tensor) -> Tensor:
    """Linear radiance -> log10(1 + radiance), the space in which the network works."""
    return torch.log10(1 + image)


def tone_map(y: Tensor) -> Tensor:
    """log10(1 + radiance) -> display value in [0, 1], where radiance 1 is white; differentiable where it does not clamp."""
    return (y / math.log10(2)).clamp(0, 1)


def image_loss(y: Tensor, image: Tensor, lpips: LPIPS | None, lpips_weight: float) -> Tensor:
    """y: (B, V, H, W, 3) predicted log10(1 + radiance); image: the same shape, radiance. Always in float32."""
    target = log_radiance(image.float())
    loss = F.l1_loss(y.float(), target)
    if lpips is not None and lpips_weight > 0:
        a, b = (tone_map(x).flatten(0, 1).permute(0, 3, 1, 2) for x in (y.float(), target))
        loss = loss + lpips_weight * lpips(a, b).mean()
    return loss
