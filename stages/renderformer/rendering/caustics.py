"""Light paths: caustics, by paths that start at the lamps.

A small lamp seen in something mirror-like, from a wall, is what chance hardly ever finds from the camera. From the lamp it is
easily found. So path space is divided. A surface reflects by a wide part (diffuse, and GGX of a width from ``NARROW_ALPHA`` on)
and a narrow one. Paths that reach a lamp from a wide part by one or more narrow ones belong to the light paths here; camera
paths (``jit.trace_paths``) leave them out and bring all others. Every path has one technique and full weight.

A light path picks a lamp's triangle by power and a triangle with a narrow part by how much of the light that sends on. It goes
on by narrow parts, and where it meets a wide part,
- what the camera sees directly is *joined*: the light is added to the pixel of every view that sees the point (`Film`), exact
  whatever was sampled;
- for what camera paths meet later, in mirrors and by further bounces, it is left there as a *photon* (`Photons`). Surfaces
  are divided into texels about as large as a pixel. A camera path that meets a wide part picks one of the texel's photons.
  This blurs caustics seen in mirrors by a texel, and keeps their sum.

Each view joins the path numbers of a window of its own, so that its bytes do not depend on the other views. What is added up
are whole numbers, and photons are kept in the order of their paths: neither threads nor chunks change the bytes.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from stages.graphics.geometry.measure import normal_vectors
from stages.renderformer.records import SceneRecord
from stages.renderformer.rendering.lights import SLOTS, LightTable, point_within
from stages.renderformer.rendering.material import NARROW_ALPHA, Material
from stages.renderformer.rendering.sobol import Sampler, mixed
from stages.renderformer.rendering.surfaces import Surfaces, gatherable

LIGHT = 0x51ED270B  # tells the random numbers of light paths from those of camera paths
LANE = 32  # paths of a lane, one after another
CHUNK = 1 << 22  # paths in flight
UNIT = 2.0**-12  # of the whole numbers that light adds up in; a pixel of radiance 1 gets one whole per path
RR_DEPTH = 4  # vertices before Russian roulette may end a path
PHOTONS = 1 << 21  # paths at most that leave photons at one time
SHARE = 0.125  # of those paths over camera paths of one view
PORTION = 256  # samples per pixel at most that meet the same photons
TEXELS = 2  # of all surfaces over pixels of a view
NOWHERE = 0xFFFFFFFF  # texel of a path that left no photon
BRIGHTEST = 2.0**30  # a contribution counts as this much at most, before the division by the number of paths
# Where paths start is decided by probes of single points, which do not tell of all of a triangle.
PROBES = 1 << 17  # of a pass over the lights
LEAST_COSINE = 0.1
ESCAPES, UNSEEN = 0.1, 0.02  # what a probe counts that leaves the scene behind the triangle, or does not get to it
# Dimensions of a vertex for the sampler; those of the start come before.
PAIR, LIGHT_POINT, POINT, START = range(4)
END, DIRECTION, ROULETTE, DIMENSIONS = range(4)


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
        point = point_within(self.vertices, entry, spot)
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
    """What joined paths add up in: the pixels of some views, in one pass over the lights.

    ``windows``: (V, 2) the first and the last but one path number that count for each of the ``views``.
    """

    ends = False  # paths go on behind a point that is joined

    def __init__(self, cameras, scene: mi.Scene, slots: int, views: Sequence[int], windows: np.ndarray):
        self.first, self.last = int(windows.min()), int(windows.max())
        self.cameras, self.scene = cameras, scene  # the scene that stands between surfaces and cameras
        self.shape = (len(views), slots, cameras.pixels, 3)
        self.sums = dr.zeros(mi.UInt64, int(np.prod(self.shape)))
        self.views, self.windows = gatherable(np.asarray(views), mi.UInt32), gatherable(windows, mi.UInt32)
        self.count, self.slots, self.pixels = (dr.opaque(mi.UInt32, size) for size in self.shape[:3])

    def light(self) -> np.ndarray:
        """(views, slots, pixels, 3) float32 sums of light over the paths."""
        return (self.sums.numpy().reshape(self.shape) * UNIT).astype(np.float32)

    @dr.syntax
    def take(self, number, vertices, slot, arriving, si, wide, material, active):
        """Join a point to every camera that sees it. ``arriving``: light per area that is across its way, over density."""
        row = dr.select(active, mi.UInt32(0), self.count)
        while row < self.count:
            view = dr.gather(mi.UInt32, self.views, row)
            first, last = (dr.gather(mi.UInt32, self.windows, 2 * row + end) for end in (0, 1))
            eye, pixel, spread = self.cameras.project(view, si.p)
            to_eye = dr.normalize(eye - si.p)
            local = si.to_local(to_eye)
            reflected, _ = material.evaluate(wide, local, si.wi)
            value = arriving * reflected * (dr.abs(dr.dot(si.n, to_eye)) * spread)
            seen = (number >= first) & (number < last) & (spread > 0) & (dr.max(value) > 0)
            seen &= ~self.scene.ray_test(si.spawn_ray_to(eye), seen)
            place = ((row * self.slots + slot) * self.pixels + pixel) * 3
            for channel in range(3):
                amount = mi.UInt64(dr.minimum(value[channel], BRIGHTEST) * (1 / UNIT) + 0.5)
                dr.scatter_reduce(dr.ReduceOp.Add, self.sums, amount, place + channel, seen)
            row += 1


class Texels:
    """Cells of about equal area on all triangles of a scene, some ``count`` of them."""

    def __init__(self, scene: SceneRecord, count: int):
        corners = scene.triangles.astype(np.float64)
        one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        normal = np.cross(one, two)
        square = np.maximum((normal**2).sum(axis=1, keepdims=True), 1e-30)
        along = [np.cross(two, normal) / square, np.cross(normal, one) / square]  # from a point to its barycentric weights
        area = 0.5 * np.sqrt(square[:, 0])
        side = np.ceil(np.sqrt(2 * area / (area.sum() / count))).astype(np.int64)
        first = np.concatenate([[0], np.cumsum(side**2)])
        self.count = int(first[-1])
        self.places = gatherable(np.concatenate([corners[:, 0], *along], axis=1))
        self.first, self.side = gatherable(first[:-1], mi.UInt32), gatherable(side, mi.UInt32)
        self.area = gatherable(2 * area / side**2)  # of a texel that the third side does not cut

    def at(self, triangle: mi.UInt32, point: mi.Point3f, active: mi.Bool) -> tuple[mi.UInt32, mi.Float]:
        """The texel of a point on a triangle, and its area."""
        corner, one, two = (dr.gather(mi.Vector3f, self.places, 3 * triangle + part, active) for part in range(3))
        side = dr.gather(mi.UInt32, self.side, triangle, active)
        way = point - corner
        column, row = (
            mi.UInt32(dr.clip(dr.dot(axis, way) * mi.Float(side), 0, dr.maximum(mi.Float(side), 1) - 1)) for axis in (one, two)
        )
        row = dr.minimum(row, side - 1 - dr.minimum(column, side - 1))  # a rounding behind the third side
        area = dr.gather(mi.Float, self.area, triangle, active) * dr.select(row + column + 1 == side, 0.5, 1)
        return dr.gather(mi.UInt32, self.first, triangle, active) + row * side + column, area


class Photons:
    """The photons of some paths of each of several streams, by texels."""

    ends = True  # a path where it leaves its photon

    def __init__(self, texels: Texels, paths: int):
        self.texels, self.paths = texels, paths
        self.kept: list[list[np.ndarray]] = []  # per stream: first photon of each texel; light, direction, and what else

    def begin(self, first: int) -> None:
        self.first, self.last, self.number = first, first + self.paths, dr.opaque(mi.UInt32, first)
        self.texel = dr.full(mi.UInt32, NOWHERE, self.paths)
        self.light, self.direction = dr.zeros(mi.Color3f, self.paths), dr.zeros(mi.Vector3f, self.paths)
        self.told = dr.zeros(mi.UInt32, self.paths)

    def take(self, number, vertices, slot, arriving, si, wide, material, active):
        """Keep a photon."""
        place = number - self.number
        texel, area = self.texels.at(si.prim_index, si.p, active)
        dr.scatter(self.texel, texel, place, active)
        dr.scatter(self.light, arriving / area, place, active)
        dr.scatter(self.direction, si.to_world(si.wi), place, active)
        dr.scatter(self.told, slot | (vertices << 8), place, active)

    def end(self) -> None:
        """Sort the stream's photons."""
        texel = self.texel.numpy()
        order = np.argsort(texel, kind="stable")[: np.count_nonzero(texel != NOWHERE)]
        first = np.searchsorted(texel[order], np.arange(self.texels.count + 1))
        light, direction = (values.numpy()[:, order].T for values in (self.light, self.direction))
        before = sum(len(told) for *_, told in self.kept)
        self.kept.append([before + first, light / self.paths, direction, self.told.numpy()[order]])

    def publish(self) -> None:
        """Ready to be met by camera paths."""
        firsts, lights, directions, told = (np.concatenate(parts) for parts in zip(*self.kept, strict=True))
        self.starts = gatherable(firsts, mi.UInt32)
        none = len(told) == 0
        self.lights, self.directions = (gatherable(np.zeros((1, 3)) if none else part) for part in (lights, directions))
        self.told = gatherable(np.zeros(1) if none else told, mi.UInt32)
        self.stride = dr.opaque(mi.UInt32, self.texels.count + 1)

    def meet(self, stream, bounce, max_bounces, si, lobes, material, pick, active):
        """(slot, radiance reflected towards ``si.wi``) of one of the photons about a point, for all of them.

        ``stream``: index among those kept. ``pick``: number in [0, 1).
        """
        texel, _ = self.texels.at(si.prim_index, si.p, active)
        place = stream * self.stride + texel
        first, last = (dr.gather(mi.UInt32, self.starts, place + end, active) for end in (0, 1))
        active = active & (last > first)
        photon = first + dr.minimum(mi.UInt32(pick * mi.Float(last - first)), last - first - 1)
        told = dr.gather(mi.UInt32, self.told, photon, active)
        active &= bounce + 1 + (told >> 8) <= max_bounces
        direction = dr.gather(mi.Vector3f, self.directions, photon, active)
        reflected, _ = material.evaluate(lobes.part(narrow=False), si.wi, si.to_local(direction))
        light = dr.gather(mi.Color3f, self.lights, photon, active) * mi.Float(last - first)
        return mi.Int32(told & 0xFF), dr.select(active, light * reflected, 0)


@dr.syntax
def trace_light(scene, lights, starts, material, sink, key, first, count, max_bounces):
    """Hand the ``count`` light paths from number ``first`` on, per lane, to the ``sink``."""
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
        # Light per area across its way. A path's first point was chosen by area: there it is per area of the surface.
        carried /= dr.select(vertex == 0, 1, dr.maximum(dr.abs(dr.dot(si.n, ray.d)), 1e-6))
        wide, narrow = (lobes.part(flag) for flag in (False, True))
        dimension = START + vertex * DIMENSIONS
        by_wide, by_narrow = dr.max(wide.diffuse + wide.specular), dr.max(narrow.specular)
        meets = alive & (vertex > 0) & (by_wide > 0)
        if sink.ends:  # a path leaves one photon: it ends there, by chance
            chance = dr.select(vertex == 0, 0, by_wide / dr.maximum(by_wide + by_narrow, 1e-30))
            ends = sampler.one(dimension + END) < chance
            sink.take(number, vertex, slot, carried / chance, si, wide, material, meets & ends)
            carried /= dr.maximum(1 - chance, 1e-6)
            alive &= ~ends
        else:
            sink.take(number, vertex, slot, carried, si, wide, material, meets)

        # Go on by the narrow part, from here to where the camera path would have come from.
        wo = material.sample(narrow, si.wi, narrow.specular_share > 0, sampler.two(dimension + DIRECTION))
        scattered, pdf = material.evaluate(narrow, si.wi, wo)
        direction = si.to_world(wo)
        # by the cosines of the camera path: what it scatters is the light by that to the shading normal
        turned = dr.abs(si.wi.z) * dr.abs(dr.dot(si.n, direction)) / dr.maximum(dr.abs(wo.z), 1e-6)
        carried *= dr.select(pdf > 0, scattered / pdf, 0) * turned
        survival = dr.select(vertex < RR_DEPTH, 1, dr.clip(by_narrow, 0.05, 0.95))
        alive &= (dr.max(carried) > 0) & (vertex + 2 <= max_bounces) & (sampler.one(dimension + ROULETTE) < survival)
        carried /= survival
        ray = si.spawn_ray(direction)
        vertex = dr.select(alive, vertex + 1, 0)
        fresh = ~alive
        done += dr.select(fresh, 1, 0)


class LightPaths:
    """A scene's light paths; those that are joined share none with those that leave photons."""

    def __init__(
        self,
        scene: SceneRecord,
        mitsuba_scene: mi.Scene,
        material: Material,
        narrow: tuple[np.ndarray, np.ndarray],
        passes: Sequence[LightTable],
        seed: int,
        pixels: int,
        bounces: int,
    ):
        self.seed, self.passes, self.scene, self.material = seed, passes, mitsuba_scene, material
        self.texels, self.bounces = Texels(scene, TEXELS * pixels), dr.opaque(mi.UInt32, bounces)
        self.starts = [
            Starts(scene, mitsuba_scene, SLOTS * number, table.slots, *narrow) for number, table in enumerate(passes)
        ]

    def photons(self, number: int, streams: Sequence[int], first: int, paths: int) -> Photons:
        """Those of each stream's paths from ``first`` on, in pass ``number`` over the lights."""
        photons = Photons(self.texels, paths)
        for stream in streams:
            photons.begin(first)
            self.trace(number, photons, stream)
            photons.end()
        photons.publish()
        return photons

    def trace(self, number: int, sink: Film | Photons, stream: int) -> None:
        """Hand the stream's paths from ``sink.first`` to ``sink.last`` - 1, in pass ``number`` over the lights, to the sink."""

        def opaque(value: int) -> mi.UInt32:
            return dr.opaque(mi.UInt32, value & 0xFFFFFFFF)

        purpose = opaque(self.seed) + opaque(LIGHT + isinstance(sink, Film))
        key = mixed(mixed(mixed(purpose) + opaque(self.seed >> 32)) + opaque(stream)) ^ opaque(number * 0x5851F42D)
        tables = self.passes[number], self.starts[number]
        for begin in range(sink.first, sink.last, CHUNK):
            end = min(begin + CHUNK, sink.last)
            first = np.arange(begin, end, LANE)
            counts = gatherable(np.minimum(LANE, end - first), mi.UInt32)
            numbers = gatherable(first, mi.UInt32), counts
            trace_light(self.scene, *tables, self.material, sink, key, *numbers, self.bounces)
            dr.eval()


def narrow_triangles(surfaces: Surfaces) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the triangles with a narrow part somewhere, and how much it reflects at most."""
    bright = surfaces.bound("specular", np.max).max(axis=-1) * (surfaces.bound("alpha", np.min) < NARROW_ALPHA)
    narrow = np.flatnonzero(bright)
    return narrow, bright[narrow]
