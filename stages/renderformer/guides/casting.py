"""From a scene to its guides, by casting rays on one thread.

The rays do what the path tracer's do: camera rays pass through lights, all others hit them; shading normals decide where
reflections go, and both sides of a triangle are alike. One design choice: the random numbers of the sampled reflections
depend on the pixel alone, so guides are a pure function of scene, camera and resolution.
"""

from __future__ import annotations

import numpy as np

from pipeline.errors import UserError
from stages.graphics.cameras import Camera
from stages.graphics.casting import Caster
from stages.renderformer.guides.records import BOUNCE_RAYS, SUBSAMPLES, SceneGuides, ViewGuides
from stages.renderformer.records import SceneRecord

# Barycentric weights (4, 3): the centroids of the four triangles that a triangle's edge midpoints cut it into.
POINTS = np.array([[4, 1, 1], [1, 4, 1], [1, 1, 4], [2, 2, 2]]) / 6
OFFSET = 1e-4  # scene units between a surface and a ray that leaves it
SHORTER = 1 - 1e-3  # of a segment to a light, so that it does not end in it
SAME = (1e-4, 1e-2)  # scene units, and of unit normals: nearer corners are one vertex
MIN_ALPHA = 1e-4  # GGX width below which the lobe is numerically a mirror
MOST_LIGHTS = 256  # emitting triangles whose visibility is kept one by one


class GuideCaster:
    """Casts a scene's guides; build once for all of its views."""

    def __init__(self, scene: SceneRecord):
        self.scene = scene
        self.light_triangles = np.flatnonzero(scene.light_index >= 0).astype(np.int32)
        if len(self.light_triangles) > MOST_LIGHTS:
            raise UserError(
                f"scene {scene.id} has {len(self.light_triangles)} emitting triangles: guides take at most {MOST_LIGHTS}; "
                "give its lights fewer triangles, or use a model without guides"
            )
        corners = scene.triangles.astype(np.float64)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self._corners = corners
        self._normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        self._light_points = np.einsum("kc,lcd->kld", POINTS, corners[self.light_triangles])  # (4, L, 3)
        self._rows = np.flatnonzero(scene.light_index < 0).astype(np.int32)  # what camera rays see
        faces = np.arange(3 * len(corners)).reshape(-1, 3)
        self._all = Caster(corners.reshape(-1, 3), faces)
        self._visible = Caster(corners.reshape(-1, 3), faces[self._rows], self._all.origin)

    def scene_guides(self, bounces: bool = True) -> SceneGuides:
        """Which lights each of the triangles' points sees, from the side that faces the light; with ``bounces`` what else."""
        points = np.einsum("kc,ncd->nkd", POINTS, self._corners)
        count, lights = len(points), len(self.light_triangles)
        seen = np.zeros((count, SUBSAMPLES, lights), bool)
        triangle = np.repeat(np.arange(count), SUBSAMPLES)
        for point in range(SUBSAMPLES):  # each point of the triangle looks at another point of the light
            targets = np.broadcast_to(self._light_points[point], (count, lights, 3))
            free = self._free(triangle[::SUBSAMPLES, None], points[:, None, point], targets)
            seen[:, point] = free
        seen[self.light_triangles[:, None], :, np.arange(lights)] = False  # a light does not light itself
        if not bounces:
            return SceneGuides(self.light_triangles, seen)
        return SceneGuides(self.light_triangles, seen, *self._bounces(), self._vertices())

    def _bounces(self) -> tuple[np.ndarray, np.ndarray]:
        """(N, 2, 16) and (N, 2, 16, 2): what rays hit that leave points all over each triangle, from its front and its back.

        They are stratified over the disc that the hemisphere projects to. The numbers depend on the triangle's row alone.
        """
        count, side = len(self._corners), int(np.sqrt(BOUNCE_RAYS))
        shape = (count, 2, BOUNCE_RAYS)
        random = np.random.default_rng(0).random((*shape, 4))
        strata = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(BOUNCE_RAYS, 2)
        height, turn = np.moveaxis((strata + random[..., :2]) / side, -1, 0).reshape(2, -1)
        root, along = np.sqrt(random[..., 2]).ravel(), random[..., 3].ravel()
        triangle = np.repeat(np.arange(count), 2 * BOUNCE_RAYS)
        weights = np.stack([1 - root, root * (1 - along), root * along], axis=1)
        start = (self._corners[triangle] * weights[:, :, None]).sum(axis=1)
        up = frames((self._normals[:, None] * np.array([[1.0], [-1.0]])).reshape(-1, 3)).repeat(BOUNCE_RAYS, axis=0)
        radius, angle = np.sqrt(height), 2 * np.pi * turn
        ways = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - height)], axis=1)
        ways = np.einsum("nij,ni->nj", up, ways)
        starts, _ = self._leave(triangle, start, ways)
        hit, hit_weights, _ = self._all.cast(starts, ways)
        return hit.reshape(shape), hit_weights.reshape(*shape, 2)

    def _vertices(self) -> np.ndarray:
        """(N, 3): corners that lie at one place and have one shading normal, to `SAME`, have one number."""
        corners = self.scene.triangles.reshape(-1, 3).astype(float)
        normals = self.scene.vertex_normals.reshape(-1, 3).astype(float)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        keys = np.round(np.concatenate([corners / SAME[0], normals / SAME[1]], axis=1)).astype(np.int64)
        _, number = np.unique(keys, axis=0, return_inverse=True)
        return number.reshape(-1, 3).astype(np.int32)

    def view_guides(self, view: int, height: int, width: int) -> ViewGuides:
        """What camera ``view`` of the scene sees; its fov is the angle across the height."""
        scene = self.scene
        focal = height / np.tan(np.radians(float(scene.fov_deg[view])) / 2)  # of the grid twice as fine
        fine = Camera(2 * width, 2 * height, focal, focal, width, height, scene.camera_to_world[view].astype(float))
        directions = fine.directions().reshape(height, 2, width, 2, 3).swapaxes(1, 2).reshape(-1, 3)
        face, weights, _ = self._visible.cast(np.broadcast_to(fine.position, directions.shape), directions)
        hit = np.where(face >= 0, self._rows[np.maximum(face, 0)] if len(self._rows) else -1, -1).astype(np.int32)
        shape = (height, width, SUBSAMPLES)

        there = np.flatnonzero(hit >= 0)
        surface = _Surface(self, hit[there], weights[there], directions[there])
        lobe, lobe_weights = np.full(len(hit), -1, np.int32), np.zeros((len(hit), 2), np.float32)
        random = np.random.default_rng(0).random((height * width, 1, 2))
        strata = np.stack(np.meshgrid([0, 1], [0, 1]), axis=-1).reshape(1, SUBSAMPLES, 2)
        numbers = ((strata + random) / 2).reshape(-1, 2)[there]
        lobe[there], lobe_weights[there] = self._reflect(surface, sample_ggx(surface.to_eye, surface.alpha, numbers))

        landed = (hit >= 0).reshape(-1, SUBSAMPLES)
        main = np.where(landed.any(axis=1), landed.argmax(axis=1), -1).astype(np.int32)
        pixels = np.flatnonzero(main >= 0)
        chosen = np.searchsorted(there, pixels * SUBSAMPLES + main[pixels])
        mirror, mirror_weights = np.full(len(main), -1, np.int32), np.zeros((len(main), 2), np.float32)
        straight = surface.take(chosen)
        up = np.broadcast_to([0.0, 0.0, 1.0], straight.to_eye.shape)
        mirror[pixels], mirror_weights[pixels] = self._reflect(straight, up)

        seen = np.zeros((len(hit), len(self.light_triangles)), bool)
        for light in range(len(self.light_triangles)):
            target = self._light_points[(there % SUBSAMPLES), light]
            lit = np.flatnonzero(np.einsum("ij,ij->i", target - surface.position, surface.normal) > 0)
            seen[there[lit], light] = self._free(surface.triangle[lit], surface.position[lit], target[lit])
        return ViewGuides(
            hit.reshape(shape),
            weights.reshape(*shape, 2),
            main.reshape(height, width),
            mirror.reshape(height, width),
            mirror_weights.reshape(height, width, 2),
            lobe.reshape(shape),
            lobe_weights.reshape(*shape, 2),
            seen.reshape(*shape, -1),
        )

    def _free(self, triangle: np.ndarray, points: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """Whether nothing lies between points of ``triangle`` and targets; arguments broadcast, (...,) and (..., 3)."""
        points, targets = np.broadcast_arrays(points, targets)
        starts, _ = self._leave(np.broadcast_to(triangle, points.shape[:-1]), points, targets - points)
        ways = targets - starts
        lengths = np.linalg.norm(ways, axis=-1)
        ways = ways / np.maximum(lengths, 1e-30)[..., None]
        free = ~self._all.occluded(starts.reshape(-1, 3), ways.reshape(-1, 3), (lengths * SHORTER).reshape(-1))
        return free.reshape(lengths.shape)

    def _leave(self, triangle: np.ndarray, points: np.ndarray, ways: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where rays that leave ``points`` along ``ways`` begin, off the surface on the side that they go to; and the side."""
        normal = self._normals[triangle]
        side = np.where(np.einsum("...i,...i->...", normal, ways) < 0, -1.0, 1.0)
        return points + OFFSET * side[..., None] * normal, side

    def _reflect(self, surface: _Surface, facet: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What the reflections at microfacets with normals ``facet`` (N, 3), in the shading frame, hit."""
        eye = surface.to_eye
        out = 2 * np.einsum("ij,ij->i", eye, facet)[:, None] * facet - eye
        up = out[:, 2] > 0  # the others leave below the surface: nothing comes from there
        ways = surface.to_world(out)
        starts, _ = self._leave(surface.triangle, surface.position, ways)
        hit, weights = np.full(len(ways), -1, np.int32), np.zeros((len(ways), 2), np.float32)
        hit[up], weights[up], _ = self._all.cast(starts[up], ways[up])
        return hit, weights


class _Surface:
    """Shading frames at N hits; z is the normal on the side of the eye.

    triangle: (N,). position: (N, 3), world. to_eye: (N, 3), in the shading frame. alpha: (N,) GGX width.
    """

    def __init__(self, caster: GuideCaster, triangle: np.ndarray, weights: np.ndarray, directions: np.ndarray):
        second, third = weights.T.astype(float)
        shares = np.stack([1 - second - third, second, third], axis=1)[:, :, None]
        scene = caster.scene
        self.triangle = triangle
        self.position = (caster._corners[triangle] * shares).sum(axis=1)
        normal = (scene.vertex_normals[triangle].astype(float) * shares).sum(axis=1)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
        normal *= np.where(np.einsum("ij,ij->i", normal, directions) > 0, -1.0, 1.0)[:, None]
        self.alpha = np.maximum(scene.roughness[triangle].astype(float) ** 2, MIN_ALPHA)
        self.normal = normal
        self.frame = frames(normal)  # (N, 3, 3), rows are x, y, z
        self.to_eye = -np.einsum("nij,nj->ni", self.frame, directions)

    def take(self, rows: np.ndarray) -> _Surface:
        """The surface at some of the hits."""
        out = object.__new__(_Surface)
        vars(out).update({name: values[rows] for name, values in vars(self).items()})
        return out

    def to_world(self, vectors: np.ndarray) -> np.ndarray:
        return np.einsum("nij,ni->nj", self.frame, vectors)


def frames(normal: np.ndarray) -> np.ndarray:
    """(N, 3) unit normals -> (N, 3, 3) orthonormal frames whose rows are x, y and the normal (Duff et al. 2017)."""
    x, y, z = normal.T
    sign = np.where(z < 0, -1.0, 1.0)
    a = -1 / (sign + z)
    b = x * y * a
    tangent = np.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=1)
    bitangent = np.stack([b, sign + y * y * a, -y], axis=1)
    return np.stack([tangent, bitangent, normal], axis=1)


def sample_ggx(to_eye: np.ndarray, alpha: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """(N, 3) normals of the microfacets that the eye sees, in the shading frame (Dupuy and Benyoub 2023).

    to_eye: (N, 3) unit, z >= 0. alpha: (N,). numbers: (N, 2) in [0, 1).
    """
    eye = to_eye * np.stack([alpha, alpha, np.ones_like(alpha)], axis=1)
    eye /= np.maximum(np.linalg.norm(eye, axis=1, keepdims=True), 1e-30)
    height = (1 - numbers[:, 1]) * (1 + eye[:, 2]) - eye[:, 2]
    radius = np.sqrt(np.clip(1 - height**2, 0, None))
    angle = 2 * np.pi * numbers[:, 0]
    half = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1) + eye
    half *= np.stack([alpha, alpha, np.ones_like(alpha)], axis=1)
    return half / np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-30)
