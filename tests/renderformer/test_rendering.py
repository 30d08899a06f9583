"""The path tracer against what can be computed by hand, against itself, and against Cycles."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys

import numpy as np
import pytest

from pipeline.errors import UserError
from stages.graphics.exr import read_rgb
from stages.graphics.metrics import log_error
from stages.graphics.mitsuba import backend as backends
from stages.renderformer.records import SceneRecord
from stages.renderformer.rendering.settings import RenderSettings
from stages.renderformer.views import encode_view
from tests.renderformer.fakes import path_traced

SCALAR = {"backend": "scalar"}


@pytest.fixture(scope="session")
def jit():
    """The JIT backend that works here."""
    for candidate in backends.candidates("auto"):
        if candidate["backend"] != "scalar" and backends.works(candidate):
            return candidate
    pytest.skip("no JIT backend of Mitsuba works here (no NVIDIA GPU, no libLLVM 16 or newer)")


@pytest.fixture(params=["jit", "scalar"])
def backend(request):
    return request.getfixturevalue("jit") if request.param == "jit" else SCALAR


def quad(centre, u, v):
    """Two triangles spanning centre +- u +- v, facing u x v."""
    c, u, v = (np.asarray(x, np.float64) for x in (centre, u, v))
    corners = [c - u - v, c + u - v, c + u + v, c - u + v]
    return np.array([[corners[0], corners[1], corners[2]], [corners[0], corners[2], corners[3]]])


def camera(position, target=(0, 0, 0), up=(0, 0, 1)):
    position, target = np.asarray(position, np.float64), np.asarray(target, np.float64)
    back = (position - target) / np.linalg.norm(position - target)
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, position], axis=1)
    return pose


def build(surfaces, lights, cameras, fov=40.0):
    """surfaces [(triangles, diffuse, specular, roughness)], lights [(triangles, radiance)]; flat normals."""
    parts = [(np.asarray(t), d, s, r, 0, -1) for t, d, s, r in surfaces]
    parts += [(np.asarray(t), 1, 0, 1, e, index) for index, (t, e) in enumerate(lights)]
    counts = [len(part[0]) for part in parts]
    triangles = np.concatenate([part[0] for part in parts]).astype(np.float32)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)

    def column(index, width):
        rows = [np.broadcast_to(np.asarray(part[index], np.float32), (n, width)) for part, n in zip(parts, counts, strict=True)]
        return np.concatenate(rows)

    return SceneRecord(
        "test",
        triangles,
        np.repeat(normals[:, None], 3, axis=1),
        column(1, 3),
        column(2, 3),
        column(3, 1)[:, 0],
        column(4, 3),
        column(5, 1)[:, 0].astype(np.int16),
        np.zeros(len(triangles), np.int16),
        np.float32(cameras),
        np.full(len(cameras), fov, np.float32),
    )


def clutter(lights=3, cameras=2, roughness=0.3):
    """A floor, a wall, a glossy tilted quad and some lights: everything interacts. Light paths start on the quad unless its
    ``roughness`` is larger."""
    surfaces = [
        (quad((0, 0, -0.5), (0.6, 0, 0), (0, 0.6, 0)), (0.6, 0.4, 0.2), 0.1, 0.8),
        (quad((0, 0.5, 0), (0.6, 0, 0), (0, 0, 0.6)), 0.5, 0.3, 0.4),
        (quad((0.1, 0, 0), (0.2, 0.1, 0.1), (0, 0.2, -0.1)), (0.1, 0.2, 0.3), 0.6, roughness),
    ]
    rng = np.random.default_rng(5)
    lit = []
    for _ in range(lights):
        direction = rng.normal(size=3) * (1, 1, 0.3) + (0, -1.5, 1.5)
        lit.append(((2 * direction / np.linalg.norm(direction) + rng.normal(size=(1, 3, 3)) * 0.12), rng.uniform(200, 500, 3)))
    poses = [camera((0.4 * index - 0.2, -2, 0.5)) for index in range(cameras)]
    return build(surfaces, lit, poses)


def hashed(views):
    return [hashlib.sha256(b"".join(encode_view(view).values())).hexdigest() for view in views]


# --- against what is known --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("flip", [False, True])
def test_small_light_over_a_diffuse_plane(backend, flip):
    """L A cos cos / d^2 * albedo / pi, from either side of the light."""
    tilt = np.array([0.3, 0, 1]) / np.hypot(0.3, 1)
    u, v = np.cross((0, 1, 0), tilt), np.array([0.0, 1, 0])
    light = np.array([[0.3, 0, 1.2] + 0.02 * u, [0.3, 0, 1.2] + 0.02 * v, [0.3, 0, 1.2] - 0.02 * u - 0.02 * v])
    light = light[::-1] if flip else light
    pose = camera((-0.5, 0, 1.5), (-0.5, 0, 0), (0, 1, 0))
    plane = quad((0, 0, 0), (3, 0, 0), (0, 3, 0))
    scene = build([(plane, (0.2, 0.5, 0.8), 0, 1)], [(light[None], (900, 600, 300))], [pose], fov=1.0)
    view = path_traced(scene, 8, max_spp=64, seed=1, backend=backend, denoise=False)[0]
    area = np.linalg.norm(np.cross(light[1] - light[0], light[2] - light[0])) / 2
    way = light.mean(axis=0) - [-0.5, 0, 0]
    distance2 = way @ way
    cosines = way[2] / np.sqrt(distance2) * abs(way @ tilt) / np.sqrt(distance2)
    expected = np.array([900, 600, 300]) * area * cosines / distance2 * np.array([0.2, 0.5, 0.8]) / np.pi
    assert np.allclose(view.image.mean(axis=(0, 1)), expected, rtol=4e-3)
    assert np.allclose(view.direct, view.image, rtol=1e-4 if backend != SCALAR else 0.2)
    assert np.allclose(view.depth, 1.5, rtol=1e-3) and np.allclose(view.normal, [0, 0, 1], atol=1e-3)
    assert np.allclose(view.albedo, [0.2, 0.5, 0.8], atol=1e-4) and (view.coverage == 1).all()


@pytest.mark.parametrize(("diffuse", "specular", "roughness"), [(1.0, 0.0, 1.0), (0.0, 1.0, 0.05), (0.3, 0.7, 0.05)])
def test_white_furnace(backend, diffuse, specular, roughness):
    """A surface that loses nothing, inside a closed light of radiance 1, cannot be told from the light."""
    faces = [
        quad(sign * np.eye(3)[axis] * 3, np.eye(3)[(axis + 1) % 3] * 3, np.eye(3)[(axis + 2) % 3] * 3)
        for axis in range(3)
        for sign in (-1.0, 1.0)
    ]
    inside = quad((0, 0, 0), (0.5, 0.1, 0), (0, 0.3, 0.5))
    scene = build([(inside, diffuse, specular, roughness)], [(np.concatenate(faces), 1)], [camera((0, -2, 0.3))])
    view = path_traced(scene, 16, max_spp=64, seed=1, backend=backend, denoise=False, lights_visible=True)[0]
    # Rough facets send a little of the light below the surface: single scattering loses it.
    assert np.allclose(view.image.mean(axis=(0, 1)), 1, atol=0.01)
    assert view.coverage.min() == 1
    hidden = path_traced(scene, 16, max_spp=64, seed=1, backend=backend, denoise=False)[0]
    assert np.allclose(hidden.image.mean(axis=-1), hidden.coverage, atol=0.45)  # the scalar one: other samples
    assert 0 < hidden.coverage.mean() < 1


def cast(triangles, origin, directions):
    """The triangle that each ray hits first, -1 for none (Moeller and Trumbore), the slow obvious way."""
    nearest_index, nearest = np.full(directions.shape[:-1], -1), np.full(directions.shape[:-1], np.inf)
    for index, (a, b, c) in enumerate(triangles.astype(np.float64)):
        p = np.cross(directions, c - a)
        determinant = p @ (b - a)
        safe = np.where(abs(determinant) < 1e-12, 1, determinant)
        u = p @ (origin - a) / safe
        q = np.cross(origin - a, b - a)
        v = directions @ q / safe
        t = (c - a) @ q / safe
        hit = (abs(determinant) >= 1e-12) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < nearest)
        nearest_index, nearest = np.where(hit, index, nearest_index), np.where(hit, t, nearest)
    return nearest_index


def test_coverage_and_triangles_are_a_ray_cast(backend):
    scene, size = clutter(), 24
    scene.object_index = np.arange(len(scene.triangles), dtype=np.int16) // 2
    view = path_traced(scene, size, max_spp=32, seed=0, backend=backend, denoise=False, views=[1])[0]
    half = np.tan(np.radians(scene.fov_deg[1] / 2))
    x, y = np.meshgrid((2 * np.arange(size) + 1) / size - 1, 1 - (2 * np.arange(size) + 1) / size)
    local = np.stack([x * half, y * half, -np.ones_like(x)], axis=-1)
    pose = scene.camera_to_world[1].astype(np.float64)
    expected = cast(scene.triangles[scene.light_index < 0], pose[:3, 3], local @ pose[:3, :3].T)
    hit = expected >= 0
    sure = (view.coverage == 0) | (view.coverage == 1)
    assert sure.mean() > 0.7
    assert np.array_equal(view.coverage[sure] == 1, hit[sure])
    assert ((view.depth > 0) == (view.coverage > 0)).all()
    assert np.array_equal(view.triangle[view.coverage == 0], expected[view.coverage == 0])
    assert np.mean(view.triangle == expected) > 0.9  # a sample somewhere in the pixel, and the pixel's centre
    assert np.array_equal(view.object, np.where(view.triangle >= 0, view.triangle // 2, -1))
    lit = view.image[view.coverage == 0].any(axis=-1).sum()
    assert lit <= (3 if backend == SCALAR else 0)  # the scalar renderer's first hits are other samples than its light


def test_lights_are_hidden_from_cameras_but_not_from_reflections(backend):
    """A mirror shows the light in either case; the light itself appears only where lights are visible."""
    light = quad((0, 0.5, 0.3), (0.25, 0, 0), (0, 0, 0.25))
    mirror = quad((0, 0, -0.3), (1, 0, 0), (0, 1, 0))
    back = quad((0, 1, 0.3), (1, 0, 0), (0, 0, 0.9))
    scene = build([(mirror, 0, 0.9, 0.01), (back, 0.001, 0, 1)], [(light, 10)], [camera((0, -2, 0.5))], fov=45)
    kept = {"max_spp": 32, "seed": 0, "backend": backend, "denoise": False}
    visible, hidden = (path_traced(scene, 24, lights_visible=flag, **kept)[0] for flag in (True, False))
    bright = np.abs(visible.image.mean(axis=-1) - 10) < 1e-3  # wholly on the light
    bright[12:] = False  # not on its reflection
    assert bright.sum() > 8
    assert hidden.image[bright].max() < 1 and hidden.coverage[bright].min() == 1
    assert np.allclose(hidden.depth[bright] - visible.depth[bright], 0.5, atol=0.1)
    lower = np.arange(24) > 13
    assert hidden.image[lower].max() > 8.5
    assert np.allclose(hidden.image[lower].mean(), visible.image[lower].mean(), rtol=0.03)


# --- against itself ---------------------------------------------------------------------------------------------------


def test_lights_apart_sum_to_the_plain_render(jit):
    """The same samples, with all light triangles declared one light. (Light paths start elsewhere then: other samples.)"""
    apart = clutter(lights=6, roughness=0.4)
    together = clutter(lights=6, roughness=0.4)
    together.light_index[together.light_index >= 0] = 0
    a, b = (path_traced(scene, 16, max_spp=16, seed=3, backend=jit, denoise=False)[0] for scene in (apart, together))
    assert a.lights.shape == (6, 16, 16, 3) and b.lights.shape == (1, 16, 16, 3)
    assert np.allclose(a.image, b.image, rtol=1e-4, atol=1e-5)
    assert np.allclose(a.direct, b.direct, rtol=1e-4, atol=1e-5)


def test_light_paths_of_lights_apart_sum_to_the_plain_render(jit):
    apart, together = clutter(lights=6, cameras=1), clutter(lights=6, cameras=1)
    together.light_index[together.light_index >= 0] = 0
    kept = {"max_spp": 1024, "seed": 3, "backend": jit, "denoise": False}
    a, b = (path_traced(scene, 16, **kept)[0] for scene in (apart, together))
    assert np.allclose(a.image.mean(axis=(0, 1)), b.image.mean(axis=(0, 1)), rtol=2e-3)


def test_more_than_eight_lights(backend):
    """Ten lights, each against a render with the others dark."""
    scene = clutter(lights=10, cameras=1)
    view = path_traced(scene, 16, max_spp=256, seed=0, backend=backend, denoise=False)[0]
    assert view.lights.shape[0] == 10
    for light in (0, 9):
        alone = clutter(lights=10, cameras=1)
        alone.emission[alone.light_index != light] = 0
        only = path_traced(alone, 16, max_spp=256, seed=1, backend=backend, denoise=False)[0]
        assert not np.delete(only.lights, light, axis=0).any()
        assert np.allclose(only.image.mean(), view.lights[light].mean(), rtol=0.05)
    assert view.direct.mean() < view.image.mean()


def test_no_light_is_dark(backend):
    scene = clutter(lights=0, cameras=1)
    view = path_traced(scene, 8, max_spp=4, seed=0, backend=backend)[0]
    assert view.lights.shape == (0, 8, 8, 3) and view.meta["status"] == "dark"
    assert view.coverage.max() == 1


def test_scalar_and_jit_agree(jit):
    scene = clutter(lights=3, cameras=1)
    a = path_traced(scene, 16, max_spp=512, seed=0, backend=jit, denoise=False)[0]
    b = path_traced(scene, 16, max_spp=1024, seed=0, backend=SCALAR, denoise=False)[0]
    for light in range(3):
        assert np.allclose(a.lights[light].mean(axis=(0, 1)), b.lights[light].mean(axis=(0, 1)), rtol=0.04)
    assert np.allclose(a.direct.mean(axis=(0, 1)), b.direct.mean(axis=(0, 1)), rtol=0.02)
    inside = (a.coverage == 1) & (b.coverage == 1)
    # Pixels with an edge inside them hold means over two surfaces: compare the others.
    flat = inside & (np.linalg.norm(a.normal, axis=-1) > 0.999)
    assert flat.mean() > 0.4
    for name, tolerance in (("albedo", 0.01), ("normal", 0.01), ("depth", 0.02)):
        assert np.abs(getattr(a, name) - getattr(b, name))[flat].max() < tolerance, name


@pytest.mark.parametrize(("spp", "target"), [(8, 0), (48, 1e-9)], ids=["plain", "guided"])
def test_bytes_do_not_depend_on_threads(backend, spp, target):
    scene, kept = clutter(), {"max_spp": spp, "target_error": target, "backend": backend}
    runs = [hashed(path_traced(scene, 16, seed=2, threads=threads, **kept)) for threads in (1, 2, 2)]
    assert runs[0] == runs[1] == runs[2]
    assert hashed(path_traced(scene, 16, seed=3, **kept)) != runs[0]


@pytest.mark.parametrize("target", [0, 1e-9], ids=["plain", "guided"])
def test_bytes_do_not_depend_on_views_or_chunks(jit, monkeypatch, target):
    from stages.renderformer.rendering import jit as module

    scene, kept = clutter(), {"max_spp": 44, "seed": 2, "backend": jit, "denoise": False, "target_error": target}
    whole = path_traced(scene, 16, **kept)
    assert hashed(path_traced(scene, 16, views=[1], **kept)) == hashed(whole)[1:]
    monkeypatch.setattr(module, "CHUNK", 100)  # lanes, of six blocks for each pixel
    assert hashed(path_traced(scene, 16, **kept)) == hashed(whole)
    monkeypatch.setattr(module, "GROUP", 4)  # blocks in flight for each pixel: memory is bounded at any number of samples
    for a, b in zip(path_traced(scene, 16, **kept), whole, strict=True):
        np.testing.assert_allclose(a.lights, b.lights, rtol=1e-6)
        assert np.array_equal(a.triangle, b.triangle) and a.meta["nearest"] == b.meta["nearest"]


def test_denoiser_gives_the_same_bytes_for_any_thread_count():
    code = (
        "import hashlib, numpy as np; from stages.graphics.denoising import denoise; r = np.random.default_rng(0);"
        "x = [r.uniform(0, 1, (40, 40, 3)) for _ in range(3)];"
        "print(hashlib.sha256(denoise(*x, np.ones((40, 40))).tobytes()).hexdigest())"
    )
    runs = [
        subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            check=True,
            env={**os.environ, "OIDN_NUM_THREADS": str(threads)},
        ).stdout
        for threads in (1, 2)
    ]
    assert runs[0] == runs[1]


def test_denoising_comes_nearer_to_the_truth(backend):
    scene = clutter(cameras=1)
    truth = path_traced(scene, 32, max_spp=1024, seed=9, backend=backend, denoise=False)[0].image
    noisy, clean = (path_traced(scene, 32, max_spp=4, seed=0, backend=backend, denoise=flag)[0].image for flag in (False, True))

    def error(image):
        return np.abs(np.log10(1 + image) - np.log10(1 + truth)).mean()

    assert error(clean) < 0.6 * error(noisy)


def test_samples_are_spent_until_the_target_is_met(backend):
    scene, kept = clutter(), {"seed": 0, "backend": backend, "denoise": False}
    needs = [
        [view.meta for view in path_traced(scene, 16, max_spp=256, target_error=target, **kept)] for target in (1.0, 0.02, 1e-9)
    ]
    for target, metas in zip((1.0, 0.02, 1e-9), needs, strict=True):
        for meta in metas:
            assert meta["error"] <= target or meta["spp"] + meta["dropped"] == 256
    first, middle, last = ([meta["spp"] + meta["dropped"] for meta in metas] for metas in needs)
    assert first == [16, 16] and last == [256, 256] and all(16 <= spp < 256 for spp in middle)
    capped = path_traced(scene, 16, max_spp=24, target_error=1e-9, **kept)
    assert [view.meta["spp"] for view in capped] == [24, 24]


def caustic(roughness=0.35):
    """A rough floor lit by a lamp's reflection in something metallic as much as by the lamp."""
    surfaces = [
        (quad((0, 0, -0.5), (0.6, 0, 0), (0, 0.6, 0)), 0.8, 0.0, 1.0),
        (quad((0, 0.6, 0.1), (0.6, 0, 0), (0, 0, 0.6)), 0.0, 0.9, roughness),
    ]
    lamp = np.array([[[0, -0.6, 1.9], [0.2, -0.6, 1.9], [0, -0.4, 1.9]]])
    return build(surfaces, [(lamp, 200.0)], [camera((0, -2, 0.8), (0, 0, -0.4))])


def test_guiding_finds_caustics_and_keeps_the_mean(jit):
    from stages.renderformer.rendering.jit import JitRenderer, Limits

    backends.activate(jit)

    def images(renderer, first, spp):
        return [sums.lights[0] / spp for (sums,) in renderer.sample([0], [0, 1], first, spp)]

    few, means = {}, {}
    for guided in (False, True):
        renderer = JitRenderer(caustic(0.25), (32, 32), 4, Limits(8), False, guided)
        renderer.sample([0], [0, 1], 0, 16)
        renderer.learn([0])
        few[guided], means[guided] = images(renderer, 16, 16), np.mean(images(renderer, 32, 2048))
    assert means[True] == pytest.approx(means[False], rel=0.005)
    plain, guided = (np.mean(np.abs(np.subtract(*few[flag]))) for flag in (False, True))
    assert guided < 0.7 * plain  # twice the samples without guiding


def test_first_samples_are_dropped_where_the_target_is_far(jit):
    kept = {"seed": 0, "backend": jit, "denoise": False}
    error = path_traced(caustic(), 32, max_spp=16, target_error=1e-9, **kept)[0].meta["error"]
    for max_spp, target, counts in ((128, error / 3, (112, 16)), (128, error / 1.5, (None, 0)), (24, error / 3, (24, 0))):
        meta = path_traced(caustic(), 32, max_spp=max_spp, target_error=target, **kept)[0].meta
        assert (counts[0] or meta["spp"], counts[1]) == (meta["spp"], meta["dropped"])


def test_samples_in_portions_are_the_same_samples(jit):
    from stages.renderformer.rendering.jit import JitRenderer, Limits

    backends.activate(jit)
    renderer = JitRenderer(clutter(), (16, 16), 4, Limits(8), False)
    whole = renderer.sample([0, 1], [0, 1], 0, 32)
    portions = [renderer.sample([0, 1], [0, 1], first, 16) for first in (0, 16)]
    assert not np.array_equal(whole[0][0].lights, whole[1][0].lights)
    for stream in (0, 1):
        for view in (0, 1):
            a, b = whole[stream][view], portions[0][stream][view] + portions[1][stream][view]
            for name in vars(a):
                np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=1e-12)


def test_sampler_fills_every_pair_of_dimensions_evenly(jit):
    """Any 2^k first points of a key have one in each of the 2^k boxes of every shape: a (0, 2)-sequence in base 2."""
    backends.activate(jit)
    import drjit as dr
    import mitsuba as mi

    from stages.renderformer.rendering.sobol import Sampler

    index = dr.arange(mi.UInt32, 256)
    other = None
    for key, dimension in ((1, 0), (1, 7), (987654321, 0xFFFFFFFF)):
        points = Sampler(mi.UInt32(key), index).two(mi.UInt32(dimension)).numpy()
        line = Sampler(mi.UInt32(key), index).one(mi.UInt32(dimension)).numpy()
        assert points.shape == (2, 256) and (points >= 0).all() and (points < 1).all()
        for k in range(9):
            assert len(np.unique(np.floor(line[: 2**k] * 2**k))) == 2**k
            for split in range(k + 1):
                boxes = np.floor(points[:, : 2**k] * np.array([[2**split], [2 ** (k - split)]]))
                assert len(np.unique(boxes, axis=1).T) == 2**k, (k, split)
        assert other is None or np.abs(np.corrcoef(np.vstack([points, line, other]))[:3, 3:]).max() < 0.3
        other = points


def test_raw_error_estimate_is_the_error(backend):
    scene, kept = clutter(cameras=1), {"backend": backend, "denoise": False}
    truth = path_traced(scene, 32, max_spp=4096, seed=9, **kept)[0].image
    for spp in (16, 64):
        view = path_traced(scene, 32, max_spp=spp, target_error=1e-9, seed=0, **kept)[0]
        assert view.meta["error"] == pytest.approx(log_error(view.image, truth), rel=0.2)
    assert path_traced(scene, 16, max_spp=1, seed=0, **kept)[0].meta["error"] is None


def test_scale_changes_nothing(jit):
    """Emission is radiance: a scene twice as large, seen from twice as far, is the same picture."""
    scene, large = clutter(cameras=1), clutter(cameras=1)
    large.triangles = 2 * large.triangles
    large.camera_to_world = large.camera_to_world.copy()
    large.camera_to_world[:, :3, 3] *= 2
    a, b = (path_traced(record, 16, max_spp=64, seed=0, backend=jit, denoise=False)[0] for record in (scene, large))
    assert np.allclose(a.image.mean(), b.image.mean(), rtol=0.01)
    assert np.allclose(2 * a.depth, b.depth, rtol=1e-4)


def test_cycles_mode_clamps_filters_and_limits(jit):
    from stages.renderformer.rendering.jit import filter_offsets

    offsets = filter_offsets("blackman-harris")
    assert offsets[0] == -1.5 and offsets[-1] == 1.5 and np.allclose(offsets, -offsets[::-1], atol=1e-6)
    assert 0.37 < offsets.std() < 0.42  # the window's standard deviation, in pixels
    scene = clutter(cameras=1)
    kept = {"max_spp": 64, "seed": 0, "backend": jit, "denoise": False}
    physical, cycles = (path_traced(scene, 16, mode=mode, **kept)[0] for mode in ("physical", "cycles"))
    assert np.allclose(physical.direct.mean(), cycles.direct.mean(), rtol=0.05)
    assert cycles.image.mean() < 1.02 * physical.image.mean()
    with pytest.raises(UserError, match="JIT"):
        path_traced(scene, 8, max_spp=1, seed=0, backend=SCALAR, mode="cycles")


# --- against Cycles ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "spp", "tolerance"),
    [("init-template", 32, 0.01), ("cbox", 64, 0.015), ("shader-ball", 64, 0.015), ("veach-mis", 128, 0.1)],
)
def test_means_match_cycles(shared_data, jit, name, spp, tolerance):
    """Few samples, hence the tolerance; the caustics of veach-mis leave 1 % of noise in the mean at 1,024 samples."""
    from stages.renderformer.scenes.released import load_scene

    scene = load_scene(shared_data / "scenes" / f"{name}.h5")
    reference = read_rgb(shared_data / "cycles" / f"{name}-physical-128.exr")
    image = path_traced(scene, 128, max_spp=spp, seed=1, backend=jit, denoise=False, lights_visible=True)[0].image
    ratio = np.minimum(image, 4).mean(axis=(0, 1)) / np.minimum(reference, 4).mean(axis=(0, 1))
    assert np.allclose(ratio, 1, atol=tolerance), ratio


# --- the backend, the command ------------------------------------------------------------------------------


def test_trace_writes_one_file_per_view(tmp_path, shared_data, monkeypatch):
    from stages.renderformer.inference.trace import trace

    monkeypatch.setattr(backends, "choose", lambda choice: SCALAR)
    scene = shared_data / "scenes" / "init-template.json"
    settings = RenderSettings(8, 2)
    assert trace(scene, tmp_path / "a.exr", settings, view="all") == [tmp_path / "a-0.exr"]
    assert read_rgb(tmp_path / "a-0.exr").shape == (8, 8, 3)
    with pytest.raises(UserError, match="1 camera"):
        trace(scene, tmp_path / "b.exr", settings, view=3)
    with pytest.raises(UserError, match=r"OUT\.exr"):
        trace(scene, "a.jpg", settings)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"resolution": 0}, "resolution=0: expected at least 1"),
        ({"max_spp": 0}, "max_spp=0: expected at least 1"),
        ({"seed": -1}, "seed=-1: expected at least 0"),
        ({"mode": "fast"}, "choose from physical, cycles"),
    ],
)
def test_settings_that_cannot_be_rendered_are_refused(wrong, message):
    with pytest.raises(UserError, match=message):
        RenderSettings(**{"resolution": 8, "max_spp": 2, **wrong})


def test_radiance_at_texels_is_what_a_camera_sees_of_diffuse_surfaces(jit):
    from stages.renderformer.rendering.texels import texel_radiance, texel_weights

    kept, weights = texel_weights(32)
    assert kept.sum() == len(weights) == 528 + 31 and np.allclose(weights.sum(axis=1), 1)
    scene = clutter(lights=2, cameras=1)
    scene.specular[:2] = 0  # the floor
    radiance, met = texel_radiance(scene, [0, 1, 4, len(scene.triangles) - 1], spp=1024, seed=0, backend=jit, size=16)
    assert radiance.shape == (4, 2, 16, 16, 3) and met[:2].sum() == 2 * texel_weights(16)[0].sum()
    assert not radiance[:, :, ~texel_weights(16)[0]].any() and not radiance[3].any() and not met[3].any()
    # against a camera that looks straight down at a few texels of the floor
    for row, column in ((2, 3), (8, 5), (1, 12)):
        one, two = (column + 0.5) / 16, (row + 0.5) / 16
        point = np.array([1 - one - two, one, two]) @ scene.triangles[0].astype(np.float64)
        above = clutter(lights=2, cameras=1)
        above.specular[:2] = 0
        above.camera_to_world = np.float32([camera(point + (0, 0, 0.01), point, (0, 1, 0))])
        above.fov_deg = np.float32([1])
        view = path_traced(above, 8, max_spp=256, seed=1, backend=jit, denoise=False)[0]
        np.testing.assert_allclose(radiance[0, :, row, column], view.lights.mean(axis=(1, 2)), rtol=0.1)
    with pytest.raises(UserError, match="JIT"):
        texel_radiance(scene, [0], spp=1, seed=0, backend=SCALAR)


@pytest.mark.parametrize("roughness", [0.05, 0.4, 1.0])
def test_multiple_scattering_returns_what_single_scattering_loses(jit, roughness):
    """A white furnace at any roughness, seen straight and at a grazing angle; single scattering darkens the rough ones."""
    sky = [
        quad(sign * np.eye(3)[a] * 3, np.eye(3)[(a + 1) % 3] * 3, np.eye(3)[(a + 2) % 3] * 3)
        for a in range(3)
        for sign in (-1, 1)
    ]
    plate = quad((0, 0, 0), (0.5, 0, 0), (0, 0.5, 0))
    poses = [camera((0, -0.1, 2)), camera((0, -2, 0.5))]
    scene = build([(plate, 0, 1, roughness)], [(np.concatenate(sky), 1)], poses, fov=5.0)
    kept = {"max_spp": 64, "seed": 0, "backend": jit, "denoise": False, "lights_visible": True}
    single, multiple = ([view.image.mean() for view in path_traced(scene, 16, mode=m, **kept)] for m in ("physical", "cycles"))
    assert np.allclose(multiple, 1, atol=0.01)
    assert np.allclose(single, 1, atol=0.01) == (roughness < 0.3) and max(single) < 1.005


def test_material_is_ggx_with_correlated_masking(jit):
    """The BSDF and its density against the formulas, in numpy, on either side; directions follow their density."""
    backends.activate(jit)
    import mitsuba as mi

    from stages.renderformer.rendering.material import Lobes, Material
    from stages.renderformer.rendering.surfaces import Surfaces

    scene = clutter()
    material = Material(Surfaces(scene, np.arange(len(scene.triangles))), multiscatter=False)
    rng = np.random.default_rng(0)
    wi, wo = rng.normal(size=(2, 3, 400_000))
    wi, wo = wi / np.linalg.norm(wi, axis=0), wo / np.linalg.norm(wo, axis=0)
    wi[:, :200_000] = np.array([[0.6], [0], [0.8]])
    alpha, diffuse, specular = 0.3, np.array([0.2, 0.3, 0.1]), np.array([0.5, 0.4, 0.6])
    lobes = Lobes(mi.Color3f(*map(float, diffuse)), mi.Color3f(*map(float, specular)), mi.Float(alpha))
    value, density = material.evaluate(lobes, mi.Vector3f(wi), mi.Vector3f(wo))

    def loss(w):  # Smith's lambda
        return 0.5 * (np.sqrt(1 + alpha**2 * (1 / w[2] ** 2 - 1)) - 1)

    half = wi * np.sign(wi[2]) + wo * np.sign(wi[2])
    half /= np.linalg.norm(half, axis=0)
    ndf = alpha**2 / np.pi / (half[2] ** 2 * (alpha**2 - 1) + 1) ** 2
    lobe = ndf / (1 + loss(wi) + loss(wo)) / (4 * np.abs(wi[2]))
    same = wi[2] * wo[2] > 0
    expected = np.where(same, diffuse[:, None] / np.pi * np.abs(wo[2]) + specular[:, None] * lobe, 0)
    np.testing.assert_allclose(np.array(value), expected, rtol=2e-3, atol=1e-5)
    glossy = mi.Float(rng.random(400_000)) < lobes.specular_share
    drawn = material.sample(lobes, mi.Vector3f(wi), glossy, mi.Point2f(rng.random((2, 400_000))))
    albedo, pdf = (np.array(part) for part in material.evaluate(lobes, mi.Vector3f(wi), drawn))
    # what the density leaves out is sent below the surface
    kept = (np.array(drawn)[2, :200_000] > 0).mean()
    assert 0.9 < kept < 0.99 and 4 * np.pi * np.array(density)[:200_000].mean() == pytest.approx(kept, abs=0.01)
    by_lobes = np.mean(np.where(pdf > 0, albedo / np.maximum(pdf, 1e-9), 0)[:, :200_000], axis=1)
    np.testing.assert_allclose(by_lobes, 4 * np.pi * expected[:, :200_000].mean(axis=1), rtol=0.02)
