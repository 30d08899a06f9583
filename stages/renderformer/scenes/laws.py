"""Sampling laws of RenderFormer's training scenes (paper section 3.3 and the released templates).

Writes nothing, reads nothing: ``draw_plan(laws, rng, ...)`` turns a generator into a ``Plan``. All lengths are in *template
units* (a wall spans [-1, 1]); the assembly halves walls and objects, so that a scene is one unit. Cameras and lights are
in scene units at once. Every number of the released templates is a named field; the paper's law is other values of the
same fields.

How the templates are read where their description leaves room:

- Floor height: the narrow range 0.15..0.25 and the wide one -0.05..0.25 are drawn equally often (``floor_offset_wide_share``).
- Patch scenes: the walls have scale 1, no tilt and no offset; they keep their spin.
- Special scenes: one simple shape made by code, half of them on the floor template and half in the corner.
- Corner lights come from the half x + y <= 0 of the upper hemisphere; box lights from the directions within 60 degrees of
  +z that also lie in front (y <= 0), so that light always enters through the open top or front.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from pipeline.config import Section, added
from pipeline.errors import UserError

Range = tuple[float, float]  # uniform between the two
Share = Annotated[float, Field(ge=0, le=1)]

WALLS = {"floor": 2, "back": 1, "right": 0, "left": 0}  # wall -> axis of its normal
TEMPLATES = {
    "floor": ("floor",),
    "wall": ("floor", "right"),
    "corner": ("floor", "right", "back"),
    "box": ("floor", "back", "right", "left"),
}
SPECIAL_SHAPES = ("sphere", "cube", "cylinder", "cone", "torus")


class WeightLaw(Section):
    """How often each kind of scene is drawn, in relative weights (the released ones sum to 46)."""

    floor_single: float = 3.0
    floor_multi: float = 3.0
    floor_empty: float = 1.0
    floor_special: float = 2.0
    floor_thin: float = 8.0
    wall_single: float = 3.0
    wall_multi: float = 3.0
    wall_empty: float = 1.0
    wall_single_patch: float = 1.0
    wall_multi_patch: float = 1.0
    corner_single: float = 3.0
    corner_multi: float = 3.0
    corner_empty: float = 1.0
    corner_special: float = 2.0
    corner_single_patch: float = 1.0
    corner_multi_patch: float = 1.0
    box_single: float = 3.0
    box_multi: float = 3.0
    box_empty: float = 1.0
    box_single_patch: float = 1.0
    box_multi_patch: float = 1.0

    @model_validator(mode="after")
    def _positive(self) -> WeightLaw:
        weights = list(self.model_dump().values())
        if min(weights) < 0 or sum(weights) == 0:
            raise ValueError("weights must not be negative, and at least one must be positive")
        return self


class WallLaw(Section):
    """Walls are 2 x 2 squares at distance 1 from the origin, in template units."""

    scale: Range = (0.9, 1.35)  # per axis; along the normal it moves the wall
    box_scale: Range = (1.0, 1.35)
    tilt_deg: Range = (-10.0, 10.0)  # about the two axes in the wall's plane
    box_tilt_deg: Range = (-3.0, 3.0)
    spin_deg: Range = (-180.0, 180.0)  # about its own normal; keeps the model from learning the grid
    floor_offset_z: Range = (0.15, 0.25)
    floor_offset_z_wide: Range = (-0.05, 0.25)
    floor_offset_wide_share: float = 0.5  # share of scenes that draw the floor's height from the wide range
    offset: Range = (-0.05, 0.05)  # all other offsets
    offset_along: Range = (-0.25, 0.25)  # wall template: along y; corner: along each wall's own normal


# Half of a quad of the largest wall, scene units squared: larger triangles are rare in the training data (paper, figure 9)
LARGEST_TRIANGLE = (WallLaw().scale[1] / 8) ** 2 / 2


class ObjectLaw(Section):
    """Objects have their vertex mean at the origin and a largest radius of 0.5 before scale, in template units."""

    multi_count: tuple[int, int] = (2, 3)  # objects of a multi-object scene
    box_multi_count: tuple[int, int] = (1, 2)
    centre: Range = (-1.0, 1.0)  # per axis
    rotation_deg: Range = (-180.0, 180.0)  # about x, then y, then z
    scale_single: Range = (1.2, 2.2)
    scale_multi: Range = (0.8, 1.8)
    box_scale_single: Range = (1.8, 2.0)
    box_scale_multi: Range = (0.8, 1.8)
    thin_scale: Range = (1.4, 1.6)
    special_scale: Range = (1.6, 2.1)
    special_smooth_share: float = 0.25
    thin_thickness: float = 0.25  # thin: shortest side of the bounding box at most this share of the longest
    thin_tries: int = 32  # objects looked at to find a thin one; without success the thinnest of them is taken
    single_faces: int = 3968  # largest object of a single-object scene, in triangles
    multi_faces: int = 1188  # largest object of a multi-object scene, in triangles


class MaterialLaw(Section):
    """specular = s r (grey), diffuse = s (1 - r) c, per object and per wall alike."""

    total: Range = (0.9, 1.0)  # s
    specular_share: Range = (0.0, 1.0)  # r
    colour: Range = (0.0, 1.0)  # c, per channel
    roughness: Range = (0.06, 1.055)  # exp(U[ln a, ln b]) - roughness_shift, clipped to [0.01, 1]
    roughness_shift: float = 0.05
    smooth_share: float = 0.5
    crease_deg: float = 30.0
    variation: Literal["diffuse_if_smooth", "all_per_triangle"] = "diffuse_if_smooth"  # the released data's, the paper's
    variation_share: float = 0.5  # diffuse_if_smooth: of the smooth-shaded ones; all_per_triangle: of all


class LightLaw(Section):
    """Lights are single triangles, in scene units: white, small and outside, as in the paper, unless a share says otherwise.

    ``count`` may go beyond eight, with a smaller ``separation``.
    """

    count: tuple[int, int] = (1, 8)
    radiance: Range = (2500.0, 5000.0)  # of each light, divided by their number
    scale: Range = (2.0, 2.5)  # per axis, of a triangle of edge 0.0707
    rotation_deg: Range = (-180.0, 180.0)  # about x, then y, then z
    shell_radius: float = 0.866
    separation: float = 0.3  # least distance between two lights on the shell
    distance: Range = (2.1, 2.7)  # from the target, after moving outwards
    target: Range = (-0.2, 0.2)  # per axis
    box_cap_deg: float = 60.0
    # beyond the paper (its section 4.2 names each as a limit of its data); share 0: never
    coloured_share: Share = 0.0  # of the lights
    tint: Range = (0.1, 1.0)  # per channel of a coloured light, the largest then raised to 1
    large_share: Share = 0.0
    large_scale: Range = (4.0, 10.0)  # instead of scale; the power stays about the same
    inside_share: Share = 0.0
    inside: Range = (-0.45, 0.45)  # position of a light inside, per axis
    inside_dimming: Range = (0.01, 0.05)  # its radiance over that of a light outside


class CameraLaw(Section):
    """Cameras look at a point near the origin, in scene units: from outside, as in the paper, unless a share says otherwise."""

    views: int = 4
    distance: Range = (1.5, 2.0)  # from the look-at point
    look_at: Range = (-0.2, 0.2)  # per axis
    up: Range = (-0.1, 0.1)  # added to +z, per axis
    fov_deg: Range = (30.0, 60.0)
    shell_radius: float = 0.866
    box_y: float = -3.0  # box: start from a square in front at this y ...
    box_square: Range = (-1.0, 1.0)  # ... and these x and z
    # beyond the paper
    inside_share: Share = 0.0
    inside: Range = (-0.45, 0.45)  # position of a camera inside, per axis
    inside_distance: float = 0.3  # least distance to its look-at point
    inside_fov_deg: Range = (50.0, 90.0)


class TextureLaw(Section):
    """Textures, beyond the paper's data: a textured surface has diffuse = s (1 - r) times the colour of its image.

    Objects show the base colours that *collect* kept (``collect.textures``), special shapes and walls patterns made by code.
    """

    share: Share = 0.0  # of the objects; one without base colours stays as it is
    wall_share: Share = 0.0  # of the walls


@dataclass
class Material:
    diffuse: list[float]
    specular: float
    roughness: float
    smooth: bool
    vary: bool  # whether parameters change within the object, see MaterialLaw.variation
    seed: int  # of that variation
    bound: float = 0.0  # s (1 - r), what diffuse is of a white surface; told only where there is a texture


@dataclass
class Placement:
    """A wall or an object: rotate (x, y, z about the world origin), scale, halve, translate by half the translation."""

    name: str
    kind: str  # wall | object
    rotation_deg: list[float]
    scale: list[float]
    translation: list[float]  # template units
    material: Material
    index: int = -1  # which object of the split
    shape: str = ""  # special shape made by code instead of an object
    texture: int | None = None  # seed of a pattern; None: the surface has no texture


@dataclass
class Light:
    """One triangle: rotate, scale, move to ``position`` (scene units)."""

    shell: list[float]
    target: list[float]
    distance: float
    position: list[float]
    rotation_deg: list[float]
    scale: list[float]
    radiance: float
    tint: list[float] = field(default_factory=lambda: [1.0, 1.0, 1.0])  # RGB factor of the radiance
    inside: bool = False  # position was drawn inside; shell, target and distance did not decide it


@dataclass
class Camera:
    shell: list[float]
    look_at: list[float]
    distance: float
    position: list[float]
    up: list[float]
    fov_deg: float
    inside: bool = False  # as of a light


@dataclass
class Plan:
    """All that was drawn for one scene."""

    template: str
    variant: str  # single | multi | empty | special | thin
    patch: bool
    walls: list[Placement]
    objects: list[Placement]
    lights: list[Light]
    cameras: list[Camera]
    thin_candidates: list[int] = field(default_factory=list)  # indices to look at, in order


class Laws(Section):
    """Everything that a scene is drawn from."""

    weights: WeightLaw = WeightLaw()
    walls: WallLaw = WallLaw()
    objects: ObjectLaw = ObjectLaw()
    material: MaterialLaw = MaterialLaw()
    lights: LightLaw = LightLaw()
    cameras: CameraLaw = CameraLaw()
    textures: TextureLaw = added(TextureLaw(), legacy=TextureLaw())


def draw_plan(laws: Laws, rng: np.random.Generator, n_objects: int) -> Plan:
    """One scene; ``n_objects`` is the number of objects in the split."""
    names, weights = zip(*laws.weights.model_dump().items(), strict=True)
    name = names[rng.choice(len(names), p=np.array(weights, float) / sum(weights))]
    template, variant, *patch = name.split("_")
    walls = [_draw_wall(laws, rng, template, wall, bool(patch)) for wall in TEMPLATES[template]]
    _draw_floor_height(laws, rng, template, walls[0], bool(patch))
    plan = Plan(template, variant, bool(patch), walls, [], [], [])
    _draw_objects(laws, rng, plan, n_objects)
    plan.lights = draw_lights(laws.lights, rng, template)
    plan.cameras = [draw_camera(laws.cameras, rng, template) for _ in range(laws.cameras.views)]
    # generators of their own: what goes beyond the paper leaves the rest of a scene as it was
    beyond_lights, beyond_cameras, beyond_surfaces = rng.spawn(3)
    for light in plan.lights:
        _vary_light(laws.lights, beyond_lights, light)
    for camera in plan.cameras:
        _vary_camera(laws.cameras, beyond_cameras, camera)
    for placement in (*plan.walls, *plan.objects):
        chance, seed = beyond_surfaces.random(), int(beyond_surfaces.integers(2**31))
        if chance < (laws.textures.wall_share if placement.kind == "wall" else laws.textures.share):
            placement.texture = seed
    return plan


def _vary_light(law: LightLaw, rng: np.random.Generator, light: Light) -> None:
    """Colour, size and place beyond the paper; every light takes the same number of draws."""
    coloured, large, inside = rng.random(3) < (law.coloured_share, law.large_share, law.inside_share)
    tint, scale = rng.uniform(*law.tint, size=3), rng.uniform(*law.large_scale, size=3)
    position, dimming = rng.uniform(*law.inside, size=3), float(rng.uniform(*law.inside_dimming))
    if coloured:
        light.tint = (tint / tint.max()).tolist()
    if large:
        light.radiance *= float((np.mean(light.scale) / scale.mean()) ** 2)
        light.scale = scale.tolist()
    if inside:
        light.inside, light.position = True, position.tolist()
        light.radiance *= dimming


def _vary_camera(law: CameraLaw, rng: np.random.Generator, camera: Camera) -> None:
    """A place inside, beyond the paper."""
    if rng.random() >= law.inside_share:
        return
    for _ in range(1000):
        position = rng.uniform(*law.inside, size=3)
        distance = float(np.linalg.norm(position - camera.look_at))
        if distance >= law.inside_distance:
            camera.inside, camera.position, camera.distance = True, position.tolist(), distance
            camera.fov_deg = float(rng.uniform(*law.inside_fov_deg))
            return
    raise UserError(
        f"no camera in {law.inside} per axis is {law.inside_distance} away from its look-at point: widen scene.cameras.inside "
        "or lower scene.cameras.inside_distance"
    )


def _draw_wall(laws: Laws, rng: np.random.Generator, template: str, wall: str, patch: bool) -> Placement:
    law, axis, box = laws.walls, WALLS[wall], template == "box"
    rotation = rng.uniform(*(law.box_tilt_deg if box else law.tilt_deg), size=3)
    rotation[axis] = rng.uniform(*law.spin_deg)
    scale = rng.uniform(*(law.box_scale if box else law.scale), size=3)
    offset = rng.uniform(*law.offset, size=3)
    if wall != "floor" and template == "wall":
        offset[1] = rng.uniform(*law.offset_along)
    elif wall != "floor" and template == "corner":
        offset[axis] = rng.uniform(*law.offset_along)
    if patch:
        spin = rotation[axis]
        rotation, scale, offset = np.zeros(3), np.ones(3), np.zeros(3)
        rotation[axis] = spin
    material = draw_material(laws.material, rng, laws.material.smooth_share)
    return Placement(wall, "wall", rotation.tolist(), scale.tolist(), offset.tolist(), material)


def _draw_floor_height(laws: Laws, rng: np.random.Generator, template: str, floor: Placement, patch: bool) -> None:
    law = laws.walls
    wide = rng.random() < law.floor_offset_wide_share
    height = float(rng.uniform(*(law.floor_offset_z_wide if wide else law.floor_offset_z)))
    if template != "box" and not patch:
        floor.translation[2] = height


def _draw_objects(laws: Laws, rng: np.random.Generator, plan: Plan, n_objects: int) -> None:
    law, box = laws.objects, plan.template == "box"
    low, high = law.box_multi_count if box else law.multi_count
    count = {"empty": 0, "multi": int(rng.integers(low, high + 1))}.get(plan.variant, 1)
    scale = {
        "single": law.box_scale_single if box else law.scale_single,
        "multi": law.box_scale_multi if box else law.scale_multi,
        "thin": law.thin_scale,
        "special": law.special_scale,
    }.get(plan.variant)
    smooth_share = law.special_smooth_share if plan.variant == "special" else laws.material.smooth_share
    # Without repetition where the split is large enough for it.
    chosen = rng.choice(n_objects, size=count, replace=count > n_objects) if plan.variant != "special" else [-1] * count
    for number, index in enumerate(chosen):
        size = float(rng.uniform(*scale))
        plan.objects.append(
            Placement(
                name=f"object_{number}",
                kind="object",
                rotation_deg=rng.uniform(*law.rotation_deg, size=3).tolist(),
                scale=[size] * 3,
                translation=rng.uniform(*law.centre, size=3).tolist(),
                material=draw_material(laws.material, rng, smooth_share),
                index=int(index),
                shape=SPECIAL_SHAPES[rng.integers(len(SPECIAL_SHAPES))] if plan.variant == "special" else "",
            )
        )
    if plan.variant == "thin":
        plan.thin_candidates = [int(i) for i in rng.choice(n_objects, size=min(law.thin_tries, n_objects), replace=False)]


def draw_material(law: MaterialLaw, rng: np.random.Generator, smooth_share: float) -> Material:
    diffuse, specular, roughness, bound = draw_reflectance(law, rng, 1)
    smooth = bool(rng.random() < smooth_share)
    vary = bool(rng.random() < law.variation_share)
    if law.variation == "diffuse_if_smooth":
        vary = vary and smooth
    seed = int(rng.integers(2**31))
    return Material(diffuse[0].tolist(), float(specular[0]), float(roughness[0]), smooth, vary, seed, float(bound[0]))


def draw_reflectance(law: MaterialLaw, rng: np.random.Generator, n: int) -> tuple[np.ndarray, ...]:
    """``n`` materials: diffuse (n, 3), specular (n,), roughness (n,), and what diffuse would be of a white surface (n,)."""
    total, share = rng.uniform(*law.total, size=n), rng.uniform(*law.specular_share, size=n)
    bound = total * (1 - share)
    diffuse = bound[:, None] * rng.uniform(*law.colour, size=(n, 3))
    low, high = law.roughness
    roughness = np.exp(rng.uniform(math.log(low), math.log(high), size=n)) - law.roughness_shift
    return diffuse, total * share, np.clip(roughness, 0.01, 1.0), bound


def draw_lights(law: LightLaw, rng: np.random.Generator, template: str) -> list[Light]:
    count = int(rng.integers(law.count[0], law.count[1] + 1))
    shells = _separated(law, rng, template, count)
    lights = []
    for shell in shells:
        target = rng.uniform(*law.target, size=3)
        distance = float(rng.uniform(*law.distance))
        lights.append(
            Light(
                shell=shell.tolist(),
                target=target.tolist(),
                distance=distance,
                position=_move(shell, target, distance).tolist(),
                rotation_deg=rng.uniform(*law.rotation_deg, size=3).tolist(),
                scale=rng.uniform(*law.scale, size=3).tolist(),
                radiance=float(rng.uniform(*law.radiance)) / count,
            )
        )
    return lights


def _separated(law: LightLaw, rng: np.random.Generator, template: str, count: int) -> list[np.ndarray]:
    """Points on the template's light shell, no two nearer than the separation; starts anew when it gets stuck."""
    for _ in range(100):
        points: list[np.ndarray] = []
        for _ in range(50 * count):
            point = law.shell_radius * _draw_direction(rng, lambda d: _light_allowed(law, template, d))
            if all(np.linalg.norm(point - other) >= law.separation for other in points):
                points.append(point)
                if len(points) == count:
                    return points
    raise UserError(
        f"{count} lights {law.separation} apart do not fit on the {template} template's shell: lower scene.lights.separation "
        "(0.2 holds 16) or scene.lights.count"
    )


def _light_allowed(law: LightLaw, template: str, d: np.ndarray) -> bool:
    if template == "box":
        return d[2] >= math.cos(math.radians(law.box_cap_deg)) and d[1] <= 0
    return d[2] >= 0 and (template != "corner" or d[0] + d[1] <= 0)


def draw_camera(law: CameraLaw, rng: np.random.Generator, template: str) -> Camera:
    if template == "box":
        x, z = rng.uniform(*law.box_square, size=2)
        shell = np.array([x, law.box_y, z])
    else:
        shell = law.shell_radius * _draw_direction(rng, lambda d: _camera_allowed(template, d))
    look_at = rng.uniform(*law.look_at, size=3)
    distance = float(rng.uniform(*law.distance))
    up = np.array([0.0, 0.0, 1.0]) + rng.uniform(*law.up, size=3)
    position = _move(shell, look_at, distance)
    return Camera(shell.tolist(), look_at.tolist(), distance, position.tolist(), up.tolist(), float(rng.uniform(*law.fov_deg)))


def _camera_allowed(template: str, d: np.ndarray) -> bool:
    upper = d[2] >= 0
    if template == "wall":
        return upper and d[0] <= 0
    if template == "corner":
        return upper and d[0] <= 0 and d[1] <= 0
    return upper


def _draw_direction(rng: np.random.Generator, allowed: Any) -> np.ndarray:
    """Uniform on the allowed part of the unit sphere."""
    while True:
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        if allowed(direction):
            return direction


def _move(shell: np.ndarray, target: np.ndarray, distance: float) -> np.ndarray:
    """The point on the ray from the target through the shell point, at that distance from the target."""
    away = shell - target
    return target + distance * away / np.linalg.norm(away)
