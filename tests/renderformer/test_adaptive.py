"""Adaptive sampling: samples go where they pay, are the same samples, and leave the mean alone."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.keys import canonical
from stages.graphics.mitsuba import backend as backends
from stages.renderformer.rendering.adaptive import AIM, CELL, CELL_GROWTH, LEAST, MULTIPLE, next_counts
from stages.renderformer.rendering.error import ThriftyJudge
from stages.renderformer.s04_render import Render, RenderConfig
from tests.renderformer.fakes import path_traced
from tests.renderformer.test_caustics import hashed, mirrors, renderer, two_views, views  # noqa: F401 (a fixture)
from tests.renderformer.test_rendering import caustic, jit  # noqa: F401 (a fixture)


def test_samples_follow_the_noise():
    counts = np.full((40, 36), 16)  # the last cells are cut
    even = next_counts(counts, np.full(counts.shape, 0.01), 1e-6, 4096)
    assert (even == 32).all()  # all the same: everything twice
    error = np.full(counts.shape, 1e-4)
    error[2 * CELL : 3 * CELL, 2 * CELL : 3 * CELL] = 0.1
    after = next_counts(counts, error, 1e-6, 4096)
    cells = after[::CELL, ::CELL]
    assert (np.kron(cells, np.ones((CELL, CELL), int))[:40, :36] == after).all()
    assert (cells[1:4, 1:4] == cells[2, 2]).all() and 3 * 16 < cells[2, 2] <= CELL_GROWTH * 16  # its neighbours, too
    assert cells[0, 0] == cells[4, 4] == 16  # not the rest
    middle = (2 * CELL, 2 * CELL)
    more = next_counts(after, error, 1e-6, 4096)
    assert more[middle] > 1.5 * after[middle] and (more >= after).all() and (more % MULTIPLE == 0).all()
    while (more := next_counts(more, error, 1e-6, 512))[middle] < 512:
        assert more.max() <= more.min() / LEAST + MULTIPLE
    assert more.min() >= 512 * LEAST  # none is left far behind
    assert (next_counts(np.full((8, 8), 512), np.ones((8, 8)), 1e-6, 512) == 512).all()
    assert (next_counts(counts, np.zeros(counts.shape), 1e-6, 512) == counts).all()


def test_no_more_samples_than_the_target_asks_for():
    rng = np.random.default_rng(0)
    noise = np.kron(np.exp(rng.normal(0, 1, (8, 8))), np.ones((CELL, CELL))) * 0.02
    counts, target = np.full(noise.shape, 64), (noise / 8).mean() / 1.15
    after = next_counts(counts, noise / 8, target, 4096)
    assert 0.8 * target < (noise / np.sqrt(after)).mean() < target
    assert 64 < after.mean() < 64 * (1.15 / AIM) ** 2  # fewer than would do everywhere alike


@pytest.mark.parametrize("scene", [mirrors, caustic])
def test_the_samples_are_those_of_all_pixels(jit, scene):  # noqa: F811
    """The same counts everywhere bring the same sums; other counts the sums of those samples, pixel by pixel."""
    backends.activate(jit)
    one = renderer(scene(), size=12, light_paths=False)
    low, high = np.full((12, 12), 8), np.full((12, 12), 40)
    whole = [one.sample([0], [0, 1], first, 16)[1][0] for first in (8, 24)]
    whole = whole[0] + whole[1]
    uneven = one.more(0, [0, 1], low, high, 8)[1]
    for name in ("lights", "direct", "albedo", "normal", "distance", "hits"):
        np.testing.assert_allclose(getattr(uneven, name), getattr(whole, name), rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(uneven.nearest, whole.nearest)
    assert (uneven.spp == 32).all() and (uneven.triangle == -1).all()
    high[:, 5:] = 24
    high[3:5] = 8
    part = one.more(0, [0, 1], low, high, 8)[1]
    np.testing.assert_allclose(part.lights[:, :3, :5], whole.lights[:, :3, :5], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(part.lights[:, :3, 5:], one.sample([0], [0, 1], 8, 16)[1][0].lights[:, :3, 5:], rtol=1e-5)
    assert not part.lights[:, 3:5].any() and np.isinf(part.nearest[3:5]).all() and not part.spp[3:5].any()


def test_bytes_depend_on_neither_threads_chunks_nor_other_views(jit, monkeypatch):  # noqa: F811
    from stages.renderformer.rendering import caustics
    from stages.renderformer.rendering import jit as module

    scene = two_views()
    kept = {"max_spp": 128, "target_error": 1e-9, "seed": 2, "backend": jit, "denoise": False, "adaptive": True}
    whole = hashed(path_traced(scene, 24, threads=1, **kept))
    assert hashed(path_traced(scene, 24, threads=2, **kept)) == whole
    assert hashed(path_traced(scene, 24, views=[1], **kept)) == whole[1:]
    monkeypatch.setattr(module, "CHUNK", 700)
    monkeypatch.setattr(caustics, "LANE", 5)
    assert hashed(path_traced(scene, 24, **kept)) == whole
    assert hashed(path_traced(scene, 24, **{**kept, "adaptive": False})) != whole


@pytest.mark.parametrize(("scene", "target"), [(mirrors, 0.0025), (caustic, 0.0025)])
def test_the_mean_is_that_of_even_samples(jit, monkeypatch, scene, target):  # noqa: F811
    """With light paths and with guiding: light by light within what the noise of so many runs leaves."""
    from stages.renderformer.rendering import render

    counts = []
    monkeypatch.setattr(render, "next_counts", lambda *given: counts.append(next_counts(*given)) or counts[-1])
    means = {}
    for adaptive in (False, True):
        kept = {"max_spp": 256, "target_error": target, "backend": jit, "denoise": False, "adaptive": adaptive}
        runs = [path_traced(scene(), 32, seed=seed, **kept)[0] for seed in range(12)]
        means[adaptive] = np.stack([view.lights.astype(np.float64).mean(axis=(1, 2, 3)) for view in runs])
    assert any(of_view.max() > of_view.min() for of_view in counts)
    spread = np.sqrt(sum(values.var(axis=0, ddof=1) / len(values) for values in means.values()))
    gap = np.abs(means[True].mean(axis=0) - means[False].mean(axis=0))
    assert (gap <= 4 * spread).all() and (spread < 0.01 * means[False].mean(axis=0)).all()


def test_the_denoisers_large_network_has_to_be_cheaper_than_samples(monkeypatch):
    from stages.renderformer.rendering import error as module

    told = iter([0.0024, 0.0023, 0.0021, 0.0019])
    monkeypatch.setattr(module, "denoised_error", lambda *given: (next(told), np.ones((2, 2))))
    many = ThriftyJudge(0.002, True, images=30, most=4096)
    assert [many.error(samples, None, None, None)[0] for samples in (16, 24, 32, 40)] == ["fast"] * 4
    told = iter([0.0026, 0.0024])
    few = ThriftyJudge(0.002, True, images=2, most=4096)
    assert few.error(16, None, None, None) == ("high", pytest.approx(0.00208))  # and more samples
    assert few.error(64, None, None, None) == ("high", pytest.approx(0.00192)) and few.shares[0, 0] == pytest.approx(0.8)
    told = iter([0.0024])
    assert ThriftyJudge(0.002, True, images=30, most=20).error(16, None, None, None)[0] == "high"  # no samples left


def test_a_view_stops_at_its_target_with_fewer_samples(jit, views):  # noqa: F811
    kept = {"max_spp": 1024, "target_error": 0.003, "seed": 1, "backend": jit, "denoise": False}
    even, uneven = (path_traced(views.scene("sphere"), 64, adaptive=flag, **kept)[0] for flag in (False, True))
    assert uneven.meta["error"] <= 0.003 and uneven.meta["spp"] < even.meta["spp"]
    assert uneven.meta["dropped"] == 0 and not uneven.meta["stalled"]


def test_keys_know_of_it_where_it_is_on():
    assert "adaptive" not in canonical(RenderConfig()) and canonical(RenderConfig(adaptive=True))["adaptive"] is True
    assert not Render().identity(RenderConfig(), None) and Render().identity(RenderConfig(adaptive=True), None) == {
        "adaptive": 2
    }
