"""The dataset card: what is in the shards, for people, as Markdown and as one HTML page that opens from disk.

Reads the draft of a *shard* artifact; writes ``README.md``, ``card.html``, ``distributions.png`` and ``contact.png``. One
design choice: the content is built once, as sections of paragraphs, tables, code and pictures, and written twice.

Counts are of everything; distributions and ranges are of at most ``SAMPLED`` scenes, evenly spaced over each split.
"""

from __future__ import annotations

import base64
import html
import json
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from stages.renderformer.dataset.encoding import READ

SAMPLED = 1000  # scenes per split that distributions are drawn from
SHEET = 5  # scenes per split on the contact sheet
SHEET_SIDE = 128  # pixels of a view on it, at most
LISTED = 1000  # objects named in the card; objects.json names all

# field, shape, dtype, unit and frame and range
SCENE_FIELDS = (
    ("vertices", "(P, 3)", "uint16", "distinct corners: world = vertices * scale + origin; float32 where the scene is large"),
    ("scale, origin", "(), (3,)", "float32", "scene units; origin is the least corner of the bounding box"),
    ("faces", "(F, 3)", "uint8/16, int32", "into vertices; counter-clockwise seen from outside"),
    ("normals", "(N, 3)", "int16", "distinct shading normals * 32767; world; normalise after dividing"),
    ("face_normals", "(F, 3)", "uint8/16, int32", "into normals, per corner"),
    ("diffuse, specular", "(M, 3)", "float16", "distinct, RGB, [0, 1]; BSDF = diffuse / pi + specular * GGX, no Fresnel"),
    ("roughness", "(M,)", "float16", "[0.01, 1]; GGX alpha = roughness^2"),
    ("material", "(F,)", "uint8/16, int32", "into diffuse, specular, roughness"),
    ("emission", "(E, 3)", "float32", "distinct emissions: radiance RGB, > 0, both sides emit; emitters reflect nothing"),
    ("emission_index", "(F,)", "int8/16/32", "into emission, -1 where a triangle does not emit"),
    ("light_index", "(F,)", "int8/16/32", "the light 0..L-1 that a triangle belongs to, -1 where it does not emit"),
    ("object_index", "(F,)", "uint8/16, int32", "into objects of meta.json"),
    ("camera_to_world", "(V, 4, 4)", "float32", "rigid; the camera looks along -z, +y up, +x right; world"),
    ("fov_deg", "(V,)", "float32", "degrees, full angle of the square image"),
    ("patch_index", "(F,)", "u/int8/16/32", "only in scenes with textured triangles: into patches, -1 where constant"),
    (
        "patches",
        "(T, 7, 32, 32)",
        "float16",
        "of textured triangles alone: diffuse RGB, specular RGB, roughness; texel [row, column] has its centre at "
        "barycentric weight (column + 0.5) / 32 of corner 1, (row + 0.5) / 32 of corner 2; texels with row + column > 32 "
        "are 0; the triangle's own diffuse, specular and roughness are the means over row + column < 32",
    ),
)  # fmt: skip
VIEW_MEMBERS = (
    ("view<i>.exr", "light<l>.R/G/B", "(L, H, W, 3)", "half", "linear radiance by light; their sum is the image; [0, 65504]"),
    ("view<i>.aov.exr", "direct.R/G/B", "(H, W, 3)", "half", "linear radiance after at most one bounce, all lights"),
    ("view<i>.aov.exr", "albedo.R/G/B", "(H, W, 3)", "half", "diffuse + specular at the first hit"),
    ("view<i>.aov.exr", "normal.X/Y/Z", "(H, W, 3)", "half", "shading normal at the first hit, world, [-1, 1], pixel mean"),
    ("view<i>.aov.exr", "depth.Z", "(H, W)", "half", "distance along the ray, scene units, 0 = nothing hit"),
    ("view<i>.aov.exr", "coverage.A", "(H, W)", "half", "share of the pixel that hits something, [0, 1]"),
    ("view<i>.aov.exr", "triangle.id", "(H, W)", "uint", "what the pixel's first sample hit: row of faces + 1, 0 = nothing"),
    ("view<i>.aov.exr", "object.id", "(H, W)", "uint", "its object_index + 1, 0 = nothing"),
    ("meta.json", "views", "list", "int", "camera index i of each kept view"),
    ("meta.json", "objects", "list", "JSON", "walls, objects, lights: name, kind, faces, placement, material, id, licence"),
    ("meta.json", "render", "JSON", "JSON", "per camera: status, mean radiance, spp, error (estimated), clamped values, noise"),
    ("meta.json", "crc32", "JSON", "int", "CRC-32 of each other member"),
)  # fmt: skip


WEBDATASET = """
import webdataset
for sample in webdataset.WebDataset("parts/<digest>.tar", shardshuffle=False):
    scene = read_scene(sample["scene.npz"])  # see above
    image = sample["view0.exr"]  # bytes of an OpenEXR file
"""


@dataclass
class Section:
    """A heading and its blocks: ("text", str), ("table", header, rows), ("code", str), ("picture", file name, caption)."""

    title: str
    blocks: list[tuple] = field(default_factory=list)


def write_card(config: Any, inputs: Mapping[str, Any], draft: Any) -> None:
    """The card of a draft whose ``index.jsonl``, ``shards.json`` and ``objects.json`` are written."""
    from pipeline.store import history

    with open(draft.files / "index.jsonl", encoding="utf-8") as file:
        facts = [{name: value for name, value in json.loads(line).items() if name != "members"} for line in file]
    shards, objects = (json.loads((draft.files / f"{name}.json").read_text()) for name in ("shards", "objects"))
    by_split: dict[str, list[dict[str, Any]]] = {}
    for fact in facts:
        by_split.setdefault(fact["split"], []).append(fact)
    drawn = {split: gather(draft, rows[:: -(-len(rows) // SAMPLED)]) for split, rows in by_split.items()}
    plot_distributions(drawn, draft.files / "distributions.png")
    contact_sheet(draft, by_split).save(draft.files / "contact.png")
    preimages = {**dict(reversed(history(inputs).items())), "shard": draft.preimage}
    card = sections(shards, by_split, objects, drawn, preimages, draft.key)
    (draft.files / "README.md").write_text(to_markdown(card), encoding="utf-8")
    (draft.files / "card.html").write_text(to_html(card, draft.files), encoding="utf-8")


# --- what is in it ----------------------------------------------------------------------------------------------------


def gather(draft: Any, rows: Iterable[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """Quantity -> its values over the scenes (lights, cameras, views, triangles of them)."""
    from stages.graphics.arrays import unpack_json
    from stages.renderformer.dataset.encoding import decode_scene

    out: dict[str, list[Any]] = {
        name: []
        for name in (
            "triangles", "lights", "roughness", "camera distance", "light distance", "field of view", "mean radiance",
            "samples", "error", "clamped", "emission", "vertex", "bytes", "noise", "noise relit", "noise psnr", "textured",
        )
    }  # fmt: skip
    for row in rows:
        members = draft.read(row["id"], ["scene.npz", "meta.json"]).members
        scene = decode_scene(row["id"], members["scene.npz"], members["meta.json"])
        reflects = scene.light_index < 0
        out["triangles"].append([len(scene.triangles)])
        out["lights"].append([scene.n_lights])
        out["textured"].append([0.0 if scene.patch_index is None else np.mean(scene.patch_index >= 0)])
        out["roughness"].append(scene.roughness[reflects])
        out["emission"].append(scene.emission[~reflects].max(axis=1))
        out["vertex"].append([scene.triangles[reflects].min(initial=0), scene.triangles[reflects].max(initial=0)])
        views = unpack_json(members["meta.json"])["views"]
        out["camera distance"].append(np.linalg.norm(scene.camera_to_world[views, :3, 3], axis=1))
        out["field of view"].append(scene.fov_deg[views])
        for light in range(scene.n_lights):
            out["light distance"].append([np.linalg.norm(scene.triangles[scene.light_index == light].mean(axis=(0, 1)))])
        for view in scene.meta["render"]["views"]:
            if view.get("status") == "ok":
                for name, key in (("mean radiance", "mean"), ("samples", "spp"), ("error", "error"), ("clamped", "clamped")):
                    if view.get(key) is not None:
                        out[name].append([view[key]])
                if noise := view.get("noise"):  # of views that were rendered twice
                    out["noise"].append([noise["sum"]["log_error"]])
                    out["noise psnr"].append([noise["sum"]["psnr"]])
                    out["noise relit"].append([one["log_error"] for one in noise["reweighted"]])
        out["bytes"].append([len(members["scene.npz"])])
    return {name: np.concatenate(values).astype(float) if values else np.zeros(0) for name, values in out.items()}


PLOTS = (  # quantity, label, scale
    ("triangles", "triangles per scene", "linear"),
    ("lights", "lights per scene", "integer"),
    ("textured", "share of textured triangles per scene", "linear"),
    ("roughness", "roughness, per triangle", "linear"),
    ("emission", "emission of a light's triangle", "log"),
    ("camera distance", "camera to origin, scene units", "linear"),
    ("light distance", "light to origin, scene units", "linear"),
    ("field of view", "field of view, degrees", "linear"),
    ("mean radiance", "exposure: mean radiance of a view", "log"),
    ("samples", "samples per pixel of a view", "log2"),
    ("error", "estimated error of a view, log10(1 + x)", "log"),
    ("noise", "noise floor of a view, log10(1 + x)", "log"),
)


def plot_distributions(drawn: Mapping[str, Mapping[str, np.ndarray]], path: Path) -> None:
    """A histogram per quantity, a line per split, each normalised to shares."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 8.5), layout="constrained")
    for axes, (name, label, scale) in zip(figure.subplots(3, 4).flat, PLOTS, strict=True):
        values = {split: columns[name] for split, columns in drawn.items() if len(columns[name])}
        every = np.concatenate(list(values.values())) if values else np.zeros(0)
        axes.set_xlabel(label)
        if scale in ("log", "log2"):
            every = every[every > 0]
        if not len(every):
            axes.text(0.5, 0.5, "not estimated", ha="center", va="center", transform=axes.transAxes)
            axes.set(xticks=[], yticks=[])
            continue
        low, high = every.min(), every.max()
        if high - low <= 1e-6 * abs(high):  # constant: one bar over the value
            scale = "constant"
            edges = low + np.array([-0.5, 0.5]) * (abs(low) or 1.0)
        elif scale == "integer":
            edges = np.arange(np.floor(low), np.floor(high) + 2) - 0.5
        elif scale == "log2":
            edges = 2.0 ** (np.arange(np.floor(np.log2(low)), np.floor(np.log2(high)) + 2) - 0.5)
        else:
            bins = int(np.clip(2 * len(every) ** 0.5, 8, 40))
            edges = (np.geomspace if scale == "log" else np.linspace)(low, high, bins + 1)
        for (split, mine), color in zip(sorted(values.items(), key=lambda item: ORDER.get(item[0], 9)), COLORS, strict=False):
            shares = np.histogram(mine, edges)[0] / len(mine)
            style = {"fill": True, "alpha": 0.35} if split == "train" else {"linewidth": 1.5}
            axes.stairs(shares, edges, label=f"{split} ({len(mine):,})", color=color, **style)
        if scale in ("log", "log2"):
            axes.set_xscale("log", base=2 if scale == "log2" else 10)
            if scale == "log2":
                ticks = 2.0 ** np.arange(np.floor(np.log2(low)), np.floor(np.log2(high)) + 1)
            elif high > 30 * low:
                ticks = 10.0 ** np.arange(np.ceil(np.log10(low)), np.floor(np.log10(high)) + 1)
            else:  # no or one power of ten in it
                ticks = np.array([float(f"{tick:.2g}") for tick in np.geomspace(edges[0], edges[-1], 4)])
            ticks = ticks[:: -(-len(ticks) // 6)]
            axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
            axes.minorticks_off()
        if scale == "constant":
            axes.set_xticks([low], [f"{low:.4g}"])
            axes.set_xlim(*(edges + np.diff(edges) * [-1, 1]))
        axes.set_ylabel("share")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    figure.savefig(path, dpi=90)


ORDER = {"train": 0, "validation": 1, "test": 2}
COLORS = ("tab:blue", "tab:orange", "tab:red", "tab:green")


def contact_sheet(draft: Any, by_split: Mapping[str, list[Mapping[str, Any]]]) -> Any:
    """A row per scene with its views, a column of rows per split; every scene with its own exposure, sRGB."""
    from PIL import Image, ImageDraw

    from stages.graphics.exr import decode_lights
    from stages.graphics.tonemap import exposure_for, to_picture
    from stages.renderformer.views import view_members

    margin, title = 8, 18
    columns = []
    for split in sorted(by_split, key=lambda name: ORDER.get(name, 9)):
        rows = by_split[split]
        chosen = [rows[i] for i in np.unique(np.linspace(0, len(rows) - 1, SHEET).round().astype(int))]
        pictures = []
        for row in chosen:
            names = [view_members(view)[0] for view in row["views"][:4]]
            members = draft.read(row["id"], names).members
            images = np.stack([decode_lights(members[name])[0].sum(axis=0) for name in names])
            exposure = exposure_for(images)
            pictures.append([Image.fromarray(to_picture(image, exposure)) for image in images])
        columns.append((split, pictures))
    side = min(SHEET_SIDE, max(row["resolution"] for rows in by_split.values() for row in rows))
    widths = [max(map(len, pictures)) * (side + 2) + margin for _, pictures in columns]
    height = title + max(len(pictures) for _, pictures in columns) * (side + 2) + margin
    sheet = Image.new("RGB", (sum(widths) + margin, height), "white")
    pen, left = ImageDraw.Draw(sheet), margin
    for (split, pictures), width in zip(columns, widths, strict=True):
        pen.text((left, 3), split, fill="black")
        for i, row in enumerate(pictures):
            for j, picture in enumerate(row):
                sheet.paste(picture.resize((side, side), Image.Resampling.BOX), (left + j * (side + 2), title + i * (side + 2)))
        left += width
    return sheet


# --- the content ------------------------------------------------------------------------------------------------------


def sections(
    shards: Mapping[str, Any],
    by_split: Mapping[str, list[dict[str, Any]]],
    objects: Mapping[str, Any],
    drawn: Mapping[str, Mapping[str, np.ndarray]],
    preimages: Mapping[str, Any],
    key: str,
) -> list[Section]:
    """The card's content."""
    splits = sorted(by_split, key=lambda name: ORDER.get(name, 9))
    views = sum(len(row["views"]) for rows in by_split.values() for row in rows)
    scenes = sum(map(len, by_split.values()))
    resolution = max(row["resolution"] for rows in by_split.values() for row in rows)
    every = {name: np.concatenate([columns[name] for columns in drawn.values()]) for name in next(iter(drawn.values()))}
    about = Section("Dataset card")
    about.blocks += [
        ("text", f"Path-traced triangle scenes for neural renderers: {scenes:,} scenes, {views:,} views of {resolution} x "
         f"{resolution} pixels, a layer of linear radiance for each light. Artifact key {key}."),
        ("text", "One sample per scene in webdataset tars (`parts/*.tar`, members `<id>.<member>`), in a fixed order. One unit "
         "is the scene's box, about [-0.5, 0.5]^3 (walls may stick out; lights and cameras stand outside); z up, right-handed. "
         "Radiance is linear RGB, without units. F triangles, V cameras, L lights, H x W pixels, row 0 on top."),
        ("picture", "contact.png", "Scenes of each split, a row each, every scene with its own exposure"),
    ]  # fmt: skip

    fields = Section("Fields")
    fields.blocks += [
        ("table", ("member", "field", "shape", "dtype", "unit, frame, range"),
         [("scene.npz", *row) for row in SCENE_FIELDS] + [tuple(row) for row in VIEW_MEMBERS]),
        ("text", "`scene.npz` read with numpy alone, a row per triangle, float32 (error of a vertex at most scale / 2 an axis, "
         "of a normal 3e-5, of a material 2.5e-4):"),
        ("code", READ.strip()),
    ]  # fmt: skip
    fields.blocks.append(("table", ("range of", "least", "median", "largest"), ranges(drawn)))

    counts = Section("Counts and splits")
    rows = []
    for split in splits:
        mine, shard = by_split[split], shards[split]
        faces = [row["triangles"] for row in mine]
        rows.append((
            split, f"{len(mine):,}", f"{sum(len(row['views']) for row in mine):,}", f"{min(faces)}..{max(faces)}",
            f"{len(objects.get(split, {})):,}", len(shard["parts"]), f"{shard['bytes'] / 1e6:.1f}", shard["digest"],
        ))  # fmt: skip
    counts.blocks += [
        ("table", ("split", "scenes", "views", "triangles", "objects", "shards", "MB", "digest of samples"), rows),
        ("text", "No object is in two splits: checked over all samples when this was made. Which objects are held out, and "
         "with them the test scenes, follows from the seeds below; two copies whose test digests agree give comparable "
         "numbers. Walls, lights and the simple shapes of special scenes are made by code and belong to no split."),
    ]  # fmt: skip
    kinds = Counter(row["scene"] for rows in by_split.values() for row in rows)
    counts.blocks.append(("table", ("kind of scene", "scenes"), [(name, f"{n:,}") for name, n in sorted(kinds.items())]))

    shown = Section("Distributions")
    shown.blocks.append(("picture", "distributions.png", f"Shares per split, of at most {SAMPLED:,} scenes each"))
    shown.blocks.append(("text", noise_floor(every)))
    samples, clamped = every["samples"], int(every["clamped"].sum())
    spp = f"{np.median(samples):g} in the median, {samples.min():g}..{samples.max():g}" if len(samples) else "not noted"
    shown.blocks.append(("text", f"Samples per pixel: {spp}. Radiance values clamped at 65,504: {clamped:,}."))

    origins = Section("Objects, origins and licences")
    known: Counter = Counter()
    for ids in objects.values():
        known.update((str(o["licence"] or "unknown"), source_of(o["source"])) for o in ids.values())
    origins.blocks.append(("table", ("licence", "source", "objects"), [(*pair, f"{n:,}") for pair, n in sorted(known.items())]))
    listed = [
        (split, id, o["source"] or "", o["origin"] or "", o["licence"] or "unknown", o["scenes"])
        for split in splits
        for id, o in sorted(objects.get(split, {}).items())
    ]
    if len(listed) > LISTED:
        origins.blocks.append(("text", f"The first {LISTED:,} of {len(listed):,}; `objects.json` names all."))
    origins.blocks.append(("table", ("split", "object", "source", "origin", "licence", "scenes"), listed[:LISTED]))

    made = Section("How it was made")
    made.blocks.append(("text", f"The key {key} is the hash of stage, version, parameters and the keys of its inputs."))
    for stage, preimage in preimages.items():
        made.blocks.append(("text", f"**{stage}** (version {preimage['version']}, reads {inputs_of(preimage)})"))
        made.blocks.append(("code", json.dumps(preimage["params"], indent=1, sort_keys=True)))

    files = Section("Reading it")
    files.blocks += [
        ("text", "`index.jsonl` has a line per sample in the shards' order: id, split, shard, triangles, lights, views, "
         "resolution, kind of scene, and members: name to [offset in the shard, bytes, CRC-32], so that a member is one seek. "
         "`shards.json` lists the shards of each split with bytes and samples; a shard's name is the blake2b-256 of its bytes. "
         "Plain webdataset:"),
        ("code", WEBDATASET.strip()),
    ]  # fmt: skip
    return [about, fields, counts, shown, origins, made, files]


def noise_floor(every: Mapping[str, np.ndarray]) -> str:
    """How far images are from noiseless ones: of views rendered twice, and as the renderer estimates it."""

    def spread(values: np.ndarray) -> str:
        return (
            f"{values.mean():.4f} in the mean, {np.median(values):.4f} in the median, {np.quantile(values, 0.95):.4f} at 95 %"
        )

    noise, errors = every["noise"], every["error"]
    told = []
    if len(noise):
        told.append(
            f"Noise floor, of {len(noise):,} views rendered twice, independently: mean absolute error of log10(1 + radiance) "
            f"{spread(noise)}; PSNR of values clamped to 1 {every['noise psnr'].mean():.1f} dB; with reweighted lights "
            f"{spread(every['noise relit'])}."
        )
    if len(errors):
        told.append(f"Error of a view as the renderer estimates it, log10(1 + radiance): {spread(errors)}.")
    return " ".join(told) or "Noise floor: not measured; every view has a fixed number of samples and was rendered once."


def ranges(drawn: Mapping[str, Mapping[str, np.ndarray]]) -> list[tuple[str, ...]]:
    """What was measured: (quantity, least, median, largest)."""
    labels = {
        "vertex": "vertex coordinate (without lights)",
        **{name: label for name, label, _ in PLOTS},
        "bytes": "bytes of scene.npz",
    }
    rows = []
    for name, label in labels.items():
        values = np.concatenate([columns[name] for columns in drawn.values()])
        if len(values):
            rows.append((label, *(f"{value:.4g}" for value in (values.min(), np.median(values), values.max()))))
    return rows


def source_of(source: str | None) -> str:
    """The kind of an object's source: procedural, objaverse, or files (of a folder), whose paths are in objects.json."""
    kind = (source or "unknown").partition("/")[0]
    return kind if kind in ("procedural", "objaverse", "unknown") else "files"


def inputs_of(preimage: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {key[:12]}" for name, key in preimage["inputs"].items()) or "nothing"


# --- written twice ----------------------------------------------------------------------------------------------------


def to_markdown(card: Iterable[Section]) -> str:
    lines: list[str] = []
    for number, section in enumerate(card):
        lines += ["#" * (1 if number == 0 else 2) + f" {section.title}", ""]
        for kind, *content in section.blocks:
            if kind == "text":
                lines += [content[0], ""]
            elif kind == "code":
                lines += ["```", content[0], "```", ""]
            elif kind == "picture":
                lines += [f"![{content[1]}]({content[0]})", "", f"*{content[1]}*", ""]
            else:
                header, rows = content
                lines += ["| " + " | ".join(header) + " |", "| " + " | ".join("---" for _ in header) + " |"]
                lines += [f"| {' | '.join(map(_cell, row))} |" for row in rows] + [""]
    return "\n".join(lines)


def _cell(value: Any) -> str:
    """A table's cell: on one line, and nothing in it that Markdown would read."""
    return " ".join(str(value).split()).replace("|", "\\|").replace("<", "\\<")


STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1150px; margin: 2em auto; padding: 0 1em; color: #222 }
table { border-collapse: collapse; margin: 1em 0; font-size: 13px; display: block; overflow-x: auto }
th, td { border: 1px solid #ccc; padding: 3px 8px; text-align: left; vertical-align: top }
th { background: #f2f2f2 } code, pre { font: 12.5px/1.4 ui-monospace, monospace; background: #f6f6f6 }
pre { padding: .8em; overflow-x: auto; max-height: 30em } figure { margin: 1em 0 } img { max-width: 100% }
figcaption { color: #666; font-size: 13px }
"""


def to_html(card: Iterable[Section], folder: Path) -> str:
    """One page, its pictures inside it."""
    out = ["<!doctype html><html lang='en'><head><meta charset='utf-8'><title>Dataset card</title>"]
    out += [f"<style>{STYLE}</style></head><body>"]
    for number, section in enumerate(card):
        level = 1 if number == 0 else 2
        out.append(f"<h{level}>{html.escape(section.title)}</h{level}>")
        for kind, *content in section.blocks:
            if kind == "text":
                out.append(f"<p>{_inline(content[0])}</p>")
            elif kind == "code":
                out.append(f"<pre>{html.escape(content[0])}</pre>")
            elif kind == "picture":
                data = base64.b64encode((folder / content[0]).read_bytes()).decode()
                caption = html.escape(content[1])
                out.append(f"<figure><img src='data:image/png;base64,{data}' alt='{caption}'>")
                out.append(f"<figcaption>{caption}</figcaption></figure>")
            else:
                header, rows = content
                cells = "".join(f"<th>{html.escape(cell)}</th>" for cell in header)
                out.append(f"<table><tr>{cells}</tr>")
                out += ["<tr>" + "".join(f"<td>{html.escape(str(cell))}</td>" for cell in row) + "</tr>" for row in rows]
                out.append("</table>")
    return "\n".join([*out, "</body></html>\n"])


def _inline(text: str) -> str:
    """Escaped text in which `code` and **bold** are marked up."""
    for mark, tag in (("`", "code"), ("**", "b")):
        pieces = text.split(mark)
        if mark == "`":
            pieces = [html.escape(piece, quote=False) for piece in pieces]
        text = "".join(f"<{tag}>{piece}</{tag}>" if i % 2 else piece for i, piece in enumerate(pieces))
    return text
