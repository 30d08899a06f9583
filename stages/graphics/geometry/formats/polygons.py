"""Polygons of faces with any number of corners as triangles."""

from __future__ import annotations

import numpy as np


def triangulate(sizes: np.ndarray, in_order: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """(T, 3) places of triangle corners in the list of all corners, and the (T,) polygon that each triangle is of.

    sizes: (F,) corners of each polygon; their corners follow each other in the list. Fewer than three corners give nothing.
    Quads become two triangles, larger ones fans. Triangles come first, then the first halves of all quads, their second
    halves, and fans; ``in_order``: by polygon, unless all have the same size.
    """
    sizes = np.asarray(sizes, np.int64)
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
    places, owners = np.concatenate(places), np.concatenate(owners)
    if in_order and len(np.unique(sizes)) > 1:
        order = np.argsort(owners, kind="stable")
        places, owners = places[order], owners[order]
    return places, owners
