"""How long a model takes, step by step, on scenes of several sizes (paper, table 2).

Times are measured, so they are no part of records, digests or keys. One image at a time, in float32, as *evaluate* predicts.
"""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from model.renderformer.network import RenderFormer
    from stages.renderformer.dataset import Sample

REPEATS = 3
STEPS: Mapping[str, str] = {  # of a forward pass; reading the arrays is left out
    "encode": "view-independent stage, per scene",
    "project": "keys and values for the rays, per scene",
    "rays": "view-dependent layers, per image",
    "head": "decoding to pixels, per image",
}
PER_IMAGE = ("rays", "head")


def time_model(model: RenderFormer, samples: Sequence[Sample], device: str) -> dict[str, Any]:
    """Seconds by step for the first view of each sample: ``scenes``, a row for each, and their ``median``.

    Beside them what they depend on: ``device``, ``threads``, ``resolution``, ``repeats``.
    """
    import torch

    from model.renderformer.timing import time_steps
    from stages.renderformer.dataset import collate, make_example

    model = model.to(device).eval()
    rows = []
    for sample in samples:
        batch = collate([make_example(sample, list(sample.views)[:1], None)], 1)
        seconds = time_steps(model, batch, batch["image"].shape[2:4], device, REPEATS)
        row = {"id": sample.scene.id, "triangles": len(sample.scene.triangles)}
        rows.append(row | {step: round(seconds[step], 6) for step in STEPS})
    return {
        "device": torch.cuda.get_device_name() if device == "cuda" else processor_name(),
        "threads": None if device == "cuda" else torch.get_num_threads(),
        "resolution": next(iter(samples[0].views.values())).image.shape[0],
        "repeats": REPEATS,
        "scenes": rows,
        "median": {step: round(median(row[step] for row in rows), 6) for step in STEPS},
    }


def processor_name() -> str:
    """The processor's name as Linux gives it; elsewhere the name of its kind."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
