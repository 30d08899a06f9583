"""The paper's tables on one page: our rows, each a config file, with the published figures beside them.

Reads ``conf/neuras/experiment/<table>/`` and from the store what *evaluate* left for each row. Writes ``report.html`` (one file
that opens from disk), ``report.md`` and ``report.json``. Rows that are not in the store yet are shown as such.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.atomic import write_atomic
from pipeline.errors import INTERRUPTED, UserError
from pipeline.experiments import Experiments, Order, Table, made, only_planned
from stages.graphics.metrics import Metric
from stages.graphics.page import Cell, Picture, Section, Text, markdown, render
from stages.graphics.page import Table as PageTable
from stages.graphics.statistics import bootstrap, decided
from stages.neuras.evaluation.distributions import METRICS as DISTRIBUTION_METRICS
from stages.neuras.evaluation.paper import TABLES, PaperTable
from stages.neuras.evaluation.report import thumbnail
from stages.neuras.evaluation.scores import told

if TYPE_CHECKING:
    from pipeline.store import Artifact
    from pipeline.sweep import Job

ALL = "paper"  # stands for all of the tables
BETWEEN = "between frames"  # the group of views that tables are of
SHIFTS = (2, 3)  # metres beside the lane
GAINS = {  # name: metres beside the lane, and the column's heading
    "gain": (0, "PSNR against the first row"),
    "gain_3": (3, "PSNR at 3 m against the first row"),
}
MB = 1e6


@dataclass(frozen=True)
class Made:
    """What the store has of a row: its evaluation, and what stages before it say of theirs."""

    evaluated: Artifact
    summary: Mapping[str, Any]
    timing: Mapping[str, Any]
    notes: Mapping[str, Mapping[str, Any]]  # stage -> its manifest's summary

    @classmethod
    def of(cls, job: Job) -> Made | None:
        evaluated = made(job)
        if evaluated is None:
            return None
        before = {stage: artifact for stage in ("capture", "scaffold", "atlas") if (artifact := made(job, stage)) is not None}
        return cls(
            evaluated,
            *(json.loads(evaluated.file(name).read_bytes()) for name in ("metrics.json", "timing.json")),
            {stage: artifact.manifest["summary"].get("summary", {}) for stage, artifact in before.items()},
        )

    @property
    def held_out(self) -> list[Mapping[str, Any]]:
        """What is known of each view that the tables are of; none where ``evaluate.splits`` leaves them out."""
        return [view for view in self.summary["per_view"] if view["split"] == "test"]

    def beside(self, metres: float) -> list[Mapping[str, Any]]:
        """The same of the views so far beside the lane; at 0 those between frames."""
        views = self.summary["per_view"]
        return (
            [view for view in views if view["split"] == "shift" and abs(view["shift"]) == metres] if metres else self.held_out
        )

    def picture(self, id: str, name: str) -> bytes:
        """A view's PNG: the photo, or a method's."""
        return self.evaluated.read(id, (f"{name}.png",)).members[f"{name}.png"]

    def group(self, label: str) -> Mapping[str, Any] | None:
        return next((group for group in self.summary["groups"] if group["label"] == label), None)

    def score(self, label: str, method: str, metric: str) -> Mapping[str, Any] | None:
        """Mean and interval of a group's metric; LPIPS of whichever network."""
        group = self.group(label)
        scores = {} if group is None else group["methods"].get(method, {})
        return next((value for name, value in scores.items() if name.startswith(metric)), None)

    def shifted(self, metres: int, method: str) -> Mapping[str, Any] | None:
        """PSNR beside the lane, of both sides or of the one that there is."""
        labels = (f"{metres} m, both sides", f"{metres} m to the left", f"{metres} m to the right")
        return next((score for label in labels if (score := self.score(label, method, "psnr")) is not None), None)

    def fid(self, metres: int, method: str) -> Mapping[str, Any] | None:
        sets = {row["label"]: row["methods"] for row in self.summary.get("distributions", [])}
        found = sets.get(f"{metres} m, both sides", {}).get(method)
        return None if found is None else {"mean": found["fid"]}


def _exactly(value: float | None) -> Mapping[str, Any] | None:
    return None if value is None else {"mean": value}


def _ours_alone(value: Callable[[Made], float | None]) -> Callable[[Made, str], Mapping[str, Any] | None]:
    return lambda row, method: _exactly(value(row)) if method == "ours" else None


@dataclass(frozen=True)
class Column:
    """A column: how numbers are written, and how a row's is found. metric: of a mean over views; None: a count or a cost."""

    heading: str
    format: Callable[[float], str]
    value: Callable[[Made, str], Mapping[str, Any] | None]


def _of_metric(name: str, metric: Metric, heading: str = "") -> Column:
    return Column(heading or metric.heading, metric.format, lambda row, method: row.score(BETWEEN, method, name))


def _columns() -> dict[str, Column]:
    metrics = told(["mse", "psnr", "ssim", "lpips_vgg"])
    columns = {name: _of_metric(name, metrics[name]) for name in ("mse", "psnr", "ssim")}
    columns["lpips"] = _of_metric("lpips", metrics["lpips_vgg"], "LPIPS ↓")
    for metres in SHIFTS:
        columns[f"psnr_{metres}"] = Column(
            f"PSNR at {metres} m ↑", metrics["psnr"].format, lambda row, method, metres=metres: row.shifted(metres, method)
        )
        columns[f"fid_{metres}"] = Column(
            f"FID at {metres} m ↓",
            DISTRIBUTION_METRICS["fid"].format,
            lambda row, method, metres=metres: row.fid(metres, method),
        )
    device = _ours_alone(lambda row: sum(row.summary["device"][of] for of in ("fp16", "geometry", "residuals")) / MB)
    columns["memory"] = Column("on the device, MB", "{:,.0f}".format, device)
    columns["stored"] = Column("stored, MB", "{:,.1f}".format, _ours_alone(lambda row: row.summary["storage"]["stored"] / MB))
    columns["fps"] = Column(
        "frames/s ↑", "{:,.3g}".format, _ours_alone(lambda row: row.timing.get("opengl", {}).get("neural_fps"))
    )
    for name, stage in (("vertices", "scaffold"), ("faces", "atlas"), ("charts", "atlas")):
        columns[name] = Column(
            name, "{:,.0f}".format, _ours_alone(lambda row, name=name, stage=stage: row.notes.get(stage, {}).get(name))
        )
    return columns


COLUMNS = _columns()


# --- making -----------------------------------------------------------------------------------------------------------


def chosen(name: str) -> list[PaperTable]:
    """The tables of that name; all for `ALL`."""
    tables = [table for table in TABLES if name in (ALL, table.name)]
    if not tables:
        raise UserError(f"table {name!r} is unknown: choose from {', '.join([ALL, *(table.name for table in TABLES)])}")
    return tables


def files_of(table: PaperTable) -> Table:
    return Table.of("neuras", table.name, list(dict.fromkeys(row.file for row in table.rows if row.file)))


def _orders(order: Order) -> list[tuple[PaperTable, Table, list[str]]]:
    """Tables with the rows that are asked for. ``--rows`` names rows of one table."""
    tables = chosen(order.table)
    if order.rows is not None and len(tables) > 1:
        raise UserError(
            f"--rows chooses among the rows of one table: name it, such as `lightmill sweep {tables[0].name} --rows ..`"
        )
    return [(table, files, files.chosen(order.rows)) for table in tables for files in [files_of(table)]]


def sweep(order: Order) -> int:
    """Make what is missing, table by table, since rows of one table share the most; then the page. Returns the exit status."""
    status = 0
    for _, files, rows in _orders(order):
        done = files.make(rows, order.overrides, len(rows), order.until)
        if done == INTERRUPTED:
            return done
        status = max(status, done)
    planned = any(only_planned(files.jobs(rows[:1], order.overrides)) for _, files, rows in _orders(order)[:1])
    return status if planned or order.until != "evaluate" else max(status, write(order))


def write(order: Order) -> int:
    """The page of what the store holds; 1 if a row that was asked for is not there."""
    numbers, sections, missing = [], [], 0
    for table, files, rows in _orders(order):
        jobs = files.jobs(rows, order.overrides)
        if len(jobs) != len(rows):
            raise UserError("a table is a sweep over its rows alone: give each override one value, or a list in brackets")
        found = {row: result for row, job in jobs if (result := Made.of(job)) is not None}
        missing |= files.tell_missing([row for row in rows if row not in found])
        gathered = gather(table, found, dict(jobs))
        numbers.append(gathered)
        sections.append(Section(table.title, [*blocks(table, gathered), *pictures(table, found)]))
    title = "The paper's tables" if len(numbers) > 1 else sections[0].title
    lead = [Text(LEAD)]
    order.out.mkdir(parents=True, exist_ok=True)
    page = render(Path(__file__).with_name("tables.html.j2"), title, lead=lead, sections=sections)
    words = [Section(section.title, [block for block in section.blocks if block.kind != "figure"]) for section in sections]
    write_atomic(order.out / "report.html", page.encode())
    write_atomic(order.out / "report.md", (markdown.document(title, lead, words) + "\n").encode())
    write_atomic(order.out / "report.json", (json.dumps(numbers, indent=1, allow_nan=False) + "\n").encode())
    print(order.out / "report.html")
    return missing


LEAD = (
    "**Published** columns hold the paper's own figures. Other scenes, other counts and other machines are behind them, as the "
    "last table of each section says: compare the order of the rows and the size of their differences, not the figures. Ours "
    "are means over held-out views; below a figure stands its 95 % interval under resampling of frames. Differences to the "
    "first row are taken frame by frame before they are averaged, and positive is better. Frames per second are of the machine "
    "that made the rows, mostly software OpenGL. A dash: not measured, or not published."
)


# --- what a table says ------------------------------------------------------------------------------------------------


def gather(table: PaperTable, found: Mapping[str, Made], jobs: Mapping[str, Job]) -> dict[str, Any]:
    """Everything that the table says, as plain JSON."""
    base = next(row for row in table.rows if row.file)  # columns say "the first row": without it there is none
    rows = []
    for row in table.rows:
        entry: dict[str, Any] = {"label": row.label, "file": row.file, "method": row.method, "published": dict(row.figures)}
        if row.file in found:
            result = found[row.file]
            values = {name: COLUMNS[name].value(result, row.method) for name in table.columns}
            entry["ours"] = {name: value for name, value in values.items() if value is not None}
            entry["evaluate"] = result.evaluated.key
            if table.paired and base.file in found and row is not base:
                for name, (metres, _) in GAINS.items():
                    entry[name] = gain(result, row.method, found[base.file], base.method, metres)
        rows.append(entry)
    first = next(iter(found.values()), None)
    differs = [] if first is None else here(first, jobs[next(iter(found))])
    facts = [[name, table.facts.get(name), dict(differs).get(name)] for name in dict.fromkeys([*table.facts, *dict(differs)])]
    return {"table": table.name, "title": table.title, "rows": rows, "differs": facts}


def gain(row: Made, method: str, base: Made, base_method: str, metres: float) -> dict[str, Any] | None:
    """How much better in PSNR than the first row, frame by frame, so far beside the lane; None where they are not of the same
    frames."""

    def scores(of: Made, method: str) -> dict[str, float]:
        return {view["id"]: view["scores"][method]["psnr"] for view in of.beside(metres) if method in view["scores"]}

    ours, theirs = scores(row, method), scores(base, base_method)
    if not ours or ours.keys() != theirs.keys() or any(row.picture(id, "photo") != base.picture(id, "photo") for id in ours):
        return None
    return bootstrap([[ours[id] - theirs[id]] for id in sorted(ours)])


def here(row: Made, job: Job) -> list[tuple[str, str]]:
    """What our runs were, in the names of ``PaperTable.facts``, and more."""
    capture, fit = (job.plan[stage].config for stage in ("capture", "fit"))
    notes, atlas = row.notes.get("capture", {}), row.notes.get("atlas", {})
    counts = notes.get("frames", {})
    scene = {
        "street": f"a made-up street, seed {getattr(capture, 'seed', 0)}",
        "drone": f"made-up blocks of houses from the air, seed {getattr(capture, 'seed', 0)}",
        "object": "made-up objects",
    }.get(getattr(capture, "preset", ""), f"one capture, {capture.name}")
    pixels = fit.patches * fit.patch**2
    drawn = row.timing.get("opengl")
    sets = row.summary.get("distributions")
    facts = {
        "scenes": scene,
        "images": ", ".join(notes.get("sizes", {})),
        "held out": f"{notes.get('split_rule', '')} ({counts.get('train', 0)} for training, {counts.get('test', 0)} scored)",
        "texture": f"{atlas.get('width')} x {atlas.get('height')}, {fit.texture_levels} levels, {fit.channels} channels",
        "skyboxes": str(fit.skyboxes),
        "training": f"{fit.steps:,} steps of {pixels:,} pixels, learning rate {fit.lr:g}",
        "perceptual loss": {True: "none", False: fit.perceptual_network}[fit.perceptual == 0],
    }
    if drawn:
        facts["frames per second"] = (
            f"{drawn['drawn_by']}, {drawn['size'][0]} x {drawn['size'][1]}; "
            f"{drawn['ratio']:.1f} times the time of a plain textured mesh"
        )
    scored = row.summary["per_view"][0]["scores"]["ours"]
    if networks := [name for name in scored if name.startswith("lpips_")]:
        facts["LPIPS"] = f"by {networks[0].removeprefix('lpips_')}"
    if sets:
        facts["FID"] = (
            f"{sets[0]['photos']} photos, sets of " + ", ".join(sorted({str(one["views"]) for one in sets})) + " views"
        )
    return list(facts.items())


# --- the page ---------------------------------------------------------------------------------------------------------


def blocks(table: PaperTable, numbers: Mapping[str, Any]) -> list[Any]:
    """Tables and texts of a section."""
    rows = numbers["rows"]
    shown = [name for name in table.columns if any(name in row.get("ours", {}) or name in row["published"] for row in rows)]
    heads: list[Any] = ["row"]
    for name in shown:
        heads.append(COLUMNS[name].heading)
        if any(name in row["published"] for row in rows):
            heads.append(Cell("published", COLUMNS[name].heading, kind="soft"))
    gains = [name for name in GAINS if any(row.get(name) for row in rows)]
    lines = []
    for row in rows:
        line: list[Any] = [
            Cell(row["label"], "" if row["file"] else "published only", kind="strong" if row["file"] else "soft")
        ]
        if row["file"] and "ours" not in row:
            line[0] = Cell(row["label"], f"not made: lightmill sweep {table.name} --rows {row['file']} system=neuras")
        for name in shown:
            line.append(_ours(name, row.get("ours", {}).get(name)))
            if any(name in other["published"] for other in rows):
                line.append(_published(name, row["published"].get(name)))
        line += [_gain(row.get(name)) for name in gains]
        lines.append(line)
    heads += [GAINS[name][1] for name in gains]
    out: list[Any] = [PageTable(heads, lines, numeric=True)]
    if table.note:
        out.append(Text(table.note, quiet=True))
    if table.facts:
        out.append(PageTable(["", Cell("published", kind="soft"), "here"], numbers["differs"]))
    else:
        out.append(PageTable(["", "here"], [[name, value] for name, _, value in numbers["differs"]]))
    return out


def _ours(name: str, value: Mapping[str, Any] | None) -> Cell | None:
    if value is None:
        return None
    form = COLUMNS[name].format
    interval = "" if value.get("low") is None else f"[{form(value['low'])}, {form(value['high'])}]"
    return Cell(form(value["mean"]), interval)


def _published(name: str, value: float | None) -> Cell | None:
    return None if value is None else Cell(f"{value:.2f}" if name == "psnr" else f"{value:,.10g}", kind="soft")


def _gain(value: Mapping[str, Any] | None) -> Cell | None:
    if value is None:
        return None
    interval = "" if value["low"] is None else f"[{value['low']:+.2f}, {value['high']:+.2f}]"
    kind = ("good" if value["mean"] > 0 else "bad") if decided(value) else ""
    return Cell(f"{value['mean']:+.2f}", interval, kind=kind)


def pictures(table: PaperTable, found: Mapping[str, Made]) -> list[Picture]:
    """The photo of one view, and every row's picture of it; of tables whose rows are of different scenes, both of each."""
    out: list[Picture] = []
    id = ""
    for row in table.rows:
        if row.file not in found:
            continue
        result = found[row.file]
        views = result.held_out or result.summary["per_view"]
        views = sorted(views, key=lambda view: (view["scores"]["ours"]["psnr"], view["id"]))
        if not id or not table.paired:
            id = views[len(views) // 2]["id"]
            out.append(Picture(thumbnail(result.picture(id, "photo")), f"photo {id}"))
        if row.method in views[0]["scores"]:
            out.append(Picture(thumbnail(result.picture(id, row.method)), row.label))
    return out


EXPERIMENTS = Experiments(ALL, sweep, write)
