"""How many floating-point operations the network needs, and how many a device can do: for utilisation and cost estimates.

Counted are matrix products, convolutions and attention, a multiplication and an addition as two; everything else is below a
hundredth. A training step counts as three forward passes, recomputation not included ("model FLOPs").
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence

import torch

from model.renderformer.config import ModelConfig
from model.timing import fastest

TRAINING = 3  # forward passes' worth of a training step: forward, gradients of activations, gradients of weights
ENCODER_PARTS = ("embedding", "encoder layers", "encoder attention")  # the rest is of the view-dependent stage


def forward_flops(
    config: ModelConfig, triangles: Sequence[int], views: int, height: int, width: int, textured: int = 0
) -> dict[str, float]:
    """FLOPs of a forward pass by part, for scenes of so many triangles, each seen by ``views`` cameras.

    ``textured`` triangles of them carry full patches.
    """
    d, patch = config.latent_dim, config.texture_encode_patch_size
    lengths = [config.num_register_tokens + n for n in triangles]
    tokens, total, scenes = sum(lengths), sum(triangles), len(lengths)
    h, w = height // config.patch_size, width // config.patch_size
    grid, rays = h * w, scenes * views * h * w
    layers, view_layers, hidden = config.num_layers, config.view_transformer_n_layers, config.view_transformer_ffn_hidden_dim

    embedding = total * (config.texture_channels + 9 * (1 + 2 * config.vn_pe_num_freqs)) * d
    embedding += textured * config.texture_channels * patch**2 * d
    sources = tokens  # rows of the keys' and values' projection
    if config.pe_type == "nerf":
        encoding = 9 * (1 + 2 * config.vertex_pe_num_freqs) * d
        embedding += total * encoding
        sources = views * tokens
    window = 64 if config.view_transformer_use_swin_attn else grid
    self_attention = config.view_transformer_include_self_attn
    parts = {
        "embedding": embedding,
        "encoder layers": layers * tokens * (4 * d * d + 3 * d * config.dim_feedforward),
        "encoder attention": layers * 2 * d * sum(n * n for n in lengths),
        "rays": rays * 3 * config.patch_size**2 * d + (views * (tokens + scenes) * encoding if config.pe_type == "nerf" else 0),
        "keys and values": view_layers * sources * 2 * d * d,
        "decoder layers": view_layers * rays * (2 * d * d + 4 * d * d * self_attention + 3 * d * hidden),
        "cross-attention": view_layers * 2 * d * views * grid * tokens,
        "self-attention": view_layers * 2 * d * rays * window * self_attention,
        "head": scenes * views * _dpt(config, h, w) if config.use_dpt_decoder else rays * d * 3 * config.patch_size**2,
    }
    return {name: 2.0 * count for name, count in parts.items()}


def _dpt(config: ModelConfig, h: int, w: int) -> int:
    """Multiplications of the DPT head for one image of h x w tokens."""
    d, features, channels = config.latent_dim, config.dpt_features, config.dpt_out_channels
    pixels = [16 * h * w, 4 * h * w, h * w, ((h + 1) // 2) * ((w + 1) // 2)]
    count = h * w * d * sum(channels)
    count += h * w * (16 * channels[0] ** 2 + 4 * channels[1] ** 2) + pixels[3] * 9 * channels[3] ** 2
    for level, size in enumerate(pixels):
        units = 1 if level == 3 else 2  # of two 3 x 3 convolutions
        count += size * (9 * channels[level] * features + units * 18 * features**2 + features**2)
    count += 64 * h * w * 9 * features * (features // 2)
    return count + config.patch_size**2 * h * w * (9 * (features // 2) * 32 + 32 * 3)


def ideal_seconds(parts: Mapping[str, float], peaks: Mapping[str, float], precision: str) -> float:
    """Time that the parts would take at the peak rates ("float32", "bfloat16"), in FLOP/s, of their precisions."""
    seconds = 0.0
    for name, count in parts.items():
        low = precision == "bf16" or (precision == "mixed" and name in ENCODER_PARTS)
        seconds += count / peaks["bfloat16" if low else "float32"]
    return seconds


@functools.cache
def peak_flops(device: str, dtype: str, size: int = 0) -> float:
    """FLOP/s of a large ``torch.mm``, the best of several: what this device reaches, rather than what its data sheet says."""
    size = size or (8192 if device.startswith("cuda") else 1024)
    random = torch.Generator(device).manual_seed(0)  # its own: a run's random numbers stay what they were
    a, b = (torch.randn(size, size, device=device, generator=random).to(getattr(torch, dtype)) for _ in range(2))
    return 2 * size**3 / fastest(lambda: torch.mm(a, b), device, repeats=8)
