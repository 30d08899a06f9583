"""The arithmetic of ``bench/render.py``: figures in the documents rest on it."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def bench():
    spec = importlib.util.spec_from_file_location("bench_render", ROOT / "bench" / "render.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


@pytest.mark.parametrize("share", [0.25, 0.5, 1.0])
def test_noise_of_the_truth_is_taken_out_of_an_error(bench, share):
    rng = np.random.default_rng(0)
    clean = rng.uniform(0.5, 1.5, (128, 128, 3))
    image = clean + rng.normal(0, 0.01, clean.shape)
    halves = clean + rng.normal(0, 0.01 * (2 * share) ** 0.5, (2, *clean.shape))  # variance of their mean: share 0.01^2
    truth = bench.Truth(64, halves, halves, clean)
    exact = bench.log_error(clean, image)
    assert bench.log_error(halves.mean(axis=0), image) > (1 + 0.4 * share) * exact
    assert truth.bound(image) == pytest.approx(exact, rel=0.11 * share + 0.01)
    assert truth.error(image) == pytest.approx(exact, rel=0.01)
    assert truth.raw_noise == pytest.approx(bench.log_error(clean, halves.mean(axis=0)), rel=0.03)


def test_crossing_is_interpolated_between_doublings(bench):
    points = [bench.Point(16, 1.0, 0.008), bench.Point(32, 3.0, 0.004), bench.Point(64, 4.0, 0.001)]
    assert bench.crossing(points, 0.01) == points[0]
    crossing = bench.crossing(points, 0.002)  # half way between 0.004 and 0.001 in logarithms
    assert crossing.spp == pytest.approx(32 * 2**0.5, abs=1)
    assert crossing.seconds == pytest.approx(12**0.5)
    assert crossing.error == 0.002
    assert bench.crossing(points, 0.0005) is None


def test_views_per_hour_count_the_start_up(bench):
    images = [bench.Image("16", seconds, 0.002, 0.002, 1.0) for seconds in (4.0, 6.0)]
    assert bench.Production(20.0, images).per_hour == pytest.approx(240)


def test_bad_options_are_refused(bench, capsys):
    for words in (["--targets", "0.002,fast"], ["--views", "0"], ["--cycles-python", "no-such-interpreter"]):
        with pytest.raises(SystemExit):
            bench.parsed(words)
        assert words[0] in capsys.readouterr().err
