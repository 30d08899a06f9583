"""Six views full of caustics, made by code alone: what path tracing from the camera finds dear.

Four are drawn by the released law, with its special shapes and one wall made mirror-like (roughness 0.03 to 0.12). One has a
glossy tree over a mirror-like floor before rough walls, one a thick gold ring on a table. ``scenes()`` gives them as
SceneRecords of one camera each; lamps, walls and places are drawn.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stages.renderformer.objects.procedural import tree
from stages.renderformer.records import SceneRecord
from stages.renderformer.scenes.assemble import assemble
from stages.renderformer.scenes.laws import Laws, Plan, WeightLaw, draw_plan
from stages.renderformer.scenes.meshes import special

MIRROR_LIKE = {  # name: template, shape, its resolution, roughness, smooth, mirror-like wall
    "sphere": ("corner", "sphere", 9, 0.05, True, 2),
    "torus": ("corner", "torus", 8, 0.08, True, 0),
    "cylinder": ("corner", "cylinder", 8, 0.03, False, 1),
    "cone": ("wall", "cone", 8, 0.12, True, 1),
}
FIELDS = {"cylinder": 32.0, "ring": 26.0}  # of view, degrees; 42 else
NAMES = (*MIRROR_LIKE, "tree", "ring")


def scenes() -> dict[str, SceneRecord]:
    return {name: scene(name) for name in NAMES}


def scene(name: str) -> SceneRecord:
    """One of ``NAMES``."""
    laws, seed = Laws(), NAMES.index(name)
    template, shape, resolution, roughness, smooth, metal = MIRROR_LIKE.get(
        name, ("corner" if name == "tree" else "floor", "torus", 12, 0.05, True, None)
    )
    none = dict.fromkeys(WeightLaw().model_dump(), 0.0)
    only = laws.model_copy(update={"weights": WeightLaw(**none | {f"{template}_single": 1.0})})
    plan = draw_plan(only, np.random.default_rng(seed), 1)
    mesh = special(shape, resolution)
    _colour(plan, roughness, smooth, metal)
    item, floor = plan.objects[0], plan.walls[0]
    if name == "tree":
        mesh = tree(np.random.default_rng(5))
        item.translation, item.rotation_deg, item.scale = [0.0, 0.0, -0.1], [0.0, 0.0, 0.0], [1.6] * 3
        item.material = replace(item.material, specular=0.5, diffuse=[0.1, 0.35, 0.1], roughness=0.3)
        floor.material = replace(floor.material, specular=0.85, diffuse=[0.08, 0.08, 0.08], roughness=0.06)
    if name == "ring":
        floor.rotation_deg, floor.translation = [0.0, 0.0, 0.0], [0.0, 0.0, 0.3]
        item.rotation_deg, item.scale, item.translation = [0.0, 0.0, 0.0], [1.1, 1.1, 1.6], [0.0, 0.0, -0.44]
    plan.cameras[0] = replace(
        plan.cameras[0],
        position=[-1.0, -1.45, 0.7],
        look_at=[0.0, 0.0, -0.1],
        up=[0.0, 0.0, 1.0],
        fov_deg=FIELDS.get(name, 42.0),
    )
    record = assemble(name, plan, [mesh], [{}], laws.material, {"law": "caustics"})
    if name == "ring":
        gold = (record.specular > 0.8).all(axis=1) & (record.light_index < 0)
        record.specular[gold] = (0.95, 0.7, 0.3)
    return replace(record, camera_to_world=record.camera_to_world[:1], fov_deg=record.fov_deg[:1])


def _colour(plan: Plan, roughness: float, smooth: bool, metal: int | None) -> None:
    """Rough walls of some colour about a mirror-like thing."""
    for number, wall in enumerate(plan.walls):
        diffuse = [(0.7, 0.65, 0.6), (0.6, 0.3, 0.25), (0.3, 0.4, 0.6), (0.4, 0.6, 0.4)][number]
        wall.material = replace(wall.material, diffuse=list(diffuse), specular=0.1, roughness=0.6, vary=False, smooth=False)
        if number == metal:
            wall.material = replace(wall.material, diffuse=[0.1, 0.1, 0.1], specular=0.8, roughness=0.1)
    for item in plan.objects:
        material = replace(item.material, diffuse=[0.05, 0.05, 0.05], specular=0.9, roughness=roughness, vary=False)
        item.material = replace(material, smooth=smooth)
