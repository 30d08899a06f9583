"""Make the parts of a map stage: list its items, take over what earlier artifacts hold, run the rest."""

from __future__ import annotations

import contextlib
import gc
import itertools
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.config import Limits
from pipeline.errors import Damaged, ItemsFailed, MachineError, TooManyRejects
from pipeline.executor import run_parts
from pipeline.keys import digest_of
from pipeline.making import Making
from pipeline.plan import Planned, base_key, item_keys
from pipeline.progress import Progress
from pipeline.stage import Item, MapStage
from pipeline.store import Artifact, Draft
from pipeline.worker import PartResult, PartTask, Reuse, log_file


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


@dataclass
class _Work:
    """What a map stage has to do and what is there already, without the items themselves: there may be millions."""

    part_keys: list[str] = field(default_factory=list)  # of all parts, in the artifact's order
    tasks: list[PartTask] = field(default_factory=list)  # parts to make
    missing: dict[str, int] = field(default_factory=dict)  # part key -> items to compute
    items: int = 0  # in all
    retried: int = 0  # items that lower limits rejected before
    damaged: int = 0  # finished parts whose bytes are not those that were written

    @property
    def reused(self) -> int:
        """Items that need no computing."""
        return self.items - sum(self.missing.values())


def run_map(making: Making) -> None:
    """Make all parts of a map stage's draft, then the files that the stage makes of all records.

    ItemsFailed where items raised, TooManyRejects where too few are left. Either keeps what is finished for the next run.
    """
    draft, config, inputs, stage = making.draft, making.planned.config, making.inputs, making.planned.stage
    assert isinstance(stage, MapStage)
    work = _list_work(making, stage)
    if not making.forced:
        work.tasks = _link_whole_parts(work.tasks, draft)
    if work.retried:
        making.say(f"{work.retried} item(s) that lower limits rejected before are tried again")
    if work.damaged:
        making.say(f"{work.damaged} finished part(s) of the interrupted run are damaged and made again")
    making.say(f"running    {work.items} items" + (f", {work.reused} of them already there" if work.reused else ""))
    tally = _Tally(making, work)
    try:
        if work.tasks:
            draft.prepared.mkdir(exist_ok=True)
            stage.prepare(config, inputs, draft.prepared)
            _make_parts(making, stage, work.tasks, tally)
    finally:
        tally.progress.close()
    tally.check_failures()
    draft.use_parts(_finished(making.planned.name, draft, work.part_keys))
    _check_rejects(making.planned, draft, work.items)
    for path in sorted(draft.files.rglob("*"), reverse=True):  # what an interrupted finish left
        path.unlink() if path.is_file() else path.rmdir()
    stage.finish(config, inputs, draft)
    stage.check(draft)


@_without_gc()
def _list_work(making: Making, stage: MapStage) -> _Work:
    """List the stage's parts, and make a task of each that lacks an item."""
    planned, draft, inputs = making.planned, making.draft, making.inputs
    config = planned.config
    items = sorted(stage.items(config, inputs), key=lambda item: (item.group, item.id))
    if len({item.id for item in items}) != len(items):
        raise AssertionError(f"{planned.name} lists an item twice")
    keys = item_keys(planned, items, inputs)
    reusable = {} if making.forced else _reusable_items(making, keys)
    parts: dict[str, tuple[str, tuple[Item, ...], tuple[str, ...]]] = {}
    for group, indices in _parts(items, keys, stage.part_size(config, inputs)):
        part_item_keys = tuple(keys[index] for index in indices)
        part_key = digest_of({"group": group, "items": part_item_keys})
        parts[part_key] = group, tuple(items[index] for index in indices), part_item_keys
    markers, damaged = draft.sound_markers({key: [item.id for item in part_items] for key, (_, part_items, _) in parts.items()})
    unfinished = draft.unfinished_parts()
    limits = Limits(**{**stage.limits, **config.limits.model_dump(exclude_none=True)})
    work = _Work(list(parts), items=len(items), damaged=damaged)
    for part_key, (group, part_items, part_item_keys) in parts.items():
        marker = markers[part_key] or unfinished.get(part_key, {"items": [], "rejects": []})
        retried = {reject["item"] for reject in marker["rejects"] if limits.exceed(reject)}
        finished_ids = set(marker["items"]) - retried
        if len(finished_ids) == len(part_items) and markers[part_key] is not None:
            making.state.add_rejects(Counter(reject["reason"] for reject in marker["rejects"]))
            continue
        keyed_items = zip(part_items, part_item_keys, strict=True)
        reuse = {item.id: reusable[key] for item, key in keyed_items if key in reusable and item.id not in finished_ids}
        work.retried += len(retried)
        work.missing[part_key] = len(part_items) - len(finished_ids) - len(reuse)
        work.tasks.append(
            PartTask(
                making.run.settings.system, planned.name, planned.key, config, inputs, making.environment, draft.path,
                part_key, group, part_items, part_item_keys, reuse, limits=limits, open_wall_s=stage.open_wall_s,
            )
        )  # fmt: skip
    return work


class _Tally:
    """What has become of the items so far: counted on the screen and in the run's state, failures by name."""

    def __init__(self, making: Making, work: _Work):
        self._making, self._missing = making, work.missing
        self._failures: list[tuple[str, str, Path]] = []  # item, traceback, log of its part
        self.progress = Progress(making.run.label(making.planned.name), work.items, work.reused)
        making.state.update(now=True, parts=len(work.part_keys), total=work.items, reused=work.reused, done=work.reused)

    def add(self, result: PartResult) -> None:
        """Count a part that has been made, or made but for the items that failed."""
        state, log = self._making.state, log_file(self._making.draft.path, result.part_key)
        for item, trace in result.failed:
            self._failures.append((item, trace, log))
            state.add_failure(item, trace, log)
        self.progress.add(max(0, self._missing[result.part_key] - len(result.failed)), sum(result.rejects.values()))
        state.add_rejects(result.rejects)
        state.update(now=bool(result.failed), done=self.progress.done)

    def check_failures(self) -> None:
        """ItemsFailed where items raised."""
        if not self._failures:
            return
        _, trace, log = self._failures[0]
        last = trace.strip().splitlines()[-1]
        names = ", ".join(item for item, _, _ in self._failures[:8]) + (", ..." if len(self._failures) > 8 else "")
        raise ItemsFailed(
            f"{self._making.planned.name}: {len(self._failures)} item(s) failed: {names}. The first: {last}. Its traceback: "
            f"{log} (`lightmill status` names the others'). Everything else is kept; run again to continue"
        )


def _make_parts(making: Making, stage: MapStage, tasks: Sequence[PartTask], tally: _Tally) -> None:
    """Make the parts: on the run's cluster, or by processes of this machine that share its cores."""
    if making.run.cluster is not None:
        making.run.cluster.run_parts(tasks, tally.add, tally.progress.log)
        return
    config, cores = making.planned.config, os.cpu_count() or 1
    workers = config.workers if config.workers is not None else making.run.settings.workers
    workers = cores if workers == "auto" else workers
    most = stage.max_workers(config, making.environment)
    workers = min(workers, len(tasks), *([] if most is None else [most]))
    run_parts(tasks, workers, max(1, cores // max(workers, 1)), tally.add, tally.progress.log)


def _finished(name: str, draft: Draft, part_keys: Iterable[str]) -> Iterator[dict[str, Any]]:
    """The parts' markers, in order. MachineError where one is gone."""
    for part_key in part_keys:
        marker = draft.marker(part_key)
        if marker is None:
            raise MachineError(f"{name}: finished part {part_key[:12]} vanished from {draft.path}: run again")
        yield marker


def _check_rejects(planned: Planned, draft: Draft, items: int) -> None:
    """TooManyRejects where a larger share of the items was rejected than the config allows."""
    rejects = draft.rejects()
    if items and len(rejects) / items > planned.config.max_reject_share:
        counts = Counter(reject["reason"] for reject in rejects)
        listed = ", ".join(f"{count} {reason}" for reason, count in sorted(counts.items()))
        first, name, most = rejects[0], planned.name, planned.config.max_reject_share
        raise TooManyRejects(
            f"{name}: {len(rejects)} of {items} items were rejected ({listed}), more than {name}.max_reject_share={most:g}. "
            f"For example {first['item']}: {first['reason']}: {first['detail']}"
        )


def _reusable_items(making: Making, keys: Sequence[str]) -> dict[str, Reuse]:
    """Item key -> where an earlier artifact of the same stage holds that item; only of ``keys``."""
    planned = making.planned
    base = base_key(planned)
    reusable: dict[str, Reuse] = {}
    codes: dict[Path | None, list[str]] = {None: []}
    wanted_keys: set[str] = set()
    for artifact in making.run.store.artifacts(planned.place):
        manifest = artifact.manifest
        if manifest["base_key"] != base or not planned.stage.same_environment(manifest["environment"], making.environment):
            continue
        try:
            artifact.rows(), artifact.rejects()
        except Damaged:  # it gives nothing, and is no input of ours
            continue
        wanted_keys = wanted_keys or set(keys)
        codes[artifact.path] = artifact.codes
        for item_key, rows in itertools.groupby(artifact.rows(), key=lambda row: row.item_key):  # an item's rows are neighbours
            if item_key in wanted_keys:
                reusable[item_key] = Reuse(artifact.path, tuple(row.id for row in rows))
        for reject in artifact.rejects():
            if reject.get("item_key") in wanted_keys and not reject.get("machine"):
                reusable[reject["item_key"]] = Reuse(reject=reject)
    sources = {reuse.artifact for reuse in reusable.values()}
    making.draft.made_by(
        itertools.chain.from_iterable(codes[path] for path in sources), "what is taken over from earlier artifacts was"
    )
    return reusable


def _link_whole_parts(tasks: Sequence[PartTask], draft: Draft) -> list[PartTask]:
    """Take over by hard link what earlier artifacts hold as whole parts; returns the tasks that are left."""
    sources: dict[Path, _Source] = {}
    return [task for task in tasks if not _link_whole(task, sources, draft)]


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
