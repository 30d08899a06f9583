"""The network written plainly: the slow reference beside the fast paths of ``model.renderformer.network``.

Padded scenes with a mask over keys, the full material patch of every triangle, and in the view-dependent stage every view with
its own copy of the triangle tokens, its own keys and values and its own angles in every layer. Shares with the fast paths only
the parameters, the encodings and the DPT head, which have one form (section 3).
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from model.renderformer.layers import RotaryFrequencies, SelfAttention, merge_heads, sinusoids, split_heads
from model.renderformer.network import RenderFormer, from_patches, ray_directions, to_patches


def forward(
    model: RenderFormer, triangles: Tensor, vertex_normals: Tensor, patches: Tensor, mask: Tensor, camera_to_world: Tensor,
    fov_deg: Tensor, resolution: int,
) -> Tensor:  # fmt: skip
    """(B, N, 3, 3) twice, patches (B, N, C, P, P), mask (B, N), cameras (B, V, 4, 4), (B, V) -> (B, V, H, W, 3)."""
    tokens, positions, keys = encode(model, triangles, vertex_normals, patches, mask)
    views = fov_deg.shape[1]
    repeated = (x.repeat_interleave(views, dim=0) for x in (tokens, positions, keys))
    y = decode(model, *repeated, camera_to_world.flatten(0, 1), fov_deg.flatten(), resolution)
    return y.unflatten(0, (-1, views))


def encode(
    model: RenderFormer, triangles: Tensor, vertex_normals: Tensor, patches: Tensor, mask: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Tokens (B, S, d), their positions (B, S, 9) and which of them count as keys (B, S)."""
    config = model.config
    batch = len(triangles)
    patches = torch.cat([patches[:, :, :-3], torch.log10(1 + patches[:, :, -3:])], dim=2)
    x = model.tri_token + model.texture_encoder_norm(model.texture_encoder(patches.flatten(2)))
    x = x + model.vn_encoder_norm(model.vn_encoding_proj(sinusoids(vertex_normals.flatten(2), config.vn_pe_num_freqs)))
    positions = triangles.flatten(2)
    if config.pe_type == "nerf":
        encoded = sinusoids(positions, config.vertex_pe_num_freqs)
        x = x + model.tri_encoding_norm(model.tri_encoding_proj(encoded))
    registers = config.num_register_tokens
    if registers:
        weight = mask[:, :, None, None].to(triangles.dtype)
        mean = ((triangles * weight).sum(dim=(1, 2)) / (3 * weight.sum(dim=(1, 2)))).repeat(1, 3)
        x = torch.cat([model.reg_tokens.expand(batch, -1, -1), x], dim=1)
        positions = torch.cat([mean[:, None].expand(-1, registers, -1), positions], dim=1)
        mask = F.pad(mask, (registers, 0), value=True)
    rope = getattr(model.transformer, "rope_emb", None)
    for layer in model.transformer.layers:
        x = x + _self_attention(layer.multihead_attn, layer.query_norm(x), rope, positions, mask[:, None, None])
        x = x + layer.ffn(layer.ffn_norm(x))
    return x, positions, mask


def decode(
    model: RenderFormer, tokens: Tensor, positions: Tensor, mask: Tensor, camera_to_world: Tensor, fov_deg: Tensor,
    resolution: int,
) -> Tensor:  # fmt: skip
    """One view per row: tokens (B, S, d), positions (B, S, 9), mask (B, S), cameras (B, 4, 4), (B,) -> (B, H, W, 3)."""
    config, view = model.config, model.view_transformer
    side = resolution // config.patch_size
    directions = ray_directions(fov_deg, resolution, resolution)
    rotation, origin = camera_to_world[:, :3, :3], camera_to_world[:, :3, 3]
    if config.turn_to_cam_coord:
        points = torch.einsum("bsvi,bij->bsvj", positions.unflatten(-1, (3, 3)) - origin[:, None, None], rotation)
        points, origin = points.flatten(2), torch.zeros_like(origin)
    else:
        directions = torch.einsum("bij,bhwj->bhwi", rotation, directions)
        points = positions
    rays = to_patches(directions, config.patch_size)
    x = view.ray_map_encoder_norm(view.ray_map_encoder(rays)) + view.ray_map_patch_token
    at = origin.repeat(1, 3)[:, None].expand(-1, x.shape[1], -1)
    if config.pe_type == "nerf":
        encode = lambda p: view.token_pos_pe_norm(view.pe_token_proj(sinusoids(p, config.vertex_pe_num_freqs)))  # noqa: E731
        x, tokens = x + encode(at), tokens + encode(points)
    rope = getattr(view.transformer, "rope_emb", None)
    outputs = []
    for i, layer in enumerate(view.transformer.layers):
        cross, source = layer.multihead_attn, layer.kv_norm(tokens)
        q = _heads(cross.q_norm(cross.q_proj(layer.query_norm(x))), cross.heads, rope, at)
        k = _heads(cross.k_norm(cross.k_proj(source)), cross.heads, rope, points)
        v = split_heads(cross.v_proj(source), cross.heads)
        x = x + cross.out_proj(merge_heads(F.scaled_dot_product_attention(q, k, v, mask[:, None, None])))
        if layer.self_attn is not None:
            allowed = None
            if config.view_transformer_use_swin_attn:
                allowed = _windows(side, 4 if i % 2 else 0, x.device)
            # Swin's self-attention has no rotary encoding.
            self_rope = None if config.view_transformer_use_swin_attn else rope
            x = x + _self_attention(layer.self_attn, layer.self_attn_norm(x), self_rope, at, allowed)
        x = x + layer.ffn(layer.ffn_norm(x))
        outputs.append(x)
    if config.use_dpt_decoder:
        image = view.out_dpt([outputs[i] for i in config.dpt_layers], side, side)
    else:
        image = from_patches(view.out_proj(x), side, side, config.patch_size)
    return F.elu(image, alpha=1e-3).permute(0, 2, 3, 1)


def _heads(x: Tensor, heads: int, rope: RotaryFrequencies | None, positions: Tensor) -> Tensor:
    """(B, S, d) -> (B, heads, S, c), turned: x cos + [-x2, x1] sin with every angle twice."""
    x = split_heads(x, heads)
    if rope is None:
        return x
    cos, sin = (torch.cat([part, part], dim=-1)[:, None] for part in rope(positions, x.shape[-1]))
    a, b = x.chunk(2, dim=-1)
    return x * cos + torch.cat([-b, a], dim=-1) * sin


def _self_attention(
    attention: SelfAttention, x: Tensor, rope: RotaryFrequencies | None, positions: Tensor, mask: Tensor | None
) -> Tensor:
    q, k, v = attention.in_proj(x).chunk(3, dim=-1)
    q = _heads(attention.q_norm(q), attention.heads, rope, positions)
    k = _heads(attention.k_norm(k), attention.heads, rope, positions)
    v = split_heads(v, attention.heads)
    return attention.out_proj(merge_heads(F.scaled_dot_product_attention(q, k, v, mask)))


def _windows(side: int, shift: int, device: torch.device) -> Tensor:
    """(side^2, side^2) bool: pairs of tokens of one 8 x 8 window; shifted ones do not wrap around."""
    i = torch.arange(side, device=device)
    cell = (i - shift).div(8, rounding_mode="floor")
    window = (cell[:, None] * 1000 + cell[None, :]).flatten()
    return window[:, None] == window[None, :]
