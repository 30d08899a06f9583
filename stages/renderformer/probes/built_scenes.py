"""Sweeps over scenes built for the purpose: occluders between light and floor, mirrors (paper, figures 14 and 15).

Nothing is read of the shards but their key. One design choice: scenes are plans like sampled ones
(``stages.renderformer.scenes``), so that triangles, materials, lights and cameras lie where training has them and only what
is varied is new.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator

from pipeline.config import count
from pipeline.stage import Inputs
from stages.renderformer.probes.probe import Probe, ProbeConfig, Sweep, Worker
from stages.renderformer.probes.sweeps import Values, at_least
from stages.renderformer.records import SceneRecord
from stages.renderformer.scenes import meshes
from stages.renderformer.scenes.assemble import assemble
from stages.renderformer.scenes.laws import Camera, Light, LightLaw, Material, MaterialLaw, Placement, Plan, draw_lights

DOWN = (45.0, -35.2644)  # degrees about x, then y: turns the light triangle's normal (1, 1, 1) up, and so its other side down


def material(diffuse: Any, specular: float = 0.0, roughness: float = 1.0) -> Material:
    return Material([float(x) for x in diffuse], specular, roughness, smooth=False, vary=False, seed=0)


def wall(name: str, of: Material, scale: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Placement:
    return Placement(name, "wall", [0.0, 0.0, 0.0], list(scale), [0.0, 0.0, 0.0], of)


def in_place(name: str, mesh: meshes.Mesh, of: Material) -> Placement:
    """The placement that leaves a mesh, given in scene units, where it is."""
    vertices = mesh[0]
    centre = vertices.mean(axis=0)
    radius = float(np.linalg.norm(vertices - centre, axis=1).max())
    return Placement(name, "object", [0.0, 0.0, 0.0], [4 * radius] * 3, (2 * centre).tolist(), of)


def camera(position: np.ndarray, look_at: tuple[float, float, float], fov_deg: float) -> Camera:
    place = [float(x) for x in position]
    return Camera(place, list(look_at), float(np.linalg.norm(position - look_at)), place, [0.0, 0.0, 1.0], fov_deg)


class BuiltScenes(Sweep):
    """Scenes of the probe's own; the config's ``scenes`` says how many."""

    def scene_ids(self, config: Any, inputs: Inputs) -> list[str]:
        return [f"made-{number:02d}" for number in range(config.scenes)]

    def scope(self, config: Any) -> str:
        return f"scene(s) made for the probe, one view each at {config.resolution} px"

    def scene(self, worker: Worker, scene_id: str, value: float) -> SceneRecord:
        """From random numbers that are the same for every value."""
        plan, solids = self.plan(worker.rng(self.name, scene_id), value, worker.config)
        return assemble(scene_id, plan, solids, [{} for _ in solids], MaterialLaw(), {"law": "probe"})

    def plan(self, rng: np.random.Generator, value: float, config: Any) -> tuple[Plan, list[meshes.Mesh]]:
        raise NotImplementedError


class OccludersConfig(ProbeConfig):
    name: Literal["occluders"] = "occluders"
    values: Values = count((0, 1, 4, 9, 36))

    @field_validator("values")
    @classmethod
    def _squares(cls, values: Values) -> Values:
        if not values or any(value not in (0, 1, 4, 9, 36) for value in values):
            raise ValueError("expected numbers of plates among 0, 1, 4, 9, 36: all cut from the same 72 triangles")
        return values


SHEET = 6  # quads along the side of the sheet that plates are cut from
SHEET_SIDE = 0.6  # scene units
SPREAD = 1.5  # plates and the gaps between them, over the plates


def plates(number: int, angle: float) -> meshes.Mesh:
    """``number`` square plates in a grid at z = 0, turned about z: always 6 x 6 quads and the same area in all."""
    across = round(number**0.5)
    cell, place = SHEET_SIDE / SHEET, np.stack(np.divmod(np.arange(SHEET**2), SHEET), axis=1)
    apart = (place // (SHEET // across) - (across - 1) / 2) * (SPREAD - 1) * SHEET_SIDE / across
    quad = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    flat = (place[:, None] + quad) * cell - SHEET_SIDE / 2 + apart[:, None]
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    vertices = np.concatenate([flat.reshape(-1, 2) @ turn.T, np.zeros((4 * SHEET**2, 1))], axis=1)
    faces = 4 * np.arange(SHEET**2)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])
    return vertices, faces.reshape(-1, 3)


class Occluders(BuiltScenes):
    name = "occluders"
    title = "Occluders"
    question = "How fine may the shadow of many occluders between a light and the floor be?"
    setting = "plates, of equal area in all"
    axis = "even"
    Config = OccludersConfig

    def plan(self, rng: np.random.Generator, value: float, config: Any) -> tuple[Plan, list[meshes.Mesh]]:
        colours = rng.uniform(0.3, 0.9, (2, 3))
        turn, around, tilt, azimuth = rng.uniform(0, 2 * np.pi, 4)
        floor = wall("floor", material(colours[0]), (1.3, 1.3, 1.0))
        solids = [plates(int(value), turn)] if value else []
        above = np.array([0.2 * np.cos(tilt), 0.2 * np.sin(tilt), 1.0])
        light = Light([0.0, 0.0, 0.866], [0.0, 0.0, 0.0], 2.4, (2.4 * above / np.linalg.norm(above)).tolist(),
                      [*DOWN, float(np.degrees(around))], [2.25] * 3, 3750.0)  # fmt: skip
        camera_position = 1.8 * np.array([0.7 * np.cos(azimuth), 0.7 * np.sin(azimuth), 0.71])
        return (
            Plan("floor", "occluders", False, [floor], [in_place("plates", s, material(colours[1])) for s in solids],
                 [light], [camera(camera_position, (0.0, 0.0, -0.25), 45.0)]),
            solids,
        )  # fmt: skip

    def notes(self, config: OccludersConfig) -> list[str]:
        return [
            "Plates 0.5 above the floor and 1.9 under a light of edge 0.16, all of the same total area and the same 72 "
            "triangles: only their arrangement gets finer. 0: no plates."
        ]


class BouncesConfig(ProbeConfig):
    name: Literal["bounces"] = "bounces"
    values: Values = count((0, 1, 2, 3))
    roughness: float = Field(0.05, ge=0.01, le=1)  # of the mirrors
    max_spp: int = Field(512, ge=1)

    _values = field_validator("values")(at_least(0, 3, whole=True))


MIRRORS = ("back", "right", "left")  # in the order in which walls become mirrors


class Bounces(BuiltScenes):
    name = "bounces"
    title = "Specular bounces"
    question = "Does the network follow light over one, two and more mirrors?"
    setting = "walls that are mirrors"
    Config = BouncesConfig

    def plan(self, rng: np.random.Generator, value: float, config: BouncesConfig) -> tuple[Plan, list[meshes.Mesh]]:
        colours = rng.uniform(0.2, 0.9, (5, 3))
        mirrors = MIRRORS[: int(value)]
        walls = [
            wall(name, material((0, 0, 0), 0.95, config.roughness) if name in mirrors else material(colour))
            for name, colour in zip(("floor", "back", "right", "left"), colours, strict=False)
        ]
        vertices, faces = meshes.special(("torus", "cube", "cone", "cylinder")[rng.integers(4)], 3)
        centre = np.array([*rng.uniform(-0.12, 0.12, 2), -0.28])
        solid = (0.2 * vertices / np.abs(vertices).max() + centre, faces)
        camera_position = np.array([rng.uniform(-0.35, 0.35), -1.75, rng.uniform(0.2, 0.6)])
        lights = draw_lights(LightLaw(count=(1, 1)), rng, "box")
        return (
            Plan("box", "mirrors", False, walls, [in_place("object", solid, material(colours[4]))], lights,
                 [camera(camera_position, (0.0, 0.0, -0.1), 40.0)]),
            [solid],
        )  # fmt: skip

    def notes(self, config: BouncesConfig) -> list[str]:
        return [
            "A box with an object: first the back wall, then the right and the left one become mirrors (specular 0.95, "
            f"roughness {config.roughness:g}). One mirror shows things over one bounce, two in a corner over two, the facing "
            "ones of three over many."
        ]


PROBES: tuple[type[Probe], ...] = (Occluders, Bounces)
