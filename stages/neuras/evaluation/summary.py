"""From scores per view to the report's numbers: views between the training frames, lanes beside the drive, both sides of it.

Intervals come from a bootstrap over frames. Differences of two methods are taken frame by frame before they are averaged.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from stages.graphics.statistics import bootstrap
from stages.neuras.evaluation.scores import PLACES, told, worst

METHODS = {
    "ours": "ours, torch",
    "shader": "ours, baked shader",
    "textures": "ours, without residuals",
    "warping": "multi-view warping",
}
View = Mapping[str, Any]  # a record's metrics.json, see stages.neuras.s06_evaluate


@dataclass(frozen=True)
class Group:
    """Views that are averaged. label: for people. kind: "between", "side" (of the drive) or "both". metres: off the drive."""

    label: str
    kind: str
    views: Sequence[View]
    metres: float = 0.0


def groups(views: Sequence[View]) -> list[Group]:
    """Views between the training frames, then for each shift its left side, its right side, and both."""
    found = []
    splits = sorted({view["split"] for view in views} - {"shift"})
    for split in splits:
        name = "between frames" if split == "test" else f"{split} frames"
        found.append(Group(name, "between", [view for view in views if view["split"] == split]))
    shifted = [view for view in views if view["split"] == "shift"]
    for metres in sorted({abs(view["shift"]) for view in shifted}):
        sides = []
        for shift, side in ((-metres, "left"), (metres, "right")):
            of_side = [view for view in shifted if view["shift"] == shift]
            if of_side:
                sides.append(Group(f"{metres:g} m to the {side}", "side", of_side, metres))
        found += sides
        if len(sides) == 2:
            both = [view for side in sides for view in side.views]
            found.append(Group(f"{metres:g} m, both sides", "both", both, metres))
    return found


def summarise(views: Sequence[View]) -> dict[str, Any]:
    """Everything that the report says of quality in numbers, as plain JSON."""
    return {
        "views": len(views),
        "groups": [_of_group(group) for group in groups(views)],
        "agreement": _agreement(views),
        "per_view": list(views),
    }


def _of_group(group: Group) -> dict[str, Any]:
    methods = {method: _estimates(group.views, method) for method in METHODS if method in group.views[0]["scores"]}
    return {
        "label": group.label,
        "kind": group.kind,
        "metres": group.metres,
        "views": len(group.views),
        "ids": [view["id"] for view in group.views],
        "methods": methods,
        "gains": {method: _gains(group.views, method) for method in methods if method != "warping"},
        "errors": _error_places(group.views),
        "agreement": _agreement(group.views),
    }


def _estimates(views: Sequence[View], method: str) -> dict[str, Any]:
    metrics = told(views[0]["scores"][method])
    return {name: bootstrap([[view["scores"][method][name]] for view in views], metrics[name].bounds) for name in metrics}


def _gains(views: Sequence[View], method: str) -> dict[str, Any]:
    """How much better than warping, frame by frame; positive is better whatever the metric."""
    gains = {}
    for name, metric in told(views[0]["scores"][method]).items():
        sign = 1 if metric.higher_is_better else -1
        pairs = [(view["scores"][method][name], view["scores"]["warping"][name]) for view in views]
        gains[name] = bootstrap([[sign * (ours - theirs)] for ours, theirs in pairs])
    return gains


def _error_places(views: Sequence[View]) -> dict[str, Any] | None:
    """Shares of pixels and of the squared error, over all views whose true depth is known; None where it never is."""
    known = [view for view in views if view["errors"] is not None]
    if not known:
        return None
    weight = sum(view["scores"]["ours"]["mse"] for view in known) or 1.0
    return {
        place: {
            "pixels": sum(view["errors"][place]["pixels"] for view in known) / len(known),
            "squared_error": sum(v["errors"][place]["squared_error"] * v["scores"]["ours"]["mse"] for v in known) / weight,
        }
        for place in PLACES
    }


def _agreement(views: Sequence[View]) -> dict[str, Any]:
    """By texture format: the largest median and 99 % quantile of a view, the share of pixels seen, and the worst view."""
    kinds: Iterable[str] = views[0]["agreement"] if views else ()
    return {
        kind: {
            "median": max(view["agreement"][kind]["median"] for view in views),
            "p99": max(view["agreement"][kind]["p99"] for view in views),
            "seen": sum(view["agreement"][kind]["seen"] for view in views) / len(views),
            "worst": {"id": worst(views, kind)["id"], **worst(views, kind)["agreement"][kind]},
        }
        for kind in kinds
    }
