"""Triangles, gathered by material: quads, boxes, tubes and lofts in a local frame, with texture coordinates in metres.

``Shapes.at`` gives the same collection in another frame, so a window, a car or a house is written once, around its own origin:
x along, y deep, z up.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np

# Corners of a unit box's six faces, counter-clockwise from outside: -x +x -y +y -z +z.
_BOX = np.array(
    [
        [[0, 1, 0], [0, 0, 0], [0, 0, 1], [0, 1, 1]],
        [[1, 0, 0], [1, 1, 0], [1, 1, 1], [1, 0, 1]],
        [[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]],
        [[1, 1, 0], [0, 1, 0], [0, 1, 1], [1, 1, 1]],
        [[0, 1, 0], [1, 1, 0], [1, 0, 0], [0, 0, 0]],
        [[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]],
    ],
    float,
)
_BOX_AXES = np.array([[1, 2], [1, 2], [0, 2], [0, 2], [0, 1], [0, 1]])  # that u and v of each face run along


@dataclass
class Soup:
    """Quads and triangles of one material, world frame."""

    vertices: list[np.ndarray] = field(default_factory=list)
    uvs: list[np.ndarray] = field(default_factory=list)
    faces: list[np.ndarray] = field(default_factory=list)
    count: int = 0

    def add(self, vertices: np.ndarray, uvs: np.ndarray, faces: np.ndarray) -> None:
        self.vertices.append(vertices)
        self.uvs.append(uvs)
        self.faces.append(faces + self.count)
        self.count += len(vertices)

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(V, 3) float32 vertices, (F, 3) int32 faces, (V, 2) float32 uvs."""
        vertices, uvs, faces = (np.concatenate(part) for part in (self.vertices, self.uvs, self.faces))
        return vertices.astype(np.float32), faces.astype(np.int32), uvs.astype(np.float32)


class Shapes:
    """Adds shapes to the soups, seen from a frame: a turn ``yaw`` about z, then a shift to ``origin``, world."""

    def __init__(self, soups: dict[str, Soup] | None = None, origin: tuple[float, float, float] = (0, 0, 0), yaw: float = 0.0):
        self.soups = defaultdict(Soup) if soups is None else soups
        self.origin, self.yaw = np.asarray(origin, float), yaw
        c, s = np.cos(yaw), np.sin(yaw)
        self._turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])  # for row vectors

    def at(self, x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> Shapes:
        """The frame at (x, y, z) of this one, turned by ``yaw`` radians."""
        return Shapes(self.soups, tuple(self.world(np.array([x, y, z], float))), self.yaw + yaw)

    def world(self, points: np.ndarray) -> np.ndarray:
        return np.asarray(points, float) @ self._turn + self.origin

    def mesh(self, material: str, vertices: np.ndarray, faces: np.ndarray, uvs: np.ndarray) -> None:
        self.soups[material].add(self.world(vertices), np.asarray(uvs, float), np.asarray(faces))

    def quads(self, material: str, corners: np.ndarray, uvs: np.ndarray) -> None:
        """``corners`` (N, 4, 3) counter-clockwise; ``uvs`` (N, 4, 2)."""
        corners = np.asarray(corners, float).reshape(-1, 4, 3)
        base = 4 * np.arange(len(corners))[:, None]
        faces = np.concatenate([base + [0, 1, 2], base + [0, 2, 3]])
        self.mesh(material, corners.reshape(-1, 3), faces, np.asarray(uvs, float).reshape(-1, 2))

    def pictures(self, material: str, corners: np.ndarray, cells: np.ndarray) -> None:
        """Quads that show ``cells`` (N, 4) of an atlas: u0, v0, u1, v1.

        Corners start at the viewer's lower right and go clockwise, as x runs to the left of who looks at a facade.
        """
        u0, v0, u1, v1 = np.asarray(cells, float).reshape(-1, 4).T
        self.quads(
            material, corners, np.stack([np.stack(pair, -1) for pair in ((u1, v1), (u0, v1), (u0, v0), (u1, v0))], axis=1)
        )

    def boxes(self, material: str, low: np.ndarray, high: np.ndarray, metres: float = 1.0) -> None:
        """Boxes from ``low`` (N, 3) to ``high`` (N, 3); the texture repeats every ``metres``."""
        low, high = np.broadcast_arrays(np.atleast_2d(np.asarray(low, float)), np.atleast_2d(np.asarray(high, float)))
        corners = low[:, None, None] + _BOX * (high - low)[:, None, None]
        axes = np.broadcast_to(_BOX_AXES[None, :, None, :], (len(low), 6, 4, 2))
        uvs = np.take_along_axis(corners, axes, axis=3) / metres * [1, -1] + 0.37 * low[:, None, None, :2]
        self.quads(material, corners, uvs)

    def box(self, material: str, x0: float, y0: float, z0: float, x1: float, y1: float, z1: float, metres: float = 1.0) -> None:
        self.boxes(material, [[x0, y0, z0]], [[x1, y1, z1]], metres)

    def floor(
        self, material: str, x0: float, y0: float, x1: float, y1: float, z: float, metres: float, step: float = 4.0
    ) -> None:
        """A level rectangle, in squares of about ``step``."""
        xs = np.linspace(x0, x1, max(1, int(np.ceil((x1 - x0) / step))) + 1)
        ys = np.linspace(y0, y1, max(1, int(np.ceil((y1 - y0) / step))) + 1)
        self.sheet(material, xs, ys, lambda x, y: np.stack([x, y, np.full_like(x, z)], -1), metres, flip=-1)

    def sheet(self, material, xs, ys, place, metres, keep=None, flip=-1) -> None:  # noqa: ANN001
        """A grid of cells over ``xs`` and ``ys``; ``place(x, y)`` says where a corner lies; ``keep`` (X-1, Y-1) bool."""
        x0, y0 = np.meshgrid(xs[:-1], ys[:-1], indexing="ij")
        x1, y1 = np.meshgrid(xs[1:], ys[1:], indexing="ij")
        keep = np.ones(x0.shape, bool) if keep is None else keep
        x0, y0, x1, y1 = x0[keep], y0[keep], x1[keep], y1[keep]
        corners = np.stack([place(x0, y0), place(x1, y0), place(x1, y1), place(x0, y1)], axis=1)
        flat = np.stack([np.stack(pair, -1) for pair in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))], axis=1)
        self.quads(material, corners, flat / metres * [1, flip])

    def tube(
        self, material: str, start: np.ndarray, end: np.ndarray, radii: tuple[float, float], sides: int = 8, metres: float = 1.0
    ) -> None:
        """A cone's trunk from ``start`` to ``end`` with a lid at its end."""
        start, end = np.asarray(start, float), np.asarray(end, float)
        axis = (end - start) / np.linalg.norm(end - start)
        across = np.cross(axis, [1, 0, 0] if abs(axis[0]) < 0.9 else [0, 1, 0])
        across /= np.linalg.norm(across)
        angle = np.linspace(0, 2 * np.pi, sides + 1)
        circle = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * np.cross(axis, across)
        low, high = start + circle * radii[0], end + circle * radii[1]
        corners = np.stack([low[:-1], low[1:], high[1:], high[:-1]], axis=1)
        u = angle * max(radii) / metres
        v = np.array([0, -np.linalg.norm(end - start) / metres])
        uvs = np.stack(
            [
                np.stack(np.broadcast_arrays(a, b), -1)
                for a, b in ((u[:-1], v[0]), (u[1:], v[0]), (u[1:], v[1]), (u[:-1], v[1]))
            ],
            axis=1,
        )
        self.quads(material, corners, uvs)
        lid = np.concatenate([high[:-1], end[None]])
        fan = np.stack([np.arange(sides), (np.arange(sides) + 1) % sides, np.full(sides, sides)], axis=1)
        self.mesh(material, lid, fan, (lid - end) @ np.stack([across, np.cross(axis, across)], 1) / metres)

    def loft(self, material: str, sections: np.ndarray, metres: float = 1.0, lids: bool = True) -> None:
        """A skin over ``sections`` (N, K, 3), each an open or closed outline of K points."""
        sections = np.asarray(sections, float)
        a, b = sections[:-1, :-1], sections[1:, :-1]
        c, d = sections[1:, 1:], sections[:-1, 1:]
        corners = np.stack([a, b, c, d], axis=2).reshape(-1, 4, 3)
        self.quads(material, corners, corners[..., [0, 2]] / metres + corners[..., [1, 1]] * 0.3)
        if lids:
            for outline in (sections[0], sections[-1]):
                points = np.concatenate([outline, outline.mean(axis=0)[None]])
                k = len(outline)
                fan = np.stack([np.arange(k), (np.arange(k) + 1) % k, np.full(k, k)], axis=1)
                self.mesh(material, points, fan, points[:, [1, 2]] / metres)

    def cards(
        self, material: str, centres: np.ndarray, normals: np.ndarray, sizes: np.ndarray, spin: np.ndarray, spots: np.ndarray
    ) -> None:
        """Leaves: kites about ``centres`` (N, 3), each showing one spot (N, 2) of the texture."""
        axis = np.cross(normals, np.stack([np.cos(spin), np.sin(spin), np.zeros_like(spin)], -1))
        axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-9)
        other = np.cross(normals, axis)
        long, wide = axis * sizes[:, None], other * sizes[:, None] * 0.55
        corners = np.stack([centres - long, centres + wide - 0.2 * long, centres + long, centres - wide - 0.2 * long], axis=1)
        self.quads(material, corners, spots[:, None] + np.array([[0, 0], [0.01, 0], [0.01, 0.01], [0, 0.01]]))
