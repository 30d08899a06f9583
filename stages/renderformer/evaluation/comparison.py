"""Models on one dataset, side by side: each a file of ``conf/renderformer/experiment/<table>/``, all of them on one page.

Trains and evaluates what is missing of the rows; writes ``report.html``, ``report.json`` and ``report.md``. One design choice:
a row is found by its key, computed from its config, so that the page never shows another run than the files describe.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.errors import UserError
from pipeline.hydra_config import CONF
from stages.renderformer.evaluation import ablation

if TYPE_CHECKING:
    from pipeline.sweep import Job

EXPERIMENTS = CONF / "renderformer" / "experiment"


def tables() -> list[str]:
    return sorted(path.name for path in EXPERIMENTS.iterdir() if path.is_dir() and path.name not in ablation.tables())


def rows_of(table: str, names: Sequence[str] | None) -> list[str]:
    """The rows' names, in the order of their files; all, or those of ``names``."""
    if table not in tables():
        raise UserError(f"table {table!r} is unknown: choose from {', '.join([*ablation.tables(), *tables()])}")
    every = sorted(path.stem for path in (EXPERIMENTS / table).glob("*.yaml"))
    if unknown := [name for name in names or () if name not in every]:
        raise UserError(f"row {', '.join(unknown)} is unknown: choose from {', '.join(every)}")
    return [name for name in every if names is None or name in names]


def words(table: str, rows: Sequence[str], stage: str = "evaluate") -> list[str]:
    return [f"stage={stage}", "experiment=" + ",".join(f"{table}/{row}" for row in rows)]


def jobs_of(table: str, names: Sequence[str] | None, overrides: Sequence[str]) -> list[tuple[str, Job]]:
    """Each row's name and jobs: one, or one for each value of what the overrides sweep, such as ``train.seed=0,1``.

    UserError unless all of them read the same shards.
    """
    from pipeline.sweep import expand

    rows = rows_of(table, names)
    jobs = [(row, job) for row in rows for job in expand([*words(table, [row]), *overrides])]
    shards = {job.keys["shard"] for _, job in jobs}
    if len(shards) > 1:
        raise UserError(
            f"the rows of {table} read {len(shards)} different datasets: they may differ in model and training alone"
        )
    return jobs


def sweep(table: str, names: Sequence[str] | None, overrides: Sequence[str], out: Path, until: str = "evaluate") -> int:
    """Make what is missing of the rows up to stage ``until``, then the page; returns the exit status.

    Unless ``jobs=N`` is among the overrides: as many rows at a time as there are cores, each with one thread; on a GPU, one.
    """
    from pipeline.__main__ import main as run_main
    from pipeline.plan import split_config
    from stages.graphics.device import choose_device

    jobs = jobs_of(table, names, overrides)
    at_once = []
    if not any(word.startswith("jobs=") for word in overrides):
        at_once = ["jobs=1" if choose_device("auto", "") == "cuda" else f"jobs={min(len(jobs), os.cpu_count() or 1)}"]
    status = run_main([*words(table, rows_of(table, names), until), *overrides, *at_once, "-m"])
    if until != "evaluate" or status == ablation.INTERRUPTED or split_config(jobs[0][1].root)[0].plan:
        return status
    return max(status, write_page(table, names, overrides, out))


def write_page(table: str, names: Sequence[str] | None, overrides: Sequence[str], out: Path) -> int:
    """The page of the rows that the store holds; 1 if one that was asked for is not there."""
    from pipeline.plan import split_config
    from pipeline.store import Store
    from stages.renderformer.evaluation.side_by_side import write_report

    jobs = jobs_of(table, names, overrides)
    store = Store(split_config(jobs[0][1].root)[0].store)
    found = [(row, job.plan["evaluate"].key) for row, job in jobs if store.find("evaluate", job.plan["evaluate"].key)]
    lacking = [row for row, job in jobs if job.plan["evaluate"].key not in [key for _, key in found]]
    if lacking:
        print(f"not in the store: {', '.join(lacking)} (lightmill sweep {table} makes what is missing)")
    if found:
        out.mkdir(parents=True, exist_ok=True)
        rows = [row for row, _ in found]
        runs = [f"{row if rows.count(row) == 1 else f'{row}-{key[:6]}'}={key}" for row, key in found]
        print(write_report(runs, store, out / "report.html")[0])
    return int(bool(lacking))
