"""How the threads of a training process wait for each other: said before torch loads, as its OpenMP reads it only then."""

from __future__ import annotations

import os

POLICIES = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")  # what a user may have set


SPINS = "100000"  # turns of GNU OpenMP's loop before a thread sleeps


def wait_briefly() -> None:
    """Let threads spin for a moment at a barrier and then sleep, unless the environment says how they wait.

    By default they spin for long. On a machine with other busy programs that takes the cores from the very threads that they
    wait for: beside two endless loops on two cores, training is 1.4 to 1.8 times as fast so. Sleeping at once
    (OMP_WAIT_POLICY=passive) costs 40 % of the speed on a quiet machine, and this nothing (``bench/waiting.py``). No
    effect once torch is loaded.
    """
    if not any(name in os.environ for name in POLICIES):
        os.environ["GOMP_SPINCOUNT"] = SPINS
