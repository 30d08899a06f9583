"""A sweep (``-m``): the jobs that its overrides span, each composed once, all their keys before the first one starts.

Jobs run one after the other in this process. With ``jobs=N`` they run N at a time, each in a process of its own with its
share of the cores and GPUs, so that one that dies takes no other with it; what all jobs share is made first, with all cores.
Where a launcher of Hydra is asked for (``hydra/launcher=slurm``), that starts the jobs. A job whose keys are no longer those
of the plan, because a source file changed meanwhile, stops.
"""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.errors import HydraException
from omegaconf import DictConfig

from pipeline.errors import UserError, for_people, status_of
from pipeline.executor import THREAD_VARIABLES
from pipeline.gpus import VISIBLE, visible_gpus
from pipeline.hydra_config import compose, initialized, parse_overrides, system_of, to_plain
from pipeline.plan import Planned, RunPlan, plan_run
from pipeline.run import run_plan
from pipeline.store import Store

LAUNCHER = "hydra/launcher="


@dataclass(frozen=True)
class Job:
    """One combination of the overrides: its words, the composed config as plain containers, and its plan."""

    words: tuple[str, ...]
    root: Mapping[str, Any]
    run_plan: RunPlan

    @property
    def name(self) -> str:
        return " ".join(self.words)

    @property
    def plan(self) -> Mapping[str, Planned]:
        """Stage name -> planned stage."""
        return self.run_plan.stages

    @property
    def keys(self) -> dict[str, str]:
        """Stage name -> key."""
        return self.run_plan.keys


def is_hydras(word: str) -> bool:
    """Whether the override is of Hydra's own settings, which belong to no job."""
    return word.lstrip("+~").startswith(("hydra.", "hydra/"))


def expand(overrides: Sequence[str]) -> list[Job]:
    """The jobs of a sweep, in Hydra's order. The same combination twice is one job."""
    parsed = parse_overrides([word for word in overrides if not is_hydras(word)])
    try:
        batches = BasicSweeper.split_arguments(parsed, None)
    except HydraException as error:
        raise UserError(str(error).splitlines()[0]) from None
    roots = {tuple(words): compose(words) for batch in batches for words in batch}
    return [Job(words, root, plan_run(root)) for words, root in roots.items()]


def plan_again(name: str, root: Mapping[str, Any], planned_keys: Mapping[str, str]) -> RunPlan:
    """The job's plan at the moment when it begins, which it then runs.

    UserError if its keys are not those that it had when the sweep began. A key must never name what a changed source gives.
    """
    plan = plan_run(root)
    if plan.keys != planned_keys:
        raise UserError(f"the config or a source file changed after the sweep began: job {name!r} has other keys now")
    return plan


def shared_stages(jobs: Sequence[Job]) -> dict[str, str]:
    """Stage -> key, of the stages whose artifact is the same for all jobs."""
    return {name: key for name, key in jobs[0].keys.items() if all(job.keys.get(name) == key for job in jobs)}


def describe(jobs: Sequence[Job]) -> str:
    """One line: what the jobs share, with the key of the last shared stage, and how many artifacts the others come to."""
    shared = shared_stages(jobs)
    names = list(dict.fromkeys(name for job in jobs for name in job.plan))
    unshared = [f"{name} {len({job.keys.get(name) for job in jobs} - {None})}" for name in names if name not in shared]
    text = f"sweep: {len(jobs)} jobs"
    if shared:
        last = list(shared)[-1]
        text += f" share {', '.join(shared)} ({last} {shared[last][:12]})"
    return text + (f"; artifacts of their own: {', '.join(unshared)}" if unshared else "")


def label(job: Job, jobs: Sequence[Job]) -> str:
    """What tells the job from the others: the values of the overrides in which they differ."""
    return " ".join(word.partition("=")[2] for word in job.words if not all(word in other.words for other in jobs)) or job.name


# -- one after the other


def run_in_turn(jobs: Sequence[Job], command: Sequence[str], out: Callable[[str], None]) -> dict[str, int]:
    """Run the jobs in this process; returns the exit status of each by name. After one that fails the next one runs."""
    statuses = {}
    for job in jobs:
        out(f"== {job.name}")
        try:
            run_plan(plan_again(job.name, job.root, job.keys), command, out)
            statuses[job.name] = 0
        except ValueError as error:  # UserError, and what model/ says of bad input
            if job.root["debug"] or not for_people(error):
                raise
            print(f"error: {error}", file=sys.stderr, flush=True)
            statuses[job.name] = status_of(error)
    return statuses


# -- side by side


def run_side_by_side(jobs: Sequence[Job], at_once: int, command: Sequence[str], out: Callable[[str], None]) -> dict[str, int]:
    """Run the jobs ``at_once`` at a time in processes of their own; returns the exit status of each by its label."""
    todo = [job for job in jobs if not _complete(job)]
    shared = shared_stages(jobs)
    if todo and shared:
        _make_shared(jobs[0], shared, command, out)
    cores = max(1, (os.cpu_count() or 1) // at_once)
    names = {job.name: label(job, jobs) for job in jobs}
    width = max(len(name) for name in names.values())
    free: queue.SimpleQueue[Mapping[str, str]] = queue.SimpleQueue()  # one environment for each job that runs at a time
    for devices in deal(visible_gpus(), at_once):
        gpu_environment = {} if devices is None else {VISIBLE: ",".join(devices)}
        free.put(os.environ | dict.fromkeys(THREAD_VARIABLES, str(cores)) | gpu_environment)

    def run(job: Job) -> int:
        def say(text: str) -> None:
            out(f"{names[job.name]:<{width}} | {text}")

        if job not in todo:  # says so, and that it was used
            run_plan(job.run_plan, command, say)
            return 0
        root = {**job.root, "workers": cores if job.root["workers"] == "auto" else job.root["workers"]}
        message = {"name": job.name, "root": root, "keys": job.keys, "command": list(command)}
        environment = free.get()
        try:
            return _run_process(message, environment, say)
        finally:
            free.put(environment)

    pool = ThreadPoolExecutor(at_once)
    try:
        return dict(zip(names.values(), pool.map(run, jobs), strict=True))
    finally:  # after Ctrl-C, which the running jobs get too, none starts any more
        pool.shutdown(cancel_futures=True)


def _run_process(message: Mapping[str, Any], environment: Mapping[str, str], say: Callable[[str], None]) -> int:
    """Run a job in a process of its own and hand on its lines; returns its exit status.

    ``message``: what ``pipeline.job`` reads. ``environment``: the process's variables.
    """
    process = subprocess.Popen(
        [sys.executable, "-m", "pipeline.job"],
        env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    assert process.stdin is not None and process.stdout is not None
    try:
        json.dump(message, process.stdin)
        process.stdin.close()
    except BrokenPipeError:  # it died before it could read: its status says how
        pass
    for line in process.stdout:
        say(line.rstrip("\n"))
    status = process.wait()
    return status if status >= 0 else 128 - status  # killed by a signal: the shells' number


def deal(gpus: Sequence[str], at_once: int) -> list[list[str] | None]:
    """For each of the jobs that run at a time its GPUs: an equal share, or one that others use too. None without GPUs."""
    if not gpus:
        return [None] * at_once
    if at_once > len(gpus):
        return [[gpus[slot % len(gpus)]] for slot in range(at_once)]
    return [list(gpus[slot::at_once]) for slot in range(at_once)]


def _complete(job: Job) -> bool:
    """Whether the job has nothing to make."""
    run = job.run_plan.run
    store = Store(run.store)
    planned = [job.plan[name] for name in run.stage]
    return not run.force and not run.retry and all(store.find(one.place, one.key) is not None for one in planned)


def _make_shared(job: Job, shared: Mapping[str, str], command: Sequence[str], out: Callable[[str], None]) -> None:
    """Make what all jobs read, once and with all workers, instead of by one job for which the others wait."""
    plan = plan_again(job.name, job.root, job.keys)
    run = plan.run
    for setting, names in (("force", run.force), ("retry", run.retry)):
        if again := [name for name in names if name in shared]:
            raise UserError(
                f"{setting}={','.join(again)}: all jobs of the sweep share it; do that by itself, then run the sweep"
            )
    parents = {parent for name in shared for parent in job.plan[name].parents.values()}
    targets = tuple(name for name in shared if name not in parents)
    run = run.model_copy(update={"stage": targets, "force": (), "retry": ()})
    run_plan(replace(plan, run=run, stages={name: plan.stages[name] for name in shared}), command, out)


# -- by a launcher of Hydra


def launcher_of(overrides: Sequence[str]) -> str | None:
    """The launcher that the overrides ask for."""
    launchers = [word.removeprefix(LAUNCHER) for word in overrides if word.startswith(LAUNCHER)]
    return launchers[-1] if launchers else None


def run_by_launcher(
    jobs: Sequence[Job], overrides: Sequence[str], command: Sequence[str], out: Callable[[str], None]
) -> dict[str, int]:
    """Hand the jobs to Hydra's launcher, which composes each once more where it runs; returns the exit status of each."""
    from hydra._internal.callbacks import Callbacks
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.plugins import Plugins
    from hydra.types import HydraContext, RunMode

    planned_keys = {job.name: job.keys for job in jobs}
    commands = list(command)

    def work(config: DictConfig) -> int:
        from hydra.core.hydra_config import HydraConfig

        words = [word for word in HydraConfig.get().overrides.task if not is_hydras(word)]
        root = to_plain(config)
        try:
            name = " ".join(words)
            run_plan(plan_again(name, root, planned_keys[name]), commands, lambda text: print(text, flush=True))
        except ValueError as error:
            if not for_people(error):
                raise
            print(f"error: {error}", file=sys.stderr, flush=True)
            return status_of(error)
        return 0

    system = system_of(overrides)
    with initialized(system) as more:
        loader = GlobalHydra.instance().config_loader()
        hydra_words = [word for word in overrides if is_hydras(word)]
        try:
            config = loader.load_configuration("config", overrides=[*hydra_words, *more], run_mode=RunMode.MULTIRUN)
            launcher = Plugins.instance().instantiate_launcher(
                hydra_context=HydraContext(config_loader=loader, callbacks=Callbacks()), task_function=work, config=config
            )
        except HydraException as error:
            raise UserError(str(error).splitlines()[0]) from None
        out(f"launcher: {len(jobs)} jobs by {launcher_of(overrides)}")
        returns = launcher.launch([list(job.words) for job in jobs], initial_job_idx=0)
    statuses = {}
    for job, result in zip(jobs, returns, strict=True):
        try:
            statuses[label(job, jobs)] = int(result.return_value)
        except Exception as error:  # whatever the job died of, on whatever machine
            print(f"error: {label(job, jobs)}: {error}", file=sys.stderr, flush=True)
            statuses[label(job, jobs)] = status_of(error)
    return statuses
