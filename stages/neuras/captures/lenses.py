"""Lenses of real cameras, and images without their distortion.

A lens is a pinhole with OpenCV's rational and tangential distortion, which holds every polynomial model of COLMAP and
nerfstudio. Pixels are measured from the image's upper left corner, centres at +0.5; x to the right, y down.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from stages.graphics.cameras import Camera


@dataclass(frozen=True)
class Lens:
    """width, height: pixels. fx, fy, cx, cy: pixels. radial: k1 to k6 as OpenCV numbers them. tangential: p1, p2."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    radial: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)

    @property
    def straight(self) -> bool:
        """Whether it is a pinhole already."""
        return not any(self.radial) and not any(self.tangential)

    def wrong(self) -> str | None:
        """What makes it no lens, if something does."""
        values = [self.fx, self.fy, self.cx, self.cy, *self.radial, *self.tangential]
        if not np.isfinite(values).all():
            return "an intrinsic is not a finite number"
        if min(self.fx, self.fy) <= 0 or min(self.width, self.height) < 1:
            return f"focal lengths {self.fx:g}, {self.fy:g} and size {self.width} x {self.height} must be above 0"
        if not (0 <= self.cx <= self.width and 0 <= self.cy <= self.height):
            return f"the principal point ({self.cx:g}, {self.cy:g}) lies outside {self.width} x {self.height} pixels"
        return None

    def camera(self, camera_to_world: np.ndarray) -> Camera:
        """The pinhole of the undistorted image: same size, focal lengths and principal point."""
        return Camera(self.width, self.height, self.fx, self.fy, self.cx, self.cy, camera_to_world)

    def distort(self, points: np.ndarray) -> np.ndarray:
        """(.., 2) of the real image plane (at distance 1) from (.., 2) of the ideal one."""
        x, y = points[..., 0], points[..., 1]
        square = x * x + y * y
        scale = self.radial_scale(square)
        p1, p2 = self.tangential
        return np.stack(
            [
                x * scale + 2 * p1 * x * y + p2 * (square + 2 * x * x),
                y * scale + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
            ],
            axis=-1,
        )

    def radial_scale(self, square: np.ndarray) -> np.ndarray:
        """How much farther out a point lies in the image, from its squared radius on the ideal plane."""
        k1, k2, k3, k4, k5, k6 = (*self.radial, *(0.0,) * 6)[:6]
        return (1 + square * (k1 + square * (k2 + square * k3))) / (1 + square * (k4 + square * (k5 + square * k6)))


@lru_cache(maxsize=4)  # most captures have one lens
def sources(lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Where each pixel of the undistorted image lies in the real one: (H, W, 2) pixels, and (H, W) bool: in it.

    A polynomial folds back beyond some radius; what lies there is not in the image.
    """
    focal, centre = np.array([lens.fx, lens.fy]), np.array([lens.cx, lens.cy])
    ideal = (lens.camera(np.eye(4)).pixel_centres() - centre) / focal
    pixels = lens.distort(ideal) * focal + centre
    inside = ((pixels >= 0) & (pixels <= [lens.width, lens.height])).all(axis=-1)
    radius = np.linalg.norm(ideal, axis=-1)
    return pixels, inside & (radius < _fold(lens, float(radius.max())))


def _fold(lens: Lens, farthest: float) -> float:
    """The radius on the ideal plane up to which a larger one is a larger one in the image too."""
    radius = np.linspace(0, farthest * 1.001 + 1e-9, 2000)
    turns = np.flatnonzero(np.diff(radius * lens.radial_scale(radius * radius)) <= 0)
    return float(radius[turns[0]]) if len(turns) else np.inf


def undistorted(image: np.ndarray, lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """The image (H, W, 3) uint8 through the lens's pinhole, and (H, W) bool: which of its pixels the real image has."""
    pixels, inside = sources(lens)
    return np.clip(np.rint(bilinear(image, pixels)), 0, 255).astype(np.uint8), inside.copy()


def bilinear(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(.., C) float32 samples of ``image`` (H, W, C) at ``pixels`` (.., 2); the border goes on outside."""
    height, width = image.shape[:2]
    x = np.clip(pixels[..., 0] - 0.5, 0, width - 1)
    y = np.clip(pixels[..., 1] - 0.5, 0, height - 1)
    left, top = np.minimum(x.astype(int), max(width - 2, 0)), np.minimum(y.astype(int), max(height - 2, 0))
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    along, down = ((x - left)[..., None].astype(np.float32), (y - top)[..., None].astype(np.float32))
    image = image.astype(np.float32)
    upper = image[top, left] * (1 - along) + image[top, right] * along
    lower = image[bottom, left] * (1 - along) + image[bottom, right] * along
    return upper * (1 - down) + lower * down
