"""From UV images to the 32 x 32 right-triangle patches that renderer and model share (paper section 4.2, figure 16).

``bake`` is for triangles that have texture coordinates, ``transfer`` for those that lost them: remeshed and decimated
objects take, at every texel, the colour of the nearest point of the collected mesh, as both lie in the same frame. Design
choice: a texel is the mean over a grid of points in its own footprint, never a look-up in a shrunken image, so that neither
distant triangles nor other islands of the atlas bleed in; points are moved into the triangle where the footprint leaves it.
Colours are linear; texel [row, column] lies as ``SceneRecord.patches`` says.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from stages.graphics.geometry.records import TextureRecord
from stages.graphics.tonemap import from_picture
from stages.renderformer.records import PATCH_CHANNELS, PATCH_INSIDE, PATCH_KEPT, PATCH_SIDE, TEXTURED_CHANNELS

MAX_GRID = 8  # points per side of a texel's grid, at most
MAX_POINTS = 1 << 21  # per object, where the grid decides: beyond, texels get fewer points
CHUNK = 1 << 18  # points looked up at once
_LINEAR = from_picture(np.arange(256, dtype=np.uint8))  # (256,) float32: sRGB bytes in linear light


def texel_points(grid: int) -> np.ndarray:
    """(texels, grid^2, 3) barycentric weights of the points that each texel inside the triangle is the mean of.

    Texels are those of PATCH_INSIDE in row-major order; points outside the triangle are moved to its nearest side.
    """
    row, column = np.nonzero(PATCH_INSIDE)
    step = (np.arange(grid) + 0.5) / grid
    down, right = (axis.ravel() for axis in np.meshgrid(step, step, indexing="ij"))
    first = (column[:, None] + right) / PATCH_SIDE
    second = (row[:, None] + down) / PATCH_SIDE
    over = np.maximum(first + second - 1, 0) / 2
    first, second = np.maximum(first - over, 0), np.maximum(second - over, 0)
    return np.stack([1 - first - second, first, second], axis=-1)


def full_patches(inside: np.ndarray) -> np.ndarray:
    """(F, 32, 32, C) from the (F, texels, C) values inside the triangle.

    The texels just beyond the third side go on linearly from their three neighbours, so that bilinear look-up inside the
    triangle is linear in between; the rest is 0.
    """
    patches = np.zeros((len(inside), PATCH_SIDE, PATCH_SIDE, inside.shape[-1]), inside.dtype)
    patches[:, PATCH_INSIDE] = inside
    row, column = np.nonzero(PATCH_KEPT & ~PATCH_INSIDE)
    beyond = patches[:, row - 1, column] + patches[:, row, column - 1] - patches[:, row - 1, column - 1]
    patches[:, row, column] = np.clip(beyond, 0, 1)
    return patches


def look_up(image: np.ndarray, uv: np.ndarray, wrap: tuple[int, int] = (0, 0)) -> np.ndarray:
    """(N, 3) float32 linear colours of a (H, W, 3) uint8 sRGB image at (N, 2) coordinates, bilinear in linear light.

    (0, 0) is the upper left corner, v runs down. ``wrap``: indices into TextureRecord.WRAPS along u and v.
    """
    cells = []
    for axis, size in ((0, image.shape[1]), (1, image.shape[0])):
        mode, x = TextureRecord.WRAPS[wrap[axis]], np.asarray(uv[:, axis], np.float64)
        if mode == "repeat":
            x = x - np.floor(x)
        elif mode == "mirror":
            x = 1 - np.abs(1 - x % 2)
        x = np.clip(x, 0, 1) * size - 0.5
        low = np.floor(x).astype(np.int64)
        part = (x - low).astype(np.float32)[:, None]
        ends = np.stack([low, low + 1])
        cells.append((ends % size if mode == "repeat" else ends.clip(0, size - 1), part))
    (columns, right), (rows, down) = cells
    upper, lower = (
        _LINEAR[image[rows[side], columns[0]]] * (1 - right) + _LINEAR[image[rows[side], columns[1]]] * right for side in (0, 1)
    )
    return upper * (1 - down) + lower * down


def bake(image: np.ndarray, uv: np.ndarray, wrap: tuple[int, int] = (0, 0)) -> np.ndarray:
    """(F, 32, 32, 3) float32 linear colours of triangles with (F, 3, 2) corner coordinates on a (H, W, 3) uint8 sRGB image."""
    scale = np.array([image.shape[1], image.shape[0]])
    grid = _grid_for(float(_areas(np.asarray(uv, np.float64) * scale).sum()), len(uv))
    weights = texel_points(grid)

    def colours(chunk: np.ndarray) -> np.ndarray:
        points = np.einsum("tgk,fkc->ftgc", weights, uv[chunk].astype(np.float64))
        return look_up(image, points.reshape(-1, 2), wrap)

    return _means(colours, len(uv), weights.shape)


def transfer(
    texture: TextureRecord, vertices: np.ndarray, faces: np.ndarray, triangles: np.ndarray, seen: np.ndarray | None = None
) -> np.ndarray:
    """(F, 32, 32, 3) float32 linear colours of ``triangles`` (F, 3, 3) from the nearest points of a textured mesh.

    The mesh as of `nearest_colours`, in the frame of the triangles.
    """
    look = nearest_colours(texture, vertices, faces, seen)
    weights = texel_points(points_per_side(texture, len(triangles)))

    def colours(chunk: np.ndarray) -> np.ndarray:
        return look(np.einsum("tgk,fkc->ftgc", weights, triangles[chunk].astype(np.float64)).reshape(-1, 3))

    return _means(colours, len(triangles), weights.shape)


def nearest_colours(
    texture: TextureRecord, vertices: np.ndarray, faces: np.ndarray, seen: np.ndarray | None = None
) -> Callable[[np.ndarray], np.ndarray]:
    """A function of (N, 3) points: (N, 3) float32 linear colours of the nearest points of a textured mesh.

    vertices (V, 3), faces (S, 3): the mesh that ``texture`` belongs to. ``seen``: (S,) bool, the faces to take colours from
    (None: all).
    """
    import igl

    visible = np.arange(len(faces)) if seen is None or not seen.any() else np.flatnonzero(seen)
    vertices = np.ascontiguousarray(vertices, np.float64)
    faces = np.ascontiguousarray(faces[visible], np.int64)
    material, uv = texture.material[visible].astype(np.int64), texture.uv[visible].astype(np.float64)
    tint = None if texture.tint is None else texture.tint[visible]
    corners = vertices[faces]
    tree = igl.AABB()
    tree.init(vertices, faces)

    def colours(points: np.ndarray) -> np.ndarray:
        _, face, nearest = tree.squared_distance(vertices, faces, np.ascontiguousarray(points))
        face = np.asarray(face).ravel()
        place = barycentric(nearest, corners[face])
        where = np.einsum("nk,nkc->nc", place, uv[face])
        look = material[face]
        out = texture.colour[look].astype(np.float32)
        for row in np.flatnonzero(texture.image >= 0):
            of_look = look == row
            if of_look.any():
                out[of_look] *= look_up(texture.images[texture.image[row]], where[of_look], tuple(texture.wrap[row]))
        if tint is not None:
            out *= np.einsum("nk,nkc->nc", place, tint[face]).astype(np.float32)
        return out

    return colours


def points_per_side(texture: TextureRecord, count: int) -> int:
    """Of the grid of points that a texel of ``count`` triangles is the mean of."""
    sizes = np.array([(1, 1)] + [(image.shape[1], image.shape[0]) for image in texture.images], np.float64)
    scale = sizes[texture.image[texture.material].astype(np.int64) + 1]
    pixels = _areas(texture.uv.astype(np.float64) * scale[:, None])
    return _grid_for(float(np.minimum(pixels, 1e9).sum()), count)


def seen_faces(vertices: np.ndarray, faces: np.ndarray, number: int = 60000) -> np.ndarray:
    """(F,) bool: faces with a point that a ray from outside meets, among their centres and points spread over the area."""
    from stages.graphics.geometry import measure

    points, normals, owner = measure.sample_with_faces(vertices, faces, number)
    vectors = measure.face_vectors(vertices, faces)
    centres = measure.corners_of(vertices, faces).mean(axis=1)
    normals = np.concatenate([normals, vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)])
    outer = measure.Visibility(vertices, faces).outer(np.concatenate([points, centres]), normals)
    seen = np.zeros(len(faces), bool)
    seen[np.concatenate([owner, np.arange(len(faces))])[outer]] = True
    return seen


def material_patches(colours: np.ndarray, bound: float, specular: float, roughness: float) -> np.ndarray:
    """(F, 7, 32, 32) float16 patches: diffuse = ``bound`` times the (F, 32, 32, 3) colours, the rest constant."""
    patches = np.zeros((len(colours), TEXTURED_CHANNELS, PATCH_SIDE, PATCH_SIDE), np.float16)
    patches[:, PATCH_CHANNELS["diffuse"]] = np.moveaxis(bound * colours, 3, 1)
    patches[:, PATCH_CHANNELS["specular"]] = specular * PATCH_KEPT
    patches[:, PATCH_CHANNELS["roughness"]] = roughness * PATCH_KEPT
    return patches


def _areas(triangles: np.ndarray) -> np.ndarray:
    """(F,) areas of (F, 3, 2) triangles in the plane."""
    a, b = np.moveaxis(triangles[:, 1:] - triangles[:, :1], 1, 0)
    return np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2


def _grid_for(pixels: float, faces: int) -> int:
    """Points per side of a texel's grid: a point per image pixel that it covers, within limits."""
    texels = max(1, faces) * int(PATCH_INSIDE.sum())
    most = max(1, math.isqrt(MAX_POINTS // texels))
    return int(min(max(1, math.ceil(math.sqrt(pixels / texels))), MAX_GRID, most))


def _means(colours, faces: int, shape: tuple[int, ...]) -> np.ndarray:
    """Full patches of ``faces`` triangles, whose points' ``colours`` are asked for in chunks of faces."""
    texels, points = shape[:2]
    size = max(1, CHUNK // (texels * points))
    inside = np.empty((faces, texels, 3), np.float32)
    for start in range(0, faces, size):
        chunk = np.arange(start, min(start + size, faces))
        inside[chunk] = colours(chunk).reshape(len(chunk), texels, points, 3).mean(axis=2)
    return full_patches(inside)


def barycentric(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(N, 3) weights of points that lie in (N, 3, 3) triangles; even where a triangle has no area."""
    a, b, p = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], points - corners[:, 0]
    aa, ab, bb = (np.einsum("ij,ij->i", x, y) for x, y in ((a, a), (a, b), (b, b)))
    pa, pb = np.einsum("ij,ij->i", p, a), np.einsum("ij,ij->i", p, b)
    determinant = aa * bb - ab * ab
    good = determinant > 1e-300
    safe = np.where(good, determinant, 1)
    first = np.where(good, (bb * pa - ab * pb) / safe, 1 / 3).clip(0, 1)
    second = np.where(good, (aa * pb - ab * pa) / safe, 1 / 3).clip(0, 1)
    total = np.maximum(first + second, 1)
    first, second = first / total, second / total
    return np.stack([1 - first - second, first, second], axis=1)
