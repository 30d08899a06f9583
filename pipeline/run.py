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
from pipeline.errors import (
    Damaged,
    MachineError,
    UserError,
)
from pipeline.make import describe, machine_rejects, make_artifact
from pipeline.plan import Planned, RunConfig, hashes_of, label, make_plan, split_config
from pipeline.stage import RunStage
from pipeline.store import Artifact, Store

LEADER_PATIENCE_S = 600.0  # a follower waits so long without a sign of the process that leads


def run_pipeline(root: Mapping[str, Any], command: Sequence[str], out: Callable[[str], None] = print) -> dict[str, Any]:
    """Make the artifacts that ``root`` (the composed config as plain containers) asks for.

    Returns stage name -> artifact (None for a stage that was not needed) with the keys of the plan under ``keys``.
    """
    run, system, sections = split_config(root)
    store = Store(run.store)
    with hashes_of(store) as hashes:
        plan = make_plan(run, system, sections, hashes)
    for setting, names in (("force", run.force), ("retry", run.retry)):
        for name in names:
            if name not in plan:
                raise UserError(f"{setting}={name}: the stage is not among those that stage={','.join(run.stage)} needs")
    artifacts: dict[str, Artifact | None] = {}
    damaged: dict[str, Damaged] = {}
    for name, planned in plan.items():
        try:
            artifacts[name] = store.find(planned.place, planned.key)
            if artifacts[name] is not None and not run.plan:
                store.touch(planned.key)  # not only at its turn, which may be days away: gc must know
        except Damaged as error:
            artifacts[name], damaged[name] = None, error
    run = run.model_copy(update={"retry": tuple(name for name in run.retry if machine_rejects(artifacts[name]))})
    todo = _todo(run, plan, artifacts)
    for name, error in damaged.items():
        if name in todo and name not in run.force:
            raise error
    if int(os.environ.get("WORLD_SIZE", "1")) > 1 and (again := (*run.force, *run.retry)):
        raise UserError(f"force or retry={','.join(again)} needs a process of its own: run it without torchrun")
    if int(os.environ.get("RANK", "0")) > 0 and not run.plan:  # one of several processes that torchrun started
        return _follow(plan, todo, store)
    with Cluster(run.executor, out) if isinstance(run.executor, DaskExecutor) else contextlib.nullcontext() as cluster:
        for name, planned in plan.items():
            artifact = artifacts[name]
            if name in todo:
                if run.plan:
                    out(f"{label(system, name)} to make   key {planned.key[:12]}")
                    for line in planned.stage.estimate(planned.config, {other: plan[other].config for other in plan}):
                        out(f"      {line}")
                else:
                    inputs = planned.inputs(artifacts)
                    assert all(inputs.values())
                    rest = [other for other in plan if other in todo]
                    artifacts[name] = make_artifact(run, system, planned, inputs, store, command, out, rest, cluster)  # type: ignore[arg-type]
            elif artifact is not None:
                store.touch(artifact.key)
                out(f"{label(system, name)} up to date {describe(artifact)}")
                for line in _note_rejects(artifact, command):
                    out(line)
                if artifact.codes != [code_digest(system, name)]:
                    out(f"   note: the code of {name} has changed since, its version has not (force={name} recomputes)")
            else:
                out(f"{label(system, name)} not needed key {planned.key[:12]}")
    for name in run.stage:
        artifact = artifacts[name]
        headline = plan[name].stage.headline
        if artifact is not None and headline and not run.plan:
            out(f"{headline}: {artifact.file(headline)}")
    return {"artifacts": artifacts, "keys": {name: planned.key for name, planned in plan.items()}}


def _follow(plan: Mapping[str, Planned], todo: set[str], store: Store) -> dict[str, Any]:
    """What a process does that another one leads: its part of run stages, once what they read has been made."""

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
    return {"artifacts": {}, "keys": {name: planned.key for name, planned in plan.items()}}


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
    """Says of machine rejects what to do: an undisturbed run would have made records of them."""
    try:
        rejects = machine_rejects(artifact)
    except Damaged:  # nobody reads it now
        return
    if rejects:
        name = artifact.stage
        counts = Counter(reject["reason"] for reject in rejects)
        listed = ", ".join(f"{count} {reason}" for reason, count in sorted(counts.items()))
        met: dict[str, float] = {}
        for reject in rejects:
            for limit, value in reject.get("limit", {}).items():
                met[limit] = max(value, met.get(limit, 0.0))
        raised = "".join(f", {name}.limits.{limit}=N allows more than {value:g}" for limit, value in sorted(met.items()))
        yield f"   note: the machine rejected {len(rejects)} of its items ({listed})"
        again = [word for word in command if word != "plan=true"]
        yield f"   note: to try them again: {shlex.join([*again, f'retry={name}'])}{raised}"
