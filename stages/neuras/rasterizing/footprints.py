"""How many texels a pixel covers where it sees the mesh: which level of a texture's pyramid it needs."""

from __future__ import annotations

import numpy as np

from stages.graphics.cameras import Camera
from stages.neuras.rasterizing.casting import GBuffer
from stages.neuras.records import AtlasMesh

FINEST = -10.0  # a pixel that covers a thousandth of a texel's side


def detail(view: GBuffer, camera: Camera, atlas: AtlasMesh) -> np.ndarray:
    """(H, W) float32: log2 of the side of a square as large as a pixel's footprint, in texels; 0 where nothing is hit.

    The footprint is a parallelogram on the plane of the face: what texture coordinates change by along the image's two axes. A
    shader has the same from ``dFdx`` and ``dFdy``. Its area has a closed form: the pixel's solid angle, times the distance
    squared, over the cosine of incidence, times the face's texels per unit area.
    """
    hit = view.hit
    corners = np.asarray(atlas.vertices, float)[atlas.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])  # as long as twice the area
    twice = np.linalg.norm(normals, axis=1)
    flat = (atlas.uvs.astype(float) * (atlas.width, atlas.height))[atlas.faces]
    (x1, y1), (x2, y2) = (flat[:, 1] - flat[:, 0]).T, (flat[:, 2] - flat[:, 0]).T
    density = np.abs(x1 * y2 - x2 * y1) / np.maximum(twice, 1e-30)  # texels per unit area
    face, rays = view.face[hit], camera.directions()[hit]
    along = rays @ -camera.camera_to_world[:3, 2]
    cosine = np.abs(np.einsum("ij,ij->i", normals[face], rays)) / np.maximum(twice[face], 1e-30)
    solid_angle = along**3 / (camera.fx * camera.fy)
    area = density[face] * solid_angle * view.depth[hit].astype(float) ** 2 / np.maximum(cosine, 1e-6)
    out = np.zeros(hit.shape, np.float32)
    out[hit] = np.maximum(0.5 * np.log2(np.maximum(area, 1e-12)), FINEST)
    return out
