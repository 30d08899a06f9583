"""Where a glTF node's vertices stand: its morph targets, its skin, its instances (EXT_mesh_gpu_instancing).

What moves is drawn as its nodes stand without animation, and with the weights of morph targets that the file states. A skinned
mesh follows its joints alone, as glTF prescribes: the transform of its own node does not count.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pipeline.errors import Reject
from stages.graphics.geometry.formats.faults import at
from stages.graphics.geometry.formats.gltf import Gltf, Primitive, instances
from stages.graphics.geometry.formats.json_values import floats, integer, integers, items
from stages.graphics.geometry.formats.parts import Part, Source, checked_part


@dataclass
class Placed:
    """A primitive in its place.

    part: in the scene; triangles of a mirrored one are turned, so that they stay outward.
    linear: (3, 3), or (V, 3, 3) of each vertex, of what moved it there. normals: (V, 3) in the primitive's frame, or None.
    """

    part: Part
    linear: np.ndarray
    normals: np.ndarray | None

    @property
    def directions(self) -> np.ndarray | None:
        """(V, 3) normals in the scene, of any length."""
        return None if self.normals is None else (self.normals[:, None] @ np.linalg.pinv(self.linear))[:, 0]


class Poses:
    """The places of all nodes of a file. ``source.note`` gets what is said about them. normals: whether they are asked for."""

    def __init__(self, gltf: Gltf, source: Source, normals: bool = False):
        self.gltf, self.source, self.normals = gltf, source, normals
        self._to_scene: dict[int, np.ndarray] = {}

    def placed(self, index: int, to_scene: np.ndarray, primitive: Primitive) -> Iterator[Placed]:
        """A primitive of a node's mesh, in each of its places. to_scene: (4, 4) matrix of the node."""
        node = self.gltf.entry("nodes", index)
        name = str(node.get("name") or f"node {index}")[:80]
        points, normals = self._morphed(node, name, primitive)
        local = checked_part(points, primitive.triangles, primitive.vertex_place, primitive.triangle_place)
        skinned = self._skinned(node, name, primitive) if "skin" in node else None
        matrices = [skinned] if skinned is not None else [to_scene]
        with at(f"node {index}"):
            copies = instances(self.gltf, node)
        if copies is not None:
            self.source.note(f"{name!r}: {len(copies):,} instances (EXT_mesh_gpu_instancing)")
            matrices = to_scene @ copies
        for matrix in matrices:
            linear, move = matrix[..., :3, :3], matrix[..., :3, 3]
            with np.errstate(invalid="ignore", over="ignore"):
                if linear.ndim == 2:
                    points = local.points @ linear.T + move
                else:
                    points = np.einsum("vij,vj->vi", linear, local.points) + move
            turned = np.median(np.sign(np.linalg.det(linear))) < 0
            triangles = local.triangles[:, ::-1] if turned else local.triangles
            yield Placed(checked_part(points, triangles, primitive.vertex_place, primitive.triangle_place), linear, normals)

    def _morphed(self, node: dict, name: str, primitive: Primitive) -> tuple[np.ndarray, np.ndarray | None]:
        """Positions and normals of a primitive with its morph targets at the weights of the node, else of the mesh."""
        points, normals = primitive.points, None
        with at(primitive.place):
            if self.normals and primitive.has("NORMAL"):
                normals = primitive.attribute("NORMAL", 3)
            targets = items(primitive.entry, "targets")
            if not targets:
                return points, normals
            stated = next((entry for entry in (node, primitive.mesh) if "weights" in entry), {})
            weights = floats(stated, "weights", len(targets), [0] * len(targets))
            for number in np.flatnonzero(weights):
                if "POSITION" in targets[number]:
                    points = points + weights[number] * primitive.target(number, "POSITION")
                if "NORMAL" in targets[number] and normals is not None:
                    normals = normals + weights[number] * primitive.target(number, "NORMAL")
            self.source.note(f"{name!r} has shape keys: it is drawn with the file's weights, {weights.tolist()[:8]}")
        return points, normals

    def _skinned(self, node: dict, name: str, primitive: Primitive) -> np.ndarray | None:
        """(V, 4, 4) matrix of each vertex to the scene; None for a primitive without joints."""
        if not primitive.has("JOINTS_0"):
            self.source.note(f"{name!r} has a skin, but {primitive.place} no joints: it stands where its node does")
            return None
        self.source.note(f"{name!r} is moved by a skeleton: it is drawn as its joints stand without animation")
        joints = self._joints(integer(node, "skin"))
        matrices, total, number = np.zeros((len(primitive.points), 4, 4)), np.zeros(len(primitive.points)), 0
        with at(primitive.place):
            while primitive.has(f"JOINTS_{number}"):
                indices = primitive.attribute(f"JOINTS_{number}", 4)
                weights = primitive.attribute(f"WEIGHTS_{number}", 4).astype(np.float64)
                if indices.dtype.kind != "i":
                    raise Reject("unreadable", f"JOINTS_{number} are no whole numbers")
                if not np.isfinite(weights).all():
                    raise Reject("not_finite", f"WEIGHTS_{number} has a number that is not finite")
                wrong = (weights != 0) & (indices >= len(joints))
                if wrong.any():
                    raise Reject("bad_indices", f"JOINTS_{number}: joint {indices[wrong][0]} of {len(joints)}")
                for column in range(4):
                    used = np.where(weights[:, column] != 0, indices[:, column], 0)
                    matrices += weights[:, column, None, None] * joints[used]
                total += weights.sum(axis=1)
                number += 1
        loose = np.abs(total) < 1e-6  # held by no joint: viewers give them to the first
        matrices[loose], total[loose] = joints[0], 1
        return matrices / total[:, None, None]

    def _joints(self, number: int) -> np.ndarray:
        """(J, 4, 4) matrix of each joint of a skin: from the mesh's frame to the scene."""
        skins = items(self.gltf.tree, "skins")
        with at(f"skin {number}"):
            if number >= len(skins):
                raise Reject("unreadable", f"it does not exist, the file has {len(skins)}")
            joints = integers(skins[number], "joints")
            if not joints:
                raise Reject("unreadable", "it has no joints")
            self._to_scene = self._to_scene or dict(self.gltf.walk(self.gltf.roots()))
            for joint in joints:
                self.gltf.entry("nodes", joint)
            matrices = np.stack([self._to_scene[joint] for joint in joints])
            if "inverseBindMatrices" in skins[number]:
                inverse = self.gltf.accessor(integer(skins[number], "inverseBindMatrices"))
                if inverse.shape[1] != 16 or len(inverse) < len(joints):
                    raise Reject(
                        "unreadable", f"{len(inverse)} matrices of {inverse.shape[1]} numbers for {len(joints)} joints"
                    )
                if not np.isfinite(inverse).all():
                    raise Reject("not_finite", "inverseBindMatrices has a number that is not finite")
                matrices = matrices @ inverse[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1)
            return matrices
