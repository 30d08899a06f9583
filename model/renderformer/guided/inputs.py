"""What a guided network reads: packed scenes with their lights, and what rays hit, as tensors.

Radiance is divided by one scale per scene, so that the network is homogeneous: twice the light gives twice the image.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from model.errors import InputError
from model.renderformer.guided.light import dot
from model.renderformer.layers import Segments

SUBSAMPLES = 4  # rays of a pixel
MIN_ALPHA = 1e-4
# Barycentric weights (4, 3) of the points of a triangle whose view of the lights is known
POINTS = ((4 / 6, 1 / 6, 1 / 6), (1 / 6, 4 / 6, 1 / 6), (1 / 6, 1 / 6, 4 / 6), (1 / 3, 1 / 3, 1 / 3))


@dataclass
class Scenes:
    """B scenes, their T triangles packed one scene after the other; L lights are emitting triangles, padded.

    corners, vertex_normals: (T, 3, 3), world. diffuse, specular: (T, 3); roughness: (T,); emitters are black.
    emission: (T, 3), and radiance (B, L, 3), of the lights: over ``scale`` (B,). light_corners: (B, L, 3, 3).
    seen: (T, 4, L), which lights the triangle's points see, 0 to 1. segments: triangles of each scene.
    bounces: (1, T 2 R) hits of the R rays that leave each triangle's front, then its back, spread by cosine; or None.
    vertex: (T, 3), corners of one number lie at one place of one smooth surface; only with ``bounces``.
    textures: (K, 7, P, P) diffuse, specular and roughness of some triangles; texture_row: (T,), -1 for the others; or None.
    """

    corners: Tensor
    vertex_normals: Tensor
    diffuse: Tensor
    specular: Tensor
    roughness: Tensor
    emission: Tensor
    scale: Tensor
    light_corners: Tensor
    radiance: Tensor
    seen: Tensor
    segments: Segments
    bounces: Hits | None = None
    vertex: Tensor | None = None
    textures: Tensor | None = None
    texture_row: Tensor | None = None

    @property
    def offsets(self) -> Tensor:
        """(B,), the row of each scene's first triangle."""
        lengths = torch.tensor([0, *self.segments.lengths[:-1]], device=self.corners.device)
        return lengths.cumsum(0)

    @cached_property
    def face_normals(self) -> Tensor:
        """(T, 3), unit."""
        return F.normalize(_cross(self.corners), dim=-1, eps=1e-20)

    @cached_property
    def areas(self) -> Tensor:
        """(T,)."""
        return _cross(self.corners).norm(dim=-1) / 2

    @property
    def scene_of(self) -> Tensor:
        """(T,), the scene of each triangle."""
        return self.segments.index(self.corners.device)

    @classmethod
    def read(cls, batch: Mapping[str, Any], device: torch.device | str, bounces: bool = True) -> Scenes:
        """From padded numpy arrays (``stages.renderformer.dataset`` lists them); InputError where they lack guides.

        bounces: whether those are read, too.
        """
        for name, setting in (("light_triangles", "guides"), ("bounces", "bounces")):
            if f"guide_{name}" not in batch and (name != "bounces" or bounces):
                raise InputError(
                    f"a guided model reads {setting}, and the data has none: make the shards with shard.{setting}=true "
                    "(model=guided does)"
                )
        mask = np.asarray(batch["mask"], bool)

        def put(name: str) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(np.asarray(batch[name])[mask])).to(device, non_blocking=True)

        segments = Segments(mask.sum(axis=1).tolist())
        corners, emission = put("triangles"), put("emission")
        lights = torch.from_numpy(np.asarray(batch["guide_light_triangles"]).astype(np.int64)).to(device)  # (B, L)
        first = torch.tensor([0, *segments.lengths[:-1]], device=device).cumsum(0)
        exists = lights >= 0
        rows = (lights.clamp(min=0) + first[:, None]).clamp(max=max(len(corners) - 1, 0))
        light_corners = corners[rows]
        radiance = emission[rows] * exists[..., None]
        a, b, c = light_corners.unbind(dim=-2)
        areas = torch.linalg.cross(b - a, c - a).norm(dim=-1) / 2
        # What lights at the usual distance of 2.4 shed on the scene: dark surfaces end up near 0.2.
        scale = 0.2 / (4.8 * torch.pi) * (radiance.mean(dim=-1) * areas * exists).sum(dim=1)
        unit = scale.clamp(min=torch.finfo(torch.float32).tiny)
        emits = torch.zeros(len(corners), device=device)
        emits[rows[exists]] = 1
        reflects = (1 - emits)[:, None]
        scenes = cls(
            corners,
            put("vertex_normals"),
            put("diffuse") * reflects,
            put("specular") * reflects,
            put("roughness"),
            emission / unit[segments.index(corners.device)][:, None],
            scale,
            light_corners,
            radiance / unit[:, None, None],
            put("guide_triangle_seen").float(),
            segments,
        )
        if bounces:
            scene = segments.index(corners.device)
            scenes.bounces = _bounces(put("guide_bounces"), put("guide_bounces_weights"), first[scene])
            scenes.vertex = put("guide_vertex").long() + 3 * first[scene][:, None]
        if batch.get("patch_index") is not None and len(batch["patches"]):
            scenes.texture_row = put("patch_index").long()
            scenes.textures = torch.from_numpy(np.asarray(batch["patches"], np.float32)).to(device)
        return scenes


def _cross(corners: Tensor) -> Tensor:
    """(T, 3, 3) -> (T, 3): normals, twice as long as the triangles are large."""
    a, b, c = corners.unbind(dim=1)
    return torch.linalg.cross(b - a, c - a)


@dataclass
class Hits:
    """Where rays land, (B, M) of them: rows of the packed triangles (0 where ``there`` is 0), weights (B, M, 3) of corners."""

    triangle: Tensor
    weights: Tensor
    there: Tensor  # (B, M, 1), 1 or 0

    @classmethod
    def read(cls, triangle: np.ndarray, weights: np.ndarray, scenes: Scenes) -> Hits:
        """(B, ...) rows of each scene's triangles, -1 for nothing, and (B, ..., 2) weights of the second and third corner."""
        device = scenes.corners.device
        rows = torch.from_numpy(np.ascontiguousarray(triangle)).to(device).long().flatten(1)
        weights_two = torch.from_numpy(np.ascontiguousarray(weights)).to(device).float().reshape(*rows.shape, 2)
        there = rows >= 0
        rows = torch.where(there, rows + scenes.offsets[:, None], 0)
        return cls(rows, all_weights(weights_two), there[..., None].float())

    def interpolate(self, values: Tensor, rows: Tensor | None = None) -> Tensor:
        """(T, 3, C) of corners -> (B, M, C). rows: (B, M) into ``values``, where they are not one for each triangle."""
        return weighted(values[self.triangle if rows is None else rows], self.weights)

    def sides(self, scenes: Scenes, to_eye: Tensor) -> Tensor:
        """(B, M): 2 t where triangle t is seen from its front, 2 t + 1 from its back. to_eye: (B, M, 3)."""
        return 2 * self.triangle + (dot(to_eye, scenes.face_normals[self.triangle]) < 0).long()

    def between_points(self, values: Tensor, rows: Tensor | None = None) -> Tensor:
        """(T, 4, C), of the triangles' ``POINTS`` -> (B, M, C): linear within each triangle of two corners and the centroid.

        rows: (B, M) into ``values``, where they are not one for each triangle.
        """
        least = self.weights.min(dim=-1, keepdim=True).values
        shares = torch.cat([self.weights - least, 3 * least], dim=-1)
        return weighted(values[self.triangle if rows is None else rows], shares)


def all_weights(two: Tensor) -> Tensor:
    """(..., 2) barycentric weights of the second and third corner -> (..., 3)."""
    return torch.cat([(1 - two.sum(dim=-1, keepdim=True)).clamp(min=0), two], dim=-1)


def _bounces(triangle: Tensor, weights: Tensor, first: Tensor) -> Hits:
    """(T, 2, R) rows within each triangle's scene, (T, 2, R, 2) weights, (T,) the scene's first row."""
    there = (triangle >= 0).reshape(1, -1, 1)
    rows = torch.where(triangle >= 0, triangle.long() + first[:, None, None], 0)
    return Hits(rows.reshape(1, -1), all_weights(weights.reshape(1, -1, 2)), there.float())


def weighted(values: Tensor, weights: Tensor) -> Tensor:
    """(..., K, C), (..., K) -> (..., C): the sum over K, of few; faster than a reduction."""
    total = values[..., 0, :] * weights[..., 0, None]
    for k in range(1, values.shape[-2]):
        total = torch.addcmul(total, values[..., k, :], weights[..., k, None])
    return total


@dataclass
class Surface:
    """What is at hits, (B, M, ...): position, shading normal on the side of the eye, direction to the eye; materials."""

    position: Tensor
    normal: Tensor
    to_eye: Tensor
    diffuse: Tensor
    specular: Tensor
    roughness: Tensor  # (B, M, 1)
    there: Tensor

    @classmethod
    def at(cls, hits: Hits, scenes: Scenes, eye: Tensor) -> Surface:
        """eye: (B, M, 3), where the rays come from."""
        position = hits.interpolate(scenes.corners)
        to_eye = F.normalize(eye - position, dim=-1)
        normal = F.normalize(hits.interpolate(scenes.vertex_normals), dim=-1)
        normal = torch.where(dot(normal, to_eye)[..., None] < 0, -normal, normal)
        diffuse, specular = scenes.diffuse[hits.triangle], scenes.specular[hits.triangle]
        roughness = scenes.roughness[hits.triangle][..., None]
        if scenes.textures is not None:
            diffuse, specular, roughness = _textured(hits, scenes, diffuse, specular, roughness)
        surface = cls(position, normal, to_eye, diffuse, specular, roughness, hits.there)
        return Surface(**{name: value * hits.there for name, value in vars(surface).items()})

    @property
    def alpha(self) -> Tensor:
        """(B, M), GGX width."""
        return self.roughness[..., 0].square().clamp(min=MIN_ALPHA)

    @property
    def mirrored(self) -> Tensor:
        """(B, M, 3), the direction in which a mirror sends the ray."""
        return 2 * dot(self.to_eye, self.normal)[..., None] * self.normal - self.to_eye


def _textured(hits: Hits, scenes: Scenes, *plain: Tensor) -> list[Tensor]:
    """Diffuse, specular and roughness with the texel at each hit of a textured triangle."""
    row = scenes.texture_row[hits.triangle]
    side = scenes.textures.shape[-1]
    column, line = (hits.weights[..., 1:] * side).long().clamp(max=side - 1).unbind(dim=-1)
    texel = scenes.textures[row.clamp(min=0), :, line, column]  # (B, M, 7)
    textured = (row >= 0)[..., None]
    return [torch.where(textured, part, value) for part, value in zip(texel.split([3, 3, 1], -1), plain, strict=True)]
