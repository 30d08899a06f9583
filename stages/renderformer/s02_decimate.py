"""Stage decimate: each object at a ladder of face budgets, so that a scene only picks.

Reads remesh's meshes, and collect's originals to measure against and to start again from a coarser grid; writes one
record per object (``stages.renderformer.objects.rungs``), ``files/objects.json`` (the catalogue of what is left, with its
rungs) and ``files/contact_sheet.png``. Design choice: quadric collapse with quality and planar weights, which gives the
paper's triangles of roughly equal size; a rung that cannot be had watertight and close enough is left out rather than handed
on. Paper section 3.3 (QSlim to 256..3,072 faces).
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from pipeline.config import StageConfig
from pipeline.errors import Reject
from pipeline.stage import Inputs, Item, MapStage, Record
from stages.graphics.arrays import pack_json, unpack_json
from stages.graphics.geometry.records import MeshRecord
from stages.renderformer.objects.rungs import load_rungs, rung_faces, rungs_record

if TYPE_CHECKING:
    from pipeline.store import Draft

SHEET_OBJECTS = 48  # at most this many on the contact sheet


class DecimateConfig(StageConfig):
    budgets: list[int] = Field([64, 128, 256, 512, 1024, 1188, 2048, 3072, 3968], min_length=1)  # most faces of each rung
    method: Literal["pymeshlab", "fast_simplification"] = "pymeshlab"
    # pymeshlab's, tried in this order until the triangles are even; more: evener, farther from the surface; 0: QSlim alone
    planar_weights: list[Annotated[float, Field(ge=0, le=1)]] = Field([0.001, 0.003], min_length=1)
    even: float = Field(0.5, ge=0)  # area spread (deviation over mean) at which triangles are even
    nearer: int = Field(8, ge=0)  # times the largest budget: fast_simplification brings a mesh that near first; 0: never
    coarser: list[int] = [96, 64, 40]  # grids to start again from, in this order, when a rung is missed
    max_distance: float = Field(0.02, gt=0)  # of a rung to the original's outer surface, in diagonals
    min_kept: float = Field(0.9, ge=0, le=1)  # of the outer surface that remesh kept, within 1 % of the diagonal
    min_kept_coarse: float = Field(0.5, ge=0, le=1)  # the same, for rungs of under 256 faces
    max_inside: float = Field(0.35, ge=0, le=1)  # of the rung's area hidden from outside
    max_flipped: float = Field(0.01, ge=0, le=1)  # of rays from outside that meet the back of a face
    max_crossing: float = Field(0.05, ge=0, le=1)  # of the faces that pass through another one
    max_slivers: float = Field(0.05, ge=0, le=1)  # of the faces with an angle under 5 degrees


class Decimate(MapStage):
    name: ClassVar[str] = "decimate"
    version: ClassVar[int] = 2
    inputs: ClassVar[tuple[str, ...]] = ("collect", "remesh")
    Config: ClassVar[Any] = DecimateConfig
    reasons: ClassVar[dict[str, str]] = {"no_rung": "no budget was reached with a mesh that passes the gates"}
    limits: ClassVar[dict[str, float]] = {"cpu_s": 300.0, "wall_s": 900.0, "memory_gb": 6.0}

    def slug(self, config: DecimateConfig) -> str:
        return f"{config.method}-{min(config.budgets)}-{max(config.budgets)}"

    def items(self, config: DecimateConfig, inputs: Inputs) -> Iterable[Item]:
        ids = [o["object_id"] for o in _catalogue(inputs)]
        return [Item(id, needs=(("collect", id), ("remesh", id))) for id in ids if id in inputs["remesh"]]

    def open(self, config: DecimateConfig, inputs: Inputs, environment: dict[str, Any]) -> Any:
        from stages.graphics.geometry import one_thread

        one_thread()
        return config, inputs

    def process(self, worker: Any, item: Item) -> Iterator[Record]:
        from stages.graphics.geometry import decimator, measure, remesher

        config, inputs = worker
        original = MeshRecord.from_record(inputs["collect"].read(item.id))
        fine = MeshRecord.from_record(inputs["remesh"].read(item.id))
        reference = measure.Reference(original.vertices, original.faces)
        gates = decimator.Gates(
            reference,
            most={name: getattr(config, f"max_{name}") for name in ("distance", "inside", "flipped", "crossing", "slivers")},
            least={"kept": config.min_kept * fine.meta["kept"]},
            least_coarse={"kept": config.min_kept_coarse * fine.meta["kept"]},
        )
        near = config.nearer * max(config.budgets) or len(fine.faces)

        def coarse(resolution: int) -> tuple[np.ndarray, np.ndarray] | None:
            try:
                mesh = remesher.remesh(original.vertices, original.faces, resolution, **fine.meta["settings"])
                return decimator.brought_nearer(*mesh, near)
            except Reject:  # a coarser grid may hold nothing of it: then this source has nothing to offer
                return None

        def reducer(weight: float) -> Callable[[decimator.Mesh, int], decimator.Mesh]:
            return lambda mesh, budget: decimator.collapse(*mesh, budget, config.method, weight)

        finest = fine.vertices.astype(np.float64), fine.faces.astype(np.int64)
        sources = [lambda: decimator.brought_nearer(*finest, near)]
        sources += [lambda resolution=resolution: coarse(resolution) for resolution in config.coarser]
        weights = config.planar_weights if config.method == "pymeshlab" else [0.0]
        rungs = decimator.ladder(sources, config.budgets, [reducer(weight) for weight in weights], gates, config.even)
        missed = {str(budget): why for budget, why in sorted(gates.refused.items()) if budget not in rungs}
        if not rungs:
            raise Reject("no_rung", "; ".join(f"{why} at {budget}" for budget, why in missed.items()))
        meta = {key: fine.meta[key] for key in ("object_id", "content_hash", "family", "source", "origin", "licence")}
        meta["remeshed"] = {key: fine.meta[key] for key in ("faces", "distance", "kept", "inside", "area_spread")}
        meta["missed"] = missed  # budget -> why there is no such rung
        meta["rungs"] = {str(budget): rung.measures for budget, rung in sorted(rungs.items())}
        yield rungs_record(item.id, {budget: (rung.vertices, rung.faces) for budget, rung in rungs.items()}, meta)

    def finish(self, config: DecimateConfig, inputs: Inputs, draft: Draft) -> None:
        from stages.renderformer.objects import catalogue

        metas = {row.id: unpack_json(draft.read(row.id).members["meta.json"]) for row in draft.rows()}
        remaining = [o for o in _catalogue(inputs) if o["object_id"] in metas]
        # what was rejected on the way may have left a split short: it is filled up from train, by the same rule
        splits = catalogue.fill_splits(remaining, {o["object_id"]: o["split"] for o in remaining})
        listed = []
        for o in remaining:
            name = o["object_id"]
            rungs = {str(budget): faces for budget, faces in rung_faces(metas[name]).items()}
            listed.append({**o, "split": splits[name], "rungs": rungs})
        (draft.files / "objects.json").write_bytes(pack_json(listed))
        summary: dict[str, Any] = {"objects": len(listed), "splits": dict(sorted(Counter(splits.values()).items()))}
        for budget in sorted(config.budgets):
            measures = [meta["rungs"][str(budget)] for meta in metas.values() if str(budget) in meta["rungs"]]
            names = ("distance", "kept", "area_spread", "min_angle_deg", "slivers", "crossing", "flipped")
            summary[f"rung_{budget}"] = {
                "objects": len(measures),
                **{name: catalogue.spread([m[name] for m in measures]) for name in names},
            }
        draft.note("summary", summary)
        _write_contact_sheet(inputs, draft, sorted(metas), sorted(config.budgets, reverse=True))

    def check(self, draft: Draft) -> None:
        from stages.graphics.geometry import measure

        for row in draft.rows():
            record = draft.read(row.id)
            rungs, stated = load_rungs(record), rung_faces(unpack_json(record.members["meta.json"]))
            assert rungs and stated == {b: len(faces) for b, (_, faces) in rungs.items()}, f"{row.id}: rungs and meta differ"
            for budget, (vertices, faces) in rungs.items():
                where = f"{row.id} at {budget} faces"
                assert len(faces) <= budget, f"{where} has {len(faces)}"
                assert measure.watertight(faces, len(vertices)), f"{where} is not watertight"
                assert np.isfinite(vertices).all() and measure.volume(vertices, faces) > 0, f"{where} is not outward"


def _catalogue(inputs: Inputs) -> list[dict[str, Any]]:
    return json.loads(inputs["collect"].file("objects.json").read_bytes())


def _write_contact_sheet(inputs: Inputs, draft: Draft, ids: list[str], budgets: list[int]) -> None:
    """Original, remeshed and a column per budget, of objects spread evenly over the catalogue."""
    from stages.graphics.geometry import sheet

    rows = []
    for id in ids[:: max(1, -(-len(ids) // SHEET_OBJECTS))]:
        before = [MeshRecord.from_record(inputs[name].read(id)) for name in ("collect", "remesh")]
        rungs = load_rungs(draft.read(id))
        pictures = [(mesh.vertices, mesh.faces) for mesh in before] + [rungs.get(budget) for budget in budgets]
        rows.append((f"{id}: original, remeshed, {', '.join(map(str, budgets))}", pictures))
    sheet.write_sheet(draft.files / "contact_sheet.png", rows, columns=2)
