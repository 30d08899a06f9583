"""The same layers without a JIT compiler: Mitsuba's built-in ``path`` and ``aov`` integrators on ``scalar_rgb``.

A Python integrator would be called once per sample here, so each light is rendered on its own with the others dark,
by its share of the samples. Mitsuba's area emitter shines from one side: a light is two meshes wound against each
other, moved apart by a few hundred-thousandths of a scene unit so that a ray meets the side that faces it first. A
side that no surface can see is never sampled. Dark lights stay emitters (of radiance zero), so that camera rays pass
through all hidden lights.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from stages.graphics.geometry.measure import normal_vectors
from stages.renderformer.records import SceneRecord
from stages.renderformer.rendering.sums import Sums
from stages.renderformer.rendering.surfaces import mesh_of, surface_mesh

MIN_SPP = 1  # per light
GAP = 1e-5  # distance of a light's side from its true plane, over the largest coordinate of the light


class ScalarRenderer:
    """One scene, ready to be seen from its cameras."""

    guided, light_paths = False, None  # Mitsuba's own integrator picks directions by itself, and starts at the camera

    def __init__(self, scene: SceneRecord, size: tuple[int, int], seed: int, max_depth: int, lights_visible: bool):
        self.record, self.size, self.seed, self.max_depth = scene, size, seed, max_depth  # (height, width)
        self.lights_visible = lights_visible
        surfaces = np.nonzero(scene.light_index < 0)[0]
        shapes = {"surface": surface_mesh(scene, surfaces)} if len(surfaces) else {}
        # Name in the scene, light, radiance and sampling weight of each one-sided emitter.
        self.emitters: list[tuple[str, int, np.ndarray, float]] = []
        content = scene.triangles[surfaces].reshape(-1, 3)
        for light in range(scene.n_lights):
            of_light = scene.light_index == light
            for radiance in np.unique(scene.emission[of_light], axis=0):
                triangles = scene.triangles[of_light & (scene.emission == radiance).all(axis=1)]
                for side in (triangles, triangles[:, ::-1]):
                    name = f"light{len(self.emitters)}"
                    mesh, weight = _emitter_mesh(side, radiance, content)
                    shapes[name] = mesh
                    self.emitters.append((name, light, radiance, weight))
        self.scene = mi.load_dict({"type": "scene", **shapes})
        self.params = mi.traverse(self.scene)
        self.visible_triangles = np.arange(len(scene.triangles)) if lights_visible else surfaces
        first = (
            {"surface": surface_mesh(scene, self.visible_triangles, albedo_only=True)} if len(self.visible_triangles) else {}
        )
        self.first_hit_scene = mi.load_dict({"type": "scene", **first})

    def learn(self, views: list[int]) -> None:
        """As ``JitRenderer``; nothing to do."""

    def sample(self, views: list[int], streams: list[int], first: int, spp: int) -> list[list[Sums]]:
        """Per stream, the sums of each view over ``spp`` paths per pixel, the stream's ones from ``first`` on. A light gets
        its share of them, first hits and direct light all; a light's sum is scaled up to ``spp``."""
        return [self._sample(views, stream, first, spp) for stream in streams]

    def _sample(self, views: list[int], stream: int, first: int, spp: int) -> list[Sums]:
        count = self.record.n_lights
        share = self.light_spp(spp)
        shape = (*self.size, 3)
        lights = np.zeros((len(views), count, *shape))
        direct = np.zeros((len(views), *shape))
        sensors = [perspective(self.record, view, self.size) for view in views]

        def trace(sensor, depth: int, samples: int, *where: int) -> np.ndarray:
            integrator = mi.load_dict({"type": "path", "max_depth": depth, "hide_emitters": not self.lights_visible})
            seed = _seed(self.seed, *where, stream, first)
            image = mi.render(self.scene, sensor=sensor, integrator=integrator, spp=samples, seed=seed)
            return np.array(image, np.float64)[..., :3] * spp

        for light in range(count):
            if self._switch_on([light]):
                for row, view in enumerate(views):
                    lights[row, light] = trace(sensors[row], self.max_depth, share, view, light)
        if self._switch_on(range(count)):
            for row, view in enumerate(views):
                direct[row] = trace(sensors[row], min(2, self.max_depth), spp, view, count)
        sums = []
        for row, view in enumerate(views):
            hit = self._first_hits(sensors[row], view, spp, _seed(self.seed, view, count + 1, stream, first))
            albedo, normal, depth, coverage = (np.asarray(values, np.float64) for values in hit)
            hits = coverage * spp
            nearest = np.where(hits > 0, depth, np.inf)
            triangle = self._triangles(view)
            sums.append(Sums(spp, lights[row], direct[row], albedo * spp, normal * spp, depth * hits, hits, nearest, triangle))
        return sums

    def light_spp(self, spp: int) -> int:
        """Paths per pixel that each light gets of ``spp``."""
        return max(MIN_SPP, -(-spp // max(self.record.n_lights, 1)))

    def _switch_on(self, lights) -> bool:
        """Give these lights their radiance, make the others dark; False if nothing would shine on anything."""
        shining = False
        for name, light, radiance, weight in self.emitters:
            on = light in lights and radiance.max() > 0
            shining |= on
            self.params[f"{name}.emitter.radiance.value"] = [float(value) for value in radiance * on]
            self.params[f"{name}.emitter.sampling_weight"] = weight if on else 0.0
        if shining:
            self.params.update()
        return shining

    def _first_hits(self, sensor: mi.Sensor, view: int, spp: int, seed: int) -> tuple[np.ndarray, ...]:
        """albedo, normal, depth and coverage."""
        integrator = mi.load_dict(
            {
                "type": "aov",
                "aovs": "albedo:albedo,normal:sh_normal,depth:depth",
                "alpha": {"type": "path", "max_depth": 2},
            }
        )
        image = np.array(mi.render(self.first_hit_scene, sensor=sensor, integrator=integrator, spp=spp, seed=seed), np.float32)
        coverage, albedo, normal, depth = image[..., 3], image[..., 4:7], image[..., 7:10], image[..., 10]
        depth = np.where(coverage > 0, depth / np.maximum(coverage, 1e-6), 0)
        # Normals are turned to the viewer, as the two-sided material does.
        away = (normal * self._directions(view)).sum(axis=-1, keepdims=True) > 0
        return albedo, np.where(away, -normal, normal), depth, coverage

    def _triangles(self, view: int) -> np.ndarray:
        """(H, W) int32 triangle at the pixel centres."""
        origin = mi.ScalarPoint3f(self.record.camera_to_world[view, :3, 3].astype(np.float64))
        directions = self._directions(view)
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        hits = np.full(directions.shape[:2], -1, np.int32)
        if len(self.visible_triangles):
            for row, column in np.ndindex(hits.shape):
                intersection = self.first_hit_scene.ray_intersect_preliminary(
                    mi.Ray3f(origin, mi.Vector3f(directions[row, column]))
                )
                hits[row, column] = self.visible_triangles[intersection.prim_index] if intersection.is_valid() else -1
        return hits

    def _directions(self, view: int) -> np.ndarray:
        """(H, W, 3) unnormalised directions of the rays through the pixel centres, world space."""
        height, width = self.size
        right = ((np.arange(width) + 0.5) / width - 0.5) * (width / height)
        down = (np.arange(height) + 0.5) / height - 0.5
        focal = 0.5 / np.tan(0.5 * np.radians(float(self.record.fov_deg[view])))
        x, y = np.meshgrid(right, -down)
        return np.stack([x, y, np.full_like(x, -focal)], axis=-1) @ self.record.camera_to_world[view, :3, :3].T


def perspective(scene: SceneRecord, view: int, size: tuple[int, int]) -> mi.Sensor:
    """The scene's camera as a sensor of Mitsuba's, with a box filter. ``size``: (height, width) in pixels."""
    turn = np.diag([-1.0, 1.0, -1.0, 1.0])  # Mitsuba looks along +z with +x to the left
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": float(scene.fov_deg[view]),
            "fov_axis": "y",
            "near_clip": 1e-4,
            "far_clip": 1e4,
            "to_world": mi.ScalarTransform4f(scene.camera_to_world[view].astype(np.float64) @ turn),
            "film": {
                "type": "hdrfilm",
                "width": size[1],
                "height": size[0],
                "rfilter": {"type": "box"},
                "pixel_format": "rgba",
                "component_format": "float32",
            },
            "sampler": {"type": "independent"},
        }
    )


def _emitter_mesh(triangles: np.ndarray, radiance: np.ndarray, content: np.ndarray) -> tuple[mi.Mesh, float]:
    """One side of a light, and how often to sample it: by power and by how much of the content it faces."""
    cross = normal_vectors(triangles.astype(np.float64))
    length = np.linalg.norm(cross, axis=1)
    normal = cross / np.maximum(length, 1e-30)[:, None]
    shift = GAP * max(float(np.abs(triangles).max()), 1.0)
    moved = triangles + shift * normal[:, None].astype(np.float32)
    ahead = float(np.mean(content @ normal.T > np.sum(normal * triangles[:, 0], axis=1))) if len(content) else 0.0
    weight = float(radiance.sum() * length.sum()) * (max(ahead, 0.1) if ahead > 0 else 0.0)
    emitter = mi.load_dict({"type": "area", "radiance": {"type": "rgb", "value": [float(value) for value in radiance]}})
    return mesh_of(moved, None, emitter=emitter), weight


def _seed(*parts: int) -> int:
    return int(np.random.SeedSequence(list(parts)).generate_state(1)[0])
