"""Frames of a city: path traced by Mitsuba, denoised, exposed and encoded.

A frame's samples are seeded by its id and drawn on one thread, so its bytes depend neither on order nor on the number of
workers.
"""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from PIL import Image
from scipy.ndimage import gaussian_filter

from stages.graphics.cameras import Camera
from stages.graphics.casting import Caster
from stages.graphics.denoising import denoise
from stages.graphics.tonemap import srgb_decode, srgb_encode
from stages.neuras.street.city import City, Group

BOUNCES = 4  # segments of the longest path
SUN = 3.4  # irradiance of a surface that faces the sun, before the exposure
SUN_COLOUR = (1.0, 0.93, 0.8)
INDEX = {"gloss": 1.9, "satin": 1.5}  # of refraction. Of glass it is higher than real, as panes have two sides
EXPOSURE = 1.35
LENS = 0.5  # pixels: deviation of the spot that a lens makes of a point. A box filter alone is sharper than any camera


class Renderer:
    """A city as a Mitsuba scene: built once, rendered often. The variant must be set (``stages.graphics.mitsuba.backend``).

    ``over_white``: where nothing stands there is white in place of the sky, which still lights what does.
    """

    def __init__(self, city: City, caster: Caster, over_white: bool = False):
        import mitsuba as mi

        self.city, self.caster, self.over_white = city, caster, over_white
        self.uvs = np.concatenate([group.uvs for group in city.groups])

        turn = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
        scene: dict[str, Any] = {
            "type": "scene",
            "sky": {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(city.sky)), "to_world": turn},
            "sun": {
                "type": "directional",
                "direction": (-city.sun).tolist(),
                "irradiance": {"type": "rgb", "value": [SUN * channel for channel in SUN_COLOUR]},
            },
        }
        for group in city.groups:
            scene[group.name] = _shape(mi, group)
        self.scene = mi.load_dict(scene)

    def radiance(self, camera: Camera, spp: int, seed: int) -> np.ndarray:
        """(H, W, 3) float32, linear, denoised."""
        import mitsuba as mi

        integrator = mi.load_dict({"type": "path", "max_depth": BOUNCES, "hide_emitters": self.over_white})
        sensor = _sensor(mi, camera, "rgba" if self.over_white else "rgb")
        image = np.array(mi.render(self.scene, sensor=sensor, integrator=integrator, spp=spp, seed=seed))
        colour = np.minimum(np.nan_to_num(image[..., :3]), 30.0)  # a firefly is no light to spread
        albedo, normal = self._guides(camera)
        denoised = denoise(colour, albedo, normal, np.ones(colour.shape[:2]))
        return denoised + (1 - image[..., 3:]) / EXPOSURE if self.over_white else denoised

    def _guides(self, camera: Camera, side: int = 2) -> tuple[np.ndarray, np.ndarray]:
        """Albedo and normal (H, W, 3) for the denoiser, each the mean of ``side`` x ``side`` rays a pixel.

        Mitsuba's own cost twice what the paths cost without a JIT backend.
        """
        seen = self.caster.view(camera, side)
        vertices, faces = self.caster.vertices, self.caster.faces
        corners = vertices[faces[np.maximum(seen.face, 0)]]
        normal = np.cross(corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :])
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
        towards = np.einsum("ijk,ijk->ij", normal, camera.position - self.caster.origin - corners[..., 0, :])
        normal = np.where(seen.hit[..., None], normal * np.sign(towards)[..., None], 0)
        uvs = seen.interpolate(faces, self.uvs)
        albedo = np.ones(normal.shape)
        owner = np.where(seen.hit, self.city.owners[np.maximum(seen.face, 0)], -1)
        for number in np.unique(owner[seen.hit]):
            here, texture = owner == number, self.city.groups[number].texture
            u, v = (np.floor(uvs[here] % 1 * texture.shape[0]).astype(int) % texture.shape[0]).T
            albedo[here] = srgb_decode(texture[v, u] / 255.0)

        def pooled(values: np.ndarray) -> np.ndarray:
            return values.reshape(camera.height, side, camera.width, side, 3).mean(axis=(1, 3)).astype(np.float32)

        return pooled(albedo), pooled(normal)

    def picture(self, camera: Camera, spp: int, seed: int) -> bytes:
        """A PNG."""
        out = io.BytesIO()
        light = gaussian_filter(self.radiance(camera, spp, seed), (LENS, LENS, 0), mode="nearest")
        pixels = (srgb_encode(light * EXPOSURE) * 255 + 0.5).astype(np.uint8)
        Image.fromarray(pixels).save(out, "PNG")
        return out.getvalue()


def _sensor(mi: Any, camera: Camera, pixel_format: str) -> Any:
    flip = np.diag([-1.0, 1.0, -1.0, 1.0])  # Mitsuba's cameras look along +z with +x to the left
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": float(np.degrees(2 * np.arctan(0.5 * camera.width / camera.fx))),
            "fov_axis": "x",
            "near_clip": 0.05,
            "far_clip": 1e4,
            "to_world": mi.ScalarTransform4f(camera.camera_to_world @ flip),
            "film": {
                "type": "hdrfilm", "width": camera.width, "height": camera.height, "pixel_format": pixel_format,
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": "multijitter"},
        }
    )  # fmt: skip


def _shape(mi: Any, group: Group) -> Any:
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(group.texture)), "raw": False}
    if group.kind == "matt":
        surface: dict[str, Any] = {"type": "diffuse", "reflectance": texture}
    elif group.kind in INDEX:
        surface = {
            "type": "roughplastic",
            "diffuse_reflectance": texture,
            "int_ior": INDEX[group.kind],
            "alpha": group.roughness,
            "nonlinear": False,
        }
    else:
        surface = {"type": "roughconductor", "alpha": group.roughness, "specular_reflectance": texture, "material": "none"}
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": surface})
    mesh = mi.Mesh(group.name, len(group.vertices), len(group.faces), has_vertex_texcoords=True, props=properties)
    values = mi.traverse(mesh)
    values["vertex_positions"] = group.vertices.ravel()
    values["faces"] = group.faces.ravel().astype(np.uint32)
    values["vertex_texcoords"] = group.uvs.ravel()
    values.update()
    return mesh
