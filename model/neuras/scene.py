"""Everything that is learned of a scene, how it starts, and how rays are rendered from it (sections 3.1 and 3.2).

The start matters most: features begin as the mean colours of the rays that touch a texel, networks as the identity on them, and
all skyboxes but the farthest as nearly clear, so that far layers explain first what no parallax tells apart.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from model.neuras import shading, skyboxes
from model.neuras.baked import Baked
from model.neuras.exposure import Exposure
from model.neuras.losses import PerceptualNetwork
from model.neuras.maps import Maps, blocks, voxels
from model.neuras.quantization import clusters, nearest
from model.neuras.rays import Batch, Pixels
from model.neuras.sampling import Pyramid, bilinear, gather
from model.neuras.shading import ShaderConfig

CHUNK = 1 << 16  # rays at a time where nothing is learned
FILL_LEVELS = 6  # sizes of cells, each four times as wide as the one before, from which unseen texels are filled


@dataclass(frozen=True)
class FitConfig:
    """How to fit. Lengths are in world units; the paper's lambdas and beta are in a supplement that was not seen."""

    steps: int
    seed: int = 0
    shader: ShaderConfig = ShaderConfig()
    patch: int = 8  # pixels along a patch
    patches: int = 128  # of a step
    lr: float = 0.01  # of textures and codes
    network_lr: float = 0.01
    final_lr: float = 0.1  # share of both that the cosine ends at
    codes: int = 1024  # of each codebook; 0: no quantization
    quantize_from: float = 0.0  # share of the steps before quantization begins
    vq: float = 0.1  # lambda_vq
    commitment: float = 0.25  # beta
    perceptual: float = 0.0  # lambda_perc
    perceptual_network: PerceptualNetwork = "gradients"
    shared_levels: int = 2  # coarse levels
    voxel: float = 0.3  # edge of the finest voxel that texels of the mesh share
    block: int = 4  # texels along the finest block that texels of a skybox share
    sky_side: int = 256  # texels along a face of a skybox
    rays: int = 1  # along a pixel's side when the finished scene is drawn; fitting casts one a pixel
    near_opacity: float = 0.12  # of all skyboxes but the farthest, at the start: far layers explain first
    direction_noise: float = 0.0  # sigma added to the view direction
    coarser_share: float = 0.0  # of the pixels that read coarser levels of the mesh's texture than they ask for
    exposure: bool = False  # an affine change of colour per training image
    # Runtime: these do not change the result, or only its rounding
    compile: bool = False
    mixed_precision: bool = False
    log_every: int = 20
    validate_every: int = 0  # steps; 0: at the end alone
    checkpoint_every: int = 50
    lpips_folder: str | None = None  # of VGG16's weights; None: see model.weights

    RUNTIME = ("lpips_folder", "compile", "mixed_precision", "log_every", "validate_every", "checkpoint_every")

    def identity(self) -> dict[str, Any]:
        return {name: value for name, value in dataclasses.asdict(self).items() if name not in self.RUNTIME}


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What the textures lie on. positions: (h, w, 3) float32, world, of the texels of the pyramid's sheet that ``inside``
    (h, w) bool says a sample can reach. sky_centre: (3,), sky_half_sizes: (L, 3), float64, world.
    """

    pyramid: Pyramid
    positions: np.ndarray
    inside: np.ndarray
    sky_centre: np.ndarray
    sky_half_sizes: np.ndarray


class Scene:
    """Everything that is learned, and how rays are rendered from it."""

    def __init__(self, config: FitConfig, surroundings: Surroundings, pixels: Pixels):
        self.config, self.surroundings = config, surroundings
        self.pyramid = surroundings.pyramid
        self.layers = len(surroundings.sky_half_sizes)
        self.wider = self.pyramid.levels - 1 if config.coarser_share else 0  # levels that a pixel may look coarser by
        self.device = pixels.uv.device
        self.half = torch.from_numpy(surroundings.sky_half_sizes.astype(np.float32)).to(self.device)
        generator = torch.Generator().manual_seed(config.seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.mesh_shader = shading.MeshShader(config.shader).to(self.device)
            self.sky_shader = shading.SkyShader(config.shader).to(self.device)
        self.rates = {
            name: _rates(shader.NAMED, config.shader.channels).to(self.device) for name, shader in self.shaders.items()
        }
        self.exposure = Exposure(len(pixels.sizes)).to(self.device) if config.exposure else None
        self.maps = self._start(pixels)
        self.codes: dict[str, Tensor] = {}
        if config.codes:
            for name, maps in self.maps.items():
                rows = torch.randint(maps.count, (min(maps.count, 20 * config.codes),), generator=generator)
                sample = maps.features(rows.to(self.device))
                self.codes[name] = clusters(sample, config.codes, 8, generator).requires_grad_()

    def _start(self, pixels: Pixels) -> dict[str, Maps]:
        """Maps of the texels that training rays touch, their features started from the mean colours of those rays."""
        side, channels = self.config.sky_side, self.config.shader.channels
        totals = {"mesh": math.prod(self.pyramid.sheet), "sky": self.layers * 6 * side * side}
        sums = {name: torch.zeros(total, 4, device=self.device) for name, total in totals.items()}
        lending = {"mesh": torch.ones(totals["mesh"], dtype=torch.bool), "sky": torch.zeros(totals["sky"], dtype=torch.bool)}
        for batch in self._wider(pixels):
            for name, (texels, weights, rays) in self.places(batch).items():
                used = weights + 1e-6  # a texel of weight 0 is named too
                colours = torch.cat([batch.rgb[rays], torch.ones(len(rays), 1, device=self.device)], dim=1)
                sums[name].index_add_(0, texels.reshape(-1), (used[:, :, None] * colours[:, None, :]).reshape(-1, 4))
                if name == "sky":  # a ray beside the mesh may see what the mesh lacks: that is no sky to spread
                    lending[name][texels[batch.open[rays]].reshape(-1).cpu()] = True
        config, side = self.config, self.config.sky_side
        shared = [4**level for level in range(config.shared_levels)]
        filling = [4**level for level in range(FILL_LEVELS)]
        cells = {
            "mesh": (
                [self._voxels(config.voxel * size) for size in shared],
                [self._voxels(config.voxel / 2 * size) for size in filling],
            ),
            "sky": tuple(
                [blocks(self.layers, side, config.block * k) for k in sizes if config.block * k < 4 * side]
                for sizes in (shared, filling)
            ),
        }
        maps, everything = {}, sum(total.sum(dim=0) for total in sums.values())
        for name, total in sums.items():
            if not total[:, 3].any():  # no ray meets it, but other views may: one texel, opaque, has the photos' mean for all
                one = (self.layers - 1) * 6 * side * side if name == "sky" else 0
                total[one] = everything / everything[3].clamp(min=1e-6)
                total[one, 3] = 1
            touched = total[:, 3] > 0
            start = torch.zeros(int(touched.sum()), channels, device=self.device)
            start[:, :3] = total[touched, :3] / total[touched, 3:]
            if name == "sky":
                farthest = torch.nonzero(touched)[:, 0] >= (self.layers - 1) * 6 * side * side
                near = math.log(self.config.near_opacity / (1 - self.config.near_opacity))
                start[:, shading.OPACITY] = torch.where(farthest, 4.0, near)
            maps[name] = Maps(touched.cpu().numpy(), lending[name].numpy(), *cells[name], start)
        return maps

    def _wider(self, pixels: Pixels) -> Iterator[Batch]:
        """All pixels, and those that see the mesh once more for each level that fitting may look coarser by."""
        for batch in pixels.everything(CHUNK):
            yield batch
            on_mesh = dataclasses.replace(batch, counts=batch.counts & batch.hit)
            for levels in range(1, self.wider + 1):
                yield on_mesh.coarser(torch.full_like(batch.views, levels))

    def _voxels(self, edge: float) -> np.ndarray:
        """(T,) int64: cells of the mesh's texels; those that no sample reaches are all in cell 0."""
        inside = self.surroundings.inside.reshape(-1)
        cells = np.zeros(len(inside), np.int64)
        cells[inside] = voxels(self.surroundings.positions.reshape(-1, 3)[inside], edge)
        return cells

    def places(self, batch: Batch) -> dict[str, tuple[Tensor, Tensor, Tensor]]:
        """Of mesh and sky: texels (N, K), weights (N, K), and the number in the batch of each sample's ray (N,).

        Pixels that do not count have no samples. The sky's are those of rays that miss the mesh, ray after ray, near to far.
        """
        rays = torch.nonzero(batch.hit & batch.counts)[:, 0]
        found = {"mesh": (*self.pyramid.sample(batch.uv[rays], batch.spread[rays], batch.detail[rays]), rays)}
        rays = torch.nonzero(~batch.hit & batch.counts)[:, 0]
        side, origins, directions = self.config.sky_side, batch.origins[rays], batch.directions[rays]
        texels, weights = [], []
        for layer in range(self.layers):
            face, uv = skyboxes.intersect(origins, directions, self.half[layer])
            inside, weight = bilinear(uv, side, side)
            texels.append(inside + ((6 * layer + face) * side * side)[:, None])
            weights.append(weight)
        stacked = (torch.stack(parts, dim=1).reshape(-1, 4) for parts in (texels, weights))
        return found | {"sky": (*stacked, rays.repeat_interleave(self.layers))}

    def shade(self, batch: Batch, samples: dict[str, tuple[Tensor, Tensor]], directions: Tensor) -> Tensor:
        """(B, 3) colours from the sampled features (N, D) of mesh and sky and the numbers of their rays, not clamped."""
        features, rays = samples["mesh"]
        rgb = torch.zeros(len(batch.hit), 3, device=self.device)
        rgb = rgb.index_copy(0, rays, self.mesh_shader(features, directions[rays]).float())
        features, rays = samples["sky"]
        if not len(rays):
            return rgb
        colours, opacities = self.sky_shader(features, directions[rays])
        light = shading.composite(colours.float().view(-1, self.layers, 3), opacities.float().view(-1, self.layers))
        return rgb.index_copy(0, rays[:: self.layers], light)

    @property
    def shaders(self) -> dict[str, shading.MeshShader | shading.SkyShader]:
        return {"mesh": self.mesh_shader, "sky": self.sky_shader}

    def networks(self) -> list[Tensor]:
        return [*self.mesh_shader.parameters(), *self.sky_shader.parameters()]

    def render(self, pixels: Pixels) -> list[np.ndarray]:
        """(H, W, 3) float32 in [0, 1] of every view, as the baked maps will show it."""
        tables = {name: maps.features_of_all() for name, maps in self.maps.items()}
        found: list[list[Tensor]] = []
        with torch.no_grad():
            for batch in pixels.everything(CHUNK):
                batch = dataclasses.replace(batch, counts=torch.ones_like(batch.counts))
                samples = {}
                for name, (texels, weights, rays) in self.places(batch).items():
                    rows, where = self.maps[name].row_of[texels].long().unique(return_inverse=True)
                    values = tables[name][rows]
                    if self.codes:
                        values = self.codes[name][nearest(values, self.codes[name])]
                    samples[name] = (gather(values, where, weights), rays)
                found.append(self.shade(batch, samples, batch.directions).clamp(0, 1))
        flat = torch.cat(found).cpu().numpy()
        return [flat[first : first + h * w].reshape(h, w, 3) for first, (h, w) in zip(pixels.first, pixels.sizes, strict=True)]

    def baked(self, meta: dict[str, Any]) -> Baked:
        """The finished scene, unseen texels filled."""
        side, shader = self.config.sky_side, self.config.shader
        shapes = {"mesh": self.pyramid.sheet, "sky": (self.layers, 6, side, side)}
        arrays = {}
        for name, maps in self.maps.items():
            values, row_of = maps.features_of_all(), maps.row_of.cpu().numpy()
            if self.codes:
                codes = self.codes[name].detach()
                indices = nearest(values, codes).cpu().numpy().astype(np.uint16)
                arrays |= {
                    f"{name}_indices": indices[row_of].reshape(shapes[name]),
                    f"{name}_codebook": codes.cpu().numpy().copy(),
                }
            else:
                arrays[f"{name}_features"] = values.cpu().numpy().astype(np.float16)[row_of].reshape(*shapes[name], -1)
        return Baked(
            mesh_mlp=shading.arrays(self.mesh_shader.layers),
            sky_mlp=shading.arrays([*self.sky_shader.trunk, *self.sky_shader.layers]),
            sky_opacity=shading.arrays([self.sky_shader.opacity])[0],
            sky_centre=np.asarray(self.surroundings.sky_centre, np.float64),
            sky_half_sizes=np.asarray(self.surroundings.sky_half_sizes, np.float64),
            view_dependent=shader.view_direction and shader.layers > 0,
            levels=self.pyramid.levels,
            rays=self.config.rays,
            meta=meta,
            **arrays,
        )


def _rates(named: int, channels: int) -> Tensor:
    """(D,) shares of the learning rate."""
    return torch.tensor([1.0 if channel < named else shading.QUIET for channel in range(channels)])
