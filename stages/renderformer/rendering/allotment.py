"""How many light paths a view gets beside its camera paths, told from the noise that either leaves."""

from __future__ import annotations

import numpy as np

from stages.renderformer.rendering.sums import Sums

FIRST = 0.25  # light paths per camera path before anything is known
RANGE = (0.06, 4.0)
COST = 1.0  # of a light path over that of a camera path
CELL = 4  # pixels over which the denoiser is taken to smooth, per axis


class Allotment:
    """The light paths of one view, per stream. ``size``: (height, width)."""

    def __init__(self, size: tuple[int, int]):
        self.pixels, self.paths, self.ratio = size[0] * size[1], 0, FIRST

    def window(self, spp: float) -> tuple[int, int]:
        """First and last but one of the path numbers that are due beside ``spp`` camera paths per pixel in all."""
        first = self.paths
        self.paths = max(first, round(self.ratio * self.pixels * spp))
        return first, self.paths

    def weigh(self, a: Sums, b: Sums) -> None:
        """Choose the ratio that leaves least noise at equal cost, from the sums of two streams."""
        if not (a.paths and a.mean_spp):
            return
        camera, light = ([per_path(s, getattr(s, name).sum(axis=0)) for s in (a, b)] for name, per_path in PARTS)
        image = (camera[0] + camera[1] + light[0] + light[1]) / 2
        of_camera, of_light = (_noise(image, first - second) for first, second in (camera, light))
        now = a.paths / (a.mean_spp * self.pixels)
        self.ratio = float(np.clip(of_light / max(of_camera, 1e-12) * np.sqrt(now / COST), *RANGE))


PARTS = (("lights", lambda sums, values: sums.per_sample(values)), ("caustics", lambda sums, values: values / sums.paths))


def _noise(image: np.ndarray, difference: np.ndarray) -> float:
    """Mean change of the smoothed image's log10(1 + radiance) by the difference of two halves of its samples."""
    high, low = (np.log10(1 + np.maximum(_smooth(image + sign * difference / 2), 0)) for sign in (1, -1))
    return float(np.abs(high - low).mean())


def _smooth(image: np.ndarray) -> np.ndarray:
    """Means over the whole cells of an image that has some."""
    height, width = (max(side // CELL, 1) for side in image.shape[:2])
    cells = image[: height * CELL, : width * CELL]
    return cells.reshape(height, -1, width, cells.shape[1] // width, 3).mean(axis=(1, 3))
