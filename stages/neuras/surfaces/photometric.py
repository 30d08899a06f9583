"""Vertices and cameras moved until the photos agree: a variational refinement, in the manner of Vu et al. (2012).

Each training ray's hit on the mesh is a sample. A triangle and barycentric weights name it, so its world point follows the
vertices, and its pixels follow the cameras. A sample is looked up in the photos that see it. What they differ by is least
squares in offsets of vertices along their normals and in a small motion of each camera. Gauss-Newton solves that, coarse to
fine, and all rays are cast anew before every step. One thread, the same bytes every time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.sparse.linalg import cg
from scipy.spatial.transform import Rotation

from stages.graphics.cameras import Camera
from stages.graphics.casting import Caster
from stages.graphics.geometry import measure
from stages.neuras.rasterizing.photos import beside, nearest
from stages.neuras.records import Mesh

LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32)
CONTRAST = 0.03  # of sRGB in [0, 1]: local contrast below this is not amplified to that of the rest
WINDOW = 3.0  # sigmas of the level: how wide the neighbourhood is that contrast is measured in
WHOLE = 0.95  # share of the neighbourhood that must count
ROBUST = 0.5  # of normalised luminance: larger differences count less and less (Geman-McClure)
BEHIND = 0.01  # share of its distance that a point may lie behind the surface and still be seen
FOLLOWED = 2  # cameras that one without a photo follows
ALIKE = np.radians(45)  # between the axes of cameras that look alike
LONGEST = 3.0  # sigmas of the level that a step moves a vertex at most, in pixels


@dataclass(frozen=True, eq=False)
class Photo:
    """image: (H, W, 3) uint8, sRGB. counts: (H, W) bool, its mask."""

    camera: Camera
    image: np.ndarray
    counts: np.ndarray


@dataclass(frozen=True)
class Settings:
    """How to refine. Offsets and motions are measured in pixels of the nearest camera, so far and near are alike.

    blurs: sigma of each level in pixels, coarse to fine; rounds: steps of each. neighbours: nearest photos that a photo is
    compared with. stride: pixels from sample to sample. smoothness: weight of the squared difference of two neighbouring
    vertices' offsets; closeness: of the squared offset; camera_closeness: of the squared motion. Weights are relative to what
    the photos weigh on the mean vertex or motion. vertices, cameras: whether they move. least_gain: share of the difference
    that must go, or nothing moves: photos of exact cameras differ too, and would move them by a tenth of a pixel.
    """

    vertices: bool = False
    cameras: bool = True
    blurs: tuple[float, ...] = (4.0, 2.0, 1.0)
    rounds: int = 3
    neighbours: int = 4
    stride: int = 2
    smoothness: float = 1.0
    closeness: float = 0.02
    camera_closeness: float = 0.003
    least_gain: float = 0.05


def refine(
    mesh: Mesh, photos: Sequence[Photo], settings: Settings, log: Callable[[str], None] = lambda line: None
) -> tuple[Mesh, list[Camera]]:
    """The mesh with moved vertices, and the photos' cameras, moved. Both as they were where that hardly helps."""
    cameras = [photo.camera for photo in photos]
    state = _State(mesh, cameras, settings)
    pairs = {number: beside(cameras, number, settings.neighbours) for number in range(len(cameras))}
    for line in _descend(state, photos, pairs, list(range(len(photos)))):
        log(line)
    finest = [normalised(photo, settings.blurs[-1]) for photo in photos]
    before, after = (
        differences(*scene, finest, pairs, settings.stride).difference
        for scene in ((mesh, cameras), (state.mesh, state.cameras))
    )
    log(f"difference {before:.4f} before, {after:.4f} after")
    if after > (1 - settings.least_gain) * before:
        log(f"less than {settings.least_gain:.0%} is gone (refine.least_gain), so nothing is moved")
        return mesh, cameras
    return state.mesh, state.cameras


def follow(camera: Camera, before: Sequence[Camera], after: Sequence[Camera]) -> Camera:
    """``camera`` with the motion of the two nearest cameras of ``before``, which went to ``after``; the nearer weighs more.

    Errors of poses change slowly along a drive, so a camera whose photo nobody looks at shares those of its neighbours. Motions
    are along a camera's own axes, so cameras that look alike are asked: not those of the next, opposite line of a flight, or of
    another camera of a car. Where none looks alike the camera stays.
    """
    alike = [number for number, other in enumerate(before) if _turn(camera, other) < ALIKE]
    if not alike:
        return camera
    near = [alike[number] for number in nearest([before[number] for number in alike], camera, FOLLOWED)]
    away = np.array([np.linalg.norm(before[number].position - camera.position) for number in near])
    weights = 1 / np.maximum(away, 1e-3 * max(away.max(), 1e-9))
    motions = np.array([motion_between(before[number], after[number]) for number in near])
    return moved(camera, weights @ motions / weights.sum())


def align(photo: Photo, mesh: Mesh, photos: Sequence[Photo], settings: Settings) -> Camera:
    """The camera of ``photo``, moved until it agrees with ``photos`` near it; they and the mesh stay."""
    around = [photo, *photos]
    state = _State(mesh, [one.camera for one in around], replace(settings, vertices=False, cameras=True))
    for _ in _descend(state, around, {0: list(range(1, len(around)))}, [0]):
        pass
    return state.cameras[0]


class _State:
    """What moves. offsets: (V,) pixels that each vertex has moved along its normals. motions: (C, 6), of each camera."""

    def __init__(self, mesh: Mesh, cameras: Sequence[Camera], settings: Settings):
        self.mesh, self.cameras, self.settings = mesh, list(cameras), settings
        self.offsets, self.motions = np.zeros(len(mesh.vertices)), np.zeros((len(cameras), 6))
        distances = np.full(len(mesh.vertices), np.inf)
        self.pixel = distances.copy()  # (V,) world units that a pixel of the nearest camera spans at the vertex
        for camera in cameras:
            away = np.linalg.norm(mesh.vertices - camera.position, axis=1)
            distances, self.pixel = np.minimum(distances, away), np.minimum(self.pixel, away / camera.fx)
        reach = float(np.median(distances))  # a point so far away moves a pixel by each unit below
        self.units = np.array([[1.0] * 3 + [reach] * 3 for _ in cameras]) / [[camera.fx] for camera in cameras]
        self.smooth = _differences(mesh)

    def move_cameras(self, equations: Equations, free: Sequence[int]) -> None:
        """One step of the cameras ``free`` together, held by the prior to where they began."""
        rows = np.concatenate([np.arange(6 * number, 6 * number + 6) for number in free])
        units = self.units.ravel()[rows]
        matrix = equations.motion_matrix.reshape(self.motions.size, -1)[np.ix_(rows, rows)] * units * units[:, None]
        prior = self.settings.camera_closeness * max(np.trace(matrix) / len(rows), 1e-9)
        pull = equations.motion_pull.ravel()[rows] * units - prior * self.motions.ravel()[rows] / units
        step = np.linalg.solve(matrix + prior * np.eye(len(rows)), pull) * units
        self.motions.ravel()[rows] += step
        for number, motion in zip(free, step.reshape(-1, 6), strict=True):
            self.cameras[number] = moved(self.cameras[number], motion)

    def move_vertices(self, equations: Equations, longest: float) -> None:
        """One step of all vertices, at most ``longest`` pixels."""
        weights = equations.weights @ sparse.diags(self.pixel)
        matrix = (weights.T @ sparse.diags(equations.offset_matrix) @ weights).tocsr()
        prior = self.settings.smoothness * self.smooth + self.settings.closeness * sparse.eye(len(self.pixel))
        prior *= max(matrix.diagonal().mean(), 1e-9)
        matrix += prior
        pull = weights.T @ equations.offset_pull - prior @ self.offsets
        step, _ = cg(matrix, pull, rtol=1e-3, maxiter=300, M=sparse.diags(1 / matrix.diagonal()))
        step = np.clip(step, -longest, longest)
        self.offsets += step
        vertices = self.mesh.vertices + vertex_normals(self.mesh) * (step * self.pixel)[:, None]
        self.mesh = Mesh(vertices.astype(np.float32), self.mesh.faces)


def _descend(state: _State, photos: Sequence[Photo], pairs: dict[int, list[int]], free: list[int]) -> Iterator[str]:
    """All steps; says after each how far it is."""
    phase, settings = 0, state.settings
    for blur in settings.blurs:
        levels = [normalised(photo, blur) for photo in photos]
        for _ in range(settings.rounds):
            equations = differences(state.mesh, state.cameras, levels, pairs, settings.stride, phase)
            if settings.cameras:
                state.move_cameras(equations, free)
            if settings.vertices:
                state.move_vertices(equations, LONGEST * blur)
            phase += 1
            yield (
                f"blur {blur:g}  difference {equations.difference:.4f} of {equations.count:,} samples"
                f"  vertices moved {np.sqrt(np.square(state.offsets).mean()):.3f} px"
                f"  cameras {np.sqrt(np.square(state.motions / state.units).mean()):.3f} px"
            )


@dataclass(frozen=True, eq=False)
class Equations:
    """Normal equations at a point.

    weights: (S, V), barycentric, of samples by vertices. offset_matrix, offset_pull: (S,), of a sample's offset along its
    normal: curvature, and what it is drawn to, negative gradient. motion_matrix: (C, 6, C, 6), motion_pull: (C, 6), likewise
    of motions. difference: mean robust difference of ``count`` pairs of looks.
    """

    weights: sparse.csr_matrix
    offset_matrix: np.ndarray
    offset_pull: np.ndarray
    motion_matrix: np.ndarray
    motion_pull: np.ndarray
    difference: float
    count: int


def differences(
    mesh: Mesh,
    cameras: Sequence[Camera],
    levels: Sequence[Level],
    pairs: dict[int, list[int]],
    stride: int,
    phase: int = 0,
) -> Equations:
    """What the photos of ``pairs`` (of each photo: those that its samples are looked up in) differ by, and how that changes.

    levels: of each photo. phase: which of the stride squared grids of pixels.
    """
    caster, normals = Caster(mesh.vertices, mesh.faces), vertex_normals(mesh)
    motion_matrix, motion_pull = np.zeros((len(cameras), 6, len(cameras), 6)), np.zeros((len(cameras), 6))
    parts, total, count = [], 0.0, 0
    for own, others in pairs.items():
        samples = _samples(caster, cameras[own], levels[own], normals, stride, phase)
        matrix, pull = np.zeros(len(samples.points)), np.zeros(len(samples.points))
        for other in others:
            rows, difference, by_offset, by_motions = _looked_up(samples, caster, cameras[other], levels[other])
            square = np.square(difference)
            weight = (ROBUST**2 / (ROBUST**2 + square)) ** 2
            matrix[rows] += weight * np.square(by_offset)
            pull[rows] -= weight * by_offset * difference
            block, part = (by_motions * weight[:, None]).T @ by_motions, by_motions.T @ (weight * difference)
            for a, first in enumerate((own, other)):
                motion_pull[first] -= part[6 * a : 6 * a + 6]
                for b, second in enumerate((own, other)):
                    motion_matrix[first, :, second] += block[6 * a : 6 * a + 6, 6 * b : 6 * b + 6]
            total += float((square / (ROBUST**2 + square)).sum())
            count += len(rows)
        parts.append((samples.corners, samples.weights, matrix, pull))
    corners, weights, matrix, pull = (np.concatenate(values) for values in zip(*parts, strict=True))
    starts = np.arange(0, corners.size + 1, 3)
    sparse_weights = sparse.csr_matrix((weights.ravel(), corners.ravel(), starts), (len(corners), len(mesh.vertices)))
    return Equations(sparse_weights, matrix, pull, motion_matrix, motion_pull, total / max(count, 1), count)


@dataclass(frozen=True, eq=False)
class _Samples:
    """Points of the mesh that a photo sees. corners, weights: (S, 3), vertices and barycentric weights. points, normals:
    (S, 3). value: (S,), what the photo has there; by_point: (S, 3), by_motion: (S, 6), how it changes with point and camera."""

    corners: np.ndarray
    weights: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    value: np.ndarray
    by_point: np.ndarray
    by_motion: np.ndarray


def _samples(caster: Caster, camera: Camera, level: Level, normals: np.ndarray, stride: int, phase: int) -> _Samples:
    row, column = divmod(phase % stride**2, stride)
    rows, columns = np.nonzero(level.usable[row::stride, column::stride])
    rows, columns = row + stride * rows, column + stride * columns
    directions = camera.directions(np.stack([columns, rows], axis=1) + 0.5)
    face, barycentric, depth = caster.cast(np.broadcast_to(camera.position, directions.shape), directions)
    hit = face >= 0
    corners = caster.faces[face[hit]]
    weights = np.concatenate([1 - barycentric.sum(axis=1, keepdims=True), barycentric], axis=1)[hit].astype(np.float64)
    points = camera.position + directions[hit] * depth[hit, None]
    value, *slopes = level.planes[:, rows[hit], columns[hit]]
    _, by_point, by_motion = project(camera, points)
    return _Samples(
        corners,
        weights,
        points,
        np.einsum("sk,skc->sc", weights, normals[corners]),
        value,
        _chain(slopes, by_point),
        _chain(slopes, by_motion),
    )


def _looked_up(
    samples: _Samples, caster: Caster, camera: Camera, level: Level
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Rows (R,) of the samples that another photo sees, what it has there less their own (R,), and how that changes: by the
    sample's offset (R,), and by the motions (R, 12) of its own camera and of this one."""
    pixels, by_point, by_motion = project(camera, samples.points)
    places = pixels - 0.5
    with np.errstate(invalid="ignore"):
        rows = np.flatnonzero(((places >= 1) & (places <= (camera.width - 2, camera.height - 2))).all(axis=1))
    column, row = np.rint(places[rows]).astype(int).T
    rows = rows[level.usable[row, column]]
    ways = samples.points[rows] - camera.position
    lengths = np.linalg.norm(ways, axis=1)
    ways /= lengths[:, None]
    rows = rows[~caster.occluded(np.broadcast_to(camera.position, ways.shape), ways, lengths * (1 - BEHIND))]
    value, *slopes = (map_coordinates(plane, places[rows].T[::-1], order=1, mode="nearest") for plane in level.planes)
    by_offset = np.einsum("sc,sc->s", _chain(slopes, by_point[rows]) - samples.by_point[rows], samples.normals[rows])
    by_motions = np.concatenate([-samples.by_motion[rows], _chain(slopes, by_motion[rows])], axis=1)
    return rows, value - samples.value[rows], by_offset, by_motions


def _chain(slopes: Sequence[np.ndarray], by: np.ndarray) -> np.ndarray:
    """(S, K): slopes along x and y times how the pixel changes, ``by`` (S, 2, K)."""
    return slopes[0][:, None] * by[:, 0] + slopes[1][:, None] * by[:, 1]


@dataclass(frozen=True, eq=False)
class Level:
    """A photo as it is compared. planes: (3, H, W) float32, a value and its slopes along x and y, per pixel. usable: (H, W)
    bool."""

    planes: np.ndarray
    usable: np.ndarray


def normalised(photo: Photo, blur: float) -> Level:
    """Blurred luminance without local brightness and contrast, so neither exposure nor a soft sheen pulls at the surface.

    Pixels that do not count enter no mean. Close to them and to the border the neighbourhood is cut, by another line in every
    photo, so what is measured there is not used.
    """
    counts = photo.counts.astype(np.float32)

    def mean(values: np.ndarray, sigma: float) -> np.ndarray:
        total = gaussian_filter(values * counts, sigma, mode="constant")
        return total / np.maximum(gaussian_filter(counts, sigma, mode="constant"), 1e-6)

    grey = mean(photo.image.astype(np.float32) @ LUMINANCE / 255, blur)
    wide = WINDOW * max(blur, 1.0)
    local = grey - mean(grey, wide)
    value = local / (np.sqrt(mean(np.square(local), wide)) + CONTRAST)
    down, across = np.gradient(value)
    return Level(np.stack([value, across, down]), gaussian_filter(counts, wide, mode="constant") > WHOLE)


def project(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels (N, 2) of world ``points`` (N, 3), their derivatives by the point (N, 2, 3) and by a motion (N, 2, 6).

    Points behind the camera have NaN.
    """
    turn = camera.camera_to_world[:3, :3]
    x, y, back = ((points - camera.position) @ turn).T
    ahead = np.where(back < 0, -back, np.nan)
    pixels = np.stack([camera.cx + camera.fx * x / ahead, camera.cy - camera.fy * y / ahead], axis=1)
    zero = np.zeros_like(x)
    across = np.stack([camera.fx / ahead, zero, camera.fx * x / ahead**2], axis=1)
    down = np.stack([zero, -camera.fy / ahead, -camera.fy * y / ahead**2], axis=1)
    local = np.stack([across, down], axis=1)
    turned = np.stack([zero, -back, y, back, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)  # p x w = turned @ w
    return pixels, local @ turn.T, np.concatenate([local @ turned, -local], axis=2)


def moved(camera: Camera, motion: np.ndarray) -> Camera:
    """The camera after a ``motion`` (6,): a rotation vector in radians, then a way in world units, both along its own axes."""
    pose = camera.camera_to_world.copy()
    pose[:3, 3] += pose[:3, :3] @ motion[3:]
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(motion[:3]).as_matrix()
    return replace(camera, camera_to_world=pose)


def motion_between(before: Camera, after: Camera) -> np.ndarray:
    """(6,): what ``moved`` needs to get from one to the other."""
    turn = before.camera_to_world[:3, :3].T
    rotation = Rotation.from_matrix(turn @ after.camera_to_world[:3, :3]).as_rotvec()
    return np.concatenate([rotation, turn @ (after.position - before.position)])


def _turn(one: Camera, other: Camera) -> float:
    """Radians from the axes of one camera to those of the other."""
    return float(Rotation.from_matrix(one.camera_to_world[:3, :3].T @ other.camera_to_world[:3, :3]).magnitude())


def vertex_normals(mesh: Mesh) -> np.ndarray:
    """(V, 3) float64 unit vectors, means of the faces' by area."""
    vectors = measure.face_vectors(mesh.vertices.astype(np.float64), mesh.faces)
    sums = np.zeros((len(mesh.vertices), 3))
    for corner in range(3):
        np.add.at(sums, mesh.faces[:, corner], vectors)
    return sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-30)


def _differences(mesh: Mesh) -> sparse.csr_matrix:
    """(V, V): its quadratic form is the sum of squared differences along edges."""
    edges = np.unique(np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    starts = np.arange(0, edges.size + 1, 2)
    along = sparse.csr_matrix((np.tile([1.0, -1.0], len(edges)), edges.ravel(), starts), (len(edges), len(mesh.vertices)))
    return (along.T @ along).tocsr()
