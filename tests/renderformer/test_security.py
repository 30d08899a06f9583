"""What strangers' files must not be able to do: read or write outside their folder, run code, take memory on their word.

docs/security.md says what is trusted and where each limit stands. Meshes: test_collect.py and test_textures.py. Shards and
their index: test_dataset.py too.
"""

from __future__ import annotations

import ast
import dataclasses
import io
import json
import os
import pickle
import struct
import tarfile
import zipfile
from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import Reject, UserError
from stages.graphics.arrays import unpack_arrays
from stages.renderformer.dataset.encoding import decode_scene
from stages.renderformer.scenes.released import load_scene
from tests.renderformer import fakes

ROOT = Path(__file__).resolve().parents[2]
CAMERA = {"position": [0, -2, 0], "look_at": [0, 0, 0], "up": [0, 0, 1], "fov": 40}
BOX = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\n"


class Bomb:
    """Unpickling it writes a file."""

    def __init__(self, mark: Path):
        self.mark = mark

    def __reduce__(self):
        return os.mkdir, (str(self.mark),)


# -- code


FORBIDDEN = {"pickle", "cPickle", "marshal", "shelve", "dill", "cloudpickle", "joblib", "yaml"}
UNPICKLERS = {  # whose readers make nothing that a pickle asks for, but arrays of numbers
    "stages/neuras/captures/pickles.py",  # PandaSet's tables
    "model/pickles.py",  # published weights
}
CALLS = {"eval", "exec", "extractall", "unpack_archive", "os.system", "os.popen"}


def test_no_module_unpickles_unpacks_archives_or_runs_text():
    for package in ("pipeline", "stages", "model"):
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_bytes())):
                where = f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 0)}"
                if isinstance(node, (ast.Import, ast.ImportFrom)):
                    names = {alias.name for alias in node.names} | {getattr(node, "module", None) or ""}
                    used = {name.split(".")[0] for name in names} & FORBIDDEN
                    assert not used or path.relative_to(ROOT).as_posix() in UNPICKLERS, where
                if isinstance(node, ast.Call):
                    name = ast.unparse(node.func)
                    options = {keyword.arg: getattr(keyword.value, "value", None) for keyword in node.keywords}
                    assert name not in CALLS and name.rpartition(".")[2] not in ("extractall", "unpack_archive"), where
                    assert not options.get("shell"), where
                    assert name != "torch.load" or options.get("weights_only") is True, where
                    assert name != "np.load" or options.get("allow_pickle") is False, where


def test_pickles_in_checkpoints_are_refused(tmp_path):
    torch = pytest.importorskip("torch")
    from model.lpips import LPIPS, NETWORKS

    for file in NETWORKS["vgg"]["files"]:
        torch.save({"weights": Bomb(tmp_path / "mark")}, tmp_path / file.published)
    with pytest.raises(ValueError, match="is no file of tensors.*(?i:weights.only|unsupported)"):
        LPIPS.load(tmp_path)
    for file in NETWORKS["vgg"]["files"]:  # under the name of a format that holds no programs
        (tmp_path / file.published).rename(tmp_path / file.name)
    with pytest.raises(ValueError, match="is no file of tensors"):
        LPIPS.load(tmp_path)
    assert not (tmp_path / "mark").exists()


def test_object_arrays_are_refused(tmp_path):
    buffer = io.BytesIO()
    np.savez(buffer, vertices=np.array([Bomb(tmp_path / "mark")], dtype=object))
    with pytest.raises(ValueError, match="pickle"):
        unpack_arrays(buffer.getvalue())
    with pytest.raises(UserError, match="cannot be decoded"):
        decode_scene("a", buffer.getvalue(), b"{}")
    assert pickle.dumps(Bomb(tmp_path)) and not (tmp_path / "mark").exists()


# -- scene files


def json_scene(folder: Path, mesh: str, data: bytes | None = None) -> Path:
    folder.mkdir(exist_ok=True)
    if data is not None:
        (folder / mesh).write_bytes(data)
    entry = {"mesh_path": mesh, "material": {}, "transform": {}}
    (folder / "scene.json").write_text(json.dumps({"objects": {"a": entry}, "cameras": [CAMERA]}))
    return folder / "scene.json"


def gltf(**changes: object) -> bytes:
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
        {"bufferView": 1, "componentType": 5125, "count": 9, "type": "SCALAR"},
    ]
    tree = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}], "accessors": accessors,
        "bufferViews": [{"buffer": 0, "byteLength": 48}, {"buffer": 0, "byteOffset": 48, "byteLength": 36}],
        "buffers": [{"byteLength": 84, "uri": "../secret.bin"}],
    }  # fmt: skip
    return json.dumps({**tree, **changes}).encode()


@pytest.fixture
def secrets(tmp_path):
    """What lies beside the folder of the scene: complete, so that only a refusal keeps it from being read."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], "<f4").tobytes()
    (tmp_path / "secret.bin").write_bytes(corners + np.array([0, 1, 2, 0, 1, 3, 0, 2, 3], "<u4").tobytes())
    (tmp_path / "secret.obj").write_bytes(BOX)
    return tmp_path


def test_a_plain_scene_loads(secrets):
    assert len(load_scene(json_scene(secrets / "in", "a.obj", BOX)).triangles) == 3


@pytest.mark.parametrize(
    ("mesh", "data", "message"),
    [
        ("../secret.obj", None, "leads out"),
        ("a.gltf", gltf(), "cannot be read as a mesh"),
        ("a.gltf", gltf(accessors=[{"componentType": 5126, "count": 10**12, "type": "VEC3"}] * 2), "too_large"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 9000000000\nend_header\n", "states 9000000000"),
        ("a.stl", bytes(80) + struct.pack("<I", 2**31) + bytes(100), "states 2147483648"),
        ("a.zip", b"PK\3\4", "of no kind that is read"),
        ("a.3mf", b"PK\3\4", "of no kind that is read"),
    ],
)
def test_meshes_of_json_scenes_stay_inside_and_within_limits(secrets, mesh, data, message):
    with pytest.raises(UserError, match=message):
        load_scene(json_scene(secrets / "in", mesh, data))


def test_a_material_library_outside_the_folder_is_not_opened(secrets):
    (secrets / "secret.mtl").write_text("newmtl x\nKd 1 0 0\n")
    before = os.stat(secrets / "secret.mtl").st_atime_ns
    os.utime(secrets / "secret.mtl", ns=(0, 0))
    load_scene(json_scene(secrets / "in", "a.obj", b"mtllib ../secret.mtl\nusemtl x\n" + BOX))
    assert os.stat(secrets / "secret.mtl").st_atime_ns == 0 != before


def test_json_without_end_is_an_error_of_the_file(tmp_path):
    from stages.renderformer.s03_import import is_scene, meshes_of

    path = tmp_path / "deep.json"
    path.write_text("[" * 200_000)
    with pytest.raises(UserError, match="deep.json"):
        load_scene(path)
    assert is_scene(path) and meshes_of(path) == []


def hdf5(path: Path, **odd: object) -> Path:
    """A scene in the released format in which ``odd`` fields are made by a function of the file."""
    h5py = pytest.importorskip("h5py")
    fields = {
        "triangles": np.random.default_rng(0).random((4, 3, 3)), "vn": np.ones((4, 3, 3)), "texture": np.ones((4, 13)),
        "c2w": np.eye(4)[None], "fov": np.array([40.0]),
    }  # fmt: skip
    with h5py.File(path, "w") as file:
        for name, values in fields.items():
            if name in odd:
                odd[name](file)
            else:
                file[name] = values.astype(np.float32)
    return path


def outside(kind: str, folder: Path):
    import h5py

    other, raw = folder / "secret.h5", folder / "secret.raw"
    with h5py.File(other, "w") as file:
        file["triangles"] = np.ones((4, 3, 3), np.float32)
    raw.write_bytes(bytes(144))
    layout = h5py.VirtualLayout((4, 3, 3), "f4")
    layout[:] = h5py.VirtualSource(str(other), "triangles", (4, 3, 3))
    return {
        "external link": lambda f: f.__setitem__("triangles", h5py.ExternalLink(str(other), "triangles")),
        "external storage": lambda f: f.create_dataset("triangles", (4, 3, 3), "f4", external=[(str(raw), 0, 144)]),
        "virtual": lambda f: f.create_virtual_dataset("triangles", layout),
        "group": lambda f: f.create_group("triangles"),
        "text": lambda f: f.create_dataset("triangles", data=np.array([b"x"] * 4)),
    }[kind]


@pytest.mark.parametrize("kind", ["external link", "external storage", "virtual", "group", "text"])
def test_hdf5_scenes_hold_their_own_numbers(tmp_path, kind):
    assert len(load_scene(hdf5(tmp_path / "plain.h5")).triangles) == 4
    path = hdf5(tmp_path / "odd.h5", triangles=outside(kind, tmp_path))
    with pytest.raises(UserError, match="triangles is not a dataset of numbers in the file itself"):
        load_scene(path)


def test_hdf5_claims_are_not_believed(tmp_path):
    path = hdf5(tmp_path / "a.h5", texture=lambda f: f.create_dataset("texture", (10**9, 13), "f4", chunks=(1000, 13)))
    assert path.stat().st_size < 10**5
    with pytest.raises(UserError, match="texture claims 52,000,000,000 bytes"):
        load_scene(path)


def test_linked_scenes_outside_the_folder_are_not_imported(tmp_path):
    from stages.renderformer.s03_import import ImportConfig, ImportScene

    (tmp_path / "in").mkdir()
    hdf5(tmp_path / "secret.h5")
    (tmp_path / "in" / "a.h5").symlink_to(tmp_path / "secret.h5")
    config, stage = ImportConfig(path=str(tmp_path / "in")), ImportScene()
    assert stage.identity(config, lambda path: "read")["items"] == {"a.h5": "outside"}
    (item,) = stage.items(config, {})
    with pytest.raises(Reject, match="leads out of the folder"):
        list(stage.process(config, item))


# -- images, arrays, checkpoints: headers that claim too much


def exr(side: int, channels: int) -> bytes:
    """A small EXR file whose header claims to be large."""
    import OpenEXR

    buffer = io.BytesIO()
    pixels = {f"c{i}": np.zeros((8, 8), np.float32) for i in range(channels)}
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, pixels, 0).write(buffer)
    return buffer.getvalue().replace(struct.pack("<4i", 0, 0, 7, 7), struct.pack("<4i", 0, 0, side - 1, side - 1))


def test_exr_claims_are_not_believed(tmp_path):
    from stages.graphics.exr import claimed_bytes, read_rgb

    path = tmp_path / "a.exr"
    path.write_bytes(exr(16384, 40))
    with pytest.raises(UserError, match="claims to hold"):
        read_rgb(path)
    path.write_bytes(exr(20000, 1))
    with pytest.raises(UserError, match="not an OpenEXR image"):
        read_rgb(path)
    assert 8 * 8 * 4 * 3 <= claimed_bytes(exr(8, 3)) <= 2 * 8 * 8 * 4 * 3


def test_a_picture_is_a_png_or_nothing(tmp_path):
    """Pillow would hand an EPS file to another program, whatever its name ends in."""
    from stages.renderformer.inference.compare import read_image

    (tmp_path / "a.png").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n%%EndComments\nshowpage\n")
    with pytest.raises(UserError, match="cannot identify"):
        read_image(tmp_path / "a.png")


def npz(shape: tuple[int, ...]) -> bytes:
    buffer, head = io.BytesIO(), io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f4", "fortran_order": False, "shape": shape})
    with zipfile.ZipFile(buffer, "w") as file:
        file.writestr("vertices.npy", head.getvalue() + bytes(64))
    return buffer.getvalue()


def test_npz_claims_are_not_believed():
    for count in (10**9, 10**15):
        with pytest.raises(ValueError):
            unpack_arrays(npz((count,)))
        with pytest.raises(UserError, match="cannot be decoded"):
            decode_scene("a", npz((count,)), b"{}")


def test_checkpoint_claims_are_not_believed(tmp_path):
    checkpoint = pytest.importorskip("model.renderformer.checkpoint")
    from safetensors.numpy import save_file

    from model.renderformer.config import ModelConfig

    wide = {"latent_dim": 6 * 10**6, "view_transformer_latent_dim": 6 * 10**6, "dim_feedforward": 10**7}
    for changes, message in (
        ({"num_layers": 10**9}, "asks for 100000000. layers"),
        (wide, "unknown parameter x0, x1"),
    ):
        config = dataclasses.replace(ModelConfig(), **changes)
        (tmp_path / "config.json").write_text(config.dumps())
        save_file(
            {"tri_token": np.zeros((1, 1, 768), np.float32), **{f"x{i}": np.zeros(1) for i in range(20)}},
            tmp_path / "model.safetensors",
        )
        with pytest.raises(ValueError, match=message):
            checkpoint.load(tmp_path)
    for header in (struct.pack("<Q", 2**62), struct.pack("<Q", 64) + b"{" * 64, struct.pack("<Q", 10**8) + b"{}"):
        (tmp_path / "model.safetensors").write_bytes(header)
        with pytest.raises(ValueError, match="not a safetensors file"):
            checkpoint.load(tmp_path)


# -- datasets from elsewhere


@pytest.fixture
def dataset(tmp_path):
    _, artifact = fakes.sharded(tmp_path / "made")
    return artifact.path


@pytest.mark.parametrize("field", ["id", "shard", "split"])
def test_names_in_an_index_cannot_leave_the_folder(dataset, tmp_path, field):
    from stages.renderformer.dataset.interchange import export

    index, shards = dataset / "files" / "index.jsonl", dataset / "files" / "shards.json"
    rows = [json.loads(line) for line in index.read_text().splitlines()]
    evil = "../../escaped"
    for row in rows:
        row[field] = evil if field != "shard" else f"{evil}.tar"
    index.write_text("".join(json.dumps(row) + "\n" for row in rows))
    if field == "split":
        listed = json.loads(shards.read_text())
        shards.write_text(json.dumps({evil: next(iter(listed.values()))}))
    with pytest.raises(UserError, match="escaped"):
        list(export(dataset, tmp_path / "a" / "b" / "out"))
    assert not list(tmp_path.rglob("*escaped*"))


def test_members_of_a_shard_are_never_files(dataset, tmp_path):
    """A shard's tar is read by offset: names in it lead nowhere."""
    from stages.renderformer.dataset import ShardDataset

    shard = next((dataset / "parts").glob("*.tar"))
    with tarfile.open(shard) as tar:
        old = tar.getnames()[0]
    data = shard.read_bytes()
    shard.write_bytes(data.replace(old.encode(), b"../" * 3 + b"x" * (len(old) - 9), 1))
    for split in ("train", "validation", "test"):
        try:
            samples = ShardDataset(dataset, split)
        except UserError:
            continue
        for index in range(len(samples)):
            samples.read(index)
    assert {path.name for path in tmp_path.iterdir()} == {"made"}
