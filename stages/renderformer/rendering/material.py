"""The material of the JIT integrator: diffuse / pi + specular * GGX, two-sided, its lobes read from triangles or patches.

Mitsuba's microfacet distribution supplies normals and masking. Masking and shadowing are height-correlated, as in Cycles;
Mitsuba's own ``roughconductor``, which the scalar renderer has to use, takes them as independent: darker at grazing angles on
rough metal. ``multiscatter`` adds what single scattering loses between the facets, as Cycles' "Multiscatter GGX" does.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np

from stages.renderformer.rendering.surfaces import MIN_ALPHA, Surfaces, atlas_texture, gatherable

CELLS = 32  # of the tables of directional albedo, per axis
NARROW_ALPHA = 0.1  # GGX width under which the specular lobe is a narrow part of the material, else of its wide part


@cache
def directional_albedo() -> tuple[np.ndarray, np.ndarray]:
    """What a white GGX lobe reflects by single scattering: E (CELLS, CELLS) by roughness and cosine, and its cosine-weighted
    mean over cosines (CELLS,). Roughness, the square root of alpha, and cosine run evenly from 0 to 1."""
    steps = 64
    u, v = (axis.ravel() for axis in np.meshgrid(*[(np.arange(steps) + 0.5) / steps] * 2))
    cosines = np.linspace(0, 1, CELLS).clip(1e-3)
    table = np.ones((CELLS, CELLS))
    for row, roughness in enumerate(np.linspace(0, 1, CELLS)[1:], 1):
        alpha = roughness**2
        for column, cosine in enumerate(cosines):
            # visible normals (Dupuy and Benyoub 2023): a point on the cap of half vectors of the stretched hemisphere
            sine = np.sqrt(1 - cosine**2)
            x, z = alpha * sine, cosine
            length = np.hypot(x, z)
            x, z = x / length, z / length
            height = (1 - v) * (1 + z) - z
            radius = np.sqrt(np.clip(1 - height**2, 0, None))
            m = np.stack([alpha * (radius * np.cos(2 * np.pi * u) + x), alpha * radius * np.sin(2 * np.pi * u), height + z])
            m /= np.linalg.norm(m, axis=0)
            out = 2 * (sine * m[0] + cosine * m[2]) * m[2] - cosine  # z of the reflected direction
            up = out > 0
            tangent2 = 1 / np.where(up, out, 1) ** 2 - 1
            masked = [0.5 * (np.sqrt(1 + alpha**2 * t) - 1) for t in (1 / cosine**2 - 1, tangent2)]
            table[row, column] = np.mean(np.where(up, (1 + masked[0]) / (1 + masked[0] + masked[1]), 0))
    weights = cosines / cosines.sum()
    return table, table @ weights


@dataclass
class Lobes:
    """The material at surface interactions."""

    diffuse: mi.Color3f
    specular: mi.Color3f
    alpha: mi.Float  # GGX width

    @property
    def specular_share(self) -> mi.Float:
        """Probability to sample the specular lobe."""
        bright, dull = dr.max(self.specular), dr.max(self.diffuse)
        return bright / dr.maximum(bright + dull, 1e-20)

    @property
    def is_narrow(self) -> mi.Bool:
        return self.alpha < NARROW_ALPHA

    def part(self, narrow: bool) -> Lobes:
        """The narrow or the wide part."""
        specular = dr.select(self.is_narrow == narrow, self.specular, 0)
        return Lobes(mi.Color3f(0) if narrow else self.diffuse, specular, self.alpha)


class Material:
    """The lobes of a scene's triangles, of which ``surfaces`` are all; emitting ones are black."""

    def __init__(self, surfaces: Surfaces, multiscatter: bool):
        self._pictures = {name: atlas_texture(surfaces.picture(name)) for name in sorted(surfaces.varying - {"albedo"})}
        self._values = {
            name: gatherable(surfaces.values[name]) for name in ("diffuse", "specular", "alpha") if name not in self._pictures
        }
        self._albedo = [gatherable(table) for table in directional_albedo()] if multiscatter else None

    def at(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> Lobes:
        diffuse, specular = (
            self._pictures[name].eval(si, active)
            if name in self._pictures
            else dr.gather(mi.Color3f, self._values[name], si.prim_index, active)
            for name in ("diffuse", "specular")
        )
        if "alpha" in self._pictures:
            alpha = self._pictures["alpha"].eval_1(si, active)
        else:
            alpha = dr.gather(mi.Float, self._values["alpha"], si.prim_index, active)
        return Lobes(diffuse, specular, dr.maximum(alpha, MIN_ALPHA))

    def evaluate(self, lobes: Lobes, wi: mi.Vector3f, wo: mi.Vector3f) -> tuple[mi.Color3f, mi.Float]:
        """BSDF times cosine, and density per solid angle of `sample`, for directions in the shading frame."""
        diffuse, specular, density = self.evaluate_lobes(lobes, wi, wo)
        return diffuse + specular, density

    def evaluate_lobes(self, lobes: Lobes, wi: mi.Vector3f, wo: mi.Vector3f) -> tuple[mi.Color3f, mi.Color3f, mi.Float]:
        """As `evaluate`, with the diffuse and the specular lobe's part of the first apart."""
        side = dr.select(wi.z < 0, -1, 1)  # seen from below: the same material
        wi, wo = mi.Vector3f(wi.x, wi.y, wi.z * side), mi.Vector3f(wo.x, wo.y, wo.z * side)
        above = (wi.z > 0) & (wo.z > 0)
        facets = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, lobes.alpha, True)
        half = dr.normalize(wi + wo)
        seen, lit = facets.smith_g1(wi, half), facets.smith_g1(wo, half)
        shape = facets.eval(half) / (4 * dr.maximum(wi.z, 1e-12))
        masked = dr.select((seen > 0) & (lit > 0), 1 / (1 / seen + 1 / lit - 1), 0)
        diffuse = lobes.diffuse * (dr.inv_pi * wo.z)
        specular = self._specular(lobes, wi.z) * (shape * masked)
        density = dr.lerp(dr.inv_pi * wo.z, shape * seen, lobes.specular_share)
        return dr.select(above, diffuse, 0), dr.select(above, specular, 0), dr.select(above, density, 0)

    def sample(self, lobes: Lobes, wi: mi.Vector3f, glossy: mi.Bool, spot: mi.Point2f) -> mi.Vector3f:
        """A direction in the shading frame, by the specular lobe where ``glossy``, else by the diffuse one."""
        side = dr.select(wi.z < 0, -1, 1)
        wi = mi.Vector3f(wi.x, wi.y, wi.z * side)
        facets = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, lobes.alpha, True)
        normal, _ = facets.sample(wi, spot)
        wo = dr.select(glossy, mi.reflect(wi, normal), mi.warp.square_to_cosine_hemisphere(spot))
        return mi.Vector3f(wo.x, wo.y, wo.z * side)

    def _specular(self, lobes: Lobes, cosine: mi.Float) -> mi.Color3f:
        """With multiple scattering, what comes back from further bounces between facets is spread like the first."""
        if self._albedo is None:
            return lobes.specular
        table, means = self._albedo
        row, row_part = _cell(dr.sqrt(lobes.alpha))
        column, part = _cell(cosine)

        def at(step: int) -> mi.Float:
            low, high = (dr.gather(mi.Float, table, (row + step) * CELLS + column + side) for side in (0, 1))
            return dr.lerp(low, high, part)

        single = dr.maximum(dr.lerp(at(0), at(1), row_part), 1e-3)
        mean = dr.lerp(dr.gather(mi.Float, means, row), dr.gather(mi.Float, means, row + 1), row_part)
        again = lobes.specular * mean / dr.maximum(1 - lobes.specular * (1 - mean), 1e-3)
        return lobes.specular * (1 + again * (1 - single) / single)


def _cell(x: mi.Float) -> tuple[mi.UInt32, mi.Float]:
    """The cell of CELLS grid points over [0, 1], and how far into it."""
    x = dr.clip(x, 0, 1) * (CELLS - 1)
    cell = dr.minimum(mi.UInt32(x), CELLS - 2)
    return cell, x - mi.Float(cell)
