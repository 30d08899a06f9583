"""What a renderer hands over for one view: sums over the samples of every pixel, which add up."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from stages.renderformer.records import ViewRecord


@dataclass
class Sums:
    """Sums over ``spp`` samples per pixel of one view, float64. ``a + b`` is the view from the samples of both.

    spp: one number, or (H, W) of each pixel.
    lights (L, H, W, 3), direct, albedo, normal (H, W, 3); distance (H, W) over the samples that hit something, hits (H, W)
    their number. Not sums: nearest (H, W), the smallest distance, infinite where nothing was hit; triangle (H, W) int32, what
    the first sample hit, -1 for nothing.
    caustics (L, H, W, 3) float32: sums over ``paths`` light paths (``stages.renderformer.rendering.caustics``) of the light
    that camera paths leave out; 0 where there are none.
    """

    spp: int | np.ndarray
    lights: np.ndarray
    direct: np.ndarray
    albedo: np.ndarray
    normal: np.ndarray
    distance: np.ndarray
    hits: np.ndarray
    nearest: np.ndarray
    triangle: np.ndarray
    caustics: np.ndarray | float = 0.0
    paths: int = 0

    def __add__(self, other: Sums) -> Sums:
        summed = [f.name for f in fields(self) if f.name not in ("nearest", "triangle")]
        total = {name: getattr(self, name) + getattr(other, name) for name in summed}
        return Sums(**total, nearest=np.minimum(self.nearest, other.nearest), triangle=self.triangle)

    @property
    def mean_spp(self) -> float:
        """Samples per pixel in the mean."""
        return float(np.mean(self.spp))

    def per_sample(self, values: np.ndarray) -> np.ndarray:
        """Sums (.., H, W, 3) over the pixels' samples."""
        return values / (self.spp if np.isscalar(self.spp) else self.spp[..., None])

    def view(self, object_index: np.ndarray) -> ViewRecord:
        """The means, without meta; ``object_index`` (F,) is the scene's."""

        def mean(values: np.ndarray) -> np.ndarray:
            return self.per_sample(values).astype(np.float32)

        depth = np.where(self.hits > 0, self.distance / np.maximum(self.hits, 1e-9), 0).astype(np.float32)
        coverage = (self.hits / self.spp).astype(np.float32)
        lights = (self.per_sample(self.lights) + self.caustics / max(self.paths, 1)).astype(np.float32)
        means = [lights, *(mean(values) for values in (self.direct, self.albedo, self.normal))]
        object_at_pixel = np.where(self.triangle >= 0, object_index[self.triangle], -1).astype(np.int32)
        return ViewRecord(*means, depth, coverage, self.triangle.astype(np.int32), object_at_pixel)
