"""The finished model as plain arrays: what is baked, and what every renderer of it must equal.

A fitted scene is two sets of maps (mesh, skyboxes), a codebook for each, and two small networks. ``Baked.render`` computes a
pixel from them as the fragment shader does: it is the reference. Files: ``model.safetensors`` (arrays) and ``model.json``.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file
from torch import Tensor

from model.errors import InputError
from model.neuras.sampling import Pyramid, bilinear, gather
from model.neuras.skyboxes import intersect
from pipeline.atomic import atomic_path, write_atomic

ARRAYS, VALUES = "model.safetensors", "model.json"
FORMAT = 2  # of the two files
Layer = tuple[np.ndarray, np.ndarray]  # weight (out, in) float32, bias (out,) float32


@dataclass(frozen=True, eq=False)
class Baked:
    """A fitted scene. D: channels of a feature, K: codes, L: skyboxes near to far, S: texels along a skybox face.

    mesh_indices (H, W), a sheet of the ``levels`` of a ``Pyramid``, and sky_indices (L, 6, S, S): uint16, the code of each
    texel; None without quantization.
    mesh_features (H, W, D) and sky_features (L, 6, S, S, D): float16, instead of them; None with quantization.
    mesh_codebook, sky_codebook: (K, D) float32; None without quantization.
    mesh_mlp, sky_mlp: layers as (weight (out, in), bias (out,)) float32, see ``render``; no layers: the feature's first
    three channels are the colour. sky_opacity: one layer with one output. sky_centre: (3,) float64, world.
    sky_half_sizes: (L, 3) float64, world units (``model.neuras.skyboxes`` says where a face's texels lie).
    view_dependent: whether the networks take the view direction. rays: along a pixel's side, evenly spaced; their mean is what
    is drawn, each with the texture that the whole pixel covers. So silhouettes are smooth, as a photo's are.
    activations: by name, for who writes a shader.
    """

    mesh_mlp: list[Layer]
    sky_mlp: list[Layer]
    sky_opacity: Layer
    sky_centre: np.ndarray
    sky_half_sizes: np.ndarray
    view_dependent: bool
    levels: int = 1
    rays: int = 1
    mesh_indices: np.ndarray | None = None
    sky_indices: np.ndarray | None = None
    mesh_codebook: np.ndarray | None = None
    sky_codebook: np.ndarray | None = None
    mesh_features: np.ndarray | None = None
    sky_features: np.ndarray | None = None
    activations: dict[str, str] = field(default_factory=lambda: {"hidden": "relu", "opacity": "sigmoid", "colour": "clamp"})
    meta: dict[str, Any] = field(default_factory=dict)  # for people: settings and results

    @property
    def quantized(self) -> bool:
        return self.mesh_indices is not None

    @property
    def channels(self) -> int:
        return (self.mesh_codebook if self.quantized else self.mesh_features).shape[-1]

    @property
    def mesh_size(self) -> tuple[int, int]:
        """Height and width of the mesh's sheet, all levels."""
        return (self.mesh_indices if self.quantized else self.mesh_features).shape[:2]

    @property
    def pyramid(self) -> Pyramid:
        """How the levels lie in the mesh's sheet."""
        height, width = self.mesh_size
        return Pyramid(width * 2 // 3 if self.levels > 1 else width, height, self.levels)

    @property
    def sky_size(self) -> tuple[int, int]:
        """L and S."""
        maps = self.sky_indices if self.quantized else self.sky_features
        return maps.shape[0], maps.shape[2]

    def mesh_texture(self) -> np.ndarray:
        """(H, W, D) float32 features of the sheet's texels."""
        return self.mesh_codebook[self.mesh_indices] if self.quantized else self.mesh_features.astype(np.float32)

    def sky_textures(self) -> np.ndarray:
        """(L, 6, S, S, D) float32 features of the texels."""
        return self.sky_codebook[self.sky_indices] if self.quantized else self.sky_features.astype(np.float32)

    def save(self, folder: Path) -> None:
        """Write the two files, the same bytes every time."""
        arrays = {f.name: getattr(self, f.name) for f in fields(self) if isinstance(getattr(self, f.name), np.ndarray)}
        for name in ("mesh_mlp", "sky_mlp"):
            for number, layer in enumerate(getattr(self, name)):
                arrays |= {f"{name}.{number}.{part}": value for part, value in zip(("weight", "bias"), layer, strict=True)}
        arrays |= dict(zip(("sky_opacity.weight", "sky_opacity.bias"), self.sky_opacity, strict=True))
        values = {
            "format": FORMAT,
            "view_dependent": self.view_dependent,
            "levels": self.levels,
            "rays": self.rays,
            "quantized": self.quantized,
            "activations": self.activations,
            "sizes": {"mesh": list(self.mesh_size), "sky": list(self.sky_size), "channels": self.channels},
            "meta": self.meta,
        }
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_path(folder / ARRAYS) as temporary:
            save_file({name: np.ascontiguousarray(value) for name, value in sorted(arrays.items())}, temporary)
        write_atomic(folder / VALUES, (json.dumps(values, indent=1, sort_keys=True, allow_nan=False) + "\n").encode())

    @classmethod
    def load(cls, folder: Path) -> Baked:
        """From the two files; InputError where they are missing or malformed."""
        try:
            values = json.loads((folder / VALUES).read_bytes())
            arrays = load_file(folder / ARRAYS)
            if values["format"] != FORMAT:
                raise InputError(f"{folder / VALUES} has format {values['format']}, this version reads {FORMAT}: fit it again")

            def layers(name: str) -> list[Layer]:
                count = sum(key.startswith(f"{name}.") for key in arrays) // 2
                return [(arrays.pop(f"{name}.{i}.weight"), arrays.pop(f"{name}.{i}.bias")) for i in range(count)]

            networks = {name: layers(name) for name in ("mesh_mlp", "sky_mlp")}
            opacity = (arrays.pop("sky_opacity.weight"), arrays.pop("sky_opacity.bias"))
            stated = {name: values[name] for name in ("view_dependent", "levels", "activations", "meta")}
            stated["rays"] = int(values.get("rays", 1))  # scenes had one ray a pixel before
            return cls(sky_opacity=opacity, **networks, **stated, **arrays)
        except (OSError, ValueError, KeyError, TypeError, SafetensorError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{folder} holds no fitted scene ({error}): expected {ARRAYS} and {VALUES} of stage fit") from None

    def render(
        self,
        uv: np.ndarray,
        spread: np.ndarray,
        detail: np.ndarray,
        hit: np.ndarray,
        origin: np.ndarray,
        directions: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Colours (N, 3) in [0, 1] and opacities (N, 1 + L), mesh first, of rays from ``origin`` (3,) along ``directions``.

        uv: (N, 2) texture coordinates where the ray meets the mesh; spread: (N, 2) and detail: (N,), the part of the texture
        that its pixel covers (``Pyramid.sample``); hit: (N,) bool, whether it does; directions: (N, 3) unit vectors. The
        steps, which a shader repeats:

        1. F = sample of the map of *features* (indices do not mix): the mesh as ``Pyramid.sample`` says, each skybox where
           ``model.neuras.skyboxes.intersect`` says, bilinear.
        2. Mesh: colour = mesh_mlp([F, d]) with ReLU between layers; opacity = 1 where ``hit``, else 0 (eq. 1 and 2).
        3. Skybox: h = relu(first layer of sky_mlp(F)); opacity = sigmoid(sky_opacity(h)); colour = the other layers of
           sky_mlp of [h, d], ReLU between them. So the opacity does not depend on the view (eq. 3).
           Without layers opacity = sigmoid(sky_opacity(F)).
        4. sum_i colour_i opacity_i prod_(j<i) (1 - opacity_j), near to far (eq. 4); then clamped to [0, 1].

        d is left out of both inputs where ``view_dependent`` is False.
        """
        hit_rays = torch.from_numpy(np.ascontiguousarray(hit, dtype=bool))
        rays = torch.from_numpy(np.ascontiguousarray(directions, dtype=np.float32))
        opacity = torch.zeros(len(rays), 1 + self.sky_size[0])
        rgb = torch.zeros(len(rays), 3)
        with torch.no_grad():
            opacity[:, 0] = hit_rays.float()
            looks = (torch.from_numpy(np.ascontiguousarray(x, dtype=np.float32))[hit_rays] for x in (uv, spread, detail))
            features = self._sample("mesh", *self.pyramid.sample(*looks))
            rgb[hit_rays] = _colour(self.mesh_mlp, self._with_direction(features, rays[hit_rays]))
            open_rays = rays[~hit_rays]
            seen, light = torch.zeros(len(open_rays), self.sky_size[0]), torch.zeros(len(open_rays), 3)
            passed = torch.ones(len(open_rays))
            for layer in range(self.sky_size[0]):
                colour, seen[:, layer] = self._skybox(layer, origin, open_rays)
                light += colour * (passed * seen[:, layer])[:, None]
                passed = passed * (1 - seen[:, layer])
            rgb[~hit_rays] = light
            opacity[~hit_rays, 1:] = seen
        return rgb.clamp(0, 1).numpy(), opacity.numpy()

    def _skybox(self, layer: int, origin: np.ndarray, rays: Tensor) -> tuple[Tensor, Tensor]:
        """Colours (N, 3) and opacities (N,) of one skybox."""
        side = self.sky_size[1]
        start = torch.from_numpy((np.asarray(origin, float) - self.sky_centre).astype(np.float32))
        half = torch.from_numpy(self.sky_half_sizes[layer].astype(np.float32))
        face, uv = intersect(start, rays, half)
        texels, weights = bilinear(uv, side, side)
        features = self._sample("sky", texels + (6 * layer + face)[:, None] * side * side, weights)
        if not self.sky_mlp:
            return features[:, :3], torch.sigmoid(_linear(self.sky_opacity, features))[:, 0]
        hidden = torch.relu(_linear(self.sky_mlp[0], features))
        opacity = torch.sigmoid(_linear(self.sky_opacity, hidden))[:, 0]
        return _colour(self.sky_mlp[1:], self._with_direction(hidden, rays)), opacity

    def _sample(self, maps: str, texels: Tensor, weights: Tensor) -> Tensor:
        """(N, D) features of the maps "mesh" or "sky"; ``texels``: (N, K) flat indices."""
        used, where = texels.unique(return_inverse=True)
        numbers = used.numpy()
        if self.quantized:
            rows = getattr(self, f"{maps}_codebook")[getattr(self, f"{maps}_indices").reshape(-1)[numbers]]
        else:
            rows = getattr(self, f"{maps}_features").reshape(-1, self.channels)[numbers].astype(np.float32)
        return gather(torch.from_numpy(rows), where, weights)

    def _with_direction(self, features: Tensor, rays: Tensor) -> Tensor:
        return torch.cat([features, rays], dim=1) if self.view_dependent else features


def _linear(layer: Layer, x: Tensor) -> Tensor:
    weight, bias = layer
    return x @ torch.from_numpy(weight).T + torch.from_numpy(bias)


def _colour(layers: list[Layer], x: Tensor) -> Tensor:
    """(N, 3): the layers with ReLU between them, not clamped; without layers the first three channels."""
    for layer in layers[:-1]:
        x = torch.relu(_linear(layer, x))
    return _linear(layers[-1], x) if layers else x[:, :3]
