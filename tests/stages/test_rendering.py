"""The path tracer against what can be computed by hand, against itself, and against Cycles."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.errors import Reject, UserError
from pipeline.stage import Item
from stages.arrays import unpack_json
from stages.exr import decode_view, encode_view, read_rgb
from stages.metrics import log_error
from stages.records import SceneRecord
from stages.rendering import backend as backends
from stages.rendering.render import render_views
from stages.s04_render import Render, RenderConfig

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


def clutter(lights=3, cameras=2):
    """A floor, a wall, a glossy tilted quad and some lights: everything interacts."""
    surfaces = [
        (quad((0, 0, -0.5), (0.6, 0, 0), (0, 0.6, 0)), (0.6, 0.4, 0.2), 0.1, 0.8),
        (quad((0, 0.5, 0), (0.6, 0, 0), (0, 0, 0.6)), 0.5, 0.3, 0.4),
        (quad((0.1, 0, 0), (0.2, 0.1, 0.1), (0, 0.2, -0.1)), (0.1, 0.2, 0.3), 0.6, 0.3),
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
    view = render_views(scene, 8, max_spp=64, seed=1, backend=backend, denoise=False)[0]
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
    view = render_views(scene, 16, max_spp=64, seed=1, backend=backend, denoise=False, lights_visible=True)[0]
    # Rough facets send a little of the light below the surface: single scattering loses it.
    assert np.allclose(view.image.mean(axis=(0, 1)), 1, atol=0.01)
    assert view.coverage.min() == 1
    hidden = render_views(scene, 16, max_spp=64, seed=1, backend=backend, denoise=False)[0]
    assert np.allclose(hidden.image.mean(axis=-1), hidden.coverage, atol=0.45)  # the scalar one: other samples
    assert 0 < hidden.coverage.mean() < 1


def cast(triangles, origin, directions):
    """Whether each ray hits any triangle (Moeller and Trumbore), the slow obvious way."""
    hit = np.zeros(directions.shape[:-1], bool)
    for a, b, c in triangles.astype(np.float64):
        p = np.cross(directions, c - a)
        determinant = p @ (b - a)
        safe = np.where(abs(determinant) < 1e-12, 1, determinant)
        u = p @ (origin - a) / safe
        q = np.cross(origin - a, b - a)
        v = directions @ q / safe
        t = (c - a) @ q / safe
        hit |= (abs(determinant) >= 1e-12) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
    return hit


def test_coverage_is_a_ray_cast_of_the_triangles(backend):
    scene, size = clutter(), 24
    view = render_views(scene, size, max_spp=32, seed=0, backend=backend, denoise=False, views=[1])[0]
    half = np.tan(np.radians(scene.fov_deg[1] / 2))
    x, y = np.meshgrid((2 * np.arange(size) + 1) / size - 1, 1 - (2 * np.arange(size) + 1) / size)
    local = np.stack([x * half, y * half, -np.ones_like(x)], axis=-1)
    pose = scene.camera_to_world[1].astype(np.float64)
    hit = cast(scene.triangles[scene.light_index < 0], pose[:3, 3], local @ pose[:3, :3].T)
    sure = (view.coverage == 0) | (view.coverage == 1)
    assert sure.mean() > 0.7
    assert np.array_equal(view.coverage[sure] == 1, hit[sure])
    assert ((view.depth > 0) == (view.coverage > 0)).all()
    lit = view.image[view.coverage == 0].any(axis=-1).sum()
    assert lit <= (3 if backend == SCALAR else 0)  # the scalar renderer's first hits are other samples than its light


def test_lights_are_hidden_from_cameras_but_not_from_reflections(backend):
    """A mirror shows the light in either case; the light itself appears only where lights are visible."""
    light = quad((0, 0.5, 0.3), (0.25, 0, 0), (0, 0, 0.25))
    mirror = quad((0, 0, -0.3), (1, 0, 0), (0, 1, 0))
    back = quad((0, 1, 0.3), (1, 0, 0), (0, 0, 0.9))
    scene = build([(mirror, 0, 0.9, 0.01), (back, 0.001, 0, 1)], [(light, 10)], [camera((0, -2, 0.5))], fov=45)
    kept = {"max_spp": 32, "seed": 0, "backend": backend, "denoise": False}
    shown, hidden = (render_views(scene, 24, lights_visible=flag, **kept)[0] for flag in (True, False))
    bright = np.abs(shown.image.mean(axis=-1) - 10) < 1e-3  # wholly on the light
    bright[12:] = False  # not on its reflection
    assert bright.sum() > 8
    assert hidden.image[bright].max() < 1 and hidden.coverage[bright].min() == 1
    assert np.allclose(hidden.depth[bright] - shown.depth[bright], 0.5, atol=0.1)
    lower = np.arange(24) > 13
    assert hidden.image[lower].max() > 8.5
    assert np.allclose(hidden.image[lower].mean(), shown.image[lower].mean(), rtol=0.03)


# --- against itself ---------------------------------------------------------------------------------------------------


def test_lights_apart_sum_to_the_plain_render(jit):
    """The same samples, with all light triangles declared one light."""
    apart = clutter(lights=6)
    together = clutter(lights=6)
    together.light_index[together.light_index >= 0] = 0
    a, b = (render_views(scene, 16, max_spp=16, seed=3, backend=jit, denoise=False)[0] for scene in (apart, together))
    assert a.lights.shape == (6, 16, 16, 3) and b.lights.shape == (1, 16, 16, 3)
    assert np.allclose(a.image, b.image, rtol=1e-4, atol=1e-5)
    assert np.allclose(a.direct, b.direct, rtol=1e-4, atol=1e-5)


def test_more_than_eight_lights(backend):
    """Ten lights, each against a render with the others dark."""
    scene = clutter(lights=10, cameras=1)
    view = render_views(scene, 16, max_spp=256, seed=0, backend=backend, denoise=False)[0]
    assert view.lights.shape[0] == 10
    for light in (0, 9):
        alone = clutter(lights=10, cameras=1)
        alone.emission[alone.light_index != light] = 0
        only = render_views(alone, 16, max_spp=256, seed=1, backend=backend, denoise=False)[0]
        assert not np.delete(only.lights, light, axis=0).any()
        assert np.allclose(only.image.mean(), view.lights[light].mean(), rtol=0.05)
    assert view.direct.mean() < view.image.mean()


def test_no_light_is_dark(backend):
    scene = clutter(lights=0, cameras=1)
    view = render_views(scene, 8, max_spp=4, seed=0, backend=backend)[0]
    assert view.lights.shape == (0, 8, 8, 3) and view.meta["status"] == "dark"
    assert view.coverage.max() == 1


def test_scalar_and_jit_agree(jit):
    scene = clutter(lights=3, cameras=1)
    a = render_views(scene, 16, max_spp=512, seed=0, backend=jit, denoise=False)[0]
    b = render_views(scene, 16, max_spp=1024, seed=0, backend=SCALAR, denoise=False)[0]
    for light in range(3):
        assert np.allclose(a.lights[light].mean(axis=(0, 1)), b.lights[light].mean(axis=(0, 1)), rtol=0.04)
    assert np.allclose(a.direct.mean(axis=(0, 1)), b.direct.mean(axis=(0, 1)), rtol=0.02)
    inside = (a.coverage == 1) & (b.coverage == 1)
    # Pixels with an edge inside them hold means over two surfaces: compare the others.
    flat = inside & (np.linalg.norm(a.normal, axis=-1) > 0.999)
    assert flat.mean() > 0.4
    for name, tolerance in (("albedo", 0.01), ("normal", 0.01), ("depth", 0.02)):
        assert np.abs(getattr(a, name) - getattr(b, name))[flat].max() < tolerance, name


def test_bytes_do_not_depend_on_threads(backend):
    scene = clutter()
    runs = [hashed(render_views(scene, 16, max_spp=8, seed=2, backend=backend, threads=threads)) for threads in (1, 2, 2)]
    assert runs[0] == runs[1] == runs[2]
    assert hashed(render_views(scene, 16, max_spp=8, seed=3, backend=backend)) != runs[0]


def test_bytes_do_not_depend_on_views_or_chunks(jit, monkeypatch):
    from stages.rendering import jit as module

    scene = clutter()
    whole = hashed(render_views(scene, 16, max_spp=8, seed=2, backend=jit, denoise=False))
    assert hashed(render_views(scene, 16, max_spp=8, seed=2, backend=jit, denoise=False, views=[1])) == whole[1:]
    monkeypatch.setattr(module, "CHUNK", 1000)  # 15 samples at most in flight per pixel
    assert hashed(render_views(scene, 16, max_spp=8, seed=2, backend=jit, denoise=False)) == whole


def test_denoiser_gives_the_same_bytes_for_any_thread_count():
    code = (
        "import hashlib, numpy as np; from stages.rendering.denoising import denoise; r = np.random.default_rng(0);"
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
    truth = render_views(scene, 32, max_spp=1024, seed=9, backend=backend, denoise=False)[0].image
    noisy, clean = (
        render_views(scene, 32, max_spp=8, seed=0, backend=backend, denoise=flag)[0].image for flag in (False, True)
    )

    def error(image):
        return np.abs(np.log10(1 + image) - np.log10(1 + truth)).mean()

    assert error(clean) < 0.6 * error(noisy)


def test_samples_are_spent_until_the_target_is_met(backend):
    scene, kept = clutter(), {"seed": 0, "backend": backend, "denoise": False}
    needs = [
        [view.meta for view in render_views(scene, 16, max_spp=256, target_error=target, **kept)]
        for target in (1.0, 0.02, 1e-9)
    ]
    for target, metas in zip((1.0, 0.02, 1e-9), needs, strict=True):
        for meta in metas:
            assert meta["error"] <= target or meta["spp"] == 256
    first, middle, last = ([meta["spp"] for meta in metas] for metas in needs)
    assert first == [16, 16] and last == [256, 256] and all(16 <= spp < 256 for spp in middle)
    capped = render_views(scene, 16, max_spp=24, target_error=1e-9, **kept)
    assert [view.meta["spp"] for view in capped] == [24, 24]


def test_samples_in_portions_are_the_same_samples(jit):
    scene, kept = clutter(), {"seed": 4, "backend": jit, "denoise": False, "max_spp": 64}
    whole, portions = (render_views(scene, 16, target_error=target, **kept) for target in (0, 1e-9))
    for a, b in zip(whole, portions, strict=True):
        for name in ("lights", "direct", "albedo", "normal", "depth", "coverage"):
            np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=1e-6, atol=1e-7)
        assert a.meta["nearest"] == b.meta["nearest"]


def test_raw_error_estimate_is_the_error(backend):
    scene, kept = clutter(cameras=1), {"backend": backend, "denoise": False}
    truth = render_views(scene, 32, max_spp=4096, seed=9, **kept)[0].image
    for spp in (16, 64):
        view = render_views(scene, 32, max_spp=spp, target_error=1e-9, seed=0, **kept)[0]
        assert view.meta["error"] == pytest.approx(log_error(view.image, truth), rel=0.2)
    assert render_views(scene, 16, max_spp=1, seed=0, **kept)[0].meta["error"] is None


def test_scale_changes_nothing(jit):
    """Emission is radiance: a scene twice as large, seen from twice as far, is the same picture."""
    scene, large = clutter(cameras=1), clutter(cameras=1)
    large.triangles = 2 * large.triangles
    large.camera_to_world = large.camera_to_world.copy()
    large.camera_to_world[:, :3, 3] *= 2
    a, b = (render_views(record, 16, max_spp=64, seed=0, backend=jit, denoise=False)[0] for record in (scene, large))
    assert np.allclose(a.image.mean(), b.image.mean(), rtol=0.01)
    assert np.allclose(2 * a.depth, b.depth, rtol=1e-4)


def test_cycles_mode_clamps_filters_and_limits(jit):
    from stages.rendering.jit import filter_offsets

    offsets = filter_offsets("blackman-harris")
    assert offsets[0] == -0.75 and offsets[-1] == 0.75 and np.allclose(offsets, -offsets[::-1], atol=1e-6)
    assert 0.18 < offsets.std() < 0.22  # the window's standard deviation, in pixels
    scene = clutter(cameras=1)
    kept = {"max_spp": 64, "seed": 0, "backend": jit, "denoise": False}
    physical, cycles = (render_views(scene, 16, mode=mode, **kept)[0] for mode in ("physical", "cycles"))
    assert np.allclose(physical.direct.mean(), cycles.direct.mean(), rtol=0.05)
    assert cycles.image.mean() < 1.02 * physical.image.mean()
    with pytest.raises(UserError, match="JIT"):
        render_views(scene, 8, max_spp=1, seed=0, backend=SCALAR, mode="cycles")


# --- against Cycles ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "spp", "tolerance"),
    [("init-template", 32, 0.01), ("cbox", 64, 0.015), ("shader-ball", 64, 0.015), ("veach-mis", 128, 0.1)],
)
def test_means_match_cycles(shared_data, jit, name, spp, tolerance):
    """Few samples, hence the tolerance; the caustics of veach-mis leave 1 % of noise in the mean at 1,024 samples."""
    from stages.released import load_scene

    scene = load_scene(shared_data / "scenes" / f"{name}.h5")
    reference = read_rgb(shared_data / "cycles" / f"{name}-physical-128.exr")
    image = render_views(scene, 128, max_spp=spp, seed=1, backend=jit, denoise=False, lights_visible=True)[0].image
    ratio = np.minimum(image, 4).mean(axis=(0, 1)) / np.minimum(reference, 4).mean(axis=(0, 1))
    assert np.allclose(ratio, 1, atol=tolerance), ratio


# --- the stage, the backend, the command ------------------------------------------------------------------------------


class Scenes:
    """Stands for the scene artifact."""

    def __init__(self, scenes):
        self.scenes = scenes

    def rows(self):
        return [SimpleNamespace(id=id, item=id, group="train") for id in self.scenes]

    def read(self, id):
        return self.scenes[id].to_record()


def test_stage_renders_drops_and_rejects(tmp_path):
    good = clutter(lights=2, cameras=3)
    good.camera_to_world = good.camera_to_world.copy()
    good.camera_to_world[1] = camera((0, -2, 0), (0, -4, 0))  # looks away
    good.camera_to_world[2] = camera((0, 0.495, 0.2), (0, 0.6, 0.2))  # at the wall
    dark = clutter(lights=2)
    dark.emission = dark.emission * 1e-6
    inputs = {"scene": Scenes({"good": good, "dark": dark})}
    stage, config = Render(), RenderConfig(resolution=16, max_spp=4)
    items = list(stage.items(config, inputs))
    assert items[0] == Item("good", "train", (("scene", "good"),))
    worker = stage.open(config, inputs, SCALAR)
    (record,) = stage.process(worker, items[0])
    assert sorted(record.members) == ["meta.json", "view0.aov.exr", "view0.exr"]
    views = unpack_json(record.members["meta.json"])["views"]
    assert [view["status"] for view in views] == ["ok", "dark", "too_close"]
    assert decode_view(record.members, 0).lights.shape == (2, 16, 16, 3)
    with pytest.raises(Reject) as caught:
        list(stage.process(worker, items[1]))
    assert caught.value.reason == "dark"

    notes = {}
    rows = inputs["scene"].rows()[:1]
    draft = SimpleNamespace(rows=lambda: rows, read=lambda id: record, files=tmp_path, note=notes.__setitem__)
    stage.finish(config, inputs, draft)
    assert notes["views"] == {"ok": 1, "dark": 1, "too_close": 1, "clamped_values": 0}
    assert (tmp_path / "contact-train.png").stat().st_size > 0


def test_an_interrupted_artifact_keeps_its_backend():
    stage = Render()
    assert stage.environment(RenderConfig(), SCALAR) == SCALAR
    with pytest.raises(UserError, match="begun with the backend llvm with /none"):
        stage.environment(RenderConfig(), {"backend": "llvm", "library": "/none/libLLVM.so"})


def test_without_a_jit_backend_the_scalar_one_is_taken_with_a_word(monkeypatch, caplog):
    monkeypatch.setattr(backends, "works", lambda candidate: candidate["backend"] == "scalar")
    assert backends.choose("auto") == SCALAR
    assert "libllvm19" in caplog.text
    with pytest.raises(UserError, match="backend=llvm does not work here"):
        backends.choose("llvm")
    with pytest.raises(UserError, match="unknown"):
        backends.choose("metal")


def test_trace_writes_one_file_per_view(tmp_path, shared_data, monkeypatch):
    from stages.trace import trace

    monkeypatch.setattr(backends, "choose", lambda choice: SCALAR)
    scene = shared_data / "scenes" / "init-template.json"
    assert trace(scene, tmp_path / "a.exr", resolution=8, spp=2, view="all") == [tmp_path / "a-0.exr"]
    assert read_rgb(tmp_path / "a-0.exr").shape == (8, 8, 3)
    for arguments, message in (
        ({"view": 3}, "1 camera"),
        ({"out_path": "a.jpg"}, "OUT.exr"),
        ({"spp": 0}, "at least 1"),
    ):
        with pytest.raises(UserError, match=message):
            trace(**{"scene_path": scene, "out_path": tmp_path / "b.exr", "resolution": 8, **arguments})
