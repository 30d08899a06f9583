"""From scores per view to the report's numbers: averages, confidence intervals, verdicts, breakdowns, paired differences.

Averages are over images, as in the paper's table 1. Views of one scene are not independent, so intervals come from a
bootstrap over *scenes*; its generator is fixed, so the interval is a function of the scores. Differences are taken view by
view before they are averaged: what makes a view hard is the same for both and drops out.

Resampling few scenes makes intervals that are too narrow: its variance is (n - 1) / n of what it should be, and it knows
nothing of how uncertain that is. The ends' distances from the mean are therefore multiplied by t / 1.96 sqrt(n / (n - 1)), t
being the 97.5 % quantile of Student's distribution of n - 1 degrees of freedom (Hesterberg 2015): 1.06 for 32 scenes, 1.9 for
4. One or two have no interval.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np

from stages.graphics.metrics import METRICS, Metric

METHODS: Mapping[str, str] = {
    "model": "model",
    "mean_image": "mean training image",
    "constant": "best constant colour per scene (oracle)",
    "direct": "direct light only (reference)",
    "closed_form": "closed form alone, nothing learned",  # only of models that start from one
}
BARS = ("mean_image", "constant")  # what the model has to beat ...
JUDGED = ("psnr", "log_error")  # ... in these metrics
RESAMPLES = 2000
LEAST_SCENES = 3  # for an interval: that of two would be nine times as wide as they lie apart

Scene = Mapping[str, Any]  # a record's metrics.json, see stages.renderformer.s07_evaluate
View = Mapping[str, Any]  # one of its views
Estimate = Mapping[str, Any]  # of `bootstrap`

TRIANGLE_EDGES = (256, 384, 512, 640, 768, 1024, 1536, 2048, 3072, 4096, 8192)
TRIANGLE_BINS = (*(f"{a + 1}–{b}" for a, b in pairwise((0, *TRIANGLE_EDGES))), f"> {TRIANGLE_EDGES[-1]}")
ROUGHNESS_EDGES = (0.1, 0.2, 0.4, 0.7)
ROUGHNESS_BINS = (
    f"< {ROUGHNESS_EDGES[0]}",
    *(f"{a}–{b}" for a, b in pairwise(ROUGHNESS_EDGES)),
    f"≥ {ROUGHNESS_EDGES[-1]}",
    "nothing glossy",
)


@dataclass(frozen=True)
class Breakdown:
    """A way to put views into bins: ``value`` names a view's, ``about`` says in words how they are made."""

    title: str
    about: str
    value: Callable[[Scene, View], Any]
    bins: Sequence[Any] | None = None  # all there are, in order; None: as many as there are values

    def order(self, value: Any) -> Any:
        """Sorts bins."""
        return value if self.bins is None else self.bins.index(value)


BREAKDOWNS: Mapping[str, Breakdown] = {
    "template": Breakdown("template", "one bin each", lambda scene, view: scene["template"]),
    "triangles": Breakdown(
        "triangles",
        "the scene's, walls and lights included; a bin holds its upper edge",
        lambda scene, view: TRIANGLE_BINS[bisect_left(TRIANGLE_EDGES, scene["triangles"])],
        TRIANGLE_BINS,
    ),
    "lights": Breakdown("lights", "one bin for each number", lambda scene, view: scene["lights"]),
    "roughness": Breakdown(
        "roughness",
        "the mean over the view's pixels, each weighted by the specular reflectance that it shows; a bin holds its lower edge",
        lambda scene, view: ROUGHNESS_BINS[
            -1 if view["roughness"] is None else bisect_right(ROUGHNESS_EDGES, view["roughness"])
        ],
        ROUGHNESS_BINS,
    ),
}


@lru_cache(maxsize=8)
def _draws(count: int) -> np.ndarray:
    """(RESAMPLES, count): how often each of ``count`` scenes is in each resample; always the same."""
    return np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), size=RESAMPLES)


@lru_cache(maxsize=64)
def _widening(count: int) -> float:
    """What the distance from the mean to an end of a percentile interval of ``count`` scenes is multiplied by."""
    from scipy.special import ndtri, stdtrit

    return float(stdtrit(count - 1, 0.975) / ndtri(0.975) * np.sqrt(count / (count - 1)))


def bootstrap(values: Sequence[Sequence[float]], bounds: tuple[float, float] = (-np.inf, np.inf)) -> Estimate:
    """Mean over all values (one sequence per scene) and its 95 % interval under resampling of scenes.

    ``{"mean", "low", "high"}``; of fewer than `LEAST_SCENES` the ends are None. ``bounds``: of what a value can be.
    """
    sums = np.array([sum(scene) for scene in values])
    counts = np.array([len(scene) for scene in values])
    mean, count = float(sums.sum() / counts.sum()), len(values)
    if count < LEAST_SCENES:
        return {"mean": mean, "low": None, "high": None}
    draws = _draws(count)
    ends = np.percentile((draws @ sums) / (draws @ counts), [2.5, 97.5])
    low, high = np.clip(mean + (ends - mean) * _widening(count), *bounds)
    return {"mean": mean, "low": float(low), "high": float(high)}


def decided(value: Estimate) -> bool:
    """Whether the interval leaves no doubt about the sign."""
    return value["low"] is not None and (value["low"] > 0 or value["high"] < 0)


def with_interval(value: Estimate, show: Callable[[float], str], bold: bool = False) -> str:
    """``mean [low, high]`` as text, in Markdown."""
    mean = f"**{show(value['mean'])}**" if bold else show(value["mean"])
    return mean if value["low"] is None else f"{mean} [{show(value['low'])}, {show(value['high'])}]"


def _column(scenes: Iterable[Scene], method: str, metric: str) -> list[list[float]]:
    return [[view["scores"][method][metric] for view in scene["views"]] for scene in scenes]


def _gain(metric: Metric, ours: Sequence[Sequence[float]], theirs: Sequence[Sequence[float]]) -> Estimate:
    """How much better ours is, view by view; positive is better whatever the metric."""
    sign = 1 if metric.higher_is_better else -1
    return bootstrap([[sign * (a - b) for a, b in zip(*pair, strict=True)] for pair in zip(ours, theirs, strict=True)])


def _breakdown(scenes: Sequence[Scene], key: str, metrics: Mapping[str, Metric]) -> list[dict[str, Any]]:
    """Averages over the views of each bin, the model's with their intervals; bins in order."""
    breakdown = BREAKDOWNS[key]
    bins: dict[Any, dict[str, list[View]]] = {}
    for scene in scenes:
        for view in scene["views"]:
            bins.setdefault(breakdown.value(scene, view), {}).setdefault(scene["id"], []).append(view)
    out = []
    for value in sorted(bins, key=breakdown.order):
        some = [{"views": views} for views in bins[value].values()]
        row: dict[str, Any] = {"value": value, "scenes": len(some), "views": sum(len(scene["views"]) for scene in some)}
        for method in methods_of(scenes):
            row[method] = {name: float(np.mean(np.concatenate(_column(some, method, name)))) for name in metrics}
        model = {name: bootstrap(_column(some, "model", name), metric.bounds) for name, metric in metrics.items()}
        row["interval"] = {n: None if value["low"] is None else [value["low"], value["high"]] for n, value in model.items()}
        out.append(row)
    return out


def methods_of(scenes: Sequence[Scene]) -> list[str]:
    """The methods that the scenes' views were scored with."""
    scored = scenes[0]["views"][0]["scores"]
    return [method for method in METHODS if method in scored]


def summarise(scenes: Sequence[Scene], metrics: Mapping[str, Metric] = METRICS) -> dict[str, Any]:
    """Everything that the report says of one run in numbers, as plain JSON."""
    methods = methods_of(scenes)
    columns = {method: {name: _column(scenes, method, name) for name in metrics} for method in methods}
    gains = {
        other: {name: _gain(metric, columns["model"][name], columns[other][name]) for name, metric in metrics.items()}
        for other in methods
        if other != "model"
    }
    return {
        "scenes": len(scenes),
        "views": sum(len(scene["views"]) for scene in scenes),
        "methods": {
            method: {name: bootstrap(column, metrics[name].bounds) for name, column in row.items()}
            for method, row in columns.items()
        },
        "gains": gains,
        "beats_baselines": all(gains[bar][name]["mean"] > 0 for bar in BARS for name in JUDGED),
        "bins": {key: breakdown.about for key, breakdown in BREAKDOWNS.items()},
        "by": {key: _breakdown(scenes, key, metrics) for key in BREAKDOWNS},
        "per_scene": list(scenes),
    }


def difference(
    ours: Sequence[Scene], theirs: Sequence[Scene], same: Collection[str], metrics: Mapping[str, Metric] = METRICS
) -> dict[str, Any] | None:
    """How much better one run's model is than another's, ``{"scenes", "views", "gains": {metric: bootstrap}}``.

    Paired view by view over the scenes ``same``, whose data is the same for both; None where they are fewer than two, which
    would say nothing of a third. Positive is better whatever the metric.
    """
    if len(same) < 2:
        return None
    pairs = [sorted((scene for scene in run if scene["id"] in same), key=lambda scene: scene["id"]) for run in (ours, theirs)]
    gains = {name: _gain(metric, *(_column(run, "model", name) for run in pairs)) for name, metric in metrics.items()}
    return {"scenes": len(same), "views": sum(len(scene["views"]) for scene in pairs[0]), "gains": gains}


def worst_first(runs: Sequence[Sequence[Scene]], limit: int) -> list[tuple[int, list[Scene], list[View]]]:
    """(rank, the scene and the view as each run has it) of the views that all ``runs`` have, worst first.

    Sorted by the models' PSNR, averaged over the runs; at most ``limit``, evenly spaced from worst to best.
    """
    views = [{(scene["id"], view["index"]): (scene, view) for scene in run for view in scene["views"]} for run in runs]
    shared = set.intersection(*map(set, views))

    def psnr(place: tuple[str, int]) -> float:
        return sum(run[place][1]["scores"]["model"]["psnr"] for run in views) / len(views)

    places = sorted(shared, key=lambda place: (psnr(place), place))
    ranks = sorted({round(i) for i in np.linspace(0, len(places) - 1, min(limit, len(places)))})
    return [(rank + 1, *map(list, zip(*(run[places[rank]] for run in views), strict=True))) for rank in ranks]
