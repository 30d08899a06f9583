"""The ceiling: what a model would score that predicted the noiseless truth.

The targets are path traced and denoised, so they differ from the noiseless truth by an error of their own, and a perfect model
is charged for it. Two things are known of that error, both noted by *render* in a view's meta:

- Some views were rendered twice, independently. Half the mean squared difference of such a pair is the mean squared error
  that noise leaves in one image, so ``PSNR(A, B) + 3.01 dB`` is the PSNR of the noiseless truth against one of them
  (``stages.renderformer.rendering.noise``). The ceiling in dB is the mean of that over the pairs, as the model's PSNR is a
  mean over views. It lacks what both renders share (the denoiser's bias): the real ceiling is at most this high.
- Every view has an estimate of its mean absolute error of log10(1 + x), the denoiser's bias included
  (``stages.renderformer.rendering.error``). Its mean over the evaluated views is the least log error that can be expected.

For SSIM, FLIP and LPIPS no formula leads from a pair's score to that of the truth. So some of the evaluated views are
rendered once more, with the settings of *render* and random numbers of their own, and the second image is scored against the
target. The truth would score better than that, as it has no noise of its own. Tone-mapped PSNR has the formula of PSNR.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.keys import seed_for
from pipeline.store import history
from stages.graphics.metrics import METRICS, PSNR_MAX, Metric, measure_all
from stages.graphics.mitsuba import backend as backends
from stages.graphics.statistics import Scene, bootstrap
from stages.renderformer.dataset import decode_sample
from stages.renderformer.rendering.render import render_views
from stages.renderformer.rendering.settings import RenderSettings

if TYPE_CHECKING:
    from pipeline.store import Artifact

ENOUGH = 20  # pairs of the evaluated split; where it has fewer, all splits are asked: their noise has the same law
MOST = 20000  # scenes whose meta is read for them
TOLD_BY_DATA = ("psnr", "log_error")  # metrics whose ceiling the data's own figures tell
HALVED_DB = 10 * np.log10(2)  # the truth has half the squared error against an image that a second one has


def view_noise(meta: Mapping[str, Any], camera: int) -> dict[str, Any]:
    """What is known of the noise in one view, from its sample's meta.

    ``log_error``: estimated, or None; ``pair``: the error of one image of a pair, ``{"log_error", "psnr"}``, or None.
    """
    noted = next(view for view in meta["render"]["views"] if view["index"] == camera)
    return {"log_error": noted["error"], "pair": noted["noise"]["sum"] if "noise" in noted else None}


def noise_pairs(shard: Artifact, split: str) -> tuple[list[list[dict[str, float]]], str]:
    """Per scene that has some, the errors told by its pairs; and the split that they are of, or "all splits"."""
    from stages.graphics.arrays import unpack_json

    def of(ids: list[str]) -> list[list[dict[str, float]]]:
        scene_pairs = []
        for id in ids[:: len(ids) // MOST + 1]:
            meta = unpack_json(shard.read(id, ("meta.json",)).members["meta.json"])
            pairs = [view_noise(meta, camera)["pair"] for camera in meta["views"]]
            scene_pairs.append([pair for pair in pairs if pair is not None])
        return [pairs for pairs in scene_pairs if pairs]

    split_pairs = of(shard.ids(split))
    return (split_pairs, split) if sum(map(len, split_pairs)) >= ENOUGH else (of(shard.ids()), "all splits")


def ceiling(scenes: Sequence[Scene], split: str, pairs: Sequence[Sequence[Mapping[str, float]]], where: str) -> dict[str, Any]:
    """Metric -> its ceiling ``{"mean", "low", "high", "views", "scenes", "of", "from"}``; metrics without one are left out.

    scenes: those evaluated, of ``split``. pairs, where: see `noise_pairs`.
    """
    ceilings = {}

    def add(metric: str, values: Sequence[Sequence[float]], of: str, source: str) -> None:
        if values:
            counts = {"views": sum(map(len, values)), "scenes": len(values)}
            ceilings[metric] = {**bootstrap(values, METRICS[metric].bounds), **counts, "of": of, "from": source}

    estimates = [[view["noise"]["log_error"] for view in scene["views"]] for scene in scenes]
    estimates = [known for scene in estimates if (known := [value for value in scene if value is not None])]
    add("psnr", [[pair["psnr"] for pair in scene] for scene in pairs], where, "pairs")
    if estimates:
        add("log_error", estimates, split, "estimates")
    else:
        add("log_error", [[pair["log_error"] for pair in scene] for scene in pairs], where, "pairs")
    return ceilings


def render_ceilings(shard: Artifact, split: str, count: int, metrics: Mapping[str, Metric]) -> dict[str, Any]:
    """Ceilings, as `ceiling` gives them, of the metrics that are not told by the data: from ``count`` views rendered again.

    At most a view of each scene. Nothing where the shards do not come from *render*.
    """
    rendered = history({"shard": shard}).get("render")
    if rendered is None or not count:
        return {}
    params = rendered["params"]
    given = {field.name: params[field.name] for field in fields(RenderSettings) if field.name in params}
    backend, ids = backends.choose(), shard.ids(split)
    scores = []
    for place in np.unique(np.linspace(0, len(ids) - 1, min(count, len(ids))).round().astype(int)):
        sample = decode_sample(shard.read(ids[place]))
        camera, view = next(iter(sample.views.items()))
        settings = RenderSettings(**given | {"seed": seed_for(params["seed"], "evaluate/ceiling", ids[place])})
        again = render_views(sample.scene, settings, backend, [camera])[0]
        scores.append(measure_all(view.image, again.image, metrics))
    ceilings = {}
    for name, metric in metrics.items():
        if name in TOLD_BY_DATA:
            continue
        values = [[min(row[name] + HALVED_DB, PSNR_MAX) if name == "psnr_tm" else row[name]] for row in scores]
        source = "pairs" if name == "psnr_tm" else "second renders"
        counts = {"views": len(scores), "scenes": len(scores)}
        ceilings[name] = {**bootstrap(values, metric.bounds), **counts, "of": split, "from": source}
    return ceilings
