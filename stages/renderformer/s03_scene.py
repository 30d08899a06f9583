"""scene: from decimated objects to scenes, walls, materials, lights and cameras (paper section 3.3).

Reads *decimate* (the ladder of each object), and *collect* where objects are to be textured; writes one ``SceneRecord`` per
scene. The laws are in ``stages.renderformer.scenes.laws``.
One design choice: a scene never exceeds ``max_triangles`` because lower rungs of the ladder are taken; nothing is cut, and a
scene that does not fit even so is rejected.

Thin scenes want a thin object: candidates are looked at in random order and the first whose bounding box is flat enough
is taken, else the thinnest of them. Special scenes use simple shapes made by code.

Textures (``scene.textures``): remeshing loses texture coordinates, so the colours of a rung are those of the nearest points
of the collected mesh (``stages.renderformer.scenes.textures``). They depend on object and rung only and are kept for the next
scene.
"""

from __future__ import annotations

import json
from collections import Counter, OrderedDict
from collections.abc import Iterator
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from pipeline.config import Section, StageConfig, count
from pipeline.errors import Reject, UserError
from pipeline.keys import seed_for
from pipeline.stage import Inputs, Item, MapStage, Record
from stages.graphics.arrays import unpack_json
from stages.graphics.geometry.records import MeshRecord, TextureRecord
from stages.renderformer.records import SceneRecord
from stages.renderformer.scenes.laws import Laws, Placement, Plan, TextureLaw, draw_plan

MIN_OBJECTS = 2  # per split: with one object a split's scenes would all show the same thing
KEPT_MESHES = 512  # objects that a worker holds in memory
KEPT_COLOURS = 1 << 28  # bytes of rungs' colours that a worker holds in memory


class SceneCount(Section):
    """Scenes per split."""

    train: int = Field(880, ge=0)
    validation: int = Field(16, ge=0)
    test: int = Field(24, ge=0)


class SceneConfig(StageConfig, Laws):
    name: Literal["released", "paper"] = "released"  # the law's name; its numbers are below
    seed: int = 0
    count: SceneCount = count(SceneCount())
    max_triangles: int = Field(768, ge=1)  # walls, objects and lights together

    def laws(self) -> Laws:
        return Laws(**{name: getattr(self, name) for name in Laws.model_fields})

    @model_validator(mode="after")
    def _some(self) -> SceneConfig:
        if self.count.train + self.count.validation + self.count.test == 0:
            raise ValueError("scene.count asks for no scene at all")
        return self


class SceneWorker:
    """Draws and assembles scenes; keeps the meshes and colours of recently used objects.

    ``collect``: None where no object is to be textured.
    """

    def __init__(self, config: SceneConfig, catalogue: dict[str, list[dict]], decimate: Any, collect: Any = None):
        self.config, self.catalogue, self.decimate, self.collect = config, catalogue, decimate, collect
        self.laws = config.laws()
        self._colours: OrderedDict[tuple[str, str], np.ndarray | None] = OrderedDict()  # of (object id, rung)
        self._meshes: dict[str, dict[int, tuple[np.ndarray, np.ndarray]]] = {}  # object id -> its rungs

    def mesh(self, entry: dict, rung: str) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (V, 3) float32 and faces (F, 3) of one rung of an object."""
        from stages.renderformer.objects.rungs import load_rungs

        id = entry["object_id"]
        if id not in self._meshes:
            if len(self._meshes) >= KEPT_MESHES:
                self._meshes.clear()
            self._meshes[id] = load_rungs(self.decimate.read(id))
        return self._meshes[id][int(rung)]

    def colours(self, entry: dict, rung: str) -> np.ndarray | None:
        """(F, 32, 32, 3) float16 linear colours of a rung's faces; None for an object without base colours."""
        from stages.renderformer.scenes import textures

        key = entry["object_id"], rung
        if key in self._colours:
            self._colours.move_to_end(key)
            return self._colours[key]
        colours = None
        name = key[0] + TextureRecord.SUFFIX
        record = self.collect.read(name) if name in self.collect else None
        if record is not None and "texture.npz" in record.members:
            source, texture = MeshRecord.from_record(self.collect.read(key[0])), TextureRecord.from_record(record)
            vertices, faces = self.mesh(entry, rung)
            visible = textures.seen_faces(source.vertices, source.faces)
            colours = textures.transfer(texture, source.vertices, source.faces, vertices[faces], visible).astype(np.float16)
        self._colours[key] = colours
        while sum(a.nbytes for a in self._colours.values() if a is not None) > KEPT_COLOURS and len(self._colours) > 1:
            self._colours.popitem(last=False)
        return colours

    def pattern(self, placement: Placement, mesh: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """(F, 32, 32, 3) linear colours of a wall or special shape: the pattern of its seed, from all sides."""
        from stages.renderformer.objects.procedural import box_coordinates, pattern
        from stages.renderformer.scenes import textures

        rng = np.random.default_rng(placement.texture)
        return textures.bake(pattern(rng), box_coordinates(*mesh, float(rng.uniform(1, 4))))

    def plan(self, item: Item) -> Plan:
        """What the item's generator draws."""
        rng = np.random.default_rng(seed_for(self.config.seed, SampleScene.name, item.id))
        plan = draw_plan(self.laws, rng, len(self.catalogue[item.group]))
        if plan.variant == "thin":
            plan.objects[0].index = self._thin(plan.thin_candidates, self.catalogue[item.group])
        return plan

    def scene(self, item: Item) -> SceneRecord:
        from stages.renderformer.scenes.assemble import WALL_FACES, assemble, choose_rungs
        from stages.renderformer.scenes.meshes import special, special_rungs, wall
        from stages.renderformer.scenes.textures import material_patches

        plan, entries, law = self.plan(item), self.catalogue[item.group], self.laws.objects
        ladders = [special_rungs(p.shape) if p.shape else entries[p.index]["rungs"] for p in plan.objects]
        budget = self.config.max_triangles - WALL_FACES * len(plan.walls) - len(plan.lights)
        largest = law.single_faces if len(plan.objects) == 1 else law.multi_faces
        rungs = choose_rungs(ladders, budget, largest) if budget >= 0 else None
        if rungs is None:
            raise Reject(
                "over_budget",
                f"{len(plan.walls)} walls, {len(plan.lights)} lights and {len(plan.objects)} objects exceed "
                f"{self.config.max_triangles} triangles even on the lowest rungs",
            )
        meshes, chosen = [], []
        colours = {w.name: self.pattern(w, wall(w.name)) for w in plan.walls if w.texture is not None}
        for placement, rung in zip(plan.objects, rungs, strict=True):
            if placement.shape:
                meshes.append(special(placement.shape, int(rung)))
                chosen.append({"shape": placement.shape, "rung": rung})
            else:
                entry = entries[placement.index]
                meshes.append(self.mesh(entry, rung))
                origin_fields = ("object_id", "content_hash", "family", "source", "origin", "licence")
                chosen.append({"rung": rung, **{name: entry.get(name) for name in origin_fields}})
            if placement.texture is not None:
                base_colours = self.pattern(placement, meshes[-1]) if placement.shape else self.colours(entry, rung)
                chosen[-1]["textured"] = base_colours is not None
                if base_colours is None:  # no base colours: it stays as it is without textures
                    placement.texture = None
                else:
                    colours[placement.name] = base_colours
        patches = {
            p.name: material_patches(colours[p.name], p.material.bound, p.material.specular, p.material.roughness)
            for p in (*plan.walls, *plan.objects)
            if p.name in colours
        }
        meta = {"law": self.config.name, "split": item.group}
        return assemble(item.id, plan, meshes, chosen, self.laws.material, meta, patches)

    def _thin(self, candidates: list[int], entries: list[dict]) -> int:
        thickness = {}
        for index in candidates:
            vertices, _ = self.mesh(entries[index], min(entries[index]["rungs"], key=int))
            sides = np.ptp(vertices, axis=0)
            thickness[index] = float(sides.min() / sides.max())
            if thickness[index] <= self.laws.objects.thin_thickness:
                return index
        return min(candidates, key=thickness.__getitem__)


class SampleScene(MapStage):
    name = "scene"
    version = 3
    inputs = ("collect", "decimate")
    Config = SceneConfig
    reasons = {"over_budget": "walls, lights and the smallest rungs of the objects exceed max_triangles"}

    def reads(self, config: SceneConfig) -> tuple[str, ...]:
        """*collect* has the objects' base colours, and nothing else that a scene needs."""
        return ("collect", "decimate") if config.textures.share > 0 else ("decimate",)

    def slug(self, config: SceneConfig) -> str:
        return f"{config.name}-{config.max_triangles}"

    def part_size(self, config: SceneConfig, inputs: Inputs) -> int:
        return 64

    def items(self, config: SceneConfig, inputs: Inputs) -> Iterator[Item]:
        catalogue = read_catalogue(inputs)
        if config.textures.share > 0:
            try:
                inputs["collect"].file("textures.json")
            except UserError:
                raise UserError(
                    f"scene.textures.share={config.textures.share} needs objects with their base colours, and these were "
                    "collected without: set collect.textures=true, or scene.textures.share=0"
                ) from None
        for split, scenes in config.count.model_dump().items():
            if scenes and len(catalogue.get(split, [])) < MIN_OBJECTS:
                raise UserError(
                    f"the {split} split has {len(catalogue.get(split, []))} decimated object(s), but scenes need at least "
                    f"{MIN_OBJECTS} per split, or all of them would show the same object: collect more meshes, see why the "
                    f"others were rejected (lightmill show remesh, decimate), or set scene.count.{split}=0"
                )
            for number in range(scenes):
                yield Item(f"{split}-{number:06d}", split)

    def open(self, config: SceneConfig, inputs: Inputs, environment: dict[str, Any]) -> SceneWorker:
        return SceneWorker(config, read_catalogue(inputs), inputs["decimate"], inputs.get("collect"))

    def process(self, worker: SceneWorker, item: Item) -> Iterator[Record]:
        yield worker.scene(item).to_record()

    def finish(self, config: SceneConfig, inputs: Inputs, draft: Any) -> None:
        """``files/statistics.json``: how often each template and variant, objects, lights and triangles occur."""
        names = ["split", "scene", "objects", "lights", "triangles"]
        names += ["textures"] * (config.textures != TextureLaw())
        tallies: dict[str, Counter] = {name: Counter() for name in names}
        for row in draft.rows():
            meta = unpack_json(draft.read(row.id).members["meta.json"])
            tallies["split"][meta["split"]] += 1
            tallies["scene"][f"{meta['template']}_{meta['variant']}"] += 1
            tallies["objects"][sum(entry["kind"] == "object" for entry in meta["objects"])] += 1
            tallies["lights"][meta["n_lights"]] += 1
            tallies["triangles"][meta["n_triangles"] // 64 * 64] += 1  # histogram: lower edge of bins of 64
            for entry in meta["objects"] if "textures" in tallies else ():
                if entry["kind"] != "light":
                    drawn = entry.get("textured", "texture" in entry or None)  # None: was not drawn to be textured
                    state = {True: "textured", False: "without_base_colours", None: "plain"}[drawn]
                    tallies["textures"][f"{entry['kind']}_{state}"] += 1
        tables = {name: {str(key): tally[key] for key in sorted(tally)} for name, tally in tallies.items()}
        (draft.files / "statistics.json").write_text(json.dumps(tables, indent=1) + "\n")
        draft.note("scenes", {"law": config.name, "max_triangles": config.max_triangles, **tables})


def read_catalogue(inputs: Inputs) -> dict[str, list[dict]]:
    """split -> its objects that have at least one rung, in order of id."""
    catalogue: dict[str, list[dict]] = {}
    for entry in sorted(json.loads(inputs["decimate"].file("objects.json").read_text()), key=lambda e: e["object_id"]):
        if entry["rungs"]:
            catalogue.setdefault(entry["split"], []).append(entry)
    return catalogue
