"""``lightmill report KEY ...``: several runs, and probes, on one page.

Reads artifacts of stages *evaluate* and *probe*; writes ``OUT.html`` (one file that opens from disk), ``OUT.json`` (the same
numbers), ``OUT.md`` (tables to paste) and ``OUT.png`` (the runs' views under the targets).
One design choice: runs are compared view by view, so that they must have been evaluated on the same scenes, which is told by
the scenes' bytes; other runs are shown together only when asked.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.atomic import write_atomic
from pipeline.errors import UserError
from pipeline.store import store_of

if TYPE_CHECKING:
    from pipeline.store import Artifact, Store
    from stages.renderformer.evaluation.runs import Probe, Run


def write_report(
    words: Sequence[str], store: Store, out: Path, gallery: int = 24, different_data: bool = False, title: str | None = None
) -> list[Path]:
    """Write the page, JSON, Markdown and, of runs, the picture; returns their paths.

    words: artifacts as ``Store.resolve`` takes them, or ``NAME=KEY`` with the name that the page shall use. gallery: at most so
    many views are shown. different_data: show runs together that were evaluated on different scenes.
    """
    from stages.renderformer.evaluation import report, tables

    if out.suffix.lower() != ".html":
        raise UserError(f"{out}: the page must end in .html; the other files lie beside it")
    if not out.parent.is_dir():
        raise UserError(f"{out.parent} is not a folder: make it first")
    beside = [out.with_suffix(suffix) for suffix in (".json", ".md", ".png")]
    if not out.exists() and (existing := [path.name for path in beside if path.exists()]):
        raise UserError(f"{' and '.join(existing)} would be replaced, and there is no report {out.name}: give another name")
    runs, probes = load(words, store)
    if not different_data:
        check_same(runs)
    page = report.page(runs, probes, gallery, title)
    numbers = json.dumps(tables.numbers(runs, probes), indent=1, allow_nan=False) + "\n"
    files = {
        out: page.encode(),
        out.with_suffix(".json"): numbers.encode(),
        out.with_suffix(".md"): tables.side_by_side(runs, probes).encode(),
    }
    picture = report.overview(runs) if runs and gallery else None  # which alone reads the shards
    if picture:
        files[out.with_suffix(".png")] = picture
    for path, data in files.items():
        write_atomic(path, data)
    return list(files)


def load(words: Sequence[str], store: Store) -> tuple[list[Run], list[Probe]]:
    """Runs and probes in the order in which they were given."""
    from stages.renderformer.evaluation.runs import load_probe, load_run

    named_artifacts: list[tuple[str, Artifact]] = []
    for word in words:
        name, _, reference = word.rpartition("=")
        artifact = store.resolve(reference)
        if artifact.stage not in ("evaluate", "probe"):
            raise UserError(f"{reference} is an artifact of stage {artifact.stage}: a report shows those of evaluate and probe")
        named_artifacts.append((name, artifact))
    for key, count in Counter(artifact.key for _, artifact in named_artifacts).items():
        if count > 1:
            raise UserError(f"{key[:12]} is given {count} times: once is enough")
    evaluated = [(name, artifact) for name, artifact in named_artifacts if artifact.stage == "evaluate"]
    names = [name or default for (name, _), default in zip(evaluated, default_names(evaluated), strict=True)]
    for name, count in Counter(names).items():
        if count > 1:
            raise UserError(f"{count} runs are called {name!r}: give NAME=KEY")
    runs = [load_run(artifact, name) for name, (_, artifact) in zip(names, evaluated, strict=True)]
    return runs, [load_probe(artifact) for _, artifact in named_artifacts if artifact.stage == "probe"]


def default_names(evaluated: Sequence[tuple[str, Artifact]]) -> list[str]:
    """The models' names (``tiny``); where that would be said of two, the train artifacts' (``tiny-0123456789ab``)."""
    keys = [artifact.manifest["preimage"]["inputs"]["train"] for _, artifact in evaluated]
    trained = [store_of(artifact).find("train", key) for key, (_, artifact) in zip(keys, evaluated, strict=True)]
    folders = [train.path.name if train is not None else key[:12] for train, key in zip(trained, keys, strict=True)]
    if len(set(folders)) < len(folders):  # one model on several data
        folders = [f"{folder} on {artifact.path.name}" for folder, (_, artifact) in zip(folders, evaluated, strict=True)]
        return folders
    short = [folder.rpartition("-")[0] or folder for folder in folders]
    return [name if short.count(name) == 1 else folder for name, folder in zip(short, folders, strict=True)]


def check_same(runs: Sequence[Run]) -> None:
    """UserError unless all runs were evaluated on the same scenes."""
    for run in runs[1:]:
        first = runs[0]
        if run.targets != first.targets:
            shared = sum(run.targets.get(id) == target for id, target in first.targets.items())
            names = [
                f"{one.name} on {len(one.targets)} {data['split']} scenes of shard {data['key'][:12]}"
                for one in (first, run)
                for data in (one.summary["data"],)
            ]
            raise UserError(
                f"the runs were evaluated on different scenes ({'; '.join(names)}; {shared} in common), so that their averages "
                "do not tell which is better: evaluate them on one dataset, or give --different-data to show them all the same"
            )
