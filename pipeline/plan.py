"""Plan a run: the engine's part of the config, and the key of every stage before anything runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import BaseModel, Field

from pipeline.cluster import Executor, LocalExecutor
from pipeline.config import Section, StageConfig, nearest, parse
from pipeline.errors import UserError
from pipeline.keys import LEGACY_SYSTEM, SCHEME, canonical, digest_of, digest_of_plain
from pipeline.stage import Item, Stage, System, load_system
from pipeline.store import Artifact, HashCache, Store, place


class RunConfig(Section):
    """The engine's own part of the config; everything here is outside keys."""

    system: str = LEGACY_SYSTEM
    stage: tuple[str, ...] = Field(min_length=1)  # what to make, stages or targets; what they read comes first
    seed: int = 0  # stages that draw random numbers refer to it
    store: str = "store"
    force: tuple[str, ...] = ()  # stages to compute again although their artifacts exist
    retry: tuple[str, ...] = ()  # stages to run again for the items that crashed or hit a limit
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
    names = {*RunConfig.model_fields, *system.modules, *system.groups}
    for name in root:
        if name not in names:
            raise UserError(f"{name} is unknown{nearest(name, names)}")
    stages = [stage for name in run.stage for stage in system.targets.get(name, (name,))]
    run = run.model_copy(update={"stage": tuple(dict.fromkeys(stages))})
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

    @property
    def place(self) -> str:
        """The folder of the store where such artifacts lie (``pipeline.store.place``)."""
        return place(self.preimage)

    @property
    def parents(self) -> dict[str, str]:
        """Role -> the stage that plays it, of what this config reads."""
        return self.stage.parents(self.config)

    def inputs(self, artifacts: Mapping[str, Any]) -> dict[str, Any]:
        """Role -> what ``artifacts`` holds for the stage that plays it."""
        return {role: artifacts[parent] for role, parent in self.parents.items()}


def make_plan(
    run: RunConfig, system: System, sections: Mapping[str, Any], hash_file: Callable[[Any], str]
) -> dict[str, Planned]:
    """Stage name -> planned stage, each after what it reads. Every key is known here, before anything runs."""
    plan: dict[str, Planned] = {}

    def visit(name: str, path: tuple[str, ...]) -> None:
        if name in path:
            raise AssertionError(f"stages form a cycle: {' -> '.join((*path, name))}")
        if name in plan:
            return
        stage = system.stage(name)
        if name not in sections:
            raise UserError(f"the config has no section {name!r} for the stage of that name")
        config = parse(stage.Config, sections[name], name)
        parents = stage.parents(config)
        for parent in parents.values():
            visit(parent, (*path, name))
        keys = {role: plan[parent].key for role, parent in parents.items()}
        plan[name] = plan_stage(system.name, stage, config, keys, hash_file)

    for name in run.stage:
        visit(name, ())
    configs = {name: planned.config for name, planned in plan.items()}
    for planned in plan.values():
        planned.stage.agree(planned.config, configs)
    return plan


@dataclass(frozen=True)
class RunPlan:
    """What a composed config asks for: the engine's settings, the system, and the planned stages by name, in running order."""

    run: RunConfig
    system: System
    stages: Mapping[str, Planned]

    @property
    def keys(self) -> dict[str, str]:
        """Stage name -> key."""
        return {name: planned.key for name, planned in self.stages.items()}


def plan_run(root: Mapping[str, Any]) -> RunPlan:
    """The plan of ``root``, the composed config as plain containers.

    Source files are hashed here. The store remembers their hashes for the next plan.
    """
    run, system, sections = split_config(root)
    with hashes_of(Store(run.store)) as hashes:
        return RunPlan(run, system, make_plan(run, system, sections, hashes))


def plan_stage(
    system: str, stage: Stage, config: StageConfig, inputs: Mapping[str, str], hash_file: Callable[[Any], str]
) -> Planned:
    """The stage of the system with this config and these input keys by role, and with the key that they give."""
    params = canonical(config, stage.name)
    identity = stage.identity(config, hash_file)
    if identity:
        params = {**params, "identity": canonical(identity, f"{stage.name}.identity")}
    preimage = {
        "scheme": SCHEME, "stage": stage.name, "version": stage.version, "params": params, "inputs": dict(inputs),
    }  # fmt: skip
    if system != LEGACY_SYSTEM:
        preimage["system"] = system
    return Planned(stage.name, stage, config, digest_of(preimage), preimage)


def hashes_of(store: Store) -> HashCache:
    """The store's memory of source files' hashes; as a context it is saved at the end."""
    return HashCache(store.root / ".cache" / "hashes.json")


def identity_params(config: BaseModel, params: Mapping[str, Any]) -> dict[str, Any]:
    """``params`` without what no item depends on: how many items there are, and what only ``finish`` reads.

    Those are the fields of ``pipeline.config.count`` and ``pipeline.config.report``.
    """
    extras = {name: field.json_schema_extra for name, field in type(config).model_fields.items()}
    apart = {name for name, extra in extras.items() if isinstance(extra, dict) and (extra.get("count") or extra.get("report"))}
    return {name: value for name, value in params.items() if name not in apart}


def base_key(planned: Planned) -> str:
    """What an item of the stage is, apart from its id and its inputs: shared by artifacts that differ only in items."""
    params = identity_params(planned.config, planned.preimage["params"])
    if "identity" in params:
        params["identity"] = {name: value for name, value in params["identity"].items() if name != "items"}
    return digest_of({**planned.preimage, "params": params, "inputs": {}})


def item_keys(planned: Planned, items: Sequence[Item], inputs: Mapping[str, Artifact]) -> list[str]:
    """One key per item: the stage's identity, the item's id and source, the digests of the records that it needs."""
    base = base_key(planned)
    sources = planned.preimage["params"].get("identity", {}).get("items", {})
    artifact_keys = {name: artifact.key for name, artifact in inputs.items()}
    keys = []
    for item in items:
        needs: Any = artifact_keys
        if item.needs is not None:
            needs = [[name, record, inputs[name].digest_of(record)] for name, record in item.needs]
        keys.append(digest_of_plain({"base": base, "item": item.id, "source": sources.get(item.id), "needs": needs}))
    return keys
