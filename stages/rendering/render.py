"""``render_views``: the one entrance to path tracing, for the render stage, for ``lightmill trace`` and for
experiments.

Modes:
- ``physical``: no clamping, box pixel filter, deep paths with Russian roulette, single-scattering GGX.
- ``cycles``: Cycles' defaults as far as they can be matched: at most 12 bounces, 4 diffuse, 4 glossy, indirect
  contributions clamped at 10, Blackman-Harris pixel filter of 1.5 pixels. Not matched: multiple-scattering GGX, the
  glossy filter (1.0), adaptive sampling, Cycles' random numbers and its own choice of lights (which decides what the
  clamp cuts).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.errors import UserError
from stages.exr import clamped_values
from stages.records import SceneRecord, ViewRecord
from stages.rendering import backend as backends
from stages.rendering.denoising import denoise as denoise_layer

MODES = ("physical", "cycles")
MIN_MEAN = 0.01  # mean radiance under which a view is dark
MIN_DEPTH = 0.01  # nearest distance, scene units, under which a view is too close


def render_views(
    scene: SceneRecord,
    resolution: int,
    *,
    spp: int,
    seed: int,
    backend: dict[str, Any],
    views: Sequence[int] | None = None,
    mode: str = "physical",
    max_depth: int = 34,
    denoise: bool = True,
    lights_visible: bool = False,
    threads: int | None = None,
) -> list[ViewRecord]:
    """Path trace ``views`` (indices of cameras; None: all) of a scene at ``resolution`` x ``resolution`` pixels.

    spp: camera paths per pixel for the image with all lights on. The JIT integrator shares each path among all lights;
        the scalar one gives each light its share of the paths (``light_spp`` in the view's meta).
    backend: from ``stages.rendering.backend.choose``. max_depth: longest path in segments; 2 is direct light only.
    lights_visible: whether camera rays see lights (reflections always do).
    """
    if mode not in MODES:
        raise UserError(f"mode={mode!r} is unknown: choose from {', '.join(MODES)}")
    backends.activate(backend, threads)
    views = list(range(len(scene.camera_to_world))) if views is None else list(views)
    if backend["backend"] == "scalar":
        if mode == "cycles":
            raise UserError("mode=cycles needs a JIT backend of Mitsuba, and none works here: " + backends.INSTALL)
        from stages.rendering.scalar import ScalarRenderer

        renderer = ScalarRenderer(scene, lights_visible)
        light_spp = renderer.light_spp(spp)
        layers = renderer.render(resolution, spp, seed, views, max_depth)
    else:
        from stages.rendering.jit import JitRenderer, Limits

        light_spp = spp
        # Cycles lets light in at the hit behind the last counted bounce, hence 12 + 1.
        limits = (
            Limits(max_depth - 1)
            if mode == "physical"
            else Limits(min(max_depth - 1, 13), 4, 4, indirect_clamp=10.0, filter="blackman-harris")
        )
        layers = JitRenderer(scene).render(resolution, spp, seed, views, limits, lights_visible)

    records = []
    for index, layer in zip(views, layers, strict=True):

        def clean(radiance: np.ndarray, layer=layer) -> np.ndarray:
            return denoise_layer(radiance, layer.albedo, layer.normal, layer.coverage) if denoise else radiance

        lights = np.stack([clean(light) for light in layer.lights]) if len(layer.lights) else layer.lights
        view = ViewRecord(lights, clean(layer.direct), layer.albedo, layer.normal, layer.depth, layer.coverage)
        mean = float(view.image.mean(dtype=np.float64))
        status = "too_close" if layer.nearest < MIN_DEPTH else "dark" if mean < MIN_MEAN else "ok"
        view.meta = {
            "index": int(index),
            "status": status,
            "mean": mean,
            "spp": int(spp),
            "light_spp": light_spp,
            "clamped": clamped_values(view),
            "nearest": layer.nearest if np.isfinite(layer.nearest) else None,
        }
        records.append(view)
    return records
