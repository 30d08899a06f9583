"""How far a view is from the truth, told from its own samples: mean absolute difference of log10(1 + radiance).

The samples come in two halves that share no path. Raw, the halves differ by twice the error of their mean, exactly in
expectation. Denoised, half their difference is the noise that got through the denoiser; its bias is the same in both, but
shrinks with more samples, and shows in how far the image of all samples has moved away from the mean of the halves' images.
The weights of the two were fitted to long references (docs/rendering.md has the scatter plot).

Images are compared, and stored where the target allows, as the denoiser's middle network makes them; the large one takes twice
the time and leaves a little less error.
"""

from __future__ import annotations

import numpy as np

from stages.metrics import log_error
from stages.records import ViewRecord
from stages.rendering.denoising import denoise
from stages.tonemap import log_encode

NOISE_WEIGHT = 0.5  # of the mean difference between the denoised halves
DRIFT_WEIGHT = 1.6  # of the mean difference between their mean and the denoised whole
QUALITIES = {"balanced": 1.0, "high": 0.87}  # of the denoiser: error over that of the middle network


def estimated_error(a: ViewRecord, b: ViewRecord, whole: ViewRecord, denoised: bool) -> float:
    """Of the image with all lights on, from the views of both halves and of all samples, not yet denoised; ``denoised``: of
    what the middle network will make of it."""
    if not denoised:
        return 0.5 * log_error(a.image, b.image)
    first, second, now = (
        log_encode(denoise(v.image, v.albedo, v.normal, v.coverage, "balanced").astype(np.float64)) for v in (a, b, whole)
    )
    noise, drift = np.abs(first - second).mean(), np.abs((first + second) / 2 - now).mean()
    return float(NOISE_WEIGHT * noise + DRIFT_WEIGHT * drift)
