"""The report: one HTML page with its pictures inside (it opens from disk and can be mailed), a Markdown table, JSON.

One design choice: a page shows any number of runs side by side, and the page that *evaluate* leaves is that of one run.
Pictures are plain sRGB. All pictures of a view share one exposure, which is named; a difference is taken between those
pictures, times 5. The page follows the reader's light or dark setting.
"""

from __future__ import annotations

import base64
import io
import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stages.graphics.statistics import BREAKDOWNS, decided, worst_first
from stages.graphics.tonemap import exposure_for, to_picture
from stages.renderformer.evaluation import plots, tables
from stages.renderformer.evaluation.runs import Images, Probe, Run
from stages.renderformer.evaluation.timing import PER_IMAGE, STEPS
from stages.renderformer.inference.compare import DIFFERENCE_GAIN, error_pictures

OVERVIEW_VIEWS = 10  # columns of overview.png
OVERVIEW_VIEW_PIXELS = 128  # least width of a column
TITLES = ("Probes of a model", "How close the model comes to the path tracer", "Models side by side")  # by number of runs
SHOWN = ("psnr", "ssim", "log_error", "flip")  # beside every view, and in breakdowns


def picture_uri(data: bytes) -> str:
    """A PNG as a data URI."""
    return "data:image/png;base64," + base64.b64encode(data).decode()


def png(pixels: np.ndarray) -> bytes:
    """(H, W, 3) uint8."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG", optimize=True)
    return buffer.getvalue()


def view_pictures(runs: Sequence[Images]) -> tuple[list[tuple[str, str]], list[list[tuple[str, str]]], float]:
    """Pictures of one view as [(caption, data URI)]: those that all runs share, those of each run; and the exposure."""
    target = runs[0]["target"]
    exposure = exposure_for(target)

    def uri(pixels: np.ndarray) -> str:
        return picture_uri(png(np.ascontiguousarray(pixels)))

    def own(prediction: np.ndarray) -> list[tuple[str, str]]:
        difference, flip = error_pictures(target, prediction, exposure)
        return [
            ("prediction", uri(to_picture(prediction, exposure))),
            (f"difference ×{DIFFERENCE_GAIN}", uri(difference)),
            ("HDR-FLIP error", uri(flip)),
        ]

    shared = [
        ("target", uri(to_picture(target, exposure))),
        ("direct light only", uri(to_picture(runs[0]["direct"], exposure))),
    ]
    return shared, [own(images["prediction"]) for images in runs], exposure


def overview(images: Sequence[Images], enlarge: int) -> np.ndarray:
    """One picture of many views, worst first: (2 H, n W, 3) uint8, targets above predictions, each pixel ``enlarge`` wide."""
    columns = []
    for view in images:
        exposure = exposure_for(view["target"])
        columns.append(np.concatenate([to_picture(view[name], exposure) for name in ("target", "prediction")]))
    return np.concatenate(columns, axis=1).repeat(enlarge, axis=0).repeat(enlarge, axis=1)


def gallery(runs: Sequence[Run], limit: int) -> tuple[list[dict[str, Any]], int]:
    """The views shown, worst first, and how many there are. Runs on different data show what they have in common."""
    same = tables.same_scenes(runs) if len(runs) > 1 else {scene["id"] for run in runs for scene in run.summary["per_scene"]}
    scenes = [[scene for scene in run.summary["per_scene"] if scene["id"] in same] for run in runs]
    rows = []
    for rank, found, views in worst_first(scenes, limit):
        images = [run.images(found[0]["id"], views[0]["index"]) for run in runs]
        shared, own, exposure = view_pictures(images)
        scores = [view["scores"]["model"] for view in views]
        facts = {"rank": rank, "scene": found[0], "view": views[0], "exposure": exposure, "scores": scores}
        rows.append({**facts, "shared": shared, "own": own})
    return rows, sum(len(scene["views"]) for scene in scenes[0]) if scenes else 0


def timing_rows(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """The median times as rows: ``{"label", "kind", "ms": a number or None per run}``; ``kind`` is scene, image or sum."""

    def of(steps: Sequence[str]) -> list[float | None]:
        return [1000 * sum(run.timing["median"][step] for step in steps) if run.timing else None for run in runs]

    once = [step for step in STEPS if step not in PER_IMAGE]
    kinds = {step: "image" if step in PER_IMAGE else "scene" for step in STEPS}
    rows = [{"label": label, "kind": kinds[step], "ms": of([step])} for step, label in STEPS.items()]
    rows.append({"label": "first image of a scene", "kind": "sum", "ms": of(list(STEPS))})
    rows.append({"label": "every further image", "kind": "sum", "ms": of(PER_IMAGE)})
    rows.append({"label": "share of the per-scene part in the first", "kind": "share", "ms": of(once)})
    total = rows[-3]["ms"]
    rows[-1]["ms"] = [part / whole if part is not None else None for part, whole in zip(rows[-1]["ms"], total, strict=True)]
    return rows


def _grouped(texts: Sequence[str], runs: Sequence[Run]) -> dict[str, str]:
    """Text -> the names of the runs of which it is true; "" where it is of all."""
    names = {text: [run.name for run, own in zip(runs, texts, strict=True) if own == text] for text in texts}
    return {text: "" if len(names) == 1 else ", ".join(found) for text, found in names.items()}


def page(runs: Sequence[Run], probes: Sequence[Probe] = (), limit: int = 24, title: str | None = None) -> str:
    """The whole report as HTML; at most ``limit`` views in the gallery."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    summaries = [run.summary for run in runs]
    metrics = tables.metrics_of(summaries)
    table = tables.columns(runs) if runs else []
    rows, views = gallery(runs, limit) if runs else ([], 0)
    same = tables.all_same(runs)
    named_runs = {run.name: run.summary for run in runs}
    return environment.get_template("report.html.j2").render(
        title=title or TITLES[min(len(runs), 2)],
        runs=runs,
        same=same,
        metrics=metrics,
        shown=[name for name in SHOWN if name in metrics],
        table=table,
        best=tables.best_of(table, metrics) if runs and same else dict.fromkeys(metrics),
        told=tables.told,
        decided=decided,
        verdicts=[tables.verdicts(summary) for summary in summaries],
        ceilings=_grouped([" ".join(tables.ceiling_lines(summary)) for summary in summaries], runs),
        shares=[(run.name, share) for run in runs if (share := tables.noise_share(run.summary)) is not None],
        differences=tables.differences(runs) if len(runs) > 1 else {},
        unlike=tables.unlike(runs) if len(runs) > 1 else {},
        breakdowns=BREAKDOWNS,
        plots=[plots.breakdowns(named_runs, metrics[name], same) for name in ("psnr", "log_error", "flip")] if runs else [],
        loss_svg=plots.loss_curves({run.name: run.log for run in runs}),
        colours=list(itertools.islice(itertools.cycle(plots.COLOURS), len(runs))),
        timing=timing_rows(runs) if any(run.timing for run in runs) else [],
        configs=[{stage: tables.flatten(config) for stage, config in run.configs.items()} for run in runs],
        rows=rows,
        views=views,
        probes=[
            {
                "facts": probe.facts,
                "key": probe.key,
                "figure": picture_uri(probe.figure.read_bytes()),
                "model": ", ".join(f"{name} {value[:12]}" for name, value in tables.flatten(probe.facts["model"])),
            }
            for probe in probes
        ],
    )


def write_evaluation(folder: Path, run: Run, gallery: int) -> None:
    """Write what *evaluate* leaves of one run: report.html, metrics.json, metrics.md and overview.png."""
    (folder / "report.html").write_text(page([run], limit=gallery), encoding="utf-8")
    shown = worst_first([run.summary["per_scene"]], OVERVIEW_VIEWS)
    if shown:
        views = [run.images(scene["id"], view["index"]) for _, (scene,), (view,) in shown]
        (folder / "overview.png").write_bytes(png(overview(views, max(1, OVERVIEW_VIEW_PIXELS // len(views[0]["target"])))))
    (folder / "metrics.md").write_text(tables.markdown(run.summary), encoding="utf-8")
    (folder / "metrics.json").write_text(json.dumps(run.summary, indent=1, allow_nan=False) + "\n", encoding="utf-8")
