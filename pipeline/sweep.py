"""A sweep (``-m``): the jobs that its overrides span, all their keys before the first one starts, and jobs side by side.

Hydra runs the jobs one after the other in this process. With ``jobs=N`` they run N at a time instead, each in a process of its
own with its share of the cores, so that one that dies takes no other with it; what all jobs share is made first, with all
cores. Either way a job whose keys are no longer those of the plan stops: Hydra composes a job only when its turn comes.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

from pipeline.errors import UserError
from pipeline.executor import THREAD_VARIABLES
from pipeline.hydra_config import compose
from pipeline.plan import Planned, make_plan, split_config
from pipeline.run import run_pipeline
from pipeline.store import HashCache, Store
from pipeline.worker import die_with_parent

# The jobs of one sweep: of each a hash of its overrides and one of its keys. It goes where the jobs go, to other machines
# too, and it is small: Linux starts no process with a variable of 128 KiB.
KEYS_VARIABLE = "LIGHTMILL_SWEEP_KEYS"
HASH_LETTERS = 8
MAX_JOBS = 8000
JOB_VARIABLE = "LIGHTMILL_SWEEP_JOB"  # set in the processes of jobs that run side by side

Plan = Mapping[str, Planned]


@dataclass(frozen=True)
class Job:
    """One combination of the overrides: its words, the composed config as plain containers, and what it would make."""

    words: tuple[str, ...]
    root: Mapping[str, Any]
    plan: Plan

    @property
    def name(self) -> str:
        return " ".join(self.words)


def plan_of(root: Mapping[str, Any]) -> dict[str, Planned]:
    run, system, sections = split_config(root)
    return make_plan(run, system, sections, HashCache(Store(run.store).root / ".cache" / "hashes.json"))


def keys_of(plan: Plan) -> dict[str, str]:
    return {name: planned.key for name, planned in plan.items()}


def is_hydras(word: str) -> bool:
    """Whether the override is of Hydra's own settings, which belong to no job."""
    return word.lstrip("+~").startswith(("hydra.", "hydra/"))


def expand(overrides: Sequence[str]) -> list[Job]:
    """The jobs of a sweep, in Hydra's order."""
    try:
        parsed = OverridesParser.create().parse_overrides([word for word in overrides if not is_hydras(word)])
        batches = BasicSweeper.split_arguments(parsed, None)
    except HydraException as error:
        raise UserError(str(error).splitlines()[0]) from None
    roots = [(tuple(words), compose(words)) for batch in batches for words in batch]
    return [Job(words, root, plan_of(root)) for words, root in roots]


def for_hydra(overrides: Sequence[str]) -> list[str]:
    """The overrides of a sweep as Hydra's own launch takes them.

    It first composes those with one value by themselves, without the groups that the sweep chooses, and refuses what only such
    a group knows. As a choice of one, such a word waits for its job.
    """

    def known(words: Sequence[str]) -> bool:
        try:
            compose(words)
        except UserError:
            return False
        return True

    parsed = OverridesParser.create().parse_overrides(list(overrides))
    single = [word for word, override in zip(overrides, parsed, strict=True) if not override.is_sweep_override()]
    asked = [word for word in single if not is_hydras(word) and "=" in word]
    waiting = set() if known(asked) else {word for word in asked if not known([word])}
    return [
        f"{name}=choice({value})" if word in waiting else word for word in overrides for name, _, value in [word.partition("=")]
    ]


def sweep_keys(overrides: Sequence[str]) -> dict[str, dict[str, str]]:
    """Keys of every job of a sweep, by the job's overrides."""
    return {job.name: keys_of(job.plan) for job in expand(overrides)}


def _hash(text: str) -> str:
    return base64.urlsafe_b64encode(hashlib.blake2b(text.encode(), digest_size=HASH_LETTERS * 3 // 4).digest()).decode()


def _entry(task: str, keys: Mapping[str, str]) -> str:
    return _hash(task) + _hash(json.dumps(keys, sort_keys=True))


def planned_keys(keys: Mapping[str, Mapping[str, str]]) -> str:
    """KEYS_VARIABLE for jobs of these overrides and keys."""
    if len(keys) > MAX_JOBS:
        raise UserError(f"a sweep of {len(keys)} jobs: at most {MAX_JOBS} at a time, so leave out some values")
    return "".join(_entry(task, own) for task, own in keys.items())


def check_keys(task: str, root: Mapping[str, Any]) -> None:
    """UserError if the job ``task`` is one of a sweep that planned other keys for it."""
    told = os.environ.get(KEYS_VARIABLE, "")
    known = {told[start : start + 2 * HASH_LETTERS] for start in range(0, len(told), 2 * HASH_LETTERS)}
    if any(entry.startswith(_hash(task)) for entry in known) and _entry(task, keys_of(plan_of(root))) not in known:
        raise UserError(f"the config or a source file changed after the sweep began: job {task!r} has other keys now")


def shared_stages(jobs: Sequence[Job]) -> dict[str, str]:
    """Stage -> key, of the stages whose artifact is the same for all jobs."""
    first = keys_of(jobs[0].plan)
    return {name: key for name, key in first.items() if all(keys_of(job.plan).get(name) == key for job in jobs)}


def describe(jobs: Sequence[Job]) -> str:
    """One line: what the jobs share, with the key of the last shared stage, and how many artifacts the others come to."""
    shared = shared_stages(jobs)
    names = list(dict.fromkeys(name for job in jobs for name in job.plan))
    own = [f"{name} {len({keys_of(job.plan).get(name) for job in jobs} - {None})}" for name in names if name not in shared]
    text = f"sweep: {len(jobs)} jobs"
    if shared:
        last = list(shared)[-1]
        text += f" share {', '.join(shared)} ({last} {shared[last][:12]})"
    return text + (f"; artifacts of their own: {', '.join(own)}" if own else "")


def label(job: Job, jobs: Sequence[Job]) -> str:
    """What tells the job from the others: the values of the overrides in which they differ."""
    return " ".join(word.partition("=")[2] for word in job.words if not all(word in other.words for other in jobs)) or job.name


def run_side_by_side(
    jobs: Sequence[Job], at_once: int, hydra_words: Sequence[str], command: Sequence[str], out: Callable[[str], None]
) -> dict[str, int]:
    """Run the jobs ``at_once`` at a time in processes of their own; returns the exit status of each by its label."""
    todo = [job for job in jobs if not _complete(job)]
    shared = shared_stages(jobs)
    if todo and shared:
        _make_shared(jobs[0], shared, command, out)
    cores = max(1, (os.cpu_count() or 1) // at_once)
    names = {job.name: label(job, jobs) for job in jobs}
    width = max(len(name) for name in names.values())
    environment = os.environ | dict.fromkeys(THREAD_VARIABLES, str(cores)) | {JOB_VARIABLE: "1"}

    def run(job: Job) -> int:
        def say(text: str) -> None:
            out(f"{names[job.name]:<{width}} | {text}")

        if job not in todo:  # says so, and that it was used
            run_pipeline(job.root, command, say)
            return 0
        words = list(job.words)
        if job.root["workers"] == "auto":
            words = [word for word in words if not word.startswith("workers=")] + [f"workers={cores}"]
        keys = planned_keys({" ".join(words): keys_of(job.plan)})
        process = subprocess.Popen(
            [sys.executable, "-m", "pipeline", *words, *hydra_words],
            env=environment | {KEYS_VARIABLE: keys}, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip
        assert process.stdout is not None
        for line in process.stdout:
            say(line.rstrip("\n"))
        status = process.wait()
        return status if status >= 0 else 128 - status  # killed by a signal: the shells' number

    pool = ThreadPoolExecutor(at_once)
    try:
        return dict(zip(names.values(), pool.map(run, jobs), strict=True))
    finally:  # after Ctrl-C, which the running jobs get too, none starts any more
        pool.shutdown(cancel_futures=True)


def live_with_the_sweep() -> None:
    """In the process of a job: end with the sweep that started it, but let Ctrl-C reach this process too."""
    if os.environ.pop(JOB_VARIABLE, None):
        die_with_parent()
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _complete(job: Job) -> bool:
    run = split_config(job.root)[0]
    store = Store(run.store)
    return not run.force and not run.retry and all(store.find(name, job.plan[name].key) is not None for name in run.stage)


def _make_shared(job: Job, shared: Mapping[str, str], command: Sequence[str], out: Callable[[str], None]) -> None:
    """What all jobs read, once and with all workers, instead of by one job for which the others wait."""
    run = split_config(job.root)[0]
    for setting, names in (("force", run.force), ("retry", run.retry)):
        if ours := [name for name in names if name in shared]:
            raise UserError(
                f"{setting}={','.join(ours)}: all jobs of the sweep share it; do that by itself, then run the sweep"
            )
    read = {parent for name in shared for parent in job.plan[name].stage.reads(job.plan[name].config)}
    run_pipeline({**job.root, "stage": [name for name in shared if name not in read], "force": [], "retry": []}, command, out)
