"""Charts without xatlas: faces that look one way along an axis, projected along it, and rectangles packed on shelves.

A quarter of xatlas' time, for meshes of very many faces, and its time grows no faster than they do. The price: a face is seen
at up to 55 degrees, so its texels are stretched by up to 1.7, and there are twice as many charts, so more of the texture is
padding.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from stages.graphics.casting import Caster
from stages.neuras.records import Mesh
from stages.neuras.surfaces.unfold import Placed, Tile

INSET = 0.2  # of the way from a face's corners to its middle: where it is asked whether another face covers it
ROUNDS = 16  # of taking covered faces out; what is left then gets a chart of its own each


def unfold(mesh: Mesh, rows: np.ndarray, texels_per_unit: float, padding: int) -> Tile:
    """Charts of the faces ``rows``, on shelves in a rectangle of texels with ``padding`` texels between them."""
    corners = mesh.vertices[mesh.faces[rows]].astype(np.float64)  # (F, 3, 3)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axis = np.abs(normals).argmax(axis=1)
    side = np.take_along_axis(normals, axis[:, None], 1)[:, 0] < 0
    flat = _projected(corners, axis, side) * texels_per_unit  # (F, 3, 3): u, v, towards the viewer
    charts = _charts(mesh.faces[rows], 2 * axis + side, flat)
    vertices, uvs, faces = _welded(mesh, rows, charts, flat[..., :2])
    placed = pack(uvs, faces, charts, padding)
    return Tile(
        vertices=vertices,
        uvs=placed.uvs,
        faces=faces,
        charts=charts.astype(np.int32),
        source=np.asarray(rows, np.int32),
        width=placed.width,
        height=placed.height,
    )


def pack(uvs: np.ndarray, faces: np.ndarray, charts: np.ndarray, padding: int) -> Placed:
    """Charts of ``uvs`` (N, 2), in texels, on shelves. charts: (F,), each face's; no vertex is of two."""
    low, high = _bounds(charts, uvs[faces])
    places, width, height = shelves(np.ceil(high - low).astype(int) + 1, padding)
    owner = np.zeros(len(uvs), np.int64)
    owner[faces] = charts[:, None]
    placed = uvs - low[owner] + places[owner] + 0.5
    return Placed(np.arange(len(uvs)), faces, placed.astype(np.float32), width, height)


def shelves(sizes: np.ndarray, padding: int) -> tuple[np.ndarray, int, int]:
    """Where rectangles of ``sizes`` (N, 2), width and height, go: (N, 2) int corners, and the width and height of the whole.

    The highest first, from left to right on shelves, in a rectangle that is about square. ``padding`` lies around each.
    """
    padded = sizes + padding
    width = int(max(padded[:, 0].max(), np.ceil(np.sqrt(1.1 * float(padded.prod(axis=1).sum()))))) + padding
    places = np.zeros_like(sizes)
    x, y, shelf = padding, padding, 0
    for number in np.lexsort((-padded[:, 0], -padded[:, 1])):
        if x + padded[number, 0] > width:
            x, y, shelf = padding, y + shelf, 0
        places[number] = x, y
        x, shelf = x + padded[number, 0], max(shelf, padded[number, 1])
    return places, width, int(y + shelf)


def _projected(corners: np.ndarray, axis: np.ndarray, side: np.ndarray) -> np.ndarray:
    """Corners (F, 3, 3) as seen against the axis that each face looks along, not mirrored; the third number grows towards
    the viewer.
    """
    first, second = (axis + 1) % 3, (axis + 2) % 3
    rows, places = np.arange(len(corners))[:, None], np.arange(3)[None]
    u, v, near = (corners[rows, places, which[:, None]] for which in (first, second, axis))
    sign = np.where(side, -1.0, 1.0)[:, None]
    return np.stack([u * sign, v, near * sign], axis=-1)


def _charts(faces: np.ndarray, look: np.ndarray, flat: np.ndarray) -> np.ndarray:
    """(F,) number of each face's chart: faces that look one way and share edges, none of which covers another."""
    pairs = _sharing_edges(faces)
    groups = look.astype(np.int64)
    for _ in range(ROUNDS):
        groups = _pieces(pairs, groups)
        covered = _covered(groups, flat)
        if not covered.any():
            return groups
        groups = np.where(covered, groups + groups.max() + 1, groups)
    alone = np.where(covered)[0]
    groups[alone] = groups.max() + 1 + np.arange(len(alone))
    return np.unique(groups, return_inverse=True)[1]


def _sharing_edges(faces: np.ndarray) -> np.ndarray:
    """(E, 2) faces that share an edge; of more than two at one edge each with the next."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).astype(np.int64), axis=1)
    numbers = edges @ [int(faces.max()) + 1, 1]
    order = np.argsort(numbers, kind="stable")
    same = numbers[order[1:]] == numbers[order[:-1]]
    return np.stack([order[:-1][same], order[1:][same]], axis=1) // 3


def _pieces(pairs: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Connected pieces of each group. pairs: (E, 2) faces that share an edge."""
    pairs = pairs[groups[pairs[:, 0]] == groups[pairs[:, 1]]]
    links = coo_array((np.ones(len(pairs), np.int8), tuple(pairs.T)), shape=(len(groups), len(groups)))
    return connected_components(links, directed=False)[1].astype(np.int64)


def _covered(charts: np.ndarray, flat: np.ndarray) -> np.ndarray:
    """(F,) bool: faces that another face of their chart lies before, at a corner or in the middle."""
    low, high = _bounds(charts, flat[..., :2])
    left = np.concatenate([[0.0], np.cumsum(high[:, 0] - low[:, 0] + 1)])[:-1]  # charts side by side
    shift = np.stack([left - low[:, 0], -low[:, 1]], axis=1)[charts][:, None]
    spread = np.concatenate([flat[..., :2] + shift, flat[..., 2:]], axis=2)
    caster = Caster(spread.reshape(-1, 3), np.arange(3 * len(spread)).reshape(-1, 3))
    top = spread[..., 2].max() + 1
    middle = spread.mean(axis=1, keepdims=True)
    spots = np.concatenate([middle, spread + INSET * (middle - spread)], axis=1)
    covered = np.zeros(len(spread), bool)
    for number in range(spots.shape[1]):
        starts = np.column_stack([spots[:, number, :2], np.full(len(spots), top)])
        found, _, _ = caster.cast(starts, np.broadcast_to([0.0, 0.0, -1.0], starts.shape))
        covered |= (found >= 0) & (found != np.arange(len(spread)))
    return covered


def _bounds(charts: np.ndarray, flat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(C, 2) the least and the largest u, v of each chart."""
    count = int(charts.max()) + 1
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    for corner in range(3):
        np.minimum.at(low, charts, flat[:, corner])
        np.maximum.at(high, charts, flat[:, corner])
    return low, high


def _welded(mesh: Mesh, rows: np.ndarray, charts: np.ndarray, flat: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (N, 3), their u, v (N, 2) and faces (F, 3): a vertex stands there once per chart. flat: (F, 3, 2)."""
    used, corner = np.unique(mesh.faces[rows], return_inverse=True)
    keys = charts[:, None].astype(np.int64) * len(used) + corner.reshape(-1, 3)
    unique, first, faces = np.unique(keys, return_index=True, return_inverse=True)
    uvs = flat.reshape(-1, 2)[first]
    return mesh.vertices[used][unique % len(used)], uvs, faces.reshape(-1, 3).astype(np.int32)
