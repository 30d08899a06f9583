"""A small scene for tests: a box with a picture per face, skyboxes and networks of random numbers."""

from __future__ import annotations

import numpy as np
import trimesh

from model.neuras.baked import Baked
from model.neuras.sampling import Pyramid
from model.neuras.skyboxes import half_sizes
from stages.graphics.cameras import Camera
from stages.neuras.records import AtlasMesh, Mesh
from stages.neuras.surfaces import unfold


def atlas(subdivisions: int = 2, centre: tuple[float, float, float] = (0.0, 0.0, 0.0), density: float = 12.0) -> AtlasMesh:
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=2.0)
    mesh = Mesh(np.asarray(ball.vertices + centre, np.float32), np.asarray(ball.faces, np.int32))
    return unfold.pack([unfold.unfold(mesh, np.arange(len(mesh.faces)), density, 2)], 2)


def baked(
    flat: AtlasMesh,
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0),
    quantized: bool = True,
    view_dependent: bool = True,
    networks: bool = True,
    channels: int = 12,
    levels: int = 3,
    seed: int = 0,
) -> Baked:
    """Smooth maps of random codes, so that bilinear samples matter, and networks whose colours stay in range."""
    rng = np.random.default_rng(seed)
    layers, side, hidden, extra = 3, 16, 32, 3 if view_dependent else 0

    def network(*sizes: int):
        pairs = zip(sizes[:-1], sizes[1:], strict=True)
        made = [
            (rng.normal(0, 1.6 / np.sqrt(a), (b, a)).astype(np.float32), rng.normal(0, 0.1, b).astype(np.float32))
            for a, b in pairs
        ]
        made[-1][1][:] = 0.5
        return made

    if networks:
        mesh_mlp = network(channels + extra, hidden, hidden, 3)
        sky_mlp = [*network(channels, hidden), *network(hidden + extra, hidden, 3)]
        opacity = (rng.normal(0, 0.5, (1, hidden)).astype(np.float32), np.array([-0.5], np.float32))
    else:
        mesh_mlp, sky_mlp = [], []
        opacity = (rng.normal(0, 0.5, (1, channels)).astype(np.float32), np.array([-0.5], np.float32))
    maps = {
        "mesh_codebook": rng.normal(0.5, 0.5, (64, channels)).astype(np.float32),
        "sky_codebook": rng.normal(0.5, 0.5, (64, channels)).astype(np.float32),
        "mesh_indices": rng.integers(0, 64, Pyramid(flat.width, flat.height, levels).sheet).astype(np.uint16),
        "sky_indices": rng.integers(0, 64, (layers, 6, side, side)).astype(np.uint16),
    }
    if not quantized:
        maps = {
            "mesh_features": maps["mesh_codebook"][maps["mesh_indices"]].astype(np.float16),
            "sky_features": maps["sky_codebook"][maps["sky_indices"]].astype(np.float16),
        }
    return Baked(
        mesh_mlp=mesh_mlp,
        sky_mlp=sky_mlp,
        sky_opacity=opacity,
        sky_centre=np.array(centre, float),
        sky_half_sizes=half_sizes(np.full(3, 4.0), 20.0, 200.0, layers),
        view_dependent=view_dependent,
        levels=levels,
        **maps,
    )


def looking_at(
    position: tuple[float, float, float], target: tuple[float, float, float] = (0.0, 0.0, 0.0), size=(96, 64)
) -> Camera:
    back = np.array(position, float) - np.array(target, float)
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    pose[:3, 3] = position
    camera = Camera.from_fov(*size, 70, pose)
    return Camera(camera.width, camera.height, camera.fx, camera.fy * 1.05, camera.cx + 3, camera.cy - 2, pose)
