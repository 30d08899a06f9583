"""The report: one HTML page with its pictures inside (it opens from disk and can be mailed), a Markdown table, JSON.

One design choice: a page shows any number of runs side by side, and the page that *evaluate* leaves is that of one run.
Pictures are plain sRGB. All pictures of a view share one exposure, which is named; a difference is taken between those
pictures, times 5. The page follows the reader's light or dark setting.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stages.graphics.metrics import Metric
from stages.graphics.page import Cell, Picture, Table, embed, png, render
from stages.graphics.statistics import BREAKDOWNS, decided, worst_first
from stages.graphics.tonemap import exposure_for, to_picture
from stages.renderformer.evaluation import plots, tables
from stages.renderformer.evaluation.regions import REGIONS
from stages.renderformer.evaluation.runs import Images, Probe, Run
from stages.renderformer.evaluation.timing import steps_of
from stages.renderformer.inference.compare import DIFFERENCE_GAIN, error_pictures

OVERVIEW_VIEWS = 10  # columns of overview.png
OVERVIEW_VIEW_PIXELS = 128  # least width of a column
TITLES = ("Probes of a model", "How close the model comes to the path tracer", "Models side by side")  # by number of runs
VIEW_METRICS = ("psnr", "ssim", "log_error", "flip")  # beside every view


@dataclass(frozen=True)
class View:
    """One view in the gallery: where it stands from the worst, what it shows, and its pictures.

    shared: pictures that all runs have in common. own: the pictures of each run. scores: metric -> value, of each run.
    """

    rank: int
    scene: Mapping[str, Any]
    view: Mapping[str, Any]
    exposure: float
    scores: Sequence[Mapping[str, float]]
    shared: Sequence[Picture]
    own: Sequence[Sequence[Picture]]

    @property
    def facts(self) -> str:
        lights = self.scene["lights"]
        facts = [f"view {self.view['index']}", self.scene["template"], f"{lights} light{'' if lights == 1 else 's'}"]
        facts.append(f"{self.scene['triangles']} triangles")
        facts += [] if self.view["roughness"] is None else [f"roughness {self.view['roughness']:.2f}"]
        return " · ".join([*facts, f"exposure ×{self.exposure:g}"])


def view_pictures(runs: Sequence[Images], name: str) -> tuple[list[Picture], list[list[Picture]], float]:
    """Pictures of one view: those that all runs share, those of each run; and the exposure. name: of scene and view."""
    target = runs[0]["target"]
    exposure = exposure_for(target)

    def picture(caption: str, pixels: np.ndarray) -> Picture:
        return Picture(embed(png(np.ascontiguousarray(pixels))), caption, f"{caption}, {name}", pixels=True)

    def own(prediction: np.ndarray) -> list[Picture]:
        difference, flip = error_pictures(target, prediction, exposure)
        return [
            picture("prediction", to_picture(prediction, exposure)),
            picture(f"difference ×{DIFFERENCE_GAIN}", difference),
            picture("HDR-FLIP error", flip),
        ]

    shared = [
        picture("target", to_picture(target, exposure)),
        picture("direct light only", to_picture(runs[0]["direct"], exposure)),
    ]
    return shared, [own(images["prediction"]) for images in runs], exposure


def common_scenes(runs: Sequence[Run]) -> list[list[Mapping[str, Any]]]:
    """Of each run, its summaries of the scenes that all runs have in common."""
    same = tables.same_scenes(runs) if len(runs) > 1 else {scene["id"] for run in runs for scene in run.summary["per_scene"]}
    return [[scene for scene in run.summary["per_scene"] if scene["id"] in same] for run in runs]


def overview(runs: Sequence[Run]) -> bytes | None:
    """A PNG of many views, the first run's worst first: targets on top, then a row of predictions for each run.

    None where they have no view in common.
    """
    columns = []
    for _, scenes, views in worst_first(common_scenes(runs), OVERVIEW_VIEWS):
        images = [run.images(scenes[0]["id"], views[0]["index"]) for run in runs]
        exposure = exposure_for(images[0]["target"])
        pictures = [images[0]["target"], *(image["prediction"] for image in images)]
        columns.append(np.concatenate([to_picture(picture, exposure) for picture in pictures]))
    if not columns:
        return None
    enlarge = max(1, OVERVIEW_VIEW_PIXELS // columns[0].shape[1])
    return png(np.concatenate(columns, axis=1).repeat(enlarge, axis=0).repeat(enlarge, axis=1))


def gallery(runs: Sequence[Run], limit: int) -> tuple[list[View], int]:
    """The gallery's views, worst first, and how many there are. Runs on different data show what they have in common."""
    scenes = common_scenes(runs)
    rows = []
    for rank, run_scenes, views in worst_first(scenes, limit):
        scene, view = run_scenes[0], views[0]
        images = [run.images(scene["id"], view["index"]) for run in runs]
        shared, own, exposure = view_pictures(images, f"{scene['id']} view {view['index']}")
        rows.append(View(rank, scene, view, exposure, [view["scores"]["model"] for view in views], shared, own))
    return rows, sum(len(scene["views"]) for scene in scenes[0]) if scenes else 0


# --- tables -----------------------------------------------------------------------------------------------------------


def run_headings(runs: Sequence[Run], alone: str) -> list[Cell | str]:
    """The runs' names with their colours; ``alone`` where there is one."""
    return [alone] if len(runs) == 1 else [Cell(run.name, colour=plots.colour(number)) for number, run in enumerate(runs)]


def summary_table(runs: Sequence[Run], metrics: Mapping[str, Metric]) -> Table:
    """Rows are metrics; columns the runs and what they are seen against. The best is marked where scenes are the same."""
    columns = tables.columns(runs)
    best = tables.best_of(columns, metrics) if tables.all_same(runs) else dict.fromkeys(metrics)
    filled = [(number, column) for number, column in enumerate(columns) if column["values"]]

    def heading(number: int, column: Mapping[str, Any]) -> Cell:
        is_model = column["kind"] == "model"
        return Cell(
            column["label"],
            kind="strong" if is_model else "",
            colour=plots.colour(number) if is_model and len(runs) > 1 else "",
        )

    def score(name: str, number: int, column: Mapping[str, Any]) -> Cell | None:
        if name not in column["values"]:
            return None
        kind = "best" if best[name] == number else "soft" if column["kind"] in ("direct", "ceiling") else ""
        return Cell(*tables.format_estimate(metrics[name], column["values"][name]), kind=kind)

    rows = [[metric.heading, *(score(name, *column) for column in filled)] for name, metric in metrics.items()]
    return Table(["metric", *(heading(*column) for column in filled)], rows, numeric=True)


def difference_table(runs: Sequence[Run], differences: Mapping[str, Any], metrics: Mapping[str, Metric]) -> Table:
    """How much better each run is than the first, coloured where the interval leaves no doubt."""

    def gain(name: str, row: Mapping[str, Any]) -> Cell | None:
        if name not in row["gains"]:
            return None
        value = row["gains"][name]
        kind = ("good" if value["mean"] > 0 else "bad") if decided(value) else ""
        return Cell(*tables.format_estimate(metrics[name], value, "+"), kind=kind)

    rows = [[tables.with_unit(metric), *(gain(name, row) for row in differences.values())] for name, metric in metrics.items()]
    return Table([f"how much better than {runs[0].name}", *differences], rows, numeric=True)


def breakdown_tables(runs: Sequence[Run]) -> list[Table]:
    """The scores in every bin of every breakdown, a table for each run and breakdown."""
    return [breakdown_table(run, key, len(runs) > 1) for run in runs for key in BREAKDOWNS]


def breakdown_table(run: Run, key: str, several: bool) -> Table:
    metrics = tables.metrics_of([run.summary])

    def score(row: Mapping[str, Any], name: str, metric: Metric) -> Cell:
        interval = row["interval"][name]
        note = f"{metric.format(interval[0])} to {metric.format(interval[1])}" if interval else ""
        return Cell(metric.format(row["model"][name]), note)

    title = BREAKDOWNS[key].title + (f", {run.name}" if several else "")
    rows = [
        [row["value"], row["scenes"], row["views"], *(score(row, name, metric) for name, metric in metrics.items())]
        for row in run.summary["by"][key]
    ]
    return Table([title, "scenes", "views", *(metric.heading for metric in metrics.values())], rows, numeric=True)


def timing_table(runs: Sequence[Run]) -> Table:
    """Median milliseconds of every step and of their sums, with a bar for each."""
    steps = dict(steps_of([run.timing for run in runs if run.timing]))
    per_image = [name for name, step in steps.items() if step.per_image]
    per_scene = [name for name, step in steps.items() if not step.per_image]

    def milliseconds(run: Run, names: Iterable[str]) -> float | None:
        """None where the run has none of these steps, or no times."""
        median = run.timing["median"] if run.timing else {}
        times = [median[name] for name in names if name in median]
        return 1000 * sum(times) if times else None

    longest = max(milliseconds(run, steps) or 0 for run in runs)

    def cells(names: Iterable[str], kind: str = "") -> list[Cell | None]:
        times = [milliseconds(run, names) for run in runs]
        return [
            None if ms is None else Cell(f"{ms:.1f}", kind=kind, colour=plots.colour(number), share=ms / longest)
            for number, ms in enumerate(times)
        ]

    shares = [f"{100 * milliseconds(run, per_scene) / milliseconds(run, steps):.0f} %" if run.timing else None for run in runs]
    rows = [[step.label, *cells([name])] for name, step in steps.items()]
    rows.append([Cell("first image of a scene", kind="strong"), *cells(steps, "strong")])
    rows.append([Cell("every further image", kind="strong"), *cells(per_image, "strong")])
    rows.append(["share of the per-scene part in the first", *shares])
    return Table(["milliseconds", *run_headings(runs, "model")], rows, numeric=True)


def timing_note(timing: Mapping[str, Any]) -> str:
    """Where and how the times of a run were measured."""
    triangles = [scene["triangles"] for scene in timing["scenes"]]
    threads = timing["threads"]
    cores = f", {threads} thread{'' if threads == 1 else 's'}" if threads else ""
    return (
        f"{timing['device']}{cores}, float32, {timing['resolution']}×{timing['resolution']} pixels, one image at a time. "
        f"Median of {len(triangles)} scenes of {min(triangles)} to {max(triangles)} triangles, each the least of "
        f"{timing['repeats']} runs."
    )


# --- the page ---------------------------------------------------------------------------------------------------------


def _grouped(texts: Sequence[str], runs: Sequence[Run]) -> dict[str, str]:
    """Text -> the names of the runs of which it is true; "" where it is of all."""
    names = {text: [run.name for run, run_text in zip(runs, texts, strict=True) if run_text == text] for text in texts}
    return {text: "" if len(names) == 1 else ", ".join(of_text) for text, of_text in names.items()}


def page(runs: Sequence[Run], probes: Sequence[Probe] = (), limit: int = 24, title: str | None = None) -> str:
    """The whole report as HTML; at most ``limit`` views in the gallery."""
    return render(
        Path(__file__).with_name("report.html.j2"),
        title or TITLES[min(len(runs), 2)],
        runs=runs,
        colours=[plots.colour(number) for number in range(len(runs))],
        probes=[probe_values(probe) for probe in probes],
        **(run_values(runs, limit) if runs else {}),
    )


def run_values(runs: Sequence[Run], limit: int) -> dict[str, Any]:
    """What the template says about runs."""
    summaries = [run.summary for run in runs]
    metrics, same = tables.metrics_of(summaries), tables.all_same(runs)
    differences = tables.differences(runs) if len(runs) > 1 else {}
    unlike = tables.unlike(runs) if len(runs) > 1 else {}
    named = {run.name: run.summary for run in runs}
    views, view_count = gallery(runs, limit)
    return {
        "same": same,
        "metrics": metrics,
        "view_metrics": {name: metrics[name] for name in VIEW_METRICS if name in metrics},
        "verdicts": [tables.verdicts(summary) for summary in summaries],
        "tiles": tiles(summaries[0]) if len(runs) == 1 else {},
        "summary": summary_table(runs, metrics),
        "ceilings": _grouped([" ".join(tables.ceiling_lines(summary)) for summary in summaries], runs),
        "noise_shares": [(run.name, share) for run in runs if (share := tables.noise_share(run.summary)) is not None],
        "differences": difference_table(runs, differences, metrics) if differences else None,
        "paired": next(iter(differences.values()), None),
        "unlike": Table(["setting", *run_headings(runs, "")], [[name, *values] for name, values in unlike.items()]),
        "configs": [{stage: tables.flatten(config) for stage, config in run.configs.items()} for run in runs],
        "loss_curves": plots.loss_curves({run.name: run.log for run in runs}),
        "breakdowns": BREAKDOWNS,
        "breakdown_plots": [plots.breakdowns(named, metrics[name], same) for name in ("psnr", "log_error", "flip")],
        "breakdown_tables": breakdown_tables(runs),
        "regions": tables.region_table(runs),
        "region_notes": REGIONS,
        "timing": timing_table(runs) if any(run.timing for run in runs) else None,
        "timing_notes": [(run.name, timing_note(run.timing)) for run in runs if run.timing],
        "views": views,
        "view_count": view_count,
    }


def tiles(summary: Mapping[str, Any]) -> dict[str, Cell]:
    """The scores that are judged, for the top of the page of one run."""
    metrics, model = tables.metrics_of([summary]), summary["methods"]["model"]
    estimates = {
        metrics[name].heading: tables.format_estimate(metrics[name], model[name]) for name in VIEW_METRICS if name in model
    }
    return {label: Cell(mean, "" if mean == interval else interval) for label, (mean, interval) in estimates.items()}


def probe_values(probe: Probe) -> dict[str, Any]:
    """What the template says about a probe."""
    facts = probe.facts
    return {
        "facts": facts,
        "key": probe.key[:12],
        "figure": Picture(embed(probe.figure.read_bytes()), alt=facts["title"]),
        "table": Table(facts["columns"], facts["rows"], numeric=True),
        "model": ", ".join(f"{name} {value[:12]}" for name, value in tables.flatten(facts["model"])),
    }


def write_evaluation(folder: Path, run: Run, gallery: int) -> None:
    """Write what *evaluate* leaves of one run: report.html, metrics.json, metrics.md and overview.png."""
    (folder / "report.html").write_text(page([run], limit=gallery), encoding="utf-8")
    picture = overview([run])
    if picture:
        (folder / "overview.png").write_bytes(picture)
    (folder / "metrics.md").write_text(tables.markdown(run.summary), encoding="utf-8")
    (folder / "metrics.json").write_text(json.dumps(run.summary, indent=1, allow_nan=False) + "\n", encoding="utf-8")
