"""Charts by xatlas, tile by tile, and their tiles packed into one texture.

xatlas' time grows faster than the number of faces, so a large mesh is cut into tiles. Each tile has a texel density of its
own, since far walls need fewer texels than the road in front of the camera.
"""

from __future__ import annotations

from collections.abc import Callable
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


@dataclass(frozen=True, eq=False)
class Placed:
    """Charts in one rectangle. copies: (N,) which given vertex each is; faces: (F, 3) int32; uvs: (N, 2) float32 in texels."""

    copies: np.ndarray
    faces: np.ndarray
    uvs: np.ndarray
    width: int
    height: int


Packer = Callable[[np.ndarray, np.ndarray, np.ndarray, int], Placed]  # uvs in texels, faces, charts, padding


def by_xatlas(uvs: np.ndarray, faces: np.ndarray, charts: np.ndarray, padding: int) -> Placed:
    """Charts packed closely, each at its own size. It finds them by itself: no two may touch in ``uvs``."""
    import xatlas

    atlas = xatlas.Atlas()
    atlas.add_uv_mesh(np.ascontiguousarray(uvs, np.float32), np.ascontiguousarray(faces, np.uint32))
    options = xatlas.PackOptions()
    options.texels_per_unit = 1.0
    options.padding = int(padding)
    options.bilinear = True
    atlas.generate(pack_options=options)
    copies, packed, placed = atlas.get_mesh(0)
    size = (atlas.width, atlas.height)
    return Placed(copies, np.asarray(packed, np.int32).reshape(-1, 3), np.asarray(placed) * size, *size)


def pack(parts: list[Tile], padding: int, size: int | None = None, multiple: int = 16, packer: Packer = by_xatlas) -> AtlasMesh:
    """One texture of all charts of all tiles, each at its own size: about square, sides multiples of ``multiple``.

    With ``size`` the texture is ``size`` x ``size``, and charts that do not fit are made smaller by one factor for all.
    """
    first_vertex = np.cumsum([0, *(len(part.vertices) for part in parts)])
    first_chart = np.cumsum([0, *(int(part.charts.max(initial=-1)) + 1 for part in parts)])
    left = np.cumsum([0, *(part.width + 16 for part in parts)])  # tiles side by side, so that no two charts touch
    order = np.argsort(np.concatenate([part.source for part in parts]), kind="stable")
    faces = np.concatenate([part.faces + first for part, first in zip(parts, first_vertex, strict=False)])[order]
    charts = np.concatenate([part.charts + first for part, first in zip(parts, first_chart, strict=False)])[order]
    spread = np.concatenate([part.uvs + (x, 0) for part, x in zip(parts, left, strict=False)]).astype(np.float32)
    placed = packer(spread, faces, charts, padding)
    width, height, texels = placed.width, placed.height, placed.uvs
    if size is not None:
        texels = texels * min(1.0, size / max(width, height))
    width, height = (size, size) if size else (-(-side // multiple) * multiple for side in (width, height))
    return AtlasMesh(
        vertices=np.concatenate([part.vertices for part in parts])[placed.copies].astype(np.float32),
        uvs=(texels / (width, height)).astype(np.float32),
        faces=placed.faces,
        charts=charts.astype(np.int32),
        width=int(width),
        height=int(height),
    )
