"""Scenes in space with their cameras, and what the path tracer saw from them, light by light."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from pipeline.errors import UserError
from pipeline.store import Artifact
from stages.graphics.arrays import unpack_json
from stages.graphics.cameras import Camera
from stages.graphics.exr import decode_lights
from stages.graphics.panels import Eye, Facts, Image, Images, Lazy, Pane, Shown, Space, Surface, general
from stages.graphics.tonemap import exposure_for
from stages.renderformer.dataset.encoding import decode_scene
from stages.renderformer.records import SceneRecord
from stages.renderformer.views import VIEW, decode_layers, view_members

SIDE = 512  # pixels of a camera that has seen nothing yet


def show(shown: Shown) -> Iterator[Any]:
    """A scene and its images: of *scene* none, of *render* and *shard* all."""
    if shown.record_id is None:
        yield from general.panels(shown)
        return
    members = shown.members()
    scene = scene_of(shown)
    images = {int(match[1]): lazy_image(shown.artifact, shown.record_id, int(match[1])) for name in members
              if (match := VIEW.match(name))}  # fmt: skip
    meta = unpack_json(shown.record(("meta.json",)).members["meta.json"])
    if scene is not None:
        reference = {"artifact": shown.artifact.name, "record": shown.record_id}
        yield space(scene, images, reference, "Scene and images" if images else "Scene")
    else:
        yield from images.values()
    yield Facts("Facts", meta)


def space(scene: SceneRecord, images: Mapping[int, Lazy], reference: Mapping[str, Any], title: str) -> Space:
    """The scene's triangles, materials and lights, its cameras, and the images that some of them saw."""
    pane = Pane("scene", [surface(scene)], eyes(scene, images))
    objects = [{"name": entry.get("name", f"object {i}"), "kind": entry.get("kind", "object")}
               for i, entry in enumerate(scene.meta.get("objects", ()))]  # fmt: skip
    notes = list(scene.meta.get("notes", ()))
    if scene.textured:
        notes.append("textures are shown as the mean of each triangle")
    eye = min(images, default=0) if len(scene.fov_deg) else None
    return Space(title, [pane], eye=eye, note="; ".join(notes), objects=objects, scene=dict(reference))


def surface(scene: SceneRecord) -> Surface:
    """The scene as the preview draws it."""
    return Surface.of_corners(
        "scene",
        scene.triangles,
        normals=scene.vertex_normals.astype(np.float32),
        colours={name: getattr(scene, name).astype(np.float32) for name in ("diffuse", "specular", "emission")},
        values={"roughness": scene.roughness.astype(np.float32)},
        labels={"object": scene.object_index.astype(np.int32), "light": scene.light_index.astype(np.int32)},
    )


def eyes(scene: SceneRecord, images: Mapping[int, Lazy]) -> list[Eye]:
    return [Eye(f"camera {i}", camera_of(scene, i), images.get(i)) for i in range(len(scene.fov_deg))]


def camera_of(scene: SceneRecord, view: int) -> Camera:
    """One of the scene's cameras, for a picture of `SIDE` pixels on its longer side; the field of view is across the height."""
    height, width = scene.picture_size(view, SIDE)
    focal = 0.5 * height / np.tan(np.radians(scene.fov_deg[view]) / 2)
    return Camera(width, height, focal, focal, width / 2, height / 2, scene.camera_to_world[view].astype(float))


def lazy_image(artifact: Artifact, record_id: str, view: int) -> Lazy:
    """The view as it is stored, light by light, with its other outputs; read by seek when it is looked at."""

    def make() -> Image:
        members = artifact.read(record_id, view_members(view)).members
        image, aov = view_members(view)
        where = f"{image} of {record_id}"
        lights, meta = decode_lights(members[image], where, None)
        layers = decode_layers(members[aov], where, None)
        whole = lights.sum(axis=0, dtype=np.float32)
        return Image(f"view {view}", lights, layers, exposure_for(whole), meta)

    return Lazy(make)


# --- the scene of a record --------------------------------------------------------------------------------------------


def scene_of(shown: Shown) -> SceneRecord | None:
    """The scene of a record of *scene* or *shard*; of *render*, that of its input, None where it is gone."""
    record_id, artifact = shown.record_id, shown.artifact
    if artifact.stage == "shard":
        members = shown.record(("scene.npz", "meta.json")).members
        return decode_scene(record_id, members["scene.npz"], members["meta.json"])
    if artifact.stage != "scene":
        artifact = shown.input("scene")
        if artifact is None or record_id not in artifact:
            return None
    return SceneRecord.from_members(record_id, artifact.read(record_id, ("scene.npz", "meta.json")).members)


# --- predictions that are stored --------------------------------------------------------------------------------------


def predicted(shown: Shown) -> Iterator[Any]:
    """What a model made of a test scene: its pictures and scores; of *evaluate*, beside the truth."""
    shard = shown.input("shard")
    if shown.record_id is None or shard is None or shown.record_id not in shard:
        yield from general.panels(shown)
        return
    truth, names = Shown(shown.store, shard, shown.record_id), list(shown.members())
    for name in names:
        view, _, rest = name.partition(".")
        if rest == "prediction.exr" and f"{view}.exr" in truth.members():
            number = int(view.removeprefix("view"))
            pair = {"path traced": lazy_image(shard, shown.record_id, number), "predicted": general.lazy_hdr(shown, name)}
            yield Images(f"View {number}", pair)
    yield from general.panels(shown, [name for name in names if name.endswith(".prediction.exr")])


def check_record(artifact: Artifact) -> None:
    """UserError unless the artifact's records are scenes."""
    if artifact.stage not in ("scene", "render", "shard"):
        raise UserError(f"{artifact.name} holds no scenes: choose a record of scene, render or shard")
