"""The report's plots: loss curves, and scores by what a scene or a view holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from stages.graphics.metrics import Metric
from stages.graphics.page.plots import INK, colour, svg_axes
from stages.graphics.statistics import BREAKDOWNS, METHODS

REFERENCES = {"direct": "D", "constant": "_"}  # method -> marker


def loss_curves(logs: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """Training logs by run (rows with ``step``, ``loss``, now and then ``validation_log_error``); "" if they are all empty."""
    logs = {name: rows for name, rows in logs.items() if rows}
    key = "validation_log_error"

    def draw(axes: Any) -> None:
        from matplotlib import ticker

        for number, (name, rows) in enumerate(logs.items()):
            train = np.array([(row["step"], row["loss"]) for row in rows if row.get("loss") is not None]).reshape(-1, 2)
            validation = np.array([(row["step"], row[key]) for row in rows if row.get(key) is not None]).reshape(-1, 2)
            train_colour, validation_colour = (colour(0), colour(1)) if len(logs) == 1 else (colour(number),) * 2
            prefix = "" if len(logs) == 1 else f"{name}: "
            width = max(1, len(train) // 50)  # smoothed over 2 % of the run
            axes.plot(
                *train.T,
                color=train_colour,
                linewidth=0.8,
                alpha=0.4 if width > 1 else 1,
                marker="o" if len(train) < 3 else None,
            )
            if width > 1:
                smooth = np.convolve(train[:, 1], np.ones(width) / width, mode="valid")
                axes.plot(train[width - 1 :, 0], smooth, color=train_colour, linewidth=1.6)
            axes.plot(
                [],
                [],
                color=train_colour,
                label=f"{prefix}training loss" + (f" (bold: mean of {width} rows)" if width > 1 else ""),
            )
            if len(validation):
                style = {"linestyle": "-" if len(logs) == 1 else "--", "linewidth": 1.6, "marker": "o", "markersize": 3}
                axes.plot(*validation.T, color=validation_colour, label=f"{prefix}validation, log error", **style)
        axes.set(xlabel="step", ylabel="loss", yscale="log")
        axes.yaxis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter(ticker.FormatStrFormatter("%g"))
        axes.yaxis.set_minor_formatter(ticker.NullFormatter())
        axes.grid(which="both")
        axes.legend()

    return svg_axes(draw, 11, 3.4) if logs else ""


def breakdowns(runs: Mapping[str, Mapping[str, Any]], metric: Metric, references: bool) -> str:
    """The models' scores in every bin of every breakdown, with intervals. ``runs``: name -> summary.

    ``references``: show the direct-light render and the constant colour too, as the first run has them.
    """
    bins = {}
    for key, breakdown in BREAKDOWNS.items():
        values = {row["value"] for summary in runs.values() for row in summary["by"][key]}
        bins[key] = sorted(values, key=breakdown.order)

    def draw(panels: list[Any]) -> None:
        for axes, (key, breakdown) in zip(panels, BREAKDOWNS.items(), strict=True):
            counts = dict.fromkeys(bins[key], 0)
            for number, (name, summary) in enumerate(runs.items()):
                shift = 0.5 * ((number + 0.5) / len(runs) - 0.5)
                rows = [row for row in summary["by"][key] if metric.name in row["model"]]
                for row in rows:
                    counts[row["value"]] = max(counts[row["value"]], row["scenes"])
                    x, y, interval = (
                        bins[key].index(row["value"]) + shift,
                        row["model"][metric.name],
                        row["interval"][metric.name],
                    )
                    axes.plot(x, y, "o", color=colour(number), markersize=5)
                    if interval:
                        axes.plot([x, x], interval, color=colour(number), linewidth=1.6)
                    for method, marker in REFERENCES.items() if references and number == 0 else ():
                        middle = bins[key].index(row["value"])
                        size = 16 if marker == "_" else 5
                        axes.plot(middle, row[method][metric.name], marker, color=INK, markersize=size, markerfacecolor="none")
                axes.plot([], [], "o-", color=colour(number), markersize=5, label=name)
            for method, marker in REFERENCES.items() if references else ():
                label = METHODS[method].partition(" (")[0]
                axes.plot([], [], marker, color=INK, markersize=9 if marker == "_" else 5, markerfacecolor="none", label=label)
            axes.set_xticks(range(len(counts)), [f"{value}\n({scenes})" for value, scenes in counts.items()], fontsize=9)
            axes.set(xlabel=breakdown.title, xlim=(-0.6, len(counts) - 0.4))
            axes.grid(axis="y")
        panels[0].set_ylabel(metric.heading.replace("\u00a0", " "))
        handles, labels = panels[0].get_legend_handles_labels()
        panels[0].figure.legend(handles, labels, loc="outside upper left", ncols=min(len(labels), 6))

    columns = [max(2, len(values)) for values in bins.values()]
    return svg_axes(draw, 13, 3.4, columns)
