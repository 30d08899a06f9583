"""RenderFormer: triangles to tokens, ray bundles to pixels (sections 3.1 and 3.2).

Computes exactly what the released checkpoints compute (``checks/parity.py``) and what ``model.renderformer.reference`` spells
out, with shortcuts that change nothing: constant materials skip the patch, scenes are packed without padding, position angles
are computed once per stage, and the triangles' keys and values are projected once per layer for all views of a scene.
``encode`` once and ``decode`` many views, call the model for both (training), or ``render`` (everything else).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.errors import InputError
from model.renderformer.base import Network, autocast, run_layer
from model.renderformer.config import ModelConfig
from model.renderformer.dpt import DPTHead
from model.renderformer.flops import forward_flops
from model.renderformer.inputs import Triangles, encode_emission, kept_cells, scenes_of
from model.renderformer.layers import (
    EMBEDDING_EPS,
    DecoderLayer,
    EncoderLayer,
    KeysValues,
    RMSNorm,
    RotaryFrequencies,
    Rotation,
    Segments,
    Windows,
    sinusoids,
)


@dataclass
class Tokens:
    """What the view-independent stage knows about B scenes: registers, then triangles, scene after scene.

    x: (S, d). positions: (S, 9) float32, world: a triangle's vertices; a register's is the mean of all, three times.
    """

    x: Tensor
    positions: Tensor
    segments: Segments


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

    def forward(self, x: Tensor, positions: Tensor, segments: Segments) -> Tensor:
        """x: (S, d); positions: (S, 9)."""
        rotation = None
        if hasattr(self, "rope_emb") and len(self.layers):
            cos, sin = self.rope_emb(positions, self.head_dim)
            rotation = cos[None], sin[None]  # one for all heads, and for all layers
        for layer in self.layers:
            x = run_layer(layer, x, rotation, segments)
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
        self.ray_map_encoder_norm = RMSNorm(dim, EMBEDDING_EPS)
        if config.pe_type == "nerf":
            self.pe_token_proj = nn.Linear(9 * (1 + 2 * config.vertex_pe_num_freqs), dim)
            self.token_pos_pe_norm = RMSNorm(dim, EMBEDDING_EPS)
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
        self, tokens: Tokens, camera_to_world: Tensor, fov_deg: Tensor, height: int, width: int,
        keys_values: Sequence[KeysValues] | None = None,
    ) -> Tensor:  # fmt: skip
        """Cameras (B, V, 4, 4), (B, V) -> (B, V, height, width, 3), log10(1 + radiance).

        ``keys_values``: what ``project`` made of the tokens, if that was done before.
        """
        config = self.config
        batch, views = fov_deg.shape
        h, w = height // config.patch_size, width // config.patch_size
        # Geometry in float32 and without matrix products, which TF32 or autocast would round.
        directions = ray_directions(fov_deg, height, width)  # (B, V, H, W, 3)
        rotation_cw, origin = camera_to_world[..., :3, :3].float(), camera_to_world[..., :3, 3].float()
        if not config.turn_to_cam_coord:
            directions = (rotation_cw[:, :, None, None] * directions[..., None, :]).sum(dim=-1)
        points = self.camera_points(tokens, camera_to_world)
        # Every ray of a view starts at its camera: (B V, 1, 9), in the camera frame 0.
        origins = (torch.zeros_like(origin) if config.turn_to_cam_coord else origin).repeat(1, 1, 3).view(-1, 1, 9)

        rays = to_patches(directions.flatten(0, 1), config.patch_size)
        x = self.ray_map_encoder_norm(self.ray_map_encoder(rays)) + self.ray_map_patch_token  # (B V, T, d)
        key_rotation: Rotation | None = None
        ray_rotation: Rotation | None = None
        if config.pe_type == "rope":
            cos, sin = self.transformer.rope_emb(points, self.transformer.head_dim)
            key_rotation = cos[:, None], sin[:, None]  # (V, 1, S, c / 2), for all layers
            if not config.turn_to_cam_coord:  # in the camera frame the rays sit at 0: no turn
                cos, sin = self.transformer.rope_emb(origins, self.transformer.head_dim)
                ray_rotation = cos[:, None], sin[:, None]  # (B V, 1, 1, c / 2)
        else:
            x = x + self._encode_position(origins)
        windows: list[Windows | None] = [None, None]
        if config.view_transformer_use_swin_attn:
            windows = [Windows(h, w, shifted, x.device) for shifted in (False, True)]

        # (1, S, d): projected once for all views; where positions are added to them, (V, S, d)
        source: Sequence[Any] = [self._sources(tokens, points)] * len(self.transformer.layers)
        if keys_values is not None:
            source = keys_values
        outputs = []
        for i, layer in enumerate(self.transformer.layers):
            x = run_layer(layer, x, source[i], key_rotation, ray_rotation, tokens.segments, windows[i % 2])
            outputs.append(x)

        if config.use_dpt_decoder:
            image = self.out_dpt([outputs[i] for i in config.dpt_layers], h, w)
        else:
            image = from_patches(self.out_proj(x), h, w, config.patch_size)
        image = image.float()
        activated = F.elu(image, alpha=1e-3)
        if self.training and self.gradient_leak:  # same value, more gradient where the output is negative
            activated = activated + self.gradient_leak * (image - image.detach()) * (image < 0)
        return activated.permute(0, 2, 3, 1).unflatten(0, (batch, views)).contiguous()

    def camera_points(self, tokens: Tokens, camera_to_world: Tensor) -> Tensor:
        """(V, S, 9): the tokens' positions as the view stage sees them, in each of their scene's V cameras or in the world."""
        if not self.config.turn_to_cam_coord:
            return tokens.positions.expand(camera_to_world.shape[1], -1, -1)
        camera = camera_to_world.float()[tokens.segments.index(camera_to_world.device)].transpose(0, 1)  # (V, S, 4, 4)
        relative = tokens.positions.unflatten(-1, (3, 3)) - camera[:, :, None, :3, 3]  # (V, S, 3 vertices, 3)
        # World to camera: p_c = R^T (p - o), as row vectors (p - o) R.
        return (relative[..., :, None] * camera[:, :, None, :3, :3]).sum(dim=-2).flatten(-2)

    def _sources(self, tokens: Tokens, points: Tensor) -> Tensor:
        """What the rays attend to: (1, S, d), or (V, S, d) where the encoding is added to the tokens."""
        if self.config.pe_type == "rope":
            return tokens.x[None]
        return tokens.x[None] + self._encode_position(points)

    def project(self, tokens: Tokens) -> list[KeysValues] | None:
        """Keys and values of every layer, to decode more views later; None where they differ from view to view."""
        if self.config.pe_type != "rope":
            return None
        return [layer.keys_values(tokens.x[None]) for layer in self.transformer.layers]


class RenderFormer(Network):
    """The whole network; ``state_dict`` holds exactly the released parameter names."""

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.config = config
        dim = config.latent_dim
        self.tri_token = nn.Parameter(torch.randn(1, 1, dim) * 0.02)
        if config.num_register_tokens:
            self.reg_tokens = nn.Parameter(torch.randn(1, config.num_register_tokens, dim) * 0.02)
        self.texture_encoder = nn.Linear(config.texture_channels * config.texture_encode_patch_size**2, dim)
        self.texture_encoder_norm = RMSNorm(dim, EMBEDDING_EPS)
        self.vn_encoding_proj = nn.Linear(9 * (1 + 2 * config.vn_pe_num_freqs), dim)
        self.vn_encoder_norm = RMSNorm(dim, EMBEDDING_EPS)
        if config.pe_type == "nerf":
            self.tri_encoding_proj = nn.Linear(9 * (1 + 2 * config.vertex_pe_num_freqs), dim)
            self.tri_encoding_norm = RMSNorm(dim, EMBEDDING_EPS)
        self.transformer = Encoder(config)
        self.view_transformer = ViewTransformer(config)

    def read(self, batch: Mapping[str, Any], device: torch.device | str = "cpu") -> Triangles:
        """This network's input from padded numpy arrays (``model.renderformer.inputs.scenes_of``)."""
        return scenes_of(batch, self.config.texture_channels, self.config.texture_encode_patch_size, device)

    def arguments(self, batch: Mapping[str, Any], device: torch.device | str) -> tuple[Any, ...]:
        """Scenes, cameras and the images' size."""
        cameras, fov_deg = (
            torch.from_numpy(np.ascontiguousarray(batch[name])).to(device, non_blocking=True)
            for name in ("camera_to_world", "fov_deg")
        )
        return self.read(batch, device), cameras, fov_deg, tuple(batch["image"].shape[2:4])

    def frames(
        self, scene: Mapping[str, Any], views: Iterable[Mapping[str, Any]], size: tuple[int, int], device: Any
    ) -> Iterator[Tensor]:
        cameras = list(views)
        camera_to_world, fov_deg = (
            torch.from_numpy(np.concatenate([view[name] for view in cameras], axis=1, dtype=np.float32)).to(device)
            for name in ("camera_to_world", "fov_deg")
        )
        for y in self.render_batches(self.read(scene, device), camera_to_world, fov_deg, size):
            yield from y[0]

    def flops(self, batch: Mapping[str, Any]) -> dict[str, float]:
        views, height, width = batch["image"].shape[1:4]
        textured = int((batch["patch_index"] >= 0).sum()) if "patch_index" in batch else 0
        return forward_flops(self.config, batch["mask"].sum(axis=1).tolist(), views, height, width, textured)

    def tokens(self, batch: Mapping[str, Any]) -> int:
        views, height, width = batch["image"].shape[1:4]
        rays = views * (height // self.config.patch_size) * (width // self.config.patch_size)
        return int(batch["mask"].sum()) + len(batch["mask"]) * (self.config.num_register_tokens + rays)

    def leak_gradient(self, share: float) -> None:
        self.view_transformer.gradient_leak = share

    def _encode_material(self, scenes: Triangles) -> Tensor:
        """(T, d)."""
        channels, patch = self.config.texture_channels, self.config.texture_encode_patch_size
        patches = scenes.patches
        if scenes.material.shape[1] != channels or (patches is not None and patches.shape[1:] != (channels, patch, patch)):
            shapes = [tuple(x.shape) for x in (scenes.material, patches) if x is not None]
            raise InputError(
                f"material has shape {', '.join(map(str, shapes))}: the model reads {channels} channels, "
                f"as one vector or a {patch} x {patch} patch per triangle"
            )
        encoder = self.texture_encoder
        # A constant patch is an outer product with the kept cells: sum their weights first, exactly the same result.
        weight = encoder.weight.view(-1, channels, patch * patch)
        weight = weight @ kept_cells(patch, weight.device).flatten().to(weight.dtype)
        x = F.linear(encode_emission(scenes.material), weight, encoder.bias)
        if patches is not None:
            full = encoder(encode_emission(patches).flatten(1))
            x = x.index_copy(0, scenes.textured, full.to(x.dtype))
        return x

    def encode(self, scenes: Triangles) -> Tokens:
        """View-independent stage: tokens that carry the scenes' light."""
        config = self.config
        x = self.tri_token[0] + self.texture_encoder_norm(self._encode_material(scenes))
        normals = sinusoids(scenes.vertex_normals.flatten(1), config.vn_pe_num_freqs)
        x = x + self.vn_encoder_norm(self.vn_encoding_proj(normals))
        if config.pe_type == "nerf":
            vertices = sinusoids(scenes.triangles.flatten(1), config.vertex_pe_num_freqs)
            x = x + self.tri_encoding_norm(self.tri_encoding_proj(vertices))
        positions, segments, registers = scenes.triangles.flatten(1), scenes.segments, config.num_register_tokens
        if registers:  # in front of the triangles of each scene
            rows, places = [], []
            for scene_tokens, scene_positions in zip(segments.split(x, 0), segments.split(positions, 0), strict=True):
                mean = scene_positions.unflatten(1, (3, 3)).mean(dim=(0, 1)).repeat(3)
                rows += [self.reg_tokens[0].to(x.dtype), scene_tokens]
                places += [mean.expand(registers, -1), scene_positions]
            x, positions = torch.cat(rows), torch.cat(places)
            segments = Segments([registers + n for n in segments.lengths])
        return Tokens(self.transformer(x, positions, segments), positions, segments)

    def decode(
        self, tokens: Tokens, camera_to_world: Tensor, fov_deg: Tensor, resolution: int | tuple[int, int],
        keys_values: Sequence[KeysValues] | None = None,
    ) -> Tensor:  # fmt: skip
        """View-dependent stage: cameras (B, V, 4, 4) and (B, V) degrees -> (B, V, H, W, 3), log10(1 + radiance)."""
        height, width = (resolution, resolution) if isinstance(resolution, int) else resolution
        multiple = self.config.resolution_multiple
        if min(height, width) < multiple or height % multiple or width % multiple:
            raise InputError(f"resolution {height}x{width} must be a multiple of {multiple} pixels for this model")
        return self.view_transformer(tokens, camera_to_world, fov_deg, height, width, keys_values)

    def forward(
        self, scenes: Triangles, camera_to_world: Tensor, fov_deg: Tensor, resolution: int | tuple[int, int],
        precision: str = "fp32",
    ) -> Tensor:  # fmt: skip
        """Both stages. ``precision``: fp32; mixed, the view-independent one in bfloat16 as in the paper; bf16, both."""
        device = scenes.triangles.device.type
        with autocast(device, precision in ("mixed", "bf16")):
            tokens = self.encode(scenes)
        with autocast(device, precision == "bf16"):
            if precision == "mixed":
                tokens.x = tokens.x.float()
            return self.decode(tokens, camera_to_world, fov_deg, resolution)

    def render(
        self, scenes: Triangles, camera_to_world: Tensor, fov_deg: Tensor, resolution: int | tuple[int, int],
        precision: str = "fp32", rays_at_once: int | None = None,
    ) -> Tensor:  # fmt: skip
        """As ``forward``, for any number of views: ``render_batches`` put together."""
        return torch.cat(
            list(self.render_batches(scenes, camera_to_world, fov_deg, resolution, precision, rays_at_once)), dim=1
        )

    @torch.inference_mode()
    def render_batches(
        self, scenes: Triangles, camera_to_world: Tensor, fov_deg: Tensor, resolution: int | tuple[int, int],
        precision: str = "fp32", rays_at_once: int | None = None,
    ) -> Iterator[Tensor]:  # fmt: skip
        """(B, v, H, W, 3) of v views at a time, in order: what a long animation needs does not grow with its length.

        Scenes are encoded, and keys and values projected, once for all of them. ``rays_at_once`` ray bundles are decoded
        together; None: a CPU's caches like few, a GPU's processors many.
        """
        device = scenes.triangles.device.type
        height, width = (resolution, resolution) if isinstance(resolution, int) else resolution
        most = rays_at_once or (1024 if device == "cpu" else 16384)
        views = max(1, most // max(1, len(scenes.segments) * height * width // self.config.patch_size**2))
        with autocast(device, precision in ("mixed", "bf16")):
            tokens = self.encode(scenes)
        if precision == "mixed":
            tokens.x = tokens.x.float()
        with autocast(device, precision == "bf16"):
            projected = self.view_transformer.project(tokens)
        for cameras, fov in zip(camera_to_world.split(views, 1), fov_deg.split(views, 1), strict=True):
            with autocast(device, precision == "bf16"):
                batch = self.decode(tokens, cameras, fov, resolution, projected)
            yield batch  # outside of autocast, which would otherwise stay on in the caller

    def gathering_layers(self) -> list[nn.Module]:
        return list(self.view_transformer.transformer.layers)

    def layers(self) -> list[nn.Module]:
        """Every transformer layer of both stages: the units of compilation, recomputation and sharding."""
        return [*self.transformer.layers, *self.view_transformer.transformer.layers]


def to_radiance(y: Tensor) -> Tensor:
    """The network's log10(1 + radiance) -> linear radiance."""
    return torch.expm1(y * math.log(10.0))
