"""The released scene formats, and what is said about files that are not quite in them."""

from __future__ import annotations

import copy
import json
import os

import numpy as np
import pytest

from pipeline.errors import UserError
from stages.renderformer.scenes.released import load_scene

SCENES = ("init-template", "cbox", "veach-mis", "shader-ball")
SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n"
OBJECT = {
    "mesh_path": "mesh/square.obj",
    "material": {
        "diffuse": [0.5, 0.4, 0.3],
        "specular": [0.1] * 3,
        "roughness": 0.5,
        "emissive": [0, 0, 0],
        "smooth_shading": False,
        "rand_tri_diffuse_seed": None,
    },
    "transform": {"translation": [0, 0, 1], "rotation": [90, 0, 90], "scale": [2, 2, 2], "normalize": False},
}
SCENE = {
    "scene_name": "square",
    "version": "1.0",
    "objects": {"square": OBJECT},
    "cameras": [{"position": [0, -2, 0], "look_at": [0, 0, 0], "up": [0, 0, 1], "fov": 40}],
}


@pytest.fixture
def write(tmp_path):
    """Write a scene after ``change`` has altered it, with its mesh; returns the path."""
    (tmp_path / "scene" / "mesh").mkdir(parents=True)
    (tmp_path / "scene" / "mesh" / "square.obj").write_text(SQUARE)
    (tmp_path / "outside.obj").write_text(SQUARE)

    def write(change=lambda scene: None):
        scene = copy.deepcopy(SCENE)
        change(scene)
        path = tmp_path / "scene" / "scene.json"
        path.write_text(json.dumps(scene))
        return path

    return write


@pytest.mark.parametrize("name", SCENES)
def test_json_and_hdf5_agree(shared_data, name):
    from_json = load_scene(shared_data / "scenes" / f"{name}.json")
    from_hdf5 = load_scene(shared_data / "scenes" / f"{name}.h5")
    assert len(from_json.triangles) == len(from_hdf5.triangles)
    assert from_json.n_lights == from_hdf5.n_lights == 1
    # Meshes with creases come in another order: compare as sets of triangles, matched by centre.
    from scipy.spatial import cKDTree

    centres = [scene.triangles.mean(axis=1) for scene in (from_json, from_hdf5)]
    distance, match = cKDTree(centres[1]).query(centres[0])
    assert distance.max() < 1e-5
    assert len(set(match.tolist())) > 0.99 * len(match)  # coincident triangles may share a match
    for column, tolerance in (("diffuse", 1 / 255), ("specular", 1e-3), ("roughness", 1e-3), ("emission", 1)):
        assert np.abs(getattr(from_json, column) - getattr(from_hdf5, column)[match]).max() <= tolerance, column
    assert np.allclose(from_json.camera_to_world, from_hdf5.camera_to_world, atol=1e-5)
    assert np.allclose(from_json.fov_deg, from_hdf5.fov_deg)
    dots = np.einsum("fij,fij->fi", from_json.vertex_normals, from_hdf5.vertex_normals[match])
    normals_agree = np.sort(dots, axis=1)[:, 0] > 0.999  # corner order may turn with the triangle order
    assert normals_agree.mean() > 0.98


def test_transform_rotates_then_scales_then_translates(write):
    scene = load_scene(write())
    # (1, 0, 0) about x by 90: itself; about z by 90: (0, 1, 0); twice; one up.
    assert np.allclose(scene.triangles[0], [[0, 0, 1], [0, 2, 1], [0, 2, 3]], atol=1e-6)
    assert np.allclose(scene.vertex_normals, [1, 0, 0], atol=1e-6)
    assert scene.light_index.tolist() == [-1, -1]
    assert scene.meta["objects"] == [{"name": "square", "kind": "object", "faces": 2}]


def test_normalize_centres_and_bounds_the_mesh(write):
    def change(scene):
        scene["objects"]["square"]["transform"] = {"normalize": True, "scale": 1}

    scene = load_scene(write(change))
    assert np.isclose(np.linalg.norm(scene.triangles, axis=-1).max(), 0.5)


def test_random_colours_are_per_triangle_and_repeatable(write):
    def change(scene):
        scene["objects"]["square"]["material"] |= {"rand_tri_diffuse_seed": 3, "random_diffuse_max": 0.25}

    colours = load_scene(write(change)).diffuse
    assert np.array_equal(colours, load_scene(write(change)).diffuse)
    assert colours.max() <= 0.25
    assert not np.array_equal(colours[0], colours[1])


def test_each_emitting_object_is_a_light(write):
    def change(scene):
        for index in range(3):
            scene["objects"][f"light{index}"] = copy.deepcopy(OBJECT)
            scene["objects"][f"light{index}"]["material"]["emissive"] = [0, 0, 5]

    scene = load_scene(write(change))
    assert scene.light_index.tolist() == [-1, -1, 0, 0, 1, 1, 2, 2]
    assert scene.emission[-1].tolist() == [0, 0, 5]


def set_in(*keys):
    *path, last, value = keys

    def change(scene):
        for key in path:
            scene = scene[key]
        scene[last] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (set_in("cameras", []), "no camera"),
        (set_in("cameras", 0, "fov", 180), "fov"),
        (set_in("cameras", 0, "look_at", [0, -2, 0]), "do not span"),
        (set_in("cameras", 0, "position", [0, None, 0]), "position"),
        (set_in("objects", {}), "no objects"),
        (set_in("objects", "square", "mesh_path", "mesh/none.obj"), "none.obj does not exist"),
        (set_in("objects", "square", "mesh_path", "../outside.obj"), "leads out"),
        (set_in("objects", "square", "mesh_path", os.path.abspath(os.sep + "etc/hosts")), "leads out"),
        (set_in("objects", "square", "mesh_path", None), "no mesh_path"),
        (set_in("objects", "square", "material", "roughness", "rough"), "roughness"),
        (set_in("objects", "square", "material", "diffuse", [1, 1]), "diffuse"),
        (set_in("objects", "square", "material", "emissive", [-1, 0, 0]), "emissive"),
        (set_in("objects", "square", "remesh", True), "remeshing"),
    ],
)
def test_faults_are_named(write, change, message):
    with pytest.raises(UserError, match=message) as caught:
        load_scene(write(change))
    assert "scene.json" in str(caught.value)


def test_a_vertex_that_is_not_a_number_is_named(write):
    path = write()
    (path.parent / "mesh" / "square.obj").write_text(SQUARE.replace("v 1 1 0", "v nan 1 0"))
    with pytest.raises(UserError, match="square.obj: line 3: a coordinate is infinite or not a number"):
        load_scene(path)


def test_a_link_out_of_the_folder_is_refused(write):
    path = write(set_in("objects", "square", "mesh_path", "mesh/link.obj"))
    (path.parent / "mesh" / "link.obj").symlink_to(path.parent.parent / "outside.obj")
    with pytest.raises(UserError, match="leads out"):
        load_scene(path)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_byte_order_mark_is_read(write, encoding):
    path = write(lambda scene: None)
    plain = load_scene(path)
    path.write_bytes(path.read_text(encoding="utf-8").encode(encoding))
    assert (load_scene(path).triangles == plain.triangles).all()


def test_what_lies_too_far_away_is_refused(write):
    with pytest.raises(UserError, match=r"reaches 1e\+30 scene units, at most 1e\+12 are taken: scale it down"):
        load_scene(write(set_in("objects", "square", "transform", {"scale": [1e30] * 3})))


def test_other_files_are_refused(tmp_path):
    (tmp_path / "a.json").write_text("{")
    (tmp_path / "a.h5").write_text("no")
    faults = {"a.json": "not JSON", "a.h5": "not an HDF5", "a.obj": "not a scene file", "b.json": "does not exist"}
    for name, message in faults.items():
        with pytest.raises(UserError, match=message):
            load_scene(tmp_path / name)


def test_hdf5_lights_are_connected_groups(tmp_path):
    import h5py

    triangles = np.zeros((5, 3, 3), np.float32)
    triangles[:, 1, 0] = triangles[:, 2, 1] = 1
    triangles[:, :, 2] = np.array([0, 1, 2, 1, 2])[:, None]  # 1 and 3 coincide, and so do 2 and 4
    texture = np.zeros((5, 13, 4, 4), np.float16)
    kept = np.add.outer(np.arange(4), np.arange(4)) <= 4
    texture[1:, 10:13] = 7 * kept
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.update(
            {
                "triangles": triangles,
                "vn": np.broadcast_to(np.float32([0, 0, 1]), (5, 3, 3)),
                "texture": texture,
                "c2w": np.eye(4, dtype=np.float32)[None],
                "fov": np.float32([40]),
            }
        )
    scene = load_scene(tmp_path / "a.h5")
    assert scene.light_index.tolist() == [-1, 0, 1, 0, 1]
    assert not scene.textured and scene.patches is None


def test_hdf5_textures_are_read_and_what_may_not_change_is_named(tmp_path):
    import h5py

    corner = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    i = np.arange(32)
    kept = np.add.outer(i, i) <= 32
    texture = np.zeros((4, 13, 32, 32), np.float16)
    texture[:, :6] = 0.25 * kept
    texture[:, 6] = 0.5 * kept
    texture[:, 7:10] = np.array([0.5, 0.5, 1])[:, None, None] * kept
    texture[1, 0] = kept * (i / 64)  # red rises along the columns, towards corner 1
    texture[1, 6] = kept * (i / 32)[:, None]  # rougher towards corner 2, from 0
    texture[2, 0, 31, 31] = 7  # a cell that is not kept means nothing
    arrays = {"triangles": np.stack([corner] * 4), "vn": np.broadcast_to(np.float32([0, 0, 1]), (4, 3, 3))}
    arrays |= {"c2w": np.eye(4, dtype=np.float32)[None], "fov": np.float32([40]), "texture": texture}

    def load(**changes):
        with h5py.File(tmp_path / "a.h5", "w") as file:
            file.update(arrays | changes)
        return load_scene(tmp_path / "a.h5")

    scene = load()
    assert scene.patch_index.tolist() == [-1, 0, -1, -1] and scene.patches.shape == (1, 7, 32, 32)
    assert np.array_equal(scene.patches[0, 0], texture[1, 0]) and (scene.patches[0, 1] == texture[1, 1]).all()
    assert scene.patches[0, 6][kept].min() == np.float16(0.01) and scene.patches[0, 6, 20, 3] == np.float16(20 / 32)
    inside = np.add.outer(i, i) < 32
    assert scene.diffuse[1] == pytest.approx([texture[1, 0][inside].astype(float).mean(), 0.25, 0.25], abs=1e-6)
    assert scene.diffuse[0].tolist() == scene.diffuse[2].tolist() == [0.25] * 3
    for channel, name in ((8, "normal"), (11, "emission")):
        wrong = texture.copy()
        wrong[3, channel, 1, 1] += 0.25
        with pytest.raises(UserError, match=f"{name} changes within triangle 3"):
            load(texture=wrong)
    with pytest.raises(UserError, match="16 x 16"):
        load(texture=texture[:, :, :16, :16])
    with pytest.raises(UserError, match="expected"):
        load(texture=texture[:, :7])
