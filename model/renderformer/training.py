"""The training loop (section 3.3): resumable, and after a kill exactly the run that it would have been.

Reads batches that are a pure function of the step; writes into the folder it is given ``training.pt`` (what is needed to go
on), ``log.jsonl``, and in the released format ``last/`` (at the end) and ``best/`` (lowest validation error so far). The one
design choice: everything that changes from step to step is in ``training.pt``, replaced atomically, and the log is cut back to
that step on resume, so nothing is logged twice. Many processes (``model.training.parallel``) follow the run of one.
"""

from __future__ import annotations

import functools
import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from model.errors import InputError
from model.lpips import LPIPS
from model.renderformer import checkpoint
from model.renderformer.base import Network
from model.renderformer.flops import TRAINING, ideal_seconds, peak_flops
from model.renderformer.losses import image_loss, log_radiance
from model.renderformer.network import to_radiance
from model.renderformer.recipe import FitConfig
from model.training.gradients import SideBySide, threads_kept
from model.training.logs import TrainingLog
from model.training.optimization import Average, build_optimizers, schedule, set_learning_rate
from model.training.parallel import Group, accumulating, distribute, gather, scatter
from pipeline.atomic import atomic_path

STATE, LAST, BEST = "training.pt", "last", "best"
PATIENCE = 20  # this many non-finite steps in a row stop the run

Batch = Mapping[str, Any]
Pair = tuple[np.ndarray, np.ndarray]  # a reference and a prediction, each (H, W, 3) radiance


def predict(forward: Callable[..., Tensor], model: Network, batch: Batch, device: Any, precision: str) -> Tensor:
    """log10(1 + radiance) of the batch's images, in their shape."""
    return forward(*model.arguments(batch, device), precision=precision)


def evaluate(
    model: Network, batches: Sequence[Batch], group: Group, precision: str = "fp32", pictures: int = 0
) -> tuple[dict[str, float], list[Pair]]:
    """Means over all views: ``log_error`` (L1 of log10(1 + x)) and ``psnr`` of linear radiance clamped to [0, 1], in dB.

    Each process measures its share of the batches. Also the first views of the first ``pictures`` batches (of its share).
    """
    sums = torch.zeros(3, dtype=torch.float64)
    pairs: list[Pair] = []
    model.eval()
    with torch.no_grad():
        for number, batch in _share(batches, group):
            y = predict(model, model, batch, group.device, precision).float()
            image = torch.from_numpy(np.ascontiguousarray(batch["image"])).to(group.device)
            errors = (y - log_radiance(image)).abs().mean(dim=(2, 3, 4)).flatten()
            mse = (to_radiance(y).clamp(0, 1) - image.clamp(0, 1)).square().mean(dim=(2, 3, 4)).flatten()
            psnrs = -10 * torch.log10(mse.clamp(min=1e-10))
            if number is not None:
                sums += torch.stack([errors.sum(), psnrs.sum(), torch.tensor(float(len(errors)))]).double().cpu()
                if number < pictures:
                    pairs.append((batch["image"][0, 0], to_radiance(y[0, 0]).cpu().numpy()))
    model.train()
    error, psnr, count = group.mean(sums.to(group.device)).tolist()
    return {"log_error": error / count, "psnr": psnr / count}, pairs


def _share(batches: Sequence[Batch], group: Group) -> Iterator[tuple[int | None, Batch]]:
    """(number, batch) of this process; all take part equally often (FSDP), with number None where one stands in."""
    for first in range(0, len(batches), group.world):
        number = first + group.rank
        yield (number, batches[number]) if number < len(batches) else (None, batches[first])


def parts(batch: Batch, most: int | None) -> Iterator[tuple[Batch, float, bool]]:
    """The batch in parts of at most ``most`` scenes, each with its share of the scenes and whether it is the last."""
    scenes = len(batch["mask"])
    most = most or scenes
    for first in range(0, scenes, most):
        last = min(first + most, scenes)
        # Textures are shared by the batch's scenes, which refer to them by row.
        part = {name: value if name == "patches" else value[first:last] for name, value in batch.items()}
        yield part, (last - first) / scenes, last == scenes


class Work:
    """Scenes, tokens and floating-point operations since the last log line, for rates and utilisation."""

    def __init__(self, model: Network, group: Group, precision: str):
        self.model, self.group, self.precision = model, group, precision
        self.peaks = {"float32": peak_flops(str(group.device), "float32")}
        if precision != "fp32":
            self.peaks["bfloat16"] = peak_flops(str(group.device), "bfloat16")
        self.fastest = 1.0  # largest share of the measured peaks so far: over 1 where others computed while they were measured
        self.start()

    def start(self) -> None:
        self.began, self.scenes, self.tokens, self.ideal = time.perf_counter(), 0, 0, 0.0

    def add(self, batch: Batch) -> None:
        """One training step; padding is not counted."""
        self.scenes += len(batch["mask"])
        self.tokens += self.model.tokens(batch)
        self.ideal += TRAINING * ideal_seconds(self.model.flops(batch), self.peaks, self.precision)

    def rates(self) -> dict[str, float]:
        """Over all processes, which do equal work; ``mfu``: time at the rate of a large matrix product, over elapsed time.

        A run that was faster than the measured rate has shown a higher one: it counts from then on.
        """
        elapsed = time.perf_counter() - self.began
        self.fastest = max(self.fastest, self.ideal / elapsed)
        return {
            "scenes_per_s": round(self.group.world * self.scenes / elapsed, 3),
            "tokens_per_s": round(self.group.world * self.tokens / elapsed, 1),
            "memory_gb": round(_memory_gb(self.group.device), 3),
            "mfu": round(self.ideal / elapsed / self.fastest, 4),
        }


def _memory_gb(device: torch.device) -> float:
    """Peak memory so far: of the GPU, or of this process."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**30
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


class _State:
    """All that changes from step to step, as one file: whole tensors, however many processes there are."""

    PLAIN = ("step", "skipped", "skipped_in_a_row", "seconds", "window", "best")

    def __init__(self, model: Network, config: FitConfig, folder: Path, group: Group):
        self.model, self.config, self.path, self.group = model, config, folder / STATE, group
        self.optimizers = build_optimizers(model, config.optimizer, config.lr, config.muon_lr, config.weight_decay)
        self.average = Average(model, config.ema) if config.ema else None
        self.step = 0  # steps done: also the position in the data
        self.skipped = 0
        self.skipped_in_a_row = 0
        self.seconds = 0.0
        self.window: list[list[float]] = []  # loss, gradient norm of the steps since the last log line
        self.best: float | None = None  # lowest validation log error so far

    def save(self) -> None:
        saved = {
            "identity": self._identity(),
            "plain": {name: getattr(self, name) for name in self.PLAIN},
            "model": gather(self.model.state_dict()),
            "optimizers": [gather(optimizer.state_dict()) for optimizer in self.optimizers],
            "average": gather(self.average.values) if self.average else None,
            "rng": {"cpu": torch.get_rng_state()},
        }
        if torch.cuda.is_available():
            saved["rng"]["cuda"] = torch.cuda.get_rng_state()
        if self.group.leads:
            with atomic_path(self.path) as temporary:
                torch.save(saved, temporary)

    def load(self) -> bool:
        """Whether there was something to go on from."""
        if not self.path.is_file():
            return False
        saved = torch.load(self.path, map_location="cpu", weights_only=True)
        if saved["identity"] != self._identity():
            raise InputError(f"{self.path} belongs to a training run of another configuration: give it another folder")
        current = self.model.state_dict()
        self.model.load_state_dict({name: scatter(value, current[name]) for name, value in saved["model"].items()})
        for optimizer, state in zip(self.optimizers, saved["optimizers"], strict=True):
            parameters = [p for group in optimizer.param_groups for p in group["params"]]
            for index, values in state["state"].items():
                for name, value in values.items():
                    if isinstance(value, Tensor):
                        values[name] = scatter(value, parameters[index])
            optimizer.load_state_dict(state)
        if self.average is not None:
            for name, value in saved["average"].items():
                self.average.values[name].copy_(scatter(value, self.average.values[name]))
        torch.set_rng_state(saved["rng"]["cpu"])
        if "cuda" in saved["rng"] and torch.cuda.is_available():
            torch.cuda.set_rng_state(saved["rng"]["cuda"])
        for name, value in saved["plain"].items():
            setattr(self, name, value)
        return True

    def averaged(self) -> Any:
        """A context in which the model has the weights that count: the averaged ones, if there are any."""
        return self.average.in_place() if self.average else nullcontext()

    def release(self, folder: Path, trained_with: Mapping[str, str] | None) -> None:
        """Save the weights that count as a released-format checkpoint."""
        with self.averaged():
            weights = gather(self.model.state_dict())
            if self.group.leads:
                checkpoint.save(self.model.config, weights, folder, trained_with)

    def _identity(self) -> str:
        return json.dumps([self.model.config.to_dict(), self.config.identity()], sort_keys=True)


class Backward:
    """Adds a batch's gradient to the parameters and returns its loss. loss_of: of a part of the batch, times its weight.

    On several threads of a CPU scene by scene (``model.training.gradients``), unless a setting says how to go about it.
    """

    def __init__(
        self,
        loss_of: Callable[[Batch, float], Tensor],
        forward: nn.Module,
        parameters: Sequence[Tensor],
        config: FitConfig,
        group: Group,
    ):
        self.loss_of, self.forward, self.parameters, self.config, self.group = loss_of, forward, parameters, config, group
        self.threads = 1
        if group.device.type == "cpu" and group.world == 1 and not (config.micro_scenes or config.compile):
            self.threads = torch.get_num_threads()
        self.side_by_side: SideBySide | None = None

    def __call__(self, batch: Batch) -> Tensor:
        scenes = len(batch["mask"])
        if self.threads == 1 or scenes == 1:
            return self._in_turn(batch)
        if self.side_by_side is None:
            self.side_by_side = SideBySide(self.parameters, scenes, self.threads)
        return self.side_by_side.backward(
            [functools.partial(self.loss_of, part, weight) for part, weight, _ in parts(batch, 1)]
        )

    def _in_turn(self, batch: Batch) -> Tensor:
        total = torch.zeros((), device=self.group.device)
        for part, weight, last in parts(batch, self.config.micro_scenes):
            with accumulating(self.forward, last):
                loss = self.loss_of(part, weight)
                loss.backward()
                total += loss.detach()
        return total


@threads_kept()
def fit(
    model: Network,
    config: FitConfig,
    batches: Callable[[int, int], Iterable[Batch]],
    validation: Sequence[Batch],
    folder: Path,
    group: Group,
    say: Callable[[str], None] = print,
    show: Callable[[int, list[Pair]], np.ndarray] | None = None,
    tensorboard: Path | None = None,
    trained_with: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """Train ``model`` in place up to ``config.steps``, going on from ``folder`` if it holds a state.

    ``batches(start, stop)`` yields the batches of those steps, each a pure function of its step and this process's slice of the
    global batch: dicts of numpy arrays that ``model.arguments`` reads, with image (B, V, H, W, 3) radiance. ``validation`` is
    a fixed list of such; ``show`` makes a picture of some views. ``trained_with`` goes into the checkpoints. Returns steps,
    skipped, seconds, and the last and best validation's metrics.
    """
    precision = config.precision_on(group.device.type)
    folder.mkdir(parents=True, exist_ok=True)
    model.to(group.device).train()
    model.leak_gradient(config.gradient_leak)
    model.activation_checkpointing(config.activation_checkpointing)
    if precision != "fp32" and group.device.type == "cuda":
        torch.set_float32_matmul_precision("high")
    if config.compile:
        model.compile_layers()
    lpips = (
        LPIPS.load(Path(config.lpips_folder).expanduser() if config.lpips_folder else None).to(group.device)
        if config.lpips > 0
        else None
    )
    forward = distribute(model, group, config.parallel == "fsdp")
    state = _State(model, config, folder, group)
    if state.load() and group.leads:
        say(f"going on from step {state.step:,} of {config.steps:,}")
    parameters = [p for optimizer in state.optimizers for entry in optimizer.param_groups for p in entry["params"]]
    work = Work(model, group, precision)
    # Only the first process writes. All have read the state by now, and none goes on before the log is cut.
    log = TrainingLog(*((folder, tensorboard) if group.leads else (None, None)), state.step, config.steps,
                      say if group.leads else lambda text: None)  # fmt: skip
    group.wait()
    metrics: dict[str, float] = {}

    def validate() -> dict[str, float]:
        with state.averaged():
            scores, pairs = evaluate(model, validation, group, precision, config.pictures if show else 0)
        if state.best is None or scores["log_error"] < state.best:
            state.best = scores["log_error"]
            state.release(folder / BEST, trained_with)
        if pairs and group.leads:
            log.picture("validation/reference above, prediction below", show(state.step, pairs), state.step)
        return scores

    def loss_of(part: Batch, weight: float) -> Tensor:
        y = predict(forward, model, part, group.device, precision)
        image = torch.from_numpy(np.ascontiguousarray(part["image"])).to(group.device, non_blocking=True)
        return weight * image_loss(y, image, lpips, config.lpips)

    backward = Backward(loss_of, forward, parameters, config, group)
    base_seconds, began = state.seconds, time.perf_counter()
    work.start()
    for step, batch in enumerate(batches(state.step, config.steps), start=state.step):
        share = schedule(step, config.steps, config.warmup, config.decay_steps, config.final_lr)
        set_learning_rate(state.optimizers, share)
        loss = backward(batch)
        norm = gather(nn.utils.clip_grad_norm_(parameters, config.clip))
        loss_value, norm_value = torch.stack([group.mean(loss), norm]).tolist()
        if math.isfinite(loss_value) and math.isfinite(norm_value):
            for optimizer in state.optimizers:
                optimizer.step()
            if state.average is not None:
                state.average.update()
            state.window.append([loss_value, norm_value])
            state.skipped_in_a_row = 0
        else:
            state.skipped += 1
            state.skipped_in_a_row += 1
            if state.skipped_in_a_row >= PATIENCE:
                scenes = ", ".join(str(i) for i in batch.get("ids", ())) or "not named"
                raise InputError(
                    f"training stopped at step {step}: loss {loss_value}, gradient norm {norm_value}, not finite for "
                    f"{PATIENCE} steps in a row; look at the scenes of this batch ({scenes}), or try a smaller lr"
                )
        for optimizer in state.optimizers:
            optimizer.zero_grad(set_to_none=True)
        state.step = step + 1
        state.seconds = base_seconds + time.perf_counter() - began
        work.add(batch)
        last = state.step == config.steps

        if state.step % config.log_every == 0 or last:
            mean_loss, mean_norm = np.mean(state.window, axis=0).tolist() if state.window else (None, None)
            log.interval(
                {"step": state.step, "loss": mean_loss, "lr": share * config.lr, "grad_norm": mean_norm}
                | {"skipped": state.skipped, "seconds": round(state.seconds, 3)}
                | work.rates()
            )
            state.window = []
            work.start()
        if validation and (state.step % config.validate_every == 0 or last):
            before, metrics = state.best, validate()
            log.validation(state.step, metrics, state.best != before)
            work.start()
        if state.step % config.checkpoint_every == 0 or last:
            state.save()
    if validation and not metrics:  # killed between the last step and the product: everything was done already
        metrics = validate()
    state.release(folder / LAST, trained_with)
    log.close()
    group.wait()
    model.eval()
    summary = {"steps": state.step, "skipped": state.skipped, "seconds": round(state.seconds, 1)} | metrics
    return summary | ({"best_log_error": state.best} if state.best is not None else {})
