"""How far the line scales: a store of a million items, two workers over one, and what the paper's data would take.

    python bench/scale.py [--only store,workers,model] [--work FOLDER]

store    a million items with empty payloads in 10,000 parts, and a second artifact made from it but for its last 10 parts.
         Time and peak memory of ``ls``, of planning, of resuming the second, of ``verify`` and ``verify --deep``, each in
         a process of its own. *build* makes the store with the engine's own writers, without waiting for the disk. Memory:
         resident, of the process and of the largest worker; *all* is theirs together, with what they share counted once.
workers  remesh and render on one and on two workers of one thread each, beside one and two copies of a pure CPU loop: a
         machine whose cores share caches, memory or clocks does not double either. Every item is a part of its own here, so
         that no worker runs out of work early and the cost of parts is in it. *Steady* is the work done per second while both
         workers are at work, in units of what the same parts took one worker; *whole* is the stage from its call to its
         artifact: start of processes, imports, opening, finish and all. Bar: steady at least 0.95 of the loop's.
model    time, storage and cost of 2M scenes x 4 views, from what items took and weighed in the artifacts of ``--store``,
         or in a sample made for it (experiment=paper_256 on made-up objects). Per item that a stage keeps: the CPU time of
         all that it tried (but for items that a limit killed: nobody knows theirs) and the bytes of its parts. What is
         assumed is an option.

Some 20 minutes on two quiet cores.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import psutil

ROOT = Path(__file__).resolve().parents[1]
if sys.path[0] != str(ROOT):  # before this folder, whose files have the names of packages; for workers too
    sys.path.insert(0, str(ROOT))

from pipeline import commands, mapping  # noqa: E402
from pipeline.config import StageConfig, count, parse  # noqa: E402
from pipeline.hydra_config import compose  # noqa: E402
from pipeline.keys import digest_of  # noqa: E402
from pipeline.plan import item_keys, make_plan, split_config  # noqa: E402
from pipeline.run import run_pipeline  # noqa: E402
from pipeline.stage import Item, MapStage, Record, System, load_system  # noqa: E402
from pipeline.store import Artifact, Attempt, Store  # noqa: E402
from pipeline.worker import log_file  # noqa: E402

LEFT = 10  # parts of the second artifact that are not there yet
PARTS = ("store", "workers", "model")


# --- a million items --------------------------------------------------------------------------------------------------


class EmptyConfig(StageConfig):
    n: int = count(1_000_000)


class Empty(MapStage):
    name, version, Config = "empty", 1, EmptyConfig

    def part_size(self, config: Any, inputs: Any) -> int:
        return 100

    def items(self, config: Any, inputs: Any) -> Iterator[Item]:
        return (Item(f"{number:07d}", needs=()) for number in range(config.n))

    def open(self, config: Any, inputs: Any, environment: Any) -> Any:
        return inputs

    def process(self, inputs: Any, item: Item) -> Iterator[Record]:
        yield Record(item.id, {"nothing": b""})


class Again(Empty):
    """Item by item from ``empty``, as render is from scene."""

    name, inputs, Config = "again", ("empty",), StageConfig

    def items(self, config: Any, inputs: Any) -> Iterator[Item]:
        return (Item(row.id, row.group, (("empty", row.id),)) for row in inputs["empty"].rows())

    def process(self, inputs: Any, item: Item) -> Iterator[Record]:
        yield inputs["empty"].read(item.id)


SYSTEM = System("scale", {"empty": "bench.scale:Empty", "again": "bench.scale:Again"})


def config_of(folder: Path, items: int) -> dict[str, Any]:
    return {"system": "bench.scale", "stage": "again", "store": str(folder), "empty": {"n": items}, "again": {}}


def fill(folder: Path, items: int, name: str, left: int) -> None:
    """Make the parts of a draft, all but the last, as workers would, without starting any."""
    run, system, sections = split_config(config_of(folder, items))
    store = Store(folder)
    plan = make_plan(run, system, sections, lambda path: "")
    planned = plan[name]
    inputs = planned.inputs({other: store.find(plan[other].place, plan[other].key) for other in plan})
    draft = store.draft(planned.place, planned.key, planned.preimage, Attempt({"system": run.system, "config": {}}))
    draft.set_environment({})
    stage = load_system("bench.scale").stage(name)
    listed = sorted(stage.items(planned.config, inputs), key=lambda item: (item.group, item.id))
    keys = item_keys(planned, listed, inputs)
    parts = list(mapping._parts(listed, keys, stage.part_size(planned.config, inputs)))
    for group, indices in parts[: len(parts) - left]:
        writer = draft.open_part()
        for index in indices:
            writer.add(Record(listed[index].id, {"nothing": b""}), listed[index].id, group, keys[index])
        part_key = digest_of({"group": group, "items": tuple(keys[index] for index in indices)})
        ids = [listed[index].id for index in indices]
        draft.finish_part(part_key, {**writer.close(), "part_key": part_key, "group": group, "items": ids, "rejects": []})


def step(name: str, folder: Path, items: int) -> None:
    """One step in this process; its last line of output is what it took, as JSON."""
    arguments = argparse.Namespace(stage=None, artifacts=[], deep=name == "verify --deep")
    before, began = time.process_time(), time.monotonic()
    if name == "build":
        os.fsync = lambda handle: None  # it is not what is timed
        fill(folder, items, "empty", 0)
        run_pipeline({**config_of(folder, items), "stage": "empty", "workers": 0}, ["bench"])
        fill(folder, items, "again", LEFT)
    elif name == "ls":
        commands.command_ls(Store(folder), arguments)
    elif name.startswith("verify"):
        assert commands.command_verify(Store(folder), arguments) == 0
    else:
        run_pipeline({**config_of(folder, items), "workers": 2, "plan": name == "plan"}, ["bench"])
    print(json.dumps({"wall": time.monotonic() - began, "cpu": time.process_time() - before}))


class Memory(NamedTuple):
    """Peaks in MB: resident, of a process and of the largest below it; and of all together, shared pages counted once."""

    own: float
    worker: float
    all: float


def watch_memory(process: subprocess.Popen) -> Memory:
    """Until the process ends. Not getrusage: what it says of a process begins with the size of the one that started it."""
    own = worker = together = 0.0
    root = psutil.Process(process.pid)
    for tick in itertools.count():
        with contextlib.suppress(psutil.Error):
            own = max(own, root.memory_info().rss)
            family = root.children(recursive=True)
            for child in family:
                with contextlib.suppress(psutil.Error):
                    worker = max(worker, child.memory_info().rss)
            if tick % SLOW == 0:
                together = max(together, sum(_shared_fairly(member) for member in (root, *family)))
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(POLL_S)
            return Memory(own / 2**20, worker / 2**20, together / 2**20)
    raise AssertionError


def _shared_fairly(process: psutil.Process) -> float:
    """Proportional set size in bytes: a page of many processes counts in each by its share."""
    try:
        return process.memory_full_info().pss
    except psutil.Error:  # it has ended meanwhile
        return 0.0


POLL_S = 0.05
SLOW = 10  # polls: the proportional size costs the kernel a walk over all pages


def bench_store(work: Path, items: int) -> None:
    folder = work / "million"
    shutil.rmtree(folder, ignore_errors=True)
    print(f"store: {items:,} items with empty payloads, 100 a part; two artifacts, the second but for its last {LEFT} parts")
    print(f"  {'':<14}{'s':>8}{'CPU s':>8}{'MB':>7}{'MB, largest worker':>20}{'MB, all':>9}")
    for name in ("build", "ls", "plan", "resume", "ls", "plan", "verify", "verify --deep"):
        command = [sys.executable, __file__, "--step", name, "--work", str(folder), "--items", str(items)]
        with tempfile.TemporaryFile("w+") as output:
            process = subprocess.Popen(command, cwd=ROOT, stdout=output, stderr=subprocess.STDOUT)
            memory = watch_memory(process)
            output.seek(0)
            lines = output.read().splitlines()
        if process.returncode:
            raise SystemExit("\n".join([f"{name} failed:", *lines]))
        took = json.loads(lines[-1])
        row = f"  {name:<14}{took['wall']:8.1f}{took['cpu']:8.1f}{memory.own:7.0f}"
        print(row + (f"{memory.worker:20.0f}{memory.all:9.0f}" if name == "resume" else ""), flush=True)
    print("  bar: resume under 30 s and 1,000 MB")
    shutil.rmtree(folder)


# --- two workers over one ---------------------------------------------------------------------------------------------

LOOP = """import time
began, x = time.perf_counter(), 1
for i in range({n}):
    x = x * 48271 % 2147483647
print(time.perf_counter() - began)"""


def loop_ratio(rounds: int = 3, n: int = 30_000_000) -> float:
    """Throughput of two copies of a pure CPU loop over one's, the median of ``rounds``."""

    def seconds(copies: int) -> float:
        command = [sys.executable, "-c", LOOP.format(n=n)]
        running = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(copies)]
        return statistics.mean(float(process.communicate()[0]) for process in running)

    return statistics.median(2 * seconds(1) / seconds(2) for _ in range(rounds))


WORKER = re.compile(r" items of \S+ \S+: process (\d+) on ")  # in a part's log


class Arrival(NamedTuple):
    """A finished part: its key, the process that made it, seconds since the workers were asked for."""

    part: str
    worker: str
    at: float


def timed_stage(root: dict[str, Any], stage: str, workers: int) -> tuple[float, list[Arrival]]:
    """Compute the stage anew. Seconds of the whole, and its parts as they came in."""
    arrived: list[Arrival] = []
    run_parts = mapping.run_parts

    def noting(tasks: Any, workers: int, threads: int, on_result: Any, log: Any) -> None:
        assert threads == 1
        began = time.perf_counter()

        def note(result: Any) -> None:
            at, log = time.perf_counter() - began, log_file(tasks[0].draft, result.part_key)
            arrived.append(Arrival(result.part_key, WORKER.search(log.read_text())[1], at))
            on_result(result)

        run_parts(tasks, workers, threads, note, log)

    kind = type(load_system(root["system"]).stage(stage))
    with (
        mock.patch.object(mapping, "run_parts", noting),
        mock.patch.object(kind, "part_size", lambda self, config, inputs: 1),
        mock.patch("os.cpu_count", lambda: workers),  # from which the runner takes the threads of a worker: one
    ):
        began = time.perf_counter()
        run_pipeline({**root, "stage": stage, "force": stage, "workers": workers}, ["bench"], lambda text: None)
        return time.perf_counter() - began, arrived


def worked(arrivals: Sequence[Arrival]) -> Iterator[tuple[str, str, float, float]]:
    """(part, worker, from, to) of every part but each worker's first, whose beginning nobody saw."""
    last: dict[str, float] = {}
    for part, worker, at in arrivals:
        if worker in last:
            yield part, worker, last[worker], at
        last[worker] = at


def steady_ratio(alone: Sequence[Arrival], together: Sequence[Arrival]) -> float:
    """Work per second with many workers over work per second with one, while all of the many were at work.

    A part's work is the seconds that it took one worker; of a part that was partly made then, that share of it counts.
    """
    work = {part: to - begun for part, _, begun, to in worked(alone)}
    spans = list(worked(together))
    workers = {worker for _, worker, _, _ in spans}
    first = max(min(begun for _, worker, begun, _ in spans if worker == mine) for mine in workers)
    last = min(max(to for _, worker, _, to in spans if worker == mine) for mine in workers)
    done = sum(work[part] * max(0.0, min(to, last) - max(begun, first)) / (to - begun) for part, _, begun, to in spans)
    return done / (last - first)


def bench_workers(work: Path, objects: int, scenes: int) -> None:
    store = work / "workers"
    overrides = [
        f"store={store}", f"collect.per_family={objects}", f"scene.count.train={scenes}", "scene.count.validation=2",
        "scene.count.test=2", "render.resolution=64", "render.max_spp=64", "render.target_error=0",
    ]  # fmt: skip
    root = compose(overrides)
    run_pipeline({**root, "stage": "render"}, ["bench"])  # what both read, and what the machine keeps of a first run
    print("workers: throughput of two workers over one, one thread each")
    before = loop_ratio()
    rows = []
    for stage in ("remesh", "render"):
        whole_1, alone = timed_stage(root, stage, 1)
        whole_2, together = timed_stage(root, stage, 2)
        rows.append((stage, len(alone), whole_1, whole_2, steady_ratio(alone, together), whole_1 / whole_2))
    after = loop_ratio()
    loop = (before + after) / 2
    print(f"  pure CPU loop: two copies do {loop:.3f} times what one does ({before:.3f} before, {after:.3f} after)")
    print(f"  {'':<8}{'parts':>6}{'s, one':>9}{'s, two':>9}{'steady':>9}{'of loop':>9}{'whole':>9}{'of loop':>9}")
    for stage, parts, one, two, steady, whole in rows:
        print(f"  {stage:<8}{parts:>6}{one:9.1f}{two:9.1f}{steady:9.3f}{steady / loop:9.3f}{whole:9.3f}{whole / loop:9.3f}")
    print("  bar: steady at least 0.95 of the loop")


# --- the paper's data -------------------------------------------------------------------------------------------------

OF_OBJECTS, OF_SCENES = ("collect", "remesh", "decimate"), ("scene", "render", "shard")
ITEM = re.compile(r"\S+ \S+ (.+?): [0-9.]+ s, ([0-9.]+) s of CPU, (?:\d+ record\(s\)|rejected, )")  # an id may have spaces
TAKEN_OVER = re.compile(r", taken over( from \S+)?$")


def seconds_per_item(logs: Path) -> tuple[float, int]:
    """Mean CPU seconds of an item, kept or rejected, and of how many: from an artifact's logs, which tell a process' opening
    apart. Of an item that was computed twice (its worker died) the last time counts.
    """
    told = (text for path in sorted(logs.glob("*.log")) for text in path.read_text(errors="replace").splitlines())
    seconds = {match[1]: float(match[2]) for text in told if (match := ITEM.match(text)) and not TAKEN_OVER.search(text)}
    return (statistics.mean(seconds.values()) if seconds else 0.0), len(seconds)


class PerItem(NamedTuple):
    """What an item that a stage keeps costs: its share of the CPU time of all that were tried, and the bytes of its records."""

    seconds: float
    measured: int  # items whose time the logs tell
    bytes: float
    kept: int


def per_item(artifact: Artifact) -> PerItem:
    outputs = artifact.manifest["outputs"]
    kept = outputs["items"] - sum(outputs["rejects"].values())
    seconds, items = seconds_per_item(artifact.path / "logs")
    name = f"model: {artifact.stage}/{artifact.path.name}"
    if not kept:
        raise SystemExit(f"{name} kept none of its {outputs['items']} items: there is nothing to count by")
    if not items:
        raise SystemExit(
            f"{name} tells no item's CPU time in its logs: it was made before logs did, or all was taken over from another "
            f"artifact; force={artifact.stage} makes it again"
        )
    size = sum(part["bytes"] for part in outputs["parts"])  # files/ (cards, sheets) does not grow with the items
    return PerItem(seconds * outputs["items"] / kept, items, size / kept, kept)


def measured(store: Store) -> dict[str, PerItem]:
    """Stage -> what an item costs, of the newest artifact of each."""
    found = {}
    for stage in OF_OBJECTS + OF_SCENES:
        artifacts: list[Artifact] = store.artifacts(stage)
        if not artifacts:
            raise SystemExit(f"model: {store.root} has no artifact of {stage}: make the line up to shard first")
        found[stage] = per_item(artifacts[-1])
    return found


def sample_config(store: Path, scenes: int) -> dict[str, Any]:
    """The line up to shard as the paper's first phase has it, but for few scenes of few made-up objects."""
    overrides = [
        f"store={store}", "stage=shard", "experiment=paper_256", "collect=procedural", "collect.per_family=1",
        f"scene.count.train={scenes}", "scene.count.validation=1", "scene.count.test=1",
    ]  # fmt: skip
    return compose(overrides)


def make_sample(work: Path, scenes: int) -> Store:
    store = work / "sample"
    run_pipeline(sample_config(store, scenes), ["bench"])
    return Store(store)


def training_days(gpus: int) -> float:
    """Days of ``paper_256`` on A100s at the utilisation that ``plan=true`` assumes."""
    from model.renderformer.flops import TRAINING, forward_flops, ideal_seconds
    from stages.renderformer.s06_train import A100_TFLOPS, UTILISATION

    root = compose(["stage=train", "experiment=paper_256", "collect.ids_file=FILE"])
    config = parse(load_system("renderformer").stage("train").Config, root["train"], "train")
    side, triangles = root["render"]["resolution"], root["scene"]["max_triangles"]
    flops = forward_flops(config.model.build(), [triangles], config.views_per_scene, side, side)
    peaks = {name: value * 1e12 * UTILISATION for name, value in A100_TFLOPS.items()}
    return TRAINING * ideal_seconds(flops, peaks, config.precision) * config.batch_scenes * config.steps / 86400 / gpus


def bench_model(work: Path, options: argparse.Namespace) -> None:
    store = Store(options.store) if options.store else make_sample(work, options.sample_scenes)
    found = measured(store)
    print(f"model: {options.objects:,} objects, {options.scenes:,} scenes of 4 views; per item as in {store.root}")
    print(f"  {'':<9}{'CPU s':>12}{'timed':>7}{'kB':>9}{'kept':>9}{'of':>11}{'core-hours':>12}{'TB':>8}")
    hours: dict[str, float] = {}
    terabytes: dict[str, float] = {}
    for stage, (seconds, items, size, kept) in found.items():
        number = options.objects if stage in OF_OBJECTS else options.scenes
        hours[stage], terabytes[stage] = seconds * number / 3600, size * number / 1e12
        cells = f"{seconds:12.3f}{items:7d}{size / 1e3:9.1f}{kept:9d}"
        print(f"  {stage:<9}{cells}{number:11,}{hours[stage]:12,.0f}{terabytes[stage]:8.2f}")
    core_hours, everything, shards = sum(hours.values()), sum(terabytes.values()), terabytes["shard"]
    days = core_hours / options.cores / 24 / options.use
    on_gpus = hours["render"] / options.gpu_cores / options.gpus / 24
    train = training_days(options.gpus)
    cores, node = core_hours / options.use * options.core_hour, train * 24 * options.node_hour
    disk = options.tb_month * (everything * days / 30 + shards * options.months)
    print(f"  {'all':<57}{core_hours:12,.0f}{everything:8.2f}")
    print(f"  {options.cores:,} CPU cores: {days:.1f} days, {options.use:.0%} of them at work")
    print(f"  {options.gpus} GPUs of one node: render it in {on_gpus:.1f} days, a GPU taken for {options.gpu_cores:g} cores")
    print(
        f"  {options.gpus} A100s of one node: train paper_256 in {train:.1f} days, at 40 % of their peak (the authors: 5 days)"
    )
    print("  USD:")
    print(f"  {cores:10,.0f} for cores, at {options.core_hour:g} a core-hour")
    print(f"  {node:10,.0f} for training, at {options.node_hour:g} a node-hour")
    print(
        f"  {disk:10,.0f} for disks, at {options.tb_month:g} a TB-month: all during the run, shards {options.months:g} months"
    )


def parsed(words: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--only", type=lambda text: text.split(","), default=list(PARTS), help=f"of {','.join(PARTS)}")
    add("--work", type=Path, help="where stores are made, and kept (default: a temporary folder)")
    add("--items", type=int, default=1_000_000, help="store: items")
    add("--per-family", type=int, default=4, help="workers: objects of each of 21 families to remesh")
    add("--worker-scenes", type=int, default=80, help="workers: scenes to render")
    add("--store", help="model: take figures from the artifacts of this store")
    add("--sample-scenes", type=int, default=12, help="model: training scenes of the sample")
    add("--objects", type=int, default=800_000, help="model: objects (Objaverse 1.0 has about so many)")
    add("--scenes", type=int, default=2_000_000, help="model: scenes, of four views each")
    add("--cores", type=int, default=1000)
    add("--use", type=float, default=0.9, help="model: share of the cores' time that is work (assumed)")
    add("--gpus", type=int, default=8, help="model: of a node")
    add("--gpu-cores", type=float, default=100, help="model: CPU cores that one GPU renders like (assumed)")
    add("--core-hour", type=float, default=0.04, help="model: USD")
    add("--node-hour", type=float, default=16.0, help="model: USD of a GPU node")
    add("--tb-month", type=float, default=20.0, help="model: USD")
    add("--months", type=float, default=3.0, help="model: that the shards are kept")
    add("--step", help=argparse.SUPPRESS)
    options = parser.parse_args(words)
    for name in options.only:
        if name not in PARTS:
            parser.error(f"--only {name}: choose from {', '.join(PARTS)}")
    return options


def main() -> None:
    options = parsed()
    if options.step:
        step(options.step, options.work, options.items)
        return
    with contextlib.ExitStack() as stack:
        work = options.work or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        work.mkdir(parents=True, exist_ok=True)
        if "store" in options.only:
            bench_store(work, options.items)
        if "workers" in options.only:
            bench_workers(work, options.per_family, options.worker_scenes)
        if "model" in options.only:
            bench_model(work, options)


if __name__ == "__main__":
    main()
