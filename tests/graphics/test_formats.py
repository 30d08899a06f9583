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
from stages.graphics.geometry.formats.parts import Source
from stages.graphics.geometry.records import TextureRecord
from stages.renderformer.dataset.interchange import write_hdf5
from stages.renderformer.inference.room import SPECULAR, Room, room_scene
from stages.renderformer.inference.scene_files import load_scene
from stages.renderformer.s00_collect import Collect
from stages.renderformer.scenes import textures
from tests.graphics import slow_gltf
from tests.graphics.habits import BOX, HABITS, QUADS, TRIANGLES, F, V
from tests.graphics.malformed import MALFORMED, glb

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


# -- glTF numbers


def opened(path: Path) -> gltf.Gltf:
    return gltf.Gltf(path.read_bytes(), Source(path, path.parent, 1 << 24, 1 << 20))


def test_accessors_of_every_layout_are_read_as_a_plain_reader_does(tmp_path: Path) -> None:
    """All types and components, with strides, offsets, sparse changes with and without a base, normalised or not."""
    rng = np.random.default_rng(0)
    accessors, views, data = [], [], b""

    def view(length: int, stride: int | None = None) -> int:
        nonlocal data
        data += bytes(-len(data) % 4)
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": length, **({"byteStride": stride} if stride else {})})
        data += rng.integers(0, 255, length, dtype=np.uint8).tobytes()
        return len(views) - 1

    for kind, (columns, rows) in gltf.SHAPES.items():
        for component, dtype in gltf.DTYPES.items():
            for stride, offset, sparse in ((0, 0, False), (4, 0, False), (8, 4, True), (0, 8, True), (0, 0, None)):
                column = rows * np.dtype(dtype).itemsize
                size = columns * (column + (-column % 4 if columns > 1 else 0))
                step = size + -size % 4 + stride if stride else size
                count = 9
                entry = {"componentType": component, "type": kind, "count": count, "byteOffset": offset}
                entry["normalized"] = bool(rng.integers(2)) and component < 5125
                if sparse is not None:
                    entry["bufferView"] = view(offset + (count - 1) * step + size, step if stride else None)
                else:
                    del entry["byteOffset"]
                if sparse or sparse is None:
                    places = np.sort(rng.choice(count, 4, replace=False))
                    index = view(4 + 4 * 4)
                    start = views[index]["byteOffset"] + 4
                    data = data[:start] + places.astype("<u4").tobytes() + data[start + 16 :]
                    entry["sparse"] = {
                        "count": 4,
                        "indices": {"bufferView": index, "byteOffset": 4, "componentType": 5125},
                        "values": {"bufferView": view(4 * size)},
                    }
                accessors.append(entry)
    tree = {"asset": {"version": "2.0"}, "accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(data)}]}
    (tmp_path / "a.glb").write_bytes(glb(tree, data))
    file, plain = opened(tmp_path / "a.glb"), slow_gltf.opened(tmp_path / "a.glb")
    for index, entry in enumerate(accessors):
        values = file.accessor(index)
        assert np.array_equal(values, np.array(slow_gltf.accessor(*plain, index), values.dtype), equal_nan=True), entry
    assert len(accessors) == 7 * 6 * 5


def test_accessors_of_real_files_are_read_as_a_plain_reader_does(shared_data: Path) -> None:
    count = 0
    for path in sorted([*(shared_data / "meshes").rglob("*.gl*"), *(shared_data / "cases").rglob("*.gl*")]):
        if path.stat().st_size > 300_000 or path.name == "donut.gltf":
            continue
        file, plain = opened(path), slow_gltf.opened(path)
        for index in range(len(file.tree["accessors"])):
            values = file.accessor(index)
            expected = np.array(slow_gltf.accessor(*plain, index)).reshape(values.shape)
            assert np.array_equal(values, expected), (path.name, index)
            count += 1
    assert count > 500


def test_quantised_positions_and_all_kinds_of_triangles_make_the_same_square(tmp_path: Path) -> None:
    """A strip, a fan and a list, with 8 and 16 bit positions, normalised and as they are."""
    ring = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    for mode, order in ((4, [0, 1, 2, 0, 2, 3]), (5, [0, 1, 3, 2]), (6, [0, 1, 2, 3])):
        for component, normalized in ((5120, True), (5121, True), (5122, True), (5123, True), (5122, False), (5126, False)):
            dtype = np.dtype(gltf.DTYPES[component])
            scale = np.iinfo(dtype).max if normalized else 1
            points = np.zeros((4, 4), dtype)  # the fourth is padding
            points[:, :3] = ring * scale
            data = points.tobytes() + np.array(order, "<u2").tobytes()
            tree = {
                "asset": {"version": "2.0"},
                "extensionsRequired": ["KHR_mesh_quantization"],
                "nodes": [{"mesh": 0}],
                "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "mode": mode}]}],
                "accessors": [
                    {"bufferView": 0, "componentType": component, "normalized": normalized, "count": 4, "type": "VEC3"},
                    {"bufferView": 1, "componentType": 5123, "count": len(order), "type": "SCALAR"},
                ],
                "bufferViews": [
                    {"buffer": 0, "byteLength": points.nbytes, "byteStride": 4 * dtype.itemsize},
                    {"buffer": 0, "byteOffset": points.nbytes, "byteLength": 2 * len(order)},
                ],
                "buffers": [{"byteLength": len(data)}],
            }
            (tmp_path / "a.glb").write_bytes(glb(tree, data))
            mesh = mesh_of(tmp_path / "a.glb")
            normals = measure.normal_vectors(mesh.vertices[mesh.faces])
            assert np.allclose(normals, [[0, 0, 1]] * 2), (mode, component, normalized)


# -- colours


def box_glb(material: dict | None, colours: np.ndarray | None = None, normalized: bool = False) -> bytes:
    """The box of ``habits`` with one material and colours of its eight corners."""
    triangles, component = TRIANGLES.astype("<u2"), {"f": 5126, "B": 5121, "H": 5123}
    data = BOX.astype("<f4").tobytes() + triangles.tobytes() + (b"" if colours is None else colours.tobytes())
    primitive: dict = {"attributes": {"POSITION": 0}, "indices": 1}
    tree: dict = {
        "asset": {"version": "2.0"}, "nodes": [{"mesh": 0}], "meshes": [{"primitives": [primitive]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 36, "type": "SCALAR"},
        ],
        "bufferViews": [{"buffer": 0, "byteLength": 96}, {"buffer": 0, "byteOffset": 96, "byteLength": 72}],
        "buffers": [{"byteLength": len(data)}],
    }  # fmt: skip
    if material is not None:
        tree["materials"], primitive["material"] = [material], 0
    if colours is not None:
        primitive["attributes"]["COLOR_0"] = 2
        kind = {"componentType": component[colours.dtype.char], "type": f"VEC{colours.shape[1]}", "normalized": normalized}
        tree["accessors"].append({"bufferView": 2, "count": 8, **kind})
        tree["bufferViews"].append({"buffer": 0, "byteOffset": 168, "byteLength": colours.nbytes})
    return glb(tree, data)


def shown(path: Path) -> tuple[np.ndarray, list[str]]:
    """(2, 3) mean linear colours of the low and the high half along x, as ``trace`` and ``predict`` see them, and notes."""
    loaded = mesh_of(path, textures=True)
    if loaded.texture is None:
        return np.full((2, 3), np.nan), loaded.notes
    look_up = textures.nearest_colours(loaded.texture, loaded.vertices, loaded.faces)
    ends = loaded.vertices[:, 0].min(), loaded.vertices[:, 0].max()
    side = np.array([[[x, y, z] for y in (0.2, 0.5, 0.8) for z in (0.1, 0.2, 0.4)] for x in ends])
    return look_up(side.reshape(-1, 3)).reshape(2, -1, 3).mean(axis=1), loaded.notes


RAMP = np.where(BOX[:, :1] > 1, [[0.0, 0.25, 1.0]], [[1.0, 0.25, 0.0]])
PBR = "pbrMetallicRoughness"
OLDER = "KHR_materials_pbrSpecularGlossiness"


@pytest.mark.parametrize(
    ("material", "colours", "normalized", "expected", "note"),
    [
        (None, None, False, None, None),
        ({}, None, False, [1, 1, 1], None),
        ({PBR: {"baseColorFactor": [0, 0, 0, 1]}}, None, False, [0, 0, 0], None),
        ({PBR: {"baseColorFactor": [0.2, 0.3, 0.4, 0.5]}}, None, False, [0.2, 0.3, 0.4], None),
        ({PBR: {"baseColorFactor": [255, 128, 0, 255]}}, None, False, [1, 1, 0], "reach 255"),
        ({PBR: {"baseColorFactor": [-1, 0.5, 0.5, 1]}}, None, False, [0, 0.5, 0.5], "reach -1"),
        ({PBR: {"baseColorFactor": [0.5, 0.5]}}, None, False, None, "expected 4 numbers"),
        ({PBR: {"baseColorFactor": "red"}}, None, False, None, "expected 4 numbers"),
        ({PBR: {"baseColorTexture": {"index": 0}}}, None, False, None, "texture 0 does not exist"),
        ({PBR: {"baseColorFactor": [0.5, 0.5, 0.5, 1]}, "extensions": {OLDER: {"diffuseFactor": [0, 0, 1, 1]}}}, None, False,
         [0, 0, 1], None),
        ({"extensions": {OLDER: {}}}, None, False, [1, 1, 1], None),
        ({"extensions": {OLDER: {"diffuseFactor": [0, 0, 0, 1], "specularFactor": [0.9, 0.7, 0.2]}}}, None, False,
         [0.9, 0.7, 0.2], None),
        ({PBR: {"baseColorFactor": [1, 0, 0, 0]}, "alphaMode": "BLEND"}, None, False, [1, 0, 0], "it is opaque here"),
        ({PBR: {"baseColorFactor": [0, 0, 0, 1]}, "emissiveFactor": [1, 1, 0]}, None, False, [0, 0, 0], "it shines"),
        ({"extensions": {"KHR_materials_unlit": {}}, PBR: {"baseColorFactor": [0, 1, 0, 1]}}, None, False, [0, 1, 0], None),
        (None, RAMP.astype("<f4"), False, RAMP, None),
        (None, np.c_[RAMP, np.ones(8)].astype("<f4"), False, RAMP, None),
        (None, np.c_[np.round(RAMP * 255), np.ones(8)].astype("u1"), True, np.round(RAMP * 255) / 255, None),
        (None, np.c_[np.round(RAMP * 65535), np.ones(8)].astype("<u2"), True, np.round(RAMP * 65535) / 65535, None),
        (None, np.c_[np.round(RAMP * 255), np.ones(8)].astype("u1"), False, np.round(RAMP * 255) / 255, "whole numbers"),
        ({PBR: {"baseColorFactor": [0.5, 1, 0.5, 1]}}, RAMP.astype("<f4"), False, RAMP * [0.5, 1, 0.5], None),
        (None, (3 * RAMP).astype("<f4"), False, np.minimum(3 * RAMP, 1), "reach 3"),
    ],
)  # fmt: skip
def test_gltf_colours(tmp_path: Path, material, colours, normalized, expected, note) -> None:
    (tmp_path / "a.glb").write_bytes(box_glb(material, colours, normalized))
    found, notes = shown(tmp_path / "a.glb")
    if expected is None:
        assert np.isnan(found).all()  # the default grey
    else:
        expected = np.broadcast_to(expected, (8, 3))
        ends = [expected[BOX[:, 0] < 1].mean(axis=0), expected[BOX[:, 0] > 1].mean(axis=0)]
        assert np.allclose(found, ends, atol=1e-4)
    assert (note in "".join(notes)) if note else not notes
    assert not any(CLASSES.search(line) for line in notes)


PLY = """ply
format ascii 1.0
element vertex 8
property float x
property float y
property float z
{}element face 6
property list uchar int vertex_indices
end_header
"""


@pytest.mark.parametrize(
    ("kind", "names", "value"),
    [
        ("uchar", "red green blue", "255 0 0"), ("ushort", "red green blue", "65535 0 0"), ("float", "red green blue", "1 0 0"),
        ("float", "red green blue", "255 0 0"), ("int", "red green blue", "255 0 0"), ("uchar", "r g b", "255 0 0"),
        ("uchar", "diffuse_red diffuse_green diffuse_blue", "255 0 0"),
    ],
)  # fmt: skip
def test_ply_colours_of_every_type_and_name(tmp_path: Path, kind: str, names: str, value: str) -> None:
    header = PLY.format("".join(f"property {kind} {name}\n" for name in names.split()))
    rows = [*(f"{x} {y} {z} {value}" for x, y, z in BOX), *("4 " + " ".join(map(str, quad)) for quad in QUADS)]
    (tmp_path / "a.ply").write_text(header + "\n".join(rows))
    found, notes = shown(tmp_path / "a.ply")
    assert np.allclose(found, [1, 0, 0]) and not notes


@pytest.mark.parametrize(
    ("name", "data", "reason", "words"),
    [
        ("a.ply", PLY.format("").replace("vertex 8", "vertex 9"), "unreadable", "line 23: 2 words after the last element"),
        ("a.ply", PLY.format("").replace("face 6", "face 5"), "unreadable", "line 23: 5 words after the last element"),
        ("a.ply", PLY.format("").replace("face 6", "face 0"), "unreadable", "30 words after the last element"),
        ("a.obj", "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", "unreadable", "a Git LFS pointer"),
        ("a.glb", "<!DOCTYPE html>\n<html><body>Log in</body></html>", "unreadable", "an HTML page"),
    ],
)
def test_what_does_not_fit_is_no_mesh(tmp_path: Path, name: str, data: str, reason: str, words: str) -> None:
    rows = [*(f"{x} {y} {z}" for x, y, z in BOX), *("4 " + " ".join(map(str, quad)) for quad in QUADS)]
    (tmp_path / name).write_text(data + "\n".join(rows) if name.endswith(".ply") else data)
    with pytest.raises(Reject) as caught:
        mesh_of(tmp_path / name)
    assert caught.value.reason == reason and words in caught.value.detail


LINEAR = 0.21586  # of the byte 128


@pytest.mark.parametrize(
    ("library", "colour", "note"),
    [
        ("newmtl my red\nKd 0.8 0.1 0\n", [0.8, 0.1, 0], None),
        ("newmtl\tmy red\n\tKd\t0.8\t0.1\t0 # a comment\r\n", [0.8, 0.1, 0], None),
        ("newmtl my red\nKd 0 0 0\n", [0, 0, 0], None),
        ("newmtl my red\nKd 0.5\n", [0.5] * 3, None),
        ("newmtl my red\nKd 204 26 0\n", [1, 1, 0], "reach 204"),
        ("newmtl my red\nKd 2.e-1 1.-e1 0\n", [0.2, 0.1, 0], None),
        ("newmtl my red\nKd spectral red.rfl\n", None, "is not three numbers"),
        ("newmtl my red\nKd a b c\n", None, "is not three numbers"),
        ("newmtl my red\n", None, None),
        ("newmtl other\nKd 1 0 0\n", None, "'my red' is in no library"),
        ("newmtl my red\nKd 0.8 0.1 0\nmap_Kd gone.png\n", None, "'gone.png' is missing"),
        ("newmtl my red\nmap_Kd -s 1 1 1 -o 0.5 0 0 -mm 0 1 gone away.png\n", None, "'gone away.png' is missing"),
    ],
)
def test_obj_colours(tmp_path: Path, library: str, colour, note: str | None) -> None:
    (tmp_path / "a.obj").write_bytes(HABITS["names-with-spaces.obj"])
    for encoding in ("utf-8", "utf-8-sig", "utf-16"):
        (tmp_path / "my colours.mtl").write_bytes(library.encode(encoding))
        found, notes = shown(tmp_path / "a.obj")
        assert np.isnan(found).all() if colour is None else np.allclose(found, colour, atol=1e-6)
        assert (note in "".join(notes)) if note else not notes
    for names in ("a.mtl my.mtl", "my.mtl"):  # several libraries in one line
        text = HABITS["names-with-spaces.obj"].replace(b"mtllib my colours.mtl", f"mtllib {names}".encode())
        (tmp_path / "a.obj").write_bytes(text)
        (tmp_path / "my.mtl").write_bytes(b"newmtl my red\nKd 0 1 0\n")
        assert np.allclose(shown(tmp_path / "a.obj")[0], [0, 1, 0])


@pytest.mark.parametrize(
    "name",
    ["with-colours.obj", "coff.off", "coff3.off", "cnoff.off", "face-colours.off", "face-alpha.off", "ascii-6.ply",
     "binary_little_endian-6.ply", "binary_big_endian-6.ply"],
)  # fmt: skip
def test_colours_of_vertices_and_faces_are_srgb(name: str, tmp_path: Path) -> None:
    """Orange, as (255, 128, 0) or (1, 0.5, 0): no format says so, but tools write what a screen shows."""
    (tmp_path / name).write_bytes(HABITS[name])
    found, notes = shown(tmp_path / name)
    assert np.allclose(found, [1, LINEAR, 0], atol=2e-3) and not notes


@pytest.mark.parametrize(
    ("name", "words"),
    [("some-colours.obj", "only some vertices"), ("face-index.off", "not three numbers for each face")],
)
def test_colours_that_are_not_read_are_said(name: str, words: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(HABITS[name])
    found, notes = shown(tmp_path / name)
    assert np.isnan(found).all() and any(words in note for note in notes)


# -- sizes that no mesh has


@pytest.mark.parametrize(
    ("points", "reason", "words"),
    [
        (BOX * 1e38, "too_large_extent", "coordinates up to 2e.38"),
        (BOX * 1e13, "too_large_extent", "scale it down"),
        (BOX * [1, 1e-9, 1e-9], "too_thin", "area"),
        (BOX * [0.5, 1e-7, 2e-7], "too_thin", "at least 1e-06"),
        (BOX * 1e-14, "degenerate", "scale it up"),
        (BOX * 1e-9 + 1e6, "degenerate", "move it to the origin"),
        (BOX * [1, 0, 0], "degenerate", "no triangle of it has an area"),
    ],
)
def test_sizes_are_refused_with_a_reason_of_their_own(points: np.ndarray, reason: str, words: str, tmp_path: Path) -> None:
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in points.tolist()] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in TRIANGLES]
    (tmp_path / "a.obj").write_text("\n".join(lines))
    with pytest.raises(Reject, match=f"{reason}: a.obj: .*{words}"):
        mesh_of(tmp_path / "a.obj")
    assert reason in Collect.reasons


def test_a_sliver_is_too_thin_and_a_leaf_is_not(tmp_path: Path) -> None:
    for height, accepted in ((1e-3, True), (1e-7, False)):
        (tmp_path / "a.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 0.5 {height!r} 0\nf 1 2 3\n")
        if accepted:
            assert len(mesh_of(tmp_path / "a.obj").faces) == 1
        else:
            with pytest.raises(Reject, match="too_thin"):
                mesh_of(tmp_path / "a.obj")
    (tmp_path / "b.obj").write_bytes(V.replace(" 0.5", " 0").encode() + F.encode())
    assert len(mesh_of(tmp_path / "b.obj").faces) == 4  # without thickness, but not thin in two directions


RINGS = {  # corners of a polygon in the plane, counter-clockwise, and its area
    "arrow": ([[0, 0], [2, 1], [0, 2], [0.5, 1]], 1.5),
    "arrow-turned": ([[2, 1], [0, 2], [0.5, 1], [0, 0]], 1.5),
    "hook": ([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]], 3.0),
    "hook-turned": ([[1, 1], [1, 2], [0, 2], [0, 0], [2, 0], [2, 1]], 3.0),
    "comb": ([[0, 0], [5, 0], [5, 2], [4, 2], [4, 1], [3, 1], [3, 2], [2, 2], [2, 1], [1, 1], [1, 2], [0, 2]], 8.0),
    "with-corners-in-line": ([[0, 0], [1, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2], [0, 1]], 3.0),
    "keyhole": ([[0, 0], [4, 0], [4, 4], [0, 4], [0, 0], [1, 1], [1, 3], [3, 3], [3, 1], [1, 1]], 12.0),
}


@pytest.mark.parametrize("name", RINGS)
def test_polygons_with_inward_corners_cover_their_area_once(name: str, tmp_path: Path) -> None:
    ring, area = RINGS[name]
    for turn in (
        [[1, 0, 0], [0, 1, 0]],
        [[0, 1, 0], [0, 0, 1]],
        [[0, 0, 1], [1, 0, 0]],
        [[-1, 0, 0], [0, 1, 0]],
        [[0, 0, 1], [0, 1, 0]],
    ):
        points = np.array(ring) @ np.array(turn, float)
        rows = [" ".join(map(str, p)) for p in points.tolist()]
        count = len(rows)
        (tmp_path / "a.off").write_text(
            f"OFF {count} 1 0\n" + "\n".join(rows) + f"\n{count} {' '.join(map(str, range(count)))}\n"
        )
        (tmp_path / "a.obj").write_text(
            "".join(f"v {row}\n" for row in rows) + f"f {' '.join(map(str, range(1, count + 1)))}\n"
        )
        for file in ("a.off", "a.obj"):
            mesh = mesh_of(tmp_path / file)
            normals = measure.normal_vectors(mesh.vertices[mesh.faces])
            assert np.linalg.norm(normals, axis=1).sum() / 2 == pytest.approx(area), (file, turn)
            assert np.allclose(normals.sum(axis=0) / 2, area * np.cross(*turn)), (file, turn)
