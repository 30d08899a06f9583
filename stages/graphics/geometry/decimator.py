"""A watertight mesh to a ladder of face budgets by quadric edge collapse (QSlim; paper section 3.3).

pymeshlab with topology and normals preserved. Planar quadrics (``planar_weight``) give the paper's triangles of roughly
equal size, but pull smooth shapes inwards: hence no more of them than a shape needs. A mesh far above the largest budget
is brought nearer by fast_simplification first, which is ten times faster. A rung is kept only when it passes the gates;
what misses is tried again from a coarser grid.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from stages.graphics.geometry import measure

Mesh = tuple[np.ndarray, np.ndarray]  # (V, 3) float64, (F, 3) int64
COARSE = 256  # rungs of fewer faces may lose more of the shape


@dataclass
class Rung:
    """One accepted mesh and what was measured of it."""

    vertices: np.ndarray
    faces: np.ndarray
    measures: dict[str, Any]


@dataclass
class Gates:
    """What a rung must fulfil. ``least`` and ``most`` bound measures by name (``measure.measures`` and ``compare``);
    ``least_coarse`` stands in for ``least`` under 256 faces. ``refused`` says of each budget what the first refused rung did
    not fulfil."""

    reference: measure.Reference
    most: dict[str, float]
    least: dict[str, float] = field(default_factory=dict)
    least_coarse: dict[str, float] = field(default_factory=dict)
    refused: dict[int, str] = field(default_factory=dict, init=False)

    def __call__(self, mesh: Mesh, budget: int) -> Rung | None:
        vertices, faces = mesh[0].astype(np.float32).astype(np.float64), mesh[1]  # as it will be stored
        if len(faces) > budget:
            return self._refuse(budget, f"{len(faces)} faces")
        if not measure.watertight(faces, len(vertices)):
            return self._refuse(budget, "not watertight")
        if measure.component_volumes(vertices, faces).min() <= 0 or measure.face_areas(vertices, faces).min() <= 1e-12:
            return self._refuse(budget, "collapsed")
        stated = measure.measures(vertices, faces) | {"crossing": measure.crossing(vertices, faces)}
        stated |= self.reference.compare(vertices, faces)
        bad = [f"{name} {stated[name]:.2%} over {limit:.2%}" for name, limit in self.most.items() if stated[name] > limit]
        least = self.least_coarse if budget < COARSE else self.least
        bad += [f"{name} {stated[name]:.2%} under {limit:.2%}" for name, limit in least.items() if stated[name] < limit]
        return self._refuse(budget, ", ".join(bad)) if bad else Rung(vertices, faces, stated)

    def _refuse(self, budget: int, why: str) -> None:
        self.refused.setdefault(budget, why)


def collapse(vertices: np.ndarray, faces: np.ndarray, budget: int, method: str, planar_weight: float) -> Mesh:
    """Towards ``budget`` faces; what the library reached, unchecked. ``planar_weight`` is pymeshlab's: 0 for QSlim alone."""
    if len(faces) <= budget:
        return vertices, faces
    if method == "fast_simplification":
        return _fast(vertices, faces, budget, 7)
    import pymeshlab

    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(np.asarray(vertices, np.float64), np.asarray(faces, np.int32)))
    # every parameter is given: what is left out keeps its value of the process's last call
    meshes.meshing_decimation_quadric_edge_collapse(
        targetfacenum=int(budget) // 2 * 2,
        targetperc=0.0,
        qualitythr=0.5,
        preserveboundary=False,
        boundaryweight=1.0,
        preservenormal=True,
        preservetopology=True,
        optimalplacement=True,
        planarquadric=planar_weight > 0,
        planarweight=planar_weight,
        qualityweight=False,
        autoclean=True,
        selected=False,
    )
    mesh = meshes.current_mesh()
    return measure.compact(mesh.vertex_matrix(), np.asarray(mesh.face_matrix(), np.int64))


def brought_nearer(vertices: np.ndarray, faces: np.ndarray, target: int) -> Mesh:
    """With about ``target`` faces where fast_simplification gets there and leaves the mesh watertight, else as it is."""
    if len(faces) > target:
        nearer = _fast(vertices, faces, target, 2)
        if measure.watertight(nearer[1], len(nearer[0])):
            return nearer
    return vertices, faces


def _fast(vertices: np.ndarray, faces: np.ndarray, target: int, aggressiveness: int) -> Mesh:
    import fast_simplification

    points, triangles = fast_simplification.simplify(
        np.ascontiguousarray(vertices, np.float32),
        np.ascontiguousarray(faces, np.int32),
        target_count=int(target),
        agg=aggressiveness,
    )
    return measure.compact(np.asarray(points, np.float64), np.asarray(triangles, np.int64))


def ladder(
    sources: Sequence[Callable[[], Mesh | None]],
    budgets: Sequence[int],
    reducers: Sequence[Callable[[Mesh, int], Mesh]],
    gates: Callable[[Mesh, int], Rung | None],
    even: float,
) -> dict[int, Rung]:
    """budget -> rung, of those reached. ``sources`` are meshes to start from, in this order, made only when needed.

    Each is reduced to the largest missing budget first, every rung starting from the one above it. ``reducers`` are tried
    from the closest to the evenest until a rung's area spread is at most ``even``; the evenest that passes is taken.
    """
    rungs: dict[int, Rung] = {}
    for source in sources:
        missing = sorted(set(budgets) - set(rungs), reverse=True)
        mesh = source() if missing else None
        if mesh is None:
            continue
        mesh = reducers[0](mesh, 2 * missing[0])  # the long way down is gone once
        for budget in missing:
            above, best = mesh, None
            for reduce in reducers:
                mesh = reduce(above, budget)
                rung = gates(mesh, budget)
                if rung and (best is None or rung.measures["area_spread"] < best.measures["area_spread"]):
                    best = rung
                if best and best.measures["area_spread"] <= even:
                    break
            if best:
                rungs[budget], mesh = best, (best.vertices, best.faces)
    return rungs
