"""A surface through points. Lengths are in world units."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.spatial import Delaunay, cKDTree

from stages.graphics.geometry import measure
from stages.neuras.records import Mesh

BLOCK = 32  # cubes along a block that is marched at a time
NEAREST = 8  # points that decide the distance to the surface


def thin(points: np.ndarray, voxel: float, *others: np.ndarray) -> tuple[np.ndarray, ...]:
    """The first point of every occupied voxel, in the order of the points, and the same rows of ``others``."""
    cells = np.floor((points - points.min(axis=0)) / voxel).astype(np.int64)
    _, first = np.unique(cells @ _strides(cells), return_index=True)
    rows = np.sort(first)
    return tuple(array[rows] for array in (points, *others))


def _strides(cells: np.ndarray) -> np.ndarray:
    """Factors that make one number of three cell numbers."""
    width, depth, _ = cells.max(axis=0) + 1
    return np.array([1, width, width * depth], np.int64)


def spacing(points: np.ndarray) -> float:
    """The median distance of a point from the nearest other one."""
    return float(np.median(cKDTree(points).query(points, k=2)[0][:, 1]))


def normals(points: np.ndarray, viewers: np.ndarray, neighbours: int) -> np.ndarray:
    """(P, 3) unit normals: the least axis of each point's nearest neighbours, turned towards ``viewers`` (P, 3)."""
    tree = cKDTree(points)
    result = np.empty_like(points, dtype=np.float64)
    for start in range(0, len(points), 100_000):  # neighbours of all points at once would take gigabytes
        block = slice(start, start + 100_000)
        near = points[tree.query(points[block], k=min(neighbours, len(points)))[1]]
        offsets = near - near.mean(axis=1, keepdims=True)
        result[block] = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))[1][:, :, 0]
    away = np.einsum("ij,ij->i", result, viewers - points) < 0
    result[away] *= -1
    return result


def poisson(points: np.ndarray, point_normals: np.ndarray, depth: int, trim: float) -> Mesh:
    """Screened Poisson reconstruction, an octree of ``depth`` levels; what lies farther than ``trim`` from all points goes."""
    import pymeshlab

    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(vertex_matrix=points.astype(np.float64), v_normals_matrix=point_normals))
    meshes.generate_surface_reconstruction_screened_poisson(
        visiblelayer=False,
        depth=depth,
        fulldepth=5,
        cgdepth=0,
        scale=1.1,
        samplespernode=1.5,
        pointweight=4.0,
        iters=8,
        confidence=False,
        preclean=False,
        threads=1,  # more threads sum in another order
    )
    mesh = meshes.current_mesh()
    vertices, faces = mesh.vertex_matrix(), np.asarray(mesh.face_matrix(), np.int64)
    near = cKDTree(points).query(vertices, distance_upper_bound=trim)[0] <= trim
    return Mesh.compact(vertices, faces[near[faces].all(axis=1)])


def distance_field(points: np.ndarray, point_normals: np.ndarray, cell: float, trim: float) -> Mesh:
    """Marching cubes of a signed distance that is known within ``trim`` of the points, as other reconstructions leave it.

    The distance at a place is the weighted mean of those to the planes of its nearest points (implicit moving least squares).
    Cubes of edge ``cell`` are marched block by block, so memory does not grow with the empty space between surfaces.
    Neighbouring blocks share the places of their vertices, not the vertices.
    """
    from skimage.measure import marching_cubes

    tree, origin = cKDTree(points), points.min(axis=0) - 2 * trim
    sides = np.array(list(itertools.product((-trim, trim), repeat=3)))
    near = (points[:, None] + sides - origin).reshape(-1, 3)
    corners = np.stack(np.meshgrid(*[np.arange(BLOCK + 1)] * 3, indexing="ij"), axis=-1)
    vertices, faces, count = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], 0
    for block in np.unique(np.floor(near / (cell * BLOCK)).astype(np.int64), axis=0):
        places = origin + cell * (block * BLOCK + corners)
        field = _signed_distances(places.reshape(-1, 3), tree, point_normals, trim).reshape(corners.shape[:3])
        known = np.isfinite(field)
        if not known.any() or np.nanmin(field) >= 0 or np.nanmax(field) <= 0:
            continue
        found, triangles, _, _ = marching_cubes(np.where(known, field, trim), 0.0)
        sure = known[tuple(np.floor(found).astype(int).T)] & known[tuple(np.ceil(found).astype(int).T)]
        vertices.append(origin + cell * (block * BLOCK + found))
        faces.append(triangles[sure[triangles].all(axis=1)] + count)
        count += len(found)
    return Mesh.compact(np.concatenate(vertices), np.concatenate(faces))


def _signed_distances(places: np.ndarray, tree: cKDTree, point_normals: np.ndarray, trim: float) -> np.ndarray:
    """(P,) distance of ``places`` to the surface of the tree's points, positive outside; NaN farther than ``trim`` from all."""
    apart, near = tree.query(places, k=NEAREST, distance_upper_bound=trim)
    there = np.isfinite(apart)
    near = np.where(there, near, 0)
    planes = np.einsum("pki,pki->pk", point_normals[near], places[:, None] - tree.data[near])
    closest = np.where(there[:, :1], apart[:, :1], 1.0)
    weights = np.where(there, np.exp(-np.square(np.where(there, apart, 0.0) / (closest + 0.1 * trim))), 0.0)
    return np.where(there[:, 0], (weights * planes).sum(axis=1) / np.maximum(weights.sum(axis=1), 1e-300), np.nan)


def terrain(points: np.ndarray, up: np.ndarray, longest: float, outlier: float) -> Mesh:
    """A Delaunay triangulation of the points as seen from above, for what is flat, such as a flight's points.

    Points that stand out from their neighbours' median height by more than ``outlier`` go, and so do triangles with a side
    seen from above longer than ``longest``.
    """
    across = np.linalg.svd(up[None])[2][1:]
    plan, height = points @ across.T, points @ up
    near = cKDTree(plan).query(plan, k=min(9, len(plan)))[1]
    kept = np.abs(height - np.median(height[near], axis=1)) <= outlier
    points, plan = points[kept], plan[kept]
    faces = Delaunay(plan).simplices.astype(np.int64)
    sides = np.linalg.norm(plan[faces] - plan[faces[:, [1, 2, 0]]], axis=-1).max(axis=1)
    faces = faces[sides <= longest]
    downward = measure.face_vectors(points, faces) @ up < 0
    faces[downward] = faces[downward][:, [0, 2, 1]]
    return Mesh.compact(points, faces)
