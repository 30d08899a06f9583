"""Light of triangles in closed form: what a point receives and reflects where nothing is in the way.

Lights emit from both sides, with one radiance. Everything here is geometry: per unit of radiance, so light by light the
results scale and add. Materials are diffuse / pi + specular * GGX with alpha = roughness^2, without Fresnel.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

TINY = 1e-12


def dot(a: Tensor, b: Tensor) -> Tensor:
    """(..., 3), (..., 3) -> (...,); several times as fast as a sum over so short a dimension."""
    (ax, ay, az), (bx, by, bz) = a.unbind(dim=-1), b.unbind(dim=-1)
    return torch.addcmul(torch.addcmul(ax * bx, ay, by), az, bz)


def by_coordinates(coordinates: Sequence[Tensor]) -> Tensor:
    """Three (...,) -> (..., 3), each coordinate in memory of its own, where `dot` reads it fast."""
    return torch.stack(list(coordinates)).movedim(0, -1)


def vector_form_factor(points: Tensor, corners: Tensor) -> Tensor:
    """(..., 3) points, (..., 3, 3) corners -> (..., 3): its product with a normal is irradiance over pi times radiance.

    Lambert's formula: the sum over edges of the angle that an edge subtends times its plane's normal, over 2 pi. Exact for
    lights wholly above the horizon of that normal. It points to the light.
    """
    rays = [by_coordinates([x - y for x, y in zip(corner.unbind(-1), points.unbind(-1), strict=True)])
            for corner in corners.unbind(dim=-2)]  # fmt: skip
    total = sum(_edge(rays[i], rays[(i + 1) % 3]) for i in range(3)) / (2 * math.pi)
    return torch.where(dot(total, sum(rays))[..., None] < 0, -total, total)


def _edge(a: Tensor, b: Tensor) -> Tensor:
    """(..., 3): the normal of the plane of two rays, as long as the angle between them; their lengths do not matter."""
    (ax, ay, az), (bx, by, bz) = a.unbind(dim=-1), b.unbind(dim=-1)
    cross = by_coordinates([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
    sine = dot(cross, cross).sqrt()
    return cross * (torch.atan2(sine, dot(a, b)) / sine.clamp(min=TINY))[..., None]


def masking(alpha: Tensor, cosine: Tensor) -> Tensor:
    """Smith's G1 of GGX facets for directions at that cosine."""
    squared = cosine.square().clamp(min=TINY)
    return 2 / (1 + torch.sqrt(1 + alpha.square() * (1 - squared).clamp(min=0) / squared))


def joint_masking(alpha: Tensor, cosine_eye: Tensor, cosine_light: Tensor) -> Tensor:
    """Height-correlated masking and shadowing, G2."""
    return 1 / (1 / masking(alpha, cosine_eye) + 1 / masking(alpha, cosine_light) - 1)


def diffuse_light(factor: Tensor, normal: Tensor) -> Tensor:
    """(...,): radiance that a white diffuse surface reflects, per unit of the light's."""
    return dot(factor, normal).clamp(min=0)


def specular_light(factor: Tensor, normal: Tensor, to_eye: Tensor, alpha: Tensor) -> Tensor:
    """(...,): radiance that a white GGX surface reflects to the eye, per unit of the light's.

    The light stands for a disc of its solid angle. The lobe is widened by that disc, in the space of half vectors: a mirror
    shows the light's own radiance, a rough surface its irradiance times the lobe.
    """
    size = dot(factor, factor).sqrt()
    eye = dot(normal, to_eye)
    to_light = factor / size[..., None].clamp(min=TINY)
    light, between = dot(normal, to_light), dot(to_eye, to_light)
    length = (2 + 2 * between).clamp(min=TINY).sqrt()  # of the half vector, the sum of both directions
    facet, tilt = (eye + light) / length, ((1 + between) / length).clamp(min=1e-3)
    width = (alpha.square() + size / (4 * tilt)).clamp(max=1)  # solid angle / pi = size
    spread = width / (math.pi * (facet.square() * (width - 1) + 1).square())
    eye = eye.clamp(min=1e-3)
    shape = math.pi * size * spread * joint_masking(alpha, eye, light) / (4 * eye)
    return torch.where(light > 0, shape, 0)


def sum_over_lights(shares: Tensor, radiance: Tensor) -> Tensor:
    """(B, M, L) shares, (B, L, 3) radiance -> (B, M, 3); not in bfloat16, whatever the network is computed in."""
    with torch.autocast(shares.device.type, enabled=False):
        return shares @ radiance
