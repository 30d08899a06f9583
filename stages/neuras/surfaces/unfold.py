"""Charts by xatlas, tile by tile, and their tiles packed into one texture.

xatlas' time grows faster than the number of faces, so a large mesh is cut into tiles. Each tile has a texel density of its
own, since far walls need fewer texels than the road in front of the camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.neuras.records import AtlasMesh, Mesh


@dataclass(frozen=True, eq=False)
class Tile:
    """A part of a mesh, unfolded. vertices: (N, 3) float32; uvs: (N, 2) float32 in texels, v down; faces: (F, 3) int32;
    charts: (F,) int32; source: (F,) int32, each face's row in the whole mesh. width, height: texels."""

    vertices: np.ndarray
    uvs: np.ndarray
    faces: np.ndarray
    charts: np.ndarray
    source: np.ndarray
    width: int
    height: int


def tiles(mesh: Mesh, most_faces: int) -> list[np.ndarray]:
    """Rows of faces per tile: halves along the longest side of the centres' box until each has at most ``most_faces``."""
    centres = mesh.vertices[mesh.faces].mean(axis=1)
    waiting, done = [np.arange(len(mesh.faces))], []
    while waiting:
        rows = waiting.pop()
        if len(rows) <= most_faces:
            done.append(np.sort(rows))
            continue
        axis = int(np.argmax(np.ptp(centres[rows], axis=0)))
        order = rows[np.argsort(centres[rows, axis], kind="stable")]
        waiting += [order[len(order) // 2 :], order[: len(order) // 2]]
    return done


def unfold(mesh: Mesh, rows: np.ndarray, texels_per_unit: float, padding: int) -> Tile:
    """Charts of the faces ``rows``, packed into a rectangle of texels with ``padding`` texels between them."""
    import xatlas

    used, faces = np.unique(mesh.faces[rows], return_inverse=True)
    faces = faces.reshape(-1, 3).astype(np.uint32)
    positions = mesh.vertices[used] - mesh.vertices[used].mean(axis=0)  # small numbers: xatlas computes in single precision
    atlas = xatlas.Atlas()
    atlas.add_mesh(np.ascontiguousarray(positions, np.float32), faces)
    options = xatlas.PackOptions()
    options.texels_per_unit = float(texels_per_unit)
    options.padding = int(padding)
    options.bilinear = True
    options.rotate_charts = True
    atlas.generate(xatlas.ChartOptions(), options)
    copies, unfolded, uvs = atlas.get_mesh(0)
    charts = np.full(len(rows), -1, np.int32)
    for chart in range(atlas.get_mesh_chart_count(0)):
        charts[np.asarray(atlas.get_mesh_chart(0, chart).faces)] = chart
    width, height = max(atlas.width, 1), max(atlas.height, 1)
    return Tile(
        vertices=mesh.vertices[used][copies],
        uvs=(np.asarray(uvs) * (width, height)).astype(np.float32),
        faces=np.asarray(unfolded, np.int32).reshape(-1, 3),
        charts=charts,
        source=np.asarray(rows, np.int32),
        width=width,
        height=height,
    )


def shelves(sizes: list[tuple[int, int]], width: int, gap: int) -> tuple[list[tuple[int, int]], int]:
    """Places (x, y) of rectangles (w, h) on shelves of ``width``, tallest first, ``gap`` apart; and the height of all."""
    places: list[tuple[int, int]] = [(0, 0)] * len(sizes)
    x = y = shelf = 0
    for index in sorted(range(len(sizes)), key=lambda i: (-sizes[i][1], -sizes[i][0], i)):
        w, h = sizes[index]
        if x and x + w > width:
            x, y, shelf = 0, y + shelf + gap, 0
        places[index] = (x, y)
        x, shelf = x + w + gap, max(shelf, h)
    return places, y + shelf


def pack(parts: list[Tile], gap: int, size: int | None = None, multiple: int = 4) -> AtlasMesh:
    """One texture of all tiles: about square, or ``size`` x ``size``; sides are multiples of ``multiple``.

    Tiles that do not fit a given size are made smaller by one factor for all.
    """
    sizes = [(part.width, part.height) for part in parts]
    widest = max(w for w, _ in sizes)
    area = sum(w * h for w, h in sizes)
    guesses = [max(widest, int(np.sqrt(area) * factor)) for factor in np.linspace(0.9, 1.5, 25)]
    packings = {width: shelves(sizes, width, gap) for width in guesses}
    width = min(packings, key=lambda w: (max(w, packings[w][1]), w))
    places, height = packings[width]
    width = max(x + w for (x, _), (w, _) in zip(places, sizes, strict=True))
    scale = 1.0 if size is None else min(1.0, size / max(width, height))
    width, height = (size, size) if size else tuple(-(-side // multiple) * multiple for side in (width, height))
    first_vertex = np.cumsum([0, *(len(part.vertices) for part in parts)])
    first_chart = np.cumsum([0, *(int(part.charts.max(initial=-1)) + 1 for part in parts)])
    order = np.argsort(np.concatenate([part.source for part in parts]), kind="stable")
    uvs = np.concatenate([(part.uvs + place) * scale for part, place in zip(parts, places, strict=True)])
    return AtlasMesh(
        vertices=np.concatenate([part.vertices for part in parts]).astype(np.float32),
        uvs=(uvs / (width, height)).astype(np.float32),
        faces=np.concatenate([part.faces + v for part, v in zip(parts, first_vertex, strict=False)])[order].astype(np.int32),
        charts=np.concatenate([part.charts + c for part, c in zip(parts, first_chart, strict=False)])[order].astype(np.int32),
        width=int(width),
        height=int(height),
    )
