"""What guides hold, and their bytes in a shard: ``guides.npz`` of a scene, ``view<i>.guides.npz`` of each view.

Reads and writes bytes. One design choice: a hit is a triangle and barycentric weights, never a position. So guides need no
change where the scene is moved or relit, and a mirrored scene swaps two weights. Weights are stored in 255 steps, triangles
plus one, visibility as bits.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from pipeline.errors import UserError

SUBSAMPLES = 4  # rays of a pixel, 2 x 2, row by row
MIRRORED = (1, 0, 3, 2)  # the sub-samples of a pixel whose image is flipped left to right
WEIGHT_STEPS = 255  # of a stored barycentric weight
BOUNCE_RAYS = 16  # rays from each side of a triangle, a square number
SCENE_MEMBER = "guides.npz"


def guide_member(index: int) -> str:
    """Name of the member with a view's guides."""
    return f"view{index}.guides.npz"


@dataclass
class SceneGuides:
    """Of a scene, whatever the camera. N triangles, L of them emit.

    light_triangles: (L,) int32, rows of the scene's triangles.
    light_seen: (N, 4, L) bool, whether a point of the triangle sees a point of the light. Points 0 to 2 lie near the corners,
        point 3 at the centroid (``casting.POINTS``).

    With ``bounces``, else None:
    bounces: (N, 2, 16) int32, what rays hit that leave the triangle's front and back, spread by the cosine to its normal; -1
        for nothing. bounces_weights: (N, 2, 16, 2) float32, barycentric, of the second and the third corner.
    vertex: (N, 3) int32 under 3 N; corners of one number lie at one place of one smooth surface.
    """

    light_triangles: np.ndarray
    light_seen: np.ndarray
    bounces: np.ndarray | None = None
    bounces_weights: np.ndarray | None = None
    vertex: np.ndarray | None = None

    def mirrored(self) -> SceneGuides:
        """Of the mirrored scene, with the second and third corner of triangles swapped."""
        light_seen = self.light_seen[:, [0, 2, 1, 3]]
        if self.bounces is None:
            return SceneGuides(self.light_triangles, light_seen)
        weights = np.ascontiguousarray(self.bounces_weights[..., ::-1])
        return SceneGuides(self.light_triangles, light_seen, self.bounces, weights, self.vertex[:, [0, 2, 1]])


@dataclass
class ViewGuides:
    """Of a view of H x W pixels. Triangles are int32 rows of the scene's, -1 where a ray hits nothing; barycentric weights
    are float32, of the second and the third corner.

    hit: (H, W, 4), what the pixel's 2 x 2 rays hit; lights are invisible to them. hit_weights: (H, W, 4, 2).
    main: (H, W) int32, one of these rays that hits something, -1 where none does; of these the first, row by row.
    mirror: (H, W), what the mirror reflection of that ray hits. mirror_weights: (H, W, 2).
    lobe: (H, W, 4), what a reflection of each ray hits that is drawn from the surface's GGX lobe. lobe_weights: (H, W, 4, 2).
    light_seen: (H, W, 4, L) bool, whether the hit point sees a point of the light; False where the light is behind it.
    """

    hit: np.ndarray
    hit_weights: np.ndarray
    main: np.ndarray
    mirror: np.ndarray
    mirror_weights: np.ndarray
    lobe: np.ndarray
    lobe_weights: np.ndarray
    light_seen: np.ndarray

    def mirrored(self) -> ViewGuides:
        """As a camera sees them in the scene that is mirrored, with the second and third corner of triangles swapped."""
        flipped = {name: values[:, ::-1] for name, values in vars(self).items()}
        for name in ("hit", "hit_weights", "lobe", "lobe_weights", "light_seen"):
            flipped[name] = flipped[name][:, :, list(MIRRORED)]
        for name in ("hit_weights", "mirror_weights", "lobe_weights"):
            flipped[name] = flipped[name][..., ::-1]
        flipped["main"] = np.where(flipped["main"] < 0, -1, np.array(MIRRORED, np.int32)[flipped["main"]])
        return ViewGuides(**{name: np.ascontiguousarray(values) for name, values in flipped.items()})


def check_guides(triangles: int, scene: SceneGuides, views: Iterable[ViewGuides]) -> None:
    """UserError unless the guides can be those of a scene of so many triangles."""
    lights = scene.light_triangles
    fits = scene.light_seen.shape == (triangles, SUBSAMPLES, len(lights))
    fits = fits and (not len(lights) or 0 <= lights.min() <= lights.max() < triangles)
    if scene.bounces is not None:
        fits = fits and scene.bounces.shape[:2] == (triangles, 2) and scene.vertex.shape == (triangles, 3)
        fits = fits and scene.bounces_weights.shape == (*scene.bounces.shape, 2)
        fits = fits and scene.bounces.max(initial=-1) < triangles
        fits = fits and 0 <= scene.vertex.min(initial=0) <= scene.vertex.max(initial=0) < max(3 * triangles, 1)
    for view in views:
        fits = fits and view.light_seen.shape[-1] == len(lights) and view.main.max(initial=-1) < SUBSAMPLES
        fits = fits and all(kind.max(initial=-1) < triangles for kind in (view.hit, view.mirror, view.lobe))
    if not fits:
        raise UserError(f"the guides are not those of a scene of {triangles} triangles: make the shards again")


# --- bytes ----------------------------------------------------------------------------------------------------------------


def encode_scene_guides(guides: SceneGuides) -> bytes:
    arrays = {"light_triangles": guides.light_triangles.astype(np.int32), "light_seen": _bits(guides.light_seen)}
    if guides.bounces is not None:
        arrays |= _hits("bounces", guides.bounces, guides.bounces_weights, _row_kind(guides.bounces))
        arrays["vertex"] = guides.vertex.astype(np.int32)
    return _pack(arrays)


def decode_scene_guides(data: bytes, where: str) -> SceneGuides:
    arrays = _unpack(data, where, ("light_triangles", "light_seen"), ("bounces", "bounces_weights", "vertex"))
    arrays["light_seen"] = _from_bits(arrays["light_seen"], len(arrays["light_triangles"]), where)
    if "bounces" in arrays:
        _as_hits(arrays, "bounces")
    return SceneGuides(**arrays)


def encode_view_guides(guides: ViewGuides) -> bytes:
    arrays = {"light_seen": _bits(guides.light_seen), "lights": np.int32(guides.light_seen.shape[-1])}
    arrays["main"] = guides.main.astype(np.int8)
    kind = _row_kind(guides.hit, guides.mirror, guides.lobe)
    for name in ("hit", "mirror", "lobe"):
        arrays |= _hits(name, getattr(guides, name), getattr(guides, f"{name}_weights"), kind)
    return _pack(arrays)


def decode_view_guides(data: bytes, where: str) -> ViewGuides:
    arrays = _unpack(data, where, (*(field.name for field in fields(ViewGuides)), "lights"))
    arrays["main"] = arrays["main"].astype(np.int32)
    arrays["light_seen"] = _from_bits(arrays["light_seen"], int(arrays.pop("lights")), where)
    for name in ("hit", "mirror", "lobe"):
        _as_hits(arrays, name)
    return ViewGuides(**arrays)


def _row_kind(*rows: np.ndarray) -> type:
    """The smallest integers that hold such rows plus one."""
    return np.uint16 if max(kind.max(initial=-1) for kind in rows) < 65535 else np.uint32


def _hits(name: str, rows: np.ndarray, weights: np.ndarray, kind: type) -> dict[str, np.ndarray]:
    return {name: (rows + 1).astype(kind), f"{name}_weights": np.round(weights * WEIGHT_STEPS).astype(np.uint8)}


def _as_hits(arrays: dict[str, Any], name: str) -> None:
    """Turn what `_hits` made back, in place."""
    arrays[name] = arrays[name].astype(np.int32) - 1
    arrays[f"{name}_weights"] = arrays[f"{name}_weights"].astype(np.float32) / np.float32(WEIGHT_STEPS)


def _bits(seen: np.ndarray) -> np.ndarray:
    return np.packbits(seen, axis=-1)


def _from_bits(packed: np.ndarray, lights: int, where: str) -> np.ndarray:
    if not 0 <= lights <= 8 * packed.shape[-1]:
        raise UserError(f"{where}: visibility of {lights} lights cannot be in {packed.shape[-1]} bytes")
    return np.unpackbits(packed, axis=-1, count=lights).astype(bool)


def _pack(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Always the same bytes of the same arrays (numpy dates zip members 1980)."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **{name: arrays[name] for name in sorted(arrays)})
    return buffer.getvalue()


def _unpack(data: bytes, where: str, names: tuple[str, ...], optional: tuple[str, ...] = ()) -> dict[str, Any]:
    """optional: names that are there all or none."""
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            return {name: file[name] for name in (*names, *(optional if set(optional) & set(file.files) else ()))}
    except (KeyError, ValueError, OSError, EOFError, MemoryError, zipfile.BadZipFile, zipfile.zlib.error) as error:
        raise UserError(f"{where} cannot be decoded ({type(error).__name__}: {error})") from error
