"""What a probe is: one question put to a trained network by varying one setting of scenes whose truth is traced.

Reads *shard* (scenes) and *train* (checkpoint); a probe lists items, makes a record of each, and turns the records into an
``Outcome``: a table, a figure and notes. Most probes are a ``Sweep``, which needs no more than an edit of a scene for each
value of the setting, and perhaps several methods of predicting it. One design choice: the reference is traced anew for every
edited scene, so that no probe has to argue why a stored image would still be right.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from pipeline.config import StageConfig, count, runtime
from pipeline.errors import Reject, UserError
from pipeline.keys import seed_for
from pipeline.stage import Inputs, Item, Record
from stages.graphics.arrays import pack_json, unpack_json
from stages.graphics.metrics import METRICS, Metric
from stages.renderformer.probes import edits
from stages.renderformer.records import SceneRecord
from stages.renderformer.rendering.settings import RenderSettings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pipeline.store import Draft
    from stages.renderformer.records import ViewRecord

SURFACES = "log_error_surfaces"  # the black around a scene is easy, and its share changes with what is varied
CURVES = ("psnr", SURFACES)  # metrics that a sweep's figure draws
SHOWN = ("psnr", "ssim", "log_error", SURFACES, "flip")  # and that tables show; the records hold all
HEADINGS = {name: metric.heading for name, metric in METRICS.items()} | {SURFACES: "log error on surfaces\u00a0↓"}


class ProbeConfig(StageConfig):
    """What every probe has."""

    split: Literal["test", "validation", "train"] = "test"
    scenes: int = count(12, ge=1)  # the first ones of the split that suit the probe
    resolution: int = Field(64, ge=16, le=2048)  # pixels per side
    target_error: float = Field(0.002, ge=0)  # of the references, as in *render*
    max_spp: int = Field(256, ge=1)
    seed: int = 0
    backend: Literal["auto", "cuda", "llvm", "scalar"] = runtime("auto")  # of the path tracer
    device: Literal["auto", "cpu", "cuda"] = runtime("auto")  # of the network


@dataclass
class Outcome:
    """What a probe found. ``rows`` hold what is shown, one cell per column; ``figure`` is drawn for a width of a page."""

    columns: list[str]
    rows: list[list[Any]]
    figure: Figure
    notes: list[str] = field(default_factory=list)


def _threads() -> int | None:
    """What the engine has set in worker processes."""
    threads = os.environ.get("LIGHTMILL_THREADS")
    return int(threads) if threads else None


@dataclass
class Worker:
    """The scenes, the network and the path tracer, one set per process; the latter two are loaded when first used."""

    config: Any
    inputs: Inputs
    renderer: dict[str, Any]  # a backend that ``stages.graphics.mitsuba.backend`` chose
    device: str = "cpu"
    threads: int | None = field(default_factory=_threads)  # of the path tracer; None: all cores

    @cached_property
    def _loaded(self) -> tuple[Any, dict[str, str]]:
        from model.renderformer import checkpoint

        model, trained_with = checkpoint.load(self.inputs["train"].file("checkpoint"))
        return model.to(self.device), trained_with

    @property
    def model(self) -> Any:
        return self._loaded[0]

    @property
    def trained_with(self) -> dict[str, str]:
        """What the checkpoint says of its training, numbers as text; may be empty."""
        return self._loaded[1]

    def base(self, scene_id: str) -> SceneRecord:
        """A scene of the shards, with the first of its kept cameras alone."""
        from stages.renderformer.dataset.encoding import decode_scene

        members = self.inputs["shard"].read(scene_id, ("scene.npz", "meta.json")).members
        scene = decode_scene(scene_id, members["scene.npz"], members["meta.json"])
        return edits.one_view(scene, scene.meta["views"][0])

    def predict(self, scene: SceneRecord, resolution: int | None = None) -> np.ndarray:
        """(H, W, 3) linear radiance as the network sees the scene's first camera."""
        from stages.renderformer.inference.predict import predict_scene

        resolution = resolution or self.config.resolution
        multiple = self.model.config.resolution_multiple
        if resolution % multiple:
            raise UserError(f"a resolution of {resolution} must be a multiple of {multiple} pixels for this checkpoint")
        image = predict_scene(self.model, scene, [0], resolution, self.device)[0]
        if not np.isfinite(image).all():
            raise UserError(f"the model's prediction of scene {scene.id} holds NaN or infinity: training has diverged")
        return image

    def trace(self, scene: SceneRecord, **changes: Any) -> ViewRecord:
        """The scene's first camera, path traced as the config says but for ``changes``: fields of `RenderSettings`."""
        from stages.renderformer.rendering.render import render_views

        config, seed = self.config, seed_for(self.config.seed, "probe/trace", scene.id)
        settings = replace(RenderSettings(config.resolution, config.max_spp, seed, config.target_error), **changes)
        return render_views(scene, settings, self.renderer, [0], self.threads)[0]

    def rng(self, purpose: str, scene_id: str) -> np.random.Generator:
        """Random numbers of a scene, the same for every value of the setting."""
        return np.random.default_rng(seed_for(self.config.seed, f"probe/{purpose}", scene_id))


class Probe:
    """One question. Subclasses set the class variables and fill in the methods; instances hold no state."""

    name: ClassVar[str]
    title: ClassVar[str]
    question: ClassVar[str]
    setting: ClassVar[str]  # what is varied, with its unit
    Config: ClassVar[type[ProbeConfig]] = ProbeConfig
    reads: ClassVar[tuple[str, ...]] = ("shard", "train")  # inputs

    def refusal(self, model: Any) -> str | None:
        """Why the probe would say nothing of this network, if it would not."""
        return None

    def suits(self, meta: Mapping[str, Any]) -> bool:
        """Whether a scene of the shards can be used, from its meta."""
        return True

    def scene_ids(self, config: Any, inputs: Inputs) -> list[str]:
        """The scenes that the probe works on."""
        shard, scene_ids = inputs["shard"], []
        for scene_id in shard.ids(config.split):
            if self.suits(unpack_json(shard.read(scene_id, ("meta.json",)).members["meta.json"])):
                scene_ids.append(scene_id)
                if len(scene_ids) == config.scenes:
                    break
        if not scene_ids:
            raise UserError(
                f"probe={self.name}: the {config.split} split has {len(shard.ids(config.split))} scenes and none of them "
                "suits this probe: make more scenes (scene.count), or choose another probe.split"
            )
        return scene_ids

    def items(self, config: Any, inputs: Inputs) -> Iterator[Item]:
        raise NotImplementedError

    def process(self, worker: Worker, item: Item) -> Iterator[Record]:
        raise NotImplementedError

    def finish(self, worker: Worker, draft: Draft) -> Outcome:
        """``worker`` is one of the main process; what it measures there may differ from run to run (times)."""
        raise NotImplementedError


# --- sweeps -----------------------------------------------------------------------------------------------------------

Predict = Callable[[SceneRecord], np.ndarray]


class Sweep(Probe):
    """Scenes edited for every value of a setting, traced, predicted by one or several methods, measured."""

    axis: ClassVar[Literal["linear", "log", "even"]] = "linear"  # of the curves; even: values side by side

    def edit(self, worker: Worker, scene: SceneRecord, value: float) -> SceneRecord:
        """The scene at that value of the setting."""
        raise NotImplementedError

    def scene(self, worker: Worker, scene_id: str, value: float) -> SceneRecord:
        """What is traced and predicted."""
        return self.edit(worker, worker.base(scene_id), value)

    def resolution(self, config: Any, value: float) -> int:
        return config.resolution

    def methods(self, worker: Worker, predict: Predict, scene: SceneRecord) -> Mapping[str, Callable[[], np.ndarray]]:
        """Name -> the prediction of the edited scene."""
        return {"model": lambda: predict(scene)}

    def trained(self, trained_with: Mapping[str, str]) -> tuple[float, float] | None:
        """The values that the network has met in training, where that is known."""
        return None

    def label(self, value: float) -> str:
        return f"{value:g}"

    def scope(self, config: Any) -> str:
        """What the table's averages are over, after their number."""
        return f"{config.split} scene(s), one view each at {config.resolution} px"

    def notes(self, config: Any) -> list[str]:
        """What a reader has to know besides."""
        return []

    # -- as a map stage

    def items(self, config: Any, inputs: Inputs) -> Iterator[Item]:
        for scene_id in self.scene_ids(config, inputs):
            for value in config.values:
                yield Item(f"{scene_id}-{slug(value)}", config.split)

    def process(self, worker: Worker, item: Item) -> Iterator[Record]:
        from stages.graphics.exr import encode_rgb

        config = worker.config
        scene_id, _, name = item.id.rpartition("-")
        value = {slug(value): value for value in config.values}[name]
        resolution = self.resolution(config, value)
        scene = self.scene(worker, scene_id, value)
        view = worker.trace(scene, resolution=resolution)
        if view.meta["status"] == "too_close":
            raise Reject("too_close", f"nearest {view.meta['nearest']}")
        if not view.image.any():
            raise Reject("dark", "no light reaches the camera")
        scores, members = {}, {"reference.exr": encode_rgb(view.image)}
        for number, (method, predicted) in enumerate(
            self.methods(worker, lambda edited: worker.predict(edited, resolution), scene).items()
        ):
            image = predicted()
            scores[method] = measure(view, image)
            members[f"method{number}.exr"] = encode_rgb(image)
        facts = {
            "scene": scene_id,
            "value": value,
            "triangles": len(scene.triangles),
            "lights": scene.n_lights,
            "spp": view.meta["spp"],
            "error": view.meta["error"],
            "methods": list(scores),  # in the order of the pictures, which JSON's sorted keys lose
            "scores": scores,
        }
        yield Record(item.id, {"metrics.json": pack_json(facts), **members})

    def finish(self, worker: Worker, draft: Draft) -> Outcome:
        from stages.graphics.statistics import bootstrap
        from stages.renderformer.probes.figures import sweep_figure

        config = worker.config
        rows = [unpack_json(draft.read(row.id, ("metrics.json",)).members["metrics.json"]) for row in draft.rows()]
        row_by_case = {(row["scene"], row["value"]): {**row, "id": id.id} for row, id in zip(rows, draft.rows(), strict=True)}
        all_scenes = {row["scene"] for row in rows} | {reject["item"].rpartition("-")[0] for reject in draft.rejects()}
        complete_scenes = [
            scene for scene in sorted(all_scenes) if all((scene, value) in row_by_case for value in config.values)
        ]
        if not complete_scenes:
            raise UserError(
                f"probe={self.name}: no scene is left that could be rendered at every value (dark, or the camera inside an "
                "object): use more scenes (probe.scenes) or other probe.values"
            )
        methods = row_by_case[complete_scenes[0], config.values[0]]["methods"]

        def scores(method: str, value: float, metric: str) -> list[float]:
            return [row_by_case[scene, value]["scores"][method][metric] for scene in complete_scenes]

        summary = {
            (method, value, metric): bootstrap([[score] for score in scores(method, value, metric)], metric_of(metric).bounds)
            for method in methods
            for value in config.values
            for metric in SHOWN
        }

        def mean(name: str, value: float) -> float:
            return float(np.mean([row_by_case[scene, value][name] for scene in complete_scenes]))

        facts = [
            name
            for name in ("triangles", "lights")
            if name != self.setting and len({mean(name, value) for value in config.values}) > 1
        ]
        columns = [self.setting, *(["method"] if len(methods) > 1 else []), *facts]
        columns += [HEADINGS[name] for name in SHOWN]
        table = []
        for value in config.values:
            for method in methods:
                cells: list[Any] = [self.label(value), *([method] if len(methods) > 1 else [])]
                cells += [f"{mean(name, value):,.0f}" for name in facts]
                cells += [interval(name, summary[method, value, name]) for name in SHOWN]
                table.append(cells)
        drawn_scenes = complete_scenes[: max(1, 4 // (1 + len(methods)))]

        def picture(scene: str, value: float, member: str) -> np.ndarray:
            from stages.graphics.exr import decode_rgb

            return decode_rgb(draft.read(row_by_case[scene, value]["id"], (member,)).members[member])

        figure = sweep_figure(
            self.setting,
            [self.label(value) for value in config.values],
            config.values,
            methods,
            {scene: [[picture(scene, v, "reference.exr") for v in config.values]]
             + [[picture(scene, v, f"method{n}.exr") for v in config.values] for n in range(len(methods))]
             for scene in drawn_scenes},
            {name: {m: [summary[m, v, name] for v in config.values] for m in methods} for name in CURVES},
            self.trained(worker.trained_with),
            self.axis,
            HEADINGS,
        )  # fmt: skip
        notes = [f"{len(complete_scenes)} {self.scope(config)}; 95 % intervals over scenes."]
        if len(complete_scenes) < len(all_scenes):
            left_out = len(all_scenes) - len(complete_scenes)
            notes.append(f"{left_out} scene(s) left out: dark, or the camera too close to something, at one of the values.")
        errors = [row["error"] for row in rows if row["error"] is not None]
        if errors:
            spp = span([row["spp"] for row in rows])
            notes.append(f"References: {spp} samples per pixel, mean estimated log error {np.mean(errors):.4f}.")
        notes += [*self.notes(config), *self._changes(config.values, methods, scores)]
        return Outcome(columns, table, figure, notes)

    def _changes(self, values: Sequence[float], methods: Sequence[str], scores: Callable[..., list[float]]) -> list[str]:
        """Sentences: what the same scenes lose from the first value to the last, and how the methods compare there."""
        from stages.graphics.statistics import bootstrap
        from stages.renderformer.evaluation.tables import format_estimate

        metric, out = METRICS["psnr"], []

        def difference(a: tuple[str, float], b: tuple[str, float]) -> str:
            pairs = zip(scores(*a, metric.name), scores(*b, metric.name), strict=True)
            estimate = bootstrap([[second - first] for first, second in pairs])
            mean, interval = format_estimate(metric, estimate, "+")
            return f"{mean} dB PSNR (95 % interval {interval})"

        if len(values) > 1:
            first, last = values[0], values[-1]
            for method in methods:
                who = f"{method}: " if len(methods) > 1 else ""
                change = difference((method, first), (method, last))
                out.append(f"{who}{change} from {self.label(first)} to {self.label(last)} ({self.setting}).")
        for method in methods[1:]:
            change = difference((methods[0], values[-1]), (method, values[-1]))
            out.append(f"{method} against {methods[0]} at {self.label(values[-1])}: {change}.")
        return out


def measure(reference: ViewRecord, image: np.ndarray) -> dict[str, float]:
    """Every metric, and the log error of the pixels that mostly see a surface."""
    from stages.graphics.metrics import log_error, measure_all

    surface = reference.coverage > 0.5
    # one row of pixels; without any, nothing was got wrong
    error = log_error(reference.image[surface], image[surface]) if surface.any() else 0.0
    return measure_all(reference.image, image) | {SURFACES: round(error, 6)}


def slug(value: float) -> str:
    """A value as part of an item's id, without '-' ."""
    return f"{value:g}".replace(".", "p").replace("-", "m").replace("+", "")


def span(numbers: Sequence[int]) -> str:
    """'16 to 256', or '16' where all are equal."""
    return " to ".join(f"{number:,}" for number in sorted({min(numbers), max(numbers)}))


def interval(name: str, estimate: Mapping[str, float]) -> str:
    """A metric's mean and its interval as text."""
    from stages.graphics.statistics import with_interval

    return with_interval(estimate, metric_of(name).format)


def metric_of(name: str) -> Metric:
    return METRICS["log_error" if name == SURFACES else name]
