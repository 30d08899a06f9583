"""Shards: images copied byte for byte, compact arrays, an index of seeks, no object in two splits, a card, plain webdataset."""

from __future__ import annotations

import io
import json
import re
import zlib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.errors import UserError
from stages.graphics.arrays import unpack_json
from stages.renderformer.dataset.encoding import MAX_ERROR, decode_scene, encode_scene
from stages.renderformer.records import SceneRecord
from stages.renderformer.s05_shard import Shard, ShardConfig
from stages.renderformer.views import LAYERS
from tests.renderformer.fakes import commit_shards, dataset_inputs, sharded


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return sharded(tmp_path_factory.mktemp("shard"))


def scenes(inputs) -> list[SceneRecord]:
    return [SceneRecord.from_record(inputs["scene"].read(row.id)) for row in inputs["scene"].rows()]


def test_sample_holds_images_unchanged_and_both_metas(dataset):
    inputs, artifact = dataset
    for row in artifact.rows():
        members, scene, render = artifact.read(row.id).members, inputs["scene"].read(row.id), inputs["render"].read(row.id)
        meta = unpack_json(members["meta.json"])
        assert meta["views"] == [0, 2, 3] and meta["template"] == unpack_json(scene.members["meta.json"])["template"]
        assert meta["render"] == unpack_json(render.members["meta.json"]) and meta["resolution"] == 12
        for index in meta["views"]:
            for name in (f"view{index}.exr", f"view{index}.aov.exr"):
                assert members[name] == render.members[name]
        assert meta["crc32"] == {name: zlib.crc32(data) for name, data in members.items() if name != "meta.json"}


def test_items_need_their_two_records(dataset):
    inputs, _ = dataset
    items = list(Shard().items(ShardConfig(), inputs))
    assert [item.id for item in items] == [row.id for row in inputs["render"].rows()]
    assert items[0].needs == (("scene", items[0].id), ("render", items[0].id)) and items[0].group == "test"


def test_shards_come_near_their_size_in_powers_of_two():
    def size(shard_mb: float, *megabytes: float) -> int:
        rows = [SimpleNamespace(members={"a": (0, int(mb * 5e5)), "b": (9, int(mb * 5e5))}) for mb in megabytes]
        return Shard().part_size(ShardConfig(shard_mb=shard_mb), {"render": SimpleNamespace(rows=lambda: rows)})

    assert size(256, 4, 4) == 64 and size(256, 3.7, 4.1, 4.9) == 64  # a slightly other mean keeps the shards
    assert size(256, 0.25) == 1024 and size(256, 9) == 32
    assert size(1, 400) == 1 and size(256) >= 1


# --- compact arrays ---------------------------------------------------------------------------------------------------


def test_arrays_come_back_within_what_is_stated(dataset):
    inputs, artifact = dataset
    before = after = 0
    for scene in scenes(inputs):
        members = artifact.read(scene.id).members
        back = decode_scene(scene.id, members["scene.npz"], members["meta.json"])
        for name, dtype in SceneRecord.DTYPES.items():
            assert getattr(back, name).dtype == dtype and getattr(back, name).shape == getattr(scene, name).shape, name
        step = np.load(io.BytesIO(members["scene.npz"]))["scale"]
        assert np.abs(back.triangles - scene.triangles).max() <= 0.501 * step <= MAX_ERROR
        assert np.abs(back.vertex_normals - scene.vertex_normals).max() < 3e-5
        for name in ("diffuse", "specular", "roughness"):
            assert np.abs(getattr(back, name) - getattr(scene, name)).max() < 2.5e-4
        for name in ("emission", "light_index", "object_index", "camera_to_world", "fov_deg"):
            assert np.array_equal(getattr(back, name), getattr(scene, name)), name
        assert back.textured == scene.textured
        if scene.textured:
            for name in SceneRecord.PATCH_DTYPES:
                assert np.array_equal(getattr(back, name), getattr(scene, name)), name
                assert getattr(back, name).dtype == getattr(scene, name).dtype, name
        else:
            assert not {"patch_index", "patches"} & set(np.load(io.BytesIO(members["scene.npz"])))
            before, after = before + len(inputs["scene"].read(scene.id).members["scene.npz"]), after + len(members["scene.npz"])
    assert 0 < after < before / 5


def test_corners_that_were_one_stay_one(dataset):
    """Watertight meshes stay watertight: equal corners are equal afterwards, whatever triangle they belong to."""
    for scene in scenes(dataset[0])[:3]:
        back = decode_scene(scene.id, encode_scene(scene), b"{}")
        before = np.unique(scene.triangles.reshape(-1, 3), axis=0, return_inverse=True)[1].reshape(-1)
        after = np.unique(back.triangles.reshape(-1, 3), axis=0, return_inverse=True)[1].reshape(-1)
        assert len({*zip(before.tolist(), after.tolist(), strict=True)}) == before.max() + 1


def test_large_scenes_and_odd_values_keep_their_precision():
    rng = np.random.default_rng(0)
    scene = SceneRecord(
        "odd", rng.normal(size=(70000, 3, 3)) * 50, np.tile([0, 0, 1.0], (70000, 3, 1)), rng.uniform(size=(70000, 3)),
        np.zeros((70000, 3)), np.full(70000, 0.01), np.zeros((70000, 3)), np.full(70000, -1), np.arange(70000) % 300,
        np.eye(4)[None], np.array([45.0]), {},
    )  # fmt: skip
    scene.light_index[5:7], scene.emission[5], scene.emission[6] = 0, [1e6, 2, 3], [1, 0, 0]
    back = decode_scene("odd", encode_scene(scene), b"{}")
    assert np.array_equal(back.triangles, scene.triangles.astype(np.float32))  # a 16-bit grid would be too coarse
    assert np.array_equal(back.emission, scene.emission.astype(np.float32))
    assert np.array_equal(back.object_index, scene.object_index) and np.array_equal(back.light_index, scene.light_index)


def test_same_scene_same_bytes_and_damage_is_an_error(dataset):
    scene = scenes(dataset[0])[0]
    data = encode_scene(scene)
    assert data == encode_scene(scene)
    for broken in (b"", b"nonsense", data[: len(data) // 2], data.replace(b"faces.npy", b"fices.npy")):
        with pytest.raises(UserError, match=scene.id):
            decode_scene(scene.id, broken, b"{}")
    with pytest.raises(UserError, match=scene.id):
        decode_scene(scene.id, data, b"{")


def test_textures_keep_every_texel_and_fit_their_triangles(dataset):
    scene, rng = scenes(dataset[0])[0], np.random.default_rng(0)
    index = np.full(len(scene.triangles), -1, np.int32)
    index[[3, 9]] = [1, 0]
    patches = rng.uniform(size=(2, 7, 32, 32)).astype(np.float16)
    textured = replace(scene, patch_index=index, patches=patches)
    back = decode_scene("x", encode_scene(textured), b"{}")
    assert np.array_equal(back.patches, patches) and np.array_equal(back.patch_index, index)
    assert not scene.textured and decode_scene("x", encode_scene(scene), b"{}").patches is None
    assert encode_scene(replace(textured, patch_index=np.full_like(index, -1))) == encode_scene(scene)  # nothing reads them
    for wrong in ({"patch_index": index * 2}, {"patch_index": index[:-1]}, {"patches": patches[:, :, :16]}):
        with pytest.raises(UserError, match="scene x .*patches"):
            decode_scene("x", encode_scene(replace(textured, **wrong)), b"{}")


# --- index and card ---------------------------------------------------------------------------------------------------


def test_index_leads_to_every_member(dataset):
    _, artifact = dataset
    shards = json.loads(artifact.file("shards.json").read_text())
    assert [part["samples"] for part in shards["train"]["parts"]] == [4, 2] and shards["train"]["samples"] == 6
    lines = [json.loads(line) for line in artifact.file("index.jsonl").read_text().splitlines()]
    assert [line["id"] for line in lines] == artifact.ids()
    for line in lines:
        data = (artifact.path / line["shard"]).read_bytes()
        members = artifact.read(line["id"]).members
        assert set(line["members"]) == set(members) and line["views"] == [0, 2, 3] and line["triangles"] > 100
        for name, (offset, size, crc) in line["members"].items():
            assert data[offset : offset + size] == members[name] and zlib.crc32(members[name]) == crc
    assert all(part["bytes"] == (artifact.path / part["path"]).stat().st_size for s in shards.values() for part in s["parts"])


def test_card_tells_what_is_there_and_its_reader_works(dataset):
    """Ten lines of numpy, copied out of the card, give the arrays that the loader gives."""
    _, artifact = dataset
    card, page = artifact.file("README.md").read_text(), artifact.file("card.html").read_text()
    assert "| train | 6 | 18 |" in card and "| CC0 | files |" in card and artifact.key in card
    assert (
        "of 8 views rendered twice" in card and "0.0200 in the mean" in card and "31.0 dB" in card and "0.0300 in the" in card
    )
    assert "https://example.org/train-blob" in card and '"shard_mb": 256' in card
    assert page.count("data:image/png;base64,") == 1 and page.count("<svg") == 1  # contact sheet, distributions
    assert not re.search(r'(src|href)="(?!data:|#)', page)  # one file, nothing to fetch
    assert "<script" not in page and "http" not in page.split("<h2")[0]
    for name in artifact.read(artifact.ids()[0]).members:
        assert re.sub(r"\d", r"\\<i>", name) in card
    snippet = next(block for block in re.findall(r"```\n(.*?)```", card, re.S) if "def read_scene" in block)
    space: dict = {}
    exec(snippet, space)
    assert len(snippet.strip().splitlines()) <= 14
    for id in artifact.ids():
        members = artifact.read(id).members
        read, scene = space["read_scene"](members["scene.npz"]), decode_scene(id, members["scene.npz"], members["meta.json"])
        for name in SceneRecord.DTYPES | (SceneRecord.PATCH_DTYPES if scene.textured else {}):
            assert np.array_equal(read[name], getattr(scene, name)), name


def test_card_documents_every_array(dataset):
    _, artifact = dataset
    card = artifact.file("README.md").read_text()
    named = {word for row in re.findall(r"\| scene.npz \| ([^|]+) \|", card) for word in row.strip().split(", ")}
    members = [artifact.read(id).members["scene.npz"] for id in artifact.ids("train")[:2]]
    textured, plain = (set(np.load(io.BytesIO(data)).files) for data in members)
    assert textured == named and named - plain == {"patch_index", "patches"}
    layers = {word for row in re.findall(r"\| view\\<i>.aov.exr \| ([^|]+) \|", card) for word in row.strip().split(", ")}
    assert {word.partition(".")[0] for word in layers} == LAYERS.keys()


def test_object_in_two_splits_is_refused(tmp_path):
    inputs = dataset_inputs(tmp_path)
    for row in inputs["scene"].rows():  # the same object everywhere
        record = inputs["scene"].read(row.id)
        meta = unpack_json(record.members["meta.json"])
        meta["objects"].append({"kind": "object", "name": "leak", "object_id": "leak", "faces": 0})
        record.members["meta.json"] = json.dumps(meta).encode()
    with pytest.raises(UserError, match="object leak is in the splits test and train"):
        commit_shards(tmp_path / "store", inputs, Shard(), ShardConfig(), 4)


@pytest.mark.parametrize("opener", ["{}", "pipe:cat {}", "file:{}"])
def test_plain_webdataset_reads_the_shards(dataset, opener):
    webdataset = pytest.importorskip("webdataset")
    from stages.renderformer.dataset import decode_members, decode_sample

    _, artifact = dataset
    parts = json.loads(artifact.file("shards.json").read_text())["train"]["parts"]
    urls = [opener.format(artifact.path / part["path"]) for part in parts]
    samples = list(webdataset.WebDataset(urls, shardshuffle=False))
    assert [sample["__key__"] for sample in samples] == artifact.ids("train")
    sample = decode_members(samples[0]["__key__"], samples[0])
    same = decode_sample(artifact.read(samples[0]["__key__"]))
    assert np.array_equal(sample.scene.triangles, same.scene.triangles)
    assert np.array_equal(sample.views[2].lights, same.views[2].lights) and list(sample.views) == [0, 2, 3]
