"""Stage 6, train: the shards to a checkpoint of a RenderFormer (section 3.3), or of a guided network.

Reads the train and validation splits of *shard*; writes ``checkpoint/`` in the released format (the model after the last
step: with a cosine to zero that is the one to use, and nothing is chosen by looking at validation), ``best/`` (the one with the
lowest validation error, should the last be worse), ``objects.json`` in both (`TrainingObjects`), ``log.jsonl``, ``curve.png``,
``validation/`` (pictures of fixed views) and ``tensorboard/``. The loop itself is ``model.renderformer.training.fit``; this
module binds it to configs, artifacts and files. Started by ``torchrun``, the first process leads and the others follow.
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

from pydantic import Discriminator, Field, Tag, create_model, model_validator

from model.renderformer.config import FIXED, ModelConfig
from model.renderformer.guided.config import GuideConfig, GuidedConfig
from model.renderformer.recipe import FitConfig
from model.training.threads import wait_briefly
from pipeline.config import Section, StageConfig, runtime
from pipeline.errors import UserError
from pipeline.stage import Inputs, RunStage
from stages.graphics.device import choose_device
from stages.renderformer import hub
from stages.renderformer.dataset import BatchConfig

if TYPE_CHECKING:
    import numpy as np

    from model.renderformer.base import Network
    from model.training.parallel import Group
    from pipeline.store import Artifact, Draft


OBJECTS = "objects.json"  # beside a checkpoint: its training objects; of a shard artifact: those of all splits


class NetworkSection(Section):
    """What `ModelSection` has besides the network's own fields."""

    name: str = runtime("custom")  # for people: the variant's file name; what it holds is in the other fields

    @model_validator(mode="after")
    def _computable(self) -> NetworkSection:
        self.build()
        return self

    def build(self) -> ModelConfig:
        """As the network's own config, which refuses what it cannot compute."""
        return ModelConfig(**self.model_dump(exclude={"name"}))

    def unstartable(self, train: TrainConfig) -> str | None:
        """Why these settings cannot train the network, if they cannot."""
        if train.bundles_per_view:
            return f"bundles_per_view={train.bundles_per_view}: {self.name} needs whole views; set train.bundles_per_view=0"
        if train.informed_start is True and train.init_from is None and not (self.pe_type == "rope" and self.turn_to_cam_coord):
            return (
                f"informed_start=true aims rays by rotary positions in the camera frame, which {self.name} does not have: "
                "set train.informed_start=inputs or false"
            )
        return None


# The network: the fields of ModelConfig that have more than one supported value. They are stated there.
ModelSection = create_model(
    "ModelSection",
    __base__=NetworkSection,
    __module__=__name__,
    **{name: (kind, getattr(ModelConfig, name)) for name, kind in get_type_hints(ModelConfig).items() if name not in FIXED},
)

GuideSection = create_model(
    "GuideSection",
    __base__=Section,
    __module__=__name__,
    **{name: (kind, getattr(GuideConfig, name)) for name, kind in get_type_hints(GuideConfig).items()},
)


class GuidedNetworkSection(Section):
    """What `GuidedSection` has besides the network's own fields."""

    architecture: Literal["guided"] = "guided"
    name: str = runtime("guided")
    guide: GuideSection = GuideSection()

    @model_validator(mode="after")
    def _computable(self) -> GuidedNetworkSection:
        self.build()
        return self

    def build(self) -> GuidedConfig:
        fields = self.model_dump(exclude={"name", "architecture", "guide"})
        return GuidedConfig(guide=GuideConfig(**self.guide.model_dump()), **fields)

    def unstartable(self, train: TrainConfig) -> str | None:
        if train.informed_start:
            return (
                f"informed_start={train.informed_start}: {self.name} starts from closed forms; set train.informed_start=false"
            )
        return None


GuidedSection = create_model(
    "GuidedSection",
    __base__=GuidedNetworkSection,
    __module__=__name__,
    **{name: (kind, getattr(GuidedConfig, name)) for name, kind in get_type_hints(GuidedConfig).items() if name != "guide"},
)


def _architecture(data: Any) -> str:
    name = data.get("architecture") if isinstance(data, dict) else getattr(data, "architecture", None)
    return "renderformer" if name is None else str(name)


Model = Annotated[
    Annotated[ModelSection, Tag("renderformer")] | Annotated[GuidedSection, Tag("guided")], Discriminator(_architecture)
]


class TrainConfig(StageConfig, BatchConfig, FitConfig):
    """The data's and the loop's settings, which are stated with what reads them, and what binds the two."""

    model: Model = ModelSection()
    max_triangles: int | None = Field(None, ge=1)  # scenes with more are left out; null: none is
    init_from: str | None = runtime(None)  # checkpoint folder or train artifact to start from; its content counts, not its path
    # Initial values that say what is known (model.renderformer.initial), for runs of minutes.
    # inputs: of materials and normals, not of rays
    informed_start: bool | Literal["inputs"] = True
    # Runtime
    device: str = runtime("auto")  # auto | cpu | cuda
    threads: int | None = runtime(None, ge=1)  # CPU threads, at most one a core; null: torch's choice
    ahead: int = runtime(4, ge=1)  # batches that are read ahead
    loader_workers: int = runtime(0, ge=0)  # processes that decode them; 0: threads of this one
    skip_damaged_shards: bool = runtime(False)  # go on without the samples of shards that are missing or cut
    validation_scenes: int = runtime(16, ge=1)
    validate_on: Literal["validation", "train"] = runtime("validation")  # train: how well it fits what it sees
    tensorboard: bool = runtime(True)  # events besides log.jsonl

    @model_validator(mode="after")
    def _startable(self) -> TrainConfig:
        if self.views_per_scene < 1:
            raise ValueError("views_per_scene=0 leaves nothing to learn from: give each scene at least one view")
        if problem := self.model.unstartable(self):
            raise ValueError(problem)
        return self


class Train(RunStage):
    name = "train"
    version = 4
    inputs = ("shard",)
    Config = TrainConfig

    def slug(self, config: TrainConfig) -> str:
        return config.model.name

    def agree(self, config: TrainConfig, configs: Mapping[str, StageConfig]) -> None:
        """Weights that are missing are missed before anything runs."""
        if config.lpips > 0:
            from model.lpips import LPIPS

            LPIPS.files(config.lpips_folder)

    def identity(self, config: TrainConfig, hash_file: Callable[[Any], str]) -> dict[str, Any]:
        if config.init_from is None:
            return {}
        folder = initial_folder(config.init_from)
        names = ["config.json", "model.safetensors", *([OBJECTS] if (folder / OBJECTS).is_file() else [])]
        return {"init_from": {name: hash_file(folder / name) for name in names}}

    def estimate(self, config: TrainConfig, configs: Mapping[str, StageConfig]) -> list[str]:
        return estimate(config, configs)

    def run(self, config: TrainConfig, inputs: Inputs, draft: Draft) -> list[str]:
        wait_briefly()
        from model.training.parallel import join

        with join(choose_device(config.device, "train.device")) as group:
            group.tell(str(draft.state))
            summary = self._train(config, inputs, group, draft.state, draft.files, draft.log)
        objects = training_objects(config, inputs["shard"])
        for name, where in (("last", "checkpoint"), ("best", "best")):
            if (draft.state / name).is_dir():
                shutil.copytree(draft.state / name, draft.files / where, dirs_exist_ok=True)
                objects.write(draft.files / where)
        rows = [json.loads(line) for line in (draft.state / "log.jsonl").read_text().splitlines()]
        (draft.files / "log.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
        plot_curve(rows, draft.files / "curve.png", f"{config.model.name}, {config.steps:,} steps")
        draft.note("training", summary)
        return ["checkpoint/config.json", "checkpoint/model.safetensors"]

    def follow(self, config: TrainConfig, inputs: Inputs) -> None:
        wait_briefly()
        from model.training.parallel import join

        with join(choose_device(config.device, "train.device")) as group:
            self._train(config, inputs, group, Path(group.tell("")), None, lambda text: None)

    def _train(
        self, config: TrainConfig, inputs: Inputs, group: Group, state: Path, files: Path | None, say: Callable[[str], None]
    ) -> dict[str, Any]:
        """This process's part; ``files`` only for the one that leads."""
        import torch

        from model.renderformer.architectures import build
        from model.renderformer.training import fit
        from stages.renderformer.dataset import Batches, Needs, ShardDataset, evaluation_samples, prefetch

        if config.threads is not None:  # more than there are cores would only wait for one another
            torch.set_num_threads(min(config.threads, os.cpu_count() or config.threads))
        # a well-trained network's attention is full of numbers below 1e-38, which a CPU computes many times slower than zeros;
        # before the first parallel operation, as threads take the setting of the one that starts them
        torch.set_flush_denormal(True)
        skip = config.skip_damaged_shards
        train = ShardDataset(inputs["shard"], "train", config.max_triangles, skip_damaged_shards=skip)
        validation = train
        if config.validate_on != "train":
            validation = ShardDataset(inputs["shard"], config.validate_on, config.max_triangles, skip_damaged_shards=skip)
        if config.init_from is not None:
            check_objects(f"train.init_from={config.init_from}", initial_folder(config.init_from), inputs["shard"], say)
        torch.manual_seed(config.seed)
        model = build(config.model.build())
        start(model, config)
        if model.reads_guides and not train.guided:
            raise UserError(
                f"{config.model.name} reads guides, and the shards have none: set shard.guides=true, or choose another model"
            )
        needs = Needs(model.reads_guides, bundle=model.config.resolution_multiple)
        batches = Batches(train, config, group.rank, group.world, needs)
        held_out = list(itertools.islice(evaluation_samples(validation, model.reads_guides), config.validation_scenes))
        processes = f", {group.world} processes" if group.world > 1 else ""
        say(
            f"{sum(p.numel() for p in model.parameters()) / 1e6:.1f}M parameters ({config.model.name}) on {group.device}, "
            f"{torch.get_num_threads()} threads{processes}; {len(train)} training and {len(validation)} validation scenes; "
            + (f"starting from {config.init_from}" if config.init_from else "starting from scratch")
        )
        multiple = model.config.resolution_multiple
        if train.resolution % multiple:
            raise UserError(
                f"images of {train.resolution} px cannot train {config.model.name}: its resolution must be a "
                f"multiple of {multiple} (render.resolution)"
            )
        damaged: dict[str, str] = {}
        summary = fit(
            model,
            config,
            lambda start, stop: name_damaged(prefetch(batches, start, stop, config.ahead, config.loader_workers), damaged, say),
            held_out,
            state,
            group,
            say,
            show=None if files is None else lambda step, pairs: show(files / "validation", step, pairs),
            tensorboard=files / "tensorboard" if files is not None and config.tensorboard else None,
            trained_with={"triangles": str(train.triangles.max()), "resolution": str(train.resolution)},
        )
        return summary | ({"damaged_samples": len(damaged)} if damaged else {})


def name_damaged(
    batches: Iterable[dict[str, Any]], damaged: dict[str, str], say: Callable[[str], None]
) -> Iterator[dict[str, Any]]:
    """The batches as they come. Each sample that they skipped is said once, and kept in ``damaged``: id -> reason."""
    for batch in batches:
        for id, reason in batch["damaged"]:
            if id not in damaged:
                damaged[id] = reason
                say(f"sample {id} is damaged, another one takes its place: {reason}")
        yield batch


def initial_folder(reference: str) -> Path:
    """The checkpoint folder that ``train.init_from`` names: itself, or inside a train artifact's folder."""
    folder = hub.checkpoint(reference) if hub.is_hub(reference) else Path(reference).expanduser()
    for candidate in (folder, folder / "files" / "checkpoint"):
        if (candidate / "config.json").is_file() and (candidate / "model.safetensors").is_file():
            return candidate
    raise UserError(
        f"train.init_from={reference} holds no checkpoint: give a folder with config.json and model.safetensors, or that of a "
        "finished train artifact (store/train/...)"
    )


@dataclass(frozen=True)
class TrainingObjects:
    """Objects in the training scenes of a model, and of the models that it started from: ``objects.json`` beside its weights.

    ``objects``: object id -> content hash of its mesh. ``complete``: False where the scenes do not say what they show, or a
    model that it started from had no complete list.
    """

    objects: dict[str, str]
    complete: bool = True

    def write(self, folder: Path) -> None:
        (folder / OBJECTS).write_text(json.dumps(asdict(self), indent=1, sort_keys=True) + "\n")

    @classmethod
    def read(cls, folder: Path) -> TrainingObjects:
        """Of a checkpoint folder; empty and not complete where it has no list. UserError where the list is malformed."""
        if not (folder / OBJECTS).is_file():
            return cls({}, complete=False)
        try:
            objects_json = json.loads((folder / OBJECTS).read_bytes())
            return cls(
                {str(id): str(content) for id, content in objects_json["objects"].items()}, bool(objects_json["complete"])
            )
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise UserError(
                f"{folder / OBJECTS} is no list of training objects ({error}): expected objects, complete"
            ) from None


def split_objects(shard: Artifact, split: str) -> dict[str, str]:
    """Object id -> content hash, of the objects in the shards' scenes of a split."""
    listed = json.loads(shard.file(OBJECTS).read_bytes()).get(split, {})
    return {id: entry["content_hash"] for id, entry in listed.items()}


def training_objects(config: TrainConfig, shard: Artifact) -> TrainingObjects:
    """What the finished model has seen. Imported scenes do not say which objects they show, so their list is not complete."""
    seen_objects = split_objects(shard, "train")
    before = TrainingObjects({}) if config.init_from is None else TrainingObjects.read(initial_folder(config.init_from))
    return TrainingObjects(before.objects | seen_objects, before.complete and bool(seen_objects))


def check_objects(setting: str, folder: Path, shard: Artifact, say: Callable[[str], None]) -> None:
    """Refuse the model in the checkpoint folder that ``setting`` names if it was trained on objects of the test split.

    Content decides, as made-up objects have the same ids for every seed.
    """
    training = TrainingObjects.read(folder)
    contents = set(training.objects.values())
    leaked = [id for id, content in sorted(split_objects(shard, "test").items()) if content in contents]
    if leaked:
        names = ", ".join([*leaked[:5], *["..."] * (len(leaked) > 5)])
        raise UserError(
            f"{setting} was trained on {len(leaked)} object(s) of the test split ({names}), so its test would say nothing: "
            "choose another model, or other test scenes"
        )
    if not training.complete:
        say(
            f"warning: nobody knows all objects that {setting} was trained on ({OBJECTS} is missing there or in what it "
            "started from): some may be in the test split"
        )


def start(model: Network, config: TrainConfig) -> None:
    """Give the model its initial values: another run's, informed ones, or those of its layers."""
    if config.init_from is None:
        if config.informed_start:
            from model.renderformer.initial import start_informed

            start_informed(model, rays=config.informed_start is True)
        return
    from model.renderformer import checkpoint

    initial, _ = checkpoint.load(initial_folder(config.init_from))
    expected, actual = model.config.to_dict(), initial.config.to_dict()
    names = sorted(expected.keys() | actual.keys())
    different = [f"{name} {actual.get(name)} instead of {expected.get(name)}" for name in names
                 if expected.get(name) != actual.get(name)]  # fmt: skip
    if different:
        raise UserError(f"train.init_from={config.init_from} is another network: {', '.join(different)} (choose model=...)")
    model.load_state_dict(initial.state_dict())


def show(folder: Path, step: int, pairs: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """References above, predictions below, each pair at the reference's exposure; also written as ``step-<step>.png``."""
    import numpy as np
    from PIL import Image

    from stages.graphics.tonemap import exposure_for, to_picture

    columns = []
    for reference, prediction in pairs:
        exposure = exposure_for(reference)
        columns.append(np.concatenate([to_picture(image, exposure) for image in (reference, prediction)]))
    picture = np.concatenate(columns, axis=1)
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).save(folder / f"step-{step:07}.png")
    return picture


A100_TFLOPS = {"float32": 156.0, "bfloat16": 312.0}  # its data sheet's, float32 products in TF32
UTILISATION = 0.4  # of that, assumed


@dataclass(frozen=True)
class Cost:
    """Of a whole training run: floating-point operations, and days of one A100 at `UTILISATION`."""

    flops: float
    days: float


def sizes(config: TrainConfig, configs: Mapping[str, StageConfig]) -> tuple[int | None, int | None]:
    """Pixels per side and most triangles of a scene; None where the data does not say."""
    largest = config.max_triangles or getattr(configs.get("scene"), "max_triangles", None)
    return getattr(configs.get("render"), "resolution", None), largest


def cost(config: TrainConfig, configs: Mapping[str, StageConfig]) -> Cost | None:
    """With every scene as large as allowed; None where the data does not say how large that is."""
    from model.renderformer.architectures import architecture_of
    from model.renderformer.flops import TRAINING, ideal_seconds

    side, largest = sizes(config, configs)
    if side is None or largest is None:
        return None
    network = config.model.build()
    flops = architecture_of(network).flops(network, [largest], config.views_per_scene, side, side)
    if config.bundles_per_view:
        share = min(1.0, config.bundles_per_view * network.resolution_multiple**2 / side**2)
        flops = architecture_of(network).flops(network, [largest], config.views_per_scene, side, side * share)
    peaks = {name: value * 1e12 * UTILISATION for name, value in A100_TFLOPS.items()}
    scenes = TRAINING * config.batch_scenes * config.steps
    return Cost(scenes * sum(flops.values()), scenes * ideal_seconds(flops, peaks, config.precision) / 86400)


def estimate(config: TrainConfig, configs: Mapping[str, StageConfig]) -> list[str]:
    """What data and training cost, at most: every scene as large as allowed, every pixel with all its samples."""
    lines = []
    network = config.model.build()
    scene, render = configs.get("scene"), configs.get("render")
    side, largest = sizes(config, configs)
    if hasattr(scene, "count") and render is not None:
        images = sum(scene.count.model_dump().values()) * scene.cameras.views
        adaptive = f", fewer where the error is under {render.target_error:g}" if render.target_error else ""
        visits = config.steps * config.batch_scenes / max(1, scene.count.train)
        lines += [
            f"data: {scene.count.train:,} training scenes of at most {scene.max_triangles:,} triangles; {images:,} images of "
            f"{side} px in all splits, {images * side**2 * render.max_spp:.2e} camera paths to render "
            f"(at most {render.max_spp:,} per pixel{adaptive})",
            f"visits: {visits:.1f} of each training scene",
        ]
    paid = cost(config, configs)
    if paid is None:
        return [*lines, "training: cost unknown, the data does not say its resolution or its triangles"]
    bundles = (side // network.bundle_side) ** 2
    rays = config.views_per_scene * min(bundles, config.bundles_per_view or bundles)
    tokens = (largest + network.registers + rays) * config.batch_scenes
    return [
        *lines,
        f"training: {config.steps:,} steps of {config.batch_scenes} scenes x {config.views_per_scene} views, "
        f"{tokens:,} tokens a step, {tokens * config.steps:.2e} in all",
        f"compute: {paid.flops / config.steps:.2e} FLOPs a step, {paid.flops:.2e} in all; {paid.days:.3g} days of one A100, "
        f"{paid.days / 8:.3g} of eight (at {UTILISATION:.0%} of its peak, {config.precision} precision)",
        "start: "
        + (f"from {config.init_from}" if config.init_from else "from scratch (train.init_from=FOLDER: from another run)"),
    ]


def plot_curve(rows: list[dict[str, Any]], path: Path, title: str) -> None:
    """Training loss and validation error over steps on the left, validation PSNR on the right."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.add_subplot()
    right = axes.twinx()
    lines = []
    for where, key, label, style in (
        (axes, "loss", "training loss", "C0-"),
        (axes, "validation_log_error", "validation, log error", "C1o-"),
        (right, "validation_psnr", "validation, PSNR", "C2.--"),
    ):
        points = [(row["step"], row[key]) for row in rows if row.get(key) is not None]
        if points:
            lines += where.plot(*zip(*points, strict=True), style, label=label, markersize=3, linewidth=1.2)
    axes.set(xlabel="step", ylabel="L1 of log10(1 + radiance)", title=title, yscale="log")
    right.set(ylabel="PSNR (dB)")
    axes.grid(alpha=0.3, which="both")
    figure.legend(handles=lines, loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(path, dpi=120)
