"""How far a view is from the truth, told from its own samples: mean absolute difference of log10(1 + radiance).

The samples come in two halves that share no path. Raw, the halves differ by twice the error of their mean, exactly in
expectation. Denoised, half their difference is the noise that got through the denoiser; its bias is the same in both, but
shrinks with more samples, and shows in how far the image of all samples has moved away from the mean of the halves' images.
The weights of the two were fitted to long references (docs/rendering.md has the scatter plot).

The denoiser has a small network (``fast``) and a large one (``high``), which takes four times the time and leaves about four
fifths of the error. The small one serves where it meets the target.
"""

from __future__ import annotations

import numpy as np

from stages.metrics import log_error
from stages.records import ViewRecord
from stages.rendering.denoising import denoise
from stages.tonemap import log_encode

NOISE_WEIGHT = 0.5  # of the mean difference between the denoised halves
DRIFT_WEIGHT = 1.6  # of the mean difference between their mean and the denoised whole
QUALITIES = {"fast": 1.13, "high": 1.0}  # the denoiser's networks: what the estimate is to be multiplied by
HIGH = 0.8  # error of the large network over that of the small one, in the median
HOPE = 0.6  # least error of the large network over that of the small one


def raw_error(a: ViewRecord, b: ViewRecord) -> float:
    """Of the image with all lights on, not denoised, from the views of both halves."""
    return 0.5 * log_error(a.image, b.image)


def denoised_error(a: ViewRecord, b: ViewRecord, whole: ViewRecord, quality: str) -> float:
    """Of the image with all lights on, from the views of both halves and of all samples, not yet denoised."""
    first, second, now = (
        log_encode(denoise(v.image, v.albedo, v.normal, v.coverage, quality).astype(np.float64)) for v in (a, b, whole)
    )
    noise, drift = np.abs(first - second).mean(), np.abs((first + second) / 2 - now).mean()
    return float(QUALITIES[quality] * (NOISE_WEIGHT * noise + DRIFT_WEIGHT * drift))


def cheapest(a: ViewRecord, b: ViewRecord, whole: ViewRecord, target: float) -> tuple[str, float]:
    """(quality, error): the cheapest network that meets the target; the large one where none does."""
    error = denoised_error(a, b, whole, "fast")
    if error <= target:
        return "fast", error
    if HOPE * error > target:
        return "high", error * HIGH
    return "high", denoised_error(a, b, whole, "high")
