"""A scene cut into tiles that a page loads and drops one by one: which faces, and which texels of which level, belong to each.

Tiles are cells of a grid on the ground, so drives and flights are cut alike; the grid lies along the cameras' path. Charts of
one tile lie scattered over the whole texture. So each level of a tile becomes an image of its own, in which the rectangles
that its charts cover are packed anew. Texels are copied, never resampled, and each rectangle has the texels around it that
filters read. So a tile draws what the whole scene draws.

All images have the same width. The page can then keep them one below the other in one texture, its *pool*. That has several
such columns side by side, because a texture may be only so high.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.neuras.sampling import Pyramid
from pipeline.errors import UserError
from stages.graphics.cameras import Camera
from stages.neuras.baking.drawing import lens
from stages.neuras.records import AtlasMesh

FILTER = 1  # texels beyond those of a bilinear sample that the pair of samples of a long footprint reaches
SPARE = 1.25  # the pool's rows over those that the driven path needs: room to load ahead, and what lies between images
MULTIPLE = 16  # of the pool's sides


@dataclass(frozen=True)
class Tiling:
    """side: of a tile on the ground. reach: how far from the camera tiles are loaded. Both in world units. largest: texels
    along a side that devices are expected to take."""

    side: float
    reach: float
    largest: int


@dataclass(frozen=True, eq=False)
class Tile:
    """A part of a scene.

    mesh: its faces, with texture coordinates of the whole texture; ``charts`` are numbers of its own, 0 to P - 1. charts: (P,)
    the whole scene's numbers of them. corners, sizes: of each level (P, 2) int64, row and column in the level where the
    texels begin that a chart needs, and how many. density: texels of level 0 along a world unit, where it is lowest.
    """

    mesh: AtlasMesh
    charts: np.ndarray
    corners: list[np.ndarray]
    sizes: list[np.ndarray]
    density: float

    def needed(self, distance: float, pixel: float) -> int:
        """The finest level that any pixel asks for. distance: of the tile; pixel: its side at distance 1."""
        texels = max(self.density * distance * pixel, 1.0)
        return min(int(np.log2(texels)), len(self.sizes) - 1)

    def distance(self, position: np.ndarray) -> float:
        """From its box, world units; 0 inside."""
        low, high = self.mesh.vertices.min(axis=0), self.mesh.vertices.max(axis=0)
        return float(np.linalg.norm(np.maximum(np.maximum(low - position, position - high), 0)))


@dataclass(frozen=True, eq=False)
class Tiles:
    """A whole scene. places: of each tile and level (P, 2), row and column of its charts in that level's image.
    rows: of each tile and level, the image's height. width: of all images. columns, height: of the page's pool, in images and
    in rows. reach: ``Tiling``'s.
    """

    tiles: list[Tile]
    places: list[list[np.ndarray]]
    rows: list[list[int]]
    width: int
    columns: int
    height: int
    reach: float

    def image(self, tile: int, level: int, sheet: np.ndarray, pyramid: Pyramid) -> np.ndarray:
        """(rows, width, ..): the texels of a tile's level. sheet: (H, W, ..), all levels of the whole scene."""
        one, (row, column) = self.tiles[tile], pyramid.corner(level)
        image = np.zeros((self.rows[tile][level], self.width, *sheet.shape[2:]), sheet.dtype)
        for (top, left), (y, x), (high, wide) in zip(
            self.places[tile][level], one.corners[level] + (row, column), one.sizes[level], strict=True
        ):
            image[top : top + high, left : left + wide] = sheet[y : y + high, x : x + wide]
        return image

    def table(self, tile: int, level: int) -> np.ndarray:
        """(P, 8) int32: what a chart's texel coordinates (x, y) in the whole level grow by in the image, 0, the whole scene's
        number of the chart, and the corners of its texels in the image: x, y, and beyond the last x, y."""
        one, places = self.tiles[tile], self.places[tile][level]
        moves, ends = places - one.corners[level], places + one.sizes[level]
        zero = np.zeros_like(one.charts)
        return np.column_stack([moves[:, ::-1], zero, one.charts, places[:, ::-1], ends[:, ::-1]]).astype(np.int32)


def cut(atlas: AtlasMesh, pyramid: Pyramid, up: Sequence[float], cameras: Sequence[Camera], tiling: Tiling) -> Tiles:
    """The scene in tiles, and a pool with room for what each of the cameras needs; UserError where no device has that room."""
    cells = _cells(atlas, np.asarray(up, float), np.array([camera.position for camera in cameras]), tiling.side)
    tiles = [_tile(atlas, pyramid, np.flatnonzero(cells == cell)) for cell in range(cells.max() + 1)]
    widest = max(int(sizes[:, 1].max()) for tile in tiles for sizes in tile.sizes)
    width = _rounded(max(widest, np.sqrt(np.mean([tile.sizes[0].prod(axis=1).sum() for tile in tiles]))))
    packed = [[_packed(sizes, width) for sizes in tile.sizes] for tile in tiles]
    rows = [[height for _, height in levels] for levels in packed]
    needed = SPARE * max(_needed(tiles, rows, camera, tiling.reach) for camera in cameras)
    columns = max(1, int(np.ceil(needed / tiling.largest)))
    height = _rounded(max(needed / columns, *(max(levels) for levels in rows)))
    if max(columns * width, height) > tiling.largest:
        raise UserError(
            f"the tiles near at one time need a texture of {columns * width} x {height} texels, and bake.largest="
            f"{tiling.largest}: lower bake.reach_m or bake.tile_m, or raise bake.largest for devices that take more"
        )
    return Tiles(tiles, [[places for places, _ in levels] for levels in packed], rows, width, columns, height, tiling.reach)


def pixel_side(lens: Sequence[float], width: int, height: int) -> float:
    """The least side of what a pixel shows of a surface at distance 1 from the camera, anywhere in the picture."""
    slopes = (1 + abs(lens[2])) / lens[0], (1 + abs(lens[3])) / lens[1]
    return min(2 / (width * lens[0]), 2 / (height * lens[1])) / (1 + slopes[0] ** 2 + slopes[1] ** 2)


def _needed(tiles: list[Tile], rows: list[list[int]], camera: Camera, reach: float) -> int:
    """Rows of all levels that pixels of the camera's picture ask for, of the tiles within reach."""
    pixel, total = pixel_side(lens(camera), camera.width, camera.height), 0
    for tile, levels in zip(tiles, rows, strict=True):
        distance = tile.distance(camera.position)
        if distance <= reach:
            total += sum(levels[tile.needed(distance, pixel) :])
    return total


def _cells(atlas: AtlasMesh, up: np.ndarray, positions: np.ndarray, side: float) -> np.ndarray:
    """(F,) number of the cell of each face's centre, without gaps. The path runs along a row of cells, in their middle."""
    middle = positions.mean(axis=0)
    across = np.eye(3) - np.outer(up, up) / (up @ up)
    ahead = np.linalg.svd((positions - middle) @ across)[2][0]
    axes = np.stack([ahead, np.cross(up / np.linalg.norm(up), ahead)], axis=1)
    centres = atlas.vertices[atlas.faces].astype(float).mean(axis=1) - middle
    _, cells = np.unique(np.floor(centres @ axes / side + (0, 0.5)), axis=0, return_inverse=True)
    return cells.reshape(-1)


def _tile(atlas: AtlasMesh, pyramid: Pyramid, rows: np.ndarray) -> Tile:
    used, faces = np.unique(atlas.faces[rows], return_inverse=True)
    faces = faces.reshape(-1, 3)
    charts, numbers = np.unique(atlas.charts[rows], return_inverse=True)
    vertices, uvs = atlas.vertices[used], atlas.uvs[used].astype(float)
    low, high = np.full((len(charts), 2), np.inf), np.full((len(charts), 2), -np.inf)
    np.minimum.at(low, numbers, uvs[faces].min(axis=1))
    np.maximum.at(high, numbers, uvs[faces].max(axis=1))
    corners, sizes = [], []
    for level in range(pyramid.levels):
        size = np.array(pyramid.size(level))
        first = np.floor(low[:, ::-1] * size - 0.5).astype(int) - FILTER
        last = np.floor(high[:, ::-1] * size - 0.5).astype(int) + 1 + FILTER
        first, last = np.clip(first, 0, size - 1), np.clip(last, 0, size - 1)
        corners.append(first)
        sizes.append(last + 1 - first)
    mesh = AtlasMesh(vertices, atlas.uvs[used], faces.astype(np.int32), numbers.astype(np.int32), atlas.width, atlas.height)
    return Tile(mesh, charts, corners, sizes, _density(mesh))


def _density(mesh: AtlasMesh) -> float:
    """Texels along a world unit that all but a hundredth of the surface has."""
    from stages.graphics.geometry import measure

    flat = np.pad(mesh.uvs.astype(float) * (mesh.width, mesh.height), ((0, 0), (0, 1)))
    area, texels = measure.face_areas(mesh.vertices, mesh.faces), measure.face_areas(flat, mesh.faces)
    density = np.sqrt(texels / np.maximum(area, 1e-30))
    order = np.argsort(density)
    return float(density[order][np.searchsorted(np.cumsum(area[order]), 0.01 * area.sum())])


def _packed(sizes: np.ndarray, width: int) -> tuple[np.ndarray, int]:
    """(P, 2) row and column of rectangles of ``sizes`` (P, 2), height and width, none over another; and the rows they take.

    The tallest come first; each goes where it lies highest up on what is there.
    """
    from scipy.ndimage import maximum_filter1d

    places, filled = np.zeros_like(sizes), np.zeros(width, np.int64)
    for number in np.lexsort((sizes[:, 1], sizes[:, 0]))[::-1]:
        high, wide = sizes[number]
        tops = maximum_filter1d(filled, wide, origin=-(wide // 2))[: width - wide + 1]  # of the columns from each one on
        left = int(tops.argmin())
        places[number] = tops[left], left
        filled[left : left + wide] = tops[left] + high
    return places, int(filled.max())


def _rounded(side: float) -> int:
    return int(-(-side // MULTIPLE) * MULTIPLE)
