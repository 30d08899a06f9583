"""Path tracing with an integrator of our own on Dr.Jit (CUDA or LLVM): radiance per light and first-hit channels in one
pass.

Light transport is linear, so one path serves all lights: each contribution goes to the slot of the light that it
came from. The integrator keeps its own light arrays, picks a light triangle by power, lets it shine from both sides,
and knows a light that a ray hits by its triangle index. Next-event estimation and BSDF sampling are combined by the
power heuristic.

A pixel's samples are neighbours in the wavefront and are added in order on the host, never by atomics, and a
sample's random numbers depend on (seed, view, pixel, sample) only: the bytes are the same for any thread count and
any chunk size.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from stages.records import SceneRecord
from stages.rendering.sums import Sums
from stages.rendering.surfaces import FirstHitAlbedo, face_normals, surface_mesh

SLOTS = 8  # lights per pass; more lights take several passes of the same kernel
OTHER = SLOTS  # slot of a light that belongs to another pass: hidden like any light, black here
CHUNK = 1 << 19  # paths in flight: 40 floats of results each, about 80 MB
RR_DEPTH = 5  # bounces before Russian roulette may end a path
FILTER_CELLS = 1024
R2_STEPS = (3242174889, 2447445414)  # 2^32 / g and 2^32 / g^2 with g^3 = g + 1: Roberts' R2 sequence


@dataclass(frozen=True)
class Limits:
    """How far paths go, and what is cut. Bounces are scattering events, light hits not counted."""

    bounces: int
    diffuse_bounces: int = 1 << 20
    glossy_bounces: int = 1 << 20
    indirect_clamp: float = float("inf")  # bound on the mean over RGB of one indirect contribution, after Cycles
    filter: str = "box"


def filter_offsets(name: str) -> np.ndarray:
    """Inverse cumulative distribution of the pixel filter: FILTER_CELLS + 1 offsets from the centre, in pixels.

    Samples drawn from the filter itself need no weights, so a pixel stays the plain mean of its own samples.
    """
    u = np.linspace(0, 1, FILTER_CELLS + 1)
    if name == "box":
        return u - 0.5
    assert name == "blackman-harris", name
    x = np.linspace(-0.5, 0.5, 8 * FILTER_CELLS + 1)  # four-term Blackman-Harris window, 1.5 pixels wide
    angle = 2 * np.pi * (x + 0.5)
    weight = 0.35875 - 0.48829 * np.cos(angle) + 0.14128 * np.cos(2 * angle) - 0.01168 * np.cos(3 * angle)
    cumulative = np.concatenate([[0], np.cumsum(weight[1:] + weight[:-1])])
    return 1.5 * np.interp(u, cumulative / cumulative[-1], x)


def alias_table(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Walker's alias method: (threshold, alias); cell floor(u n) keeps itself with its threshold's probability."""
    count = len(weights)
    scaled = weights * count / weights.sum()
    threshold, alias = np.ones(count), np.arange(count)
    small = [index for index in range(count) if scaled[index] < 1]
    large = [index for index in range(count) if scaled[index] >= 1]
    while small and large:
        low, high = small.pop(), large.pop()
        threshold[low], alias[low] = scaled[low], high
        scaled[high] -= 1 - scaled[low]
        (small if scaled[high] < 1 else large).append(high)
    return threshold, alias


class LightTable:
    """The lights of one pass: slot, radiance and sampling density per triangle, and the table to pick from."""

    def __init__(self, scene: SceneRecord, first: int):
        index = scene.light_index.astype(np.int64)
        mine = (index >= first) & (index < first + SLOTS)
        slot = np.where(mine, index - first, np.where(index >= 0, OTHER, -1))
        emission = np.where(mine[:, None], scene.emission, 0).astype(np.float32)
        cross = face_normals(scene.triangles)
        length = np.linalg.norm(cross, axis=1)
        power = emission.sum(axis=1, dtype=np.float64) * length
        chosen = np.nonzero(power > 0)[0]  # lights without power get no samples
        if len(chosen) == 0:
            chosen, power = (
                np.array([0]),
                np.where(np.arange(len(power)) == 0, 1.0, 0.0),
            )  # radiance is 0: any table does
        threshold, alias = alias_table(power[chosen])
        density = np.zeros(len(power))  # per unit area
        density[chosen] = power[chosen] / power[chosen].sum() / np.maximum(0.5 * length[chosen], 1e-30)
        normal = cross / np.maximum(length, 1e-30)[:, None]

        self.slot = mi.Int32(slot.astype(np.int32))
        self.emission = _floats(emission)
        self.density = _floats(density)
        self.normal = _floats(normal)
        self.vertices = _floats(scene.triangles)
        self.count = dr.opaque(mi.UInt32, len(chosen))
        self.triangle = mi.UInt32(chosen.astype(np.uint32))
        self.threshold = _floats(threshold)
        self.alias = mi.UInt32(alias.astype(np.uint32))


def _floats(values: np.ndarray) -> mi.Float:
    return mi.Float(np.ascontiguousarray(values, dtype=np.float32).reshape(-1))


def _add(slots: list, slot: mi.Int32, value: mi.Color3f) -> list:
    return [total + dr.select(slot == index, value, 0) for index, total in enumerate(slots)]


@dr.syntax
def trace_paths(scene, lights, albedo, ray, rng, limits, hide):
    """One path per ray. Returns (light slots, direct, albedo, normal, distance, coverage), one value per path.

    ``limits``: opaque (bounces, diffuse bounces, glossy bounces, indirect clamp on the sum over RGB). ``hide``: opaque
    bool, camera rays pass through lights.
    """
    max_bounces, max_diffuse, max_glossy, clamp = limits
    context = mi.BSDFContext()
    slots = [mi.Color3f(0) for _ in range(SLOTS)]
    direct = mi.Color3f(0)
    first_albedo, first_normal = mi.Color3f(0), mi.Normal3f(0)
    first_distance, coverage = mi.Float(0), mi.Float(0)
    origin = mi.Point3f(ray.o)
    throughput = mi.Color3f(1)
    bsdf_pdf = mi.Float(0)
    bounce, diffuse, glossy = mi.UInt32(0), mi.UInt32(0), mi.UInt32(0)
    active = mi.Bool(True)

    while active:
        # without dPdUV: a frame that textures do not turn, so that the same samples go the same ways
        si = scene.ray_intersect(ray, mi.RayFlags.UV | mi.RayFlags.ShadingFrame, False, active)
        active &= si.is_valid()
        slot = dr.select(active, dr.gather(mi.Int32, lights.slot, si.prim_index, active), -1)
        on_light = slot >= 0
        through = on_light & (bounce == 0) & hide  # a camera ray goes on behind a hidden light

        # First hit. The shading normal is turned to the viewer, as the two-sided material does.
        first = active & (bounce == 0) & ~through
        facing = dr.select(dr.dot(si.sh_frame.n, ray.d) > 0, -1, 1)
        first_normal = dr.select(first, si.sh_frame.n * facing, first_normal)
        first_albedo = dr.select(first, albedo.eval(si, first), first_albedo)
        first_distance = dr.select(first, dr.norm(si.p - origin), first_distance)
        coverage = dr.select(first, 1, coverage)

        # Emission met by chance: weighted against the chance of next-event estimation to find it.
        hit = on_light & ~through & (slot < SLOTS)
        cosine = dr.abs(dr.dot(si.n, ray.d))
        light_pdf = dr.gather(mi.Float, lights.density, si.prim_index, hit) * si.t * si.t / dr.maximum(cosine, 1e-9)
        weight = dr.select(bounce == 0, 1, mis_weight(bsdf_pdf, light_pdf))
        value = throughput * dr.gather(mi.Color3f, lights.emission, si.prim_index, hit) * weight
        value = dr.select(hit, clamped(value, dr.select(bounce > 1, clamp, dr.inf)), 0)
        slots = _add(slots, slot, value)
        direct += dr.select(bounce <= 1, value, 0)

        # Next-event estimation at surfaces; lights reflect nothing.
        surface = active & ~on_light & (bounce < max_bounces) & (diffuse <= max_diffuse) & (glossy <= max_glossy)
        bsdf = si.bsdf(ray)
        u = rng.next_float32() * lights.count
        cell = dr.minimum(mi.UInt32(u), lights.count - 1)
        keep = u - mi.Float(cell) < dr.gather(mi.Float, lights.threshold, cell)
        cell = dr.select(keep, cell, dr.gather(mi.UInt32, lights.alias, cell))
        triangle = dr.gather(mi.UInt32, lights.triangle, cell)
        root, v = dr.sqrt(rng.next_float32()), rng.next_float32()
        a, b, c = [dr.gather(mi.Point3f, lights.vertices, 3 * triangle + corner) for corner in range(3)]
        point = a * (1 - root) + b * (root * (1 - v)) + c * (root * v)
        shadow = si.spawn_ray_to(point)
        to_light = point - si.p
        distance2 = dr.squared_norm(to_light)
        to_light *= dr.rsqrt(dr.maximum(distance2, 1e-30))
        cosine = dr.abs(dr.dot(dr.gather(mi.Normal3f, lights.normal, triangle), to_light))
        density = dr.gather(mi.Float, lights.density, triangle)
        sampled = surface & (cosine > 0) & (distance2 > 0) & (density > 0)
        reflected, pdf = bsdf.eval_pdf(context, si, si.to_local(to_light), sampled)
        sampled &= dr.max(reflected) > 0
        sampled &= ~scene.ray_test(shadow, sampled)
        light_pdf = density * distance2 / dr.maximum(cosine, 1e-9)
        value = (
            throughput * reflected * dr.gather(mi.Color3f, lights.emission, triangle) * (mis_weight(light_pdf, pdf) / light_pdf)
        )
        value = dr.select(sampled, clamped(value, dr.select(bounce > 0, clamp, dr.inf)), 0)
        slots = _add(slots, dr.gather(mi.Int32, lights.slot, triangle), value)
        direct += dr.select(bounce == 0, value, 0)

        # The next direction, from the material.
        sample, scattered = bsdf.sample(
            context, si, rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32()), surface
        )
        is_glossy = mi.has_flag(sample.sampled_type, mi.BSDFFlags.GlossyReflection)
        glossy += dr.select(surface & is_glossy, 1, 0)
        diffuse += dr.select(surface & ~is_glossy, 1, 0)
        bounce += dr.select(surface, 1, 0)
        throughput = dr.select(surface, throughput * scattered, throughput)
        bsdf_pdf = dr.select(surface, sample.pdf, bsdf_pdf)
        brightest = dr.max(throughput)
        survival = dr.select(surface & (bounce >= RR_DEPTH), dr.minimum(brightest, 0.95), 1)
        lives = surface & (brightest > 0) & (rng.next_float32() < survival)
        throughput = dr.select(lives, throughput / survival, throughput)
        ray = dr.select(through, si.spawn_ray(ray.d), si.spawn_ray(si.to_world(sample.wo)))
        active = lives | through

    return slots, direct, first_albedo, first_normal, first_distance, coverage


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

    def __init__(self, scene: SceneRecord):
        self.record = scene
        mesh = surface_mesh(scene, np.arange(len(scene.triangles)))
        self.scene = mi.load_dict({"type": "scene", "surface": mesh})
        self.albedo = FirstHitAlbedo(scene)
        self.passes = [LightTable(scene, first) for first in range(0, max(scene.n_lights, 1), SLOTS)]

    def sample(
        self, resolution: int, first: int, spp: int, seed: int, views: list[int], limits: Limits, lights_visible: bool
    ) -> list[Sums]:
        """Sums of each view over the samples ``first`` to ``first + spp`` of every pixel; a path serves all lights."""
        pixels = resolution * resolution
        ids = np.concatenate([view * pixels + np.arange(pixels) for view in views]).astype(np.uint32)
        passes = [
            self._pass(table, number, ids, resolution, first, spp, seed, limits, lights_visible)
            for number, table in enumerate(self.passes)
        ]
        lights = np.concatenate([p["lights"] for p in passes])[: self.record.n_lights]
        direct = sum(p["direct"] for p in passes)
        hit = passes[0]  # the camera rays of all passes are the same
        sums = []
        for index in range(len(views)):
            part = slice(index * pixels, (index + 1) * pixels)

            def image(values: np.ndarray, part=part) -> np.ndarray:
                values = values[..., part, :]
                return values.reshape(*values.shape[:-2], resolution, resolution, values.shape[-1])

            sums.append(
                Sums(
                    spp,
                    *(image(values) for values in (lights, direct, hit["albedo"], hit["normal"])),
                    image(hit["distance"])[..., 0],
                    image(hit["coverage"])[..., 0],
                    float(hit["nearest"][part].min(initial=np.inf)),
                )
            )
        return sums

    def _pass(
        self,
        table: LightTable,
        number: int,
        ids: np.ndarray,
        resolution: int,
        first: int,
        spp: int,
        seed: int,
        limits: Limits,
        lights_visible: bool,
    ) -> dict[str, np.ndarray]:
        """Sums over the samples, float64 (pixels, channels) each; ``lights`` (SLOTS, pixels, 3), ``nearest`` a minimum."""
        count = len(ids)
        widths = {"direct": 3, "albedo": 3, "normal": 3, "distance": 1, "coverage": 1}
        sums = {name: np.zeros((count, width)) for name, width in widths.items()}
        sums["lights"] = np.zeros((SLOTS, count, 3))
        sums["nearest"] = np.full((count, 1), np.inf)
        samples = min(spp, CHUNK // 64)
        for done in range(0, spp, samples):
            depth = min(samples, spp - done)
            rows = max(CHUNK // depth, 1)
            for start in range(0, count, rows):
                part = slice(start, min(start + rows, count))
                values = self._chunk(table, number, ids[part], first + done, depth, resolution, seed, limits, lights_visible)
                for name, value in values.items():
                    shaped = value.reshape(*value.shape[:-1], -1, depth)  # (.., channels, pixels, samples)
                    total = np.moveaxis(shaped.sum(axis=-1, dtype=np.float64), -1, -2)
                    sums[name][..., part, :] += total
                hit = values["coverage"].reshape(-1, depth) > 0
                nearest = np.where(hit, values["distance"].reshape(-1, depth), np.inf).min(axis=1, keepdims=True)
                sums["nearest"][part] = np.minimum(sums["nearest"][part], nearest)
        return sums

    def _chunk(
        self,
        table: LightTable,
        number: int,
        ids: np.ndarray,
        first: int,
        depth: int,
        resolution: int,
        seed: int,
        limits: Limits,
        lights_visible: bool,
    ) -> dict[str, np.ndarray]:
        """Every path's values for ``depth`` samples of the pixels ``ids``, from sample ``first``: (channels, paths)."""

        def opaque(value: int) -> mi.UInt32:
            return dr.opaque(mi.UInt32, value)

        size = len(ids) * depth
        index = dr.arange(mi.UInt32, size)
        row = index // opaque(depth)
        pixel = dr.gather(mi.UInt32, mi.UInt32(ids), row)
        sample = index - row * opaque(depth) + opaque(first)
        low, high = opaque(seed & 0xFFFFFFFF), opaque((seed >> 32) & 0xFFFFFFFF)
        # Points in the pixel follow the additive R2 sequence from a random start of its own: even at any count,
        # so edges are smooth, and alike in every pass, so first hits agree.
        start = mi.sample_tea_32(pixel ^ low, ~high)
        points = [(shift + sample * opaque(step)) >> 8 for shift, step in zip(start, R2_STEPS, strict=True)]
        ray = self._camera_rays(pixel, [mi.Float(point) * 2.0**-24 for point in points], resolution, limits.filter)
        state = mi.sample_tea_32(pixel ^ low, sample ^ high)
        stream = mi.UInt64(state[1]) + (mi.UInt64(opaque(number)) << 32)
        # No `size` here: with it the constructor would add the position in the wavefront to the stream.
        rng = mi.PCG32(initstate=mi.UInt64(state[0]), initseq=stream)

        bounds = (
            opaque(limits.bounces),
            opaque(limits.diffuse_bounces),
            opaque(limits.glossy_bounces),
            dr.opaque(mi.Float, 3 * limits.indirect_clamp),
        )
        slots, direct, albedo, normal, distance, coverage = trace_paths(
            self.scene, table, self.albedo, ray, rng, bounds, dr.opaque(mi.Bool, not lights_visible)
        )
        dr.eval(slots, direct, albedo, normal, distance, coverage)
        one = [distance, coverage]
        wide = [direct, albedo, normal]
        return {
            "lights": np.stack([_channels(slot, size) for slot in slots]),
            **{name: _channels(value, size) for name, value in zip(("direct", "albedo", "normal"), wide, strict=True)},
            **{name: value.numpy()[None] for name, value in zip(("distance", "coverage"), one, strict=True)},
        }

    def _camera_rays(self, pixel: mi.UInt32, points: list[mi.Float], resolution: int, filter_name: str) -> mi.Ray3f:
        """Rays through points of the pixels' filter, given as two numbers in [0, 1) each; image row 0 is on top."""
        cameras = _floats(np.concatenate([self.record.camera_to_world[:, :3].reshape(-1, 12)], axis=1))
        focal = _floats(0.5 / np.tan(0.5 * np.radians(self.record.fov_deg.astype(np.float64))))  # image width 1
        side = dr.opaque(mi.UInt32, resolution)
        view = pixel // (side * side)
        inside = pixel - view * side * side
        row = inside // side
        column = inside - row * side
        table = _floats(filter_offsets(filter_name))

        def offset(point: mi.Float) -> mi.Float:
            u = point * FILTER_CELLS
            cell = dr.minimum(mi.UInt32(u), FILTER_CELLS - 1)
            low, high = dr.gather(mi.Float, table, cell), dr.gather(mi.Float, table, cell + 1)
            return low + (high - low) * (u - mi.Float(cell))

        x = (mi.Float(column) + 0.5 + offset(points[0])) / mi.Float(side) - 0.5
        y = (mi.Float(row) + 0.5 + offset(points[1])) / mi.Float(side) - 0.5
        local = dr.normalize(mi.Vector3f(x, -y, -dr.gather(mi.Float, focal, view)))
        entry = [dr.gather(mi.Float, cameras, 12 * view + index) for index in range(12)]
        direction = mi.Vector3f(
            *[entry[4 * axis] * local.x + entry[4 * axis + 1] * local.y + entry[4 * axis + 2] * local.z for axis in range(3)]
        )
        return mi.Ray3f(mi.Point3f(entry[3], entry[7], entry[11]), dr.normalize(direction))


def _channels(value, size: int) -> np.ndarray:
    """(3, paths) float32 from a three-channel value, which may be a literal."""
    out = np.empty((3, size), np.float32)
    for axis in range(3):
        out[axis] = value[axis].numpy()
    return out
