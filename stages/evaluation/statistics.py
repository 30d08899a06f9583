"""From scores per view to the report's numbers: averages, confidence intervals, verdicts, breakdowns.

Averages are over images, as in the paper's table 1. Views of one scene are not independent, so intervals come from a
bootstrap over *scenes*; its generator is fixed, so the interval is a function of the scores.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from stages.metrics import METRICS, Metric

METHODS: Mapping[str, str] = {
    "model": "model",
    "mean_image": "mean training image",
    "constant": "best constant colour per scene (oracle)",
    "direct": "direct light only (reference)",
}
BARS = ("mean_image", "constant")  # what the model has to beat ...
JUDGED = ("psnr", "log_error")  # ... in these metrics
RESAMPLES = 2000

Scene = Mapping[str, Any]  # a record's metrics.json, see stages.s07_evaluate


def bootstrap(values: Sequence[Sequence[float]]) -> dict[str, float]:
    """Mean over all values (one sequence per scene) and its 95 % interval under resampling of scenes."""
    sums = np.array([sum(scene) for scene in values])
    counts = np.array([len(scene) for scene in values])
    draws = np.random.default_rng(0).multinomial(len(values), np.full(len(values), 1 / len(values)), size=RESAMPLES)
    low, high = np.percentile((draws @ sums) / (draws @ counts), [2.5, 97.5])
    return {"mean": float(sums.sum() / counts.sum()), "low": float(low), "high": float(high)}


def _column(scenes: Sequence[Scene], method: str, metric: str) -> list[list[float]]:
    return [[view["scores"][method][metric] for view in scene["views"]] for scene in scenes]


def _gain(scenes: Sequence[Scene], metric: Metric, bar: str) -> dict[str, float]:
    """How much better the model is than a bar, view by view; positive is better whatever the metric."""
    sign = 1 if metric.higher_is_better else -1
    columns = zip(_column(scenes, "model", metric.name), _column(scenes, bar, metric.name), strict=True)
    return bootstrap([[sign * (a - b) for a, b in zip(*pair, strict=True)] for pair in columns])


def _breakdown(scenes: Sequence[Scene], key: str, metrics: Mapping[str, Metric]) -> list[dict[str, Any]]:
    """The model's averages over the scenes of each value of ``key``."""
    out = []
    for value in sorted({scene[key] for scene in scenes}):
        some = [scene for scene in scenes if scene[key] == value]
        means = {name: bootstrap(_column(some, "model", name))["mean"] for name in metrics}
        out.append({"value": value, "scenes": len(some), "views": sum(len(s["views"]) for s in some), "model": means})
    return out


def summarise(scenes: Sequence[Scene], metrics: Mapping[str, Metric] = METRICS) -> dict[str, Any]:
    """Everything that the report says in numbers, as plain JSON."""
    gains = {bar: {name: _gain(scenes, metric, bar) for name, metric in metrics.items()} for bar in BARS}
    return {
        "scenes": len(scenes),
        "views": sum(len(scene["views"]) for scene in scenes),
        "methods": {method: {name: bootstrap(_column(scenes, method, name)) for name in metrics} for method in METHODS},
        "gains": gains,
        "beats_baselines": all(gains[bar][name]["mean"] > 0 for bar in BARS for name in JUDGED),
        "by": {key: _breakdown(scenes, key, metrics) for key in ("template", "lights")},
        "per_scene": list(scenes),
    }


def worst_first(scenes: Sequence[Scene], limit: int) -> list[tuple[int, Scene, Mapping[str, Any]]]:
    """(rank, scene, view) by the model's PSNR, lowest first; at most ``limit``, evenly spaced from worst to best."""
    pairs = [(scene, view) for scene in scenes for view in scene["views"]]
    pairs.sort(key=lambda pair: (pair[1]["scores"]["model"]["psnr"], pair[0]["id"], pair[1]["index"]))
    ranks = sorted({round(i) for i in np.linspace(0, len(pairs) - 1, min(limit, len(pairs)))})
    return [(rank + 1, *pairs[rank]) for rank in ranks]
