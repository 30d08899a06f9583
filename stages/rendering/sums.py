"""What a renderer hands over for one view: sums over the samples of every pixel, which add up."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from stages.records import ViewRecord


@dataclass
class Sums:
    """Sums over ``spp`` samples per pixel of one view, float64. ``a + b`` is the view from the samples of both.

    lights (L, H, W, 3), direct, albedo, normal (H, W, 3); distance (H, W) over the samples that hit something, hits (H, W)
    their number; nearest: the smallest distance of all.
    """

    spp: int
    lights: np.ndarray
    direct: np.ndarray
    albedo: np.ndarray
    normal: np.ndarray
    distance: np.ndarray
    hits: np.ndarray
    nearest: float

    def __add__(self, other: Sums) -> Sums:
        total = {f.name: getattr(self, f.name) + getattr(other, f.name) for f in fields(self) if f.name != "nearest"}
        return Sums(**total, nearest=min(self.nearest, other.nearest))

    def view(self) -> ViewRecord:
        """The means, without meta."""

        def mean(values: np.ndarray) -> np.ndarray:
            return (values / self.spp).astype(np.float32)

        depth = np.where(self.hits > 0, self.distance / np.maximum(self.hits, 1e-9), 0).astype(np.float32)
        means = [mean(values) for values in (self.lights, self.direct, self.albedo, self.normal)]
        return ViewRecord(*means, depth, mean(self.hits))
