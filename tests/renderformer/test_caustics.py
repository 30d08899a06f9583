"""Light paths: the same light as camera paths bring, with less noise, in the same bytes on every run."""

from __future__ import annotations

import hashlib
import importlib.util
from pathlib import Path

import numpy as np
import pytest

from stages.graphics.mitsuba import backend as backends
from stages.renderformer.rendering.error import Judge
from stages.renderformer.views import encode_view
from tests.renderformer.fakes import path_traced, with_textures
from tests.renderformer.test_rendering import build, camera, caustic, jit, quad  # noqa: F401 (a fixture)

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def views():
    """The module of the bench's six views."""
    spec = importlib.util.spec_from_file_location("bench_caustics", ROOT / "bench" / "caustics.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def renderer(scene, size=16, light_paths=True, **limits):
    from stages.renderformer.rendering.jit import JitRenderer, Limits

    return JitRenderer(scene, (size, size), 4, Limits(**{"bounces": 8, **limits}), False, light_paths=light_paths)


def image(renderer, spp, stream=0, first=0):
    """(L, H, W, 3) light of all paths."""
    ((sums,),) = renderer.sample([0], [stream], first, spp)
    if renderer.light_paths:
        renderer.add_caustics([sums], [0], stream, [(first * renderer.pixels, (first + spp) * renderer.pixels)])
    return sums.lights / sums.spp + sums.caustics / max(sums.paths, 1)


def mirrors(roughness=0.28, lamp=0.3):
    """A floor and two metal walls: light of all kinds of paths. Normals lean, as those of smooth shapes do.

    ``lamp``: length of the lamps' legs.
    """
    surfaces = [
        (quad((0, 0, -0.5), (0.6, 0, 0), (0, 0.6, 0)), (0.7, 0.5, 0.3), 0.2, 0.7),
        (quad((0, 0.6, 0.1), (0.6, 0, 0), (0, 0, 0.6)), 0.1, 0.8, roughness),
        (quad((-0.6, 0, 0.1), (0, 0.6, 0), (0, 0, 0.6)), (0.0, 0.1, 0.2), 0.7, roughness),
    ]
    lamps = [np.array([[[x, -0.6, 1.4], [x + lamp, -0.6, 1.4], [x, lamp - 0.6, 1.4]]]) for x in (-0.2, 0.3)]
    scene = build(surfaces, [(lamps[0], (60, 50, 40)), (lamps[1], 30)], [camera((0.7, -2, 0.8), (0, 0, -0.2))])
    lean = scene.vertex_normals + np.float32([0.1, -0.15, 0.1])
    scene.vertex_normals = lean / np.linalg.norm(lean, axis=2, keepdims=True)
    return scene


@pytest.mark.parametrize(("name", "bounces"), [("plain", 8), ("plain", 2), ("textured", 3)])
def test_light_paths_bring_the_light_that_camera_paths_leave_out(jit, monkeypatch, name, bounces):  # noqa: F811
    """Means by light and channel, and pixel by pixel, against camera paths alone; all that is narrow is so wide here, and
    lamps so large, that chance finds them too."""
    from stages.renderformer.rendering import caustics, material

    backends.activate(jit)
    for module in (caustics, material):
        monkeypatch.setattr(module, "NARROW_ALPHA", 0.3)
    scene = mirrors(0.52, 0.9)
    scene = with_textures(scene, 3) if name == "textured" else scene
    one, other = (renderer(scene, light_paths=flag, bounces=bounces) for flag in (False, True))
    assert other.light_paths and not one.light_paths
    ((alone,),) = other.sample([0], [0], 0, 64)  # without what is joined
    truth, joined = image(one, 2048), image(other, 1024)
    assert (alone.lights / 64).mean() < 0.95 * truth.mean()
    np.testing.assert_allclose(joined.mean(axis=(1, 2)), truth.mean(axis=(1, 2)), rtol=5e-3)
    assert np.abs(joined - truth).mean() < 0.03 * truth.mean()  # noise; a pixel aside it would be several times that


def test_light_paths_have_less_noise(jit, views):  # noqa: F811
    backends.activate(jit)
    scene = views.scene("cylinder")
    noise = {}
    for flag in (False, True):
        one = renderer(scene, size=32, light_paths=flag, bounces=33)
        a, b = (np.log10(1 + image(one, 16, stream).sum(axis=0)) for stream in (0, 1))
        noise[flag] = np.sqrt(((a - b) ** 2).mean())
    assert noise[True] < 0.4 * noise[False]


def two_views():
    """`mirrors`, seen by two cameras."""
    scene = mirrors()
    scene.camera_to_world = np.repeat(scene.camera_to_world, 2, axis=0)
    scene.camera_to_world[1, :3, 3] += (0.2, 0, 0.1)
    scene.fov_deg = np.repeat(scene.fov_deg, 2)
    return scene


def hashed(views):
    return [hashlib.sha256(b"".join(encode_view(view).values())).hexdigest() for view in views]


def test_bytes_depend_neither_on_threads_nor_on_chunks_or_views(jit, monkeypatch):  # noqa: F811
    from stages.renderformer.rendering import caustics as module

    scene = two_views()
    kept = {"max_spp": 48, "target_error": 1e-9, "seed": 2, "backend": jit, "denoise": False}
    whole = hashed(path_traced(scene, 16, threads=1, **kept))
    assert hashed(path_traced(scene, 16, threads=2, **kept)) == whole
    assert hashed(path_traced(scene, 16, views=[1], **kept)) == whole[1:]
    monkeypatch.setattr(module, "CHUNK", 700)
    monkeypatch.setattr(module, "LANE", 5)
    assert hashed(path_traced(scene, 16, **kept)) == whole
    assert hashed(path_traced(scene, 16, **{**kept, "seed": 3})) != whole


def test_light_paths_serve_where_they_can(jit):  # noqa: F811
    """Not for rough surfaces, without lamps, by direct light alone or where indirect light is clamped."""
    from stages.renderformer.rendering.render import _renderer
    from stages.renderformer.rendering.settings import RenderSettings

    backends.activate(jit)
    assert renderer(mirrors()).light_paths
    assert not renderer(caustic()).light_paths
    assert not renderer(mirrors(), bounces=1).light_paths
    dark = mirrors()
    dark.light_index[:], dark.emission[:] = -1, 0
    assert not renderer(dark).light_paths
    for mode in ("physical", "cycles"):
        assert bool(_renderer(mirrors(), RenderSettings(8, 16, mode=mode), jit).light_paths) == (mode == "physical")


def test_hidden_lamps_hide_no_caustics(jit):  # noqa: F811
    """A lamp between camera and floor: cameras see through it, or see it."""
    scene = mirrors()
    lamp = np.float32([[[0.2, -1.2, -0.2], [0.7, -1.2, 0.2], [0.2, -1.1, 0.8]]])
    for name, value in {"triangles": lamp, "emission": [[1e-3] * 3], "light_index": [2]}.items():
        before = getattr(scene, name)
        setattr(scene, name, np.concatenate([before, np.asarray(value, before.dtype)]))
    for name in ("vertex_normals", "diffuse", "specular", "roughness", "object_index"):
        setattr(scene, name, np.concatenate([getattr(scene, name), getattr(scene, name)[-1:]]))
    kept = {"max_spp": 256, "seed": 0, "backend": jit, "denoise": False}
    hidden, seen = (path_traced(scene, 16, lights_visible=flag, **kept)[0] for flag in (False, True))
    behind = seen.lights[2] > 5e-4  # on the lamp
    assert behind.any() and (hidden.lights[0][behind] > 0).mean() > 0.5
    assert np.abs(seen.lights[:2][:, (seen.lights[2] == 1e-3).all(axis=-1)]).max(initial=0) < 1e-6


def test_light_paths_are_allotted_by_their_noise():
    from stages.renderformer.rendering.allotment import RANGE, Allotment
    from stages.renderformer.rendering.sums import Sums

    rng = np.random.default_rng(0)

    def half(light):
        lights, caustics = (1 + noise * rng.normal(size=(2, 16, 16, 3)) for noise in (0.1, light))
        return Sums(8, 8 * lights, *[np.zeros(1)] * 7, caustics=512 * caustics, paths=512)

    ratios = []
    for noise in (0.0, 0.1, 0.2, 9.0):
        allotment = Allotment((16, 16))
        assert allotment.window(8) == (0, 512)  # a quarter of the camera paths
        allotment.weigh(half(noise), half(noise))
        ratios.append(allotment.ratio)
        first, last = allotment.window(16)
        assert first == 512 and last == max(512, round(allotment.ratio * 256 * 16))
    assert ratios[0] == RANGE[0] and ratios[1] == pytest.approx(0.5, rel=0.2)
    assert ratios[2] == pytest.approx(2 * ratios[1], rel=0.2) and ratios[3] == RANGE[1]


def test_estimates_that_fall_too_slowly_stop_a_view():
    def judged(errors, most=4096):
        judge = Judge(0.002, True)
        stalls = []
        for number, error in enumerate(errors):
            judge.told.append((32 << number, error))
            stalls.append(judge.stalled(32 << number, most))
        return stalls

    assert judged([0.02, 0.019, 0.018, 0.017]) == [False, False, True, True]
    assert not any(judged([0.02, 0.014, 0.01, 0.007, 0.005]))  # as samples pay for
    assert not any(judged([0.0022, 0.0021, 0.00205]))  # slowly, but it gets there
    assert not any(Judge(0.002, True).stalled(samples, 64) for samples in (16, 64))  # nothing told
