"""How the threads of a training process wait for each other: said before torch loads, as its OpenMP reads it only then."""

from __future__ import annotations

import os

POLICIES = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")  # what a user may have set


def wait_without_spinning() -> None:
    """Let threads sleep at barriers, unless the environment says how they wait.

    By default they spin. On a machine with other busy programs that takes the cores from the very threads that they wait for.
    ``bench/waiting.py`` measures both. No effect once torch is loaded.
    """
    if not any(name in os.environ for name in POLICIES):
        os.environ["OMP_WAIT_POLICY"] = "passive"
