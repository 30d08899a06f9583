"""The loop: it learns, it resumes exactly, it survives bad steps, and it logs each step once."""

from __future__ import annotations

import json
import math
import time

import numpy as np
import pytest
import torch

from model.renderformer import checkpoint
from model.renderformer.config import ModelConfig
from model.renderformer.flops import forward_flops
from model.renderformer.network import RenderFormer
from model.renderformer.recipe import FitConfig
from model.renderformer.training import BEST, LAST, Work, fit, predict
from model.training.gradients import SideBySide
from model.training.logs import LOG
from model.training.optimization import schedule
from model.training.parallel import Group
from tests.model.synthetic import batch
from tests.model.test_config import MICRO

STEPS = 14
ALONE = Group(torch.device("cpu"))
MEASURED = ("seconds", "scenes_per_s", "tokens_per_s", "memory_gb", "mfu")  # of a log row; the rest must repeat exactly


def settings(**fields) -> FitConfig:
    plain = dict(steps=STEPS, lr=1e-3, warmup=3, optimizer="adamw", gradient_leak=0.0)
    return FitConfig(**(plain | dict(log_every=4, validate_every=7, checkpoint_every=5) | fields))


def stream(start: int, stop: int):
    return map(batch, range(start, stop))


def model_of(seed: int = 0) -> RenderFormer:
    torch.manual_seed(seed)
    return RenderFormer(ModelConfig(**MICRO))


def train(folder, batches=stream, validation=(), lines=None, **fields):
    model = model_of()
    log = (lambda text: None) if lines is None else lines.append
    summary = fit(model, settings(**fields), batches, list(validation), folder, ALONE, log)
    return model, summary, [json.loads(line) for line in (folder / LOG).read_text().splitlines()]


def without_time(rows):
    return [{name: value for name, value in row.items() if name not in MEASURED} for row in rows]


class Killed(BaseException):
    pass


@pytest.mark.parametrize(("optimizer", "ema"), [("adamw", 0.0), ("muon", 0.9)])
@pytest.mark.parametrize("killed_at", [3, 9, 12])  # before the first state; between states, a log line after the last one
def test_killed_and_resumed_equals_undisturbed(tmp_path, optimizer, ema, killed_at):
    validation = [batch(1000)]
    fields = {"validation": validation, "optimizer": optimizer, "ema": ema}
    whole, _, expected = train(tmp_path / "whole", **fields)

    def dying(start, stop):
        for step in range(start, stop):
            if step == killed_at:
                raise Killed
            yield batch(step)

    with pytest.raises(Killed):
        train(tmp_path / "killed", dying, **fields)
    with (tmp_path / "killed" / LOG).open("a") as file:
        file.write('{"step": 13, "lo')  # a line that the kill cut short
    torch.manual_seed(99)  # the state, not luck, brings the random numbers back
    resumed, _, rows = train(tmp_path / "killed", **fields)
    assert without_time(rows) == without_time(expected)
    assert all(torch.equal(a, b) for a, b in zip(whole.parameters(), resumed.parameters(), strict=True))
    for name in (LAST, BEST):
        weights = [(tmp_path / run / name / "model.safetensors").read_bytes() for run in ("whole", "killed")]
        assert weights[0] == weights[1]


def test_learns_one_batch(tmp_path):
    _, _, rows = train(tmp_path, lambda start, stop: (batch(0) for _ in range(start, stop)), steps=60, log_every=10, lr=3e-3)
    losses = [row["loss"] for row in rows if "loss" in row]
    assert losses[-1] < 0.5 * losses[0]


def test_log_and_summary(tmp_path):
    lines: list[str] = []
    _, summary, rows = train(tmp_path, validation=[batch(1000)], lines=lines)
    assert [row["step"] for row in rows if "loss" in row] == [4, 8, 12, 14]
    assert [row["step"] for row in rows if "validation_psnr" in row] == [7, 14]
    assert summary["steps"] == STEPS and summary["skipped"] == 0 and summary["psnr"] == rows[-1]["validation_psnr"]
    assert "tokens/s" in lines[0] and "scenes/s" in lines[0]
    # Done already: nothing more is trained or logged, the metrics are still there.
    _, again, same = train(tmp_path, lambda start, stop: iter(()), validation=[batch(1000)])
    assert same == rows and again["psnr"] == summary["psnr"]


def test_another_configuration_does_not_resume(tmp_path):
    train(tmp_path)
    with pytest.raises(ValueError, match="another configuration"):
        train(tmp_path, lr=5e-4)
    train(tmp_path, log_every=1)  # what does not change the result may change


def spoiled(bad):
    def batches(start, stop):
        for step in range(start, stop):
            data = batch(step)
            if step in bad:
                data["image"] = data["image"] * np.float32(math.nan)
            yield data

    return batches


def test_non_finite_steps_are_skipped_and_counted(tmp_path):
    model, summary, rows = train(tmp_path, spoiled({4, 5, 9}))
    assert summary["skipped"] == 3 and rows[-1]["skipped"] == 3
    assert all(parameter.isfinite().all() for parameter in model.parameters())
    assert all(row["loss"] is not None and math.isfinite(row["loss"]) for row in rows)


def test_a_run_of_non_finite_steps_stops(tmp_path):
    with pytest.raises(ValueError, match="not finite for 20 steps.*scene19_0"):
        train(tmp_path, spoiled(range(1000)), steps=40)


def test_parts_of_a_batch_add_up_to_its_gradient(tmp_path):
    """micro_scenes only saves memory: same losses and weights, to rounding; textures follow their scenes."""

    def stream(start, stop):
        return (batch(step, scenes=3, padded=2, textured=True) for step in range(start, stop))

    whole, _, rows = train(tmp_path / "whole", stream, log_every=1, clip=1e9)
    split, _, same = train(tmp_path / "split", stream, log_every=1, clip=1e9, micro_scenes=2)
    for a, b in zip(rows, same, strict=True):
        assert b["loss"] == pytest.approx(a["loss"], rel=1e-4) and b["grad_norm"] == pytest.approx(a["grad_norm"], rel=1e-3)


@pytest.fixture
def threads():
    """Sets torch's number of threads for a test."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def test_scenes_on_threads_add_up_to_the_gradient_of_the_batch(tmp_path, threads):
    """Side by side: the same losses to rounding; the same bytes for any number of threads, also of uneven shares."""

    def stream(start, stop):
        return (batch(step, scenes=3, padded=2, textured=True) for step in range(start, stop))

    def run(count):
        threads(count)
        return train(tmp_path / str(count), stream, log_every=1, clip=1e9)

    (_, _, whole), (two, _, rows), (five, _, same) = run(1), run(2), run(5)
    for a, b in zip(whole, rows, strict=True):
        assert b["loss"] == pytest.approx(a["loss"], rel=1e-4) and b["grad_norm"] == pytest.approx(a["grad_norm"], rel=1e-3)
    assert [row["loss"] for row in rows] == [row["loss"] for row in same]
    assert all(torch.equal(a, b) for a, b in zip(two.parameters(), five.parameters(), strict=True))


def test_a_fault_on_a_thread_is_the_fault_of_the_step(threads):
    threads(2)
    side_by_side = SideBySide([torch.ones(1, requires_grad=True)], 2, 2)
    with pytest.raises(ZeroDivisionError):
        side_by_side.backward([lambda: 1 / 0, lambda: 1 / 0])


def test_a_part_that_uses_no_parameter_adds_nothing():
    used, unused = torch.ones(2, requires_grad=True), torch.ones(2, requires_grad=True)
    total = SideBySide([used, unused], 3, 2).backward([lambda weight=weight: (weight * used).sum() for weight in (1, 2, 4)])
    assert total.item() == 14 and used.grad.tolist() == [7, 7] and unused.grad is None


def test_averaged_weights_are_what_is_validated_and_saved(tmp_path):
    model, summary, _ = train(tmp_path / "ema", validation=[batch(1000)], ema=0.9)
    saved, _ = checkpoint.load(tmp_path / "ema" / LAST)
    assert not torch.equal(saved.tri_token, model.tri_token)  # the trained model itself is left as it was
    plain, _, _ = train(tmp_path / "plain", validation=[batch(1000)])
    assert torch.equal(plain.tri_token, model.tri_token)
    average = model_of().tri_token.detach().clone()

    def replay(start, stop):  # the average by its definition, from the weights after each step
        for step in range(start, stop):
            yield batch(step)
            average.mul_(0.9).add_(watched.tri_token.detach(), alpha=0.1)

    watched = model_of()
    fit(watched, settings(), replay, [], tmp_path / "replay", ALONE, lambda text: None)
    torch.testing.assert_close(saved.tri_token.detach(), average)


def test_best_and_last_are_kept(tmp_path):
    """The best by validation is what it was at that step, though training goes on and gets worse."""
    _, summary, rows = train(tmp_path, validation=[batch(1000)], validate_every=2, lr=0.03)
    errors = [row["validation_log_error"] for row in rows if "validation_log_error" in row]
    assert summary["best_log_error"] == min(errors) < errors[-1] == summary["log_error"]
    last, best = (checkpoint.load(tmp_path / name)[0] for name in (LAST, BEST))
    from model.renderformer.training import evaluate

    assert evaluate(best, [batch(1000)], ALONE)[0]["log_error"] == pytest.approx(min(errors), rel=1e-6)
    assert evaluate(last, [batch(1000)], ALONE)[0]["log_error"] == pytest.approx(errors[-1], rel=1e-6)


def test_tensorboard_has_the_log_and_the_pictures(tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    seen = []

    def show(step, pairs):
        seen.append((step, len(pairs)))
        return (np.clip(np.concatenate([np.hstack(pair) for pair in pairs]), 0, 1) * 255).astype(np.uint8)

    validation = [batch(1000 + i) for i in range(3)]
    fit(model_of(), settings(pictures=2), stream, validation, tmp_path, ALONE, lambda text: None, show, tmp_path / "events")
    events = EventAccumulator(str(tmp_path / "events"))
    events.Reload()
    rows = [json.loads(line) for line in (tmp_path / LOG).read_text().splitlines()]
    assert [e.value for e in events.Scalars("train/loss")] == pytest.approx([r["loss"] for r in rows if "loss" in r])
    assert [e.step for e in events.Scalars("validation/psnr")] == [7, 14]
    assert seen == [(7, 2), (14, 2)] and len(events.Images(events.Tags()["images"][0])) == 2


def test_counted_operations_are_those_that_run():
    from torch.nn.attention import SDPBackend, sdpa_kernel
    from torch.utils.flop_counter import FlopCounterMode

    for fields in ({}, {"use_dpt_decoder": False}, {"pe_type": "nerf"}, {"view_transformer_include_self_attn": False}):
        model = RenderFormer(ModelConfig(**(MICRO | dict(latent_dim=256, num_heads=2, view_transformer_latent_dim=256,
                                                         view_transformer_n_heads=2) | fields)))  # fmt: skip
        data = batch(0, triangles=200, padded=50, views=3, resolution=64)
        # torch's counter knows attention as matrix products only
        with FlopCounterMode(display=False) as counter, torch.no_grad(), sdpa_kernel(SDPBackend.MATH):
            predict(model, model, data, "cpu", "fp32")
        counted = sum(forward_flops(model.config, [150, 200], 3, 64, 64).values())
        assert counted == counter.get_total_flops()


def test_schedule():
    def schedule_of(config, step):
        return schedule(step, config.steps, config.warmup, config.decay_steps, config.final_lr)

    config = settings(steps=100, warmup=10)
    rates = [schedule_of(config, step) for step in range(100)]
    assert rates[0] == pytest.approx(0.1) and max(rates) == rates[9] == rates[10] == 1.0
    assert all(a >= b for a, b in zip(rates[10:], rates[11:], strict=False)) and rates[-1] < 0.01
    long = settings(steps=130, warmup=10, decay_steps=100, final_lr=0.1)
    assert schedule_of(long, 100) == schedule_of(long, 129) == pytest.approx(0.1)


def test_gradient_leak_revives_negative_pixels_and_changes_no_value():
    model, data = model_of().train(), batch(0)
    with torch.no_grad():
        model.view_transformer.out_dpt.scratch.output_conv2[2].bias.fill_(-0.5)  # all pixels come out negative
    outputs = []
    for leak in (0.0, 0.1):
        model.view_transformer.gradient_leak = leak
        model.zero_grad()
        y = predict(model, model, data, "cpu", "fp32")
        y.mean().backward()
        outputs.append((y.detach(), model.tri_token.grad.abs().sum()))
    assert (outputs[0][0] < 0).all() and torch.equal(outputs[0][0], outputs[1][0])
    assert outputs[1][1] > 50 * outputs[0][1]


def test_utilisation_is_never_above_what_there_is():
    """The peak was measured while others computed: what the run itself reached is then the most that is known."""
    work = Work(RenderFormer(ModelConfig(**MICRO)), Group(torch.device("cpu")), "fp32")
    utilisations = []
    for ideal_s in (0.5, 1.65, 0.8):  # seconds at the measured peak, of work that took one second
        work.began, work.ideal = time.perf_counter() - 1.0, ideal_s
        utilisations.append(work.rates()["mfu"])
    assert utilisations == pytest.approx([0.5, 1.0, 0.8 / 1.65], rel=0.01)
