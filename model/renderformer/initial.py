"""An informed start for short runs: initial values that already say what is known about rays, materials and normals.

Rays: every ray bundle first attends to the triangles that lie in its own direction. With default initial values the
cross-attention of the view-dependent stage has to find out by itself where a triangle must be to be seen. In the camera
frame that is known: a vertex at depth z seen in direction (dx, dy, -1) lies at (z dx, z dy, -z). Rotary encoding turns key pair
i by f_i * coordinate, so a constant key and the query (cos f_i x, sin f_i x) at the expected coordinate x give the logit
cos f_i (coordinate - x), largest at the triangle.

Materials and normals: reflectances vary by less than the constants beside them, and normals are encoded up to frequencies that
tell neighbouring triangles apart but not lit from unlit ones; scaling both lets the embeddings start with what differs.

Materials and normals alone (``rays=False``) suit every variant, so that a comparison of variants can give all the same start.
Only initial values change: the network computes what it always computes (sections 3.1 and 3.2).
"""

from __future__ import annotations

import torch

from model.errors import InputError
from model.renderformer.inputs import kept_cells
from model.renderformer.network import RenderFormer

DIRECTION_GAIN = 3.0  # of a ray's mean direction in its embedding, beside a constant of 1
NOISE = 0.3  # share of the default initial values that is kept for variety
SHARPNESS = 6.0  # factor of the queries' norm: a ray starts with some 30 of 600 triangles
PAIR_WEIGHTS = (1.0, 1.0, 1.0, 0.7, 0.3, 0.1)  # per frequency, low to high: the expected angle is linear only while small
NEAR_WEIGHT = 0.5  # of the two lowest frequencies of the depth coordinate, whose cosine prefers near triangles
MATERIAL_MEAN = (0.25, 0.25, 0.25, 0.475, 0.475, 0.475, 0.3)  # diffuse, specular, roughness of the sampling law
MATERIAL_SCALE = 0.6  # standard deviation of the weights of those channels
EMISSION_SCALE = 0.3  # likewise of the last three channels, log10(1 + radiance)


def start_informed(model: RenderFormer, rays: bool = True) -> None:
    """Set the initial values in place; random numbers are torch's. ``rays`` needs rotary positions in the camera frame."""
    if rays:
        aim_rays(model)
    spread_materials(model)
    calm_normals(model)


@torch.no_grad()
def spread_materials(model: RenderFormer) -> None:
    """Centre the materials and give them weight; the same values for a patch of any size, as constant ones collapse."""
    encoder, channels = model.texture_encoder, model.config.texture_channels
    weight = torch.zeros(len(encoder.weight), channels)
    mean = torch.tensor(MATERIAL_MEAN)
    weight[:, : len(mean)] = torch.randn(len(weight), len(mean)) * MATERIAL_SCALE
    weight[:, -3:] = torch.randn(len(weight), 3) * EMISSION_SCALE
    kept = kept_cells(model.config.texture_encode_patch_size).flatten().to(weight.dtype)
    encoder.weight.copy_((weight[:, :, None] * kept / kept.sum()).flatten(1))
    encoder.bias.copy_(torch.randn(len(weight)) * 0.2 - weight[:, : len(mean)] @ mean)


@torch.no_grad()
def calm_normals(model: RenderFormer) -> None:
    """Divide the weights of each frequency of the vertex normals by it."""
    frequencies = (2.0 ** torch.arange(model.config.vn_pe_num_freqs)).repeat(9)
    model.vn_encoding_proj.weight.div_(torch.cat([torch.ones(9), frequencies, frequencies]))


@torch.no_grad()
def aim_rays(model: RenderFormer, depth: float = 1.75) -> None:
    """Set the initial values in place. ``depth``: expected distance of what is seen, in scene units (section 3.3's cameras)."""
    config = model.config
    if config.pe_type != "rope" or not config.turn_to_cam_coord:
        raise InputError(
            "train.informed_start=true needs rotary positions in the camera frame (model.pe_type=rope, "
            "model.turn_to_cam_coord=true); set train.informed_start=false for this model, or inputs"
        )
    view, dim, pixels = model.view_transformer, config.latent_dim, config.patch_size**2
    third = dim // 3
    groups = {"constant": slice(0, third), "x": slice(third, 2 * third), "y": slice(2 * third, 3 * third)}

    encoder = view.ray_map_encoder
    encoder.weight.mul_(NOISE)
    encoder.bias.copy_(0.95 * encoder.weight[:, 2 * pixels :].sum(dim=1))  # all rays point to about (0, 0, -1): take that out
    encoder.bias[groups["constant"]] += 1.0
    encoder.weight[groups["x"], :pixels] += DIRECTION_GAIN / pixels
    encoder.weight[groups["y"], pixels : 2 * pixels] += DIRECTION_GAIN / pixels

    model.tri_token.normal_()
    constant_key = model.tri_token.flatten() / model.tri_token.square().sum()
    frequencies = view.transformer.rope_emb.freqs.flatten().tolist()
    head_dim = view.transformer.head_dim
    for layer in view.transformer.layers:
        attention = layer.multihead_attn
        attention.q_proj.weight.mul_(NOISE)
        attention.k_proj.weight.mul_(NOISE)
        attention.q_norm.weight.mul_(SHARPNESS)
        for head in range(dim // head_dim):
            for coordinate in range(9):
                for k, frequency in enumerate(frequencies):
                    cosine = head * head_dim + coordinate * len(frequencies) + k
                    sine = cosine + head_dim // 2
                    attention.k_proj.weight[cosine] += 2 * constant_key
                    axis = "xyz"[coordinate % 3]
                    if axis == "z":
                        weight = NEAR_WEIGHT if k < 2 else 0.0
                    else:
                        weight = PAIR_WEIGHTS[min(k, len(PAIR_WEIGHTS) - 1)]
                        gain = weight * frequency * depth / DIRECTION_GAIN
                        attention.q_proj.weight[sine, groups[axis]] += gain / third
                    attention.q_proj.weight[cosine, groups["constant"]] += weight / third
