"""Experiments: tables whose rows are config files, made as one sweep.

A table is a folder ``experiment/<table>/`` of a system's config folder, and each file in it a row. One design choice: a row is
found in the store by its key, computed from its config, so that a table never shows another run than its files describe. What
a table looks like is the system's business (``System.experiments``).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.__main__ import main as run_main
from pipeline.errors import UserError
from pipeline.gpus import visible_gpus
from pipeline.hydra_config import config_folder
from pipeline.plan import split_config
from pipeline.stage import load_system
from pipeline.store import Artifact, Store
from pipeline.sweep import Job, expand

Jobs = Sequence[tuple[str, Job]]  # rows' names, and their jobs: several of a row where the overrides sweep


@dataclass(frozen=True)
class Table:
    """A table of a system. rows: names of its files, in the order in which they are shown."""

    system: str
    name: str
    rows: tuple[str, ...]

    @classmethod
    def of(cls, system: str, name: str, order: Sequence[str] = ()) -> Table:
        """The table in the system's config folder; rows as in ``order``, others after them. UserError: there is none."""
        known = tables(system)
        if name not in known:
            raise UserError(f"table {name!r} is unknown: choose from {', '.join(known)}")
        names = sorted(path.stem for path in (_folder(system) / name).glob("*.yaml"))
        return cls(system, name, tuple(sorted(names, key=lambda row: list(order).index(row) if row in order else len(order))))

    def chosen(self, names: Sequence[str] | None) -> list[str]:
        """The rows of these names, in the table's order; all of them where None."""
        if unknown := [name for name in names or () if name not in self.rows]:
            raise UserError(f"row {', '.join(unknown)} is unknown: choose from {', '.join(self.rows)}")
        return [row for row in self.rows if names is None or row in names]

    def words(self, rows: Sequence[str], stage: str = "evaluate") -> list[str]:
        """Overrides that sweep over the rows."""
        return [f"system={self.system}", f"stage={stage}", "experiment=" + ",".join(f"{self.name}/{row}" for row in rows)]

    def jobs(self, names: Sequence[str] | None, overrides: Sequence[str]) -> list[tuple[str, Job]]:
        """The rows' names and jobs: one, or one for each value of what the overrides sweep, such as ``train.seed=0,1``.

        UserError where the overrides undo what tells two rows apart: a table would show one run as two.
        """
        jobs = [(row, job) for row in self.chosen(names) for job in expand([*self.words([row]), *overrides])]
        rows: dict[tuple[str, ...], str] = {}
        for row, job in jobs:
            other = rows.setdefault(tuple(job.keys.values()), row)
            if other != row:
                raise UserError(
                    f"with these overrides the rows {other} and {row} of {self.name} are the same run: "
                    f"one of them replaces what the rows say ({', '.join(overrides)})"
                )
        return jobs

    def make(self, rows: Sequence[str], overrides: Sequence[str], jobs: int, until: str = "evaluate") -> int:
        """Make what is missing of the rows up to stage ``until``; returns the exit status.

        Unless ``jobs=N`` is among the overrides, as many of the ``jobs`` run at a time as there are cores, each with its share
        of the threads; on a GPU, one.
        """
        at_once = []
        if not any(word.startswith("jobs=") for word in overrides):
            at_once = [f"jobs={1 if visible_gpus() else min(jobs, os.cpu_count() or 1)}"]
        return run_main([*self.words(rows, until), *overrides, *at_once, "-m"])

    def one_artifact(self, jobs: Jobs, stage: str, may_differ: str) -> None:
        """UserError unless all rows read the same artifact of ``stage``. may_differ: in words, what rows may differ in."""
        keys = {job.keys[stage] for _, job in jobs}
        if len(keys) > 1:
            raise UserError(
                f"the rows of {self.name} read {len(keys)} different artifacts of stage {stage}: "
                f"they may differ in {may_differ} alone"
            )

    def tell_missing(self, rows: Sequence[str]) -> int:
        """Name the rows that the store does not have and what makes them; returns the exit status, 1 if there are any."""
        if rows:
            print(f"not in the store: {', '.join(dict.fromkeys(rows))} (lightmill sweep {self.name} makes what is missing)")
        return int(bool(rows))


@dataclass(frozen=True)
class Order:
    """What a person asks for. rows: None for all. out: the folder of what is written. until: the last stage."""

    table: str
    rows: Sequence[str] | None
    overrides: Sequence[str]
    out: Path
    until: str = "evaluate"


@dataclass(frozen=True)
class Experiments:
    """What a system does with its tables. default: the table of `make sweep`.

    sweep: makes what is missing, then writes the table. write: of what the store holds. Both return the exit status.
    """

    default: str
    sweep: Callable[[Order], int]
    write: Callable[[Order], int]


def experiments_of(system: str) -> Experiments:
    loaded = load_system(system)
    if not loaded.experiments:
        raise UserError(f"system={system} has no tables")
    found = loaded.load(loaded.experiments)
    assert isinstance(found, Experiments)
    return found


def tables(system: str) -> list[str]:
    """Names of the system's tables: folders of configs."""
    folder = _folder(system)
    return sorted(path.name for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []


def made(job: Job, stage: str = "evaluate") -> Artifact | None:
    """The artifact of the job's stage, if the store has it."""
    planned = job.plan[stage]
    return Store(split_config(job.root)[0].store).find(planned.place, planned.key)


def only_planned(jobs: Iterable[tuple[str, Job]]) -> bool:
    """Whether the overrides ask for a plan alone."""
    return any(split_config(job.root)[0].plan for _, job in jobs)


def _folder(system: str) -> Path:
    return config_folder(load_system(system)) / "experiment"
