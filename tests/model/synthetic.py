"""Made-up batches for tests and benchmarks of the network: random triangles whose image is a simple function of them."""

from __future__ import annotations

from typing import Any

import numpy as np

from stages.renderformer.records import SceneRecord


def batch(
    step: int,
    scenes: int = 2,
    triangles: int = 12,
    views: int = 2,
    resolution: int = 16,
    padded: int = 0,
    textured: bool = False,
) -> dict[str, Any]:
    """A training batch as ``model.renderformer.training.fit`` reads it; a pure function of its arguments."""
    rng = np.random.default_rng(step)

    def uniform(*shape: int, low: float = 0.0, high: float = 1.0) -> np.ndarray:
        return rng.uniform(low, high, shape).astype(np.float32)

    corners = uniform(scenes, triangles, 3, 3, low=-0.5, high=0.5)
    normals = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True) + 1e-9
    emission = np.zeros((scenes, triangles, 3), np.float32)
    emission[:, 0] = uniform(scenes, 1, low=500, high=5000)
    cameras = np.tile(np.eye(4, dtype=np.float32), (scenes, views, 1, 1))
    cameras[:, :, 2, 3] = uniform(scenes, views, low=1.5, high=2.0)
    mask = np.ones((scenes, triangles), bool)
    if padded:
        mask[0, -padded:] = False
    diffuse = uniform(scenes, triangles, 3)
    level = diffuse.mean(axis=1)[:, None, None, None] * emission[:, 0].mean(axis=-1)[:, None, None, None, None] / 1000
    patches = {}
    if textured:  # every third triangle but the light
        index = np.full((scenes, triangles), -1, np.int32)
        index[:, 2::3] = np.arange(index[:, 2::3].size).reshape(scenes, -1)
        i = np.arange(32)
        kept = i[:, None] + i[None, :] <= 32
        patches = {"patch_index": index, "patches": (uniform(int(index.max()) + 1, 7, 32, 32) * kept).astype(np.float16)}
    return patches | {
        "triangles": corners,
        "vertex_normals": np.repeat(normals[:, :, None], 3, axis=2).astype(np.float32),
        "diffuse": diffuse,
        "specular": uniform(scenes, triangles, 3),
        "roughness": uniform(scenes, triangles, low=0.01),
        "emission": emission,
        "mask": mask,
        "camera_to_world": cameras,
        "fov_deg": uniform(scenes, views, low=30, high=60),
        "image": (level * np.ones((scenes, views, resolution, resolution, 1))).astype(np.float32),
        "ids": [f"scene{step}_{i}" for i in range(scenes)],
    }


def flat_scene(triangles: np.ndarray, albedo: float = 0.5) -> SceneRecord:
    """Diffuse flat triangles (N, 3, 3) without lamps, and a camera that looks down at them."""
    corners = np.asarray(triangles, np.float32)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    count = len(corners)
    camera = np.eye(4, dtype=np.float32)
    camera[2, 3] = 2
    grey, black = np.full((count, 3), albedo, np.float32), np.zeros((count, 3), np.float32)
    return SceneRecord(
        "flat", corners, np.repeat(normals[:, None], 3, axis=1).astype(np.float32), grey, black,
        np.ones(count, np.float32), black, np.full(count, -1, np.int16), np.zeros(count, np.int16), camera[None],
        np.array([40], np.float32),
    )  # fmt: skip
