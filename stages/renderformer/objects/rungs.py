"""The record of *decimate*: one mesh per budget that was reached. Loads no mesh library, because the scene stage imports it.

Members: ``f0512.npz`` (vertices (V, 3) float32, faces (F, 3) int32) per rung, named by its budget, and ``meta.json``
with ``rungs``: {"512": {faces, distance, kept, ...}}.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from pipeline.stage import Record
from stages.graphics.arrays import pack_arrays, pack_json, unpack_arrays

MEMBER = re.compile(r"f(\d+)\.npz\Z")


def rungs_record(id: str, rungs: Mapping[int, tuple[np.ndarray, np.ndarray]], meta: dict[str, Any]) -> Record:
    """A record of rungs: budget -> (vertices (V, 3), faces (F, 3))."""
    members = {
        f"f{budget:04d}.npz": pack_arrays({"vertices": vertices.astype(np.float32), "faces": faces.astype(np.int32)})
        for budget, (vertices, faces) in sorted(rungs.items())
    }
    return Record(id, {**members, "meta.json": pack_json(meta)})


def load_rungs(record: Record) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Rungs of a record: budget -> (vertices (V, 3) float32, faces (F, 3) int32), budgets ascending."""
    rungs = {}
    for name in sorted(record.members):
        match = MEMBER.match(name)
        if match:
            arrays = unpack_arrays(record.members[name])
            rungs[int(match[1])] = (arrays["vertices"], arrays["faces"])
    return dict(sorted(rungs.items()))


def rung_faces(meta: Mapping[str, Any]) -> dict[int, int]:
    """Number of faces of each rung, from a record's meta: budget -> faces, budgets ascending."""
    return {int(budget): rung["faces"] for budget, rung in sorted(meta["rungs"].items(), key=lambda pair: int(pair[0]))}
