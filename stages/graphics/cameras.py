"""Pinhole cameras: rays through pixels, and pixels of points.

A camera looks along -z with +y up and +x right (as OpenGL). Pixel (row, column) has its centre at
(column + 0.5, row + 0.5), measured from the image's upper left corner, and so has the principal point.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera without distortion.

    width, height: pixels. fx, fy: focal lengths in pixels. cx, cy: principal point in pixels.
    camera_to_world: (4, 4) float64, rigid; its columns are right, up, backwards and position.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    camera_to_world: np.ndarray

    @classmethod
    def from_fov(cls, width: int, height: int, fov_deg: float, camera_to_world: np.ndarray) -> Camera:
        """A camera with square pixels, its principal point in the middle; ``fov_deg`` is the full angle across the width."""
        focal = 0.5 * width / np.tan(np.radians(fov_deg) / 2)
        return cls(width, height, focal, focal, width / 2, height / 2, np.asarray(camera_to_world, float))

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Camera:
        return cls(**{**values, "camera_to_world": np.array(values["camera_to_world"], float)})

    def to_json(self) -> dict[str, Any]:
        return {
            "width": self.width,
            "height": self.height,
            **{name: float(getattr(self, name)) for name in ("fx", "fy", "cx", "cy")},
            "camera_to_world": self.camera_to_world.tolist(),
        }

    @property
    def position(self) -> np.ndarray:
        """(3,) float64, world."""
        return self.camera_to_world[:3, 3]

    @property
    def forward(self) -> np.ndarray:
        """(3,) float64, a unit vector along the optical axis."""
        return -self.camera_to_world[:3, 2]

    @property
    def world_to_camera(self) -> np.ndarray:
        """(4, 4) float64."""
        rotation = self.camera_to_world[:3, :3].T
        inverse = np.eye(4)
        inverse[:3, :3] = rotation
        inverse[:3, 3] = -rotation @ self.position
        return inverse

    def resized(self, width: int, height: int) -> Camera:
        """The same view on another grid of pixels."""
        x, y = width / self.width, height / self.height
        return replace(self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y)

    def subpixels(self, side: int) -> list[Camera]:
        """``side`` x ``side`` cameras whose pixels' centres are evenly spaced over the pixels of this one, row by row."""
        offsets = (np.arange(side) + 0.5) / side - 0.5
        return [replace(self, cx=self.cx - x, cy=self.cy - y) for y in offsets for x in offsets]

    def moved(self, offset: np.ndarray) -> Camera:
        """The same camera elsewhere. ``offset``: (3,) in world units: right, up and backwards as the camera sees them."""
        moved = self.camera_to_world.copy()
        moved[:3, 3] += moved[:3, :3] @ np.asarray(offset, float)
        return replace(self, camera_to_world=moved)

    def pixel_centres(self) -> np.ndarray:
        """(H, W, 2) float64: x to the right, y down, in pixels."""
        x, y = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        return np.stack([x, y], axis=-1)

    def directions(self, pixels: np.ndarray | None = None) -> np.ndarray:
        """(.., 3) float64 unit vectors in the world through ``pixels`` (.., 2), or (H, W, 3) through all pixels' centres."""
        pixels = self.pixel_centres() if pixels is None else np.asarray(pixels, float)
        x = (pixels[..., 0] - self.cx) / self.fx
        y = (self.cy - pixels[..., 1]) / self.fy
        local = np.stack([x, y, np.full_like(x, -1.0)], axis=-1)
        local /= np.linalg.norm(local, axis=-1, keepdims=True)
        return local @ self.camera_to_world[:3, :3].T

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (.., 2) of world ``points`` (.., 3), and (..,) their distance along the axis, at most 0 behind the camera.

        Pixels of points behind the camera are NaN.
        """
        local = (np.asarray(points, float) - self.position) @ self.camera_to_world[:3, :3]
        ahead = -local[..., 2]
        safe = np.where(ahead > 0, ahead, np.nan)
        x = self.cx + self.fx * local[..., 0] / safe
        y = self.cy - self.fy * local[..., 1] / safe
        return np.stack([x, y], axis=-1), ahead
