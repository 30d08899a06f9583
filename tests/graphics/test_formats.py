"""Mesh formats: what is read, with which colours, and the place that a reject names."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from pipeline.errors import Reject, UserError
from stages.graphics.geometry import load, measure
from stages.graphics.geometry.formats import gltf
from stages.graphics.geometry.records import TextureRecord
from stages.renderformer.dataset.interchange import write_hdf5
from stages.renderformer.inference.room import SPECULAR, Room, room_scene
from stages.renderformer.inference.scene_files import load_scene
from stages.renderformer.s00_collect import Collect
from stages.renderformer.scenes import textures
from tests.graphics.habits import HABITS
from tests.graphics.malformed import MALFORMED

CLASSES = re.compile(r"\b\w*(?:Error|Exception|Warning)\b|Traceback|NoneType|object has no|not subscriptable")


@pytest.mark.parametrize("name", MALFORMED)
def test_a_reject_names_the_file_the_place_and_what_is_wrong(name: str, tmp_path: Path) -> None:
    data, reason, place, words = MALFORMED[name]
    (tmp_path / name).write_bytes(data)
    with pytest.raises(Reject) as caught:
        load.load_mesh(tmp_path / name, tmp_path, 1 << 24, 50_000)
    reject = caught.value
    assert reject.reason == reason and reason in Collect.reasons, reject
    assert reject.detail.startswith(f"{name}: ") and len(reject.detail) <= 400
    assert re.search(rf"(?<!\d){re.escape(place)}(?!\d)", reject.detail) and words in reject.detail, reject
    assert not CLASSES.search(reject.detail), reject


# -- the small cases from public bug reports


def sides(path: Path) -> list[float]:
    return np.ptp(load.normalise(mesh_of(path).vertices), axis=0).tolist()


def mesh_of(path: Path, textures: bool = False) -> load.Loaded:
    return load.load_mesh(path, path.parent, 1 << 24, 50_000, textures)


PRISM = [1, 0.866, 0.35]
EXTENTS = {
    **{f"12-text-formats/{name}": [1, 0.5, 0.25] for name in ("quads.off", "faces-across-lines.off", "leading-blank.off")},
    "12-text-formats/cr-line-ends.ply": [1, 0.5, 0.25],
    "12-text-formats/ngons.off": PRISM,
    "7-glb-bytestride/interleaved.glb": [1, 0.6, 0.4],
    "7-glb-bytestride/interleaved-short-last.glb": [1, 0.7, 0.2],
    "7-glb-bytestride/stride-equals-12.glb": [1, 0.3, 0.3],
    "7-glb-bytestride/quantised-beside-float.glb": [1, 0.36, 0.2],
    "7-glb-bytestride/sparse-only.glb": [1, 0.6, 0.8],
    "7-glb-bytestride/sparse-changes.glb": [0.5, 1, 0.4],
}


@pytest.mark.parametrize("name", EXTENTS)
def test_reported_files_have_their_extents_and_are_closed(name: str, shared_data: Path) -> None:
    path = shared_data / "cases" / name
    assert sides(path) == pytest.approx(EXTENTS[name], abs=1e-4)
    mesh = mesh_of(path)
    filled = measure.volume(mesh.vertices, mesh.faces) / np.ptp(mesh.vertices, axis=0).prod()
    expected = 0.75 if "ngons" in name else (1.8 / 2.25 if "beside" in name else 1.0)
    assert filled == pytest.approx(expected, abs=2e-3)


def test_the_reported_boxes_are_duplicates_of_one_another(shared_data: Path) -> None:
    boxes = [
        path for path in sorted((shared_data / "cases" / "12-text-formats").glob("*.*")) if path.suffix in (".off", ".ply")
    ]
    signatures = [measure.signature(load.normalise(m.vertices), m.faces) for m in map(mesh_of, boxes) if len(m.faces) == 12]
    assert len(signatures) == 4 and np.ptp(signatures, axis=0).max() < 1e-5


COLOURS = {
    "factor-0.0005": (0.0005, 0.002, 0.003), "factor-0.003": (0.003,) * 3, "factor-0.8": (0.8, 0.4, 0.1),
    "factor-absent": (1, 1, 1), "factor-int-ones": (1, 1, 1), "factor-int-zero-one": (0, 1, 0),
    "factor-over-one": (1, 0.5, 0.5),
    "metal": (0.9, 0.7, 0.2), "specular-glossiness": (0.05, 0.3, 0.05),
}  # fmt: skip


@pytest.mark.parametrize("name", COLOURS)
def test_a_file_of_one_plain_colour_has_it(name: str, shared_data: Path) -> None:
    path = shared_data / "cases" / "11-dark-colours" / f"{name}.glb"
    loaded = mesh_of(path, textures=True)
    assert loaded.texture.colour == pytest.approx(np.array([COLOURS[name]])) and loaded.texture.image.tolist() == [-1]
    assert bool(loaded.notes) == (name == "factor-over-one") and all("reach 3" in note for note in loaded.notes)
    scene = room_scene(path, Room("floor"))
    of_object = scene.object_index == 1
    assert np.allclose(scene.diffuse[of_object], (1 - SPECULAR) * np.array(COLOURS[name]), atol=1e-6)
    assert any("reach 3" in note for note in scene.meta["notes"]) == (name == "factor-over-one")


def test_vertex_colours_multiply_the_factor(shared_data: Path) -> None:
    """As written at each corner, and between corners their mean."""
    path = shared_data / "cases" / "11-dark-colours" / "vertex-colour-times-factor.glb"
    tree, binary = gltf.split_glb(path.read_bytes())
    positions, colours = np.frombuffer(binary, "<f4", 108).reshape(-1, 3), np.frombuffer(binary, "<f4", 144, 432).reshape(-1, 4)
    loaded = mesh_of(path, textures=True)
    corners = loaded.vertices[loaded.faces].reshape(-1, 3)
    look_up = textures.nearest_colours(loaded.texture, loaded.vertices, loaded.faces)
    for corner, tint in zip(corners, loaded.texture.tint.reshape(-1, 3), strict=True):
        stated = colours[(np.abs(positions - corner) < 1e-6).all(axis=1), :3]
        assert np.isclose(stated, tint).all(axis=1).any()
    centres = loaded.vertices[loaded.faces].mean(axis=1)
    assert np.allclose(look_up(centres), 0.5 * loaded.texture.tint.mean(axis=1), atol=1e-5)
    kept = TextureRecord.from_record(replace(loaded.texture, id="a").to_record())
    assert np.array_equal(kept.tint, loaded.texture.tint) and kept.images == []


@pytest.mark.parametrize("name", ["light-collinear", "light-point", "light-scaled-to-zero"])
def test_lights_without_area_alone_are_no_light(name: str, shared_data: Path) -> None:
    with pytest.raises(UserError, match="has no light .light_0: a light without area"):
        load_scene(shared_data / "cases" / "5-zero-area" / f"{name}.json")


def test_a_light_without_area_adds_nothing_beside_another(shared_data: Path, tmp_path: Path) -> None:
    scene = load_scene(shared_data / "cases" / "5-zero-area" / "light-good-and-zero.json")
    assert scene.n_lights == 1 and scene.meta["notes"] == ["light_1: a light without area adds nothing"]
    assert (scene.emission.max(axis=1) > 0).sum() == 1
    write_hdf5(tmp_path / "a.h5", scene)
    with h5py.File(tmp_path / "a.h5", "r+") as file:  # as the released converter would write it
        texture = file["texture"][...]
        texture[-1, 10:13] = 5000
        file["texture"][...] = texture
    again = load_scene(tmp_path / "a.h5")
    assert again.n_lights == 1 and again.meta["notes"] == ["1 of 2 lights: a light without area adds nothing"]
    assert np.array_equal(again.emission, scene.emission)


@pytest.mark.parametrize("name", ["object-needle", "object-scaled-to-zero-on-z", "object-zero-area-smooth"])
def test_objects_without_area_stay_finite(name: str, shared_data: Path) -> None:
    scene = load_scene(shared_data / "cases" / "5-zero-area" / f"{name}.json")
    assert all(np.isfinite(array).all() for array in scene.arrays().values())
    assert np.allclose(np.linalg.norm(scene.vertex_normals, axis=2), 1, atol=1e-3)


# -- habits of exporters


@pytest.mark.parametrize("name", HABITS)
def test_a_box_is_the_same_box_however_it_is_written(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(HABITS[name])
    mesh = mesh_of(tmp_path / name, textures=True)
    assert len(mesh.faces) == 12 and np.ptp(mesh.vertices, axis=0) == pytest.approx([2, 1, 0.5])
    assert measure.volume(mesh.vertices, mesh.faces) == pytest.approx(1)
    points, index = np.unique(mesh.vertices.round(6), axis=0, return_inverse=True)
    assert len(points) == 8 and measure.watertight(index.reshape(-1)[mesh.faces], 8)


def test_polygons_become_triangles_whatever_their_number_of_corners(tmp_path: Path) -> None:
    """A prism over a regular polygon: OBJ, OFF and PLY agree, and its volume is the polygon's area times the height."""
    for corners in (3, 5, 6, 9):
        angle = 2 * np.pi * np.arange(corners) / corners
        ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        points = np.concatenate([np.c_[ring, 0 * angle], np.c_[ring, 0 * angle + 1]])
        ring = np.arange(corners)
        sides = np.stack([ring, np.roll(ring, -1), np.roll(ring, -1) + corners, ring + corners], axis=1).tolist()
        faces = [ring[::-1].tolist(), (ring + corners).tolist(), *sides]
        rows = "".join(" ".join(map(repr, p.tolist())) + "\n" for p in points)
        lists = "".join(" ".join(map(str, [len(f), *f])) + "\n" for f in faces)
        (tmp_path / "a.off").write_text(f"OFF\n{len(points)} {len(faces)} 0\n{rows}{lists}")
        (tmp_path / "a.obj").write_text(
            "".join(f"v {row}\n" for row in rows.splitlines())
            + "".join("f " + " ".join(str(i + 1) for i in f) + "\n" for f in faces)
        )
        head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n" + "".join(f"property double {a}\n" for a in "xyz")
        head += f"element face {len(faces)}\nproperty list uchar int vertex_index\nend_header\n"
        (tmp_path / "a.ply").write_text(head + rows + lists)
        for name in ("a.off", "a.obj", "a.ply"):
            mesh = mesh_of(tmp_path / name)
            assert measure.volume(mesh.vertices, mesh.faces) == pytest.approx(corners / 2 * np.sin(2 * np.pi / corners))
            assert measure.watertight(mesh.faces, len(mesh.vertices)), (name, corners)


def test_triangle_strips_of_ply_are_read(tmp_path: Path) -> None:
    head = "ply\nformat ascii 1.0\nelement vertex 6\n" + "".join(f"property float {a}\n" for a in "xyz")
    head += "element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    points = "".join(f"{x} {y} 0\n" for x in (0, 1, 2) for y in (0, 1))
    (tmp_path / "a.ply").write_text(head + points + "7 0 2 1 3 -1 2 4 \n".replace("7", "9").replace("4 ", "4 3 5"))
    mesh = mesh_of(tmp_path / "a.ply")
    corners = mesh.vertices[mesh.faces]
    assert len(corners) == 4 and (measure.normal_vectors(corners)[:, 2] > 0).all()
