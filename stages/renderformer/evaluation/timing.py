"""How long a model takes, stage by stage (paper, table 2): measured, so no part of records, digests or keys.

The view-independent stage runs once per scene; its result, and the keys and values that the view-dependent layers make of it,
serve every camera. The head (DPT, or one linear layer) decodes ray tokens to pixels. One image at a time, in float32, as
*evaluate* predicts; other work on the machine makes it slower, so the least of several runs counts.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from model.renderformer.network import RenderFormer
    from stages.renderformer.dataset import Sample

STEPS: Mapping[str, str] = {
    "encode": "view-independent stage, per scene",
    "project": "keys and values for the rays, per scene",
    "rays": "view-dependent layers, per image",
    "head": "decoding to pixels, per image",
}
PER_IMAGE = ("rays", "head")
REPEATS = 3


def time_model(model: RenderFormer, samples: Sequence[Sample], device: str) -> dict[str, Any]:
    """Seconds by step for the first view of each sample: ``scenes``, a row for each, and their ``median``.

    Beside them what they depend on: ``device``, ``threads``, ``resolution``, ``repeats``.
    """
    import torch

    model = model.to(device).eval()
    rows = []
    for sample in samples:
        seconds = [_run(model, sample, device) for _ in range(REPEATS + 1)][1:]  # the first one warms up
        best = {step: round(min(run[step] for run in seconds), 6) for step in STEPS}
        rows.append({"id": sample.scene.id, "triangles": len(sample.scene.triangles), **best})
    return {
        "device": torch.cuda.get_device_name() if device == "cuda" else _processor(),
        "threads": None if device == "cuda" else torch.get_num_threads(),
        "resolution": next(iter(samples[0].views.values())).image.shape[0],
        "repeats": REPEATS,
        "scenes": rows,
        "median": {step: round(median(row[step] for row in rows), 6) for step in STEPS},
    }


def _run(model: RenderFormer, sample: Sample, device: str) -> dict[str, float]:
    import torch

    from stages.renderformer.dataset import collate, make_example

    batch = collate([make_example(sample, list(sample.views)[:1], None)], 1)
    scene = model.read(batch, device)
    cameras, fov = (torch.from_numpy(batch[name]).to(device) for name in ("camera_to_world", "fov_deg"))
    resolution = batch["image"].shape[2:4]
    view = model.view_transformer
    marks = []

    def mark(*_: Any) -> None:
        if device == "cuda":
            torch.cuda.synchronize()
        marks.append(time.perf_counter())

    hook = (view.out_dpt if model.config.use_dpt_decoder else view.out_proj).register_forward_pre_hook(mark)
    try:
        with torch.inference_mode():
            mark()
            tokens = model.encode(scene)
            mark()
            projected = view.project(tokens)
            mark()
            model.decode(tokens, cameras, fov, resolution, projected)
            mark()
    finally:
        hook.remove()
    return {step: end - start for step, start, end in zip(STEPS, marks, marks[1:], strict=False)}


def _processor() -> str:
    """The processor's name as Linux tells it."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
