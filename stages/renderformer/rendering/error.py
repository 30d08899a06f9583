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

from stages.graphics.denoising import denoise
from stages.graphics.metrics import log_error
from stages.graphics.tonemap import log_encode
from stages.renderformer.records import ViewRecord

NOISE_WEIGHT = 0.5  # of the mean difference between the denoised halves
DRIFT_WEIGHT = 1.6  # of the mean difference between their mean and the denoised whole
QUALITIES = {"fast": 1.13, "high": 1.0}  # the denoiser's networks: what the estimate is to be multiplied by
HIGH = 0.8  # error of the large network over that of the small one, in the median
HOPE = 0.6  # least error of the large network over that of the small one


class Judge:
    """Tells the error of one view again and again, with more and more samples."""

    def __init__(self, target: float, denoised: bool):
        self.target, self.network = target, "fast" if denoised else None

    def error(self, a: ViewRecord, b: ViewRecord, all_samples: ViewRecord) -> tuple[str | None, float]:
        """(network, error) of the image with all lights on, from the views of both halves and of all samples, not denoised:
        the small network where it meets the target, the large one otherwise, None where nothing is to be denoised."""
        if self.network is None:
            return None, 0.5 * log_error(a.image, b.image)
        if self.network == "fast":
            error = denoised_error(a, b, all_samples, "fast")
            if error <= self.target:
                return "fast", error
            if HOPE * error > self.target:
                return "high", error * HIGH
            self.network = "high"  # if this does not do, the small one will not do with a few samples more
        return "high", denoised_error(a, b, all_samples, "high")


def denoised_error(a: ViewRecord, b: ViewRecord, all_samples: ViewRecord, quality: str) -> float:
    """Of the image with all lights on as that network makes it, from the views of both halves and of all samples."""
    first, second, now = (
        log_encode(denoise(v.image, v.albedo, v.normal, v.coverage, quality).astype(np.float64)) for v in (a, b, all_samples)
    )
    noise, drift = np.abs(first - second).mean(), np.abs((first + second) / 2 - now).mean()
    return float(QUALITIES[quality] * (NOISE_WEIGHT * noise + DRIFT_WEIGHT * drift))
