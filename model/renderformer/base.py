"""What training and inference know of a network: RenderFormer's and the guided one are built, fed and asked in one way."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

Arrays = Mapping[str, Any]  # of a batch, as ``stages.renderformer.dataset`` lists them


class Network(nn.Module, ABC):
    """A renderer of triangle meshes. Images are log10(1 + radiance)."""

    config: Any  # has ``resolution_multiple``, ``to_dict`` and ``dumps``
    reads_guides = False  # whether batches and views must hold what ray casting says of them
    reads_bounces = False  # whether also what rays from its triangles hit
    whole_views = True  # whether it needs all ray bundles of a view at once

    @abstractmethod
    def arguments(self, batch: Arrays, device: torch.device | str) -> tuple[Any, ...]:
        """What ``forward`` takes before ``precision``, of a batch with its cameras. The images' pixels are not read."""

    @abstractmethod
    def frames(self, scene: Arrays, views: Iterable[Arrays], size: tuple[int, int], device: Any) -> Iterator[Tensor]:
        """(H, W, 3) of one scene's views in order, in float32, in memory that does not grow with their number.

        scene: arrays of a batch of one. views: of each, the arrays that a batch of it has besides them.
        """

    @abstractmethod
    def layers(self) -> list[nn.Module]:
        """The units of compilation, recomputation and sharding."""

    @abstractmethod
    def flops(self, batch: Arrays) -> dict[str, float]:
        """Floating-point operations of a forward pass by part."""

    @abstractmethod
    def tokens(self, batch: Arrays) -> int:
        """Triangles, registers and ray bundles of the batch."""

    def gathering_layers(self) -> list[nn.Module]:
        """The layers in which ray bundles attend to triangles' tokens."""
        return []

    def without_learning(self) -> Network | None:
        """This network as it was before training, where its image is more than noise then."""
        return None

    def leak_gradient(self, share: float) -> None:
        """Pass this share of the gradient to outputs that are negative, besides what the network passes itself."""

    def compile_layers(self, backend: str = "inductor") -> None:
        """``torch.compile`` for the layers, in place: a few small graphs for all of them, whatever the number of triangles."""
        for layer in self.layers():
            layer.compile(backend=backend)

    def activation_checkpointing(self, on: bool = True) -> None:
        """Keep only the layers' inputs for the backward pass and compute the rest again: same result, less memory."""
        for layer in self.layers():
            layer.recompute = on


def run_layer(layer: nn.Module, *inputs: object) -> Tensor:
    """The layer's output; where ``activation_checkpointing`` is on, inner results are computed again in the backward pass."""
    if getattr(layer, "recompute", False) and torch.is_grad_enabled():
        return checkpoint(layer, *inputs, use_reentrant=False)
    return layer(*inputs)


def autocast(device: str, on: bool) -> AbstractContextManager:
    """bfloat16 for matrix products where ``on``."""
    return torch.autocast(device, dtype=torch.bfloat16) if on else nullcontext()
