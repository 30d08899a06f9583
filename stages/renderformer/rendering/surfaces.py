"""Mitsuba meshes, materials and cameras straight from a SceneRecord's arrays: no mesh file between the renderer and the
data.

Mitsuba's own integrators take diffuse / pi + specular * GGX as ``twosided(blendbsdf(diffuse, roughconductor))`` with the two
reflectances divided by their blend weights; ours reads the same parameters itself
(``stages.renderformer.rendering.material``). Emitting triangles are black. Vertices are unshared, so that face attributes,
corner normals and texture coordinates hold.

Design choice: a parameter that no triangle's patch varies is a face attribute, the same kernels as in a scene without
textures; one that varies is an *atlas*, one picture with a tile per triangle. A textured triangle's tile is its patch with
its border texels repeated, so that Mitsuba's bilinear look-up is the patch's own, clamped to the triangle; the tile of
a constant one is four equal texels. The blend weight stays one per triangle, or the product of weight and colour would
not be linear between texels; what is interpolated of roughness is its square, the GGX width.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from stages.renderformer.records import PATCH_CHANNELS, PATCH_KEPT, PATCH_SIDE, SceneRecord

MIN_ALPHA = 1e-4  # GGX width below which the lobe is numerically a mirror
MAX_WEIGHT = 0.999  # largest blend weight of the specular lobe; also its sampling probability
TILE = PATCH_SIDE + 2  # texels of a textured triangle's tile per side
SMALL_TILE = 2  # of a constant triangle's


class Surfaces:
    """What the renderer knows of the triangles ``faces`` (indices) of a scene: their parameters and where their patches lie.

    Triangle i of everything here is faces[i]. Emitting triangles are black and constant. Parameters are ``diffuse``,
    ``specular``, ``alpha``, and ``albedo``, the sum of the first two; ``blended``: those two over their blend weights.
    """

    def __init__(self, scene: SceneRecord, faces: np.ndarray, blended: bool = False):
        emits = scene.light_index[faces] >= 0
        black = np.where(emits, np.float32(0), np.float32(1))[:, None]
        diffuse, specular = scene.diffuse[faces] * black, scene.specular[faces] * black
        self.weight = np.clip(specular.max(axis=1), 0, MAX_WEIGHT)
        self._below, self._above = np.ones((2, len(faces), 1), np.float32)
        if blended:
            self._below, self._above = (1 - self.weight)[:, None], np.where(self.weight > 0, self.weight, 1)[:, None]
        self.values = {
            "diffuse": diffuse / self._below,
            "specular": specular / self._above,
            "alpha": np.maximum(scene.roughness[faces] ** 2, MIN_ALPHA),
            "albedo": diffuse + specular,
        }
        self.varying: set[str] = set()  # parameters that change within some triangle
        index = scene.patch_index[faces] if scene.textured else np.full(len(faces), -1)
        self.textured = np.flatnonzero((index >= 0) & ~emits)  # those of the faces that have a tile of their own
        if len(self.textured):
            self._patches = np.ascontiguousarray(scene.patches[index[self.textured]], np.float16)
            bits = self._patches.view(np.uint16)  # compares faster than half-floats do
            change = ((bits != bits[:, :, :1, :1]) & PATCH_KEPT).any(axis=(0, 2, 3))
            change = {name: bool(change[PATCH_CHANNELS[name]].any()) for name in ("diffuse", "specular", "roughness")}
            of = {"diffuse": "diffuse", "specular": "specular", "alpha": "roughness"}
            self.varying = {name for name, source in of.items() if change[source]}
            if change["diffuse"] or change["specular"]:
                self.varying.add("albedo")

    @cached_property
    def atlas(self) -> Atlas:
        return Atlas(len(self.weight), self.textured)

    def bound(self, name: str, of: Callable) -> np.ndarray:
        """(F, ..) the least (``of``: np.min) or largest value of ``specular`` or ``alpha`` within each triangle."""
        values = self.values[name].copy()
        if name in self.varying:
            patches = self._patches[:, PATCH_CHANNELS["specular" if name == "specular" else "roughness"]][..., PATCH_KEPT]
            values[self.textured] = of(patches.astype(np.float32), axis=-1).reshape(values[self.textured].shape)
            if name == "alpha":
                values[self.textured] = np.maximum(values[self.textured] ** 2, MIN_ALPHA)
        return values

    def picture(self, name: str) -> np.ndarray:
        """(height, width, channels) float32: the atlas of a parameter that varies."""

        def part(channels: str) -> np.ndarray:  # (T, 32, 32, channels)
            return np.moveaxis(self._patches[:, PATCH_CHANNELS[channels]].astype(np.float32), 1, -1)

        if name == "diffuse":
            patches = part("diffuse") / self._below[self.textured, None, None]
        elif name == "specular":
            patches = part("specular") / self._above[self.textured, None, None]
        elif name == "alpha":
            patches = np.maximum(part("roughness") ** 2, MIN_ALPHA)
        else:
            patches = part("diffuse") + part("specular")
        return self.atlas.picture(self.values[name].reshape(len(self.weight), -1), patches)


class Atlas:
    """Where the tiles of ``count`` triangles lie in a square picture; those of ``textured`` (indices) hold patches."""

    def __init__(self, count: int, textured: np.ndarray):
        constant = np.setdiff1d(np.arange(count), textured)
        columns = max(1, int(np.ceil(np.sqrt(len(textured) + len(constant) * (SMALL_TILE / TILE) ** 2))))
        self.width = columns * TILE
        self.corner = np.zeros((count, 2), np.int64)  # column and row of each tile's first texel
        place = np.arange(len(textured))
        self.corner[textured] = np.stack([place % columns, place // columns], axis=1) * TILE
        top = -(-len(textured) // columns) * TILE
        place, columns = np.arange(len(constant)), self.width // SMALL_TILE
        self.corner[constant] = np.stack([place % columns, place // columns], axis=1) * SMALL_TILE + [0, top]
        self.height = top + -(-len(constant) // columns) * SMALL_TILE
        self.textured, self.constant = textured, constant

    def coordinates(self) -> np.ndarray:
        """(F, 3, 2) texture coordinates of the triangles' corners; (0, 0) is the picture's first texel's outer corner."""
        legs = np.array([[0, 0], [PATCH_SIDE, 0], [0, PATCH_SIDE]])
        texels = np.empty((len(self.corner), 3, 2))
        texels[self.textured] = self.corner[self.textured, None] + 1 + legs
        texels[self.constant] = self.corner[self.constant, None] + SMALL_TILE / 2
        return texels / [self.width, self.height]

    def picture(self, values: np.ndarray, patches: np.ndarray) -> np.ndarray:
        """(height, width, channels) float32 from (F, channels) values and the (T, 32, 32, channels) of textured triangles."""
        out = np.zeros((self.height, self.width, values.shape[1]), np.float32)

        def fill(faces: np.ndarray, side: int, tiles: np.ndarray) -> None:
            step = np.arange(side)
            rows = self.corner[faces, 1][:, None, None] + step[:, None]
            columns = self.corner[faces, 0][:, None, None] + step
            out[rows, columns] = tiles

        fill(self.textured, TILE, np.pad(patches, ((0, 0), (1, 1), (1, 1), (0, 0)), mode="edge"))
        fill(self.constant, SMALL_TILE, values[self.constant, None, None])
        return out


def material(surfaces: Surfaces, albedo_only: bool = False) -> mi.BSDF:
    """The two-sided GGX material of the faces; ``albedo_only``: a diffuse one for first-hit channels."""

    def source(name: str) -> Any:
        if name not in surfaces.varying:
            return {"type": "mesh_attribute", "name": f"face_{name}"}
        return atlas_texture(surfaces.picture(name))

    if albedo_only:
        return mi.load_dict({"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": source("albedo")}})
    diffuse = {"type": "diffuse", "reflectance": source("diffuse")}
    # `material: none` is a perfect mirror: no Fresnel term.
    specular = {
        "type": "roughconductor",
        "distribution": "ggx",
        "material": "none",
        "alpha": source("alpha"),
        "specular_reflectance": source("specular"),
    }
    weight = {"type": "mesh_attribute", "name": "face_weight"}
    blend = {"type": "blendbsdf", "weight": weight, "bsdf_0": diffuse, "bsdf_1": specular}
    return mi.load_dict({"type": "twosided", "bsdf": blend})


def atlas_texture(picture: np.ndarray) -> Any:
    """A (H, W, channels) picture as a Mitsuba texture: its numbers as they are, bilinear, nothing from outside."""
    # not accelerated: a GPU's own texture units interpolate with 8 bits
    options = {"raw": True, "filter_type": "bilinear", "wrap_mode": "clamp", "accel": False}
    return mi.load_dict({"type": "bitmap", "data": mi.TensorXf(picture), **options})


def shape_mesh(scene: SceneRecord, surfaces: Surfaces) -> mi.Mesh:
    """All triangles without a material of Mitsuba's, with texture coordinates where patches need them."""
    coordinates = surfaces.atlas.coordinates() if surfaces.varying else None
    return mesh_of(scene.triangles, scene.vertex_normals, coordinates=coordinates)


def surface_mesh(scene: SceneRecord, faces: np.ndarray, albedo_only: bool = False) -> mi.Mesh:
    """The triangles ``faces`` (indices) as one mesh; triangle i of the mesh is faces[i]."""
    surfaces = Surfaces(scene, faces, blended=True)
    coordinates = surfaces.atlas.coordinates() if surfaces.varying else None
    bsdf = material(surfaces, albedo_only)
    mesh = mesh_of(scene.triangles[faces], scene.vertex_normals[faces], bsdf, coordinates=coordinates)
    names = ("albedo",) if albedo_only else ("diffuse", "specular", "alpha")
    attributes = {name: surfaces.values[name] for name in names if name not in surfaces.varying}
    if not albedo_only:
        attributes["weight"] = surfaces.weight
    for name, values in attributes.items():
        mesh.add_attribute(f"face_{name}", values.shape[1] if values.ndim > 1 else 1, floats(values))
    return mesh


def mesh_of(
    triangles: np.ndarray,
    normals: np.ndarray | None,
    bsdf: mi.BSDF | None = None,
    emitter: mi.Emitter | None = None,
    coordinates: np.ndarray | None = None,
) -> mi.Mesh:
    """(F, 3, 3) triangles with corner normals (None: flat) and (F, 3, 2) texture coordinates (None: none) as a Mitsuba mesh
    with unshared vertices."""
    props = mi.Properties()
    if bsdf is not None:
        props["bsdf"] = bsdf
    if emitter is not None:
        props["emitter"] = emitter
    count = len(triangles)
    mesh = mi.Mesh(
        "triangles",
        3 * count,
        count,
        props=props,
        has_vertex_normals=normals is not None,
        has_vertex_texcoords=coordinates is not None,
    )
    params = mi.traverse(mesh)
    params["vertex_positions"] = floats(triangles)
    params["faces"] = (
        np.arange(3 * count, dtype=np.uint32) if _scalar() else mi.UInt32(aligned(np.arange(3 * count), np.uint32))
    )
    if normals is not None:
        params["vertex_normals"] = floats(normals)
    if coordinates is not None:
        params["vertex_texcoords"] = floats(coordinates)
    params.update()
    return mesh


def _scalar() -> bool:
    return mi.variant().startswith("scalar")


def floats(values: np.ndarray):
    """Flat numbers for Mitsuba."""
    flat = aligned(values, np.float32)
    return flat if _scalar() else dr.auto.ad.Float(flat)


def gatherable(values: np.ndarray, kind: type | None = None):
    """A flat array for kernels to gather from; ``kind``: mi.Float by default.

    It has two entries at least: Dr.Jit writes an array of one into the code of a kernel, which is then compiled for each value.
    """
    kind = kind or mi.Float
    flat = aligned(values, {mi.Float: np.float32, mi.UInt32: np.uint32, mi.Int32: np.int32}[kind])
    return kind(aligned(np.resize(flat, 2), flat.dtype) if len(flat) == 1 else flat)


def aligned(values: np.ndarray, dtype: type) -> np.ndarray:
    """Flat copy that starts at a multiple of 64 bytes: Dr.Jit uses NumPy's memory as it is, and compiles kernels anew for
    arrays that lie otherwise."""
    flat = np.ascontiguousarray(values, dtype).reshape(-1)
    room = np.empty(flat.nbytes + 64, np.uint8)
    first = -room.ctypes.data % 64
    out = room[first : first + flat.nbytes].view(dtype)
    out[:] = flat
    return out
