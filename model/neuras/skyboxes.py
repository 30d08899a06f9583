"""Nested cuboids around the scene that carry what the mesh does not: the skyboxes (section 3.1).

A skybox is an axis-aligned cuboid of six square maps of S x S texels. Its faces are numbered

====  ====  ===========  ===========
face  side  a (columns)  b (rows)
====  ====  ===========  ===========
0, 1  +x -x  y            z
2, 3  +y -y  x            z
4, 5  +z -z  x            y
====  ====  ===========  ===========

so face = 2 axis + (1 on the negative side), and the two other axes, in their order, run along columns and rows, on both sides
alike. A point p on the face, measured from the cuboid's centre, has texture coordinates u = (p_a / h_a + 1) / 2 and
v = (p_b / h_b + 1) / 2 with the half size h. Texel [row, column] has its centre at ((column + 0.5) / S, (row + 0.5) / S).
Sampling is bilinear within a face and clamped at its border (GL_CLAMP_TO_EDGE): faces do not mix, so a shader needs nothing but
a texture array of 6 L layers, layer = 6 skybox + face.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

OTHER_AXES = ((1, 2), (0, 2), (0, 1))  # of a face across axis 0, 1, 2: what runs along columns and along rows


def half_sizes(inner: np.ndarray, nearest: float, farthest: float, layers: int) -> np.ndarray:
    """(L, 3) float64 half sizes of the cuboids, near to far, in geometric progression from ``nearest`` to ``farthest``.

    ``inner``: (3,) half sizes of the cuboid that holds the mesh and the cameras. No skybox is smaller along any axis,
    because a ray must hit from inside; where the inner cuboid is longer than ``nearest``, all of them stretch.
    """
    growth = np.geomspace(1.0, farthest / nearest, layers) if layers > 1 else np.ones(layers)
    return growth[:, None] * np.maximum(nearest, np.asarray(inner, float))[None, :]


def intersect(origins: Tensor, directions: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays from inside leave the cuboid. ``origins``: (N, 3) or (3,) from its centre; ``half``: (3,).

    Returns face (N,) int64 and uv (N, 2) in [0, 1]. Where two axes tie, the lower one counts.
    """
    sign = torch.where(directions < 0, -1.0, 1.0)
    tiny = torch.full_like(directions, 1e-12)
    steps = (sign * half - origins) / torch.where(directions.abs() < 1e-12, sign * tiny, directions)
    distance, axis = steps.min(dim=1)
    lowest = torch.zeros_like(axis)
    for k in (2, 1, 0):
        lowest = torch.where(steps[:, k] == distance, k, lowest)
    axis = lowest
    scaled = (origins + distance[:, None] * directions) / half
    others = torch.tensor(OTHER_AXES, device=axis.device)[axis]
    uv = (scaled.gather(1, others) + 1) / 2
    negative = directions.gather(1, axis[:, None])[:, 0] < 0
    return 2 * axis + negative, uv.clamp(0, 1)
