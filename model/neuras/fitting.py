"""Learning a scene: textures, skyboxes, codebooks and both networks, from the pixels of posed images (section 3.3).

One step: draw patches of pixels; gather the features of the texels that they touch; quantize them (eq. 5); sample, shade and
composite (eq. 1 to 4); losses (eq. 6 to 9); Adam, on touched rows alone. The state after every step is a function of the config
and the data, so a run that was killed goes on from its last checkpoint to the same bytes (on a CPU, with as many threads).
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from model.errors import InputError
from model.neuras.baked import Baked
from model.neuras.losses import perceptual_loss
from model.neuras.quantization import straight_through
from model.neuras.rays import Batch, Pixels, View
from model.neuras.sampling import gather
from model.neuras.scene import FitConfig, Scene, Surroundings
from model.training.logs import TrainingLog
from pipeline.atomic import atomic_path

STATE = "state.safetensors"
FEW = 0.2  # share of the photos' pixels on the mesh below which something is wrong with it, most likely
LOSSES = ("loss", "photometric", "perceptual", "vq")


def rate(step: int, config: FitConfig) -> float:
    """Share of the learning rates at the 0-based step: a cosine to ``final_lr``."""
    return config.final_lr + (1 - config.final_lr) * 0.5 * (1 + math.cos(math.pi * step / config.steps))


class Trainer:
    """A scene, its optimizer and its step. ``window``: sums of the losses, and their number, since the last line of the log."""

    def __init__(self, scene: Scene):
        self.scene, self.config, self.step = scene, scene.config, 0
        groups = [{"params": scene.networks(), "lr": scene.config.network_lr}]
        if scene.codes:
            groups.append({"params": list(scene.codes.values()), "lr": scene.config.lr})
        if scene.exposure is not None:
            groups.append({"params": list(scene.exposure.parameters()), "lr": scene.config.network_lr})
        self.optimizer = torch.optim.Adam([group | {"peak_lr": group["lr"]} for group in groups], betas=(0.9, 0.99))
        self.perceptual = perceptual_loss(self.config.perceptual_network, self.config.lpips_folder, scene.device)
        self.window = torch.zeros(len(LOSSES) + 1, dtype=torch.float64)
        if scene.config.compile:
            scene.mesh_shader.compile()
            scene.sky_shader.compile()

    def train_step(self, batch: Batch) -> None:
        """One step of everything. InputError where the loss is not finite: nothing was changed then."""
        scene, config = self.scene, self.config
        quantizing = bool(scene.codes) and self.step >= config.quantize_from * config.steps
        generator = torch.Generator().manual_seed(config.seed * 1_000_003 + self.step)
        directions = batch.directions
        if config.direction_noise:
            noise = torch.randn(directions.shape, generator=generator).to(scene.device) * config.direction_noise
            directions = torch.nn.functional.normalize(directions + noise, dim=1)
        if scene.wider:
            shares = [1 - config.coarser_share, *[config.coarser_share / scene.wider] * scene.wider]
            levels = torch.multinomial(torch.tensor(shares), len(batch.detail), replacement=True, generator=generator)
            batch = batch.coarser(levels.to(scene.device))
        leaves, samples, vq = {}, {}, torch.zeros((), device=scene.device)
        for name, (texels, weights, rays) in scene.places(batch).items():
            rows, where = scene.maps[name].row_of[texels].unique(return_inverse=True)
            rows = rows.long()
            leaf = scene.maps[name].features(rows).requires_grad_()
            leaves[name] = (rows, leaf)
            used = leaf
            if quantizing and len(rows):
                used, loss = straight_through(leaf, scene.codes[name], config.commitment)
                vq = vq + loss
            samples[name] = (gather(used, where, weights), rays)
        with torch.autocast(scene.device.type, torch.bfloat16, enabled=config.mixed_precision):
            rendered = scene.shade(batch, samples, directions)
        if scene.exposure is not None:
            rendered = scene.exposure(rendered, batch.views)
        difference = (rendered - batch.rgb) * batch.counts[:, None]
        photometric = difference.square().mean()
        perceptual = torch.zeros_like(photometric)
        if config.perceptual:
            perceptual = self.perceptual(difference, batch.rgb * batch.counts[:, None], batch.patch)
        total = photometric + config.perceptual * perceptual + config.vq * vq
        losses = torch.stack([loss.detach() for loss in (total, photometric, perceptual, vq)]).double().cpu()
        if not torch.isfinite(losses).all():
            raise InputError(f"the loss of step {self.step} is not finite: try a smaller lr or network_lr")
        total.backward()
        self.window[: len(LOSSES)] += losses
        self.window[-1] += 1
        share = rate(self.step, config)
        for group in self.optimizer.param_groups:
            group["lr"] = share * group["peak_lr"]
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        self.step += 1
        for name, (rows, leaf) in leaves.items():
            if len(rows):
                scene.maps[name].update(rows, leaf.grad, share * config.lr * scene.rates[name], self.step)

    def means(self) -> dict[str, float]:
        """Mean losses since the last call."""
        *sums, count = self.window.tolist()
        self.window.zero_()
        return {name: value / max(count, 1) for name, value in zip(LOSSES, sums, strict=True)}

    def tensors(self) -> dict[str, Tensor]:
        """Everything that a step changes, by name."""
        found = {"step": torch.tensor(self.step), "window": self.window}
        for name, maps in self.scene.maps.items():
            found |= {f"{name}.{level}": table.packed for level, table in enumerate(maps.tables)}
        parameters = [p for group in self.optimizer.param_groups for p in group["params"]]
        for number, parameter in enumerate(parameters):
            found[f"parameter.{number}"] = parameter.detach()
            for key, value in self.optimizer.state[parameter].items():
                found[f"optimizer.{number}.{key}"] = value
        return found

    def save(self, folder: Path) -> None:
        tensors = {name: value.cpu().contiguous() for name, value in self.tensors().items()}
        with atomic_path(folder / STATE) as temporary:
            save_file(tensors, temporary, {"config": json.dumps(self.config.identity(), sort_keys=True)})

    def load(self, folder: Path) -> bool:
        """Whether there was something to go on from."""
        if not (folder / STATE).is_file():
            return False
        parameters = [p for group in self.optimizer.param_groups for p in group["params"]]
        with safe_open(folder / STATE, "pt") as saved:
            if (saved.metadata() or {}).get("config") != json.dumps(self.config.identity(), sort_keys=True):
                raise InputError(f"{folder / STATE} belongs to a run of another configuration: give it another folder")
            known = set(saved.keys())
            for number, parameter in enumerate(parameters):  # Adam makes the state of one that has had a gradient
                if f"optimizer.{number}.step" in known:
                    zeros = {name: torch.zeros_like(parameter) for name in ("exp_avg", "exp_avg_sq")}
                    self.optimizer.state[parameter] = {"step": torch.tensor(0.0)} | zeros
            for name, value in self.tensors().items():
                value.copy_(saved.get_tensor(name))
            self.step = int(saved.get_tensor("step"))
        return True


@dataclass(frozen=True)
class Outputs:
    """Where a run writes and speaks. state: folder of its checkpoint and log. show(step, truths, renderings): keeps a picture
    of the validation views, and returns it. tensorboard: folder of events.
    """

    state: Path
    say: Callable[[str], None] = print
    show: Callable[[int, list[np.ndarray], list[np.ndarray]], np.ndarray] | None = None
    tensorboard: Path | None = None


def fit(
    config: FitConfig,
    surroundings: Surroundings,
    views: Sequence[View],
    validation: Sequence[View],
    outputs: Outputs,
    device: str = "cpu",
) -> tuple[Baked, dict[str, Any]]:
    """The scene that ``views`` show, fitted, and a summary. Goes on from ``outputs.state`` if it holds a checkpoint."""
    outputs.state.mkdir(parents=True, exist_ok=True)
    centre = surroundings.sky_centre
    pixels = Pixels(views, centre, config.patch, torch.device(device))
    validation = [view for view in validation if view.counts.any()]  # of one that a mask hides nothing is to be said
    held_out = Pixels(validation, centre, 1, torch.device(device)) if validation else None
    scene = Scene(config, surroundings, pixels)
    trainer = Trainer(scene)
    touched = {name: maps.count for name, maps in scene.maps.items()}
    met = int((pixels.hit & pixels.counts).sum()) / max(int(pixels.counts.sum()), 1)
    outputs.say(
        f"{len(views)} views, {len(pixels.uv):,} pixels, {met:.0%} of them on the mesh, touch {touched['mesh']:,} texels, and "
        f"{touched['sky']:,} of the sky"
    )
    if met < FEW:
        outputs.say("so little of the photos shows the mesh that the rest stays a distant backdrop: look at the scaffold")
    if trainer.load(outputs.state):
        outputs.say(f"going on from step {trainer.step:,} of {config.steps:,}")
    log = TrainingLog(outputs.state, outputs.tensorboard, trainer.step, config.steps, outputs.say)
    metrics: dict[str, float] = {}
    began, first = time.perf_counter(), trainer.step
    for batch in pixels.patches(config.seed, config.patches, trainer.step, config.steps):
        trainer.train_step(batch)
        step, last = trainer.step, trainer.step == config.steps
        if step % config.log_every == 0 or last:
            means, pace = trainer.means(), (time.perf_counter() - began) / (step - first)
            log.row({"step": step, **means, "lr": config.lr * rate(step - 1, config)})
            outputs.say(
                f"step {step:>{log.width}}/{config.steps}  loss {means['loss']:.5f}  photometric {means['photometric']:.5f}  "
                f"vq {means['vq']:.5f}  {1000 * pace:6.1f} ms a step"
            )
        if held_out and (last or (config.validate_every and step % config.validate_every == 0)):
            metrics = validate(scene, held_out, validation, step, outputs, log)
        if step % config.checkpoint_every == 0 or last:
            trainer.save(outputs.state)
    if held_out and not metrics:  # killed between the last step and the product: everything was done and logged already
        metrics = validate(scene, held_out, validation, trainer.step, outputs)
    log.close()
    texels = {name: round(maps.count / len(maps.row_of), 4) for name, maps in scene.maps.items()}
    return scene.baked(config.identity()), {"steps": trainer.step, "touched_share": texels} | metrics


def validate(
    scene: Scene, pixels: Pixels, views: Sequence[View], step: int, outputs: Outputs, log: TrainingLog | None = None
) -> dict[str, float]:
    """Mean PSNR over the validation views, of the pixels that count; shown, and logged where there is a ``log``."""
    rendered = scene.render(pixels)
    errors = [np.square(image - view.rgb / 255.0)[view.counts].mean() for image, view in zip(rendered, views, strict=True)]
    psnr = float(np.mean([-10 * math.log10(max(error, 1e-10)) for error in errors]))
    outputs.say(f"step {step}/{scene.config.steps}  validation: psnr {psnr:5.2f} dB over {len(views)} views")
    picture = None if outputs.show is None else outputs.show(step, [view.rgb for view in views], rendered)
    if log is not None:
        log.row({"step": step, "validation_psnr": round(psnr, 4)})
        if picture is not None:
            log.picture("validation/truth above, ours below", picture, step)
    return {"psnr": psnr}
