"""The probes' figures: strips of pictures, curves with intervals. Without pyplot, so that nothing outlives a call."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from itertools import cycle

import numpy as np
from matplotlib.figure import Figure

from stages.graphics.tonemap import exposure_for, to_picture

DPI = 110
WIDTH, LEAST_WIDTH = 9.6, 7.5  # inches
MOST_SIDE = 1.7  # of a picture, inches
COLOURS = ("#4c78c8", "#e08a2e", "#3f9e5a", "#b5508f")
LINES = ("-", "--", ":", "-.")  # of the methods, so that equal curves do not hide one another
INK = "#606870"


def new_figure(height: float, width: float = WIDTH) -> Figure:
    return Figure(figsize=(width, height), dpi=DPI, layout="constrained", facecolor="white")


def show_picture(axes: object, pixels: np.ndarray, title: str = "", row: str = "") -> None:
    """(H, W, 3) uint8 without axes; a title above, a row's name at the left."""
    axes.imshow(pixels, interpolation="nearest")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.spines[:].set_color("#cccccc")
    if title:
        axes.set_title(title, fontsize=8.5)
    if row:
        axes.set_ylabel(textwrap.fill(row, 20), fontsize=8)


def strip(figure: Figure, where: object, rows: Sequence[tuple[str, Sequence[np.ndarray]]], titles: Sequence[str]) -> None:
    """Rows of linear pictures with one exposure, that of the first row (the references)."""
    exposure = exposure_for(np.concatenate([image.reshape(-1, 3) for image in rows[0][1]]))
    grid = where.subgridspec(len(rows), len(titles))
    for number, (name, images) in enumerate(rows):
        for column, image in enumerate(images):
            title = titles[column] if number == 0 else ""
            show_picture(figure.add_subplot(grid[number, column]), to_picture(image, exposure), title, "" if column else name)


def curve(
    axes: object, x: Sequence[float], estimates: Sequence[Mapping[str, float]], label: str, colour: str, line: str = "-"
) -> None:
    """Means over ``x`` with their intervals."""
    # a missing end (None) becomes nan, which is not drawn
    mean, low, high = (np.array([row[key] for row in estimates], float) for key in ("mean", "low", "high"))
    axes.fill_between(x, low, high, color=colour, alpha=0.16, linewidth=0)
    axes.plot(x, mean, line, color=colour, marker="o", markersize=4, linewidth=1.6, label=label)


def plain(axes: object) -> None:
    """Few lines, a light grid."""
    axes.grid(color=INK, alpha=0.18, linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8, which="both")


def sweep_figure(
    setting: str,
    labels: Sequence[str],
    values: Sequence[float],
    methods: Sequence[str],
    pictures: Mapping[str, Sequence[Sequence[np.ndarray]]],
    curves: Mapping[str, Mapping[str, Sequence[Mapping[str, float]]]],
    trained: tuple[float, float] | None,
    axis: str,
    headings: Mapping[str, str],
) -> Figure:
    """Strips above (reference, then each method, by value), curves of metrics below.

    pictures: scene -> rows of (H, W, 3) radiance by value. curves: metric -> method -> mean and interval by value.
    ``trained``: the values that training had, shaded. axis: linear, log or even (values side by side).
    headings: of the metrics.
    """
    side = min((WIDTH - 0.8) / len(values), MOST_SIDE)
    heights = [len(scene) * (side + 0.05) + 0.25 for scene in pictures.values()]
    figure = new_figure(sum(heights) + 2.8, max(len(values) * (side + 0.05) + 0.8, LEAST_WIDTH))
    figure.suptitle(f"columns: {setting}", fontsize=9, color=INK)
    outer = figure.add_gridspec(len(pictures) + 1, 1, height_ratios=[*heights, 2.5])
    names = ["path traced", *(methods if len(methods) > 1 else ["predicted"])]
    for number, scene in enumerate(pictures.values()):
        strip(figure, outer[number], list(zip(names, scene, strict=True)), labels)
    order = np.argsort(values)
    places = np.array(values, float) if axis != "even" else np.arange(len(values), dtype=float)
    below = outer[len(pictures)].subgridspec(1, len(curves))
    for number, (name, lines) in enumerate(curves.items()):
        axes = figure.add_subplot(below[number])
        low, high = places.min(), places.max()
        if axis == "log":
            axes.set_xscale("log", base=2)
            axes.set_xlim(low * (high / low) ** -0.04 / 1.01, high * (high / low) ** 0.04 * 1.01)
        else:
            axes.set_xlim(low - 0.04 * (high - low or 1), high + 0.04 * (high - low or 1))
        if trained is not None:
            band = trained if axis != "even" else np.interp(trained, np.sort(values), places[order])
            axes.axvspan(*band, color="#8a939b", alpha=0.14, linewidth=0, label="in training")
        for method, colour, line in zip(methods, cycle(COLOURS), cycle(LINES), strict=False):
            curve(axes, places[order], [lines[method][index] for index in order], method, colour, line)
        if places[0] > places[-1]:  # as the columns run
            axes.invert_xaxis()
        axes.set_xticks(places, labels)
        axes.minorticks_off()
        axes.set_xlabel(setting, fontsize=8.5)
        axes.set_ylabel(headings[name], fontsize=8.5)
        plain(axes)
        if number == 0 and (len(methods) > 1 or trained is not None):
            axes.legend(fontsize=7.5, frameon=False)
    return figure
