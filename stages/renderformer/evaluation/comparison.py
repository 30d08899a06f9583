"""Models on one dataset, side by side: each a file of ``conf/renderformer/experiment/<table>/``, all of them on one page.

Trains and evaluates what is missing of the rows; writes ``report.html``, ``report.json`` and ``report.md``.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipeline.errors import INTERRUPTED
from pipeline.experiments import Jobs, Order, Table, made, only_planned
from pipeline.store import store_of


def jobs_of(table: str, names: Sequence[str] | None, overrides: Sequence[str]) -> Jobs:
    """The rows' names and jobs. UserError unless all of them read the same shards."""
    rows = Table.of("renderformer", table)
    jobs = rows.jobs(names, overrides)
    rows.one_artifact(jobs, "shard", "model and training")
    return jobs


def sweep(order: Order) -> int:
    """Make what is missing of the rows, then the page; returns the exit status."""
    jobs = jobs_of(order.table, order.rows, order.overrides)
    table = Table.of("renderformer", order.table)
    status = table.make(table.chosen(order.rows), order.overrides, len(jobs), order.until)
    if order.until != "evaluate" or status == INTERRUPTED or only_planned(jobs):
        return status
    return max(status, write_page(order.table, order.rows, order.overrides, order.out))


def write_page(table: str, names: Sequence[str] | None, overrides: Sequence[str], out: Path) -> int:
    """The page of the rows that the store holds; 1 if one that was asked for is not there."""
    from stages.renderformer.evaluation.side_by_side import write_report

    jobs = jobs_of(table, names, overrides)
    status = Table.of("renderformer", table).tell_missing([row for row, job in jobs if made(job) is None])
    found = [(row, artifact) for row, job in jobs if (artifact := made(job)) is not None]
    if found:
        out.mkdir(parents=True, exist_ok=True)
        rows = [row for row, _ in found]
        runs = [f"{row if rows.count(row) == 1 else f'{row}-{run.key[:6]}'}={run.key}" for row, run in found]
        print(write_report(runs, store_of(found[0][1]), out / "report.html")[0])
    return status
