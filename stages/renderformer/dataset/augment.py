"""Examples: a sample as some of its cameras see it, and what may be done to it exactly.

Reads and writes arrays. One design choice: nothing here approximates. Light transport is linear, so lights may be dimmed,
coloured or turned off, and everything exposed longer; rigid motions and mirrors move triangles, normals and cameras together
(paper section 3.3). tests/renderformer/test_exactness.py compares each with a new render.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from pydantic import Field

from pipeline.config import Section
from pipeline.errors import UserError
from stages.graphics.exr import copy_pixels
from stages.renderformer.dataset.shards import Sample
from stages.renderformer.guides import SceneGuides, ViewGuides
from stages.renderformer.records import SceneRecord
from stages.renderformer.views import LAYERS

Batch = dict[str, Any]

TRIANGLES = ("triangles", "vertex_normals", "diffuse", "specular", "roughness", "emission", "mask")
RADIANCE = ("image", "direct")  # what exposure scales
PIXELS = ("image", *LAYERS)  # (V, H, W) or (V, H, W, 3)
PATCHES = tuple(SceneRecord.PATCH_DTYPES)  # only in examples with textured triangles
GUIDE = "guide_"  # begins the names of guides (``stages.renderformer.guides``), only in examples that were read with them
LIGHT_TRIANGLES, TRIANGLE_SEEN = f"{GUIDE}light_triangles", f"{GUIDE}triangle_seen"
BOUNCE_ARRAYS = tuple(f"{GUIDE}{name}" for name in ("bounces", "bounces_weights", "vertex"))
PIXEL_GUIDES = tuple(f"{GUIDE}{field.name}" for field in dataclasses.fields(ViewGuides))
PADDED = (
    LIGHT_TRIANGLES,
    TRIANGLE_SEEN,
    f"{GUIDE}light_seen",
    *BOUNCE_ARRAYS,
)  # an axis counts a scene's triangles or its lamps


class Relight(Section):
    """Fresh lighting from the stored per-light layers; image and emission follow exactly."""

    share: float = Field(1.0, ge=0, le=1)  # of the samples that are relit
    keep: float = Field(1.0, gt=0, le=1)  # probability that a light stays on; at least one does
    scale: tuple[float, float] = (0.5, 2.0)  # log-uniform factor of each light's radiance
    saturation: float = Field(0.0, ge=0, le=1)  # 0: white stays white; 1: any colour


def draw_light_factors(config: Relight, rng: np.random.Generator, n_lights: int) -> np.ndarray | None:
    """(L, 3) factors of the lights' radiance, or None for the lights as stored."""
    if rng.random() >= config.share or not n_lights:
        return None
    on = rng.random(n_lights) < config.keep
    on[rng.integers(n_lights)] = True
    scale = np.exp(rng.uniform(*np.log(config.scale), size=n_lights))
    hue = rng.uniform(size=(n_lights, 3))
    colour = 1 + config.saturation * (hue / hue.max(axis=1, keepdims=True) - 1)
    return (on * scale)[:, None] * colour


def make_example(sample: Sample, views: np.ndarray, factors: np.ndarray | None, layers: tuple[str, ...] = ()) -> Batch:
    """The sample seen by some of its cameras, its lights reweighted by (L, 3) factors where given.

    ``layers``: AOV layers to take along; ``direct`` is of all lights as stored, so a reweighted example has none.
    """
    scene = sample.scene
    example: Batch = {name: getattr(scene, name) for name in TRIANGLES if name != "mask"}
    example |= {"id": scene.id, "views": np.asarray(views, np.int64), "mask": np.ones(len(scene.triangles), bool)}
    example |= {name: getattr(scene, name)[views] for name in ("camera_to_world", "fov_deg")}
    if scene.textured:
        example |= {name: getattr(scene, name) for name in PATCHES}
    chosen_views = [sample.views[int(view)] for view in views]
    weights = np.ones((scene.n_lights, 3), np.float32) if factors is None else factors.astype(np.float32)
    if chosen_views:
        example["image"] = _stacked([lit_by(view.lights, weights) for view in chosen_views])
        for name in layers:
            if name != "direct" or factors is None:
                if any(getattr(view, name) is None for view in chosen_views):
                    raise UserError(f"views of scene {scene.id} were read without layers: read them with layers=[{name!r}]")
                example[name] = _stacked([getattr(view, name) for view in chosen_views])
    if sample.guides is not None:
        example |= scene_arrays(sample.guides) | view_arrays([sample.view_guides[int(view)] for view in views])
    if factors is not None:
        lit = scene.light_index >= 0
        example["emission"] = scene.emission.copy()
        example["emission"][lit] *= weights[scene.light_index[lit]]
    return example


def scene_arrays(guides: SceneGuides) -> Batch:
    """``guide_light_triangles`` (L,), ``guide_triangle_seen`` (N, 4, L), and what else `SceneGuides` has after ``guide_``."""
    bounces = (guides.bounces, guides.bounces_weights, guides.vertex)
    arrays = {LIGHT_TRIANGLES: guides.light_triangles, TRIANGLE_SEEN: guides.light_seen}
    return arrays | ({} if guides.bounces is None else dict(zip(BOUNCE_ARRAYS, bounces, strict=True)))


def view_arrays(views: Sequence[ViewGuides]) -> Batch:
    """Each field of `ViewGuides` after ``guide_``, (V, H, W, ...)."""
    return {f"{GUIDE}{name}": np.stack([getattr(view, name) for view in views]) for name in vars(views[0])}


def take_bundles(example: Batch, chosen: np.ndarray, side: int) -> Batch:
    """The example with some ray bundles of its views only: images and guides become (V, K, side^2, ...).

    chosen: (V, K) numbers of bundles of side x side pixels, row by row; kept as ``bundles``.
    """

    def take(pixels: np.ndarray) -> np.ndarray:
        views, height, width, *rest = pixels.shape
        grid = pixels.reshape(views, height // side, side, width // side, side, *rest).swapaxes(2, 3)
        bundles = grid.reshape(views, -1, side * side, *rest)
        return np.stack([view[rows] for view, rows in zip(bundles, chosen, strict=True)])

    per_pixel = [name for name in example if name in PIXELS or name in PIXEL_GUIDES]
    return {**example, **{name: take(example[name]) for name in per_pixel}, "bundles": chosen}


def lit_by(lights: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(H, W, 3) float32: lights (L, H, W, 3) weighted by (L, 3) and added one after the other, the same bits everywhere."""
    image = np.zeros_like(lights[0], np.float32) if len(lights) else np.zeros(lights.shape[1:], np.float32)
    scaled = np.empty(image.shape[:2], np.float32)
    on = [(light, weight) for light, weight in zip(lights, weights, strict=True) if weight.any()]
    for channel in range(image.shape[-1]):  # a plane at a time stays in the processor's cache
        for light, weight in on:
            copy_pixels(light[..., channel], scaled)
            scaled *= weight[channel]
            image[..., channel] += scaled
    return image


def _stacked(views: list[np.ndarray]) -> np.ndarray:
    """(V, H, W) or (V, H, W, 3) of V views; half floats become float32."""
    out = planes((len(views), *views[0].shape), np.float32 if views[0].dtype == np.float16 else views[0].dtype)
    for row, view in zip(out, views, strict=True):
        copy_pixels(view, row)
    return out


def expose(example: Batch, factor: float) -> Batch:
    """All radiance, emitted and seen, times a factor."""
    scaled = {name: example[name] * np.float32(factor) for name in ("emission", *RADIANCE) if name in example}
    return {**example, **scaled}


def rotation_from_vector(vector: np.ndarray) -> np.ndarray:
    """(3, 3) rotation about the vector by its length in radians (Rodrigues).

    SciPy's differs in the last bits, so a training would no longer repeat an earlier one bit by bit.
    """
    angle = np.linalg.norm(vector)
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def move(example: Batch, rotation: np.ndarray, translation: np.ndarray) -> Batch:
    """The example rigidly moved; what the cameras see stays the same, but for normals, which are in world space."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    turn = np.ascontiguousarray(rotation.T)  # of rows; BLAS likes it better than a transposed view
    corners = example["triangles"].reshape(-1, 3).astype(np.float64) @ turn
    for axis in range(3):  # numpy is slow where the innermost axis is short
        corners[:, axis] += translation[axis]
    out = {
        **example,
        "triangles": corners.astype(np.float32).reshape(-1, 3, 3),
        "vertex_normals": (example["vertex_normals"].reshape(-1, 3) @ turn.astype(np.float32)).reshape(-1, 3, 3),
        "camera_to_world": (matrix @ example["camera_to_world"]).astype(np.float32),
    }
    if "normal" in out:
        colours = np.moveaxis(out["normal"], -1, 1)  # (V, 3, H, W)
        turned = rotation.astype(np.float32) @ colours.reshape(*colours.shape[:2], -1)
        out["normal"] = np.moveaxis(turned.reshape(colours.shape), 1, -1)
    return out


def mirror(example: Batch) -> Batch:
    """The example mirrored at x = 0: corners change order to keep facing outwards, images flip left to right."""
    flip = np.diag(np.array([-1, 1, 1, 1], np.float32))
    out = {
        **example,
        "triangles": example["triangles"].take([0, 2, 1], axis=1),
        "vertex_normals": example["vertex_normals"].take([0, 2, 1], axis=1),
        # The mirrored camera would be left-handed: turn its x axis round and the image with it.
        "camera_to_world": flip @ example["camera_to_world"] @ flip,
        **{name: example[name][:, :, ::-1] for name in PIXELS if name in example},
        **_mirrored_guides(example),
    }
    if "normal" in out:
        out["normal"] = out["normal"].copy("K")
    for name in ("triangles", "vertex_normals", "normal"):
        if name in out:
            out[name][..., 0] *= -1
    if "patches" in out:  # texels run along corners 1 and 2, which have changed places
        out["patches"] = out["patches"].swapaxes(-1, -2)
    return out


def _mirrored_guides(example: Batch) -> Batch:
    if TRIANGLE_SEEN not in example:
        return {}
    fields = [field.name for field in dataclasses.fields(ViewGuides)]
    views = zip(*(example[f"{GUIDE}{name}"] for name in fields), strict=True)
    mirrored = [ViewGuides(*view).mirrored() for view in views]
    scene = SceneGuides(*(example.get(name) for name in (LIGHT_TRIANGLES, TRIANGLE_SEEN, *BOUNCE_ARRAYS)))
    return scene_arrays(scene.mirrored()) | view_arrays(mirrored)


def planes(shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """An array (.., V, H, W) or (.., V, H, W, 3) for pixels. In memory colours are planes, as they are in the file."""
    if shape[-1] != 3:
        return np.empty(shape, dtype)
    return np.moveaxis(np.empty((*shape[:-3], 3, *shape[-3:-1]), dtype), -3, -1)


def collate(examples: Iterable[Batch], count: int) -> Batch:
    """``count`` examples stacked; triangles padded with zeros to the longest, rows of guides with -1.

    A generator is asked for one example after the other, whose pixels are copied and let go before the next one's are decoded:
    memory used again at once costs far less than fresh memory.
    """
    pixels: Batch = {}
    small_arrays: list[Batch] = []
    for example in examples:
        for name in example.keys() & set(PIXELS):
            if name not in pixels:
                pixels[name] = planes((count, *example[name].shape), example[name].dtype)
            pixels[name][len(small_arrays)] = example[name]
        small_arrays.append({name: None if name in pixels else value for name, value in example.items()})
        del example
    longest = max(len(example["mask"]) for example in small_arrays)
    batch: Batch = {"ids": [example["id"] for example in small_arrays]}
    textured = [example for example in small_arrays if "patches" in example]
    if textured:
        batch["patches"] = np.concatenate([example["patches"] for example in textured])
        batch["patch_index"] = np.full((count, longest), -1, np.int32)
        first = 0
        for row, example in zip(batch["patch_index"], small_arrays, strict=True):
            if "patches" in example:
                index = example["patch_index"]
                row[: len(index)] = np.where(index >= 0, index + first, -1)
                first += len(example["patches"])
    shared = set.intersection(*(set(example) for example in small_arrays)) - {"id", *PATCHES}
    for name in sorted(shared):
        arrays = [example[name] for example in small_arrays]
        if name in pixels:
            batch[name] = pixels[name]
        elif name in TRIANGLES:
            batch[name] = np.zeros((count, longest, *arrays[0].shape[1:]), arrays[0].dtype)
            for row, array in zip(batch[name], arrays, strict=True):
                row[: len(array)] = array
        elif name in PADDED:
            shape = np.max([array.shape for array in arrays], axis=0)
            batch[name] = np.full((count, *shape), -1 if name in (LIGHT_TRIANGLES, BOUNCE_ARRAYS[0]) else 0, arrays[0].dtype)
            for row, array in zip(batch[name], arrays, strict=True):
                row[tuple(slice(0, size) for size in array.shape)] = array
        else:
            batch[name] = np.stack(arrays)
    return batch
