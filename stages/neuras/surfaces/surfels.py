"""Surfels: squares at points that no surface holds, of leaves, wires and railings.

A square is two faces that follow one another in a mesh. Squares come last, so a number tells which faces they are.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from stages.graphics.casting import Caster
from stages.neuras.rasterizing.photos import FAR, Source, beside, look_up
from stages.neuras.records import Mesh
from stages.neuras.surfaces.photometric import Photo


def at_points(points: np.ndarray, viewers: np.ndarray, side: float) -> Mesh:
    """A square of two triangles at each point, turned towards where the point was seen from. points, viewers: (P, 3)."""
    towards = viewers - points
    towards = towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    least = np.eye(3)[np.abs(towards).argmin(axis=1)]  # the axis that is least along the view
    across = np.cross(towards, least)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    along = np.cross(towards, across)
    corners = [points + side / 2 * (a * across + b * along) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    faces = 4 * np.arange(len(points))[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])
    return Mesh(np.stack(corners, axis=1).reshape(-1, 3).astype(np.float32), faces.reshape(-1, 3).astype(np.int32))


def nearest(squares: Mesh, eyes: Sequence[np.ndarray], most: int) -> Mesh:
    """The ``most`` squares that are nearest to any of the ``eyes`` (3,), in their order."""
    if len(squares.faces) <= 2 * most:
        return squares
    centres = squares.vertices[squares.faces].mean(axis=1).reshape(-1, 2, 3).mean(axis=1)
    apart = cKDTree(np.array(eyes)).query(centres)[0]
    kept = np.sort(np.argsort(apart, kind="stable")[:most])
    return Mesh.compact(squares.vertices, squares.faces.reshape(-1, 2, 3)[kept].reshape(-1, 3))


def seen_through(mesh: Mesh, count: int, photos: Sequence[Photo], neighbours: int) -> np.ndarray:
    """(S,) bool of the squares, the last ``count`` faces of the mesh: whether photos rather show what lies behind.

    A pixel of a photo that meets a square is told from the nearest ``neighbours`` other photos, twice: by the point on the
    square, and by the point behind, on the surface without squares or at the sky. The square goes if the second is nearer
    to the pixel in the mean of squares. Pixels that others cannot tell both ways do not count; nor goes a square without any.
    """
    first = len(mesh.faces) - count
    whole, surface = (Caster(mesh.vertices, faces) for faces in (mesh.faces, mesh.faces[:first]))
    middle = mesh.vertices.mean(axis=0)
    far = FAR * float(np.linalg.norm(mesh.vertices - middle, axis=1).max(initial=1e-9))
    cameras = [photo.camera for photo in photos]

    @functools.lru_cache(maxsize=4 * neighbours)
    def source(number: int) -> Source:
        photo = photos[number]
        return Source(photo.camera, photo.image.astype(np.float32) / 255, photo.counts, whole.view(photo.camera))

    votes = np.zeros(count // 2)  # of squared error by the square over that by what is behind
    for number, camera in enumerate(cameras):
        own = source(number)
        on_square = (own.view.face >= first) & own.counts
        if not on_square.any():
            continue
        rays = camera.directions()[on_square]
        _, _, depth = surface.cast(np.broadcast_to(camera.position, rays.shape), rays)
        near = camera.position + rays * own.view.depth[on_square][:, None]
        beyond = camera.position + rays * np.where(depth > 0, depth, far)[:, None]
        sources = [source(other) for other in beside(cameras, number, neighbours)]
        told = [_told(sources, points, on_mesh) for points, on_mesh in ((near, np.ones(len(rays), bool)), (beyond, depth > 0))]
        judged = told[0][1] & told[1][1]
        errors = [((colour - own.image[on_square]) ** 2).mean(axis=-1)[judged] for colour, _ in told]
        np.add.at(votes, (own.view.face[on_square][judged] - first) // 2, errors[0] - errors[1])
    return votes > 0


def _told(sources: Sequence[Source], points: np.ndarray, on_mesh: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean colours (N, 3) of points (N, 3) in the sources that see them, and (N,) bool: whether any does."""
    colours, seen = np.zeros(points.shape), np.zeros(len(points))
    for source in sources:
        colour, sees = look_up(source, points, on_mesh)
        colours += colour * sees[..., None]
        seen += sees
    return colours / np.maximum(seen, 1)[..., None], seen > 0
