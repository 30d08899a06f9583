"""``python -m pipeline stage=... [overrides] [-m]``: Hydra composes, the runner runs.

``-m`` may stand anywhere: Hydra's own parser wants flags first. Sweeps: ``pipeline.sweep``.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from pipeline.errors import INTERRUPTED, for_people, status_of
from pipeline.hydra_config import CONF, compose, to_plain
from pipeline.plan import split_config
from pipeline.run import run_pipeline
from pipeline.sweep import (
    KEYS_VARIABLE,
    check_keys,
    describe,
    expand,
    for_hydra,
    is_hydras,
    keys_of,
    live_with_the_sweep,
    planned_keys,
    run_side_by_side,
)

MULTIRUN_FLAGS = {"-m", "--multirun"}


def say(text: str) -> None:
    print(text, flush=True)


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Ctrl-C stops the workers and the run in order; a second one ends the process at once, and Linux its workers with it."""

    def at_once(number: int, frame: object) -> None:
        os._exit(INTERRUPTED)

    def in_order(number: int, frame: object) -> None:
        signal.signal(signal.SIGINT, at_once)
        os.write(2, b"interrupted: stopping (Ctrl-C again: at once)\n")
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, in_order)
    try:
        yield
    finally:
        if signal.getsignal(signal.SIGINT) is in_order:  # else the process is about to end: a late second one finds it so
            signal.signal(signal.SIGINT, before)


def guarded(work: Callable[[], None], debug: bool = False) -> int:
    """Do the work; an error that a person can mend becomes one line and its exit status, which is returned."""
    try:
        with interruptible():
            work()
    except (ValueError, OSError) as error:
        if debug or not for_people(error):
            raise
        print(f"error: {error}", file=sys.stderr, flush=True)
        return status_of(error)
    except KeyboardInterrupt:
        print("interrupted: what is finished is kept, the same command continues", file=sys.stderr)
        return INTERRUPTED
    return 0


def main(words: Sequence[str] | None = None) -> int:
    """Returns the exit status: 0 done, 130 interrupted, or that of the first error (see pipeline.errors)."""
    live_with_the_sweep()
    words = list(sys.argv[1:] if words is None else words)
    debug = "--debug" in words or "debug=true" in words
    words = [word for word in words if word != "--debug"]
    flags = [word for word in words if word in MULTIRUN_FLAGS]
    overrides = [word for word in words if word not in MULTIRUN_FLAGS]
    hydra_flags = [word for word in overrides if word.startswith("-") and word not in ("-",)]
    command = ["python", "-m", "pipeline", *words]
    failures: list[int] = []

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
            if debug or not for_people(error):
                raise
            failures.append(status_of(error))
            print(f"error: {error}", file=sys.stderr, flush=True)

    def compose_and_run() -> None:
        if not hydra_flags:
            if flags:
                jobs = expand(overrides)
                say(describe(jobs))
                run = split_config(jobs[0].root)[0]
                if run.jobs is not None and not run.plan:
                    statuses = run_side_by_side(jobs, run.jobs, [*filter(is_hydras, overrides)], command, say)
                    failures.extend(report(statuses))
                    return
                overrides[:] = for_hydra(overrides)
                os.environ[KEYS_VARIABLE] = planned_keys({job.name: keys_of(job.plan) for job in jobs})
            else:
                split_config(compose(overrides))  # a bad override gets our message instead of Hydra's
        sys.argv = ["lightmill", *flags[:1], *overrides]
        os.environ.setdefault("HYDRA_FULL_ERROR", "1")
        job()

    try:
        status = guarded(compose_and_run, debug)
    finally:
        os.environ.pop(KEYS_VARIABLE, None)
    return status or (failures[0] if failures else 0)


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
