"""Stage 6, train: the shards to a RenderFormer checkpoint (section 3.3).

Reads the train and validation splits of *shard*; writes ``checkpoint/`` in the released format (the model after the last
step: with a cosine to zero that is the one to use, and nothing is chosen by looking at validation), ``log.jsonl`` and
``curve.png``. The loop itself is ``model.training.fit``; this module binds it to configs, artifacts and files.
"""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from pipeline.config import Section, StageConfig, runtime
from pipeline.errors import UserError
from pipeline.stage import Inputs, RunStage
from stages.dataset import BatchConfig, Relight
from stages.device import choose_device

if TYPE_CHECKING:
    from model.config import ModelConfig
    from pipeline.store import Draft


class ModelSection(Section):
    """The network, in the released config's field names (``model.config.ModelConfig``, where each is explained)."""

    name: str = runtime("custom")  # for people: the variant's file name; what it holds is in the fields below
    latent_dim: int = 768
    num_layers: int = 12
    num_heads: int = 6
    dim_feedforward: int = 3072
    num_register_tokens: int = 16
    texture_channels: int = 13
    texture_encode_patch_size: int = 32
    vn_pe_num_freqs: int = 6
    pe_type: str = "rope"
    vertex_pe_num_freqs: int = 12
    rope_double_max_freq: bool = False
    view_transformer_latent_dim: int = 768
    view_transformer_n_layers: int = 6
    view_transformer_n_heads: int = 6
    view_transformer_ffn_hidden_dim: int = 3072
    view_transformer_include_self_attn: bool = True
    view_transformer_use_swin_attn: bool = False
    turn_to_cam_coord: bool = True
    use_dpt_decoder: bool = True
    dpt_features: int = 128
    dpt_out_channels: tuple[int, ...] = (96, 192, 384, 768)
    dpt_out_layers: tuple[int, ...] | None = None

    def build(self) -> ModelConfig:
        """As the network's own config, which refuses what it cannot compute."""
        from model.config import ModelConfig

        return ModelConfig(**self.model_dump(exclude={"name"}))


class TrainConfig(StageConfig):
    seed: int = 0
    model: ModelSection = ModelSection()
    # Schedule
    steps: int = Field(1500, ge=1)
    batch_scenes: int = Field(4, ge=1)
    views_per_scene: int = Field(4, ge=1)
    lr: float = Field(1e-3, gt=0)
    warmup: int = Field(50, ge=0)  # steps
    decay_steps: int | None = Field(None, ge=1)  # step at which the cosine ends; null: the last step
    final_lr: float = Field(0.0, ge=0, le=1)  # after the cosine, as a share of lr
    optimizer: Literal["adamw", "muon"] = "muon"
    muon_lr: float = Field(0.005, gt=0)  # highest learning rate of Muon's weights: a step's size in spectral norm
    weight_decay: float = Field(0.01, ge=0)
    clip: float = Field(1.0, gt=0)  # largest gradient norm
    precision: Literal["mixed", "fp32"] = "mixed"  # mixed: view-independent stage in bfloat16 on a GPU; the CPU uses fp32
    # Loss: L1 on log10(1 + x) + lpips * LPIPS(VGG)
    lpips: float = Field(0.0, ge=0)
    # Share of the gradient that pixels below 0 get besides ELU's own 1e-3: at high learning rates the output else dies
    gradient_leak: float = Field(0.1, ge=0, le=1)
    informed_start: bool = True  # initial values that say what is known (model.initial), for runs of minutes
    # Augmentation
    rotate: bool = False  # turn the scene at random: the view-independent stage must not learn an orientation
    translate_sigma: float = Field(0.0, ge=0)  # and move it; scene units
    mirror: bool = False  # x -> -x, for half of the samples
    relight: bool = True  # reweight the lights' own images: light transport is linear
    lighting: Relight = Relight()  # what relight draws from
    max_triangles: int | None = Field(None, ge=1)  # scenes with more are left out; null: none is
    # Runtime
    lpips_folder: str | None = runtime(None)  # folder with the published LPIPS weights
    device: str = runtime("auto")  # auto | cpu | cuda
    compile: bool = runtime(False)  # torch.compile
    threads: int | None = runtime(None, ge=1)  # CPU threads; null: torch's choice
    ahead: int = runtime(4, ge=1)  # batches that are read ahead
    log_every: int = runtime(50, ge=1)  # steps
    validate_every: int = runtime(200, ge=1)
    validation_scenes: int = runtime(16, ge=1)
    checkpoint_every: int = runtime(100, ge=1)

    def batches(self) -> BatchConfig:
        """The loader's part."""
        names = ("seed", "batch_scenes", "views_per_scene", "rotate", "translate_sigma", "mirror", "relight", "lighting")
        return BatchConfig(**{name: getattr(self, name) for name in names})


class Train(RunStage):
    name = "train"
    version = 1
    inputs = ("shard",)
    Config = TrainConfig

    def slug(self, config: TrainConfig) -> str:
        return config.model.name

    def run(self, config: TrainConfig, inputs: Inputs, draft: Draft) -> list[str]:
        import torch

        from model import checkpoint
        from model.initial import start_informed
        from model.renderformer import RenderFormer
        from model.training import LOG, FitConfig, fit
        from stages.dataset import Batches, ShardDataset, evaluation_samples, prefetch

        device = choose_device(config.device, "train.device")
        if config.threads is not None:
            torch.set_num_threads(config.threads)
        train = ShardDataset(inputs["shard"], "train", config.max_triangles)
        validation = ShardDataset(inputs["shard"], "validation", config.max_triangles)
        batches = Batches(train, config.batches())
        held_out = list(itertools.islice(evaluation_samples(validation), config.validation_scenes))

        torch.manual_seed(config.seed)
        model = RenderFormer(config.model.build())
        if config.informed_start:
            start_informed(model)
        draft.log(
            f"{sum(p.numel() for p in model.parameters()) / 1e6:.1f}M parameters ({config.model.name}) on {device}, "
            f"{torch.get_num_threads()} threads; {len(train)} training and {len(validation)} validation scenes"
        )
        multiple = model.config.resolution_multiple
        if train.resolution % multiple:
            raise UserError(
                f"images of {train.resolution} px cannot train {config.model.name}: its resolution must be a "
                f"multiple of {multiple} (render.resolution)"
            )
        summary = fit(
            model,
            FitConfig(
                steps=config.steps,
                lr=config.lr,
                warmup=config.warmup,
                decay_steps=config.decay_steps,
                final_lr=config.final_lr,
                weight_decay=config.weight_decay,
                clip=config.clip,
                optimizer=config.optimizer,
                muon_lr=config.muon_lr,
                lpips=config.lpips,
                gradient_leak=config.gradient_leak,
                lpips_folder=Path(config.lpips_folder) if config.lpips_folder else None,
                mixed_precision=config.precision == "mixed" and device == "cuda",
                compile=config.compile,
                log_every=config.log_every,
                validate_every=config.validate_every,
                checkpoint_every=config.checkpoint_every,
            ),
            lambda start, stop: prefetch(batches, start, stop, config.ahead),
            held_out,
            draft.state,
            device,
            draft.log,
        )
        trained_with = {"triangles": str(train.triangles.max()), "resolution": str(train.resolution)}
        checkpoint.save(model, draft.files / "checkpoint", trained_with)
        rows = [json.loads(line) for line in (draft.state / LOG).read_text().splitlines()]
        (draft.files / LOG).write_text("".join(json.dumps(row) + "\n" for row in rows))
        plot_curve(rows, draft.files / "curve.png", f"{config.model.name}, {config.steps:,} steps")
        draft.note("training", summary)
        return ["checkpoint/config.json", "checkpoint/model.safetensors"]


def plot_curve(rows: list[dict[str, Any]], path: Path, title: str) -> None:
    """Training loss and validation error over steps."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.add_subplot()
    for key, label, style in (("loss", "training loss", "-"), ("validation_log_error", "validation, log error", "o-")):
        points = [(row["step"], row[key]) for row in rows if row.get(key) is not None]
        if points:
            axes.plot(*zip(*points, strict=True), style, label=label, markersize=3)
    axes.set(xlabel="step", ylabel="L1 of log10(1 + radiance)", title=title, yscale="log")
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    figure.savefig(path, dpi=120)
