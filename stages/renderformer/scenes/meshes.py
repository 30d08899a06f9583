"""Meshes made by code (walls, light triangle, simple shapes) and shading normals, in plain numpy."""

from __future__ import annotations

from functools import cache

import numpy as np

from stages.graphics.geometry.measure import face_normals, normal_vectors

Mesh = tuple[np.ndarray, np.ndarray]  # vertices (V, 3) float64, faces (F, 3) int64

LIGHT_TRIANGLE = 0.025 * np.array([[-1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, -1.0]])  # edge 0.0707, area 0.0022


def _grid(rows: int, columns: int) -> np.ndarray:
    """(2 rows columns, 3) faces over (rows + 1) x (columns + 1) vertices, row-major; normal = row axis x column axis."""
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).reshape(-1, 1)
    a, b, c, d = corner, corner + columns + 1, corner + columns + 2, corner + 1
    return np.concatenate([np.hstack([a, b, c]), np.hstack([a, c, d])], axis=1).reshape(-1, 3)


def areas(triangles: np.ndarray) -> np.ndarray:
    """(F,) areas of (F, 3, 3) triangles."""
    return 0.5 * np.linalg.norm(normal_vectors(triangles.astype(np.float64)), axis=1)


@cache
def wall(name: str) -> Mesh:
    """Wall of 8 x 8 quads (128 triangles) over [-1, 1]^2, at distance 1 from the origin, facing it."""
    steps = np.linspace(-1, 1, 9)
    u, v = (axis.ravel() for axis in np.meshgrid(steps, steps, indexing="ij"))
    one = np.ones_like(u)
    vertices = {  # first axis x second axis = inward normal
        "floor": [u, v, -one],  # x x y = +z
        "back": [u, one, v],  # x x z = -y
        "right": [one, v, u],  # z x y = -x
        "left": [-one, u, v],  # y x z = +x
    }[name]
    return np.stack(vertices, axis=1), _grid(8, 8)


def _merge(points: np.ndarray, faces: np.ndarray) -> Mesh:
    """One vertex where points coincide, without the faces that collapse by it."""
    _, first, inverse = np.unique(np.round(points, 9), axis=0, return_index=True, return_inverse=True)
    faces = inverse.ravel()[faces]
    keep = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return points[first], faces[keep]


def _cube(n: int) -> Mesh:
    """Cube [-1, 1]^3 with n x n quads per side: 12 n^2 faces."""
    steps = np.linspace(-1, 1, n + 1)
    u, v = (axis.ravel() for axis in np.meshgrid(steps, steps, indexing="ij"))
    one = np.ones_like(u)
    sides = []
    for axis in range(3):
        side = np.stack([one, u, v], axis=1)
        sides += [np.roll(side, axis, axis=1), np.roll(np.stack([-one, v, u], axis=1), axis, axis=1)]
    faces = np.concatenate([_grid(n, n) + i * (n + 1) ** 2 for i in range(6)])
    return _merge(np.concatenate(sides), faces)


def _revolve(profile: np.ndarray, segments: int) -> Mesh:
    """Surface of revolution about z of (radius, z) points, listed from bottom to top on the outside."""
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    angle[-1] = 0.0
    radius, z = profile[:, :1], profile[:, 1:]
    points = np.stack(np.broadcast_arrays(radius * np.cos(angle), radius * np.sin(angle), z), axis=-1)
    # angle x profile points outwards: the grid's first axis must be the angle.
    return _merge(points.transpose(1, 0, 2).reshape(-1, 3), _grid(segments, len(profile) - 1))


def _line(*corners: tuple[float, float], n: int) -> np.ndarray:
    """Points along a polyline, n steps per leg."""
    legs = [np.linspace(a, b, n + 1)[:-1] for a, b in zip(corners, corners[1:], strict=False)]
    return np.concatenate([*legs, [corners[-1]]])


@cache
def special(shape: str, n: int) -> Mesh:
    """A simple closed shape at resolution ``n`` (1, 2, 3, ...)."""
    if shape == "cube":
        return _cube(n)
    if shape == "sphere":
        vertices, faces = _cube(n + 1)
        return vertices / np.linalg.norm(vertices, axis=1, keepdims=True), faces
    if shape == "cylinder":
        return _revolve(_line((0, -1), (0.7, -1), (0.7, 1), (0, 1), n=n), 8 * n)
    if shape == "cone":
        return _revolve(_line((0, -1), (0.8, -1), (0, 1), n=n), 8 * n)
    if shape == "torus":
        turn = np.linspace(0, 2 * np.pi, 4 * n + 3)
        turn[-1] = 0.0
        return _revolve(np.stack([0.7 + 0.3 * np.cos(turn), 0.3 * np.sin(turn)], axis=1), 8 * n)
    raise AssertionError(f"no shape {shape}")


@cache
def special_rungs(shape: str) -> dict[str, int]:
    """Resolution -> number of faces, up to 4,192."""
    sizes = {str(n): len(special(shape, n)[1]) for n in range(1, 19)}
    return {n: faces for n, faces in sizes.items() if faces <= 4192}


def shading_groups(vertices: np.ndarray, faces: np.ndarray, crease_deg: float) -> np.ndarray:
    """(F,) group of each face: faces are joined across edges of exactly two faces that bend by less than the angle."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    code = edges[:, 0].astype(np.int64) * len(vertices) + edges[:, 1]
    order = np.argsort(code, kind="stable")
    _, start, size = np.unique(code[order], return_index=True, return_counts=True)
    pair = start[size == 2]
    left, right = order[pair] // 3, order[pair + 1] // 3
    normal = face_normals(vertices[faces])
    smooth = np.einsum("ij,ij->i", normal[left], normal[right]) > np.cos(np.radians(crease_deg))
    left, right = left[smooth], right[smooth]
    graph = coo_matrix((np.ones(len(left), np.int8), (left, right)), shape=(len(faces), len(faces)))
    return connected_components(graph, directed=False)[1]


def smooth_normals(vertices: np.ndarray, faces: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """(F, 3, 3) unit normals per corner: the faces' normals around a vertex within a group, weighted by angle."""
    triangles = vertices[faces]
    normal = face_normals(triangles)
    ahead = np.roll(triangles, -1, axis=1) - triangles
    behind = np.roll(triangles, 1, axis=1) - triangles
    cosine = np.einsum("fcx,fcx->fc", ahead, behind)
    angle = np.arctan2(np.linalg.norm(np.cross(ahead, behind), axis=2), cosine)
    _, corner = np.unique(faces.astype(np.int64) * len(faces) + groups[:, None], return_inverse=True)
    corner = corner.ravel()
    weighted = (normal[:, None] * angle[..., None]).reshape(-1, 3)
    total = np.stack([np.bincount(corner, weights=weighted[:, axis]) for axis in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1)
    flat = np.repeat(normal, 3, axis=0)
    # A group can fold so that a vertex's normals cancel: keep the face's own there.
    good = length[corner] > 1e-6
    out = np.where(good[:, None], total[corner] / np.where(good, length[corner], 1)[:, None], flat)
    return out.reshape(-1, 3, 3)
