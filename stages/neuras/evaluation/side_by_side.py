"""Evaluations of several fits of one capture, side by side: the paper's tables of baselines and of what is left out."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.errors import UserError
from pipeline.store import Store
from stages.graphics.metrics import Metric
from stages.graphics.page import Table, markdown
from stages.graphics.statistics import bootstrap, with_interval
from stages.neuras.evaluation.distributions import METRICS as DISTRIBUTION_METRICS
from stages.neuras.evaluation.report import main_groups
from stages.neuras.evaluation.scores import told
from stages.neuras.evaluation.summary import METHODS

Scores = Mapping[str, float]  # of one view


@dataclass(frozen=True)
class Run:
    """An evaluation and how it is called."""

    name: str
    capture: str
    summary: Mapping[str, Any]
    scored: tuple[tuple[str, str], ...] = ()  # settings that decide which pixels are scored, and after which help

    @classmethod
    def of(cls, store: Store, reference: str) -> Run:
        """``NAME=KEY``, or KEY, which is its own name then. UserError where it is no evaluation."""
        name, _, key = reference.rpartition("=")
        artifact = store.resolve(key)
        if artifact.stage != "evaluate" or "bake" not in artifact.manifest["preimage"]["inputs"]:
            raise UserError(f"{artifact.name} is no evaluation of a fitted scene: `lightmill ls neuras/evaluate` lists them")
        summary = json.loads(artifact.file("metrics.json").read_bytes())
        config = artifact.manifest["config"]
        scored = tuple((name, config.get(name, "none")) for name in ("exposure", "poses"))
        return cls(name or artifact.name, artifact.manifest["preimage"]["inputs"]["capture"], summary, scored)

    def scores(self, ids: Sequence[str], method: str) -> list[Scores]:
        views = {view["id"]: view["scores"] for view in self.summary["per_view"]}
        return [views[id][method] for id in ids]


def side_by_side(runs: Sequence[Run]) -> Table:
    """Means of ours for every run, and of warping; how much better the first run is than each, paired view by view.

    UserError where the runs are not of the same frames of one capture.
    """
    first = runs[0]
    seen = {(run.capture, *sorted(view["id"] for view in run.summary["per_view"])) for run in runs}
    if len(seen) > 1:
        raise UserError("these evaluations are not of the same frames of one capture: their scores cannot be compared")
    if len({run.scored for run in runs}) > 1:
        ways = "; ".join(f"{run.name}: " + " ".join(f"evaluate.{name}={how}" for name, how in run.scored) for run in runs)
        raise UserError(
            f"these evaluations do not score the same pixels, so they cannot be compared ({ways}): evaluate all with the same"
        )
    columns = [(run.name, run, "ours") for run in runs] + [(METHODS["warping"], first, "warping")]
    rows: list[list[Any]] = []
    for group in main_groups(first.summary):
        for name, metric in told(set.intersection(*(set(run.scores(group["ids"], "ours")[0]) for run in runs))).items():
            scores = [[row[name] for row in run.scores(group["ids"], method)] for _, run, method in columns]
            means = [metric.format(sum(column) / len(column)) for column in scores]
            gains = [_gain(metric, scores[0], column) for column in scores[1:]]
            rows.append([f"{group['label']}: {metric.heading}", *means, *gains])
    rows += _distributions(runs)
    rows.append(["stored (MB)", *(f"{run.summary['storage']['stored'] / 1e6:.2f}" for run in runs), *[None] * len(columns)])
    better = [f"{first.name} better than {name}" for name, _, _ in columns[1:]]
    return Table(["views and metric", *(name for name, _, _ in columns), *better], rows, numeric=True)


def _distributions(runs: Sequence[Run]) -> list[list[Any]]:
    """FID and KID beside the drive, where every run has them. They are of whole sets, so there is no pair to subtract."""
    measured = [{row["label"]: row for row in run.summary.get("distributions", [])} for run in runs]
    rows: list[list[Any]] = []
    for label in measured[0]:
        if all(label in sets for sets in measured):
            for name, metric in DISTRIBUTION_METRICS.items():
                values = [sets[label]["methods"]["ours"][name] for sets in measured]
                values.append(measured[0][label]["methods"]["warping"][name])
                rows.append([f"{label}: {metric.heading}", *map(metric.format, values), *[None] * len(runs)])
    return rows


def _gain(metric: Metric, ours: Sequence[float], theirs: Sequence[float]) -> str:
    sign = 1 if metric.higher_is_better else -1
    pairs = zip(ours, theirs, strict=True)
    return with_interval(bootstrap([[sign * (a - b)] for a, b in pairs]), lambda value: metric.format(value, "+"))


def written(store: Store, references: Sequence[str]) -> str:
    """The table of these evaluations, in Markdown."""
    table = side_by_side([Run.of(store, reference) for reference in references])
    return "\n".join(markdown.table(table.columns, table.rows, table.numeric))
