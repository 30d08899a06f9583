"""Plan a run: the engine's part of the config, and the key of every stage before anything runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import BaseModel, Field

from pipeline.cluster import Executor, LocalExecutor
from pipeline.config import Section, StageConfig, nearest, parse
from pipeline.errors import (
    UserError,
)
from pipeline.keys import SCHEME, canonical, digest_of, digest_of_plain
from pipeline.stage import Item, Stage, System, load_system
from pipeline.store import Artifact


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


def label(system: System, name: str) -> str:
    return f"{system.number(name):02} {name:<10}"
