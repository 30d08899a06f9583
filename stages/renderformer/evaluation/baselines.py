"""The bars that a trained model has to clear, each as strong as its kind can be.

- *mean training image*: one image for every scene, the best guess of who knows the training set and never looks.
- *constant colour*: one colour per scene, over all its views, chosen with the answer in hand (an oracle).

"Best" depends on the metric. Squared error after a clamp is least at the mean of the clamped values, absolute log error
at the median in log space. So a baseline exists once per `SPACES` entry, and a metric is given the one of its own space
(``stages.graphics.metrics.Metric.space``). SSIM, FLIP and LPIPS have no closed form: they take, per scene, the one that
scores best.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from pipeline.errors import UserError
from stages.graphics.metrics import METRICS, Metric, measure_all
from stages.graphics.tonemap import clamp, log_decode, log_encode, tone_map, tone_unmap


def _identity(values: np.ndarray) -> np.ndarray:
    return values


@dataclass(frozen=True)
class Space:
    """Values in which a metric looks at radiance, and the way back."""

    encode: Callable[[np.ndarray], np.ndarray]
    decode: Callable[[np.ndarray], np.ndarray]


SPACES: Mapping[str, Space] = {
    "linear": Space(clamp, _identity),
    "tone_mapped": Space(tone_map, tone_unmap),
    "log": Space(log_encode, log_decode),
}


def best_constants(images: np.ndarray) -> dict[str, np.ndarray]:
    """Per space the colour, (3,) linear radiance, that scores best against all of a scene's images, (V, H, W, 3).

    linear, tone_mapped: the highest PSNR averaged over the views. The average of logarithms weighs a view by 1 / its
    squared error, which depends on the colour: a few rounds from the plain mean, each of which can only gain.
    log: the median, per channel.
    """
    out = {}
    for name, space in SPACES.items():
        values = space.encode(images.astype(np.float64))
        if name == "log":
            colour = np.median(values, axis=(0, 1, 2))
        else:
            means, variances = values.mean(axis=(1, 2)), values.var(axis=(1, 2)).mean(axis=1)  # (V, 3), (V,)
            colour = means.mean(axis=0)
            for _ in range(20):
                weights = 1 / np.maximum(variances + np.mean((means - colour) ** 2, axis=1), 1e-10)
                colour = weights @ means / weights.sum()
        out[name] = space.decode(colour).astype(np.float32)
    return out


def mean_images(blocks: Iterable[np.ndarray], limit: int) -> dict[str, np.ndarray]:
    """Per space the one image, (H, W, 3) linear radiance, that fits a stream of (V, H, W, 3) images best, pixelwise.

    Reads at most ``limit`` images. The means are running sums; the median needs all values, so they are held as half
    floats, (limit, H, W, 3): that is why the number is bounded.
    """
    sums: dict[str, np.ndarray] = {}
    log_images = np.empty(0, dtype=np.float16)
    count = 0
    for block in blocks:
        block = block[: limit - count]
        if not count:
            log_images = np.empty((limit, *block.shape[1:]), dtype=np.float16)
            sums = {name: np.zeros(block.shape[1:]) for name in ("linear", "tone_mapped")}
        if block.shape[1:] != log_images.shape[1:]:
            raise UserError(f"training images of {block.shape[1:]} and {log_images.shape[1:]}: a mean image needs one size")
        log_images[count : count + len(block)] = SPACES["log"].encode(block)
        for name, total in sums.items():
            total += SPACES[name].encode(block).sum(axis=0, dtype=np.float64)
        count += len(block)
        if count >= limit:
            break
    if not count:
        raise UserError("there is no training image to average")
    encoded = {name: total / count for name, total in sums.items()}
    # Row by row: the median of half floats is taken in float32, one row of all images at a time.
    encoded["log"] = np.stack([np.median(log_images[:count, y].astype(np.float32), axis=0) for y in range(log_images.shape[1])])
    return {name: SPACES[name].decode(values).astype(np.float32) for name, values in encoded.items()}


def measure_baseline(
    references: np.ndarray, candidates: Mapping[str, np.ndarray], metrics: Mapping[str, Metric] = METRICS
) -> list[dict[str, float]]:
    """Every metric between each of a scene's images (V, H, W, 3) and the candidate that is best for the metric.

    candidates: one colour (3,) or image (H, W, 3) per space, from `best_constants` or `mean_images`.
    """
    scores = {}
    for space, candidate in candidates.items():
        space_metrics = {name: metric for name, metric in metrics.items() if metric.space in (space, None)}
        image = np.broadcast_to(candidate, references.shape[1:])
        scores[space] = [measure_all(reference, image, space_metrics) for reference in references]

    def total(metric: Metric, space: str) -> float:
        return sum(row[metric.name] for row in scores[space]) * (1 if metric.higher_is_better else -1)

    chosen = {name: metric.space or max(scores, key=partial(total, metric)) for name, metric in metrics.items()}
    return [{name: scores[space][view][name] for name, space in chosen.items()} for view in range(len(references))]
