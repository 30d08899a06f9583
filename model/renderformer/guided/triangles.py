"""What is known of a scene's triangles without any weights: how lamps light them, and how they light one another.

The latter is radiosity (Goral et al. 1984): what a triangle receives from others is the mean of what the rays that leave it
hit, bounce after bounce. All materials pass on light as if they were diffuse there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from model.renderformer.guided.config import GuideConfig
from model.renderformer.guided.inputs import POINTS, Hits, Scenes
from model.renderformer.guided.light import dot, vector_form_factor

FREQUENCIES = 4  # of an encoded position: pi, 2 pi, 4 pi, 8 pi
BOUNCES = 12  # between triangles: of light that seldom is absorbed a tenth is left then


@dataclass
class Lit:
    """Radiance that white diffuse triangles reflect, front and back, over s; kept between views.

    light: (T, 2, 4, 3), of lamps, at each point of the triangle. open_light: (T, 2, 3), the same at the centroid with nothing
    in the way. bounced: (T, 2, 3, 3), of other triangles, at each corner; None without that guide.
    """

    light: Tensor
    open_light: Tensor
    bounced: Tensor | None


@torch.no_grad()
def light_triangles(scenes: Scenes, guide: GuideConfig) -> Lit:
    """In closed form, and by radiosity where that is a guide."""
    weights = torch.tensor(POINTS, device=scenes.corners.device)
    points = torch.einsum("kc,tcd->tkd", weights, scenes.corners)
    scene = scenes.scene_of
    lights, radiance = scenes.light_corners[scene], scenes.radiance[scene]  # (T, L, 3, 3), (T, L, 3)
    factor = vector_form_factor(points[:, :, None], lights[:, None])  # (T, 4, L, 3)
    cosine = dot(factor, scenes.face_normals[:, None, None])
    sides = torch.stack([cosine, -cosine], dim=1).clamp(min=0)  # (T, 2, 4, L)
    seen = scenes.seen[:, None] if guide.visibility else 1.0
    light = ((sides * seen)[..., None] * radiance[:, None, None]).sum(dim=-2)
    open_light = (sides[:, :, 3, :, None] * radiance[:, None]).sum(dim=-2)
    return Lit(light, open_light, bounce(scenes, light) if guide.bounces else None)


def bounce(scenes: Scenes, light: Tensor) -> Tensor:
    """(T, 2, 4, 3) light of lamps -> (T, 2, 3, 3) light of other triangles at corners."""
    hits: Hits = scenes.bounces
    rays = hits.triangle.shape[1] // max(1, 2 * len(light))
    start = scenes.corners.mean(dim=1).repeat_interleave(2 * rays, dim=0)
    rows = hits.sides(scenes, start[None] - hits.interpolate(scenes.corners))
    albedo = ((scenes.diffuse + scenes.specular)[hits.triangle] * hits.there)[0]
    first = albedo * hits.between_points(light.flatten(0, 1), rows)[0]
    bounced = torch.zeros_like(light[:, :, 0])
    for _ in range(BOUNCES):
        bounced = (first + albedo * bounced.flatten(0, 1)[rows[0]]).unflatten(0, (-1, 2, rays)).mean(dim=2)
    return _at_corners(scenes, bounced)


def _at_corners(scenes: Scenes, values: Tensor) -> Tensor:
    """(T, 2, C) of triangles' sides -> (T, 2, 3, C): at each vertex the mean of the triangles that share it, by area.

    A vertex has the sides of its normal. A triangle that faces away from its vertices' normals takes them the other way round.
    """
    facing = dot(scenes.face_normals[:, None], scenes.vertex_normals) >= 0  # (T, 3)
    corners = values[:, :, None].expand(-1, 2, 3, -1)
    corners = torch.where(facing[:, None, :, None], corners, corners.flip(1))
    vertex = scenes.vertex.flatten()
    areas = scenes.areas[:, None].expand(-1, 3).clamp(min=torch.finfo(torch.float32).tiny)
    total = areas.new_zeros(3 * len(values)).index_add(0, vertex, areas.flatten())
    weighted = (corners * areas[:, None, :, None]).transpose(1, 2).flatten(0, 1)  # (3 T, 2, C)
    sums = torch.zeros_like(weighted).index_add(0, vertex, weighted)
    mean = (
        (sums / total.clamp(min=torch.finfo(torch.float32).tiny)[:, None, None])[vertex].unflatten(0, (-1, 3)).transpose(1, 2)
    )
    return torch.where(facing[:, None, :, None], mean, mean.flip(1))


@torch.no_grad()
def token_features(scenes: Scenes, lit: Lit, guide: GuideConfig) -> Tensor:
    """(T, ``token_features`` of the config)."""
    corners = scenes.corners
    centroid = corners.mean(dim=1)
    roughness = scenes.roughness[:, None]
    light = torch.cat([lit.open_light.flatten(1), lit.light[:, 0].flatten(1), lit.light[:, 1].mean(dim=1)], dim=1)
    if not guide.light:
        light = torch.zeros_like(light)
    elif not guide.visibility:
        light = torch.cat([light[:, :6], torch.zeros_like(light[:, 6:])], dim=1)
    bounced = [] if lit.bounced is None else [torch.log1p(lit.bounced.mean(dim=2).flatten(1))]
    return torch.cat(
        [
            encode_position(centroid),
            ((corners - centroid[:, None]) * 8).flatten(1),
            scenes.face_normals,
            scenes.vertex_normals.flatten(1),
            torch.log10(scenes.areas[:, None].clamp(min=1e-12)) / 3 + 1,
            scenes.diffuse,
            scenes.specular,
            roughness,
            roughness.clamp(min=1e-2).log(),
            (scenes.emission.sum(dim=1, keepdim=True) > 0).float(),
            torch.log10(1 + scenes.emission),
            torch.log1p(light),
            *bounced,
        ],
        dim=1,
    )


def encode_position(positions: Tensor) -> Tensor:
    """(..., 3) -> (..., 27): the position, and sines and cosines of pi 2^0..3 times it."""
    frequencies = math.pi * 2.0 ** torch.arange(FREQUENCIES, device=positions.device)
    angles = (positions[..., None] * frequencies).flatten(-2)
    return torch.cat([positions, angles.sin(), angles.cos()], dim=-1)
