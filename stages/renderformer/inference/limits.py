"""Limits of the training data. A scene beyond one of them is rendered, with a warning that names the limit.

Reads arrays, writes nothing. Numbers come from the laws of the released data (``stages.renderformer.scenes.laws``; paper
sections 3.3 and 4.2). Triangles and resolution come from the checkpoint, if it says what it was trained with.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from stages.renderformer.records import SceneRecord
from stages.renderformer.scenes.laws import LARGEST_TRIANGLE, CameraLaw, LightLaw, MaterialLaw
from stages.renderformer.scenes.meshes import areas

RELEASED_TRIANGLES = 4096  # of the released training data, for checkpoints that do not say (section 2)
RELEASED_RESOLUTION = 512
REACH = 1.1  # scene units from the centre, per axis: objects of the largest scale at the edge of the room
UNSCALED_LIGHT_AREA = 0.0022  # scene units squared, of the light triangle before a law scales it
ROUND = 1.001  # what is drawn at a limit may lie beyond it by rounding


def triangle_limit(trained_with: Mapping[str, str]) -> int:
    """Most triangles of a scene that the checkpoint was trained with."""
    return int(trained_with.get("triangles", RELEASED_TRIANGLES))


def resolution_limit(trained_with: Mapping[str, str]) -> int:
    """Pixels per side of the images that the checkpoint was trained with."""
    return int(trained_with.get("resolution", RELEASED_RESOLUTION))


def beyond_limits(
    scene: SceneRecord,
    views: Sequence[int],
    resolution: tuple[int, int],
    trained_with: Mapping[str, str],
    composite_lights: bool = False,
) -> list[str]:
    """One sentence for each limit of the training data that the scene is beyond.

    ``views``: numbers of the cameras to render. ``resolution``: (height, width) in pixels. ``composite_lights``: lights are
    rendered one by one, so their number is no limit.
    """
    return [
        *_size(scene, resolution, trained_with),
        *_lights(scene, composite_lights),
        *_cameras(scene, list(views)),
        *_materials(scene),
    ]


def light_radiance(scene: SceneRecord) -> np.ndarray:
    """(L,) radiance of each light: mean over its area and over the colour channels."""
    emits = scene.light_index >= 0
    area, light = areas(scene.triangles[emits]), scene.light_index[emits]
    power = np.bincount(light, area * scene.emission[emits].mean(axis=1, dtype=np.float64), minlength=scene.n_lights)
    return power / np.maximum(np.bincount(light, area, minlength=scene.n_lights), 1e-12)


def _outside(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Values outside [low, high] by more than rounding."""
    return values[(values * ROUND < low) | (values > high * ROUND)]


def _worst(values: np.ndarray, low: float, high: float, quantity: str, unit: str = "", digits: int = 2) -> Iterator[str]:
    """One sentence about the value farthest outside [low, high]; nothing if all are inside."""
    outside = _outside(np.asarray(values, np.float64), low, high)
    if len(outside):
        worst = outside[np.argmax(np.maximum(low / np.maximum(outside, 1e-12), outside / high))]
        yield f"{quantity} {worst:,.{digits}f}{unit}: the training data has {low:,.{digits}f} to {high:,.{digits}f}{unit}"


def _size(scene: SceneRecord, resolution: tuple[int, int], trained_with: Mapping[str, str]) -> Iterator[str]:
    count, most = len(scene.triangles), triangle_limit(trained_with)
    if count > most:
        yield f"{count:,} triangles: the checkpoint was trained with at most {most:,}"
    side = resolution_limit(trained_with)
    if max(resolution) > side:
        yield f"resolution {resolution[1]}x{resolution[0]}: the checkpoint was trained with {side}x{side} pixels"
    solid = scene.triangles[scene.light_index < 0].astype(np.float64)
    if len(solid) == 0:
        return
    reach = float(np.abs(solid).max())
    if reach > REACH:
        yield (
            f"the scene reaches {reach:,.2f} from the origin: the training data lies within {REACH:g}, one unit being the "
            "whole scene (scale it, cameras and lights included)"
        )
    largest = float(areas(solid).max())
    if largest > 2 * LARGEST_TRIANGLE:
        yield f"a triangle of area {largest:.3f}: the training data's largest have about {LARGEST_TRIANGLE:.3f} (subdivide it)"


def _lights(scene: SceneRecord, composite_lights: bool) -> Iterator[str]:
    law, emits = LightLaw(), scene.light_index >= 0
    count, (least, most) = scene.n_lights, law.count
    if not least <= count <= most and not composite_lights:
        yield f"{count} lights: the training data has {least} to {most} (--composite-lights renders them one by one)"
    if count == 0:
        return
    emission, light = scene.emission[emits].astype(np.float64), scene.light_index[emits]
    triangles = scene.triangles[emits].astype(np.float64)
    triangle_area = areas(triangles)
    light_area = np.bincount(light, triangle_area, minlength=count)
    low, high = law.radiance  # also of a light alone in its pass, which is made as bright as all together
    yield from _worst(np.array([light_radiance(scene).sum()]), low, high, "lights of a total radiance of", digits=0)
    least_area, most_area = (UNSCALED_LIGHT_AREA * scale**2 for scale in law.scale)
    yield from _worst(light_area, least_area / 2, 2 * most_area, "a light of area", digits=4)
    weighted = triangle_area[:, None] * triangles.mean(axis=1)
    centres = np.stack([np.bincount(light, weighted[:, axis], minlength=count) for axis in range(3)], axis=1)
    distance = np.linalg.norm(centres / np.maximum(light_area, 1e-12)[:, None], axis=1)
    slack = float(np.sqrt(3) * law.target[1])  # the target is not the origin
    yield from _worst(distance, law.distance[0] - slack, law.distance[1] + slack, "a light", " from the origin")
    spread = float((emission.max(axis=1) - emission.min(axis=1)).max() / max(emission.max(), 1e-12))
    if spread > 0.02:
        yield "coloured light: the training data has white light alone"


def _cameras(scene: SceneRecord, views: list[int]) -> Iterator[str]:
    law = CameraLaw()
    distance = np.linalg.norm(scene.camera_to_world[views, :3, 3].astype(np.float64), axis=1)
    slack = float(np.sqrt(3) * law.look_at[1])  # what a camera looks at is not the origin
    yield from _worst(distance, law.distance[0] - slack, law.distance[1] + slack, "a camera", " from the origin")
    yield from _worst(scene.fov_deg[views], *law.fov_deg, "a field of view of", " degrees", 1)


def _materials(scene: SceneRecord) -> Iterator[str]:
    law, solid = MaterialLaw(), scene.light_index < 0
    if not solid.any():
        return
    low = max(law.roughness[0] - law.roughness_shift, 0.01)
    yield from _worst(scene.roughness[solid], low, 1.0, "a roughness of")
    total = (scene.diffuse + scene.specular)[solid].max()
    if total > law.total[1] + 0.005:  # the released format rounds colours to 8 bits
        yield f"diffuse and specular add up to {total:.2f}: the training data has at most {law.total[1]:g}"
    if scene.textured:
        yield f"{int((scene.patch_index >= 0).sum()):,} textured triangles: the training data has one material per triangle"
