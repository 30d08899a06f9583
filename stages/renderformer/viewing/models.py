"""Models at work: a view of an edited scene predicted, path traced, compared, and what a pixel attends to.

One design choice: the page sends the scene's name and what was changed, never arrays. So a prediction here is the one that
``Renderer`` gives for the same edited scene, and nothing else.
"""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import UserError
from pipeline.store import Artifact, Store
from stages.graphics.panels import Context, Facts, Image, Shown, general
from stages.graphics.tonemap import exposure_for
from stages.renderformer.inference.scene_files import MESHES, SCENES
from stages.renderformer.records import SceneRecord
from stages.renderformer.viewing import scenes

if TYPE_CHECKING:
    from stages.renderformer.inference.renderer import Renderer

SUFFIXES = (*SCENES, *MESHES)
MOST_SIDE, MOST_SPP, MOST_ASPECT = 2048, 4096, 8  # of one request
SIZE_MULTIPLE = 8  # of the shorter side of a picture, where no model asks for another
KEPT_MODELS = 3
KEPT_IMAGES = 8


def trained(shown: Shown) -> Iterator[Any]:
    """A training: its curves and pictures, and test scenes to try the model on."""
    shard = shown.input("shard")
    if shard is not None:
        ids = shard.ids("test") or shard.ids()
        links = [f"#/record/{shard.name}/{record}?model={shown.artifact.name}" for record in ids[:24]]
        yield Facts("Try the model on a scene of its dataset", {"links": links})
    yield from general.panels(shown)


# --- what a request names -----------------------------------------------------------------------------------------------


def checkpoints(context: Context, arguments: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The checkpoints at hand: the one given to the viewer first, then those of the store, the newest first, then those
    that ship. ``resolution``: pixels per side that it was trained with."""
    from stages.renderformer.inference.renderer import SHIPS, checkpoint_folder, checkpoint_name, shipped_checkpoints

    store = context.store.root if context.store is not None else "store"
    ids = [] if context.checkpoint is None else [context.checkpoint]
    if context.store is not None:
        ids += [made.name for made in reversed(context.store.artifacts("train")) if made.name != context.checkpoint]
    folders = {id: checkpoint_folder(id, store) for id in ids}
    shipped = {f"{SHIPS}{name}": folder for name, folder in shipped_checkpoints().items()}
    return [
        {"id": id, "name": checkpoint_name(folder) if id in shipped else id, "resolution": trained_resolution(folder)}
        for id, folder in (folders | shipped).items()
    ]


def trained_resolution(folder: Path) -> int:
    """Pixels per side that the checkpoint was trained with, without reading its weights."""
    from safetensors import safe_open

    from stages.renderformer.inference.limits import resolution_limit

    with safe_open(folder / "model.safetensors", "np") as file:
        return resolution_limit(file.metadata() or {})


def renderer(context: Context, checkpoint: Any) -> Renderer:
    """The model of that id (see `checkpoints`), kept for the next request."""
    from stages.renderformer.inference.renderer import Renderer

    allowed = [entry["id"] for entry in checkpoints(context, {})]
    if checkpoint not in allowed:
        raise UserError(f"{checkpoint!r} is no checkpoint of this viewer: choose one of its list")
    kept = context.kept.setdefault("renderers", {})
    if checkpoint not in kept:
        store = context.store.root if context.store is not None else "store"
        while len(kept) >= KEPT_MODELS:
            kept.pop(next(iter(kept)))
        kept[checkpoint] = Renderer(checkpoint, context.device, store)
    return kept[checkpoint]


def file_scene(context: Context) -> SceneRecord:
    """The scene of the file that the viewer was started with, kept for the next request."""
    from stages.renderformer.inference.room import Room
    from stages.renderformer.inference.scene_files import load_scene

    if context.path is None:
        raise UserError("no file was given to the viewer")
    stamp = context.path.stat().st_mtime_ns
    if context.kept.get("file", (None,))[0] != stamp:
        given = checkpoints(context, {})
        if context.path.suffix.lower() in MESHES and given:  # a room as large as the model knows
            scene = renderer(context, given[0]["id"]).load(context.path)
        else:
            scene = load_scene(context.path, Room())
        context.kept["file"] = stamp, scene
    return context.kept["file"][1]


def base_scene(context: Context, reference: Any) -> SceneRecord:
    """The scene that a request names, as it is stored."""
    if not isinstance(reference, Mapping):
        raise UserError("a request names its scene")
    if reference.get("file"):
        return file_scene(context)
    name, record_id = str(reference.get("artifact", "")), str(reference.get("record", ""))
    kept = context.kept.setdefault("scenes", {})
    if (name, record_id) not in kept:
        artifact = artifact_of(context.store, name)
        artifact.row(record_id)
        scene = scenes.scene_of(Shown(context.store, artifact, record_id))
        if scene is None:
            raise UserError(f"the scene of {record_id} is no longer in the store")
        while len(kept) >= KEPT_IMAGES:
            kept.pop(next(iter(kept)))
        kept[name, record_id] = scene
    return kept[name, record_id]


def artifact_of(store: Store | None, name: str) -> Artifact:
    """An artifact of the store that holds scenes, by its full name."""
    found = next((artifact for artifact in store.artifacts(name.rpartition("/")[0]) if artifact.name == name), None) \
        if store is not None and ".." not in name and not name.startswith("/") else None  # fmt: skip
    if found is None:
        raise UserError(f"there is no artifact {name!r} in the store")
    scenes.check_record(found)
    return found


def edited_scene(context: Context, arguments: Mapping[str, Any]) -> SceneRecord:
    """The scene of a request, edited as it says, with its camera alone."""
    edits, camera = (mapping(arguments.get(name) or {}, name) for name in ("edits", "camera"))
    scene = edited(base_scene(context, arguments.get("scene")), edits)
    pose = numbers(camera.get("camera_to_world"), (4, 4), "camera_to_world")
    fov = numbers(camera.get("fov_deg"), (), "fov_deg")
    if not 1 <= fov <= 170:
        raise UserError(f"fov_deg {fov:g}: expected 1 to 170")
    aspect = numbers(camera.get("aspect", 1), (), "aspect")
    if not 1 / MOST_ASPECT <= aspect <= MOST_ASPECT:
        raise UserError(f"aspect {aspect:g}: expected 1/{MOST_ASPECT} to {MOST_ASPECT}, width over height")
    meta = {**scene.meta, "aspect": [float(aspect)]}
    return replace(scene, camera_to_world=pose[None].astype(np.float32), fov_deg=np.array([fov], np.float32), meta=meta)


def edited(scene: SceneRecord, edits: Mapping[str, Any]) -> SceneRecord:
    """The scene with objects moved, materials changed and lights dimmed or coloured.

    objects: number -> 4 x 4 rigid matrix that moves the object in the world. materials: number of the object -> any of
    ``diffuse`` (3,), ``specular`` (3,), ``roughness``. lights: number -> (3,) gain of its radiance.
    """
    triangles, normals = scene.triangles.copy(), scene.vertex_normals.copy()
    changed = {name: getattr(scene, name).copy() for name in ("diffuse", "specular", "roughness", "emission")}
    patch_index = None if scene.patch_index is None else scene.patch_index.copy()
    for number, matrix in rows_of(edits, "objects"):
        matrix = numbers(matrix, (4, 4), f"object {number}")
        rotation, faces = matrix[:3, :3], scene.object_index == number
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
            raise UserError(f"the matrix of object {number} does not just turn and move it")
        triangles[faces] = triangles[faces] @ rotation.T + matrix[:3, 3]
        normals[faces] = normals[faces] @ rotation.T
    for number, material in rows_of(edits, "materials"):
        material, faces = mapping(material, f"material {number}"), scene.object_index == number
        for name, shape, low, high in (("diffuse", (3,), 0, 1), ("specular", (3,), 0, 1), ("roughness", (), 0.01, 1)):
            if name in material:
                changed[name][faces] = np.clip(numbers(material[name], shape, name), low, high)
                if patch_index is not None:
                    patch_index[faces] = -1  # the colour replaces the texture
    for light, gain in rows_of(edits, "lights"):
        gain = numbers(gain, (3,), f"light {light}")
        changed["emission"][scene.light_index == light] *= np.maximum(gain, 0).astype(np.float32)
    return replace(scene, triangles=triangles, vertex_normals=normals, patch_index=patch_index, **changed)


def rows_of(edits: Mapping[str, Any], name: str) -> Iterator[tuple[int, Any]]:
    rows = mapping(edits.get(name) or {}, name)
    if not all(str(number).isdecimal() for number in rows):
        raise UserError(f"edits of {name} are given by number")
    yield from ((int(number), value) for number, value in rows.items())


def mapping(value: Any, name: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise UserError(f"{name}: expected an object")
    return value


def numbers(value: Any, shape: tuple[int, ...], name: str) -> np.ndarray:
    """Finite numbers of that shape; UserError where the request has something else."""
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError):
        array = np.array(np.nan)
    if array.shape != shape or not np.isfinite(array).all():
        raise UserError(f"{name}: expected {shape or 'one'} finite number(s)")
    return array


# --- actions --------------------------------------------------------------------------------------------------------------


def predict(context: Context, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """One view by a model: ``image`` (an Image), ``seconds``, and the limits of the training data that it is beyond."""
    model = renderer(context, arguments.get("checkpoint"))
    scene = edited_scene(context, arguments)
    size = scene.picture_size(0, resolution(arguments), model.model.config.resolution_multiple)
    began = time.perf_counter()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        image = model.render(scene, 0, size)
    seconds = time.perf_counter() - began
    keep(context, "predicted", arguments, image)
    notes = [str(warning.message) for warning in caught]
    return {"image": Image("predicted", image[None], exposure=exposure_for(image)), "seconds": seconds, "notes": notes}


def trace(context: Context, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """The same view path traced, light by light, denoised: ``image``, ``seconds``.

    Gains of lights are left to the page, which weights the layers: light transport is linear.
    """
    from stages.graphics.mitsuba.backend import choose
    from stages.renderformer.rendering.render import render_views
    from stages.renderformer.rendering.settings import RenderSettings
    from stages.renderformer.views import LAYERS

    arguments = without_gains(arguments)
    scene = edited_scene(context, arguments)
    model = context.kept.get("renderers", {}).get(arguments.get("checkpoint"))
    multiple = SIZE_MULTIPLE if model is None else model.model.config.resolution_multiple
    size = scene.picture_size(0, resolution(arguments), multiple)  # as large as the model's picture, to be compared
    spp = int(numbers(arguments.get("spp", 64), (), "spp"))
    if not 1 <= spp <= MOST_SPP:
        raise UserError(f"{spp} samples per pixel: expected 1 to {MOST_SPP:,}")
    began = time.perf_counter()
    (view,) = render_views(scene, RenderSettings(size, spp), choose("auto"), [0])
    seconds = time.perf_counter() - began
    lights = np.ascontiguousarray(view.lights, np.float32)
    keep(context, "traced", arguments, lights)
    layers = {name: getattr(view, name) for name in LAYERS}
    return {"image": Image("path traced", lights, layers, exposure_for(view.image), view.meta), "seconds": seconds}


def compare(context: Context, arguments: Mapping[str, Any]) -> dict[str, str]:
    """Metrics of the last prediction of a view against its last path-traced image, by their labels."""
    from stages.graphics.metrics import METRICS, measure_all

    predicted = context.kept.get("predicted", {}).get(view_of(arguments))
    lights = context.kept.get("traced", {}).get(view_of(without_gains(arguments)))
    if predicted is None or lights is None:
        raise UserError("predict and path trace this view first")
    gains = dict(rows_of(arguments.get("edits") or {}, "lights"))
    weights = np.array([numbers(gains.get(light, (1, 1, 1)), (3,), f"light {light}") for light in range(len(lights))])
    truth = np.einsum("lhwc,lc->hwc", lights, weights.astype(np.float32).reshape(-1, 3))
    scores = ((METRICS[name], value) for name, value in measure_all(truth, predicted).items())
    return {metric.label: f"{metric.format(value)} {metric.unit}".strip() for metric, value in scores}


def without_gains(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """The request with all lights as they are stored."""
    edits = mapping(arguments.get("edits") or {}, "edits")
    edits = {name: value for name, value in edits.items() if name != "lights"}
    return {**arguments, "edits": edits}


def attention(context: Context, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """What the ray bundle of a pixel looks at: ``weights`` (layers, F), averaged over heads, and the registers' shares.

    pixel: (x, y) in [0, 1] from the upper left corner.
    """
    from stages.renderformer.probes.attention import cross_attention

    model = renderer(context, arguments.get("checkpoint"))
    scene, side = edited_scene(context, arguments), resolution(arguments)
    x, y = numbers(arguments.get("pixel"), (2,), "pixel").clip(0, 1 - 1e-9)
    if not model.model.gathering_layers():
        raise UserError("this network has no attention of pixels to show: choose another model")
    height, width = scene.picture_size(0, side, model.model.config.resolution_multiple)
    rows, columns = (pixels // model.model.config.bundle_side for pixels in (height, width))
    bundle = int(y * rows) * columns + int(x * columns)
    weights = cross_attention(model.model, scene, (height, width), str(model.device))[:, bundle]
    registers = weights.shape[1] - len(scene.triangles)
    return {"weights": weights[:, registers:].astype(np.float32), "registers": weights[:, :registers].sum(axis=1).tolist()}


def resolution(arguments: Mapping[str, Any]) -> int:
    side = int(numbers(arguments.get("resolution", 256), (), "resolution"))
    if not 8 <= side <= MOST_SIDE:
        raise UserError(f"resolution {side}: expected 8 to {MOST_SIDE:,} pixels")
    return side


def view_of(arguments: Mapping[str, Any]) -> str:
    """What decides a picture, as text."""
    return json.dumps([arguments.get(name) for name in ("scene", "edits", "camera", "resolution")], sort_keys=True)


def keep(context: Context, kind: str, arguments: Mapping[str, Any], image: np.ndarray) -> None:
    """Remember an image for `compare`; the oldest of a few is forgotten."""
    kept = context.kept.setdefault(kind, {})
    while len(kept) >= KEPT_IMAGES:
        kept.pop(next(iter(kept)))
    kept[view_of(arguments)] = image
