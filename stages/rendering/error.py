"""How far a view is from the truth, told from its own samples: mean absolute difference of log10(1 + radiance).

The samples come in two halves that share no path. Raw, the halves differ by twice the error of their mean, exactly in
expectation. Denoised, the difference of the two holds the noise that gets through the denoiser but not its bias, which is
the same in both; on long references the two grow together, so one factor serves (``bench/render.py --calibrate`` draws the
scatter plot that it comes from).
"""

from __future__ import annotations

import numpy as np

from stages.rendering.denoising import denoise
from stages.rendering.layers import Sums

DENOISED_FACTOR = 1.0  # true error of the whole over the difference of its denoised halves


def log_error(image: np.ndarray, reference: np.ndarray) -> float:
    """Mean absolute difference of log10(1 + x)."""
    return float(np.abs(np.log10(1 + np.maximum(image, 0)) - np.log10(1 + np.maximum(reference, 0))).mean())


def estimated_error(a: Sums | None, b: Sums | None, denoised: bool) -> float | None:
    """Of the image with all lights on, from the samples of both halves; None where there is only one half."""
    if a is None or b is None:
        return None
    images = []
    for half in (a, b):
        layers = half.layers()
        image = layers.lights.sum(axis=0, dtype=np.float32)
        images.append(denoise(image, layers.albedo, layers.normal, layers.coverage) if denoised else image)
    return log_error(*images) * (DENOISED_FACTOR if denoised else 0.5)
