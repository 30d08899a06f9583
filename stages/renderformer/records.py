"""The records that stages exchange: shapes, dtypes, units and frames, in one place.

Frames: a scene is one unit, its content inside [-0.5, 0.5]^3, z up, right-handed. Cameras look along -z with +y up and +x
right; ``camera_to_world`` is a rigid 4x4. Radiance is linear, in scene-linear RGB, without units. F triangles, V views,
L lights, H x W pixels with row 0 on top.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pipeline.stage import Record
from stages.graphics.arrays import pack_arrays, pack_json, unpack_arrays, unpack_json

# The 13 channels of a RenderFormer triangle patch and where they start, in the released order (section 3, item 1).
PATCH_CHANNELS: Mapping[str, slice] = {
    "diffuse": slice(0, 3),
    "specular": slice(3, 6),
    "roughness": slice(6, 7),
    "normal": slice(7, 10),
    "emission": slice(10, 13),
}
PATCH_NORMAL = (0.5, 0.5, 1.0)  # the released format's constant tangent-space normal
PATCH_SIDE = 32  # texels along a patch's legs
TEXTURED_CHANNELS = 7  # the first channels, diffuse, specular and roughness, may change within a triangle
_STEP = np.add.outer(np.arange(PATCH_SIDE), np.arange(PATCH_SIDE))  # row + column
PATCH_INSIDE = _STEP < PATCH_SIDE  # texels whose centre lies inside the triangle, on its third side included
PATCH_KEPT = _STEP <= PATCH_SIDE  # texels that bilinear lookup inside the triangle needs; the others are 0


@dataclass
class SceneRecord:
    """A scene as the renderer and the model see it: the same arrays for both.

    triangles: (F, 3, 3) float32, world space, scene units.
    vertex_normals: (F, 3, 3) float32, unit shading normals per corner, world space.
    diffuse: (F, 3) float32 in [0, 1]. specular: (F, 3) float32 in [0, 1]. roughness: (F,) float32 in [0.01, 1],
        GGX alpha = roughness^2. BSDF = diffuse / pi + specular * GGX, no Fresnel term.
    emission: (F, 3) float32, radiance >= 0, both sides emit. An emitting triangle reflects nothing.
    light_index: (F,) int16, -1 where a triangle does not emit, else the light (0..L-1) that it belongs to.
    object_index: (F,) int16 into ``meta["objects"]`` (walls, objects and lights).
    camera_to_world: (V, 4, 4) float32. fov_deg: (V,) float32, full angle of the square image.
    meta: JSON. ``template``, ``law``, ``split``, ``objects`` [{name, kind: wall|object|light, object_id?, faces}]. ``aspect``:
        width over height of each camera's picture, where one is not square; ``fov_deg`` is across the height.
    patch_index: (F,) int32, the row of ``patches`` that a textured triangle reads, -1 where a triangle is constant; None in
        scenes without textures.
    patches: (T, 7, 32, 32) float16, channels 0..6 of PATCH_CHANNELS (diffuse, specular, roughness) as right-triangle patches;
        normal and emission never change within a triangle. The centre of texel [row, column] has barycentric weight
        (column + 0.5) / 32 of corner 1 and (row + 0.5) / 32 of corner 2; texels with row + column > 32 are 0. Looked up
        bilinearly, clamped to the triangle. ``diffuse``, ``specular`` and ``roughness`` of a textured triangle hold the means
        over the texels inside it (``patch_means``).
    """

    id: str
    triangles: np.ndarray
    vertex_normals: np.ndarray
    diffuse: np.ndarray
    specular: np.ndarray
    roughness: np.ndarray
    emission: np.ndarray
    light_index: np.ndarray
    object_index: np.ndarray
    camera_to_world: np.ndarray
    fov_deg: np.ndarray
    meta: dict[str, Any] = field(default_factory=dict)
    patch_index: np.ndarray | None = None
    patches: np.ndarray | None = None

    DTYPES = {
        "triangles": np.float32,
        "vertex_normals": np.float32,
        "diffuse": np.float32,
        "specular": np.float32,
        "roughness": np.float32,
        "emission": np.float32,
        "light_index": np.int16,
        "object_index": np.int16,
        "camera_to_world": np.float32,
        "fov_deg": np.float32,
    }
    PATCH_DTYPES = {"patch_index": np.int32, "patches": np.float16}  # only in scenes with textured triangles

    @property
    def textured(self) -> bool:
        """Whether any triangle reads a patch."""
        return self.patch_index is not None and bool((self.patch_index >= 0).any())

    @property
    def n_lights(self) -> int:
        """L, the number of lights."""
        return int(self.light_index.max(initial=-1)) + 1

    def picture_size(self, view: int, side: int, multiple: int = 1) -> tuple[int, int]:
        """(height, width) of a camera's picture whose longer side has ``side`` pixels; the other is one of ``multiple``."""
        aspect = self.meta.get("aspect", {view: 1.0})[view]
        shorter = side * min(aspect, 1 / aspect)
        shorter = side if abs(aspect - 1) < 1e-3 else min(max(round(shorter / multiple), 1) * multiple, side)
        return (shorter, side) if aspect > 1 else (side, shorter)

    def arrays(self) -> dict[str, np.ndarray]:
        """What ``scene.npz`` holds; the patches only where a triangle reads one."""
        dtypes = self.DTYPES | self.PATCH_DTYPES if self.textured else self.DTYPES
        return {name: np.asarray(getattr(self, name)).astype(dtype) for name, dtype in dtypes.items()}

    def to_record(self) -> Record:
        # patches are large and mostly repeat themselves: only scenes that have some are worth compressing
        arrays = pack_arrays(self.arrays(), compressed=self.textured)
        return Record(self.id, {"scene.npz": arrays, "meta.json": pack_json(self.meta)})

    @classmethod
    def from_members(cls, id: str, members: Mapping[str, bytes]) -> SceneRecord:
        """From the members ``scene.npz`` and ``meta.json`` of a *scene* record; a shard's are
        ``stages.renderformer.dataset.encoding``'s.
        """
        return cls(id, **unpack_arrays(members["scene.npz"]), meta=unpack_json(members["meta.json"]))

    @classmethod
    def from_record(cls, record: Record) -> SceneRecord:
        return cls.from_members(record.id, record.members)


def patch_means(patches: np.ndarray) -> dict[str, np.ndarray]:
    """``diffuse`` (T, 3), ``specular`` (T, 3) and ``roughness`` (T,) float32 of (T, 7, 32, 32) patches: their means over
    the texels inside the triangle."""
    means = patches[:, :, PATCH_INSIDE].mean(axis=2, dtype=np.float64).astype(np.float32)
    return {
        "diffuse": means[:, PATCH_CHANNELS["diffuse"]],
        "specular": means[:, PATCH_CHANNELS["specular"]],
        "roughness": means[:, PATCH_CHANNELS["roughness"]][:, 0],
    }


@dataclass
class ViewRecord:
    """What the path tracer saw from one camera. Stored as one multi-layer half-float EXR (see ``stages.graphics.exr``).

    lights: (L, H, W, 3) float32 radiance, one layer per light; the image is their sum (light transport is linear).
    direct: (H, W, 3) float32 radiance that reached the camera after at most one bounce, summed over lights.
    albedo: (H, W, 3) float32, diffuse + specular at the first hit. normal: (H, W, 3) float32, world-space shading normal.
    depth: (H, W) float32, distance along the ray in scene units, 0 where nothing was hit. coverage: (H, W) float32 in [0, 1].
    triangle, object: (H, W) int32, what the pixel's first sample hit: row of ``SceneRecord.triangles`` and its
        ``object_index``; -1 for nothing.
    meta: JSON. ``index`` (camera), ``status`` ok|dark|too_close, ``mean``, ``nearest``, ``spp`` (the pixels' mean), ``error``
        (estimated, see ``stages.renderformer.rendering.error``), ``dropped`` (samples from before guiding that are not in it),
        ``denoiser`` fast|high|null, ``clamped`` half-floats.
    """

    lights: np.ndarray
    direct: np.ndarray
    albedo: np.ndarray
    normal: np.ndarray
    depth: np.ndarray
    coverage: np.ndarray
    triangle: np.ndarray
    object: np.ndarray
    meta: dict[str, Any] = field(default_factory=dict)

    @property
    def image(self) -> np.ndarray:
        """(H, W, 3) float32 radiance, all lights on."""
        return self.lights.sum(axis=0)
