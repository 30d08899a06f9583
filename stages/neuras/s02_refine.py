"""Stage refine: the scaffold's vertices and the training cameras, moved until the photos agree.

Reads a capture's training frames and the scaffold; writes one record "mesh", and beside it, where cameras moved, the poses of
all frames. Real cameras' poses are off by a pixel and more, and one texture shows the mean of what disagrees. Surfels go
that photos see through. ``stages.neuras.surfaces.photometric`` and ``surfels`` do it. Held-out photos are not looked
at: their cameras follow those beside them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import Field

from pipeline.config import StageConfig, added
from pipeline.stage import Inputs, Item, MapStage, Record
from stages.graphics.arrays import pack_arrays, pack_json, unpack_json

if TYPE_CHECKING:
    from pipeline.store import Draft
    from stages.neuras.surfaces.photometric import Settings


class RefineConfig(StageConfig):
    """Offsets and motions are measured in pixels of the nearest camera."""

    vertices: bool = False  # they move along their normals
    cameras: bool = True  # they turn and shift
    surfels: bool = added(True, False)  # those go that photos see through
    blurs: tuple[float, ...] = Field((4.0, 2.0, 1.0), min_length=1)  # sigma of each level, coarse to fine
    rounds: int = Field(3, ge=1)  # steps of each level
    neighbours: int = Field(4, ge=1)  # nearest photos that a photo is compared with
    stride: int = Field(2, ge=1)  # pixels from sample to sample
    smoothness: float = Field(1.0, ge=0)  # weight of what neighbouring vertices' offsets differ by
    closeness: float = Field(0.02, gt=0)  # weight of offsets
    camera_closeness: float = Field(0.003, gt=0)  # weight of motions
    least_gain: float = Field(0.05, ge=0, lt=1)  # share of the difference that must go, or nothing moves

    def settings(self) -> Settings:
        from stages.neuras.surfaces.photometric import Settings

        return Settings(**{field.name: getattr(self, field.name) for field in dataclasses.fields(Settings)})


class Refine(MapStage):
    """A map stage of one item, so that the limits on time and memory hold for it."""

    name: ClassVar[str] = "refine"
    version: ClassVar[int] = 3
    inputs: ClassVar[tuple[str, ...]] = ("capture", "scaffold")
    Config: ClassVar[Any] = RefineConfig
    limits: ClassVar[dict[str, float]] = {"cpu_s": 7200.0, "wall_s": 14400.0, "memory_gb": 20.0}

    def slug(self, config: RefineConfig) -> str:
        return "-".join(name for name in ("vertices", "cameras", "surfels") if getattr(config, name)) or "none"

    def items(self, config: RefineConfig, inputs: Inputs) -> Iterable[Item]:
        return [Item("mesh")]

    def max_workers(self, config: RefineConfig, environment: dict[str, Any]) -> int:
        return 1

    def open(self, config: RefineConfig, inputs: Inputs, environment: dict[str, Any]) -> Any:
        from stages.graphics.geometry import one_thread

        one_thread()
        return config, inputs["capture"], inputs["scaffold"]

    def process(self, worker: Any, item: Item) -> Iterator[Record]:
        from stages.neuras.records import POSES, Mesh, frames, scaffold_mesh, surfel_faces
        from stages.neuras.surfaces.photometric import Photo, follow, refine
        from stages.neuras.surfaces.surfels import seen_through

        config, capture, scaffold = worker
        mesh, views, lines = scaffold_mesh(scaffold), list(frames(capture, "train")), []
        cameras = given = [view.camera for view in views]
        moves = config.vertices or config.cameras
        squares = surfel_faces(scaffold) if config.surfels else 0
        photos = []
        if (moves or squares) and len(views) > 1:
            photos = [Photo(view.camera, view.image(), view.counts()) for view in views]
        if photos and moves:
            mesh, cameras = refine(mesh, photos, config.settings(), lines.append)
        if photos and squares:
            photos = [dataclasses.replace(photo, camera=camera) for photo, camera in zip(photos, cameras, strict=True)]
            goes = seen_through(mesh, squares, photos, config.neighbours)
            lines.append(f"{goes.sum():,} of {len(goes):,} surfels go: photos see through them")
            stays = np.concatenate([np.ones(len(mesh.faces) - squares, bool), np.repeat(~goes, 2)])
            mesh = Mesh.compact(mesh.vertices, mesh.faces[stays])
        arrays = pack_arrays({"vertices": mesh.vertices, "faces": mesh.faces})
        members = {"mesh.npz": arrays, "mesh.json": pack_json({"steps": lines})}
        if cameras != given:
            moved = {view.id: camera for view, camera in zip(views, cameras, strict=True)}
            others = (frame for frame in frames(capture) if frame.id not in moved)
            moved |= {frame.id: follow(frame.camera, given, cameras) for frame in others}
            members[POSES] = pack_json({id: camera.camera_to_world.tolist() for id, camera in moved.items()})
        yield Record(item.id, members)

    def finish(self, config: RefineConfig, inputs: Inputs, draft: Draft) -> None:
        for line in unpack_json(draft.read("mesh").members["mesh.json"])["steps"]:
            draft.log(line)
