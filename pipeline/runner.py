"""From a config to artifacts: plan the keys, run what is missing, commit."""

from __future__ import annotations

import contextlib
import gc
import itertools
import os
import platform
import shlex
import shutil
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, Field

from pipeline.cluster import Cluster, DaskExecutor, Executor, LocalExecutor
from pipeline.code import code_digest, commit
from pipeline.config import Limits, Section, StageConfig, nearest, parse
from pipeline.errors import (
    INTERRUPTED,
    STORAGE_ERRORS,
    Damaged,
    ItemsFailed,
    MachineError,
    TooManyRejects,
    UserError,
    for_people,
    status_of,
)
from pipeline.executor import REASONS, run_parts
from pipeline.keys import SCHEME, canonical, digest_of, digest_of_plain
from pipeline.progress import Progress, duration
from pipeline.stage import Item, MapStage, RunStage, Stage, System, load_system
from pipeline.status import RunState
from pipeline.store import DRAFT, SCHEMA, Artifact, Claim, Draft, HashCache, Store
from pipeline.worker import PartResult, PartTask, Reuse, log_file


class RunConfig(Section):
    """The engine's own part of the config; everything here is outside keys."""

    system: str = "renderformer"
    stage: tuple[str, ...] = Field(min_length=1)  # what to make; what it reads is made first where it is missing
    seed: int = 0  # stages that draw random numbers refer to it
    store: str = "store"
    force: tuple[str, ...] = ()  # stages to compute again although their artifacts exist
    retry: tuple[str, ...] = ()  # stages of whose artifacts only what a crash or a limit rejected is computed again
    plan: bool = False  # print the plan and stop
    workers: int | Literal["auto"] = Field("auto")  # worker processes; auto: one per core; 0: none, in this process
    jobs: int | None = Field(None, ge=1)  # of a sweep at a time, each in a process of its own; None: one by one in this one
    debug: bool = False  # tracebacks instead of one-line errors
    executor: Executor = LocalExecutor()  # where parts are made


def split_config(root: Mapping[str, Any]) -> tuple[RunConfig, System, dict[str, Any]]:
    """The composed config as (the engine's part, the system, stage name -> its section)."""
    engine = {name: value for name, value in root.items() if name in RunConfig.model_fields}
    for name in ("stage", "force", "retry"):
        if name in engine:
            value = engine[name]
            engine[name] = value.split(",") if isinstance(value, str) else value or []
    if "executor" in engine:
        engine["executor"] = parse(Executor, engine["executor"], "executor")
    run = parse(RunConfig, engine, "config")
    system = load_system(run.system)
    known = {*RunConfig.model_fields, *system.modules, *system.groups}
    for name in root:
        if name not in known:
            raise UserError(f"{name} is unknown{nearest(name, known)}")
    for name in (*run.stage, *run.force, *run.retry):
        system.stage(name)
    return run, system, {name: root[name] for name in root if name in system.modules}


@dataclass(frozen=True)
class Planned:
    """One stage of a plan: its config, its key and what the key is the hash of."""

    name: str
    stage: Stage
    config: StageConfig
    key: str
    preimage: Mapping[str, Any]


def make_plan(
    run: RunConfig, system: System, sections: Mapping[str, Any], hash_file: Callable[[Any], str]
) -> dict[str, Planned]:
    """Name -> planned stage, in running order. Every key is known here, before anything runs."""
    plan: dict[str, Planned] = {}
    for name in system.upstream(run.stage):
        stage = system.stage(name)
        if name not in sections:
            raise UserError(f"the config has no section {name!r} for the stage of that name")
        config = parse(stage.Config, sections[name], name)
        plan[name] = plan_stage(stage, config, {parent: plan[parent].key for parent in stage.reads(config)}, hash_file)
    return plan


def plan_stage(stage: Stage, config: StageConfig, inputs: Mapping[str, str], hash_file: Callable[[Any], str]) -> Planned:
    """The stage with this config and input keys, and with the key that they give."""
    params = canonical(config, stage.name)
    identity = stage.identity(config, hash_file)
    if identity:
        params = {**params, "identity": canonical(identity, f"{stage.name}.identity")}
    preimage = {
        "scheme": SCHEME, "stage": stage.name, "version": stage.version, "params": params, "inputs": dict(inputs),
    }  # fmt: skip
    return Planned(stage.name, stage, config, digest_of(preimage), preimage)


def without_counts(config: BaseModel, params: Mapping[str, Any]) -> dict[str, Any]:
    """``params`` less the fields that only say how many items there are (``pipeline.config.count``)."""
    fields = type(config).model_fields
    counts = {
        name
        for name, field in fields.items()
        if isinstance(field.json_schema_extra, dict) and field.json_schema_extra.get("count")
    }
    return {name: value for name, value in params.items() if name not in counts}


def base_key(planned: Planned) -> str:
    """What an item of the stage is, apart from its id and its inputs: shared by artifacts that differ only in items."""
    params = without_counts(planned.config, planned.preimage["params"])
    if "identity" in params:
        params["identity"] = {name: value for name, value in params["identity"].items() if name != "items"}
    return digest_of({**planned.preimage, "params": params, "inputs": {}})


def item_keys(planned: Planned, items: Sequence[Item], inputs: Mapping[str, Artifact]) -> list[str]:
    """One key per item: the stage without counts, the item's id and source, the digests of the records that it needs."""
    base = base_key(planned)
    sources = planned.preimage["params"].get("identity", {}).get("items", {})
    whole = {name: artifact.key for name, artifact in inputs.items()}
    keys = []
    for item in items:
        needs: Any = whole
        if item.needs is not None:
            needs = [[name, record, inputs[name].digest_of(record)] for name, record in item.needs]
        keys.append(digest_of_plain({"base": base, "item": item.id, "source": sources.get(item.id), "needs": needs}))
    return keys


def run_pipeline(root: Mapping[str, Any], command: Sequence[str], out: Callable[[str], None] = print) -> dict[str, Any]:
    """Make the artifacts that ``root`` (the composed config as plain containers) asks for.

    Returns stage name -> artifact (None for a stage that was not needed) with the keys of the plan under ``keys``.
    """
    run, system, sections = split_config(root)
    store = Store(run.store)
    hashes = HashCache(store.root / ".cache" / "hashes.json")
    plan = make_plan(run, system, sections, hashes)
    hashes.save()
    for setting, names in (("force", run.force), ("retry", run.retry)):
        for name in names:
            if name not in plan:
                raise UserError(f"{setting}={name}: the stage is not among those that stage={','.join(run.stage)} needs")
    artifacts: dict[str, Artifact | None] = {}
    damaged: dict[str, Damaged] = {}
    for name, planned in plan.items():
        try:
            artifacts[name] = store.find(name, planned.key)
            if artifacts[name] is not None and not run.plan:
                store.touch(planned.key)  # not only at its turn, which may be days away: gc must know
        except Damaged as error:
            artifacts[name], damaged[name] = None, error
    run = run.model_copy(update={"retry": tuple(name for name in run.retry if _machine_rejects(artifacts[name]))})
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
                    out(f"{_label(system, name)} to make   key {planned.key[:12]}")
                    for line in planned.stage.estimate(planned.config, {other: plan[other].config for other in plan}):
                        out(f"      {line}")
                else:
                    inputs = {parent: artifacts[parent] for parent in planned.stage.reads(planned.config)}
                    assert all(inputs.values())
                    rest = [other for other in plan if other in todo]
                    artifacts[name] = make_artifact(run, system, planned, inputs, store, command, out, rest, cluster)  # type: ignore[arg-type]
            elif artifact is not None:
                store.touch(artifact.key)
                out(f"{_label(system, name)} up to date {_describe(artifact)}")
                for line in _note_rejects(artifact, command):
                    out(line)
                if artifact.codes != [code_digest(system, name)]:
                    out(f"   note: the code of {name} has changed since, its version has not (force={name} recomputes)")
            else:
                out(f"{_label(system, name)} not needed key {planned.key[:12]}")
    for name in run.stage:
        artifact = artifacts[name]
        headline = plan[name].stage.headline
        if artifact is not None and headline and not run.plan:
            out(f"{headline}: {artifact.file(headline)}")
    return {"artifacts": artifacts, "keys": {name: planned.key for name, planned in plan.items()}}


def _follow(plan: Mapping[str, Planned], todo: set[str], store: Store) -> dict[str, Any]:
    """What a process does that another one leads: its part of run stages, once what they read has been made."""

    def made(name: str) -> Artifact:
        while (artifact := store.find(name, plan[name].key)) is None:
            time.sleep(0.5)
        return artifact

    for name, planned in plan.items():
        if name in todo and isinstance(planned.stage, RunStage):
            planned.stage.follow(planned.config, {parent: made(parent) for parent in planned.stage.inputs})
    return {"artifacts": {}, "keys": {name: planned.key for name, planned in plan.items()}}


def _todo(run: RunConfig, plan: Mapping[str, Planned], artifacts: Mapping[str, Artifact | None]) -> set[str]:
    """Stages to compute: targets that are missing, what they lack upstream, and what is forced."""
    todo: set[str] = set()

    again = {*run.force, *run.retry}

    def need(name: str) -> None:
        if name in todo or (artifacts[name] is not None and name not in again):
            return
        todo.add(name)
        for parent in plan[name].stage.reads(plan[name].config):
            need(parent)

    for name in (*again, *run.stage):
        need(name)
    return todo


def _machine_rejects(artifact: Artifact | None) -> list[dict[str, Any]]:
    """Rejects of the artifact that are the machine's doing; its listing is read only where there may be any."""
    if artifact is None or not artifact.manifest["outputs"]["rejects"].keys() & set(REASONS):
        return []
    return [reject for reject in artifact.rejects() if reject.get("machine")]


def _note_rejects(artifact: Artifact, command: Sequence[str]) -> Iterator[str]:
    """Says of machine rejects what to do: an undisturbed run would have made records of them."""
    try:
        rejects = _machine_rejects(artifact)
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


def _label(system: System, name: str) -> str:
    return f"{system.number(name):02} {name:<10}"


def _describe(artifact: Artifact) -> str:
    outputs = artifact.manifest["outputs"]
    text = f"{artifact.stage}/{artifact.path.name}"
    if outputs["items"]:
        rejects = sum(outputs["rejects"].values())
        text += f"  {outputs['records']} records" + (f", {rejects} rejected" if rejects else "")
    return text


def make_artifact(
    run: RunConfig,
    system: System,
    planned: Planned,
    inputs: Mapping[str, Artifact],
    store: Store,
    command: Sequence[str],
    out: Callable[[str], None],
    plan: Sequence[str] = (),
    cluster: Cluster | None = None,
    adopt: Callable[[Draft], None] | None = None,
) -> Artifact:
    """Compute one artifact and commit it. ``plan``: the whole run's stages, for its state; ``adopt`` fills a repair's draft."""
    name, key = planned.name, planned.key
    forced, retried = name in run.force, name in run.retry
    claim = store.claim(name, key)
    draft_path = store.draft_path(name, key)
    state: RunState | None = None
    began = time.monotonic()
    try:
        made = _take(claim, store, planned, forced, lambda text: out(f"{_label(system, name)} {text}"))
        if made is not None and not (retried and _machine_rejects(made)):
            return made

        def say(text: str) -> None:
            if state is not None:
                state.update(line=text)
            out(text)

        origin = {"system": run.system, "config": planned.config.model_dump(mode="json")}
        code = code_digest(system, name)
        purpose = "repair" if adopt is not None else "force" if forced else "make"
        draft = store.draft(name, key, planned.preimage, say, origin, purpose, code)
        draft.sweep()
        state = RunState(draft.path, command=shlex.join(command), plan=list(plan))
        started = time.time()
        old_digest = _digest_of(store, name, key)
        if adopt is not None:
            adopt(draft)
        if made is not None and draft.environment() is None:
            draft.set_environment(made.manifest["environment"])  # its records are taken over
        environment = draft.environment()
        if cluster is not None and isinstance(planned.stage, MapStage):
            environment = cluster.environment(run.system, name, planned.config, environment)
        else:
            environment = planned.stage.environment(planned.config, environment)
        draft.set_environment(environment)
        if isinstance(planned.stage, MapStage):
            products: list[str] = []
            _run_map(run, system, planned, planned.stage, inputs, environment, store, cluster, draft, forced, out, state)
        else:
            assert isinstance(planned.stage, RunStage)
            out(f"{_label(system, name)} running    {planned.stage.slug(planned.config)}-{key[:12]}")
            products = planned.stage.run(planned.config, inputs, draft)
            draft.use_parts([])
        others = [other for other in draft.codes() if other != code]
        manifest = {
            "schema": SCHEMA,
            "key": key,
            "preimage": planned.preimage,
            "base_key": base_key(planned),
            **origin,
            "code": {"digest": code, **commit(), **({"others": others} if others else {})},
            "environment": environment,
            "machine": machine(system.packages),
            "outputs": draft.outputs(products),
            "summary": draft.summary,
            "command": shlex.join(command),
            "started": started,
            "finished": time.time(),
            "seconds": time.monotonic() - began,
        }
        artifact = store.commit(draft, planned.stage.slug(planned.config), manifest, replace=forced or retried)
    except BaseException as error:
        if not (draft_path / DRAFT).exists() and isinstance(error, Exception) and not (forced or retried):
            made = store.find(name, key)
            if made is not None:  # another process took the claim from us, and was faster
                shutil.rmtree(draft_path, ignore_errors=True)
                out(f"{_label(system, name)} done       {_describe(made)}  by another process meanwhile")
                return made
        if isinstance(error, OSError) and (error.errno in STORAGE_ERRORS or str(error.filename).startswith(f"{store.root}/")):
            where = f" ({error.filename})" if error.filename else ""
            remedy = "make room or mend the disk, and" if error.errno in STORAGE_ERRORS else "--debug says who asked for it;"
            error = MachineError(
                f"{name}: the store at {store.root} cannot be read or written: {error.strerror}{where}. Finished parts are "
                f"kept: {remedy} run the same command again"
            )
        if isinstance(error, Exception) and not for_people(error):
            error.add_note(f"in stage {name} ({draft_path})")
        if state is not None:
            with contextlib.suppress(OSError):
                draft.sweep()  # on a full disk it is room to go on with
            interrupted = isinstance(error, KeyboardInterrupt)
            message = "interrupted" if interrupted else str(error) if for_people(error) else repr(error)
            state.end(INTERRUPTED if interrupted else status_of(error), message)
        raise error
    finally:
        claim.release()
    verdict = ""
    if (forced or retried) and old_digest is not None:
        verdict = "  equal to before" if artifact.digest == old_digest else "  DIFFERENT from before"
        if artifact.digest != old_digest:
            verdict += f" ({old_digest[:12]} is now {artifact.digest[:12]}); later stages still hold what was made from the old"
    out(f"{_label(system, name)} done       {_describe(artifact)}  in {duration(time.monotonic() - began)}{verdict}")
    return artifact


def _take(claim: Claim, store: Store, planned: Planned, forced: bool, say: Callable[[str], None]) -> Artifact | None:
    """Wait for the claim. Returns the artifact if another process has made it by then."""
    told = False
    while not claim.take():
        if not told and (holder := claim.holder()) is not None:
            say(f"waiting: process {holder['pid']} on {holder['host']} is making {planned.key[:12]}")
            told = True
        time.sleep(0.5)
    return None if forced else store.find(planned.name, planned.key)


def _digest_of(store: Store, stage: str, key: str) -> str | None:
    """The digest of the artifact that is about to be replaced, if it is there and can still say so."""
    try:
        previous = store.find(stage, key)
    except Damaged:
        return None
    return previous.digest if previous else None


def _parts(items: Sequence[Item], keys: Sequence[str], size: int) -> Iterator[tuple[str, list[int]]]:
    """(group, indices) of each part: at most ``size`` items of one group, independent of workers."""
    chunk: list[int] = []
    for index, item in enumerate(items):
        if chunk and (len(chunk) == size or items[chunk[0]].group != item.group):
            yield items[chunk[0]].group, chunk
            chunk = []
        chunk.append(index)
    if chunk:
        yield items[chunk[0]].group, chunk


@contextlib.contextmanager
def _without_gc() -> Iterator[None]:
    """Lists of a million items are no garbage, and looking through them again as they grow takes a tenth of a resume."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _run_map(
    run: RunConfig,
    system: System,
    planned: Planned,
    stage: MapStage,
    inputs: Mapping[str, Artifact],
    environment: dict[str, Any],
    store: Store,
    cluster: Cluster | None,
    draft: Draft,
    forced: bool,
    out: Callable[[str], None],
    state: RunState,
) -> None:
    config = planned.config
    with _without_gc():
        items = sorted(stage.items(config, inputs), key=lambda item: (item.group, item.id))
        if len({item.id for item in items}) != len(items):
            raise AssertionError(f"{planned.name} lists an item twice")
        keys = item_keys(planned, items, inputs)
        donors = {} if forced else _donations(planned, store, environment, keys, draft)
        parts: dict[str, tuple[str, tuple[Item, ...], tuple[str, ...]]] = {}
        for group, indices in _parts(items, keys, stage.part_size(config, inputs)):
            part_item_keys = tuple(keys[index] for index in indices)
            part_key = digest_of({"group": group, "items": part_item_keys})
            parts[part_key] = group, tuple(items[index] for index in indices), part_item_keys
        markers, damaged = draft.sound_markers(
            {key: [item.id for item in part_items] for key, (_, part_items, _) in parts.items()}
        )
        limits = Limits(**{**stage.limits, **config.limits.model_dump(exclude_none=True)})
        tasks: list[PartTask] = []
        fresh: dict[str, int] = {}  # part key -> items to compute
        total, again = len(items), 0
        for part_key, (group, part_items, part_item_keys) in parts.items():
            marker = markers[part_key]
            allowed = {reject["item"] for reject in marker["rejects"] if limits.exceed(reject)} if marker is not None else set()
            if marker is not None and not allowed:
                state.add_rejects(Counter(reject["reason"] for reject in marker["rejects"]))
                continue
            again += len(allowed)
            wanted = zip(part_items, part_item_keys, strict=True)
            reuse = {
                item.id: donors[item_key]
                for item, item_key in wanted
                if item_key in donors and (not allowed or item.id in allowed)
            }
            fresh[part_key] = len(allowed or part_items) - len(reuse)
            tasks.append(
                PartTask(
                    run.system, planned.name, planned.key, config, inputs, environment, draft.path,
                    part_key, group, part_items, part_item_keys, reuse, limits=limits,
                )
            )  # fmt: skip
    part_keys = list(parts)
    # There may be millions, and workers and what follows need the room; what is to be made is in the tasks.
    del items, keys, donors, parts, markers
    reused = total - sum(fresh.values())
    if not forced:
        sources: dict[Path, _Source] = {}
        tasks = [task for task in tasks if not _link_whole(task, sources, draft)]
    label = _label(system, planned.name)
    if again:
        out(f"{label} {again} item(s) that lower limits rejected before are tried again")
    if damaged:
        out(f"{label} {damaged} finished part(s) of the interrupted run are damaged and made again")
    out(f"{label} running    {total} items" + (f", {reused} of them already there" if reused else ""))
    progress = Progress(f"{label}", total, reused)
    failed: list[tuple[str, str, Path]] = []
    state.update(now=True, parts=len(part_keys), total=total, reused=reused, done=reused)

    def on_result(result: PartResult) -> None:
        log = log_file(draft.path, result.part_key)
        for item, trace in result.failed:
            failed.append((item, trace, log))
            state.add_failure(item, trace, log)
        progress.add(fresh[result.part_key] if not result.failed else 0, sum(result.rejects.values()))
        state.add_rejects(result.rejects)
        state.update(now=bool(result.failed), done=progress.done)

    workers = config.workers if config.workers is not None else run.workers
    cores = os.cpu_count() or 1
    workers = cores if workers == "auto" else workers
    limit = stage.max_workers(config, environment)
    workers = min(workers, limit) if limit is not None else workers
    workers = min(workers, len(tasks)) if workers else 0
    if tasks:
        try:
            if cluster is not None:
                cluster.run_parts(tasks, limits, on_result, progress.log)
            else:
                run_parts(tasks, workers, max(1, cores // max(workers, 1)), limits, on_result, progress.log)
        finally:
            progress.close()
    if failed:
        item, trace, log = failed[0]
        last = trace.strip().splitlines()[-1]
        names = ", ".join(item for item, _, _ in failed[:8]) + (", ..." if len(failed) > 8 else "")
        raise ItemsFailed(
            f"{planned.name}: {len(failed)} item(s) failed: {names}. The first: {last}. Its traceback: {log} "
            "(`lightmill status` names the others'). Everything else is kept; run again to continue"
        )
    draft.use_parts(_finished(planned.name, draft, part_keys))
    _check_rejects(planned, stage, draft, total)
    for path in sorted(draft.files.rglob("*"), reverse=True):  # what an interrupted finish left
        path.unlink() if path.is_file() else path.rmdir()
    stage.finish(config, inputs, draft)
    stage.check(draft)


def _finished(name: str, draft: Draft, part_keys: Iterable[str]) -> Iterator[dict[str, Any]]:
    for part_key in part_keys:
        marker = draft.marker(part_key)
        if marker is None:
            raise MachineError(f"{name}: finished part {part_key[:12]} vanished from {draft.path}: run again")
        yield marker


def _check_rejects(planned: Planned, stage: MapStage, draft: Draft, total: int) -> None:
    rejects = draft.rejects()
    counts: dict[str, int] = {}
    for reject in rejects:
        counts[reject["reason"]] = counts.get(reject["reason"], 0) + 1
    if total and len(rejects) / total > planned.config.max_reject_share:
        listed = ", ".join(f"{count} {reason}" for reason, count in sorted(counts.items()))
        first = rejects[0]
        raise TooManyRejects(
            f"{planned.name}: {len(rejects)} of {total} items were rejected ({listed}), more than max_reject_share="
            f"{planned.config.max_reject_share:g}. For example {first['item']}: {first['reason']}: {first['detail']}"
        )


def _donations(
    planned: Planned, store: Store, environment: Mapping[str, Any], keys: Sequence[str], draft: Draft
) -> dict[str, Reuse]:
    """Item key -> where an earlier artifact of the same stage holds that item."""
    base = base_key(planned)
    found: dict[str, Reuse] = {}
    codes: dict[Path | None, list[str]] = {None: []}
    wanted: set[str] = set()
    for artifact in store.artifacts(planned.name):
        manifest = artifact.manifest
        if manifest["base_key"] != base or manifest["environment"] != environment:
            continue
        try:
            artifact.rows(), artifact.rejects()
        except Damaged:  # it gives nothing, and is no input of ours
            continue
        wanted = wanted or set(keys)
        codes[artifact.path] = artifact.codes
        for item_key, rows in itertools.groupby(artifact.rows(), key=lambda row: row.item_key):  # an item's rows are neighbours
            if item_key in wanted:
                found[item_key] = Reuse(artifact.path, tuple(row.id for row in rows))
        for reject in artifact.rejects():
            if reject.get("item_key") in wanted and not reject.get("machine"):
                found[reject["item_key"]] = Reuse(reject=reject)
    givers = {reuse.artifact for reuse in found.values()}
    draft.made_by(
        itertools.chain.from_iterable(codes[path] for path in givers), "what is taken over from earlier artifacts was"
    )
    return found


class _Source:
    """An earlier artifact whose parts may be taken over whole."""

    def __init__(self, path: Path):
        self.artifact = Artifact(path)
        self.parts = {part["part_key"]: part for part in self.artifact.manifest["outputs"]["parts"]}
        self.rejects = {reject["item"]: reject for reject in self.artifact.rejects() if not reject.get("whole")}
        self.spans: dict[str, list[int]] = {}  # part's digest -> its first row and the one after its last
        for number, row in enumerate(self.artifact.rows()):
            self.spans.setdefault(row.part, [number, number])[1] = number + 1


def _link_whole(task: PartTask, sources: dict[Path, _Source], draft: Draft) -> bool:
    """Take over the whole part by hard link where one artifact holds exactly these items as one part."""
    if len(task.reuse) < len(task.items):
        return False
    path = next((reuse.artifact for reuse in task.reuse.values() if reuse.artifact is not None), None)
    if path is None:
        return False
    source = sources.get(path) or sources.setdefault(path, _Source(path))
    part = source.parts.get(task.part_key)
    if part is None:
        return False
    first, end = source.spans[part["digest"]]
    rows = [row.to_json() for row in source.artifact.rows()[first:end]]
    rejects = [source.rejects[item] for item in part["items"] if item in source.rejects]
    return draft.link_part(source.artifact.part_path(part["digest"]), task.part_key, {**part, "rejects": rejects, "rows": rows})


@cache
def _gpu() -> str | None:
    try:
        query = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
        result = subprocess.run(query, capture_output=True, text=True, timeout=20)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return result.stdout.strip() or None if result.returncode == 0 else None


def machine(packages: Iterable[str]) -> dict[str, Any]:
    """Where an artifact was made: Python, the named packages, the GPU and its driver."""
    versions = {}
    for package in packages:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = None
    return {
        "host": socket.gethostname(),
        "platform": platform.platform(),
        "python": sys.version.split()[0],
        "cores": os.cpu_count(),
        "gpu": _gpu(),
        "packages": versions,
    }
