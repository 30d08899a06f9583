"""Collect: what a stranger's file may contain, what counts as the same object, and how objects are split."""

from __future__ import annotations

import base64
import json
import struct
import sys
import types
from pathlib import Path

import numpy as np
import pytest

from pipeline.config import parse
from pipeline.errors import Reject, UserError
from pipeline.keys import blake
from pipeline.stage import Item
from stages.graphics.geometry import load, measure
from stages.graphics.geometry.formats import draco
from stages.graphics.geometry.records import MeshRecord
from stages.renderformer.objects import catalogue
from stages.renderformer.objects.procedural import FAMILIES
from stages.renderformer.s00_collect import Collect, mesh_files, objaverse_ids

LIMITS = {"max_bytes": 1 << 24, "max_faces": 50_000}
CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float) * [1.0, 2.0, 3.0] + [5, 0, 0]
FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1,
    5, 7], [1, 7, 3]]
)  # fmt: skip


def words(row: np.ndarray) -> str:
    return " ".join(repr(x) for x in row.tolist())


def obj(vertices: np.ndarray = CORNERS, faces: np.ndarray = FACES, head: str = "") -> bytes:
    lines = [
        head,
        *("v " + words(v) for v in vertices),
        *("f " + words(f + 1) for f in faces),
    ]
    return "\n".join(lines).encode() + b"\n"


def gltf(vertices: np.ndarray = CORNERS, faces: np.ndarray = FACES, uri: str | None = None, **changes: object) -> dict:
    """A minimal glTF of one part; the buffer inside unless a uri is given."""
    data = vertices.astype("<f4").tobytes() + faces.astype("<u4").tobytes()
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": 5126,
                "count": len(vertices),
                "type": "VEC3",
                "min": vertices.min(axis=0).tolist(),
                "max": vertices.max(axis=0).tolist(),
            },
            {"bufferView": 1, "componentType": 5125, "count": faces.size, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": vertices.size * 4},
            {"buffer": 0, "byteOffset": vertices.size * 4, "byteLength": faces.size * 4},
        ],
        "buffers": [
            {
                "byteLength": len(data),
                "uri": uri or "data:application/octet-stream;base64," + base64.b64encode(data).decode(),
            }
        ],
    }
    return {**tree, **changes}


def glb(tree: dict, binary: bytes = b"", claimed: int | None = None) -> bytes:
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<II", claimed or len(text), 0x4E4F534A) + text
    if binary:
        body += struct.pack("<II", len(binary), 0x004E4942) + binary
    return struct.pack("<III", 0x46546C67, 2, 12 + len(body)) + body


def ply(vertices: np.ndarray = CORNERS, faces: np.ndarray = FACES, claimed: int | None = None) -> bytes:
    head = (
        f"ply\nformat ascii 1.0\nelement vertex {claimed or len(vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = [words(v) for v in vertices] + ["3 " + words(f) for f in faces]
    return (head + "\n".join(rows) + "\n").encode()


def stl(vertices: np.ndarray = CORNERS, faces: np.ndarray = FACES, claimed: int | None = None) -> bytes:
    body = b"".join(bytes(12) + vertices[f].astype("<f4").tobytes() + bytes(2) for f in faces)
    return bytes(80) + struct.pack("<I", claimed or len(faces)) + body


def dumps(**changes: object) -> bytes:
    return json.dumps(gltf(**changes)).encode()


def graph(nodes: list[dict]) -> bytes:
    return dumps(nodes=nodes)


ZEROS = {"componentType": 5126, "type": "MAT4"}


def without_data(index: int, number: int, **changes: object) -> bytes:
    """A glTF with an accessor that stands for so many zeros."""
    accessors = gltf()["accessors"]
    accessors[index] = {k: v for k, v in accessors[index].items() if k != "bufferView"} | {"count": number} | changes
    return dumps(accessors=accessors)


NAN, HUGE, FAR = CORNERS.copy(), CORNERS * 1e20, CORNERS * 1e-9 + 1e6
NAN[3, 1] = np.nan
LINE = np.stack([np.linspace(0, 1, 8)] * 3, axis=1)

MALFORMED = {
    "empty.obj": (b"", "no_faces"),
    "points.obj": (obj(faces=FACES[:0]), "no_faces"),
    "nan.obj": (obj(NAN), "not_finite"),
    "past_end.obj": (obj(faces=FACES + 1), "bad_indices"),
    "line.obj": (obj(LINE), "degenerate"),
    "huge.obj": (obj(HUGE), "too_large_extent"),
    "far.obj": (obj(FAR), "degenerate"),
    "outside_materials.obj": (obj(head="mtllib ../../secret.mtl"), "unsafe_path"),
    "absolute_materials.obj": (obj(head="mtllib /etc/passwd"), "unsafe_path"),
    "faces_past_limit.stl": (stl(faces=np.repeat(FACES, 5000, axis=0)), "too_large"),
    "lies.stl": (stl(claimed=2**31), "unreadable"),
    "lies.ply": (ply(claimed=10**9), "unreadable"),
    "past_end.ply": (ply(faces=FACES + 2), "bad_indices"),
    "no_header.ply": (b"not a mesh at all", "unreadable"),
    "lies.off": (b"OFF\n1000000000 5 0\n0 0 0\n", "unreadable"),
    "no_header.off": (b"hello", "unreadable"),
    "cut.gltf": (dumps()[:300], "unreadable"),
    "list.gltf": (b"[]", "unsupported"),
    "version1.gltf": (dumps(asset={"version": "1.0"}), "unsupported"),
    "outside.gltf": (dumps(uri="../../secret.bin"), "unsafe_path"),
    "encoded.gltf": (dumps(uri="%2e%2e/%2e%2e/secret.bin"), "unsafe_path"),
    "absolute.gltf": (dumps(uri="/etc/passwd"), "unsafe_path"),
    "remote.gltf": (dumps(uri="https://example.org/x.bin"), "unsafe_path"),
    "file_uri.gltf": (dumps(uri="file:///etc/passwd"), "unsafe_path"),
    "missing.gltf": (dumps(uri="nowhere.bin"), "unreadable"),
    "other_suffix.gltf": (dumps(uri="data.dat"), "unsupported"),
    "zeros.gltf": (without_data(0, 10**12), "too_large"),
    "sparse_zeros.gltf": (without_data(0, 10**9, sparse={"count": 1}), "too_large"),
    "negative.gltf": (without_data(0, -5), "unreadable"),
    "unused_zeros.gltf": (dumps(accessors=[*gltf()["accessors"], {**ZEROS, "count": 10**9}]), "too_large"),
    "cycle.gltf": (graph([{"mesh": 0, "children": [1]}, {"children": [0]}]), "unreadable"),
    "own_child.gltf": (graph([{"mesh": 0, "children": [0]}]), "unreadable"),
    "two_parents.gltf": (graph([{"children": [1, 2]}, {"children": [2]}, {"mesh": 0}]), "unreadable"),
    "no_such_node.gltf": (graph([{"mesh": 0, "children": [7]}]), "unreadable"),
    "no_such_mesh.gltf": (graph([{"mesh": 7}]), "unreadable"),
    "many_instances.gltf": (graph([{"mesh": 0}] * 5000), "too_large"),
    "view_past_end.gltf": (dumps(bufferViews=[{"buffer": 0, "byteLength": 10**6}] * 2), "unreadable"),
    "short_buffer.gltf": (dumps(buffers=[{"byteLength": 240, "uri": "data:;base64,AAAA"}]), "unreadable"),
    "meshopt.gltf": (dumps(extensionsRequired=["EXT_meshopt_compression"]), "unsupported"),
    "cut.glb": (glb(gltf(), claimed=10**6), "unreadable"),
    "no_magic.glb": (b"\0" * 64, "unreadable"),
    "version1.glb": (struct.pack("<III", 0x46546C67, 1, 12), "unsupported"),
    "tiny.glb": (b"glTF", "unreadable"),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_files_give_their_reason(name: str, tmp_path: Path) -> None:
    root = tmp_path / "root"
    root.mkdir()
    (tmp_path / "secret.bin").write_bytes(bytes(4096))
    data, reason = MALFORMED[name]
    (root / name).write_bytes(data)
    with pytest.raises(Reject) as caught:
        load.load_mesh(root / name, root, **LIMITS)
    assert caught.value.reason == reason, caught.value
    assert reason in Collect.reasons


def test_deep_node_chains_are_read_or_refused_without_end(tmp_path: Path) -> None:
    nodes = [{"children": [i + 1]} for i in range(5_000)] + [{"mesh": 0}]
    (tmp_path / "deep.gltf").write_bytes(graph(nodes))
    try:
        assert len(load.load_mesh(tmp_path / "deep.gltf", tmp_path, **LIMITS).faces) == 12
    except Reject as reject:
        assert reject.reason in ("unreadable", "too_large")


def test_too_many_bytes(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_bytes(obj())
    with pytest.raises(Reject, match="too_large"):
        load.load_mesh(tmp_path / "a.obj", tmp_path, max_bytes=10, max_faces=100)


def test_links_out_of_the_folder_are_refused(tmp_path: Path) -> None:
    (tmp_path / "root").mkdir()
    (tmp_path / "a.obj").write_bytes(obj())
    (tmp_path / "root" / "b.obj").symlink_to(tmp_path / "a.obj")
    (tmp_path / "x.bin").write_bytes(CORNERS.astype("<f4").tobytes() + FACES.astype("<u4").tobytes())
    (tmp_path / "root" / "x.bin").symlink_to(tmp_path / "x.bin")
    (tmp_path / "root" / "c.gltf").write_bytes(dumps(uri="x.bin"))
    for name in ("b.obj", "c.gltf"):
        with pytest.raises(Reject, match="unsafe_path"):
            load.load_mesh(tmp_path / "root" / name, tmp_path / "root", **LIMITS)
    config = folder_config(tmp_path / "root")
    assert Collect().identity(config, lambda path: "read")["items"] == {"b.obj": "outside", "c.gltf": "read"}


def test_all_formats_load_the_same_box(tmp_path: Path) -> None:
    tree = gltf()
    binary = base64.b64decode(tree["buffers"][0].pop("uri").partition(",")[2])
    (tmp_path / "side.bin").write_bytes(binary)
    off = f"OFF\n8 12 0\n{chr(10).join(words(v) for v in CORNERS)}\n"
    off += "\n".join("3 " + words(f) for f in FACES) + "\n"
    files = {
        "a.obj": obj(),
        "b.ply": ply(),
        "c.stl": stl(),
        "d.off": off.encode(),
        "e.gltf": dumps(),
        "f.glb": glb(tree, binary),
        "g.gltf": dumps(uri="side.bin"),
    }
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
        mesh = load.load_mesh(tmp_path / name, tmp_path, **LIMITS)
        vertices = load.normalise(mesh.vertices)
        assert len(mesh.faces) == 12 and measure.volume(mesh.vertices, mesh.faces) == pytest.approx(6, rel=1e-5), name
        np.testing.assert_allclose(np.ptp(vertices, axis=0), np.array([1, 2, 3]) / 3, atol=1e-6)
        np.testing.assert_allclose(vertices.max(axis=0) + vertices.min(axis=0), 0, atol=1e-6)


def test_scene_graph_is_flattened_and_mirrored_parts_stay_outward(tmp_path: Path) -> None:
    nodes = [
        {"children": [1, 2], "scale": [2, 2, 2]},
        {"mesh": 0, "translation": [10, 0, 0]},
        {"mesh": 0, "scale": [-1, 1, 1]},
    ]
    (tmp_path / "a.gltf").write_bytes(graph(nodes))
    mesh = load.load_mesh(tmp_path / "a.gltf", tmp_path, **LIMITS)
    assert mesh.parts == 2 and len(mesh.faces) == 24
    assert measure.volume(mesh.vertices, mesh.faces) == pytest.approx(2 * 6 * 8, rel=1e-5)
    assert mesh.vertices[:, 0].max() == pytest.approx(2 * 16)


def test_parts_come_in_the_same_order_every_time(tmp_path: Path) -> None:
    """trimesh puts random letters into the names of nodes whose mesh has several primitives."""
    primitives = [{"attributes": {"POSITION": 0}, "indices": index} for index in (1, 2)]
    nodes = [{"mesh": 0, "name": "part", "translation": [x, 0, 0]} for x in range(6)]
    tree = gltf(nodes=nodes, scenes=[{"nodes": list(range(6))}], meshes=[{"primitives": primitives}])
    tree["accessors"].append({**tree["accessors"][1], "count": 18})
    (tmp_path / "a.gltf").write_bytes(json.dumps(tree).encode())
    first = load.load_mesh(tmp_path / "a.gltf", tmp_path, **LIMITS)
    assert first.parts == 12
    for _ in range(5):
        again = load.load_mesh(tmp_path / "a.gltf", tmp_path, **LIMITS)
        assert np.array_equal(first.vertices, again.vertices) and np.array_equal(first.faces, again.faces)


def test_draco_without_its_decoder_is_refused_by_name(shared_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = shared_data / "meshes" / "market"
    assert len(load.load_mesh(root / "barrel.gltf", root, **LIMITS).faces) == 306
    monkeypatch.setattr(draco.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(Reject, match="needs_draco.*DracoPy"):
        load.load_mesh(root / "barrel.gltf", root, **LIMITS)


def test_draco_data_may_not_hold_more_than_is_stated(tmp_path: Path) -> None:
    DracoPy = pytest.importorskip("DracoPy")
    index = np.arange(60 * 60).reshape(60, 60)
    corners = [index[:-1, :-1], index[1:, :-1], index[1:, 1:]], [index[:-1, :-1], index[1:, 1:], index[:-1, 1:]]
    faces = np.concatenate([np.stack(three, axis=-1).reshape(-1, 3) for three in corners])
    points = np.stack([index.ravel() // 60, index.ravel() % 60, 0 * index.ravel()], axis=1).astype(np.float32)
    for level in (0, 7):  # the sequential encoding and edgebreaker
        data = DracoPy.encode(points, faces, compression_level=level)
        for stated, fits in ((len(faces), True), (12, False)):
            tree = gltf()
            tree["meshes"][0]["primitives"][0]["extensions"] = {
                draco.EXTENSION: {"bufferView": 0, "attributes": {"POSITION": 0}}
            }
            tree["accessors"] = [
                {"componentType": 5126, "count": len(points), "type": "VEC3"},
                {"componentType": 5125, "count": 3 * stated, "type": "SCALAR"},
            ]
            tree["bufferViews"] = [{"buffer": 0, "byteLength": len(data)}]
            tree["buffers"] = [{"byteLength": len(data)}]
            (tmp_path / "a.glb").write_bytes(glb(tree, data + bytes(-len(data) % 4)))
            if fits:
                assert len(load.load_mesh(tmp_path / "a.glb", tmp_path, **LIMITS).faces) == len(faces)
            else:
                with pytest.raises(
                    Reject, match=f"unreadable: a.glb: .*buffer view 0: Draco data: {len(faces)} faces where 12 are stated"
                ):
                    load.load_mesh(tmp_path / "a.glb", tmp_path, **LIMITS)


def test_real_files_are_taken_as_their_readme_expects(shared_data: Path) -> None:
    root = shared_data / "meshes"
    refused = {
        "market/donut.gltf": "unreadable",
        "odd/inf_nan.obj": "not_finite",
        **{f"odd/{name}": "no_faces" for name in ("empty.stl", "empty.obj", "empty.ply", "empty_nodes.glb")},
        **{f"odd/{name}": "no_faces" for name in ("points_ascii.ply", "points_bin.ply")},
    }
    either = {f"odd/{name}" for name in ("notenoughindices.obj", "deg_faces.obj", "soup.stl", "busted.STL", "mirror.ply")}
    for name in mesh_files(folder_config(root)):
        try:
            load.load_mesh(root / name, root, 1 << 28, 2_000_000)
            assert name not in refused
        except Reject as reject:
            assert refused.get(name) == reject.reason or name in either, f"{name}: {reject}"


# -- the same object, splits


def shuffled(vertices: np.ndarray, faces: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """The same surface: unmerged vertices, another order of faces and first corners, noise as of a text format."""
    corners = vertices[faces][rng.permutation(len(faces))]
    corners = np.stack([np.roll(c, k, axis=0) for c, k in zip(corners, rng.integers(0, 3, len(corners)), strict=True)])
    points = corners.reshape(-1, 3).round(5) + rng.normal(0, 1e-6, (3 * len(corners), 3))
    return points, np.arange(len(points)).reshape(-1, 3)


def test_duplicates_are_found_whatever_the_order_and_the_noise() -> None:
    rng = np.random.default_rng(1)
    meshes: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for family in ("gear", "chair", "torus", "leaf"):
        for number in range(2):
            vertices, faces = FAMILIES[family](rng)
            meshes[f"{family}{number}"] = (load.normalise(vertices).astype(float), faces)
    for name in ("gear0", "leaf1"):
        vertices, faces = shuffled(*meshes[name], rng)
        meshes[f"{name}-copy"] = (load.normalise(vertices).astype(float), faces)
    ids = list(meshes)
    signatures = np.array([measure.signature(*meshes[name]) for name in ids])
    assert catalogue.find_duplicates(ids, signatures, meshes.__getitem__) == {
        "gear0-copy": "gear0",
        "leaf1-copy": "leaf1",
    }


def test_content_hash_ignores_order_only() -> None:
    rng = np.random.default_rng(0)
    vertices, faces = FAMILIES["star"](rng)
    vertices, order = vertices.astype(np.float32), rng.permutation(len(faces))
    turned = np.stack([np.roll(f, k) for f, k in zip(faces[order], rng.integers(0, 3, len(faces)), strict=True)])
    unmerged = vertices[turned].reshape(-1, 3), np.arange(len(faces) * 3).reshape(-1, 3)
    assert measure.content_hash(vertices, faces) == measure.content_hash(*unmerged)
    assert measure.content_hash(vertices, faces) != measure.content_hash(vertices * np.float32(1.001), faces)


def some(number: int) -> list[dict]:
    return [{"object_id": f"o{i}", "content_hash": blake(str(i).encode())} for i in range(number)]


@pytest.mark.parametrize("number", [6, 7, 20, 25, 101, 2000])
def test_every_split_has_objects_and_large_sets_a_tenth_of_them(number: int) -> None:
    splits = catalogue.fill_splits(some(number), {})
    counts = {name: list(splits.values()).count(name) for name in catalogue.SPLITS}
    assert len(splits) == number and min(counts.values()) >= 2
    assert number < 2000 or all(0.08 < counts[name] / number < 0.12 for name in ("test", "validation"))
    assert splits == catalogue.fill_splits(some(number)[::-1], {})


TOWARDS_TRAIN = {name: place for place, name in enumerate(("test", "validation", "train"))}


@pytest.mark.parametrize("held_share", [0.0, 0.1])
def test_growth_moves_no_object_towards_the_test(held_share: float) -> None:
    """Random sets that grow: objects only leave a split that they filled up, and nothing moves once none is."""
    filled_up = moved = 0
    for seed in range(300):
        rng = np.random.default_rng(seed)
        objects = [{"object_id": f"o{i}", "content_hash": rng.bytes(32).hex()} for i in range(200)]
        fraction = {o["object_id"]: catalogue.hash_fraction(o["content_hash"]) for o in objects}
        held = {o["object_id"]: ("test", "validation")[i % 2] for i, o in enumerate(objects) if rng.random() < held_share}
        before, settled = {}, False
        for number in np.cumsum(rng.integers(1, 12, 40)):
            inside = objects[: 5 + number]
            present = {o["object_id"]: held[o["object_id"]] for o in inside if o["object_id"] in held}
            try:
                splits = catalogue.fill_splits(inside, present)
            except UserError:
                assert not before  # what was enough is enough for ever
                continue
            assert all(splits[name] == split for name, split in present.items())
            for name, split in before.items():
                assert TOWARDS_TRAIN[splits[name]] >= TOWARDS_TRAIN[split]
                if splits[name] != split:
                    moved += 1
                    assert not settled and name not in held and fraction[name] >= catalogue.BOUNDS[split]
            by_hash = {n: next((s for s, b in catalogue.BOUNDS.items() if fraction[n] < b), "train") for n in splits}
            settled = settled or all(splits[n] == by_hash[n] for n in splits if n not in held)
            filled_up += not settled
            before = splits
    assert filled_up and moved


def test_a_folder_that_grows_keeps_its_splits() -> None:
    small, large = (catalogue.fill_splits(some(number), {}) for number in (40, 400))
    assert all(large[name] == split for name, split in small.items())


def test_a_duplicate_that_takes_an_objects_place_cannot_bring_it_to_the_test() -> None:
    """The file that sorts first stands for a surface; all files of that surface decide."""
    objects = some(100)
    splits = catalogue.fill_splits(objects, {})
    low = min(objects, key=lambda o: o["content_hash"])
    trained = next(o for o in objects if splits[o["object_id"]] == "train")
    new = {"object_id": "new", "content_hash": "0" + low["content_hash"][1:]}
    replaced = [new if o is trained else o for o in objects]
    assert catalogue.fill_splits(replaced, {})["new"] == "test"
    assert catalogue.fill_splits(replaced, {}, {"new": [trained["content_hash"]]})["new"] == "train"


def test_held_out_objects_keep_their_split() -> None:
    held = {f"o{i}": "test" for i in range(8)} | {"o9": "validation"}
    splits = catalogue.fill_splits(some(30), held)
    assert held.items() <= splits.items()
    others = catalogue.fill_splits(some(30), {})
    assert all(splits[name] == split for name, split in others.items() if name not in held)


@pytest.mark.parametrize("number", [0, 1, 5])
def test_too_few_meshes_are_an_error_that_counts(number: int) -> None:
    with pytest.raises(UserError, match=rf"{number} distinct usable meshes.*at least 6 in all"):
        catalogue.fill_splits(some(number), {})


# -- the stage


class FakeDraft:
    """As much of a draft as `finish` uses."""

    def __init__(self, records: dict[str, tuple[str, object]], files: Path):
        self.records, self.files, self.rejected, self.notes = records, files, [], {}

    def rows(self) -> list:
        return [types.SimpleNamespace(id=id, item=item) for id, (item, _) in self.records.items()]

    def read(self, id: str) -> object:
        return self.records[id][1]

    def reject(self, item: str, reason: str, detail: str) -> None:
        self.rejected.append((item, reason, detail))

    def note(self, name: str, value: object) -> None:
        self.notes[name] = value


def run(config: object, files: Path) -> FakeDraft:
    stage, records = Collect(), {}
    worker = stage.open(config, {}, {})
    for item in stage.items(config, {}):
        for record in stage.process(worker, item):
            records[record.id] = (item.id, record)
    draft = FakeDraft(records, files)
    stage.finish(config, {}, draft)
    return draft


def folder_config(path: Path, **changes: object) -> object:
    return parse(Collect.Config, {"name": "folder", "path": str(path), **changes}, "collect")


def test_folder_end_to_end(tmp_path: Path) -> None:
    source = tmp_path / "source"
    (source / "sub").mkdir(parents=True)
    (source / "README.md").write_text("| folder | licence |\n| --- | --- |\n| sub/ | CC0, by somebody |\n")
    rng = np.random.default_rng(0)
    for number in range(7):
        vertices, faces = FAMILIES["chair"](rng)
        (source / "sub" / f"Chair No. {number}.obj").write_bytes(obj(vertices, faces))
        if number == 3:
            (source / "again.stl").write_bytes(stl(vertices * 2 + 1, faces))
    draft = run(folder_config(source), tmp_path)
    objects = json.loads((tmp_path / "objects.json").read_bytes())
    assert draft.rejected == [("sub/Chair No. 3.obj", "duplicate", "same geometry as again.stl")]
    assert len(objects) == 7 and {o["split"] for o in objects} == {"train", "validation", "test"}
    assert {o["licence"] for o in objects} == {"CC0, by somebody", ""}
    first = objects[1]
    assert first["object_id"].startswith("chair-no-0-") and first["source"] == "sub/Chair No. 0.obj"
    record = MeshRecord.from_record(draft.read(first["object_id"]))
    assert record.vertices.dtype == np.float32 and np.ptp(record.vertices, axis=0).max() == pytest.approx(1)
    assert record.meta["content_hash"] == first["content_hash"]


def test_moving_a_folder_keeps_its_identity(tmp_path: Path) -> None:
    def hash_file(path: Path) -> str:
        return blake(Path(path).read_bytes())

    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.obj").write_bytes(obj())
        (tmp_path / name / "b.gltf").write_bytes(dumps(uri="b%20side.bin"))
        (tmp_path / name / "b side.bin").write_bytes(b"1234")
    stage = Collect()
    one, two = (stage.identity(folder_config(tmp_path / name), hash_file) for name in ("one", "two"))
    assert one == two and set(one["items"]) == {"a.obj", "b.gltf"} and set(one["items"]["b.gltf"][1]) == {"b side.bin"}
    (tmp_path / "two" / "b side.bin").write_bytes(b"1235")
    assert stage.identity(folder_config(tmp_path / "two"), hash_file) != one


def test_folder_errors_say_what_to_do(tmp_path: Path) -> None:
    stage = Collect()
    for config, words in (
        (parse(Collect.Config, {"name": "folder"}, "collect"), "collect.path=DIR"),
        (folder_config(tmp_path / "nowhere"), "is not a folder"),
        (folder_config(tmp_path), "holds no mesh"),
    ):
        with pytest.raises(UserError, match=words):
            list(stage.items(config, {}))


def test_procedural_families_are_held_out_whole(tmp_path: Path) -> None:
    config = parse(Collect.Config, {"name": "procedural", "per_family": 1, "test_families": ["mug"]}, "collect")
    draft = run(config, tmp_path)
    objects = json.loads((tmp_path / "objects.json").read_bytes())
    split = {o["family"]: o["split"] for o in objects}
    assert len(objects) == len(FAMILIES) >= 12 and not draft.rejected
    assert split["mug"] == "test" and split["gear"] == "validation"
    again = MeshRecord.from_record(next(iter(Collect().process(Collect().open(config, {}, {}), Item("vase-000")))))
    assert again.meta["content_hash"] == {o["family"]: o["content_hash"] for o in objects}["vase"]
    with pytest.raises(UserError, match="nonsense"):
        Collect().items(config.model_copy(update={"test_families": ["nonsense"]}), {})


@pytest.mark.parametrize("family", FAMILIES)
def test_family_members_are_sound_and_differ(family: str) -> None:
    rng = np.random.default_rng(7)
    first, second = (load.checked(*FAMILIES[family](rng), 50_000) for _ in range(2))
    assert len({measure.content_hash(load.normalise(v), f) for v, f in (first, second)}) == 2
    assert family == "leaf" or measure.volume(*first) > 0


def test_objaverse_uses_the_package_in_the_worker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.glb").write_bytes(glb(gltf()))
    package = types.ModuleType("objaverse")
    package.load_objects = lambda uids, download_processes: {u: str(tmp_path / "a.glb") for u in uids if u != "gone"}
    notes = {"license": "by", "viewerUrl": "https://x/y", "user": {"displayName": "N"}}
    package.load_annotations = lambda uids: {uid: notes for uid in uids}
    monkeypatch.setitem(sys.modules, "objaverse", package)
    (tmp_path / "ids.txt").write_text("u2\nu1\n")
    config = parse(Collect.Config, {"name": "objaverse", "ids": ["gone"], "ids_file": str(tmp_path / "ids.txt")}, "collect")
    stage = Collect()
    assert objaverse_ids(config) == ["gone", "u1", "u2"] == list(stage.identity(config, blake)["items"])
    worker = stage.open(config, {}, {})
    meta = MeshRecord.from_record(next(iter(stage.process(worker, Item("u1"))))).meta
    assert meta["licence"] == "by" and meta["origin"] == "https://x/y by N" and meta["source"] == "objaverse/u1"
    assert meta["download_hash"] == blake((tmp_path / "a.glb").read_bytes())
    with pytest.raises(Reject, match="unavailable"):
        list(stage.process(worker, Item("gone")))
