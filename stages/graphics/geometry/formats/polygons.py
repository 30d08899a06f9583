"""Polygons of faces with any number of corners as triangles."""

from __future__ import annotations

import numpy as np

from stages.graphics.geometry.measure import normal_vectors

MOST_CORNERS = 2000  # of a polygon whose ears are cut; that takes time with their square


def triangulate(sizes: np.ndarray, corners: np.ndarray | None, in_order: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """(T, 3) places of triangle corners in the list of all corners, and the (T,) polygon that each triangle is of.

    sizes: (F,) corners of each polygon; their corners follow each other in the list. Fewer than three corners give nothing.
    corners: (N, 3) where they are; None where they refer to no points.
    Convex quads become two triangles, larger polygons fans; of polygons with an inward corner ears are cut. Triangles come
    first, then the first halves of all quads, their second halves, and the rest; ``in_order``: by polygon, unless all have the
    same size.
    """
    places, owners = _fans(np.asarray(sizes, np.int64))
    if corners is not None and len(places) and max(sizes) > 3:
        places = _without_overlaps(places, owners, corners)
    if in_order and len(np.unique(sizes)) > 1:
        order = np.argsort(owners, kind="stable")
        places, owners = places[order], owners[order]
    return places, owners


def points_at(points: np.ndarray, corners: np.ndarray) -> np.ndarray | None:
    """(N, 3) points of corners; None where one refers to none."""
    known = not len(corners) or (corners.min() >= 0 and corners.max() < len(points))
    return points[corners] if known else None


def _fans(sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``triangulate`` of convex polygons, block by block."""
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]]) if len(sizes) else sizes
    places, owners, fans = [], [], []
    for size in np.unique(sizes[sizes > 2]):
        polygon = np.flatnonzero(sizes == size)
        first = starts[polygon][:, None]
        if size == 3:
            places.append(first + [0, 1, 2])
            owners.append(polygon)
        elif size == 4:
            places += [first + [0, 1, 2], first + [2, 3, 0]]
            owners += [polygon, polygon]
        else:
            step = np.arange(size - 2)
            fan = np.stack([0 * step, step + 1, step + 2], axis=1)
            fans.append(((first[..., None] + fan).reshape(-1, 3), np.repeat(polygon, size - 2)))
    if fans:
        fan_places, fan_owners = (np.concatenate(arrays) for arrays in zip(*fans, strict=True))
        order = np.argsort(fan_owners, kind="stable")
        places.append(fan_places[order])
        owners.append(fan_owners[order])
    if not places:
        return np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
    return np.concatenate(places), np.concatenate(owners)


def _without_overlaps(places: np.ndarray, owners: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """The places, with those of polygons whose triangles do not all face one way replaced by cut ears."""
    with np.errstate(all="ignore"):
        normals = normal_vectors(corners[places])
        sums = np.zeros((owners.max() + 1, 3))
        np.add.at(sums, owners, normals)
        agreement = np.einsum("ij,ij->i", normals, sums[owners])
        turned = agreement < -1e-9 * np.einsum("ij,ij->i", sums, sums)[owners]
    order = np.argsort(owners, kind="stable")
    in_order = owners[order]
    for polygon in np.unique(owners[turned]):
        rows = order[slice(*np.searchsorted(in_order, [polygon, polygon + 1]))]
        if len(rows) > MOST_CORNERS:
            continue
        ring = np.arange(places[rows].min(), places[rows].max() + 1)
        ears = _ears(corners[ring], sums[polygon])
        if ears is not None:
            places[rows] = ring[ears]
    return places


def _ears(ring: np.ndarray, normal: np.ndarray) -> np.ndarray | None:
    """(n - 2, 3) triangles of a simple polygon (n, 3), seen along its normal; None where it crosses itself."""
    drop = int(np.abs(normal).argmax())
    flat = np.delete(ring, drop, axis=1) * ([1, 1] if (normal[drop] > 0) ^ (drop == 1) else [-1, 1])

    left, ears = np.arange(len(flat)), []
    while len(left) > 3:
        before, after = np.roll(left, 1), np.roll(left, -1)
        turns = _turns(flat[before], flat[left], flat[after])
        for place in np.flatnonzero(turns > 0):
            a, b, c = (flat[index[place]] for index in (before, left, after))
            points = flat[left]
            others = (points != a).any(axis=1) & (points != b).any(axis=1) & (points != c).any(axis=1)
            inside = (_turns(a, b, points) >= 0) & (_turns(b, c, points) >= 0) & (_turns(c, a, points) >= 0)
            if not (inside & others).any():
                break
        else:
            if not (turns == 0).any():
                return None
            place = int(np.argmax(turns == 0))  # three corners in a row: a triangle without area
        ears.append([before[place], left[place], after[place]])
        left = np.delete(left, place)
    return np.array([*ears, left])


def _turns(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Twice the signed area of triangles (..., 2) in the plane: above 0 where they turn left."""
    return (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])
