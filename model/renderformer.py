"""RenderFormer: triangles to tokens, ray bundles to pixels (sections 3.1 and 3.2).

Computes exactly what the released checkpoints compute (``tests/parity.py``), with three shortcuts that change nothing:
constant materials skip the patch, triangles' keys and values are projected once for all views of a scene, and rotary
angles are computed once per stage. ``encode`` once and ``decode`` many views, or call the model for both.
"""

from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.config import ModelConfig
from model.dpt import DPTHead
from model.layers import (
    EMBEDDING_EPS,
    DecoderLayer,
    EncoderLayer,
    RotaryFrequencies,
    Rotation,
    Windows,
    rotate,
    sinusoids,
)

PATCH_NORMAL = (0.5, 0.5, 1.0)  # the released format's constant tangent-space normal
EMISSION = 3  # emission is the last three channels


@dataclass
class Triangles:
    """A batch of scenes as the network reads them, padded to one triangle count.

    triangles: (B, N, 3, 3) float32, world space. vertex_normals: (B, N, 3, 3).
    material: (B, N, C) where every triangle is of one material, or patches (B, N, C, P, P); C = 13 channels (diffuse 3,
        specular 3, roughness 1, normal 3, emission 3) or the 10 without the normal; emission as radiance.
    mask: (B, N) bool, True where a triangle exists; None where all do.
    """

    triangles: Tensor
    vertex_normals: Tensor
    material: Tensor
    mask: Tensor | None = None


def constant_material(diffuse: Tensor, specular: Tensor, roughness: Tensor, emission: Tensor, channels: int = 13) -> Tensor:
    """(..., 3), (..., 3), (...), (..., 3) -> (..., channels) in the released order."""
    parts = [diffuse, specular, roughness[..., None], emission]
    if channels == 13:
        parts.insert(3, diffuse.new_tensor(PATCH_NORMAL).expand(diffuse.shape))
    return torch.cat(parts, dim=-1)


def kept_cells(patch: int, device: torch.device | None = None) -> Tensor:
    """(P, P) bool: the half of a patch that a triangle covers, x + y <= P."""
    i = torch.arange(patch, device=device)
    return i[:, None] + i[None, :] <= patch


def material_patches(material: Tensor, patch: int) -> Tensor:
    """Constant materials (..., C) as the released format stores them, (..., C, P, P): zero outside the triangle."""
    return material[..., None, None] * kept_cells(patch, material.device).to(material.dtype)


def encode_emission(material: Tensor, dim: int) -> Tensor:
    """Emission enters as log10(1 + e); a new tensor, so that nothing is encoded twice."""
    rest, emission = material.split([material.shape[dim] - EMISSION, EMISSION], dim=dim)
    return torch.cat([rest, torch.log10(1 + emission)], dim=dim)


def ray_directions(fov_deg: Tensor, height: int, width: int) -> Tensor:
    """(...,) full angle across the height -> (..., height, width, 3) unit directions in camera space, at pixel centres."""
    device = fov_deg.device
    focal = (height / 2) / torch.tan(torch.deg2rad(fov_deg) / 2)
    y = torch.arange(height, device=device, dtype=torch.float32) + 0.5 - height / 2
    x = torch.arange(width, device=device, dtype=torch.float32) + 0.5 - width / 2
    shape = (*fov_deg.shape, height, width)
    directions = torch.stack(
        [
            (x / focal[..., None])[..., None, :].expand(shape),
            (-y / focal[..., None])[..., :, None].expand(shape),
            torch.full(shape, -1.0, device=device),
        ],
        dim=-1,
    )
    return F.normalize(directions, dim=-1)


def to_patches(image: Tensor, patch: int) -> Tensor:
    """(B, H, W, 3) -> (B, tokens, 3 patch^2), channel-major within a token."""
    batch, height, width, channels = image.shape
    grid = image.view(batch, height // patch, patch, width // patch, patch, channels)
    return grid.permute(0, 1, 3, 5, 2, 4).reshape(batch, -1, channels * patch * patch)


def from_patches(tokens: Tensor, h: int, w: int, patch: int) -> Tensor:
    """(B, h w, 3 patch^2), channel-major within a token -> (B, 3, h patch, w patch)."""
    batch = tokens.shape[0]
    grid = tokens.view(batch, h, w, 3, patch, patch)
    return grid.permute(0, 3, 1, 4, 2, 5).reshape(batch, 3, h * patch, w * patch)


class Encoder(nn.Module):
    """The view-independent transformer; the frequencies are stored even with no layers."""

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.head_dim = config.latent_dim // config.num_heads
        self.layers = nn.ModuleList(
            EncoderLayer(config.latent_dim, config.num_heads, config.dim_feedforward) for _ in range(config.num_layers)
        )
        if config.pe_type == "rope":
            self.rope_emb = RotaryFrequencies(config.vertex_pe_num_freqs, config.rope_double_max_freq)

    def forward(self, x: Tensor, positions: Tensor, mask: Tensor | None) -> Tensor:
        """x: (B, S, d); positions: (B, S, 9); mask: (B, 1, 1, S)."""
        rotation = None
        if hasattr(self, "rope_emb") and len(self.layers):
            cos, sin = self.rope_emb(positions, self.head_dim)
            rotation = cos[:, None], sin[:, None]
        for layer in self.layers:
            x = layer(x, rotation, mask)
        return x


class Decoder(nn.Module):
    """The view-dependent transformer's layers."""

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.head_dim = config.latent_dim // config.view_transformer_n_heads
        self.layers = nn.ModuleList(
            DecoderLayer(
                config.latent_dim,
                config.view_transformer_n_heads,
                config.view_transformer_ffn_hidden_dim,
                config.view_transformer_include_self_attn,
            )
            for _ in range(config.view_transformer_n_layers)
        )
        if config.pe_type == "rope":
            self.rope_emb = RotaryFrequencies(config.view_pe_num_freqs, config.rope_double_max_freq)


class ViewTransformer(nn.Module):
    """Ray bundles look at the triangle tokens and become pixels."""

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.config = config
        dim, pixels = config.latent_dim, 3 * config.patch_size**2
        self.ray_map_patch_token = nn.Parameter(torch.randn(1, 1, dim) * 0.02)
        self.ray_map_encoder = nn.Linear(pixels, dim)
        self.ray_map_encoder_norm = nn.RMSNorm(dim, EMBEDDING_EPS)
        if config.pe_type == "nerf":
            self.pe_token_proj = nn.Linear(9 * (1 + 2 * config.vertex_pe_num_freqs), dim)
            self.token_pos_pe_norm = nn.RMSNorm(dim, EMBEDDING_EPS)
        self.transformer = Decoder(config)
        if config.use_dpt_decoder:
            self.out_dpt = DPTHead(dim, config.dpt_features, config.dpt_out_channels, config.patch_size)
        else:
            self.out_proj = nn.Linear(dim, pixels)
        self.gradient_leak = 0.0
        self._start_bright()

    def _start_bright(self) -> None:
        """Start near a constant grey: ELU with alpha 1e-3 passes next to no gradient to pixels that start negative."""
        last = self.out_dpt.scratch.output_conv2[2] if self.config.use_dpt_decoder else self.out_proj
        with torch.no_grad():
            last.weight.mul_(0.1)
            last.bias.fill_(0.1)

    def _encode_position(self, positions: Tensor) -> Tensor:
        return self.token_pos_pe_norm(self.pe_token_proj(sinusoids(positions, self.config.vertex_pe_num_freqs)))

    def forward(
        self, tokens: Tensor, positions: Tensor, mask: Tensor | None, camera_to_world: Tensor, fov_deg: Tensor,
        height: int, width: int,
    ) -> Tensor:  # fmt: skip
        """tokens: (B, S, d); positions: (B, S, 9) world; mask: (B, 1, 1, S); cameras (B, V, 4, 4), (B, V).

        Returns (B, V, height, width, 3), log10(1 + radiance).
        """
        config = self.config
        batch, views = fov_deg.shape
        h, w = height // config.patch_size, width // config.patch_size
        directions = ray_directions(fov_deg, height, width)  # (B, V, H, W, 3)
        rotation_cw, origin = camera_to_world[..., :3, :3], camera_to_world[..., :3, 3]
        points = positions.unflatten(-1, (3, 3))[:, None]  # (B, 1, S, 3 vertices, 3)
        if config.turn_to_cam_coord:
            # World to camera: p_c = R^T (p - o), as row vectors (p - o) R.
            points = (points - origin[:, :, None, None]) @ rotation_cw[:, :, None]
            origin = torch.zeros_like(origin)
        else:
            directions = directions @ rotation_cw[:, :, None].transpose(-1, -2)
            points = points.expand(-1, views, -1, -1, -1)
        points = points.flatten(-2)  # (B, V, S, 9)
        origins = origin.repeat(1, 1, 3)[:, :, None]  # (B, V, 1, 9): every ray of a view starts at its camera

        rays = to_patches(directions.flatten(0, 1), config.patch_size)
        x = self.ray_map_encoder_norm(self.ray_map_encoder(rays)) + self.ray_map_patch_token  # (B V, T, d)
        if mask is not None:
            mask = mask[:, None].expand(-1, views, -1, -1, -1).flatten(0, 1)

        key_rotation: Rotation | None = None
        ray_rotation: Rotation | None = None
        if config.pe_type == "rope":
            head_dim = self.transformer.head_dim
            cos, sin = self.transformer.rope_emb(points, head_dim)
            key_rotation = cos[:, :, None], sin[:, :, None]  # (B, V, 1, S, c / 2)
            if not config.turn_to_cam_coord:  # in the camera frame the rays sit at 0: no turn
                cos, sin = self.transformer.rope_emb(origins, head_dim)
                ray_rotation = cos.flatten(0, 1)[:, None], sin.flatten(0, 1)[:, None]  # (B V, 1, 1, c / 2)
            tokens = tokens[:, None]  # (B, 1, S, d): projected once for all views
        else:
            x = x + self._encode_position(origins).flatten(0, 1)
            tokens = tokens[:, None] + self._encode_position(points)  # (B, V, S, d)

        outputs = []
        for i, layer in enumerate(self.transformer.layers):
            keys, values = layer.multihead_attn.keys_values(layer.kv_norm(tokens))
            keys = rotate(keys, key_rotation).expand(-1, views, -1, -1, -1).flatten(0, 1)
            values = values.expand(-1, views, -1, -1, -1).flatten(0, 1)
            windows = Windows(h, w, i % 2 == 1, x.device) if config.view_transformer_use_swin_attn else None
            x = layer(x, keys, values, ray_rotation, mask, windows)
            outputs.append(x)

        if config.use_dpt_decoder:
            image = self.out_dpt([outputs[i] for i in config.dpt_layers], h, w)
        else:
            image = from_patches(self.out_proj(x), h, w, config.patch_size)
        activated = F.elu(image, alpha=1e-3)
        if self.training and self.gradient_leak:  # same value, more gradient where the output is negative
            activated = activated + self.gradient_leak * (image - image.detach()) * (image < 0)
        image = activated
        return image.permute(0, 2, 3, 1).unflatten(0, (batch, views))


class RenderFormer(nn.Module):
    """The whole network; ``state_dict`` holds exactly the released parameter names."""

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.config = config
        dim = config.latent_dim
        self.tri_token = nn.Parameter(torch.randn(1, 1, dim) * 0.02)
        if config.num_register_tokens:
            self.reg_tokens = nn.Parameter(torch.randn(1, config.num_register_tokens, dim) * 0.02)
        self.texture_encoder = nn.Linear(config.texture_channels * config.texture_encode_patch_size**2, dim)
        self.texture_encoder_norm = nn.RMSNorm(dim, EMBEDDING_EPS)
        self.vn_encoding_proj = nn.Linear(9 * (1 + 2 * config.vn_pe_num_freqs), dim)
        self.vn_encoder_norm = nn.RMSNorm(dim, EMBEDDING_EPS)
        if config.pe_type == "nerf":
            self.tri_encoding_proj = nn.Linear(9 * (1 + 2 * config.vertex_pe_num_freqs), dim)
            self.tri_encoding_norm = nn.RMSNorm(dim, EMBEDDING_EPS)
        self.transformer = Encoder(config)
        self.view_transformer = ViewTransformer(config)

    def _encode_material(self, material: Tensor) -> Tensor:
        """(B, N, C) or (B, N, C, P, P) -> (B, N, d)."""
        channels, patch = self.config.texture_channels, self.config.texture_encode_patch_size
        if material.shape[2] != channels or (material.ndim == 5 and material.shape[3:] != (patch, patch)):
            raise ValueError(
                f"material has shape {tuple(material.shape)}: the model reads {channels} channels, "
                f"as one vector or a {patch} x {patch} patch per triangle"
            )
        encoder = self.texture_encoder
        material = encode_emission(material, dim=2)
        if material.ndim == 5:
            return encoder(material.flatten(2))
        # A constant patch is an outer product with the kept cells: sum their weights first, exactly the same result.
        weight = encoder.weight.view(-1, channels, patch * patch)
        return F.linear(material, weight @ kept_cells(patch, weight.device).flatten().to(weight.dtype), encoder.bias)

    def _positions(self, scene: Triangles) -> Tensor:
        """(B, S, 9): the mean of all valid vertices, three times, for every register; then the triangles' vertices."""
        triangles = scene.triangles
        if scene.mask is None:
            mean = triangles.mean(dim=(1, 2))
        else:
            weight = scene.mask[:, :, None, None].to(triangles.dtype)
            mean = (triangles * weight).sum(dim=(1, 2)) / (3 * weight.sum(dim=(1, 2)).clamp(min=1))
        registers = mean.repeat(1, 3)[:, None].expand(-1, self.config.num_register_tokens, -1)
        return torch.cat([registers, triangles.flatten(2)], dim=1)

    def _key_mask(self, scene: Triangles) -> Tensor | None:
        """(B, 1, 1, S) bool; registers always count."""
        if scene.mask is None:
            return None
        return F.pad(scene.mask, (self.config.num_register_tokens, 0), value=True)[:, None, None]

    def encode(self, scene: Triangles) -> Tensor:
        """View-independent stage: (B, S, d) tokens that carry the scene's light, S = registers + triangles."""
        config = self.config
        x = self.tri_token + self.texture_encoder_norm(self._encode_material(scene.material))
        normals = sinusoids(scene.vertex_normals.flatten(2), config.vn_pe_num_freqs)
        x = x + self.vn_encoder_norm(self.vn_encoding_proj(normals))
        if config.pe_type == "nerf":
            vertices = sinusoids(scene.triangles.flatten(2), config.vertex_pe_num_freqs)
            x = x + self.tri_encoding_norm(self.tri_encoding_proj(vertices))
        if config.num_register_tokens:
            x = torch.cat([self.reg_tokens.to(x.dtype).expand(x.shape[0], -1, -1), x], dim=1)
        return self.transformer(x, self._positions(scene), self._key_mask(scene))

    def decode(
        self, tokens: Tensor, scene: Triangles, camera_to_world: Tensor, fov_deg: Tensor, resolution: int | tuple[int, int]
    ) -> Tensor:
        """View-dependent stage: cameras (B, V, 4, 4) and (B, V) degrees -> (B, V, H, W, 3), log10(1 + radiance)."""
        height, width = (resolution, resolution) if isinstance(resolution, int) else resolution
        multiple = self.config.resolution_multiple
        if min(height, width) < multiple or height % multiple or width % multiple:
            raise ValueError(f"resolution {height}x{width} must be a multiple of {multiple} pixels for this model")
        return self.view_transformer(
            tokens, self._positions(scene), self._key_mask(scene), camera_to_world, fov_deg, height, width
        )

    def forward(
        self, scene: Triangles, camera_to_world: Tensor, fov_deg: Tensor, resolution: int | tuple[int, int],
        mixed_precision: bool = False,
    ) -> Tensor:  # fmt: skip
        """Both stages. ``mixed_precision`` runs the view-independent one in bfloat16, as the paper does."""
        device = scene.triangles.device.type
        with torch.autocast(device, dtype=torch.bfloat16) if mixed_precision else nullcontext():
            tokens = self.encode(scene)
        return self.decode(tokens.float(), scene, camera_to_world, fov_deg, resolution)


def to_radiance(y: Tensor) -> Tensor:
    """The network's log10(1 + radiance) -> linear radiance."""
    return torch.expm1(y * math.log(10.0))
