"""Stage remesh: every object as one closed surface, what can be seen of it from outside.

Reads collect's catalogue and MeshRecords; writes one watertight, edge-manifold, outward MeshRecord per object, in the
same frame. Design choice: unsigned distance and flood fill from outside (``stages.graphics.geometry.remesher``), because it
needs no closed, oriented or even connected input, and then a pull back to the surface, because the level set alone is
half a voxel too fat. Paper section 3.3 (conversion to a signed distance field and back by marching cubes).
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import Field

from pipeline.config import StageConfig
from pipeline.errors import Reject
from pipeline.stage import Inputs, Item, MapStage, Record
from stages.graphics.geometry.records import MeshRecord

if TYPE_CHECKING:
    from pipeline.store import Draft


class RemeshConfig(StageConfig):
    """Lengths are in voxels."""

    resolution: int = Field(128, ge=16, le=512)  # voxels along the longest side; the released recipe has 256
    eps: float = Field(0.87, gt=0.5, le=3)  # gaps narrower than twice this are closed; half a voxel's diagonal at least
    sheet_gap: float = Field(0.3, gt=0, le=1)  # half the thickness that an open sheet gets
    solid_gap: float = Field(0.05, gt=0, le=1)  # distance from the original where there is inside behind it
    min_area_share: float = Field(1e-4, ge=0, lt=1)  # a component under this share of the area is a speck and goes
    min_kept: float = Field(0.6, ge=0, le=1)  # of the outer surface, within 1 % of the diagonal; less is rejected
    max_inside: float = Field(0.35, ge=0, le=1)  # of the result's area hidden from outside; more is rejected
    max_components: int = Field(20, ge=1)  # separate pieces; more are rejected


class Remesh(MapStage):
    name: ClassVar[str] = "remesh"
    version: ClassVar[int] = 2
    inputs: ClassVar[tuple[str, ...]] = ("collect",)
    Config: ClassVar[Any] = RemeshConfig
    reasons: ClassVar[dict[str, str]] = {
        "no_surface": "nothing of it is left at this grid",
        "not_watertight": "marching cubes left a surface that is not closed and edge-manifold",
        "hidden": "no part of the result can be seen from outside",
        "inside_out": "a component encloses no volume",
        "lost": "less than the configured share of the outer surface is near the result",
        "cluttered": "more than the configured share of the result cannot be seen from outside",
        "scattered": "more separate pieces than configured",
    }
    limits: ClassVar[dict[str, float]] = {"cpu_s": 180.0, "wall_s": 900.0, "memory_gb": 6.0}

    def slug(self, config: RemeshConfig) -> str:
        return f"grid{config.resolution}"

    def items(self, config: RemeshConfig, inputs: Inputs) -> Iterable[Item]:
        objects = json.loads(inputs["collect"].file("objects.json").read_bytes())
        return [Item(o["object_id"], needs=(("collect", o["object_id"]),)) for o in objects]

    def open(self, config: RemeshConfig, inputs: Inputs, environment: dict[str, Any]) -> Any:
        from stages.graphics.geometry import one_thread

        one_thread()
        return config, inputs["collect"]

    def process(self, worker: Any, item: Item) -> Iterator[Record]:
        from stages.graphics.geometry import measure, remesher

        config, collect = worker
        source = MeshRecord.from_record(collect.read(item.id))
        settings = {name: getattr(config, name) for name in ("eps", "sheet_gap", "solid_gap", "min_area_share")}
        vertices, faces = remesher.remesh(source.vertices, source.faces, config.resolution, **settings)
        compared = measure.Reference(source.vertices, source.faces).compare(vertices, faces)
        if compared["kept"] < config.min_kept:
            raise Reject("lost", f"{compared['kept']:.0%} of the outer surface kept, at least {config.min_kept:.0%} needed")
        if compared["inside"] > config.max_inside:
            raise Reject("cluttered", f"{compared['inside']:.0%} hidden, at most {config.max_inside:.0%} taken")
        stated = measure.measures(vertices, faces)
        if stated["components"] > config.max_components:
            raise Reject("scattered", f"{stated['components']} pieces, at most {config.max_components} taken")
        meta = {key: source.meta[key] for key in ("object_id", "content_hash", "family", "source", "origin", "licence")}
        meta |= stated | compared | {"settings": settings}  # for decimate, which may have to start from a coarser grid
        yield MeshRecord(item.id, vertices.astype(np.float32), faces.astype(np.int32), meta).to_record()

    def finish(self, config: RemeshConfig, inputs: Inputs, draft: Draft) -> None:
        from stages.renderformer.objects.catalogue import spread

        metas = [MeshRecord.from_record(draft.read(row.id)).meta for row in draft.rows()]
        names = ("faces", "distance", "kept", "inside", "components", "area_spread", "min_angle_deg")
        draft.note("summary", {"objects": len(metas), **{name: spread([m[name] for m in metas]) for name in names}})

    def check(self, draft: Draft) -> None:
        for row in draft.rows():
            meta = MeshRecord.from_record(draft.read(row.id)).meta
            assert meta["watertight"] and meta["volume"] > 0 and meta["faces"] > 0, f"{row.id} is not a closed outward mesh"
