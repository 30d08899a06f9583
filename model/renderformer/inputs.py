"""What the network reads: scenes of triangles, packed one after the other, from padded arrays or batches of numpy arrays.

A triangle has one material (a vector of channels), or is textured (a patch of them). The material of a constant patch is its
vector: only textured triangles carry patches, so a batch needs 1/1024 of the released format's numbers (section 3, item 1).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from model.errors import InputError
from model.renderformer.layers import Segments

PATCH_NORMAL = (0.5, 0.5, 1.0)  # the released format's constant tangent-space normal
EMISSION = 3  # emission is the last three channels
REFLECTANCE = 7  # channels before the normal: diffuse, specular, roughness


@dataclass
class Triangles:
    """B scenes, packed: T triangles in all, scene after scene.

    triangles: (T, 3, 3) float32, world space. vertex_normals: (T, 3, 3).
    material: (T, C), C = 13 channels (diffuse 3, specular 3, roughness 1, normal 3, emission 3) or the 10 without the normal;
        emission as radiance. Not read where a triangle is textured.
    segments: triangles of each scene.
    patches: (K, C, P, P) of the textured triangles, zero where x + y > P; textured: (K,) int64, which triangles these are.
    """

    triangles: Tensor
    vertex_normals: Tensor
    material: Tensor
    segments: Segments
    patches: Tensor | None = None
    textured: Tensor | None = None

    @classmethod
    def pack(cls, triangles: Tensor, vertex_normals: Tensor, material: Tensor, mask: Tensor | None = None) -> Triangles:
        """From padded arrays: (B, N, 3, 3) twice, (B, N, C) or patches (B, N, C, P, P), mask (B, N), True = a triangle.

        Patches that are constant become the vector that they repeat.
        """
        if mask is None:
            mask = torch.ones(triangles.shape[:2], dtype=torch.bool, device=triangles.device)
        segments = Segments(mask.sum(dim=1).tolist())
        patches = textured = None
        if material.ndim == 5:
            full = material[mask]
            material = full[:, :, 0, 0][:, :, None, None]
            varies = (full != material * kept_cells(full.shape[-1], full.device)).flatten(1).any(dim=1)
            material = material[:, :, 0, 0]
            if varies.any():
                patches, textured = full[varies], varies.nonzero().flatten()
        else:
            material = material[mask]
        return cls(triangles[mask], vertex_normals[mask], material, segments, patches, textured)


def constant_material(diffuse: Tensor, specular: Tensor, roughness: Tensor, emission: Tensor, channels: int = 13) -> Tensor:
    """(..., 3), (..., 3), (...), (..., 3) -> (..., channels) in the released order."""
    parts = [diffuse, specular, roughness[..., None], emission]
    if channels == 13:
        parts.insert(REFLECTANCE - 4, diffuse.new_tensor(PATCH_NORMAL).expand(diffuse.shape))
    return torch.cat(parts, dim=-1)


def kept_cells(patch: int, device: torch.device | None = None) -> Tensor:
    """(P, P) bool: the half of a patch that a triangle covers, x + y <= P."""
    i = torch.arange(patch, device=device)
    return i[:, None] + i[None, :] <= patch


def material_patches(material: Tensor, patch: int) -> Tensor:
    """Constant materials (..., C) as the released format stores them, (..., C, P, P): zero outside the triangle."""
    return material[..., None, None] * kept_cells(patch, material.device).to(material.dtype)


def textured_patches(reflectance: Tensor, material: Tensor, patch: int) -> Tensor:
    """(K, 7, Q, Q) textures of triangles of constant (K, C) material else -> (K, C, P, P), P = ``patch`` dividing Q.

    A cell of the smaller patch is the mean of the texels of the larger one that it covers and that the triangle keeps.
    """
    size = reflectance.shape[-1]
    if size % patch:
        raise InputError(
            f"textures of {size} x {size} texels do not suit model.texture_encode_patch_size={patch}: it must divide {size}"
        )
    kept = kept_cells(size, reflectance.device).to(material.dtype)
    sums, weights = (F.avg_pool2d(x, size // patch) for x in (reflectance.to(material.dtype) * kept, kept[None]))
    full = material_patches(material, patch)
    means = sums / weights.clamp(min=torch.finfo(weights.dtype).tiny) * kept_cells(patch, kept.device)
    full[:, :REFLECTANCE] = means
    return full


def encode_emission(material: Tensor) -> Tensor:
    """(T, C, ...): emission enters as log10(1 + e); a new tensor, so that nothing is encoded twice."""
    reflectance, emission = material.split([material.shape[1] - EMISSION, EMISSION], dim=1)
    return torch.cat([reflectance, torch.log10(1 + emission)], dim=1)


def scenes_of(batch: Mapping[str, Any], channels: int = 13, patch: int = 32, device: torch.device | str = "cpu") -> Triangles:
    """The network's input from padded numpy arrays; only triangles that exist travel to the device.

    triangles, vertex_normals (B, N, 3, 3); diffuse, specular (B, N, 3); roughness (B, N); emission (B, N, 3) radiance; mask
    (B, N) bool; where any are textured patch_index (B, N), -1 or a row of patches (K, 7, Q, Q). ``channels`` and ``patch`` are
    the model's: it reads textures through patches of its own size, and with a size of 1 only the materials, their means.
    """
    mask = np.asarray(batch["mask"], bool)

    def put(array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(device, non_blocking=True)

    names = ("triangles", "vertex_normals", "diffuse", "specular", "roughness", "emission")
    arrays = {name: put(np.asarray(batch[name])[mask]) for name in names}
    material = constant_material(arrays["diffuse"], arrays["specular"], arrays["roughness"], arrays["emission"], channels)
    scenes = Triangles(arrays["triangles"], arrays["vertex_normals"], material, Segments(mask.sum(axis=1).tolist()))
    if patch > 1 and batch.get("patch_index") is not None:
        index = np.asarray(batch["patch_index"])[mask]
        rows = np.nonzero(index >= 0)[0]
        if len(rows):
            scenes.textured = put(rows)
            reflectance = put(np.asarray(batch["patches"])[index[rows]])
            scenes.patches = textured_patches(reflectance, material[scenes.textured], patch)
    return scenes
