"""shard: scenes and their images as the dataset: webdataset tars, an index and a card.

Reads *scene* and *render*, writes one sample per scene: ``scene.npz`` (the arrays of ``SceneRecord``), ``meta.json`` and
``view<i>.exr`` for every kept view i, copied unchanged. One design choice: the store's parts *are* the shards, so that plain
``webdataset`` reads them where they lie and nothing is stored twice. Paper section 3.3.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Any

from pydantic import Field

from pipeline.config import StageConfig
from pipeline.errors import UserError
from pipeline.stage import Inputs, Item, MapStage, Record

VIEW = re.compile(r"view(\d+)\.exr\Z")


class ShardConfig(StageConfig):
    scenes_per_shard: int = Field(32, ge=1)  # samples per tar


class Shard(MapStage):
    name = "shard"
    version = 1
    inputs = ("scene", "render")
    Config = ShardConfig

    def slug(self, config: ShardConfig) -> str:
        return f"{config.scenes_per_shard}-per-tar"

    def part_size(self, config: ShardConfig) -> int:
        return config.scenes_per_shard

    def items(self, config: ShardConfig, inputs: Inputs) -> Iterator[Item]:
        for row in inputs["render"].rows():
            yield Item(row.id, row.group, (("scene", row.id), ("render", row.id)))

    def open(self, config: ShardConfig, inputs: Inputs, environment: dict[str, Any]) -> Inputs:
        return inputs

    def process(self, worker: Inputs, item: Item) -> Iterator[Record]:
        yield merge(worker["scene"].read(item.id), worker["render"].read(item.id))

    def finish(self, config: ShardConfig, inputs: Inputs, draft: Any) -> None:
        """``files/shards.json``, ``index.json`` (a line of facts per sample), ``objects.json``, ``README.md``."""
        from stages.arrays import unpack_json

        index, shards, objects = {}, {}, {}
        for row in draft.rows():
            meta = unpack_json(inputs["scene"].read(row.id).members["meta.json"])  # the sample's has it too, behind its images
            index[row.id] = {
                "split": row.group,
                "triangles": meta["n_triangles"],
                "lights": meta["n_lights"],
                "views": views_of(row.members),
                "scene": f"{meta['template']}_{meta['variant']}",
            }
            path, split = draft.part_of(row.id)
            shard = shards.setdefault(split, {"samples": 0, "parts": []})
            shard["samples"] += 1
            if (name := f"parts/{path.name}") not in shard["parts"]:
                shard["parts"].append(name)
            for entry in meta["objects"]:
                if entry.get("object_id"):
                    told = {name: entry.get(name) for name in ("family", "source", "origin", "licence")}
                    objects.setdefault(split, {})[entry["object_id"]] = told
        for shard in shards.values():
            shard["bytes"] = sum((draft.path / name).stat().st_size for name in shard["parts"])
        for name, value in (("shards", shards), ("index", index), ("objects", objects)):
            (draft.files / f"{name}.json").write_text(json.dumps(value, indent=1, sort_keys=True) + "\n")
        (draft.files / "README.md").write_text(card(shards, index, objects))
        draft.note("shards", {split: {**shard, "parts": len(shard["parts"])} for split, shard in shards.items()})

    def check(self, draft: Any) -> None:
        seen: dict[str, str] = {}
        for split, ids in json.loads((draft.files / "objects.json").read_text()).items():
            for id in ids:
                if seen.setdefault(id, split) != split:
                    raise UserError(
                        f"object {id} is in the splits {seen[id]} and {split}: images of it would leak into the test"
                    )


def merge(scene: Record, render: Record) -> Record:
    """One sample: the scene's arrays, both metas, and the images byte for byte.

    ``meta["views"]`` lists the camera index of each kept view in order, ``meta["render"]`` is what the renderer noted.
    """
    from stages.arrays import pack_json, unpack_json

    views = views_of(render.members)
    meta = {
        **unpack_json(scene.members["meta.json"]),
        "views": views,
        "render": unpack_json(render.members["meta.json"]),
    }
    members = {"meta.json": pack_json(meta), "scene.npz": scene.members["scene.npz"]}
    return Record(scene.id, {**members, **{f"view{index}.exr": render.members[f"view{index}.exr"] for index in views}})


def views_of(members: Iterable[str]) -> list[int]:
    """Camera indices of the images among a record's members, in order."""
    return sorted(int(match[1]) for name in members if (match := VIEW.match(name)))


FIELDS = """
| member | field | shape | dtype | unit, frame, range |
| --- | --- | --- | --- | --- |
| scene.npz | triangles | (F, 3, 3) | float32 | corners; world, one unit = the scene's bounding box, z up |
| scene.npz | vertex_normals | (F, 3, 3) | float32 | unit shading normal per corner; world |
| scene.npz | diffuse | (F, 3) | float32 | diffuse albedo RGB, [0, 1] |
| scene.npz | specular | (F, 3) | float32 | factor of the GGX lobe, RGB, [0, 1] |
| scene.npz | roughness | (F,) | float32 | [0.01, 1]; GGX alpha = roughness^2 |
| scene.npz | patch_index | (F,) | int32 | row of `patches`, -1 = constant; only in scenes with textured triangles |
| scene.npz | patches | (T, 7, 32, 32) | float16 | diffuse, specular, roughness per texel [row, column], see below |
| scene.npz | emission | (F, 3) | float32 | radiance RGB, >= 0, both sides emit; emitters reflect nothing |
| scene.npz | light_index | (F,) | int16 | light 0..L-1, -1 where a triangle does not emit |
| scene.npz | object_index | (F,) | int16 | into `objects` of meta.json |
| scene.npz | camera_to_world | (V, 4, 4) | float32 | rigid; the camera looks along -z, +y up, +x right |
| scene.npz | fov_deg | (V,) | float32 | degrees, full angle of the square image |
| meta.json | views | list | int | camera index of each kept view; view i is `view<i>.exr` |
| meta.json | template, variant, law, split, objects, cameras, render | | JSON | what was drawn, and what the renderer noted |
| view<i>.exr | one RGB layer per light | (L, H, W, 3) | float16 | linear radiance by light; their sum is the image |
| view<i>.exr | direct | (H, W, 3) | float16 | linear radiance after at most one bounce, all lights |
| view<i>.exr | albedo, normal | (H, W, 3) | float16 | first hit: diffuse + specular; world shading normal |
| view<i>.exr | depth, coverage | (H, W) | float16 | distance along the ray in units, 0 = nothing; hit share of the pixel |
| view<i>.exr | triangle, object | (H, W) | uint32 | first sample's hit plus one: row of triangles, object_index; 0 = nothing |
"""


def card(shards: dict[str, Any], index: dict[str, Any], objects: dict[str, Any]) -> str:
    """The dataset card, as Markdown."""
    lines = [
        "# Dataset card",
        "",
        "Path-traced triangle scenes for RenderFormer. F triangles, V cameras, L lights, H x W pixels.",
        FIELDS,
        "The centre of texel [row, column] of a patch has barycentric weight (column + 0.5) / 32 of corner 1 and "
        "(row + 0.5) / 32 of corner 2; texels with row + column > 32 are 0. A textured triangle's diffuse, specular and "
        "roughness are the means over the texels inside it.",
        "",
    ]
    lines += [
        "## Counts",
        "",
        "| split | scenes | views | triangles | objects | shards | MB |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for split, shard in sorted(shards.items()):
        rows = [row for row in index.values() if row["split"] == split]
        views, faces = sum(len(row["views"]) for row in rows), [row["triangles"] for row in rows]
        lines.append(
            f"| {split} | {shard['samples']} | {views} | {min(faces)}..{max(faces)} | {len(objects.get(split, {}))} "
            f"| {len(shard['parts'])} | {shard['bytes'] / 1e6:.1f} |"
        )
    lines += ["", "| scene | scenes |", "| --- | --- |"]
    lines += [f"| {name} | {number} |" for name, number in sorted(Counter(row["scene"] for row in index.values()).items())]
    lines += ["", "## Licences and sources of the objects", "", "| licence | source | objects |", "| --- | --- | --- |"]
    known = Counter(
        (entry["licence"] or "unknown", entry["source"] or "unknown") for ids in objects.values() for entry in ids.values()
    )
    lines += [f"| {licence} | {source} | {number} |" for (licence, source), number in sorted(known.items())]
    lines += ["", "`objects.json` names every object's origin; no object is in two splits (checked when this was made).", ""]
    return "\n".join(lines)
