"""Any triangles to one closed mesh of their outer surface (paper section 3.3: distance field and marching cubes).

1. Unsigned distance to the triangles, only in a narrow band of blocks. 2. What the outside cannot reach at level eps is
inside, and so is a cavity behind a narrow opening that cannot be looked into. 3. Marching cubes at that level.
4. Vertices move back to the surface: all the way (but ``solid_gap``) where there is inside behind it, up to
``sheet_gap`` where the other side is outside too, so that open sheets keep two sides. 5. Components that no ray from
outside reaches, and specks, are dropped.

A winding number or a signed distance would need closed, oriented input; this needs only a surface. Everything is array
work; lengths are in voxels unless said.
"""

from __future__ import annotations

import itertools

import numpy as np

from pipeline.errors import Reject
from stages.graphics.geometry import measure

BLOCK = 8  # voxels along the side of a block of the band
MARGIN = 3  # voxels of empty space around the object, at least
CAVITY_RADII = (0.03, 0.06, 0.1)  # of the longest side: openings up to twice as wide may be closed


def remesh(
    vertices: np.ndarray,
    faces: np.ndarray,
    resolution: int,
    eps: float = 0.87,
    sheet_gap: float = 0.3,
    solid_gap: float = 0.05,
    min_area_share: float = 1e-4,
) -> tuple[np.ndarray, np.ndarray]:
    """Watertight (vertices float64, faces int64), outward, of the outer surface; ``resolution`` voxels along the
    longest side."""
    vertices, faces = np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int64)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    voxel = float((high - low).max()) / (resolution - 2 * MARGIN)
    blocks = np.ceil((high - low) / voxel / BLOCK + 2 * MARGIN / BLOCK + 1e-9).astype(int)
    origin = (low + high) / 2 - (blocks * BLOCK - 1) / 2 * voxel
    grid = (vertices - origin) / voxel

    # an edge of the grid that crosses level eps has no end farther than eps + 1 from the surface
    distance = narrow_band(grid, faces, blocks, reach=eps + 1.01)
    value, outside = signed_field(distance, eps)
    fill_cavities(value, outside, [share * resolution for share in CAVITY_RADII])
    if not (value < 0).any():
        raise Reject("no_surface", f"grid {resolution}")
    surface, triangles = marching_cubes(value)
    surface, triangles = visible_components(surface, triangles, min_area_share)
    surface = pull_back(surface, triangles, grid, faces, outside, eps, sheet_gap, solid_gap)
    if not measure.watertight(triangles, len(surface)):
        raise Reject("not_watertight", f"grid {resolution}")
    if measure.component_volumes(surface, triangles).min() <= 0:
        raise Reject("inside_out", f"grid {resolution}")
    return surface * voxel + origin, triangles


def narrow_band(grid: np.ndarray, faces: np.ndarray, blocks: np.ndarray, reach: float) -> np.ndarray:
    """Distance of every voxel to the triangles where it is under ``reach``, else some larger number; float32, blocks *
    BLOCK.

    Blocks whose centre is too far away to hold a voxel in reach are skipped, then their eighths, then voxels are asked.
    """
    field = np.full(blocks * BLOCK, np.float32(reach + 1))
    cells = np.stack(np.meshgrid(*[np.arange(n) for n in blocks], indexing="ij"), axis=-1).reshape(-1, 3) * BLOCK
    side = BLOCK
    while True:
        near = measure.distances(cells + (side - 1) / 2, grid, faces)
        if side == 1:
            field[tuple(cells.T)] = np.minimum(near, reach + 1)
            return field
        cells = cells[near <= reach + np.sqrt(3) * (side - 1) / 2]
        side //= 2
        halves = np.stack(np.meshgrid(*[[0, side]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        cells = (cells[:, None] + halves).reshape(-1, 3)


def signed_field(distance: np.ndarray, eps: float) -> tuple[np.ndarray, np.ndarray]:
    """(distance minus eps outside and negative inside; mask of the outside). Outside: what a walk from the border
    reaches."""
    from scipy import ndimage

    labels, _ = ndimage.label(distance > eps)
    outside = labels == labels[0, 0, 0]
    value = distance - np.float32(eps)
    value[~outside] = np.minimum(value[~outside], -value[~outside])
    # a value of almost zero would put a vertex onto a voxel, and triangles of no area around it
    value = np.where(outside, np.maximum(value, 0.02), np.minimum(value, -0.02))
    return value.astype(np.float32), outside


def seen_from_outside(free: np.ndarray) -> np.ndarray:
    """Voxels from which a straight way in one of 64 directions leaves the grid through free voxels."""
    seen = np.zeros_like(free)
    turned = [np.ascontiguousarray(np.moveaxis(free, axis, 0)) for axis in range(3)]
    for direction in measure.sphere_directions():
        axis = int(np.argmax(np.abs(direction)))
        view, out = turned[axis], np.moveaxis(seen, axis, 0)
        if direction[axis] < 0:
            view, out = view[::-1], out[::-1]
        slope = np.delete(direction, axis) / abs(direction[axis])
        steps = np.diff(np.rint(np.arange(len(view))[:, None] * slope).astype(int), axis=0) + 1  # 0, 1 or 2
        (n, m), line = view.shape[1:], view[-1]
        out[-1] |= line
        around = np.ones((n + 2, m + 2), bool)  # past the border everything is free
        # a voxel sees out if it is free and so does what the next slice has at the place where its line arrives
        for k in range(len(view) - 2, -1, -1):
            around[1:-1, 1:-1] = line
            i, j = steps[k]
            line = view[k] & around[i : i + n, j : j + m]
            out[k] |= line
    return seen


def fill_cavities(value: np.ndarray, outside: np.ndarray, radii: list[float]) -> None:
    """Count cavities as inside, in place: where no ball of a radius (voxels) gets in from outside, and most is hidden.

    An open scan is a bag: its inner side would take half of the triangles and never be seen. The opening gets the ball
    as its lid.
    """
    import edt
    from scipy import ndimage

    hidden = outside & ~seen_from_outside(outside)
    pad = int(np.ceil(max(radii))) + 2
    room = None
    for radius in radii:
        if hidden.sum() < radius**3:
            return
        if room is None:
            room = edt.edt(np.pad(outside, pad, constant_values=True), parallel=1)
        labels, _ = ndimage.label(room > radius)
        to_ball = edt.edt(labels != labels[0, 0, 0], parallel=1)[pad:-pad, pad:-pad, pad:-pad]
        pockets, number = ndimage.label(outside & (to_ball > radius))
        sizes = np.bincount(pockets.ravel(), minlength=number + 1)
        dark = np.bincount(pockets.ravel(), hidden.ravel(), minlength=number + 1)
        fill = (sizes >= radius**3) & (dark > 0.5 * sizes)
        fill[0] = False
        filled = fill[pockets]
        if not filled.any():
            continue
        lid = ndimage.binary_dilation(filled) & outside & ~filled
        field = np.float32(radius) - to_ball
        value[lid] = np.maximum(np.minimum(value[lid], field[lid]), 0.02)
        value[filled] = np.minimum(field[filled], -0.02)
        outside[filled] = False
        hidden[filled] = False


def marching_cubes(value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The zero level as (vertices, faces), outward."""
    from skimage import measure as images

    surface, triangles, _, _ = images.marching_cubes(value, 0.0, gradient_direction="ascent", allow_degenerate=True)
    surface, triangles = surface.astype(np.float64), triangles.astype(np.int64)
    if measure.volume(surface, triangles) < 0:
        triangles = triangles[:, ::-1]
    return surface, np.ascontiguousarray(triangles)


def visible_components(surface: np.ndarray, triangles: np.ndarray, min_area_share: float) -> tuple[np.ndarray, np.ndarray]:
    """Without components of under that share of the area, and without those of which no ray from outside hits a
    face."""
    component = measure.vertex_components(triangles, len(surface))[triangles[:, 0]]
    areas = measure.face_areas(surface, triangles)
    keep = np.bincount(component, areas) >= min_area_share * areas.sum()
    if keep.sum() > 1:
        # up to 200 faces of each component, evenly spread, are asked
        order = np.argsort(component, kind="stable")
        counts = np.bincount(component)
        rank = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
        sampled_triangles = order[(rank % np.maximum(1, np.repeat(counts, counts) // 200) == 0) & keep[component[order]]]
        vectors = measure.face_vectors(surface, triangles[sampled_triangles])
        normals = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)
        centres = measure.corners_of(surface, triangles[sampled_triangles]).mean(axis=1)
        seen = measure.Visibility(surface, triangles).outer(centres, normals, two_sided=False)
        keep &= np.bincount(component[sampled_triangles], seen, minlength=len(keep)) > 0
    if not keep.any():
        raise Reject("hidden")
    return measure.compact(surface, triangles[keep[component]])


def pull_back(
    surface: np.ndarray,
    triangles: np.ndarray,
    grid: np.ndarray,
    faces: np.ndarray,
    outside: np.ndarray,
    eps: float,
    sheet_gap: float,
    solid_gap: float,
) -> np.ndarray:
    """Vertices moved from level eps towards the closest point of the original; where a triangle would turn over, less
    far."""
    import igl

    squared, _, closest = igl.point_mesh_squared_distance(surface, grid, faces)
    away = np.sqrt(squared)
    direction = (closest - surface) / np.maximum(away, 1e-9)[:, None]
    # behind the surface: outside too (a sheet, or a part thinner than this) or inside?
    behind = np.zeros(len(surface), bool)
    for step in (eps + 0.6, eps + 1.2):
        voxels = np.rint(closest + step * direction).astype(int)
        voxels = np.clip(voxels, 0, np.array(outside.shape) - 1)
        behind |= outside[tuple(voxels.T)]
    gap = smooth(np.where(behind, sheet_gap, solid_gap), triangles)
    step = np.where(away < eps + 0.75, np.maximum(away - gap, 0), 0)  # farther ones are the lid of a cavity
    before = measure.face_vectors(surface, triangles)
    length = np.linalg.norm(before, axis=1)
    normals = before / np.maximum(length, 1e-300)[:, None]
    share = np.ones(len(surface))
    look = np.arange(len(triangles))  # at these faces: a corner has just moved
    for attempt in itertools.count():
        moved = surface + (share * step)[:, None] * direction
        after = measure.face_vectors(moved, triangles[look])
        # neither turned over nor, seen along the normal that it had, shrunk to almost nothing
        along = np.einsum("ij,ij->i", after, normals[look])
        bad = along <= np.maximum(0.1 * np.linalg.norm(after, axis=1), 0.02 * length[look])
        if not bad.any():
            return moved
        touched = np.zeros(len(surface), bool)
        touched[triangles[look[bad]]] = True
        share[touched] *= 0.6 if attempt < 6 else 0  # ends: an unmoved triangle is not bad
        look = np.flatnonzero(touched[triangles].any(axis=1))


def smooth(gap: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """The largest gap among a vertex and its neighbours: a sheet's rim is not pulled flat beside a solid."""
    out = gap.copy()
    for corner in (1, 2):
        np.maximum.at(out, triangles, gap[np.roll(triangles, corner, axis=1)])
    return out
