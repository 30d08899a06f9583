"""A mesh made small: near vertices welded, small pieces dropped, edges collapsed by quadric error."""

from __future__ import annotations

import numpy as np

from stages.graphics.geometry import decimator, measure
from stages.neuras.records import Mesh


def weld(mesh: Mesh, distance: float) -> Mesh:
    """One vertex, the mean, for all within a cell of a grid of ``distance``; faces that collapse or double go."""
    cells = np.floor((mesh.vertices - mesh.vertices.min(axis=0)) / distance).astype(np.int64)
    _, cluster, sizes = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    cluster = cluster.ravel()
    means = np.stack([np.bincount(cluster, mesh.vertices[:, axis]) for axis in range(3)], axis=1) / sizes[:, None]
    faces = cluster[mesh.faces]
    flat = (faces[:, 0] == faces[:, 1]) | (faces[:, 1] == faces[:, 2]) | (faces[:, 2] == faces[:, 0])
    faces = faces[~flat]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return Mesh.compact(means, faces[np.sort(first)])


def without_specks(mesh: Mesh, least_faces: int) -> Mesh:
    """Without connected pieces of fewer faces: they cost a chart each and show little."""
    piece = measure.vertex_components(mesh.faces, len(mesh.vertices))[mesh.faces[:, 0]]
    return Mesh.compact(mesh.vertices, mesh.faces[np.bincount(piece)[piece] >= least_faces])


def collapse(mesh: Mesh, target_faces: int) -> Mesh:
    """About ``target_faces`` faces by QSlim."""
    return Mesh.compact(*decimator.collapse(mesh.vertices, mesh.faces, target_faces, "fast_simplification", 0.0))
