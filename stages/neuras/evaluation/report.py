"""The report: one HTML page with its pictures and videos inside, so that it opens from disk and can be mailed.

Pictures in the gallery are JPEGs of the records' PNGs. A difference is taken in 8-bit sRGB, times 4.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pipeline.stage import Inputs
from stages.graphics.metrics import Metric
from stages.graphics.page import Cell, Clip, Picture, Table, embed, render
from stages.graphics.statistics import decided
from stages.neuras.baking.drawing import INSTALL
from stages.neuras.evaluation.distributions import METRICS as DISTRIBUTION_METRICS
from stages.neuras.evaluation.distributions import TRUTH
from stages.neuras.evaluation.scores import PLACES, SEEN, told
from stages.neuras.evaluation.summary import METHODS
from stages.neuras.evaluation.views import GAIN
from stages.neuras.records import CaptureInfo

SHOWN = {"photo": "photo", "ours": "ours", "warping": "warping", "difference": f"difference ×{GAIN}"}
WIDEST = 640  # pixels of a picture in the gallery
AGAIN = "then run again with `force=evaluate`"
NO_OPENGL = (
    "The baked shader's scores, its agreement with torch and its frames per second: OpenGL did not start. "
    f"To have them, {INSTALL}, {AGAIN}."
)
KINDS = {
    "fp16": "OpenGL, half-float textures",
    "rgba8": "OpenGL, 8-bit textures",
    "page": "the page in a browser",
}

Summary = Mapping[str, Any]  # of `summary.summarise`, with what the stage adds
Group = Mapping[str, Any]  # one of its groups
ReadPicture = Callable[[str, str], bytes]  # a frame's id and a picture's name -> PNG


@dataclass(frozen=True)
class About:
    """What was evaluated: the stage's inputs by role, its own key and config, what drew by OpenGL."""

    inputs: Inputs
    key: str
    config: Mapping[str, Any]
    drawn_by: str | None

    def facts(self) -> dict[str, str]:
        info = CaptureInfo.of(self.inputs["capture"])
        unit = "metres" if info.units == "metre" else f"arbitrary; a nominal metre is {info.metre:.4g}"
        return {
            **{role: f"{artifact.name}" for role, artifact in self.inputs.items()},
            "source": ", ".join(f"{name} {value}" for name, value in info.source.items()),
            "split": info.split_rule,
            "unit": unit,
            "OpenGL": self.drawn_by or "none",
            "page": str(self.inputs["bake"].file("site/index.html")),
        }


def without_weights(lpips: bool, inception: bool) -> list[str]:
    """What these settings leave out because it needs published weights, and what would give it."""
    missing = []
    if not lpips:
        missing.append("LPIPS: `lightmill weights lpips` fetches its networks, then run with `evaluate.lpips=vgg,alex`.")
    if not inception:
        missing.append(
            "FID and KID beside the drive: `lightmill weights inception` fetches their network, then run with "
            "`evaluate.inception=true`."
        )
    return missing


def no_page(error: Exception) -> str:
    return f"The page's pictures and frame times: {error}. To have them, install chromium, {AGAIN}."


# --- numbers in words -------------------------------------------------------------------------------------------------


def main_groups(summary: Summary) -> list[Group]:
    """Between the frames and each shift as a whole: both sides, or the one there is."""
    both = {group["metres"] for group in summary["groups"] if group["kind"] == "both"}
    return [group for group in summary["groups"] if group["kind"] != "side" or group["metres"] not in both]


def verdicts(summary: Summary) -> list[dict[str, Any]]:
    """How much better than warping in PSNR, for each main group, each side stated. ``decided``: beyond doubt."""
    psnr = told(["psnr"])["psnr"]
    out = []
    for group in main_groups(summary):
        gain = group["gains"]["ours"]["psnr"]
        of_group = [g for g in summary["groups"] if g["kind"] == "side" and g["metres"] == group["metres"] and g is not group]
        sides = "; ".join(f"{side['label']} {psnr.format(side['gains']['ours']['psnr']['mean'], '+')}" for side in of_group)
        text = f"{group['label']}: {psnr.format(gain['mean'], '+')} dB{_interval(psnr, gain)}{f' ({sides})' if sides else ''}"
        out.append({"text": text, "won": gain["mean"] > 0, "decided": decided(gain), "shifted": group["kind"] != "between"})
    return out


def headline(summary: Summary) -> dict[str, Any]:
    """The few numbers that `lightmill show` prints."""
    return {
        group["label"]: {
            method: {name: round(row[name]["mean"], 4) for name in ("psnr", "ssim")} for method, row in group["methods"].items()
        }
        for group in summary["groups"]
    }


def lines(summary: Summary) -> list[str]:
    """PSNR of every main group, for the run's output."""
    return [
        f"{group['label']} ({group['views']} views), PSNR: "
        + ", ".join(f"{METHODS[method]} {row['psnr']['mean']:.2f}" for method, row in group["methods"].items())
        for group in main_groups(summary)
    ]


def _interval(metric: Metric, value: Mapping[str, Any], sign: str = "+") -> str:
    return "" if value["low"] is None else f" [{metric.format(value['low'], sign)}, {metric.format(value['high'], sign)}]"


# --- tables -----------------------------------------------------------------------------------------------------------


def score_table(groups: Sequence[Group]) -> Table:
    """Rows are groups and metrics; columns the methods and how much better ours is than warping. The best is marked."""
    methods = list(groups[0]["methods"])
    rows = []
    for group in groups:
        for number, (name, metric) in enumerate(told(group["methods"]["ours"]).items()):
            means = {method: group["methods"][method][name]["mean"] for method in methods}
            best = (max if metric.higher_is_better else min)(means, key=lambda method: means[method])
            gain = group["gains"]["ours"][name]
            kind = ("good" if gain["mean"] > 0 else "bad") if decided(gain) else ""
            rows.append(
                [
                    Cell(group["label"], f"{group['views']} views", kind="strong") if number == 0 else "",
                    metric.heading,
                    *(_score(metric, group["methods"][method][name], method == best) for method in methods),
                    Cell(metric.format(gain["mean"], "+"), _interval(metric, gain).strip(), kind=kind),
                ]
            )
    return Table(["views", "metric", *(METHODS[method] for method in methods), "better than warping"], rows, numeric=True)


def _score(metric: Metric, value: Mapping[str, Any], best: bool) -> Cell:
    return Cell(metric.format(value["mean"]), _interval(metric, value, "").strip(), kind="best" if best else "")


def distribution_table(summary: Summary) -> Table | None:
    """FID and KID beside the drive, of the truth where it is known and of every method; None where they were not measured."""
    sets = summary.get("distributions")
    if not sets:
        return None
    columns = list(sets[0]["methods"])
    rows = []
    for row in sets:
        methods = [method for method in columns if method != TRUTH]
        for number, (name, metric) in enumerate(DISTRIBUTION_METRICS.items()):
            best = min(methods, key=lambda method: row["methods"][method][name])
            about = Cell(row["label"], f"{row['views']} views against {row['photos']} photos", kind="strong")
            cells = [Cell(metric.format(row["methods"][m][name]), kind="best" if m == best else "") for m in columns]
            rows.append([about if number == 0 else "", metric.heading, *cells])
    return Table(["views", "metric", *(METHODS.get(method, "the truth there") for method in columns)], rows, numeric=True)


def error_table(groups: Sequence[Group]) -> Table | None:
    """Where the squared error sits; None where no true depth is known."""
    known = [group for group in groups if group["errors"] is not None]
    if not known:
        return None
    columns = [f"{words}, {what}" for words in PLACES.values() for what in ("pixels", "error")]
    rows = [
        [
            group["label"],
            *(f"{100 * group['errors'][place][what]:.0f} %" for place in PLACES for what in ("pixels", "squared_error")),
        ]
        for group in known
    ]
    return Table(["views", *columns], rows, numeric=True)


def agreement_table(summary: Summary) -> Table | None:
    """How far other renderers of the same scene are from torch; None where none drew."""
    rows = []
    for kind, row in summary["agreement"].items():
        worst = row["worst"]
        rows.append([KINDS[kind], *_steps(row), Cell(f"{100 * worst['seen']:.2f} %", worst["id"])])
    if "page" in summary:
        views = summary["page"]
        row = {name: max(view[name] for view in views) for name in ("median", "p99")}
        row["seen"] = sum(view["seen"] for view in views) / len(views)
        worst = max(views, key=lambda view: view["seen"])
        rows.append([KINDS["page"], *_steps(row), Cell(f"{100 * worst['seen']:.2f} %", worst["id"])])
    columns = ["against torch", "median", "99 %", f"over {SEEN}/255", "worst view"]
    return Table(columns, rows, numeric=True) if rows else None


def _steps(row: Mapping[str, float]) -> list[str]:
    return [f"{row['median']:.3f}", f"{row['p99']:.3f}", f"{100 * row['seen']:.3f} %"]


def time_table(timing: Mapping[str, Any]) -> Table | None:
    """Frames per second, and the neural shader's cost as a ratio; None where nothing was timed."""
    rows = []
    if "opengl" in timing:
        row = timing["opengl"]
        width, height = row["size"]
        for what, fps, ratio in (
            ("baked shader", row["neural_fps"], row["ratio"]),
            ("plain textured mesh", row["plain_fps"], 1.0),
        ):
            rows.append([Cell(f"{what}, {width} × {height}", row["drawn_by"]), f"{fps:.2f}", f"{ratio:.2f}"])
    if timing.get("page", {}).get("ms"):
        width, height = timing["page"]["size"]
        fps = 1000 / float(np.median(timing["page"]["ms"]))
        rows.append(
            [Cell(f"the page, {width} × {height}", "a browser without a window, WebGL 2 in software"), f"{fps:.2f}", None]
        )
    return Table(["what is drawn", "frames per second", "time, plain = 1"], rows, numeric=True) if rows else None


def byte_table(summary: Summary) -> Table:
    """Bytes on disk and on the device, in megabytes."""
    stored, device = summary["storage"], summary["device"]
    rows = [
        [
            f"stored: geometry, textures, shaders, residuals{', codes and codebooks' if stored['quantized'] else ''}",
            _mb(stored["stored"]),
        ],
        ["the same without quantization: features as half floats", _mb(stored["without_codes"])],
        *([f"  of the site: {kind}", _mb(size)] for kind, size in stored["kinds"].items()),
        ["on the device: half-float textures and geometry", _mb(device["fp16"] + device["geometry"])],
        ["on the device: 8-bit textures and geometry", _mb(device["rgba8"] + device["geometry"])],
        *([["on the device: residuals beside them", _mb(device["residuals"])]] if device["residuals"] else []),
    ]
    return Table(["what", "MB"], rows, numeric=True)


def _mb(size: float) -> str:
    return f"{size / 1e6:.2f}"


def tiles(summary: Summary, timing: Mapping[str, Any]) -> dict[str, Cell]:
    """The figures that a reader looks for first."""
    psnr = told(["psnr"])["psnr"]
    found = {}
    for group in main_groups(summary):
        ours, warping = (group["methods"][method]["psnr"]["mean"] for method in ("ours", "warping"))
        found[f"PSNR (dB), {group['label']}"] = Cell(psnr.format(ours), f"warping {psnr.format(warping)}")
    found["stored (MB)"] = Cell(_mb(summary["storage"]["stored"]), f"without codes {_mb(summary['storage']['without_codes'])}")
    if "opengl" in timing:
        row = timing["opengl"]
        found["time of a frame, plain mesh = 1"] = Cell(
            f"{row['ratio']:.1f}", f"{row['neural_fps']:.2g} frames/s, {row['drawn_by'].split()[0]}"
        )
    return found


# --- the page ---------------------------------------------------------------------------------------------------------


def chosen(summary: Summary, limit: int) -> list[tuple[str, list[Mapping[str, Any]]]]:
    """Views for the gallery, by trajectory: of each about as many, evenly spaced from worst to best; ``limit`` in all."""
    groups = [group for group in summary["groups"] if group["kind"] != "both"]
    out = []
    for group in groups:
        views = [view for view in summary["per_view"] if view["id"] in group["ids"]]
        views = sorted(views, key=lambda view: (view["scores"]["ours"]["psnr"], view["id"]))
        count = min(len(views), max(1, limit // len(groups))) if limit else 0
        places = np.unique(np.linspace(0, len(views) - 1, count).round().astype(int)) if count else []
        out.append((group["label"], [views[i] for i in places]))
    return [row for row in out if row[1]]


def gallery(summary: Summary, limit: int, read: ReadPicture) -> list[dict[str, Any]]:
    """Rows of pictures: photo, ours, warping and difference of a view, with its scores."""
    psnr = told(["psnr"])["psnr"]
    rows = []
    for label, views in chosen(summary, limit):
        for view in views:
            scores = " · ".join(f"{METHODS[method]} {psnr.format(row['psnr'])} dB" for method, row in view["scores"].items())
            pictures = [
                Picture(thumbnail(read(view["id"], name)), words, f"{words}, {view['id']}") for name, words in SHOWN.items()
            ]
            rows.append({"title": f"{view['id']}: {label}", "scores": scores, "pictures": pictures})
    return rows


def overview(summary: Summary, read: ReadPicture, columns: int = 2) -> bytes:
    """A PNG of the views farthest beside the driven path, one of each side: photo above, ours below.

    Of a side it is the view in the middle, from worst to best. Where no view lies beside the path, views between frames.
    """
    farthest = max(group["metres"] for group in summary["groups"])
    groups = [group for group in summary["groups"] if group["kind"] != "both" and group["metres"] == farthest]
    scores = {view["id"]: view["scores"]["ours"]["psnr"] for view in summary["per_view"]}
    shown = []
    for group in groups[:columns]:
        ranked = sorted(group["ids"], key=lambda id: (scores[id], id))
        pair = [Image.open(io.BytesIO(read(ranked[len(ranked) // 2], name))).convert("RGB") for name in ("photo", "ours")]
        shown.append(np.concatenate([np.array(picture) for picture in pair]))
    buffer = io.BytesIO()
    Image.fromarray(np.concatenate([row for row in shown if row.shape == shown[0].shape], axis=1)).save(buffer, "PNG")
    return buffer.getvalue()


def thumbnail(data: bytes) -> str:
    """A PNG as a JPEG of at most ``WIDEST`` pixels width, as a data URI."""
    image = Image.open(io.BytesIO(data)).convert("RGB")
    image.thumbnail((WIDEST, WIDEST))
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=90)
    return embed(buffer.getvalue(), "image/jpeg")


def page(
    about: About,
    summary: Summary,
    timing: Mapping[str, Any],
    missing: Sequence[str],
    clips: Mapping[str, Path],
    read: ReadPicture,
) -> str:
    """The whole report as HTML. clips: caption -> MP4."""
    all_verdicts = verdicts(summary)
    judged = [verdict for verdict in all_verdicts if verdict["shifted"]] or all_verdicts
    return render(
        Path(__file__).with_name("report.html.j2"),
        "How well the fitted scene shows new views",
        views=summary["views"],
        key=about.key[:12],
        facts=about.facts(),
        config=about.config,
        won=all(verdict["won"] for verdict in judged),
        shifted=judged is not all_verdicts,
        verdicts=all_verdicts,
        tiles=tiles(summary, timing),
        scores=score_table(main_groups(summary)),
        sides=_sides(summary),
        distributions=distribution_table(summary),
        errors=error_table(summary["groups"]),
        tolerance=about.config["depth_tolerance"],
        agreement=agreement_table(summary),
        times=time_table(timing),
        sizes=byte_table(summary),
        missing=missing,
        clips=[Clip(embed(path.read_bytes(), "video/mp4"), caption) for caption, path in clips.items()],
        gallery=gallery(summary, about.config["gallery"], read),
    )


def _sides(summary: Summary) -> Table | None:
    sides = [group for group in summary["groups"] if group["kind"] == "side"]
    return score_table(sides) if sides else None
