"""From a plan to the arrays that renderer and model share.

The triangle budget is met by choosing rungs of the decimated ladder; nothing is ever cut. Order of triangles: walls,
objects, lights.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict

import numpy as np

from stages.graphics.geometry.measure import face_normals
from stages.renderformer.records import PATCH_SIDE, TEXTURED_CHANNELS, SceneRecord, patch_means
from stages.renderformer.scenes import meshes
from stages.renderformer.scenes.laws import Camera, MaterialLaw, Placement, Plan, draw_reflectance

WALL_FACES = 128


def choose_rungs(ladders: list[Mapping[str, int]], budget: int, largest: int) -> list[str] | None:
    """The rung of each object, from its {rung: faces}: together at most ``budget`` faces, each at most ``largest``.

    Starts from the smallest rungs and raises the smallest object that can still be raised. None when even the smallest
    rungs do not fit.
    """
    steps = [sorted((faces, rung) for rung, faces in ladder.items() if faces <= largest) for ladder in ladders]
    if any(not step for step in steps):
        return None
    level = [0] * len(steps)
    spare = budget - sum(step[0][0] for step in steps)
    if spare < 0:
        return None
    while True:
        raises = [
            (steps[i][at][0], i, steps[i][at + 1][0] - steps[i][at][0])
            for i, at in enumerate(level)
            if at + 1 < len(steps[i]) and steps[i][at + 1][0] - steps[i][at][0] <= spare
        ]
        if not raises:
            return [step[at][1] for step, at in zip(steps, level, strict=True)]
        _, i, cost = min(raises)
        level[i] += 1
        spare -= cost


def rotation_matrix(degrees: list[float]) -> np.ndarray:
    """(3, 3) rotation about x, then y, then z.

    SciPy's differs in the last bits of nearly every matrix. That changes a float32 corner in one of 20,000 meshes of 64
    vertices, so a few of the scenes that exist would change.
    """
    (cx, cy, cz), (sx, sy, sz) = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def normalize(vertices: np.ndarray) -> np.ndarray:
    """Vertex mean at the origin, largest radius 0.5."""
    centred = vertices - vertices.mean(axis=0)
    return centred * (0.5 / max(float(np.linalg.norm(centred, axis=1).max()), 1e-12))


def place(vertices: np.ndarray, placement: Placement) -> np.ndarray:
    """Template mesh to scene units: rotate, scale, halve, translate by half the translation."""
    turned = vertices @ rotation_matrix(placement.rotation_deg).T
    return 0.5 * (turned * placement.scale) + 0.5 * np.array(placement.translation)


def camera_to_world(camera: Camera) -> np.ndarray:
    """Rigid (4, 4): columns right, up, backwards, position; the camera looks along -z."""
    position = np.array(camera.position)
    back = position - np.array(camera.look_at)
    back /= np.linalg.norm(back)
    right = np.cross(camera.up, back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, np.cross(back, right), back, position], axis=1)
    return matrix


def _reflectance(
    law: MaterialLaw, placement: Placement, groups: np.ndarray, n: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """diffuse (n, 3), specular (n, 3), roughness (n,) of a wall's or an object's faces."""
    material = placement.material
    diffuse = np.tile(np.array(material.diffuse), (n, 1))
    specular, roughness = np.full(n, material.specular), np.full(n, material.roughness)
    if material.vary:
        rng = np.random.default_rng(material.seed)
        if law.variation == "all_per_triangle":
            diffuse, specular, roughness, _ = draw_reflectance(law, rng, n)
        else:
            patch = np.arange(n) if placement.kind == "wall" else groups
            diffuse = rng.uniform(0, max(material.diffuse), size=(patch.max() + 1, 3))[patch]
    return diffuse, np.repeat(specular[:, None], 3, axis=1), roughness


def _placement_json(placement: Placement) -> dict:
    """A placement as the scene's meta tells it; what only concerns textures is left out where there is none."""
    fields = {key: value for key, value in asdict(placement).items() if key not in ("index", "shape")}
    if placement.texture is None:
        del fields["texture"], fields["material"]["bound"]
    return fields


def assemble(
    id: str,
    plan: Plan,
    object_meshes: list[meshes.Mesh],
    origins: list[dict],
    law: MaterialLaw,
    meta: dict,
    patches: dict[str, np.ndarray] | None = None,
) -> SceneRecord:
    """The scene's arrays; ``object_meshes`` are those of ``plan.objects`` at the chosen rungs.

    ``origins`` says in JSON where each of them comes from (object id, rung, licence) and enters the scene's meta.
    ``patches``: name of a textured wall or object -> (F, 7, 32, 32) float16, see ``SceneRecord.patches``.
    """
    patches = patches or {}
    columns: dict[str, list[np.ndarray]] = {
        name: [] for name in SceneRecord.DTYPES if name not in ("camera_to_world", "fov_deg")
    }
    described = []
    rows = [np.zeros((0, TEXTURED_CHANNELS, PATCH_SIDE, PATCH_SIDE), np.float16)]
    patch_index = []

    def add(entry: dict, **arrays: np.ndarray) -> None:
        faces = len(arrays["triangles"])
        columns["object_index"].append(np.full(faces, len(described), np.int16))
        for name, array in arrays.items():
            columns[name].append(array)
        described.append({**entry, "faces": faces})
        object_patches = patches.get(entry["name"])
        patch_index.append(np.full(faces, -1) if object_patches is None else sum(map(len, rows)) + np.arange(faces))
        if object_patches is not None:
            rows.append(object_patches)

    solid = [(wall, meshes.wall(wall.name)) for wall in plan.walls]
    solid += [(item, (normalize(v), f)) for item, (v, f) in zip(plan.objects, object_meshes, strict=True)]
    for placement, (template, faces) in solid:
        vertices = place(template.astype(np.float64), placement)
        groups = meshes.shading_groups(vertices, faces, law.crease_deg) if placement.material.smooth else np.arange(len(faces))
        if placement.name in patches:  # the texture is the variation
            reflectance = patch_means(patches[placement.name])
        else:
            names = ("diffuse", "specular", "roughness")
            reflectance = dict(zip(names, _reflectance(law, placement, groups, len(faces)), strict=True))
        add(
            _placement_json(placement),
            triangles=vertices[faces],
            vertex_normals=meshes.smooth_normals(vertices, faces, groups),
            **reflectance,
            emission=np.zeros((len(faces), 3)),
            light_index=np.full(len(faces), -1),
        )
    for number, light in enumerate(plan.lights):
        corners = meshes.LIGHT_TRIANGLE @ rotation_matrix(light.rotation_deg).T * light.scale + light.position
        add(
            {"name": f"light_{number}", "kind": "light", **asdict(light)},
            triangles=corners[None],
            vertex_normals=np.repeat(face_normals(corners[None])[:, None], 3, axis=1),
            diffuse=np.ones((1, 3)),  # as the released format has it; nothing reflects from a light
            specular=np.zeros((1, 3)),
            roughness=np.ones(1),
            emission=light.radiance * np.array([light.tint]),
            light_index=np.array([number]),
        )
    for entry, extra in zip((d for d in described if d["kind"] == "object"), origins, strict=True):
        entry.update(extra)
    arrays = {name: np.concatenate(parts).astype(SceneRecord.DTYPES[name]) for name, parts in columns.items()}
    return SceneRecord(
        id,
        **arrays,
        camera_to_world=np.stack([camera_to_world(c) for c in plan.cameras]).astype(np.float32),
        fov_deg=np.array([c.fov_deg for c in plan.cameras], np.float32),
        meta={
            **meta,
            "template": plan.template,
            "variant": plan.variant + ("_patch" if plan.patch else ""),
            "n_triangles": len(arrays["triangles"]),
            "n_lights": len(plan.lights),
            "objects": described,
            "cameras": [asdict(camera) for camera in plan.cameras],
        },
        patch_index=np.concatenate(patch_index).astype(np.int32) if patches else None,
        patches=np.concatenate(rows) if patches else None,
    )
