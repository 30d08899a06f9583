"""Path tracing with an integrator of our own on Dr.Jit (CUDA or LLVM): radiance per light and first-hit layers in one
pass.

Light transport is linear, so one path serves all lights: each contribution goes to the slot of the light that it
came from. The integrator keeps its own light arrays, picks a light triangle by power, lets it shine from both sides,
and knows a light that a ray hits by its triangle index. Next-event estimation and BSDF sampling are combined by the
power heuristic.

One lane of the kernel traces a block of 8 to 64 samples of a pixel, the next one as soon as a path ends, and keeps their sums:
lanes of a vector stay busy, and no light is added by atomics. The host adds a pixel's blocks in order. A sample is a function
of (seed, stream, view, pixel, number), and of what guides learned from earlier portions, which adds up in whole numbers. So
the bytes are the same for any thread count and any chunk size.
"""

from __future__ import annotations

import functools
import operator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from stages.renderformer.records import SceneRecord
from stages.renderformer.rendering.caustics import PHOTONS, PORTION, SHARE, Film, LightPaths, Photons, narrow_triangles
from stages.renderformer.rendering.guiding import Guide, Trail, Unguided
from stages.renderformer.rendering.lights import SLOTS, LightTable
from stages.renderformer.rendering.material import Material
from stages.renderformer.rendering.primary import FirstStep, PrimaryGuide
from stages.renderformer.rendering.sobol import Sampler, mixed
from stages.renderformer.rendering.sums import Sums
from stages.renderformer.rendering.surfaces import Surfaces, gatherable, mesh_of, shape_mesh

BLOCKS = (8, 64)  # samples of a lane, least and most
LANES = 1 << 15  # of a view: enough to keep processors busy, so that lanes take more samples each
GROUP = 64  # blocks of a pixel that the host adds at once
CHUNK = 1 << 19  # lanes in flight: 40 floats of results each, about 80 MB
RR_DEPTH = 5  # bounces before Russian roulette may end a path
FILTER_CELLS = 1024
BLACKMAN_HARRIS_SPAN = 3.0  # pixels from end to end: what Blender calls a width of 1.5
# Dimensions of a bounce for the sampler; camera rays come before the first bounce.
LIGHT_AND_LOBE, LIGHT_POINT, DIRECTION, ROULETTE, DIMENSIONS = range(5)
GUIDE, PHOTON = 1 << 16, 1 << 17  # behind those of all bounces: used or not, the others stay as they are
FILM = 0xFFFFFFFF


@dataclass(frozen=True)
class Limits:
    """How far paths go, and what is cut. Bounces are scattering events, light hits not counted."""

    bounces: int
    diffuse_bounces: int = 1 << 20
    glossy_bounces: int = 1 << 20
    indirect_clamp: float = float("inf")  # bound on the mean over RGB of one indirect contribution, after Cycles
    filter: str = "box"
    glossy_filter: bool = False  # after a wide scattering the lobe of the next surface is at least half as wide, after Cycles
    multiscatter: bool = False  # between the facets of rough surfaces


def filter_offsets(name: str) -> np.ndarray:
    """Inverse cumulative distribution of the pixel filter: FILTER_CELLS + 1 offsets from the centre, in pixels.

    Samples drawn from the filter itself need no weights, so a pixel stays the plain mean of its own samples.
    """
    u = np.linspace(0, 1, FILTER_CELLS + 1)
    if name == "box":
        return u - 0.5
    assert name == "blackman-harris", name
    x = np.linspace(-0.5, 0.5, 8 * FILTER_CELLS + 1)  # four-term Blackman-Harris window
    angle = 2 * np.pi * (x + 0.5)
    weight = 0.35875 - 0.48829 * np.cos(angle) + 0.14128 * np.cos(2 * angle) - 0.01168 * np.cos(3 * angle)
    cumulative = np.concatenate([[0], np.cumsum(weight[1:] + weight[:-1])])
    return BLACKMAN_HARRIS_SPAN * np.interp(u, cumulative / cumulative[-1], x)


class Cameras:
    """Rays of a scene's cameras through points of the pixels' filter; image row 0 is on top. ``size``: (height, width)."""

    def __init__(self, scene: SceneRecord, size: tuple[int, int], filter_name: str):
        self.pose = gatherable(scene.camera_to_world[:, :3].reshape(-1, 12))
        self.focal = gatherable(0.5 / np.tan(0.5 * np.radians(scene.fov_deg.astype(np.float64))))  # image height 1
        self.filter = gatherable(filter_offsets(filter_name))
        self.pixels = size[0] * size[1]  # of a view
        self.height, self.width = (dr.opaque(mi.UInt32, side) for side in size)
        self.aspect = dr.opaque(mi.Float, size[1] / size[0])

    def ray(self, pixel: mi.UInt32, u: mi.Point2f) -> mi.Ray3f:
        """``pixel`` counts row by row through all views; ``u`` in [0, 1)^2."""
        view, row, column = self.place(pixel)
        x = ((mi.Float(column) + 0.5 + self._offset(u.x)) / mi.Float(self.width) - 0.5) * self.aspect
        y = (mi.Float(row) + 0.5 + self._offset(u.y)) / mi.Float(self.height) - 0.5
        local = dr.normalize(mi.Vector3f(x, -y, -dr.gather(mi.Float, self.focal, view)))
        entry = [dr.gather(mi.Float, self.pose, 12 * view + index) for index in range(12)]
        direction = mi.Vector3f(
            *[entry[4 * axis] * local.x + entry[4 * axis + 1] * local.y + entry[4 * axis + 2] * local.z for axis in range(3)]
        )
        return mi.Ray3f(mi.Point3f(entry[3], entry[7], entry[11]), dr.normalize(direction))

    def place(self, pixel: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
        """View, row and column of a pixel; they count row by row through all views."""
        view = pixel // (self.height * self.width)
        inside = pixel - view * self.height * self.width
        row = inside // self.width
        return view, row, inside - row * self.width

    def project(self, view: mi.UInt32, point: mi.Point3f) -> tuple[mi.Point3f, mi.UInt32, mi.Float]:
        """The camera's position, the pixel (row by row) of the view in which it sees ``point``, and how many pixels an area
        about the point that faces the camera covers, over that area; 0 where it is out of the picture. For a box filter."""
        entry = [dr.gather(mi.Float, self.pose, 12 * view + index) for index in range(12)]
        eye = mi.Point3f(entry[3], entry[7], entry[11])
        way = point - eye
        right, up, back = (mi.Vector3f(entry[axis], entry[4 + axis], entry[8 + axis]) for axis in range(3))
        depth = -dr.dot(back, way)
        height, width = mi.Float(self.height), mi.Float(self.width)
        scale = dr.gather(mi.Float, self.focal, view) * height
        column = dr.dot(right, way) / depth * scale + 0.5 * width
        row = 0.5 * height - dr.dot(up, way) / depth * scale
        inside = (depth > 0) & (column >= 0) & (row >= 0) & (column < width) & (row < height)
        pixel = mi.UInt32(dr.select(inside, row, 0)) * self.width + mi.UInt32(dr.select(inside, column, 0))
        distance2 = dr.squared_norm(way)
        return eye, pixel, dr.select(inside, scale * scale * dr.sqrt(distance2) / (depth * depth * depth), 0)

    def _offset(self, u: mi.Float) -> mi.Float:
        u = u * FILTER_CELLS
        cell = dr.minimum(mi.UInt32(u), FILTER_CELLS - 1)
        low, high = dr.gather(mi.Float, self.filter, cell), dr.gather(mi.Float, self.filter, cell + 1)
        return low + (high - low) * (u - mi.Float(cell))


class Points:
    """Rays that end at given points from ``height`` above them: (N, 3) points and unit normals on the side that is asked."""

    def __init__(self, points: np.ndarray, normals: np.ndarray, height: float):
        self.origins, self.directions = gatherable(points + height * normals), gatherable(-normals)

    def ray(self, pixel: mi.UInt32, u: mi.Point2f) -> mi.Ray3f:
        return mi.Ray3f(dr.gather(mi.Point3f, self.origins, pixel), dr.gather(mi.Vector3f, self.directions, pixel))


@dataclass
class Lanes:
    """What the lanes of a kernel trace: where their rays start, and which samples."""

    start: Cameras | Points
    pixel: mi.UInt32
    view: mi.UInt32
    stream: mi.UInt32  # index among those that are traced
    key: mi.UInt32  # of the random numbers
    first: mi.UInt32  # number of the first sample
    count: mi.UInt32  # samples


def _add(slots: list, slot: mi.Int32, value: mi.Color3f) -> list:
    return [total + dr.select(slot == index, value, 0) for index, total in enumerate(slots)]


@dr.syntax
def trace_paths(scene, lights, material, lanes, pass_key, limits, hide, glossy_filter, diffuse_start, photons, guide, primary):
    """Sums over the samples of each lane: (light slots, direct, albedo, normal, distance, hits, nearest distance, triangle).

    ``limits``: opaque (bounces, diffuse bounces, glossy bounces, indirect clamp on the sum over RGB). ``hide``: opaque
    bool, camera rays pass through lights. The triangle is that of the first sample, -1 where it hit nothing.
    ``diffuse_start``: the first surface is a white diffuse one, whatever its material. ``photons``: light
    that light paths have left; what belongs to those is left out (``caustics``). ``guide`` learns, and picks directions; so
    does ``primary``, of lobes and at first surfaces, where there are photons.
    """
    max_bounces, max_diffuse, max_glossy, clamp = limits
    slots = [mi.Color3f(0) for _ in range(SLOTS)]
    direct, albedos, normals = mi.Color3f(0), mi.Color3f(0), mi.Normal3f(0)
    distances, hits, nearest = mi.Float(0), mi.Float(0), mi.Float(dr.inf)
    triangle = mi.Int32(-1)

    done = mi.UInt32(0)
    ray = dr.zeros(mi.Ray3f)
    origin = mi.Point3f(0)
    fresh = mi.Bool(True)
    throughput, bsdf_pdf, widest = mi.Color3f(1), mi.Float(0), mi.Float(dr.inf)  # widest: least density so far
    bounce, diffuse, glossy = mi.UInt32(0), mi.UInt32(0), mi.UInt32(0)
    # shares of the throughput: narrow from the first surface on; narrow at the last surface, but not at all before
    pure, theirs = mi.Color3f(1), mi.Color3f(0)
    trail = Trail.none()
    step = FirstStep.none()
    cell = None if primary is None else primary.cell(*lanes.start.place(lanes.pixel))

    while done < lanes.count:
        number = lanes.first + done
        start = lanes.start.ray(lanes.pixel, Sampler(lanes.key, number).two(mi.UInt32(FILM)))
        origin = dr.select(fresh, start.o, origin)
        ray = dr.select(fresh, start, ray)
        sampler = Sampler(lanes.key ^ pass_key, number)
        dimension = bounce * DIMENSIONS

        # without dPdUV: a frame that textures do not turn, so that the same samples go the same ways
        si = scene.ray_intersect(ray, mi.RayFlags.UV | mi.RayFlags.ShadingFrame, False)
        valid = si.is_valid()
        slot = dr.select(valid, dr.gather(mi.Int32, lights.slot, si.prim_index, valid), -1)
        on_light = slot >= 0
        through = on_light & (bounce == 0) & hide  # a camera ray goes on behind a hidden light

        # First hit. The shading normal is turned to the viewer, as the two-sided material does.
        first = valid & (bounce == 0) & ~through
        facing = dr.select(dr.dot(si.sh_frame.n, ray.d) > 0, -1, 1)
        distance = dr.norm(si.p - origin)
        lobes = material.at(si, valid)
        normals += dr.select(first, si.sh_frame.n * facing, 0)
        albedos += dr.select(first, lobes.diffuse + lobes.specular, 0)
        distances += dr.select(first, distance, 0)
        nearest = dr.minimum(nearest, dr.select(first, distance, dr.inf))
        hits += dr.select(first, 1, 0)
        triangle = dr.select(first & (done == 0), mi.Int32(si.prim_index), triangle)

        # Emission met by chance: weighted against the chance of next-event estimation to find it.
        hit = on_light & ~through & (slot < SLOTS)
        cosine = dr.abs(dr.dot(si.n, ray.d))
        light_pdf = dr.gather(mi.Float, lights.density, si.prim_index, hit) * si.t * si.t / dr.maximum(cosine, 1e-9)
        weight = dr.select(bounce == 0, 1, mis_weight(bsdf_pdf, light_pdf))
        value = throughput * dr.gather(mi.Color3f, lights.emission, si.prim_index, hit) * weight
        if photons is not None:
            value *= 1 - theirs
        value = dr.select(hit, clamped(value, dr.select(bounce > 1, clamp, dr.inf)), 0)
        slots = _add(slots, slot, value)
        direct += dr.select(bounce <= 1, value, 0)
        guide.add(trail, value, hit & trail.further)
        if primary is not None:
            step = step.bring(value, bounce > 0)

        # Next-event estimation at surfaces; lights reflect nothing.
        surface = valid & ~on_light & (bounce < max_bounces) & (diffuse <= max_diffuse) & (glossy <= max_glossy)
        if glossy_filter:
            blurred = 0.5 * dr.sqrt(dr.maximum(1 - widest, 0))
            lobes.alpha = dr.select(widest < 1, dr.maximum(lobes.alpha, blurred), lobes.alpha)
        if diffuse_start:
            white = bounce == 0
            lobes.diffuse, lobes.specular = dr.select(white, 1, lobes.diffuse), dr.select(white, 0, lobes.specular)
        if photons is not None:  # those that were left about a first surface are joined to the cameras themselves
            later = surface & (bounce > 0)
            picked = sampler.one(dimension + PHOTON)
            slot, value = photons.meet(lanes.stream, bounce, max_bounces, si, lobes, material, picked, later)
            value = clamped(throughput * value, dr.select(later, clamp, dr.inf))
            slots = _add(slots, slot, value)
            if primary is not None:
                step = step.bring(value, later)
        spot = guide.at(lanes.view, si, lobes, surface)
        choice = sampler.two(dimension + LIGHT_AND_LOBE)
        lit, point = lights.sample(choice.x, sampler.two(dimension + LIGHT_POINT))
        shadow = si.spawn_ray_to(point)
        to_light = point - si.p
        distance2 = dr.squared_norm(to_light)
        to_light *= dr.rsqrt(dr.maximum(distance2, 1e-30))
        cosine = dr.abs(dr.dot(dr.gather(mi.Normal3f, lights.normal, lit), to_light))
        density = dr.gather(mi.Float, lights.density, lit)
        sampled = surface & (cosine > 0) & (distance2 > 0) & (density > 0)
        dull, bright, pdf = material.evaluate_lobes(lobes, si.wi, si.to_local(to_light))
        reflected = dull + bright
        if photons is not None:
            reflected = dull + bright * dr.select(lobes.is_narrow, pure, 1)
        sampled &= dr.max(reflected) > 0
        sampled &= ~scene.ray_test(shadow, sampled)
        light_pdf = density * distance2 / dr.maximum(cosine, 1e-9)
        pdf = guide.density(pdf, spot, to_light)
        value = throughput * reflected * dr.gather(mi.Color3f, lights.emission, lit) * (mis_weight(light_pdf, pdf) / light_pdf)
        value = dr.select(sampled, clamped(value, dr.select(bounce > 0, clamp, dr.inf)), 0)
        slots = _add(slots, dr.gather(mi.Int32, lights.slot, lit), value)
        direct += dr.select(bounce == 0, value, 0)
        guide.add(trail, value, sampled)
        if primary is not None:
            step = step.bring(value, bounce > 0)

        # The next direction, from the material or from what was learned.
        within = sampler.two(dimension + DIRECTION)
        is_glossy = choice.y < lobes.specular_share
        if primary is not None:
            leaves = surface & (bounce == 0)
            chain = dr.max(pure) > 0.5
            is_glossy, within, chance, first_step = primary.leave(cell, lobes, choice.y, within, leaves, chain)
            step = dr.select(leaves, first_step, step)
            throughput = dr.select(surface, throughput / chance, throughput)
        wo = material.sample(lobes, si.wi, is_glossy, within)
        wo = guide.direction(wo, spot, si, sampler.two(dimension + GUIDE), within)
        dull, bright, pdf = material.evaluate_lobes(lobes, si.wi, wo)
        scattered = dull + bright
        if photons is not None:
            narrow = dr.select(lobes.is_narrow & (scattered > 0), bright / scattered, 0)
            theirs = dr.select(surface, narrow * (1 - pure), theirs)
            pure = dr.select(surface, narrow * pure, pure)
        direction, arriving = si.to_world(wo), mi.Color3f(throughput)
        pdf = guide.density(pdf, spot, direction)
        glossy += dr.select(surface & is_glossy, 1, 0)
        diffuse += dr.select(surface & ~is_glossy, 1, 0)
        bounce += dr.select(surface, 1, 0)
        throughput = dr.select(surface, throughput * dr.select(pdf > 0, scattered / pdf, 0), throughput)
        bsdf_pdf = dr.select(surface, pdf, bsdf_pdf)
        widest = dr.select(surface, dr.minimum(widest, pdf), widest)
        brightest = dr.max(throughput)
        survival = dr.select(bounce >= RR_DEPTH, dr.minimum(brightest, 0.95), 1)
        lives = surface & (brightest > 0) & (sampler.one(dimension + ROULETTE) < survival)
        throughput = dr.select(lives, throughput / survival, throughput)
        ray = dr.select(through, si.spawn_ray(ray.d), si.spawn_ray(direction))

        # The path goes on, or the lane's next sample begins.
        fresh = ~(lives | through)
        done += dr.select(fresh, 1, 0)
        throughput, bsdf_pdf = dr.select(fresh, 1, throughput), dr.select(fresh, 0, bsdf_pdf)
        widest = dr.select(fresh, dr.inf, widest)
        if photons is not None:
            pure, theirs = dr.select(fresh, 1, pure), dr.select(fresh, 0, theirs)
        if primary is not None:
            primary.add(step, fresh)
            step = dr.select(fresh, FirstStep.none(), step)
        trail = guide.step(trail, spot, direction, arriving, fresh)
        bounce, diffuse, glossy = [dr.select(fresh, 0, count) for count in (bounce, diffuse, glossy)]

    return slots, direct, albedos, normals, distances, hits, nearest, triangle


def mis_weight(pdf, other):
    """Power heuristic of the first strategy."""
    square = pdf * pdf
    return dr.select(pdf > 0, square / (square + other * other), 0)


def clamped(value, limit):
    """``value`` scaled so that its RGB sum is at most ``limit``."""
    total = dr.sum(value)
    return value * dr.select(total > limit, limit / total, 1)


class JitRenderer:
    """One scene, ready to be seen from its cameras."""

    def __init__(
        self,
        scene: SceneRecord,
        size: tuple[int, int],
        seed: int,
        limits: Limits,
        lights_visible: bool,
        guided: bool = False,
        light_paths: bool = False,
        primary: bool = False,
    ):
        self.record, self.size, self.seed = scene, size, seed  # (height, width)
        self.pixels = size[0] * size[1]  # of a view
        self.limits, self.lights_visible = limits, lights_visible
        surfaces = Surfaces(scene, np.arange(len(scene.triangles)))
        self.scene = mi.load_dict({"type": "scene", "surface": shape_mesh(scene, surfaces)})
        self.material = Material(surfaces, limits.multiscatter)
        self.passes = [LightTable(scene, first) for first in range(0, max(scene.n_lights, 1), SLOTS)]
        self.cameras = Cameras(scene, size, limits.filter)
        self.light_paths = None
        narrow = narrow_triangles(surfaces)
        if light_paths and limits.bounces > 1 and scene.n_lights and len(narrow[0]):
            within = self.passes, seed, self.pixels, limits.bounces
            self.light_paths = LightPaths(scene, self.scene, self.material, narrow, *within)
            hidden = (scene.light_index >= 0) & (not lights_visible)
            seen = mesh_of(scene.triangles[~hidden], None)
            self.before_cameras = mi.load_dict({"type": "scene", "surface": seen})
        self.guided = guided and not self.light_paths  # what guiding finds best is what light paths bring
        self.guides = [Guide(scene) if self.guided else Unguided() for _ in self.passes]
        wanted = primary and self.light_paths
        self.primaries = [PrimaryGuide(len(scene.camera_to_world), size) if wanted else None for _ in self.passes]

    def learn(self, views: list[int]) -> None:
        """Guide the paths of these views from now on by what those so far have brought."""
        for guide in (*self.guides, *filter(None, self.primaries)):
            guide.learn(views)

    def texel_sums(self, points: np.ndarray, normals: np.ndarray, height: float, spp: int) -> dict[str, np.ndarray]:
        """Light that arrives at (N, 3) points, as seen from their normals' side on white diffuse material.

        Sums over ``spp`` samples: ``lights`` (N, L, 3); and ``triangle`` (N,), which ``height`` above the point is met first.
        """
        start, ids = Points(points, normals, height), np.arange(len(points))
        passes = [self._pass(table, number, start, None, ids, [0], 0, spp) for number, table in enumerate(self.passes)]
        lights = np.concatenate([p["lights"][0] for p in passes], axis=-2)[:, : self.record.n_lights]
        return {"lights": lights, "triangle": passes[0]["triangle"][0]}

    def sample(self, views: list[int], streams: list[int], first: int, spp: int) -> list[list[Sums]]:
        """Per stream, the sums of each view over the stream's samples ``first`` to ``first + spp`` of every pixel.

        Streams share no path. A path serves all lights.
        """
        if self.light_paths and spp > PORTION:
            portions = [
                self.sample(views, streams, begin, min(PORTION, first + spp - begin))
                for begin in range(first, first + spp, PORTION)
            ]
            of_streams = [zip(*of_stream, strict=True) for of_stream in zip(*portions, strict=True)]
            return [[functools.reduce(operator.add, of_view) for of_view in of_stream] for of_stream in of_streams]
        ids = np.concatenate([view * self.pixels + np.arange(self.pixels) for view in views])
        passes = []
        for number, table in enumerate(self.passes):
            photons = None
            if self.light_paths:
                paths = min(int(SHARE * self.pixels * spp), PHOTONS)
                photons = self.light_paths.photons(number, streams, self.pixels * first, paths)
            passes.append(self._pass(table, number, self.cameras, photons, ids, streams, first, spp))
        return self._sums(passes, len(streams), len(views), spp)

    def _sums(self, passes: list[dict[str, np.ndarray]], streams: int, views: int, spp: int | np.ndarray) -> list[list[Sums]]:
        """Per stream and view, from what the passes over the lights brought, (streams, pixels of all views, ..)."""
        shape = (streams, views, *self.size)
        lights = np.concatenate([p["lights"] for p in passes], axis=-2)[..., : self.record.n_lights, :]
        hit = passes[0]  # the camera rays of all passes are the same
        images = {name: values.reshape(*shape, *values.shape[2:]) for name, values in hit.items()}
        images["direct"] = sum(p["direct"] for p in passes).reshape(*shape, 3)
        images["lights"] = np.moveaxis(lights.reshape(*shape, -1, 3), -2, 2)
        return [
            [Sums(spp, **{name: image[stream, view] for name, image in images.items()}) for view in range(views)]
            for stream in range(streams)
        ]

    def more(self, view: int, streams: list[int], before: np.ndarray, after: np.ndarray, place: int) -> list[Sums]:
        """Per stream, the sums of one view over samples that differ from pixel to pixel in number.

        Of each pixel the samples from ``before`` on, up to ``after``, both (H, W). place: samples of all pixels that stand for
        those so far: from there on are the light paths that no other call has.
        """
        first, count = before.ravel(), (after - before).ravel()
        passes = []
        for number, table in enumerate(self.passes):
            photons = None
            if self.light_paths:
                paths = min(max(int(SHARE * count.sum()), 1), PHOTONS)
                photons = self.light_paths.photons(number, streams, self.pixels * place, paths)
            passes.append(self._uneven_pass(table, number, photons, view, streams, first, count))
        return [sums for (sums,) in self._sums(passes, len(streams), 1, after - before)]

    def add_caustics(self, sums: list[Sums], views: list[int], stream: int, windows: list[tuple[int, int]]) -> None:
        """Add to the sums of each of the ``views`` what the stream's light paths bring, from the first to the last but one of
        the view's window."""
        lights = []
        for number, table in enumerate(self.passes):
            film = Film(self.cameras, self.before_cameras, table.slots, views, np.asarray(windows))
            self.light_paths.trace(number, film, stream)
            lights.append(film.light().reshape(len(views), table.slots, *self.size, 3))
        for of_view, caustics, (first, last) in zip(sums, np.concatenate(lights, axis=1), windows, strict=True):
            of_view.caustics, of_view.paths = of_view.caustics + caustics, of_view.paths + last - first

    def _pass(
        self,
        table: LightTable,
        number: int,
        rays: Cameras | Points,
        photons: Photons | None,
        ids: np.ndarray,
        streams: list[int],
        first: int,
        spp: int,
    ) -> dict[str, np.ndarray]:
        """(streams, pixels, ..) sums over the samples, float64; ``lights`` (.., lights of the pass, 3)."""
        size = _block(self.pixels * spp)  # of resolution and samples alone, since it decides how sums are rounded
        rows, blocks = len(streams) * len(ids), -(-spp // size)
        sums: dict[str, np.ndarray] = {}
        for block in range(0, blocks, GROUP):
            depth = min(GROUP, blocks - block)
            step = max(CHUNK // depth, 1)
            for start in range(0, rows, step):
                row = np.arange(start, min(start + step, rows)).repeat(depth)
                number_of = block + np.tile(np.arange(depth), len(row) // depth)
                counts = np.minimum(size, spp - number_of * size)
                where = (
                    ids[row % len(ids)],
                    np.asarray(streams)[row // len(ids)],
                    row // len(ids),
                    first + number_of * size,
                    counts,
                )
                for name, value in self._chunk(table, number, rays, photons, *where).items():
                    parts = value.reshape(*value.shape[:-1], -1, depth)
                    part = slice(start, start + parts.shape[-2])
                    if name == "triangle":
                        total = sums.setdefault(name, np.zeros(rows, np.int32))
                        total[part] = parts[:, 0] if block == 0 else total[part]
                    elif name == "nearest":
                        total = sums.setdefault(name, np.full(rows, np.inf, np.float32))
                        total[part] = np.minimum(total[part], parts.min(axis=-1))
                    else:
                        total = sums.setdefault(name, np.zeros((*value.shape[:-1], rows)))
                        total[..., part] += parts.sum(axis=-1, dtype=np.float64)
        shape = (len(streams), len(ids))
        return {name: np.moveaxis(total, -1, 0).reshape(*shape, *total.shape[:-1]) for name, total in sums.items()}

    def _uneven_pass(
        self,
        table: LightTable,
        number: int,
        photons: Photons | None,
        view: int,
        streams: list[int],
        first: np.ndarray,
        count: np.ndarray,
    ) -> dict[str, np.ndarray]:
        """As `_pass`, of one view, whose pixels have samples of their own, (pixels,) each."""
        size, pixels = _block(int(count.sum())), np.flatnonzero(count)
        blocks = np.tile(-(-count[pixels] // size), len(streams))
        rows = len(blocks)  # of pixels that have samples, stream by stream
        row = np.arange(rows).repeat(blocks)
        block = np.arange(len(row)) - (np.cumsum(blocks) - blocks)[row]
        pixel = pixels[row % len(pixels)]
        stream = np.asarray(streams)[row // len(pixels)]
        sums: dict[str, np.ndarray] = {}
        ends = np.cumsum(blocks)
        start = 0
        while start < len(row):  # whole pixels, so that chunks do not decide how sums are rounded
            end = int(ends[max(np.searchsorted(ends, start + CHUNK, "right") - 1, row[start])])
            part, start = slice(start, end), end
            inside, starts = np.unique(row[part], return_index=True)
            where = (
                pixel[part] + view * self.pixels,
                stream[part],
                row[part] // len(pixels),
                first[pixel[part]] + block[part] * size,
                np.minimum(size, count[pixel[part]] - block[part] * size),
            )
            for name, value in self._chunk(table, number, self.cameras, photons, *where).items():
                if name == "triangle":  # of the first sample, which another call has taken
                    sums.setdefault(name, np.full(rows, -1, np.int32))
                elif name == "nearest":
                    total = sums.setdefault(name, np.full(rows, np.inf, np.float32))
                    total[inside] = np.minimum(total[inside], np.minimum.reduceat(value, starts))
                else:
                    total = sums.setdefault(name, np.zeros((*value.shape[:-1], rows)))
                    total[..., inside] += np.add.reduceat(value.astype(np.float64), starts, axis=-1)
        nothing = {"triangle": -1, "nearest": np.inf}  # of pixels without samples
        return {name: self._spread(total, len(streams), pixels, nothing.get(name, 0)) for name, total in sums.items()}

    def _spread(self, values: np.ndarray, streams: int, pixels: np.ndarray, nothing: float) -> np.ndarray:
        """(.., streams x some pixels) -> (streams, all pixels, ..), ``nothing`` in the others."""
        rows = np.moveaxis(values, -1, 0).reshape(streams, len(pixels), *values.shape[:-1])
        whole = np.full((streams, self.pixels, *rows.shape[2:]), nothing, values.dtype)
        whole[:, pixels] = rows
        return whole

    def _chunk(
        self,
        table: LightTable,
        number: int,
        rays: Cameras | Points,
        photons: Photons | None,
        pixel: np.ndarray,
        stream: np.ndarray,
        row: np.ndarray,
        first: np.ndarray,
        count: np.ndarray,
    ) -> dict[str, np.ndarray]:
        """Every lane's sums, (.., lanes) float32."""

        def opaque(value: int) -> mi.UInt32:
            return dr.opaque(mi.UInt32, value & 0xFFFFFFFF)

        places = (pixel, stream, row, pixel // self.pixels, first, count)
        ids, streams, row, views, first, count = (gatherable(values, mi.UInt32) for values in places)
        # the first two steps are one to one in the pixel: no two pixels of a stream share their numbers
        key = mixed(mixed(mixed(ids + opaque(self.seed)) + opaque(self.seed >> 32)) + streams)
        lanes = Lanes(rays, ids, views, row, key, first, count)
        limits = self.limits
        bounds = (
            opaque(limits.bounces),
            opaque(limits.diffuse_bounces),
            opaque(limits.glossy_bounces),
            dr.opaque(mi.Float, 3 * limits.indirect_clamp),
        )
        hide = dr.opaque(mi.Bool, not self.lights_visible)
        pass_key = opaque(number * 0x5851F42D)
        white = isinstance(rays, Points)
        guides = (Unguided(), None) if white else (self.guides[number], self.primaries[number])
        out = trace_paths(
            self.scene, table, self.material, lanes, pass_key, bounds, hide, limits.glossy_filter, white, photons, *guides
        )
        dr.eval(out)
        slots, *wide, distances, hits, nearest, triangle = out
        size = len(pixel)
        return {
            "lights": np.stack([_channels(slot, size) for slot in slots[: table.slots]]),
            **{name: _channels(value, size) for name, value in zip(("direct", "albedo", "normal"), wide, strict=True)},
            "distance": distances.numpy(),
            "hits": hits.numpy(),
            "nearest": nearest.numpy(),
            "triangle": triangle.numpy(),
        }


def _block(samples: int) -> int:
    """Samples of a lane, where a view takes so many."""
    return min(max(1 << (samples // LANES).bit_length() >> 1, BLOCKS[0]), BLOCKS[1])


def _channels(value, size: int) -> np.ndarray:
    """(3, lanes) float32 from a three-channel value, which may be a literal."""
    out = np.empty((3, size), np.float32)
    for axis in range(3):
        out[axis] = value[axis].numpy()
    return out
