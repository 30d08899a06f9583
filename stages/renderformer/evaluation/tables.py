"""Runs in numbers and in words: the columns of the summary, verdicts, differences; as Markdown to paste and as JSON."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from stages.graphics.metrics import METRICS, Metric, named
from stages.graphics.page import Cell, Table
from stages.graphics.page.markdown import table
from stages.graphics.statistics import BARS, JUDGED, METHODS, Estimate, decided, difference, with_interval
from stages.renderformer.evaluation.regions import REGIONS
from stages.renderformer.evaluation.runs import Probe, Run

CEILING = "ceiling: noise of the ground truth"
CEILING_SOURCES = {"pairs": "rendered twice", "estimates": "by the renderer's own estimate"}


def format_estimate(metric: Metric, value: Estimate, sign: str = "") -> tuple[str, str]:
    """Mean and its interval (``low to high``, "none: too few scenes"), as text."""
    if value["low"] is None:
        return metric.format(value["mean"], sign), "none: too few scenes"
    mean, low, high = (metric.format(value[key], sign) for key in ("mean", "low", "high"))
    return mean, f"{low} to {high}"


def metrics_of(summaries: Collection[Mapping[str, Any]]) -> dict[str, Metric]:
    """Every metric that one of the runs has."""
    return named({name for summary in summaries for name in summary["methods"]["model"]})


def verdicts(summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """One sentence for each bar and judged metric, true or not; ``decided``: the interval leaves no doubt which.

    A model's own closed form, where it starts from one, is a bar here: what it learned is the gain over it.
    """
    verdicts = []
    for bar in (*BARS, *({"closed_form"} & summary["gains"].keys())):
        for name in JUDGED:
            gain, metric = summary["gains"][bar][name], METRICS[name]
            mean, interval = format_estimate(metric, gain, "+")
            won = gain["mean"] > 0
            text = f"{'beats' if won else 'does not beat'} the {METHODS[bar]} in {metric.label}: gain "
            text += f"{mean} {metric.unit}".rstrip() + f" (95 % interval {interval})"
            verdicts.append({"won": won, "decided": decided(gain), "text": text})
    return verdicts


def ceiling_lines(summary: Mapping[str, Any]) -> list[str]:
    """What the noise of the ground truth means for the scores, a sentence for each metric whose ceiling is an estimate."""
    lines, bounded = [], {}
    for name, metric in named(summary["ceiling"]).items():
        ceiling = summary["ceiling"][name]
        of = f"{ceiling['views']} views of {ceiling['of']}"
        if ceiling["from"] not in CEILING_SOURCES:
            bounded.setdefault(of, []).append(metric.label)
            continue
        mean, interval = format_estimate(metric, ceiling)
        text = f"{metric.label}: the noiseless truth would score " + f"{mean} {metric.unit}".rstrip()
        lines.append(f"{text} (95 % interval {interval}; {of}, {CEILING_SOURCES[ceiling['from']]}).")
    for of, labels in bounded.items():
        what = "the score of a second render with noise of its own, which the truth would beat"
        lines.append(f"{'; '.join(labels)}: {what} ({of}).")
    return lines or ["No view of the data was rendered twice and none has an error estimate: the ceiling is unknown."]


def noise_share(summary: Mapping[str, Any]) -> float | None:
    """The noise's share of the model's squared error, from mean PSNR and its ceiling; None where that is unknown."""
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
        distinct: list[tuple[dict[str, Any], list[str]]] = []  # values of the metrics, and the runs that have them
        for run in runs:
            values = run.summary["ceiling"] if method == "ceiling" else run.summary["methods"].get(method)
            if values is None:
                continue
            for other, names in distinct:
                if all(other.get(name, value) == value for name, value in values.items()):
                    other |= values
                    names.append(run.name)
                    break
            else:
                distinct.append((dict(values), [run.name]))
        kind = "bar" if method in BARS else method
        for values, names in distinct:
            everywhere = len(distinct) == 1 and (len(names) == len(runs) or method != "closed_form")
            suffix = "" if everywhere else f", {', '.join(names)}"
            out.append({"label": label + suffix, "kind": kind, "values": values})
    return out


def best_of(columns: Sequence[Mapping[str, Any]], metrics: Mapping[str, Metric]) -> dict[str, int]:
    """Per metric the column of the best mean among models and bars."""
    best = {}
    for name, metric in metrics.items():
        comparable = [i for i, column in enumerate(columns) if column["kind"] in ("model", "bar") and name in column["values"]]
        best[name] = (max if metric.higher_is_better else min)(
            comparable, key=lambda i, name=name: columns[i]["values"][name]["mean"]
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
    by_run = {}
    for run in runs[1:]:
        scenes = [other.summary["per_scene"] for other in (run, runs[0])]
        metrics = {
            name: metric
            for name, metric in metrics_of([run.summary, runs[0].summary]).items()
            if all(name in other.summary["methods"]["model"] for other in (run, runs[0]))
        }
        by_run[run.name] = difference(*scenes, same, metrics)
    return {name: value for name, value in by_run.items() if value is not None}


def unlike(runs: Sequence[Run]) -> dict[str, list[str]]:
    """Settings in which the runs differ: ``stage.name`` -> a value per run."""
    flat = [dict(flatten(run.configs)) for run in runs]
    names = dict.fromkeys(name for facts in flat for name in facts)
    rows = {name: [facts.get(name, "–") for facts in flat] for name in names}
    return {name: values for name, values in rows.items() if len(set(values)) > 1}


def region_table(runs: Sequence[Run]) -> Table:
    """Mean log error of every region, with its part of the whole; by run, and for the first also of what it is seen against."""
    metric = METRICS["log_error"]
    first = runs[0].summary["regions"]
    against = [method for method in METHODS if method != "model" and method in first[0]["error"]]
    columns = [(METHODS["model"] if len(runs) == 1 else run.name, run.summary["regions"], "model") for run in runs]
    columns += [(METHODS[method], first, method) for method in against]
    rows = []
    for name in REGIONS:
        cells: list[Cell | str | None] = []
        for _, regions, method in columns:
            row = next((row for row in regions if row["region"] == name), None)
            cell = row and Cell(metric.format(row["error"][method]), f"{row['part'][method]:.0%} of the error")
            cells.append(cell)
        if any(cells):
            share = next(row["share"] for _, regions, _ in columns for row in regions if row["region"] == name)
            rows.append([name, f"{share:.0%}", *cells])
    return Table(["region", "pixels", *(label for label, _, _ in columns)], rows, numeric=True)


def markdown(summary: Mapping[str, Any]) -> str:
    """The summary of one run as a Markdown table to paste; the best of model and bars in bold."""
    metrics = metrics_of([summary])
    rows = columns([Run("model", "", summary)])
    best = best_of(rows, metrics)
    cells = [
        [row["label"], *(_cell(metric, row["values"].get(name), best[name] == number) for name, metric in metrics.items())]
        for number, row in enumerate(rows)
        if row["values"]
    ]
    lines = [f"{summary['scenes']} scenes, {summary['views']} views; mean over views [95 % interval over scenes]", ""]
    lines += table(["method", *(metric.heading for metric in metrics.values())], cells, numeric=True)
    lines += ["", *(f"- The model {verdict['text']}." for verdict in verdicts(summary))]
    lines += [f"- Ceiling in {line}" for line in ceiling_lines(summary)] if summary["ceiling"] else []
    return "\n".join(lines) + "\n"


def _cell(metric: Metric, value: Estimate | None, bold: bool, sign: str = "") -> str:
    if value is None:
        return "–"
    return with_interval(value, lambda number: metric.format(number, sign), bold)


def with_unit(metric: Metric) -> str:
    return f"{metric.label} ({metric.unit})" if metric.unit else metric.label


def side_by_side(runs: Sequence[Run], probes: Sequence[Probe]) -> str:
    """Several runs as Markdown tables to paste: runs as columns, differences, probes."""
    lines = []
    if runs:
        metrics = metrics_of([run.summary for run in runs])
        filled = [column for column in columns(runs) if column["values"]]
        best = best_of(filled, metrics) if all_same(runs) else dict.fromkeys(metrics)
        cells = [
            [metric.heading, *(_cell(metric, column["values"].get(name), best[name] == i) for i, column in enumerate(filled))]
            for name, metric in metrics.items()
        ]
        lines = ["Mean over views [95 % interval over scenes]", ""]
        lines += table(["metric", *(column["label"] for column in filled)], cells, numeric=True)
        by_run = differences(runs)
        if by_run:
            first = next(iter(by_run.values()))
            paired = f"paired over {first['views']} views of {first['scenes']} scenes"
            lines += ["", f"How much better than {runs[0].name}, {paired} (positive is better)", ""]
            cells = [
                [with_unit(metric), *(_cell(metric, row["gains"].get(name), False, "+") for row in by_run.values())]
                for name, metric in metrics.items()
            ]
            lines += table(["metric", *by_run], cells, numeric=True)
    for probe in probes:
        facts = probe.facts
        lines += ["", f"### {facts['title']}", "", facts["question"], ""]
        lines += table(facts["columns"], facts["rows"], numeric=True)
        lines += ["", *(f"- {note}" for note in facts["notes"])] if facts["notes"] else []
    return "\n".join(lines).strip() + "\n"


def numbers(runs: Sequence[Run], probes: Sequence[Probe]) -> dict[str, Any]:
    """What the page says, as plain JSON; the scores of every view are in each run's own metrics.json."""
    rows = [
        {"name": run.name, "key": run.key, **{k: v for k, v in run.summary.items() if k != "per_scene"}, "timing": run.timing}
        for run in runs
    ]
    against = {"base": runs[0].name, "runs": differences(runs)} if len(runs) > 1 else None
    return {"runs": rows, "differences": against, "probes": [{"key": probe.key, **probe.facts} for probe in probes]}


def flatten(value: Any, prefix: str = "") -> list[tuple[str, str]]:
    """Nested config as (dotted name, value) lines."""
    if isinstance(value, Mapping):
        return [line for key in value for line in flatten(value[key], f"{prefix}{key}.")]
    return [(prefix.rstrip("."), "none" if value is None else str(value))]
