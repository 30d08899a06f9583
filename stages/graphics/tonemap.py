"""Tone mapping, each map defined once: linear radiance to what a loss, a metric or a picture looks at.

numpy only. A picture (PNG) is plain sRGB of radiance clamped to [0, 1], after an exposure that is stated where it is
not 1, so that reading a picture back gives the clamped radiance again. The paper's own map (section 3.3) is logarithmic:
``log2(1 + x)`` clamped, its loss's ``log10(1 + x) / log10(2)``. ``TONE_MAPPERS`` are what pictures for people may be made
with instead of clamping; metrics never use them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

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


def exposure_text(exposure: float) -> str:
    """In words, as in ``exposure 1/4``."""
    return f"exposure {exposure:g}" if exposure >= 1 else f"exposure 1/{1 / exposure:g}"


def to_picture(radiance: np.ndarray, exposure: float = 1.0, mapper: str = "none") -> np.ndarray:
    """(..., 3) linear radiance as (..., 3) uint8 sRGB; ``mapper`` is a key of `TONE_MAPPERS`."""
    return np.round(srgb_encode(TONE_MAPPERS[mapper](radiance * exposure)) * 255).astype(np.uint8)


def from_picture(picture: np.ndarray) -> np.ndarray:
    """(..., 3) uint8 sRGB as linear float32 radiance in [0, 1]."""
    return srgb_decode(picture.astype(np.float64) / 255).astype(np.float32)


# --- tone mappers for people: (..., 3) linear sRGB radiance >= 0 to linear display values, to be clamped to [0, 1] ------------


def reinhard(radiance: np.ndarray) -> np.ndarray:
    """x / (1 + x) of the luminance, colours kept (Reinhard et al. 2002)."""
    return radiance / (1 + radiance @ LUMINANCE)[..., None]


def filmic(radiance: np.ndarray) -> np.ndarray:
    """Hable's filmic curve (Uncharted 2, 2010) with exposure 2 and linear white 11.2."""

    def curve(x: np.ndarray | float) -> np.ndarray | float:
        return (x * (0.15 * x + 0.05) + 0.004) / (x * (0.15 * x + 0.5) + 0.06) - 0.02 / 0.3

    return curve(2 * radiance) / curve(11.2)


_ACES_IN = np.array([[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]])
_ACES_OUT = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])


def aces(radiance: np.ndarray) -> np.ndarray:
    """Hill's fit of ACES' RRT and sRGB ODT, exposed by 1 / 0.6 as most renderers do, so that middle grey stays."""
    x = radiance / 0.6 @ _ACES_IN.T
    return ((x * (x + 0.0245786) - 0.000090537) / (x * (0.983729 * x + 0.4329510) + 0.238081)) @ _ACES_OUT.T


_REC2020 = np.array([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0113], [0.0164, 0.0880, 0.8956]])  # from linear sRGB
_AGX_IN = np.array(
    [
        [0.856627153315983, 0.0951212405381588, 0.0482516061458583],
        [0.137318972929847, 0.761241990602591, 0.101439036467562],
        [0.11189821299995, 0.0767994186031903, 0.811302368396859],
    ]
)
_AGX_OUT = np.array(
    [
        [1.1271005818144368, -0.11060664309660323, -0.016493938717834573],
        [-0.1413297634984383, 1.157823702216272, -0.016493938717834257],
        [-0.14132976349843826, -0.11060664309660294, 1.2519364065950405],
    ]
)
_AGX_STOPS = (-12.47393, 4.026069)  # log2 of the radiance that becomes black and white
_AGX_CURVE = (15.5, -40.14, 31.96, -6.868, 0.4298, 0.1191, -0.00232)  # Wrensch's polynomial, highest power first


def agx(radiance: np.ndarray) -> np.ndarray:
    """Sobotka's AgX without a look, in Rec. 2020 primaries as Blender's, its curve by Wrensch's polynomial."""
    low, high = _AGX_STOPS
    x = np.log2(np.maximum(radiance @ (_AGX_IN @ _REC2020).T, 1e-10))
    x = np.polyval(_AGX_CURVE, np.clip((x - low) / (high - low), 0, 1)) @ _AGX_OUT.T
    return np.maximum(x, 0) ** 2.2 @ np.linalg.inv(_REC2020).T


def pbr_neutral(radiance: np.ndarray) -> np.ndarray:
    """Khronos' PBR Neutral (2024): colours as they are up to 0.76, highlights compressed and desaturated."""
    start, desaturation = 0.8 - 0.04, 0.15
    low = radiance.min(axis=-1, keepdims=True)
    colour = radiance - np.where(low < 0.08, low - 6.25 * low**2, 0.04)
    peak = colour.max(axis=-1, keepdims=True)
    compressed = 1 - (1 - start) ** 2 / (np.maximum(peak, start) + 1 - 2 * start)
    share = 1 / (desaturation * (peak - compressed) + 1)
    bright = colour * (compressed / np.maximum(peak, start)) * share + compressed * (1 - share)
    return np.where(peak < start, colour, bright)


TONE_MAPPERS: Mapping[str, Callable[[np.ndarray], np.ndarray]] = {
    "none": clamp,
    "reinhard": reinhard,
    "filmic": filmic,
    "aces": aces,
    "agx": agx,
    "pbr_neutral": pbr_neutral,
}
