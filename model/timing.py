"""The clock for work on a device: wall time, with the wait for a GPU to have finished.

A GPU takes orders and returns at once, so the clock is read only after it has caught up. Other programs only ever add to a
time, so the fastest of several calls is the one that counts.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch

Clock = Callable[[], float]  # seconds since some moment; another than ``perf_counter`` for time of the processor


def wait(device: str) -> None:
    """Return when the device has finished what it was given. On a CPU that is at once."""
    if device.startswith("cuda"):
        torch.cuda.synchronize(device)


def timed(work: Callable[[], Any], device: str, clock: Clock = time.perf_counter) -> tuple[float, Any]:
    """(seconds, result) of one call."""
    wait(device)
    start = clock()
    result = work()
    wait(device)
    return clock() - start, result


def fastest(work: Callable[[], Any], device: str, repeats: int, warm_up: int = 1) -> float:
    """Seconds of the fastest of ``repeats`` calls, after ``warm_up`` calls that do not count."""
    for _ in range(warm_up):
        work()
    return min(timed(work, device)[0] for _ in range(repeats))
