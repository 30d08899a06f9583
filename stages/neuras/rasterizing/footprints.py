"""Which part of a texture a pixel covers: where to sample it, and at which level of its pyramid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.graphics.cameras import Camera
from stages.graphics.casting import GBuffer
from stages.neuras.records import AtlasMesh

FINEST = -10.0  # a pixel that covers a thousandth of a texel's side


@dataclass(frozen=True, eq=False)
class Footprint:
    """spread: (H, W, 2) float32, texture coordinates from the pixel's centre to one of its two samples; the other lies on the
    opposite side. detail: (H, W) float32, log2 of the texels of the finest level that a sample covers side by side. 0 where
    nothing is hit.
    """

    spread: np.ndarray
    detail: np.ndarray


def footprint(view: GBuffer, camera: Camera, atlas: AtlasMesh) -> Footprint:
    """Of every pixel.

    A pixel covers a parallelogram on the plane of the face. Its sides are what texture coordinates change by along the image's
    two axes. Its length is the longer side, its width the area over the length. On a road it is many times as long as wide:
    one sample would be either too coarse across or too fine along. So two samples share the length. Each lies a quarter of
    what the length exceeds the width by from the centre, and covers half the length, or the width if that is more.
    """
    hit = view.hit
    face = view.face[hit]
    corners = np.asarray(atlas.vertices, float)[atlas.faces[face]]
    flat = (atlas.uvs.astype(float) * (atlas.width, atlas.height))[atlas.faces[face]]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(first, second)
    square = np.maximum(_dot(normal, normal), 1e-60)
    rays = camera.directions()[hit]
    rays /= (rays @ -camera.camera_to_world[:3, 2])[:, None]  # of length 1 along the axis
    depth = view.depth[hit] / np.linalg.norm(rays, axis=1)
    facing = _dot(normal, rays)
    facing = np.where(np.abs(facing) < 1e-30, 1e-30, facing)
    sides = []
    for step in (camera.camera_to_world[:3, 0] / camera.fx, -camera.camera_to_world[:3, 1] / camera.fy):
        moved = depth[:, None] * (step - rays * (normal @ step / facing)[:, None])  # on the plane, from pixel to pixel
        s, t = (_dot(np.cross(a, b), normal) / square for a, b in ((moved, second), (first, moved)))
        sides.append(s[:, None] * (flat[:, 1] - flat[:, 0]) + t[:, None] * (flat[:, 2] - flat[:, 0]))
    across, down = sides
    lengths = np.stack([np.linalg.norm(side, axis=1) for side in sides])
    length = np.maximum(lengths.max(axis=0), 1e-12)
    width = np.abs(across[:, 0] * down[:, 1] - across[:, 1] * down[:, 0]) / length
    longer = np.where((lengths[0] >= lengths[1])[:, None], across, down)
    spread, detail = np.zeros((*hit.shape, 2), np.float32), np.zeros(hit.shape, np.float32)
    spread[hit] = 0.25 * (1 - width / length)[:, None] * longer / (atlas.width, atlas.height)
    detail[hit] = np.maximum(np.log2(np.maximum(np.maximum(0.5 * length, width), 1e-12)), FINEST)
    return Footprint(spread, detail)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("ij,ij->i", a, b)
