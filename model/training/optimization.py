"""Learning rates, optimizers and the average of the weights (section 3.3)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from model.errors import InputError


def schedule(step: int, steps: int, warmup: int, decay_steps: int | None, final: float) -> float:
    """Share of the highest learning rate at the 0-based step: linear warm-up, then cosine to ``final``."""
    if step < warmup:
        return (step + 1) / warmup
    end = steps if decay_steps is None else decay_steps
    progress = min(1.0, (step - warmup) / max(1, end - warmup))
    return final + (1 - final) * 0.5 * (1 + math.cos(math.pi * progress))


def build_optimizers(
    model: nn.Module, name: str, lr: float, muon_lr: float, weight_decay: float
) -> list[torch.optim.Optimizer]:
    """AdamW for all, or Muon for the transformer layers' matrices and AdamW for the rest.

    Norms, biases and tokens do not decay. Every group remembers its highest learning rate as ``peak_lr``.
    """
    named = [(key, p) for key, p in model.named_parameters() if p.requires_grad]
    hidden = {key for key, p in named if p.ndim == 2 and ".layers." in key}
    if name == "adamw":
        hidden = set()
    elif name != "muon":
        raise InputError(f"optimizer={name!r} is unknown: adamw or muon")
    others = [(key, p) for key, p in named if key not in hidden]
    decayed = [p for key, p in others if p.ndim >= 2 and "token" not in key]
    plain = [p for key, p in others if not (p.ndim >= 2 and "token" not in key)]
    groups = [{"params": decayed, "weight_decay": weight_decay}, {"params": plain, "weight_decay": 0.0}]
    optimizers: list[torch.optim.Optimizer] = [torch.optim.AdamW([g for g in groups if g["params"]], lr=lr, betas=(0.9, 0.95))]
    if hidden:
        matrices = [p for key, p in named if key in hidden]
        optimizers.append(torch.optim.Muon(matrices, lr=muon_lr, weight_decay=weight_decay))
    for optimizer in optimizers:
        for group in optimizer.param_groups:
            group["peak_lr"] = group["lr"]
    return optimizers


def set_learning_rate(optimizers: list[torch.optim.Optimizer], share: float) -> None:
    """``share`` of every group's highest learning rate."""
    for optimizer in optimizers:
        for group in optimizer.param_groups:
            group["lr"] = share * group["peak_lr"]


class Average:
    """Exponential moving average of a model's parameters: what is validated and saved where it is on."""

    def __init__(self, model: nn.Module, decay: float):
        self.model, self.decay = model, decay
        self.values: dict[str, Tensor] = {name: p.detach().clone() for name, p in model.named_parameters()}

    @torch.no_grad()
    def update(self) -> None:
        for name, parameter in self.model.named_parameters():
            self.values[name].mul_(self.decay).add_(parameter, alpha=1 - self.decay)

    @contextmanager
    def in_place(self) -> Iterator[None]:
        """The model with the averaged weights, for as long as the context lasts."""
        current = {name: p.detach().clone() for name, p in self.model.named_parameters()}
        self._assign(self.values)
        try:
            yield
        finally:
            self._assign(current)

    @torch.no_grad()
    def _assign(self, values: dict[str, Tensor]) -> None:
        for name, parameter in self.model.named_parameters():
            parameter.copy_(values[name])
