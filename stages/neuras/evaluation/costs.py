"""What a baked scene costs: time of a frame, memory on the device, bytes on disk.

The neural shader's time means little without the machine's, so it is told as a ratio: a plain textured mesh, drawn by the same
engine at the same size, is 1.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from model.neuras.baked import Baked
from stages.graphics.cameras import Camera
from stages.neuras.baking import site
from stages.neuras.baking.drawing import Drawing
from stages.neuras.baking.shaders import textures
from stages.neuras.evaluation.paths import framed
from stages.neuras.evaluation.renderers import Scene

HALF = 2  # bytes of a half float


def plain(scene: Scene) -> Scene:
    """The same mesh with one 8-bit colour texture as large as the finest level, one sample a pixel, and one skybox of the same
    side: no network.
    """
    baked = scene.baked
    finest = baked.mesh_texture()[: baked.pyramid.height, : baked.pyramid.width, :3]
    side = baked.sky_size[1]
    colours = Baked(
        mesh_mlp=[],
        sky_mlp=[],
        sky_opacity=(np.zeros((1, 3), np.float32), np.full(1, 20, np.float32)),  # opaque
        sky_centre=baked.sky_centre,
        sky_half_sizes=baked.sky_half_sizes[-1:],
        view_dependent=False,
        rays=baked.rays,
        mesh_features=np.clip(finest, 0, 1).astype(np.float16),
        sky_features=np.zeros((1, 6, side, side, 3), np.float16),
    )
    return Scene(colours, scene.atlas, scene.info, scene.planes)


def frame_times(drawing: Drawing, cameras: Sequence[Camera]) -> list[float]:
    """Milliseconds that each camera's picture takes the second time: the first time files of residuals are read."""
    times = []
    for camera in cameras:
        for _ in range(2):
            began = time.perf_counter()
            drawing.draw(camera)
            drawing.finish()
        times.append(1000 * (time.perf_counter() - began))
    return times


def time_shader(scene: Scene, cameras: Sequence[Camera], size: tuple[int, int]) -> dict[str, Any]:
    """Times of the neural shader and of a plain textured mesh, at ``size``, and their ratio."""
    shown = [framed(camera, *size) for camera in cameras]
    with scene.drawing() as drawing:
        neural = frame_times(drawing, shown)
    with plain(scene).drawing("rgba8") as drawing:
        textured = frame_times(drawing, shown)
    medians = [statistics.median(times) for times in (neural, textured)]
    return {
        "size": list(size),
        "neural_ms": [round(value, 3) for value in neural],
        "plain_ms": [round(value, 3) for value in textured],
        "neural_fps": round(1000 / medians[0], 3),
        "plain_fps": round(1000 / medians[1], 3),
        "ratio": round(medians[0] / medians[1], 3),
    }


def device_bytes(scene: Scene) -> dict[str, int]:
    """Bytes on the device with half-float and with 8-bit textures, of vertices and faces, and of residuals."""
    baked, atlas = scene.baked, scene.atlas
    (height, width), (layers, side) = baked.mesh_size, baked.sky_size
    texels = (height * width + 6 * layers * side * side) * 4 * textures(baked.channels)
    geometry = atlas.vertices.nbytes + atlas.uvs.nbytes + atlas.faces.nbytes
    residuals = 0 if scene.residuals is None else scene.residuals.device_bytes
    return {"fp16": HALF * texels, "rgba8": texels, "geometry": geometry, "residuals": residuals}


def storage(folder: Path, baked: Baked) -> dict[str, Any]:
    """Bytes of the site's kinds of files, of the scene as it is stored, and of the same features without codes.

    The photos and the page itself are no part of the scene. ``without_codes``: every texel's features as half floats.
    """
    kinds = site.sizes(folder)
    scene = kinds["geometry"] + kinds["textures"] + kinds["shaders"] + kinds["residuals"]
    (height, width), (layers, side) = baked.mesh_size, baked.sky_size
    features = HALF * baked.channels * (height * width + 6 * layers * side * side)
    return {
        "kinds": kinds,
        "quantized": baked.quantized,
        "stored": scene,
        "without_codes": scene - kinds["textures"] + features,
    }
