"""The training loop (section 3.3): resumable, and after a kill exactly the run that it would have been.

Reads batches that are a pure function of the step; writes ``training.pt`` (what is needed to go on) and ``log.jsonl`` into the
folder it is given. The one design choice: everything that changes from step to step is in ``training.pt``, replaced
atomically, and the log is cut back to that step on resume, so nothing is logged twice.
"""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from model.checkpoint import replace
from model.losses import LPIPS, image_loss, log_radiance
from model.renderformer import RenderFormer, Triangles, constant_material, to_radiance

STATE, LOG = "training.pt", "log.jsonl"
PATIENCE = 20  # this many non-finite steps in a row stop the run

Batch = Mapping[str, Any]


@dataclass(frozen=True)
class FitConfig:
    """How to train; the paper's values are in ``conf/train/paper_256.yaml``."""

    steps: int
    lr: float = 1e-4
    warmup: int = 8000  # steps of linear warm-up
    decay_steps: int | None = None  # step at which the cosine ends; None: the last
    final_lr: float = 0.0  # learning rate after the cosine, as a share of lr
    weight_decay: float = 0.01  # on matrices; norms, biases and tokens are left alone
    clip: float = 1.0  # largest gradient norm
    optimizer: str = "adamw"  # adamw | muon (2-D hidden weights; AdamW for the rest)
    muon_lr: float = 0.02  # highest learning rate of Muon's weights: the size of a step in spectral norm
    lpips: float = 0.0  # weight of LPIPS(VGG)
    gradient_leak: float = 0.0  # gradient, beyond ELU's own, of pixels that come out negative: without it they can die
    # Runtime: these do not change the result
    lpips_folder: Path | None = None
    mixed_precision: bool = False  # bfloat16 view-independent stage, and TF32 in the other
    compile: bool = False
    log_every: int = 50
    validate_every: int = 1000
    checkpoint_every: int = 500

    RUNTIME = ("lpips_folder", "mixed_precision", "compile", "log_every", "validate_every", "checkpoint_every")

    def identity(self) -> dict[str, Any]:
        return {name: value for name, value in dataclasses.asdict(self).items() if name not in self.RUNTIME}


def schedule(config: FitConfig, step: int) -> float:
    """Share of the highest learning rate at the 0-based step: linear warm-up, then cosine."""
    if step < config.warmup:
        return (step + 1) / config.warmup
    end = config.steps if config.decay_steps is None else config.decay_steps
    progress = min(1.0, (step - config.warmup) / max(1, end - config.warmup))
    return config.final_lr + (1 - config.final_lr) * 0.5 * (1 + math.cos(math.pi * progress))


def optimizers(model: nn.Module, config: FitConfig) -> list[torch.optim.Optimizer]:
    """AdamW for all, or Muon for the transformer layers' matrices and AdamW for the rest."""
    named = [(name, p) for name, p in model.named_parameters() if p.requires_grad]
    hidden = {name for name, p in named if p.ndim == 2 and ".layers." in name}
    if config.optimizer == "adamw":
        hidden = set()
    elif config.optimizer != "muon":
        raise ValueError(f"optimizer={config.optimizer!r} is unknown: adamw or muon")
    rest = [(name, p) for name, p in named if name not in hidden]
    decayed = [p for name, p in rest if p.ndim >= 2 and "token" not in name]
    plain = [p for name, p in rest if not (p.ndim >= 2 and "token" not in name)]
    groups = [{"params": decayed, "weight_decay": config.weight_decay}, {"params": plain, "weight_decay": 0.0}]
    found: list[torch.optim.Optimizer] = [
        torch.optim.AdamW([g for g in groups if g["params"]], lr=config.lr, betas=(0.9, 0.95))
    ]
    if hidden:
        matrices = [p for name, p in named if name in hidden]
        found.append(torch.optim.Muon(matrices, lr=config.muon_lr, weight_decay=config.weight_decay))
    return found


def scene_of(batch: Batch, model: RenderFormer, device: torch.device | str) -> Triangles:
    """The network's input from a batch of numpy arrays (see ``Triangles``); emission stays radiance here."""
    arrays = {
        name: torch.from_numpy(np.ascontiguousarray(batch[name])).to(device, non_blocking=True)
        for name in ("triangles", "vertex_normals", "diffuse", "specular", "roughness", "emission")
    }
    material = constant_material(
        arrays["diffuse"], arrays["specular"], arrays["roughness"], arrays["emission"], model.config.texture_channels
    )
    mask = None if batch["mask"].all() else torch.from_numpy(batch["mask"]).to(device, non_blocking=True)
    return Triangles(arrays["triangles"], arrays["vertex_normals"], material, mask)


def predict(forward: Callable[..., Tensor], model: RenderFormer, batch: Batch, device: Any, mixed: bool) -> Tensor:
    """(B, V, H, W, 3) log10(1 + radiance) for the batch's cameras, at its images' size."""
    cameras = torch.from_numpy(np.ascontiguousarray(batch["camera_to_world"])).to(device, non_blocking=True)
    fov = torch.from_numpy(np.ascontiguousarray(batch["fov_deg"])).to(device, non_blocking=True)
    return forward(scene_of(batch, model, device), cameras, fov, tuple(batch["image"].shape[2:4]), mixed)


def evaluate(model: RenderFormer, batches: Sequence[Batch], device: Any, mixed: bool = False) -> dict[str, float]:
    """Means over all views: ``log_error`` (L1 of log10(1 + x)) and ``psnr`` of linear radiance clamped to [0, 1], in dB."""
    errors, psnrs = [], []
    model.eval()
    with torch.inference_mode():
        for batch in batches:
            y = predict(model, model, batch, device, mixed).float()
            image = torch.from_numpy(batch["image"]).to(device)
            errors.append((y - log_radiance(image)).abs().mean(dim=(2, 3, 4)).flatten())
            mse = (to_radiance(y).clamp(0, 1) - image.clamp(0, 1)).square().mean(dim=(2, 3, 4)).flatten()
            psnrs.append(-10 * torch.log10(mse.clamp(min=1e-10)))
    model.train()
    return {"log_error": torch.cat(errors).mean().item(), "psnr": torch.cat(psnrs).mean().item()}


def _tokens(batch: Batch, model: RenderFormer) -> int:
    """Triangle, register and ray tokens of a batch, padding not counted."""
    views, height, width = batch["image"].shape[1:4]
    rays = views * (height // model.config.patch_size) * (width // model.config.patch_size)
    return int(batch["mask"].sum()) + batch["mask"].shape[0] * (model.config.num_register_tokens + rays)


def _memory_gb(device: torch.device) -> float:
    """Peak memory so far: of the GPU, or of this process."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**30
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


class _State:
    """All that changes from step to step, as one file."""

    def __init__(self, model: RenderFormer, config: FitConfig, folder: Path):
        self.model, self.config, self.path = model, config, folder / STATE
        self.optimizers = optimizers(model, config)
        self.step = 0  # steps done
        self.skipped = 0
        self.skipped_in_a_row = 0
        self.seconds = 0.0
        self.window: list[list[float]] = []  # loss, gradient norm of the steps since the last log line

    def save(self) -> None:
        temporary = self.path.with_suffix(".tmp")
        plain = {name: getattr(self, name) for name in ("step", "skipped", "skipped_in_a_row", "seconds", "window")}
        rng = {"cpu": torch.get_rng_state()}
        if torch.cuda.is_available():
            rng["cuda"] = torch.cuda.get_rng_state()
        torch.save(
            {
                "identity": self._identity(),
                "plain": plain,
                "model": self.model.state_dict(),
                "optimizers": [optimizer.state_dict() for optimizer in self.optimizers],
                "rng": rng,
            },
            temporary,
        )
        replace(temporary, self.path)

    def load(self) -> bool:
        """Whether there was something to go on from."""
        if not self.path.is_file():
            return False
        saved = torch.load(self.path, map_location="cpu", weights_only=True)
        if saved["identity"] != self._identity():
            raise ValueError(f"{self.path} belongs to a training run of another configuration: give it another folder")
        self.model.load_state_dict(saved["model"])
        for optimizer, state in zip(self.optimizers, saved["optimizers"], strict=True):
            optimizer.load_state_dict(state)
        torch.set_rng_state(saved["rng"]["cpu"])
        if "cuda" in saved["rng"] and torch.cuda.is_available():
            torch.cuda.set_rng_state(saved["rng"]["cuda"])
        for name, value in saved["plain"].items():
            setattr(self, name, value)
        return True

    def _identity(self) -> str:
        return json.dumps([self.model.config.to_dict(), self.config.identity()], sort_keys=True)


def _cut_log(path: Path, step: int) -> None:
    """Drop lines after ``step``, and a last one that a kill cut short."""
    kept = []
    for line in path.read_text().splitlines() if path.is_file() else []:
        try:
            row = json.loads(line)
        except ValueError:
            break
        if row["step"] <= step:
            kept.append(line + "\n")
    temporary = path.with_suffix(".tmp")
    temporary.write_text("".join(kept))
    replace(temporary, path)


def fit(
    model: RenderFormer,
    config: FitConfig,
    batches: Callable[[int, int], Iterable[Batch]],
    validation: Sequence[Batch],
    folder: Path,
    device: torch.device | str,
    log: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Train ``model`` in place up to ``config.steps``, going on from ``folder`` if it holds a state.

    ``batches(start, stop)`` yields the batches of those steps, each a pure function of its step: dicts of float32 arrays
    triangles (B, N, 3, 3), vertex_normals, diffuse, specular, roughness, emission (radiance), mask (B, N) bool,
    camera_to_world (B, V, 4, 4), fov_deg (B, V), image (B, V, H, W, 3) radiance. ``validation`` is a fixed list of such.
    Returns steps, skipped, seconds and the last validation's metrics.
    """
    device = torch.device(device)
    folder.mkdir(parents=True, exist_ok=True)
    model.to(device).train()
    model.view_transformer.gradient_leak = config.gradient_leak
    if config.mixed_precision:
        torch.set_float32_matmul_precision("high")
    lpips = LPIPS.load(config.lpips_folder).to(device) if config.lpips > 0 else None
    state = _State(model, config, folder)
    if state.load():
        log(f"going on from step {state.step:,} of {config.steps:,}")
    _cut_log(folder / LOG, state.step)
    forward = torch.compile(model) if config.compile else model
    parameters = [p for optimizer in state.optimizers for group in optimizer.param_groups for p in group["params"]]
    metrics: dict[str, float] = {}

    with (folder / LOG).open("a") as file:

        def write(row: dict[str, Any]) -> None:
            file.write(json.dumps(row) + "\n")
            file.flush()

        began, base_seconds = time.perf_counter(), state.seconds
        interval_began, interval_scenes, interval_tokens = began, 0, 0
        for step, batch in enumerate(batches(state.step, config.steps), start=state.step):
            share = schedule(config, step)
            for optimizer in state.optimizers:
                for group in optimizer.param_groups:
                    group["lr"] = share * (config.muon_lr if isinstance(optimizer, torch.optim.Muon) else config.lr)
            y = predict(forward, model, batch, device, config.mixed_precision)
            loss = image_loss(y, torch.from_numpy(batch["image"]).to(device), lpips, config.lpips)
            loss.backward()
            norm = nn.utils.clip_grad_norm_(parameters, config.clip)
            loss_value, norm_value = loss.item(), norm.item()
            if math.isfinite(loss_value) and math.isfinite(norm_value):
                for optimizer in state.optimizers:
                    optimizer.step()
                state.window.append([loss_value, norm_value])
                state.skipped_in_a_row = 0
            else:
                state.skipped += 1
                state.skipped_in_a_row += 1
                if state.skipped_in_a_row >= PATIENCE:
                    scenes = ", ".join(str(i) for i in batch.get("ids", ())) or "not named"
                    raise ValueError(
                        f"training stopped at step {step}: loss {loss_value}, gradient norm {norm_value}, not finite for "
                        f"{PATIENCE} steps in a row; look at the scenes of this batch ({scenes}), or try a smaller lr"
                    )
            for optimizer in state.optimizers:
                optimizer.zero_grad(set_to_none=True)
            state.step = step + 1
            interval_scenes += len(batch["mask"])
            interval_tokens += _tokens(batch, model)
            last = state.step == config.steps

            if state.step % config.log_every == 0 or last:
                now = time.perf_counter()
                state.seconds, elapsed = base_seconds + now - began, now - interval_began
                mean_loss, mean_norm = np.mean(state.window, axis=0).tolist() if state.window else (None, None)
                row = {"step": state.step, "loss": mean_loss, "lr": share * config.lr, "grad_norm": mean_norm}
                write(row | {"skipped": state.skipped, "seconds": round(state.seconds, 3)})
                shown = "     nan" if mean_loss is None else f"{mean_loss:8.5f}"
                log(
                    f"step {state.step:>{len(str(config.steps))}}/{config.steps}  loss {shown}  lr {share * config.lr:.2e}  "
                    f"grad {mean_norm or 0:7.3f}  {interval_scenes / elapsed:7.2f} scenes/s  "
                    f"{interval_tokens / elapsed:9,.0f} tokens/s  {_memory_gb(device):5.2f} GB"
                    + (f"  {state.skipped} skipped" if state.skipped else "")
                )
                state.window = []
                interval_began, interval_scenes, interval_tokens = now, 0, 0
            if validation and (state.step % config.validate_every == 0 or last):
                metrics = evaluate(model, validation, device, config.mixed_precision)
                write({"step": state.step} | {f"validation_{name}": value for name, value in metrics.items()})
                log(
                    f"step {state.step:>{len(str(config.steps))}}/{config.steps}  validation: "
                    f"log error {metrics['log_error']:.5f}  psnr {metrics['psnr']:.2f} dB"
                )
                interval_began = time.perf_counter()
                interval_scenes = interval_tokens = 0
            if state.step % config.checkpoint_every == 0 or last:
                state.seconds = base_seconds + time.perf_counter() - began
                state.save()
    if validation and not metrics:  # killed between the last step and the product: everything was done already
        metrics = evaluate(model, validation, device, config.mixed_precision)
    model.eval()
    return {"steps": state.step, "skipped": state.skipped, "seconds": round(state.seconds, 1)} | metrics
