"""What moves in a glTF stands as the file says: morph weights, skins, instances. And what is compressed is named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.errors import Reject
from stages.graphics.geometry.load import Loaded, load_mesh
from stages.renderformer.importing.gltf import read_gltf
from tests.graphics.habits import BOX, TRIANGLES
from tests.graphics.malformed import glb

KINDS = {"f4": 5126, "u2": 5123, "u1": 5121, "i1": 5120}
SHAPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
QUARTER = [0, 0, np.sqrt(0.5), np.sqrt(0.5)]  # a turn by 90 degrees about z


class Made:
    """A box of `habits` in a glTF that a test adds to."""

    def __init__(self) -> None:
        self.data = b""
        self.primitive: dict[str, Any] = {"attributes": {}}
        self.mesh: dict[str, Any] = {"primitives": [self.primitive]}
        self.node: dict[str, Any] = {"mesh": 0, "name": "Box"}
        self.tree: dict[str, Any] = {
            "asset": {"version": "2.0"}, "nodes": [self.node], "meshes": [self.mesh], "accessors": [], "bufferViews": [],
        }  # fmt: skip
        self.primitive["attributes"]["POSITION"] = self.accessor(BOX, "f4")
        self.primitive["indices"] = self.accessor(TRIANGLES.ravel(), "u2")

    def accessor(self, values: Any, kind: str, normalized: bool = False) -> int:
        values = np.asarray(values).astype(f"<{kind}")
        width = 1 if values.ndim == 1 else values.shape[1]
        self.data += b"\0" * (-len(self.data) % 4)
        self.tree["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": values.nbytes})
        self.data += values.tobytes()
        self.tree["accessors"].append(
            {"bufferView": len(self.tree["bufferViews"]) - 1, "componentType": KINDS[kind], "count": len(values),
             "type": SHAPES[width], "normalized": normalized}
        )  # fmt: skip
        return len(self.tree["accessors"]) - 1

    def write(self, tmp_path: Path) -> Path:
        (tmp_path / "made.glb").write_bytes(glb({**self.tree, "buffers": [{"byteLength": len(self.data)}]}, self.data))
        return tmp_path / "made.glb"

    def read(self, tmp_path: Path, max_faces: int = 50_000) -> Loaded:
        return load_mesh(self.write(tmp_path), tmp_path, 1 << 24, max_faces, True)


def same_points(found: np.ndarray, expected: np.ndarray) -> bool:
    """Whether both are the same set of points."""
    distances = np.linalg.norm(found[:, None] - expected[None], axis=2)
    return bool((distances.min(axis=0) < 1e-5).all() and (distances.min(axis=1) < 1e-5).all())


@pytest.mark.parametrize("weights_of", ["node", "mesh", "neither"])
def test_morph_targets_are_added_by_the_stated_weights(weights_of: str, tmp_path: Path) -> None:
    made = Made()
    up, aside = np.zeros((8, 3)), np.zeros((8, 3))
    up[BOX[:, 1] > 0] = [0, 2, 0]
    aside[:, 0] = 5
    made.primitive["targets"] = [{"POSITION": made.accessor(shift, "f4")} for shift in (up, aside)]
    if weights_of != "neither":
        made.mesh["weights"] = [0, 1]
        getattr(made, weights_of)["weights"] = [0.5, 0]  # the node's go before the mesh's
    loaded = made.read(tmp_path)
    assert same_points(loaded.vertices, BOX + (0 if weights_of == "neither" else 0.5) * up)
    assert any("'Box' has shape keys" in note for note in loaded.notes)


def test_a_skinned_mesh_follows_its_joints_and_not_its_node(tmp_path: Path) -> None:
    """The right end hangs on a joint that turns and moves; the mesh's own node is far away, which does not count."""
    made = Made()
    right = BOX[:, 0] > 0
    made.primitive["attributes"] |= {
        "JOINTS_0": made.accessor(np.where(right[:, None], [[1, 0, 0, 0]], [[0, 9, 0, 0]]), "u1"),  # 9 has no weight
        "WEIGHTS_0": made.accessor(np.tile([[200, 0, 0, 0]], (8, 1)), "u1", normalized=True),  # not a sum of one
    }
    inverse = np.tile(np.eye(4), (2, 1, 1))
    inverse[1, :3, 3] = [-1, 0, 0]
    made.node |= {"skin": 0, "translation": [100, 0, 0], "scale": [3, 3, 3]}
    made.tree["nodes"] += [{"translation": [0, 1, 0], "children": [2]}, {"translation": [1, 0, 0], "rotation": QUARTER}]
    made.tree["scenes"], made.tree["scene"] = [{"nodes": [0, 1]}], 0
    columns = inverse.transpose(0, 2, 1).reshape(2, 16)
    made.tree["skins"] = [{"joints": [1, 2], "inverseBindMatrices": made.accessor(columns, "f4")}]
    expected = BOX + [0, 1, 0]
    moved = BOX[right] - [1, 0, 0]
    expected[right] = np.stack([-moved[:, 1] + 1, moved[:, 0] + 1, moved[:, 2]], axis=1)
    loaded = made.read(tmp_path)
    assert same_points(loaded.vertices, expected)
    assert any("'Box' is moved by a skeleton" in note for note in loaded.notes)
    scene = read_gltf(made.write(tmp_path))
    assert same_points(scene.parts[0].corners.reshape(-1, 3), expected)


def test_instances_are_placed_and_counted(tmp_path: Path) -> None:
    made = Made()
    attributes = {
        "TRANSLATION": made.accessor([[0, 0, 0], [10, 0, 0], [0, 10, 0]], "f4"),
        "ROTATION": made.accessor([[0, 0, 0, 127]] * 2 + [[0, 0, 90, 90]], "i1", normalized=True),
        "SCALE": made.accessor([[1, 1, 1], [2, 1, 1], [-1, 1, 1]], "f4"),
    }
    made.node |= {"extensions": {"EXT_mesh_gpu_instancing": {"attributes": attributes}}, "scale": [1, 1, 2]}
    made.tree["extensionsRequired"] = ["EXT_mesh_gpu_instancing"]
    copies = [BOX, BOX * [2, 1, 1] + [10, 0, 0], np.stack([-BOX[:, 1], -BOX[:, 0] + 10, BOX[:, 2]], axis=1)]
    expected = np.concatenate(copies) * [1, 1, 2]
    loaded = made.read(tmp_path)
    assert same_points(loaded.vertices, expected) and len(loaded.faces) == 36
    volumes = np.linalg.det(loaded.vertices[loaded.faces]) / 6
    assert volumes.sum() == pytest.approx(2 * 4 * np.prod(np.ptp(BOX, axis=0)), rel=1e-4)  # the mirrored one is outward too
    assert any("'Box': 3 instances" in note for note in loaded.notes)
    assert len(read_gltf(made.write(tmp_path)).parts) == 3
    with pytest.raises(Reject, match="states 36 faces, at most 30") as caught:
        made.read(tmp_path, max_faces=30)
    assert caught.value.reason == "too_large"


def test_hidden_nodes_are_not_drawn(tmp_path: Path) -> None:
    made = Made()
    hidden = {"extensions": {"KHR_node_visibility": {"visible": False}}, "children": [2]}
    made.tree["nodes"] += [hidden, {"mesh": 0, "translation": [9, 0, 0]}]
    assert same_points(made.read(tmp_path).vertices, BOX)
    hidden["extensions"]["KHR_node_visibility"]["visible"] = True
    assert len(made.read(tmp_path).faces) == 24


def test_normals_turn_with_what_moves(tmp_path: Path) -> None:
    made = Made()
    made.primitive["attributes"] |= {
        "NORMAL": made.accessor(np.tile([[1, 0, 0]], (8, 1)), "f4"),
        "JOINTS_0": made.accessor(np.zeros((8, 4)), "u1"),
        "WEIGHTS_0": made.accessor(np.tile([[1, 0, 0, 0]], (8, 1)), "f4"),
    }
    made.node["skin"] = 0
    made.tree["nodes"].append({"rotation": QUARTER, "scale": [2, 1, 1]})
    made.tree["skins"] = [{"joints": [1]}]
    normals = read_gltf(made.write(tmp_path)).parts[0].normals.reshape(-1, 3)
    assert np.allclose(normals / np.linalg.norm(normals, axis=1, keepdims=True), [0, 1, 0], atol=1e-6)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda made: made.tree.update(skins=[]), "skin 0: it does not exist, the file has 0"),
        (lambda made: made.tree["skins"][0].update(joints=[5]), "node 5 does not exist"),
        (lambda made: made.tree["skins"][0].update(inverseBindMatrices=0), "skin 0: 8 matrices of 3 numbers for 1 joints"),
        (lambda made: made.primitive["attributes"].update(JOINTS_0=made.accessor(np.full((8, 4), 3), "u1")), "joint 3 of 1"),
        (lambda made: made.primitive.update(targets=[{"POSITION": 1}]) or made.mesh.update(weights=[1]), "type SCALAR"),
        (lambda made: made.primitive.update(targets=[{}]) or made.mesh.update(weights=[1, 2]), "weights is '[1, 2]'"),
    ],
)
def test_what_is_wrong_is_named(change, words: str, tmp_path: Path) -> None:
    made = Made()
    made.primitive["attributes"] |= {
        "JOINTS_0": made.accessor(np.zeros((8, 4)), "u1"),
        "WEIGHTS_0": made.accessor(np.tile([[1, 0, 0, 0]], (8, 1)), "f4"),
    }
    made.node["skin"], made.tree["skins"] = 0, [{"joints": [0]}]
    change(made)
    with pytest.raises(Reject) as caught:
        made.read(tmp_path)
    assert words in caught.value.detail


@pytest.mark.parametrize("required", [True, False])
def test_meshopt_names_what_takes_it_away(required: bool, tmp_path: Path) -> None:
    made = Made()
    if required:
        made.tree["extensionsRequired"] = ["EXT_meshopt_compression"]
    buffers = [
        {"byteLength": len(made.data)},
        {"byteLength": 96, "extensions": {"EXT_meshopt_compression": {"fallback": True}}},
    ]
    (tmp_path / "a.glb").write_bytes(glb({**made.tree, "buffers": buffers}, made.data))
    with pytest.raises(Reject, match="EXT_meshopt_compression: write it without that compression, as `gltfpack") as caught:
        load_mesh(tmp_path / "a.glb", tmp_path, 1 << 24, 50_000)
    assert caught.value.reason == "unsupported"
