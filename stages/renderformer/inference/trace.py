"""``lightmill trace``: path trace a scene or mesh file, and write float EXR images.

``stages.renderformer.inference.scene_files`` reads the file.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pipeline.errors import UserError

if TYPE_CHECKING:
    from stages.renderformer.inference.room import Room
    from stages.renderformer.rendering.settings import RenderSettings


def trace(
    scene_path: Path | str,
    out_path: Path | str,
    settings: RenderSettings,
    view: int | Literal["all"] = 0,
    backend: str = "auto",
    room: Room | None = None,
) -> list[Path]:
    """Write the view as linear RGB; returns the paths. Notes go to stderr.

    With ``view`` all, the files are ``OUT-0.exr``, ``OUT-1.exr`` ..

    ``room``: what a mesh gets around it.
    """
    from stages.graphics.exr import write_rgb
    from stages.graphics.mitsuba.backend import choose
    from stages.renderformer.inference.scene_files import load_scene, print_notes
    from stages.renderformer.rendering.render import render_views

    out = Path(out_path)
    if out.suffix.lower() != ".exr":
        raise UserError(f"{out} is not an EXR file's name: give OUT.exr")
    if not out.parent.is_dir():
        raise UserError(f"the folder {out.parent} does not exist: make it first")
    scene = load_scene(scene_path, room)
    count = len(scene.camera_to_world)
    if view != "all" and not 0 <= view < count:
        raise UserError(f"view={view} does not exist: {scene_path} has {count} camera(s), counted from 0; or give 'all'")
    print_notes(scene)
    chosen = choose(backend)
    paths = []
    for index in range(count) if view == "all" else [view]:
        given = settings.resolution
        size = scene.picture_size(index, given) if isinstance(given, int) else given
        (record,) = render_views(scene, replace(settings, resolution=size), chosen, [index])
        paths.append(out.with_name(f"{out.stem}-{index}{out.suffix}") if view == "all" else out)
        write_rgb(paths[-1], record.image)
    return paths
