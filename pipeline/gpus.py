"""The NVIDIA GPUs of this machine, and those of them that this process may use."""

from __future__ import annotations

import os
import subprocess
from functools import cache

VISIBLE = "CUDA_VISIBLE_DEVICES"  # the variable by which CUDA hides GPUs from a process
NONE = "-1"  # in that variable: this entry and all that follow name no GPU
QUERY_S = 20.0  # seconds that the driver gets for its answer


def visible_gpus() -> list[str]:
    """Names of the GPUs that this process may use, as CUDA_VISIBLE_DEVICES takes them; empty without an NVIDIA driver.

    The names are those of the variable. Where it is not set they are UUIDs, because CUDA need not number GPUs as
    nvidia-smi does.
    """
    named = os.environ.get(VISIBLE)
    if named is None:
        return _query("uuid")
    gpus = []
    for name in map(str.strip, named.split(",")):
        if name in ("", NONE):  # CUDA reads no further either
            break
        gpus.append(name)
    return gpus


@cache
def gpu_models() -> str | None:
    """A line ``model, driver version`` for each GPU of the machine; None without an NVIDIA driver."""
    return "\n".join(_query("name,driver_version")) or None


def _query(fields: str) -> list[str]:
    """What nvidia-smi says of each GPU; empty where it is missing, fails or hangs."""
    command = ["nvidia-smi", f"--query-gpu={fields}", "--format=csv,noheader"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=QUERY_S)
    except (OSError, subprocess.TimeoutExpired):
        return []
    return answer.stdout.strip().splitlines() if answer.returncode == 0 else []
