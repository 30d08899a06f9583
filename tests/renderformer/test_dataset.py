"""The loader: batches are pure functions of the step, for any ranks and workers, after a resume, and beside damage."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import zlib

import numpy as np
import pytest

from pipeline.errors import UserError
from stages.renderformer.dataset import (
    BatchConfig,
    Batches,
    DamagedSample,
    DamagedShard,
    Needs,
    Relight,
    ShardDataset,
    collate,
    draw_light_factors,
    evaluation_samples,
    expose,
    make_example,
    mirror,
    move,
    prefetch,
    rotation_from_vector,
)
from tests.renderformer.fakes import sharded

PLAIN = BatchConfig(views_per_scene=2, rotate=False, translate_sigma=0.0, relight=False)
EVERYTHING = BatchConfig(
    mirror=True, relight=True, lighting=Relight(share=0.8, keep=0.5, saturation=1.0), exposure_stops=1.0, bucket=2,
    rotate=True, translate_sigma=0.25, views_per_scene=2,
)  # fmt: skip


@pytest.fixture(scope="module")
def artifact(tmp_path_factory):
    return sharded(tmp_path_factory.mktemp("dataset"))[1]


@pytest.fixture(scope="module")
def dataset(artifact):
    return ShardDataset(artifact, "train")


def same(a: dict, b: dict) -> bool:
    return a.keys() == b.keys() and all(
        np.array_equal(a[name], b[name]) if isinstance(a[name], np.ndarray) else a[name] == b[name] for name in a
    )


def project(example: dict, points: np.ndarray) -> np.ndarray:
    """(V, N, 2) image-plane positions of (N, 3) points."""
    inverse = np.linalg.inv(example["camera_to_world"].astype(np.float64))
    camera = np.einsum("vij,nj->vni", inverse[:, :3, :3], points) + inverse[:, None, :3, 3]
    focal = 1 / np.tan(np.radians(example["fov_deg"].astype(np.float64)) / 2)
    return focal[:, None, None] * camera[..., :2] / -camera[..., 2:]


def test_without_augmentation_the_stored_arrays(artifact, dataset):
    batch = Batches(dataset, PLAIN, needs=Needs(layers=("direct",)))(0)
    assert batch["image"].shape == (4, 2, 12, 12, 3) and len(batch["ids"]) == 4
    assert batch["mask"].shape[1] == batch["mask"].sum(axis=1).max()
    for i, id in enumerate(batch["ids"]):
        sample = dataset[dataset.ids.index(id)]
        n = len(sample.scene.triangles)
        assert batch["mask"][i].sum() == n and batch["mask"][i, :n].all()
        for name in ("triangles", "vertex_normals", "diffuse", "specular", "roughness", "emission"):
            assert np.array_equal(batch[name][i, :n], getattr(sample.scene, name)) and not batch[name][i, n:].any()
            assert batch[name].dtype == np.float32
        index = batch["patch_index"][i, :n]
        assert (batch["patch_index"][i, n:] == -1).all() and (index >= 0).any() == sample.scene.textured
        if sample.scene.textured:
            rows = index >= 0
            assert np.array_equal(batch["patches"][index[rows]], sample.scene.patches[sample.scene.patch_index[rows]])
        assert set(batch["views"][i]) <= {0, 2, 3} and len(set(batch["views"][i])) == 2
        for v, view in enumerate(batch["views"][i]):
            assert np.array_equal(batch["camera_to_world"][i, v], sample.scene.camera_to_world[view])
            assert np.array_equal(batch["image"][i, v], sample.views[int(view)].image)
            assert np.array_equal(batch["direct"][i, v], sample.views[int(view)].direct)


def test_batches_are_functions_of_the_step(artifact, dataset):
    config = EVERYTHING
    forward = [Batches(dataset, config)(step) for step in range(5)]
    fresh = Batches(ShardDataset(artifact, "train", cache_mb=0), config)  # no cache, other order of access
    assert all(same(fresh(step), forward[step]) for step in (4, 1, 3))
    assert all(same(a, b) for a, b in zip(prefetch(Batches(dataset, config), 1, 5), forward[1:], strict=True))
    assert not same(Batches(dataset, config.model_copy(update={"seed": 1}))(0), forward[0])


def test_epochs_visit_every_scene_once_and_ranks_share_the_batch(dataset):
    batches = Batches(dataset, PLAIN)
    sequence = [id for step in range(6) for id in batches(step)["ids"]]
    for epoch in range(4):
        assert sorted(sequence[epoch * 6 : epoch * 6 + 6]) == sorted(dataset.ids)
    assert sequence[:6] != sequence[6:12]
    parts = [Batches(dataset, PLAIN, rank, 2)(1)["ids"] for rank in (0, 1)]
    assert parts[0] + parts[1] == batches(1)["ids"]
    with pytest.raises(UserError, match="multiple of 3"):
        Batches(dataset, PLAIN, 0, 3)


def test_augmentation_differs_between_epochs(dataset):
    batches = Batches(dataset, BatchConfig(batch_scenes=6))
    cameras = [dict(zip(b["ids"], b["camera_to_world"], strict=True)) for b in (batches(0), batches(1))]
    assert all(not np.allclose(cameras[0][id], cameras[1][id]) for id in dataset.ids)


def test_motion_changes_nothing_that_a_camera_sees(dataset):
    sample = dataset[0]
    example = make_example(sample, np.array([0, 2]), None)
    rotation = rotation_from_vector(np.array([0.3, -1.2, 2.0]))
    assert np.allclose(rotation @ rotation.T, np.eye(3)) and np.linalg.det(rotation) == pytest.approx(1)
    assert np.allclose(rotation @ [0.3, -1.2, 2.0], [0.3, -1.2, 2.0])
    assert np.allclose(rotation_from_vector(np.array([0, 0, np.pi / 2])) @ [1, 0, 0], [0, 1, 0])
    moved = move(example, rotation, np.array([0.1, -0.4, 0.2]))
    before, after = (project(e, e["triangles"].reshape(-1, 3)) for e in (example, moved))
    near = np.abs(before) < 2  # points beside or behind the camera have no stable projection
    assert np.abs(before - after)[near].max() < 1e-4
    for e in (example, moved):  # normals stay with their triangles
        a, b, c = e["triangles"].transpose(1, 0, 2)
        e["cos"] = np.einsum("fcx,fx->fc", e["vertex_normals"], np.cross(b - a, c - a))
    assert np.allclose(example["cos"], moved["cos"], atol=1e-5)
    assert np.array_equal(example["image"], moved["image"])


def test_mirror_flips_the_image(dataset):
    example = make_example(dataset[0], np.array([0, 3]), None)
    flipped = mirror(example)
    before = project(example, example["triangles"].reshape(-1, 3))
    after = project(flipped, flipped["triangles"][:, [0, 2, 1]].reshape(-1, 3))
    near = (np.abs(before) < 2).all(axis=2)
    assert np.allclose(after[near], before[near] * [-1, 1], atol=1e-4)
    assert np.array_equal(flipped["image"], example["image"][:, :, ::-1])
    assert np.allclose(np.linalg.det(flipped["camera_to_world"][:, :3, :3]), 1, atol=1e-5)
    for e in (example, flipped):  # corners still run counter-clockwise around the normal
        a, b, c = e["triangles"].transpose(1, 0, 2)
        e["side"] = np.einsum("fx,fx->f", np.cross(b - a, c - a), e["vertex_normals"].sum(axis=1))
    assert np.allclose(example["side"], flipped["side"], atol=1e-5)
    assert same({**mirror(flipped), "side": 0}, {**example, "side": 0})


def test_exposure_scales_all_radiance(dataset):
    example = make_example(dataset[0], np.array([0, 3]), None, ("direct", "albedo"))
    exposed = expose(example, 2.0)
    for name in ("image", "direct", "emission"):
        assert np.array_equal(exposed[name], 2 * example[name]) and example[name].any()
    assert np.array_equal(exposed["albedo"], example["albedo"])


def test_textures_travel_with_their_triangles():
    """Rows of patches are per batch; mirroring exchanges corners 1 and 2, along which texels run."""

    def example(n: int, textured: int) -> dict:
        arrays = {"id": "x", "mask": np.ones(n, bool), "triangles": np.zeros((n, 3, 3)), "vertex_normals": np.zeros((n, 3, 3))}
        arrays |= {"camera_to_world": np.eye(4)[None]}
        if textured:
            index = np.where(np.arange(n) < textured, np.arange(n), -1).astype(np.int32)
            arrays |= {
                "patch_index": index,
                "patches": np.random.default_rng(n).random((textured, 7, 32, 32)).astype(np.float16),
            }
        return arrays

    batch = collate([example(3, 2), example(5, 0), example(4, 3)], 3)
    assert batch["patch_index"].tolist() == [[0, 1, -1, -1, -1], [-1] * 5, [2, 3, 4, -1, -1]]
    assert batch["patches"].shape == (5, 7, 32, 32) and batch["patches"].dtype == np.float16
    assert "patches" not in collate([example(2, 0)], 1)
    assert np.array_equal(mirror(example(3, 2))["patches"], example(3, 2)["patches"].transpose(0, 1, 3, 2))


def test_relit_image_is_the_weighted_sum_and_emission_follows(dataset):
    sample = next(s for s in (dataset[i] for i in range(len(dataset))) if s.scene.n_lights > 1)
    factors = np.random.default_rng(0).uniform(0, 2, (sample.scene.n_lights, 3))
    example = make_example(sample, np.array([2]), factors)
    expected = sum(light * factor for light, factor in zip(sample.views[2].lights, factors, strict=True))
    assert np.allclose(example["image"][0], expected, rtol=1e-5) and "direct" not in example
    lit = sample.scene.light_index >= 0
    assert np.allclose(example["emission"][lit], sample.scene.emission[lit] * factors[sample.scene.light_index[lit]])
    assert not example["emission"][~lit].any() and sample.scene.emission[lit].min() > 100  # the cached sample is untouched


def test_light_factors_stay_in_their_ranges():
    rng = np.random.default_rng(0)
    drawn = np.concatenate([draw_light_factors(Relight(keep=0.5), rng, 5) for _ in range(500)])
    on = drawn[:, 0] > 0
    assert 0.5 < on.mean() < 0.7 and drawn[on].min() >= 0.5 and drawn.max() <= 2
    assert np.allclose(drawn, drawn[:, :1])
    assert all(draw_light_factors(Relight(keep=0.01), rng, 3).any() for _ in range(50))
    assert sum(draw_light_factors(Relight(share=0.5), rng, 3) is None for _ in range(200)) in range(60, 140)


def test_evaluation_reads_all_views_as_stored(artifact):
    samples = list(evaluation_samples(ShardDataset(artifact, "test")))
    assert [batch["ids"][0] for batch in samples] == artifact.ids("test")
    assert all(batch["views"].tolist() == [[0, 2, 3]] and batch["mask"].all() for batch in samples)


def test_cache_is_bounded_and_oversized_scenes_are_left_out(artifact):
    dataset = ShardDataset(artifact, "train", cache_mb=0.2)
    for index in (0, 1, 2, 3, 0, 5):
        assert dataset[index].scene.id == dataset.ids[index]
        assert sum(size for _, size in dataset._cache.values()) == dataset._used <= 0.2e6
    assert dataset._used > 0.1e6
    assert [len(dataset[index].scene.triangles) for index in range(len(dataset))] == dataset.triangles.tolist()
    sizes = sorted(dataset.triangles)
    few = ShardDataset(artifact, "train", max_triangles=sizes[2])
    assert few.dropped == sum(size > sizes[2] for size in sizes) > 0 and len(few) + few.dropped == 6
    with pytest.raises(UserError, match="no validation scenes: its splits are test, train"):
        ShardDataset(artifact, "validation")
    with pytest.raises(UserError, match="is not a dataset"):
        ShardDataset(artifact.path / "parts", "train")
    assert few.resolution == 12


def test_only_what_is_wanted_is_decoded(artifact, monkeypatch):
    from stages.renderformer.dataset import shards

    decoded = []
    for name in ("decode_lights", "decode_layers"):
        real = getattr(shards, name)
        monkeypatch.setattr(
            shards, name, lambda data, where, *a, n=name, f=real: decoded.append((n, where)) or f(data, where, *a)
        )
    dataset = ShardDataset(artifact, "train", cache_mb=0)
    sample = dataset.read(1, [2])
    assert list(sample.views) == [2] and sample.views[2].normal is None
    assert decoded == [("decode_lights", f"view2.exr of {dataset.ids[1]}")]
    assert dataset.read(1, [2], ["normal"]).views[2].normal.shape == (12, 12, 3)


def test_layers_that_are_not_there_are_named(dataset):
    with pytest.raises(UserError, match="layers albdo are unknown: choose from direct, albedo"):
        Batches(dataset, PLAIN, needs=Needs(layers=("albdo",)))
    with pytest.raises(UserError, match=r"read them with layers=\['triangle'\]"):
        make_example(dataset.read(0, [2]), np.array([2]), None, ("triangle",))
    assert "image" not in Batches(dataset, BatchConfig(views_per_scene=0))(0)


# --- order, ranks, workers, resume ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def many(tmp_path_factory):
    """13 scenes: no multiple of any batch."""
    return ShardDataset(sharded(tmp_path_factory.mktemp("many"), train=13, test=1, size=8)[1], "train")


@pytest.mark.parametrize(("bucket", "shuffle_shards"), [(0, 0), (1, 0), (3, 0), (0, 2), (3, 2)])
def test_every_epoch_visits_every_scene_once_whatever_the_buckets(many, bucket, shuffle_shards):
    batches = Batches(many, BatchConfig(batch_scenes=4, bucket=bucket, shuffle_shards=shuffle_shards))
    sequence = [id for step in range(13) for id in batches(step)["ids"]]
    for epoch in range(4):
        assert sorted(sequence[epoch * 13 : epoch * 13 + 13]) == sorted(many.ids)
    assert sequence[:13] != sequence[13:26]


def test_buckets_waste_less_and_the_stated_waste_is_that_of_the_batches(many):
    def waste_of(**fields) -> float:
        batches = Batches(many, BatchConfig(batch_scenes=4, **fields))
        waste = batches.padding_waste(0, 13)
        masks = [batches(step)["mask"] for step in range(13)]
        assert waste == pytest.approx(1 - sum(mask.sum() for mask in masks) / sum(mask.size for mask in masks))
        return waste

    assert waste_of(bucket=3) < 0.8 * waste_of()
    halves = Batches(many, BatchConfig(batch_scenes=4, bucket=3), 0, 2)
    assert halves.padding_waste(0, 13) <= Batches(many, halves.config).padding_waste(0, 13)


def test_two_ranks_with_two_workers_are_one_rank(many):
    """Every sample exactly once per epoch, in one global order, with the very same arrays."""
    config = EVERYTHING.model_copy(update={"batch_scenes": 4})
    whole = list(prefetch(Batches(many, config), 0, 13))
    ranks = [list(prefetch(Batches(many, config, rank, 2), 0, 13, ahead=3, workers=2)) for rank in (0, 1)]
    visited = [id for one, other in zip(*ranks, strict=True) for id in one["ids"] + other["ids"]]
    assert visited == [id for batch in whole for id in batch["ids"]]
    assert all(sorted(visited[e * 13 : e * 13 + 13]) == sorted(many.ids) for e in range(4))
    for batch, *parts in zip(whole, *ranks, strict=True):
        for rank, part in enumerate(parts):
            n = part["mask"].shape[1]
            rows = slice(2 * rank, 2 * rank + 2)
            assert np.array_equal(part["image"], batch["image"][rows])
            assert np.array_equal(part["triangles"], batch["triangles"][rows, :n])
            assert np.array_equal(part["camera_to_world"], batch["camera_to_world"][rows])


RUN = """
import json, sys
from stages.renderformer.dataset import BatchConfig, Batches, ShardDataset, prefetch

root, state, workers, kill = sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
config = BatchConfig(batch_scenes=4, mirror=True, bucket=2)
try:
    start = int(open(state).read())
except FileNotFoundError:
    start = 0
batches = Batches(ShardDataset(root, "train"), config)
for step, batch in enumerate(prefetch(batches, start, 12, ahead=4, workers=workers), start=start):
    print(json.dumps([batch["ids"], float(batch["image"].sum()), float(batch["triangles"].sum())]), flush=True)
    with open(state + ".tmp", "w") as file:
        file.write(str(step + 1))
    import os
    os.replace(state + ".tmp", state)
    if step + 1 == kill:
        os.kill(os.getpid(), 9)
"""


def test_killed_at_a_random_step_it_goes_on_with_the_very_next_batch(many, tmp_path):
    kill = int(np.random.default_rng().integers(1, 12))
    root = many.source.root

    def run(name: str, workers: int, kill: int) -> list[str]:
        command = [sys.executable, "-c", RUN, str(root), str(tmp_path / name), str(workers), str(kill)]
        return subprocess.run(command, capture_output=True, text=True).stdout.splitlines()

    undisturbed = run("a", 0, 99)
    assert len(undisturbed) == 12 == len(set(undisturbed))
    assert run("b", 2, kill) + run("b", 1, 99) == undisturbed, f"killed after step {kill}"


def test_going_on_with_more_ranks_is_the_same_sequence(many):
    rest = list(prefetch(Batches(many, PLAIN, 1, 2), 3, 5))
    assert [batch["ids"] for batch in rest] == [Batches(many, PLAIN)(step)["ids"][2:] for step in (3, 4)]


# --- damage -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def copy(many, tmp_path):
    """A copy of the dataset's folder that a test may damage, and the lines of its index."""
    shutil.copytree(many.source.root, tmp_path / "copy")
    lines = (tmp_path / "copy" / "files" / "index.jsonl").read_text().splitlines()
    return tmp_path / "copy", [row for row in map(json.loads, lines) if row["split"] == "train"]


def flip(root, row, name, at=0.5):
    offset, size, _ = row["members"][name]
    with open(root / row["shard"], "r+b") as file:
        file.seek(offset + int(at * size))
        byte = file.read(1)[0]
        file.seek(-1, os.SEEK_CUR)
        file.write(bytes([byte ^ 4]))


def test_a_damaged_sample_is_skipped_by_name(copy):
    root, rows = copy
    for row, name in ((rows[3], "scene.npz"), (rows[7], "view0.exr"), (rows[7], "view2.exr"), (rows[7], "view3.exr")):
        flip(root, row, name)
    bad = {rows[3]["id"], rows[7]["id"]}
    config = BatchConfig(batch_scenes=4, bucket=1)
    clean = Batches(ShardDataset(root, "train"), config)
    batches = list(prefetch(clean, 0, 7))
    assert all(len(batch["ids"]) == 4 and not bad & set(batch["ids"]) for batch in batches)  # no batch is short
    reasons = dict(pair for batch in batches for pair in batch["damaged"])
    assert set(reasons) == bad and all("CRC-32" in reason for reason in reasons.values())
    again = list(prefetch(clean, 0, 7, workers=2))
    assert all(same(a, b) for a, b in zip(batches, again, strict=True))  # damage is part of the data: still a pure function
    with pytest.raises(DamagedSample, match=rows[3]["id"]):
        ShardDataset(root, "train")[3]


def test_a_member_that_does_not_decode_counts_as_damage(copy):
    """A wrong file that was indexed as it is: its CRC is right."""
    root, rows = copy
    offset, size, _ = rows[0]["members"]["view0.exr"]
    with open(root / rows[0]["shard"], "r+b") as file:
        file.seek(offset)
        file.write(bytes(size))
    text = (root / "files" / "index.jsonl").read_text()
    (root / "files" / "index.jsonl").write_text(
        text.replace(str(rows[0]["members"]["view0.exr"][2]), str(zlib.crc32(bytes(size))))
    )
    with pytest.raises(DamagedSample, match=f"view0.exr of {rows[0]['id']} is not an OpenEXR image"):
        ShardDataset(root, "train")[0]


def test_a_damaged_shard_stops_the_run_unless_told_otherwise(copy):
    root, rows = copy
    shard = rows[-1]["shard"]
    lost = {row["id"] for row in rows if row["shard"] == shard}
    os.truncate(root / shard, rows[-1]["members"]["view3.exr"][0])
    with pytest.raises(DamagedShard, match="bytes, not .*skip_damaged_shards"):
        ShardDataset(root, "train")
    os.unlink(root / shard)
    with pytest.raises(DamagedShard, match="is missing"):
        ShardDataset(root, "train")
    batches = list(prefetch(Batches(ShardDataset(root, "train", skip_damaged_shards=True), PLAIN), 0, 7))
    assert lost and all(not lost & set(batch["ids"]) for batch in batches)
    reasons = dict(pair for batch in batches for pair in batch["damaged"])
    assert reasons and set(reasons) <= lost


def test_a_shard_that_is_cut_during_the_run_stops_it(copy):
    root, rows = copy
    dataset = ShardDataset(root, "train", cache_mb=0)
    os.truncate(root / rows[0]["shard"], 4096)
    for workers in (0, 2):
        with pytest.raises(UserError, match="has 4,096 bytes"):
            list(prefetch(Batches(dataset, PLAIN), 0, 7, workers=workers))


def test_an_index_that_lies_is_refused(copy):
    root, rows = copy
    text = (root / "files" / "index.jsonl").read_text()
    (root / "files" / "index.jsonl").write_text(text.replace(rows[0]["shard"], "../../../etc/passwd"))
    with pytest.raises(UserError, match="names a shard '../../../etc/passwd'"):
        ShardDataset(root, "train")
    (root / "files" / "index.jsonl").write_text(text[:-40])
    with pytest.raises(UserError, match="line 14 of .*index.jsonl is no line of an index"):
        ShardDataset(root, "train")
    offset = rows[0]["members"]["scene.npz"][0]
    (root / "files" / "index.jsonl").write_text(text.replace(f"[{offset},", "[999999999999,"))
    with pytest.raises(DamagedSample, match="outside its shard"):
        ShardDataset(root, "train").read(0, [0])


# --- from afar --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["file:{root}", "pipe:cat {root}/{{}}"])
def test_a_dataset_behind_a_url_is_fetched_once_and_then_local(many, tmp_path, form):
    pytest.importorskip("webdataset")
    url = form.format(root=many.source.root)
    remote = ShardDataset(url, "train", cache_folder=tmp_path)
    assert not list(tmp_path.rglob("*.tar"))
    assert all(
        same(a, b) for a, b in zip(prefetch(Batches(remote, PLAIN), 0, 4), prefetch(Batches(many, PLAIN), 0, 4), strict=True)
    )
    kept = sorted(tmp_path.rglob("*.tar"))
    assert kept and not list(tmp_path.rglob(".*"))
    before = [path.stat().st_mtime_ns for path in kept]
    assert len(list(prefetch(Batches(ShardDataset(url, "train", cache_folder=tmp_path), PLAIN), 0, 4, workers=2))) == 4
    assert [path.stat().st_mtime_ns for path in kept] == before


def test_few_shards_are_in_use_at_a_time(many, tmp_path):
    """A split that does not fit the local disk: shards come and go, and every scene is still visited once."""
    pytest.importorskip("webdataset")
    config = BatchConfig(batch_scenes=4, shuffle_shards=1, bucket=1)
    batches = Batches(many, config)
    for epoch in range(3):
        order = batches.order(epoch)
        assert sorted(order) == list(range(13))
        assert sum(np.diff(many.shard_of[order]) != 0) <= 3 + 2 * 4  # four shards, mixed where a batch spans two
    assert many.shard_of.tolist() == [0] * 4 + [1] * 4 + [2] * 4 + [3]
    largest = max(many._sizes.values())
    remote = ShardDataset(f"file:{many.source.root}", "train", cache_mb=0, cache_folder=tmp_path, cache_gb=2.5 * largest / 1e9)
    for step in range(7):
        assert same(Batches(remote, config)(step), batches(step))
        assert sum(path.stat().st_size for path in tmp_path.rglob("*.tar")) <= 2.5 * largest


def test_what_arrives_damaged_is_refused(copy, tmp_path):
    pytest.importorskip("webdataset")
    root, rows = copy
    flip(root, rows[0], "scene.npz")
    remote = ShardDataset(f"file:{root}", "train", cache_folder=tmp_path)
    with pytest.raises(DamagedShard, match="does not hash to its name"):
        remote[0]
    with pytest.raises(UserError, match="cannot be read"):
        ShardDataset(f"file:{tmp_path}/nowhere", "train", cache_folder=tmp_path)


def test_an_error_in_a_thread_reaches_the_caller():
    def broken(step):
        raise UserError("damaged")

    with pytest.raises(UserError, match="damaged"):
        list(prefetch(broken, 0, 3))
    assert list(prefetch(lambda step: {"step": step}, 3, 3)) == []
    endless = prefetch(lambda step: {"step": step}, 3, None)
    assert [next(endless)["step"] for _ in range(5)] == [3, 4, 5, 6, 7]


def test_no_torch_here():
    modules = "stages.renderformer.dataset, stages.renderformer.s05_shard"
    code = f"import sys, {modules}; sys.exit(bool({{'torch', 'mitsuba', 'trimesh'}} & {{*sys.modules}}))"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
