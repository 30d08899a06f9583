"""Speed and memory of collect, remesh and decimate, and a comparison of decimators:

    python bench/geometry.py [--path DIR] [--grids 64,128,256] [--decimators] [--limit N]

One worker with one thread, as the pipeline runs them; each grid in a fresh process, whose peak memory is printed. Meshes are
two of each procedural family, or every accepted file below DIR.
"""

from __future__ import annotations

import argparse
import functools
import multiprocessing
import resource
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # before this folder, whose files have the names of packages

from stages.graphics.geometry import one_thread  # noqa: E402

one_thread()

import numpy as np  # noqa: E402

from pipeline.config import parse  # noqa: E402
from pipeline.errors import Reject  # noqa: E402
from pipeline.stage import Item, Record  # noqa: E402
from stages.graphics.geometry import decimator, load, measure, remesher  # noqa: E402
from stages.graphics.geometry.records import MeshRecord  # noqa: E402
from stages.renderformer.objects.catalogue import record_id  # noqa: E402
from stages.renderformer.objects.procedural import FAMILIES  # noqa: E402
from stages.renderformer.s01_remesh import Remesh  # noqa: E402
from stages.renderformer.s02_decimate import Decimate  # noqa: E402

PHASES = {  # what is timed: (where it is called, its name, in words)
    "distances in the band": (remesher, "narrow_band"),
    "flood fill": (remesher, "signed_field"),
    "cavities": (remesher, "fill_cavities"),
    "marching cubes": (remesher, "marching_cubes"),
    "visible components": (remesher, "visible_components"),
    "pull-back": (remesher, "pull_back"),
    "first reduction": (decimator, "brought_nearer"),
    "edge collapse": (decimator, "collapse"),
    "measuring": (measure.Reference, "compare"),
    "measuring ": (measure.Reference, "__init__"),
    "self-intersections": (measure, "crossing"),
}


class Clock:
    """Seconds per (stage, phase)."""

    def __init__(self) -> None:
        self.seconds: Counter[tuple[str, str]] = Counter()
        self.stage = ""
        for words, (owner, name) in PHASES.items():
            setattr(owner, name, self.timed(getattr(owner, name), words.strip()))

    def timed(self, function: Callable, words: str) -> Callable:
        @functools.wraps(function)
        def wrapper(*arguments: object, **named: object) -> object:
            began = time.perf_counter()
            try:
                return function(*arguments, **named)
            finally:
                self.seconds[self.stage, words] += time.perf_counter() - began

        return wrapper


class Held:
    """As much of an artifact as the stages ask for."""

    def __init__(self, records: dict[str, Record]):
        self.records = records

    def read(self, id: str) -> Record:
        return self.records[id]


def sources(path: str | None, limit: int | None) -> list[tuple[str, Callable[[], load.Loaded]]]:
    """(name, what loads it), unchecked."""
    if path is None:
        made = []
        for family, make in FAMILIES.items():
            for number in range(2):
                made.append((f"{family}-{number}", functools.partial(_procedural, make, number)))
        return made[:: _stride(made, limit)]
    root = Path(path)
    files = [file for file in sorted(root.rglob("*")) if file.suffix.lower() in load.SUFFIXES]
    files = files[:: _stride(files, limit)]
    return [(str(file), functools.partial(load.load_mesh, file, root, 1 << 28, 2_000_000)) for file in files]


def _stride(items: list, limit: int | None) -> int:
    return max(1, -(-len(items) // limit)) if limit else 1


def _procedural(make: Callable, seed: int) -> load.Loaded:
    return load.Loaded(*load.checked(*make(np.random.default_rng(seed)), 2_000_000))


def records(path: str | None, limit: int | None) -> tuple[dict[str, Record], float]:
    """(collected records, seconds that loading them took)."""
    found, began = {}, time.perf_counter()
    for name, read in sources(path, limit):
        try:
            mesh = read()
        except Reject:
            continue
        meta = dict.fromkeys(("object_id", "content_hash", "family", "source", "origin", "licence"), name)
        name = record_id(name, Path(name).stem)
        found[name] = MeshRecord(name, load.normalise(mesh.vertices), mesh.faces.astype(np.int32), meta).to_record()
    return found, time.perf_counter() - began


def run_grid(grid: int, path: str | None, limit: int | None) -> dict:
    """Everything measured at one grid, in this process."""
    collected, loading = records(path, limit)
    inputs = {"collect": Held(collected), "remesh": Held({})}
    stages = {"remesh": (Remesh(), {"resolution": grid}), "decimate": (Decimate(), {})}
    workers = {name: stage.open(parse(stage.Config, given, name), inputs, {}) for name, (stage, given) in stages.items()}
    clock, times, rejected = Clock(), {"remesh": [], "decimate": []}, Counter()
    for id in collected:
        for name, (stage, _) in stages.items():
            clock.stage, began = name, time.perf_counter()
            try:
                (record,) = stage.process(workers[name], Item(id))
            except Reject as reject:
                rejected[f"{name}: {reject.reason}"] += 1
                record = None
            times[name].append(time.perf_counter() - began)
            if record is None:
                break
            if name == "remesh":
                inputs["remesh"].records[id] = record
    done = [MeshRecord.from_record(record).meta for record in inputs["remesh"].records.values()]
    return {
        "grid": grid,
        "objects": len(collected),
        "loading": loading,
        "times": times,
        "phases": dict(clock.seconds),
        "rejected": dict(rejected),
        "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "distance": float(np.median([meta["distance"] for meta in done])),
        "kept": float(np.percentile([meta["kept"] for meta in done], 10)),
    }


def run_decimators(path: str | None, limit: int | None) -> list[tuple]:
    """(budget, method, one row of measures per object) from grid 128, each rung straight from the remeshed mesh."""
    ways = {
        "QSlim alone (planar weight 0)": ("pymeshlab", 0.0),
        "planar weight 0.001": ("pymeshlab", 0.001),
        "planar weight 0.003": ("pymeshlab", 0.003),
        "planar weight 0.01": ("pymeshlab", 0.01),
        "fast_simplification": ("fast_simplification", 0.0),
    }
    rows: dict[tuple[int, str], list[dict]] = {}
    for record in records(path, limit)[0].values():
        source = MeshRecord.from_record(record)
        try:
            fine = remesher.remesh(source.vertices, source.faces, 128)
        except Reject:
            continue
        reference = measure.Reference(source.vertices, source.faces)
        for budget in (256, 1024, 3072):
            for words, (method, weight) in ways.items():
                began = time.perf_counter()
                mesh = decimator.collapse(*fine, budget, method, weight)
                seconds = time.perf_counter() - began
                stated = measure.measures(*mesh) | reference.compare(*mesh)
                stated |= {"crossing": measure.crossing(*mesh), "seconds": seconds, "reached": len(mesh[1]) <= budget}
                rows.setdefault((budget, words), []).append(stated)
    return [(budget, words, stated) for (budget, words), stated in rows.items()]


def table(titles: list[str], rows: list[list[str]]) -> None:
    """A Markdown table, numbers to the right."""
    print("\n| " + " | ".join(titles) + " |")
    print("| " + " | ".join("---:" for _ in titles) + " |")
    for row in rows:
        print("| " + " | ".join(row) + " |")


def print_grids(results: list[dict]) -> None:
    print(f"\n{results[0]['objects']} objects, loaded in {results[0]['loading']:.1f} s; one core")
    titles = ["grid", "remesh/s", "decimate/s", "both/s", "s: median", "p90", "most", "peak MB", "distance", "kept p10"]
    rows = []
    for r in results:
        remesh, decimate = (np.array(r["times"][name]) for name in ("remesh", "decimate"))
        both = remesh.sum() + decimate.sum()
        each = np.concatenate([remesh[: len(decimate)] + decimate, remesh[len(decimate) :]])
        rates = [len(remesh) / remesh.sum(), len(decimate) / decimate.sum(), len(remesh) / both]
        spread = [np.median(each), np.percentile(each, 90), each.max()]
        rows.append([str(r["grid"]), *(f"{x:.2f}" for x in rates), *(f"{x:.1f}" for x in spread)])
        rows[-1] += [f"{r['memory']:.0f}", f"{r['distance']:.3%}", f"{r['kept']:.3f}"]
    table(titles, rows)
    for r in results:
        print(f"grid {r['grid']}, rejected: {r['rejected'] or 'none'}")

    rows = []
    for stage in ("remesh", "decimate"):
        for phase in sorted({phase for r in results for of, phase in r["phases"] if of == stage}):
            rows.append([stage, phase, *(_per_object(r, stage, r["phases"].get((stage, phase), 0)) for r in results)])
        # the phases do not nest, so the rest is a plain difference
        rest = [sum(r["times"][stage]) - sum(s for (of, _), s in r["phases"].items() if of == stage) for r in results]
        rows.append([stage, "all else", *(_per_object(r, stage, s) for r, s in zip(results, rest, strict=True))])
        rows.append([stage, "TOTAL", *(_per_object(r, stage, sum(r["times"][stage])) for r in results)])
    table(["stage", "ms per object", *(f"grid {r['grid']}" for r in results)], rows)


def _per_object(result: dict, stage: str, seconds: float) -> str:
    return f"{1000 * seconds / max(len(result['times'][stage]), 1):.0f}"


def print_decimators(measured: list[tuple]) -> None:
    rows = []
    for budget, words, stated in measured:
        column = {name: np.array([s[name] for s in stated]) for name in stated[0]}
        good = int((column["watertight"] & column["reached"]).sum())
        row = [str(budget), words, f"{good} of {len(stated)}", f"{np.median(column['distance']):.3%}"]
        row += [f"{np.percentile(column['kept'], 10):.3f}", f"{np.median(column['area_spread']):.2f}"]
        row += [f"{column[name].mean():.2%}" for name in ("slivers", "crossing", "flipped")]
        rows.append([*row, f"{column['seconds'].mean():.2f}"])
    titles = ["budget", "method", "sound", "distance", "kept p10", "area spread", "slivers", "crossing", "flipped", "s"]
    table(titles, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--path", help="folder of meshes (default: procedural ones)")
    parser.add_argument("--grids", default="64,128,256")
    parser.add_argument("--decimators", action="store_true", help="compare decimators instead, at grid 128")
    parser.add_argument("--limit", type=int, help="at most so many meshes, evenly spread")
    arguments = parser.parse_args()
    context = multiprocessing.get_context("spawn")
    if arguments.decimators:
        print_decimators(run_decimators(arguments.path, arguments.limit))
        return
    results = []
    for grid in map(int, arguments.grids.split(",")):
        with context.Pool(1) as pool:
            results.append(pool.apply(run_grid, (grid, arguments.path, arguments.limit)))
    print_grids(results)


if __name__ == "__main__":
    main()
