"""shard: scenes and their images as the dataset: webdataset tars, an index and a card.

Reads *scene* and *render*, writes one sample per scene: ``scene.npz`` (compact, ``stages.renderformer.dataset.encoding``),
``meta.json``, and ``view<i>.exr`` and ``view<i>.aov.exr`` for every kept view i, copied unchanged; with ``guides`` also what
ray casting says of scene and views (``stages.renderformer.guides``). One design choice: the store's parts *are* the shards,
so that plain ``webdataset`` reads them where they lie and nothing is stored twice. Samples lie in order of id, which is a
random order already: every scene is an independent draw. Paper section 3.3.
"""

from __future__ import annotations

import hashlib
import json
import math
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pydantic import Field, model_validator

from pipeline.config import StageConfig, added
from pipeline.errors import UserError
from pipeline.stage import Inputs, Item, MapStage, Record
from stages.renderformer.views import VIEW, view_members

if TYPE_CHECKING:
    from stages.renderformer.records import SceneRecord


class ShardConfig(StageConfig):
    shard_mb: float = Field(256.0, gt=0)  # size that shards come near: a power of two of scenes each
    guides: bool = added(False, False)  # also hits, reflections and visibility by ray casting: what guided models read
    bounces: bool = added(False, False)  # and what rays from both sides of every triangle hit

    @model_validator(mode="after")
    def _together(self) -> ShardConfig:
        if self.bounces and not self.guides:
            raise ValueError("bounces=true is an addition to guides: set shard.guides=true, too")
        return self


@dataclass(frozen=True)
class Worker:
    inputs: Inputs
    config: ShardConfig


class Shard(MapStage):
    name = "shard"
    version = 3
    headline = "card.html"
    inputs = ("scene", "render")
    Config = ShardConfig

    def slug(self, config: ShardConfig) -> str:
        return f"{config.shard_mb:g}mb" + ("-bounces" if config.bounces else "-guides" if config.guides else "")

    def part_size(self, config: ShardConfig, inputs: Inputs) -> int:
        """Scenes per shard: the power of two nearest to the target, by the mean bytes of a rendered scene.

        A power of two, so that a dataset that grows keeps its full shards although the mean has moved a little.
        """
        rows = inputs["render"].rows()
        mean = sum(size for row in rows for _, size in row.members.values()) / max(len(rows), 1)
        return 2 ** max(0, round(math.log2(config.shard_mb * 1e6 / max(mean, 1.0))))

    def items(self, config: ShardConfig, inputs: Inputs) -> Iterator[Item]:
        for row in inputs["render"].rows():
            yield Item(row.id, row.group, (("scene", row.id), ("render", row.id)))

    def open(self, config: ShardConfig, inputs: Inputs, environment: dict[str, Any]) -> Worker:
        if config.guides and inputs["render"].manifest["preimage"]["params"].get("lights_visible"):
            raise UserError(
                "shard.guides=true: camera rays of guides pass through lights, but render.lights_visible=true shows them; "
                "choose one of the two"
            )
        return Worker(inputs, config)

    def process(self, worker: Worker, item: Item) -> Iterator[Record]:
        yield merge(worker.inputs["scene"].read(item.id), worker.inputs["render"].read(item.id), worker.config)

    def finish(self, config: ShardConfig, inputs: Inputs, draft: Any) -> None:
        """``files/``: ``index.jsonl``, ``shards.json``, ``objects.json``, and the card with its pictures."""
        from pipeline.store.files import write_jsonl
        from stages.graphics.arrays import unpack_json
        from stages.renderformer.dataset.card import write_card

        shards: dict[str, Any] = {}
        objects: dict[str, Any] = {}
        digests: dict[str, Any] = {}

        def index() -> Iterator[dict[str, Any]]:
            for row in draft.rows():
                data = draft.read(row.id, ["meta.json"]).members["meta.json"]
                meta = unpack_json(data)
                crc = {**meta["crc32"], "meta.json": zlib.crc32(data)}
                path, split = draft.part_of(row.id)
                note_objects(objects.setdefault(split, {}), meta)
                shard = shards.setdefault(split, {"samples": 0, "parts": []})
                shard["samples"] += 1
                if not shard["parts"] or shard["parts"][-1]["path"] != f"parts/{path.name}":
                    shard["parts"].append({"path": f"parts/{path.name}", "bytes": path.stat().st_size, "samples": 0})
                shard["parts"][-1]["samples"] += 1
                content = digests.setdefault(split, hashlib.blake2b(digest_size=16))
                content.update(json.dumps([row.id, row.digest]).encode())
                yield {
                    "id": row.id,
                    "split": split,
                    "shard": f"parts/{path.name}",
                    "triangles": meta["n_triangles"],
                    "lights": meta["n_lights"],
                    "views": meta["views"],
                    "resolution": meta["resolution"],
                    "scene": f"{meta['template']}_{meta['variant']}" if "variant" in meta else meta["template"],
                    "members": {name: [*row.members[name], crc[name]] for name in sorted(row.members)},
                }

        write_jsonl(draft.files / "index.jsonl", index())
        for split, shard in shards.items():
            shard["bytes"] = sum(part["bytes"] for part in shard["parts"])
            shard["digest"] = digests[split].hexdigest()
        for name, value in (("shards", shards), ("objects", objects)):
            (draft.files / f"{name}.json").write_text(json.dumps(value, indent=1, sort_keys=True) + "\n")
        write_card(config, inputs, draft)
        draft.note("shards", {split: {**shard, "parts": len(shard["parts"])} for split, shard in shards.items()})

    def check(self, draft: Any) -> None:
        split_of_object: dict[str, str] = {}
        for split, ids in json.loads((draft.files / "objects.json").read_text()).items():
            for id in ids:
                if split_of_object.setdefault(id, split) != split:
                    raise UserError(
                        f"object {id} is in the splits {split_of_object[id]} and {split}: images of it would leak into the test"
                    )


def note_objects(objects: dict[str, Any], meta: dict[str, Any]) -> None:
    """Add the objects of a scene: the hash of its mesh, where each is from and under which licence."""
    for entry in meta["objects"]:
        if entry.get("object_id"):
            origin = {name: entry.get(name) for name in ("content_hash", "family", "source", "origin", "licence")}
            objects.setdefault(entry["object_id"], {**origin, "scenes": 0})["scenes"] += 1


def merge(scene: Record, render: Record, config: ShardConfig | None = None) -> Record:
    """One sample: the scene's arrays made compact, both metas, and the images byte for byte; the guides, where wanted.

    ``meta["views"]`` lists the camera index of each kept view in order, ``meta["render"]`` is what the renderer noted,
    ``meta["crc32"]`` maps each other member to the CRC-32 of its bytes.
    """
    from stages.graphics.arrays import unpack_json
    from stages.graphics.exr import size_of
    from stages.renderformer.dataset.encoding import encode_scene
    from stages.renderformer.records import SceneRecord

    views = views_of(render.members)
    record = SceneRecord.from_record(scene)
    members = {name: render.members[name] for index in views for name in view_members(index)}
    members = {"scene.npz": encode_scene(record), **members}
    resolution = size_of(members[view_members(views[0])[0]])[0]
    if config is not None and config.guides:
        members |= cast_guides(record, views, resolution, config.bounces)
    meta = {
        **record.meta,
        "n_triangles": len(record.triangles),
        "n_lights": record.n_lights,
        "views": views,
        "resolution": resolution,
        "render": unpack_json(render.members["meta.json"]),
        "crc32": {name: zlib.crc32(data) for name, data in members.items()},
    }
    plain = json.dumps(meta, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=False)
    return Record(scene.id, {"meta.json": plain.encode(), **members})


def cast_guides(scene: SceneRecord, views: Iterable[int], resolution: int, bounces: bool) -> dict[str, bytes]:
    """Members with the guides of the scene and of its views."""
    from stages.renderformer.guides import GuideCaster, guide_member
    from stages.renderformer.guides.records import SCENE_MEMBER, encode_scene_guides, encode_view_guides

    caster = GuideCaster(scene)
    members = {SCENE_MEMBER: encode_scene_guides(caster.scene_guides(bounces))}
    for view in views:
        members[guide_member(view)] = encode_view_guides(caster.view_guides(view, resolution, resolution))
    return members


def views_of(members: Iterable[str]) -> list[int]:
    """Camera indices of the images among a record's members, in order."""
    return sorted(int(match[1]) for name in members if (match := VIEW.match(name)))
