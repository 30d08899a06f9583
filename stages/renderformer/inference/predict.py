"""Scenes to images by a trained network. *evaluate*, the probes and ``stages.renderformer.inference.renderer`` share it.

Reads a checkpoint folder and scene records, gives linear HDR images. One design choice: a scene is encoded
once, and its views are decoded from the same tokens a few at a time (section 3.1). So memory does not grow with the views.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stages.renderformer.dataset.augment import scene_arrays, view_arrays
from stages.renderformer.guides import GuideCaster
from stages.renderformer.inference.limits import light_radiance

if TYPE_CHECKING:
    from model.renderformer.base import Network
    from stages.renderformer.records import SceneRecord


def load_model(folder: Path) -> Network:
    """The network of a checkpoint folder, in eval mode on the CPU."""
    from model.renderformer import checkpoint

    return checkpoint.load(folder)[0]


def predict_frames(
    model: Network, scene: SceneRecord, views: Sequence[int], resolution: int | tuple[int, int], device: Any = "cpu"
) -> Iterator[np.ndarray]:
    """(H, W, 3) float32 linear radiance, at least 0, of each of the scene's cameras ``views``, in order."""
    from model.renderformer.network import to_radiance

    size = (resolution, resolution) if isinstance(resolution, int) else resolution
    batch, seen_by = network_arrays(model, scene, size)
    for y in model.to(device).eval().frames(batch, map(seen_by, views), size, device):
        yield to_radiance(y).clamp(min=0).cpu().numpy()  # the network may undershoot 0 by a thousandth


def network_arrays(
    model: Network, scene: SceneRecord, size: tuple[int, int]
) -> tuple[dict[str, np.ndarray], Callable[[int], dict[str, np.ndarray]]]:
    """What the network reads: the scene as a batch of one; of each camera what that has besides. size: height, width."""
    caster = GuideCaster(scene) if model.reads_guides else None
    batch = padded_arrays(scene) | ({} if caster is None else batched(scene_arrays(caster.scene_guides(model.reads_bounces))))

    def seen_by(view: int) -> dict[str, np.ndarray]:
        guides = {} if caster is None else batched(view_arrays([caster.view_guides(view, *size)]))
        return camera_arrays(scene, view) | guides

    return batch, seen_by


def batched(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """As a batch of one holds them."""
    return {name: array[None] for name, array in arrays.items()}


def padded_arrays(scene: SceneRecord) -> dict[str, np.ndarray]:
    """The scene as a batch of one holds it, without cameras and images."""
    arrays = scene.arrays()
    patches = {"patches": arrays.pop("patches")} if "patches" in arrays else {}
    cameras = ("camera_to_world", "fov_deg")
    triangles = {name: array for name, array in arrays.items() if name not in cameras}
    return batched(triangles) | {"mask": np.ones((1, len(scene.triangles)), bool)} | patches


def camera_arrays(scene: SceneRecord, view: int) -> dict[str, np.ndarray]:
    """One of its cameras, as the same batch holds it."""
    return {name: getattr(scene, name)[None, [view]].astype(np.float32) for name in ("camera_to_world", "fov_deg")}


def predict_scene(model: Network, scene: SceneRecord, views: Sequence[int], resolution: int, device: Any = "cpu") -> np.ndarray:
    """(V, H, W, 3) float32 linear radiance: all images of ``predict_frames`` in one array."""
    return np.stack(list(predict_frames(model, scene, views, resolution, device)))


def single_lights(scene: SceneRecord) -> Iterator[SceneRecord]:
    """The scene under each of its lights alone. The other lights stay as black surfaces, as an unlit light is."""
    for light in range(scene.n_lights):
        off = (scene.light_index >= 0) & (scene.light_index != light)
        dark = {
            name: np.where(off[:, None], np.float32(0), getattr(scene, name)) for name in ("diffuse", "specular", "emission")
        }
        yield replace(scene, **dark)


def light_passes(scene: SceneRecord) -> Iterator[tuple[SceneRecord, float]]:
    """One pass per light: the scene under that light alone, as bright as all lights together, and the light's share of that.

    The image is the sum over passes of share times prediction. This is exact, because light transport is linear. Without
    brightening, each of many passes would be darker than all training scenes (docs/probes.md, probe=lights).
    """
    radiance = light_radiance(scene)
    shares = radiance / radiance.sum()
    for alone, share in zip(single_lights(scene), shares, strict=True):
        if share > 0:
            yield replace(alone, emission=(alone.emission / share).astype(np.float32)), float(share)
