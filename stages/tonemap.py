"""Tone mapping, each map defined once: linear radiance to what a loss, a metric or a picture looks at.

numpy only. A picture (PNG) is plain sRGB of radiance clamped to [0, 1], after an exposure that is stated where it is
not 1, so that reading a picture back gives the clamped radiance again. The paper's own map (section 3.3) is logarithmic:
``log2(1 + x)`` clamped, its loss's ``log10(1 + x) / log10(2)``.
"""

from __future__ import annotations

import numpy as np

LUMINANCE = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)  # of linear sRGB (Rec. 709)


def log_encode(radiance: np.ndarray) -> np.ndarray:
    """log10(1 + x), what the network predicts; negative radiance counts as black."""
    return np.log10(1 + np.maximum(radiance, 0))


def log_decode(encoded: np.ndarray) -> np.ndarray:
    """Inverse of `log_encode`."""
    return 10**encoded - 1


def clamp(radiance: np.ndarray) -> np.ndarray:
    """Linear radiance clamped to [0, 1]."""
    return np.clip(radiance, 0, 1)


def tone_map(radiance: np.ndarray) -> np.ndarray:
    """The tone map of the paper's perceptual loss: log10(1 + x) / log10(2), clamped to [0, 1]."""
    return np.clip(log_encode(radiance) / np.log10(2), 0, 1)


def tone_unmap(mapped: np.ndarray) -> np.ndarray:
    """Inverse of `tone_map` on [0, 1]."""
    return 2**mapped - 1


def srgb_encode(linear: np.ndarray) -> np.ndarray:
    """sRGB's transfer curve on linear values clamped to [0, 1] (IEC 61966-2-1)."""
    x = clamp(linear)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055)


def srgb_decode(encoded: np.ndarray) -> np.ndarray:
    """Inverse of `srgb_encode`."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((np.maximum(encoded, 0.04045) + 0.055) / 1.055) ** 2.4)


def exposure_for(radiance: np.ndarray) -> float:
    """A power of two that brings the 95th percentile of luminance nearest to 0.7: what a camera's automatic would do.

    A power of two so that a caption can name it, and so that near-equal images get equal exposures.
    """
    bright = float(np.percentile(radiance @ LUMINANCE, 95))
    return float(2.0 ** round(np.log2(0.7 / bright))) if bright > 1e-6 else 1.0


def to_picture(radiance: np.ndarray, exposure: float = 1.0) -> np.ndarray:
    """(..., 3) linear radiance as (..., 3) uint8 sRGB."""
    return np.round(srgb_encode(radiance * exposure) * 255).astype(np.uint8)


def from_picture(picture: np.ndarray) -> np.ndarray:
    """(..., 3) uint8 sRGB as linear float32 radiance in [0, 1]."""
    return srgb_decode(picture.astype(np.float64) / 255).astype(np.float32)
