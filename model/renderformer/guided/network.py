"""The guided network: radiance = s (k_d (sum_l V_l D_l L_l + B + E) + k_s (sum_l V'_l S_l L_l + m M + R)).

D_l and S_l are the closed forms of each light on a diffuse and on a GGX surface (``light``), V_l its visibility, B what other
triangles shed on this one by radiosity (``triangles``), M what the reflections hit, lit likewise (``pixels``); s is the scene's
scale. The network makes V_l from what rays say of it, the gate m, and E and R, the light that neither has. Its last layers
start at zero: before training the image is the closed form.
Tokens of triangles carry the indirect light; ray bundles gather from them at the surface that they hit, not at the camera.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.renderformer.base import Network, autocast, run_layer
from model.renderformer.guided.config import LIGHT_DIM, LIGHT_FEATURES, PIXEL_DIM, GuidedConfig
from model.renderformer.guided.flops import forward_flops
from model.renderformer.guided.inputs import SUBSAMPLES, Scenes
from model.renderformer.guided.light import sum_over_lights
from model.renderformer.guided.pixels import Known, Lobes, Observer, Pixels, from_bundles, mean_of_rays
from model.renderformer.guided.triangles import Lit, light_triangles, token_features
from model.renderformer.layers import LAYER_EPS, DecoderLayer, EncoderLayer, FeedForward, RMSNorm, Rotation

SOFT = 0.02  # visibility is corrected as if it were this far from 0 and 1
AT_ONCE = 300_000  # pairs of ray and light that are computed together where no gradient is kept


def rotary(positions: Tensor, head_dim: int) -> Rotation:
    """(..., 3) -> cos and sin (..., head_dim / 2), the angles of `model.renderformer.layers.rotate`."""
    frequencies = math.pi * 2.0 ** torch.arange(head_dim // 6, device=positions.device)
    angles = (positions[..., None].float() * frequencies).flatten(-2)
    return angles.cos(), angles.sin()


@dataclass
class Encoded:
    """Scenes with all that is the same for every view of them."""

    scenes: Scenes
    lit: Lit
    tokens: Tensor | None  # (T, d)
    centroids: Tensor  # (T, 3)


class Head(nn.Module):
    """From what is known of a pixel to E, R and the gate; and what each of its lights needs to correct its visibility."""

    def __init__(self, inputs: int, config: GuidedConfig):
        super().__init__()
        dim = config.head_dim
        self.input = nn.Linear(inputs, dim)
        self.layers = nn.ModuleList(HeadLayer(dim) for _ in range(config.head_layers))
        self.norm = RMSNorm(dim, LAYER_EPS)
        self.output = nn.Linear(dim, 7)  # E, R, gate
        self.corrects_lights = config.guide.light
        if self.corrects_lights:
            self.to_light = nn.Linear(dim, LIGHT_DIM)
            self.of_light = nn.Linear(LIGHT_FEATURES, LIGHT_DIM)
            self.light_hidden = nn.Linear(LIGHT_DIM, LIGHT_DIM)
            self.light_output = nn.Linear(LIGHT_DIM, 2)
        self.start_at_zero()

    def start_at_zero(self) -> None:
        """Let the network say nothing: the image is the closed form."""
        for last in (self.output, self.light_output) if self.corrects_lights else (self.output,):
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)

    def forward(self, features: Tensor, lights: Tensor) -> tuple[Tensor, Tensor | None]:
        """(B, M, F) pixels, (B, M, L, LIGHT_FEATURES) their lights -> (B, M, 7), and (B, M, L, 2) if there are closed forms."""
        x = self.input(features)
        for layer in self.layers:
            x = run_layer(layer, x)
        x = self.norm(x)
        if not self.corrects_lights:
            return self.output(x), None
        of_light = F.silu(self.to_light(x)[:, :, None] + self.of_light(lights))
        return self.output(x), self.light_output(F.silu(self.light_hidden(of_light)))


class HeadLayer(nn.Module):
    def __init__(self, dim: int):
        super().__init__()
        self.norm = RMSNorm(dim, LAYER_EPS)
        self.ffn = FeedForward(dim, 2 * dim)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.ffn(self.norm(x))


class GuidedNetwork(Network):
    """The whole network. ``encode`` once per scene, ``decode`` its pixels; `forward` does both, for training."""

    reads_guides = True
    whole_views = False

    def __init__(self, config: GuidedConfig):
        super().__init__()
        self.config = config
        self.reads_bounces = config.guide.bounces
        self.gradient_leak = 0.1
        dim = config.token_dim
        inputs = config.pixel_features
        if config.tokens != "none":
            self.token_input = nn.Linear(config.token_features, 2 * dim)
            self.token_output = nn.Linear(2 * dim, dim)
            self.token_corners = nn.Linear(dim, 3 * LIGHT_DIM)
            inputs += 2 * dim + LIGHT_DIM
        if config.tokens == "encoder":
            self.encoder = nn.ModuleDict(
                {"layers": nn.ModuleList(EncoderLayer(dim, config.token_heads, 4 * dim) for _ in range(config.token_layers))}
            )
            self.pixel_input = nn.Linear(config.pixel_features, PIXEL_DIM)
            self.bundle_input = nn.Linear(PIXEL_DIM * config.bundle**2, dim)
            self.gather = nn.ModuleDict(
                {"layers": nn.ModuleList([DecoderLayer(dim, config.token_heads, 4 * dim, self_attention=False)])}
            )
            inputs += dim
        self.head = Head(inputs, config)

    # --- training and inference -------------------------------------------------------------------------------------------

    def arguments(self, batch: Mapping[str, Any], device: torch.device | str) -> tuple[Any, ...]:
        """What `forward` takes, of a batch as the loader makes it."""
        scenes = self.read_scenes(batch, device)
        size = None if "bundles" in batch else tuple(batch["guide_hit"].shape[2:4])
        return scenes, Pixels.read(batch, scenes, self.config.bundle), size

    def read_scenes(self, batch: Mapping[str, Any], device: torch.device | str) -> Scenes:
        """The scenes of a batch with what this network reads of them; InputError where guides are missing."""
        return Scenes.read(batch, device, self.config.guide.bounces)

    def forward(self, scenes: Scenes, pixels: Pixels, size: tuple[int, int] | None = None, precision: str = "fp32") -> Tensor:
        """(B, V, H, W, 3) log10(1 + radiance) of whole views of that size, or (B, V, K, P^2, 3) of some of their bundles.

        No bundle knows of the others, for a step may have some of a view alone. `frames`, which have whole views, share lobes
        across them.
        """
        with autocast(scenes.corners.device.type, precision == "bf16"):
            radiance = self.decode(self.encode(scenes), pixels)
        radiance = radiance.unflatten(1, (pixels.eye.shape[1], pixels.bundles, -1))
        y = torch.log1p(radiance.float()) / math.log(10)
        return y if size is None else from_bundles(y, *size, self.config.bundle)

    @torch.inference_mode()
    def frames(
        self, scene: Mapping[str, Any], views: Iterable[Mapping[str, Any]], size: tuple[int, int], device: Any
    ) -> Iterator[Tensor]:
        """(H, W, 3) log10(1 + radiance) of one scene's views, one by one.

        scene: padded arrays of a batch of one; views: of each view the arrays that a batch has besides them.
        """
        encoded = self.encode(self.read_scenes(scene, device))
        for view in views:
            radiance = self.decode_view(encoded, Pixels.read(view, encoded.scenes, self.config.bundle))
            yield from_bundles(torch.log1p(radiance) / math.log(10), *size, self.config.bundle)[0, 0]

    def layers(self) -> list[nn.Module]:
        """The units of compilation, recomputation and sharding."""
        towers = [getattr(self, name)["layers"] for name in ("encoder", "gather") if hasattr(self, name)]
        return [*(layer for tower in towers for layer in tower), *self.head.layers]

    def gathering_layers(self) -> list[nn.Module]:
        return list(self.gather["layers"]) if self.config.tokens == "encoder" else []

    def without_learning(self) -> GuidedNetwork | None:
        """The closed form alone; None where the network is not given any light: that image is black."""
        if not self.config.guide.light:
            return None
        network = copy.deepcopy(self)
        network.head.start_at_zero()
        return network

    def flops(self, batch: Mapping[str, Any]) -> dict[str, float]:
        views, height, width = batch["image"].shape[1:4]
        lights = batch["guide_light_triangles"].shape[1]
        return forward_flops(self.config, batch["mask"].sum(axis=1).tolist(), views, height, width, lights=lights)

    def tokens(self, batch: Mapping[str, Any]) -> int:
        bundles = math.prod(batch["image"].shape[:4]) // self.config.bundle**2
        return int(batch["mask"].sum()) + bundles

    # --- per scene --------------------------------------------------------------------------------------------------------

    def encode(self, scenes: Scenes) -> Encoded:
        lit = light_triangles(scenes, self.config.guide)
        centroids = scenes.corners.mean(dim=1)
        if self.config.tokens == "none":
            return Encoded(scenes, lit, None, centroids)
        x = self.token_output(F.silu(self.token_input(token_features(scenes, lit, self.config.guide))))
        if self.config.tokens == "encoder":
            cos, sin = rotary(centroids, self.config.token_dim // self.config.token_heads)
            for layer in self.encoder["layers"]:
                x = run_layer(layer, x, (cos[None], sin[None]), scenes.segments)
        return Encoded(scenes, lit, x, centroids)

    # --- per pixel --------------------------------------------------------------------------------------------------------

    def decode(self, encoded: Encoded, pixels: Pixels) -> Tensor:
        """(B, V K P^2, 3) radiance."""
        return self._draw(encoded, pixels, Observer(encoded.scenes, encoded.lit, self.config.guide).know(pixels))

    def decode_view(self, encoded: Encoded, pixels: Pixels) -> Tensor:
        """(1, 1, K, P^2, 3) radiance of one whole view of one scene, in portions; bundles that hit nothing are black."""
        lights, size = max(1, encoded.scenes.radiance.shape[1]), pixels.size
        observer = Observer(encoded.scenes, encoded.lit, self.config.guide)
        radiance = torch.zeros(1, 1, pixels.bundles, size, 3, device=pixels.eye.device)
        landed = pixels.landed()
        if not len(landed):
            return radiance
        at_once = max(1, AT_ONCE // (lights * SUBSAMPLES * size))
        chosen = landed.split(at_once)
        portions = [pixels.take(bundles) for bundles in chosen]
        seen = [observer.see(portion) for portion in portions]
        lobes, deviation = zip(*map(observer.reflect, portions, seen), strict=True)
        whole = Lobes.joined(lobes).put(landed, pixels.bundles, size)
        reflected = observer.share(whole, size, pixels.grid).unflatten(1, (-1, size))[:, landed]
        parts = zip(chosen, portions, seen, reflected.split(at_once, dim=1), deviation, strict=True)
        for bundles, portion, of_portion, shared, apart in parts:
            known = observer.conclude(portion, of_portion, shared.flatten(1, 2), apart)
            radiance[0, 0, bundles] = self._draw(encoded, portion, known).view(len(bundles), size, 3)
        return radiance

    def _draw(self, encoded: Encoded, pixels: Pixels, known: Known) -> Tensor:
        """The pixels (B, M, 3) of which that is known."""
        features = [known.features]
        if encoded.tokens is not None:
            tokens = encoded.tokens.float()
            corners = self.token_corners(tokens).unflatten(-1, (3, LIGHT_DIM))
            main = known.main
            features += [tokens[main.triangle] * main.there, main.interpolate(corners) * main.there]
            features.append(tokens[pixels.mirror.triangle] * pixels.mirror.there)
        if self.config.tokens == "encoder":
            features.append(self._gather(encoded, pixels, known))
        outputs, corrections = self.head(torch.cat(features, dim=-1), known.lights)
        return self._compose(encoded.scenes, known, outputs.float(), corrections)

    def _gather(self, encoded: Encoded, pixels: Pixels, known: Known) -> Tensor:
        """(B, M, d): what each pixel's bundle gathers from the tokens, by attention at the mean position that it hits."""
        views, size = pixels.eye.shape[1], pixels.size
        head_dim = self.config.token_dim // self.config.token_heads
        grid = self.pixel_input(known.features).unflatten(1, (views, pixels.bundles, size))
        x = self.bundle_input(grid.flatten(-2)).flatten(0, 1)  # (B V, K, d)
        position = known.position.unflatten(1, (views, pixels.bundles, size))
        coverage = known.coverage.unflatten(1, (views, pixels.bundles, size))
        place = (position * coverage).sum(dim=3) / coverage.sum(dim=3).clamp(min=1e-6)
        ray_cos, ray_sin = rotary(place.flatten(0, 1), head_dim)
        cos, sin = rotary(encoded.centroids, head_dim)
        for layer in self.gather["layers"]:
            x = run_layer(
                layer, x, encoded.tokens[None], (cos[None, None], sin[None, None]), (ray_cos[:, None], ray_sin[:, None]),
                encoded.scenes.segments, None,
            )  # fmt: skip
        x = x.unflatten(0, (-1, views)).flatten(1, 2)  # (B, V K, d)
        return x.repeat_interleave(size, dim=1)

    def _compose(self, scenes: Scenes, known: Known, outputs: Tensor, corrections: Tensor | None) -> Tensor:
        """The image (B, M, 3) from the head's outputs."""
        rays, direct = known.rays, known.direct
        indirect, reflected, gate = outputs.split([3, 3, 1], dim=-1)
        soft = direct.seen.clamp(SOFT, 1 - SOFT)

        def spread(values: Tensor) -> Tensor:
            return values.repeat_interleave(SUBSAMPLES, dim=1)

        def light(closed_form: Tensor, change: Tensor) -> Tensor:
            seen = (direct.seen + torch.sigmoid(torch.logit(soft) + spread(change)) - soft).clamp(0, 1)
            return sum_over_lights(closed_form * seen, scenes.radiance)

        bounced = 0.0 if known.bounced is None else known.bounced
        diffuse, specular = self.positive(bounced + spread(indirect)), spread(self.positive(reflected))
        if corrections is not None:
            diffuse = diffuse + light(direct.diffuse, corrections[..., 0].float())
            specular = specular + light(direct.specular, corrections[..., 1].float())
        specular = specular + spread(self.positive(1 + gate) * known.reflected)
        image = (rays.diffuse * diffuse + rays.specular * specular) * rays.there
        return mean_of_rays(image, 1) * scenes.scale[:, None, None]

    def positive(self, x: Tensor) -> Tensor:
        """max(x, 0), with some gradient also where that is flat: what starts at zero could not rise otherwise."""
        return x.clamp(min=0) + self.gradient_leak * (x - x.detach()) * (x <= 0)

    def leak_gradient(self, share: float) -> None:
        self.gradient_leak = share
