"""Plots as SVG elements that take their ink from the page, so that they follow its light or dark setting."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Sequence
from typing import Any

from markupsafe import Markup

COLOURS = ("#4c8dd6", "#e08a2e", "#3aa673", "#b66bd1", "#d1566a", "#8a8f2b", "#2aa7b8", "#a3765a")  # read on white and on black
INK, LINE = "#808890", "#909aa4"  # stand for the page's colours: replaced by its variables
STYLE = {
    "svg.hashsalt": "lightmill",
    "svg.fonttype": "none",
    **dict.fromkeys(("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color"), INK),
    "legend.labelcolor": INK,
    "legend.frameon": False,
    "font.size": 10,
    "font.family": "sans-serif",
    "grid.color": LINE,
    "grid.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
}


def colour(index: int) -> str:
    """The colour of a page's run or curve of this number."""
    return COLOURS[index % len(COLOURS)]


def svg(draw: Callable[[Any], None], width: float, height: float) -> Markup:
    """``draw(figure)`` on an empty figure of this size, inches, as an SVG element."""
    import matplotlib
    from matplotlib.figure import Figure

    buffer = io.StringIO()
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        draw(figure)
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    text = buffer.getvalue()
    text = _unshared_ids(text[text.index("<svg") :])
    return Markup(text.replace(INK, "var(--soft)").replace(LINE, "var(--line)"))


def svg_axes(draw: Callable[[Any], None], width: float, height: float, columns: Sequence[float] = (1,)) -> Markup:
    """``draw(axes)`` on a row of axes that share y and have these relative widths; on a single axes where there is one."""

    def fill(figure: Any) -> None:
        row = figure.subplots(1, len(columns), width_ratios=columns, sharey=True, squeeze=False)[0]
        draw(list(row) if len(columns) > 1 else row[0])

    return svg(fill, width, height)


def _unshared_ids(text: str) -> str:
    """Without the ids of groups, which all plots of a page would share."""
    return re.sub(r'<g id="[^"]*"', "<g", text)
