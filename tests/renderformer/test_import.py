"""Scenes in the released formats as a source: what is read, which split it is in, what is refused, when it is read anew."""

from __future__ import annotations

import hashlib
import io
import json
import shutil

import numpy as np
import pytest

from pipeline.errors import Reject, UserError
from pipeline.hydra_config import compose
from pipeline.plan import make_plan, split_config
from pipeline.run import run_pipeline
from pipeline.stage import Item
from pipeline.store.files import hash_file
from stages.cli import main
from stages.renderformer.records import SceneRecord
from stages.renderformer.s03_import import ImportConfig, ImportScene
from stages.renderformer.scenes.released import load_scene
from tests.renderformer.fakes import with_textures

MESH = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def scene_json(**light) -> str:
    solid = {"mesh_path": "mesh.obj", "material": {"diffuse": [0.5, 0.4, 0.3], "roughness": 0.7}, "transform": {}}
    lamp = {"mesh_path": "mesh.obj", "material": {"emissive": [900, 900, 900]}, "transform": {"translation": [0, 0, 2]} | light}
    camera = {"position": [3, 3, 2], "look_at": [0, 0, 0], "up": [0, 0, 1], "fov": 45}
    return json.dumps({"scene_name": "s", "version": "1.0", "objects": {"a": solid, "l": lamp}, "cameras": [camera]})


@pytest.fixture
def folder(tmp_path):
    for name in ("train/one.json", "validation/two.json", "loose.json", "sub/train/deep.json"):
        path = tmp_path / "scenes" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(scene_json())
        (path.parent / "mesh.obj").write_text(MESH)
    (tmp_path / "scenes" / "notes.json").write_text('{"not": "a scene"}')
    return tmp_path / "scenes"


def test_splits_come_from_folders_and_ids_are_safe(folder):
    stage, config = ImportScene(), ImportConfig(path=str(folder), split="test")
    items = list(stage.items(config, {}))
    assert [(item.id, item.group) for item in items] == [
        ("loose.json", "test"), ("sub/train/deep.json", "test"), ("train/one.json", "train"),
        ("validation/two.json", "validation"),
    ]  # fmt: skip
    for item in items:
        (record,) = stage.process(stage.open(config, {}, {}), item)
        scene = SceneRecord.from_record(record)
        assert scene.meta["split"] == item.group and scene.meta["n_triangles"] == 8 and scene.meta["n_lights"] == 1
        assert scene.meta["source"] == item.id


def test_what_is_no_scene_is_rejected_with_its_reason(folder):
    (folder / "broken.json").write_text("{")
    (folder / "fake.h5").write_bytes(b"nothing")
    (folder / "train" / "mesh.obj").unlink()
    stage, config = ImportScene(), ImportConfig(path=str(folder), max_triangles=7)
    worker = stage.open(config, {}, {})
    reasons = {}
    for item in stage.items(config, {}):
        with pytest.raises(Reject) as caught:
            list(stage.process(worker, Item(item.id, item.group)))
        reasons[item.id] = caught.value.reason
    assert reasons == {
        "broken.json": "unreadable", "fake.h5": "unreadable", "train/one.json": "unreadable", "loose.json": "over_budget",
        "sub/train/deep.json": "over_budget", "validation/two.json": "over_budget",
    }  # fmt: skip
    assert set(reasons.values()) == set(stage.reasons)
    for path, message in ((None, "scene.path=DIR"), (str(folder / "no"), "is not a folder"), (str(folder / "sub"), None)):
        if message:
            with pytest.raises(UserError, match=message):
                list(stage.items(ImportConfig(path=path), {}))


def test_the_key_is_that_of_the_content(folder, tmp_path):
    """Neither the folder's name nor other files matter; a mesh that a scene names does."""

    def keys(path) -> dict[str, str]:
        run, system, sections = split_config(compose(["stage=render", "scene=imported", f"scene.path={path}"]))
        assert run.system == "renderformer"
        return {name: planned.key for name, planned in make_plan(run, system, sections, hash_file).items()}

    before = keys(folder)
    assert list(before) == ["scene", "render"]  # nothing is collected
    shutil.copytree(folder, tmp_path / "copy")
    (tmp_path / "copy" / "readme.txt").write_text("hello")
    assert keys(tmp_path / "copy") == before
    (tmp_path / "copy" / "train" / "mesh.obj").write_text(MESH.replace("v 1 0 0", "v 2 0 0"))
    after = keys(tmp_path / "copy")
    assert after["scene"] != before["scene"] and after["render"] != before["render"]


def test_the_key_follows_every_file_that_is_opened(tmp_path):
    """The mesh and the buffers of a glTF; not the libraries and images of materials, which are the scene's own."""
    import trimesh

    mesh = trimesh.load(io.StringIO(MESH), file_type="obj")
    for name, data in mesh.export(file_type="gltf").items():
        (tmp_path / name.replace("model", "solid")).write_bytes(data)
    tree = json.loads((tmp_path / "solid.gltf").read_bytes())
    (tmp_path / tree["buffers"][0]["uri"]).rename(tmp_path / "solid.bin")
    tree["buffers"] = [{"uri": "solid.bin", "byteLength": (tmp_path / "solid.bin").stat().st_size}]
    tree["bufferViews"] = [view | {"buffer": 0} for view in tree["bufferViews"]]
    tree["images"] = [{"uri": "/maps/a.png"}, {"uri": "data:image/png;base64,AA=="}, {"uri": "missing.png"}]
    (tmp_path / "solid.gltf").write_text(json.dumps(tree))
    (tmp_path / "solid.obj").write_text("mtllib colours.mtl\n" + MESH)
    (tmp_path / "colours.mtl").write_text("newmtl a\nKd 1 0 0\n")
    (tmp_path / "solid.ply").write_bytes(mesh.export(file_type="ply"))
    beside = {"solid.gltf": ["solid.bin"], "solid.obj": [], "solid.ply": []}
    (tmp_path / "unrelated.bin").write_bytes(b"1")
    stage, config = ImportScene(), ImportConfig(path=str(tmp_path))

    def identity() -> dict:
        return stage.identity(config, lambda path: hashlib.sha256(path.read_bytes()).hexdigest())

    for mesh_name, files in beside.items():
        (tmp_path / "one.json").write_text(scene_json().replace("mesh.obj", mesh_name))
        load_scene(tmp_path / "one.json")  # the mesh is one that can be read
        for file in (mesh_name, *files):
            before, content = identity(), (tmp_path / file).read_bytes()
            (tmp_path / file).write_bytes(content + b" ")
            assert identity() != before, file
            (tmp_path / file).write_bytes(content)
            assert identity() == before
        before = identity()
        (tmp_path / "unrelated.bin").write_bytes(b"2" if mesh_name == "solid.obj" else b"3")
        assert identity() == before


def test_imported_scenes_are_rendered_and_sharded_like_any_other(folder, tmp_path):
    """One of them is textured, and stays so."""
    from stages.renderformer.dataset import BatchConfig, Batches, ShardDataset
    from stages.renderformer.dataset.interchange import write_hdf5

    painted = with_textures(load_scene(folder / "train" / "one.json"), 2)
    write_hdf5(folder / "train" / "painted.h5", painted)
    words = ["stage=shard", "scene=imported", f"scene.path={folder}", "render.resolution=16", "render.max_spp=16"]
    words += ["render.backend=scalar", f"store={tmp_path}/store", "workers=0"]
    shard = run_pipeline(compose(words), words, out=lambda line: None)["artifacts"]["shard"]
    assert shard.groups() == ["test", "train", "validation"]
    dataset = ShardDataset(shard, "train")
    for sample in (dataset[0], dataset[1]):
        assert len(sample.scene.triangles) == 8 and sample.views[0].image.shape == (16, 16, 3) and sample.views[0].image.any()
    textured = [sample for sample in (dataset[0], dataset[1]) if sample.scene.textured]
    assert [sample.scene.meta["scene_name"] for sample in textured] == ["painted"]
    batch = Batches(dataset, BatchConfig(batch_scenes=2, views_per_scene=1))(0)
    rows = np.sort(painted.patch_index[painted.patch_index >= 0])
    assert batch["patches"].shape == (2, 7, 32, 32) and sorted(batch["patch_index"][batch["patch_index"] >= 0]) == [0, 1]
    assert {p.tobytes() for p in batch["patches"]} == {p.tobytes() for p in painted.patches[rows]}
    assert '"name": "imported"' in shard.file("README.md").read_text()


def test_a_given_checkpoint_is_measured_on_imported_scenes(folder, tmp_path, shared_data):
    """No training scene, no training: evaluate takes somebody's model and somebody's scenes."""
    shutil.rmtree(folder / "train")
    shutil.rmtree(folder / "validation")
    words = ["stage=evaluate", "scene=imported", f"scene.path={folder}", "render.resolution=64", "render.max_spp=1"]
    words += ["train=given", f"train.checkpoint={shared_data}/parity/no-dpt", "render.backend=scalar", f"store={tmp_path}/s"]
    artifacts = run_pipeline(compose([*words, "workers=0"]), words, out=lambda line: None)["artifacts"]
    assert artifacts["train"].path.name.startswith("given-") and len(artifacts["evaluate"].rows()) == 2
    given = (shared_data / "parity" / "no-dpt" / "model.safetensors").read_bytes()
    assert artifacts["train"].file("checkpoint/model.safetensors").read_bytes() == given
    with pytest.raises(UserError, match="holds no config.json"):
        run_pipeline(compose([*words[:-3], f"train.checkpoint={tmp_path}", words[-1]]), words, out=lambda line: None)


def test_the_commands_say_what_they_did(folder, tmp_path, capsys):
    assert main(["import", str(folder), f"store={tmp_path}/store", "workers=0"]) == 0
    assert "scene/imported-" in (out := capsys.readouterr().out) and "4 records" in out
    assert main(["import", str(folder / "missing"), f"store={tmp_path}/store"]) == 2
    assert "is not a folder" in capsys.readouterr().err
    assert main(["export", "scene", str(tmp_path / "out"), "--store", f"{tmp_path}/store"]) == 2
    assert "give one of stage shard" in capsys.readouterr().err
