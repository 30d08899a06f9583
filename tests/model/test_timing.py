"""The clock counts no warm-up, takes the fastest call, and waits for a GPU."""

from __future__ import annotations

import torch

from model import timing


def test_the_fastest_call_after_the_warm_up_counts(monkeypatch):
    moments = iter([0.0, 3.0, 10.0, 12.0, 20.0, 25.0])
    calls = []
    monkeypatch.setattr(timing, "timed", lambda work, device: (-next(moments) + next(moments), work()))
    assert timing.fastest(lambda: calls.append(1), "cpu", repeats=3) == 2.0
    assert len(calls) == 4  # one of them warms up


def test_the_clock_is_read_when_the_gpu_has_finished(monkeypatch):
    order = []
    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: order.append(f"wait for {device}"))

    def clock() -> float:
        order.append("clock")
        return float(len(order))

    seconds, result = timing.timed(lambda: order.append("work") or "image", "cuda:1", clock)
    assert result == "image" and seconds == 5.0 - 2.0
    assert order == ["wait for cuda:1", "clock", "work", "wait for cuda:1", "clock"]
    order.clear()
    timing.timed(lambda: order.append("work"), "cpu", clock)
    assert order == ["clock", "work", "clock"]
