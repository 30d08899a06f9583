"""Things that move, as boxes: where they stand in a picture, and which points lie on them (section 4.1).

A scene is learned as if nothing moved. So pixels of actors do not count, and their points make no surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from stages.graphics.cameras import Camera

CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2.0
EDGES = [(a, b) for a in range(8) for b in range(a) if (CORNERS[a] != CORNERS[b]).sum() == 1]


@dataclass(frozen=True)
class Box:
    """A cuboid that stands upright. centre: (3,) world. size: (3,) along its own axes. yaw: radians about z from world axes."""

    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    yaw: float

    def grown(self, margin: float, below: float) -> Box:
        """The box with ``margin`` more on all sides but below, where it is ``below``."""
        x, y, z = self.centre
        width, length, height = self.size
        return Box(
            (x, y, z + (margin - below) / 2), (width + 2 * margin, length + 2 * margin, height + margin + below), self.yaw
        )

    def axes(self) -> np.ndarray:
        """(3, 3) its own axes as columns, world."""
        cosine, sine = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])

    def corners(self) -> np.ndarray:
        """(8, 3) world."""
        return np.array(self.centre) + (CORNERS * self.size) @ self.axes().T


def inside(points: np.ndarray, boxes: Sequence[Box]) -> np.ndarray:
    """(P,) bool: whether the point (P, 3) lies in a box."""
    found = np.zeros(len(points), bool)
    for box in boxes:
        local = (points - np.array(box.centre)) @ box.axes()
        found |= (np.abs(local) <= np.array(box.size) / 2).all(axis=1)
    return found


def outline(box: Box, camera: Camera, nearest: float = 0.1) -> np.ndarray | None:
    """(N, 2) pixels: the convex polygon that the box fills; None where it lies behind the camera or beside the picture.

    What is nearer than ``nearest`` (world units along the axis) is cut off, so a box beside the camera keeps what shows.
    """
    corners = box.corners()
    ahead = -((corners - camera.position) @ camera.camera_to_world[:3, 2])
    shown = [corners[ahead >= nearest]]
    for a, b in EDGES:
        if (ahead[a] < nearest) != (ahead[b] < nearest):
            share = (nearest - ahead[a]) / (ahead[b] - ahead[a])
            shown.append((corners[a] + share * (corners[b] - corners[a]))[None])
    pixels = camera.project(np.concatenate(shown))[0]
    if len(pixels) < 3:
        return None
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    if (high <= 0).any() or (low >= [camera.width, camera.height]).any():
        return None
    try:
        return pixels[ConvexHull(pixels).vertices]
    except QhullError:  # seen edge-on
        return None
