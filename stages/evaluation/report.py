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
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from stages.evaluation import plots
from stages.evaluation.statistics import BARS, BREAKDOWNS, JUDGED, METHODS, difference, worst_first
from stages.evaluation.timing import PER_IMAGE, STEPS
from stages.metrics import METRICS, Metric, flip_map, named
from stages.tonemap import exposure_for, srgb_encode, to_picture

DIFFERENCE_GAIN = 5
OVERVIEW_VIEWS = 10  # columns of overview.png
OVERVIEW_VIEW_PIXELS = 128  # least width of a column
SHOWN = ("psnr", "ssim", "log_error", "flip")  # beside every view, and in breakdowns
CEILING = "ceiling: noise of the ground truth"

Images = Mapping[str, np.ndarray]  # target, prediction, direct: (H, W, 3) linear radiance


@dataclass(frozen=True)
class Run:
    """One evaluated model.

    summary: what metrics.json holds. timing: what timing.json holds, or None. facts: label -> text. configs: stage -> resolved
    config. log: rows of the training log. images: (scene id, camera) -> its `Images`. targets: scene id -> the digest of its
    data, by which runs on the same scenes are told.
    """

    name: str
    key: str
    summary: Mapping[str, Any]
    timing: Mapping[str, Any] | None = None
    facts: Mapping[str, str] = field(default_factory=dict)
    configs: Mapping[str, Any] = field(default_factory=dict)
    log: Sequence[Mapping[str, Any]] = ()
    images: Callable[[str, int], Images] | None = None
    targets: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Probe:
    """One artifact of stage *probe*: a question put to a model, and what came out. ``facts``: its probe.json."""

    key: str
    facts: Mapping[str, Any]
    figure: Path


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
    import matplotlib

    target = runs[0]["target"]
    exposure = exposure_for(target)

    def uri(pixels: np.ndarray) -> str:
        return picture_uri(png(np.ascontiguousarray(pixels)))

    def own(prediction: np.ndarray) -> list[tuple[str, str]]:
        difference = np.abs(srgb_encode(prediction * exposure) - srgb_encode(target * exposure)) * DIFFERENCE_GAIN
        error = matplotlib.colormaps["magma"](np.clip(flip_map(target, prediction), 0, 1), bytes=True)[..., :3]
        return [
            ("prediction", uri(to_picture(prediction, exposure))),
            (f"difference ×{DIFFERENCE_GAIN}", uri(np.round(np.clip(difference, 0, 1) * 255).astype(np.uint8))),
            ("HDR-FLIP error", uri(error)),
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


# --- numbers ----------------------------------------------------------------------------------------------------------


def told(metric: Metric, value: Mapping[str, float], sign: str = "") -> tuple[str, str, str]:
    """Mean and both ends of its interval, as text."""
    return tuple(metric.format(value[key], sign) for key in ("mean", "low", "high"))  # type: ignore[return-value]


def metrics_of(summaries: Collection[Mapping[str, Any]]) -> dict[str, Metric]:
    """Every metric that one of the runs has."""
    return named({name for summary in summaries for name in summary["methods"]["model"]})


def verdicts(summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """One sentence for each bar and judged metric, true or not; ``decided``: the interval leaves no doubt which."""
    out = []
    for bar in BARS:
        for name in JUDGED:
            gain, metric = summary["gains"][bar][name], METRICS[name]
            mean, low, high = told(metric, gain, "+")
            won = gain["mean"] > 0
            text = f"{'beats' if won else 'does not beat'} the {METHODS[bar]} in {metric.label}: gain "
            text += f"{mean} {metric.unit}".rstrip() + f" (95 % interval {low} to {high})"
            out.append({"won": won, "decided": gain["low"] > 0 or gain["high"] < 0, "text": text})
    return out


def ceiling_lines(summary: Mapping[str, Any]) -> list[str]:
    """What the noise of the ground truth means for the scores, one sentence per metric that has a ceiling."""
    lines = []
    for name, ceiling in summary["ceiling"].items():
        metric, (mean, low, high) = METRICS[name], told(METRICS[name], ceiling)
        text = f"{metric.label}: the noiseless truth would score " + f"{mean} {metric.unit}".rstrip()
        source = {"pairs": "rendered twice", "estimates": "by the renderer's own estimate"}[ceiling["from"]]
        text += f" (95 % interval {low} to {high}; {ceiling['views']} views of {ceiling['of']}, {source})"
        lines.append(text + ".")
    return lines or ["No view of the data was rendered twice and none has an error estimate: the ceiling is unknown."]


def noise_share(summary: Mapping[str, Any]) -> float | None:
    """The noise's share of the model's squared error, told from mean PSNR and its ceiling; None where that is unknown."""
    if "psnr" not in summary["ceiling"]:
        return None
    return 10 ** ((summary["methods"]["model"]["psnr"]["mean"] - summary["ceiling"]["psnr"]["mean"]) / 10)


def columns(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Columns of the summary, ``{"label", "kind", "values": {metric: bootstrap}}``: the runs, then what they are seen against.

    A baseline that is the same for several runs, as it is on the same data, has one column.
    """
    single = len(runs) == 1
    out = [
        {"label": METHODS["model"] if single else run.name, "kind": "model", "values": run.summary["methods"]["model"]}
        for run in runs
    ]
    for method, label in [*METHODS.items(), ("ceiling", CEILING)]:
        if method == "model":
            continue
        found: list[tuple[dict[str, Any], list[str]]] = []
        for run in runs:
            values = run.summary["ceiling"] if method == "ceiling" else run.summary["methods"][method]
            for other, names in found:
                if all(other.get(name, value) == value for name, value in values.items()):
                    other |= values
                    names.append(run.name)
                    break
            else:
                found.append((dict(values), [run.name]))
        kind = "bar" if method in BARS else method
        for values, names in found:
            of = "" if len(found) == 1 else f", {', '.join(names)}"
            out.append({"label": label + of, "kind": kind, "values": values})
    return out


def best_of(columns: Sequence[Mapping[str, Any]], metrics: Mapping[str, Metric]) -> dict[str, int]:
    """Per metric the column of the best mean among models and bars."""
    best = {}
    for name, metric in metrics.items():
        known = [i for i, column in enumerate(columns) if column["kind"] in ("model", "bar") and name in column["values"]]
        best[name] = (max if metric.higher_is_better else min)(
            known, key=lambda i, name=name: columns[i]["values"][name]["mean"]
        )
    return best


def same_scenes(runs: Sequence[Run]) -> set[str]:
    """Ids of the scenes whose data is the same in all runs."""
    return {id for id, target in runs[0].targets.items() if all(run.targets.get(id) == target for run in runs)}


def all_same(runs: Sequence[Run]) -> bool:
    """Whether all runs were evaluated on the same scenes, and on no others."""
    return all(run.targets == runs[0].targets for run in runs)


def differences(runs: Sequence[Run]) -> dict[str, dict[str, Any]]:
    """Name -> how much better that run is than the first (`statistics.difference`), over the scenes that all have in common."""
    same = same_scenes(runs)
    found = {}
    for run in runs[1:]:
        scenes = [other.summary["per_scene"] for other in (run, runs[0])]
        metrics = {
            name: metric
            for name, metric in metrics_of([run.summary, runs[0].summary]).items()
            if all(name in other.summary["methods"]["model"] for other in (run, runs[0]))
        }
        found[run.name] = difference(*scenes, same, metrics)
    return {name: value for name, value in found.items() if value is not None}


def unlike(runs: Sequence[Run]) -> dict[str, list[str]]:
    """Settings in which the runs differ: ``stage.name`` -> a value per run."""
    flat = [dict(flatten(run.configs)) for run in runs]
    names = dict.fromkeys(name for one in flat for name in one)
    rows = {name: [one.get(name, "–") for one in flat] for name in names}
    return {name: values for name, values in rows.items() if len(set(values)) > 1}


def markdown(summary: Mapping[str, Any]) -> str:
    """The summary of one run as a Markdown table to paste; the best of model and bars in bold."""
    metrics = metrics_of([summary])
    rows = columns([Run("model", "", summary)])
    best = best_of(rows, metrics)
    lines = [
        f"{summary['scenes']} scenes, {summary['views']} views; mean over views [95 % interval over scenes]",
        "",
        "| method | " + " | ".join(metric.heading for metric in metrics.values()) + " |",
        "| --- |" + " ---: |" * len(metrics),
    ]
    for number, row in enumerate(rows):
        if row["values"]:
            cells = [_cell(metric, row["values"].get(name), best[name] == number) for name, metric in metrics.items()]
            lines.append(f"| {row['label']} | " + " | ".join(cells) + " |")
    lines += ["", *(f"- The model {verdict['text']}." for verdict in verdicts(summary))]
    lines += [f"- Ceiling in {line}" for line in ceiling_lines(summary)] if summary["ceiling"] else []
    return "\n".join(lines) + "\n"


def _cell(metric: Metric, value: Mapping[str, float] | None, bold: bool, sign: str = "") -> str:
    if value is None:
        return "–"
    mean, low, high = told(metric, value, sign)
    return f"**{mean}** [{low}, {high}]" if bold else f"{mean} [{low}, {high}]"


def side_by_side(runs: Sequence[Run], probes: Sequence[Probe]) -> str:
    """Several runs as Markdown tables to paste: runs as columns, differences, probes."""
    lines = []
    if runs:
        metrics = metrics_of([run.summary for run in runs])
        table = [column for column in columns(runs) if column["values"]]
        best = best_of(table, metrics) if all_same(runs) else dict.fromkeys(metrics)
        lines = ["Mean over views [95 % interval over scenes]", ""]
        lines += ["| metric | " + " | ".join(column["label"] for column in table) + " |", "| --- |" + " ---: |" * len(table)]
        for name, metric in metrics.items():
            cells = [_cell(metric, column["values"].get(name), best[name] == i) for i, column in enumerate(table)]
            lines.append(f"| {metric.heading} | " + " | ".join(cells) + " |")
        found = differences(runs)
        if found:
            first = next(iter(found.values()))
            paired = f"paired over {first['views']} views of {first['scenes']} scenes"
            lines += ["", f"How much better than {runs[0].name}, {paired} (positive is better)", ""]
            lines += ["| metric | " + " | ".join(found) + " |", "| --- |" + " ---: |" * len(found)]
            for name, metric in metrics.items():
                cells = [_cell(metric, row["gains"].get(name), False, "+") for row in found.values()]
                lines.append(f"| {metric.label}{f' ({metric.unit})' if metric.unit else ''} | " + " | ".join(cells) + " |")
    for probe in probes:
        facts = probe.facts
        lines += ["", f"### {facts['title']}", "", facts["question"], ""]
        lines += ["| " + " | ".join(facts["columns"]) + " |", "| --- |" + " ---: |" * (len(facts["columns"]) - 1)]
        lines += ["| " + " | ".join("–" if cell is None else str(cell) for cell in row) + " |" for row in facts["rows"]]
        lines += ["", *(f"- {note}" for note in facts["notes"])] if facts["notes"] else []
    return "\n".join(lines).strip() + "\n"


def numbers(runs: Sequence[Run], probes: Sequence[Probe]) -> dict[str, Any]:
    """What the page says, as plain JSON; the scores of every view are in each run's own metrics.json."""
    shown = [
        {"name": run.name, "key": run.key, **{k: v for k, v in run.summary.items() if k != "per_scene"}, "timing": run.timing}
        for run in runs
    ]
    against = {"base": runs[0].name, "runs": differences(runs)} if len(runs) > 1 else None
    return {"runs": shown, "differences": against, "probes": [{"key": probe.key, **probe.facts} for probe in probes]}


def flatten(value: Any, prefix: str = "") -> list[tuple[str, str]]:
    """Nested config as (dotted name, value) lines."""
    if isinstance(value, Mapping):
        return [line for key in value for line in flatten(value[key], f"{prefix}{key}.")]
    return [(prefix.rstrip("."), "none" if value is None else str(value))]


# --- the page ---------------------------------------------------------------------------------------------------------


def gallery(runs: Sequence[Run], limit: int) -> tuple[list[dict[str, Any]], int]:
    """The views shown, worst first, and how many there are. Runs on different data show what they have in common."""
    same = same_scenes(runs) if len(runs) > 1 else {scene["id"] for run in runs for scene in run.summary["per_scene"]}
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
    metrics = metrics_of(summaries)
    table = columns(runs) if runs else []
    rows, views = gallery(runs, limit) if runs else ([], 0)
    same = all_same(runs)
    named_runs = {run.name: run.summary for run in runs}
    return environment.get_template("report.html.j2").render(
        title=title or ("How close the model comes to the path tracer" if len(runs) == 1 else "Models side by side"),
        runs=runs,
        same=same,
        metrics=metrics,
        shown=[name for name in SHOWN if name in metrics],
        judged=JUDGED,
        table=table,
        best=best_of(table, metrics) if runs and same else dict.fromkeys(metrics),
        told=told,
        verdicts=[verdicts(summary) for summary in summaries],
        ceilings=_grouped([" ".join(ceiling_lines(summary)) for summary in summaries], runs),
        shares=[(run.name, share) for run in runs if (share := noise_share(run.summary)) is not None],
        differences=differences(runs) if len(runs) > 1 else {},
        unlike=unlike(runs) if len(runs) > 1 else {},
        breakdowns=BREAKDOWNS,
        plots=[plots.breakdowns(named_runs, metrics[name], same) for name in ("psnr", "log_error", "flip")] if runs else [],
        loss_svg=plots.loss_curves({run.name: run.log for run in runs}),
        colours=list(itertools.islice(itertools.cycle(plots.COLOURS), len(runs))),
        timing=timing_rows(runs) if any(run.timing for run in runs) else [],
        configs=[{stage: flatten(config) for stage, config in run.configs.items()} for run in runs],
        rows=rows,
        views=views,
        probes=[
            {
                "facts": probe.facts,
                "key": probe.key,
                "figure": picture_uri(probe.figure.read_bytes()),
                "model": ", ".join(f"{name} {value[:12]}" for name, value in flatten(probe.facts["model"])),
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
    (folder / "metrics.md").write_text(markdown(run.summary), encoding="utf-8")
    (folder / "metrics.json").write_text(json.dumps(run.summary, indent=1, allow_nan=False) + "\n", encoding="utf-8")
