"""Rays against a mesh with embree, on one thread: first hits, and whether a segment is free.

A pixel's ray goes through its centre, so a `Caster.view` equals rasterization but for ties on edges (0.01 % of pixels).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.graphics.cameras import Camera


@dataclass(frozen=True, eq=False)
class GBuffer:
    """What each pixel's centre sees.

    face: (H, W) int32, -1 for nothing. barycentric: (H, W, 2) float32, weights of the face's second and third corner.
    depth: (H, W) float32, distance along the ray in world units, 0 for nothing.
    """

    face: np.ndarray
    barycentric: np.ndarray
    depth: np.ndarray

    @property
    def hit(self) -> np.ndarray:
        """(H, W) bool."""
        return self.face >= 0

    def interpolate(self, faces: np.ndarray, values: np.ndarray) -> np.ndarray:
        """(H, W, C) float32: ``values`` (V, C) per vertex at each hit, 0 where there is none."""
        out = np.zeros((*self.face.shape, values.shape[1]), np.float32)
        hit = self.hit
        corners = values[faces[self.face[hit]]]
        second, third = self.barycentric[hit].T[:, :, None]
        out[hit] = corners[:, 0] * (1 - second - third) + corners[:, 1] * second + corners[:, 2] * third
        return out


class Caster:
    """A mesh that rays are cast against: build once, cast often.

    vertices: (V, 3), world; faces: (F, 3). Faces are hit from both sides. Rays are cast about ``origin`` (default: the mean of
    the vertices), since embree computes in single precision.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, origin: np.ndarray | None = None):
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        vertices = np.asarray(vertices, np.float64)
        self.faces = np.asarray(faces, np.int64)
        self.origin = vertices.mean(axis=0) if origin is None else np.asarray(origin, float)
        self.vertices = vertices - self.origin
        self._scene = rtcore_scene.EmbreeScene()
        if len(self.faces):
            TriangleMesh(self._scene, self.vertices.astype(np.float32), self.faces.astype(np.int32))

    def cast(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """First hits of rays from ``origins`` (N, 3) along unit ``directions`` (N, 3).

        Returns face (N,) int32 (-1: none), barycentric (N, 2) float32 and distance (N,) float32 (0: none), computed in
        double precision from the face that embree names.
        """
        starts = np.asarray(origins, float) - self.origin
        rays = np.asarray(directions, float)
        if not len(self.faces) or not len(rays):
            n = len(rays)
            return np.full(n, -1, np.int32), np.zeros((n, 2), np.float32), np.zeros(n, np.float32)
        face = np.asarray(self._scene.run(starts.astype(np.float32), rays.astype(np.float32)), np.int32)
        a, b, c = (self.vertices[self.faces[np.maximum(face, 0), corner]] for corner in range(3))
        barycentric, distance = _intersect(starts, rays, a, b, c)
        hit = (face >= 0) & (distance > 0)
        return (
            np.where(hit, face, -1).astype(np.int32),
            np.where(hit[:, None], barycentric, 0).astype(np.float32),
            np.where(hit, distance, 0).astype(np.float32),
        )

    def occluded(self, origins: np.ndarray, directions: np.ndarray, lengths: np.ndarray) -> np.ndarray:
        """(N,) bool: whether anything lies on the segments from ``origins`` (N, 3) along unit ``directions`` (N, 3).

        lengths: (N,), in world units.
        """
        if not len(self.faces) or not len(directions):
            return np.zeros(len(directions), bool)
        starts = (np.asarray(origins, float) - self.origin).astype(np.float32)
        rays, lengths = (np.ascontiguousarray(values, np.float32) for values in (directions, lengths))
        return np.asarray(self._scene.run(starts, rays, dists=lengths, query="OCCLUDED")) >= 0

    def view(self, camera: Camera, rays_per_side: int = 1) -> GBuffer:
        """What the camera sees; with ``rays_per_side`` n, on a grid n times as fine in both directions."""
        if rays_per_side > 1:
            camera = camera.resized(camera.width * rays_per_side, camera.height * rays_per_side)
        directions = camera.directions().reshape(-1, 3)
        face, barycentric, depth = self.cast(np.broadcast_to(camera.position, directions.shape), directions)
        shape = (camera.height, camera.width)
        return GBuffer(face.reshape(shape), barycentric.reshape(*shape, 2), depth.reshape(shape))


def _intersect(
    starts: np.ndarray, rays: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where rays meet the planes of triangles with corners a, b, c (N, 3).

    Returns the barycentric weights (N, 2) of b and c, clamped to the triangle, and distances (N,).
    """
    ab, ac = b - a, c - a
    cross = np.cross(rays, ac)
    det = np.einsum("ij,ij->i", ab, cross)
    det = np.where(np.abs(det) < 1e-300, 1e-300, det)
    offset = starts - a
    second = np.einsum("ij,ij->i", offset, cross) / det
    other = np.cross(offset, ab)
    third = np.einsum("ij,ij->i", rays, other) / det
    distance = np.einsum("ij,ij->i", ac, other) / det
    second, third = np.clip(second, 0, 1), np.clip(third, 0, 1)
    excess = np.maximum(second + third, 1)
    return np.stack([second / excess, third / excess], axis=1), distance
