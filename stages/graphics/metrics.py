"""Image metrics, each defined once. Images are (H, W, 3) float arrays of linear HDR radiance, the reference first.

| name | what | on | better |
| --- | --- | --- | --- |
| psnr, ssim | peak signal-to-noise ratio (dB), structural similarity | linear, clamped to [0, 1] | higher |
| psnr_tm, ssim_tm | the same | ``log10(1 + x) / log10(2)``, clamped to [0, 1] | higher |
| log_error | mean absolute difference of ``log10(1 + x)`` (the paper's L1 loss) | HDR | lower |
| flip | mean HDR-FLIP error, NVIDIA's own package, its default viewing conditions | HDR | lower |
| lpips_vgg, lpips_alex | LPIPS with that network, only where its weights are given | as psnr_tm | lower |

Each metric says in which `space` its best constant has a closed form, if in any, so that a baseline
(``stages.renderformer.evaluation.baselines``) can be the strongest of its kind for that very metric. Paper: section 4.1,
table 1.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.errors import UserError
from stages.graphics.tonemap import LUMINANCE, clamp, log_encode, tone_map

PSNR_MAX = 100.0  # dB; equal images would have infinitely many, which neither JSON nor an average can hold
SSIM_MIN_SIZE = 11  # pixels: the Gaussian window, sigma 1.5 cut at 3.5 sigma
FLIP_MIN_LUMINANCE = 2.0**-23  # below this everywhere FLIP cannot choose exposures from the reference (and exits)


def psnr(reference: np.ndarray, test: np.ndarray) -> float:
    """PSNR in dB of values in [0, 1], the squared error averaged over pixels and channels; at most `PSNR_MAX`."""
    mse = np.mean((reference.astype(np.float64) - test.astype(np.float64)) ** 2)
    return float(-10 * np.log10(max(mse, 10 ** (-PSNR_MAX / 10))))


def ssim(reference: np.ndarray, test: np.ndarray, counts: np.ndarray | None = None) -> float:
    """SSIM of values in [0, 1]: Gaussian window of sigma 1.5, data range 1, mean over pixels and channels.

    counts: (H, W) bool, the pixels that the mean is over; None: all. Pixels nearer to the border than the window's radius
    are never in it.
    """
    from skimage.metrics import structural_similarity

    mean, similarity = structural_similarity(
        reference.astype(np.float64),
        test.astype(np.float64),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=-1,
        full=True,
    )
    if counts is None:
        return float(mean)
    inner = (slice(SSIM_MIN_SIZE // 2, -(SSIM_MIN_SIZE // 2)),) * 2
    return float(similarity[inner][counts[inner]].mean())


def log_error(reference: np.ndarray, test: np.ndarray) -> float:
    """Mean absolute difference of log10(1 + x)."""
    return float(np.mean(np.abs(log_encode(reference.astype(np.float64)) - log_encode(test.astype(np.float64)))))


def flip_map(reference: np.ndarray, test: np.ndarray) -> np.ndarray:
    """HDR-FLIP error per pixel, (H, W) float32 in [0, 1], of linear values that are not clamped from above.

    The exposures come from the reference, as the package does it; for a black reference it would end the process, so
    exposure 0 stands in there.
    """
    # Its threads spin while they wait, which on a busy machine takes ten times the work itself; read as the package loads.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    import flip_evaluator

    images = [np.ascontiguousarray(np.maximum(image, 0), dtype=np.float32) for image in (reference, test)]
    black = float((images[0] @ LUMINANCE).max()) <= FLIP_MIN_LUMINANCE
    parameters = {"startExposure": 0.0, "stopExposure": 0.0} if black else {}
    error, _, _ = flip_evaluator.evaluate(*images, "HDR", applyMagma=False, computeMeanError=False, parameters=parameters)
    return np.asarray(error)[..., 0]


def flip(reference: np.ndarray, test: np.ndarray) -> float:
    """Mean of `flip_map`."""
    return float(flip_map(reference, test).mean(dtype=np.float64))


@dataclass(frozen=True)
class Metric:
    """``measure(reference, test)`` takes linear HDR images; ``space`` is a key of ``baselines.SPACES`` or None; ``bounds``: the
    least and the largest value that there is."""

    name: str
    label: str
    unit: str
    higher_is_better: bool
    digits: int
    space: str | None
    bounds: tuple[float, float]
    measure: Callable[[np.ndarray, np.ndarray], float]

    @property
    def heading(self) -> str:
        """Column title; the arrow points to better and keeps to the title's last word."""
        unit = f" ({self.unit})" if self.unit else ""
        return f"{self.label}{unit}\u00a0{'↑' if self.higher_is_better else '↓'}"

    def format(self, value: float, sign: str = "") -> str:
        return f"{value:{sign}.{self.digits}f}"


METRICS: Mapping[str, Metric] = {
    metric.name: metric
    for metric in (
        Metric("psnr", "PSNR", "dB", True, 2, "linear", (0, PSNR_MAX), lambda a, b: psnr(clamp(a), clamp(b))),
        Metric("ssim", "SSIM", "", True, 4, None, (-1, 1), lambda a, b: ssim(clamp(a), clamp(b))),
        Metric(
            "psnr_tm",
            "PSNR, tone-mapped",
            "dB",
            True,
            2,
            "tone_mapped",
            (0, PSNR_MAX),
            lambda a, b: psnr(tone_map(a), tone_map(b)),
        ),
        Metric("ssim_tm", "SSIM, tone-mapped", "", True, 4, None, (-1, 1), lambda a, b: ssim(tone_map(a), tone_map(b))),
        Metric("log_error", "log error", "", False, 4, "log", (0, np.inf), log_error),
        Metric("flip", "HDR-FLIP", "", False, 4, None, (0, 1), flip),
    )
}  # fmt: skip


LPIPS_NETWORKS = {"vgg": "LPIPS (VGG)", "alex": "LPIPS (AlexNet)"}


def with_lpips(networks: Iterable[str], folder: str | None) -> dict[str, Metric]:
    """`METRICS`, and LPIPS with each of the networks ("vgg", "alex") on tone-mapped values.

    The weights are those in ``folder``; without them a UserError says where they can be had.
    """
    return METRICS | {metric.name: metric for network in networks for metric in [_measured_lpips(network, folder)]}


def _measured_lpips(network: str, folder: str | None) -> Metric:
    import torch

    from model.lpips import LPIPS

    try:
        lpips = LPIPS.load(None if folder is None else Path(folder), network)
    except ValueError as error:
        raise UserError(str(error)) from None

    def measure(reference: np.ndarray, test: np.ndarray) -> float:
        images = [torch.from_numpy(tone_map(image).astype(np.float32)).permute(2, 0, 1)[None] for image in (reference, test)]
        with torch.no_grad():
            return float(lpips(*images))

    return _lpips(network, measure)


def _lpips(network: str, measure: Callable[[np.ndarray, np.ndarray], float]) -> Metric:
    return Metric(f"lpips_{network}", LPIPS_NETWORKS[network], "", False, 4, None, (0, np.inf), measure)


def named(names: Iterable[str]) -> dict[str, Metric]:
    """The metrics of these names, in the order of their definition, to be told, not measured: LPIPS without its weights."""

    def absent(reference: np.ndarray, test: np.ndarray) -> float:
        raise AssertionError("with_lpips has the metric with its weights")

    chosen = set(names)
    by_name = METRICS | {metric.name: metric for network in LPIPS_NETWORKS for metric in [_lpips(network, absent)]}
    return {name: metric for name, metric in by_name.items() if name in chosen}


def check_pair(reference: np.ndarray, test: np.ndarray) -> None:
    """ValueError unless both are finite (H, W, 3) images of one size that every metric can take."""
    if reference.shape != test.shape or reference.ndim != 3 or reference.shape[2] != 3:
        sizes = " and ".join("x".join(map(str, image.shape)) for image in (reference, test))
        raise ValueError(f"the images are {sizes} (height x width x channels): metrics need two RGB images of one size")
    if min(reference.shape[:2]) < SSIM_MIN_SIZE:
        raise ValueError(
            f"the images are {reference.shape[1]}x{reference.shape[0]} pixels: SSIM needs {SSIM_MIN_SIZE} or more each way"
        )
    for name, image in (("reference", reference), ("test image", test)):
        bad = int(np.count_nonzero(~np.isfinite(image).all(axis=-1)))
        if bad:
            raise ValueError(f"the {name} holds {bad} pixels that are NaN or infinite: there is no metric of those")


def measure_all(reference: np.ndarray, test: np.ndarray, metrics: Mapping[str, Metric] = METRICS) -> dict[str, float]:
    """Every metric between two linear HDR images, rounded to 1e-6 (below what any of them means)."""
    check_pair(reference, test)
    return {name: round(metric.measure(reference, test), 6) for name, metric in metrics.items()}
