"""How bright each photo is: an affine change of colour per image, so that one scene explains photos of different exposure.

Cameras choose exposure and white balance anew for every frame. Learned with the scene, the changes keep that out of the
textures. They average to none over the training images, so the scene keeps the mean exposure, and a new view has no change.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn


class Exposure(nn.Module):
    """colour' = colour + A colour + b, with A (3, 3) and b (3,) of each image; all zero at the start."""

    def __init__(self, images: int):
        super().__init__()
        self.change = nn.Parameter(torch.zeros(images, 3, 4))

    def changes(self) -> Tensor:
        """(images, 3, 4): A and b side by side, less their mean over all images."""
        return self.change - self.change.mean(dim=0)

    def forward(self, rgb: Tensor, images: Tensor) -> Tensor:
        """(B, 3) colours as the ``images`` (B,) have them."""
        change = self.changes()[images]
        return rgb + torch.einsum("bij,bj->bi", change[:, :, :3], rgb) + change[:, :, 3]


def matched(picture: np.ndarray, photo: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """``picture`` (H, W, 3) uint8 with the exposure of ``photo``: the affine change of colour that fits where ``counts``.

    counts: (H, W) bool. For scores beside others, take pixels that do not count here.
    """
    known = np.concatenate([picture[counts] / 255.0, np.ones((int(counts.sum()), 1))], axis=1)
    change = np.linalg.lstsq(known, photo[counts] / 255.0, rcond=None)[0]
    changed = (picture / 255.0) @ change[:3] + change[3]
    return np.round(255 * np.clip(changed, 0, 1)).astype(np.uint8)


def halves(size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) bool of ``size`` (H, W): the left half, to find an exposure on, and the right half, to score."""
    height, width = size
    left = np.broadcast_to(np.arange(width) < width // 2, (height, width))
    return left, ~left
