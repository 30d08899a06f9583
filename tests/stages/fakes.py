"""Stand-ins for artifacts and drafts, with the interface of ``pipeline.store`` and nothing on disk but ``files/``."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from pipeline.stage import Record
from stages.arrays import pack_arrays, pack_json


class FakeArtifact:
    """Records in memory; serves as draft too."""

    def __init__(self, path: Path, records: list[tuple[str, Record]]):
        self.path, self.files, self.notes = path, path / "files", {}
        self.files.mkdir(parents=True, exist_ok=True)
        self._records = {record.id: (group, record) for group, record in records}

    def rows(self):
        stored = self._records.items()
        rows = [SimpleNamespace(id=id, item=id, group=group, members=record.members) for id, (group, record) in stored]
        return sorted(rows, key=lambda row: (row.group, row.id))

    def ids(self, group=None):
        return [row.id for row in self.rows() if group in (None, row.group)]

    def read(self, id, only=None):
        record = self._records[id][1]
        return record if only is None else Record(id, {name: record.members[name] for name in only})

    def file(self, name):
        return self.files / name

    def part_of(self, id):
        group = self._records[id][0]
        return self.path / "parts" / f"{group}.tar", group

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
    from stages.scenes.meshes import special

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


def dataset_inputs(path: Path, train: int = 6, test: int = 2, size: int = 12) -> dict[str, FakeArtifact]:
    """*scene* and *render* artifacts with random images; camera 1 of every scene was dropped by the renderer."""
    from stages.exr import encode_view
    from stages.records import SceneRecord, ViewRecord
    from stages.s03_scene import SampleScene, SceneConfig, SceneCount

    config, stage = SceneConfig(count=SceneCount(train=train, validation=0, test=test)), SampleScene()
    decimate = {"decimate": decimated(path / "decimate")}
    worker, scenes, renders = stage.open(config, decimate, {}), [], []
    for item in stage.items(config, decimate):
        record = next(iter(stage.process(worker, item)))
        scenes.append((item.group, record))
        scene, rng, members = SceneRecord.from_record(record), np.random.default_rng(len(scenes)), {}
        for index in (0, 2, 3):
            lights = rng.uniform(0, 2, (scene.n_lights, size, size, 3)).astype(np.float16).astype(np.float32)
            planes = {name: rng.uniform(size=(size, size, 3)).astype(np.float32) for name in ("direct", "albedo", "normal")}
            flat = {name: np.ones((size, size), np.float32) for name in ("depth", "coverage")}
            flat |= {name: np.zeros((size, size), np.int32) for name in ("triangle", "object")}
            members[f"view{index}.exr"] = encode_view(ViewRecord(lights, **planes, **flat, meta={"index": index, "spp": 1}))
        members["meta.json"] = pack_json({"views": [{"index": index, "status": "ok"} for index in range(4)]})
        renders.append((item.group, Record(item.id, members)))
    return {"scene": FakeArtifact(path / "scene", scenes), "render": FakeArtifact(path / "render", renders)}


def sharded(path: Path) -> tuple[dict[str, FakeArtifact], FakeArtifact]:
    """The inputs of *shard* and its artifact, one tar per split."""
    from pipeline.files import TarWriter
    from stages.s05_shard import Shard, ShardConfig

    inputs, stage, config = dataset_inputs(path), Shard(), ShardConfig()
    worker = stage.open(config, inputs, {})
    records = [(item.group, record) for item in stage.items(config, inputs) for record in stage.process(worker, item)]
    draft = FakeArtifact(path / "shard", records)
    (draft.path / "parts").mkdir()
    for split in ("train", "test"):
        with open(draft.path / "parts" / f"{split}.tar", "wb") as file:
            tar = TarWriter(file)
            for id in draft.ids(split):
                for name, data in draft.read(id).members.items():
                    tar.add(f"{id}.{name}", data)
            tar.close()
    stage.finish(config, inputs, draft)
    stage.check(draft)
    return inputs, draft
