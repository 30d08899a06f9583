"""The report: one HTML page with its pictures inside (it opens from disk and can be mailed), a Markdown table, JSON.

Pictures are plain sRGB. Target, prediction and direct light of a view share one exposure, which is named; their
difference is taken between those pictures, times 5. The page follows the reader's light or dark setting.
"""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stages.evaluation.statistics import BARS, JUDGED, METHODS, worst_first
from stages.metrics import METRICS, Metric, flip_map
from stages.tonemap import exposure_for, srgb_encode, to_picture

DIFFERENCE_GAIN = 5
OVERVIEW_VIEWS = 10  # columns of overview.png
OVERVIEW_VIEW_PIXELS = 128  # least width of a column
INK = "#808890"  # reads on white and on black

Images = Mapping[str, np.ndarray]  # target, prediction, direct: (H, W, 3) linear radiance


def picture_uri(pixels: np.ndarray) -> str:
    """(H, W, 3) uint8 as a data URI of a PNG."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def view_pictures(images: Images) -> tuple[list[tuple[str, str]], float]:
    """[(caption, data URI)] of one view and the exposure that they share."""
    import matplotlib

    target, prediction, direct = images["target"], images["prediction"], images["direct"]
    exposure = exposure_for(target)
    difference = np.abs(srgb_encode(prediction * exposure) - srgb_encode(target * exposure)) * DIFFERENCE_GAIN
    error = matplotlib.colormaps["magma"](np.clip(flip_map(target, prediction), 0, 1), bytes=True)[..., :3]
    pictures = {
        "target": to_picture(target, exposure),
        "prediction": to_picture(prediction, exposure),
        f"difference ×{DIFFERENCE_GAIN}": np.round(np.clip(difference, 0, 1) * 255).astype(np.uint8),
        "HDR-FLIP error": np.ascontiguousarray(error),
        "direct light only": to_picture(direct, exposure),
    }
    return [(caption, picture_uri(pixels)) for caption, pixels in pictures.items()], exposure


def overview(images: Sequence[Images], enlarge: int) -> np.ndarray:
    """One picture of many views, worst first: (2 H, n W, 3) uint8, targets above predictions, each pixel ``enlarge`` wide."""
    columns = []
    for view in images:
        exposure = exposure_for(view["target"])
        columns.append(np.concatenate([to_picture(view[name], exposure) for name in ("target", "prediction")]))
    return np.concatenate(columns, axis=1).repeat(enlarge, axis=0).repeat(enlarge, axis=1)


def loss_curve(rows: Sequence[Mapping[str, Any]]) -> str:
    """The training log (rows with ``step``, ``loss``, now and then ``validation_log_error``) as an SVG element."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    key = "validation_log_error"
    train = np.array([(row["step"], row["loss"]) for row in rows if row.get("loss") is not None]).reshape(-1, 2)
    held_out = [(row["step"], row[key]) for row in rows if row.get(key) is not None]
    validation = np.array(held_out).reshape(-1, 2)
    style = {
        "svg.hashsalt": "lightmill",
        "svg.fonttype": "none",
        "text.color": INK,
        "axes.labelcolor": INK,
        "axes.edgecolor": INK,
    }
    style |= {"xtick.color": INK, "ytick.color": INK, "font.size": 10, "font.family": "sans-serif"}
    with matplotlib.rc_context(style):
        figure, axes = pyplot.subplots(figsize=(9, 3.2), layout="constrained")
        width = max(1, len(train) // 50)  # smoothed over 2 % of the run
        axes.plot(
            *train.T, color="#4c8dd6", linewidth=0.8, alpha=0.4 if width > 1 else 1, marker="o" if len(train) < 3 else None
        )
        if width > 1:
            smooth = np.convolve(train[:, 1], np.ones(width) / width, mode="valid")
            axes.plot(train[width - 1 :, 0], smooth, color="#4c8dd6", linewidth=1.6)
        axes.plot([], [], color="#4c8dd6", label="training loss" + (f" (bold: mean of {width} rows)" if width > 1 else ""))
        if len(validation):
            axes.plot(*validation.T, color="#e08a2e", linewidth=1.6, marker="o", markersize=3, label="validation, log error")
        axes.set(xlabel="step", ylabel="loss", yscale="log")
        axes.yaxis.set_major_locator(matplotlib.ticker.LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
        axes.yaxis.set_minor_formatter(matplotlib.ticker.NullFormatter())
        axes.grid(color=INK, alpha=0.2, which="both", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(frameon=False, labelcolor=INK)
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
        pyplot.close(figure)
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def verdicts(summary: Mapping[str, Any], metrics: Mapping[str, Metric] = METRICS) -> list[dict[str, Any]]:
    """One sentence for each bar and judged metric, true or not; ``decided``: the interval leaves no doubt which."""
    out = []
    for bar in BARS:
        for name in JUDGED:
            gain, metric = summary["gains"][bar][name], metrics[name]
            mean, low, high = (metric.format(gain[key], "+") for key in ("mean", "low", "high"))
            won = gain["mean"] > 0
            text = f"{'beats' if won else 'does not beat'} the {METHODS[bar]} in {metric.label}: gain "
            text += f"{mean} {metric.unit}".rstrip() + f" (95 % interval {low} to {high})"
            out.append({"won": won, "decided": gain["low"] > 0 or gain["high"] < 0, "text": text})
    return out


def best_methods(summary: Mapping[str, Any], metrics: Mapping[str, Metric]) -> dict[str, str]:
    """Per metric the method with the best mean, the reference left out."""
    return {
        name: (max if metric.higher_is_better else min)(
            ("model", *BARS), key=lambda method, name=name: summary["methods"][method][name]["mean"]
        )
        for name, metric in metrics.items()
    }


def markdown(summary: Mapping[str, Any], metrics: Mapping[str, Metric] = METRICS) -> str:
    """The summary as a Markdown table to paste; the best of model and bars in bold."""
    best = best_methods(summary, metrics)
    lines = [
        f"{summary['scenes']} scenes, {summary['views']} views; mean over views [95 % interval over scenes]",
        "",
        "| method | " + " | ".join(metric.heading for metric in metrics.values()) + " |",
        "| --- |" + " ---: |" * len(metrics),
    ]
    for method, label in METHODS.items():
        cells = []
        for name, metric in metrics.items():
            value = summary["methods"][method][name]
            mean, low, high = (metric.format(value[key]) for key in ("mean", "low", "high"))
            cells.append(f"**{mean}** [{low}, {high}]" if best[name] == method else f"{mean} [{low}, {high}]")
        lines.append(f"| {label} | " + " | ".join(cells) + " |")
    lines += ["", *(f"- The model {verdict['text']}." for verdict in verdicts(summary, metrics))]
    return "\n".join(lines) + "\n"


def flatten(value: Any, prefix: str = "") -> list[tuple[str, str]]:
    """Nested config as (dotted name, value) lines."""
    if isinstance(value, Mapping):
        return [line for key in value for line in flatten(value[key], f"{prefix}{key}.")]
    return [(prefix.rstrip("."), "none" if value is None else str(value))]


def write_report(
    folder: Path,
    summary: Mapping[str, Any],
    split: str,
    facts: Mapping[str, str],
    configs: Mapping[str, Mapping[str, Any]],
    log: Sequence[Mapping[str, Any]],
    images: Callable[[str, int], Images],
    gallery: int,
    metrics: Mapping[str, Metric] = METRICS,
) -> None:
    """Write report.html, metrics.json, metrics.md and overview.png into ``folder``.

    facts: what was evaluated, label -> text. configs: stage -> resolved config, shown folded. log: the rows of the training
    log. images: (scene id, view index) -> its `Images`. gallery: at most so many views are shown.
    """
    import jinja2

    rows = []
    for rank, scene, view in worst_first(summary["per_scene"], gallery):
        pictures, exposure = view_pictures(images(scene["id"], view["index"]))
        rows.append({"rank": rank, "scene": scene, "view": view, "pictures": pictures, "exposure": exposure})
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    page = environment.get_template("report.html.j2").render(
        summary=summary,
        split=split,
        methods=METHODS,
        bars=BARS,
        metrics=metrics,
        best=best_methods(summary, metrics),
        verdicts=verdicts(summary, metrics),
        facts=facts,
        configs={stage: flatten(config) for stage, config in configs.items()},
        loss_svg=loss_curve(log) if log else "",
        rows=rows,
    )
    (folder / "report.html").write_text(page, encoding="utf-8")
    shown = [images(scene["id"], view["index"]) for _, scene, view in worst_first(summary["per_scene"], OVERVIEW_VIEWS)]
    if shown:
        from PIL import Image

        pixels = overview(shown, max(1, OVERVIEW_VIEW_PIXELS // len(shown[0]["target"])))
        Image.fromarray(pixels).save(folder / "overview.png", optimize=True)
    (folder / "metrics.md").write_text(markdown(summary, metrics), encoding="utf-8")
    (folder / "metrics.json").write_text(json.dumps(summary, indent=1, allow_nan=False) + "\n", encoding="utf-8")
