"""A mesh file as a scene: the default room, lights and camera around one object.

Reads a mesh file (``stages.graphics.geometry.load``), returns a ``SceneRecord``. The object stands on the floor, its front to
the camera, under three white lights. The room is a template of the training scenes, with every number inside the released
ranges (paper section 3.3), so that a model sees what it knows. Design choice: an object of too many triangles goes through
*remesh* and *decimate* with their defaults. So it becomes an object like those of the training data. One of few large
triangles is subdivided as far as the limit of triangles allows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.errors import Reject, UserError
from stages.graphics.geometry.records import MeshRecord, TextureRecord
from stages.renderformer.records import SceneRecord
from stages.renderformer.scenes import laws, meshes
from stages.renderformer.scenes.assemble import WALL_FACES, assemble, camera_to_world, normalize, place
from stages.renderformer.scenes.lamps import LIGHTS, three_lights
from stages.renderformer.scenes.laws import LARGEST_TRIANGLE, TEMPLATES, Camera, Material, MaterialLaw, Placement, Plan

MAX_BYTES, MAX_FACES = 1 << 28, 2_000_000  # of a mesh file, as *collect* has them
LEAST_FACES = 128  # an object should get; a room with fewer walls is taken before
UP = {"x": (0, 90, 0), "-x": (0, -90, 0), "y": (90, 0, 0), "-y": (-90, 0, 0), "z": (0, 0, 0), "-z": (180, 0, 0)}
Z_UP = (".stl", ".3mf")  # made for printing; the other formats mostly have y up, as glTF prescribes


# Scene units. The object's bounding sphere stands on the floor in the middle.
RADIUS = 0.4
FLOOR = 0.6, 0.57, 0.53
WALL_COLOURS = {"right": (0.55, 0.2, 0.13), "back": FLOOR, "left": (0.16, 0.34, 0.4)}
OBJECT_COLOUR = 0.7, 0.7, 0.7  # of files without base colours
SPECULAR, ROUGHNESS = 0.1, 0.4  # of the object
CAMERAS = {"box": (-0.15, -1.0, 0.35)}  # direction from what they look at; of the other templates:
CAMERA = -0.55, -1.0, 0.65
CAMERA_DISTANCE = 1.85
FILLED = 0.66  # of the picture's side, by the object
LEAST_TRIANGLES = WALL_FACES + len(LIGHTS) + LEAST_FACES // 2  # a floor, the lights and something on it


@dataclass(frozen=True)
class Room:
    """What may be chosen of the room around a mesh. A value that no room can have is a UserError.

    template: floor, wall, corner or box. None: a corner, or fewer walls if ``triangles`` are too few for a corner.
    up: the file's axis that points up, ``x`` to ``-z``. None: z for STL, y for the other formats.
    triangles: most triangles of the scene, room and lights included; a larger mesh is decimated. None: the mesh as it is.
    """

    template: str | None = None
    up: str | None = None
    triangles: int | None = None

    def __post_init__(self) -> None:
        if self.template not in (None, *TEMPLATES) or self.up not in (None, *UP):
            raise UserError(
                f"room {self.template!r}, up {self.up!r}: expected one of {', '.join(TEMPLATES)}, and one of {', '.join(UP)}"
            )
        if self.triangles is not None and self.triangles < LEAST_TRIANGLES:
            raise UserError(f"a room of {self.triangles} triangles: an object on a floor needs at least {LEAST_TRIANGLES}")


def room_scene(path: Path, room: Room) -> SceneRecord:
    """The mesh file in its room. ``meta["notes"]`` says what was done to the mesh.

    UserError: the file has no mesh that can be used, or none that can be decimated so far.
    """
    import trimesh

    from stages.graphics.geometry.load import load_mesh, normalise

    triangles = room.triangles
    path = path.resolve()  # a link may point anywhere: what the file refers to must lie beside what it points to
    try:
        loaded = load_mesh(path, path.parent, MAX_BYTES, MAX_FACES, textures=True)
    except Reject as error:
        from stages.renderformer.s00_collect import Collect

        raise UserError(f"{path} cannot be used: {Collect.reasons[error.reason]} ({error.detail})") from None
    original = normalise(loaded.vertices).astype(np.float64), loaded.faces
    template = room.template or _template(triangles, len(loaded.faces))
    walls = TEMPLATES[template]
    object_faces = None  # at most
    if triangles is not None:
        object_faces = max(triangles - WALL_FACES * len(walls) - len(LIGHTS), LEAST_FACES // 2)
    notes = [f"{path.name}: {note}" for note in loaded.notes]
    mesh = _welded(*original)
    if object_faces is not None and len(mesh[1]) > object_faces:
        mesh, how = decimated(*original, object_faces)
        notes.append(f"{path.name}: {len(original[1]):,} triangles {how} to {len(mesh[1]):,}, of {triangles:,} in the scene")

    turn = UP[room.up or ("z" if path.suffix.lower() in Z_UP else "y")]
    placement = _object(mesh[0], turn)
    while object_faces is not None and 4 * len(mesh[1]) <= object_faces and _largest(mesh, placement) > LARGEST_TRIANGLE:
        mesh = trimesh.remesh.subdivide(*mesh)
        placement = _object(mesh[0], turn)  # another mean of the vertices
    camera = _camera(template, place(normalize(mesh[0]), placement))
    plan = Plan(template, "single", False, [_wall(name) for name in walls], [placement], three_lights(), [camera])
    meta = {"law": "room", "source": path.name, "notes": notes}
    scene = assemble(path.stem, plan, [mesh], [{"faces_before": len(original[1])}], MaterialLaw(), meta)
    if loaded.texture is None:
        return scene
    return _coloured(scene, loaded.texture, original, mesh)


def _largest(mesh: meshes.Mesh, placement: Placement) -> float:
    """Area of the largest triangle of the placed object."""
    return float(meshes.areas(place(normalize(mesh[0]), placement)[mesh[1]]).max())


def _template(triangles: int | None, faces: int) -> str:
    """Name of the room with the most walls that leaves enough triangles for the object's ``faces``."""
    for name in ("corner", "wall"):
        for_object = np.inf if triangles is None else triangles - WALL_FACES * len(TEMPLATES[name]) - len(LIGHTS)
        if for_object >= min(faces, 2 * LEAST_FACES):
            return name
    return "floor"


def decimated(vertices: np.ndarray, faces: np.ndarray, budget: int) -> tuple[meshes.Mesh, str]:
    """The mesh with at most ``budget`` faces, and words for how it was made.

    *remesh* and *decimate* make it. A mesh that they reject is collapsed as it is. UserError: that leaves too many faces.
    """
    from pipeline.stage import Item, Record
    from stages.graphics.geometry import decimator
    from stages.renderformer.objects.rungs import load_rungs
    from stages.renderformer.s01_remesh import Remesh, RemeshConfig
    from stages.renderformer.s02_decimate import Decimate, DecimateConfig

    class OneRecord(dict):
        """One record in the place of an artifact."""

        def read(self, id: str) -> Record:
            return self[id]

    names = ("object_id", "content_hash", "family", "source", "origin", "licence")
    record = MeshRecord("mesh", vertices.astype(np.float32), faces.astype(np.int32), dict.fromkeys(names, "")).to_record()
    collect, item = OneRecord(mesh=record), Item("mesh")
    try:
        (fine,) = Remesh().process((RemeshConfig(), collect), item)
        config = DecimateConfig(budgets=[budget])
        (record,) = Decimate().process((config, {"collect": collect, "remesh": OneRecord(mesh=fine)}), item)
        ((vertices, faces),) = load_rungs(record).values()
        return (vertices.astype(np.float64), faces.astype(np.int64)), "remeshed and decimated"
    except Reject as error:
        mesh = decimator.collapse(*_welded(vertices, faces), budget, "fast_simplification", 0.0)
        if len(mesh[1]) > budget or len(mesh[1]) == 0:
            raise UserError(
                f"a mesh of {len(faces):,} triangles cannot be decimated to {budget:,} ({error}): simplify it, or allow more "
                "triangles (--triangles)"
            ) from None
        return mesh, f"decimated as they are ({error.reason} when remeshed)"


def _welded(vertices: np.ndarray, faces: np.ndarray) -> meshes.Mesh:
    """The mesh with vertices at equal positions merged. Files repeat them along texture seams, where shading must not break."""
    points, index = np.unique(vertices, axis=0, return_inverse=True)
    faces = index.reshape(-1)[faces]
    return points, faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]


def _material(colour: Sequence[float], specular: float = 0.0, roughness: float = 1.0, smooth: bool = False) -> Material:
    bound = 1 - specular
    return Material([bound * value for value in colour], specular, roughness, smooth, False, 0, bound)


def _wall(name: str) -> Placement:
    """A wall, as wide as the law allows. The floor is raised so that object and camera fit as they do in the data."""
    floor = name == "floor"
    law = laws.WallLaw()
    wide, near = law.scale[1], law.scale[0]
    scale = [near if axis == laws.WALLS[name] else wide for axis in range(3)]
    height = [0.0, 0.0, law.floor_offset_z[1] if floor else 0.0]
    material = _material(FLOOR if floor else WALL_COLOURS[name])
    if not floor:
        scale[laws.WALLS[name]] = 1.0
    return Placement(name, "wall", [0.0] * 3, scale, height, material)


def _floor_height() -> float:
    floor = _wall("floor")
    return float(place(meshes.wall("floor")[0].astype(np.float64), floor)[:, 2].min())


def _object(vertices: np.ndarray, turn: Sequence[float]) -> Placement:
    """The object's placement: upright, centred, its lowest point on the floor, ``RADIUS`` around its bounding box's centre.

    ``vertices``: (V, 3) as in the file. ``turn``: degrees about x, y and z that bring the file's up to z.
    """
    placement = Placement(
        "object_0", "object", [float(angle) for angle in turn], [1.0] * 3, [0.0] * 3,
        _material(OBJECT_COLOUR, SPECULAR, ROUGHNESS, smooth=True),
    )  # fmt: skip
    placed = place(normalize(vertices), placement)
    low, high = placed.min(axis=0), placed.max(axis=0)
    scale = RADIUS / float(np.linalg.norm(placed - (low + high) / 2, axis=1).max())
    shift = -scale * np.array([*(low + high)[:2] / 2, low[2]]) + [0, 0, _floor_height() + 1e-4]  # no two faces in one plane
    return replace(placement, scale=[scale] * 3, translation=(2 * shift).tolist())


def _camera(template: str, points: np.ndarray) -> Camera:
    """A camera that looks at the middle of the object's ``points`` (N, 3), with a field of view that the object fills well.

    The camera law bounds both.
    """
    law = laws.CameraLaw()
    direction = np.array(CAMERAS.get(template, CAMERA))
    direction /= np.linalg.norm(direction)
    look_at = np.clip((points.min(axis=0) + points.max(axis=0)) / 2, *law.look_at)
    position = look_at + CAMERA_DISTANCE * direction
    camera = Camera(direction.tolist(), look_at.tolist(), CAMERA_DISTANCE, position.tolist(), [0.0, 0.0, 1.0], 0.0)
    in_camera = (points - position) @ camera_to_world(camera)[:3, :3]
    fov_deg = 2 * np.degrees(np.arctan(np.abs(in_camera[:, :2] / in_camera[:, 2:]).max() / FILLED))
    return replace(camera, fov_deg=float(np.clip(fov_deg, *law.fov_deg)))


COLOUR_GRID = 4  # points per side of a triangle that its colour is the mean of


def _coloured(scene: SceneRecord, texture: TextureRecord, original: meshes.Mesh, mesh: meshes.Mesh) -> SceneRecord:
    """The scene, its object in the file's base colours. A triangle's colour is the mean at the nearest points of the original.

    ``original`` and ``mesh``: the object as in the file and as in the scene, (vertices, faces).
    """
    from stages.renderformer.scenes.textures import nearest_colours, seen_faces

    vertices, faces = original
    visible = None if len(faces) == len(mesh[1]) else seen_faces(vertices, faces)
    row, column = np.nonzero(np.add.outer(np.arange(COLOUR_GRID), np.arange(COLOUR_GRID)) < COLOUR_GRID)
    first, second = (column + 1 / 3) / COLOUR_GRID, (row + 1 / 3) / COLOUR_GRID
    weights = np.stack([1 - first - second, first, second], axis=1)
    points = np.einsum("pk,fkc->fpc", weights, np.asarray(mesh[0], np.float64)[mesh[1]])
    colour_at = nearest_colours(texture, vertices, faces, visible)
    colours = colour_at(points.reshape(-1, 3)).reshape(*points.shape[:2], 3).mean(axis=1)
    diffuse = scene.diffuse.copy()
    diffuse[scene.object_index == len(TEMPLATES[scene.meta["template"]])] = (1 - SPECULAR) * np.clip(colours, 0, 1)
    return replace(scene, diffuse=diffuse)
