"""A modelled scene as a RenderFormer scene: scaled into the unit box, lights as triangles, materials without a Fresnel term.

Reads a file by its reader (`READERS`), returns a ``SceneRecord``. What the model has no word for is replaced by the nearest
thing that it has, and ``meta["notes"]`` says so, a sentence for each. Radiance does not depend on the scale: a scene that is
s times as large has s^2 times the watts of a point light, and the same picture.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.errors import UserError
from stages.graphics.geometry.formats.usd import SUFFIXES
from stages.graphics.geometry.load import EXPORTS
from stages.graphics.geometry.measure import face_normals
from stages.renderformer.importing import gltf, usd
from stages.renderformer.importing.bodies import Body, fit, subdivide
from stages.renderformer.importing.described import Described, Lamp, Part, Viewpoint
from stages.renderformer.records import SceneRecord
from stages.renderformer.scenes import meshes
from stages.renderformer.scenes.assemble import camera_to_world, rotation_matrix
from stages.renderformer.scenes.lamps import LIGHT_AREA, LIGHT_DISTANCE, LIGHT_RADIANCE, light_triangle, three_lights
from stages.renderformer.scenes.laws import LARGEST_TRIANGLE, Camera, LightLaw

# By suffix: whether a file is a scene, and what it describes.
READERS: Mapping[str, tuple[Callable[[Path], bool], Callable[[Path], Described]]] = {
    **dict.fromkeys((".glb", ".gltf"), (gltf.holds_scene, gltf.read_gltf)),
    **dict.fromkeys(SUFFIXES, (usd.holds_scene, usd.read_usd)),
}
FAR = LightLaw().distance[1]  # scene units: where a directional light stands
STAND_IN_FOV_DEG = 40.0  # of the camera that a file without one gets, and of one that stands for an orthographic camera
STAND_IN_DIRECTION = -0.55, -1.0, 0.65  # to that camera, from the middle
# A material is constant over a triangle: what has a texture gets so many, so small ones where their number is free.
TEXTURED_TRIANGLES, TEXTURED_LARGEST = 1 << 17, (1 / 192) ** 2 / 2
NEAREST = 0.25  # scene units: lights nearer to the middle count as if they stood there
FLAT = 1e-14  # area over the squared side of the scene under which a triangle is left out


@dataclass(frozen=True)
class ImportSettings:
    """What may be chosen.

    triangles: at most, lights included. None: those of the file, subdivided where they have textures.
    exposure: factor of all light. None: as bright as the default room, all lights together.
    """

    triangles: int | None = None
    exposure: float | None = 1.0

    def __post_init__(self) -> None:
        if self.triangles is not None and self.triangles < 1:
            raise UserError(f"a scene of {self.triangles} triangles: give at least 1")


def holds_scene(path: Path) -> bool:
    """Whether the file is a scene with a camera and a light of its own, and no mere mesh."""
    holds, _ = READERS.get(path.suffix.lower(), (None, None))
    return holds is not None and holds(path)


def import_scene(path: Path, settings: ImportSettings | None = None) -> SceneRecord:
    """The scene that a file describes. UserError says what is wrong with it."""
    if path.suffix.lower() not in READERS:
        advice = EXPORTS.get(path.suffix.lower(), "export glTF (.glb)")
        raise UserError(f"{path} is no scene of a kind that is imported ({', '.join(READERS)}): {advice}")
    _, read = READERS[path.suffix.lower()]
    return converted(path, read(path), settings or ImportSettings())


def converted(path: Path, described: Described, settings: ImportSettings) -> SceneRecord:
    """The scene that a reader described. UserError where it has nothing to draw."""
    notes = list(described.notes)
    frame = _Frame.of(described, path)
    notes.append(
        f"the longest side of what is drawn, {1 / frame.scale:.4g} in the file, is one scene unit: all is scaled by "
        f"{frame.scale:.4g}"
    )
    bodies = _bodies(described.parts, frame, notes)
    lamps = [lamp for lamp in described.lamps if lamp.shines]
    if settings.triangles is not None:
        lit = bool(lamps) or any(part.surface.emits for part in described.parts)
        lamp_count = len(lamps) if lit else len(three_lights())
        notes += fit(bodies, max(settings.triangles - lamp_count, 1), LARGEST_TRIANGLE)
    else:
        subdivide([body for body in bodies if body.textured], TEXTURED_TRIANGLES, TEXTURED_LARGEST)
    columns = _Columns()
    for body in bodies:
        notes += columns.add_body(body)
    content = np.concatenate([body.triangles for body in bodies])
    for lamp in lamps:
        triangle, radiance, note = lamp_triangle(lamp, frame, content)
        columns.add_light(lamp.name, triangle, radiance)
        notes.append(note)
    dark = [lamp.name for lamp in described.lamps if not lamp.shines]
    notes += [f"light {name!r} has no strength: it is left out" for name in dark]
    if not columns.lights:
        notes.append("no light in the file: three white ones stand above, as in the default room")
        for number, light in enumerate(three_lights()):
            corners = meshes.LIGHT_TRIANGLE @ rotation_matrix(light.rotation_deg).T * light.scale + light.position
            columns.add_light(f"light_{number}", corners, np.full(3, light.radiance))
    poses, fovs, aspects = _cameras(described.viewpoints, frame, content, notes)
    scene = columns.record(path.stem, poses, fovs)
    gain = _gain(scene) if settings.exposure is None else settings.exposure
    if gain != 1:
        notes.append(f"all light is multiplied by {gain:.4g}")
        scene = replace(scene, emission=(scene.emission * gain).astype(np.float32))
    meta = {"law": "imported", "template": "imported", "source": path.name, "notes": notes, **scene.meta}
    if any(abs(aspect - 1) > 1e-3 for aspect in aspects):
        meta["aspect"] = aspects
    return replace(scene, meta=meta)


def _gain(scene: SceneRecord) -> float:
    """What makes the lights, where they stand, as bright in the middle of the scene as the default room's."""
    squared = np.maximum((scene.triangles.mean(axis=1) ** 2).sum(axis=1), NEAREST**2)
    arriving = float((meshes.areas(scene.triangles) / squared) @ scene.emission.mean(axis=1))
    return LIGHT_RADIANCE * LIGHT_AREA / LIGHT_DISTANCE**2 / arriving if arriving > 0 else 1.0


@dataclass(frozen=True)
class _Frame:
    """From the file's world to the scene's: turned so that z is up, moved, scaled."""

    turn: np.ndarray  # (3, 3)
    centre: np.ndarray  # (3,), in the turned frame
    scale: float

    @classmethod
    def of(cls, described: Described, path: Path) -> _Frame:
        turn = np.eye(3) if described.up == "z" else np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
        solid = [part.corners for part in described.parts if not part.surface.emits]
        corners = solid or [part.corners for part in described.parts]
        if not corners:
            raise UserError(f"{path} has no triangle to draw")
        points = np.concatenate(corners).reshape(-1, 3) @ turn.T
        low, high = points.min(axis=0), points.max(axis=0)
        side = float((high - low).max())
        if not 1e-12 < side < 1e12:
            raise UserError(f"{path} cannot be scaled: its longest side is {side:.3g}")
        return cls(turn, (low + high) / 2, 1 / side)

    def points(self, points: np.ndarray) -> np.ndarray:
        return (points @ self.turn.T - self.centre) * self.scale

    def pose(self, pose: np.ndarray) -> np.ndarray:
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = self.turn @ pose[:3, :3], self.points(pose[:3, 3])
        return out


def _bodies(parts: Sequence[Part], frame: _Frame, notes: list[str]) -> list[Body]:
    """The objects in scene units, in the file's order."""
    by_name: dict[str, list[Part]] = {}
    flat: dict[str, int] = {}
    for part in parts:
        corners = frame.points(part.corners)
        solid = meshes.areas(corners) > FLAT
        if not solid.all():
            flat[part.object] = flat.get(part.object, 0) + int((~solid).sum())
        if solid.any():
            by_name.setdefault(part.object, []).append(
                Part(
                    part.object,
                    corners[solid],
                    part.surface,
                    None if part.normals is None else part.normals[solid] @ frame.turn.T,
                    {number: uv[solid] for number, uv in part.uv.items()},
                    None if part.tint is None else part.tint[solid],
                )
            )
    notes += [f"{name!r}: {count:,} triangles without area are left out" for name, count in flat.items()]
    if not by_name:
        raise UserError("no triangle of the file has an area")
    return [Body.of(name, of_body) for name, of_body in by_name.items()]


# --- lights -------------------------------------------------------------------------------------------------------------------


def lamp_triangle(lamp: Lamp, frame: _Frame, content: np.ndarray) -> tuple[np.ndarray, np.ndarray, str]:
    """(3, 3) corners and (3,) radiance of the triangle that stands for a lamp, and a sentence that says so.

    A point or spot light becomes one of equal power at its place. Both sides of a triangle shine, so its power is 2 pi times
    its area and radiance. A directional light becomes a far one that lights the middle of the scene as strongly.
    content: (F, 3, 3) what it lights.
    """
    if lamp.kind == "directional":
        direction = frame.turn @ lamp.direction
        corners = light_triangle(-FAR * direction, direction, LIGHT_AREA)
        radiance = lamp.strength * FAR**2 / LIGHT_AREA
        nearer = (FAR / (FAR - 0.5)) ** 2
        note = (
            f"light {lamp.name!r} (directional, {lamp.strength:.4g} W/m2): a triangle {FAR:g} scene units away lights the "
            f"middle as strongly; half a unit nearer to it there is {nearer:.2f} times the light"
        )
        return corners, radiance * lamp.colour, note
    position = frame.points(lamp.position)
    area, cramped = _room_for(position, content)
    strength = lamp.strength * frame.scale**2  # W/sr in scene units
    if lamp.kind == "point":
        solid_angle = 4 * np.pi
        direction = -position / np.linalg.norm(position) if np.linalg.norm(position) > 1e-6 else np.array([0.0, 0.0, -1.0])
    else:
        inner, outer = (float(np.clip(angle, 0, np.pi / 2)) for angle in lamp.cone)
        inner = min(inner, outer)
        # the specification's falloff is the square of a ramp in the cosine: a third of what lies between the cones
        solid_angle = 2 * np.pi * ((1 - np.cos(inner)) + (np.cos(inner) - np.cos(outer)) / 3)
        direction = frame.turn @ lamp.direction
    radiance = strength * solid_angle / (2 * np.pi * area)
    watts = lamp.strength * solid_angle
    ahead = radiance * area / strength
    shape = (
        f"point, {watts:.4g} W"
        if lamp.kind == "point"
        else f"spot of {np.degrees(2 * lamp.cone[1]):.0f} degrees, {watts:.4g} W"
    )
    toward = "towards the middle" if lamp.kind == "point" else "along its axis"
    note = (
        f"light {lamp.name!r} ({shape}): a triangle of equal power and area {area:.4g} at its place; {toward} it is "
        f"{ahead:.3g} times as bright as in the file, sideways dark" + (", and it has no cone" if lamp.kind == "spot" else "")
    )
    if cramped:
        note += "; it is smaller than those of the training data, as something stands close to it"
    return light_triangle(position, direction, area), radiance * lamp.colour, note


def _room_for(position: np.ndarray, content: np.ndarray) -> tuple[float, bool]:
    """Area of a light triangle there, and whether it had to be smaller than the usual one to touch nothing."""
    import igl

    faces = np.arange(3 * len(content)).reshape(-1, 3)
    vertices = np.ascontiguousarray(content.reshape(-1, 3), np.float64)
    squared, _, _ = igl.point_mesh_squared_distance(np.ascontiguousarray(position[None]), vertices, faces)
    radius = np.sqrt(4 * LIGHT_AREA / np.sqrt(27))  # of the circle through its corners
    free = max(float(np.sqrt(np.min(squared))) / 2, 1e-3)
    return LIGHT_AREA * min(free / radius, 1.0) ** 2, bool(free < radius)


# --- cameras ------------------------------------------------------------------------------------------------------------------


def _cameras(
    viewpoints: Sequence[Viewpoint], frame: _Frame, content: np.ndarray, notes: list[str]
) -> tuple[list[np.ndarray], list[float], list[float]]:
    """Poses, fields of view in degrees, and widths over heights."""
    if not viewpoints:
        notes.append("no camera in the file: one looks at all of it from above")
        return [_stand_in(content)], [STAND_IN_FOV_DEG], [1.0]
    poses, fovs, aspects = [], [], []
    for viewpoint in viewpoints:
        pose, fov = frame.pose(viewpoint.pose), viewpoint.fov_deg
        if viewpoint.height is not None:
            fov = STAND_IN_FOV_DEG
            distance = viewpoint.height * frame.scale / 2 / np.tan(np.radians(fov) / 2)
            ahead = float((content.reshape(-1, 3).mean(axis=0) - pose[:3, 3]) @ -pose[:3, 2])
            pose[:3, 3] += (distance - ahead) * pose[:3, 2]
            notes.append(
                f"camera {viewpoint.name!r} is orthographic: one of {fov:g} degrees stands where the middle of the scene is as "
                "large"
            )
        poses.append(pose)
        fovs.append(fov)
        aspects.append(viewpoint.aspect)
    if len(viewpoints) > 1:
        notes.append("cameras: " + ", ".join(f"{index} {viewpoint.name}" for index, viewpoint in enumerate(viewpoints)))
    return poses, fovs, aspects


def _stand_in(content: np.ndarray) -> np.ndarray:
    """Pose of a camera that sees all (F, 3, 3) triangles."""
    points = content.reshape(-1, 3)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    radius = float(np.linalg.norm(points - middle, axis=1).max())
    direction = np.array(STAND_IN_DIRECTION) / np.linalg.norm(STAND_IN_DIRECTION)
    distance = radius / np.sin(np.radians(STAND_IN_FOV_DEG) / 2)
    position = middle + distance * direction
    return camera_to_world(Camera(direction.tolist(), middle.tolist(), distance, position.tolist(), [0.0, 0.0, 1.0], 0.0))


# --- arrays -------------------------------------------------------------------------------------------------------------------


class _Columns:
    """The arrays of a scene in the making, by object."""

    def __init__(self) -> None:
        self.arrays: dict[str, list[np.ndarray]] = {
            name: [] for name in SceneRecord.DTYPES if name not in ("camera_to_world", "fov_deg")
        }
        self.objects: list[dict] = []
        self.lights = 0

    def _add(self, name: str, kind: str, **arrays: np.ndarray) -> None:
        faces = len(arrays["triangles"])
        for column, values in arrays.items():
            self.arrays[column].append(values)
        self.arrays["object_index"].append(np.full(faces, len(self.objects)))
        self.arrays["light_index"].append(np.full(faces, self.lights if kind == "light" else -1))
        self.lights += kind == "light"
        self.objects.append({"name": name, "kind": kind, "faces": faces})

    def add_body(self, body: Body) -> list[str]:
        """Its surfaces, and what of it emits as a light of its own. Returns a sentence about the latter."""
        look = body.material()
        emits = look["emission"].max(axis=1) > 0
        notes = []
        for kind, rows in (("object", ~emits), ("light", emits)):
            if rows.any():
                values = {name: array[rows] for name, array in look.items()}
                self._add(body.name, kind, triangles=body.triangles[rows], vertex_normals=body.normals[rows], **values)
        if emits.any():
            most = np.round(look["emission"].max(axis=0), 3).tolist()
            notes.append(
                f"{body.name!r}: {int(emits.sum()):,} triangles emit a radiance of up to {most}: one light, which shines from "
                "both sides, reflects nothing, and is not seen by cameras unless they are told to"
            )
        return notes

    def add_light(self, name: str, corners: np.ndarray, radiance: np.ndarray) -> None:
        self._add(
            name,
            "light",
            triangles=corners[None],
            vertex_normals=np.repeat(face_normals(corners[None])[:, None], 3, axis=1),
            diffuse=np.ones((1, 3)),  # as the released format has it; nothing reflects from a light
            specular=np.zeros((1, 3)),
            roughness=np.ones(1),
            emission=radiance[None],
        )

    def record(self, id: str, poses: list[np.ndarray], fovs: list[float]) -> SceneRecord:
        arrays = {name: np.concatenate(parts).astype(SceneRecord.DTYPES[name]) for name, parts in self.arrays.items()}
        meta = {"n_triangles": len(arrays["triangles"]), "n_lights": self.lights, "objects": self.objects}
        cameras = {"camera_to_world": np.stack(poses).astype(np.float32), "fov_deg": np.array(fovs, np.float32)}
        return SceneRecord(id, **arrays, **cameras, meta=meta)
