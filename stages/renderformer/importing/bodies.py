"""Objects of an imported scene: their triangles, fewer or more of them than in the file, and what lies at each.

A body remembers the triangles of the file. So a material is looked up there, at the same place or at the nearest one,
whatever became of the triangles since.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from stages.graphics.geometry import decimator
from stages.graphics.geometry.measure import face_normals
from stages.graphics.tonemap import srgb_encode
from stages.renderformer.importing.described import Part, Surface
from stages.renderformer.scenes import meshes
from stages.renderformer.scenes.released import CREASE_DEG, MIN_ROUGHNESS
from stages.renderformer.scenes.textures import barycentric, look_up

GRID = 4, 24  # points per side of a triangle that its material is the mean of: a point per texel within these bounds
CHUNK = 1 << 20  # points looked up at once
DIM = 0.01  # of the brightest of a body: triangles of less emission are taken as surfaces


@dataclass
class Body:
    """One object.

    parts: as in the file, in scene units. triangles, normals: (F, 3, 3), as they are drawn.
    source: (F,) which triangle of the parts together each lies in, and place: (F, 3, 3) barycentric coordinates of its corners
        there. None once it was decimated.
    """

    name: str
    parts: Sequence[Part]
    triangles: np.ndarray
    normals: np.ndarray
    source: np.ndarray | None
    place: np.ndarray = field(repr=False, default=None)

    @classmethod
    def of(cls, name: str, parts: Sequence[Part]) -> Body:
        triangles = np.concatenate([part.corners for part in parts])
        normals = np.concatenate([_normals(part) for part in parts])
        return cls(name, parts, triangles, normals, np.arange(len(triangles)), np.tile(np.eye(3), (len(triangles), 1, 1)))

    @property
    def smooth(self) -> bool:
        """Whether any normal differs from its triangle's own."""
        return bool((np.einsum("fci,fi->fc", self.normals, face_normals(self.triangles)) < 1 - 1e-4).any())

    @property
    def textured(self) -> bool:
        """Whether its material changes within a part."""
        return any(part.tint is not None or part.surface.textures for part in self.parts)

    @property
    def largest(self) -> float:
        """Area of its largest triangle."""
        return float(meshes.areas(self.triangles).max(initial=0.0))

    def subdivide(self) -> None:
        """Every triangle becomes four."""
        self.triangles, self.place = _quartered(self.triangles), _quartered(self.place)
        normals = _quartered(self.normals)
        length = np.linalg.norm(normals, axis=2, keepdims=True)
        self.normals = np.where(length > 1e-6, normals / np.maximum(length, 1e-6), face_normals(self.triangles)[:, None])
        self.source = self.source.repeat(4)

    def decimate(self, budget: int) -> None:
        """At most ``budget`` triangles by edge collapse, where the library gets there."""
        smooth = self.smooth
        points, index = np.unique(self.triangles.reshape(-1, 3), axis=0, return_inverse=True)
        faces = index.reshape(-1, 3)
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        vertices, faces = decimator.collapse(points, faces, budget, "fast_simplification", 0.0)
        triangles = vertices[faces]
        if not len(triangles):
            return
        groups = meshes.shading_groups(vertices, faces, CREASE_DEG) if smooth else np.arange(len(faces))
        self.triangles, self.normals = triangles, meshes.smooth_normals(vertices, faces, groups)
        self.source = None

    def material(self) -> dict[str, np.ndarray]:
        """diffuse, specular, emission (F, 3) and roughness (F,): means over each triangle."""
        points = _points(self._grid()) if self.textured else np.full((1, 3), 1 / 3)
        step = max(CHUNK // len(points), 1)
        chunks = [slice(start, start + step) for start in range(0, len(self.triangles), step)]
        values = np.concatenate([self._means(chunk, points) for chunk in chunks])
        values[:, 9] = np.maximum(values[:, 9], MIN_ROUGHNESS)
        emission = values[:, 6:9]
        emission[emission.max(axis=1, initial=0) < DIM * emission.max(initial=0)] = 0
        return {"diffuse": values[:, :3], "specular": values[:, 3:6], "emission": emission, "roughness": values[:, 9]}

    def _grid(self) -> int:
        """Points per side of a triangle, enough for the finest texture over the whole body."""
        texels = 0.0
        for part in self.parts:
            sizes = [(t.coordinates, t.image.shape[1::-1]) for t in part.surface.textures.values() if t.coordinates in part.uv]
            uv_areas = [np.abs(np.cross(*np.moveaxis(np.diff(part.uv[k] * size, axis=1), 1, 0))).sum() / 2 for k, size in sizes]
            texels += max(uv_areas, default=0.0)
        return int(np.clip(np.ceil(np.sqrt(2 * texels / len(self.triangles))), *GRID))

    def _means(self, rows: slice, points: np.ndarray) -> np.ndarray:
        """(F, 10) of `_look`: means of some triangles over barycentric ``points``."""
        if self.source is not None:
            face, weights = self.source[rows].repeat(len(points)), (points @ self.place[rows]).reshape(-1, 3)
        else:
            face, weights = self._nearest((points @ self.triangles[rows]).reshape(-1, 3))
        return self._look(face, weights).reshape(-1, len(points), 10).mean(axis=1)

    def _nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of (N, 3) points: the triangle of the file nearest to each, and the barycentric coordinates (N, 3) there."""
        import igl

        corners = np.concatenate([part.corners for part in self.parts])
        faces = np.arange(3 * len(corners)).reshape(-1, 3)
        vertices = np.ascontiguousarray(corners.reshape(-1, 3))
        tree = igl.AABB()
        tree.init(vertices, faces)
        _, face, nearest = tree.squared_distance(vertices, faces, np.ascontiguousarray(points))
        face = np.asarray(face).ravel()
        return face, barycentric(nearest, corners[face])

    def _look(self, face: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """(N, 10) diffuse, specular, emission and roughness at places in triangles of the file."""
        out = np.zeros((len(face), 10))
        start = 0
        for part in self.parts:
            here = (face >= start) & (face < start + len(part.corners))
            if here.any():
                out[here] = _look_of(part, face[here] - start, weights[here])
            start += len(part.corners)
        return out


def _points(grid: int) -> np.ndarray:
    """(P, 3) barycentric coordinates of points spread over a triangle, ``grid`` along a side."""
    row, column = np.nonzero(np.add.outer(np.arange(grid), np.arange(grid)) < grid)
    first, second = (column + 1 / 3) / grid, (row + 1 / 3) / grid
    return np.stack([1 - first - second, first, second], axis=1)


def _normals(part: Part) -> np.ndarray:
    """(F, 3, 3) unit normals; a triangle's own where the file has none."""
    flat = np.repeat(face_normals(part.corners)[:, None], 3, axis=1)
    if part.normals is None:
        return flat
    length = np.linalg.norm(part.normals, axis=2, keepdims=True)
    usable = np.isfinite(length) & (length > 1e-12)
    return np.where(usable, part.normals / np.where(usable, length, 1), flat)


def _quartered(values: np.ndarray) -> np.ndarray:
    """(4 F, 3, n) of the (F, 3, n) values at the corners: three outer triangles and the middle one, the same way around."""
    a, b, c = np.moveaxis(values, 1, 0)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    quarters = [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
    return np.stack([np.stack(corners, axis=1) for corners in quarters], axis=1).reshape(-1, *values.shape[1:])


def _look_of(part: Part, face: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """As `Body._look`, of one part: the metallic-roughness model in the terms diffuse, specular and roughness.

    A metal reflects its base colour as specular; anything else a little of white, and its base colour as diffuse.
    """
    surface = part.surface
    colour = np.tile(surface.colour, (len(face), 1))
    metallic, roughness = np.full(len(face), surface.metallic), np.full(len(face), surface.roughness)
    emission = np.tile(surface.emission, (len(face), 1))
    if part.tint is not None:
        colour = colour * np.einsum("nk,nkc->nc", weights, part.tint[face]).clip(0, 1)
    for use, pixels in _pixels(part, surface, face, weights).items():
        if use == "colour":
            colour = colour * pixels
        elif use == "emission":
            emission = emission * pixels
        else:  # numbers, not colours: as stored
            stored = srgb_encode(pixels)
            roughness, metallic = roughness * stored[:, 1], metallic * stored[:, 2]
    dielectric = (1 - metallic)[:, None]
    diffuse = colour * dielectric * (1 - surface.dielectric.max())
    specular = surface.dielectric * dielectric + colour * metallic[:, None]
    return np.hstack([diffuse, specular, emission, roughness[:, None]])


def _pixels(part: Part, surface: Surface, face: np.ndarray, weights: np.ndarray) -> dict[str, np.ndarray]:
    """use -> (N, 3) linear values of each texture that the part has coordinates for."""
    out = {}
    for use, texture in surface.textures.items():
        if texture.coordinates in part.uv:
            uv = np.einsum("nk,nkc->nc", weights, part.uv[texture.coordinates][face])
            uv = np.nan_to_num(uv @ texture.transform[:, :2].T + texture.transform[:, 2], posinf=0, neginf=0)
            wrap = tuple(("repeat", "clamp", "mirror").index(mode) for mode in texture.wrap)
            out[use] = look_up(texture.image, uv, wrap)
    return out


def fit(bodies: Sequence[Body], budget: int, largest: float) -> list[str]:
    """Bring the bodies to at most ``budget`` triangles, and none larger than ``largest`` while that leaves room.

    Every body may have an equal share of the budget: with fewer triangles than that, its large ones are subdivided. The
    largest bodies lose triangles then: all keep as many up to one number, which is as high as the budget allows. Where there is
    room left, the body of the largest triangle is subdivided further. Returns what was done, a sentence each.
    """
    before = {body.name: len(body.triangles) for body in bodies}
    for body in bodies:
        while body.largest > largest and 4 * len(body.triangles) <= budget // len(bodies):
            body.subdivide()
    counts = np.array([len(body.triangles) for body in bodies])
    cap = _cap(counts, budget)
    for body in bodies:
        if len(body.triangles) > cap:
            body.decimate(cap)
    if counts.sum() <= budget:
        subdivide(bodies, budget, largest)
    notes = []
    for body in bodies:
        now = len(body.triangles)
        if now != before[body.name]:
            how = "decimated" if body.source is None else "subdivided, as they are large,"
            notes.append(f"{body.name!r}: {before[body.name]:,} triangles {how} to {now:,}")
    total = sum(len(body.triangles) for body in bodies)
    if total > budget:
        notes.append(f"{total:,} triangles are left, {budget:,} were asked for: simplify the scene, or allow more")
    return notes


def subdivide(bodies: Sequence[Body], budget: int, largest: float) -> None:
    """Subdivide the body of the largest triangle, again and again, until none is over ``largest`` or the budget is spent."""
    while bodies:
        body = max(bodies, key=lambda body: body.largest)
        if body.largest <= largest or sum(len(b.triangles) for b in bodies) + 3 * len(body.triangles) > budget:
            break
        body.subdivide()


def _cap(counts: np.ndarray, budget: int) -> int:
    """The largest c with sum(min(counts, c)) <= budget; at least 1."""
    ordered = np.sort(counts)
    below = 0
    for index, count in enumerate(ordered):
        rest = len(ordered) - index
        if below + rest * count > budget:
            return max((budget - below) // rest, 1)
        below += count
    return int(ordered[-1])
