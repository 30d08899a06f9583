"""Augmented samples against new renders: relit, moved and mirrored scenes look as the path tracer sees them, within noise.

Also there and back: an exported scene read by a reader that knows only the released format's description.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import PurePosixPath

import numpy as np
import pytest

from stages.graphics.metrics import log_error
from stages.renderformer.dataset import Sample, decode_sample, expose, make_example, mirror, move, rotation_from_vector
from stages.renderformer.dataset.encoding import decode_scene, encode_scene
from stages.renderformer.records import SceneRecord
from tests.renderformer.fakes import dataset_inputs, with_textures

VIEWS = np.array([0, 2])
SPP = 256


def path_trace(scene: SceneRecord, seed: int, views=VIEWS) -> list:
    from tests.renderformer.fakes import path_traced

    scalar = {"backend": "scalar", "variant": "scalar_rgb"}
    return path_traced(scene, 20, max_spp=SPP, seed=seed, backend=scalar, views=[int(v) for v in views], denoise=False)


def images(views: list) -> np.ndarray:
    return np.stack([view.image for view in views])


@pytest.fixture(scope="module")
def sample(tmp_path_factory):
    """A scene of several lights that went through render and shard, and its original record."""
    from pipeline.stage import Record
    from stages.graphics.arrays import pack_json
    from stages.renderformer.s05_shard import merge
    from stages.renderformer.views import encode_view

    inputs = dataset_inputs(tmp_path_factory.mktemp("exact"))
    records = [inputs["scene"].read(row.id) for row in inputs["scene"].rows()]
    record = next(r for r in records if SceneRecord.from_record(r).n_lights in (2, 3))
    views = path_trace(SceneRecord.from_record(record), 1)
    members = {name: data for view in views for name, data in encode_view(view).items()}
    rendered = Record(record.id, {"meta.json": pack_json({"views": [view.meta for view in views]}), **members})
    return decode_sample(merge(record, rendered)), SceneRecord.from_record(record)


def rendered_again(example: dict, scene: SceneRecord, seed: int) -> list:
    """What the path tracer sees in the example's own arrays."""
    names = ("triangles", "vertex_normals", "emission", "camera_to_world", "fov_deg", "patch_index", "patches")
    arrays = {name: example[name] for name in names if name in example}
    return path_trace(replace(scene, **arrays), seed, range(len(VIEWS)))


def assert_same_picture(image: np.ndarray, example: dict, scene: SceneRecord) -> list:
    """The image differs from a new render as two new renders differ from each other."""
    again = [rendered_again(example, scene, seed) for seed in (11, 12)]
    noise = log_error(images(again[0]), images(again[1]))
    for render in again:
        assert log_error(images(render), image) < 1.25 * noise
    # the mean of logarithms, which a single bright pixel hardly moves
    assert np.log1p(image).mean() == pytest.approx(np.mean([np.log1p(images(render)) for render in again]), rel=0.03)
    return again[0]


def test_relighting_equals_a_render_with_those_lights(sample):
    decoded, scene = sample
    factors = np.array([[0.2, 1.5, 0.4], [3.0, 0.5, 0.1], [0.0, 0.0, 0.0]])[: scene.n_lights]
    example = make_example(decoded, VIEWS, factors)
    render = assert_same_picture(example["image"], example, scene)
    as_stored = make_example(decoded, VIEWS, None)["image"]
    assert log_error(images(render), as_stored) > 2 * log_error(images(render), example["image"])


def test_moved_scene_equals_a_render_of_it(sample):
    decoded, scene = sample
    example = make_example(decoded, VIEWS, None, ("albedo", "normal", "depth"))
    moved = move(example, rotation_from_vector(np.array([0.4, -1.0, 2.0])), np.array([0.2, -0.1, 0.3]))
    render = assert_same_picture(moved["image"], moved, scene)
    for name in ("albedo", "normal", "depth"):
        assert np.abs(np.stack([getattr(view, name) for view in render]) - moved[name]).mean() < 0.03, name
    assert np.abs(np.stack([view.normal for view in render]) - example["normal"]).mean() > 0.1
    left_behind = {**moved, "camera_to_world": example["camera_to_world"]}
    stayed = images(rendered_again(left_behind, scene, 11))
    assert log_error(stayed, moved["image"]) > 2 * log_error(images(render), moved["image"])


def test_mirrored_scene_equals_a_render_of_it(sample):
    decoded, scene = sample
    example = make_example(decoded, VIEWS, None, ("normal",))
    flipped = mirror(example)
    render = assert_same_picture(flipped["image"], flipped, scene)
    assert np.abs(np.stack([view.normal for view in render]) - flipped["normal"]).mean() < 0.03
    assert log_error(images(render), example["image"]) > 2 * log_error(images(render), flipped["image"])


def test_moved_and_mirrored_textures_lie_where_a_render_shows_them(sample):
    """Told by albedo, which has no noise but at edges."""
    scene = with_textures(sample[1], 100)
    views = dict(zip(VIEWS.tolist(), path_trace(scene, 1), strict=True))
    decoded = Sample(decode_scene(scene.id, encode_scene(scene), b"{}"), views)
    example = make_example(decoded, VIEWS, None, ("albedo",))
    moved = move(mirror(example), rotation_from_vector(np.array([0.4, -1.0, 2.0])), np.array([0.2, -0.1, 0.3]))

    def off(patches: np.ndarray) -> float:
        again = rendered_again({**moved, "patches": patches}, scene, 11)
        return np.abs(np.stack([view.albedo for view in again]) - moved["albedo"]).mean()

    right = off(moved["patches"])
    assert right < 0.01 and off(example["patches"]) > 3 * right


def test_exposure_equals_a_render_with_brighter_lights(sample):
    decoded, scene = sample
    exposed = expose(make_example(decoded, VIEWS, None), 4.0)
    assert_same_picture(exposed["image"], exposed, scene)


# --- the released format ----------------------------------------------------------------------------------------------


def read_released(path) -> dict:
    """As the format is described: triangles (N,3,3), vn (N,3,3), texture (N,13,32,32) fp16, c2w (V,4,4), fov (V) in degrees;
    13 channels = diffuse RGB, specular RGB, roughness, normal (0.5, 0.5, 1), emission RGB; cells with x + y > 32 are zero."""
    import h5py

    with h5py.File(path) as file:
        assert sorted(file) == ["c2w", "fov", "texture", "triangles", "vn"]
        arrays = {name: file[name][...] for name in file}
    n, v = len(arrays["triangles"]), len(arrays["c2w"])
    assert arrays["triangles"].shape == arrays["vn"].shape == (n, 3, 3) and arrays["c2w"].shape == (v, 4, 4)
    assert arrays["texture"].shape == (n, 13, 32, 32) and arrays["texture"].dtype == np.float16
    assert arrays["fov"].shape == (v,)
    return arrays


def test_an_exported_scene_has_the_same_arrays(tmp_path):
    from stages.renderformer.dataset.interchange import export
    from tests.renderformer.fakes import sharded

    artifact = sharded(tmp_path, train=2, test=1)[1]
    written = list(export(artifact, tmp_path / "out", ["train"], images=True))
    assert written == [tmp_path / "out" / "train" / f"{id}.h5" for id in artifact.ids("train")]
    x, y = np.meshgrid(np.arange(32), np.arange(32))
    for path in written:
        read, sample = read_released(path), decode_sample(artifact.read(path.stem))
        scene = sample.scene
        assert np.array_equal(read["triangles"], scene.triangles) and np.array_equal(read["vn"], scene.vertex_normals)
        assert np.array_equal(read["c2w"], scene.camera_to_world) and np.array_equal(read["fov"], scene.fov_deg)
        texture = read["texture"]
        assert not texture[:, :, x + y > 32].any()
        if scene.textured:
            rows = scene.patch_index >= 0
            assert np.array_equal(texture[rows, :7], scene.patches[scene.patch_index[rows]]) and rows.sum() == 4
            means = np.concatenate([scene.diffuse, scene.specular, scene.roughness[:, None]], axis=1)
            texture[rows, :7] = means[rows, :, None, None]
        kept = texture[:, :, x + y <= 32]
        assert (kept == kept[:, :, :1]).all()  # constant patches
        values = kept[:, :, 0].astype(np.float32)
        assert np.array_equal(values[:, 0:3], scene.diffuse) and np.array_equal(values[:, 3:6], scene.specular)
        assert np.array_equal(values[:, 6], scene.roughness) and (values[:, 7:10] == [0.5, 0.5, 1]).all()
        assert np.array_equal(values[:, 10:13], scene.emission.astype(np.float16))
        from stages.graphics.exr import read_rgb

        for view in (0, 2, 3):
            image = read_rgb(path.with_name(f"{path.stem}-view{view}.exr"))
            assert np.allclose(image, sample.views[view].image, rtol=1e-3)


def test_export_then_import_renders_the_same_scene(tmp_path):
    """Arrays, cameras and lights come back through the released format, and each light is told apart again."""
    from pipeline.stage import Item
    from stages.renderformer.dataset.interchange import export
    from stages.renderformer.s03_import import ImportConfig, ImportScene
    from tests.renderformer.fakes import sharded

    artifact = sharded(tmp_path, train=2, test=1)[1]
    list(export(artifact, tmp_path / "out"))
    stage, config = ImportScene(), ImportConfig(path=str(tmp_path / "out"))
    items = list(stage.items(config, {}))
    assert [(item.id, item.group) for item in items] == [
        ("test/test-000000.h5", "test"), ("train/train-000000.h5", "train"), ("train/train-000001.h5", "train"),
    ]  # fmt: skip
    worker = stage.open(config, {}, {})
    for item in items:
        (record,) = stage.process(worker, Item(item.id, item.group))
        back = SceneRecord.from_record(record)
        scene = decode_sample(artifact.read(PurePosixPath(item.id).stem)).scene
        for name in ("triangles", "vertex_normals", "light_index", "camera_to_world"):
            assert np.array_equal(getattr(back, name), getattr(scene, name)), name
        assert back.textured == scene.textured == (item.id == "train/train-000000.h5")
        plain = np.ones(len(scene.triangles), bool)
        if scene.textured:
            plain = scene.patch_index < 0
            assert np.array_equal(plain, back.patch_index < 0)
            assert np.array_equal(back.patches[back.patch_index[~plain]], scene.patches[scene.patch_index[~plain]])
        for name in ("diffuse", "specular", "roughness"):  # of textured triangles the means, which shards round to half floats
            assert np.array_equal(getattr(back, name)[plain], getattr(scene, name)[plain]), name
            assert np.allclose(getattr(back, name), getattr(scene, name), atol=2.5e-4), name
        assert np.allclose(back.emission, scene.emission, rtol=5e-4) and back.meta["split"] == item.group
