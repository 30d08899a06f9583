"""Which device PyTorch runs on: one rule for training, prediction and evaluation."""

from __future__ import annotations

from pipeline.errors import UserError


def choose_device(choice: str, setting: str) -> str:
    """The device to use: cpu or cuda. ``choice`` auto takes CUDA where there is one, else the CPU.

    ``setting`` is the name of the choice in errors.
    """
    import torch

    if choice == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if choice not in ("cpu", "cuda"):
        raise UserError(f"{setting}={choice!r} is unknown: auto, cpu or cuda")
    if choice == "cuda" and not torch.cuda.is_available():
        raise UserError(f"{setting}=cuda, but torch sees no GPU: use {setting}=cpu, or install the CUDA build of torch")
    return choice
