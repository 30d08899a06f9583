"""A system for tests: a made-up ball in place of capture, atlas and fit, then the real stages bake and evaluate."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image

from model.neuras.baked import Baked
from pipeline.config import StageConfig
from pipeline.stage import Item, MapStage, RunStage, System
from stages.graphics.arrays import pack_json
from stages.neuras.evaluation.renderers import Reference, as_bytes
from stages.neuras.records import CaptureInfo, FrameRecord, save
from stages.neuras.surfaces.photometric import moved
from tests.neuras import scenes

PLACES = {  # split, shift and camera position, along an arc around the ball
    "frame-drive_00": ("train", 0.0, (5.0, 0.0, 2.0)),
    "frame-drive_01": ("test", 0.0, (4.9, 0.5, 2.0)),
    "frame-drive_02": ("train", 0.0, (4.8, 1.0, 2.0)),
    "frame-drive_03": ("test", 0.0, (4.6, 1.5, 2.0)),
    "frame-drive_04": ("train", 0.0, (4.3, 2.0, 2.0)),
    "frame-left_2m_00": ("shift", -2.0, (4.9, 0.5, 3.0)),
    "frame-left_2m_01": ("shift", -2.0, (4.6, 1.5, 3.0)),
    "frame-right_2m_00": ("shift", 2.0, (4.9, 0.5, 1.0)),
}
INFO = CaptureInfo("metre", 1.0, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 5.0, "none", "every other frame is held out")


def truth() -> Reference:
    flat = scenes.atlas()
    return Reference(scenes.baked(flat), flat)


class CaptureConfig(StageConfig):
    masked: bool = False  # the upper half of every frame does not count, and is white
    beside: bool = False  # nor does the left half of the second frame
    gain: float = 1.0  # of the photos' colours
    turned: float = 0.0  # radians that the held-out frames' poses are off


class Capture(MapStage):
    name, version, Config = "capture", 1, CaptureConfig

    def items(self, config, inputs):
        return [Item(id, split, needs=()) for id, (split, _, _) in PLACES.items()]

    def open(self, config, inputs, environment):
        return config, truth()

    def process(self, worker, item):
        config, scene = worker
        split, shift, position = PLACES[item.id]
        camera = scenes.looking_at(position, size=(96, 64))
        picture, mask = as_bytes(config.gain * scene.render(camera)), None
        if config.masked:
            picture[:32] = 255
            mask = encoded(np.repeat(np.arange(64)[:, None] >= 32, 96, axis=1).astype(np.uint8) * 255)
        if config.beside and item.id == "frame-drive_01":
            mask = encoded(np.repeat(np.arange(96)[None] >= 48, 64, axis=0).astype(np.uint8) * 255)
        depth = scene.caster.view(camera).depth
        if split == "test":
            camera = moved(camera, np.array([config.turned, -config.turned, 0, 0, 0, 0]))
        path = "drive" if split != "shift" else f"shift_{shift:+g}m"
        yield FrameRecord(item.id, camera, encoded(picture), split, path, shift, mask=mask, depth=depth).to_record()

    def finish(self, config, inputs, draft):
        (draft.files / "capture.json").write_bytes(pack_json(INFO.to_json()))


class Atlas(RunStage):
    name, version, Config = "atlas", 1, StageConfig

    def run(self, config, inputs, draft):
        save(draft.files / "atlas.npz", scenes.atlas())
        return ["atlas.npz"]


class FitConfig(StageConfig):
    error: float = 0.02  # added to the codes, sigma


class Fit(RunStage):
    name, version, inputs, Config = "fit", 1, ("atlas",), FitConfig

    def run(self, config, inputs, draft):
        baked = scenes.baked(scenes.atlas())
        noise = np.random.default_rng(1).normal(0, config.error, baked.mesh_codebook.shape).astype(np.float32)
        arrays = {**vars(baked), "mesh_codebook": baked.mesh_codebook + noise}
        Baked(**arrays).save(draft.files)
        return ["model.safetensors", "model.json"]


def encoded(pixels: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    return buffer.getvalue()


SYSTEM = System(
    name="ball",
    modules={
        "capture": "tests.neuras.line:Capture",
        "atlas": "tests.neuras.line:Atlas",
        "fit": "tests.neuras.line:Fit",
        "bake": "stages.neuras.s05_bake:Bake",
        "evaluate": "stages.neuras.s06_evaluate:Evaluate",
    },
)
