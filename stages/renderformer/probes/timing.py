"""timing and equal_time: what a picture costs, by stage and against the path tracer (paper, table 2 and figure 5).

Images, metrics and operation counts are records; times are taken as the figure is made, one after the other in the main
process, after a run that warms up, the fastest of several. One design choice: both sides are timed from a scene's arrays to one
picture: the path tracer builds the scene, samples, and denoises the picture once (not every light, as the references are); the
network reads the arrays, encodes and decodes, and a guided one casts its rays besides.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import field_validator

from pipeline.config import count
from pipeline.stage import Inputs, Item, Record
from stages.graphics.arrays import pack_json, unpack_json
from stages.renderformer.evaluation.timing import STEPS, step_seconds
from stages.renderformer.probes import edits
from stages.renderformer.probes.probe import (
    HEADINGS,
    SHOWN,
    Outcome,
    Probe,
    ProbeConfig,
    Worker,
    interval,
    measure,
    metric_of,
    slug,
    span,
)
from stages.renderformer.probes.sweeps import at_least
from stages.renderformer.records import SceneRecord

if TYPE_CHECKING:
    from pipeline.store import Draft


def use_threads(worker: Worker, threads: int | None) -> int:
    """Let network and path tracer use so many CPU threads (None: all cores), in this process from here on."""
    import torch

    torch.set_num_threads(threads or os.cpu_count() or 1)
    worker.threads = torch.get_num_threads()
    return worker.threads


def traced_picture(worker: Worker, scene: SceneRecord, spp: int, denoised: bool, **options: Any) -> np.ndarray:
    """(H, W, 3) linear radiance: what a path tracer shows for ``spp`` samples, denoised as a whole."""
    from stages.graphics.denoising import denoise

    view = worker.trace(scene, max_spp=spp, target_error=0.0, denoise=False, **options)
    return denoise(view.image, view.albedo, view.normal, view.coverage) if denoised else view.image


def machine(worker: Worker, threads: int) -> str:
    """Where times were taken, and whether the machine had other things to do."""
    text = f"network on {worker.device} and path tracer on {worker.renderer['backend']} with {threads} CPU thread(s)"
    load, cores = os.getloadavg()[0], os.cpu_count() or 1
    return text + (f" (the machine was busy, load {load:.1f} on {cores} cores: times too long)" if load > 1.5 * cores else "")


# --- time by stage ----------------------------------------------------------------------------------------------------


class TimingConfig(ProbeConfig):
    name: Literal["timing"] = "timing"
    scenes: int = count(1, ge=1)
    values: tuple[float, ...] = count((512, 1024, 2048, 4096))  # triangles
    # No record depends on what follows, but the artifact's times do
    frames: int = count(8, ge=1)  # of an animation of a static scene
    tracer_spp: int = count(64, ge=0)  # of the path tracer beside it, denoised; 0: without
    repeats: int = count(3, ge=1)
    threads: int | None = count(None, ge=1)  # of network and path tracer; null: all cores

    _values = field_validator("values")(at_least(1, 65536, whole=True))


class Timing(Probe):
    name = "timing"
    title = "Time by stage"
    question = "What do the steps of a picture cost, by number of triangles?"
    setting = "triangles"
    Config = TimingConfig

    def items(self, config: TimingConfig, inputs: Inputs) -> Iterator[Item]:
        for scene_id in self.scene_ids(config, inputs):
            for value in config.values:
                yield Item(f"{scene_id}-{slug(value)}", config.split)

    def _scene(self, worker: Worker, item_id: str) -> SceneRecord:
        scene_id, _, triangles = item_id.rpartition("-")
        return edits.bisected(worker.base(scene_id), int(triangles))

    def process(self, worker: Worker, item: Item) -> Iterator[Record]:
        from model.renderformer.architectures import architecture_of
        from model.renderformer.flops import ENCODER_PARTS
        from stages.graphics.exr import encode_rgb

        config, scene = worker.config, self._scene(worker, item.id)
        network = worker.model.config
        flops = architecture_of(network).flops(network, [len(scene.triangles)], 1, config.resolution, config.resolution)
        independent = sum(flops.get(name, 0.0) for name in ENCODER_PARTS)  # a network without tokens has none
        facts = {
            "triangles": len(scene.triangles),
            "flops": {"view_independent": independent, "view_dependent": sum(flops.values()) - independent},
        }
        image = encode_rgb(worker.predict(scene))
        yield Record(item.id, {"metrics.json": pack_json(facts), "prediction.exr": image})

    def finish(self, worker: Worker, draft: Draft) -> Outcome:
        from stages.renderformer.probes.figures import COLOURS, new_figure, plain

        config = worker.config
        threads = use_threads(worker, config.threads)
        measured: dict[int, list[dict[str, float]]] = {}
        for row in draft.rows():
            facts = unpack_json(draft.read(row.id, ("metrics.json",)).members["metrics.json"])
            gflops = {name: flops / 1e9 for name, flops in facts["flops"].items()}
            measured.setdefault(facts["triangles"], []).append(self._times(worker, self._scene(worker, row.id)) | gflops)
        means = {n: {k: float(np.mean([m[k] for m in rows])) for k in rows[0]} for n, rows in sorted(measured.items())}
        steps = {name: step for name, step in STEPS.items() if name in next(iter(means.values()))}
        columns = ["triangles", *(f"{step.label} (s)" for step in steps.values()), "one picture (s)"]
        columns += [f"each of {config.frames} frames (s)", "GFLOP, view-independent", "GFLOP, view-dependent"]
        columns += [f"path tracer, {config.tracer_spp} samples, denoised (s)"] if config.tracer_spp else []
        rows = [
            [
                f"{n:,}",
                *(f"{m[name]:.4f}" for name in (*steps, "total", "frame")),
                *(f"{m[name]:.2f}" for name in ("view_independent", "view_dependent")),
                *([f"{m['trace']:.3f}"] if config.tracer_spp else []),
            ]
            for n, m in means.items()
        ]
        figure = new_figure(3.8)
        left, right = figure.subplots(1, 2)
        labels, place = [f"{n:,}" for n in means], np.arange(len(means))
        below = np.zeros(len(means))
        for (name, step), colour in zip(steps.items(), COLOURS, strict=False):
            seconds = np.array([m[name] for m in means.values()])
            left.bar(place, seconds, 0.6, bottom=below, color=colour, label=step.label)
            below += seconds
        left.set(ylabel="seconds of the first picture", ylim=(0, 1.7 * below.max()))
        lines = {"one picture": ("total", COLOURS[0]), f"each of {config.frames} frames": ("frame", COLOURS[2])}
        if config.tracer_spp:
            lines[f"path tracer, {config.tracer_spp} samples, denoised"] = ("trace", COLOURS[3])
        for label, (name, colour) in lines.items():
            right.plot(place, [m[name] for m in means.values()], color=colour, marker="o", markersize=4, label=label)
        right.set(yscale="log", ylabel="seconds per picture")
        for axes in (left, right):
            axes.set_xticks(place, labels)
            axes.set_xlabel("triangles", fontsize=8.5)
            plain(axes)
            axes.legend(fontsize=7.5, frameon=False)
        notes = [
            f"{config.resolution} px; {machine(worker, threads)}; the fastest of {config.repeats} after a warm-up. Triangles "
            "are cut in two until there are so many; the picture stays the same.",
            "Steps leave out reading the arrays, one picture does not. Frames: other cameras of a static scene, for which the "
            "steps per scene are taken once.",
        ]
        return Outcome(columns, rows, figure, notes)

    def _times(self, worker: Worker, scene: SceneRecord) -> dict[str, float]:
        """Seconds of the network's steps and of the path tracer on one scene."""
        from model.timing import fastest
        from stages.renderformer.inference.predict import predict_scene

        config, model = worker.config, worker.model.eval()

        def predicted(views: int) -> float:
            return fastest(
                lambda: predict_scene(model, scene, [0] * views, config.resolution, worker.device),
                worker.device,
                config.repeats,
            )

        times = step_seconds(model, scene, 0, config.resolution, worker.device, config.repeats)
        times |= {"total": predicted(1), "frame": predicted(config.frames) / config.frames}
        if config.tracer_spp:
            times["trace"] = fastest(
                lambda: traced_picture(worker, scene, config.tracer_spp, denoised=True), "cpu", config.repeats
            )
        return times


# --- equal time -------------------------------------------------------------------------------------------------------


class EqualTimeConfig(ProbeConfig):
    name: Literal["equal_time"] = "equal_time"
    values: tuple[float, ...] = (1, 2, 4, 8, 16, 32, 64)  # samples per pixel; all in one record
    repeats: int = count(3, ge=1)
    threads: int | None = count(None, ge=1)  # of network and path tracer; null: all cores

    _values = field_validator("values")(at_least(1, 65536, whole=True))


REFERENCE_FACTOR = 16  # samples of the reference over the most of the path tracer beside it: a quarter of its error
TRACED = {"path traced": False, "path traced, denoised": True}  # method -> whether denoised


class EqualTime(Probe):
    name = "equal_time"
    title = "Equal-time comparison"
    question = "What does a path tracer make of the time that the network takes?"
    setting = "samples per pixel"
    Config = EqualTimeConfig

    def items(self, config: EqualTimeConfig, inputs: Inputs) -> Iterator[Item]:
        for scene_id in self.scene_ids(config, inputs):
            yield Item(scene_id, config.split)

    def _traced(self, worker: Worker, scene: SceneRecord, spp: float, denoise: bool) -> np.ndarray:
        from pipeline.keys import seed_for

        # other random numbers than the reference's
        seed = seed_for(worker.config.seed, "probe/equal_time", scene.id)
        return traced_picture(worker, scene, int(spp), denoise, seed=seed)

    def process(self, worker: Worker, item: Item) -> Iterator[Record]:
        from stages.graphics.exr import encode_rgb

        scene = worker.base(item.id)
        # far from what is judged by it, whatever its own estimate says
        spp = max(worker.config.max_spp, REFERENCE_FACTOR * int(max(worker.config.values)))
        reference = worker.trace(scene, max_spp=spp, target_error=0.0)
        prediction = worker.predict(scene)
        members = {"reference.exr": encode_rgb(reference.image), "prediction.exr": encode_rgb(prediction)}
        traced = {}
        for number, (method, denoise) in enumerate(TRACED.items()):
            for spp in worker.config.values:
                image = self._traced(worker, scene, spp, denoise)
                traced.setdefault(method, {})[slug(spp)] = measure(reference, image)
                members[f"traced{number}.s{slug(spp)}.exr"] = encode_rgb(image)
        facts = {
            "model": measure(reference, prediction),
            "traced": traced,
            "spp": reference.meta["spp"],
        }
        yield Record(item.id, {"metrics.json": pack_json(facts), **members})

    def finish(self, worker: Worker, draft: Draft) -> Outcome:
        from model.timing import fastest
        from stages.graphics.exr import decode_rgb
        from stages.graphics.statistics import bootstrap
        from stages.renderformer.probes.figures import COLOURS, LEAST_WIDTH, new_figure, plain, strip

        config = worker.config
        threads = use_threads(worker, config.threads)
        ids = [row.id for row in draft.rows()]
        facts = [unpack_json(draft.read(id, ("metrics.json",)).members["metrics.json"]) for id in ids]
        scene = worker.base(ids[0])
        model_s = fastest(lambda: worker.predict(scene), worker.device, config.repeats)
        steps = step_seconds(worker.model.eval(), scene, 0, config.resolution, worker.device, config.repeats)
        traced_s = {
            (method, spp): fastest(lambda spp=spp, d=denoise: self._traced(worker, scene, spp, d), "cpu", config.repeats)
            for method, denoise in TRACED.items()
            for spp in config.values
        }

        def summary(get: Callable[[dict], dict[str, float]]) -> dict[str, dict[str, float]]:
            return {metric: bootstrap([[get(fact)[metric]] for fact in facts], metric_of(metric).bounds) for metric in SHOWN}

        estimates: dict[tuple[str, float | None], dict] = {("network", None): summary(lambda fact: fact["model"])}
        for method, spp in traced_s:
            estimates[method, spp] = summary(lambda fact, m=method, s=spp: fact["traced"][m][slug(s)])
        times = {("network", None): model_s, **traced_s}
        columns = ["method", "samples per pixel", "seconds", *(HEADINGS[name] for name in SHOWN)]
        rows = [
            [method, "" if spp is None else f"{spp:g}", f"{times[method, spp]:.3f}"]
            + [interval(name, estimates[method, spp][name]) for name in SHOWN]
            for method, spp in estimates
        ]
        # the sample count whose time is nearest to the network's
        equal = {
            method: min(config.values, key=lambda spp, m=method: abs(np.log(traced_s[m, spp] / model_s))) for method in TRACED
        }
        titles = ["reference", f"network,\n{model_s:.3f} s"]
        titles += [f"{m},\n{s:g} samples, {traced_s[m, s]:.3f} s" for m, s in equal.items()]
        drawn_ids = ids[:2]
        side = (LEAST_WIDTH - 0.3) / len(titles)
        figure = new_figure(len(drawn_ids) * (side + 0.05) + 0.6 + 3.0, LEAST_WIDTH)
        outer = figure.add_gridspec(2, 1, height_ratios=[len(drawn_ids) * (side + 0.05) + 0.6, 3.0])
        pictures = outer[0].subgridspec(len(drawn_ids), 1)
        for number, id in enumerate(drawn_ids):
            record = draft.read(id)
            names = ["reference.exr", "prediction.exr"]
            names += [f"traced{n}.s{slug(spp)}.exr" for n, spp in enumerate(equal.values())]
            images = [decode_rgb(record.members[name]) for name in names]
            strip(figure, pictures[number], [("", images)], titles if number == 0 else [""] * len(titles))
        axes = figure.add_subplot(outer[1])
        for (method, _), colour in zip(TRACED.items(), COLOURS[1:], strict=False):
            line = [(traced_s[method, spp], estimates[method, spp]["log_error"]) for spp in config.values]
            x, y = [seconds for seconds, _ in line], [row["mean"] for _, row in line]
            axes.plot(x, y, color=colour, marker="o", markersize=4, linewidth=1.6, label=method)
            for at in (0, -1):
                axes.annotate(f"{config.values[at]:g}", (x[at], y[at]), (3, 4), textcoords="offset points", fontsize=7)
        model = estimates["network", None]["log_error"]
        low = model["low"]
        error = None if low is None else [[model["mean"] - low], [model["high"] - model["mean"]]]
        axes.errorbar([model_s], [model["mean"]], error, color=COLOURS[0], marker="s", capsize=3, label="network")
        axes.set(xscale="log", yscale="log")
        axes.set_xlabel("seconds per picture (numbers: samples per pixel)", fontsize=8.5)
        axes.set_ylabel(HEADINGS["log_error"], fontsize=8.5)
        plain(axes)
        axes.legend(fontsize=7.5, frameon=False)
        ratios = ", ".join(
            f"{method} with {spp:g} samples takes {traced_s[method, spp] / model_s:.2g} times as long"
            for method, spp in equal.items()
        )
        notes = [
            f"{len(facts)} {config.split} scene(s) at {config.resolution} px; {machine(worker, threads)}; times of the first "
            f"scene, the fastest of {config.repeats} after a warm-up.",
            f"The network's {model_s:.3f} s by step: " + ", ".join(f"{STEPS[n].label} {t:.3f}" for n, t in steps.items()) + ".",
            f"The counts nearest to them: {ratios}.",
            f"References: {span([fact['spp'] for fact in facts])} samples per pixel, every light denoised on its own. The path "
            "tracer's pictures have other random numbers, no path guiding, and are denoised as a whole.",
        ]
        return Outcome(columns, rows, figure, notes)


PROBES: tuple[type[Probe], ...] = (EqualTime, Timing)
