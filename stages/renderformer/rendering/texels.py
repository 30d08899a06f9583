"""Outgoing diffuse radiance at the texel centres of triangles: what a triangle token should know of its own light
(paper, section 4.1 and figure 7).

Texels are those of the triangle patches (``SceneRecord.patches``): row and column count along the edges from corner 0 to
corner 2 and to corner 1, and cells with row + column > P stay 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.errors import UserError
from stages.graphics.geometry.measure import normal_vectors
from stages.graphics.mitsuba import backend as backends
from stages.renderformer.records import PATCH_CHANNELS, PATCH_SIDE, SceneRecord

HEIGHT = 1e-4  # scene units above a surface from where it is looked at
INSET = 1e-3  # least barycentric weight of a point: edges belong to nobody


def texel_weights(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Kept cells (P, P) bool, and the barycentric weights (kept, 3) of their centres.

    The centres of the last diagonal, row + column = P, lie just outside and are moved to the edge.
    """
    row, column = np.indices((size, size))
    kept = row + column <= size
    along_first, along_second = (column[kept] + 0.5) / size, (row[kept] + 0.5) / size
    weights = np.maximum(np.stack([1 - along_first - along_second, along_first, along_second], axis=1), INSET)
    return kept, weights / weights.sum(axis=1, keepdims=True)


def texel_radiance(
    scene: SceneRecord, triangles: Sequence[int], *, spp: int, seed: int, backend: dict[str, Any], size: int = 32
) -> tuple[np.ndarray, np.ndarray]:
    """Per light, the radiance that leaves the front of ``triangles`` (T indices) by diffuse reflection.

    Returns radiance (T, L, P, P, 3) float32, and (T, P, P) bool, which texels were met: a texel whose front another surface
    covers within ``HEIGHT`` is not. It is diffuse reflectance / pi times irradiance; needs a JIT backend.
    """
    from stages.renderformer.rendering.jit import JitRenderer, Limits

    backends.activate(backend)
    if backend["backend"] == "scalar":
        raise UserError("radiance at texels needs a JIT backend of Mitsuba, and none works here: " + backends.INSTALL)
    faces = np.asarray(triangles, np.int64)
    kept, weights = texel_weights(size)
    corners = scene.triangles[faces].astype(np.float64)
    cross = normal_vectors(corners)
    normals = cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-30)
    points = (weights @ corners).reshape(-1, 3)
    renderer = JitRenderer(scene, (1, 1), seed, Limits(33), lights_visible=True)
    sums = renderer.texel_sums(points, np.repeat(normals, len(weights), axis=0), HEIGHT, spp)
    met = (sums["triangle"].reshape(len(faces), -1) == faces[:, None]) & (scene.light_index[faces] < 0)[:, None]
    arriving = sums["lights"].reshape(len(faces), len(weights), -1, 3) / spp * met[..., None, None]
    radiance = np.zeros((len(faces), scene.n_lights, size, size, 3), np.float32)
    radiance[:, :, kept] = np.moveaxis(arriving * _diffuse(scene, faces, size)[:, kept][:, :, None], 2, 1)
    valid = np.zeros((len(faces), size, size), bool)
    valid[:, kept] = met
    return radiance, valid


def _diffuse(scene: SceneRecord, faces: np.ndarray, size: int) -> np.ndarray:
    """(T, P, P, 3) diffuse reflectance at the texel centres."""
    from scipy.ndimage import map_coordinates

    values = np.tile(scene.diffuse[faces][:, None, None], (1, size, size, 1)).astype(np.float32)
    place = (np.indices((size, size)) + 0.5) * (PATCH_SIDE / size) - 0.5
    for row in np.flatnonzero(scene.patch_index[faces] >= 0) if scene.textured else ():
        patch = scene.patches[scene.patch_index[faces[row]], PATCH_CHANNELS["diffuse"]].astype(np.float32)
        values[row] = np.stack([map_coordinates(channel, place, order=1, mode="nearest") for channel in patch], axis=-1)
    return values
