"""Light tracing: caustics, by paths that start at the lamps and are joined to the cameras.

A small lamp seen in something mirror-like, from a wall that the camera sees, is what chance hardly ever finds from the camera.
From the lamp it is easily found. So path space is divided. A surface reflects by a wide part (diffuse, and GGX beyond
``NARROW_ALPHA``) and a narrow one. Paths whose vertex next to the lamp is narrow and whose vertex next to the camera is wide
belong to the light paths here, all others to the camera paths (``jit.trace_paths``), which leave those out. Every path has
one technique and full weight, so the sum is exact whatever was sampled.

A light path picks a lamp's triangle by power and a triangle with a narrow part by the light that it gets from there, unless
something stands between. It goes on as from a camera, and at each wide vertex adds its light to the pixel of every view that
sees the vertex. Each view counts the path numbers of a window of its own, so that its bytes do not depend on the other views.
What is added up are whole numbers: neither threads nor chunks change the bytes.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from stages.graphics.geometry.measure import normal_vectors
from stages.renderformer.records import SceneRecord
from stages.renderformer.rendering.lights import SLOTS, LightTable
from stages.renderformer.rendering.material import NARROW_ALPHA, Material
from stages.renderformer.rendering.sobol import Sampler, mixed
from stages.renderformer.rendering.surfaces import Surfaces, gatherable

LIGHT = 0x51ED270B  # tells the random numbers of light paths from those of camera paths
LANE = 32  # paths of a lane, one after another
CHUNK = 1 << 22  # paths in flight
UNIT = 2.0**-12  # of the whole numbers that light adds up in; a pixel of radiance 1 gets one whole per path
BRIGHTEST = 2.0**30  # a contribution counts as this much at most, before the division by the number of paths
# Where paths start is decided by probes of single points, which do not tell of all of a triangle.
PROBES = 1 << 17  # of a pass over the lights
LEAST_COSINE = 0.1
ESCAPES, UNSEEN = 0.1, 0.02  # what a probe counts that leaves the scene behind the triangle, or does not get to it
# Dimensions of a vertex for the sampler; those of the start come before.
PAIR, LIGHT_POINT, POINT, START = range(4)
LOBE, DIRECTION, ROULETTE, DIMENSIONS = range(4)


class Starts:
    """Where light paths start: for each light of a pass, the narrow triangles by how much of its light they send on.

    ``narrow``: (N,) indices of triangles with a narrow part somewhere; ``bright``: (N,) how much that reflects at most.
    """

    def __init__(
        self, scene: SceneRecord, mitsuba_scene: mi.Scene, first: int, slots: int, narrow: np.ndarray, bright: np.ndarray
    ):
        corners = scene.triangles.astype(np.float64)
        cross = normal_vectors(corners)
        length = np.linalg.norm(cross, axis=1)
        normal = cross / np.maximum(length, 1e-30)[:, None]
        shares = np.zeros((slots, len(narrow)))
        probes = int(np.clip(PROBES // (slots * len(narrow)), 1, 8))
        rng = np.random.default_rng(first)
        for slot in range(slots):
            lamps = np.flatnonzero(scene.light_index == first + slot)
            power = scene.emission[lamps].sum(axis=1, dtype=np.float64) * length[lamps]
            if not power.sum() > 0:
                continue
            lamp = rng.choice(lamps, len(narrow), p=power / power.sum())
            received = np.zeros(len(narrow))
            for _ in range(probes):
                start, point = (_inside(corners[faces], rng) for faces in (lamp, narrow))
                way = point - start
                distance2 = np.maximum((way**2).sum(axis=1), length[lamp])
                way /= np.sqrt(distance2)[:, None]
                cosines = [np.abs((way * normal[faces]).sum(axis=1)) for faces in (lamp, narrow)]
                leaving, arriving = (np.maximum(cosine, LEAST_COSINE) for cosine in cosines)
                received += leaving * arriving / distance2 * _prospects(mitsuba_scene, start, point, narrow)
            shares[slot] = received * length[narrow] * bright
        total = shares.sum(axis=1, keepdims=True)
        cumulative = np.cumsum(shares / np.where(total > 0, total, 1), axis=1).astype(np.float32)
        cumulative[:, -1:] = np.where(total > 0, 1, 0)
        chance = np.diff(cumulative.astype(np.float64), axis=1, prepend=0)
        self.cumulative = gatherable(cumulative)
        self.density = gatherable(chance / np.maximum(0.5 * length[narrow], 1e-30))  # per unit area of the triangle
        self.triangle = gatherable(narrow, mi.UInt32)
        self.vertices = gatherable(scene.triangles[narrow])
        self.count = dr.opaque(mi.UInt32, len(narrow))
        self.steps = dr.opaque(mi.UInt32, int(len(narrow)).bit_length())

    def sample(self, slot: mi.UInt32, pick: mi.Float, spot: mi.Point2f) -> tuple[mi.UInt32, mi.Point3f, mi.Float]:
        """A triangle, a point spread evenly over it, and the density of that point per unit area."""
        entry = dr.minimum(self._search(slot * self.count, pick), self.count - 1)
        a, b, c = [dr.gather(mi.Point3f, self.vertices, 3 * entry + corner) for corner in range(3)]
        root = dr.sqrt(spot.x)
        point = a * (1 - root) + b * (root * (1 - spot.y)) + c * (root * spot.y)
        return dr.gather(mi.UInt32, self.triangle, entry), point, dr.gather(mi.Float, self.density, slot * self.count + entry)

    @dr.syntax
    def _search(self, start: mi.UInt32, pick: mi.Float) -> mi.UInt32:
        """The first entry behind ``start`` whose cumulative share is over ``pick``."""
        low, high, step = mi.UInt32(0), mi.UInt32(self.count), mi.UInt32(0)
        while step < self.steps:
            middle = (low + high) // 2
            over = dr.gather(mi.Float, self.cumulative, start + dr.minimum(middle, self.count - 1)) > pick
            high = dr.select(over, middle, high)
            low = dr.select(over, low, dr.minimum(middle + 1, high))
            step += 1
        return low


def _inside(corners: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(N, 3) points spread evenly over (N, 3, 3) triangles."""
    u, v = rng.random((2, len(corners), 1))
    root = np.sqrt(u)
    return corners[:, 0] * (1 - root) + corners[:, 1] * (root * (1 - v)) + corners[:, 2] * (root * v)


def _prospects(scene: mi.Scene, start: np.ndarray, point: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(N,) what light from (N, 3) starts to points on the triangles ``faces`` promises: that it gets there, and that what a
    mirror sends on meets a surface. Never nothing: it is one probe of a whole triangle."""
    start, point = (mi.Point3f(*(gatherable(axis) for axis in places.T)) for places in (start, point))
    way = point - start
    si = scene.ray_intersect(mi.Ray3f(start + way * 1e-4, dr.normalize(way)), mi.RayFlags.ShadingFrame, False)
    arrives = si.is_valid() & (si.prim_index == gatherable(faces, mi.UInt32))
    meets = arrives & scene.ray_test(si.spawn_ray(si.to_world(mi.reflect(si.wi))), arrives)
    return dr.select(meets, 1, dr.select(arrives, ESCAPES, UNSEEN)).numpy()[: len(faces)]


class Film:
    """What light paths are joined to: the sums of some views of a scene, in one pass over its lights.

    ``windows``: (V, 2) the first and the last but one path number that count for each of the ``views``.
    """

    def __init__(self, cameras, scene: mi.Scene, slots: int, views: Sequence[int], windows: np.ndarray):
        self.first, self.last = int(windows.min()), int(windows.max())
        self.cameras, self.scene = cameras, scene  # the scene that stands between surfaces and cameras
        self.shape = (len(views), slots, cameras.pixels, 3)
        self.sums = dr.zeros(mi.UInt64, int(np.prod(self.shape)))
        self.views, self.windows = gatherable(np.asarray(views), mi.UInt32), gatherable(windows, mi.UInt32)
        self.count, self.slots, self.pixels = (dr.opaque(mi.UInt32, size) for size in self.shape[:3])

    def light(self) -> np.ndarray:
        """(views, slots, pixels, 3) sums of light over the paths."""
        return self.sums.numpy().reshape(self.shape) * UNIT


@dr.syntax
def trace_light(scene, lights, starts, material, film, key, first, count, max_bounces):
    """Add to ``film.sums`` the light of ``count`` paths from number ``first`` on, per lane."""
    done = mi.UInt32(0)
    fresh = mi.Bool(True)
    ray = dr.zeros(mi.Ray3f)
    carried = mi.Color3f(0)
    slot, vertex = mi.UInt32(0), mi.UInt32(0)

    while done < count:
        number = first + done
        sampler = Sampler(key, number)

        # A new path: from the lamp to a point on a narrow triangle, unless something stands between.
        pair = sampler.two(mi.UInt32(PAIR))
        lit, lamp = lights.sample(pair.x, sampler.two(mi.UInt32(LIGHT_POINT)))
        new_slot = mi.UInt32(dr.maximum(dr.gather(mi.Int32, lights.slot, lit), 0))
        target, point, density = starts.sample(new_slot, pair.y, sampler.two(mi.UInt32(POINT)))
        way = point - lamp
        distance2 = dr.maximum(dr.squared_norm(way), 1e-12)
        cosine = dr.abs(dr.dot(dr.gather(mi.Normal3f, lights.normal, lit), way)) * dr.rsqrt(distance2)
        density *= dr.gather(mi.Float, lights.density, lit)
        emitted = dr.gather(mi.Color3f, lights.emission, lit) * (cosine / distance2)
        ray = dr.select(fresh, mi.Ray3f(lamp + way * 1e-4, way * dr.rsqrt(distance2)), ray)
        carried = dr.select(fresh, dr.select(density > 0, emitted / density, 0), carried)
        slot = dr.select(fresh, new_slot, slot)

        si = scene.ray_intersect(ray, mi.RayFlags.UV | mi.RayFlags.ShadingFrame, False)
        alive = si.is_valid() & (dr.max(carried) > 0) & ~(fresh & (si.prim_index != target))
        alive &= dr.gather(mi.Int32, lights.slot, si.prim_index, alive) < 0  # lights reflect nothing
        lobes = material.at(si, alive)
        wide = lobes.part(narrow=False)
        arriving = dr.abs(dr.dot(si.n, ray.d))
        # Shading normals: the light that a camera path would carry is scattered by the cosine to the shading normal, but
        # arrives by that to the true one. A path's first point was chosen by area: there nothing has arrived by a direction.
        shading = dr.abs(si.wi.z) / dr.select(vertex == 0, 1, dr.maximum(arriving, 1e-6))

        # Join the vertex to every camera that sees it.
        joins = alive & (vertex > 0) & (dr.max(wide.diffuse + wide.specular) > 0)
        row = dr.select(joins, mi.UInt32(0), film.count)
        while row < film.count:
            view = dr.gather(mi.UInt32, film.views, row)
            counts = (number >= dr.gather(mi.UInt32, film.windows, 2 * row)) & (
                number < dr.gather(mi.UInt32, film.windows, 2 * row + 1)
            )
            eye, pixel, spread = film.cameras.project(view, si.p)
            to_eye = dr.normalize(eye - si.p)
            local = si.to_local(to_eye)
            seen = counts & (spread > 0)
            reflected, _ = material.evaluate(wide, si.wi, local)
            across = dr.abs(dr.dot(si.n, to_eye)) / dr.maximum(dr.abs(local.z), 1e-6)
            value = carried * reflected * (shading * across * spread)
            seen &= dr.max(value) > 0
            seen &= ~film.scene.ray_test(si.spawn_ray_to(eye), seen)
            place = ((row * film.slots + slot) * film.pixels + pixel) * 3
            for channel in range(3):
                amount = mi.UInt64(dr.minimum(value[channel], BRIGHTEST) * (1 / UNIT) + 0.5)
                dr.scatter_reduce(dr.ReduceOp.Add, film.sums, amount, place + channel, seen)
            row += 1

        # Go on: from the start by its narrow part alone, else by all.
        narrow = lobes.part(narrow=True)
        lobes.diffuse = dr.select(vertex == 0, narrow.diffuse, lobes.diffuse)
        lobes.specular = dr.select(vertex == 0, narrow.specular, lobes.specular)
        dimension = START + vertex * DIMENSIONS
        wo, _ = material.sample(lobes, si.wi, sampler.one(dimension + LOBE), sampler.two(dimension + DIRECTION))
        scattered, pdf = material.evaluate(lobes, si.wi, wo)
        direction = si.to_world(wo)
        across = dr.abs(dr.dot(si.n, direction)) / dr.maximum(dr.abs(wo.z), 1e-6)
        factor = dr.select(pdf > 0, scattered / pdf, 0) * (shading * across)
        before = dr.max(carried)
        carried *= factor
        survival = dr.select(vertex == 0, 1, dr.clip(dr.max(carried) / dr.maximum(before, 1e-30), 0.05, 0.95))
        alive &= (dr.max(carried) > 0) & (vertex + 2 <= max_bounces) & (sampler.one(dimension + ROULETTE) < survival)
        carried /= survival
        ray = si.spawn_ray(direction)
        vertex = dr.select(alive, vertex + 1, 0)
        fresh = ~alive
        done += dr.select(fresh, 1, 0)


class LightPaths:
    """A scene's light paths."""

    def __init__(
        self, scene: SceneRecord, mitsuba_scene: mi.Scene, surfaces: Surfaces, passes: Sequence[LightTable], seed: int
    ):
        narrow, bright = narrow_triangles(surfaces)
        self.seed, self.passes = seed, passes
        self.starts = [
            Starts(scene, mitsuba_scene, SLOTS * number, table.slots, narrow, bright) for number, table in enumerate(passes)
        ]

    def add(self, number: int, scene: mi.Scene, material: Material, film: Film, stream: int, bounces: int) -> None:
        """Join the stream's paths of the film's windows, in pass ``number`` over the lights, to the film's cameras."""

        def opaque(value: int) -> mi.UInt32:
            return dr.opaque(mi.UInt32, value & 0xFFFFFFFF)

        key = mixed(mixed(mixed(opaque(self.seed) + opaque(LIGHT)) + opaque(self.seed >> 32)) + opaque(stream))
        key ^= opaque(number * 0x5851F42D)
        for begin in range(film.first, film.last, CHUNK):
            end = min(begin + CHUNK, film.last)
            first = np.arange(begin, end, LANE)
            numbers = gatherable(first, mi.UInt32), gatherable(np.minimum(LANE, end - first), mi.UInt32)
            trace_light(scene, self.passes[number], self.starts[number], material, film, key, *numbers, opaque(bounces))
            dr.eval(film.sums)


def narrow_triangles(surfaces: Surfaces) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the triangles with a narrow part somewhere, and how much it reflects at most."""
    bright = surfaces.bound("specular", np.max).max(axis=-1) * (surfaces.bound("alpha", np.min) < NARROW_ALPHA)
    narrow = np.flatnonzero(bright)
    return narrow, bright[narrow]
