"""How far a view is from the truth, told from its own samples: mean absolute difference of log10(1 + radiance).

The samples come in two halves that share no path. Raw, the halves differ by twice the error of their mean, exactly in
expectation. Denoised, the difference of the two holds the noise that gets through the denoiser but not its bias, which is
the same in both; the two grow together, so one factor serves. It has not been calibrated on long references yet.
"""

from __future__ import annotations

from stages.metrics import log_error
from stages.records import ViewRecord
from stages.rendering.denoising import denoise

DENOISED_FACTOR = 1.0  # true error of the whole over the difference of its denoised halves


def estimated_error(a: ViewRecord, b: ViewRecord, denoised: bool) -> float:
    """Of the image with all lights on, from the views of both halves, not denoised."""
    images = [denoise(v.image, v.albedo, v.normal, v.coverage) if denoised else v.image for v in (a, b)]
    return log_error(*images) * (DENOISED_FACTOR if denoised else 0.5)
