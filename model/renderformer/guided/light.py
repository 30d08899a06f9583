"""Light of triangles in closed form: what a point receives and reflects where nothing is in the way.

Lights emit from both sides, with one radiance. Everything here is geometry: per unit of radiance, so light by light the
results scale and add. Materials are diffuse / pi + specular * GGX with alpha = roughness^2, without Fresnel.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

TINY = 1e-12


def vector_form_factor(points: Tensor, corners: Tensor) -> Tensor:
    """(..., 3) points, (..., 3, 3) corners -> (..., 3): its product with a normal is irradiance over pi times radiance.

    Lambert's formula: the sum over edges of the angle that an edge subtends times its plane's normal, over 2 pi. Exact for
    lights wholly above the horizon of that normal. It points to the light.
    """
    rays = corners - points[..., None, :]
    units = rays / rays.norm(dim=-1, keepdim=True).clamp(min=TINY)
    ahead = units.roll(-1, dims=-2)
    cross = torch.linalg.cross(units, ahead)
    sine = cross.norm(dim=-1, keepdim=True)
    angle = torch.atan2(sine, (units * ahead).sum(dim=-1, keepdim=True))
    total = (cross * (angle / sine.clamp(min=TINY))).sum(dim=-2) / (2 * math.pi)
    towards = (total * rays.sum(dim=-2)).sum(dim=-1, keepdim=True)
    return torch.where(towards < 0, -total, total)


def masking(alpha: Tensor, cosine: Tensor) -> Tensor:
    """Smith's G1 of GGX facets for directions at that cosine."""
    squared = cosine.square().clamp(min=TINY)
    return 2 / (1 + torch.sqrt(1 + alpha.square() * (1 - squared).clamp(min=0) / squared))


def joint_masking(alpha: Tensor, cosine_eye: Tensor, cosine_light: Tensor) -> Tensor:
    """Height-correlated masking and shadowing, G2."""
    return 1 / (1 / masking(alpha, cosine_eye) + 1 / masking(alpha, cosine_light) - 1)


def diffuse_light(factor: Tensor, normal: Tensor) -> Tensor:
    """(...,): radiance that a white diffuse surface reflects, per unit of the light's."""
    return (factor * normal).sum(dim=-1).clamp(min=0)


def specular_light(factor: Tensor, normal: Tensor, to_eye: Tensor, alpha: Tensor) -> Tensor:
    """(...,): radiance that a white GGX surface reflects to the eye, per unit of the light's.

    The light stands for a disc of its solid angle. The lobe is widened by that disc, in the space of half vectors: a mirror
    shows the light's own radiance, a rough surface its irradiance times the lobe.
    """
    size = factor.norm(dim=-1)
    to_light = factor / size[..., None].clamp(min=TINY)
    half = to_light + to_eye
    half = half / half.norm(dim=-1, keepdim=True).clamp(min=TINY)
    eye, light, facet = ((normal * x).sum(dim=-1) for x in (to_eye, to_light, half))
    tilt = (to_eye * half).sum(dim=-1).clamp(min=1e-3)
    width = (alpha.square() + size / (4 * tilt)).clamp(max=1)  # solid angle / pi = size
    spread = width / (math.pi * (facet.square() * (width - 1) + 1).square())
    eye = eye.clamp(min=1e-3)
    shape = math.pi * size * spread * joint_masking(alpha, eye, light) / (4 * eye)
    return torch.where(light > 0, shape, 0)
