"""Metrics agree with the packages that define them, and with slow formulas where those are short."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.errors import UserError
from stages.graphics.lpips_setting import lpips_networks, parse_lpips
from stages.graphics.metrics import (
    METRICS,
    PSNR_MAX,
    check_pair,
    flip,
    flip_map,
    log_error,
    measure_all,
    named,
    psnr,
    ssim,
    with_lpips,
)
from stages.graphics.tonemap import (
    clamp,
    exposure_for,
    from_picture,
    log_decode,
    log_encode,
    srgb_decode,
    srgb_encode,
    to_picture,
    tone_map,
    tone_unmap,
)


def hdr_pair(seed: int, shape: tuple[int, int], scale: float) -> tuple[np.ndarray, np.ndarray]:
    """A random HDR image of about this brightness, and a distorted copy with some values below 0."""
    rng = np.random.default_rng(seed)
    reference = (rng.gamma(0.5, 2 * scale, (*shape, 3)) * np.exp(rng.normal(0, 1, (*shape, 1)))).astype(np.float32)
    test = reference * rng.uniform(0.5, 1.5, reference.shape) + rng.normal(0, 0.03 * scale, reference.shape)
    return reference, test.astype(np.float32)


# dark, everyday, far above white; square, wide, tall, as small as SSIM allows
PAIRS = [(1, (32, 32), 0.02), (2, (48, 20), 0.5), (3, (20, 48), 3.0), (4, (11, 11), 40.0), (5, (64, 64), 800.0)]


@pytest.mark.parametrize(("seed", "shape", "scale"), PAIRS)
def test_metrics_agree_with_the_reference_packages_on_random_hdr_images(seed, shape, scale):
    import flip_evaluator
    from skimage.metrics import peak_signal_noise_ratio, structural_similarity

    reference, test = hdr_pair(seed, shape, scale)
    scores = measure_all(reference, test)
    linear = [np.clip(image.astype(np.float64), 0, 1) for image in (reference, test)]
    mapped = [np.clip(np.log2(1 + np.maximum(image.astype(np.float64), 0)), 0, 1) for image in (reference, test)]
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1, "channel_axis": 2}
    for suffix, (a, b) in (("", linear), ("_tm", mapped)):
        assert scores[f"psnr{suffix}"] == pytest.approx(peak_signal_noise_ratio(a, b, data_range=1), abs=1e-4)
        assert scores[f"ssim{suffix}"] == pytest.approx(structural_similarity(a, b, **options), abs=1e-4)
        assert scores[f"ssim{suffix}"] == pytest.approx(slow_ssim(a, b), abs=1e-4)
    _, mean, _ = flip_evaluator.evaluate(reference, np.maximum(test, 0), "HDR", applyMagma=False, parameters={})
    assert scores["flip"] == pytest.approx(mean, abs=1e-4)


@pytest.mark.parametrize("network", ["vgg", "alex"])
def test_lpips_agrees_with_its_definition_on_tone_mapped_values(network, tmp_path):
    from tests.model.lpips import distance, write_weights

    write_weights(tmp_path, network)
    reference, test = hdr_pair(7, (36, 40), 0.5)
    metric = with_lpips([network], str(tmp_path))[f"lpips_{network}"]
    mapped = [np.clip(np.log2(1 + np.maximum(x.astype(np.float64), 0)), 0, 1).transpose(2, 0, 1) for x in (reference, test)]
    expected = distance(tmp_path, network, *mapped)
    assert expected > 0.01
    assert metric.measure(reference, test) == pytest.approx(expected, abs=1e-4)


def test_metrics_are_known_by_name_without_their_weights():
    assert list(named(["lpips_vgg", "flip", "psnr"])) == ["psnr", "flip", "lpips_vgg"]
    assert named(["lpips_vgg"])["lpips_vgg"].format(0.12345) == "0.1235"


@pytest.fixture
def pair() -> tuple[np.ndarray, np.ndarray]:
    """A random HDR image, many values above 1, and a distorted copy with some values below 0."""
    rng = np.random.default_rng(1)
    reference = rng.gamma(0.7, 1.0, (40, 48, 3)).astype(np.float32)
    return reference, (reference * rng.uniform(0.6, 1.4, reference.shape) - 0.02).astype(np.float32)


def slow_ssim(a: np.ndarray, b: np.ndarray) -> float:
    """SSIM by its definition: an explicit 11x11 Gaussian window at each pixel where it fits, data range 1."""
    line = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    window = np.outer(line, line)[..., None] / line.sum() ** 2
    values = []
    for y in range(5, a.shape[0] - 5):
        for x in range(5, a.shape[1] - 5):
            p, q = (image[y - 5 : y + 6, x - 5 : x + 6].astype(np.float64) for image in (a, b))
            mean_p, mean_q = (window * p).sum((0, 1)), (window * q).sum((0, 1))
            var_p, var_q = (window * p * p).sum((0, 1)) - mean_p**2, (window * q * q).sum((0, 1)) - mean_q**2
            cov = (window * p * q).sum((0, 1)) - mean_p * mean_q
            top = (2 * mean_p * mean_q + 0.01**2) * (2 * cov + 0.03**2)
            values.append(top / ((mean_p**2 + mean_q**2 + 0.01**2) * (var_p + var_q + 0.03**2)))
    return float(np.mean(values))


def test_ssim_is_the_gaussian_one_with_data_range_1(pair):
    from skimage.metrics import structural_similarity

    a, b = map(clamp, pair)
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1}
    assert ssim(a, b) == pytest.approx(structural_similarity(a, b, channel_axis=2, **options), abs=1e-4)
    assert ssim(a, b) == pytest.approx(slow_ssim(a, b), abs=1e-4)


def test_psnr_clamps_and_agrees_with_skimage(pair):
    from skimage.metrics import peak_signal_noise_ratio

    scores = measure_all(*pair)
    a, b = (clamp(image).astype(np.float64) for image in pair)
    assert scores["psnr"] == pytest.approx(peak_signal_noise_ratio(a, b, data_range=1), abs=1e-4)
    # What lies above 1 in both images is white in both: brighter highlights change nothing.
    brighter = [np.where(image > 1, image * 7, image) for image in pair]
    assert measure_all(*brighter)["psnr"] == scores["psnr"]
    assert measure_all(*brighter)["log_error"] > scores["log_error"]


def test_tone_mapped_metrics_use_log2_of_1_plus_x(pair):
    a, b = (np.clip(np.log2(1 + np.maximum(image.astype(np.float64), 0)), 0, 1) for image in pair)
    scores = measure_all(*pair)
    assert scores["psnr_tm"] == pytest.approx(psnr(a, b), abs=1e-4)
    assert scores["ssim_tm"] == pytest.approx(ssim(a, b), abs=1e-4)


def test_log_error():
    zeros, nines = np.zeros((12, 12, 3)), np.full((12, 12, 3), 9.0)
    assert log_error(zeros, nines) == pytest.approx(1.0)
    assert log_error(zeros, -nines) == 0  # radiance below 0 is black, not NaN


def test_flip_is_nvidias_on_unclamped_values(pair, capfd):
    import flip_evaluator

    a, b = (np.maximum(image, 0) for image in pair)
    error, mean, _ = flip_evaluator.evaluate(a, b, "HDR", applyMagma=False, parameters={})
    capfd.readouterr()
    assert flip(*pair) == pytest.approx(mean, abs=1e-4)
    assert np.array_equal(flip_map(*pair), error[..., 0])
    assert np.array_equal(flip_map(*pair), flip_map(*pair))
    assert capfd.readouterr().out == ""  # a command that prints JSON must not print anything else


def test_flip_of_a_black_reference_does_not_end_the_process():
    black, grey = np.zeros((16, 16, 3), np.float32), np.full((16, 16, 3), 0.1, np.float32)
    assert flip(black, black) == 0
    assert 0.1 < flip(black, grey) <= 1


def test_flip_takes_views_and_other_dtypes(pair):
    a, b = (image.astype(np.float64)[::-1].transpose(1, 0, 2) for image in pair)
    copies = [np.ascontiguousarray(image, dtype=np.float32) for image in (a, b)]
    assert flip(a, b) == flip(*copies)


def test_equal_images_score_perfectly_and_finitely(pair):
    scores = measure_all(pair[0], pair[0])
    assert scores == {"psnr": PSNR_MAX, "ssim": 1, "psnr_tm": PSNR_MAX, "ssim_tm": 1, "log_error": 0, "flip": 0}


def test_better_images_score_better(pair):
    a, b = pair
    worse, near = measure_all(a, b), measure_all(a, 0.9 * a + 0.1 * b)
    for name, metric in METRICS.items():
        assert (near[name] > worse[name]) is metric.higher_is_better, name


def test_bad_pairs_are_refused_with_what_is_wrong(pair):
    a, b = pair
    for other, message in ((b[:, :40], "40x48x3 and 40x40x3"), (np.where(b > 1, np.nan, b), "NaN"), (b[..., 0], "RGB")):
        with pytest.raises(ValueError, match=message):
            check_pair(a, other)
    with pytest.raises(ValueError, match="SSIM needs 11"):
        check_pair(a[:8], b[:8])


def test_lpips_carries_its_net_and_asks_for_weights(tmp_path):
    assert with_lpips([], None) == METRICS
    metrics = named({*METRICS, "lpips_alex"})
    assert list(metrics) == [*METRICS, "lpips_alex"] and metrics["lpips_alex"].heading == "LPIPS (AlexNet)\u00a0↓"
    with pytest.raises(UserError, match="alexnet.*evaluate.lpips=none"):  # at once, not after a path trace
        with_lpips(["alex"], str(tmp_path))


def test_the_setting_names_no_network_or_one_or_both(tmp_path):
    from tests.model.lpips import write_weights

    words = {"none": "none", "alex": "alex", "vgg,alex": ("vgg", "alex"), "alex,vgg": ("vgg", "alex"), "vgg,vgg": "vgg"}
    assert {word: parse_lpips(word) for word in words} == words
    assert parse_lpips(["alex", "vgg"]) == ("vgg", "alex") and parse_lpips(["vgg"]) == "vgg"
    for wrong in ("", "vgg,none", "squeeze", [], None, 3):
        with pytest.raises(ValueError, match="choose vgg, alex, both as vgg,alex, or none"):
            parse_lpips(wrong)
    for network in ("vgg", "alex"):
        write_weights(tmp_path, network)
    metrics = with_lpips(lpips_networks(("vgg", "alex")), str(tmp_path))
    assert list(metrics) == [*METRICS, "lpips_vgg", "lpips_alex"]
    image = np.random.default_rng(0).uniform(0, 2, (64, 64, 3)).astype(np.float32)
    assert measure_all(image, image[::-1].copy(), metrics).keys() == metrics.keys()


def test_tone_maps_invert():
    x = np.linspace(0, 1, 1001)
    for encode, decode in ((srgb_encode, srgb_decode), (tone_map, tone_unmap), (log_encode, log_decode)):
        assert decode(encode(x)) == pytest.approx(x, abs=1e-12)
    assert tone_map(np.array([0, 1, 50])).tolist() == [0, 1, 1]
    assert srgb_encode(np.array(0.5)) == pytest.approx(0.735357, abs=1e-6)
    picture = np.arange(256, dtype=np.uint8).reshape(-1, 1).repeat(3, axis=1)
    assert np.array_equal(to_picture(from_picture(picture)), picture)


def test_exposure_is_a_power_of_two_that_brings_a_dark_image_up():
    assert exposure_for(np.full((8, 8, 3), 0.01)) == 64  # 0.64: nearest to 0.7 in stops
    assert exposure_for(np.full((8, 8, 3), 0.5)) == 1
    assert exposure_for(np.zeros((8, 8, 3))) == 1
