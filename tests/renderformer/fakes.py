"""Stand-ins for the artifacts that stages read, with nothing on disk but ``files/``; and real shards made of them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from pipeline.keys import digest_of
from pipeline.stage import Record
from pipeline.store import Artifact, Store
from stages.graphics.arrays import pack_arrays, pack_json
from stages.renderformer.records import SceneRecord, ViewRecord


class FakeArtifact:
    """Records in memory; serves as draft too."""

    def __init__(self, path: Path, records: list[tuple[str, Record]]):
        self.path, self.files, self.notes, self.stage = path, path / "files", {}, path.name
        self.manifest = {"preimage": {"stage": self.stage, "version": 1, "params": {"seed": 0}, "inputs": {}}}
        self.store = Store(path.parent)
        self.files.mkdir(parents=True, exist_ok=True)
        self._records = {record.id: (group, record) for group, record in records}

    def rows(self):
        stored = self._records.items()
        rows = [
            SimpleNamespace(
                id=id, item=id, group=group, members={name: (0, len(data)) for name, data in record.members.items()}
            )
            for id, (group, record) in stored
        ]
        return sorted(rows, key=lambda row: (row.group, row.id))

    def ids(self, group=None):
        return [row.id for row in self.rows() if group in (None, row.group)]

    def read(self, id, only=None):
        record = self._records[id][1]
        return record if only is None else Record(id, {name: record.members[name] for name in only})

    def file(self, name):
        return self.files / name

    def note(self, name, value):
        self.notes[name] = value

    def log(self, text):
        pass

    def groups(self):
        return sorted({row.group for row in self.rows()})

    def __contains__(self, id):
        return id in self._records


def blob(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A closed bumpy surface of about 12 n^2 faces, its longest side 1."""
    from stages.renderformer.scenes.meshes import special

    vertices, faces = special("sphere", n)
    rng = np.random.default_rng(seed)
    vertices = vertices * rng.uniform(0.3, 1.0, 3) * (1 + 0.2 * np.sin(vertices @ rng.normal(size=(3, 1)) * 3))
    vertices -= (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    return (vertices / np.ptp(vertices, axis=0).max()).astype(np.float32), faces.astype(np.int32)


def decimated(path: Path, per_split: int = 4) -> FakeArtifact:
    """A *decimate* artifact: blobs on rungs of 48, 192 and 768 faces, the first of each split flat."""
    records, catalogue = [], []
    for split in ("train", "validation", "test"):
        for number in range(per_split):
            id, members, rungs = f"{split}-blob{number}", {}, {}
            for rung, n in ((48, 1), (192, 3), (768, 7)):
                vertices, faces = blob(n, number)
                if number == 0:
                    vertices = vertices * np.float32([1, 1, 0.1])
                members[f"f{rung:04d}.npz"] = pack_arrays({"vertices": vertices, "faces": faces})
                rungs[str(rung)] = len(faces)
            records.append((split, Record(id, members)))
            catalogue.append({"object_id": id, "split": split, "family": "blob", "content_hash": id, "source": "test",
                              "origin": f"https://example.org/{id}", "licence": "CC0", "rungs": rungs})  # fmt: skip
    artifact = FakeArtifact(path, records)
    artifact.file("objects.json").write_text(json.dumps(catalogue))
    return artifact


def with_textures(scene, count: int = 4):
    """The scene with its largest triangles textured: red rises towards corner 1, green towards corner 2."""
    from stages.renderformer.records import PATCH_KEPT, patch_means

    edges = scene.triangles[:, 1:] - scene.triangles[:, :1]
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) * (scene.light_index < 0)
    faces = np.sort(np.argsort(-area, kind="stable")[:count])
    patches = np.full((count, 7, 32, 32), 0.25, np.float16)
    row, column = np.indices((32, 32))
    patches[:, 0], patches[:, 1], patches[:, 6] = column / 32, row / 32, 0.5
    patches[:, 2] = np.arange(count)[:, None, None] / count
    patches *= PATCH_KEPT
    index = np.full(len(scene.triangles), -1, np.int32)
    index[faces] = np.arange(count)[::-1]  # rows need not lie in the order of faces
    columns = {name: getattr(scene, name).copy() for name in ("diffuse", "specular", "roughness")}
    for name, means in patch_means(patches).items():
        columns[name][faces] = means[index[faces]]
    return replace(scene, **columns, patch_index=index, patches=patches)


def dataset_inputs(path: Path, train: int = 6, validation: int = 0, test: int = 2, size: int = 12) -> dict[str, FakeArtifact]:
    """*scene* and *render* artifacts with random images; camera 1 of every scene was dropped by the renderer.

    Every other training scene is textured.
    """
    from stages.renderformer.records import SceneRecord, ViewRecord
    from stages.renderformer.s03_scene import SampleScene, SceneConfig, SceneCount
    from stages.renderformer.views import encode_view

    config, stage = SceneConfig(count=SceneCount(train=train, validation=validation, test=test)), SampleScene()
    decimate = {"decimate": decimated(path / "decimate")}
    worker, scenes, renders = stage.open(config, decimate, {}), [], []
    for item in stage.items(config, decimate):
        scene = SceneRecord.from_record(next(iter(stage.process(worker, item))))
        if item.id.startswith("train") and int(item.id[-1]) % 2 == 0:
            scene = with_textures(scene)
        scenes.append((item.group, scene.to_record()))
        rng, members = np.random.default_rng(len(scenes)), {}
        for index in (0, 2, 3):
            lights = rng.uniform(0, 2, (scene.n_lights, size, size, 3)).astype(np.float16).astype(np.float32)
            planes = {name: rng.uniform(size=(size, size, 3)).astype(np.float32) for name in ("direct", "albedo", "normal")}
            flat = {name: np.ones((size, size), np.float32) for name in ("depth", "coverage")}
            flat |= {name: rng.integers(-1, 9, (size, size), np.int32) for name in ("triangle", "object")}
            members |= encode_view(ViewRecord(lights, **planes, **flat, meta={"index": index, "spp": 1}))
        noted = {"mean": 0.5, "spp": 16, "error": 0.01, "clamped": 0}
        statuses = ["ok", "dark", "ok", "ok"]
        views = [{"index": i, "status": s, **noted} for i, s in enumerate(statuses)]
        views[2]["noise"] = {"sum": {"log_error": 0.02, "psnr": 31.0}, "reweighted": [{"log_error": 0.03, "psnr": 30.0}] * 2}
        meta = {"template": scene.meta["template"], "variant": scene.meta["variant"], "lights": scene.n_lights}
        members["meta.json"] = pack_json({**meta, "views": views})
        renders.append((item.group, Record(item.id, members)))
    return {"scene": FakeArtifact(path / "scene", scenes), "render": FakeArtifact(path / "render", renders)}


def sharded(path: Path, per_shard: int = 4, **inputs: int) -> tuple[dict[str, FakeArtifact], Artifact]:
    """The inputs of *shard* and its artifact, committed to a store: ``per_shard`` scenes in a tar."""
    from stages.renderformer.s05_shard import Shard, ShardConfig

    fakes, stage, config = dataset_inputs(path, **inputs), Shard(), ShardConfig()
    return fakes, commit_shards(path / "store", fakes, stage, config, per_shard)


def commit_shards(root: Path, inputs: dict, stage, config, per_shard: int) -> Artifact:
    store, worker = Store(root), stage.open(config, inputs, {})
    preimage = {"stage": "shard", "version": stage.version, "params": config.model_dump(mode="json"), "inputs": {}}
    draft = store.draft("shard", digest_of(preimage), preimage)
    items = sorted(stage.items(config, inputs), key=lambda item: (item.group, item.id))
    markers = []
    for group in sorted({item.group for item in items}):
        group_items = [item for item in items if item.group == group]
        for first in range(0, len(group_items), per_shard):
            part = draft.open_part()
            for item in group_items[first : first + per_shard]:
                for record in stage.process(worker, item):
                    part.add(record, item.id, group, "")
            ids = [item.id for item in group_items[first : first + per_shard]]
            markers.append({"part_key": str(len(markers)), "group": group, "items": ids, "rejects": [], **part.close()})
    draft.use_parts(markers)
    stage.finish(config, inputs, draft)
    stage.check(draft)
    manifest = {"key": draft.key, "preimage": preimage, "outputs": draft.outputs(), "summary": draft.summary, "finished": 0.0}
    return store.commit(draft, stage.slug(config), manifest)


def path_traced(
    scene: SceneRecord, resolution: int, *, backend: dict, views=None, threads=None, **settings
) -> list[ViewRecord]:
    """``render_views`` in one call; ``settings`` are fields of `RenderSettings`."""
    from stages.renderformer.rendering.render import render_views
    from stages.renderformer.rendering.settings import RenderSettings

    return render_views(scene, RenderSettings(resolution, **settings), backend, views, threads)
