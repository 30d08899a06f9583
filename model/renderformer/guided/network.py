"""The guided network: radiance = s (k_d (sum_l V_l D_l L_l + E) + k_s (sum_l V'_l S_l L_l + m M + R)).

D_l and S_l are the closed forms of each light on a diffuse and on a GGX surface (``light``), V_l its visibility, M what the
reflections hit, lit in closed form too; s is the scene's scale. The network makes V_l from what rays say of it, the gate m,
and E and R, the light that no closed form has. Its last layers start at zero: before training the image is the closed form.
Tokens of triangles carry the indirect light; ray bundles gather from them at the surface that they hit, not at the camera.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.renderformer.base import Network, autocast, run_layer
from model.renderformer.guided.config import (
    LIGHT_DIM,
    LIGHT_FEATURES,
    PIXEL_DIM,
    PIXEL_FEATURES,
    TOKEN_FEATURES,
    GuidedConfig,
)
from model.renderformer.guided.flops import forward_flops
from model.renderformer.guided.inputs import POINTS, SUBSAMPLES, Hits, Scenes, Surface
from model.renderformer.guided.light import (
    diffuse_light,
    dot,
    joint_masking,
    masking,
    specular_light,
    sum_over_lights,
    vector_form_factor,
)
from model.renderformer.layers import LAYER_EPS, DecoderLayer, EncoderLayer, FeedForward, RMSNorm, Rotation

FREQUENCIES = 4  # of an encoded position: pi, 2 pi, 4 pi, 8 pi
SOFT = 0.02  # visibility is corrected as if it were this far from 0 and 1
SHARED = 0.7  # of a lobe's width: how far apart pixels are that share what their lobes see
AT_ONCE = 300_000  # pairs of ray and light that are computed together where no gradient is kept


@dataclass
class Pixels:
    """Some pixels of the views of B scenes, by ray bundles: B x (V K) bundles of P^2 pixels of 4 rays.

    eye: (B, V, 3). hit, mirror, lobe: rays (B, V K P^2 4), (B, V K P^2), (B, V K P^2 4). main: (B, V K P^2), the ray of each
    pixel that its mirror reflection starts from. seen: (B, V K P^2 4, L).
    """

    eye: Tensor
    hit: Hits
    mirror: Hits
    lobe: Hits
    main: Tensor
    seen: Tensor
    bundles: int  # of a view
    bundle: int

    @classmethod
    def read(cls, batch: Mapping[str, Any], scenes: Scenes, bundle: int) -> Pixels:
        device = scenes.corners.device
        arrays = {name: np.asarray(batch[f"guide_{name}"]) for name in GUIDES}
        if "bundles" not in batch:
            arrays = {name: to_bundles(array, bundle) for name, array in arrays.items()}
        hits = {name: Hits.read(arrays[name], arrays[f"{name}_weights"], scenes) for name in ("hit", "mirror", "lobe")}
        seen = torch.from_numpy(np.ascontiguousarray(arrays["light_seen"])).to(device).float()
        eye = torch.from_numpy(np.ascontiguousarray(batch["camera_to_world"][:, :, :3, 3])).to(device).float()
        main = torch.from_numpy(np.ascontiguousarray(arrays["main"])).to(device).long().clamp(min=0).flatten(1)
        return cls(eye, **hits, main=main, seen=seen.flatten(1, -2), bundles=arrays["hit"].shape[2], bundle=bundle)

    def landed(self) -> Tensor:
        """Of one view of one scene the bundles that hit anything."""
        return self.hit.there.view(self.bundles, -1).any(dim=1).nonzero()[:, 0]

    def take(self, bundles: Tensor) -> Pixels:
        """Some bundles of one view of one scene."""

        def some(rays: Tensor) -> Tensor:
            return rays.unflatten(1, (self.bundles, -1))[:, bundles].flatten(1, 2)

        hits = {
            name: Hits(**{part: some(value) for part, value in vars(getattr(self, name)).items()})
            for name in ("hit", "mirror", "lobe")
        }
        return Pixels(self.eye, **hits, main=some(self.main), seen=some(self.seen), bundles=len(bundles), bundle=self.bundle)


GUIDES = ("hit", "hit_weights", "main", "mirror", "mirror_weights", "lobe", "lobe_weights", "light_seen")


def to_bundles(pixels: np.ndarray, side: int) -> np.ndarray:
    """(B, V, H, W, ...) -> (B, V, K, side^2, ...), bundles row by row."""
    batch, views, height, width, *rest = pixels.shape
    grid = pixels.reshape(batch, views, height // side, side, width // side, side, *rest).swapaxes(3, 4)
    return grid.reshape(batch, views, -1, side * side, *rest)


def from_bundles(bundles: Tensor, height: int, width: int, side: int) -> Tensor:
    """(B, V, K, side^2, C) -> (B, V, H, W, C)."""
    grid = bundles.unflatten(2, (height // side, width // side)).unflatten(4, (side, side))
    return grid.transpose(3, 4).flatten(4, 5).flatten(2, 3)


def encode_position(positions: Tensor) -> Tensor:
    """(..., 3) -> (..., 27): the position, and sines and cosines of pi 2^0..3 times it."""
    angles = (positions[..., None] * _frequencies(positions)).flatten(-2)
    return torch.cat([positions, angles.sin(), angles.cos()], dim=-1)


def rotary(positions: Tensor, head_dim: int) -> Rotation:
    """(..., 3) -> cos and sin (..., head_dim / 2), the angles of `model.renderformer.layers.rotate`."""
    frequencies = math.pi * 2.0 ** torch.arange(head_dim // 6, device=positions.device)
    angles = (positions[..., None].float() * frequencies).flatten(-2)
    return angles.cos(), angles.sin()


def _frequencies(positions: Tensor) -> Tensor:
    return math.pi * 2.0 ** torch.arange(FREQUENCIES, device=positions.device)


@dataclass
class Lit:
    """What the closed forms say of the scenes, before any network: kept between views.

    light: (T, 2, 4, 3), radiance that a white diffuse surface reflects at each point of the triangle, front and back, over s.
    open_light: (T, 2, 3), the same at the centroid with nothing in the way.
    """

    light: Tensor
    open_light: Tensor


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
        self.gradient_leak = 0.1
        dim = config.token_dim
        inputs = PIXEL_FEATURES
        if config.tokens != "none":
            self.token_input = nn.Linear(TOKEN_FEATURES, 2 * dim)
            self.token_output = nn.Linear(2 * dim, dim)
            self.token_corners = nn.Linear(dim, 3 * LIGHT_DIM)
            inputs += 2 * dim + LIGHT_DIM
        if config.tokens == "encoder":
            self.encoder = nn.ModuleDict(
                {"layers": nn.ModuleList(EncoderLayer(dim, config.token_heads, 4 * dim) for _ in range(config.token_layers))}
            )
            self.pixel_input = nn.Linear(PIXEL_FEATURES, PIXEL_DIM)
            self.bundle_input = nn.Linear(PIXEL_DIM * config.bundle**2, dim)
            self.gather = nn.ModuleDict(
                {"layers": nn.ModuleList([DecoderLayer(dim, config.token_heads, 4 * dim, self_attention=False)])}
            )
            inputs += dim
        self.head = Head(inputs, config)

    # --- training and inference -------------------------------------------------------------------------------------------

    def arguments(self, batch: Mapping[str, Any], device: torch.device | str) -> tuple[Any, ...]:
        """What `forward` takes, of a batch as the loader makes it."""
        scenes = Scenes.read(batch, device)
        size = None if "bundles" in batch else tuple(batch["guide_hit"].shape[2:4])
        return scenes, Pixels.read(batch, scenes, self.config.bundle), size

    def forward(self, scenes: Scenes, pixels: Pixels, size: tuple[int, int] | None = None, precision: str = "fp32") -> Tensor:
        """(B, V, H, W, 3) log10(1 + radiance) of whole views of that size, or (B, V, K, P^2, 3) of some of their bundles."""
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
        encoded = self.encode(Scenes.read(scene, device))
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
        lit = self._light_triangles(scenes)
        centroids = scenes.corners.mean(dim=1)
        if self.config.tokens == "none":
            return Encoded(scenes, lit, None, centroids)
        x = self.token_output(F.silu(self.token_input(self._token_features(scenes, lit))))
        if self.config.tokens == "encoder":
            cos, sin = rotary(centroids, self.config.token_dim // self.config.token_heads)
            for layer in self.encoder["layers"]:
                x = run_layer(layer, x, (cos[None], sin[None]), scenes.segments)
        return Encoded(scenes, lit, x, centroids)

    @torch.no_grad()
    def _light_triangles(self, scenes: Scenes) -> Lit:
        weights = torch.tensor(POINTS, device=scenes.corners.device)
        points = torch.einsum("kc,tcd->tkd", weights, scenes.corners)
        normal = face_normals(scenes.corners)
        scene = scenes.scene_of
        lights, radiance = scenes.light_corners[scene], scenes.radiance[scene]  # (T, L, 3, 3), (T, L, 3)
        factor = vector_form_factor(points[:, :, None], lights[:, None])  # (T, 4, L, 3)
        cosine = dot(factor, normal[:, None, None])
        sides = torch.stack([cosine, -cosine], dim=1).clamp(min=0)  # (T, 2, 4, L)
        seen = scenes.seen[:, None] if self.config.guide.visibility else 1.0
        light = ((sides * seen)[..., None] * radiance[:, None, None]).sum(dim=-2)
        open_light = (sides[:, :, 3, :, None] * radiance[:, None]).sum(dim=-2)
        return Lit(light, open_light)

    @torch.no_grad()
    def _token_features(self, scenes: Scenes, lit: Lit) -> Tensor:
        """(T, TOKEN_FEATURES)."""
        corners, guide = scenes.corners, self.config.guide
        centroid = corners.mean(dim=1)
        cross = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = cross.norm(dim=-1, keepdim=True) / 2
        roughness = scenes.roughness[:, None]
        light = torch.cat([lit.open_light.flatten(1), lit.light[:, 0].flatten(1), lit.light[:, 1].mean(dim=1)], dim=1)
        if not guide.light:
            light = torch.zeros_like(light)
        elif not guide.visibility:
            light = torch.cat([light[:, :6], torch.zeros_like(light[:, 6:])], dim=1)
        return torch.cat(
            [
                encode_position(centroid),
                ((corners - centroid[:, None]) * 8).flatten(1),
                face_normals(corners),
                scenes.vertex_normals.flatten(1),
                torch.log10(area.clamp(min=1e-12)) / 3 + 1,
                scenes.diffuse,
                scenes.specular,
                roughness,
                roughness.clamp(min=1e-2).log(),
                (scenes.emission.sum(dim=1, keepdim=True) > 0).float(),
                torch.log10(1 + scenes.emission),
                torch.log1p(light),
            ],
            dim=1,
        )

    # --- per pixel --------------------------------------------------------------------------------------------------------

    def decode(self, encoded: Encoded, pixels: Pixels) -> Tensor:
        """(B, V K P^2, 3) radiance."""
        with torch.no_grad():
            known = self._known(encoded, pixels)
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

    def decode_view(self, encoded: Encoded, pixels: Pixels) -> Tensor:
        """(1, 1, K, P^2, 3) radiance of one view of one scene, in portions; bundles that hit nothing are black."""
        lights, size = max(1, encoded.scenes.radiance.shape[1]), self.config.bundle**2
        radiance = torch.zeros(1, 1, pixels.bundles, size, 3, device=pixels.eye.device)
        landed = pixels.landed()
        for bundles in landed.split(max(1, AT_ONCE // (lights * SUBSAMPLES * size))) if len(landed) else ():
            radiance[0, 0, bundles] = self.decode(encoded, pixels.take(bundles)).view(len(bundles), size, 3)
        return radiance

    def _gather(self, encoded: Encoded, pixels: Pixels, known: Known) -> Tensor:
        """(B, M, d): what each pixel's bundle gathers from the tokens, by attention at the mean position that it hits."""
        views, size = pixels.eye.shape[1], self.config.bundle**2
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

    def _known(self, encoded: Encoded, pixels: Pixels) -> Known:
        """All that needs no weights."""
        scenes = encoded.scenes
        eye = pixels.eye.repeat_interleave(pixels.bundles * self.config.bundle**2, dim=1)  # (B, M, 3)
        rays = Surface.at(pixels.hit, scenes, eye.repeat_interleave(SUBSAMPLES, dim=1))
        direct = self._direct(scenes, pixels, rays)
        main, surface = _main(pixels, rays)
        mirror = self._reflected(encoded, surface, pixels.mirror)
        coverage = _mean(rays.there, 1)
        means = Surface(**{name: _mean(value, 1) / coverage.clamp(min=1 / SUBSAMPLES) for name, value in vars(rays).items()})
        reflected, deviation = self._reflections(encoded, pixels, rays, means, mirror, surface)
        features = [
            encode_position(means.position),
            means.normal,
            surface.to_eye,
            surface.mirrored,
            dot(surface.to_eye, surface.normal)[..., None],
            means.diffuse,
            means.specular,
            means.roughness,
            means.roughness.clamp(min=1e-2).log(),
            coverage,
            main.weights * main.there,
            *self._light_sums(scenes, direct, coverage),
            *self._mirror_features(mirror, surface),
            torch.log1p(reflected) * float(self.config.guide.lobe),
            torch.log1p(deviation),
        ]
        lights = self._light_features(scenes, surface, coverage, direct)
        return Known(torch.cat(features, dim=-1), lights, rays, direct, reflected, means.position, coverage, main)

    def _direct(self, scenes: Scenes, pixels: Pixels, rays: Surface) -> Direct:
        factor = vector_form_factor(rays.position[:, :, None], scenes.light_corners[:, None])  # (B, M 4, L, 3)
        normal = rays.normal[:, :, None]
        diffuse = diffuse_light(factor, normal)
        specular = specular_light(factor, normal, rays.to_eye[:, :, None], rays.alpha[:, :, None])
        seen = torch.ones_like(diffuse)
        if self.config.guide.shadow_rays:
            seen = pixels.seen
        elif self.config.guide.visibility:
            seen = pixels.hit.between_points(scenes.seen)
        return Direct(factor, diffuse, specular, seen)

    def _reflected(self, encoded: Encoded, surface: Surface, hits: Hits) -> Reflected:
        """What reflections at ``surface`` hit, and how it is lit."""
        scenes = encoded.scenes
        second = Surface.at(hits, scenes, surface.position)
        ways = second.position - surface.position
        back = (dot(ways, face_normals(scenes.corners)[hits.triangle]) > 0).long()
        light = hits.between_points(encoded.lit.light.flatten(0, 1), 2 * hits.triangle + back)
        out = F.normalize(ways, dim=-1)
        eye, away = (dot(surface.normal, way) for way in (surface.to_eye, out))
        returned = joint_masking(surface.alpha, eye, away) / masking(surface.alpha, eye)
        there = hits.there * surface.there * (away > 0)[..., None]
        return Reflected(
            second,
            ways,
            light * there,
            self._highlight(scenes, second, hits, surface.alpha) * there,
            returned[..., None] * there,
        )

    def _highlight(self, scenes: Scenes, surface: Surface, hits: Hits, before: Tensor) -> Tensor:
        """(B, M, 3): the lights in a white lobe of surfaces, as far as the triangles' points see them.

        before: (B, M), GGX width of the surface that the ray comes from. It blurs what it shows, so highlights are widened by
        it: rays are few, and would find narrow ones rarely, and then as bright dots.
        """
        alpha = torch.sqrt(surface.alpha.square() + before.square()).clamp(max=1)
        factor = vector_form_factor(surface.position[:, :, None], scenes.light_corners[:, None])
        shape = specular_light(factor, surface.normal[:, :, None], surface.to_eye[:, :, None], alpha[:, :, None])
        if self.config.guide.visibility:
            shape = shape * hits.between_points(scenes.seen)
        return sum_over_lights(shape, scenes.radiance)

    def _reflections(
        self, encoded: Encoded, pixels: Pixels, rays: Surface, means: Surface, mirror: Reflected, surface: Surface
    ) -> tuple[Tensor, Tensor]:
        """(B, M, 3) twice: radiance that a white lobe returns of what reflections hit, the lights left out; and how far apart
        the rays of the pixel are in it."""
        none = torch.zeros_like(means.position)
        if not self.config.guide.lobe:
            return (mirror.image if self.config.guide.mirror else none), none
        lobe = self._reflected(encoded, rays, pixels.lobe).image
        mean = _per_pixel(lobe, rays)
        return share_lobes(mean, means.position, surface, mirror.distance, self.config.bundle**2), _deviation(lobe)

    def _light_sums(self, scenes: Scenes, direct: Direct, coverage: Tensor) -> list[Tensor]:
        """Of each pixel the closed forms of all lights together, diffuse and specular: open, and as far as lights are seen."""
        parts = (direct.diffuse, direct.specular, direct.diffuse * direct.seen, direct.specular * direct.seen)
        sums = [_mean(sum_over_lights(part, scenes.radiance), 1) for part in parts]
        share = coverage.clamp(min=1 / SUBSAMPLES)
        return [torch.log1p(total / share) * float(self.config.guide.light) for total in sums]

    def _mirror_features(self, mirror: Reflected, surface: Surface) -> list[Tensor]:
        second = mirror.surface
        parts = [
            mirror.ways, mirror.distance, second.normal, second.diffuse, second.specular, second.roughness,
            torch.log1p(second.diffuse * mirror.light), torch.log1p(mirror.highlight), surface.there,
        ]  # fmt: skip
        return [part * second.there * float(self.config.guide.mirror) for part in parts]

    def _light_features(self, scenes: Scenes, surface: Surface, coverage: Tensor, direct: Direct) -> Tensor:
        """(B, M, L, LIGHT_FEATURES): direction, size, cosine, closed forms and visibility of each light in each pixel."""
        share = coverage.clamp(min=1 / SUBSAMPLES)
        diffuse, specular, seen = (_mean(values, 1) / share for values in (direct.diffuse, direct.specular, direct.seen))
        vector = _mean(direct.factor, 1)
        size = vector.norm(dim=-1, keepdim=True)
        direction = vector / size.clamp(min=1e-12)
        radiance = scenes.radiance.mean(dim=-1)[:, None]
        bright = [torch.log1p(part * radiance) for part in (diffuse, specular)]
        cosines = [dot(direction, way[:, :, None]) for way in (surface.normal, surface.mirrored)]
        parts = [*bright, seen, seen * (1 - seen), *cosines, surface.roughness.expand_as(seen)]
        offset = scenes.light_corners.mean(dim=2)[:, None] - surface.position[:, :, None]
        return torch.cat([direction, offset, torch.stack(parts, dim=-1)], dim=-1)

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

        diffuse, specular = spread(self.positive(indirect)), spread(self.positive(reflected))
        if corrections is not None:
            diffuse = diffuse + light(direct.diffuse, corrections[..., 0].float())
            specular = specular + light(direct.specular, corrections[..., 1].float())
        specular = specular + spread(self.positive(1 + gate) * known.reflected)
        image = (rays.diffuse * diffuse + rays.specular * specular) * rays.there
        return _mean(image, 1) * scenes.scale[:, None, None]

    def positive(self, x: Tensor) -> Tensor:
        """max(x, 0), with some gradient also where that is flat: what starts at zero could not rise otherwise."""
        return x.clamp(min=0) + self.gradient_leak * (x - x.detach()) * (x <= 0)

    def leak_gradient(self, share: float) -> None:
        self.gradient_leak = share


@dataclass
class Direct:
    """The closed forms at B x M 4 rays, of L lights. factor: (B, M 4, L, 3); diffuse, specular, seen: (B, M 4, L)."""

    factor: Tensor
    diffuse: Tensor
    specular: Tensor
    seen: Tensor


@dataclass
class Reflected:
    """What M reflections of B scenes hit. ways: (B, M, 3), from where they leave. light: (B, M, 3), of a white diffuse surface
    there; highlight: the same of a white lobe. returned: (B, M, 1), what a white lobe returns of it to the eye."""

    surface: Surface
    ways: Tensor
    light: Tensor
    highlight: Tensor
    returned: Tensor

    @property
    def distance(self) -> Tensor:
        """(B, M, 1)."""
        return self.ways.norm(dim=-1, keepdim=True)

    @property
    def image(self) -> Tensor:
        """(B, M, 3), radiance that a white lobe returns."""
        return (self.surface.diffuse * self.light + self.surface.specular * self.highlight) * self.returned


@dataclass
class Known:
    """What needs no weights, of B x M pixels and their M 4 rays.

    features: (B, M, PIXEL_FEATURES). lights: (B, M, L, LIGHT_FEATURES). rays: what the rays hit. direct: how it is lit.
    reflected: (B, M, 3), radiance in reflections.
    position: (B, M, 3) and coverage (B, M, 1), of the pixel. main: the main ray of each pixel.
    """

    features: Tensor
    lights: Tensor
    rays: Surface
    direct: Direct
    reflected: Tensor
    position: Tensor
    coverage: Tensor
    main: Hits


def face_normals(corners: Tensor) -> Tensor:
    """(T, 3, 3) -> (T, 3), unit."""
    return F.normalize(torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), dim=-1, eps=1e-20)


def _mean(values: Tensor, dim: int) -> Tensor:
    """(B, M 4, ...) -> (B, M, ...): over a pixel's rays."""
    return values.unflatten(dim, (-1, SUBSAMPLES)).mean(dim=dim + 1)


def share_lobes(radiance: Tensor, position: Tensor, surface: Surface, distance: Tensor, size: int) -> Tensor:
    """(B, M, 3): reflected radiance, averaged over the pixels of a bundle as far as their lobes see the same.

    Few rays of a wide lobe are noise; the neighbours' rays are more of them. Two pixels share where they are nearer to one
    another than the lobe is wide at the distance of what it sees, and their normals differ by less than the lobe is wide. So a
    mirror shares nothing. ``size``: pixels of a bundle.
    """

    def bundles(values: Tensor) -> Tensor:
        return values.unflatten(1, (-1, size))  # (B, bundles, size, C)

    alpha = surface.alpha[..., None]
    there = bundles(surface.there)
    reach = bundles(SHARED * alpha * torch.where(distance > 0, distance, 1.0)).clamp(min=1e-5)
    width = bundles(SHARED * alpha)
    apart = (
        _squared_distances(bundles(position)) / reach.square() + _squared_distances(bundles(surface.normal)) / width.square()
    )
    ratio = bundles(alpha) / bundles(alpha).transpose(-1, -2)
    alike = (ratio - 1).abs() < 0.1
    weight = torch.exp(-apart / 2) * alike * there * there.transpose(-1, -2)
    weight = weight + torch.eye(size, device=weight.device) * 1e-6
    return (weight @ bundles(radiance) / weight.sum(dim=-1, keepdim=True)).flatten(1, 2)


def _squared_distances(points: Tensor) -> Tensor:
    """(..., N, C) -> (..., N, N)."""
    return (points[..., :, None, :] - points[..., None, :, :]).square().sum(dim=-1)


def _per_pixel(values: Tensor, rays: Surface) -> Tensor:
    """(B, M 4, C) -> (B, M, C): the mean over those of a pixel's rays that hit something."""
    return _mean(values * rays.there, 1) / _mean(rays.there, 1).clamp(min=1 / SUBSAMPLES)


def _deviation(values: Tensor) -> Tensor:
    """(B, M 4, C) -> (B, M, C): how far a pixel's rays lie apart."""
    grid = values.unflatten(1, (-1, SUBSAMPLES))
    return grid.amax(dim=2) - grid.amin(dim=2)


def _main(pixels: Pixels, rays: Surface) -> tuple[Hits, Surface]:
    """Of each pixel its main ray, as hits and as surface."""

    def choose(values: Tensor) -> Tensor:
        grid = values.unflatten(1, (-1, SUBSAMPLES))
        index = pixels.main.reshape(*pixels.main.shape, 1, *[1] * (grid.ndim - 3))
        return grid.gather(2, index.expand(-1, -1, 1, *grid.shape[3:])).squeeze(2)

    hits = Hits(**{name: choose(values) for name, values in vars(pixels.hit).items()})
    return hits, Surface(**{name: choose(values) for name, values in vars(rays).items()})
