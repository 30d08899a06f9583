"""The made-up place as a source of a capture: items, frames, sweeps, and what is known of the whole."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np

from pipeline.keys import seed_for
from stages.graphics.casting import Caster
from stages.neuras.records import CaptureInfo, FrameRecord, Mesh, PointsRecord
from stages.neuras.street import lidar
from stages.neuras.street.cameras import poses
from stages.neuras.street.city import City, make
from stages.neuras.street.rendering import Renderer
from stages.neuras.street.settings import StreetConfig

AROUND = {"street": 60.0, "drone": 30.0, "object": 0.0}  # metres that are seen beyond the cameras
RULES = {
    "street": "every other frame of the drive is held out",
    "drone": "a random half of the frames is held out",
    "object": "every other frame is held out",
}


def prepare(config: StreetConfig, folder: Path) -> None:
    """Make the place once, for all workers."""
    make(config.preset, config.seed, config.length, config.texture_size, config.object).save(folder)


class StreetSource:
    """Frames and sweeps of the place that ``prepare`` wrote to ``folder``; ``items`` and ``info`` need none.

    A frame needs Mitsuba with a variant chosen (``stages.graphics.mitsuba.backend.activate``).
    """

    def __init__(self, config: StreetConfig, folder: Path | None = None):
        self.config, self.folder = config, folder
        self._poses = {pose.id: pose for pose in poses(config)}
        self._sensors = {f"points-sweep_{number:04d}": place for number, place in enumerate(lidar.sensors(config))}

    def items(self) -> list[tuple[str, str]]:
        """Ids with their groups: a frame's split, or "points"."""
        return [(pose.id, pose.split) for pose in self._poses.values()] + [(id, "points") for id in self._sensors]

    def frame(self, id: str) -> FrameRecord:
        pose = self._poses[id]
        return FrameRecord(
            id,
            pose.camera,
            self._renderer.picture(pose.camera, self.config.spp, seed_for(self.config.seed, "street", id) % 2**31),
            pose.split,
            pose.trajectory,
            pose.shift,
            pose.time,
            depth=self._caster.view(pose.camera).depth,
        )

    def points(self, id: str) -> PointsRecord:
        rng = np.random.default_rng(seed_for(self.config.seed, "street", id))
        return lidar.sweep(self.config, self._city, self._caster, id, self._sensors[id], rng)

    def info(self) -> CaptureInfo:
        config = self.config
        places = np.array([pose.camera.position for pose in self._poses.values() if pose.split == "train"])
        centre = 0.5 * (places.min(axis=0) + places.max(axis=0))
        radius = 0.5 * float(np.linalg.norm(np.ptp(places, axis=0))) + AROUND[config.preset]
        rule = RULES[config.preset]
        return CaptureInfo(
            units="metre",
            metre=1.0,
            up=(0.0, 0.0, 1.0),
            centre=tuple(float(value) for value in centre),
            radius=radius,
            points="lidar",
            split_rule=f"{rule}; of the held-out, every fifth is for validation, the others are the test",
            source={
                "name": "street",
                "preset": config.preset,
                **({"object": config.object} if config.preset == "object" else {}),
                "seed": config.seed,
                "licence": "made by this program",
            },
        )

    def mesh(self) -> Mesh | None:
        """The true mesh as far as the LiDAR reaches, where the settings ask for it; else a scaffold is reconstructed."""
        if not self.config.true_mesh:
            return None
        vertices, faces = self._city.mesh()
        places = np.array([pose.camera.position for pose in self._poses.values() if pose.split == "train"])
        centres = vertices[faces].mean(axis=1)
        near = np.linalg.norm(centres - np.clip(centres, places.min(axis=0), places.max(axis=0)), axis=1)
        return Mesh.compact(vertices, faces[near < lidar.REACH[self.config.preset]])

    @functools.cached_property
    def _city(self) -> City:
        if self.folder is None:
            raise ValueError("a street renders from the folder that prepare() wrote: none was given")
        return City.load(self.folder)

    @functools.cached_property
    def _caster(self) -> Caster:
        return Caster(*self._city.mesh())

    @functools.cached_property
    def _renderer(self) -> Renderer:
        return Renderer(self._city, self._caster, self.config.preset == "object")
