"""How long a model takes, step by step, on scenes of several sizes (paper, table 2).

Times are measured, so they are no part of records, digests or keys. One image at a time, in float32, as *evaluate* predicts.
"""

from __future__ import annotations

import platform
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from model.renderformer.base import Network
    from stages.renderformer.dataset import Sample
    from stages.renderformer.records import SceneRecord

REPEATS = 3


@dataclass(frozen=True)
class Step:
    """A step of a picture; once per image, or once per scene."""

    label: str
    per_image: bool


# Reading the arrays is left out. RenderFormer's steps first, then those of a guided network, which shares none.
STEPS: Mapping[str, Step] = {
    "encode": Step("view-independent stage, per scene", False),
    "project": Step("keys and values for the rays, per scene", False),
    "rays": Step("view-dependent layers, per image", True),
    "head": Step("decoding to pixels, per image", True),
    "cast_scene": Step("casting visibility of lights, per scene", False),
    "guided_encode": Step("closed forms and tokens of triangles, per scene", False),
    "cast_view": Step("casting hits, reflections and shadows, per image", True),
    "guided_decode": Step("closed forms and network of pixels, per image", True),
}


def time_model(model: Network, samples: Sequence[Sample], device: str) -> dict[str, Any]:
    """Seconds by step for the first view of each sample: ``scenes``, a row for each, and their ``median``.

    Beside them what they depend on: ``device``, ``threads``, ``resolution``, ``repeats``.
    """
    import torch

    model = model.to(device).eval()
    resolution = next(iter(samples[0].views.values())).image.shape[0]
    rows = []
    for sample in samples:
        seconds = step_seconds(model, sample.scene, next(iter(sample.views)), resolution, device, REPEATS)
        row = {"id": sample.scene.id, "triangles": len(sample.scene.triangles)}
        rows.append(row | {step: round(value, 6) for step, value in seconds.items()})
    steps = [step for step in STEPS if step in rows[0]]
    return {
        "device": torch.cuda.get_device_name() if device == "cuda" else processor_name(),
        "threads": None if device == "cuda" else torch.get_num_threads(),
        "resolution": resolution,
        "repeats": REPEATS,
        "scenes": rows,
        "median": {step: round(median(row[step] for row in rows), 6) for step in steps},
    }


def step_seconds(model: Network, scene: SceneRecord, view: int, resolution: int, device: str, repeats: int) -> dict[str, float]:
    """Seconds of each step that the model has, the least of ``repeats`` runs."""
    seconds = guided_seconds if model.reads_guides else renderformer_seconds
    return seconds(model, scene, view, resolution, device, repeats)


def renderformer_seconds(
    model: Any, scene: SceneRecord, view: int, resolution: int, device: str, repeats: int
) -> dict[str, float]:
    from model.renderformer.timing import time_steps
    from stages.renderformer.inference.predict import camera_arrays, padded_arrays

    seconds = time_steps(model, padded_arrays(scene) | camera_arrays(scene, view), resolution, device, repeats)
    return {name: value for name, value in seconds.items() if name in STEPS}


def guided_seconds(model: Any, scene: SceneRecord, view: int, resolution: int, device: str, repeats: int) -> dict[str, float]:
    """Rays are cast on one thread of the CPU, whatever the device."""
    import torch

    from model.renderformer.guided.pixels import Pixels
    from model.timing import fastest
    from stages.renderformer.dataset.augment import scene_arrays, view_arrays
    from stages.renderformer.guides import GuideCaster
    from stages.renderformer.inference.predict import batched, camera_arrays, padded_arrays

    caster = GuideCaster(scene)
    batch = padded_arrays(scene) | batched(scene_arrays(caster.scene_guides(model.reads_bounces)))
    cast = caster.view_guides(view, resolution, resolution)
    with torch.inference_mode():
        scenes = model.read_scenes(batch, device)
        encoded = model.encode(scenes)
        pixels = Pixels.read(camera_arrays(scene, view) | batched(view_arrays([cast])), scenes, model.config.bundle)
        return {
            "cast_scene": fastest(lambda: GuideCaster(scene).scene_guides(model.reads_bounces), "cpu", repeats),
            "guided_encode": fastest(lambda: model.encode(scenes), device, repeats),
            "cast_view": fastest(lambda: caster.view_guides(view, resolution, resolution), "cpu", repeats),
            "guided_decode": fastest(lambda: model.decode_view(encoded, pixels), device, repeats),
        }


def steps_of(timings: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, Step]]:
    """The steps that any of the timings has, in order."""
    yield from ((name, step) for name, step in STEPS.items() if any(name in timing["median"] for timing in timings))


def processor_name() -> str:
    """The processor's name as Linux gives it; elsewhere the name of its kind."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
