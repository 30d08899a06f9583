"""Open Image Denoise on HDR radiance with albedo and normal as guides, always on the CPU so that bytes do not depend on
a GPU.

The guides are declared free of noise (``clean_aux``): first hits of evenly spread samples are, but for the last trace of
aliasing, and the denoiser then keeps every edge that they show. Measured in docs/rendering.md.
"""

from __future__ import annotations

import functools
import sys
from types import ModuleType

import numpy as np


def denoise(
    radiance: np.ndarray, albedo: np.ndarray, normal: np.ndarray, coverage: np.ndarray, quality: str = "high"
) -> np.ndarray:
    """(H, W, 3) float32 denoised radiance, not negative, and black where no sample of the pixel hit anything.

    ``quality``: high or fast, the denoiser's large and small networks; the large one takes four times the time.
    """
    if not radiance.any():
        return radiance
    clean = _pyoidn().denoise(
        np.ascontiguousarray(radiance, np.float32),
        np.ascontiguousarray(np.clip(albedo, 0, 1), np.float32),
        np.ascontiguousarray(normal, np.float32),
        hdr=True,
        clean_aux=True,
        quality=quality,
    )
    return np.where(coverage[..., None] > 0, np.maximum(clean, 0), 0).astype(np.float32)


@functools.cache
def _pyoidn() -> ModuleType:
    """The library, kept from importing torch: a second at every worker's start and 200 MB, for tensors that are not used."""
    hidden = "torch" not in sys.modules
    if hidden:
        sys.modules["torch"] = None
    try:
        import pyoidn
    finally:
        if hidden:
            del sys.modules["torch"]
    return pyoidn
