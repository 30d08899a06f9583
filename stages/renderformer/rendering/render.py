"""``render_views``: the one entrance to path tracing, for the render stage, for ``lightmill trace`` and for
experiments.

Modes:
- ``physical``: no clamping, box pixel filter, deep paths with Russian roulette, single-scattering GGX.
- ``cycles``: Cycles' defaults as far as they can be matched: at most 12 bounces, 4 diffuse, 4 glossy, indirect contributions
  clamped at 10, Blackman-Harris pixel filter (width 1.5), glossy filter 1.0, multiple-scattering GGX. Not matched: adaptive
  sampling, Cycles' random numbers and its own choice of lights (which decides what the clamp cuts).
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.errors import UserError
from stages.graphics.denoising import denoise as denoise_layer
from stages.graphics.mitsuba import backend as backends
from stages.renderformer.records import SceneRecord, ViewRecord
from stages.renderformer.rendering.adaptive import next_counts
from stages.renderformer.rendering.allotment import Allotment
from stages.renderformer.rendering.error import Judge, ThriftyJudge
from stages.renderformer.rendering.settings import RenderSettings
from stages.renderformer.rendering.sums import Sums
from stages.renderformer.views import clamped_values

FIRST_SPP = 16  # before the first estimate
FAR = 2.0  # times the target: a view whose first estimate is beyond loses its first samples, taken without guiding
MIN_MEAN = 0.01  # mean radiance under which a view is dark
MIN_DEPTH = 0.01  # nearest distance, scene units, under which a view is too close


def render_views(
    scene: SceneRecord,
    settings: RenderSettings,
    backend: dict[str, Any],
    views: Sequence[int] | None = None,
    threads: int | None = None,
) -> list[ViewRecord]:
    """Path trace ``views`` (indices of cameras; None: all) of a scene.

    backend: from ``stages.graphics.mitsuba.backend.choose``. threads: of this process; None: all cores.
    """
    backends.activate(backend, threads)
    target_error, max_spp, denoise = settings.target_error, settings.max_spp, settings.denoise
    renderer = _renderer(scene, settings, backend)
    adaptive = settings.adaptive and backend["backend"] != "scalar"
    records = {}
    active = list(range(len(scene.camera_to_world))) if views is None else list(views)
    order, sampled_spp = list(active), 0
    # With a target, two streams that share no path: what tells noise from image.
    streams = [0, 1] if target_error > 0 and max_spp > 1 else [0]
    total = max_spp // len(streams)  # of each stream
    step = min(FIRST_SPP // 2, total) if len(streams) > 1 else total
    parts: dict[int, list[Sums]] = {view: [] for view in active}  # per stream
    judges = {
        view: ThriftyJudge(target_error, denoise, scene.n_lights + 1, max_spp) if adaptive else Judge(target_error, denoise)
        for view in active
    }
    allotments = {view: Allotment(settings.size) for view in active}
    due = dict.fromkeys(active, 0.0)  # samples of a stream before which an estimate is not worth its cost
    while active:
        if sampled_spp:
            renderer.learn(active)
        sampled = renderer.sample(active, streams, sampled_spp, step)
        sampled_spp += step
        if renderer.light_paths:
            windows = [allotments[view].window(sampled_spp) for view in active]
            for stream, of_views in zip(streams, sampled, strict=True):
                renderer.add_caustics(of_views, active, stream, windows)
        unfinished = []
        for view, new in zip(active, zip(*sampled, strict=True), strict=True):
            of_streams = parts[view] = (
                [before + more for before, more in zip(parts[view], new, strict=True)] if parts[view] else list(new)
            )
            if 1.5 * sampled_spp <= due[view] and sampled_spp < total:  # even the next count would not do
                unfinished.append(view)
                continue
            sums = functools.reduce(operator.add, of_streams)
            all_samples, *halves = (part.view(scene.object_index) for part in (sums, *of_streams))
            quality, error = "high" if denoise else None, None
            if len(halves) > 1:
                allotments[view].weigh(*of_streams)
                quality, error = judges[view].error(sums.spp, *halves, all_samples)
            done = sampled_spp == total or error is None or error <= target_error
            stalled = not done and judges[view].stalled(sums.spp, max_spp)
            if done or stalled:
                records[view] = _finish(all_samples, sums, view, quality, error)
                records[view].meta |= {"dropped": len(streams) * sampled_spp - sums.spp, "stalled": stalled}
                del parts[view]
                continue
            dropped = renderer.guided and sampled_spp == step and total >= 2 * sampled_spp and error > FAR * target_error
            if adaptive and not dropped:
                uneven = _Uneven(of_streams, sampled_spp, judges[view], allotments[view])
                records[view] = uneven.finish(renderer, view, streams, settings, scene)
                del parts[view]
                continue
            unfinished.append(view)
            if dropped:
                parts[view] = []  # guided samples are so much better that these would only harm
            else:  # no error falls faster than by the square root, and denoised ones do not reach it
                due[view] = sampled_spp + ((error / target_error) ** (2.5 if denoise else 2.0) - 1) * of_streams[0].spp
        active, step = unfinished, min(_next(sampled_spp) - sampled_spp, total - sampled_spp)
    return [records[view] for view in order]


class _Uneven:
    """A view that goes on with samples where they pay, from the sums of the streams over the same samples of each pixel."""

    def __init__(self, of_streams: list[Sums], sampled: int, judge: Judge, allotment: Allotment):
        self.of_streams, self.judge, self.allotment = of_streams, judge, allotment
        self.place = sampled  # samples of all pixels that stand for those so far

    def finish(self, renderer: Any, view: int, streams: list[int], settings: RenderSettings, scene: SceneRecord) -> ViewRecord:
        """Until the target is met or out of reach."""
        counts = np.full(settings.size, self.of_streams[0].spp)
        earlier = self.place - self.of_streams[0].spp  # samples that do not count any more
        most = settings.max_spp // len(streams)
        while True:
            after = next_counts(counts, self.judge.shares, settings.target_error, most)
            renderer.learn([view])
            new = renderer.more(view, streams, counts + earlier, after + earlier, self.place)
            self.place += -(-int((after - counts).sum()) // counts.size)
            counts = after
            if renderer.light_paths:
                window = self.allotment.window(float(counts.mean()))
                for stream, sums in zip(streams, new, strict=True):
                    renderer.add_caustics([sums], [view], stream, [window])
            self.of_streams = [before + more for before, more in zip(self.of_streams, new, strict=True)]
            sums = functools.reduce(operator.add, self.of_streams)
            all_samples, *halves = (part.view(scene.object_index) for part in (sums, *self.of_streams))
            self.allotment.weigh(*self.of_streams)
            quality, error = self.judge.error(sums.mean_spp, *halves, all_samples)
            full = not (next_counts(counts, self.judge.shares, settings.target_error, most) > counts).any()
            stalled = error > settings.target_error and not full and self.judge.stalled(sums.mean_spp, settings.max_spp)
            if error <= settings.target_error or full or stalled:
                record = _finish(all_samples, sums, view, quality, error)
                record.meta |= {"dropped": len(streams) * earlier, "stalled": bool(stalled)}
                return record


def _next(samples: int) -> int:
    """Of 16, 24, 32, 48, 64, 96 .. the one after ``samples``; 16 after 8."""
    if samples <= 8:
        return 16
    power_of_two = samples & (samples - 1) == 0
    return samples * 3 // 2 if power_of_two else samples * 4 // 3


def _renderer(scene: SceneRecord, settings: RenderSettings, backend: dict[str, Any]) -> Any:
    """A ``ScalarRenderer`` or ``JitRenderer``; guided where it can be and nothing is clamped."""
    size, seed, depth, lights_visible = settings.size, settings.seed, settings.max_depth, settings.lights_visible
    if backend["backend"] == "scalar":
        if settings.mode == "cycles":
            raise UserError("mode=cycles needs a JIT backend of Mitsuba, and none works here: " + backends.INSTALL)
        from stages.renderformer.rendering.scalar import ScalarRenderer

        return ScalarRenderer(scene, size, seed, depth, lights_visible)
    from stages.renderformer.rendering.jit import JitRenderer, Limits

    if settings.mode == "physical":
        guided = settings.target_error > 0 and settings.max_spp > FIRST_SPP  # else there is no second portion to guide
        return JitRenderer(scene, size, seed, Limits(depth - 1), lights_visible, guided, light_paths=True)
    # Cycles lets light in at the hit behind the last counted bounce, hence 12 + 1.
    bounces = min(depth - 1, 13)
    limits = Limits(bounces, 4, 4, 10.0, "blackman-harris", glossy_filter=True, multiscatter=True)
    return JitRenderer(scene, size, seed, limits, lights_visible)


def _finish(view: ViewRecord, sums: Sums, index: int, quality: str | None, error: float | None) -> ViewRecord:
    """The stored view: every light denoised on its own (quality None: not at all), and what is to be said of it."""
    nearest = float(sums.nearest.min())
    if quality:

        def clean(radiance: np.ndarray) -> np.ndarray:
            return denoise_layer(radiance, view.albedo, view.normal, view.coverage, quality)

        view.lights = np.stack([clean(light) for light in view.lights]) if len(view.lights) else view.lights
        view.direct = clean(view.direct)
    mean = float(view.image.mean(dtype=np.float64))
    view.meta = {
        "index": int(index),
        "status": "too_close" if nearest < MIN_DEPTH else "dark" if mean < MIN_MEAN else "ok",
        "mean": mean,
        "spp": round(sums.mean_spp),
        "error": error,
        "denoiser": quality,
        "clamped": clamped_values(view),
        "nearest": nearest if np.isfinite(nearest) else None,
    }
    return view
