"""The loop: it learns, it resumes exactly, it survives bad steps, and it logs each step once."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch

from model.config import ModelConfig
from model.renderformer import RenderFormer
from model.training import LOG, FitConfig, fit, predict, schedule
from tests.model.synthetic import batch
from tests.model.test_config import MICRO

STEPS = 14


def settings(**fields) -> FitConfig:
    return FitConfig(**(dict(steps=STEPS, lr=1e-3, warmup=3, log_every=4, validate_every=7, checkpoint_every=5) | fields))


def stream(start: int, stop: int):
    return map(batch, range(start, stop))


def model_of(seed: int = 0) -> RenderFormer:
    torch.manual_seed(seed)
    return RenderFormer(ModelConfig(**MICRO))


def train(folder, batches=stream, validation=(), lines=None, **fields):
    model = model_of()
    log = (lambda text: None) if lines is None else lines.append
    summary = fit(model, settings(**fields), batches, list(validation), folder, "cpu", log)
    return model, summary, [json.loads(line) for line in (folder / LOG).read_text().splitlines()]


def without_time(rows):
    return [{name: value for name, value in row.items() if name != "seconds"} for row in rows]


class Killed(BaseException):
    pass


@pytest.mark.parametrize("optimizer", ["adamw", "muon"])
@pytest.mark.parametrize("killed_at", [3, 9, 12])  # before the first state; between states, a log line after the last one
def test_killed_and_resumed_equals_undisturbed(tmp_path, optimizer, killed_at):
    validation = [batch(1000)]
    whole, _, expected = train(tmp_path / "whole", validation=validation, optimizer=optimizer)

    def dying(start, stop):
        for step in range(start, stop):
            if step == killed_at:
                raise Killed
            yield batch(step)

    with pytest.raises(Killed):
        train(tmp_path / "killed", dying, validation, optimizer=optimizer)
    with (tmp_path / "killed" / LOG).open("a") as file:
        file.write('{"step": 13, "lo')  # a line that the kill cut short
    torch.manual_seed(99)  # the state, not luck, brings the random numbers back
    resumed, _, rows = train(tmp_path / "killed", validation=validation, optimizer=optimizer)
    assert without_time(rows) == without_time(expected)
    assert all(torch.equal(a, b) for a, b in zip(whole.parameters(), resumed.parameters(), strict=True))


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


def test_schedule():
    config = settings(steps=100, warmup=10)
    rates = [schedule(config, step) for step in range(100)]
    assert rates[0] == pytest.approx(0.1) and max(rates) == rates[9] == rates[10] == 1.0
    assert all(a >= b for a, b in zip(rates[10:], rates[11:], strict=False)) and rates[-1] < 0.01
    long = settings(steps=130, warmup=10, decay_steps=100, final_lr=0.1)
    assert schedule(long, 100) == schedule(long, 129) == pytest.approx(0.1)


def test_gradient_leak_revives_negative_pixels_and_changes_no_value():
    model, data = model_of().train(), batch(0)
    with torch.no_grad():
        model.view_transformer.out_dpt.scratch.output_conv2[2].bias.fill_(-0.5)  # all pixels come out negative
    found = []
    for leak in (0.0, 0.1):
        model.view_transformer.gradient_leak = leak
        model.zero_grad()
        y = predict(model, model, data, "cpu", False)
        y.mean().backward()
        found.append((y.detach(), model.tri_token.grad.abs().sum()))
    assert (found[0][0] < 0).all() and torch.equal(found[0][0], found[1][0])
    assert found[1][1] > 50 * found[0][1]
