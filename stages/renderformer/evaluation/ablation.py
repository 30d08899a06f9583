"""Table 1 of the paper: its rows as one sweep over one dataset, and the table with the paper's numbers beside ours.

Reads ``conf/renderformer/experiment/<table>/``, a file per row, and from the store what *evaluate* and *train* left for
each. Writes ``table.md``, ``table.json`` and ``table.png``. Paper: section 4.1.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.atomic import write_atomic
from pipeline.errors import INTERRUPTED, UserError
from pipeline.experiments import Order, Table, made, only_planned, tables

if TYPE_CHECKING:
    from pipeline.store import Artifact
    from pipeline.sweep import Job

COLUMNS = {"psnr": "PSNR", "ssim": "SSIM", "lpips_vgg": "LPIPS", "flip": "FLIP"}  # our metric -> the paper's column
DRAWN = ("psnr", "flip")  # columns of the figure
BASE = "full"  # the row that the others are held against


@dataclass(frozen=True)
class Row:
    """A row of the paper's table: what it says there, and its figures in the order of `COLUMNS`; None: it gives none."""

    name: str  # the file's, in conf/renderformer/experiment/<table>/
    label: str
    figures: tuple[float, float, float, float] | None
    parameters: str = ""  # as the paper states them

    @property
    def paper(self) -> dict[str, float]:
        return dict(zip(COLUMNS, self.figures, strict=True)) if self.figures else {}


ROWS = (
    Row("full", "full model", (29.77, 0.9526, 0.05514, 0.1751), "205M"),
    Row("no_dpt", "without DPT", (29.75, 0.9476, 0.05519, 0.1806)),
    Row("no_self_attention", "without self-attention", (29.70, 0.9503, 0.05703, 0.1766)),
    Row("neither", "without both", (29.15, 0.9396, 0.06407, 0.1836)),
    Row("world_space", "view stage in world space", (28.98, 0.9420, 0.06309, 0.1904)),
    Row("143m", "143M: 768 wide, 8 + 4", (28.99, 0.9444, 0.06408, 0.1873), "143M"),
    Row("71m", "71M: 512 wide, 8 + 4", (28.27, 0.9356, 0.07238, 0.2032), "71M"),
    Row("45m", "45M: 384 wide, 8 + 4", (27.87, 0.9295, 0.07921, 0.2075), "45M"),
    Row("9_9", "9 + 9 layers", (30.11, 0.9554, 0.05121, 0.1735)),
    Row("6_12", "6 + 12 layers", (30.38, 0.9560, 0.05043, 0.1685)),
    Row("0_18", "0 + 18 layers", (28.28, 0.9355, 0.07152, 0.1994)),
    Row("nerf_pe", "NeRF position encoding", None),
)

# What the paper's runs were, beside which `settings` puts ours
PAPER = {
    "training scenes": "2,000,000",
    "objects": "Objaverse",
    "triangles per scene, at most": "1,536",
    "images": "256 px, 4 views per scene",
    "samples per pixel, at most": "4,096",
    "test": "400 scenes, 1,600 views",
    "training": "500,000 steps of 128 scenes x 4 views",
    "visits of each training scene": "32",
    "optimizer": "adamw, learning rate 0.0001, 8,000 steps of warm-up",
    "loss": "L1 of log10(1 + x), 0.05 LPIPS",
    "augmentation": "rotation",
    "start": "random",
    "full model": "12 + 6 layers, width 768",
}


def names() -> list[str]:
    """The tables that are the paper's table 1."""
    return [name for name in tables("renderformer") if name.startswith("table1")]


def table_of(name: str) -> Table:
    return Table.of("renderformer", name, [row.name for row in ROWS])


def jobs_of(table: str, rows: Sequence[str] | None, overrides: Sequence[str]) -> dict[str, Job]:
    """Row name -> its job, in the table's order; a UserError unless all of them read the same shards."""
    jobs = table_of(table).jobs(rows, overrides)
    if len({row for row, _ in jobs}) != len(jobs):
        raise UserError("a table is a sweep over its rows alone: give each override one value, or a list in brackets")
    table_of(table).one_artifact(jobs, "shard", "model")
    return dict(jobs)


def sweep(order: Order) -> int:
    """Train and evaluate what is missing of the rows, then write the table; returns the exit status.

    Rows run side by side, which docs/training.md finds faster than one after the other.
    """
    from stages.renderformer.s06_train import cost

    jobs = jobs_of(order.table, order.rows, order.overrides)
    costs = {}
    for name, job in jobs.items():
        configs = {stage: planned.config for stage, planned in job.plan.items()}
        costs[name] = cost(configs["train"], configs)
    # the dearest first, so that the last ones fill the gaps
    dearest_first = sorted(jobs, key=lambda name: -getattr(costs[name], "days", 0))
    status = table_of(order.table).make(dearest_first, order.overrides, len(jobs))
    if only_planned(jobs.items()):
        known_costs = [estimate for estimate in costs.values() if estimate]
        print(
            f"in all: {len(known_costs)} rows, {sum(estimate.flops for estimate in known_costs):.2e} FLOPs of training, "
            f"{sum(estimate.days for estimate in known_costs):.3g} days of one A100"
        )
        return status
    return status if status == INTERRUPTED else max(status, write_table(order.table, order.rows, order.overrides, order.out))


# --- what the store holds -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Result:
    """What a finished row left: its metrics.json, the manifest's training summary, its rows of the training log."""

    metrics: Mapping[str, Any]
    training: Mapping[str, Any]
    log: Sequence[Mapping[str, Any]]
    evaluated: Artifact


def load(job: Job) -> Result | None:
    evaluated, train = (made(job, stage) for stage in ("evaluate", "train"))
    if evaluated is None:
        return None
    log = train.file("log.jsonl").read_text().splitlines() if train is not None else []
    return Result(
        json.loads(evaluated.file("metrics.json").read_bytes()),
        train.manifest["summary"].get("training", {}) if train is not None else {},
        [json.loads(line) for line in log if line],
        evaluated,
    )


def difference(row: Result, base: Result) -> dict[str, dict[str, float]]:
    """Metric -> row minus base, paired view by view and averaged, with its 95 % interval under resampling of scenes.

    Over the scenes that both have: an item may have run out of time or memory in one of them.
    """
    from stages.graphics.statistics import bootstrap

    def scores(result: Result) -> dict[str, dict[int, Mapping[str, float]]]:
        return {
            scene["id"]: {view["index"]: view["scores"]["model"] for view in scene["views"]}
            for scene in result.metrics["per_scene"]
        }

    ours, theirs = scores(row), scores(base)
    gains = {}
    for metric in COLUMNS:
        pairs = [
            [ours[scene][view][metric] - theirs[scene][view][metric] for view in sorted(ours[scene])]
            for scene in sorted(ours.keys() & theirs.keys())
            if metric in next(iter(ours[scene].values()))
        ]
        if pairs:
            gains[metric] = bootstrap(pairs)
    return gains


def settings(job: Job, full: Job | None, result: Result | None) -> dict[str, str]:
    """What the runs were, in the words of `PAPER`: ``job`` is any of them, ``full`` the full model's if it is one of them."""
    config = {stage: planned.config for stage, planned in job.plan.items()}
    train, scene, render = config["train"], config["scene"], config["render"]
    augmentation = [
        name
        for name, on in (
            ("rotation", train.rotate), ("translation", train.translate_sigma), ("mirroring", train.mirror),
            ("relighting", train.relight), ("exposure", train.exposure_stops),
        ) if on
    ]  # fmt: skip
    # imported scenes have no count: there are as many as files
    requested_counts = scene.count.model_dump() if hasattr(scene, "count") else {}
    scene_counts = result.metrics["data"]["scenes"] if result else requested_counts
    scenes = scene_counts.get("train", 0)
    loss = "L1 of log10(1 + x)" + (f", {train.lpips:g} LPIPS" if train.lpips else "")
    peak = f"learning rate {train.lr:g}" + (f", {train.muon_lr:g} of matrices" if train.optimizer == "muon" else "")
    start = "informed" if train.informed_start is True else "random"
    test = f"{requested_counts.get('test', 0):,} scenes asked for"
    if result:
        test = f"{result.metrics['scenes']:,} scenes, {result.metrics['views']:,} views"
    largest = train.max_triangles or getattr(scene, "max_triangles", None)
    views = f", {scene.cameras.views} views per scene" if hasattr(scene, "cameras") else ""
    model = full.plan["train"].config.model if full is not None else None
    size = f"{model.num_layers} + {model.view_transformer_n_layers} layers, width {model.latent_dim}" if model else "–"
    return {
        "training scenes": f"{scenes:,}",
        "objects": config["collect"].name if requested_counts else "of imported scenes",
        "triangles per scene, at most": f"{largest:,}" if largest else "any",
        "images": f"{render.resolution} px{views}",
        "samples per pixel, at most": f"{render.max_spp:,}",
        "test": test,
        "training": f"{train.steps:,} steps of {train.batch_scenes} scenes x {train.views_per_scene} views",
        "visits of each training scene": f"{train.steps * train.batch_scenes / max(1, scenes):.3g}",
        "optimizer": f"{train.optimizer}, {peak}, {train.warmup:,} steps of warm-up",
        "loss": loss,
        "augmentation": ", ".join(augmentation) or "none",
        "start": start,
        "full model": size,
    }


def gather(table: str, jobs: Mapping[str, Job]) -> dict[str, Any]:
    """Everything that the table says, as plain JSON."""
    first = next(iter(jobs.values()))
    results = {name: load(job) for name, job in jobs.items()}
    base = results.get(BASE)
    some = next((result for result in results.values() if result), None)
    rows = []
    for row in ROWS:
        entry: dict[str, Any] = {"name": row.name, "label": row.label, "paper": row.paper, "paper_parameters": row.parameters}
        result = results.get(row.name)
        if result is not None:
            model = jobs[row.name].plan["train"].config.model
            norms = [line["grad_norm"] for line in result.log if line.get("grad_norm") is not None]
            losses = [line["loss"] for line in result.log if line.get("loss") is not None]
            entry |= {
                "layers": [model.num_layers, model.view_transformer_n_layers],
                "width": model.latent_dim,
                "parameters": result.metrics["train"]["parameters"],
                "ours": {name: value for name, value in result.metrics["methods"]["model"].items() if name in COLUMNS},
                "training": {
                    "loss": losses[-1] if losses else None,
                    "largest_grad_norm": max(norms, default=None),
                    **{name: result.training.get(name) for name in ("steps", "skipped", "seconds")},
                },
                "evaluate": result.evaluated.key,
                "train": result.metrics["train"]["key"],
            }
            if base is not None and row.name != BASE:
                entry["difference"] = difference(result, base)
        rows.append(entry)
    for entry in rows:
        if entry["paper"] and entry["name"] != BASE:
            entry["paper_difference"] = {name: round(value - ROWS[0].paper[name], 5) for name, value in entry["paper"].items()}
    return {
        "table": table,
        "rows": rows,
        "bars": {
            name: {metric: value for metric, value in some.metrics["methods"][name].items() if metric in COLUMNS}
            for name in ("mean_image", "constant", "direct")
        } if some else {},
        "shard": first.plan["shard"].key,
        "settings": {"paper": PAPER, "here": settings(first, jobs.get(BASE), some)},
    }  # fmt: skip


# --- the table ----------------------------------------------------------------------------------------------------------------


def write_table(table: str, rows: Sequence[str] | None, overrides: Sequence[str], out: Path) -> int:
    """Write table.md, table.json and table.png into ``out``; 1 if a row that was asked for is not in the store."""
    jobs = jobs_of(table, rows, overrides)
    numbers = gather(table, jobs)
    out.mkdir(parents=True, exist_ok=True)
    write_atomic(out / "table.json", (json.dumps(numbers, indent=1, allow_nan=False) + "\n").encode())
    write_atomic(out / "table.md", markdown(numbers).encode())
    draw(numbers, out / "table.png")
    print(out / "table.md")
    return table_of(table).tell_missing([row["name"] for row in numbers["rows"] if row["name"] in jobs and "ours" not in row])


def _format(metric: str, value: float | None, sign: str = "") -> str:
    digits = {"psnr": 2, "lpips_vgg": 5}.get(metric, 4)
    return "–" if value is None else f"{value:{sign}.{digits}f}".replace("-", "−")


def _with_interval(metric: str, value: Mapping[str, float] | None, sign: str = "") -> str:
    """Mean and interval; a difference whose interval leaves no doubt about its sign is bold."""
    from stages.graphics.statistics import decided, with_interval

    if value is None:
        return "–"
    return with_interval(value, lambda number: _format(metric, number, sign), bool(sign) and decided(value))


def _pairs(ours: Mapping[str, Any], paper: Mapping[str, float], sign: str = "") -> list[str]:
    """For every column our cell and the paper's."""
    cells = []
    for name in COLUMNS:
        cells += [_with_interval(name, ours.get(name), sign), _format(name, paper.get(name), sign)]
    return cells


def _table(header: Sequence[str], rows: Sequence[Sequence[str]], text_columns: int = 1) -> list[str]:
    """A Markdown table whose first ``text_columns`` columns are text."""
    rule = "".join(" --- |" if place < text_columns else " ---: |" for place in range(len(header)))
    return [f"| {' | '.join(header)} |", f"|{rule}", *(f"| {' | '.join(row)} |" for row in rows), ""]


def _size(row: Mapping[str, Any]) -> list[str]:
    if "ours" not in row:
        return ["no result", "", "", row["paper_parameters"]]
    layers = " + ".join(map(str, row["layers"]))
    return [layers, str(row["width"]), f"{row['parameters'] / 1e6:.1f}M", row["paper_parameters"]]


def markdown(numbers: Mapping[str, Any]) -> str:
    """The whole page."""
    from stages.graphics.statistics import METHODS

    columns = []
    for name, column in COLUMNS.items():
        columns += [f"{column} {'↑' if name in ('psnr', 'ssim') else '↓'}", "paper"]
    figures = [[row["label"], *_size(row), *_pairs(row.get("ours", {}), row["paper"])] for row in numbers["rows"]]
    figures += [[f"*{METHODS[name]}*", "", "", "", "", *_pairs(scores, {})] for name, scores in numbers["bars"].items()]
    gaps = [
        [row["label"], *_pairs(row.get("difference", {}), row.get("paper_difference", {}), "+")]
        for row in numbers["rows"]
        if row["name"] != BASE
    ]
    training = [
        [row["label"], *("–" if value is None else f"{value:,.{digits}f}" for value, digits in zip(
            [row["training"][name] for name in ("loss", "largest_grad_norm", "skipped", "seconds")], (4, 3, 0, 0), strict=True
        ))]
        for row in numbers["rows"]
        if "ours" in row
    ]  # fmt: skip
    our_settings = numbers["settings"]["here"]
    measured = any("lpips_vgg" in row.get("ours", {}) for row in numbers["rows"])
    lines = [
        f"# Table 1 of the paper: {numbers['table']}",
        "",
        "The paper's figures stand beside ours to compare the order of the rows and the size of their differences, not "
        "the figures themselves: the last table says how much smaller our runs are. Means over views, with 95 % intervals "
        "under resampling of scenes. PSNR and SSIM are of linear values clamped to [0, 1], FLIP is HDR-FLIP. All rows: one "
        f"dataset (shard {numbers['shard'][:12]}), one recipe, one seed, the same batches in the same order."
        + ("" if measured else " LPIPS is measured where its weights are given (evaluate.lpips=vgg, docs/training.md)."),
        "",
        *_table(["variant", "layers", "width", "parameters", "paper", *columns], figures),
        "![Differences to the full model](table.png)",
        "",
        "## Differences to the full model",
        "",
        "Row minus full model. Ours are taken view by view on the same test scenes before they are averaged, bold where the "
        "interval leaves no doubt about the sign. They are of one run per row: another seed would move them too.",
        "",
        *_table(["variant", *columns], gaps),
        "## Training",
        "",
        *_table(["variant", "last loss", "largest gradient norm", "steps skipped", "seconds"], training),
        "## What differs from the paper",
        "",
        *_table(
            ["", "paper", "here"],
            [[name, text, our_settings[name]] for name, text in numbers["settings"]["paper"].items()],
            text_columns=3,
        ),
        "The authors later found a shader bug in the paper's training data and trained the released models anew, so that the "
        "paper's figures are not theirs either.",
    ]
    return "\n".join(lines) + "\n"


def draw(numbers: Mapping[str, Any], path: Path) -> None:
    """Differences to the full model, a panel per metric of `DRAWN`: ours with their intervals, the paper's beside them."""
    from matplotlib.figure import Figure

    rows = [row for row in numbers["rows"] if row["name"] != BASE][::-1]  # the first on top
    figure = Figure(figsize=(9, 0.36 * len(rows) + 1.6), layout="constrained")
    panels = figure.subplots(1, len(DRAWN), sharey=True)
    for axes, metric in zip(panels, DRAWN, strict=True):
        axes.axvline(0, color="0.3", linewidth=1)
        for place, row in enumerate(rows):
            ours = row.get("difference", {}).get(metric)
            if ours is not None:
                if ours["low"] is not None:
                    axes.plot([ours["low"], ours["high"]], [place + 0.12] * 2, color="C0", linewidth=2, solid_capstyle="round")
                axes.plot(ours["mean"], place + 0.12, "o", color="C0", markersize=6)
            theirs = row.get("paper_difference", {}).get(metric)
            if theirs is not None:
                axes.plot(theirs, place - 0.16, "D", color="C1", markerfacecolor="white", markersize=5)
        better = "right" if metric == "psnr" else "left"
        axes.set(title=f"{COLUMNS[metric]}{' (dB)' if metric == 'psnr' else ''}, better to the {better}")
        axes.set(xlabel="difference to the full model", ylim=(-0.6, len(rows) - 0.4))
        axes.set_yticks(range(len(rows)), [row["label"] for row in rows])
        axes.grid(axis="x", alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].plot([], [], "o-", color="C0", label="here, 95 % interval over test scenes")
    panels[0].plot([], [], "D", color="C1", markerfacecolor="white", label="paper")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    figure.savefig(path, dpi=130)
