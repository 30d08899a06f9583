"""Sweeps over one setting of the test scenes: lights, cameras, triangles, textures (paper, figures 9 to 13 and 16)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal

import numpy as np
from pydantic import field_validator

from pipeline.config import count
from stages.renderformer.probes import edits
from stages.renderformer.probes.probe import Predict, Probe, ProbeConfig, Sweep, Worker
from stages.renderformer.records import SceneRecord
from stages.renderformer.scenes.laws import CameraLaw, LightLaw

Values = tuple[float, ...]
Methods = Mapping[str, Callable[[], np.ndarray]]


def at_least(least: float, most: float = np.inf, whole: bool = False) -> Callable[[Values], Values]:
    """A check of values."""

    def check(values: Values) -> Values:
        if not values or any(not least <= value <= most or (whole and value != int(value)) for value in values):
            kind = "whole numbers" if whole else "numbers"
            raise ValueError(f"expected {kind} from {least:g}" + ("" if most == np.inf else f" to {most:g}"))
        if len(set(values)) < len(values):
            raise ValueError("a value is given twice")
        return values

    return check


# --- lights -----------------------------------------------------------------------------------------------------------


class LightsConfig(ProbeConfig):
    name: Literal["lights"] = "lights"
    values: Values = count((1, 2, 4, 8, 12, 16))  # beyond 8: more than in training

    _values = field_validator("values")(at_least(1, edits.MOST_LIGHTS, whole=True))


class Lights(Sweep):
    name = "lights"
    title = "One to many lights, and compositing"
    question = (
        "Does the network hold with more lights than it was trained with, and does it help to predict each alone and add?"
    )
    setting = "lights"
    Config = LightsConfig

    def edit(self, worker: Worker, scene: SceneRecord, value: float) -> SceneRecord:
        return edits.draw_nested_lights(scene, int(value), worker.rng("lights", scene.id))

    def methods(self, worker: Worker, predict: Predict, scene: SceneRecord) -> Methods:
        from stages.renderformer.inference.predict import light_passes, single_lights

        return {
            "all at once": lambda: predict(scene),
            "sum of single lights": lambda: sum(predict(alone) for alone in single_lights(scene)),
            # a light of N emits 1/N of what a single one does in training: expose it like that, and take it back
            "sum, each exposed as in training": lambda: sum(share * predict(alone) for alone, share in light_passes(scene)),
        }

    def trained(self, trained_with: Mapping[str, str]) -> tuple[float, float]:
        return LightLaw().count

    def notes(self, config: LightsConfig) -> list[str]:
        return [
            "N lights are the first N of 16 drawn by the released law, each with 1/N of its radiance. Light transport is "
            "linear: the sum over single lights is exact for a renderer. Shaded: the released law's numbers of lights."
        ]


class ColouredLightConfig(ProbeConfig):
    name: Literal["coloured_light"] = "coloured_light"
    values: Values = count((0, 0.25, 0.5, 0.75, 1))

    _values = field_validator("values")(at_least(0, 1))


class ColouredLight(Sweep):
    name = "coloured_light"
    title = "Coloured light, by blending channels"
    question = "The released lights are white: is coloured light predicted better channel by channel, each under white light?"
    setting = "saturation of the lights"
    Config = ColouredLightConfig

    def edit(self, worker: Worker, scene: SceneRecord, value: float) -> SceneRecord:
        hue = worker.rng("coloured_light", scene.id).uniform(size=(scene.n_lights, 3))
        return edits.tinted(scene, 1 + value * (hue / hue.max(axis=1, keepdims=True) - 1))

    def methods(self, worker: Worker, predict: Predict, scene: SceneRecord) -> Methods:
        def blended() -> np.ndarray:
            return np.stack([predict(edits.channel_light(scene, c))[..., c] for c in range(3)], axis=-1)

        return {"directly": lambda: predict(scene), "channel by channel": blended}

    def trained(self, trained_with: Mapping[str, str]) -> tuple[float, float]:
        return (-0.01, 0.01)

    def notes(self, config: ColouredLightConfig) -> list[str]:
        return ["Every light has a hue of its own; saturation 0 is white. Shaded: the released law has white lights only."]


class LightsInsideConfig(ProbeConfig):
    name: Literal["lights_inside"] = "lights_inside"
    values: Values = count((2.4, 1.6, 1.2, 0.8, 0.5, 0.3))

    _values = field_validator("values")(at_least(0.01))


class LightsInside(Sweep):
    name = "lights_inside"
    title = "Lights inside the scene"
    question = "Training lights are outside: what happens as they come nearer and enter the scene?"
    setting = "distance of the lights from the centre, scene units"
    Config = LightsInsideConfig

    def edit(self, worker: Worker, scene: SceneRecord, value: float) -> SceneRecord:
        return edits.lights_at(scene, value)

    def trained(self, trained_with: Mapping[str, str]) -> tuple[float, float]:
        return LightLaw().distance

    def notes(self, config: LightsInsideConfig) -> list[str]:
        return [
            "Lights keep their size, and dim by the square of the distance, so that the centre gets the same light. The "
            "content lies within 0.5 of the centre along each axis. Shaded: the released law's distances."
        ]


class LargeLightConfig(ProbeConfig):
    name: Literal["large_light"] = "large_light"
    values: Values = count((1, 2, 4, 8))
    divisions: tuple[int, ...] = (1, 2)  # how many times over each triangle is cut into four, one method each

    _values = field_validator("values")(at_least(0.1))

    @field_validator("divisions")
    @classmethod
    def _few(cls, divisions: tuple[int, ...]) -> tuple[int, ...]:
        if any(not 1 <= times <= 4 for times in divisions):
            raise ValueError("expected numbers from 1 to 4")
        return divisions


class LargeLight(Sweep):
    name = "large_light"
    title = "Large lights, subdivided"
    question = "Training lights are small: are large ones predicted better when cut into smaller triangles?"
    setting = "edge of the lights, as sampled = 1"
    Config = LargeLightConfig
    axis = "log"

    def edit(self, worker: Worker, scene: SceneRecord, value: float) -> SceneRecord:
        return edits.larger_lights(scene, value)

    def methods(self, worker: Worker, predict: Predict, scene: SceneRecord) -> Methods:
        cut = {
            f"{4**times} triangles each": lambda times=times: predict(edits.subdivided_lights(scene, times))
            for times in worker.config.divisions
        }
        return {"whole": lambda: predict(scene), **cut}

    def trained(self, trained_with: Mapping[str, str]) -> tuple[float, float]:
        return (0.8, 1.25)  # 2.0 to 2.5, whichever the light had

    def notes(self, config: LargeLightConfig) -> list[str]:
        return [
            "A light keeps its power as it grows; the pieces are the same light. Shaded: sizes that the released law draws."
        ]


# --- cameras and pictures ---------------------------------------------------------------------------------------------


class CameraConfig(ProbeConfig):
    name: Literal["camera"] = "camera"
    values: Values = count((1, 0.8, 0.6, 0.45, 0.3))

    _values = field_validator("values")(at_least(0.01))


class Camera(Sweep):
    name = "camera"
    title = "Closer camera"
    question = "How near may the camera come?"
    setting = "distance of the camera, as sampled = 1"
    Config = CameraConfig

    def edit(self, worker: Worker, scene: SceneRecord, value: float) -> SceneRecord:
        return edits.closer(scene, value)

    def trained(self, trained_with: Mapping[str, str]) -> tuple[float, float]:
        near, far = CameraLaw().distance
        return (near / far, far / near)

    def notes(self, config: CameraConfig) -> list[str]:
        return [
            "The camera goes straight ahead. Shaded: factors that a sampled camera may have and still lie in the released law."
        ]


class FovConfig(ProbeConfig):
    name: Literal["fov"] = "fov"
    values: Values = count((30, 45, 60, 75, 90, 110))

    _values = field_validator("values")(at_least(1, 170))


class Fov(Sweep):
    name = "fov"
    title = "Wider field of view"
    question = "What happens beyond the angles of training?"
    setting = "field of view, degrees"
    Config = FovConfig

    def edit(self, worker: Worker, scene: SceneRecord, value: float) -> SceneRecord:
        return edits.with_fov(scene, value)

    def trained(self, trained_with: Mapping[str, str]) -> tuple[float, float]:
        return CameraLaw().fov_deg

    def notes(self, config: FovConfig) -> list[str]:
        return ["A wider view shows more black around the scene: see the error on surfaces. Shaded: the released law's angles."]


class ResolutionConfig(ProbeConfig):
    name: Literal["resolution"] = "resolution"
    scenes: int = count(6, ge=1)
    values: Values = count((32, 64, 96, 128, 192))

    _values = field_validator("values")(at_least(16, 4096, whole=True))


class Resolution(Sweep):
    name = "resolution"
    title = "Higher resolution"
    question = "Does a network that was trained at one resolution render at others?"
    setting = "pixels per side"
    Config = ResolutionConfig
    axis = "log"

    def edit(self, worker: Worker, scene: SceneRecord, value: float) -> SceneRecord:
        return scene

    def resolution(self, config: ResolutionConfig, value: float) -> int:
        return int(value)

    def scope(self, config: ResolutionConfig) -> str:
        return f"{config.split} scene(s), one view each"

    def trained(self, trained_with: Mapping[str, str]) -> tuple[float, float] | None:
        side = float(trained_with["resolution"]) if "resolution" in trained_with else None
        return None if side is None else (side * 0.95, side * 1.05)

    def notes(self, config: ResolutionConfig) -> list[str]:
        return [
            "Each picture is measured against a reference of its own resolution; SSIM and FLIP look at neighbourhoods in "
            "pixels, so compare those columns with care."
        ]


# --- triangles --------------------------------------------------------------------------------------------------------


class MoreTrianglesConfig(ProbeConfig):
    name: Literal["more_triangles"] = "more_triangles"
    values: Values = count((1, 1.5, 2, 3, 4, 6))

    _values = field_validator("values")(at_least(1, 64))


class MoreTriangles(Sweep):
    name = "more_triangles"
    title = "More triangles than trained"
    question = "The same scene in more and smaller triangles looks the same: does the network say so?"
    setting = "triangles, as sampled = 1"
    Config = MoreTrianglesConfig
    axis = "log"

    def edit(self, worker: Worker, scene: SceneRecord, value: float) -> SceneRecord:
        return edits.bisected(scene, round(value * len(scene.triangles)))

    def notes(self, config: MoreTrianglesConfig) -> list[str]:
        return [
            "The largest triangle is cut at the middle of its longest edge until there are so many: surfaces, materials and "
            "lights stay, and with them the image."
        ]


class TriangleSizeConfig(ProbeConfig):
    name: Literal["triangle_size"] = "triangle_size"
    values: Values = count((64, 128, 256, 512, 1024))  # face budgets of the decimated ladder

    _values = field_validator("values")(at_least(1, whole=True))


class TriangleSize(Sweep):
    name = "triangle_size"
    title = "Triangle size"
    question = "The same objects in fewer, larger or in more, smaller triangles: what is predicted best?"
    setting = "faces per object, at most"
    Config = TriangleSizeConfig
    reads = ("decimate", "shard", "train")
    axis = "log"

    def suits(self, meta: Mapping[str, Any]) -> bool:
        return any("object_id" in entry for entry in meta["objects"])

    def edit(self, worker: Worker, scene: SceneRecord, value: float) -> SceneRecord:
        from stages.renderformer.objects.rungs import load_rungs

        ladders = worker.inputs["decimate"]
        for entry in scene.meta["objects"]:
            if "object_id" not in entry:
                continue
            rungs = load_rungs(ladders.read(entry["object_id"]))
            budget = max((budget for budget in rungs if budget <= value), default=min(rungs))
            scene = edits.with_rung(scene, entry["name"], rungs[int(entry["rung"])], rungs[budget])
        return scene

    def notes(self, config: TriangleSizeConfig) -> list[str]:
        return [
            "Every object is shown by the largest mesh of its ladder with at most so many faces (the smallest, where there is "
            "none), in its place, in its mean colour; walls stay. The reference is of the same mesh."
        ]


# --- textures ---------------------------------------------------------------------------------------------------------


class TexturesConfig(ProbeConfig):
    name: Literal["textures"] = "textures"
    values: Values = count((0.5, 1, 2, 4))

    _values = field_validator("values")(at_least(0.01, 64))


class Textures(Sweep):
    name = "textures"
    title = "Textures"
    question = "Does the network read the patches of textured triangles, and how fine may the pattern be?"
    setting = "repeats of the pattern per object"
    Config = TexturesConfig
    axis = "log"

    def edit(self, worker: Worker, scene: SceneRecord, value: float) -> SceneRecord:
        return edits.patterned(scene, value, worker.rng("textures", scene.id))

    def methods(self, worker: Worker, predict: Predict, scene: SceneRecord) -> Methods:
        return {
            "patches": lambda: predict(scene),
            "mean colour of each triangle": lambda: predict(edits.without_textures(scene)),
        }

    def notes(self, config: TexturesConfig) -> list[str]:
        return [
            "Walls and objects carry patterns made by code as 32 x 32 patches. A network with texture_encode_patch_size=1 "
            "reads only the mean of a patch: then both methods are the same."
        ]


PROBES: tuple[type[Probe], ...] = (
    Lights, ColouredLight, LightsInside, LargeLight, Camera, Fov, Resolution, MoreTriangles, TriangleSize, Textures,
)  # fmt: skip
