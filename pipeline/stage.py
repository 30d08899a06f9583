"""What a stage is, and what it exchanges with the engine.

A *map* stage turns items into records, in parts that workers make independently; a *run* stage writes files, resumable
from its own checkpoints. Either gets artifacts and returns records or files; it never builds a path in the store.
"""

from __future__ import annotations

import importlib
import importlib.util
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from pipeline.config import StageConfig
from pipeline.errors import Reject, UserError
from pipeline.store.record import Record

if TYPE_CHECKING:
    from pipeline.store import Artifact, Draft


@dataclass(frozen=True, slots=True)
class Item:
    """One unit of a map stage's work.

    ``id`` is stable under more items; ``group`` (a split, say) never shares a part with another group. ``needs`` names the
    input records that the item reads, as (input name, record id); None stands for the inputs as a whole. Items whose
    needs are unchanged are taken over from earlier artifacts when the configuration only asks for more items.
    """

    id: str
    group: str = ""
    needs: tuple[tuple[str, str], ...] | None = None


Inputs = Mapping[str, "Artifact"]


class Stage:
    """Common to both kinds. Subclasses set the class variables; instances hold no state."""

    name: ClassVar[str]
    version: ClassVar[int]  # bump when the same config gives other output
    # What it reads, or may read (see ``reads``): stages, or roles of stages where the two have different names
    inputs: ClassVar[tuple[str, ...] | Mapping[str, str]] = ()
    Config: ClassVar[Any]  # a StageConfig, or a union of them told apart by `name`
    reasons: ClassVar[Mapping[str, str]] = {}  # closed list: reject reason -> what it means
    headline: ClassVar[str | None] = None  # the file under files/ whose path ends a run of this stage (a report)

    @classmethod
    def roles(cls) -> dict[str, str]:
        """Role -> the stage that plays it. Equal names stay short: ``inputs = ("mesh",)``."""
        return dict(cls.inputs) if isinstance(cls.inputs, Mapping) else {name: name for name in cls.inputs}

    def reads(self, config: StageConfig) -> tuple[str, ...]:
        """The roles of ``inputs`` that this config needs: all, unless a stage leaves out what only an option asks for.

        The others enter neither the key nor the run.
        """
        return tuple(self.roles())

    def parents(self, config: StageConfig) -> dict[str, str]:
        """Role -> the stage that plays it, of what this config reads."""
        roles = self.roles()
        return {role: roles[role] for role in self.reads(config)}

    def agree(self, config: StageConfig, configs: Mapping[str, StageConfig]) -> None:
        """Raise UserError where this config does not go with those of the stages before it, by stage name in ``configs``.

        Called for every plan, before anything runs.
        """

    def slug(self, config: StageConfig) -> str:
        """A few letters for people, at the head of the artifact's folder name."""
        return "v" + str(self.version)

    def identity(self, config: StageConfig, hash_file: Callable[[Any], str]) -> dict[str, Any]:
        """What outside the config decides the output: content hashes of local source files, revisions of remote ones.

        Under the name ``items`` it may map item ids to hashes: what only that item depends on. ``hash_file(path)`` is
        cached by path, size, mtime and inode.
        """
        return {}

    def estimate(self, config: StageConfig, configs: Mapping[str, StageConfig]) -> list[str]:
        """Lines for people, shown by ``plan=true``: what the run will cost. ``configs``: those of all stages of the plan."""
        return []

    def environment(self, config: StageConfig, previous: dict[str, Any] | None) -> dict[str, Any]:
        """Runtime choices that one artifact must not mix (a renderer's backend, say), as plain JSON.

        ``previous`` is what an interrupted run of the same artifact chose. Return it if it still works here, else raise
        UserError saying what to do.
        """
        return {}

    def same_environment(self, one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
        """Whether records made in these two environments may be in one artifact."""
        return one == other


class MapStage(Stage):
    """Items in, records out, in parts."""

    limits: ClassVar[Mapping[str, float]] = {}  # of one item, where they differ from pipeline.config.Limits
    open_wall_s: ClassVar[float] = 1800.0  # seconds on the clock that ``open`` may take; no item's limit counts it

    def part_size(self, config: StageConfig, inputs: Inputs) -> int:
        """Items per part, from what the config and the inputs say: independent of the number of workers."""
        return 16

    def max_workers(self, config: StageConfig, environment: dict[str, Any]) -> int | None:
        """At most this many worker processes; None for as many as the run has."""
        return None

    def items(self, config: StageConfig, inputs: Inputs) -> Iterable[Item]:
        """All items: cheap, deterministic. The engine sorts them by (group, id)."""
        raise NotImplementedError

    def open(self, config: StageConfig, inputs: Inputs, environment: dict[str, Any]) -> Any:
        """A worker, built once per process: whatever `process` wants to keep (libraries, models, readers)."""
        raise NotImplementedError

    def prepare(self, config: StageConfig, inputs: Inputs, folder: Path) -> None:
        """Write to ``folder`` what every worker would else compute for itself.

        The runner calls it once, before workers start, and again in a run that continues: overwrite what is there, by an
        atomic rename. The folder is not kept in the artifact.
        """

    def open_prepared(self, config: StageConfig, inputs: Inputs, environment: dict[str, Any], folder: Path) -> Any:
        """The worker, as ``open`` builds it, from what ``prepare`` wrote to ``folder``. Only a stage with both needs it."""
        return self.open(config, inputs, environment)

    def process(self, worker: Any, item: Item) -> Iterator[Record] | Iterable[Record]:
        """The item's records; may raise Reject."""
        raise NotImplementedError

    def finish(self, config: StageConfig, inputs: Inputs, draft: Draft) -> None:
        """Whole-artifact files (catalogue, contact sheets, report) under ``draft.files``."""

    def check(self, draft: Draft) -> None:
        """Invariants before commit; raise UserError or AssertionError to refuse."""


class RunStage(Stage):
    """One long computation that writes files and resumes from its own checkpoints."""

    def run(self, config: StageConfig, inputs: Inputs, draft: Draft) -> list[str]:
        """Write products under ``draft.files``, state to resume from under ``draft.state``.

        Returns the names, relative to ``draft.files``, of the files that make up the artifact's digest.
        """
        raise NotImplementedError

    def follow(self, config: StageConfig, inputs: Inputs) -> None:
        """The part of one more process of a ``torchrun``, whose first process is in ``run``; it writes nothing."""
        raise UserError(f"{self.name} runs in one process: start it without torchrun")


@dataclass(frozen=True)
class System:
    """A named set of stages: a DAG through their ``inputs``."""

    name: str
    modules: Mapping[str, str]  # stage name -> "package.module:Class"
    groups: tuple[str, ...] = ()  # config groups that stages share by interpolation (``model: ${model}``)
    packages: tuple[str, ...] = ()  # whose versions a manifest records
    targets: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # what `make NAME` makes: stages, by target
    commands: str = ""  # "package.module:function" that mounts the system's own commands on `lightmill`
    experiments: str = ""  # "package.module:NAME", the `pipeline.experiments.Experiments` that makes and shows its tables
    views: str = ""  # "package.module:NAME" of what a viewer shows of its stages; the engine does not look at it
    _loaded: dict[str, Stage] = field(default_factory=dict, compare=False, repr=False)

    @property
    def folder(self) -> Path:
        """The folder of its stages' modules, where its folder ``conf`` may lie."""
        spec = importlib.util.find_spec(next(iter(self.modules.values())).partition(":")[0])
        assert spec is not None and spec.origin is not None
        return Path(spec.origin).parent

    def stage(self, name: str) -> Stage:
        """The stage of that name. Its module is imported here, so it must be cheap to import."""
        if name not in self.modules:
            raise UserError(f"stage={name!r} is unknown: choose from {', '.join(self.modules)}")
        if name not in self._loaded:
            self._loaded[name] = self.load(self.modules[name])()
        return self._loaded[name]

    @staticmethod
    def load(name: str) -> Any:
        """What a "package.module:NAME" of a system stands for."""
        module, _, attribute = name.partition(":")
        return getattr(importlib.import_module(module), attribute)

    def number(self, name: str) -> int:
        """Position of the stage, for listings only."""
        return list(self.modules).index(name)


def load_system(name: str) -> System:
    """The engine's one dynamic import: a module that supplies ``SYSTEM``.

    It is ``stages.<name>``, or a module of that name (dots allowed) that Python finds elsewhere, such as in the folder that
    the command runs in.
    """
    if not re.match(r"[a-z][a-z0-9_]*(\.[a-z][a-z0-9_]*)*\Z", name):
        raise UserError(f"system={name!r} is not a name of a system")
    for module_name in (f"stages.{name}", name):
        try:
            module = importlib.import_module(module_name)
        except ModuleNotFoundError as error:
            if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
                raise
            continue
        if not isinstance(getattr(module, "SYSTEM", None), System):
            continue
        return module.SYSTEM
    raise UserError(f"system={name!r} is unknown: there is no module stages.{name} or {name} with a SYSTEM")


__all__ = [
    "Inputs",
    "Item",
    "MapStage",
    "Record",
    "Reject",
    "RunStage",
    "Stage",
    "StageConfig",
    "System",
    "load_system",
]
