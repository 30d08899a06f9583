"""Make the parts of a map stage: list its items, take over what earlier artifacts hold, run the rest."""

from __future__ import annotations

import contextlib
import gc
import itertools
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.cluster import Cluster
from pipeline.config import Limits
from pipeline.errors import (
    Damaged,
    ItemsFailed,
    MachineError,
    TooManyRejects,
)
from pipeline.executor import run_parts
from pipeline.keys import digest_of
from pipeline.plan import Planned, RunConfig, base_key, item_keys, label
from pipeline.progress import Progress
from pipeline.stage import Item, MapStage, System
from pipeline.status import RunState
from pipeline.store import Artifact, Draft, Store
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


def run_map(
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
        unfinished = draft.unfinished_parts()
        limits = Limits(**{**stage.limits, **config.limits.model_dump(exclude_none=True)})
        tasks: list[PartTask] = []
        fresh: dict[str, int] = {}  # part key -> items to compute
        total, again = len(items), 0
        for part_key, (group, part_items, part_item_keys) in parts.items():
            marker = markers[part_key] or unfinished.get(part_key, {"items": [], "rejects": []})
            allowed = {reject["item"] for reject in marker["rejects"] if limits.exceed(reject)}
            kept = set(marker["items"]) - allowed
            if len(kept) == len(part_items) and markers[part_key] is not None:
                state.add_rejects(Counter(reject["reason"] for reject in marker["rejects"]))
                continue
            again += len(allowed)
            wanted = zip(part_items, part_item_keys, strict=True)
            reuse = {item.id: donors[item_key] for item, item_key in wanted if item_key in donors and item.id not in kept}
            fresh[part_key] = len(part_items) - len(kept) - len(reuse)
            tasks.append(
                PartTask(
                    run.system, planned.name, planned.key, config, inputs, environment, draft.path,
                    part_key, group, part_items, part_item_keys, reuse, limits=limits, open_wall_s=stage.open_wall_s,
                )
            )  # fmt: skip
    part_keys = list(parts)
    # There may be millions, and workers and what follows need the room; what is to be made is in the tasks.
    del items, keys, donors, parts, markers, unfinished
    reused = total - sum(fresh.values())
    if not forced:
        sources: dict[Path, _Source] = {}
        tasks = [task for task in tasks if not _link_whole(task, sources, draft)]
    name_label = label(system, planned.name)
    if again:
        out(f"{name_label} {again} item(s) that lower limits rejected before are tried again")
    if damaged:
        out(f"{name_label} {damaged} finished part(s) of the interrupted run are damaged and made again")
    out(f"{name_label} running    {total} items" + (f", {reused} of them already there" if reused else ""))
    progress = Progress(f"{name_label}", total, reused)
    failed: list[tuple[str, str, Path]] = []
    state.update(now=True, parts=len(part_keys), total=total, reused=reused, done=reused)

    def on_result(result: PartResult) -> None:
        log = log_file(draft.path, result.part_key)
        for item, trace in result.failed:
            failed.append((item, trace, log))
            state.add_failure(item, trace, log)
        progress.add(max(0, fresh[result.part_key] - len(result.failed)), sum(result.rejects.values()))
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
            draft.prepared.mkdir(exist_ok=True)
            stage.prepare(config, inputs, draft.prepared)
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
    for artifact in store.artifacts(planned.place):
        manifest = artifact.manifest
        if manifest["base_key"] != base or not planned.stage.same_environment(manifest["environment"], environment):
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
