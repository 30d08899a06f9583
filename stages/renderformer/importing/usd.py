"""A USD stage as `Described`: meshes with UsdPreviewSurface materials, UsdLux lights, cameras.

Light intensities are taken as radiance, as UsdLux has them up to a unit.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import Reject, UserError
from stages.graphics.geometry import colours
from stages.graphics.geometry.formats import usd
from stages.graphics.geometry.formats.faults import at
from stages.renderformer.importing.described import (
    MAX_BYTES,
    MAX_FACES,
    Described,
    Lamp,
    Part,
    Surface,
    Texture,
    Viewpoint,
    rigid,
)

DISK_SIDES = 16


def holds_scene(path: Path) -> bool:
    """Whether the file has a camera and a light, so that it is a scene and no mere mesh. False where it cannot be read."""
    try:
        with at(path.name):
            stage = usd.open_stage(path, path.parent)
    except Reject:
        return False
    from pxr import UsdGeom, UsdLux

    prims = list(stage.Traverse())
    return any(UsdGeom.Camera(prim) for prim in prims) and any(prim.HasAPI(UsdLux.LightAPI) for prim in prims)


def read_usd(path: Path) -> Described:
    """The stage's scene. UserError says what is wrong with it."""
    images = colours.Images()
    try:
        with at(path.name):
            stage = usd.open_stage(path, path.parent)
            parts = list(usd.parts(stage, path.parent, MAX_BYTES, MAX_FACES, images))
    except Reject as error:
        raise UserError(f"{path} cannot be read: {error.detail or error.reason}") from None
    from pxr import Usd, UsdGeom

    time, notes = Usd.TimeCode.EarliestTime(), []
    last_names = [part.name.rpartition("/")[2] for part in parts]
    described = Described([], [], [], "z" if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z else "y", notes)
    surfaces: dict[str, Surface] = {}
    for part in parts:
        if part.material not in surfaces:
            surfaces[part.material] = _surface(part, notes)
        uv = {} if part.uv is None else {0: part.uv}
        tint = None if part.material else part.tint
        last = part.name.rpartition("/")[2]
        name = last if last_names.count(last) == sum(other.name == part.name for other in parts) else part.name
        described.parts.append(Part(name, part.points[part.triangles], surfaces[part.material], part.normals, uv, tint))
    to_world = UsdGeom.XformCache(time)
    for prim in stage.Traverse():
        matrix = np.asarray(to_world.GetLocalToWorldTransform(prim)).T
        name = prim.GetName()
        camera = UsdGeom.Camera(prim)
        if camera:
            described.add_camera(name, _viewpoint(name, camera.GetCamera(time), matrix))
        elif prim.GetTypeName() in LIGHTS:
            LIGHTS[prim.GetTypeName()](_Light(name, prim, time, matrix), described)
        elif str(prim.GetTypeName()).startswith("DomeLight"):
            notes.append(f"light {name!r} is a sky: it is left out, since the scene's surroundings are black")
    notes += images.notes
    return described


def _surface(part: usd.UsdPart, notes: list[str]) -> Surface:
    inputs = part.inputs
    surface = Surface(part.material)

    def colour(name: str, default: float) -> np.ndarray:
        value = inputs.get(name)
        return np.full(3, default) if value is None else np.asarray(value, np.float64)

    surface.colour = colour("diffuseColor", 1.0 if "colour" in part.textures or not part.material else 0.18).clip(0, 1)
    surface.roughness = float(inputs["roughness"]) if inputs.get("roughness") is not None else 0.5
    surface.metallic = float(inputs.get("metallic") or 0.0)
    ior = float(inputs.get("ior") or 1.5)
    surface.dielectric = np.full(3, ((ior - 1) / (ior + 1)) ** 2)
    surface.emission = colour("emissiveColor", 1.0 if "emission" in part.textures else 0.0)
    surface.textures = {use: Texture(*found) for use, found in part.textures.items()}
    opacity = inputs.get("opacity", 1.0)
    if opacity is None or float(opacity) < 1:
        notes.append(f"material {part.material!r}: it is see-through in places: it is opaque here")
    unread = [name for name in ("roughness", "metallic", "normal") if name in inputs and inputs[name] is None]
    if unread:
        notes.append(f"material {part.material!r}: textures of {', '.join(unread)} are left out")
    return surface


def _viewpoint(name: str, camera: Any, matrix: np.ndarray) -> Viewpoint:
    height, width = camera.verticalAperture, camera.horizontalAperture
    if str(camera.projection).endswith("Orthographic"):
        return Viewpoint(name, rigid(matrix), 0.0, width / height, height / 10)  # apertures are tenths of a unit
    return Viewpoint(name, rigid(matrix), float(np.degrees(2 * np.arctan(height / (2 * camera.focalLength)))), width / height)


class _Light:
    """A UsdLux light: its radiance, or what it has of power where it is normalised by its size."""

    def __init__(self, name: str, prim: Any, time: Any, matrix: np.ndarray):
        from pxr import UsdLux

        light = UsdLux.LightAPI(prim)
        self.name, self.prim, self.time, self.matrix = name, prim, time, matrix
        self.strength = float(light.GetIntensityAttr().Get(time)) * 2.0 ** float(light.GetExposureAttr().Get(time))
        self.colour = np.asarray(light.GetColorAttr().Get(time), np.float64)
        self.normalized = bool(light.GetNormalizeAttr().Get(time))
        self.scale = float(abs(np.linalg.det(matrix[:3, :3])) ** (1 / 3))
        self.direction = -matrix[:3, 2] / max(float(np.linalg.norm(matrix[:3, 2])), 1e-300)

    def size(self, name: str) -> float:
        return float(self.prim.GetAttribute(f"inputs:{name}").Get(self.time))

    def radiance(self, area: float) -> float:
        return self.strength / area if self.normalized and area > 0 else self.strength


def _sphere(light: _Light, described: Described) -> None:
    radius = max(light.size("radius") * light.scale, 1e-6)
    per_direction = np.pi * radius**2 * light.radiance(4 * np.pi * radius**2)
    angle = light.prim.GetAttribute("inputs:shaping:cone:angle")
    cone = float(angle.Get(light.time)) if angle and angle.HasAuthoredValue() else 180.0
    place = light.matrix[:3, 3]
    if cone >= 90:
        described.lamps.append(Lamp(light.name, "point", light.colour, per_direction, place, light.direction))
        return
    outer = np.radians(cone)
    softness = light.prim.GetAttribute("inputs:shaping:cone:softness")
    inner = outer * (1 - float(softness.Get(light.time) or 0.0)) if softness else outer
    described.lamps.append(Lamp(light.name, "spot", light.colour, per_direction, place, light.direction, (inner, outer)))


def _flat(light: _Light, described: Described, outline: np.ndarray) -> None:
    """A light with a surface: ``outline`` (N, 3) are its corners, convex and seen from the side that shines."""
    corners = outline @ light.matrix[:3, :3].T + light.matrix[:3, 3]
    triangles = np.stack([np.repeat(corners[:1], len(corners) - 2, axis=0), corners[1:-1], corners[2:]], axis=1)
    area = float(
        np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1).sum() / 2
    )
    surface = Surface(light.name, np.zeros(3), emission=light.radiance(area) * light.colour)
    described.parts.append(Part(light.name, triangles, surface))


def _rectangle(light: _Light, described: Described) -> None:
    x, y = light.size("width") / 2, light.size("height") / 2
    _flat(light, described, np.array([[-x, -y, 0], [-x, y, 0], [x, y, 0], [x, -y, 0]]))


def _disk(light: _Light, described: Described) -> None:
    turn = -2 * np.pi * np.arange(DISK_SIDES) / DISK_SIDES
    radius = light.size("radius") * np.sqrt(2 * np.pi / DISK_SIDES / np.sin(2 * np.pi / DISK_SIDES))  # of equal area
    _flat(light, described, radius * np.stack([np.cos(turn), np.sin(turn), np.zeros(DISK_SIDES)], axis=1))


def _distant(light: _Light, described: Described) -> None:
    angle = np.radians(light.size("angle"))
    irradiance = light.strength if light.normalized or angle == 0 else light.strength * np.pi * np.sin(angle / 2) ** 2
    place = light.matrix[:3, 3]
    described.lamps.append(Lamp(light.name, "directional", light.colour, irradiance, place, light.direction))


LIGHTS: dict[str, Callable[[_Light, Described], None]] = {
    "SphereLight": _sphere, "RectLight": _rectangle, "DiskLight": _disk, "DistantLight": _distant,
}  # fmt: skip
