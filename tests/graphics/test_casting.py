"""Rays against a mesh: first hits and free segments, as a loop over triangles finds them."""

from __future__ import annotations

import numpy as np
import pytest

from stages.graphics.casting import Caster

RAYS = 400


@pytest.fixture(scope="module")
def soup() -> np.ndarray:
    """(40, 3, 3): small triangles everywhere, far from the origin of single precision."""
    rng = np.random.default_rng(0)
    return 100 + rng.uniform(-1, 1, (40, 1, 3)) + rng.uniform(-0.9, 0.9, (40, 3, 3))


@pytest.fixture(scope="module")
def rays() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    ways = rng.normal(size=(RAYS, 3))
    return 100 + rng.uniform(-1.5, 1.5, (RAYS, 3)), ways / np.linalg.norm(ways, axis=1, keepdims=True)


def caster(corners: np.ndarray) -> Caster:
    return Caster(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))


def brute_force(corners: np.ndarray, origins: np.ndarray, ways: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangle (N,), -1 for none, and distance (N,): every ray's plane equation solved for every triangle."""
    first, distance = np.full(len(ways), -1), np.full(len(ways), np.inf)
    for index, (a, b, c) in enumerate(corners):
        for ray, (origin, way) in enumerate(zip(origins, ways, strict=True)):
            t, u, v = np.linalg.solve(np.stack([-way, b - a, c - a], axis=1), origin - a)
            if t > 0 and u >= 0 and v >= 0 and u + v <= 1 and t < distance[ray]:
                first[ray], distance[ray] = index, t
    return first, distance


def test_first_hits_are_those_of_a_loop_over_triangles(soup, rays):
    face, weights, distance = caster(soup).cast(*rays)
    expected, nearest = brute_force(soup, *rays)
    assert (expected >= 0).sum() > 50 and np.array_equal(face, expected)
    hit = face >= 0
    np.testing.assert_allclose(distance[hit], nearest[hit], rtol=1e-5)
    shares = np.concatenate([1 - weights[hit].sum(axis=1, keepdims=True), weights[hit]], axis=1)
    points = np.einsum("nk,nkc->nc", shares, soup[face[hit]])
    np.testing.assert_allclose(points, rays[0][hit] + nearest[hit, None] * rays[1][hit], atol=1e-4)


def test_a_segment_is_occluded_where_its_first_hit_is_nearer_than_its_end(soup, rays):
    _, nearest = brute_force(soup, *rays)
    lengths = np.random.default_rng(2).uniform(0.05, 1.5, RAYS)
    clear = np.abs(lengths - nearest) > 1e-3
    occluded = caster(soup).occluded(*rays, lengths)
    assert 10 < occluded.sum() < RAYS and np.array_equal(occluded[clear], (nearest < lengths)[clear])


def test_nothing_occludes_in_an_empty_scene(rays):
    empty = Caster(np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros(3))
    assert not empty.occluded(*rays, np.ones(RAYS)).any() and (empty.cast(*rays)[0] == -1).all()
