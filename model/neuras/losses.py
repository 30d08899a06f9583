"""What patches are compared by besides their colours (eq. 8): by VGG16, or by a stand-in that needs no weights."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from model.lpips import Features
from model.weights import LPIPS_SET, VGG16

PerceptualNetwork = Literal["gradients", "vgg"]
# difference and truth, (B, 3) patch after patch, both 0 where pixels do not count, and the patches' side -> a loss
PerceptualLoss = Callable[[Tensor, Tensor, int], Tensor]


def vgg_file(folder: Path | str | None) -> Path:
    """VGG16's published file in ``folder``, or else where `lightmill weights lpips` puts it. A missing one is an error."""
    return LPIPS_SET.find(VGG16, folder, "fit.perceptual_network=vgg", "fit.perceptual_network=gradients")


def perceptual_loss(network: PerceptualNetwork, folder: Path | str | None, device: torch.device) -> PerceptualLoss:
    """The loss of that name. folder: of VGG16's weights."""
    return gradient_loss if network == "gradients" else VGGLoss(Features.load(vgg_file(folder)).to(device))


def gradient_loss(difference: Tensor, truth: Tensor, patch: int) -> Tensor:
    """L1 between the differences of neighbouring pixels, at three scales. ``difference``: prediction less truth."""
    image = _images(difference, patch)
    total = image.new_zeros(())
    for _ in range(3):
        total = total + (image[:, :, 1:] - image[:, :, :-1]).abs().mean() + (image[..., 1:] - image[..., :-1]).abs().mean()
        if min(image.shape[2:]) < 4:
            break
        image = torch.nn.functional.avg_pool2d(image, 2)
    return total


class VGGLoss:
    """Eq. 8: L1 between layers of VGG16, each divided by its number of elements; the last layer of each of its five blocks."""

    def __init__(self, features: Features):
        self.features = features

    def __call__(self, difference: Tensor, truth: Tensor, patch: int) -> Tensor:
        with torch.no_grad():
            wanted = self.features(_images(truth, patch))
        found = self.features(_images(truth + difference, patch))
        return torch.stack([(a - b).abs().mean() for a, b in zip(found, wanted, strict=True)]).sum()


def _images(pixels: Tensor, patch: int) -> Tensor:
    """(B, 3) patch after patch, row after row -> (N, 3, patch, patch)."""
    return pixels.view(-1, patch, patch, 3).permute(0, 3, 1, 2)
