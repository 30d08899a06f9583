"""Shards: images copied byte for byte, an index, no object in two splits, and plain webdataset reads the tars."""

from __future__ import annotations

import json

import numpy as np
import pytest
from fakes import FakeArtifact, sharded

from pipeline.errors import UserError
from stages.arrays import unpack_arrays, unpack_json
from stages.s05_shard import Shard, ShardConfig


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return sharded(tmp_path_factory.mktemp("shard"))


def test_sample_holds_scene_and_images_unchanged(made):
    inputs, draft = made
    for row in draft.rows():
        members, scene, render = draft.read(row.id).members, inputs["scene"].read(row.id), inputs["render"].read(row.id)
        meta = unpack_json(members["meta.json"])
        assert members["scene.npz"] == scene.members["scene.npz"]
        assert meta["views"] == [0, 2, 3] and meta["template"] == unpack_json(scene.members["meta.json"])["template"]
        assert meta["render"] == unpack_json(render.members["meta.json"])
        for index in meta["views"]:
            assert members[f"view{index}.exr"] == render.members[f"view{index}.exr"]


def test_items_need_their_two_records(made):
    inputs, draft = made
    items = list(Shard().items(ShardConfig(), inputs))
    assert [item.id for item in items] == [row.id for row in inputs["render"].rows()]
    assert items[0].needs == (("scene", items[0].id), ("render", items[0].id)) and items[0].group == "test"


def test_index_and_card(made):
    _, draft = made
    shards, index = (json.loads(draft.file(name).read_text()) for name in ("shards.json", "index.json"))
    assert shards["train"]["samples"] == 6 and shards["train"]["parts"] == ["parts/train.tar"]
    assert shards["train"]["bytes"] == (draft.path / "parts/train.tar").stat().st_size
    assert all(entry["triangles"] > 100 and entry["views"] == [0, 2, 3] for entry in index.values())
    card = draft.file("README.md").read_text()
    assert "| train | 6 | 18 |" in card and "CC0" in card and "camera_to_world" in card


def test_object_in_two_splits_is_refused(made, tmp_path):
    _, draft = made
    Shard().check(draft)
    leaky = FakeArtifact(tmp_path, [])
    leaky.file("objects.json").write_text(json.dumps({"train": {"a": {}, "b": {}}, "test": {"b": {}}}))
    with pytest.raises(UserError, match="object b"):
        Shard().check(leaky)


def test_plain_webdataset_reads_the_parts(made):
    webdataset = pytest.importorskip("webdataset")
    _, draft = made
    samples = list(webdataset.WebDataset(str(draft.path / "parts/train.tar"), shardshuffle=False))
    assert [sample["__key__"] for sample in samples] == draft.ids("train")
    assert np.array_equal(
        unpack_arrays(samples[0]["scene.npz"])["triangles"],
        unpack_arrays(draft.read(samples[0]["__key__"]).members["scene.npz"])["triangles"],
    )
    assert unpack_json(samples[0]["meta.json"])["views"] == [0, 2, 3] and "view2.exr" in samples[0]
