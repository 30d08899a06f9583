"""Triangles that a glTF keeps compressed with Draco (KHR_draco_mesh_compression), decoded by DracoPy."""

from __future__ import annotations

import importlib.util

import numpy as np

from pipeline.errors import Reject
from stages.graphics.geometry.formats.faults import at

EXTENSION = "KHR_draco_mesh_compression"


def require_decoder() -> None:
    """Reject ``needs_draco`` where DracoPy is not installed."""
    if importlib.util.find_spec("DracoPy") is None:
        raise Reject("needs_draco", "requires Draco compression: install the package DracoPy")


def decode(data: bytes, stated_faces: int) -> tuple[np.ndarray, dict[int, np.ndarray]]:
    """(F, 3) triangles, and attribute values by Draco's id, (V, n) as stored.

    A few kilobytes of Draco can hold millions of faces. Their header may not claim more than the accessors, which count
    against the limit.
    """
    require_decoder()
    import DracoPy

    with at("Draco data"):
        faces = claimed_faces(data[:64])
        if faces > stated_faces:
            raise Reject("unreadable", f"{faces} faces where {stated_faces} are stated")
        mesh = DracoPy.decode(data)
        values = {attribute["unique_id"]: np.asarray(attribute["data"]) for attribute in mesh.attributes}
        return np.asarray(mesh.faces, np.int64).reshape(-1, 3), values


def claimed_faces(head: bytes) -> int:
    """Faces that a Draco mesh claims to hold, from its first bytes (bitstream 2.2, which glTF prescribes)."""
    if head[:5] != b"DRACO" or tuple(head[5:8]) != (2, 2, 1):
        raise Reject("unsupported", "not a Draco mesh of bitstream 2.2")
    if head[10] & 0x80:  # metadata comes first, of any length: the worker's limits must do
        return 0
    numbers, position = [], 11 + head[8]  # sequential: faces, points; edgebreaker: a byte, points, faces
    for _ in range(2):
        value = shift = 0
        while True:
            byte, position = head[position], position + 1
            value, shift = value | (byte & 127) << shift, shift + 7
            if byte < 128:
                break
        numbers.append(value)
    return numbers[head[8]]
