"""``python -m pipeline stage=... [overrides] [-m]``: Hydra composes, the runner runs.

``-m`` may stand anywhere: Hydra's own parser wants flags first. A sweep composes its jobs lazily, so the keys of all jobs are
computed before the first one starts, and a job whose key has changed by then stops.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence

import hydra
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.types import RunMode
from omegaconf import DictConfig

from pipeline.errors import INTERRUPTED, STORAGE_ERRORS, UserError, status_of
from pipeline.hydra_config import CONF, compose, to_plain
from pipeline.runner import make_plan, run_pipeline, split_config
from pipeline.store import HashCache, Store

SWEEP_VARIABLE = "LIGHTMILL_SWEEP_KEYS"  # JSON: job's overrides -> keys, for the jobs of one sweep
MULTIRUN_FLAGS = {"-m", "--multirun"}


def plan_keys(root: dict) -> dict[str, str]:
    run, system, sections = split_config(root)
    plan = make_plan(run, system, sections, HashCache(Store(run.store).root / ".cache" / "hashes.json"))
    return {name: planned.key for name, planned in plan.items()}


def sweep_keys(overrides: Sequence[str]) -> dict[str, dict[str, str]]:
    """Keys of every job of a sweep, by the job's overrides."""
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    jobs = [job for batch in BasicSweeper.split_arguments(parsed, None) for job in batch]
    return {" ".join(job): plan_keys(compose(job)) for job in jobs}


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
        signal.signal(signal.SIGINT, before)


def guarded(work: Callable[[], None], debug: bool = False) -> int:
    """Do the work; an error that a person can mend becomes one line and its exit status, which is returned."""
    try:
        with interruptible():
            work()
    except (ValueError, OSError) as error:
        if debug or (isinstance(error, OSError) and error.errno not in STORAGE_ERRORS):
            raise
        print(f"error: {error}", file=sys.stderr, flush=True)
        return status_of(error)
    except KeyboardInterrupt:
        print("interrupted: what is finished is kept, the same command continues", file=sys.stderr)
        return INTERRUPTED
    return 0


def main(words: Sequence[str] | None = None) -> int:
    """Returns the exit status: 0 done, 130 interrupted, or that of the first error (see pipeline.errors)."""
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
            expected = json.loads(os.environ.get(SWEEP_VARIABLE, "{}")).get(task)
            if HydraConfig.get().mode == RunMode.MULTIRUN:
                print(f"== {task}", flush=True)
                if expected is not None and expected != plan_keys(root):
                    raise UserError(
                        f"the config or a source file changed after the sweep began: job {task!r} has other keys now"
                    )
            run_pipeline(root, command, lambda text: print(text, flush=True))
        except ValueError as error:  # UserError, and what model/ says of bad input
            if debug:
                raise
            failures.append(status_of(error))
            print(f"error: {error}", file=sys.stderr, flush=True)

    def compose_and_run() -> None:
        if not hydra_flags:
            if flags:
                os.environ[SWEEP_VARIABLE] = json.dumps(sweep_keys(overrides))
            else:
                split_config(compose(overrides))  # a bad override gets our message instead of Hydra's
        sys.argv = ["lightmill", *flags[:1], *overrides]
        os.environ.setdefault("HYDRA_FULL_ERROR", "1")
        job()

    try:
        status = guarded(compose_and_run, debug)
    finally:
        os.environ.pop(SWEEP_VARIABLE, None)
    return status or (failures[0] if failures else 0)


if __name__ == "__main__":
    sys.exit(main())
