"""Scene and mesh files as scenes, for trace, predict and compare.

Reads the released formats (``stages.renderformer.scenes.released``) as they are. A file of a modelling tool with cameras and
lights is a scene, too (``stages.renderformer.importing``). A plain mesh gets a room around it
(``stages.renderformer.inference.room``). One design choice: a file that cannot give a picture is refused here, so that all
commands refuse it alike.
"""

from __future__ import annotations

import sys
from pathlib import Path

from pipeline.errors import UserError
from stages.graphics.geometry.load import EXPORTS
from stages.graphics.geometry.load import SUFFIXES as MESHES
from stages.renderformer.inference.room import Room
from stages.renderformer.records import SceneRecord

SCENES = (".json", ".h5", ".hdf5")


def load_scene(path: Path | str, room: Room | None = None) -> SceneRecord:
    """The file as a SceneRecord with at least one camera and one light. A UserError says what is wrong with it.

    ``room`` is what a mesh gets around it, ``Room()`` if None. A scene file is taken as it is. A glTF that has cameras and
    lights is one, unless the room's template or axis is chosen.
    """
    from stages.renderformer.importing.convert import ImportSettings, holds_scene, import_scene
    from stages.renderformer.inference.room import room_scene
    from stages.renderformer.scenes import released

    path = Path(path)
    suffix = path.suffix.lower()
    if suffix in EXPORTS:
        raise UserError(f"{path} is of a kind that is not read: {EXPORTS[suffix]}")
    if suffix not in SCENES + MESHES:
        raise UserError(
            f"{path} is neither a scene nor a mesh: expected {', '.join(SCENES)} (the released formats) or {', '.join(MESHES)}"
        )
    if not path.is_file():
        raise UserError(f"{path} does not exist: give a scene or mesh file")
    if suffix in MESHES:
        room = room or Room()
        if room.template is None and room.up is None and holds_scene(path):
            return import_scene(path, ImportSettings(room.triangles))
        return room_scene(path, room)
    scene = released.load_scene(path)
    check_lit(scene, path)
    return scene


def check_lit(scene: SceneRecord, name: Path | str) -> None:
    """UserError, with the scene's ``name``, if nothing in it emits."""
    if not scene.emission.any():
        why = "".join(f" ({note})" for note in scene.meta.get("notes", ()) if "without area" in note)
        raise UserError(f"{name} has no light{why}, its picture would be black: give an object an emissive colour above 0")


def print_notes(scene: SceneRecord) -> None:
    """Say on stderr what was done to the file to make it a scene."""
    for note in scene.meta.get("notes", ()):
        print(f"note: {note}", file=sys.stderr)
