"""Measures of triangle meshes: what the gates of remesh and decimate, the catalogue and the report state.

Lengths are in mesh units unless a name says ``relative`` (to the bounding-box diagonal). "Outer surface" is what rays
from outside reach: a point counts when a ray from it, on the side that faces the ray, escapes in one of 64 directions.
"""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np


def corners_of(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F, 3, 3) float64 corner positions."""
    return np.asarray(vertices, np.float64)[faces]


def normal_vectors(corners: np.ndarray) -> np.ndarray:
    """(F, 3) normals of (F, 3, 3) triangles, each as long as twice the triangle's area."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def face_normals(corners: np.ndarray) -> np.ndarray:
    """(F, 3) unit normals of (F, 3, 3) triangles; +z for those without area."""
    vectors = normal_vectors(corners)
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 0, vectors / np.where(length > 0, length, 1), [0.0, 0.0, 1.0])


def have_area(corners: np.ndarray) -> np.ndarray:
    """(F,) bool of (F, 3, 3) float32 triangles: those wider than a few roundings of their coordinates."""
    corners = np.asarray(corners, np.float64)
    longest = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).max(axis=1)
    rounding = 4 * np.finfo(np.float32).eps * np.abs(corners).max(axis=(1, 2))
    return np.linalg.norm(normal_vectors(corners), axis=1) > longest * rounding


def face_vectors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F, 3): ``normal_vectors`` of a mesh."""
    return normal_vectors(corners_of(vertices, faces))


def face_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F,)."""
    return np.linalg.norm(face_vectors(vertices, faces), axis=1) / 2


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Signed volume enclosed; positive where a closed mesh faces outwards."""
    a, b, c = np.moveaxis(corners_of(vertices, faces), 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def diagonal(vertices: np.ndarray) -> float:
    """Length of the bounding box's diagonal."""
    return float(np.linalg.norm(np.ptp(vertices, axis=0)))


def watertight(faces: np.ndarray, n_vertices: int) -> bool:
    """Edge-manifold and closed: every directed edge occurs once, and once in the other direction; no corner twice in a
    face."""
    start, end = faces.ravel().astype(np.int64), faces[:, [1, 2, 0]].ravel().astype(np.int64)
    forward, backward = np.sort(start * n_vertices + end), np.sort(end * n_vertices + start)
    return len(faces) > 0 and not (start == end).any() and not (np.diff(forward) == 0).any() and (forward == backward).all()


def vertex_components(faces: np.ndarray, n_vertices: int) -> np.ndarray:
    """(V,) component of every vertex, faces sharing a vertex being connected."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    start, end = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    graph = coo_matrix((np.ones(len(start), np.int8), (start, end)), shape=(n_vertices, n_vertices))
    return connected_components(graph, directed=False)[1]


def component_volumes(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(C,) signed volume of every component of a closed mesh; positive where it faces outwards."""
    a, b, c = np.moveaxis(corners_of(vertices, faces), 1, 0)
    component = vertex_components(faces, len(vertices))[faces[:, 0]]
    return np.bincount(component, np.einsum("ij,ij->i", a, np.cross(b, c)) / 6)


def compact(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mesh without unused vertices."""
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3)


def min_angle_deg(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F,) smallest angle of each face."""
    corners = corners_of(vertices, faces)
    edges = np.roll(corners, -1, axis=1) - corners
    lengths = np.maximum(np.linalg.norm(edges, axis=2), 1e-300)
    cosines = -np.einsum("fij,fij->fi", edges, np.roll(edges, 1, axis=1)) / (lengths * np.roll(lengths, 1, axis=1))
    return np.degrees(np.arccos(np.clip(cosines, -1, 1))).min(axis=1)


def crossing(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Share of the faces that pass through another one."""
    return round(int(crossing_faces(vertices, faces).sum()) / len(faces), 4)


def crossing_faces(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F,) bool: faces that pass through another one."""
    import pymeshlab

    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(np.asarray(vertices, np.float64), np.asarray(faces, np.int32)))
    meshes.compute_selection_by_self_intersections_per_face()
    return np.asarray(meshes.current_mesh().face_selection_array(), bool)


def content_hash(vertices: np.ndarray, faces: np.ndarray) -> str:
    """Hex blake2b-256 of the triangles as float32 coordinates, whatever the order of faces, vertices and first
    corners."""
    corners = np.asarray(vertices, np.float32)[faces] + np.float32(0)  # + 0 turns -0 into 0
    order = np.lexsort(np.moveaxis(corners, 2, 0)[::-1], axis=1)[:, 0]
    corners = np.take_along_axis(corners, ((order[:, None] + np.arange(3)) % 3)[..., None], axis=1).reshape(-1, 9)
    corners = corners[np.lexsort(corners.T[::-1])]
    return hashlib.blake2b(np.ascontiguousarray(corners, "<f4").tobytes(), digest_size=32).hexdigest()


def signature(vertices: np.ndarray, faces: np.ndarray) -> list[float]:
    """13 numbers that the same normalised surface has in every file format: sides, log area, first and second moments.

    Integrals over the surface, so vertex and face order, merged vertices and how a polygon was cut into triangles do
    not matter; all are continuous, so float noise moves them by about as little.
    """
    corners = corners_of(vertices, faces)
    areas = face_areas(vertices, faces)
    centres = corners.mean(axis=1)
    area = areas.sum()
    first = areas @ centres / area
    # exact second moments of a triangle: (sum of corner products + 9 x centre products) / 12
    second = np.einsum("f,fij,fik->jk", areas, corners, corners) + 9 * np.einsum("f,fj,fk->jk", areas, centres, centres)
    second = second[np.triu_indices(3)] / (12 * area)
    return [float(x) for x in (*np.ptp(corners.reshape(-1, 3), axis=0), np.log(area), *first, *second)]


def sample(vertices: np.ndarray, faces: np.ndarray, number: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """(points (N, 3), unit normals (N, 3)): stratified by area, the same for the same mesh."""
    return sample_with_faces(vertices, faces, number, seed)[:2]


def sample_with_faces(
    vertices: np.ndarray, faces: np.ndarray, number: int, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``sample``, and the face (N,) of each point."""
    rng = np.random.default_rng(seed)
    vectors = face_vectors(vertices, faces)
    double_areas = np.linalg.norm(vectors, axis=1)
    total = np.cumsum(double_areas)
    chosen = np.searchsorted(total, (np.arange(number) + rng.random(number)) / number * total[-1]).clip(max=len(faces) - 1)
    u, v = np.sqrt(rng.random(number)), rng.random(number)
    weights = np.stack([1 - u, u * (1 - v), u * v], axis=1)
    points = np.einsum("nc,ncd->nd", weights, corners_of(vertices, faces[chosen]))
    return points, vectors[chosen] / np.maximum(double_areas[chosen, None], 1e-300), chosen


def sphere_directions(number: int = 64) -> np.ndarray:
    """(N, 3) unit vectors spread over the sphere (Fibonacci lattice)."""
    index = np.arange(number) + 0.5
    z = 1 - 2 * index / number
    turn = np.pi * (1 + np.sqrt(5)) * index
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)


def embree_scene(vertices: np.ndarray, faces: np.ndarray) -> Any:
    """What ``.run(origins, directions)``, (N, 3) float32, asks: the first face that each ray meets, -1 for none."""
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, np.ascontiguousarray(corners_of(vertices, faces), np.float32))
    return scene


class Visibility:
    """Which points of a mesh's surface a ray from outside reaches."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        self.radius = diagonal(vertices)
        self.centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
        self.offset = 1e-4 * self.radius
        self.vectors = face_vectors(vertices, faces)
        self.scene = embree_scene(vertices, faces)

    def outer(self, points: np.ndarray, normals: np.ndarray, two_sided: bool = True) -> np.ndarray:
        """(N,) bool. One-sided asks only about the side that the normal points to."""
        visible = np.zeros(len(points), bool)
        directions = sphere_directions()
        order = np.argsort((np.arange(64) * 37) % 64)  # far apart first: most points are settled in the first few
        for chunk in directions[order].reshape(8, 8, 3):
            open_ = np.flatnonzero(~visible)
            if not len(open_):
                break
            side = np.sign(normals[open_] @ chunk.T)  # (n, 8)
            sides = np.ones_like(side, bool) if two_sided else side > 0
            point_row, ray = np.nonzero(sides & (side != 0))
            index = open_[point_row]
            origins = points[index] + (side[point_row, ray, None] * self.offset) * normals[index]
            hit = self.scene.run(origins.astype(np.float32), chunk[ray].astype(np.float32), query="OCCLUDED")
            visible[index[np.asarray(hit) != 0]] = True
        return visible

    def flipped(self, points: np.ndarray) -> float:
        """Share of rays from outside, through some of the surface's ``points``, that first meet the back of a face.

        0 for a clean outward mesh; more where it is turned over or passes through itself.
        """
        directions = np.repeat(sphere_directions(), len(points), axis=0)
        through = np.tile(points, (64, 1)) - self.centre
        along = (through * directions).sum(axis=1, keepdims=True)
        origins = self.centre + through - (along + self.radius) * directions  # on a plane outside the bounding box
        hit = np.asarray(self.scene.run(origins.astype(np.float32), directions.astype(np.float32)))
        met = hit >= 0
        back = np.einsum("ij,ij->i", self.vectors[hit[met]], directions[met]) > 0
        return float(back.mean()) if len(back) else 1.0


def distances(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(N,) distance of each point to the mesh."""
    import igl

    squared = igl.point_mesh_squared_distance(
        np.ascontiguousarray(points, np.float64),
        np.ascontiguousarray(vertices, np.float64),
        np.ascontiguousarray(faces, np.int64),
    )[0]
    return np.sqrt(squared)


class Reference:
    """The original's outer surface, to measure results against: points seen by rays from outside in 64 directions."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, number: int = 4000):
        self.vertices, self.faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
        self.diagonal = diagonal(self.vertices)
        points, normals = sample(self.vertices, self.faces, number)
        outer = Visibility(self.vertices, self.faces).outer(points, normals)
        self.points = points[outer] if outer.any() else points

    def compare(self, vertices: np.ndarray, faces: np.ndarray) -> dict[str, float]:
        """distance: mean of the two directed mean distances; kept: share of the outer surface within 1 %; inside: share
        of the result's area that no ray from outside reaches; flipped: share of rays from outside that meet a back
        first."""
        forward = distances(self.points, vertices, faces) / self.diagonal
        points, normals = sample(vertices, faces, len(self.points))
        backward = distances(points, self.vertices, self.faces) / self.diagonal
        visibility = Visibility(vertices, faces)
        seen = visibility.outer(points, normals, two_sided=False)
        return {
            "distance": round(float(forward.mean() + backward.mean()) / 2, 6),
            "kept": round(float((forward < 0.01).mean()), 4),
            "inside": round(float(1 - seen.mean()), 4),
            "flipped": round(visibility.flipped(points[:: max(1, len(points) // 64)]), 4),
        }


def measures(vertices: np.ndarray, faces: np.ndarray) -> dict[str, float | int | bool]:
    """What every accepted mesh states about itself."""
    areas = face_areas(vertices, faces)
    angles = min_angle_deg(vertices, faces)
    return {
        "faces": len(faces),
        "watertight": bool(watertight(faces, len(vertices))),
        "components": int(vertex_components(faces, len(vertices)).max()) + 1,
        "area": round(float(areas.sum()), 6),
        "volume": round(volume(vertices, faces), 6),
        "area_spread": round(float(areas.std() / areas.mean()), 4),
        "min_angle_deg": round(float(angles.min()), 3),
        "slivers": round(float((angles < 5).mean()), 4),
    }
