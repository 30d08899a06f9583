"""Guided first directions: less noise, the same mean, whatever was learned."""

from __future__ import annotations

import numpy as np
import pytest

from stages.graphics.mitsuba import backend as backends
from stages.renderformer.rendering.primary import BINS, CELL, CELLS, FLOOR, SIDE, UNIT, PrimaryGuide
from tests.renderformer.test_caustics import mirrors
from tests.renderformer.test_rendering import jit  # noqa: F401 (a fixture)


@pytest.fixture(autouse=True)
def active(jit):  # noqa: F811
    backends.activate(jit, 2)


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def lobes(roughness, specular, diffuse):
    import mitsuba as mi

    from stages.renderformer.rendering.material import Lobes

    return Lobes(mi.Color3f(diffuse), mi.Color3f(specular), mi.Float(roughness**2))


def leave(guide, of, first, chain, cell=0, number=1 << 16):
    """Many paths that leave a surface: (specular, numbers (2, N), chance, bin)."""
    import drjit as dr
    import mitsuba as mi

    rng = np.random.default_rng(5)
    pick, u = mi.Float(rng.random(number)), mi.Point2f(rng.random((2, number)))
    specular, drawn, chance, step = guide.leave(mi.UInt32(cell), of, pick, u, mi.Bool(first), mi.Bool(chain))
    dr.eval(specular, drawn, chance, step)
    return np.asarray(specular), drawn.numpy(), np.resize(chance.numpy(), number), step.bin.numpy(), np.asarray(u)


def taught(rng, size=(16, 24), views=2):
    import drjit as dr
    import mitsuba as mi

    guide = PrimaryGuide(views, size)
    amounts = rng.exponential(size=dr.width(guide.squares)) ** 8
    guide.squares = mi.UInt64((amounts / UNIT).astype(np.uint64))
    guide.learn(range(views))
    return guide


def test_nothing_learned_changes_nothing():
    specular, drawn, chance, _, u = leave(PrimaryGuide(1, (16, 16)), lobes(0.5, 0.3, 0.1), True, True)
    np.testing.assert_allclose(drawn, u, atol=1e-6)
    np.testing.assert_allclose(chance, 1, rtol=1e-5)
    assert specular.mean() == pytest.approx(0.75, abs=0.01)


def test_densities_are_those_of_what_is_drawn(rng):
    guide = taught(rng)
    of = lobes(0.25, 0.3, 0.2)
    specular, drawn, chance, place, _ = leave(guide, of, True, True, cell=7)
    assert (drawn >= 0).all() and (drawn < 1).all()
    column, row = np.minimum(drawn * SIDE, SIDE - 1).astype(int)
    assert (place == (7 * 2 + specular) * BINS + column * SIDE + row).mean() > 0.999  # but for rounding at edges
    assert np.ptp(chance) > 1  # something was learned
    fine = 4 * SIDE  # so that spots within a bin count, too
    for lobe, usual in ((True, 0.6), (False, 0.4)):  # by one over its density, each spot counts as if nothing was learned
        x, y = (drawn[:, specular == lobe] * fine).astype(int)
        weight = 1 / chance[specular == lobe]
        sums, squares = (np.bincount(x * fine + y, weight**power, minlength=fine**2) for power in (1, 2))
        expected = len(place) * usual / fine**2
        assert (np.abs(sums - expected) <= 5 * np.sqrt(squares) + 1e-9).all()
        assert np.abs(sums.mean() - expected) < 0.02 * expected
    assert (1 / chance).max() < 1.01 / (FLOOR * FLOOR / (2 - FLOOR))  # no path is left out


@pytest.mark.parametrize(("specular", "diffuse"), [(0.5, 0.0), (0.0, 0.5)])
def test_one_lobe_is_taken_always(rng, specular, diffuse):
    guide = taught(rng)
    for first in (True, False):
        taken, _, chance, _, _ = leave(guide, lobes(0.2, specular, diffuse), first, True, cell=9)
        assert (taken == (specular > 0)).all() and (first or (chance == 1).all())


def test_pixels_belong_to_cells():
    import mitsuba as mi

    from stages.renderformer.rendering.jit import Cameras

    height, width, views = 1000, 600, 2
    guide, cameras = PrimaryGuide(views, (height, width)), Cameras(mirrors(), (height, width), "box")
    view, row, column = np.meshgrid(*map(np.arange, (views, height, width)), indexing="ij")
    side = -(-height // CELLS)
    rows, columns = guide.shape[1:]
    expected = (view * rows + row // side) * columns + column // side
    assert (guide.cell(*cameras.place(mi.UInt32(np.arange(expected.size)))).numpy() == expected.ravel()).all()
    assert expected.max() + 1 == np.prod(guide.shape)


def test_later_surfaces_prefer_narrow_lobes_in_chains_alone(rng):
    guide = taught(rng)
    for roughness, chain, share in ((0.2, True, 0.5), (0.2, False, 0.25), (0.5, True, 0.25)):
        specular, drawn, chance, _, u = leave(guide, lobes(roughness, 0.1, 0.3), False, chain)
        assert specular.mean() == pytest.approx(share, abs=0.01) and (drawn == u).all()
        np.testing.assert_allclose(chance, np.where(specular, share / 0.25, (1 - share) / 0.75), rtol=1e-5)


def test_views_learn_for_themselves(rng):
    guide = taught(rng)
    before = guide._edges.copy().reshape(2, -1)
    guide.squares = guide.squares * 0 + 5
    guide.learn([1])
    after = guide._edges.reshape(2, -1)
    assert (after[0] == before[0]).all() and (after[1] != before[1]).any()
    even = np.linspace(0, 1, SIDE + 1, dtype=np.float32)
    np.testing.assert_allclose(after[1].reshape(-1, SIDE + 1), np.tile(even, (after[1].size // (SIDE + 1), 1)), rtol=1e-6)


@pytest.mark.parametrize(("size", "cells"), [((32, 48), (8, 12)), ((256, 256), (64, 64)), ((1000, 600), (63, 38))])
def test_memory_is_bounded(size, cells):
    assert PrimaryGuide(1, size).shape == (1, *cells)
    assert max(cells) <= CELLS and size[0] / cells[0] >= CELL - 1e-9


def test_less_noise_and_the_same_mean():
    """A lamp's highlight on metal, seen in metal: light by light."""
    from stages.renderformer.rendering.jit import JitRenderer, Limits

    scene, size, spp = mirrors(roughness=0.31, lamp=0.1), 32, 64
    images = {}
    for way in ("plain", "untaught", "taught"):
        runs = []
        for seed in range(40):
            primary = way != "plain"
            renderer = JitRenderer(scene, (size, size), seed, Limits(8), False, light_paths=True, primary=primary)
            renderer.sample([0], [0, 1], 0, 64)
            if way == "taught":
                renderer.learn([0])
            ((sums,), _) = renderer.sample([0], [0, 1], 64, spp)
            runs.append(sums.lights.astype(np.float64) / spp)
        images[way] = np.stack(runs)
    means = {way: runs.mean(axis=(2, 3)) for way, runs in images.items()}  # (runs, lights, channels)
    for way in ("untaught", "taught"):
        spread = np.sqrt(sum(means[each].var(axis=0, ddof=1) / len(means[each]) for each in ("plain", way)))
        gap = np.abs(means[way].mean(axis=0) - means["plain"].mean(axis=0))
        assert (gap <= 4 * spread).all() and (gap < 0.005 * means["plain"].mean(axis=0)).all()
    noise = {way: runs.var(axis=0, ddof=1).mean() for way, runs in images.items()}
    assert noise["taught"] < 0.8 * noise["untaught"] and noise["untaught"] < 1.1 * noise["plain"]
