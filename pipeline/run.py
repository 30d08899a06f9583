"""Run a plan: make what is missing, in order, and say what there is."""

from __future__ import annotations

import contextlib
import os
import shlex
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from pipeline.cluster import Cluster, DaskExecutor
from pipeline.code import code_digest
from pipeline.errors import Damaged, MachineError, UserError
from pipeline.make import describe, machine_rejects, make_artifact
from pipeline.making import Run
from pipeline.plan import Planned, RunConfig, RunPlan, plan_run
from pipeline.stage import RunStage
from pipeline.store import Artifact, Store

LEADER_PATIENCE_S = 600.0  # a follower waits so long without a sign of the process that leads


def run_pipeline(root: Mapping[str, Any], command: Sequence[str], out: Callable[[str], None] = print) -> dict[str, Any]:
    """Plan and run what ``root`` (the composed config as plain containers) asks for; see ``run_plan``."""
    return run_plan(plan_run(root), command, out)


def run_plan(plan: RunPlan, command: Sequence[str], out: Callable[[str], None] = print) -> dict[str, Any]:
    """Make the artifacts of the plan that are missing.

    Returns stage name -> artifact under ``artifacts``, with None for a stage that was not needed, and stage name -> key under
    ``keys``.
    """
    _check_again(plan)
    store = Store(plan.run.store)
    artifacts, damage = _look_up(plan, store)
    settings = plan.run.model_copy(update={"retry": tuple(name for name in plan.run.retry if machine_rejects(artifacts[name]))})
    todo = _todo(settings, plan.stages, artifacts)
    for name, error in damage.items():
        if name in todo and name not in settings.force:
            raise error
    if int(os.environ.get("WORLD_SIZE", "1")) > 1 and (again := (*settings.force, *settings.retry)):
        raise UserError(f"force or retry={','.join(again)} needs a process of its own: run it without torchrun")
    if int(os.environ.get("RANK", "0")) > 0 and not settings.plan:  # one of several processes that torchrun started
        _follow(plan.stages, todo, store)
        return {"artifacts": {}, "keys": plan.keys}
    by_dask = isinstance(settings.executor, DaskExecutor)
    with Cluster(settings.executor, out) if by_dask else contextlib.nullcontext() as cluster:
        order = [name for name in plan.stages if name in todo]
        configs = {name: planned.config for name, planned in plan.stages.items()}
        run = Run(settings, plan.system, store, command, out, order, cluster)
        for name, planned in plan.stages.items():
            artifact = artifacts[name]
            if name in todo and settings.plan:
                run.say(name, f"to make   key {planned.key[:12]}")
                for line in planned.stage.estimate(planned.config, configs):
                    out(f"      {line}")
            elif name in todo:
                artifacts[name] = make_artifact(run, planned, planned.inputs(artifacts))
            elif artifact is not None:
                _say_up_to_date(run, name, artifact)
            else:
                run.say(name, f"not needed key {planned.key[:12]}")
    for name in settings.stage:
        artifact = artifacts[name]
        headline = plan.stages[name].stage.headline
        if artifact is not None and headline and not settings.plan:
            out(f"{headline}: {artifact.file(headline)}")
    return {"artifacts": artifacts, "keys": plan.keys}


def _check_again(plan: RunPlan) -> None:
    """UserError where ``force`` or ``retry`` names a stage that the run does not need."""
    for setting, names in (("force", plan.run.force), ("retry", plan.run.retry)):
        for name in names:
            if name not in plan.stages:
                targets = ",".join(plan.run.stage)
                raise UserError(f"{setting}={name}: the stage is not among those that stage={targets} needs")


def _look_up(plan: RunPlan, store: Store) -> tuple[dict[str, Artifact | None], dict[str, Damaged]]:
    """What the store holds of the plan, None for what is missing or damaged; and what is wrong with the damaged ones."""
    artifacts: dict[str, Artifact | None] = {}
    damage: dict[str, Damaged] = {}
    for name, planned in plan.stages.items():
        try:
            artifacts[name] = store.find(planned.place, planned.key)
            if artifacts[name] is not None and not plan.run.plan:
                store.touch(planned.key)  # not only at its turn, which may be days away: gc must know
        except Damaged as error:
            artifacts[name], damage[name] = None, error
    return artifacts, damage


def _say_up_to_date(run: Run, name: str, artifact: Artifact) -> None:
    """Say that the artifact is there already, and what a person should know of it."""
    run.store.touch(artifact.key)
    run.say(name, f"up to date {describe(artifact)}")
    for line in _note_rejects(artifact, run.command):
        run.out(line)
    if artifact.codes != [code_digest(run.system, name)]:
        run.out(f"   note: the code of {name} has changed since, its version has not (force={name} recomputes)")


def _follow(plan: Mapping[str, Planned], todo: set[str], store: Store) -> None:
    """Do what another process leads: this one's share of run stages, each once its inputs have been made."""

    def leader_works() -> bool:
        """Whether some process holds the claim of a stage of this plan, at which the leader is then at work."""
        return any(store.claim(plan[name].place, plan[name].key).holder() is not None for name in todo)

    def wait_for(name: str) -> Artifact:
        last_sign = time.monotonic()
        while (artifact := store.find(plan[name].place, plan[name].key)) is None:
            if leader_works():
                last_sign = time.monotonic()
            elif time.monotonic() - last_sign > LEADER_PATIENCE_S:
                raise MachineError(
                    f"waiting for {name}: nobody has worked on it or on what it needs for {LEADER_PATIENCE_S:g} s, so the "
                    "process that leads this torchrun is gone: start all of it again, finished parts are kept"
                )
            time.sleep(0.5)
        return artifact

    for name, planned in plan.items():
        if name in todo and isinstance(planned.stage, RunStage):
            inputs = {role: wait_for(parent) for role, parent in planned.parents.items()}
            planned.stage.follow(planned.config, inputs)


def _todo(run: RunConfig, plan: Mapping[str, Planned], artifacts: Mapping[str, Artifact | None]) -> set[str]:
    """Stages to compute: targets that are missing, what they lack upstream, and what is forced."""
    todo: set[str] = set()

    again = {*run.force, *run.retry}

    def need(name: str) -> None:
        if name in todo or (artifacts[name] is not None and name not in again):
            return
        todo.add(name)
        for parent in plan[name].parents.values():
            need(parent)

    for name in (*again, *run.stage):
        need(name)
    return todo


def _note_rejects(artifact: Artifact, command: Sequence[str]) -> Iterator[str]:
    """Lines that say how to try machine rejects again: an undisturbed run would have made records of them."""
    try:
        rejects = machine_rejects(artifact)
    except Damaged:  # nobody reads it now
        return
    if rejects:
        name = artifact.stage
        counts = Counter(reject["reason"] for reject in rejects)
        listed = ", ".join(f"{count} {reason}" for reason, count in sorted(counts.items()))
        highest: dict[str, float] = {}  # limit -> the highest that an item ran into
        for reject in rejects:
            for limit, value in reject.get("limit", {}).items():
                highest[limit] = max(value, highest.get(limit, 0.0))
        raised = "".join(f", {name}.limits.{limit}=N allows more than {value:g}" for limit, value in sorted(highest.items()))
        yield f"   note: the machine rejected {len(rejects)} of its items ({listed})"
        again = [word for word in command if word != "plan=true"]
        yield f"   note: to try them again: {shlex.join([*again, f'retry={name}'])}{raised}"
