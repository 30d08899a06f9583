"""scene, imported: scenes in the released formats as a source for everything that follows.

Reads a folder of ``.json``, ``.h5`` and ``.hdf5`` scenes; writes one ``SceneRecord`` each, as
``stages.renderformer.s03_scene`` does, so that render, shard, train and evaluate work unchanged. One design choice: it is a
variant of the *scene* stage (``stages.renderformer.s03_variants``), in which nothing comes before it.

Scenes below ``train/``, ``validation/`` or ``test/`` belong to that split (as ``lightmill export`` writes them), all others
to ``scene.split``.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from pipeline.config import StageConfig, existing_folder, runtime
from pipeline.errors import Reject, UserError
from pipeline.stage import Inputs, Item, MapStage, Record

SPLITS = ("train", "validation", "test")
SUFFIXES = (".json", ".h5", ".hdf5")


class ImportConfig(StageConfig):
    name: Literal["imported"] = "imported"
    path: str | None = runtime(None)  # folder of scenes; the content of its files is what counts
    split: Literal["train", "validation", "test"] = "test"  # of scenes that are not in a folder named after a split
    max_triangles: int = Field(65536, ge=1)  # scenes with more are rejected


class ImportScene(MapStage):
    name = "scene"
    version = 2
    inputs = ()
    Config = ImportConfig
    reasons = {
        "unreadable": "the file, or a mesh that it names, is not what the released format says",
        "over_budget": "more triangles than max_triangles",
    }

    def slug(self, config: ImportConfig) -> str:
        return "imported"

    def part_size(self, config: ImportConfig, inputs: Inputs) -> int:
        return 64

    def identity(self, config: ImportConfig, hash_file: Callable[[Any], str]) -> dict[str, Any]:
        from stages.graphics.geometry.paths import inside

        root = folder_of(config)
        return {
            "items": {
                relative: [hash_file(root / relative), *map(hash_file, files_of(root / relative))]
                if inside(root / relative, root)
                else "outside"
                for relative in scene_files(root)
            }
        }

    def items(self, config: ImportConfig, inputs: Inputs) -> Iterator[Item]:
        for relative in scene_files(folder_of(config)):
            yield Item(relative, split_of(relative, config.split))

    def open(self, config: ImportConfig, inputs: Inputs, environment: dict[str, Any]) -> ImportConfig:
        return config

    def process(self, worker: ImportConfig, item: Item) -> Iterator[Record]:
        from dataclasses import replace

        from stages.graphics.geometry.paths import inside
        from stages.renderformer.objects.catalogue import record_id
        from stages.renderformer.scenes.released import load_scene

        path = folder_of(worker) / item.id
        if not inside(path, folder_of(worker)):
            raise Reject("unreadable", "a link that leads out of the folder")
        try:
            scene = load_scene(path)
        except UserError as error:
            raise Reject("unreadable", str(error)) from error
        if len(scene.triangles) > worker.max_triangles:
            raise Reject("over_budget", f"{len(scene.triangles)} triangles, more than {worker.max_triangles}")
        counts = {"n_triangles": len(scene.triangles), "n_lights": scene.n_lights}
        meta = {**scene.meta, **counts, "variant": "imported", "split": item.group, "source": item.id}
        yield replace(scene, id=record_id(item.id, Path(item.id).stem), meta=meta).to_record()

    def finish(self, config: ImportConfig, inputs: Inputs, draft: Any) -> None:
        draft.note("scenes", {split: len(draft.ids(split)) for split in SPLITS if draft.ids(split)})


def folder_of(config: ImportConfig) -> Path:
    return existing_folder("scene.path", config.path, "scene=imported needs a folder of scenes")


def scene_files(root: Path) -> list[str]:
    """Relative POSIX paths of the scene files below the folder, sorted. JSON files that are no scenes are passed over."""
    files = [path for path in root.rglob("*") if path.suffix.lower() in SUFFIXES and path.is_file()]
    names = [path.relative_to(root).as_posix() for path in files]
    scenes = sorted(name for name in names if not name.lower().endswith(".json") or is_scene(root / name))
    if not scenes:
        raise UserError(f"scene.path={str(root)!r} holds no scene ({', '.join(SUFFIXES)} in the released formats)")
    return scenes


def is_scene(path: Path) -> bool:
    """Whether a JSON file is meant to be a scene; one that is not JSON at all is, so that it is rejected by name."""
    try:
        data = json.loads(path.read_bytes())
    except (ValueError, RecursionError):
        return True
    return isinstance(data, dict) and "objects" in data and "cameras" in data


def files_of(path: Path) -> list[Path]:
    """All files that are opened to read a scene, besides its own: the meshes, each followed by the files beside it."""
    from stages.renderformer.scenes.released import files_beside

    return [file for mesh in meshes_of(path) for file in (mesh, *files_beside(mesh))]


def meshes_of(path: Path) -> list[Path]:
    """The mesh files that a JSON scene names, inside the scene's folder."""
    if path.suffix.lower() != ".json":
        return []
    try:
        names = [entry["mesh_path"] for entry in json.loads(path.read_bytes())["objects"].values()]
        mesh_paths = [(path.parent / name).resolve() for name in names]
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return []
    return [mesh for mesh in mesh_paths if mesh.is_relative_to(path.parent.resolve()) and mesh.is_file()]


def split_of(relative: str, otherwise: str) -> str:
    first = relative.partition("/")[0]
    return first if first in SPLITS and "/" in relative else otherwise
