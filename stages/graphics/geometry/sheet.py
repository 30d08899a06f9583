"""Contact sheets: small shaded pictures of meshes in a grid.

Orthographic rays from above, four per pixel: no GL, no window.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from stages.graphics.geometry import measure

TILE = 128  # pixels
ANGLES = (-0.6, 0.45)  # about z, then about x, radians
LIGHT = np.array([-0.4, -0.75, 0.55]) / np.linalg.norm([-0.4, -0.75, 0.55])  # towards it; the camera looks along +y, z up


def picture(vertices: np.ndarray, faces: np.ndarray, tile: int = TILE) -> np.ndarray:
    """(tile, tile, 3) uint8, flat shading by the face normal; where the back of a face shows, red. z up."""
    rotation = Rotation.from_euler("zx", ANGLES).as_matrix()
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    points = ((vertices - (low + high) / 2) / max(float(np.linalg.norm(high - low)), 1e-9)) @ rotation.T
    fine = 2 * tile
    at = ((np.arange(fine) + 0.5) / fine - 0.5) / 0.96
    origins = np.stack(np.broadcast_arrays(at[None, :], -1.0, -at[:, None]), axis=-1).reshape(-1, 3)
    first = measure.embree_scene(points, faces).run(
        origins.astype(np.float32), np.broadcast_to(np.float32([0, 1, 0]), origins.shape).copy()
    )
    vectors = measure.face_vectors(points, faces)
    normals = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)
    colours = (60 + 190 * np.clip(normals @ LIGHT, 0, 1))[:, None] * np.array([0.85, 0.92, 1.0])
    colours[normals[:, 1] > 0] = (200, 40, 40)
    image = np.where((first >= 0)[:, None], colours[first], 255.0)
    return image.reshape(tile, 2, tile, 2, 3).mean(axis=(1, 3)).astype(np.uint8)


def write_sheet(path: Path, rows: list[tuple[str, list[tuple[np.ndarray, np.ndarray] | None]]], columns: int = 1) -> None:
    """A PNG: one row of pictures per object, its name below, ``columns`` objects side by side."""
    from PIL import Image, ImageDraw

    if not rows:
        return
    wide = max(len(meshes) for _, meshes in rows)
    lines = -(-len(rows) // columns)
    canvas = Image.new("RGB", (columns * (wide * TILE + 12), lines * (TILE + 14)), "white")
    draw = ImageDraw.Draw(canvas)
    for index, (name, meshes) in enumerate(rows):
        x, y = (index % columns) * (wide * TILE + 12), (index // columns) * (TILE + 14)
        for number, mesh in enumerate(meshes):
            if mesh is not None:
                canvas.paste(Image.fromarray(picture(*mesh)), (x + number * TILE, y))
        draw.text((x + 4, y + TILE), name, fill="black")
    canvas.save(path)
