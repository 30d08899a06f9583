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
    renderer = _renderer(scene, settings, backend)
    adaptive = settings.adaptive and backend["backend"] != "scalar"
    # With a target, two streams that share no path: what tells noise from image.
    streams = [0, 1] if settings.target_error > 0 and settings.max_spp > 1 else [0]
    total = settings.max_spp // len(streams)  # of each stream
    indices = range(len(scene.camera_to_world)) if views is None else views
    progresses = [_Progress(index, scene, settings, adaptive) for index in indices]
    active, sampled = list(progresses), 0
    step = min(FIRST_SPP // 2, total) if len(streams) > 1 else total
    while active:
        of_streams = _sample(renderer, active, streams, sampled, step)
        sampled += step
        unfinished = []
        for view, new in zip(active, zip(*of_streams, strict=True), strict=True):
            view.add(new)
            if 1.5 * sampled <= view.due and sampled < total:  # even the next count would not do
                unfinished.append(view)
                continue
            view.estimate()
            if sampled == total or view.ends():
                view.finish(sampled)
                continue
            dropped = renderer.guided and sampled == step and total >= 2 * sampled and view.error > FAR * settings.target_error
            if adaptive and not dropped:
                _finish_unevenly(renderer, view, streams, sampled, total)
                continue
            unfinished.append(view)
            if dropped:
                view.parts = []  # guided samples are so much better that these would only harm
            else:
                view.wait(sampled)
        active, step = unfinished, min(_next(sampled) - sampled, total - sampled)
    return [view.record for view in progresses]


def _sample(renderer: Any, views: Sequence[_Progress], streams: list[int], sampled: int, step: int) -> list[list[Sums]]:
    """Per stream and view the sums of ``step`` more samples of every pixel."""
    indices = [view.index for view in views]
    if sampled:
        renderer.learn(indices)
    of_streams = renderer.sample(indices, streams, sampled, step)
    _add_caustics(renderer, views, streams, of_streams, sampled + step)
    return of_streams


def _add_caustics(
    renderer: Any, views: Sequence[_Progress], streams: list[int], of_streams: list[list[Sums]], spp: float
) -> None:
    """Add the light paths that are due beside ``spp`` camera paths per pixel in all to the sums per stream and view."""
    if renderer.light_paths:
        windows = [view.allotment.window(spp) for view in views]
        for stream, of_views in zip(streams, of_streams, strict=True):
            renderer.add_caustics(of_views, [view.index for view in views], stream, windows)


def _finish_unevenly(renderer: Any, view: _Progress, streams: list[int], sampled: int, most: int) -> None:
    """Go on with samples where they pay until the view ends, or no pixel may have more. most: of a stream and pixel."""
    counts = np.full(view.settings.size, view.parts[0].spp)
    earlier = sampled - view.parts[0].spp  # samples that do not count any more
    place = sampled  # samples of all pixels that stand for those so far
    while ((after := next_counts(counts, view.judge.shares, view.settings.target_error, most)) > counts).any():
        renderer.learn([view.index])
        new = renderer.more(view.index, streams, counts + earlier, after + earlier, place)
        place += -(-int((after - counts).sum()) // counts.size)
        counts = after
        _add_caustics(renderer, [view], streams, [[sums] for sums in new], float(counts.mean()))
        view.add(new)
        view.estimate()
        if view.ends():
            break
    view.finish(earlier + view.parts[0].mean_spp)


class _Progress:
    """A view on its way: the sums of its streams, what they tell of its error, and in the end its record."""

    def __init__(self, index: int, scene: SceneRecord, settings: RenderSettings, adaptive: bool):
        self.index, self.scene, self.settings = index, scene, settings
        judged = settings.target_error, settings.denoise
        self.judge = ThriftyJudge(*judged, scene.n_lights + 1, settings.max_spp) if adaptive else Judge(*judged)
        self.allotment = Allotment(settings.size)
        self.parts: list[Sums] = []  # per stream
        self.due = 0.0  # samples of a stream before which an estimate is not worth its cost
        self.stalled = False

    def add(self, new: Sequence[Sums]) -> None:
        """More samples, per stream."""
        self.parts = [before + more for before, more in zip(self.parts, new, strict=True)] if self.parts else list(new)

    def estimate(self) -> None:
        """Judge the samples so far; one stream tells no error."""
        self.sums = functools.reduce(operator.add, self.parts)
        self.image, *halves = (part.view(self.scene.object_index) for part in (self.sums, *self.parts))
        self.quality, self.error = "high" if self.settings.denoise else None, None
        if len(halves) > 1:
            self.allotment.weigh(*self.parts)
            self.quality, self.error = self.judge.error(self.sums.mean_spp, *halves, self.image)

    def ends(self) -> bool:
        """Whether the target is met, or out of reach."""
        if self.error is None or self.error <= self.settings.target_error:
            return True
        self.stalled = self.judge.stalled(self.sums.mean_spp, self.settings.max_spp)
        return self.stalled

    def wait(self, sampled: int) -> None:
        """Estimate no more before enough samples: no error falls faster than by the square root, and denoised ones do not
        reach it."""
        power = 2.5 if self.settings.denoise else 2.0
        self.due = sampled + ((self.error / self.settings.target_error) ** power - 1) * self.parts[0].spp

    def finish(self, sampled: float) -> None:
        """The record. sampled: all samples of a stream, also those that do not count."""
        self.record = _finish(self.image, self.sums, self.index, self.quality, self.error)
        dropped = len(self.parts) * sampled - self.sums.mean_spp
        self.record.meta |= {"dropped": round(dropped), "stalled": self.stalled}
        self.parts = []


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
        primary = guided and settings.adaptive
        return JitRenderer(scene, size, seed, Limits(depth - 1), lights_visible, guided, light_paths=True, primary=primary)
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
