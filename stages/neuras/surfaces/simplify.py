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


def without_specks(mesh: Mesh, least_faces: int, largest: float = np.inf) -> Mesh:
    """Without connected pieces of fewer faces, but for those whose box has a longer diagonal than ``largest``.

    Specks cost a chart each and show little. A wall that somebody modelled may have two faces, and is none.
    """
    of_vertex = measure.vertex_components(mesh.faces, len(mesh.vertices))
    piece = of_vertex[mesh.faces[:, 0]]
    low, high = (np.full((int(of_vertex.max(initial=0)) + 1, 3), limit) for limit in (np.inf, -np.inf))
    np.minimum.at(low, of_vertex, mesh.vertices)
    np.maximum.at(high, of_vertex, mesh.vertices)
    large = np.linalg.norm(high - low, axis=1) > largest
    return Mesh.compact(mesh.vertices, mesh.faces[(np.bincount(piece)[piece] >= least_faces) | large[piece]])


def collapse(mesh: Mesh, target_faces: int, spared: int = 0) -> Mesh:
    """About ``target_faces`` faces by QSlim, and more where pieces of fewer faces than ``spared`` leave no room.

    Those stay as they are: QSlim moves borders at no cost, and takes one of the two faces of a modelled wall first.
    """
    piece = measure.vertex_components(mesh.faces, len(mesh.vertices))[mesh.faces[:, 0]]
    small = np.bincount(piece)[piece] < spared
    if not small.any():
        return Mesh.compact(*decimator.collapse(mesh.vertices, mesh.faces, target_faces, "fast_simplification", 0.0))
    kept = Mesh.compact(mesh.vertices, mesh.faces[small])
    if small.all() or len(kept.faces) >= target_faces:
        return mesh
    rest = collapse(Mesh.compact(mesh.vertices, mesh.faces[~small]), target_faces - len(kept.faces))
    return Mesh.joined(rest, kept)
