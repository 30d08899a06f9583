"""From a config to artifacts: plan the keys, run what is missing, commit."""

from __future__ import annotations

import os
import platform
import shlex
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from typing import Any, Literal

from pydantic import BaseModel, Field

from pipeline.code import code_digest, commit
from pipeline.config import Limits, Section, StageConfig, nearest, parse
from pipeline.errors import UserError
from pipeline.executor import run_parts
from pipeline.keys import SCHEME, canonical, digest_of
from pipeline.progress import Progress, duration
from pipeline.stage import Item, MapStage, RunStage, Stage, System, load_system
from pipeline.store import SCHEMA, Artifact, Draft, HashCache, Store
from pipeline.worker import PartResult, PartTask, Reuse


class RunConfig(Section):
    """The engine's own part of the config; everything here is outside keys."""

    system: str = "renderformer"
    stage: tuple[str, ...] = Field(min_length=1)  # what to make; what it reads is made first where it is missing
    seed: int = 0  # stages that draw random numbers refer to it
    store: str = "store"
    force: tuple[str, ...] = ()  # stages to compute again although their artifacts exist
    plan: bool = False  # print the plan and stop
    workers: int | Literal["auto"] = Field("auto")  # worker processes; auto: one per core; 0: none, in this process
    jobs: int | None = Field(None, ge=1)  # of a sweep at a time, each in a process of its own; None: one by one in this one
    debug: bool = False  # tracebacks instead of one-line errors


def split_config(root: Mapping[str, Any]) -> tuple[RunConfig, System, dict[str, Any]]:
    """The composed config as (the engine's part, the system, stage name -> its section)."""
    engine = {name: value for name, value in root.items() if name in RunConfig.model_fields}
    for name in ("stage", "force"):
        if name in engine:
            value = engine[name]
            engine[name] = value.split(",") if isinstance(value, str) else value or []
    run = parse(RunConfig, engine, "config")
    system = load_system(run.system)
    known = {*RunConfig.model_fields, *system.modules, *system.groups}
    for name in root:
        if name not in known:
            raise UserError(f"{name} is unknown{nearest(name, known)}")
    for name in (*run.stage, *run.force):
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
        params = canonical(config, name)
        identity = stage.identity(config, hash_file)
        if identity:
            params = {**params, "identity": canonical(identity, f"{name}.identity")}
        preimage = {
            "scheme": SCHEME,
            "stage": name,
            "version": stage.version,
            "params": params,
            "inputs": {parent: plan[parent].key for parent in stage.reads(config)},
        }
        plan[name] = Planned(name, stage, config, digest_of(preimage), preimage)
    return plan


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
            needs = [[name, record, inputs[name].row(record).digest] for name, record in item.needs]
        keys.append(digest_of({"base": base, "item": item.id, "source": sources.get(item.id), "needs": needs}))
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
    for name in run.force:
        if name not in plan:
            raise UserError(f"force={name}: the stage is not among those that stage={','.join(run.stage)} needs")
    artifacts: dict[str, Artifact | None] = {name: store.find(name, planned.key) for name, planned in plan.items()}
    todo = _todo(run, plan, artifacts)
    if int(os.environ.get("WORLD_SIZE", "1")) > 1 and run.force:
        raise UserError(f"force={','.join(run.force)} needs a process of its own: run it without torchrun")
    if int(os.environ.get("RANK", "0")) > 0 and not run.plan:  # one of several processes that torchrun started
        return _follow(plan, todo, store)
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
                artifacts[name] = _make(run, system, planned, inputs, store, command, out)  # type: ignore[arg-type]
        elif artifact is not None:
            store.touch(artifact.key)
            out(f"{_label(system, name)} up to date {_describe(artifact)}")
            if artifact.manifest["code"]["digest"] != code_digest(system, name):
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

    def need(name: str, forced: bool) -> None:
        if name in todo or (artifacts[name] is not None and not forced):
            return
        todo.add(name)
        for parent in plan[name].stage.reads(plan[name].config):
            need(parent, parent in run.force)

    for name in (*run.force, *run.stage):
        need(name, name in run.force)
    return todo


def _label(system: System, name: str) -> str:
    return f"{system.number(name):02} {name:<10}"


def _describe(artifact: Artifact) -> str:
    outputs = artifact.manifest["outputs"]
    text = f"{artifact.stage}/{artifact.path.name}"
    if outputs["items"]:
        rejects = sum(outputs["rejects"].values())
        text += f"  {outputs['records']} records" + (f", {rejects} rejected" if rejects else "")
    return text


def _make(
    run: RunConfig,
    system: System,
    planned: Planned,
    inputs: Mapping[str, Artifact],
    store: Store,
    command: Sequence[str],
    out: Callable[[str], None],
) -> Artifact:
    """Compute one artifact and commit it."""
    name, key = planned.name, planned.key
    forced = name in run.force
    claim = store.claim(name, key)
    told = False
    while (holder := claim.holder()) is not None:
        if not told:
            out(f"{_label(system, name)} waiting: process {holder['pid']} on {holder['host']} is making {key[:12]}")
            told = True
        time.sleep(1.0)
        existing = store.find(name, key)
        if existing is not None and not forced:
            return existing
    draft = store.draft(name, key, planned.preimage, out)
    claim.take()
    try:
        started = time.time()
        previous = store.find(name, key)
        old_digest = previous.digest if previous else None
        environment = draft.environment()
        environment = planned.stage.environment(planned.config, environment)
        draft.set_environment(environment)
        if isinstance(planned.stage, MapStage):
            products: list[str] = []
            _run_map(run, system, planned, planned.stage, inputs, environment, store, draft, forced, out)
        else:
            assert isinstance(planned.stage, RunStage)
            out(f"{_label(system, name)} running    {planned.stage.slug(planned.config)}-{key[:12]}")
            products = planned.stage.run(planned.config, inputs, draft)
            draft.use_parts([])
        manifest = {
            "schema": SCHEMA,
            "key": key,
            "preimage": planned.preimage,
            "base_key": base_key(planned),
            "code": {"digest": code_digest(system, name), **commit()},
            "environment": environment,
            "machine": machine(system.packages),
            "outputs": draft.outputs(products),
            "summary": draft.summary,
            "command": shlex.join(command),
            "started": started,
            "finished": time.time(),
        }
        artifact = store.commit(draft, planned.stage.slug(planned.config), manifest, replace=forced)
    except OSError as error:
        if error.errno in (28, 30, 122):  # no space, read-only, quota
            raise UserError(f"{name}: {error.strerror} at {error.filename}; finished parts are kept, run again") from None
        raise
    finally:
        claim.release()
    verdict = ""
    if forced and old_digest is not None:
        verdict = "  equal to before" if artifact.digest == old_digest else "  DIFFERENT from before"
        if artifact.digest != old_digest:
            verdict += f" ({old_digest[:12]} is now {artifact.digest[:12]}); later stages still hold what was made from the old"
    out(f"{_label(system, name)} done       {_describe(artifact)}  in {duration(time.time() - started)}{verdict}")
    return artifact


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


def _run_map(
    run: RunConfig,
    system: System,
    planned: Planned,
    stage: MapStage,
    inputs: Mapping[str, Artifact],
    environment: dict[str, Any],
    store: Store,
    draft: Draft,
    forced: bool,
    out: Callable[[str], None],
) -> None:
    config = planned.config
    items = sorted(stage.items(config, inputs), key=lambda item: (item.group, item.id))
    if len({item.id for item in items}) != len(items):
        raise AssertionError(f"{planned.name} lists an item twice")
    keys = item_keys(planned, items, inputs)
    donors = {} if forced else _donations(planned, store, environment, set(keys))
    markers: dict[str, dict[str, Any] | None] = {}
    tasks: list[PartTask] = []
    total, reused = len(items), 0
    for group, indices in _parts(items, keys, stage.part_size(config, inputs)):
        part_items = tuple(items[index] for index in indices)
        part_item_keys = tuple(keys[index] for index in indices)
        part_key = digest_of({"group": group, "items": part_item_keys})
        markers[part_key] = draft.marker(part_key)
        if markers[part_key] is not None:
            reused += len(part_items)
            continue
        reuse = {
            item.id: donors[item_key] for item, item_key in zip(part_items, part_item_keys, strict=True) if item_key in donors
        }
        reused += len(reuse)
        tasks.append(
            PartTask(
                run.system, planned.name, planned.key, config, inputs, environment, draft.path,
                part_key, group, part_items, part_item_keys, reuse,
            )
        )  # fmt: skip
    if not forced:
        tasks = [task for task in tasks if not _link_whole(task, store, draft)]
    label = _label(system, planned.name)
    out(f"{label} running    {total} items" + (f", {reused} of them already there" if reused else ""))
    progress = Progress(f"{label}", total, reused)
    failed: list[tuple[str, str]] = []
    fresh = {task.part_key: len(task.items) - len(task.reuse) for task in tasks}

    def on_result(result: PartResult) -> None:
        failed.extend(result.failed)
        progress.add(fresh[result.part_key] if not result.failed else 0, result.rejects)

    limits = parse(Limits, {**stage.limits, **config.limits}, f"{planned.name}.limits")
    workers = config.workers if config.workers is not None else run.workers
    cores = os.cpu_count() or 1
    workers = cores if workers == "auto" else workers
    limit = stage.max_workers(config, environment)
    workers = min(workers, limit) if limit is not None else workers
    workers = min(workers, len(tasks)) if workers else 0
    if tasks:
        try:
            run_parts(tasks, workers, max(1, cores // max(workers, 1)), limits, on_result, progress.log)
        finally:
            progress.close()
    if failed:
        (draft.logs / "failures.log").write_text("\n".join(f"{item}\n{trace}" for item, trace in failed))
        item, trace = failed[0]
        last = trace.strip().splitlines()[-1]
        names = ", ".join(item for item, _ in failed[:8]) + (", ..." if len(failed) > 8 else "")
        raise UserError(
            f"{planned.name}: {len(failed)} item(s) failed: {names}. The first: {last}. "
            f"Tracebacks: {draft.logs / 'failures.log'}. Everything else is kept; run again to continue"
        )
    draft.use_parts([draft.marker(part_key) for part_key in markers])  # type: ignore[misc]
    _check_rejects(planned, stage, draft, total)
    for path in sorted(draft.files.rglob("*"), reverse=True):  # what an interrupted finish left
        path.unlink() if path.is_file() else path.rmdir()
    stage.finish(config, inputs, draft)
    stage.check(draft)


def _check_rejects(planned: Planned, stage: MapStage, draft: Draft, total: int) -> None:
    rejects = draft.rejects()
    counts: dict[str, int] = {}
    for reject in rejects:
        counts[reject["reason"]] = counts.get(reject["reason"], 0) + 1
    if total and len(rejects) / total > planned.config.max_reject_share:
        listed = ", ".join(f"{count} {reason}" for reason, count in sorted(counts.items()))
        first = rejects[0]
        raise UserError(
            f"{planned.name}: {len(rejects)} of {total} items were rejected ({listed}), more than max_reject_share="
            f"{planned.config.max_reject_share:g}. For example {first['item']}: {first['reason']}: {first['detail']}"
        )


def _donations(planned: Planned, store: Store, environment: Mapping[str, Any], wanted: set[str]) -> dict[str, Reuse]:
    """Item key -> where an earlier artifact of the same stage holds that item."""
    base = base_key(planned)
    found: dict[str, Reuse] = {}
    for artifact in store.artifacts(planned.name):
        manifest = artifact.manifest
        if manifest["base_key"] != base or manifest["environment"] != environment:
            continue
        rows: dict[str, list[Any]] = {}
        for row in artifact.rows():
            if row.item_key in wanted:
                rows.setdefault(row.item_key, []).append(row)
        found.update({key: Reuse(artifact.path, tuple(group)) for key, group in rows.items()})
        for reject in artifact.rejects():
            if reject.get("item_key") in wanted and not reject.get("machine"):
                found[reject["item_key"]] = Reuse(reject=reject)
    return found


def _link_whole(task: PartTask, store: Store, draft: Draft) -> bool:
    """Take over the whole part by hard link where one artifact holds exactly these items as one part."""
    if len(task.reuse) < len(task.items):
        return False
    source = next((reuse.artifact for reuse in task.reuse.values() if reuse.artifact is not None), None)
    if source is None:
        return False
    artifact = Artifact(source)
    for part in artifact.manifest["outputs"]["parts"]:
        if part["part_key"] == task.part_key:
            rejects = [r for r in artifact.rejects() if r["item"] in set(part["items"]) and not r.get("whole")]
            rows = [row.to_json() for row in artifact.rows() if row.part == part["digest"]]
            draft.link_part(artifact.part_path(part["digest"]), task.part_key, {**part, "rejects": rejects, "rows": rows})
            return True
    return False


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
