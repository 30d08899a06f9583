"""evaluate: how well the model renders scenes that it has never seen, against baselines that deserve the name.

Reads *shard* (held-out scenes with their path-traced views; training views for the mean image) and *train* (checkpoint,
loss log). Writes one record per scene, ``metrics.json`` (every metric of every method and view, and what the view shows) and
one half-float EXR per view with the prediction, and ``files/``: report.html, metrics.json, metrics.md, timing.json,
overview.png.

One design choice: a record holds all that the report says about its scene, so that the report is only statistics and
pictures. Times, which are never the same twice, are measured at the end and stay out of records and digest. Paper: section
4.1, tables 1 and 2.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from pipeline.config import StageConfig, report, runtime
from pipeline.errors import UserError
from pipeline.stage import Inputs, Item, MapStage, Record
from stages.graphics.device import choose_device
from stages.graphics.lpips_setting import NONE, LpipsSetting, lpips_networks
from stages.renderformer.evaluation.runs import VERSION

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np

    from pipeline.store import Artifact, Draft
    from stages.renderformer.records import SceneRecord


MEAN_IMAGES = "mean_images.npz"  # in the folder that all workers read


class EvaluateConfig(StageConfig):
    split: Literal["test", "validation", "train"] = "test"
    baseline_views: int = Field(1024, ge=1)  # a mean of 1,024 is within 0.005 dB of the mean of all, in bounded memory
    gallery: int = report(24, ge=0)  # views shown in the report
    lpips: LpipsSetting = NONE
    lpips_folder: str | None = runtime(None)  # where its weights lie; which they are is known from the network's name
    ceiling_views: int = report(16, ge=0)  # views rendered once more, for the ceilings of SSIM, FLIP and LPIPS, 0: none
    timing_scenes: int = report(5, ge=0)  # scenes on which the stages are timed, 0: none
    device: Literal["auto", "cpu", "cuda"] = runtime("auto")


@dataclass
class Worker:
    config: EvaluateConfig
    device: str
    model: Any
    closed_form: Any  # the model without what it learned; None where that is no picture
    shard: Artifact
    metrics: dict[str, Any]
    mean_images: dict[str, np.ndarray]  # per space, (H, W, 3)


class Evaluate(MapStage):
    name = "evaluate"
    headline = "report.html"
    version = VERSION
    inputs = ("shard", "train")
    Config = EvaluateConfig

    def agree(self, config: EvaluateConfig, configs: Mapping[str, StageConfig]) -> None:
        """Weights that are missing are missed before anything runs."""
        from model.lpips import LPIPS

        for network in lpips_networks(config.lpips):
            LPIPS.files(config.lpips_folder, network)

    def slug(self, config: EvaluateConfig) -> str:
        return config.split

    def part_size(self, config: EvaluateConfig, inputs: Inputs) -> int:
        return 4

    def environment(self, config: EvaluateConfig, previous: dict[str, Any] | None) -> dict[str, Any]:
        """The device, one for the whole artifact: another rounds otherwise."""
        if previous is None:
            return {"device": choose_device(config.device, "evaluate.device")}
        try:
            return {"device": choose_device(previous["device"], "evaluate.device")}
        except UserError as error:
            raise UserError(f"this evaluation was begun with it; use that machine, or give another split ({error})") from None

    def max_workers(self, config: EvaluateConfig, environment: dict[str, Any]) -> int | None:
        return 1 if environment["device"] == "cuda" else None

    def items(self, config: EvaluateConfig, inputs: Inputs) -> Iterator[Item]:
        shard = inputs["shard"]
        if not shard.ids(config.split):
            raise UserError(f"evaluate.split={config.split}: the shards hold no such scene, only {', '.join(shard.groups())}")
        for scene_id in shard.ids(config.split):
            yield Item(scene_id, config.split)

    def prepare(self, config: EvaluateConfig, inputs: Inputs, folder: Path) -> None:
        """The mean training images: up to 1,024 views are read for them, and held as half floats."""
        from pipeline.atomic import write_atomic
        from stages.graphics.arrays import pack_arrays

        write_atomic(folder / MEAN_IMAGES, pack_arrays(mean_training_images(config, inputs)))

    def open(self, config: EvaluateConfig, inputs: Inputs, environment: dict[str, Any]) -> Worker:
        return open_worker(config, inputs, environment, mean_training_images(config, inputs))

    def open_prepared(self, config: EvaluateConfig, inputs: Inputs, environment: dict[str, Any], folder: Path) -> Worker:
        from stages.graphics.arrays import unpack_arrays

        return open_worker(config, inputs, environment, unpack_arrays((folder / MEAN_IMAGES).read_bytes()))

    def process(self, worker: Worker, item: Item) -> Iterator[Record]:
        import numpy as np

        from stages.graphics.arrays import pack_json
        from stages.graphics.exr import encode_rgb
        from stages.graphics.metrics import measure_all
        from stages.renderformer.dataset import decode_sample
        from stages.renderformer.evaluation.baselines import best_constants, measure_baseline
        from stages.renderformer.evaluation.ceiling import view_noise
        from stages.renderformer.evaluation.regions import region_errors, region_map
        from stages.renderformer.inference.predict import predict_scene

        sample = decode_sample(worker.shard.read(item.id))
        scene, cameras = sample.scene, list(sample.views)
        targets = np.stack([view.image for view in sample.views.values()])
        predictions = predict_scene(worker.model, scene, cameras, targets.shape[1], worker.device)
        if not np.isfinite(predictions).all():
            raise UserError(f"the model's prediction of scene {item.id} holds NaN or infinity: training has diverged")
        closed_forms = None
        if worker.closed_form is not None:
            closed_forms = predict_scene(worker.closed_form, scene, cameras, targets.shape[1], worker.device)
        mean_image = measure_baseline(targets, worker.mean_images, worker.metrics)
        constant = measure_baseline(targets, best_constants(targets), worker.metrics)
        members, rows = {}, []
        for number, (camera, target, prediction) in enumerate(zip(cameras, targets, predictions, strict=True)):
            view = sample.views[camera]
            images = {"model": prediction, "direct": view.direct}
            if closed_forms is not None:
                images["closed_form"] = closed_forms[number]
            measured = {method: measure_all(target, image, worker.metrics) for method, image in images.items()}
            scores = {**measured, "mean_image": mean_image[number], "constant": constant[number]}
            view_facts = {
                "roughness": visible_roughness(scene, view.triangle),
                "noise": view_noise(scene.meta, camera),
                "regions": region_errors(region_map(scene, view), target, images),
            }
            rows.append({"index": camera, **view_facts, "scores": scores})
            members[f"view{camera}.prediction.exr"] = encode_rgb(prediction)
        facts = {
            "id": item.id,
            "template": scene.meta["template"],
            "lights": scene.n_lights,
            "triangles": len(scene.triangles),
            "resolution": targets.shape[1],
        }
        yield Record(item.id, {"metrics.json": pack_json({**facts, "views": rows}), **members})

    def finish(self, config: EvaluateConfig, inputs: Inputs, draft: Draft) -> None:
        from stages.graphics.arrays import unpack_json
        from stages.graphics.metrics import METRICS, named, with_lpips
        from stages.graphics.statistics import summarise
        from stages.renderformer.evaluation.ceiling import ceiling, noise_pairs, render_ceilings
        from stages.renderformer.evaluation.regions import summarise_regions
        from stages.renderformer.evaluation.report import write_evaluation
        from stages.renderformer.evaluation.runs import run_of

        shard, train = inputs["shard"], inputs["train"]
        scenes = [unpack_json(draft.read(row.id, ("metrics.json",)).members["metrics.json"]) for row in draft.rows()]
        metrics = named({*METRICS, *(f"lpips_{network}" for network in lpips_networks(config.lpips))})
        summary = summarise(scenes, metrics)
        summary["regions"] = summarise_regions(scenes)
        summary["ceiling"] = ceiling(scenes, config.split, *noise_pairs(shard, config.split))
        summary["ceiling"] |= render_ceilings(
            shard, config.split, config.ceiling_views, with_lpips(lpips_networks(config.lpips), config.lpips_folder)
        )
        log = [json.loads(line) for line in train.file("log.jsonl").read_text().splitlines() if line]
        summary["train"] = {
            "key": train.key,
            "steps": log[-1]["step"] if log else None,  # of a given checkpoint nobody knows
            **network(train.file("checkpoint")),
        }
        summary["data"] = {
            "key": shard.key,
            "split": config.split,
            "scenes": {g: len(shard.ids(g)) for g in shard.groups()},
        }
        timing = self._time(config, inputs, scenes, draft)
        params = config.model_dump(mode="json")
        write_evaluation(draft.files, run_of("model", draft, params, summary, timing, shard, train), config.gallery)
        means = {
            method: {name: round(v["mean"], metrics[name].digits) for name, v in row.items()}
            for method, row in [*summary["methods"].items(), ("ceiling", summary["ceiling"])]
        }
        draft.note("metrics", {"beats_baselines": summary["beats_baselines"], **means})
        for name in ("psnr", "log_error"):
            values = ", ".join(f"{method} {metrics[name].format(row[name])}" for method, row in means.items() if name in row)
            draft.log(f"{metrics[name].heading}: {values}")

    def _time(
        self, config: EvaluateConfig, inputs: Inputs, scenes: list[dict[str, Any]], draft: Draft
    ) -> dict[str, Any] | None:
        """What timing.json gets: the stages' times on some of the scenes, from the smallest to the largest."""
        import numpy as np

        from pipeline.store.files import write_json
        from stages.renderformer.dataset import decode_sample
        from stages.renderformer.evaluation.timing import time_model
        from stages.renderformer.inference.predict import load_model

        by_size = sorted(scenes, key=lambda scene: (scene["triangles"], scene["id"]))
        places = np.unique(np.linspace(0, len(by_size) - 1, min(config.timing_scenes, len(by_size))).round().astype(int))
        if not len(places):
            return None
        samples = [decode_sample(inputs["shard"].read(by_size[place]["id"])) for place in places]
        model = load_model(inputs["train"].file("checkpoint"))
        timing = time_model(model, samples, choose_device(config.device, "evaluate.device"))
        write_json(draft.files / "timing.json", timing)
        return timing

    def check(self, draft: Draft) -> None:
        assert (draft.files / "report.html").is_file(), "evaluate wrote no report"


def open_worker(
    config: EvaluateConfig, inputs: Inputs, environment: dict[str, Any], mean_images: dict[str, np.ndarray]
) -> Worker:
    import torch

    from stages.graphics.metrics import with_lpips
    from stages.renderformer.inference.predict import load_model

    # Sums in another order round differently: one thread, so that a record is the same for any number of workers.
    torch.set_num_threads(1)
    model = load_model(inputs["train"].file("checkpoint"))
    return Worker(
        config=config,
        device=environment["device"],
        model=model,
        closed_form=model.without_learning(),
        shard=inputs["shard"],
        metrics=with_lpips(lpips_networks(config.lpips), config.lpips_folder),
        mean_images=mean_images,
    )


def mean_training_images(config: EvaluateConfig, inputs: Inputs) -> dict[str, np.ndarray]:
    """Per space (H, W, 3), of about ``baseline_views`` training images."""
    from stages.renderformer.evaluation.baselines import mean_images

    return mean_images(training_images(inputs["shard"], config.baseline_views), config.baseline_views)


def training_images(shard: Artifact, views: int) -> Iterator[np.ndarray]:
    """(V, H, W, 3) linear radiance, scene by scene, evenly strided over the training split: about ``views`` images.

    Without training scenes (imported ones, for a given checkpoint) of all scenes there are: no easier to beat, and said so.
    """
    import numpy as np

    from stages.renderformer.dataset import decode_sample

    ids = shard.ids("train") or shard.ids()
    stride = math.ceil(len(ids) * len(decode_sample(shard.read(ids[0])).views) / views)
    for scene_id in ids[::stride]:
        yield np.stack([view.image for view in decode_sample(shard.read(scene_id)).views.values()])


def visible_roughness(scene: SceneRecord, triangle: np.ndarray) -> float | None:
    """Mean roughness over the pixels of a view, weighted by the specular reflectance that they show.

    triangle: (H, W), the triangle in each pixel, -1 for nothing. None where nothing that is seen is specular.
    """
    visible = triangle[triangle >= 0]
    weight = scene.specular.mean(axis=1)[visible].astype("float64")
    return round(float(weight @ scene.roughness[visible] / weight.sum()), 4) if weight.any() else None


def network(checkpoint: Path) -> dict[str, Any]:
    """What the network in a checkpoint folder is, from its config and its headers alone."""
    from safetensors import safe_open

    from model.renderformer.architectures import load_config

    with safe_open(checkpoint / "model.safetensors", framework="numpy") as file:
        parameters = sum(math.prod(file.get_slice(name).get_shape()) for name in file.keys())  # noqa: SIM118 - not a dict
    return {"parameters": parameters, "network": load_config(checkpoint / "config.json").description}
