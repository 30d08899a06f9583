"""How long a forward pass takes, step by step (paper, table 2).

The view-independent stage runs once per scene. So does the projection of its tokens to the keys and values that the
view-dependent layers read. The layers and the head (DPT, or one linear layer) run once per image.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
import torch

from model.renderformer.network import RenderFormer
from model.timing import wait

STEPS = ("read", "encode", "project", "rays", "head")  # in this order; read: arrays to tensors


def time_steps(
    model: RenderFormer, batch: Mapping[str, Any], resolution: int | tuple[int, int], device: str, repeats: int
) -> dict[str, float]:
    """Seconds by step: of each the least of ``repeats`` passes in float32, after one that warms up.

    batch: arrays of scenes as `RenderFormer.read` takes them, and ``camera_to_world`` (B, V, 4, 4) and ``fov_deg`` (B, V).
    """
    passes = [_one_pass(model, batch, resolution, device) for _ in range(repeats + 1)][1:]
    return {step: min(seconds[step] for seconds in passes) for step in STEPS}


def _one_pass(
    model: RenderFormer, batch: Mapping[str, Any], resolution: int | tuple[int, int], device: str
) -> dict[str, float]:
    cameras, fov_deg = (torch.from_numpy(np.asarray(batch[name])).to(device) for name in ("camera_to_world", "fov_deg"))
    view = model.view_transformer
    moments: list[float] = []

    def mark(*_: Any) -> None:
        wait(device)
        moments.append(time.perf_counter())

    head = view.out_dpt if model.config.use_dpt_decoder else view.out_proj
    hook = head.register_forward_pre_hook(mark)
    try:
        with torch.inference_mode():
            mark()
            scenes = model.read(batch, device)
            mark()
            tokens = model.encode(scenes)
            mark()
            keys_values = view.project(tokens)
            mark()
            model.decode(tokens, cameras, fov_deg, resolution, keys_values)
            mark()
    finally:
        hook.remove()
    return {step: end - start for step, (start, end) in zip(STEPS, pairwise(moments), strict=True)}
