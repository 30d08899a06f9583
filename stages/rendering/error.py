"""How far a view is from the truth, told from its own samples: mean absolute difference of log10(1 + radiance).

The samples come in two halves that share no path. Raw, the halves differ by twice the error of their mean, exactly in
expectation. Denoised, the difference of the two holds the noise that gets through the denoiser but not its bias, which is
the same in both; the two grow together, so one factor serves. It has not been calibrated on long references yet.
"""

from __future__ import annotations

from stages.metrics import log_error
from stages.rendering.denoising import denoise
from stages.rendering.sums import Sums

DENOISED_FACTOR = 1.0  # true error of the whole over the difference of its denoised halves


def estimated_error(a: Sums | None, b: Sums | None, denoised: bool) -> float | None:
    """Of the image with all lights on, from the samples of both halves; None where there is only one half."""
    if a is None or b is None:
        return None
    images = []
    for half in (a, b):
        view = half.view()
        images.append(denoise(view.image, view.albedo, view.normal, view.coverage) if denoised else view.image)
    return log_error(*images) * (DENOISED_FACTOR if denoised else 0.5)
