"""``python -m pipeline [system=NAME] stage=... [overrides] [-m]``: compose the config, then run it.

``-m`` may stand anywhere and makes a sweep of overrides with commas (``pipeline.sweep``).
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence

from pipeline.errors import INTERRUPTED
from pipeline.hydra_config import compose
from pipeline.interrupts import guarded
from pipeline.run import run_pipeline
from pipeline.sweep import describe, expand, is_hydras, launcher_of, run_by_launcher, run_in_turn, run_side_by_side

MULTIRUN_FLAGS = {"-m", "--multirun"}
HELP_FLAGS = {"-h", "--help"}


def say(text: str) -> None:
    print(text, flush=True)


def main(words: Sequence[str] | None = None) -> int:
    """Returns the exit status: 0 done, 130 interrupted, or that of the first error (see pipeline.errors)."""
    words = list(sys.argv[1:] if words is None else words)
    if HELP_FLAGS & set(words):
        say((__doc__ or "").strip())
        return 0
    debug = "--debug" in words or "debug=true" in words
    words = [word for word in words if word != "--debug"]
    sweeps = any(word in MULTIRUN_FLAGS for word in words)
    overrides = [word for word in words if word not in MULTIRUN_FLAGS]
    command = ["python", "-m", "pipeline", *words]
    failures: list[int] = []

    def run_all() -> None:
        if not sweeps:
            run_pipeline(compose([word for word in overrides if not is_hydras(word)]), command, say)
            return
        jobs = expand(overrides)
        say(describe(jobs))
        run = jobs[0].run_plan.run
        if launcher_of(overrides) is not None and not run.plan:
            statuses = run_by_launcher(jobs, overrides, command, say)
        elif run.jobs is not None and not run.plan:
            statuses = run_side_by_side(jobs, run.jobs, command, say)
        else:
            statuses = run_in_turn(jobs, command, say)
        failures.extend(report(statuses))

    return guarded(run_all, debug) or (failures[0] if failures else 0)


def report(statuses: Mapping[str, int]) -> list[int]:
    """Say which jobs of a sweep failed; returns their exit statuses."""
    failed = {name: status for name, status in statuses.items() if status}
    if INTERRUPTED in failed.values():
        raise KeyboardInterrupt
    if failed:
        print(
            f"error: {len(failed)} of {len(statuses)} jobs failed: {', '.join(failed)}; the others are done, "
            "and the same command continues",
            file=sys.stderr,
        )
    return list(failed.values())


if __name__ == "__main__":
    sys.exit(main())
