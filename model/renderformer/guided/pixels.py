"""What is known of pixels without any weights: where their rays land, how that is lit, and what reflections show."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from model.renderformer.guided.config import GuideConfig
from model.renderformer.guided.inputs import SUBSAMPLES, Hits, Scenes, Surface
from model.renderformer.guided.light import (
    TINY,
    diffuse_light,
    dot,
    joint_masking,
    masking,
    specular_light,
    sum_over_lights,
    vector_form_factor,
)
from model.renderformer.guided.triangles import Lit, encode_position

SHARED = 0.7  # of a lobe's width: how far apart pixels are that share what their lobes see
LEAST = 1e-6  # a pixel's own share where it shares with none
GUIDES = ("hit", "hit_weights", "main", "mirror", "mirror_weights", "lobe", "lobe_weights", "light_seen")


@dataclass
class Pixels:
    """Some pixels of the views of B scenes, by ray bundles: B x (V K) bundles of P^2 pixels of 4 rays.

    eye: (B, V, 3). hit, mirror, lobe: rays (B, V K P^2 4), (B, V K P^2), (B, V K P^2 4). main: (B, V K P^2), the ray of each
    pixel that its mirror reflection starts from. seen: (B, V K P^2 4, L). grid: bundles down and across of whole views.
    """

    eye: Tensor
    hit: Hits
    mirror: Hits
    lobe: Hits
    main: Tensor
    seen: Tensor
    bundles: int  # of a view
    bundle: int
    grid: tuple[int, int] | None = None

    @classmethod
    def read(cls, batch: Mapping[str, Any], scenes: Scenes, bundle: int) -> Pixels:
        device = scenes.corners.device
        arrays = {name: np.asarray(batch[f"guide_{name}"]) for name in GUIDES}
        grid = None
        if "bundles" not in batch:
            grid = tuple(side // bundle for side in arrays["hit"].shape[2:4])
            arrays = {name: to_bundles(array, bundle) for name, array in arrays.items()}
        hits = {name: Hits.read(arrays[name], arrays[f"{name}_weights"], scenes) for name in ("hit", "mirror", "lobe")}
        seen = torch.from_numpy(np.ascontiguousarray(arrays["light_seen"])).to(device).float()
        eye = torch.from_numpy(np.ascontiguousarray(batch["camera_to_world"][:, :, :3, 3])).to(device).float()
        main = torch.from_numpy(np.ascontiguousarray(arrays["main"])).to(device).long().clamp(min=0).flatten(1)
        return cls(eye, **hits, main=main, seen=seen.flatten(1, -2), bundles=arrays["hit"].shape[2], bundle=bundle, grid=grid)

    @property
    def size(self) -> int:
        """Pixels of a bundle."""
        return self.bundle**2

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


def to_bundles(pixels: Any, side: int) -> Any:
    """(B, V, H, W, ...) -> (B, V, K, side^2, ...), bundles row by row; an array or a tensor."""
    batch, views, height, width, *rest = pixels.shape
    grid = pixels.reshape(batch, views, height // side, side, width // side, side, *rest).swapaxes(3, 4)
    return grid.reshape(batch, views, -1, side * side, *rest)


def from_bundles(bundles: Tensor, height: int, width: int, side: int) -> Tensor:
    """(B, V, K, side^2, C) -> (B, V, H, W, C)."""
    grid = bundles.unflatten(2, (height // side, width // side)).unflatten(4, (side, side))
    return grid.transpose(3, 4).flatten(4, 5).flatten(2, 3)


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
class Seen:
    """What M pixels see, of B scenes. rays: by each of their rays, M 4; means: over those that hit something; main, surface: by
    the main ray, and mirror: what it hits next. coverage: (B, M, 1)."""

    rays: Surface
    main: Hits
    surface: Surface
    mirror: Reflected
    means: Surface
    coverage: Tensor


@dataclass
class Lobes:
    """Radiance that white lobes of surfaces return, and which surfaces they are: (..., C), by pixels.

    radiance: C = 3, of the pixel's own rays. position, normal: C = 3. alpha, there: C = 1. reach: C = 1, how far from one
    another pixels see nearly the same.
    """

    radiance: Tensor
    position: Tensor
    normal: Tensor
    alpha: Tensor
    there: Tensor
    reach: Tensor

    @classmethod
    def joined(cls, portions: Sequence[Lobes]) -> Lobes:
        """One after the other, along dimension 1."""
        return cls(**{name: torch.cat([getattr(portion, name) for portion in portions], dim=1) for name in LOBES})

    def put(self, bundles: Tensor, of: int, size: int) -> Lobes:
        """These are ``bundles`` of one view of one scene, which has so many of that size. The others hit nothing."""

        def whole(name: str) -> Tensor:
            values = getattr(self, name).unflatten(1, (-1, size))
            everything = values.new_full((1, of, size, values.shape[-1]), float(name != "there"))
            everything[:, bundles] = values
            return everything.flatten(1, 2)

        return Lobes(**{name: whole(name) for name in LOBES})

    def map(self, change: Callable[[Tensor], Tensor]) -> Lobes:
        return Lobes(**{name: change(getattr(self, name)) for name in LOBES})

    def likeness(self, other: Lobes) -> Tensor:
        """(..., 1): how far these lobes see what others see.

        Pixels share where they are nearer to one another than the lobe is wide at the distance of what it sees, and their
        normals differ by less than the lobe is wide. So a mirror shares nothing.
        """
        width = SHARED * self.alpha
        apart = _squared(self.position - other.position) / self.reach.square()
        apart = apart + _squared(self.normal - other.normal) / width.square()
        alike = (self.alpha / other.alpha - 1).abs() < 0.1
        return torch.exp(-apart / 2) * alike * self.there * other.there


LOBES = tuple(field.name for field in fields(Lobes))


@dataclass
class Known:
    """What needs no weights, of B x M pixels and their M 4 rays.

    features: (B, M, ``pixel_features`` of the config). lights: (B, M, L, LIGHT_FEATURES). rays: what the rays hit. direct: how
    it is lit by lamps. bounced: (B, M 4, 3), by other triangles, on a white diffuse surface; None without that guide.
    reflected: (B, M, 3), radiance in reflections.
    position: (B, M, 3) and coverage (B, M, 1), of the pixel. main: the main ray of each pixel.
    """

    features: Tensor
    lights: Tensor
    rays: Surface
    direct: Direct
    bounced: Tensor | None
    reflected: Tensor
    position: Tensor
    coverage: Tensor
    main: Hits


@dataclass(frozen=True)
class Observer:
    """Finds what is known of pixels of ``scenes``, as far as ``guide`` lets it."""

    scenes: Scenes
    lit: Lit
    guide: GuideConfig

    @torch.no_grad()
    def see(self, pixels: Pixels) -> Seen:
        eye = pixels.eye.repeat_interleave(pixels.bundles * pixels.size, dim=1)  # (B, M, 3)
        rays = Surface.at(pixels.hit, self.scenes, eye.repeat_interleave(SUBSAMPLES, dim=1))
        main, surface = _main(pixels, rays)
        mirror = self._reflected(surface, pixels.mirror)
        coverage = mean_of_rays(rays.there, 1)
        means = Surface(
            **{name: mean_of_rays(value, 1) / coverage.clamp(min=1 / SUBSAMPLES) for name, value in vars(rays).items()}
        )
        return Seen(rays, main, surface, mirror, means, coverage)

    @torch.no_grad()
    def reflect(self, pixels: Pixels, seen: Seen) -> tuple[Lobes, Tensor]:
        """What white lobes return of what reflections hit, without lights; and (B, M, 3), how far a pixel's rays are apart.

        Without that guide, what the mirror reflection returns, where that is given.
        """
        surface, distance = seen.surface, seen.mirror.distance
        none = torch.zeros_like(seen.means.position)
        radiance, deviation = (seen.mirror.image if self.guide.mirror else none), none
        if self.guide.lobe:
            lobe = self._reflected(seen.rays, pixels.lobe).image
            radiance, deviation = per_pixel(lobe, seen.rays), _deviation(lobe)
        alpha = surface.alpha[..., None]
        reach = (SHARED * alpha * torch.where(distance > 0, distance, 1.0)).clamp(min=1e-5)
        return Lobes(radiance, seen.means.position, surface.normal, alpha, surface.there, reach), deviation

    def share(self, lobes: Lobes, size: int, grid: tuple[int, int] | None = None) -> Tensor:
        """(B, M, 3): reflected radiance, averaged over neighbours as far as their lobes see the same.

        Few rays of a wide lobe are noise; the neighbours' rays are more of them. size: pixels of a bundle. grid: bundles down
        and across of whole views. None: the neighbours that are there are those in the same bundle.
        """
        if not self.guide.lobe:
            return lobes.radiance
        return share_lobes(lobes, size) if grid is None else share_lobes_across(lobes, size, grid)

    @torch.no_grad()
    def know(self, pixels: Pixels) -> Known:
        """All that needs no weights. Bundles share lobes with no others, as if each were alone."""
        seen = self.see(pixels)
        lobes, deviation = self.reflect(pixels, seen)
        return self.conclude(pixels, seen, self.share(lobes, pixels.size), deviation)

    @torch.no_grad()
    def conclude(self, pixels: Pixels, seen: Seen, reflected: Tensor, deviation: Tensor) -> Known:
        """What is known of pixels whose reflections, (B, M, 3) radiance and how far a pixel's rays are apart, are known."""
        rays, surface, means, coverage, main = seen.rays, seen.surface, seen.means, seen.coverage, seen.main
        direct = self._direct(pixels, rays)
        bounced = self._bounced(pixels.hit, rays.to_eye)
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
            *self._light_sums(direct, coverage),
            *self._mirror_features(seen.mirror, surface),
            torch.log1p(reflected) * float(self.guide.lobe),
            torch.log1p(deviation),
        ]
        if bounced is not None:
            features.append(torch.log1p(per_pixel(bounced, rays)))
        lights = self._light_features(surface, coverage, direct)
        features = torch.cat(features, dim=-1)
        return Known(features, lights, rays, direct, bounced, reflected, means.position, coverage, main)

    def _direct(self, pixels: Pixels, rays: Surface) -> Direct:
        factor = vector_form_factor(rays.position[:, :, None], self.scenes.light_corners[:, None])  # (B, M 4, L, 3)
        normal = rays.normal[:, :, None]
        diffuse = diffuse_light(factor, normal)
        specular = specular_light(factor, normal, rays.to_eye[:, :, None], rays.alpha[:, :, None])
        seen = torch.ones_like(diffuse)
        if self.guide.shadow_rays:
            seen = pixels.seen
        elif self.guide.visibility:
            seen = pixels.hit.between_points(self.scenes.seen)
        return Direct(factor, diffuse, specular, seen)

    def _bounced(self, hits: Hits, to_eye: Tensor) -> Tensor | None:
        """(B, M, 3), light of other triangles on a white diffuse surface; None without that guide."""
        if self.lit.bounced is None:
            return None
        return hits.interpolate(self.lit.bounced.flatten(0, 1), hits.sides(self.scenes, to_eye)) * hits.there

    def _reflected(self, surface: Surface, hits: Hits) -> Reflected:
        """What reflections at ``surface`` hit, and how it is lit."""
        second = Surface.at(hits, self.scenes, surface.position)
        ways = second.position - surface.position
        light = hits.between_points(self.lit.light.flatten(0, 1), hits.sides(self.scenes, -ways))
        highlight = self._highlight(second, hits, surface.alpha)
        bounced = self._bounced(hits, -ways)
        if bounced is not None:  # a lobe is so wide against other triangles that it sees them as a diffuse surface does
            light, highlight = light + bounced, highlight + bounced
        out = F.normalize(ways, dim=-1)
        eye, away = (dot(surface.normal, way) for way in (surface.to_eye, out))
        returned = joint_masking(surface.alpha, eye, away) / masking(surface.alpha, eye)
        there = hits.there * surface.there * (away > 0)[..., None]
        return Reflected(second, ways, light * there, highlight * there, returned[..., None] * there)

    def _highlight(self, surface: Surface, hits: Hits, before: Tensor) -> Tensor:
        """(B, M, 3): the lights in a white lobe of surfaces, as far as the triangles' points see them.

        before: (B, M), GGX width of the surface that the ray comes from. It blurs what it shows, so highlights are widened by
        it: rays are few, and would find narrow ones rarely, and then as bright dots.
        """
        alpha = torch.sqrt(surface.alpha.square() + before.square()).clamp(max=1)
        factor = vector_form_factor(surface.position[:, :, None], self.scenes.light_corners[:, None])
        shape = specular_light(factor, surface.normal[:, :, None], surface.to_eye[:, :, None], alpha[:, :, None])
        if self.guide.visibility:
            shape = shape * hits.between_points(self.scenes.seen)
        return sum_over_lights(shape, self.scenes.radiance)

    def _light_sums(self, direct: Direct, coverage: Tensor) -> list[Tensor]:
        """Of each pixel the closed forms of all lights together, diffuse and specular: open, and as far as lights are seen."""
        parts = (direct.diffuse, direct.specular, direct.diffuse * direct.seen, direct.specular * direct.seen)
        sums = [mean_of_rays(sum_over_lights(part, self.scenes.radiance), 1) for part in parts]
        share = coverage.clamp(min=1 / SUBSAMPLES)
        return [torch.log1p(total / share) * float(self.guide.light) for total in sums]

    def _mirror_features(self, mirror: Reflected, surface: Surface) -> list[Tensor]:
        second = mirror.surface
        parts = [
            mirror.ways, mirror.distance, second.normal, second.diffuse, second.specular, second.roughness,
            torch.log1p(second.diffuse * mirror.light), torch.log1p(mirror.highlight), surface.there,
        ]  # fmt: skip
        return [part * second.there * float(self.guide.mirror) for part in parts]

    def _light_features(self, surface: Surface, coverage: Tensor, direct: Direct) -> Tensor:
        """(B, M, L, LIGHT_FEATURES): direction, size, cosine, closed forms and visibility of each light in each pixel."""
        share = coverage.clamp(min=1 / SUBSAMPLES)
        diffuse, specular, seen = (mean_of_rays(values, 1) / share for values in (direct.diffuse, direct.specular, direct.seen))
        vector = mean_of_rays(direct.factor, 1)
        size = vector.norm(dim=-1, keepdim=True)
        direction = vector / size.clamp(min=1e-12)
        radiance = self.scenes.radiance.mean(dim=-1)[:, None]
        bright = [torch.log1p(part * radiance) for part in (diffuse, specular)]
        cosines = [dot(direction, way[:, :, None]) for way in (surface.normal, surface.mirrored)]
        parts = [*bright, seen, seen * (1 - seen), *cosines, surface.roughness.expand_as(seen)]
        offset = self.scenes.light_corners.mean(dim=2)[:, None] - surface.position[:, :, None]
        return torch.cat([direction, offset, torch.stack(parts, dim=-1)], dim=-1)


def mean_of_rays(values: Tensor, dim: int) -> Tensor:
    """(B, M 4, ...) -> (B, M, ...): over a pixel's rays."""
    return values.unflatten(dim, (-1, SUBSAMPLES)).mean(dim=dim + 1)


def share_lobes(lobes: Lobes, size: int) -> Tensor:
    """(B, M, 3): radiance, averaged over the pixels of a bundle as far as their lobes see the same. ``size``: those pixels."""
    bundles = lobes.map(lambda values: values.unflatten(1, (-1, size)))  # (B, bundles, size, C)
    one, other = bundles.map(lambda values: values[:, :, :, None]), bundles.map(lambda values: values[:, :, None])
    weight = one.likeness(other)[..., 0]
    weight = weight + torch.eye(size, device=weight.device) * LEAST
    return (weight @ bundles.radiance / weight.sum(dim=-1, keepdim=True)).flatten(1, 2)


def share_lobes_across(lobes: Lobes, size: int, grid: tuple[int, int]) -> Tensor:
    """(B, M, 3): the same, over the neighbours up to half a bundle away, whatever the bundle. ``grid``: bundles down and across
    of whole views."""
    side = math.isqrt(size)
    height, width = (side * bundles for bundles in grid)

    def image(values: Tensor) -> Tensor:
        return from_bundles(values.unflatten(1, (-1, grid[0] * grid[1], size)), height, width, side).flatten(0, 1)

    views = lobes.map(image)  # (B V, H, W, C)
    far = side // 2
    around = views.map(lambda values: F.pad(values, (0, 0, far, far, far, far)))
    around.alpha.clamp_(min=TINY)
    total, weights = LEAST * views.radiance, LEAST
    for down in range(2 * far + 1):
        for right in range(2 * far + 1):
            other = around.map(lambda values, y=down, x=right: values[:, y : y + height, x : x + width])
            weight = views.likeness(other)
            total, weights = total + weight * other.radiance, weights + weight
    shared = without_dots(total / weights, views.there).unflatten(0, (len(lobes.radiance), -1))
    return to_bundles(shared, side).flatten(1, 3)


def without_dots(images: Tensor, there: Tensor) -> Tensor:
    """(B, H, W, C): no pixel is brighter than the second brightest of the eight around it: one that is shows what a single ray
    found by chance. There are (B, H, W, 1): pixels that count; one that has not two such neighbours stays."""
    height, width = images.shape[1:3]
    padded = F.pad(torch.where(there > 0, images, -1.0), (0, 0, 1, 1, 1, 1), value=-1.0)
    first = second = torch.full_like(images, -1.0)
    for down in range(3):
        for right in range(3):
            if (down, right) != (1, 1):
                other = padded[:, down : down + height, right : right + width]
                second = torch.maximum(second, torch.minimum(first, other))
                first = torch.maximum(first, other)
    return torch.where(second < 0, images, torch.minimum(images, second))


def _squared(difference: Tensor) -> Tensor:
    """(..., 3) -> (..., 1), its squared length; several times as fast as a sum over so short a dimension."""
    x, y, z = difference.square().unbind(dim=-1)
    return (x + y + z)[..., None]


def per_pixel(values: Tensor, rays: Surface) -> Tensor:
    """(B, M 4, C) -> (B, M, C): the mean over those of a pixel's rays that hit something."""
    return mean_of_rays(values * rays.there, 1) / mean_of_rays(rays.there, 1).clamp(min=1 / SUBSAMPLES)


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
