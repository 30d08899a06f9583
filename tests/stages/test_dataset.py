"""The loader: batches are pure functions of the step, and every augmentation is exact."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from fakes import sharded

from pipeline.errors import UserError
from stages.dataset import (
    BatchConfig,
    Batches,
    Relight,
    ShardDataset,
    draw_light_factors,
    evaluation_samples,
    make_example,
    mirror,
    move,
    prefetch,
    rotation_from_vector,
)

PLAIN = BatchConfig(rotate=False, translate_sigma=0.0)


@pytest.fixture(scope="module")
def artifact(tmp_path_factory):
    return sharded(tmp_path_factory.mktemp("dataset"))[1]


@pytest.fixture(scope="module")
def dataset(artifact):
    return ShardDataset(artifact, "train")


def same(a: dict, b: dict) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[name], b[name]) for name in a)


def project(example: dict, points: np.ndarray) -> np.ndarray:
    """(V, N, 2) image-plane positions of (N, 3) points."""
    inverse = np.linalg.inv(example["camera_to_world"].astype(np.float64))
    camera = np.einsum("vij,nj->vni", inverse[:, :3, :3], points) + inverse[:, None, :3, 3]
    focal = 1 / np.tan(np.radians(example["fov_deg"].astype(np.float64)) / 2)
    return focal[:, None, None] * camera[..., :2] / -camera[..., 2:]


def test_without_augmentation_the_stored_arrays(artifact, dataset):
    batch = Batches(dataset, PLAIN)(0)
    assert batch["image"].shape == (4, 2, 12, 12, 3) and len(batch["ids"]) == 4
    assert batch["mask"].shape[1] == batch["mask"].sum(axis=1).max()
    for i, id in enumerate(batch["ids"]):
        sample = dataset[dataset.ids.index(id)]
        n = len(sample.scene.triangles)
        assert batch["mask"][i].sum() == n and batch["mask"][i, :n].all()
        for name in ("triangles", "vertex_normals", "diffuse", "specular", "roughness", "emission"):
            assert np.array_equal(batch[name][i, :n], getattr(sample.scene, name)) and not batch[name][i, n:].any()
            assert batch[name].dtype == np.float32
        assert set(batch["views"][i]) <= {0, 2, 3} and len(set(batch["views"][i])) == 2
        for v, view in enumerate(batch["views"][i]):
            assert np.array_equal(batch["camera_to_world"][i, v], sample.scene.camera_to_world[view])
            assert np.array_equal(batch["image"][i, v], sample.views[int(view)].image)
            assert np.array_equal(batch["direct"][i, v], sample.views[int(view)].direct)


def test_batches_are_functions_of_the_step(artifact, dataset):
    config = BatchConfig(mirror=True, relight=True, lighting=Relight(share=0.8, keep=0.5, saturation=1.0))
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
        assert sum(size for _, size in dataset._cache.values()) <= 0.2e6
    sizes = sorted(len(dataset[index].scene.triangles) for index in range(len(dataset)))
    few = ShardDataset(artifact, "train", max_triangles=sizes[2])
    assert few.dropped == sum(size > sizes[2] for size in sizes) > 0 and len(few) + few.dropped == 6
    with pytest.raises(UserError, match="no validation scenes"):
        ShardDataset(artifact, "validation")


def test_an_error_in_a_thread_reaches_the_caller():
    def broken(step):
        raise UserError("damaged")

    with pytest.raises(UserError, match="damaged"):
        list(prefetch(broken, 0, 3))
    assert list(prefetch(lambda step: {"step": step}, 3, 3)) == []


def test_no_torch_here():
    import subprocess

    code = "import sys, stages.dataset, stages.s05_shard; sys.exit(bool({'torch', 'mitsuba', 'trimesh'} & {*sys.modules}))"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
