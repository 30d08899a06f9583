"""The dataset card: what is in the shards, for people, as Markdown and as one HTML page that opens from disk.

Reads the draft of a *shard* artifact; writes ``README.md``, ``card.html``, ``distributions.png`` and ``contact.png``. One
design choice: the content is built once, as sections of text, tables, code and pictures, and written twice.

Counts are of everything; distributions and ranges are of at most ``SAMPLED`` scenes, evenly spaced over each split.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from stages.graphics.page import Cell, Code, Picture, Section, Table, Text, embed, render
from stages.graphics.page.parts import Block
from stages.renderformer.dataset.distributions import (
    Quantities,
    measure_scenes,
    noise_floor,
    plot_distributions,
    ranges,
    split_order,
)
from stages.renderformer.dataset.encoding import READ
from stages.renderformer.guides.records import SCENE_MEMBER

TITLE = "Dataset card"
SAMPLED = 1000  # scenes per split that distributions are drawn from
SHEET = 5  # scenes per split on the contact sheet
SHEET_SIDE = 128  # pixels of a view on it, at most
LISTED = 1000  # objects named in the card; objects.json names all
DISTRIBUTIONS_SIZE = (15, 8.5)  # inches

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
GUIDE_MEMBERS = (
    ("guides.npz", "light_triangles", "(E,)", "int32", "rows of faces that emit"),
    ("guides.npz", "light_seen", "(F, 4, E)", "bits", "whether a point of the triangle sees a point of the light; points 0 to "
     "2 have weight 2/3 of their corner and 1/6 of the others, point 3 is the centroid; packed along the last axis"),
    ("guides.npz", "bounces", "(F, 2, 16)", "uint16/32", "with shard.bounces: row of faces + 1 that rays hit which leave the "
    "front and the back of each, spread by cosine, 0 for nothing; bounces_weights as below"),
    ("guides.npz", "vertex", "(F, 3)", "int32", "with shard.bounces: corners of one number are one vertex of a smooth surface"),
    ("view<i>.guides.npz", "hit", "(H, W, 4)", "uint16/32", "row of faces + 1 that the pixel's rays hit, 2 x 2 row by row, "
     "0 = nothing; camera rays pass through lights"),
    ("view<i>.guides.npz", "main", "(H, W)", "int8", "0..3, the first of these rays that hits something, -1 where none does"),
    ("view<i>.guides.npz", "mirror", "(H, W)", "uint16/32", "what the mirror reflection of the ray `main` hits"),
    ("view<i>.guides.npz", "lobe", "(H, W, 4)", "uint16/32", "what a reflection of each hits, drawn from its GGX lobe"),
    ("view<i>.guides.npz", "hit_weights, ..", "(.., 2)", "uint8", "of each of the three: barycentric weights of corner 1 and 2 "
     "of the triangle that is hit, * 255"),
    ("view<i>.guides.npz", "light_seen", "(H, W, 4, E)", "bits", "whether each hit sees a point of each emitting triangle"),
    ("view<i>.guides.npz", "lights", "()", "int32", "E, the emitting triangles"),
)  # fmt: skip


WEBDATASET = """
import webdataset
for sample in webdataset.WebDataset("parts/<digest>.tar", shardshuffle=False):
    scene = read_scene(sample["scene.npz"])  # see above
    image = sample["view0.exr"]  # bytes of an OpenEXR file
"""


Rows = Sequence[Mapping[str, Any]]  # lines of index.jsonl, without members


@dataclass(frozen=True)
class Dataset:
    """What a card is written of.

    by_split: the samples of each split. shards, objects: shards.json and objects.json, by split. measured: quantities of some
    scenes of each split. preimages: what decided each stage's artifact, by stage. key: the shard artifact's.
    guide_bytes: of the guides of a scene and of a view, in the mean; None where there are none.
    """

    by_split: Mapping[str, Rows]
    shards: Mapping[str, Any]
    objects: Mapping[str, Any]
    measured: Mapping[str, Quantities]
    preimages: Mapping[str, Any]
    key: str
    guide_bytes: tuple[float, float] | None = None

    @property
    def splits(self) -> list[str]:
        return sorted(self.by_split, key=split_order)

    @property
    def samples(self) -> list[Mapping[str, Any]]:
        return [sample for rows in self.by_split.values() for sample in rows]

    @property
    def views(self) -> int:
        return sum(len(sample["views"]) for sample in self.samples)

    @property
    def resolution(self) -> int:
        return max(sample["resolution"] for sample in self.samples)


def write_card(config: Any, inputs: Mapping[str, Any], draft: Any) -> None:
    """The card of a draft whose ``index.jsonl``, ``shards.json`` and ``objects.json`` are written."""
    from matplotlib.figure import Figure

    dataset = read_dataset(inputs, draft)
    figure = Figure(figsize=DISTRIBUTIONS_SIZE, layout="constrained")
    plot_distributions(figure, dataset.measured)
    figure.savefig(draft.files / "distributions.png", dpi=90)
    contact_sheet(draft, dataset.by_split).save(draft.files / "contact.png")
    (draft.files / "README.md").write_text(to_markdown(dataset), encoding="utf-8")
    (draft.files / "card.html").write_text(to_html(dataset, draft.files), encoding="utf-8")


def read_dataset(inputs: Mapping[str, Any], draft: Any) -> Dataset:
    from pipeline.store import history

    by_split: dict[str, list[dict[str, Any]]] = {}
    sizes: dict[str, list[int]] = {}  # of guides, by member; those of all views together
    with open(draft.files / "index.jsonl", encoding="utf-8") as file:
        for line in file:
            sample = json.loads(line)
            for name, (_, size, _) in sample.pop("members").items():
                if name.endswith(SCENE_MEMBER):
                    sizes.setdefault(name.removeprefix(SCENE_MEMBER) and "view", []).append(size)
            by_split.setdefault(sample["split"], []).append(sample)
    shards, objects = (json.loads((draft.files / f"{name}.json").read_text()) for name in ("shards", "objects"))
    measured = {split: measure_scenes(draft, rows[:: -(-len(rows) // SAMPLED)]) for split, rows in by_split.items()}
    preimages = {**dict(reversed(history(inputs).items())), "shard": draft.preimage}
    guide_bytes = (float(np.mean(sizes[""])), float(np.mean(sizes["view"]))) if sizes else None
    return Dataset(by_split, shards, objects, measured, preimages, draft.key, guide_bytes)


def to_markdown(dataset: Dataset) -> str:
    from stages.graphics.page import markdown

    return markdown.document(TITLE, [*lead(dataset), CONTACT], sections(dataset, [DISTRIBUTIONS]))


def to_html(dataset: Dataset, folder: Path) -> str:
    """One page, with its pictures inside it, and with the distributions as SVG."""
    from stages.graphics.page.plots import svg

    return render(
        Path(__file__).with_name("card.html.j2"),
        TITLE,
        lead=lead(dataset),
        tiles={
            "scenes": f"{len(dataset.samples):,}",
            "views": f"{dataset.views:,}",
            "pixels": f"{dataset.resolution} × {dataset.resolution}",
            "objects": f"{sum(map(len, dataset.objects.values())):,}",
            "megabytes": f"{sum(shard['bytes'] for shard in dataset.shards.values()) / 1e6:,.1f}",
        },
        contact=replace(CONTACT, source=embed((folder / CONTACT.source).read_bytes())),
        distributions=svg(lambda figure: plot_distributions(figure, dataset.measured), *DISTRIBUTIONS_SIZE),
        sections=sections(dataset, []),
    )


CONTACT = Picture("contact.png", "Scenes of each split, a row each, every scene with its own exposure")
DISTRIBUTIONS = Picture("distributions.png", f"Shares per split, of at most {SAMPLED:,} scenes each")


def contact_sheet(draft: Any, by_split: Mapping[str, Rows]) -> Any:
    """A row per scene with its views, a column of rows per split; every scene with its own exposure, sRGB."""
    from PIL import Image, ImageDraw

    from stages.graphics.exr import decode_lights
    from stages.graphics.tonemap import exposure_for, to_picture
    from stages.renderformer.views import view_members

    margin, title = 8, 18
    columns = []
    for split in sorted(by_split, key=split_order):
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


def lead(dataset: Dataset) -> list[Block]:
    """What stands below the title."""
    return [
        Text(
            f"Path-traced triangle scenes for neural renderers: {len(dataset.samples):,} scenes, {dataset.views:,} views of "
            f"{dataset.resolution} x {dataset.resolution} pixels, a layer of linear radiance for each light. Artifact key "
            f"{dataset.key}."
        ),
        Text(
            "One sample per scene in webdataset tars (`parts/*.tar`, members `<id>.<member>`), in a fixed order. One unit "
            "is the scene's box, about [-0.5, 0.5]^3 (walls may stick out; lights and cameras stand outside); z up, "
            "right-handed. Radiance is linear RGB, without units. F triangles, V cameras, L lights, H x W pixels, row 0 on top."
        ),
    ]


def sections(dataset: Dataset, distributions: Sequence[Block]) -> list[Section]:
    """The card's sections. distributions: how their plots are shown."""
    return [
        Section("Fields", field_blocks(dataset)),
        Section("Counts and splits", count_blocks(dataset)),
        Section("Distributions", [*distributions, *sample_blocks(dataset)]),
        Section("Objects, origins and licences", origin_blocks(dataset)),
        Section("How it was made", history_blocks(dataset)),
        Section("Reading it", READING),
    ]


def field_blocks(dataset: Dataset) -> list[Block]:
    fields = [("scene.npz", *row) for row in SCENE_FIELDS] + [*VIEW_MEMBERS]
    guides = []
    if dataset.guide_bytes:
        fields += GUIDE_MEMBERS
        scene_bytes, view_bytes = dataset.guide_bytes
        guides = [
            Text(
                f"Guides say what ray casting alone finds; they hold no light. They take {scene_bytes:,.0f} bytes a scene and "
                f"{view_bytes:,.0f} bytes a view, in the mean."
            )
        ]
    rows = [[*(Cell(name, kind="code") for name in names), meaning] for *names, meaning in fields]
    return [
        Table(("member", "field", "shape", "dtype", "unit, frame, range"), rows),
        *guides,
        Text(
            "`scene.npz` read with numpy alone, a row per triangle, float32 (error of a vertex at most scale / 2 an axis, "
            "of a normal 3e-5, of a material 2.5e-4):"
        ),
        Code(READ.strip()),
        Table(("range of", "least", "median", "largest"), ranges(dataset.measured), numeric=True),
    ]


def count_blocks(dataset: Dataset) -> list[Block]:
    rows = []
    for split in dataset.splits:
        samples, shard = dataset.by_split[split], dataset.shards[split]
        faces = [sample["triangles"] for sample in samples]
        rows.append((
            split, f"{len(samples):,}", f"{sum(len(sample['views']) for sample in samples):,}", f"{min(faces)}..{max(faces)}",
            f"{len(dataset.objects.get(split, {})):,}", len(shard["parts"]), f"{shard['bytes'] / 1e6:.1f}", shard["digest"],
        ))  # fmt: skip
    kinds = Counter(sample["scene"] for sample in dataset.samples)
    return [
        Table(("split", "scenes", "views", "triangles", "objects", "shards", "MB", "digest of samples"), rows),
        Text(
            "No object is in two splits: checked over all samples when this was made. Which objects are held out, and "
            "with them the test scenes, follows from the seeds below; two copies whose test digests agree give comparable "
            "numbers. Walls, lights and the simple shapes of special scenes are made by code and belong to no split."
        ),
        Table(("kind of scene", "scenes"), [(kind, f"{count:,}") for kind, count in sorted(kinds.items())], numeric=True),
    ]


def sample_blocks(dataset: Dataset) -> list[Block]:
    """How good the images are: noise, samples per pixel, clamped values."""
    columns = dataset.measured.values()
    pooled = {name: np.concatenate([measured[name] for measured in columns]) for name in next(iter(columns))}
    samples, clamped = pooled["samples"], int(pooled["clamped"].sum())
    spp = f"{np.median(samples):g} in the median, {samples.min():g}..{samples.max():g}" if len(samples) else "not noted"
    return [
        Text(noise_floor(pooled)),
        Text(f"Samples per pixel: {spp}. Radiance values clamped at 65,504: {clamped:,}."),
    ]


def origin_blocks(dataset: Dataset) -> list[Block]:
    counts: Counter[tuple[str, str]] = Counter()
    for objects in dataset.objects.values():
        counts.update((str(origin["licence"] or "unknown"), source_of(origin["source"])) for origin in objects.values())
    objects = [
        (split, id, origin["source"] or "", origin["origin"] or "", origin["licence"] or "unknown", origin["scenes"])
        for split in dataset.splits
        for id, origin in sorted(dataset.objects.get(split, {}).items())
    ]
    cut = [Text(f"The first {LISTED:,} of {len(objects):,}; `objects.json` names all.")] if len(objects) > LISTED else []
    return [
        Table(("licence", "source", "objects"), [(*pair, f"{count:,}") for pair, count in sorted(counts.items())]),
        *cut,
        Table(("split", "object", "source", "origin", "licence", "scenes"), objects[:LISTED]),
    ]


def history_blocks(dataset: Dataset) -> list[Block]:
    """Every stage's parameters."""
    blocks: list[Block] = [Text(f"The key {dataset.key} is the hash of stage, version, parameters and the keys of its inputs.")]
    for stage, preimage in dataset.preimages.items():
        blocks.append(Text(f"**{stage}** (version {preimage['version']}, reads {inputs_of(preimage)})"))
        blocks.append(Code(json.dumps(preimage["params"], indent=1, sort_keys=True)))
    return blocks


READING = (
    Text(
        "`index.jsonl` has a line per sample in the shards' order: id, split, shard, triangles, lights, views, "
        "resolution, kind of scene, and members: name to [offset in the shard, bytes, CRC-32], so that a member is one seek. "
        "`shards.json` lists the shards of each split with bytes and samples; a shard's name is the blake2b-256 of its bytes. "
        "Plain webdataset:"
    ),
    Code(WEBDATASET.strip()),
)


def source_of(source: str | None) -> str:
    """The kind of an object's source: procedural, objaverse, or files (of a folder), whose paths are in objects.json."""
    kind = (source or "unknown").partition("/")[0]
    return kind if kind in ("procedural", "objaverse", "unknown") else "files"


def inputs_of(preimage: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {key[:12]}" for name, key in preimage["inputs"].items()) or "nothing"
