"""Contact sheets: small shaded pictures of meshes in a grid, drawn with numpy alone.

An orthographic z-buffer over points spread on the triangles: no GL, no window, the same bytes everywhere.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.geometry import measure

TILE = 128  # pixels
ANGLES = (0.6, 0.45)  # turn about z, then tilt, radians


def picture(vertices: np.ndarray, faces: np.ndarray, tile: int = TILE) -> np.ndarray:
    """(tile, tile, 3) uint8, flat shading by the face normal; flipped faces are red. z up."""
    turn, tilt = ANGLES
    rotation = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]]) @ np.array(
        [[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]]
    )  # camera looks along +y: x right, z up
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    points = ((vertices - (low + high) / 2) / max(float(np.linalg.norm(high - low)), 1e-9)) @ rotation.T
    scale = tile * 0.96
    vectors = measure.face_vectors(points, faces)
    areas = np.linalg.norm(vectors, axis=1) / 2 * scale * scale  # in pixels
    total = int(np.clip(6 * areas.sum(), 20000, 200000))
    at, normals = measure.sample(points, faces, total)
    column = np.clip((at[:, 0] * scale + tile / 2).astype(int), 0, tile - 1)
    row = np.clip((tile / 2 - at[:, 2] * scale).astype(int), 0, tile - 1)
    pixel = row * tile + column
    order = np.lexsort((at[:, 1], pixel))  # nearest first within a pixel
    first = order[np.concatenate([[True], np.diff(pixel[order]) > 0])]
    image = np.full((tile * tile, 3), 255.0)
    light = np.array([-0.4, -0.75, 0.55]) / np.linalg.norm([-0.4, -0.75, 0.55])
    shade = 60 + 190 * np.clip(normals[first] @ light, 0, 1)
    back = normals[first, 1] > 0.2
    image[pixel[first]] = np.where(back[:, None], np.array([200.0, 40, 40]), shade[:, None] * np.array([0.85, 0.92, 1.0]))
    return image.reshape(tile, tile, 3).astype(np.uint8)


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
