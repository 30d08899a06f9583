"""Exact edits of scenes: what the probes vary, each keeping everything else as it was.

Reads and writes ``SceneRecord``; nothing is changed in place. One design choice: an edit acts on the arrays that renderer
and network share, so that the path-traced reference belongs to the edited scene by construction. Lengths are in scene units.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from stages.graphics.geometry.measure import face_normals
from stages.renderformer.records import SceneRecord, patch_means
from stages.renderformer.scenes import meshes
from stages.renderformer.scenes.assemble import place, rotation_matrix
from stages.renderformer.scenes.laws import TEMPLATES, Light, LightLaw, Material, Placement, draw_lights
from stages.renderformer.scenes.meshes import areas

FACE_ARRAYS = tuple(name for name in SceneRecord.DTYPES if name not in ("camera_to_world", "fov_deg"))
MOST_LIGHTS = 16  # that fit on the smallest shell, LIGHT_SEPARATION apart
LIGHT_SEPARATION = 0.2


def power(scene: SceneRecord) -> np.ndarray:
    """(3,) radiance times area, summed over the emitting triangles: proportional to what the lights emit in all."""
    return areas(scene.triangles) @ scene.emission.astype(np.float64)


def rows(scene: SceneRecord, index: np.ndarray) -> SceneRecord:
    """The scene with the triangles ``index`` (integers, repeats allowed, or a mask), in that order."""
    arrays = {name: getattr(scene, name)[index] for name in FACE_ARRAYS}
    if scene.patch_index is not None:
        arrays["patch_index"] = scene.patch_index[index]
    return replace(scene, **arrays)


def one_view(scene: SceneRecord, camera: int) -> SceneRecord:
    """The scene with that camera alone."""
    return replace(scene, camera_to_world=scene.camera_to_world[[camera]], fov_deg=scene.fov_deg[[camera]])


# --- cameras ----------------------------------------------------------------------------------------------------------


def closer(scene: SceneRecord, factor: float) -> SceneRecord:
    """Cameras at ``factor`` times their distance from the point of their axis that is nearest to the scene's centre."""
    poses = scene.camera_to_world.astype(np.float64)
    position, forward = poses[:, :3, 3], -poses[:, :3, 2]
    target = position - np.einsum("vi,vi->v", position, forward)[:, None] * forward
    poses[:, :3, 3] = target + factor * (position - target)
    return replace(scene, camera_to_world=poses.astype(np.float32))


def with_fov(scene: SceneRecord, degrees: float) -> SceneRecord:
    return replace(scene, fov_deg=np.full_like(scene.fov_deg, degrees))


# --- lights -----------------------------------------------------------------------------------------------------------


def with_lights(scene: SceneRecord, triangles: np.ndarray, radiance: np.ndarray, number: np.ndarray) -> SceneRecord:
    """The scene lit by other lights: (N, 3, 3) triangles of (N, 3) radiance; ``number`` (N,): which light each belongs to."""
    solid = rows(scene, scene.light_index < 0)
    entries = [entry for entry in scene.meta["objects"] if entry["kind"] != "light"]
    solid_objects = [index for index, entry in enumerate(scene.meta["objects"]) if entry["kind"] != "light"]
    place_of = np.zeros(len(scene.meta["objects"]), np.int16)
    place_of[solid_objects] = np.arange(len(solid_objects))
    count = len(triangles)
    lights = {
        "triangles": triangles,
        "vertex_normals": np.repeat(face_normals(triangles.astype(np.float64))[:, None], 3, axis=1),
        "diffuse": np.ones((count, 3)),  # as the released format has it; nothing reflects from a light
        "specular": np.zeros((count, 3)),
        "roughness": np.ones(count),
        "emission": radiance,
        "light_index": number,
        "object_index": len(solid_objects) + np.asarray(number),
    }
    arrays = {
        name: np.concatenate([place_of[solid.object_index] if name == "object_index" else getattr(solid, name), values])
        for name, values in lights.items()
    }
    if solid.patch_index is not None:
        arrays["patch_index"] = np.concatenate([solid.patch_index, np.full(count, -1)])
    dtypes = SceneRecord.DTYPES | SceneRecord.PATCH_DTYPES
    entries += [
        {"name": f"light_{light}", "kind": "light", "faces": int((np.asarray(number) == light).sum())}
        for light in range(int(np.max(number)) + 1)
    ]
    meta = {**scene.meta, "objects": entries, "n_lights": int(np.max(number)) + 1}
    return replace(scene, **{name: values.astype(dtypes[name]) for name, values in arrays.items()}, meta=meta)


def _relit(scene: SceneRecord, triangles: np.ndarray, radiance: np.ndarray, repeats: int = 1) -> SceneRecord:
    """The scene's lights in other shape: ``repeats`` triangles for each one, as parts of the same light."""
    number = scene.light_index[scene.light_index >= 0].repeat(repeats)
    return with_lights(scene, triangles, radiance, number)


def _emitters(scene: SceneRecord) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3, 3) float64 corners and (N, 3) radiance of the emitting triangles."""
    lit = scene.light_index >= 0
    return scene.triangles[lit].astype(np.float64), scene.emission[lit].astype(np.float64)


def draw_nested_lights(scene: SceneRecord, count: int, rng: np.random.Generator) -> SceneRecord:
    """The scene with ``count`` lights of the released law; with fewer, they are the first of those with more.

    Together they emit about the same, as in the law: each has its radiance divided by their number.
    """
    if not 1 <= count <= MOST_LIGHTS:
        raise ValueError(f"{count} lights do not fit: 1 to {MOST_LIGHTS}")
    template = scene.meta["template"] if scene.meta.get("template") in TEMPLATES else "floor"
    drawn = draw_lights(LightLaw(count=(MOST_LIGHTS, MOST_LIGHTS), separation=LIGHT_SEPARATION), rng, template)[:count]
    triangles = np.stack([light_triangle(light) for light in drawn])
    radiance = np.array([[light.radiance * MOST_LIGHTS / count] * 3 for light in drawn])
    return with_lights(scene, triangles, radiance, np.arange(count))


def light_triangle(light: Light) -> np.ndarray:
    """(3, 3) corners of a drawn light."""
    return meshes.LIGHT_TRIANGLE @ rotation_matrix(light.rotation_deg).T * light.scale + light.position


def tinted(scene: SceneRecord, colours: np.ndarray) -> SceneRecord:
    """Each light's radiance times its (L, 3) colour."""
    lit = scene.light_index >= 0
    emission = scene.emission.copy()
    emission[lit] *= colours.astype(np.float32)[scene.light_index[lit]]
    return replace(scene, emission=emission)


def channel_light(scene: SceneRecord, channel: int) -> SceneRecord:
    """White lights as bright as the scene's are in one colour channel: that channel of the image is the same."""
    return replace(scene, emission=np.repeat(scene.emission[:, [channel]], 3, axis=1))


def lights_at(scene: SceneRecord, distance: float) -> SceneRecord:
    """Lights moved along the line to the scene's centre until they are ``distance`` from it, dimmed by the square.

    So the centre gets the same light from them whatever the distance.
    """
    corners, radiance = _emitters(scene)
    number = scene.light_index[scene.light_index >= 0]
    for light in np.unique(number):
        of_light = number == light
        centre = corners[of_light].mean(axis=(0, 1))
        now = max(float(np.linalg.norm(centre)), 1e-9)
        corners[of_light] += centre * (distance / now - 1)
        radiance[of_light] *= (distance / now) ** 2
    return _relit(scene, corners, radiance)


def larger_lights(scene: SceneRecord, factor: float) -> SceneRecord:
    """Every light's edges ``factor`` times as long about its centre, its radiance divided by the square: equal power."""
    corners, radiance = _emitters(scene)
    number = scene.light_index[scene.light_index >= 0]
    for light in np.unique(number):
        of_light = number == light
        centre = corners[of_light].mean(axis=(0, 1))
        corners[of_light] = centre + factor * (corners[of_light] - centre)
    return _relit(scene, corners, radiance / factor**2)


def subdivided_lights(scene: SceneRecord, times: int) -> SceneRecord:
    """Every light triangle cut at its edges' midpoints into four, ``times`` times over: the same light in smaller pieces."""
    corners, radiance = _emitters(scene)
    for _ in range(times):
        a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        pieces = [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
        corners = np.stack([np.stack(piece, axis=1) for piece in pieces], axis=1).reshape(-1, 3, 3)
    return _relit(scene, corners, radiance.repeat(4**times, axis=0), 4**times)


# --- triangles --------------------------------------------------------------------------------------------------------


def bisected(scene: SceneRecord, count: int) -> SceneRecord:
    """The same surfaces in ``count`` triangles, or as many as there are if that is more.

    The largest triangle is cut at the middle of its longest edge until there are so many; lights and textured triangles
    stay whole.
    """
    while len(scene.triangles) < count:
        size = areas(scene.triangles)
        size[scene.light_index >= 0] = 0
        if scene.textured:
            size[scene.patch_index >= 0] = 0
        cut_count = min(count - len(size), int((size > 0).sum()), max(1, len(size) // 4))
        if cut_count == 0:
            break
        chosen = np.argsort(-size, kind="stable")[:cut_count]
        corners, normals = _longest_first(scene.triangles[chosen], scene.vertex_normals[chosen])
        middle = corners[:, :2].mean(axis=1)
        normal = normals[:, :2].sum(axis=1)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        doubled = rows(scene, np.concatenate([np.arange(len(size)), chosen]))
        for first, keep in ((chosen, 0), (np.arange(len(size), len(size) + cut_count), 1)):
            # corner 0 or 1 stays, the other of the two becomes the middle
            for array, values, new in ((doubled.triangles, corners, middle), (doubled.vertex_normals, normals, normal)):
                half = values.copy()
                half[:, 1 - keep] = new
                array[first] = half
        scene = doubled
    return scene


def _longest_first(corners: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners and normals turned so that the longest edge lies between corners 0 and 1."""
    length = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)  # of edges 01, 12, 20
    order = (length.argmax(axis=1)[:, None] + np.arange(3)) % 3
    return tuple(np.take_along_axis(array, order[..., None], axis=1) for array in (corners, normals))


def placement_of(entry: Mapping[str, Any]) -> Placement:
    """The placement that a sampled scene's meta tells of an object."""
    names = ("name", "kind", "rotation_deg", "scale", "translation")
    return Placement(**{name: entry[name] for name in names}, material=Material(**entry["material"]))


def with_rung(scene: SceneRecord, name: str, now: meshes.Mesh, new: meshes.Mesh, crease_deg: float = 30.0) -> SceneRecord:
    """The object ``name`` shown by another mesh of its ladder, in its place and of its mean reflectance.

    ``now``: the mesh (vertices, faces) that the scene shows; its own centre and size decide the placement, so that both lie
    in the same frame.
    """
    index, entry = next((i, entry) for i, entry in enumerate(scene.meta["objects"]) if entry["name"] == name)
    placement = placement_of(entry)
    centre = now[0].astype(np.float64).mean(axis=0)
    radius = max(float(np.linalg.norm(now[0] - centre, axis=1).max()), 1e-12)
    faces = new[1].astype(np.int64)
    vertices = place((new[0].astype(np.float64) - centre) * (0.5 / radius), placement)
    smooth = placement.material.smooth
    groups = meshes.shading_groups(vertices, faces, crease_deg) if smooth else np.arange(len(faces))
    of_object = scene.object_index == index
    first = int(np.flatnonzero(of_object)[0])
    weights = areas(scene.triangles[of_object])
    order = np.concatenate([np.flatnonzero(~of_object & (np.arange(len(of_object)) < first)), np.full(len(faces), first)])
    order = np.concatenate([order, np.flatnonzero(~of_object & (np.arange(len(of_object)) > first))])
    out = rows(scene, order)
    part = slice(int((~of_object[:first]).sum()), int((~of_object[:first]).sum()) + len(faces))
    out.triangles[part] = vertices[faces]
    out.vertex_normals[part] = meshes.smooth_normals(vertices, faces, groups)
    for array in ("diffuse", "specular", "roughness"):
        getattr(out, array)[part] = np.average(getattr(scene, array)[of_object], axis=0, weights=weights)
    entries = list(scene.meta["objects"])
    entries[index] = {**entry, "faces": len(faces)}
    return replace(out, meta={**scene.meta, "objects": entries})


# --- surfaces ---------------------------------------------------------------------------------------------------------


def patterned(scene: SceneRecord, repeats: float, rng: np.random.Generator) -> SceneRecord:
    """Every wall and object painted with a made-up pattern, ``repeats`` times along its longest side.

    The pattern multiplies the object's brightest diffuse colour; specular and roughness stay.
    """
    from stages.renderformer.objects.procedural import box_coordinates, pattern
    from stages.renderformer.scenes.textures import bake, material_patches

    patch_index = np.full(len(scene.triangles), -1, np.int32)
    patches: list[np.ndarray] = []
    means = {name: getattr(scene, name).copy() for name in ("diffuse", "specular", "roughness")}
    for index, entry in enumerate(scene.meta["objects"]):
        image = pattern(rng)
        faces = np.flatnonzero((scene.object_index == index) & (scene.light_index < 0))
        if entry["kind"] == "light" or not len(faces):
            continue
        corners = scene.triangles[faces]
        uv = box_coordinates(corners.reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3), repeats)
        bound = float(scene.diffuse[faces].max())
        specular, roughness = float(scene.specular[faces].mean()), float(scene.roughness[faces].mean())
        object_patches = material_patches(bake(image, uv), bound, specular, roughness)
        patch_index[faces] = sum(map(len, patches)) + np.arange(len(faces))
        patches.append(object_patches)
        for name, values in patch_means(object_patches).items():
            means[name][faces] = values
    return replace(scene, **means, patch_index=patch_index, patches=np.concatenate(patches))


def without_textures(scene: SceneRecord) -> SceneRecord:
    """The scene with every triangle's mean reflectance."""
    return replace(scene, patch_index=None, patches=None)
