"""A watertight mesh to a ladder of face budgets by quadric edge collapse (QSlim; paper section 3.3).

pymeshlab with topology and normals preserved and planar quadrics weighted: it gives the paper's triangles of roughly
equal size. A rung is kept only when it is watertight, not above its budget and close enough; what misses is tried again
from a coarser grid.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from stages.geometry import measure

Mesh = tuple[np.ndarray, np.ndarray]  # (V, 3) float64, (F, 3) int64


@dataclass
class Rung:
    """One accepted mesh and what was measured of it."""

    vertices: np.ndarray
    faces: np.ndarray
    measures: dict[str, Any]


@dataclass
class Gates:
    """What a rung must fulfil; ``last`` says what the last refused one did not."""

    reference: measure.Reference
    max_distance: float
    min_kept: float
    max_flipped: float
    last: str = field(default="", init=False)

    def __call__(self, mesh: Mesh, budget: int) -> Rung | None:
        vertices, faces = mesh[0].astype(np.float32).astype(np.float64), mesh[1]  # as it will be stored
        if len(faces) > budget:
            self.last = f"{len(faces)} faces for a budget of {budget}"
        elif not measure.watertight(faces, len(vertices)):
            self.last = f"not watertight at {budget}"
        elif measure.volume(vertices, faces) <= 0 or measure.face_areas(vertices, faces).min() <= 1e-12:
            self.last = f"collapsed at {budget}"
        else:
            stated = measure.measures(vertices, faces) | self.reference.compare(vertices, faces)
            good = stated["distance"] <= self.max_distance and stated["kept"] >= self.min_kept
            if good and stated["flipped"] <= self.max_flipped:
                return Rung(vertices, faces, stated)
            self.last = ", ".join(f"{name} {stated[name]:.2%}" for name in ("distance", "kept", "flipped")) + f" at {budget}"
        return None


def collapse(vertices: np.ndarray, faces: np.ndarray, budget: int, method: str) -> Mesh:
    """Towards ``budget`` faces; what the library reached, unchecked."""
    if len(faces) <= budget:
        return vertices, faces
    if method == "fast_simplification":
        import fast_simplification

        points, triangles = fast_simplification.simplify(
            np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(faces, np.int32), target_count=int(budget)
        )
    else:
        import pymeshlab

        meshes = pymeshlab.MeshSet(verbose=False)
        meshes.add_mesh(pymeshlab.Mesh(np.asarray(vertices, np.float64), np.asarray(faces, np.int32)))
        meshes.meshing_decimation_quadric_edge_collapse(
            targetfacenum=int(budget) // 2 * 2,
            qualitythr=0.5,
            preservetopology=True,
            preservenormal=True,
            planarquadric=True,
        )
        mesh = meshes.current_mesh()
        points, triangles = mesh.vertex_matrix(), mesh.face_matrix()
    return measure.compact(np.asarray(points, np.float64), np.asarray(triangles, np.int64))


def ladder(
    sources: Sequence[Callable[[], Mesh | None]],
    budgets: Sequence[int],
    method: str,
    gates: Callable[[Mesh, int], Rung | None],
) -> dict[int, Rung]:
    """budget -> rung, of those reached. ``sources`` are meshes to start from, in this order, made only when needed.

    Each is reduced to the largest missing budget first, every rung starting from the one above it.
    """
    rungs: dict[int, Rung] = {}
    for source in sources:
        missing = sorted(set(budgets) - set(rungs), reverse=True)
        mesh = source() if missing else None
        if mesh is None:
            continue
        for budget in missing:
            mesh = collapse(*mesh, budget, method)
            rung = gates(mesh, budget)
            if rung is not None:
                rungs[budget] = rung
    return rungs
