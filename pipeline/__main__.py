"""``python -m pipeline stage=... [overrides] [-m]``: Hydra composes, the runner runs.

``-m`` may stand anywhere: Hydra's own parser wants flags first. Sweeps: ``pipeline.sweep``.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping, Sequence

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from pipeline.hydra_config import CONF, compose, to_plain
from pipeline.runner import run_pipeline, split_config
from pipeline.sweep import (
    KEYS_VARIABLE,
    check_keys,
    describe,
    expand,
    is_hydras,
    keys_of,
    live_with_the_sweep,
    run_side_by_side,
)

MULTIRUN_FLAGS = {"-m", "--multirun"}


def say(text: str) -> None:
    print(text, flush=True)


def main(words: Sequence[str] | None = None) -> int:
    """Returns the exit status: 0 done, 1 failed, 2 the user can mend it, 130 interrupted."""
    live_with_the_sweep()
    words = list(sys.argv[1:] if words is None else words)
    debug = "--debug" in words or "debug=true" in words
    words = [word for word in words if word != "--debug"]
    flags = [word for word in words if word in MULTIRUN_FLAGS]
    overrides = [word for word in words if word not in MULTIRUN_FLAGS]
    hydra_flags = [word for word in overrides if word.startswith("-") and word not in ("-",)]
    command = ["python", "-m", "pipeline", *words]
    failures: list[str] = []

    @hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
    def job(config: DictConfig) -> None:
        try:
            root = to_plain(config)
            task = " ".join(HydraConfig.get().overrides.task)
            if HydraConfig.get().mode == RunMode.MULTIRUN:
                say(f"== {task}")
            check_keys(task, root)
            run_pipeline(root, command, say)
        except ValueError as error:  # UserError, and what model/ says of bad input
            if debug or not isinstance(error, ValueError):
                raise
            failures.append(str(error))
            print(f"error: {error}", file=sys.stderr, flush=True)

    try:
        if not hydra_flags:
            if flags:
                jobs = expand(overrides)
                say(describe(jobs))
                run = split_config(jobs[0].root)[0]
                if run.jobs is not None and not run.plan:
                    statuses = run_side_by_side(jobs, run.jobs, [*filter(is_hydras, overrides)], command, say)
                    return report(statuses)
                os.environ[KEYS_VARIABLE] = json.dumps({job.name: keys_of(job.plan) for job in jobs})
            else:
                split_config(compose(overrides))  # a bad override gets our message instead of Hydra's
        sys.argv = ["lightmill", *flags[:1], *overrides]
        os.environ.setdefault("HYDRA_FULL_ERROR", "1")
        job()
    except ValueError as error:
        if debug:
            raise
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted: what is finished is kept, the same command continues", file=sys.stderr)
        return 130
    finally:
        os.environ.pop(KEYS_VARIABLE, None)
    return 2 if failures else 0


def report(statuses: Mapping[str, int]) -> int:
    """Say which jobs of a sweep failed; returns the sweep's exit status."""
    failed = {name: status for name, status in statuses.items() if status}
    if not failed:
        return 0
    if 130 in failed.values():
        raise KeyboardInterrupt
    print(
        f"error: {len(failed)} of {len(statuses)} jobs failed: {', '.join(failed)}; the others are done, "
        "and the same command continues",
        file=sys.stderr,
    )
    return 2 if set(failed.values()) == {2} else 1


if __name__ == "__main__":
    sys.exit(main())
